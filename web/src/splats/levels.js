// A scene at several levels of detail, streamed SOG: the coarsest first, then what the camera and the budget ask for.
// https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog

import { Matrix4, Vector3 } from "three";
import { Cloud, ROW } from "./cloud.js";
import { fromSog } from "./sog.js";

const SPARE = 1.5; // times the budget that are kept, so that going back loads nothing
const AT_ONCE = 2; // files
const BEHIND = 0.1; // times as urgent is what the camera does not look at
const FINE = 1.0; // pixels between neighbours, below which finer levels show nothing new

export async function levels(stage, settings, budget) {
  const base = new URL(settings.stream, document.baseURI);
  const meta = await (await loaded(base)).json();
  const scene = new Levels(stage, base, meta, budget);
  const coarsest = scene.files.filter(({ level }) => level === scene.coarsest);
  const first = await scene.unpacked(coarsest[0]);
  const placed = new Matrix4().fromArray(settings.placed).transpose();
  scene.begin(new Cloud(stage, { capacity: scene.capacity, degree: first.degree, antialiased: first.antialiased, placed }));
  scene.put(coarsest[0], first);
  const fill = async (files) => {
    for (const file of files) scene.put(file, await scene.unpacked(file));
  };
  await fill(coarsest.slice(1));
  stage.revive = async () => {
    scene.begin(scene.cloud);
    scene.cloud.begin();
    await fill(coarsest);
  };
  return { cloud: scene.cloud, select: (share) => scene.select(share) };
}

export async function loaded(url) {
  const answer = await fetch(url).catch(() => null);
  if (answer?.ok) return answer;
  throw new Error(
    location.protocol === "file:"
      ? "This page loads its scene over HTTP; serve its folder, for instance by `python -m http.server`, and open it there."
      : `${url.pathname} cannot be loaded; put the whole folder beside this page.`,
  );
}

class Levels {
  constructor(stage, base, meta, budget) {
    const leaves = [...leavesOf(meta.tree)];
    const used = new Map();
    for (const leaf of leaves)
      for (const [level, row] of Object.entries(leaf.lods)) {
        const file = used.get(row.file) ?? { name: meta.filenames[row.file], level: +level, count: 0, rows: 0, at: null };
        file.count = Math.max(file.count, row.offset + row.count);
        file.rows = Math.ceil(file.count / ROW);
        used.set(row.file, file);
      }
    const files = [...used.values()], rows = files.reduce((sum, file) => sum + file.rows, 0);
    const largest = Math.max(...files.map((file) => file.rows));
    const capacity = ROW * Math.min(rows, Math.ceil((SPARE * budget) / ROW) + largest);
    const coarsest = Math.max(...files.map(({ level }) => level));
    Object.assign(this, { stage, base, budget, leaves, files, used, capacity, coarsest, free: 0, loading: 0, clock: 0 });
  }

  // With nothing loaded.
  begin(cloud) {
    for (const file of this.files) Object.assign(file, { at: null, asked: false });
    Object.assign(this, { cloud, free: 0, era: {} });
    this.toLocal = cloud.placed.clone().invert();
  }

  unpacked(file) {
    return fromSog(this.stage, new URL(file.name, this.base));
  }

  put(file, made, at = this.room(file)) {
    this.cloud.hold(at, made);
    file.at = at;
  }

  // A row of the store from which on a file has room: behind all others, or in place of one that is not shown.
  room(file) {
    if (this.free + file.rows <= this.capacity / ROW) return (this.free += file.rows) - file.rows;
    const others = this.files.filter((other) => other.at !== null && other.used < this.clock && other.rows >= file.rows);
    const [old] = others.filter(({ level }) => level < this.coarsest).sort((a, b) => a.used - b.used);
    if (!old) return null;
    const { at } = old;
    old.at = null;
    return at;
  }

  // The ranges to draw from here, and loads what would be better.
  select(share) {
    this.clock++;
    const wanted = this.wanted(share * this.budget), ranges = [];
    for (const [leaf, level] of wanted) {
      const numbers = Object.keys(leaf.lods).map(Number);
      const there = numbers.filter((other) => this.used.get(leaf.lods[other].file).at !== null);
      const best = Math.min(...there.filter((other) => other >= level), Infinity);
      const row = leaf.lods[best < Infinity ? best : Math.max(...there)];
      if (!row?.count) continue;
      const file = this.used.get(row.file), begin = ROW * file.at + row.offset;
      file.used = this.clock;
      ranges.push([begin, begin + row.count]);
    }
    if (share === 1) this.load(wanted);
    return joined(ranges);
  }

  // A level for each leaf: refined in the order of pixels between neighbours until the budget is spent.
  wanted(budget) {
    const { camera, height } = this.stage;
    const eye = camera.position.clone().applyMatrix4(this.toLocal);
    const forward = camera.getWorldDirection(new Vector3()).transformDirection(this.toLocal);
    const pixels = (height / 2) * camera.projectionMatrix.elements[5];
    const levels = new Map(), steps = [];
    for (const leaf of this.leaves) {
      const near = eye.clone().clamp(leaf.low, leaf.high), away = near.distanceTo(eye);
      const ahead = leaf.low.clone().add(leaf.high).multiplyScalar(0.5).sub(eye).dot(forward) > -leaf.radius;
      const numbers = Object.keys(leaf.lods).map(Number).sort((a, b) => b - a);
      levels.set(leaf, numbers[0]);
      budget -= leaf.lods[numbers[0]].count;
      for (let i = 1; i < numbers.length; i++) {
        const [coarse, fine] = [numbers[i - 1], numbers[i]].map((level) => leaf.lods[level].count);
        const apart = (pixels * leaf.radius) / Math.sqrt(Math.max(coarse, 1)) / Math.max(away, 0.01 * leaf.radius);
        steps.push({ leaf, level: numbers[i], cost: fine - coarse, error: ahead ? apart : BEHIND * apart });
      }
    }
    for (const { leaf, level, cost, error } of steps.sort((a, b) => b.error - a.error)) {
      if (cost > budget || error < FINE) break;
      budget -= cost;
      levels.set(leaf, level);
    }
    return levels;
  }

  async load(wanted) {
    if (this.loading >= AT_ONCE) return;
    const files = [...wanted].map(([leaf, level]) => this.used.get(leaf.lods[level].file));
    const next = files.find((file) => file.at === null && !file.asked);
    const at = next ? this.room(next) : null;
    if (at === null) return;
    const { era } = this;
    next.asked = true;
    this.loading++;
    try {
      const made = await this.unpacked(next);
      if (era !== this.era) return; // the graphics card was lost meanwhile, and the room with it
      this.put(next, made, at);
      next.asked = false;
    } catch (fault) {
      console.warn(fault.message); // and a coarser level stays
    } finally {
      this.loading--;
      this.stage.redraw();
    }
  }
}

function* leavesOf(node) {
  for (const child of node.children ?? []) yield* leavesOf(child);
  if (!Object.keys(node.lods ?? {}).length) return;
  const [low, high] = [node.bound.min, node.bound.max].map((corner) => new Vector3(...corner));
  yield { low, high, radius: 0.5 * low.distanceTo(high), lods: node.lods };
}

// Ranges that follow each other become one.
function joined(ranges) {
  const found = [];
  for (const [begin, end] of ranges.sort(([a], [b]) => a - b)) {
    const last = found.at(-1);
    if (last && last[1] === begin) last[1] = end;
    else found.push([begin, end]);
  }
  return found;
}
