// The app's page: home, and the page of a scene, chosen by the address behind #.

import { Component, html, render, useEffect, useState } from "./preact.js";
import { api, of } from "./common.js";
import { Home } from "./home.js";
import { Project } from "./project.js";
import { anyUploading, chosen, dropped, upload } from "./uploads.js";

const here = () => decodeURIComponent(location.hash.slice(1));
export const go = (key) => (location.hash = key ? encodeURIComponent(key) : "");

class Whole extends Component {
  componentDidCatch(fault) {
    this.setState({ fault });
  }
  render({ children }, { fault }) {
    if (!fault) return children;
    return html`<main class="narrow"><p class="fault">The page has failed: ${String(fault)}</p>
      <button onClick=${() => location.reload()}>Load it again</button></main>`;
  }
}

function App() {
  const [key, setKey] = useState(here());
  const [notice, setNotice] = useState(null);
  const [over, setOver] = useState(false);

  useEffect(() => {
    const moved = () => {
      setKey(here());
      scrollTo(0, 0);
    };
    const leave = (event) => anyUploading() && event.preventDefault();
    addEventListener("hashchange", moved);
    addEventListener("beforeunload", leave);
    return () => {
      removeEventListener("hashchange", moved);
      removeEventListener("beforeunload", leave);
    };
  }, []);

  useEffect(() => {
    if (!notice) return undefined;
    const timer = setTimeout(() => setNotice(null), notice.undo ? 12000 : 7000);
    return () => clearTimeout(timer);
  }, [notice]);

  const say = (text, more = {}) => setNotice({ text, ...more });

  // Photographs become a new scene on the home page, and more of the scene on its own page.
  const bring = async ({ title, files, aside }, into = key) => {
    if (!files.length) {
      say(aside ? "No photograph and no video is among these files" : "These files are empty");
      return;
    }
    try {
      const target = into || (await api("POST", "projects", { title: title || `Scene, ${new Date().toLocaleDateString(undefined, { day: "numeric", month: "long", year: "numeric" })}` })).key;
      upload(target, files);
      if (!into) go(target);
      if (aside) say(`${aside} other files were left aside`);
    } catch (fault) {
      say(fault.message);
    }
  };

  useEffect(() => {
    let depth = 0;
    const holds = (event) => [...event.dataTransfer.types].includes("Files");
    const enter = (event) => holds(event) && (event.preventDefault(), (depth += 1), setOver(true));
    const leave = (event) => holds(event) && (depth -= 1) <= 0 && ((depth = 0), setOver(false));
    const above = (event) => holds(event) && event.preventDefault();
    const drop = async (event) => {
      if (!holds(event)) return;
      event.preventDefault();
      depth = 0;
      setOver(false);
      bring(await dropped(event.dataTransfer), here());
    };
    const all = { dragenter: enter, dragleave: leave, dragover: above, drop };
    for (const [name, handler] of Object.entries(all)) addEventListener(name, handler);
    return () => {
      for (const [name, handler] of Object.entries(all)) removeEventListener(name, handler);
    };
  }, []);

  const choose = (list, into) => bring(chosen(list), into);
  return html`
    ${key
      ? html`<${Project} key=${key} item=${key} say=${say} choose=${choose} go=${go} />`
      : html`<${Home} say=${say} choose=${choose} go=${go} />`}
    ${over && html`<div class="over"><p>${key ? "Drop to add to this scene" : "Drop to make a new scene"}</p></div>`}
    <div class="notices" role="status" aria-live="polite">
      ${notice &&
      html`<div class="notice"><span>${notice.text}</span>
        ${notice.undo && html`<button onClick=${() => (setNotice(null), notice.undo())}>Undo</button>`}
        <button class="plain" aria-label="Close the message" onClick=${() => setNotice(null)}>✕</button></div>`}
    </div>`;
}

render(html`<${Whole}><${App} /></${Whole}>`, document.getElementById("app"));
