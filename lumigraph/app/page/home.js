// Home: cards of all scenes and runs of the folder, and the place to drop photographs.

import { html, useEffect, useRef, useState } from "./preact.js";
import { ago, api, bytes, judged, of, phone, pictureUrl, repeat } from "./common.js";

export function Home({ say, choose, go }) {
  const [home, setHome] = useState(null);
  const [fault, setFault] = useState("");
  const [words, setWords] = useState("");
  const search = useRef(null);

  const load = async () => {
    try {
      setHome(await api("GET", "home"));
      setFault("");
    } catch (error) {
      setFault(error.message);
    }
  };
  useEffect(() => {
    document.title = "Lumigraph";
    return repeat(3, load);
  }, []);
  useEffect(() => {
    const pressed = (event) => {
      if (event.key === "/" && !/INPUT|TEXTAREA|SELECT/.test(document.activeElement.tagName)) {
        event.preventDefault();
        search.current?.focus();
      }
    };
    addEventListener("keydown", pressed);
    return () => removeEventListener("keydown", pressed);
  }, []);

  const asked = words.toLowerCase().split(/\s+/).filter(Boolean);
  const fits = (card) => asked.every((word) => `${card.title} ${card.method || ""} ${card.kind}`.toLowerCase().includes(word));
  const cards = home ? home.cards.filter(fits) : [];
  const act = async (doing) => {
    try {
      await doing();
    } catch (error) {
      say(error.message);
    }
    load();
  };
  return html`
    <header class="top">
      <h1><img src="/static/icon.svg" alt="" width="28" height="28" /> Lumigraph</h1>
      ${home && home.cards.length > 0 && html`
      <label class="search"><span class="hidden">Search scenes</span>
        <input ref=${search} type="search" placeholder="Search" value=${words} onInput=${(event) => setWords(event.target.value)} /></label>`}
    </header>
    <main>
      ${fault && html`<p class="fault" role="alert">${fault}</p>`}
      <${Drop} home=${home} choose=${choose} say=${say} go=${go} />
      ${home && home.cards.length > 0 && html`
        <ul class="cards" aria-label="Scenes">
          ${cards.map((card) => html`<${Card} key=${card.key} card=${card} act=${act} say=${say} load=${load} queue=${home.queue} />`)}
        </ul>
        ${cards.length === 0 && html`<p class="faint">No scene is called so.</p>`}`}
      ${home && html`<footer class="faint">
        <span title=${home.folder}>${home.folder}</span>
        ${home.trash.length > 0 && html`<details class="menu"><summary>Trash: ${home.trash.length}</summary><div class="sheet up">
          ${home.trash.map((one) => html`<div class="line" key=${one.name}><span>${[one.title, one.bytes !== null && bytes(one.bytes)].filter(Boolean).join(" · ")}</span>
            <button onClick=${() => act(() => api("POST", `trash/${encodeURIComponent(one.name)}`))}>Put back</button></div>`)}
          <button class="danger" onClick=${() => act(() => api("DELETE", "trash"))}>Delete for good</button>
        </div></details>`}
      </footer>`}
    </main>`;
}

