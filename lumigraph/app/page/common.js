// Requests to the app, and words for sizes, times and states.

import { html } from "./preact.js";

export async function api(method, path, body) {
  const options = { method, headers: {} };
  if (body !== undefined) {
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(body);
  }
  let response;
  try {
    response = await fetch(`/api/${path}`, options);
  } catch {
    throw Object.assign(new Error("The app does not answer; start it again, and this page goes on"), { away: true });
  }
  const text = await response.text();
  let said = null;
  try {
    said = JSON.parse(text);
  } catch {
    said = { fault: text.trim() || `The app answered with ${response.status}` };
  }
  if (!response.ok) throw Object.assign(new Error(said.fault), { status: response.status, have: said.have });
  return said;
}

// Code and address by which a phone on the same network reaches the app, or one of its scenes.
export const phone = (url, key = "") => url && html`<details class="phone"><summary class="button">From a phone</summary>
  <p class="faint">Scan the code with a phone on the same network, photograph there, and see the pictures arrive here.</p>
  <img alt="QR code of the address below" width="200" height="200" src=${`/api/phone.svg?${new URLSearchParams({ key })}`} />
  <p><a href=${url}>${url}</a></p></details>`;

export const of = (key) => `items/${encodeURIComponent(key)}`;
export const pictureUrl = (key, query) => `/api/${of(key)}/picture?${new URLSearchParams(query)}`;

export function bytes(number) {
  if (number >= 1e9) return `${(number / 1e9).toFixed(1)} GB`;
  if (number >= 1e6) return `${number < 1e7 ? (number / 1e6).toFixed(1) : Math.round(number / 1e6)} MB`;
  return `${Math.max(1, Math.round(number / 1e3))} kB`;
}

export function ago(seconds) {
  if (seconds < 60) return "just now";
  if (seconds < 3600) return `${Math.round(seconds / 60)} min ago`;
  if (seconds < 86400) return `${Math.round(seconds / 3600)} h ago`;
  const days = Math.round(seconds / 86400);
  return days === 1 ? "yesterday" : `${days} days ago`;
}

export function lasting(seconds) {
  if (seconds < 60) return `${Math.max(1, Math.round(seconds))} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

// "about 4 min": rounded as far as it is known.
export const nearly = (seconds) => `about ${lasting(seconds < 60 ? 10 * Math.max(1, Math.round(seconds / 10)) : seconds < 5400 ? 60 * Math.max(1, Math.round(seconds / 60)) : seconds)}`;

// A picture's score in words. PSNR of training photographs is a few dB higher than of held-out ones.
export function judged(psnr, heldOut) {
  const score = heldOut ? psnr + 2 : psnr;
  return score >= 29 ? "Sharp" : score >= 24 ? "A bit soft" : "Rough";
}

export const counted = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

// A request that repeats while the page is visible. Returns a function that ends it.
export function repeat(seconds, ask) {
  let ended = false;
  let timer = 0;
  const turn = async () => {
    if (!document.hidden) await ask();
    if (!ended) timer = setTimeout(turn, 1000 * seconds);
  };
  turn();
  const seen = () => document.hidden || (clearTimeout(timer), turn());
  document.addEventListener("visibilitychange", seen);
  return () => {
    ended = true;
    clearTimeout(timer);
    document.removeEventListener("visibilitychange", seen);
  };
}
