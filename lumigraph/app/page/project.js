// Page of a scene: photographs, making, the scene itself, files to share.

import { html, useEffect, useRef, useState } from "./preact.js";
import { api, judged, of, repeat } from "./common.js";
import { Cameras } from "./cameras.js";
import { Compare } from "./compare.js";
import { Findings, Making } from "./making.js";
import { Photographs } from "./photographs.js";
import { Share } from "./share.js";
import { isUploading, stateOf } from "./uploads.js";

const NO_MODEL = { version: "", cameras: [], points: [] };

export function Project({ item, say, choose, go }) {
  const [detail, setDetail] = useState(null);
  const [fault, setFault] = useState("");
  const [states, setStates] = useState({});
  const [model, setModel] = useState(NO_MODEL);
  const [advice, setAdvice] = useState(null); // of all photographs; null before they have been looked at
  const [title, setTitle] = useState(null);
  const [tab, setTab] = useState(null);
  const [run, setRun] = useState("");
  const [, tick] = useState(0);
  const latest = useRef({});

  const load = async () => {
    try {
      const found = await api("GET", of(item));
      setDetail(found);
      setFault("");
      const capturing = found.make?.state === "running" && found.make.stage === "capture";
      const settled = `${found.make?.stage} ${found.result?.placed}`;
      if (capturing || latest.current.settled !== settled) {
        latest.current.settled = settled;
        const [marks, shape] = await Promise.all([api("GET", `${of(item)}/states`), api("GET", `${of(item)}/model`)]);
        setStates(marks);
        setModel((before) => (shape.version || !capturing ? shape : before));
      }
      const arrived = found.photographs.length;
      if (latest.current.arrived !== arrived && found.kind !== "run") {
        latest.current.arrived = arrived;
        latest.current.stale = true;
        setAdvice(null);
      }
      advise();
    } catch (error) {
      setFault(error.message);
    }
  };
  const advise = async () => {
    if (!latest.current.stale || latest.current.asking || isUploading(item)) return; // one at a time: it takes longer than other requests
    Object.assign(latest.current, { stale: false, asking: true });
    const found = await api("GET", `${of(item)}/advice`).catch(() => null);
    latest.current.asking = false;
    if (!latest.current.stale) setAdvice(found);
  };
  useEffect(() => repeat(1, load), [item]);
  useEffect(() => {
    const state = stateOf(item);
    const told = () => tick((n) => n + 1);
    state.listeners.add(told);
    return () => state.listeners.delete(told);
  }, [item]);
  useEffect(() => {
    if (detail) document.title = `${detail.title} · Lumigraph`;
  }, [detail?.title]);

  const act = async (doing) => {
    try {
      const found = await doing();
      if (found?.key === item) setDetail(found);
      else if (found?.make) go(found.key); // a scene of the command line is made in a project of its own
      return found;
    } catch (error) {
      say(error.message);
      return null;
    } finally {
      load();
    }
  };

  const rename = (event) => {
    event.preventDefault();
    setTitle(null);
    api("PATCH", of(item), { title }).then(({ key }) => (key === item ? load() : go(key)), (error) => say(error.message));
  };

  if (!detail) {
    return html`<header class="top"><a class="back" href="#">‹ All scenes</a></header>
      <main class="narrow">${fault ? html`<p class="fault" role="alert">${fault}</p>` : html`<p class="faint">Opening …</p>`}</main>`;
  }
  const { make } = detail;
  const capturing = make?.state === "running" && make.stage === "capture";
  const trained = detail.runs.filter((one) => one.trained);
  const shown = tab || (detail.live || (trained.length && !capturing) ? "scene" : model.cameras.length && make?.state !== "failed" ? "cameras" : "photographs");
  const viewed = run || trained.at(-1)?.name || "";
  const page = detail.shares.find((one) => one.kind === "page" && one.run === viewed);
  const paged = detail.kind === "project" && !detail.live && page?.state !== "failed" && trained.some((one) => one.name === viewed && one.splats);
  const tabs = [
    ["scene", "Scene", detail.live || trained.length > 0],
    ["edit", "Edit", paged],
    ["compare", "Compare", trained.some((one) => one.photographs) && !detail.live],
    ["cameras", "Cameras", model.cameras.length > 0],
    ["photographs", "Photographs", detail.kind !== "run"],
  ].filter(([, , there]) => there);
  const active = tabs.some(([name]) => name === shown) ? shown : tabs[0]?.[0];
  const keys = (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const at = tabs.findIndex(([name]) => name === active);
    const next = tabs[(at + step + tabs.length) % tabs.length][0];
    setTab(next);
    document.getElementById(`tab-${next}`)?.focus();
  };
  return html`
    <header class="top">
      <a class="back" href="#" aria-label="All scenes">‹ <span>All scenes</span></a>
      ${title === null
        ? html`<h1 title=${detail.folder}>${detail.title}</h1>
          ${detail.kind !== "scene" && html`<button class="plain" aria-label="Rename" onClick=${() => setTitle(detail.title)}>✎</button>`}`
        : html`<form class="row tight" onSubmit=${rename}><input aria-label="New name" maxlength="120" value=${title} ref=${(field) => field && field !== document.activeElement && field.focus()}
            onInput=${(event) => setTitle(event.target.value)} onKeyDown=${(event) => event.key === "Escape" && setTitle(null)} /><button class="main">Rename</button></form>`}
    </header>
    ${fault && html`<p class="fault" role="alert">${fault}</p>`}
    ${detail.faults.map((text) => html`<p class="fault">${text}</p>`)}
    <main class="project">
      <section class="stage" aria-label="Scene">
        <div class="tabs" role="tablist" onKeyDown=${keys}>
          ${tabs.map(([name, title]) => html`<button role="tab" id=${`tab-${name}`} aria-selected=${active === name} aria-controls="stage"
            tabindex=${active === name ? 0 : -1} onClick=${() => setTab(name)}>${title}</button>`)}
          ${["scene", "edit", "compare"].includes(active) && !detail.live && trained.length > 1 && html`<label class="versions"><span class="hidden">Version</span>
            <select value=${viewed} onChange=${(event) => setRun(event.target.value)}>
              ${trained.map((one, i) => html`<option value=${one.name}>${["Version " + (i + 1), one.name.endsWith("-part") && "a part", one.psnr && judged(one.psnr, one.held_out).toLowerCase()].filter(Boolean).join(" · ")}</option>`)}
            </select></label>`}
        </div>
        <div class=${`view on-${active}`} id="stage" role="tabpanel" aria-labelledby=${`tab-${active}`}>
          ${active === "scene" && paged && html`<${ScenePage} key=${viewed} item=${item} run=${viewed} page=${page} act=${act} />`}
          ${(active === "edit" || (active === "scene" && !paged)) && html`<${SceneView} key=${detail.live ? "live" : viewed} item=${item} run=${detail.live ? "" : viewed} live=${detail.live} />`}
          ${active === "compare" && html`<${Compare} key=${viewed} detail=${detail} run=${viewed} act=${act} />`}
          ${active === "cameras" && html`<${Cameras} model=${model} />`}
          ${active === "photographs" && html`<${Photographs} detail=${detail} states=${states} advice=${advice} choose=${choose} act=${act} marked=${capturing} />`}
          ${!active && html`<p class="faint pad">Nothing to show yet.</p>`}
        </div>
      </section>
      <aside class="side">
        <${Making} detail=${detail} act=${act} uploading=${isUploading(item)} show=${setTab} />
        ${detail.result && html`<${Findings} detail=${detail} act=${act} say=${say} show=${setTab} />`}
        ${trained.length > 0 && html`<${Share} detail=${detail} run=${viewed} act=${act} say=${say} />`}
      </aside>
    </main>`;
}

