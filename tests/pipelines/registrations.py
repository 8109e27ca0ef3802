"""A stand-in for the solver, with known answers, and keypoints of the embedded person."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.build import register as register_step
from smplxpp.capture import Capture
from smplxpp.core import BodyParams, Keypoints2D
from smplxpp.register import BodyFit, Observations

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
HELD_OUT = "Cam004"


@dataclass
class Solver:
    """Gives the exact parameters, reads every map, remembers what it was shown; `fails` are frames without a fit."""

    fails: tuple[int, ...] = ()
    doubtful: tuple[int, ...] = ()
    shown: list[Observations] = field(default_factory=list)

    def __call__(self, body, observed, config, *, progress) -> BodyFit:
        self.shown.append(observed)
        progress("joints", 0.5)
        for camera in observed.cameras:
            for frame in observed.frames:
                for read in (observed.mask, observed.labels):
                    if read is not None:
                        read(camera, frame)
        frames = tuple(frame for frame in observed.frames if frame not in self.fails)
        confidence = np.full((len(frames), body.joint_count), 0.9)
        confidence[np.isin(frames, self.doubtful)] = 0.2
        skin = np.where(np.isin(frames, list(observed.scans)), 2.5, np.nan)
        after = {"keypoints_px": np.linspace(1.0, 2.0, len(frames)), "skin_mm": skin}
        before = {"keypoints_px": np.linspace(9.0, 7.0, len(frames))} if observed.initial is not None else {}
        problems = tuple(f"frame {frame}: nobody is in the pictures" for frame in self.fails)
        return BodyFit(frames, exact().select(list(frames)), confidence, after, before, problems)


@cache
def exact() -> BodyParams:
    """The embedded person's parameters of all frames."""
    return load_params(FIXTURE / "params" / "params.npz")


@cache
def posed_joints() -> tuple[BodyModel, np.ndarray]:
    """The body and its joints in all frames."""
    body = load_body()
    return body, body.forward(exact()).joints


def joints_in(capture: Capture, camera: str) -> Keypoints2D:
    """The person's joints as a camera sees them, exact."""
    body, joints = posed_joints()
    pixels = capture.cameras[camera].screen_from_world(joints.reshape(-1, 3))[:, :2].reshape(*joints.shape[:2], 2)
    return Keypoints2D(tuple(body.joint_names), np.arange(len(joints)), pixels, np.full(joints.shape[:2], 0.9))


def use_solver(monkeypatch, **choices) -> Solver:
    """Let registrations be made by a `Solver`."""
    solver = Solver(**choices)
    monkeypatch.setattr(register_step, "register", solver)
    return solver


def use_keypoints(monkeypatch) -> list[str]:
    """Let captures have the joints as keypoints; returns the names of the cameras that are asked for."""
    asked: list[str] = []

    def keypoints(capture: Capture, camera: str) -> Keypoints2D:
        asked.append(camera)
        return joints_in(capture, camera)

    monkeypatch.setattr(Capture, "keypoints", keypoints)
    return asked
