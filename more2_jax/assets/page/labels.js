// Numbers over the objects, as HTML: sharp at every zoom.

class Labels {
  constructor(box, stage) {
    this.box = box;
    this.stage = stage;
    this.tags = [0, 1].map(() => stage.builds.map((built) => this.tag(built.object)));
    stage.afterDraw = () => this.place();
  }

  tag(object) {
    const tag = document.createElement("span");
    tag.className = "tag";
    tag.style.background = object.color;
    tag.style.color = object.ink;
    tag.hidden = true;
    this.box.append(tag);
    return tag;
  }

  place() {
    const views = this.stage.state.toggles.labels ? this.stage.views() : [];
    const size = [this.stage.canvas.clientWidth, this.stage.canvas.clientHeight]; // read before anything is written
    for (const [side, tags] of this.tags.entries()) {
      for (const [k, tag] of tags.entries()) this.put(tag, this.stage.builds[k], views[side], size);
    }
  }

  /** Writes only what changed: every write makes the browser lay out the tag anew. */
  put(tag, built, view, size) {
    const up = built.top * 1.03 + (built.trail ? 0.042 : 0.014) * this.stage.extent; // over the arrow's head
    const at = view ? this.stage.project(built, view, up, size) : null;
    const hidden = at === null || !this.inside(at, view, size);
    if (tag.hidden !== hidden) tag.hidden = hidden;
    if (hidden) return;
    const { id, number, name } = built.object;
    const selected = this.stage.state.selected;
    const text = id !== selected ? String(number) : name === `object ${number}` ? name : `${number} ${name}`;
    if (tag.textContent !== text) tag.textContent = text;
    tag.classList.toggle("off", selected !== null && id !== selected);
    tag.classList.toggle("chosen", id === selected);
    tag.style.transform = `translate(${Math.round(at.x)}px, ${Math.round(at.y)}px) translate(-50%, -100%)`;
  }

  inside(at, view, [w, h]) {
    const [u, v] = [at.x / w, 1 - at.y / h];
    return u >= view.x && u <= view.x + view.w && v >= view.y && v <= view.y + view.h;
  }
}
