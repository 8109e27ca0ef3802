"""The text beside a synthetic capture: what lies where, which frames are held out, what was left out for room."""

from __future__ import annotations

_TEXT = """# {name}

A synthetic capture by `smplxpp synth`: motion `{motion}`, {frames} frames at {fps:g} a second, {cameras} cameras, seed
{seed}; {worn}; light: {light}. Axes: y up, z to the front, x to the subject's left; metres; floor y = 0. Frame 0 is the
reference: a relaxed A-pose, neutral face, cloth settled.

{split} The held-out cameras are named in `manifest.json`.

| path | content | frames |
|---|---|---|
| `rgbs/CAM/` | sRGB JPEG on black, colour times opacity | all |
| `masks/CAM/` | opacity, 8 bits | all |
| `labels/CAM/` | 0 background, 1 skin, 2 hair, 3 shoes, 4 upper, 5 lower, 6 other | all |
| `normals/CAM/` | 16-bit RGB, n = value / 65535 * 2 - 1, world axes, towards the camera | {normals} |
| `geometry/frame_FFFFFF.npz` | `verts` of `topology.npz`: the true surface, rounded to 2^-14 m | {truth} |
| `params/params.npz` | body parameters, a row a frame: exact | all |
| `params/params_noisy.npz` | as a tracker would give them | all |
| `keypoints/`, `labels_estimated/` | as a detector and a parser would give them | all |
{scan}
`manifest.json` has the splits and the protocols `exact` and `tracked`, `checks.json` figures measured at its making.
"""
_WORN = {
    "skirt": "she wears a striped half-loose shirt and a loose skirt (pattern: {pattern}), both simulated",
    "trousers": "she wears a striped half-loose shirt, simulated, over tight trousers that follow the skin",
}


def capture_readme(manifest: dict, *, motion: str, clothes: str, pattern: str, scan: bool) -> str:
    """Return the README of a capture with the given manifest; the pattern is a skirt's."""
    train, novel = manifest["train_frames"], manifest.get("novel_pose_frames")
    split = f"Frames {train[0]} to {train[1]} are for training"
    split += f", {novel[0]} to {novel[1]} are held out as new poses." if novel else ", none is held out."
    return _TEXT.format(
        name=manifest["name"],
        motion=motion,
        frames=manifest["frames"],
        fps=manifest["fps"],
        seed=manifest["seed"],
        cameras=len(manifest["images"]),
        light=manifest["light"]["panorama"] if "light" in manifest else "even, brighter from above",
        worn=_WORN[clothes].format(pattern=pattern),
        split=split,
        normals=_every(next(iter(manifest["normals"].values()))),
        truth=_every(manifest["truth_frames"]),
        scan="| `scans/` | what a reconstruction of frame 0 would give, its labels | 0 |\n" if scan else "",
    )


def _every(frames: list[int]) -> str:
    step = frames[1] - frames[0] if len(frames) > 1 else 0
    return "all" if step == 1 else f"{', '.join(map(str, frames[:3]))} ..." if step else str(frames[0])
