// A cloud of Gaussians, still or moving.

import { Matrix4 } from "three";
import { clock, motion } from "./motion.js";
import { Cloud, ROW } from "./splats/cloud.js";
import { fromSpz } from "./splats/packed.js";
import { Stage } from "./stage.js";

export async function start(settings, held) {
  const stage = new Stage(settings, { antialias: false });
  const made = fromSpz(await inflated(settings.splats ? held.slice(0, settings.splats) : held));
  const moves = settings.splats ? motion(await inflated(held.slice(settings.splats)), made.count, ROW) : null;
  const placed = new Matrix4().makeScale(1, -1, -1); // .spz has y up and z back: half a turn around x
  const cloud = new Cloud(stage, { ...made, capacity: made.count, antialiased: settings.antialiased, placed, moves });
  cloud.hold(0, made);
  cloud.choose([[0, made.count]]);
  drawn(stage, cloud);
  if (moves) {
    stage.setTime = async (seconds) => {
      cloud.choose(cloud.ranges, Math.min(seconds, settings.duration * (1 - 1e-6))); // spans end before their ends
      await stage.arranged();
      stage.redraw();
    };
    stage.seek = clock(stage, settings.duration);
    await stage.seek(0);
  }
  await stage.arranged();
  stage.redraw();
  return stage;
}

// Has the stage paint a cloud: what is there in the order of before, and again once that of the new camera is found.
function drawn(stage, cloud) {
  const { paint } = stage;
  stage.arranged = async () => {
    stage.camera.updateMatrixWorld();
    while (await cloud.arrange());
  };
  stage.sorted = async () => {
    while (cloud.sorting) await cloud.sorting;
  };
  stage.paint = () => {
    paint();
    cloud.paint();
    if (!cloud.sorting) cloud.arrange().then((found) => found && stage.redraw());
  };
}

function inflated(bytes) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}
