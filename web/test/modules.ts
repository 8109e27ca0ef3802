/** What the tests take from the player. */
export { Deformer, RECORD } from "../src/avatar/deform.ts";
export { poseAt, restPose, turned } from "../src/avatar/motion.ts";
export { Resampler } from "../src/chat/resample.ts";
export { BundleError } from "../src/bundle/errors.ts";
export { readBundle } from "../src/bundle/read.ts";
export { sha256Here } from "../src/bundle/sha256.ts";
export { orbitCamera } from "../src/render/camera.ts";
export { Native } from "../src/native/memory.ts";
export { ClothDriver } from "../src/cloth/driver.ts";
export { pinned, shareOf } from "../src/cloth/garment.ts";
export { buildModel } from "../src/cloth/model.ts";
export { harmonicsOf, matrices, WHITE } from "../src/light/irradiance.ts";
export { isRadiance, readRadiance } from "../src/light/radiance.ts";
