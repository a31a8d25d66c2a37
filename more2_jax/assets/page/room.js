// Objects, background and floor as three.js sees them, and where they stand at a time.

const FADED = 0.65; // how far the colour of what is not selected goes towards the ground's

/** Quantised points as a geometry; place it with `placeOnGrid`. */
function gridGeometry(reference) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(arrayOf(reference), 3));
  return geometry;
}

/** Undoes the quantisation: low + step * integers. */
function placeOnGrid(thing, reference) {
  thing.position.fromArray(reference.low);
  thing.scale.setScalar(reference.step);
  return thing;
}

function buildObject(object) {
  const group = new THREE.Group();
  const color = new THREE.Color(object.color);
  const cloud = new THREE.Points(gridGeometry(object.cloud), [new THREE.PointsMaterial({ size: 2, sizeAttenuation: false })]);
  group.add(placeOnGrid(cloud, object.cloud));
  const top = topOf(cloud, object.cloud);
  const built = { object, group, cloud, color, mesh: null, fine: null, coarse: null, ghost: null, trail: null, top };
  if (object.mesh) {
    buildMesh(built);
    group.add(built.mesh);
    built.top = Math.max(built.top, topOf(built.mesh, object.mesh.vertices));
  }
  built.ghost = buildGhost(built);
  const parts = built.mesh ? [built.mesh, cloud] : [cloud];
  for (const part of parts) part.userData.id = object.id;
  return built;
}

/** The surface, and the same with fewer faces on the same vertices. */
function buildMesh(built) {
  const { vertices, faces, coarse, closed } = built.object.mesh;
  built.fine = gridGeometry(vertices);
  built.fine.setIndex(new THREE.BufferAttribute(arrayOf(faces), 1));
  built.fine.computeVertexNormals();
  built.coarse = built.fine.clone();
  built.coarse.attributes = built.fine.attributes; // one copy on the graphics card
  built.coarse.setIndex(new THREE.BufferAttribute(arrayOf(coarse), 1));
  const side = closed ? THREE.FrontSide : THREE.DoubleSide; // nobody sees a closed surface from within
  built.mesh = placeOnGrid(new THREE.Mesh(built.fine, new THREE.MeshLambertMaterial({ side })), vertices);
}

/** The pale shape that shows where an object was. */
function buildGhost(built) {
  const pale = { transparent: true, depthWrite: false, opacity: built.mesh ? 0.22 : 0.35, color: built.color };
  const ghost = new THREE.Group();
  ghost.add(
    built.mesh
      ? placeOnGrid(new THREE.Mesh(built.coarse, new THREE.MeshLambertMaterial(pale)), built.object.mesh.vertices)
      : placeOnGrid(new THREE.Points(built.cloud.geometry, new THREE.PointsMaterial({ ...pale, size: 2, sizeAttenuation: false })), built.object.cloud),
  );
  ghost.visible = false;
  return ghost;
}

/** Height of an object's top above its anchor, in its reference frame. */
function topOf(thing, reference) {
  thing.geometry.computeBoundingBox();
  return reference.low[2] + reference.step * thing.geometry.boundingBox.max.z;
}

function buildBackground(scan) {
  if (!scan.background) return null;
  const material = new THREE.PointsMaterial({ size: 1.5, sizeAttenuation: false, transparent: true, opacity: 0.55 });
  return placeOnGrid(new THREE.Points(gridGeometry(scan.background), material), scan.background);
}

/** Lines on the floor, one cell 1 m, or 10 m, 10 cm, … as fits. */
function buildFloor(size) {
  const wide = Math.max(size[0], size[1], 0.01);
  const cell = 10 ** Math.round(Math.log10(wide / 6));
  const count = Math.max(2, Math.ceil(wide / cell) + 2);
  const floor = new THREE.GridHelper(count * cell, count);
  floor.rotation.x = Math.PI / 2; // three.js lays it across y; here z is up
  floor.position.z = -size[2] / 2;
  return { floor, cell };
}

/** Where an object stands at a time, whole or between two scans; null where it is absent. */
function poseAt(object, time) {
  const before = seenIn(object, Math.floor(time));
  const after = seenIn(object, Math.ceil(time));
  const f = time - Math.floor(time);
  if (!before && !after) return null;
  if (!before || !after) {
    const seen = before ?? after;
    return { ...vectorsOf(seen), strength: f === 0 ? 1 : before ? 1 - f : f };
  }
  const a = vectorsOf(before);
  const b = vectorsOf(after);
  return { position: a.position.lerp(b.position, f), quaternion: a.quaternion.slerp(b.quaternion, f), strength: 1 };
}

function vectorsOf(seen) {
  return {
    position: new THREE.Vector3().fromArray(seen.position),
    quaternion: new THREE.Quaternion().fromArray(seen.quaternion),
  };
}

/** Puts a built object where it stands at a time and shows what the toggles ask for. */
function poseObject(built, time, look) {
  const pose = poseAt(built.object, time);
  paintPast(built, look);
  built.group.visible = pose !== null;
  if (!pose) return;
  built.group.position.copy(pose.position);
  built.group.quaternion.copy(pose.quaternion);
  showCloud(built, Math.round(time), look);
  if (built.mesh) {
    built.mesh.visible = look.toggles.meshes;
    built.mesh.geometry = look.quality.coarse ? built.coarse : built.fine;
  }
  paint(built, pose.strength, look);
}

/** Draws the points of one scan or of all, or a share of each scan: a scan's points follow each other in the buffer. */
function showCloud(built, scan, look) {
  const { counts, observations } = built.object;
  const all = look.toggles.accumulated;
  const shown = observations.findIndex((seen) => seen.scan === scan);
  const { geometry } = built.cloud;
  const hidden = look.quality.bare && built.mesh && look.toggles.meshes;
  built.cloud.visible = !hidden && (all || (look.toggles.clouds && shown >= 0));
  geometry.clearGroups();
  let begin = 0;
  for (const [k, count] of counts.entries()) {
    if (k === shown && !all) geometry.setDrawRange(begin, count);
    if (k === shown || all) geometry.addGroup(begin, Math.ceil(count * look.quality.points), 0);
    begin += count;
  }
  if (all) geometry.setDrawRange(0, begin);
}

function fadingOf(built, look) {
  return look.selected !== null && look.selected !== built.object.id ? FADED : 0;
}

/** The pale shape and the arrow of an object. */
function paintPast(built, look) {
  const faded = fadingOf(built, look);
  built.ghost.children[0].material.color.copy(built.color).lerp(look.theme.ground, faded);
  built.trail?.color.copy(built.color).lerp(look.theme.ink, 0.25).lerp(look.theme.ground, faded);
}

function paint(built, strength, look) {
  const chosen = look.selected === built.object.id;
  const faded = fadingOf(built, look);
  const [points] = built.cloud.material;
  points.color.copy(built.color);
  if (built.mesh && look.toggles.meshes) points.color.lerp(look.theme.ink, 0.35); // or they drown in the surface
  points.color.lerp(look.theme.ground, faded);
  for (const material of built.mesh ? [built.mesh.material, points] : [points]) {
    if (material.transparent !== strength < 1) {
      material.transparent = strength < 1;
      material.needsUpdate = true;
    }
    material.opacity = strength;
  }
  if (!built.mesh) return;
  built.mesh.material.color.copy(built.color).lerp(look.theme.ground, faded);
  built.mesh.material.emissive.copy(built.color).multiplyScalar(chosen ? 0.35 : 0.08);
}
