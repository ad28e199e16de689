// Photographs with their state: sent, details found, compared, placed or left out and why.

import { html, useEffect, useRef, useState } from "./preact.js";
import { api, bytes, counted, of, phone, pictureUrl } from "./common.js";
import { isUploading, stateOf } from "./uploads.js";

const safe = (name) => name.replace(/[\s#]/g, "_"); // its name in the scene

export function Photographs({ detail, states, advice, choose, act, marked }) {
  const [open, setOpen] = useState(null);
  const up = stateOf(detail.key);
  const sending = isUploading(detail.key);
  const own = detail.kind === "project" && !detail.source;
  const warned = new Set((advice || []).flatMap((one) => one.names));
  const named = Object.keys(states).length > 0 && detail.photographs.some((one) => one.video)
    ? Object.keys(states).map((name) => ({ name, version: detail.result ? "made" : "now" }))
    : detail.photographs;
  const stateFor = (name) => states[name] || states[safe(name)] || {};
  return html`<div class="pad">
    ${own && html`<div class="row">
      <label class="button">Add photographs<input type="file" multiple accept="image/*,video/*,.heic,.heif,.dng,.nef,.cr2,.cr3,.arw" onChange=${(event) => choose(event.target.files, detail.key)} /></label>
      <span class="faint">${counted(detail.photographs.length, "file")}</span></div>
      ${phone(detail.phone, detail.key)}`}
    ${!own && detail.source && html`<p class="faint">${detail.source}</p>`}
    ${sending && html`<div class="upload" role="status">
      <progress max=${up.total || 1} value=${up.sent} aria-label="Upload"></progress>
      <p class="faint">${up.done} of ${up.count} sent · ${bytes(up.sent)} of ${bytes(up.total)}</p>
      ${up.pause && html`<p class="fault">${up.pause}</p>`}</div>`}
    ${up.faults.length > 0 && html`<ul class="faults" role="alert">${up.faults.slice(0, 5).map((text) => html`<li>${text}</li>`)}
      ${up.faults.length > 5 && html`<li>and ${up.faults.length - 5} more</li>`}</ul>`}
    ${!sending && detail.photographs.length > 0 && !detail.result && (advice === null
      ? html`<p class="faint pad" role="status">Looking at the photographs …</p>`
      : advice.length > 0
        ? html`<ul class="advice" aria-label="Advice">${advice.map((one) => html`<li>${one.text}</li>`)}</ul>`
        : html`<p class="faint pad" role="status">${detail.photographs.some((one) => one.video) ? "The video can be read." : "All photographs look good: sharp, bright, and with the same things in several of them."}</p>`)}
    <ul class="photographs" aria-label="Photographs">
      ${named.map((one) => html`<${Photograph} key=${one.name} item=${detail.key} one=${one} state=${stateFor(one.name)} warned=${warned.has(one.name)} marked=${marked}
        open=${() => setOpen(one)} />`)}
    </ul>
    ${!named.length && !sending && html`<p class="faint">Drop photographs, a folder or a video here.</p>`}
    ${open && html`<${Large} detail=${detail} one=${open} state=${stateFor(open.name)} close=${() => setOpen(null)} act=${act} own=${own} />`}
  </div>`;
}

function words(state) {
  if (state.left_out) return ["out", "left out"];
  if (state.duplicates) return ["out", `same as ${state.duplicates}`];
  if (state.placed) return ["placed", "placed"];
  if (state.matched) return ["busy", `matches ${state.matched}`];
  if (state.features) return ["busy", `${state.features.toLocaleString()} details`];
  return ["", ""];
}

// A photograph, small; while cameras are looked for, with its details as dots.
function Photograph({ item, one, state, warned, marked, open }) {
  const [kind, text] = words(state);
  const dots = useRef(null);
  const found = marked && state.features ? state.features : 0;
  const [tries, setTries] = useState(0);
  useEffect(() => {
    if (!found) return;
    api("GET", `${of(item)}/features?${new URLSearchParams({ name: safe(one.name) })}`).then((features) => {
      if (!features.length && tries < 20) setTimeout(() => setTries(tries + 1), 1500); // they are being written just now
      if (!dots.current) return;
      const [width, height] = [264, 198];
      Object.assign(dots.current, { width, height });
      const context = dots.current.getContext("2d");
      context.fillStyle = getComputedStyle(dots.current).getPropertyValue("--mark");
      for (const [x, y] of features) context.fillRect(x * width - 1, y * height - 1, 2, 2);
    }, () => {});
  }, [found, tries]);
  return html`<li><button class=${`photograph ${kind} ${warned ? "warned" : ""}`} onClick=${open} aria-label=${`${one.name}${text ? `, ${text}` : ""}${warned ? ", see the advice" : ""}`}>
    <img loading="lazy" alt="" src=${pictureUrl(item, { name: one.name, v: one.version })} onError=${(event) => (event.target.style.visibility = "hidden")} />
    ${found > 0 && html`<canvas ref=${dots} aria-hidden="true"></canvas>`}
    ${one.video && html`<span class="badge">video</span>`}
    ${text && html`<span class=${`mark ${kind}`}>${text}</span>`}
  </button></li>`;
}

// A photograph, large, with the details that were found in it.
function Large({ detail, one, state, close, act, own }) {
  const dialog = useRef(null);
  const canvas = useRef(null);
  const [features, setFeatures] = useState([]);
  useEffect(() => {
    dialog.current.showModal();
    api("GET", `${of(detail.key)}/features?${new URLSearchParams({ name: safe(one.name) })}`).then(setFeatures, () => {});
  }, []);
  const draw = () => {
    const image = dialog.current?.querySelector("img");
    if (!image?.naturalWidth || !canvas.current) return;
    const { naturalWidth: width, naturalHeight: height } = image;
    Object.assign(canvas.current, { width, height });
    const context = canvas.current.getContext("2d");
    context.fillStyle = getComputedStyle(canvas.current).getPropertyValue("--mark");
    for (const [x, y] of features) context.fillRect(x * width - 1.5, y * height - 1.5, 3, 3);
  };
  useEffect(draw, [features]);
  const leave = async () => {
    await act(() => api("DELETE", `${of(detail.key)}/photographs?${new URLSearchParams({ name: one.name })}`));
    close();
  };
  const why = state.left_out || state.blurred || (state.duplicates ? `shows the same as ${state.duplicates}` : "");
  return html`<dialog ref=${dialog} class="large" onClose=${close} aria-label=${one.name}>
    <div class="picture"><img alt=${one.name} src=${pictureUrl(detail.key, { name: one.name, side: 1400, v: one.version })} onLoad=${draw} /><canvas ref=${canvas} aria-hidden="true"></canvas></div>
    <p>${one.name}${state.features ? ` · ${state.features.toLocaleString()} details` : ""}${state.placed ? " · placed" : ""}</p>
    ${why && html`<p class="fault">${why}</p>`}
    <div class="row">${own && html`<button onClick=${leave}>Leave it out</button>`}<button class="main" onClick=${() => dialog.current.close()}>Close</button></div>
  </dialog>`;
}
