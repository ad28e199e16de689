// An octree's textures and shader, from what lumigraph/baked/browser.py `octree_for_browser` wrote.

import shader from "./octree.glsl";
import { grid, reader, row } from "./textures.js";

const LEAF = 1, DIVIDED = 2; // kinds of cells
const NODE_MARK = 0x80000000, LEAF_MARK = 0x40000000;
const CRUMB = 2e-3; // of the smallest cell

// The harmonics of lumigraph/kernels/spherical_harmonics, as functions of a direction (x, y, z).
const HARMONICS = [
  "0.28209479", "-0.48860251 * y", "0.48860251 * z", "-0.48860251 * x",
  "1.09254843 * x * y", "-1.09254843 * y * z", "0.31539157 * (3.0 * z * z - 1.0)", "-1.09254843 * x * z",
  "0.54627422 * (x * x - y * y)", "-0.59004359 * y * (3.0 * x * x - y * y)", "2.89061144 * x * y * z",
  "-0.45704580 * y * (5.0 * z * z - 1.0)", "0.37317633 * z * (5.0 * z * z - 3.0)",
  "-0.45704580 * x * (5.0 * z * z - 1.0)", "1.44530572 * z * (x * x - y * y)",
  "-0.59004359 * x * (x * x - 3.0 * y * y)",
];

export function octree(settings, data) {
  const { nodes, leaves, bases, level, levels, size } = settings;
  const entry = 2 ** level, coefficients = 3 * bases, texels = Math.ceil(coefficients / 4);
  const read = reader(data);
  const [density, scale] = [read(Uint16Array, leaves), read(Uint16Array, leaves)];
  const [kinds, clear, codes] = [read(Uint8Array, 8 * nodes), read(Uint8Array, entry ** 3), read(Uint8Array, leaves * coefficients)];

  const cells = new Uint32Array(8 * nodes);
  for (let i = 0, leaf = 0, node = 1; i < cells.length; i++)
    cells[i] = kinds[i] === LEAF ? LEAF_MARK + leaf++ : kinds[i] === DIVIDED ? NODE_MARK + node++ : 0;
  const thick = new Uint16Array(2 * leaves);
  for (let i = 0; i < leaves; i++) [thick[2 * i], thick[2 * i + 1]] = [density[i], scale[i]];
  const colours = new Uint8Array(4 * texels * leaves);
  for (let k = 0; k < coefficients; k++)
    for (let i = 0; i < leaves; i++) colours[4 * texels * i + k] = codes[k * leaves + i];

  return {
    uniforms: {
      entries: grid(entries(cells, clear, level), "count", [entry, entry, entry]),
      cells: row(cells, "count"),
      thick: row(thick, "halves"),
      colours: row(colours, "bytes"),
      size,
      entry,
      crumb: (CRUMB * size) / 2 ** levels,
    },
    fragment: [`const int BASES = ${bases};`, `const uint TEXELS = ${texels}u;`, functions(bases), shader],
  };
}

// For each cell of the entry level how far it is empty around, else its leaf, with the leaf's size, or its node.
function entries(cells, clear, level) {
  const table = new Uint32Array(clear), side = 2 ** level;
  const visit = (node, above, x, y, z) => {
    const half = 2 ** (level - above - 1);
    for (let k = 0; k < 8; k++) {
      const cell = cells[8 * node + k];
      const [cx, cy, cz] = [x + half * (k >> 2), y + half * ((k >> 1) & 1), z + half * (k & 1)];
      if (cell >= NODE_MARK && half > 1) visit(cell - NODE_MARK, above + 1, cx, cy, cz);
      else if (cell >= NODE_MARK) table[cx + side * (cy + side * cz)] = cell;
      else if (cell)
        for (let i = 0; i < half ** 3; i++) {
          const [dx, dy, dz] = [i % half, Math.floor(i / half) % half, Math.floor(i / half ** 2)];
          table[cx + dx + side * (cy + dy + side * (cz + dz))] = cell + Math.log2(half) * 2 ** 26;
        }
    }
  };
  visit(0, 0, 0, 0, 0);
  return table;
}

// GLSL that evaluates the harmonics of a direction, and that sums a leaf's coefficients with them: bytes b mean (255 b - 128) / 127.
function functions(bases) {
  const lines = Array.from({ length: Math.ceil((3 * bases) / 4) }, (_, j) => {
    const terms = [0, 1, 2, 3].map((k) => [4 * j + k, "xyzw"[k]]).filter(([i]) => i < 3 * bases);
    const sums = terms.map(([i, part]) => `total.${"xyz"[i % 3]} += basis[${Math.floor(i / 3)}] * code.${part};`);
    return `code = (255.0 * texelFetch(colours, at(first + ${j}u), 0) - 128.0) / 127.0; ${sums.join(" ")}`;
  });
  return [
    `uniform highp sampler2DArray colours;
    ivec3 at(uint i) { return ivec3(i & 1023u, (i >> 10) & 1023u, i >> 20); }
    float[BASES] harmonics(vec3 d) {
      float x = d.x, y = d.y, z = d.z;
      return float[BASES](${HARMONICS.slice(0, bases).join(", ")});
    }
    vec3 sum(uint first, float basis[BASES]) {
      vec3 total = vec3(0.0);
      vec4 code;
      ${lines.join("\n      ")}
      return total;
    }`,
  ].join("\n");
}
