// Spark 2.2.0 packs three colours of a harmonic as bytes of a common power of two, and takes the one below the largest
// where it should be the one above, so that harmonics lose up to half of their size. They are packed again here.

const HEADER = 16; // bytes: magic, version, count, degree, bits, flags
const OTHERS = 9 + 1 + 3 + 3 + 4; // bytes a Gaussian ahead of the harmonics: position, opacity, colour, scales, rotation

// data: an unpacked .spz file of version 3. extra: Spark's arrays of one Gaussian's harmonics after another's.
export function packAgain(data, extra) {
  const view = new DataView(data);
  const count = view.getUint32(8, true);
  const rest = (view.getUint8(12) + 1) ** 2 - 1;
  const bytes = new Uint8Array(data, HEADER + OTHERS * count);
  // Four to a texel, where each array begins; the last of degree 1's texel is degree 2's first.
  const places = [["sh1", 0], ["sh2", 4], ["sh3a", 8], ["sh3b", 12]].filter(([name]) => extra[name]);
  for (const [name, first] of places) {
    const packed = extra[name];
    for (let i = 0; i < count; i++)
      for (let k = first; k < Math.min(first + 4, rest); k++) packed[4 * i + k - first] = pack(bytes, 3 * (rest * i + k));
  }
}

function pack(bytes, at) {
  const values = [0, 1, 2].map((c) => (bytes[at + c] - 128) / 128);
  const sizes = values.map(Math.abs);
  const exponent = Math.min(Math.max(Math.ceil(Math.log2(Math.max(...sizes))), -15), 16);
  const [r, g, b] = sizes.map((size) => Math.round((255 * size) / 2 ** exponent));
  const signs = values.reduce((all, value, c) => all | ((value < 0) << c), 0);
  return (r | (g << 8) | (b << 16) | (((exponent + 15) << 3 | signs) << 24)) >>> 0;
}
