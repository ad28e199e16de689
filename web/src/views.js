// Pictures rendered beforehand from one camera after another; dragging turns them over.

const FRICTION = 0.93; // of the speed that is left after a sixtieth of a second
const SWEEP = 0.8; // of all pictures, turned over by a drag across a window up to LARGE CSS pixels wide
const LARGE = 900;

const STILL = matchMedia("(prefers-reduced-motion: reduce)").matches;

export async function start(settings, data) {
  const pictures = await Promise.all(settings.pictures.map(([begin, end]) => decode(data.slice(begin, end))));
  const canvas = document.createElement("canvas");
  canvas.tabIndex = 0;
  canvas.setAttribute("aria-label", settings.title);
  document.getElementById("stage").append(canvas);
  const views = new Views(settings, pictures, canvas);
  views.resize();
  return views;
}

function decode(bytes) {
  return createImageBitmap(new Blob([bytes], { type: "image/webp" }));
}

class Views {
  constructor(settings, pictures, canvas) {
    Object.assign(this, { settings, pictures, canvas, at: settings.first, speed: 0, zoom: 1, fingers: new Map() });
    canvas.addEventListener("pointerdown", (event) => this.touch(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this.release(event));
    canvas.addEventListener("wheel", (event) => (event.preventDefault(), this.scale(Math.exp(-event.deltaY / 600))));
    canvas.addEventListener("keydown", (event) => this.press(event));
    addEventListener("resize", () => this.resize());
  }

  reset() {
    Object.assign(this, { at: this.settings.first, speed: 0, zoom: 1 });
    this.redraw();
  }

  resize() {
    const density = devicePixelRatio;
    Object.assign(this.canvas, { width: Math.round(innerWidth * density), height: Math.round(innerHeight * density) });
    this.redraw();
  }

  touch(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    this.speed = 0;
  }

  drag(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const gap = () => { const [a, b] = this.fingers.values(); return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    const pinch = this.fingers.size === 2 && gap();
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (pinch) return this.scale(gap() / pinch);
    if (this.fingers.size > 1) return;
    const across = (event.clientX - before[0]) / Math.min(innerWidth, LARGE);
    this.speed = (this.settings.inward ? -across : across) * SWEEP * this.pictures.length;
    this.moved = performance.now();
    this.turn(this.speed);
  }

  release(event) {
    this.fingers.delete(event.pointerId);
    if (performance.now() - this.moved > 60) this.speed = 0; // held still before it was let go
    this.redraw();
  }

  press(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const factor = { "+": 1.1, "=": 1.1, "-": 1 / 1.1 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || !(step || factor)) return;
    event.preventDefault();
    if (step) this.turn(step);
    else this.scale(factor);
  }

  turn(by) {
    const count = this.pictures.length;
    this.at += by;
    this.at = this.settings.closed ? ((this.at % count) + count) % count : Math.min(Math.max(this.at, 0), count - 1);
    this.redraw();
  }

  scale(by) {
    this.zoom = Math.min(Math.max(this.zoom * by, 1), 4);
    this.redraw();
  }

  redraw() {
    if (this.asked) return;
    this.asked = requestAnimationFrame(() => {
      this.asked = null;
      this.paint();
      if (STILL || this.fingers.size || Math.abs(this.speed) < 0.02) return;
      this.speed *= FRICTION;
      this.turn(this.speed);
    });
  }

  paint() {
    const { canvas, pictures } = this;
    const shown = pictures[Math.round(this.at) % pictures.length];
    const [x, y] = [canvas.width / shown.width, canvas.height / shown.height];
    const scale = this.zoom * Math.min(Math.max(x, y), this.settings.crop * Math.min(x, y));
    const [width, height] = [scale * shown.width, scale * shown.height];
    const context = canvas.getContext("2d");
    context.imageSmoothingQuality = "high";
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.drawImage(shown, (canvas.width - width) / 2, (canvas.height - height) / 2, width, height);
  }

  // The picture whose camera stands nearest to this camera-to-world pose.
  async setCamera(pose) {
    const away = this.settings.poses.map((other) => {
      let sum = 0;
      for (let i = 0; i < 12; i++) sum += (other[i >> 2][i & 3] - pose[i >> 2][i & 3]) ** 2;
      return sum;
    });
    this.speed = 0;
    this.at = away.indexOf(Math.min(...away));
    this.paint();
    await shown();
  }

  // Until the picture no longer changes.
  async rest() {
    do await shown();
    while (this.asked);
  }
}

// Until what was painted is on the screen.
function shown() {
  return new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
}
