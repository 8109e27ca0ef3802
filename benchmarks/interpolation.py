"""Motions given 20 times a second and shown 60 times, against what they truly were: millimetres and degrees.

    python -m benchmarks.interpolation [--seconds 8] [--avatar me.avatar] [--no-store]

The performances of the synthetic captures are curves that are known at every instant. Every third frame at 60 a second
is kept; those in between come from `avatar.runtime.motion.resampled` (every joint along its shortest turn), from axis
angles mixed as numbers, and from the frame before, held. Errors of the body's vertices, of its fastest joints, and of
the angle of the worst joint, over the frames in between alone. A second table sends every other key frame's vectors
to the other hemisphere, which is the same motion. With an avatar its pictures of frames in between are compared with
those of the true poses, drawn by the runtime from the front, 640 pixels high: PSNR over the person in either. Its loose
clothes are simulated along each motion whole, so that what a swing makes of small errors counts.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from avatar.runtime import AvatarPlayer
from avatar.runtime.motion import resampled
from benchmarks.machine import store_results
from pipelines.figures import VIEWS, fit_cameras
from pipelines.synth.motions import MOTIONS
from smplxpp.body import BodyModel, load_body
from smplxpp.core.params import POSE_BLOCKS, BodyParams

SHOWN, GIVEN = 60.0, 20.0
_BLOCK = 16
STEP = round(SHOWN / GIVEN)
HEIGHT, DRAWN = 640, 5


@dataclass(frozen=True)
class InterpolationBenchmark:
    """Measure all motions."""

    seconds: float = 8.0
    """Of each performance."""
    avatar: Path | None = None
    """Bundle whose pictures are compared, too."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        body = load_body()
        count = STEP * int(self.seconds * GIVEN) + 1
        figures: dict[str, dict[str, dict[str, float]]] = {}
        for name, kind in MOTIONS.items():
            performance = kind.make(
                betas=np.zeros(10), expression_names=body.expression_names, seconds=self.seconds, seed=0
            )
            motion = performance.at(np.arange(count) / SHOWN, fps=SHOWN)
            given, truth = replace(motion.select(slice(0, None, STEP)), fps=GIVEN), Posed.of(body, motion)
            for words, keys in ((name, given), (f"{name}, hemispheres flipped", flipped(given))):
                figures[words] = {way: truth.errors(Posed.of(body, make(keys))) for way, make in WAYS.items()}
            if self.avatar is not None:
                seen = pictures(AvatarPlayer(self.avatar, threads=1), motion, fit=motion)
                for way, make in WAYS.items():
                    found = pictures(AvatarPlayer(self.avatar, threads=1), make(given), fit=motion)
                    figures[name][way] |= likeness(seen, found)
        print(json.dumps(figures, indent=1))
        if self.store:
            command = f"python -m benchmarks.interpolation --seconds {self.seconds:g}"
            command += "" if self.avatar is None else f" --avatar {self.avatar.name}"
            store_results("interpolation", command, figures)


def mixed(given: BodyParams) -> BodyParams:
    """Mix all numbers in straight lines, rotations as axis angles."""
    return _between(given, lambda a, b, t: (1.0 - t) * a + t * b)


def held(given: BodyParams) -> BodyParams:
    """Show each frame until the next comes."""
    return _between(given, lambda a, b, t: a)


WAYS: dict[str, Callable[[BodyParams], BodyParams]] = {
    "shortest turns": lambda given: resampled(given, SHOWN),
    "axis angles mixed": mixed,
    "frame before, held": held,
}


def _between(given: BodyParams, mix: Callable[[np.ndarray, np.ndarray, float], np.ndarray]) -> BodyParams:
    names = (*(name for name, _ in POSE_BLOCKS), "expression", "transl")
    frames = []
    for k in range(STEP * (len(given) - 1) + 1):
        low, part = divmod(k, STEP)
        a, b = given.frame(low), given.frame(min(low + 1, len(given) - 1))
        frames.append(replace(a, **{name: mix(getattr(a, name), getattr(b, name), part / STEP) for name in names}))
    return replace(BodyParams.concatenate([replace(one, fps=None) for one in frames]), fps=SHOWN)


def flipped(given: BodyParams) -> BodyParams:
    """Turn every other frame's joints the long way round: `v (1 - 2 pi / |v|)` is the same rotation."""
    changed = {}
    for name, _ in POSE_BLOCKS:
        value = np.array(getattr(given, name))
        vectors = value.reshape(len(value), -1, 3)
        angle = np.linalg.norm(vectors, axis=2, keepdims=True)
        other = vectors * (1.0 - 2.0 * np.pi / np.maximum(angle, 1e-9))
        vectors[1::2] = np.where(angle[1::2] > 1e-6, other[1::2], vectors[1::2])
        changed[name] = value
    return replace(given, **changed)


def pictures(player: AvatarPlayer, motion: BodyParams, *, fit: BodyParams) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return every `DRAWN`-th picture in between and its opacity; the camera sees what `fit` does."""
    ends = [player.pose(fit.frame(k)).means.astype(np.float64) for k in range(0, len(fit), len(fit) // 6)]
    camera = fit_cameras(np.concatenate(ends), directions=[VIEWS["front"]], height=HEIGHT)[0]
    player.restart()
    shown = [k for k in range(len(motion)) if k % STEP][::DRAWN]
    out = []
    for k in range(shown[-1] + 1):
        player.step(motion.frame(k), 1.0 / SHOWN)
        if k in shown:
            out.append(player.draw(camera))
    return out


def likeness(seen: list[tuple[np.ndarray, np.ndarray]], found: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Return PSNR, dB, of pictures over the person in either."""
    values = []
    for (truth, alpha), (image, other) in zip(seen, found, strict=True):
        person = np.maximum(alpha, other) > 0.5
        values.append(
            -10.0 * np.log10(max(np.square(np.clip(image, 0, 1) - np.clip(truth, 0, 1))[person].mean(), 1e-12))
        )
    return {"pictures, mean dB": float(np.mean(values)), "pictures, worst dB": float(np.min(values))}


@dataclass(frozen=True, eq=False)
class Posed:
    """A motion's frames in between: vertices and joints in metres, turns of the joints."""

    vertices: np.ndarray
    joints: np.ndarray
    turned: np.ndarray

    @staticmethod
    def of(body: BodyModel, params: BodyParams) -> Posed:
        """Pose them."""
        between = [k for k in range(len(params)) if k % STEP]
        parts = [body.forward(params.select(between[k : k + _BLOCK])) for k in range(0, len(between), _BLOCK)]
        return Posed(
            np.concatenate([part.vertices.astype(np.float32) for part in parts]),
            np.concatenate([part.joints for part in parts]),
            body.joint_rotations(params.select(between)),
        )

    def errors(self, found: Posed) -> dict[str, float]:
        """Return how far another motion is from this one."""
        vertices = 1e3 * np.linalg.norm(self.vertices - found.vertices, axis=2).mean(axis=1)
        joints = 1e3 * np.linalg.norm(self.joints - found.joints, axis=2).max(axis=1)
        cosine = 0.5 * (np.einsum("tjab,tjab->tj", self.turned, found.turned) - 1.0)
        angles = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max(axis=1)
        return {
            "vertices, mean mm": float(vertices.mean()),
            "vertices, worst frame mm": float(vertices.max()),
            "fastest joint, mean mm": float(joints.mean()),
            "fastest joint, worst frame mm": float(joints.max()),
            "worst joint, mean degrees": float(angles.mean()),
            "worst joint, worst frame degrees": float(angles.max()),
        }


if __name__ == "__main__":
    tyro.cli(InterpolationBenchmark).run()
