// Finer points and surfaces of a large scene: a file an object, read when it is selected or near, let go of in time.

const MOST_HELD = { points: 500_000, faces: 500_000 }; // at a time, of all objects
const NEAR = 0.12; // share of the view's height that an object takes

class Details {
  constructor(stage) {
    this.stage = stage;
    this.most = MOST_HELD;
    this.held = new Map(); // what coarse shapes they stand for, by `built`; least recently wanted first
    this.missing = new Set(); // what could not be read
    this.reading = null;
    this.told = null; // what the last file called with
    window.more2Detail = (stamp, shape, text) => (this.told = { stamp, shape, text });
    for (const built of stage.builds) built.ball = ballOf(built);
    const place = stage.afterDraw;
    stage.afterDraw = () => {
      place();
      this.look();
    };
    this.look();
  }

  /** Reads the first detail that is wanted and not there; the next once it is. */
  look() {
    const wanted = this.wanted();
    for (const built of wanted.filter((b) => this.held.has(b)).reverse()) {
      const coarse = this.held.get(built);
      this.held.delete(built);
      this.held.set(built, coarse); // wanted last
    }
    const next = wanted.find((b) => !this.held.has(b) && !this.missing.has(b));
    if (next && !this.reading) this.read(next, wanted);
  }

  /** The selected object and those that are near, nearest first, as many as may be held. */
  wanted() {
    const size = new Map(this.stage.builds.map((built) => [built, this.sizeOf(built)]));
    const near = this.stage.builds.filter((b) => size.get(b) >= NEAR).sort((a, b) => size.get(b) - size.get(a));
    const room = { ...this.most };
    return near.filter(({ object: { detail } }) => {
      const fits = detail.points <= room.points && detail.faces <= room.faces;
      if (fits) for (const kind in room) room[kind] -= detail[kind];
      return fits;
    });
  }

  /** Share of the view's height that an object takes; 0 out of sight, and all there is where it is selected. */
  sizeOf({ object, group, ball }) {
    if (object.id === this.stage.state.selected) return Infinity;
    if (!group.visible) return 0;
    const { camera } = this.stage;
    const at = ball.middle.clone().applyMatrix4(group.matrixWorld).applyMatrix4(camera.matrixWorldInverse);
    if (at.z > ball.radius) return 0; // behind
    const high = Math.max(-at.z, camera.near) * Math.tan((camera.fov * Math.PI) / 360);
    const [outX, outY] = [Math.abs(at.x) - high * camera.aspect, Math.abs(at.y) - high];
    return Math.max(outX, outY) > ball.radius ? 0 : ball.radius / high;
  }

  async read(built, wanted) {
    this.reading = built;
    const { stamp } = built.object.detail;
    try {
      this.told = null;
      await ran(`${scene.details}/${scene.objects.indexOf(built.object)}.js`);
      if (this.told?.stamp !== stamp) throw new Error("not of this page");
      const { shape, text } = this.told;
      this.put(built, shape, await unpacked(text), wanted);
      const { pace } = this.stage;
      if (pace.settled) pace.settle(); // all of it at once: nothing moves
      else pace.ask();
    } catch {
      this.missing.add(built);
      this.say();
    }
    this.told = this.reading = null;
    this.look();
  }

  /** Shows the fine shape in the coarse one's place, on the coarse one's grid. */
  put(built, shape, bytes, wanted) {
    const { object, cloud, mesh } = built;
    const points = onGrid(shape.cloud, object.cloud, bytes);
    const fine = mesh && onGrid(shape.mesh.vertices, object.mesh.vertices, bytes);
    fine?.setIndex(new THREE.BufferAttribute(detailArray(shape.mesh.faces, bytes), 1));
    fine?.computeVertexNormals();
    this.makeRoom(object.detail, wanted);
    this.held.set(built, { points: cloud.geometry, counts: object.counts, fine: built.fine, side: mesh?.material.side });
    const side = shape.mesh?.closed ? THREE.FrontSide : THREE.DoubleSide;
    exchange(built, { points, counts: shape.counts, fine, side });
  }

  /** Lets go of what was wanted longest ago. */
  makeRoom(detail, wanted) {
    const full = (kind) => [...this.held.keys()].reduce((sum, b) => sum + b.object.detail[kind], detail[kind]) > this.most[kind];
    for (const built of [...this.held.keys()].filter((b) => !wanted.includes(b))) {
      if (!full("points") && !full("faces")) return;
      const [fine, points] = [built.fine, built.cloud.geometry];
      exchange(built, this.held.get(built));
      this.held.delete(built);
      for (const geometry of [fine, points]) geometry?.dispose();
    }
  }

  /** One quiet line about what stays coarse. */
  say() {
    this.line ??= this.stage.canvas.parentElement.appendChild(element("p", { class: "scale", role: "status" }));
    Object.assign(this.line.style, { left: ".8rem", right: "auto" });
    const count = this.missing.size;
    this.line.textContent = `${count} object${count === 1 ? " stays" : "s stay"} coarse: no detail in ${scene.details}`;
  }
}

function exchange(built, { points, counts, fine, side }) {
  built.cloud.geometry = points;
  built.object.counts = counts;
  if (!built.mesh) return;
  built.fine = fine;
  built.mesh.geometry = fine;
  built.mesh.material.side = side;
  built.mesh.material.needsUpdate = true;
}

/** The ball around a coarse shape, in its group. */
function ballOf({ mesh, cloud }) {
  const part = mesh ?? cloud;
  part.geometry.computeBoundingSphere();
  const { center, radius } = part.geometry.boundingSphere;
  return { middle: center.clone().multiplyScalar(part.scale.x).add(part.position), radius: radius * part.scale.x };
}

/** Runs a file beside the page, from disk as from a server; fails where there is none. */
function ran(path) {
  const script = document.createElement("script");
  const end = new Promise((done, failed) => Object.assign(script, { onload: done, onerror: failed }));
  script.src = path;
  document.head.append(script);
  return end.finally(() => script.remove());
}

async function unpacked(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

function detailArray(reference, bytes) {
  const Type = reference.type === "uint16" ? Uint16Array : Uint32Array;
  return new Type(bytes, reference.at, reference.count);
}

/** Points of a detail in steps of a coarse shape's grid. */
function onGrid(reference, coarse, bytes) {
  const of = (value, k) => (reference.low[k % 3] - coarse.low[k % 3] + reference.step * value) / coarse.step;
  const geometry = new THREE.BufferGeometry();
  const positions = Float32Array.from(detailArray(reference, bytes), of);
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  return geometry;
}

// Once the coarse room is drawn.
requestAnimationFrame(function begin() {
  if (!more2.ready) requestAnimationFrame(begin);
  else if (stage) more2.details = new Details(stage);
});
