// Arrays as textures: grids in three dimensions, and long rows folded into layers.

import { Data3DTexture, DataArrayTexture, DataTexture, FloatType, HalfFloatType, IntType, LinearFilter, RedIntegerFormat, RGBAFormat, RGFormat, UnsignedByteType, UnsignedIntType } from "three";

const FOLD = 1024; // texels across a layer and down it; `at` in octree.glsl reads them

// By what a texel holds: channels, format, type and WebGL's own name.
const KINDS = {
  count: [1, RedIntegerFormat, UnsignedIntType, "R32UI"],
  number: [1, RedIntegerFormat, IntType, "R32I"],
  byte: [1, RedIntegerFormat, UnsignedByteType, "R8UI"],
  bytes: [4, RGBAFormat, UnsignedByteType, "RGBA8"],
  halves: [2, RGFormat, HalfFloatType, "RG16F"],
  floats: [4, RGBAFormat, FloatType, "RGBA32F"],
};

function made(texture, kind, smooth = false) {
  const [, format, type, internalFormat] = KINDS[kind];
  Object.assign(texture, { format, type, internalFormat, unpackAlignment: 1, needsUpdate: true });
  texture.onUpdate = () => (texture.image.data = null); // the graphics have it now
  if (smooth) texture.minFilter = texture.magFilter = LinearFilter;
  return texture;
}

export function grid(data, kind, [x, y, z], smooth) {
  return made(new Data3DTexture(data, x, y, z), kind, smooth);
}

export function row(data, kind) {
  const [channels] = KINDS[kind];
  const lines = Math.max(1, Math.ceil(data.length / channels / FOLD));
  const height = Math.min(lines, FOLD);
  const depth = Math.ceil(lines / height);
  const folded = new data.constructor(FOLD * height * depth * channels);
  folded.set(data);
  return made(new DataArrayTexture(folded, FOLD, height, depth), kind);
}

export function table(data, width, height) {
  return made(new DataTexture(data, width, height), "floats");
}

// Parts of a buffer one after another: each call gives the next `length` numbers of a kind.
export function reader(buffer) {
  let begin = 0;
  return (type, length) => {
    const part = new type(buffer, begin, length);
    begin += part.byteLength;
    return part;
  };
}
