// The order of Gaussians along a direction, the farthest first, found in a worker of its own.

const DIGIT = 12; // bits of a depth that one pass of counting sorts by; two passes

// Runs inside the worker: it uses nothing from outside.
function work(DIGIT) {
  const SIZE = 1 << DIGIT;
  let centres = new Float32Array(0), moves = null, depths, keys, found, between;

  // Those of the ranges that are there at the moment, with their depths. Returns how many.
  function collect([x, y, z], ranges, time) {
    let count = 0;
    for (const [begin, end] of ranges)
      for (let i = begin; i < end; i++) {
        let depth = x * centres[3 * i] + y * centres[3 * i + 1] + z * centres[3 * i + 2];
        if (moves) {
          if (time < moves.begins[i] || moves.ends[i] <= time) continue;
          const { velocities: v } = moves;
          depth += (time - moves.middles[i]) * (x * v[3 * i] + y * v[3 * i + 1] + z * v[3 * i + 2]);
        }
        depths[count] = depth;
        found[count++] = i;
      }
    return count;
  }

  function sort(count, order) {
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < count; i++) (low = Math.min(low, depths[i])), (high = Math.max(high, depths[i]));
    const scale = (SIZE * SIZE - 1) / Math.max(high - low, 1e-30);
    const fine = new Uint32Array(SIZE + 1), coarse = new Uint32Array(SIZE + 1);
    for (let i = 0; i < count; i++) {
      const key = (keys[i] = (high - depths[i]) * scale);
      fine[(key & (SIZE - 1)) + 1]++;
      coarse[(key >>> DIGIT) + 1]++;
    }
    for (let i = 0; i < SIZE; i++) (fine[i + 1] += fine[i]), (coarse[i + 1] += coarse[i]);
    for (let i = 0; i < count; i++) between[fine[keys[i] & (SIZE - 1)]++] = i;
    for (let i = 0; i < count; i++) order[coarse[keys[between[i]] >>> DIGIT]++] = found[between[i]];
  }

  onmessage = ({ data }) => {
    if (data.capacity) centres = new Float32Array(3 * data.capacity);
    if (data.centres) centres.set(data.centres, 3 * data.at);
    if (data.moves) moves = data.moves;
    if (!data.direction) return;
    const most = data.ranges.reduce((sum, [begin, end]) => sum + end - begin, 0);
    if (!depths || depths.length < most) {
      depths = new Float32Array(most);
      [keys, found, between] = [0, 0, 0].map(() => new Uint32Array(most));
    }
    const count = collect(data.direction, data.ranges, data.time);
    const order = new Uint32Array(data.row * Math.ceil(count / data.row));
    sort(count, order);
    postMessage({ order, count }, [order.buffer]);
  };
}

export class Sorter {
  // capacity: Gaussians at most;  row: the order's length is a multiple of this
  constructor(capacity, row) {
    const url = URL.createObjectURL(new Blob([`(${work})(${DIGIT})`], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.row = row;
    this.worker.postMessage({ capacity });
  }

  // Centres of Gaussians from the `at`-th on, or the motion of all.
  hold(message) {
    this.worker.postMessage(message);
  }

  sort(direction, ranges, time) {
    return new Promise((resolve) => {
      this.worker.onmessage = ({ data }) => resolve(data);
      this.worker.postMessage({ direction, ranges, time, row: this.row });
    });
  }
}
