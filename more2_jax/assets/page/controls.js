// Slider, toggles, list, keys, pointer: everything a person does, as calls of window.more2.

const TURN_STEP = 0.12;
const CLICK_PX = 6; // a pointer that went further has turned the view

function connectControls(more2, canvas) {
  const by = (id) => document.getElementById(id);
  by("time").addEventListener("input", (event) => more2.setTime(Number(event.target.value)));
  by("play").addEventListener("click", () => more2.play(!more2.playing));
  by("base").addEventListener("change", (event) => more2.setBase(event.target.value));
  by("home").addEventListener("click", () => more2.home());
  by("theme").addEventListener("click", () => more2.setTheme(more2.theme === "dark" ? "light" : "dark"));
  for (const box of document.querySelectorAll("[data-toggle]")) {
    box.addEventListener("change", () => more2.toggle(box.dataset.toggle, box.checked));
  }
  connectList(more2);
  connectKeys(more2, canvas);
  connectPointer(more2, canvas);
}

function connectList(more2) {
  const buttons = listButtons();
  for (const [k, button] of buttons.entries()) {
    button.addEventListener("click", () => {
      more2.select(more2.selected === button.dataset.id ? null : button.dataset.id);
    });
    button.addEventListener("keydown", (event) => {
      const to = { ArrowDown: k + 1, ArrowUp: k - 1, Home: 0, End: buttons.length - 1 }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      buttons[Math.min(buttons.length - 1, Math.max(0, to))].focus();
    });
  }
}

function connectKeys(more2, canvas) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Escape") return more2.select(null);
    const inField = event.target.matches("input, select, textarea");
    if (!inField && (event.key === "ArrowLeft" || event.key === "ArrowRight")) {
      event.preventDefault();
      more2.setTime(more2.time + (event.key === "ArrowRight" ? 1 : -1));
    } else if (event.key === " " && (event.target === canvas || event.target === document.body)) {
      event.preventDefault();
      more2.play(!more2.playing);
    }
  });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    more2.moveCamera(event.key.toLowerCase());
  });
}

function connectPointer(more2, canvas) {
  let down = null;
  canvas.addEventListener("pointerdown", (event) => {
    down = event.isPrimary && event.button === 0 ? { x: event.clientX, y: event.clientY } : null;
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!down || Math.hypot(event.clientX - down.x, event.clientY - down.y) > CLICK_PX) return;
    const box = canvas.getBoundingClientRect();
    more2.select(more2.pick(event.clientX - box.left, event.clientY - box.top), true);
  });
}

const CAMERA_KEYS = {
  a: (stage) => stage.turn(-TURN_STEP, 0),
  d: (stage) => stage.turn(TURN_STEP, 0),
  w: (stage) => stage.turn(0, TURN_STEP),
  s: (stage) => stage.turn(0, -TURN_STEP),
  "+": (stage) => stage.zoom(0.87),
  "=": (stage) => stage.zoom(0.87),
  "-": (stage) => stage.zoom(1.15),
  0: (stage) => stage.home(),
};