function Drop({ home, choose, say, go }) {
  const small = home && home.cards.length > 0;
  const [path, setPath] = useState(null);
  const open = async (event) => {
    event.preventDefault();
    try {
      go((await api("POST", "projects", { title: path.replace(/[\\/]+$/, "").split(/[\\/]/).pop().replace(/\.\w{2,4}$/, ""), path })).key);
    } catch (fault) {
      say(fault.message);
    }
  };
  const example = () => api("POST", "example").then(({ key }) => go(key), (fault) => say(fault.message));
  return html`<section class=${small ? "drop small" : "drop"} aria-label="New scene">
    <div><h2>${small ? "New scene" : "Drop photographs, a folder or a video"}</h2>
    <p class="faint">${small
      ? "Drop photographs, a folder or a video anywhere on this page."
      : `Walk around the thing and take 20 to 60 photographs, or film it for half a minute. You get a scene to turn around, and can share it as a web page or a film. All stays on ${home?.local === false ? "the machine of this app" : "this machine"}.`}</p></div>
    <div class="row">
      <label class="button main">Choose photographs or a video
        <input type="file" multiple accept="image/*,video/*,.heic,.heif,.dng,.nef,.cr2,.cr3,.arw" onChange=${(event) => choose(event.target.files)} /></label>
      <label class="button">A folder
        <input type="file" webkitdirectory onChange=${(event) => choose(event.target.files)} /></label>
      ${home?.local && path === null && html`<button onClick=${() => setPath("")}>A path on this machine</button>`}
      ${home && !small && html`<button onClick=${example}>See an example</button>`}
    </div>
    ${home && phone(home.phone)}
    ${path !== null && html`<form class="row" onSubmit=${open}>
      <label class="wide"><span class="hidden">Folder of photographs, or video</span>
        <input autofocus placeholder="/home/me/photos/garden" value=${path} onInput=${(event) => setPath(event.target.value)} /></label>
      <button class="main" disabled=${!path.trim()}>Open</button></form>`}
  </section>`;
}

const STATES = { running: "being made", queued: "waiting", paused: "paused", failed: "failed", stopped: "stopped" };

function Card({ card, act, say, load, queue }) {
  const [title, setTitle] = useState(null);
  const share = card.share ? ` · ${Math.round(100 * card.share)} %` : "";
  const state = STATES[card.state] ? STATES[card.state] + share : "";
  const score = card.psnr && !state ? judged(card.psnr, card.held_out) : "";
  const facts = [score, card.bytes !== null && bytes(card.bytes), ago(card.age)].filter(Boolean);
  const rename = (event) => {
    event.preventDefault();
    act(() => api("PATCH", of(card.key), { title }));
    setTitle(null);
  };
  const remove = () => act(async () => {
    const { trash } = await api("DELETE", of(card.key));
    say(`${card.title} is in the trash`, { undo: () => act(() => api("POST", `trash/${encodeURIComponent(trash)}`)) });
  });
  const pick = (event, doing) => {
    event.target.closest("details").open = false;
    doing();
  };
  return html`<li class="card">
    <a href=${`#${encodeURIComponent(card.key)}`} aria-label=${`Open ${card.title}${state ? `, ${state}` : ""}`}>
      ${card.picture
        ? html`<img loading="lazy" alt="" src=${pictureUrl(card.key, { v: card.picture, side: 512 })} />`
        : html`<div class="blank">${card.kind === "project" ? (card.runs ? "a scene" : "no photographs yet") : card.kind}</div>`}
      ${state && html`<span class=${`badge ${card.state}`}>${state}</span>`}
    </a>
    <div class="line">
      ${title === null
        ? html`<h3 title=${card.title}>${card.title}</h3>`
        : html`<form class="row tight" onSubmit=${rename}><input aria-label="New name" value=${title} ref=${(field) => field && field !== document.activeElement && field.focus()}
            onInput=${(event) => setTitle(event.target.value)} onKeyDown=${(event) => event.key === "Escape" && setTitle(null)} /><button class="main">Rename</button></form>`}
      <details class="menu" onKeyDown=${(event) => event.key === "Escape" && (event.currentTarget.open = false)}>
        <summary aria-label=${`More for ${card.title}`}>⋯</summary>
        <div class="sheet">
          ${card.kind !== "scene" && html`<button onClick=${(event) => pick(event, () => setTitle(card.title))}>Rename</button>`}
          <button onClick=${(event) => pick(event, () => act(() => api("POST", `${of(card.key)}/duplicate`)))}>Duplicate</button>
          <button class="danger" onClick=${(event) => pick(event, remove)}>Delete</button>
        </div>
      </details>
    </div>
    <p class="faint" title=${card.psnr ? `${card.method}, ${card.psnr.toFixed(1)} dB on ${card.held_out ? "held-out" : "training"} photographs` : ""}>${card.fault && !state ? card.fault : facts.join(" · ")}</p>
  </li>`;
}
