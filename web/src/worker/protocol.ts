/** What page and worker tell each other. */

import type { Motion, Pose } from "../avatar/avatar.ts";
import type { Camera } from "../render/camera.ts";

/** To the worker. */
export type Request =
  | { kind: "open"; data: ArrayBuffer }
  | {
      kind: "frame";
      pose: Pose;
      camera: Camera;
      hidden: number[];
      /** In the order of depth; else as they come, for a renderer that sorts. */
      sorted: boolean;
      /** With normals, for another light. */
      lit: boolean;
      /** Of loose clothes' time since the last frame; Infinity: they start anew, null: they are not simulated. */
      seconds: number | null;
      /** Memory to fill, given back by the page. */
      records: ArrayBuffer | null;
    };

/** What the page knows of an avatar; the worker keeps the rest. */
export interface Summary {
  name: string;
  licence: string;
  provenance: Record<string, string>;
  partNames: string[];
  /** Parts that are simulated. */
  garments: string[];
  expressionNames: string[];
  jointNames: string[];
  count: number;
  bytes: number;
  blur: number;
  motion: Motion | null;
  /** The middle and half the height of the first pose, metres. */
  middle: [number, number, number];
  reach: number;
}

/** Threads that share a pose. */
export interface Threads {
  count: number;
  /** Slices of the work that others than the worker itself have done. */
  helped: number;
  /** Why there are no others any more; null: they were never lost. */
  lost: string | null;
}

/** From the worker. */
export type Reply =
  | { kind: "opened"; summary: Summary }
  | {
      kind: "frame"; records: ArrayBuffer; count: number; camera: Camera; depths: [number, number];
      lit: boolean;
      /** Milliseconds. */
      deform: number; cloth: number; sort: number;
      /** Of the fastest particle of the clothes, metres a second. */
      speed: number;
      threads: Threads;
    }
  | { kind: "failed"; message: string };
