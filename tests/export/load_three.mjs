// What the loaders of three.js find in a rigged GLB, VRM, FBX, OBJ or USD: a line of JSON, as foreign_readers.py prints it.
// Usage: node load_three.mjs FILE; the npm package is looked for in NODE_PATH, then as usual. Exit 3: not installed.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { extname } from "node:path";
import { pathToFileURL } from "node:url";

const require = createRequire(import.meta.url);
let core;
try {
  core = require.resolve("three");
} catch (error) {
  if (error.code !== "MODULE_NOT_FOUND") throw error;
  process.exit(3);
}
const load = (path) => import(pathToFileURL(path).href);
const loader = (name) => load(require.resolve(`three/examples/jsm/loaders/${name}.js`));
globalThis.self = globalThis;
// Pictures are counted, not decoded.
const pictures = new Set();
globalThis.document = {
  createElementNS() {
    const heard = {};
    return {
      addEventListener: (name, act) => (heard[name] = act),
      removeEventListener() {},
      set src(value) {
        queueMicrotask(() => heard.load?.call(this));
      },
    };
  },
};
console.warn = () => {};
const THREE = await load(core.replace(/build.three\.cjs$/, "build/three.module.js"));
const path = process.argv[2];
const data = readFileSync(path);
const buffer = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
const kind = extname(path);
let root;
if (kind === ".fbx") {
  const { FBXLoader } = await loader("FBXLoader");
  root = new FBXLoader().parse(buffer, "");
} else if (kind === ".obj") {
  const { OBJLoader } = await loader("OBJLoader");
  root = new OBJLoader().parse(data.toString());
} else {
  const { GLTFLoader } = await loader("GLTFLoader");
  root = (await new GLTFLoader().parseAsync(buffer, "")).scene;
}
// FBX keeps its file's centimetres, as its loader documents.
if (kind === ".fbx") root.scale.multiplyScalar(0.01);
root.updateMatrixWorld(true);
const box = new THREE.Box3();
const bones = new Set();
let [meshes, morphs, uv, agree, corners] = [0, 0, 0, 0, 0];
const [p, n, e, f, flat] = Array.from({ length: 5 }, () => new THREE.Vector3());
root.traverse((thing) => {
  if (!thing.isMesh) return;
  const { attributes, index } = thing.geometry;
  meshes += 1;
  uv += attributes.uv ? 1 : 0;
  morphs = Math.max(morphs, Object.keys(thing.morphTargetDictionary ?? {}).length);
  const used = thing.geometry.attributes.skinIndex;
  if (thing.isSkinnedMesh && used) {
    for (let k = 0; k < used.count * 4; k++) {
      if (thing.geometry.attributes.skinWeight.array[k] > 0) bones.add(thing.skeleton.bones[used.array[k]].name);
    }
    thing.skeleton.update();
  }
  for (const material of [thing.material].flat()) if (material.map) pictures.add(material.map.source.uuid);
  const at = (k, out) => out.fromBufferAttribute(attributes.position, k).applyMatrix4(thing.matrixWorld);
  for (let k = 0; k < attributes.position.count; k++) box.expandByPoint(at(k, p));
  if (!attributes.normal) return;
  const count = index ? index.count : attributes.position.count;
  for (let k = 0; k + 2 < count; k += 3) {
    const [a, b, c] = [0, 1, 2].map((j) => (index ? index.getX(k + j) : k + j));
    at(a, p);
    flat.crossVectors(at(b, e).sub(p), at(c, f).sub(p));
    for (const corner of [a, b, c]) {
      n.fromBufferAttribute(attributes.normal, corner).transformDirection(thing.matrixWorld);
      agree += n.dot(flat) > 0 ? 1 : 0;
      corners += 1;
    }
  }
});
const size = box.getSize(new THREE.Vector3());
console.log("FOUND " + JSON.stringify({
  meshes, bones: bones.size, morphs, uv, pictures: pictures.size, height: size.y, soles: box.min.y, wide: size.x / size.z,
  normals: corners ? agree / corners : null,
}));
