// Photographs beside their renderings, under a slider.

import { html, useState } from "./preact.js";
import { api, judged, of, pictureUrl } from "./common.js";

export function Compare({ detail, run, act }) {
  const [chosen, choose] = useState("");
  const [at, setAt] = useState(50);
  const { views = [], stale = false } = detail.runs.find((one) => one.name === run)?.compared || {};
  const job = detail.shares.find((one) => one.kind === "compare" && one.run === run);
  const busy = ["queued", "running"].includes(job?.state);
  const make = html`<button class=${views.length ? "" : "main"} disabled=${busy}
    onClick=${() => act(() => api("POST", `${of(detail.key)}/shares`, { kind: "compare", run }))}>
    ${busy ? html`<span class="spinner small" aria-hidden="true"></span> ${job.state === "queued" ? "Waiting" : "Rendering"}`
      : views.length ? "Compare anew" : "Compare with photographs"}</button>`;
  const fault = job?.state === "failed" && html`<p class="fault" role="alert">${job.fault}</p>`;
  if (!views.length) return html`<div class="wait">${make}${fault || html`<p>Renders the views of up to twelve photographs, to lay them over each other.${detail.live ? " It begins when the training is done." : ""}</p>`}</div>`;
  const view = views.find((one) => one.name === chosen) || views[0];
  const source = (query) => pictureUrl(detail.key, { name: view.name, side: 1400, v: view.version, ...query });
  return html`<div class="compare">
    <div class="pair" style=${`--at: ${at}%`}>
      <img alt=${`Photograph ${view.name}`} src=${source({})} />
      <img class="rendering" alt=${`Rendering of the view of ${view.name}`} src=${source({ run })} />
      <span class="badge">photograph</span><span class="badge right">rendering</span>
      <input type="range" min="0" max="100" step="0.5" value=${at} aria-label="Photograph against rendering" onInput=${(event) => setAt(event.target.value)} />
    </div>
    <div class="row"><label><span class="hidden">Photograph</span><select value=${view.name} onChange=${(event) => choose(event.target.value)}>
      ${views.map((one) => html`<option value=${one.name}>${one.name} · ${judged(one.psnr, one.held_out).toLowerCase()}${one.held_out ? ", not trained on" : ""}</option>`)}</select></label>
      ${(stale || busy) && make}</div>${fault}
  </div>`;
}
