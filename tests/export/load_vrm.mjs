// Loads a VRM with three.js and @pixiv/three-vrm and prints what came of it as JSON, with vertices that it posed itself.
// Usage: node load_vrm.mjs FILE; the npm packages are looked for in NODE_PATH, then as usual. Exit 3: not installed.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const require = createRequire(import.meta.url);
let paths;
try {
  paths = ["three", "three/examples/jsm/loaders/GLTFLoader.js", "@pixiv/three-vrm"].map((name) => require.resolve(name));
} catch (error) {
  if (error.code !== "MODULE_NOT_FOUND") throw error;
  process.exit(3);
}
globalThis.self = globalThis;
const folder = paths[0].replace(/build.three\.cjs$/, "build/three.module.js");
const vrmModule = paths[2].replace(/three-vrm\.(cjs|module\.min\.js|module\.js)$/, "three-vrm.module.js");
const [THREE, { GLTFLoader }, { VRMLoaderPlugin }] = await Promise.all(
  [folder, paths[1], vrmModule].map((path) => import(pathToFileURL(path).href)),
);
const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
const data = readFileSync(process.argv[2]);
const warnings = [];
console.warn = (...words) => warnings.push(words.join(" "));
const gltf = await loader.parseAsync(data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength), "");
const vrm = gltf.userData.vrm;
vrm.scene.updateMatrixWorld(true);

const meshes = {};
vrm.scene.traverse((thing) => {
  if (thing.isSkinnedMesh) meshes[thing.name] = thing;
});
const posed = () => {
  vrm.update(0);
  vrm.scene.updateMatrixWorld(true);
  return Object.fromEntries(
    Object.entries(meshes).map(([name, mesh]) => {
      mesh.skeleton.update();
      const out = [];
      const point = new THREE.Vector3();
      for (let k = 0; k < mesh.geometry.attributes.position.count; k++) {
        mesh.getVertexPosition(k, point).applyMatrix4(mesh.matrixWorld);
        out.push(point.x, point.y, point.z);
      }
      return [name, out];
    }),
  );
};
const bones = {};
for (const [name, bone] of Object.entries(vrm.humanoid.humanBones)) {
  bones[name] = bone.node.getWorldPosition(new THREE.Vector3()).toArray();
}
const rest = posed();
const expressions = {};
for (const { expressionName } of vrm.expressionManager?.expressions ?? []) {
  vrm.expressionManager.setValue(expressionName, 1);
  const after = posed();
  vrm.expressionManager.setValue(expressionName, 0);
  let most = 0;
  for (const name of Object.keys(rest)) rest[name].forEach((x, k) => (most = Math.max(most, Math.abs(after[name][k] - x))));
  expressions[expressionName] = { most, vertices: expressionName === "aa" ? after : undefined };
}
// The left arm down by a normalised bone, as every motion of VRM turns it, and the eyes towards a point.
vrm.humanoid.getNormalizedBoneNode("leftUpperArm").rotation.set(0, 0, -1.2);
const arm = posed();
vrm.humanoid.getNormalizedBoneNode("leftUpperArm").rotation.set(0, 0, 0);
let gaze = null;
if (vrm.lookAt) {
  vrm.lookAt.autoUpdate = false;
  vrm.lookAt.yaw = 10;
  vrm.lookAt.pitch = 5;
  vrm.lookAt.update(0);
  vrm.update(0);
  const turned = vrm.humanoid.getRawBoneNode("leftEye").getWorldQuaternion(new THREE.Quaternion());
  gaze = new THREE.Vector3(0, 0, 1).applyQuaternion(turned).toArray();
}
console.log(JSON.stringify({ meta: vrm.meta, bones, rest, expressions, arm, gaze, warnings }));
