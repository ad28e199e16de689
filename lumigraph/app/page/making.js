// Making a scene: quality, progress, pause and stop, failures with their remedies, findings of the capture.

import { html, useEffect, useState } from "./preact.js";
import { api, counted, judged, lasting, nearly, of } from "./common.js";

const QUALITIES = [
  ["draft", "Draft", "to check the photographs"],
  ["good", "Good", "most of the possible sharpness"],
  ["best", "Best", "as sharp as it gets"],
];
const LEAST = 3; // photographs of a capture
const METHODS = [
  ["gaussian-splatting", "Gaussian splatting: quick, for pages and films"],
  ["instant-ngp", "Instant-NGP: a field, for reflections and fine detail"],
  ["planar-splatting", "Planar splatting: for meshes"],
  ["nerf-w", "NeRF-W: photographs of different days"],
];

export function Making({ detail, act, uploading, show }) {
  const { make } = detail;
  if (detail.kind === "run") return html`<${Continue} detail=${detail} act=${act} />`;
  if (make && ["running", "queued"].includes(make.state)) return html`<${Progress} detail=${detail} act=${act} show=${show} />`;
  if (make && make.state === "paused") return html`<${Paused} detail=${detail} act=${act} />`;
  const trained = detail.runs.some((one) => one.trained);
  return html`
    ${make?.state === "failed" && html`<${Failed} detail=${detail} act=${act} show=${show} />`}
    ${trained && html`<${Continue} detail=${detail} act=${act} />`}
    ${!trained && html`<${Choose} detail=${detail} act=${act} uploading=${uploading} show=${show} first=${true} />`}`;
}

// Seconds by method and quality, on this computer.
function useEstimates(detail, uploading) {
  const [found, setFound] = useState({});
  useEffect(() => {
    if (detail.photographs.length && !uploading) api("GET", `${of(detail.key)}/estimates`).then(setFound, () => {});
  }, [detail.key, detail.photographs.length, uploading]);
  return found;
}

function Choose({ detail, act, uploading, show, first }) {
  const [quality, setQuality] = useState("draft");
  const [method, setMethod] = useState("gaussian-splatting");
  const [mapper, setMapper] = useState("incremental");
  const [minutes, setMinutes] = useState("");
  const [frames, setFrames] = useState("");
  const [masked, setMasked] = useState(false);
  const [known, setKnown] = useState(METHODS);
  const video = detail.photographs.some((one) => one.video);
  const few = detail.kind === "project" && !detail.source && !video && detail.photographs.length < LEAST;
  const ready = detail.photographs.length > 0 && !few && !uploading;
  const times = useEstimates(detail, uploading)[method] || {};
  const start = async () => {
    const body = { quality, method, mapper, mask_object: masked };
    if (minutes) body.minutes = Number(minutes);
    if (frames) body.frames = Number(frames);
    show(null);
    await act(() => api("POST", `${of(detail.key)}/make`, body));
  };
  return html`<section class="panel" aria-label="Make the scene">
    ${first && html`<h2>Make the scene</h2>`}
    <div class="choices" role="radiogroup" aria-label="Quality">
      ${QUALITIES.map(([name, title, about]) => html`<label class=${quality === name ? "choice on" : "choice"}>
        <input type="radio" name="quality" value=${name} checked=${quality === name} onChange=${() => setQuality(name)} />
        <strong>${title}${times[name] && !minutes ? html` <span class="faint">${nearly(times[name])}</span>` : ""}</strong><span class="faint">${about}</span></label>`)}
    </div>
    <details class="advanced"><summary>Advanced</summary>
      <label>Method<select value=${method} onChange=${(event) => setMethod(event.target.value)}>
        ${known.map(([name, title]) => html`<option value=${name}>${title}</option>`)}</select></label>
      <label>Minutes of training, instead of the quality<input type="number" min="0.1" max="10000" step="any" value=${minutes} onInput=${(event) => setMinutes(event.target.value)} /></label>
      <label>Placing cameras<select value=${mapper} onChange=${(event) => setMapper(event.target.value)}>
        <option value="incremental">one after another</option><option value="global">all at once, quicker for hundreds</option></select></label>
      ${video && html`<label>Frames of the video<input type="number" min="3" max="1000" placeholder="by its length" value=${frames} onInput=${(event) => setFrames(event.target.value)} /></label>`}
      <label class="check"><input type="checkbox" checked=${masked} onChange=${(event) => setMasked(event.target.checked)} /> One object in front of a backdrop: mask it</label>
    </details>
    <button class="main wide" disabled=${!ready} onClick=${start}>${uploading ? "The photographs are on their way" : few && detail.photographs.length ? `Add photographs: ${LEAST} are the least` : "Make the scene"}</button>
  </section>`;
}

