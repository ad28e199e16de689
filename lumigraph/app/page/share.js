// Files to share: each with its size before it is written, then to open or download.

import { html, useEffect, useState } from "./preact.js";
import { api, bytes, of } from "./common.js";

export function Share({ detail, run, act, say }) {
  const [kinds, setKinds] = useState([]);
  useEffect(() => {
    if (run) api("POST", `${of(detail.key)}/kinds`, { run }).then(setKinds, () => setKinds([]));
  }, [run, detail.make?.state]);
  const place = (name) => `/api/${of(detail.key)}/shares/${encodeURIComponent(name)}`;
  const training = ["running", "queued"].includes(detail.make?.state);
  return html`<section class="panel" aria-label="Share"><h2>Share</h2>
    ${training && html`<p class="faint">Files wait until the training is done or paused.</p>`}
    <ul class="shares">
      ${kinds.map((kind) => {
        const made = detail.shares.find((one) => one.kind === kind.kind && one.run === run);
        const busy = made && ["queued", "running"].includes(made.state);
        const size = made?.bytes ? bytes(made.bytes) : `about ${bytes(kind.bytes)}`;
        return html`<li key=${kind.kind}>
          <div><strong>${kind.title}</strong> <span class="faint">${size}</span><br /><span class="faint">${kind.about}</span></div>
          ${made?.bytes && kind.kind === "page" && html`<a class="button" target="_blank" rel="noopener" href=${`${place(made.name)}?show`}>Open</a>`}
          ${made?.bytes && html`<a class="button main" href=${place(made.name)} download=${made.name} aria-label=${`Download ${kind.title}`}>Download</a>`}
          ${!made?.bytes && html`<button disabled=${busy} aria-label=${`Make ${kind.title}`} onClick=${() => act(() => api("POST", `${of(detail.key)}/shares`, { kind: kind.kind, run }))}>
            ${busy ? html`<span class="spinner small" aria-hidden="true"></span> ${made.state === "queued" ? "Waiting" : "Making"}` : "Make"}</button>`}
          ${made?.state === "failed" && html`<p class="fault">${made.fault}</p>`}
        </li>`;
      })}
    </ul>
    ${detail.shares.some((one) => one.bytes) && html`<p class="faint">In ${detail.folder}/shared</p>
      ${detail.local && html`<button onClick=${() => act(() => api("POST", `${of(detail.key)}/reveal`))}>Show in folder</button>`}`}
  </section>`;
}
