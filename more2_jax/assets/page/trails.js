// How objects came from where they were: pale shapes, arrows, rings of a turn.

const TURN_SHOWN_DEG = 5;
const TUBE = { sides: 6, along: 28 };

/** Arrows and rings of everything that moved between two scans; ghosts are shown where they stood. */
function buildTrails(builds, from, to, pair, extent) {
  const trails = new THREE.Group();
  for (const [k, built] of builds.entries()) {
    const { status, distance_m: distance, angle_deg: angle } = pair.verdicts[k];
    const left = ["moved", "removed", "not_seen"].includes(status);
    built.ghost.visible = left && from !== to;
    built.trail = null;
    if (!built.ghost.visible) continue;
    const start = vectorsOf(lastSeen(built.object, from));
    built.ghost.position.copy(start.position);
    built.ghost.quaternion.copy(start.quaternion);
    if (status !== "moved") continue;
    const width = extent * 0.0035;
    const radius = radiusOf(built);
    if (distance > 0.25 * radius) trails.add(arrow(pathOf(built, from, to, extent), width, built));
    else if (angle >= TURN_SHOWN_DEG) trails.add(arrow(ringOf(built, from, to, radius), width, built));
  }
  return trails;
}

/** Where an object was at a scan, or before it where that scan did not look. */
function lastSeen(object, scan) {
  for (let k = scan; k > 0; k--) if (seenIn(object, k)) return seenIn(object, k);
  return seenIn(object, 0);
}

/** An arch from top to top over every scan in between: furniture does not hide it. */
function pathOf(built, from, to, extent) {
  const stops = [];
  for (let scan = from; scan <= to; scan++) {
    const seen = scan === from ? lastSeen(built.object, from) : seenIn(built.object, scan);
    if (seen) stops.push(new THREE.Vector3(0, 0, 1.03 * built.top).add(vectorsOf(seen).position));
  }
  const points = [stops[0]];
  for (let k = 1; k < stops.length; k++) {
    const far = stops[k].distanceTo(stops[k - 1]);
    if (far < 0.02 * extent && k < stops.length - 1) continue; // it rested: no needle in the arch
    const middle = stops[k].clone().add(points.at(-1)).multiplyScalar(0.5);
    middle.z += 0.14 * stops[k].distanceTo(points.at(-1)) + 0.015 * extent;
    points.push(middle, stops[k]);
  }
  return new THREE.CatmullRomCurve3(points);
}

/** Part of a circle about the axis of the turn, over the object. */
function ringOf(built, from, to, radius) {
  const a = vectorsOf(seenIn(built.object, from));
  const b = vectorsOf(seenIn(built.object, to));
  const turn = b.quaternion.clone().multiply(a.quaternion.clone().invert());
  if (turn.w < 0) turn.set(-turn.x, -turn.y, -turn.z, -turn.w);
  const angle = 2 * Math.acos(Math.min(1, turn.w));
  const axis = new THREE.Vector3(turn.x, turn.y, turn.z).normalize();
  const spoke = new THREE.Vector3(1, 0, 0).applyQuaternion(a.quaternion);
  spoke.addScaledVector(axis, -spoke.dot(axis));
  if (spoke.lengthSq() < 1e-6) spoke.set(0, 0, 1).cross(axis);
  spoke.setLength(0.75 * radius);
  const middle = b.position.clone();
  middle.z += built.top * 1.05;
  const points = [];
  for (let k = 0; k <= 16; k++) {
    const part = new THREE.Quaternion(axis.x * Math.sin((angle * k) / 32), axis.y * Math.sin((angle * k) / 32), axis.z * Math.sin((angle * k) / 32), Math.cos((angle * k) / 32));
    points.push(spoke.clone().applyQuaternion(part).add(middle));
  }
  return new THREE.CatmullRomCurve3(points);
}

function radiusOf(built) {
  const { geometry, scale } = built.mesh ?? built.cloud;
  geometry.computeBoundingSphere();
  return geometry.boundingSphere.radius * scale.x;
}

/** A tube along a curve with a head at its end, as one mesh; `paint` gives it the object's colour. */
function arrow(curve, width, built) {
  const tube = new THREE.TubeGeometry(curve, TUBE.along, width, TUBE.sides);
  const head = new THREE.ConeGeometry(4 * width, 11 * width, 12);
  const direction = curve.getTangent(1);
  const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 1, 0), direction);
  const end = curve.getPoint(1).addScaledVector(direction, -5 * width);
  head.applyQuaternion(turn).translate(end.x, end.y, end.z);
  built.trail = new THREE.MeshBasicMaterial();
  return new THREE.Mesh(joined(tube, head), built.trail);
}

/** Two geometries as one: positions and faces. */
function joined(a, b) {
  const positions = [...a.attributes.position.array, ...b.attributes.position.array];
  const shift = a.attributes.position.count;
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions), 3));
  geometry.setIndex([...a.index.array, ...[...b.index.array].map((k) => k + shift)]);
  return geometry;
}

function disposeTrails(trails) {
  trails.traverse((part) => {
    part.geometry?.dispose();
    part.material?.dispose();
  });
}