function Progress({ detail, act, show }) {
  const { make } = detail;
  if (make.state === "queued") {
    const { ahead } = detail;
    return html`<section class="panel" aria-label="Progress"><h2>Waiting</h2>
      <p class="faint" role="status">${ahead ? `“${ahead.title}” is being made${ahead.left ? `, ${nearly(ahead.left)} more` : ""}${ahead.between ? `, then ${counted(ahead.between, "other scene")}` : ""}.` : "It begins in a moment."}</p>
      <div class="row">${ahead && html`<button class="main" onClick=${() => act(() => api("POST", `${of(detail.key)}/first`))}>Start now, pause that</button>`}
      <button onClick=${() => act(() => api("POST", `${of(detail.key)}/stop`))}>Stop</button></div></section>`;
  }
  const { progress } = make;
  const training = make.stage === "train";
  const share = Math.round(100 * progress.share);
  const facts = training
    ? [progress.psnr && `${progress.psnr.toFixed(1)} dB`, progress.gaussians && `${Math.round(progress.gaussians).toLocaleString()} Gaussians`, progress.step && `step ${progress.step.toLocaleString()}`]
    : [progress.said];
  const left = progress.left ? `${nearly(progress.left)} left` : "";
  return html`<section class="panel" aria-label="Progress">
    <ol class="steps"><li class="done">Photographs</li><li class=${training ? "done" : "now"}>Cameras</li><li class=${training ? "now" : ""}>Training</li></ol>
    <div class="line"><h2><span role="status">${progress.stage}</span></h2><span>${share} %</span></div>
    <progress max="100" value=${share} aria-label=${progress.stage}></progress>
    <p class="faint">${left || " "}</p>
    <div class="row">
      <button onClick=${() => act(() => api("POST", `${of(detail.key)}/pause`))}>Pause</button>
      <button onClick=${() => act(() => api("POST", `${of(detail.key)}/stop`))}>${training ? "Stop here" : "Stop"}</button>
      ${training && make.next && html`<button onClick=${() => act(() => api("POST", `${of(detail.key)}/more`, { quality: make.next }))}>More time: ${make.next}</button>`}
    </div>
    <details class="advanced"><summary>Details</summary><p class="faint">${facts.filter(Boolean).join(" · ")}</p>
      ${training && progress.curve?.length > 2 && html`<${Curve} points=${progress.curve} />`}</details>
    <${Messages} lines=${make.messages} />
  </section>`;
}

function Curve({ points }) {
  const [w, h] = [260, 70];
  const xs = points.map(([x]) => x);
  const ys = points.map(([, y]) => y);
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const at = ([x, y]) => `${((w * (x - x0)) / (x1 - x0 || 1)).toFixed(1)},${(h - 3 - ((h - 6) * (y - y0)) / (y1 - y0 || 1)).toFixed(1)}`;
  return html`<figure class="curve"><svg viewBox=${`0 0 ${w} ${h}`} preserveAspectRatio="none" role="img"
    aria-label=${`PSNR from ${y0.toFixed(1)} to ${y1.toFixed(1)} dB`}><polyline points=${points.map(at).join(" ")} vector-effect="non-scaling-stroke" /></svg>
    <figcaption class="faint">PSNR of training photographs, ${y0.toFixed(1)} to ${y1.toFixed(1)} dB; it falls where larger pictures begin</figcaption></figure>`;
}

function Paused({ detail, act }) {
  const { make } = detail;
  return html`<section class="panel" aria-label="Paused"><h2>Paused</h2>
    ${make.fault
      ? html`<p class="fault" role="alert">${make.fault}</p>`
      : html`<p class="faint">What is done is kept${make.progress ? `: ${make.progress.stage.toLowerCase()}, ${Math.round(100 * make.progress.share)} %` : ""}.</p>`}
    <div class="row"><button class="main" onClick=${() => act(() => api("POST", `${of(detail.key)}/more`, {}))}>Go on</button>
    <button onClick=${() => act(() => api("POST", `${of(detail.key)}/stop`))}>Stop here</button></div></section>`;
}

