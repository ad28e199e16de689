// Cameras and sparse points in 3-D, on a canvas: drag or arrow keys turn, the wheel comes nearer.

import { html, useEffect, useRef } from "./preact.js";
import { counted } from "./common.js";

const FRUSTUM = 0.09; // size of a camera, in half-sizes of the scene
const TURNING_MS = 20000; // after a change; drawing takes processor time from the work that is shown
const CORNERS = [[-1, -0.7], [1, -0.7], [1, 0.7], [-1, 0.7]];

export function Cameras({ model }) {
  const canvas = useRef(null);
  const view = useRef({ turn: 0.6, tilt: 0.5, zoom: 1, idle: true, born: new Map() });
  const latest = useRef(model);
  latest.current = model;

  useEffect(() => {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const state = view.current;
    let frame = 0;
    let before = 0;
    let drawn = "";
    let changed = 0;
    const draw = (now) => {
      frame = requestAnimationFrame(draw);
      if (now - before < 40 || !canvas.current) return;
      if (state.idle && !still && now - changed < TURNING_MS) state.turn += Math.min(now - before, 100) * 0.00012;
      before = now;
      const { clientWidth, clientHeight } = canvas.current;
      const model = [latest.current.version, latest.current.cameras.length, clientWidth, clientHeight].join();
      const picture = [model, state.turn, state.tilt, state.zoom].join();
      if (!drawn.startsWith(model)) changed = now;
      if (picture === drawn && now - changed > 2000) return; // young cameras change colour
      drawn = picture;
      paint(canvas.current, latest.current, state, now);
    };
    frame = requestAnimationFrame(draw);
    return () => cancelAnimationFrame(frame);
  }, []);

  const drag = (event) => {
    if (event.buttons !== 1) return;
    view.current.idle = false;
    view.current.turn -= event.movementX * 0.008;
    view.current.tilt = Math.max(-1.5, Math.min(1.5, view.current.tilt + event.movementY * 0.008));
  };
  const wheel = (event) => {
    event.preventDefault();
    view.current.zoom = Math.max(0.3, Math.min(6, view.current.zoom * Math.exp(-event.deltaY * 0.001)));
  };
  const key = (event) => {
    const step = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (!step) return;
    event.preventDefault();
    view.current.idle = false;
    view.current.turn += step[0];
    view.current.tilt = Math.max(-1.5, Math.min(1.5, view.current.tilt + step[1]));
  };
  const said = `${counted(model.cameras.length, "camera")} and ${counted(model.points.length, "sparse point")} in 3-D`;
  return html`<canvas ref=${canvas} class="cameras" role="img" aria-label=${said} tabindex="0"
    onPointerDown=${(event) => event.target.setPointerCapture(event.pointerId)} onPointerMove=${drag}
    onWheel=${wheel} onKeyDown=${key}></canvas><p class="caption">${counted(model.cameras.length, "camera")} · ${counted(model.points.length, "point")} · drag to turn</p>`;
}

function paint(canvas, model, state, now) {
  if (!canvas) return;
  const ratio = Math.min(devicePixelRatio || 1, 2);
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (!width || !height) return;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, width, height);
  const [ct, st, cp, sp] = [Math.cos(state.turn), Math.sin(state.turn), Math.cos(state.tilt), Math.sin(state.tilt)];
  const far = 3.6;
  const focal = 1.5 * Math.min(width, height) * state.zoom; // a sphere around the scene fits the view
  const project = (x, y, z) => {
    const across = ct * x + st * y;
    const away = -st * x + ct * y;
    const depth = far + cp * away - sp * z;
    if (depth < 0.2) return null;
    return [width / 2 + (focal * across) / depth, height / 2 - (focal * (sp * away + cp * z)) / depth, depth];
  };
  const size = 2.2 * ratio;
  for (const [x, y, z, red, green, blue] of model.points) {
    const at = project(x, y, z);
    if (!at) continue;
    context.globalAlpha = Math.max(0.25, Math.min(1, 1.6 - 0.28 * at[2]));
    context.fillStyle = `rgb(${red} ${green} ${blue})`;
    context.fillRect(at[0] - size / 2, at[1] - size / 2, size, size);
  }
  const style = getComputedStyle(canvas);
  const accent = style.getPropertyValue("--accent");
  const fresh = style.getPropertyValue("--good");
  context.lineWidth = 1.3 * ratio;
  context.lineJoin = "round";
  model.cameras.forEach((row, i) => {
    const name = model.names ? model.names[i] : i;
    if (!state.born.has(name)) state.born.set(name, now);
    const young = Math.max(0, 1 - (now - state.born.get(name)) / 1500);
    const [x, y, z] = row;
    const ends = CORNERS.map(([u, v]) =>
      project(...[0, 1, 2].map((k) => row[k] + FRUSTUM * (u * 0.7 * row[3 + k] + v * 0.7 * row[6 + k] + row[9 + k]))));
    const eye = project(x, y, z);
    if (!eye || ends.some((end) => !end)) return;
    context.globalAlpha = 0.9;
    context.strokeStyle = young > 0 ? fresh : accent;
    context.fillStyle = context.strokeStyle;
    context.beginPath();
    ends.forEach((end, j) => (j ? context.lineTo(end[0], end[1]) : context.moveTo(end[0], end[1])));
    context.closePath();
    context.globalAlpha = 0.12 + 0.4 * young;
    context.fill();
    context.globalAlpha = 0.9;
    context.stroke();
    context.beginPath();
    for (const end of ends) {
      context.moveTo(eye[0], eye[1]);
      context.lineTo(end[0], end[1]);
    }
    context.stroke();
  });
  context.globalAlpha = 1;
}
