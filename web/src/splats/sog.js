// One file of SOG: pictures whose pixels are Gaussians, and a meta.json beside them.
// https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, version 2

import { loaded } from "./levels.js";
import { colourOf, room, scaleOf } from "./packed.js";

const VERSION = 2, PALETTE_ROW = 64;
const REST = [0, 9, 24, 45]; // numbers of a Gaussian's harmonics beyond degree 0

export async function fromSog(stage, url) {
  const meta = await (await loaded(url)).json();
  if (meta.version !== VERSION) throw new Error(`${url.pathname} is SOG of version ${meta.version}; write it again as version ${VERSION}.`);
  const picture = async (name) => pixels(stage, await (await loaded(new URL(name, url))).blob());
  const { means, scales, quats, sh0, shN } = meta;
  const names = [...means.files, ...scales.files, ...quats.files, ...sh0.files, ...(shN?.files ?? [])];
  const [lower, upper, sizes, turns, colours, entries, labels] = await Promise.all(names.map(picture));
  const degree = shN?.bands ?? 0, made = room(meta.count, degree);
  const logs = scales.codebook.map(scaleOf), shades = sh0.codebook.map(colourOf);
  const place = (at, axis) => {
    const share = (lower.data[at + axis] + 256 * upper.data[at + axis]) / 65535;
    const value = means.mins[axis] + share * (means.maxs[axis] - means.mins[axis]);
    return Math.sign(value) * Math.expm1(Math.abs(value));
  };
  for (let i = 0; i < meta.count; i++) {
    const at = 4 * i, [s, c] = [sizes.data, colours.data];
    const three = [logs[s[at]], logs[s[at + 1]], logs[s[at + 2]]], shade = [shades[c[at]], shades[c[at + 1]], shades[c[at + 2]]];
    made.put(i, place(at, 0), place(at, 1), place(at, 2), three, 257 * c[at + 3], rotation(turns.data, at), shade);
  }
  if (degree) {
    const bytes = shN.codebook.map((value) => Math.min(Math.max(Math.round(128 + 128 * value), 0), 255));
    const rest = REST[degree] / 3;
    for (let i = 0; i < meta.count; i++) {
      const label = labels.data[4 * i] + 256 * labels.data[4 * i + 1];
      const from = 4 * ((label % PALETTE_ROW) * rest + Math.floor(label / PALETTE_ROW) * entries.width);
      for (let k = 0; k < 3 * rest; k++) made.bytes[16 * degree * i + k] = bytes[entries.data[from + 4 * Math.floor(k / 3) + (k % 3)]];
    }
  }
  return Object.assign(made, { antialiased: meta.model === "antialiased" || meta.antialias === true });
}

// From bytes of the smaller components, in the order w, x, y, z, and the largest one's place to .spz's, in x, y, z, w.
function rotation(turns, at) {
  const largest = turns[at + 3] - 252, order = largest ? [1, 2, 0] : [0, 1, 2];
  return order.reduce((code, k) => {
    const value = turns[at + k] / 255 - 0.5;
    return (code << 10) | ((value < 0) << 9) | Math.round(1022 * Math.abs(value));
  }, (largest + 3) % 4);
}

// Bytes of a lossless picture, which a canvas would multiply by opacity.
async function pixels(stage, blob) {
  const image = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const gl = stage.renderer.getContext(), { width, height } = image;
  const [texture, frame, data] = [gl.createTexture(), gl.createFramebuffer(), new Uint8Array(4 * width * height)];
  stage.renderer.resetState();
  for (const name of [gl.UNPACK_FLIP_Y_WEBGL, gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL]) gl.pixelStorei(name, false);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  gl.deleteFramebuffer(frame);
  gl.deleteTexture(texture);
  image.close();
  stage.renderer.resetState();
  return { data, width };
}
