// An atlas's textures and shader, from what lumigraph/baked/browser.py `atlas_for_browser` wrote.

import shader from "./atlas.glsl";
import { grid, reader, table } from "./textures.js";

export function atlas(settings, data, longest) {
  const { grid: blocks, blocks: count, block, channels, voxel, cell, cells, network, contracted } = settings;
  const side = block + 2;
  const read = reader(data);
  const index = read(Int32Array, blocks[0] * blocks[1] * blocks[2]);
  const clear = read(Uint8Array, cells[0] * cells[1] * cells[2]);
  const planes = read(Uint8Array, channels * count * side ** 3);
  const shape = arrangement(count, Math.floor(longest / side));
  const place = (first) => grid(arranged(planes, first, count, side, shape), "bytes", shape.map((n) => n * side), true);
  const uniforms = {
    blocks: grid(index, "number", blocks),
    clear: grid(clear, "byte", cells),
    values: place(0),
    voxel,
    side: block,
    cell,
    atlas: shape,
  };
  const fragment = [shader];
  if (contracted) {
    uniforms.ball = (blocks[0] * block) / 4;
    fragment.unshift("#define CURVED");
  }
  if (!network) return { uniforms, fragment };
  const widths = [network[0].weights.length, ...network.map((layer) => layer.biases.length)];
  Object.assign(uniforms, { features: place(4), network: weights(network) });
  return { uniforms, fragment: ["#define WIDTHS", "uniform highp sampler2D network;", seen(widths), ...fragment] };
}

// Blocks along x, y and z of a texture that holds so many, none more than there may be along a side.
function arrangement(count, most) {
  const x = Math.min(most, Math.max(1, Math.ceil(Math.cbrt(count))));
  const y = Math.min(most, Math.max(1, Math.ceil(Math.sqrt(count / x))));
  const z = Math.max(1, Math.ceil(count / (x * y)));
  if (z > most) throw new Error("This scene is larger than the graphics of this device can hold; open it on another one.");
  return [x, y, z];
}

// Four of the channels, each with its blocks one after another, in one picture of three dimensions.
function arranged(planes, first, count, side, [nx, ny, nz]) {
  const all = new Uint8Array(4 * nx * ny * nz * side ** 3), width = nx * side, height = ny * side;
  for (let channel = 0; channel < 4; channel++)
    for (let i = 0, from = (first + channel) * count * side ** 3; i < count; i++) {
      const [x, y, z] = [i % nx, Math.floor(i / nx) % ny, Math.floor(i / (nx * ny))];
      for (let c = 0; c < side; c++)
        for (let b = 0; b < side; b++) {
          let to = 4 * (x * side + width * (y * side + b + height * (z * side + c))) + channel;
          for (let a = 0; a < side; a++, to += 4) all[to] = planes[from++];
        }
    }
  return all;
}

// Layers one below another, each input's weights a row, the biases last.
function weights(network) {
  const width = Math.max(...network.map((layer) => Math.ceil(layer.biases.length / 4)));
  const rows = network.flatMap((layer) => [...layer.weights, layer.biases]);
  const values = new Float32Array(4 * width * rows.length);
  rows.forEach((row, i) => values.set(row, 4 * width * i));
  return table(values, width, rows.length);
}

// GLSL of the network: three layers, ReLU between them, a sigmoid at the end.
function seen([inputs, first, second, last]) {
  const layer = (name, from, to, row, act) => `
    vec4 ${name}[${Math.ceil(to / 4)}];
    for (int j = 0; j < ${Math.ceil(to / 4)}; j++) {
      vec4 total = texelFetch(network, ivec2(j, ${row + from}), 0);
      for (int i = 0; i < ${from}; i++) total += ${act}[i / 4][i % 4] * texelFetch(network, ivec2(j, ${row} + i), 0);
      ${name}[j] = ${to === last && name === "c" ? "total" : "max(total, 0.0)"};
    }`;
  return `vec3 seen(vec3 d, vec3 colour, vec4 feature) {
    vec4 x[${Math.ceil(inputs / 4)}];
    float all[${4 * Math.ceil(inputs / 4)}];
    int n = 0;
    for (int k = 0; k < 3; k++) all[n++] = d[k];
    for (int octave = 0; octave < 4; octave++)
      for (int k = 0; k < 3; k++, n++) {
        all[n] = sin(d[k] * exp2(float(octave)));
        all[n + 12] = cos(d[k] * exp2(float(octave)));
      }
    n += 12;
    for (int k = 0; k < 3; k++) all[n++] = colour[k];
    for (int k = 0; k < 4; k++) all[n++] = feature[k];
    for (int i = 0; i < ${inputs}; i++) x[i / 4][i % 4] = all[i];
    ${layer("a", inputs, first, 0, "x")}
    ${layer("b", first, second, inputs + 1, "a")}
    ${layer("c", second, last, inputs + first + 2, "b")}
    return 1.0 / (1.0 + exp(-c[0].rgb));
  }`;
}
