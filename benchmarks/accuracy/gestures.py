"""Measure gestures of a speaking person: planted feet, distance of the hands, beats, repetitions.

    python -m benchmarks gestures

A Piper voice (extra `[talk]`) speaks for some minutes, and the embedded body, known from an A-pose alone, gestures to
it. Measured are the path length of the feet's joints, the distance of hands from the trunk's skin, the delay of beats
after stressed vowels, the seconds of speech until a gesture is used again, and the similarity of any two pieces of
the arms' angles; in addition the part of ARKit's expressions that numbered ones cannot make
(`smplxpp.body.blendshapes`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import tyro
from jaxtyping import Float64
from scipy.spatial import cKDTree

from avatar.speech import Face, Phoneme, Speech, SpeechAnimator, StandingBody, TalkConfig
from avatar.speech.voice import PiperVoice
from benchmarks.accuracy.talking import SENTENCES
from benchmarks.support.results import store_results
from smplxpp.body import load_body
from smplxpp.body.blendshapes import ARKIT, transfer_blendshapes
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.model import BodyModel
from smplxpp.body.retarget import FEET, Skeleton
from smplxpp.core.params import BodyParams

MINUTES = 4.0
SEEDS = (0, 1, 2)
WINDOW, STEP = 3.0, 0.5
"""Seconds of two pieces that are compared, and between those that are."""
_APART = np.radians(50.0)  # angle of the arms to the trunk in the one frame
_PARTS = ("shoulder", "elbow", "wrist")
_MOUTH = ("mouthPressLeft", "mouthRollLower", "mouthPucker", "mouthFunnel", "mouthSmileLeft", "eyeBlinkLeft")


@dataclass(frozen=True)
class Gestures:
    """Talk, measure, store."""

    def run(self) -> None:
        """Print and store the figures."""
        body = load_body()
        rest = BodyParams.rest(betas=0, expressions=body.num_expressions)
        pose = np.zeros((1, 63))
        for side, sign in (("left", -1.0), ("right", 1.0)):
            pose[0, 3 * SMPLX_JOINTS.index(f"{side}_shoulder") - 1] = sign * _APART
        seen = replace(rest, body_pose=pose)
        standing = StandingBody.of(Skeleton.of(body), seen, surface=body.forward(rest).frame(0).vertices)
        speech = said_for(60.0 * MINUTES)
        rows = [measured(body, standing, speech, seed) for seed in SEEDS]
        figures = {
            "speech": {
                "minutes": MINUTES,
                "seeds": len(SEEDS),
                "stressed": sum(one.stress == 1 for one in speech.spoken),
            },
            "gestures": {name: [row[name] for row in rows] for name in rows[0]},
            "numbered expressions": {str(count): left_of(body, count) for count in (10, 20, 50)},
        }
        for name, value in figures.items():
            print(f"{name:24s} {value}")
        print(f"stored {store_results('gestures', 'python -m benchmarks gestures', figures).name}")


def said_for(seconds: float) -> Speech:
    """Return the benchmark's sentences, repeated at changing speeds for the given minutes."""
    voice, phonemes, at = PiperVoice(threads=1), list[Phoneme](), 0.0
    texts = [voice.say(text, slower=slower).speech for text in SENTENCES for slower in (0.9, 1.0, 1.15)]
    order = np.random.default_rng(0).permutation(np.arange(10 * len(texts)) % len(texts))
    for k in order:
        if at >= seconds:
            break
        phonemes += [replace(one, start=one.start + at, end=one.end + at) for one in texts[k].phonemes]
        at += texts[k].seconds + 0.15
    return Speech(tuple(phonemes), at)


