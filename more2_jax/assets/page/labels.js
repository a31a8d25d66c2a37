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
    const selected = this.stage.state.selected;
    for (const [side, tags] of this.tags.entries()) {
      for (const [k, tag] of tags.entries()) {
        const built = this.stage.builds[k];
        const at = views[side] ? this.stage.project(built, views[side], built.top * 1.1 + 0.012 * this.stage.extent) : null;
        tag.hidden = at === null || !this.inside(at, views[side]);
        if (tag.hidden) continue;
        const { id, number, name } = built.object;
        tag.textContent = id !== selected ? number : name === `object ${number}` ? name : `${number} ${name}`;
        tag.classList.toggle("off", selected !== null && id !== selected);
        tag.style.transform = `translate(${Math.round(at.x)}px, ${Math.round(at.y)}px) translate(-50%, -100%)`;
      }
    }
  }

  inside(at, view) {
    const { clientWidth: w, clientHeight: h } = this.stage.canvas;
    const [u, v] = [at.x / w, 1 - at.y / h];
    return u >= view.x && u <= view.x + view.w && v >= view.y && v <= view.y + view.h;
  }
}