// The page to share, made at the first look.
function ScenePage({ item, run, page, act }) {
  const asked = useRef(false);
  useEffect(() => {
    if (page?.bytes || asked.current || ["queued", "running"].includes(page?.state)) return;
    asked.current = true;
    act(() => api("POST", `${of(item)}/shares`, { kind: "page", run }));
  }, [page?.bytes, page?.state]);
  if (!page?.bytes) return html`<${Wait} words="Opening the scene" />`;
  const query = new URLSearchParams({ show: "", v: page.bytes });
  return html`<iframe title="The scene in 3-D" src=${`/api/${of(item)}/shares/${encodeURIComponent(page.name)}?${query}`} allow="fullscreen"></iframe>`;
}

const Wait = ({ words }) => html`<div class="wait"><span class="spinner" aria-hidden="true"></span><p role="status">${words}</p></div>`;

// The viewer of `lumigraph view`, or of a training under way, in a frame.
function SceneView({ item, run, live }) {
  const [url, setUrl] = useState("");
  const [fault, setFault] = useState("");
  useEffect(() => {
    let ended = false;
    const ask = async () => {
      while (!ended) {
        try {
          const found = await api("POST", `${of(item)}/view`, { run });
          if (found.ready) {
            if (!ended) setUrl(found.url);
            return;
          }
          setFault("");
        } catch (error) {
          setFault(error.message);
          if (!error.away) return;
        }
        await new Promise((done) => setTimeout(done, 700));
      }
    };
    ask();
    return () => (ended = true);
  }, [item, run]);
  if (fault) return html`<p class="fault pad" role="alert">${fault}</p>`;
  if (!url) return html`<${Wait} words=${live ? "Preparing the training" : "Opening the scene"} />`;
  return html`<iframe title="The scene in 3-D" src=${url} allow="fullscreen"></iframe>`;
}
