/** What the tests take from the player. */
export { Deformer, RECORD } from "../src/avatar/deform.ts";
export { poseAt, restPose, turned } from "../src/avatar/motion.ts";
export { Resampler } from "../src/chat/resample.ts";
export { SpeakingFace } from "../src/lips/face.ts";
export { Ear } from "../src/lips/features.ts";
export { LipNetwork } from "../src/lips/network.ts";
export { Steady } from "../src/lips/steady.ts";
export { unpackTensors } from "../src/bundle/tensors.ts";
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
