// Uploads in pieces: several files at a time, each goes on where the app has it, and waits while the app is away.

import { api, of } from "./common.js";
import { hashOf } from "./hash.js";

const PIECE_BYTES = 8 << 20;
const AT_A_TIME = 3;
const WAIT_SECONDS = [1, 2, 5, 10, 20];
const states = new Map(); // by key: { files, sent, total, faults, listeners }

export function stateOf(key) {
  if (!states.has(key)) states.set(key, { waiting: [], active: 0, sent: 0, total: 0, done: 0, count: 0, faults: [], listeners: new Set(), pause: "" });
  return states.get(key);
}

export const isUploading = (key) => states.has(key) && (states.get(key).active > 0 || states.get(key).waiting.length > 0);
export const anyUploading = () => [...states.keys()].some(isUploading);

function tell(state) {
  for (const listener of state.listeners) listener();
}

// files: [{ name, file }]
export function upload(key, files) {
  const state = stateOf(key);
  if (!isUploading(key)) Object.assign(state, { sent: 0, total: 0, done: 0, count: 0, faults: [] });
  for (const one of files) {
    state.waiting.push(one);
    state.total += one.file.size;
    state.count += 1;
  }
  while (state.active < AT_A_TIME && state.waiting.length) work(key, state);
  tell(state);
}

async function work(key, state) {
  state.active += 1;
  while (state.waiting.length) {
    const one = state.waiting.shift();
    let counted = 0;
    const count = (have) => {
      state.sent += have - counted;
      counted = have;
      tell(state);
    };
    try {
      await send(key, one, count, state);
      count(one.file.size);
    } catch (fault) {
      state.sent += one.file.size - counted;
      state.faults.push(fault.message);
    }
    state.done += 1;
    tell(state);
  }
  state.active -= 1;
  tell(state);
}

async function send(key, { name, file }, count, state) {
  const hash = await hashOf(file);
  let offset = null;
  for (let tries = 0; ; ) {
    try {
      const about = new URLSearchParams({ name, size: file.size, hash });
      if (offset === null) {
        const found = await api("GET", `${of(key)}/photographs?${about}`);
        offset = found.have;
        count(offset);
        if (found.done) return;
      }
      about.set("offset", offset);
      const response = await fetch(`/api/${of(key)}/photographs?${about}`, {
        method: "PUT",
        headers: { "Content-Type": "application/octet-stream" },
        body: file.slice(offset, offset + PIECE_BYTES),
      });
      const said = await response.json();
      if (response.status === 409) {
        offset = null;
        continue;
      }
      if (response.status === 507) throw Object.assign(new Error(said.fault), { wait: true });
      if (!response.ok) throw Object.assign(new Error(said.fault), { final: true });
      state.pause = "";
      tries = 0;
      offset = said.have;
      count(offset);
      if (said.done) return;
    } catch (fault) {
      if (fault.final || (fault.status && !fault.wait)) throw fault;
      state.pause = fault.wait ? fault.message : "The app does not answer; the upload goes on when it does";
      tell(state);
      await new Promise((done) => setTimeout(done, 1000 * WAIT_SECONDS[Math.min(tries, WAIT_SECONDS.length - 1)]));
      tries += 1;
      offset = null;
    }
  }
}

// Files of a drop, with those in folders: { title, files: [{ name, file }] }
export async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return named([...transfer.files].map((file) => ({ name: file.name, file })));
  const found = [];
  for (const entry of entries) await walk(entry, "", found);
  return named(found);
}

async function walk(entry, above, found) {
  if (entry.name.startsWith(".")) return;
  if (entry.isFile) {
    const file = await new Promise((done, fail) => entry.file(done, fail));
    found.push({ name: above + entry.name, file });
    return;
  }
  const reader = entry.createReader();
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length) return;
    for (const one of some) await walk(one, `${above}${entry.name}/`, found);
  }
}

export const chosen = (list) => named([...list].map((file) => ({ name: file.webkitRelativePath || file.name, file })));

const PHOTOGRAPH = /\.(jpe?g|png|webp|tiff?|bmp|avif|hei[cf]|hif|dng|nef|cr[23]|arw|raf|orf|rw2|pef|srw)$/i;
const VIDEO = /\.(mp4|mov|m4v|mkv|webm|avi|mpe?g|m2?ts|3gp|wmv|ogv|flv)$/i;

const hidden = (name) => name.split("/").some((part) => part.startsWith("."));

// The common folder of all becomes the title. Files of other types and hidden ones are left aside.
function named(files) {
  const good = files.filter(({ name }) => !hidden(name) && (PHOTOGRAPH.test(name) || VIDEO.test(name)));
  const aside = files.length - good.length;
  const top = good.length ? good[0].name.split("/")[0] : "";
  const shared = good.length && good.every(({ name }) => name.includes("/") && name.split("/")[0] === top);
  const video = good.length === 1 && VIDEO.test(good[0].name) ? good[0].name.split("/").pop().replace(/\.\w+$/, "") : "";
  const title = shared ? top : video;
  return {
    title: /^(images?|photos?|photographs|pictures|frames|input|dcim)$/i.test(title) ? "" : title,
    files: shared ? good.map(({ name, file }) => ({ name: name.slice(top.length + 1), file })) : good,
    aside,
  };
}