def measured(body: BodyModel, standing: StandingBody, speech: Speech, seed: int) -> dict[str, float]:
    """Return what a seed's motion is like; millimetres, milliseconds, degrees, seconds."""
    face = Face.of(body.expression_names, body.joint_names)
    animator = SpeechAnimator(face, standing, TalkConfig(seed=seed))
    began = time.process_time()
    motion = animator.talk(speech)
    spent = time.process_time() - began
    assert animator.gestures is not None
    strokes = animator.gestures.strokes
    # Distances of the feet from their place in the first frame: standing feet must not slide.
    feet = standing.skeleton.pose(motion)[:, standing.skeleton.at(*FEET)]
    stressed = np.array([one.start for one in speech.spoken if one.stress == 1])
    # Beats should strike on the stressed vowel: time from the last such vowel's start to the stroke.
    behind = [float((at - stressed[stressed <= at + 1e-6]).min()) for at, _ in strokes]
    # Seconds until the same gesture comes again: a short time looks mechanical.
    again = [b - a for k, (a, one) in enumerate(strokes) for b, other in strokes[k + 1 :] if one == other]
    within, ever = likeness(motion)
    return {
        "feet move, mm": round(1e3 * float(np.abs(feet - feet[0]).max()), 6),
        "hand to trunk at least, mm": round(1e3 * hands_apart(body, motion), 1),
        "gestures": len(strokes),
        "seconds between gestures": round(float(np.diff([at for at, _ in strokes]).mean()), 2),
        "struck behind a stressed vowel's start, ms": round(1e3 * float(np.mean(behind))),
        "seconds until a gesture comes back, least": round(min(again), 1),
        "most alike 3 s within a minute, degrees": round(within, 2),
        "most alike 3 s ever, degrees": round(ever, 2),
        "frames a second of one core": round(len(motion) / spent),
    }


def likeness(motion: BodyParams) -> tuple[float, float]:
    """Return how far apart the two most alike pieces of moving arms are, within a minute and ever: RMS degrees."""
    rows = [SMPLX_JOINTS.index(f"{side}_{part}") - 1 for side in ("left", "right") for part in _PARTS]
    arms = np.degrees(np.asarray(motion.body_pose).reshape(len(motion), -1, 3)[:, rows].reshape(len(motion), -1))
    fps = motion.fps or 30.0
    size, step = round(WINDOW * fps), round(STEP * fps)
    pieces = np.stack([arms[k : k + size].ravel() for k in range(0, len(arms) - size, step)])
    moving = pieces.reshape(len(pieces), size, -1).std(axis=1).max(axis=1) > 8.0
    pieces, at = pieces[moving], np.flatnonzero(moving) * STEP
    apart = np.sqrt(np.maximum(_squared(pieces), 0.0) / pieces.shape[1])
    gap = np.abs(at[:, None] - at[None])
    return float(apart[(gap >= WINDOW) & (gap <= 60.0)].min()), float(apart[gap >= WINDOW].min())


def _squared(points: Float64[np.ndarray, "N D"]) -> Float64[np.ndarray, "N N"]:
    sizes = (points**2).sum(axis=1)
    return sizes[:, None] + sizes[None] - 2.0 * points @ points.T


def hands_apart(body: BodyModel, motion: BodyParams) -> float:
    """Return the least distance of the hands' skin from the trunk's in every tenth frame, metres."""
    names = body.joint_names
    hand, trunk = (
        body.weights[:, [k for k, n in enumerate(names) if any(part in n for part in parts)]].sum(axis=1) > 0.6
        for parts in (("wrist", "index", "middle", "ring", "pinky", "thumb"), ("pelvis", "spine", "hip"))
    )
    least = np.inf
    for k in range(0, len(motion), 10):
        v = body.forward(motion.frame(k)).frame(0).vertices
        least = min(least, float(cKDTree(v[trunk]).query(v[hand])[0].min()))
    return least


def left_of(body: BodyModel, count: int) -> dict[str, float]:
    """Return the share of displacements that principal directions leave, by their number, and the lips' gap, mm."""
    drawn = np.random.default_rng(1).gamma(0.5, 0.4, size=(400, body.num_expressions)).clip(0.0, 1.0)
    faces = (drawn - drawn.mean(axis=0)) @ body.exprdirs.reshape(-1, body.num_expressions).T
    _, size, parts = np.linalg.svd(faces, full_matrices=False)
    directions = (parts[:count] * size[:count, None] / np.sqrt(len(drawn))).T.reshape(-1, 3, count)
    names = tuple(f"expression_{k:02d}" for k in range(count))
    solved = transfer_blendshapes(replace(body, exprdirs=directions, expression_names=names))
    of = {name: round(float(solved.residual[ARKIT.index(name)]), 2) for name in _MOUTH}
    closing = [ARKIT.index(name) for name in ("mouthPressLeft", "mouthPressRight", "mouthRollLower", "mouthRollUpper")]
    gap = 1e3 * float(np.abs(solved.gap_error[closing]).max())
    return {"mean": round(float(solved.residual.mean()), 3), **of, "lips' gap, mm": round(gap, 2)}


if __name__ == "__main__":
    tyro.cli(Gestures, prog="python -m benchmarks gestures").run()
