// How much of a cloud is drawn: while the camera moves as much as a moment allows, at rest all of the budget.

const MOMENT = 33; // milliseconds that a picture may take while the camera moves
const PAUSE = 150; // milliseconds without change after which the camera counts as resting
const LEAST = 1 / 32; // of the work of a whole picture
const FIRST = 1 / 16; // of it that the first picture takes, before anything is known of the device
const ROUGHEST = 0.25; // of its pixels; below that fewer Gaussians are drawn
const PHONE = 1e6, DESK = 3e6; // Gaussians within a budget of "auto"

export function budgetOf(settings) {
  const phone = matchMedia("(pointer: coarse)").matches && Math.min(screen.width, screen.height) < 800;
  return settings.budget ?? (phone ? PHONE : DESK);
}

const powerOfTwo = (share) => 2 ** Math.ceil(Math.log2(Math.min(1, share)));

export class Pace {
  // rest: called when the camera has come to rest after pictures that were not whole
  constructor(rest) {
    Object.assign(this, { rest, work: FIRST, moving: true, drawn: 0 });
  }

  // Square root of the share of pixels, and share of Gaussians, that are to be drawn; both in powers of two, for each change costs.
  get density() {
    return this.moving ? Math.sqrt(Math.max(powerOfTwo(this.work), ROUGHEST)) : 1;
  }

  get share() {
    return this.moving ? powerOfTwo(this.work / ROUGHEST) : 1;
  }

  // From a picture's milliseconds to the work that a moment allows.
  learn(milliseconds) {
    if (milliseconds > MOMENT) this.work = Math.max(LEAST, this.work * MOMENT / milliseconds);
    else if (milliseconds < 0.7 * MOMENT) this.work = Math.min(1, 1.1 * this.work);
  }

  // After each picture that the camera's movement asked for: how long until the next can be drawn.
  async follow() {
    const begin = performance.now(), number = ++this.drawn;
    await new Promise(requestAnimationFrame);
    if (this.moving) this.learn(performance.now() - begin);
    await new Promise((resolve) => setTimeout(resolve, PAUSE));
    if (number === this.drawn) await this.rest();
  }
}
