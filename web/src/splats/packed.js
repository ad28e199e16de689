// Gaussians as textures hold them: eight numbers of 32 bits each, and the bytes of their harmonics.

import { ROW } from "./cloud.js";

const SCALES = { shift: 16, steps: 2048 }, COLOURS = { shift: 4, steps: 8192 }; // of fixed-point numbers of 16 bits
const K00 = 0.28209479177387814;
const HEADER = 16; // bytes of .spz: magic, version, count, degree, bits, flags

const fixed = (value, { shift, steps }) => Math.min(Math.max(Math.round((value + shift) * steps), 0), 65535);
const table = (count, value) => Uint16Array.from({ length: count }, (_, i) => value(i));

// Numbers of whole rows for so many Gaussians, and a function that sets the i-th: log scales and colours as fixed-point
// numbers, opacity of 65535, rotation as .spz has it. `bytes` are those of harmonics, 16 degree for each.
export function room(count, degree) {
  const length = ROW * Math.ceil(count / ROW);
  const numbers = new Uint32Array(8 * length), floats = new Float32Array(numbers.buffer);
  const harmonics = new Uint32Array(4 * degree * length), centres = new Float32Array(3 * length);
  const put = (i, x, y, z, scales, opacity, rotation, colour) => {
    const at = 8 * i;
    [floats[at], floats[at + 1], floats[at + 2]] = [centres[3 * i], centres[3 * i + 1], centres[3 * i + 2]] = [x, y, z];
    numbers[at + 3] = scales[0] | (scales[1] << 16);
    numbers[at + 4] = scales[2] | (opacity << 16);
    numbers[at + 5] = rotation;
    numbers[at + 6] = colour[0] | (colour[1] << 16);
    numbers[at + 7] = colour[2];
  };
  return { count, degree, numbers, harmonics, centres, put, bytes: new Uint8Array(harmonics.buffer) };
}

export const scaleOf = (log) => fixed(log, SCALES);
export const colourOf = (harmonic) => fixed(0.5 + K00 * harmonic, COLOURS);

// An unpacked .spz file of version 3.
export function fromSpz(data) {
  const header = new DataView(data), count = header.getUint32(8, true), degree = header.getUint8(12);
  const unit = 2 ** -header.getUint8(13), rest = 3 * ((degree + 1) ** 2 - 1);
  let begin = HEADER;
  const stream = (width) => new Uint8Array(data, (begin += width * count) - width * count, width * count);
  const [means, opacities, colours, scales, rotations, harmonics] = [9, 1, 3, 3, 4, rest].map(stream);
  const [logs, shades] = [table(256, (i) => scaleOf(i / 16 - 10)), table(256, (i) => colourOf((i / 255 - 0.5) / 0.15))];
  const made = room(count, degree), three = [0, 0, 0], shade = [0, 0, 0];
  const coordinate = (at) => (((means[at] << 8) | (means[at + 1] << 16) | (means[at + 2] << 24)) >> 8) * unit;
  for (let i = 0; i < count; i++) {
    for (let c = 0; c < 3; c++) {
      three[c] = logs[scales[3 * i + c]];
      shade[c] = shades[colours[3 * i + c]];
    }
    const r = 4 * i, rotation = rotations[r] | (rotations[r + 1] << 8) | (rotations[r + 2] << 16) | (rotations[r + 3] << 24);
    made.put(i, coordinate(9 * i), coordinate(9 * i + 3), coordinate(9 * i + 6), three, 257 * opacities[i], rotation, shade);
    for (let k = 0; k < rest; k++) made.bytes[16 * degree * i + k] = harmonics[rest * i + k];
  }
  return made;
}
