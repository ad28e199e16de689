// A baked volume, an octree or an atlas, looked at along the ray of each pixel.

import { MathUtils, Matrix4, Vector2, Vector3 } from "three";
import { Stage } from "./stage.js";
import { atlas } from "./volumes/atlas.js";
import { octree } from "./volumes/octree.js";
import { Patience } from "./volumes/patience.js";
import ray from "./volumes/ray.glsl";

export async function start(settings, data) {
  const stage = new Stage(settings, { antialias: false });
  const gl = stage.renderer.getContext();
  const longest = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
  const made = settings.volume === "octree" ? octree(settings, data) : atlas(settings, data, longest);
  const values = {
    pose: new Matrix4(),
    slope: new Vector2(),
    near: settings.near,
    low: new Vector3(...settings.low),
    ...made.uniforms,
  };
  const uniforms = Object.fromEntries(Object.entries(values).map(([name, value]) => [name, { value }]));
  const patience = new Patience(stage, uniforms, [ray, ...made.fragment].join("\n"), () => {
    const { camera } = stage, half = Math.tan(MathUtils.degToRad(camera.fov) / 2);
    camera.updateMatrixWorld();
    values.pose.copy(camera.matrixWorld);
    values.slope.set(half * camera.aspect, half);
  });
  patience.begin();
  stage.paint = () => patience.paint();
  stage.redraw();
  return stage;
}
