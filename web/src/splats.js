// A cloud of Gaussians: still, moving, or in levels of detail that are loaded as they are needed.

import { Matrix4 } from "three";
import { clock, motion } from "./motion.js";
import { Cloud, ROW } from "./splats/cloud.js";
import { levels } from "./splats/levels.js";
import { Pace, budgetOf } from "./splats/pace.js";
import { fromSpz } from "./splats/packed.js";
import { Stage } from "./stage.js";

export async function start(settings, held) {
  const stage = new Stage(settings, { antialias: false });
  const budget = limit(stage, settings);
  if (settings.stream) {
    const { cloud, select } = await levels(stage, settings, budget);
    await shown(stage, cloud, select);
    return stage;
  }
  const unpacked = async () => fromSpz(await inflated(settings.splats ? held.slice(0, settings.splats) : held));
  const made = await unpacked();
  const moves = settings.splats ? motion(await inflated(held.slice(settings.splats)), made.count, ROW) : null;
  const placed = new Matrix4().makeScale(1, -1, -1); // .spz has y up and z back: half a turn around x
  const cloud = new Cloud(stage, { ...made, capacity: made.count, antialiased: settings.antialiased, placed, moves });
  cloud.hold(0, made);
  stage.revive = async () => {
    cloud.begin();
    cloud.hold(0, await unpacked());
  };
  const most = moves ? made.count : Math.min(budget, made.count);
  // Those with the largest contribution are first, except in clouds that move, of which few are there at a time.
  const pace = await shown(stage, cloud, (share) => [[0, moves ? most : Math.ceil(share * most)]]);
  if (moves) {
    stage.setTime = async (seconds) => {
      pace.moving = true;
      cloud.choose(cloud.ranges, Math.min(seconds, settings.duration * (1 - 1e-6))); // spans end before their ends
      await cloud.arrange();
      stage.redraw();
    };
    stage.seek = clock(stage, settings.duration);
  }
  return stage;
}

function limit(stage, settings) {
  const gl = stage.renderer.getContext();
  return Math.min(budgetOf(settings), ROW * gl.getParameter(gl.MAX_TEXTURE_SIZE));
}

// Has the stage paint a cloud: what is there in the order of before, and again once that of the new camera is found.
// select(share): the ranges to draw, of so large a share of the budget. Resolves once there is a picture, a rough one: the
// whole one follows.
async function shown(stage, cloud, select) {
  const { paint, camera } = stage, seen = new Matrix4();
  const pace = new Pace(async () => {
    await stage.arranged();
    stage.paint();
  });
  stage.arranged = async () => {
    pace.moving = false;
    camera.updateMatrixWorld();
    seen.copy(camera.matrixWorld);
    cloud.choose(select(1));
    while (await cloud.arrange());
  };
  stage.sorted = async () => {
    while (cloud.sorting) await cloud.sorting;
  };
  stage.paint = () => {
    camera.updateMatrixWorld();
    if (!seen.equals(camera.matrixWorld)) pace.moving = true;
    seen.copy(camera.matrixWorld);
    cloud.choose(select(pace.share));
    const again = () => !cloud.sorting && cloud.arrange().then((found) => found && stage.redraw());
    if (cloud.count > 2 * cloud.chosen) return again(); // the picture of before stays until there are fewer
    stage.draft(pace.density);
    paint();
    cloud.paint();
    again();
    if (!pace.moving) return;
    const sharpening = pace.follow().finally(() => stage.sharpening === sharpening && (stage.sharpening = null));
    stage.sharpening = sharpening;
  };
  cloud.choose(select(pace.share));
  await cloud.arrange();
  stage.paint();
  cloud.finish();
  return pace;
}

function inflated(bytes) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}
