/** Poses, sorts and packs in a thread of its own. */

import type { Avatar } from "../avatar/avatar.ts";
import { Deformer, RECORD } from "../avatar/deform.ts";
import { poseAt, restPose } from "../avatar/motion.ts";
import { ClothDriver } from "../cloth/driver.ts";
import { BundleError } from "../bundle/errors.ts";
import { readBundle } from "../bundle/read.ts";
import { Native } from "../native/memory.ts";
import { eye, NEAR } from "../render/camera.ts";
import type { Reply, Request, Summary } from "./protocol.ts";

/** The thread, as TypeScript's library for pages does not know it. */
const thread = self as unknown as {
  onmessage: (event: MessageEvent<Request>) => void;
  postMessage(message: Reply, moved: Transferable[]): void;
};

/** Threads that share a pose where the page may share memory; more would wait for what one of them does by itself. */
const MOST_THREADS = 4;
let threads = self.crossOriginIsolated ? Math.min(MOST_THREADS, navigator.hardwareConcurrency) : 1;
/** Why there are no others any more; null: they were never lost. */
let lost: string | null = null;
let deformer: Deformer | null = null;
let clothes: ClothDriver | null = null;

thread.onmessage = async (event) => {
  try {
    const [reply, moved] = event.data.kind === "open" ? await open(event.data.data) : frame(event.data);
    thread.postMessage(reply, moved);
  } catch (error) {
    const message = error instanceof BundleError ? error.message : `the player failed: ${String(error)}`;
    thread.postMessage({ kind: "failed", message }, []);
  }
};

async function open(data: ArrayBuffer): Promise<[Reply, Transferable[]]> {
  const avatar = await readBundle(new Uint8Array(data));
  return [{ kind: "opened", summary: steadily(avatar, (it) => summary(avatar, it)) }, []];
}

/** Does some work; should threads that help have failed, in memory of its own and without any, now and from now on. */
function steadily<T>(avatar: Avatar, work: (deformer: Deformer) => T): T {
  try {
    const it = prepared(avatar);
    if (it.native.lost) throw new Error(it.native.lost);
    return work(it);
  } catch (error) {
    if (threads === 1) throw error;
    threads = 1;
    lost = (error as Error).message;
    return work(prepared(avatar));
  }
}

/** What poses an avatar, with as many threads as there are to be. */
function prepared(avatar: Avatar): Deformer {
  if (deformer?.avatar === avatar && deformer.native.threads === threads) return deformer;
  const made = new Deformer(avatar, undefined, new Native(threads));
  clothes = avatar.garments.length ? new ClothDriver(made, avatar.garments) : null;
  deformer?.native.close();
  return (deformer = made);
}

function summary(avatar: Avatar, first: Deformer): Summary {
  first.pose(avatar.motion ? poseAt(avatar.motion, 0) : restPose(avatar.skeleton.names.length, avatar.expressionNames.length));
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  first.centers.forEach((value, i) => {
    low[i % 3] = Math.min(low[i % 3], value);
    high[i % 3] = Math.max(high[i % 3], value);
  });
  return {
    name: avatar.name,
    licence: avatar.licence,
    provenance: avatar.provenance,
    partNames: avatar.partNames,
    garments: avatar.garments.map(({ part }) => part),
    expressionNames: avatar.expressionNames,
    jointNames: avatar.skeleton.names,
    count: avatar.gaussians.count,
    bytes: avatar.bytes,
    blur: avatar.blur,
    motion: avatar.motion,
    middle: low.map((value, k) => (value + high[k]) / 2) as Summary["middle"],
    reach: (high[1] - low[1]) / 2,
  };
}

function frame(request: Extract<Request, { kind: "frame" }>): [Reply, Transferable[]] {
  if (!deformer) throw new Error("no avatar is open");
  return steadily(deformer.avatar, (it) => posed(request, it));
}

function posed(request: Extract<Request, { kind: "frame" }>, deformer: Deformer): [Reply, Transferable[]] {
  const { camera } = request;
  const started = performance.now();
  const simulated = request.seconds === null ? null : clothes;
  const cloth = simulated && simulated.follow(request.pose, request.seconds!);
  const moved = performance.now();
  deformer.pose(request.pose, cloth, request.hidden);
  const posed = performance.now();
  // Where the page sorts, this only leaves out what is hidden or behind the camera.
  const { count, depths } = deformer.order(camera.view.slice(8, 12), NEAR, request.hidden, request.sorted);
  const sorted = performance.now();
  const size = 4 * RECORD * deformer.avatar.gaussians.count;
  const records = request.records?.byteLength === size ? request.records : new ArrayBuffer(size);
  new Float32Array(records).set(deformer.recordsFor(eye(camera), count, request.lit));
  const packed = performance.now();
  const times = { cloth: moved - started, deform: posed - moved + (packed - sorted), sort: sorted - posed };
  const speed = simulated ? simulated.speed : 0, used = { count: threads, helped: deformer.native.helped, lost };
  return [{ kind: "frame", records, count, camera, depths, lit: request.lit, speed, threads: used, ...times }, [records]];
}
