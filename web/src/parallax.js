// A camera that moves a little aside with the pointer or with a phone's tilt, and looks at one point all the while.

import { Vector3 } from "three";

const TILT = 20; // degrees of a phone's tilt that lead to the border
const EASE = 0.15; // share of the remaining way in each frame
const STEP = 0.2; // of the way to the border, for each press of a key

export function parallax(stage, reach) {
  const { position, target } = stage.settings;
  const base = new Vector3(...position), point = new Vector3(...target);
  const forward = point.clone().sub(base).normalize();
  const right = forward.clone().cross(stage.camera.up).normalize();
  const up = right.clone().cross(forward);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const here = { x: 0, y: 0 }, goal = { x: 0, y: 0 };
  let asked = null;

  const frame = () => {
    asked = null;
    for (const axis of ["x", "y"]) here[axis] += (goal[axis] - here[axis]) * (still ? 1 : EASE);
    stage.camera.position.copy(base).addScaledVector(right, reach * here.x).addScaledVector(up, reach * here.y);
    stage.camera.lookAt(point);
    stage.free = null;
    stage.lens();
    stage.paint();
    if (Math.hypot(goal.x - here.x, goal.y - here.y) > 1e-3) wake();
  };
  const wake = () => (asked ??= requestAnimationFrame(frame));
  const go = (x, y) => {
    const length = Math.max(Math.hypot(x, y), 1);
    Object.assign(goal, { x: x / length, y: y / length });
    wake();
  };

  addEventListener("pointermove", (event) => go((2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight));
  let first = null;
  const tilt = ({ beta, gamma }) => {
    if (beta === null || gamma === null) return;
    first ??= { beta, gamma };
    go((gamma - first.gamma) / TILT, (beta - first.beta) / TILT);
  };
  const Orientation = window.DeviceOrientationEvent;
  if (Orientation?.requestPermission) {
    const ask = async () => (await Orientation.requestPermission()) === "granted" && addEventListener("deviceorientation", tilt);
    addEventListener("pointerup", () => ask().catch(() => {}), { once: true }); // a phone asks only after a touch
  } else if (Orientation) addEventListener("deviceorientation", tilt);

  stage.controls.enabled = false;
  stage.reset = () => go(0, 0);
  stage.press = (event) => {
    const ways = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in ways)) return;
    go(goal.x + ways[event.key][0], goal.y + ways[event.key][1]);
    event.preventDefault();
  };
  frame();
}
