// Gaussians of spans of time: where each is at a moment, and whether it is there. See lumigraph/gaussians/moving.py.

import { dyno } from "@sparkjsdev/spark";
import { DataTexture, FloatType, NearestFilter, RGBAFormat } from "three";

const WIDTH = 2048; // texels of a row; two for each Gaussian
const HALVES = 3, SINGLES = 4; // numbers of each Gaussian: velocity in 16 bits; middle, begin, end and 1 / fade in 32

// data: of `count` Gaussians, one number after another. Returns a modifier of a SplatMesh and its clock in seconds.
export function motion(data, count) {
  const singles = new Float32Array(data, 0, SINGLES * count);
  const halves = new Uint16Array(data, 4 * SINGLES * count, HALVES * count);
  const height = Math.max(1, Math.ceil((2 * count) / WIDTH));
  const texels = new Float32Array(4 * WIDTH * height);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) texels[8 * i + k] = single(halves[k * count + i]);
    for (let k = 0; k < 4; k++) texels[8 * i + 3 + k] = singles[k * count + i];
  }
  const texture = new DataTexture(texels, WIDTH, height, RGBAFormat, FloatType, undefined, undefined, undefined, NearestFilter, NearestFilter);
  texture.needsUpdate = true;
  const time = dyno.dynoFloat(0);
  const table = dyno.dynoSampler2D(texture);
  const modifier = dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
    const moved = new dyno.Dyno({
      inTypes: { gsplat: dyno.Gsplat, time: "float", table: "sampler2D" },
      outTypes: { gsplat: dyno.Gsplat },
      inputs: { gsplat, time, table },
      statements: ({ inputs, outputs }) => [
        `{`,
        `  ${outputs.gsplat} = ${inputs.gsplat};`,
        `  int at = 2 * ${inputs.gsplat}.index;`,
        `  vec4 first = texelFetch(${inputs.table}, ivec2(at % ${WIDTH}, at / ${WIDTH}), 0);`,
        `  vec4 second = texelFetch(${inputs.table}, ivec2((at + 1) % ${WIDTH}, (at + 1) / ${WIDTH}), 0);`,
        `  float away = ${inputs.time} - first.w;`,
        `  ${outputs.gsplat}.center += away * first.xyz;`,
        `  float seen = exp(-0.5 * away * away * second.z * second.z);`,
        `  bool there = second.x <= ${inputs.time} && ${inputs.time} < second.y;`,
        `  ${outputs.gsplat}.rgba.a *= there ? seen : 0.0;`,
        `}`,
      ],
    });
    return { gsplat: moved.outputs.gsplat };
  });
  return { modifier, time };
}

// A number of 16 bits, as IEEE 754 has it.
function single(half) {
  const sign = half & 0x8000 ? -1 : 1, exponent = (half >> 10) & 31, fraction = half & 1023;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}

// The clock of a page: a button to play and pause, a slider of the moment, and a choice of speeds.
export function clock(stage, duration) {
  const find = (id) => document.getElementById(id);
  const [play, moment, speed] = ["play", "moment", "speed"].map(find);
  find("clock").hidden = false;
  let now = 0, before = null;
  const show = (seconds) => {
    now = Math.min(Math.max(seconds, 0), duration);
    moment.value = now / duration;
    return stage.setTime(now);
  };
  const playing = () => document.body.classList.contains("playing");
  const step = async (at) => {
    if (!playing()) return;
    if (before !== null) await show((now + ((at - before) / 1000) * speed.value) % duration);
    before = at;
    requestAnimationFrame(step);
  };
  const turn = () => {
    before = null;
    const plays = document.body.classList.toggle("playing");
    play.setAttribute("aria-label", plays ? "Pause" : "Play");
    if (plays) requestAnimationFrame(step);
  };
  play.onclick = turn;
  moment.oninput = () => show(moment.value * duration);
  addEventListener("keydown", (event) => {
    if (event.key !== " " || event.target === play || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    turn();
  });
  return show;
}
