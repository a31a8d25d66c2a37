// The page's state and its verbs, `window.more2`; then the start.

const GLIDE_MS = 900;
const PAUSE_MS = 700;
const still = matchMedia("(prefers-reduced-motion: reduce)");
const dark = matchMedia("(prefers-color-scheme: dark)");
let stage = null; // null where there is no WebGL: lists and tables work without

const more2 = {
  ready: false,
  error: null,
  time: lastScan, // the scan shown, from 0
  shownTime: lastScan, // the same, or between two scans while objects glide
  scans: scene.scans.length,
  base: "first", // what it is compared with: first | previous
  selected: null, // an object's id
  playing: false,
  theme: "light",
  toggles: {},
  frames: 0, // drawn so far

  setTime(time) {
    const to = Math.min(lastScan, Math.max(0, Math.round(time)));
    if (to === this.time) return;
    const from = this.shownTime;
    this.time = to;
    tell(this);
    stage?.retrace();
    glide(from, to);
  },

  setBase(base) {
    this.base = base;
    document.getElementById("base").value = base;
    tell(this);
    stage?.retrace();
  },

  select(id, scroll = false) {
    this.selected = id;
    tell(this);
    stage?.redraw();
    const button = listButtons()[scene.objects.findIndex((o) => o.id === id)];
    if (button && scroll) scrollInList(button);
  },

  toggle(name, on) {
    this.toggles[name] = on;
    document.getElementById(`toggle_${name}`).checked = on;
    if (name === "split") stage?.home();
    tell(this);
    stage?.redraw();
  },

  play(on) {
    this.playing = on && lastScan > 0;
    const button = document.getElementById("play");
    button.setAttribute("aria-label", this.playing ? "Stop" : "Play from the first scan to the last");
    button.firstElementChild.textContent = this.playing ? "■" : "▶";
    clearTimeout(this.playTimer);
    if (!this.playing) return;
    if (this.time === lastScan) this.setTime(0);
    const step = () => {
      this.setTime(this.time + 1);
      if (this.time === lastScan) this.play(false);
      else this.playTimer = setTimeout(step, GLIDE_MS + PAUSE_MS);
    };
    this.playTimer = setTimeout(step, GLIDE_MS + PAUSE_MS);
  },

  setTheme(theme, keep = true) {
    this.theme = theme;
    if (keep) {
      document.documentElement.dataset.theme = theme;
      try {
        localStorage.setItem("more2-theme", theme);
      } catch {
        // a page from disk may have no storage: the choice lasts as long as the page
      }
    }
    stage?.setTheme();
  },

  home: () => stage?.home(),
  pick: (x, y) => stage?.pick(x, y) ?? null,
  moveCamera: (key) => stage && CAMERA_KEYS[key]?.(stage),

  /** Where an object's number appears on the canvas in the last view, or null. */
  where(id) {
    const built = stage?.builds.find((b) => b.object.id === id);
    return built ? stage.project(built, stage.views().at(-1)) : null;
  },

  /** True when the last change is drawn in full. */
  get settled() {
    return stage === null || stage.pace.settled;
  },

  /** The latest frames: [when it ended, milliseconds it took, level of quality]. */
  paceLog: () => stage.pace.frames,

  /** Milliseconds a frame while turning, at a level of quality, waited for: one number a frame. */
  async measure(count, level = 0) {
    const times = [];
    stage.pace.busy = true; // no other frames meanwhile
    for (let k = 0; k < count; k++) {
      stage.turn(0.03, 0);
      times.push(await stage.pace.drawLevel(level));
      await new Promise((resolve) => setTimeout(resolve));
    }
    stage.pace.busy = false;
    stage.redraw();
    return times;
  },
};
window.more2 = more2;

/** Moves objects from one time to another, or sets them there at once where people want no motion. */
function glide(from, to) {
  cancelAnimationFrame(more2.gliding);
  if (!stage || still.matches || Math.abs(to - from) > 1.01) {
    more2.shownTime = to;
    stage?.redraw();
    return;
  }
  const began = performance.now();
  const step = (now) => {
    const f = Math.min(1, Math.max(0, (now - began) / GLIDE_MS));
    const eased = f * f * (3 - 2 * f);
    more2.shownTime = f === 1 ? to : from + (to - from) * eased;
    stage.redraw();
    if (f < 1) more2.gliding = requestAnimationFrame(step);
  };
  more2.gliding = requestAnimationFrame(step);
}

/** Scrolls the list, not the page, to a button. */
function scrollInList(button) {
  const list = document.getElementById("objects");
  if (list.scrollHeight <= list.clientHeight) return;
  const [b, l] = [button.getBoundingClientRect(), list.getBoundingClientRect()];
  if (b.top < l.top || b.bottom > l.bottom) list.scrollTop += b.top - l.top - (l.height - b.height) / 2;
}

function chosenTheme() {
  try {
    return localStorage.getItem("more2-theme");
  } catch {
    return null;
  }
}

async function start() {
  for (const box of document.querySelectorAll("[data-toggle]")) more2.toggles[box.dataset.toggle] = box.checked;
  const canvas = document.getElementById("canvas");
  connectControls(more2, canvas);
  const kept = chosenTheme();
  more2.setTheme(kept ?? (dark.matches ? "dark" : "light"), kept !== null);
  dark.addEventListener("change", () => {
    if (!document.documentElement.dataset.theme) more2.setTheme(dark.matches ? "dark" : "light", false);
  });
  tell(more2);
  const wait = document.getElementById("wait");
  try {
    await unpackBlob();
    stage = new Stage(canvas, more2);
    new Labels(document.getElementById("labels"), stage);
    stage.setTheme();
    await new Promise(requestAnimationFrame); // the first frame was asked for before
    wait.hidden = true;
    const cell = stage.cell >= 1 ? `${stage.cell} m` : `${Math.round(100 * stage.cell)} cm`;
    document.getElementById("scale").textContent = `floor squares: ${cell}`;
    document.getElementById("scale").hidden = false;
  } catch (error) {
    more2.error = String(error);
    wait.textContent = "The 3D view does not start here (it needs WebGL 2). The list and the tables hold all else.";
  }
  more2.ready = true;
}

// After the first paint: words are read while the 3D view is prepared.
requestAnimationFrame(() => setTimeout(start));
