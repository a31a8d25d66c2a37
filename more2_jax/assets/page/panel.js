// What is read: the sentence, the list, the counts, the selected object. Names go in as text only.

const STATUS_WORDS = { moved: "moved", added: "added", removed: "removed", static: "stayed", not_seen: "not seen", discovered: "discovered" };

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/** Puts what happened up to the present time into headline, list and counts. */
function tell(state) {
  const pair = pairAt(state.time, state.base);
  document.getElementById("headline").textContent = pair.headline;
  for (const [k, button] of listButtons().entries()) {
    const verdict = pair.verdicts[k];
    const status = button.querySelector(".status");
    status.textContent = verdict.text;
    status.className = `status ${verdict.status}`;
    const doubt = button.querySelector(".doubt");
    doubt.hidden = verdict.doubts.length === 0;
    doubt.title = verdict.doubts.join("; ");
    button.className = `object ${verdict.status}`;
    button.setAttribute("aria-pressed", String(state.selected === scene.objects[k].id));
  }
  tellCounts(pair.verdicts);
  tellDetails(state, pair);
  tellViews(state);
}

function listButtons() {
  return [...document.querySelectorAll("#objects button")];
}

function tellCounts(verdicts) {
  const items = Object.entries(STATUS_WORDS)
    .map(([status, word]) => [verdicts.filter((v) => v.status === status).length, word])
    .filter(([n]) => n > 0)
    .map(([n, word]) => element("li", {}, `${n} ${word}`));
  const unsure = verdicts.filter((v) => v.doubts.length > 0).length;
  if (unsure) items.push(element("li", { class: "unsure" }, `${unsure} unsure`));
  document.getElementById("counts").replaceChildren(...items);
}

/** Everything known of the selected object, scan by scan. */
function tellDetails(state, pair) {
  const box = document.getElementById("details");
  const k = scene.objects.findIndex((o) => o.id === state.selected);
  box.hidden = k < 0;
  if (k < 0) return;
  const object = scene.objects[k];
  const verdict = pair.verdicts[k];
  const swatch = element("span", { class: "swatch", "aria-hidden": "true" }, String(object.number));
  swatch.style.background = object.color;
  swatch.style.color = object.ink;
  const parts = [element("h2", {}, swatch, object.name), element("p", {}, `${capital(verdict.text)}.`)];
  if (verdict.doubts.length) parts.push(element("p", { class: "doubt" }, `Unsure: ${verdict.doubts.join("; ")}.`));
  parts.push(element("div", { class: "scroll" }, detailsTable(object)));
  box.replaceChildren(...parts);
}

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function detailsTable(object) {
  const head = element("tr", {}, ...["scan", "match", "fit", "points", "seen", "doubts"].map((h) => element("th", { scope: "col" }, h)));
  const rows = scene.scans.map((scan, index) => detailsRow(scan.name, seenIn(object, index)));
  return element("table", {}, element("thead", {}, head), element("tbody", {}, ...rows));
}

function detailsRow(name, seen) {
  const cells = !seen
    ? ["not here", "", "", "", ""]
    : [
        seen.score === null ? "first seen" : seen.score.toFixed(2),
        seen.rms_mm === null ? "–" : `${seen.rms_mm.toFixed(0)} mm`,
        seen.points.toLocaleString("en"),
        seen.coverage === null ? "–" : `${Math.round(100 * seen.coverage)} %`,
        seen.doubts.join("; ") || "none",
      ];
  return element("tr", {}, ...[name, ...cells].map((cell) => element("td", {}, cell)));
}

/** Names of the scans over the views and on the slider. */
function tellViews(state) {
  const now = document.getElementById("view_now");
  const before = document.getElementById("view_before");
  now.textContent = (state.toggles.split ? "After: " : "") + scene.scans[state.time].name;
  before.textContent = `Before: ${scene.scans[baseScan(state.time, state.base)].name}`;
  before.hidden = !state.toggles.split;
  document.querySelector(".stage").classList.toggle("split", state.toggles.split);
  const slider = document.getElementById("time");
  slider.value = String(state.time);
  slider.setAttribute("aria-valuetext", scene.scans[state.time].name);
  for (const [k, tick] of [...document.querySelectorAll(".ticks li")].entries()) tick.classList.toggle("now", k === state.time);
}
