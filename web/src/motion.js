// Gaussians of spans of time: where each is at a moment, and whether it is there. See lumigraph/gaussians/moving.py.

const HALVES = 3, SINGLES = 4; // numbers of each Gaussian: velocity in 16 bits; middle, begin, end and 1 / fade in 32

// data: of `count` Gaussians, one number after another. Returns texels for the graphics, whole rows of them, and the spans
// for the sorter.
export function motion(data, count, row) {
  const [middles, begins, ends, sharpness] = [0, 1, 2, 3].map((k) => new Float32Array(data, 4 * k * count, count));
  const halves = new Uint16Array(data, 4 * SINGLES * count, HALVES * count);
  const texels = new Uint32Array(4 * row * Math.ceil(count / row)), floats = new Float32Array(texels.buffer);
  const velocities = new Float32Array(HALVES * count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < HALVES; k++) velocities[HALVES * i + k] = single(halves[k * count + i]);
    texels[4 * i] = halves[i] | (halves[count + i] << 16);
    texels[4 * i + 1] = halves[2 * count + i];
    floats[4 * i + 2] = middles[i];
    floats[4 * i + 3] = sharpness[i];
  }
  return { texels, spans: { begins, ends, middles, velocities } };
}

// A number of 16 bits, as IEEE 754 has it.
function single(half) {
  const sign = half & 0x8000 ? -1 : 1, exponent = (half >> 10) & 31, fraction = half & 1023;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}

// The clock of a page: a button to play and pause, a slider of the moment, and a choice of speeds.
export function clock(stage, duration) {
  const find = (id) => document.getElementById(id);
  const [play, moment, speed] = ["play", "moment", "speed"].map(find);
  find("clock").hidden = false;
  let now = 0, before = null;
  const show = (seconds) => {
    now = Math.min(Math.max(seconds, 0), duration);
    moment.value = now / duration;
    return stage.setTime(now);
  };
  const playing = () => document.body.classList.contains("playing");
  const step = async (at) => {
    if (!playing()) return;
    if (before !== null) await show((now + ((at - before) / 1000) * speed.value) % duration);
    before = at;
    requestAnimationFrame(step);
  };
  const turn = () => {
    before = null;
    const plays = document.body.classList.toggle("playing");
    play.setAttribute("aria-label", plays ? "Pause" : "Play");
    if (plays) requestAnimationFrame(step);
  };
  play.onclick = turn;
  moment.oninput = () => show(moment.value * duration);
  addEventListener("keydown", (event) => {
    if (event.key !== " " || event.target === play || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    turn();
  });
  return show;
}
