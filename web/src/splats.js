// A cloud of Gaussians, drawn by Spark as Lumigraph draws it: blended in sRGB, cut where it adds less than 1/255.

import { ExtSplats, SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import { packAgain } from "./harmonics.js";
import { clock, motion } from "./motion.js";
import { Stage } from "./stage.js";

const FAINTEST = 1 / 255;
const BLUR = 0.3; // square pixels by which a footprint is widened

export async function start(settings, held) {
  const data = settings.splats ? held.slice(0, settings.splats) : held;
  const stage = new Stage(settings, { antialias: false });
  const widened = settings.antialiased ? { blurAmount: BLUR, preBlurAmount: 0 } : { blurAmount: 0, preBlurAmount: BLUR };
  const spark = new SparkRenderer({
    renderer: stage.renderer,
    maxStdDev: Math.sqrt(2 * Math.log(1 / FAINTEST)),
    minAlpha: FAINTEST,
    maxPixelRadius: 4096,
    clipXY: 3,
    sortRadial: false,
    accumExtSplats: true,
    enableLod: false,
    onDirty: () => stage.redraw(),
    ...widened,
  });
  asOurs(spark.material);
  const unpacked = await inflated(data);
  const cloud = new ExtSplats({ fileBytes: data, fileType: SplatFileType.SPZ });
  await cloud.initialized;
  packAgain(unpacked, cloud.extra);
  const mesh = new SplatMesh({ extSplats: cloud });
  mesh.quaternion.set(1, 0, 0, 0); // .spz has y up and z back: half a turn around x
  stage.scene.add(spark, mesh);
  const moves = settings.splats ? motion(await inflated(held.slice(settings.splats)), cloud.numSplats) : null;
  if (moves) mesh.objectModifier = moves.modifier;
  await mesh.initialized;
  stage.sorted = async () => {
    while (spark.sorting || spark.sortDirty) await new Promise((resolve) => setTimeout(resolve, 5));
  };
  stage.arranged = async () => {
    await stage.sorted(); // for another camera, perhaps
    await spark.update({ scene: stage.scene, camera: stage.camera });
    await stage.sorted();
  };
  if (moves) {
    stage.setTime = async (seconds) => {
      moves.time.value = Math.min(seconds, settings.duration * (1 - 1e-6)); // spans end before their ends
      mesh.updateVersion();
      await stage.arranged();
      stage.redraw();
    };
    stage.seek = clock(stage, settings.duration);
    await stage.seek(0);
  }
  stage.camera.updateMatrixWorld();
  await stage.arranged();
  stage.redraw();
  return stage;
}

function inflated(bytes) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

// Three differences between Spark's shaders and Kerbl's: colours are never taken for linear, no Gaussian hides more than
// 0.99, and beyond the picture's edge the projection's slope stays that of its margin, 0.15 of the picture.
function asOurs(material) {
  const replace = (source, from, to) => {
    if (!source.includes(from)) throw new Error(`Spark's shader has no ${from}`);
    return source.replace(from, to);
  };
  material.fragmentShader = replace(material.fragmentShader, "if (encodeLinear) {", "rgba.a = min(rgba.a, 0.99); if (false) {");
  material.vertexShader = replace(
    material.vertexShader,
    "vec2 J2 = -(J1 * viewCenter.xy) * invZ;",
    `vec2 plane = viewCenter.xy * invZ, edge = 1.3 / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
    vec2 J2 = -J1 * clamp(plane, -edge, edge);`,
  );
}
