// The camera, the canvas, and what lies under the pointer.

const ROOM_AROUND = 1.08;

class Stage {
  constructor(canvas, state) {
    this.canvas = canvas;
    this.state = state; // window.more2
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    this.world = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.maxPolarAngle = 0.495 * Math.PI; // not from below the floor
    this.controls.addEventListener("change", () => this.redraw());
    this.builds = scene.objects.map(buildObject);
    this.backgrounds = scene.scans.map(buildBackground);
    this.extent = Math.max(0.05, Math.hypot(...scene.size));
    this.quality = QUALITY[0];
    this.pace = new Pace((quality) => this.drawIn(quality));
    this.trails = new THREE.Group();
    this.theme = { ink: new THREE.Color(), ground: new THREE.Color() };
    this.furnish();
    this.home();
    this.resize();
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  furnish() {
    const light = new THREE.DirectionalLight(0xffffff, 1.7);
    light.position.set(0.4, 0.7, 1.2);
    this.camera.add(light);
    const { floor, cell } = buildFloor(scene.size);
    this.floor = floor;
    this.cell = cell;
    this.world.add(this.camera, new THREE.HemisphereLight(0xffffff, 0x8d8d8d, 1.6), floor, this.trails);
    for (const built of this.builds) this.world.add(built.group, built.ghost);
    for (const cloud of this.backgrounds) if (cloud) this.world.add(cloud);
  }

  /** The nearest view that holds the box of all objects in all scans; walls and stray points may lie outside. */
  home() {
    const back = new THREE.Vector3(-0.55, -0.95, 0.85).normalize();
    const right = new THREE.Vector3(0, 0, 1).cross(back).normalize();
    const up = back.clone().cross(right);
    const rise = Math.tan((this.camera.fov * Math.PI) / 360) / ROOM_AROUND;
    const [a, b] = [reach(right, back, rise * this.aspect()), reach(up, back, rise)];
    const middle = right.clone().multiplyScalar(a.middle).addScaledVector(up, b.middle);
    const depth = new THREE.Vector3(...scene.box.low).add(new THREE.Vector3(...scene.box.high)).dot(back) / 2;
    this.controls.target.copy(middle).addScaledVector(back, depth);
    this.camera.position.copy(middle).addScaledVector(back, Math.max(a.away, b.away));
    this.camera.near = this.extent / 500;
    this.camera.far = this.extent * 20;
    this.controls.maxDistance = this.extent * 6;
    this.controls.update();
    this.redraw();
  }

  /** Width to height of one view. */
  aspect() {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const ratio = w / Math.max(h, 1);
    return this.state.toggles.split ? (this.stacked() ? ratio * 2 : ratio / 2) : ratio;
  }

  stacked() {
    return matchMedia("(max-width: 56rem) and (orientation: portrait)").matches;
  }

  resize() {
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * this.quality.pixels);
    this.renderer.setSize(this.canvas.clientWidth, this.canvas.clientHeight, false);
    this.redraw();
  }

  setTheme() {
    const css = getComputedStyle(document.documentElement);
    this.theme.ink.set(css.getPropertyValue("--ink").trim());
    this.theme.ground.set(css.getPropertyValue("--stage").trim());
    this.renderer.setClearColor(this.theme.ground);
    this.floor.material.vertexColors = false;
    this.floor.material.color.set(css.getPropertyValue("--line").trim());
    this.floor.material.needsUpdate = true;
    for (const cloud of this.backgrounds) cloud?.material.color.set(css.getPropertyValue("--control").trim());
    this.retrace();
  }

  /** Makes the arrows and pale shapes of the present time anew. */
  retrace() {
    disposeTrails(this.trails);
    this.world.remove(this.trails);
    const from = baseScan(this.state.time, this.state.base);
    const pair = pairAt(this.state.time, this.state.base);
    this.trails = buildTrails(this.builds, from, this.state.time, pair, this.extent);
    this.world.add(this.trails);
    this.redraw();
  }

  /** The viewports: what part of the canvas shows which time. Fractions, from the lower left corner. */
  views() {
    const { time, base, toggles } = this.state;
    const now = this.state.shownTime;
    if (!toggles.split) return [{ x: 0, y: 0, w: 1, h: 1, time: now, trails: toggles.trails }];
    const before = { time: baseScan(time, base), trails: false };
    const after = { time: now, trails: toggles.trails };
    return this.stacked()
      ? [{ x: 0, y: 0.5, w: 1, h: 0.5, ...before }, { x: 0, y: 0, w: 1, h: 0.5, ...after }]
      : [{ x: 0, y: 0, w: 0.5, h: 1, ...before }, { x: 0.5, y: 0, w: 0.5, h: 1, ...after }];
  }

