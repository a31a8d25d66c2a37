// The scene as Python left it: JSON, and one blob of arrays, deflated.

const scene = JSON.parse(document.getElementById("scene").textContent);
const lastScan = scene.scans.length - 1;
let blobBytes = null; // ArrayBuffer, once unpacked

async function unpackBlob() {
  const element = document.getElementById("blob");
  const text = atob(element.textContent);
  element.remove(); // half the page's memory
  const packed = Uint8Array.from(text, (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  blobBytes = await new Response(stream).arrayBuffer();
}

/** The array a reference stands for, without a copy. */
function arrayOf(reference) {
  const Type = reference.type === "uint16" ? Uint16Array : Uint32Array;
  return new Type(blobBytes, reference.at, reference.count);
}

/** The object's observation in a scan, or undefined. */
function seenIn(object, scan) {
  return object.observations.find((seen) => seen.scan === scan);
}

/** What happened between two scans of `more2.base` and time; in the first scan, what is there. */
function pairAt(time, base) {
  return scene.pairs[`${baseScan(time, base)}-${time}`];
}

/** The scan that `time` is compared with. */
function baseScan(time, base) {
  return base === "first" || time === 0 ? 0 : time - 1;
}