function Failed({ detail, act, show }) {
  const { make } = detail;
  const again = (body) => act(() => api("POST", `${of(detail.key)}/make`, { quality: make.quality || "draft", method: make.method, mapper: make.mapper, ...body }));
  const other = make.mapper === "incremental" ? "global" : "incremental";
  return html`<section class="panel" aria-label="Failed"><h2>${make.stage === "capture" ? "The cameras were not found" : "The training has failed"}</h2>
    <p class="fault" role="alert">${make.fault}</p>
    <div class="row">
      <button class="main" onClick=${() => act(() => api("POST", `${of(detail.key)}/more`, {}))}>Try again</button>
      ${make.stage === "capture" && html`<button onClick=${() => again({ mapper: other })}>Use the other mapper</button>
        <button onClick=${() => show("photographs")}>Add photographs</button>`}
      ${make.stage === "train" && make.quality !== "draft" && html`<button onClick=${() => again({ quality: "draft" })}>Make a draft</button>`}
    </div>
    <${Messages} lines=${make.messages} /></section>`;
}

function Continue({ detail, act }) {
  const { make } = detail;
  const last = detail.runs.filter((one) => one.trained).at(-1);
  const [fresh, setFresh] = useState(false);
  const more = (body) => act(() => api("POST", `${of(detail.key)}/more`, body));
  const next = make ? make.next : "good";
  if (make && ["running", "queued"].includes(make.state)) return html`<${Progress} detail=${detail} act=${act} />`;
  const stopped = make && ["stopped", "failed", "paused"].includes(make.state);
  const times = useEstimates(detail, false)[last?.method] || {};
  const score = last?.psnr ? judged(last.psnr, last.held_out) : "";
  const help = score && score !== "Sharp" && !stopped && next ? `: ${times[next] ? `${nearly(times[next])} of training` : "more time"} may help` : "";
  return html`<section class="panel" aria-label="The scene"><h2>${stopped ? "Stopped" : "Ready"}</h2>
    ${score && html`<p>${score}${help}.</p>`}
    <div class="row">
      ${stopped && make.run && html`<button class="main" onClick=${() => more({})}>Go on</button>`}
      ${!stopped && next && (make || detail.kind === "run") && html`<button onClick=${() => more({ quality: next })}>More time: ${next}</button>`}
      ${!stopped && make?.seconds && html`<button onClick=${() => more({ minutes: (3 * make.seconds) / 60 })}>More time: ${lasting(3 * make.seconds)}</button>`}
      ${detail.photographs.length > 0 && detail.kind !== "run" && html`<button aria-expanded=${fresh} onClick=${() => setFresh(!fresh)}>Make it anew</button>`}
    </div>
    <details class="advanced"><summary>Details</summary><p class="faint">${[last?.method, last?.psnr && `${last.psnr.toFixed(1)} dB${last.held_out ? " held out" : " on training photographs"}`, make?.quality].filter(Boolean).join(" · ")}</p></details>
    ${fresh && html`<${Choose} detail=${detail} act=${act} uploading=${false} show=${() => {}} />`}
  </section>`;
}

const Messages = ({ lines }) => lines?.length
  ? html`<details class="advanced"><summary>Messages</summary><pre tabindex="0">${lines.join("\n")}</pre></details>` : null;

// Findings of the capture, with what to do as buttons.
export function Findings({ detail, act, show }) {
  const { result, make } = detail;
  const out = Object.entries(result.left_out || {});
  const busy = ["running", "queued"].includes(make?.state);
  const again = (mapper) => act(() => api("POST", `${of(detail.key)}/make`, { quality: make?.quality || "draft", method: make?.method || "gaussian-splatting", mapper }));
  const directions = (result.findings || []).filter((one) => !one.photograph).slice(0, 3);
  return html`<section class="panel" aria-label="Findings"><h2>Photographs</h2>
    <p title=${`${result.points.toLocaleString()} points, error ${result.error.toFixed(2)} pixels`}>${result.placed} of ${result.given} placed</p>
    ${out.length > 0 && html`<details class="advanced"><summary>${counted(out.length, "photograph")} left out: why</summary>
      <ul>${out.map(([name, why]) => html`<li><strong>${name}</strong> ${why}</li>`)}</ul></details>`}
    ${result.warnings.map((text) => html`<p class="warning">${text}</p>`)}
    ${directions.length > 0 && html`<details class="advanced"><summary>For a better scene</summary><ul>${directions.map((one) => html`<li>${one.advice}</li>`)}</ul></details>`}
    <div class="row">
      ${result.try && !busy && html`<button onClick=${() => again(result.try)}>Place them ${result.try === "global" ? "all at once" : "one after another"}</button>`}
      ${out.length > 0 && html`<button onClick=${() => show("photographs")}>Look at them</button>`}
    </div></section>`;
}