  /** Puts everything where it stands in a view. */
  arrange(view) {
    const look = { toggles: this.state.toggles, selected: this.state.selected, theme: this.theme, quality: this.quality };
    for (const built of this.builds) {
      poseObject(built, view.time, look);
      built.ghost.children[0].visible = view.trails && !this.quality.bare;
    }
    this.trails.visible = view.trails && Number.isInteger(view.time);
    for (const [scan, cloud] of this.backgrounds.entries()) {
      if (!cloud) continue;
      cloud.visible = look.toggles.background && scan === Math.round(view.time);
      cloud.geometry.setDrawRange(0, Math.ceil(cloud.geometry.attributes.position.count * this.quality.points));
    }
  }

  /** Draws at a quality; the promise is kept when it is drawn. */
  drawIn(quality) {
    if (quality.pixels !== this.quality.pixels) {
      this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * quality.pixels); // sets the size, too
    }
    this.quality = quality;
    this.draw();
    return this.drawn();
  }

  /** Waits for the graphics card; the page goes on meanwhile. */
  drawn() {
    const gl = this.renderer.getContext();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return new Promise((done) => {
      const look = () => {
        if (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return setTimeout(look);
        gl.deleteSync(fence);
        done();
      };
      look();
    });
  }

  draw() {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.camera.aspect = this.aspect();
    this.camera.updateProjectionMatrix();
    this.renderer.setScissorTest(true);
    for (const view of this.views()) {
      const box = [view.x * w, view.y * h, view.w * w, view.h * h];
      this.renderer.setViewport(...box);
      this.renderer.setScissor(...box);
      this.arrange(view);
      this.renderer.render(this.world, this.camera);
    }
    this.state.frames += 1;
    this.afterDraw?.();
  }

  /** Draws once, before the next frame. */
  redraw() {
    this.pace.request();
  }

  /** Id of the object at a place of the canvas, pixels from its upper left corner, or null. */
  pick(x, y) {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const [u, v] = [x / w, 1 - y / h];
    const view = this.views().find((b) => u >= b.x && u < b.x + b.w && v >= b.y && v < b.y + b.h);
    if (!view) return null;
    this.arrange(view);
    this.world.updateMatrixWorld();
    const ray = new THREE.Raycaster();
    ray.params.Points.threshold = this.extent * 0.004;
    ray.setFromCamera(new THREE.Vector2(((u - view.x) / view.w) * 2 - 1, ((v - view.y) / view.h) * 2 - 1), this.camera);
    const parts = this.builds.filter((b) => b.group.visible).flatMap((b) => [b.mesh, b.cloud]);
    const hits = ray.intersectObjects(parts.filter((part) => part?.visible), false);
    return hits[0]?.object.userData.id ?? null;
  }

  /** Where a point above an object's anchor appears, canvas pixels; null behind the camera or absent. */
  project(built, view, up = 0, [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight]) {
    const pose = poseAt(built.object, view.time);
    if (!pose) return null;
    const at = pose.position.clone();
    at.z += up;
    at.project(this.camera);
    if (at.z > 1) return null;
    return { x: (view.x + (view.w * (at.x + 1)) / 2) * w, y: (1 - view.y - (view.h * (at.y + 1)) / 2) * h };
  }

  turn(azimuth, polar) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const flat = Math.hypot(offset.x, offset.y);
    const angle = Math.atan2(offset.y, offset.x) + azimuth;
    const tilt = Math.min(1.55, Math.max(0.02, Math.atan2(offset.z, flat) + polar));
    const away = offset.length();
    offset.set(Math.cos(angle) * Math.cos(tilt), Math.sin(angle) * Math.cos(tilt), Math.sin(tilt)).setLength(away);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.redraw();
  }

  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.redraw();
  }
}

/**
 * How far back a camera must stand, and how far to the side, so that along one direction of its picture every corner of
 * the objects' box lies within `slope` to either side.
 */
function reach(side, back, slope) {
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((k) =>
    new THREE.Vector3(...[0, 1, 2].map((axis) => (k & (1 << axis) ? scene.box.high : scene.box.low)[axis])));
  const high = Math.max(...corners.map((c) => c.dot(side) + slope * c.dot(back)));
  const low = Math.max(...corners.map((c) => -c.dot(side) + slope * c.dot(back)));
  return { away: Math.max((high + low) / (2 * slope), 1e-3), middle: (high - low) / 2 };
}
