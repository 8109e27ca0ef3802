/** Avatars of smplxpp in other people's pages. */

export { createAvatar, CanvasAvatar, type CanvasOptions, type CanvasSettings } from "./canvas.ts";
export { VISEME_NAMES, type Viseme } from "../lips/visemes.ts";
export type { Dialogue, DialogueEvents } from "../chat/dialogue.ts";
export { AvatarError } from "./avatar.ts";
export type {
  Avatar, AvatarEvents, AvatarFiles, AvatarOptions, AvatarSettings, BrowserVoice, MotionParams, PlayOptions, PoseParams, Source, Summary,
  TextToSpeech, Utterance, Vector,
} from "./avatar.ts";
