// When a frame is drawn and how much of it: all of it at rest, and on the way there what the machine keeps up with.

// Share of the pixels along a side, share of the points; surfaces with fewer faces; neither pale shapes nor points on
// surfaces.
const QUALITY = [
  { pixels: 1, points: 1, coarse: false, bare: false },
  { pixels: 1, points: 0.4, coarse: true, bare: false },
  { pixels: 0.75, points: 0.12, coarse: true, bare: false },
  { pixels: 0.5, points: 0.06, coarse: true, bare: true },
];
const SMOOTH_MS = 50; // a frame that takes longer is too much
const COARSER_SAVES = 2.5; // what a finer frame costs, in frames one step coarser: a guess, until it was drawn
const REST_MS = 250;
const KEPT_FRAMES = 600;

class Pace {
  /** `draw(quality)` draws a frame and promises to say when it is drawn: only so is its time known. */
  constructor(draw) {
    this.drawNow = draw;
    this.cost = []; // milliseconds of the last frame of each level of QUALITY
    this.level = null; // of the last frame
    this.asked = false; // for a frame after the one being drawn
    this.busy = false; // from the wish for a frame until it is drawn
    this.frames = []; // the latest: [when it ended, milliseconds it took, level]
  }

  /** True when the last change is drawn in full. */
  get settled() {
    return !this.busy && this.level === 0;
  }

  /** Something changed: one frame before the next refresh of the screen, all of it once nothing changes any more. */
  request() {
    clearTimeout(this.rest);
    this.full = false;
    this.ask();
  }

  ask() {
    this.asked = true;
    if (this.busy) return;
    this.busy = true;
    requestAnimationFrame(() => this.frame());
  }

  async frame() {
    this.asked = false;
    const first = this.level === null;
    this.level = this.full ? 0 : this.affordable();
    await this.drawLevel(this.level);
    this.busy = false;
    if (this.asked) this.ask();
    else if (this.level > 0) this.rest = setTimeout(() => this.settle(), first ? 0 : REST_MS);
  }

  settle() {
    this.cost = [];
    this.full = true;
    this.ask();
  }

  /** Draws at a level of QUALITY; milliseconds. */
  async drawLevel(level) {
    const began = performance.now();
    await this.drawNow(QUALITY[level]);
    const ended = performance.now();
    this.cost[level] = ended - began;
    this.frames.push([ended, ended - began, level]);
    if (this.frames.length > KEPT_FRAMES) this.frames.shift();
    return ended - began;
  }

  /** The finest level that is smooth by what is known; the coarsest where nothing is. */
  affordable() {
    let level = QUALITY.length - 1;
    const next = () => this.cost[level - 1] ?? COARSER_SAVES * (this.cost[level] ?? Infinity);
    if (this.cost[0] <= SMOOTH_MS) return 0;
    while (level > 0 && next() <= SMOOTH_MS) level -= 1;
    return level;
  }
}
