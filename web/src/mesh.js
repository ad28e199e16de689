// A mesh with a colour at each vertex, unlit: its colours were photographed.

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshBasicMaterial } from "three";
import { Stage } from "./stage.js";

export async function start(settings, data) {
  const stage = new Stage(settings, { antialias: true });
  const { vertices, faces, low, high } = settings;
  const positions = new Float32Array(3 * vertices);
  const steps = new Uint16Array(data, 12 * faces, 3 * vertices); // of 65535 from corner to corner
  for (let i = 0; i < positions.length; i++) positions[i] = low[i % 3] + ((high[i % 3] - low[i % 3]) * steps[i]) / 65535;
  const geometry = new BufferGeometry();
  geometry.setIndex(new BufferAttribute(new Uint32Array(data, 0, 3 * faces), 1));
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  geometry.setAttribute("color", new BufferAttribute(new Uint8Array(data, 12 * faces + 6 * vertices, 3 * vertices), 3, true));
  const material = new MeshBasicMaterial({ vertexColors: true, side: DoubleSide });
  stage.scene.add(new Mesh(geometry, material));
  stage.redraw();
  return stage;
}
