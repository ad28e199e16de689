// A mesh with a colour at each vertex or with a picture, unlit: its colours were photographed.

import { BufferAttribute, BufferGeometry, DoubleSide, LinearFilter, Mesh, MeshBasicMaterial, Texture } from "three";
import { parallax } from "./parallax.js";
import { Stage } from "./stage.js";

export async function start(settings, data) {
  const { vertices, faces, low, high, picture, reach } = settings;
  const image = picture && (await createImageBitmap(new Blob([new Uint8Array(data, picture)])));
  const stage = new Stage(settings, { antialias: true });
  const positions = new Float32Array(3 * vertices);
  const steps = new Uint16Array(data, 12 * faces, 3 * vertices); // of 65535 from corner to corner
  for (let i = 0; i < positions.length; i++) positions[i] = low[i % 3] + ((high[i % 3] - low[i % 3]) * steps[i]) / 65535;
  const geometry = new BufferGeometry();
  geometry.setIndex(new BufferAttribute(new Uint32Array(data, 0, 3 * faces), 1));
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  const further = 12 * faces + 6 * vertices;
  const material = new MeshBasicMaterial({ vertexColors: !image, side: DoubleSide });
  if (image) {
    geometry.setAttribute("uv", new BufferAttribute(new Uint16Array(data, further, 2 * vertices), 2, true));
    material.map = Object.assign(new Texture(image), { flipY: false, minFilter: LinearFilter, generateMipmaps: false, needsUpdate: true });
  } else geometry.setAttribute("color", new BufferAttribute(new Uint8Array(data, further, 3 * vertices), 3, true));
  stage.scene.add(new Mesh(geometry, material));
  if (reach) parallax(stage, reach);
  stage.redraw();
  return stage;
}
