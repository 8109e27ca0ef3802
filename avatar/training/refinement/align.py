"""Frames of a refinement under way, and the passes that bring them to their photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64

from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians
from avatar.training.refinement.appearance import AppearanceSums
from avatar.training.refinement.cameras import CameraCorrections
from avatar.training.refinement.config import Level, RefineConfig
from avatar.training.refinement.evidence import Evidence, Photometer
from avatar.training.refinement.posing import PosedTemplate
from avatar.training.refinement.solve import Normal, changes, smoothness, solve, with_trust
from avatar.training.refinement.variables import GaussianMotion, Variables
from smplxpp.register import BodyState

DAMPING, CALMER, WILDER, LEAST_DAMPING = 1e-2, 0.3, 10.0, 1e-4
"""Levenberg and Marquardt's damping: at first, after a good pass, after a bad one, and at least."""
WORSE = 1.01
"""A pass was bad for a frame whose loss grew by more than this factor; a little may come from the others' colours."""
KNOWN_BYTES = 1 << 30
"""Of photographs at the size of a level that are kept."""
Views = Callable[[int], Sequence[View]]
"""Gives the photographs of a frame at full size."""


@dataclass(frozen=True)
class PassReport:
    """What a pass over all frames saw.

    Attributes:
        halvings: of the photographs. loss: mean over the frames. bad: frames that went back to where they were.
    """

    halvings: int
    loss: float
    bad: int


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn and compared.

    Attributes:
        posed: the template. photometer: compares. config: of the refinement.
        cameras: corrections of them, None where they are right.
        fps: frames a second, None where not known.
    """

    posed: PosedTemplate
    photometer: Photometer
    config: RefineConfig
    cameras: CameraCorrections | None = None
    fps: float | None = None


class Alignment:
    """Frames that are brought to their photographs by damped Gauss-Newton steps, all frames together.

    A pass looks at every frame through all its cameras; then poses, colours and cameras take one step each.

    Args:
        gaussians: on the template.
        frames: numbers, ascending. start: their registered poses, a row each. views: photographs of a frame.
        learns_appearance: False: the Gaussians are right.
    """

    def __init__(
        self,
        scene: Scene,
        gaussians: BoundGaussians,
        frames: tuple[int, ...],
        start: BodyState,
        views: Views,
        *,
        learns_appearance: bool = True,
    ) -> None:
        assert len(frames) == len(start), "a row a frame"
        self.scene, self.gaussians, self.frames = scene, gaussians, frames
        self.learns_appearance = learns_appearance
        self.start = self.state = start
        self.history: list[PassReport] = []
        body = scene.posed.body
        self.variables = Variables.of_body(body.joint_count, body.num_expressions, scene.config)
        self._views, self._cached, self._bytes = views, dict[tuple[int, int], list[View]](), 0
        labels = scene.posed.template.vertex_labels[scene.posed.template.faces[:, 0]]
        self._groups = torch.tensor(labels, dtype=torch.int64)[gaussians.face_index]
        self._motion = GaussianMotion(scene.posed, gaussians, self.variables)

    def run(self, levels: Sequence[Level], told: Callable[[], None] = lambda: None) -> None:
        """Take the passes of all levels; `told` is called after every frame of a pass."""
        for level in levels:
            self._run_level(level, told)

    def losses(self, state: BodyState, told: Callable[[], None] = lambda: None) -> Float64[np.ndarray, " F"]:
        """Return the firm loss of every frame in a state, at the finest level's size; see `Photometer.firm_loss`."""
        halvings, out = self.scene.config.levels[-1].halvings, []
        for row in range(len(self.frames)):
            vertices = self.scene.posed.place(state, row).vertices.detach()
            views = self._photographs(row, halvings)
            firm = self._motion.firmness
            out.append(self.scene.photometer.firm_loss(self.gaussians, vertices, firm, views))
            told()
        return np.array(out)

    def _run_level(self, level: Level, told: Callable[[], None]) -> None:
        """One look more than steps: what the last step gave is looked at, too."""
        F = len(self.frames)
        damping, best = np.full(F, DAMPING), np.full(F, np.inf)
        kept, normal = self.state, None
        for step in range(level.steps + 1):
            sums = AppearanceSums(self._groups, self._motion.firmness)
            losses, gradients, curvatures = [], [], []
            for row in range(F):
                evidence, gradient, curvature = self._look(row, level.halvings)
                sums.add(evidence)
                losses.append(evidence.loss)
                gradients.append(gradient)
                curvatures.append(curvature)
                told()
            found, loss = Normal(np.stack(gradients), np.stack(curvatures)), np.array(losses)
            bad = loss > WORSE * best
            if normal is not None:
                self.state = _mixed(kept, self.state, bad)
                found = Normal(
                    np.where(bad[:, None], normal.gradient, found.gradient),
                    np.where(bad[:, None, None], normal.curvature, found.curvature),
                )
                damping = np.where(bad, damping * WILDER, np.maximum(damping * CALMER, LEAST_DAMPING))
            best = np.where(bad, best, loss)
            kept, normal = self.state, found
            self.history.append(PassReport(level.halvings, float(loss.mean()), int(bad.sum())))
            if self.learns_appearance:
                self.gaussians = sums.learned(self.gaussians, F)
            if step < level.steps:
                self.state = self._stepped(found, damping)
                if self.scene.cameras is not None:
                    self.scene.cameras.step()

    def _look(self, row: int, halvings: int) -> tuple[Evidence, Float64[np.ndarray, " P"], Float64[np.ndarray, "P P"]]:
        """What the photographs of a frame say, and of its variables gradient and curvature."""
        posed, cameras = self.scene.posed, self.scene.cameras
        placed = posed.place(self.state, row)
        evidence = self.scene.photometer.evidence(
            self.gaussians,
            placed.vertices,
            self._photographs(row, halvings),
            halvings=halvings,
            each_camera=cameras is not None,
        )
        if cameras is not None:
            cameras.add(evidence, self._motion.firmness)
        gradient = self.variables.packed(*posed.gradient(placed, evidence.vertices))
        return evidence, gradient, self._motion.curvature(placed, evidence)

    def _photographs(self, row: int, halvings: int) -> list[View]:
        """The views of a frame at a level's size, through the cameras as they are corrected now."""
        key = (row, halvings)
        if key not in self._cached:
            views = list(halved(self._views(self.frames[row]), halvings))
            self._bytes += sum(view.foreground.numel() + view.alpha.numel() for view in views)
            if self._bytes > KNOWN_BYTES:
                self._cached, self._bytes = {}, 0
            self._cached[key] = views
        views = self._cached[key]
        corrections = self.scene.cameras
        return views if corrections is None else [corrections.corrected(view) for view in views]

    def _stepped(self, normal: Normal, damping: Float64[np.ndarray, " F"]) -> BodyState:
        """The state after one step of all frames."""
        change = changes(self.variables, self.start, self.state)
        smooth = smoothness(self.variables, self.state, self.frames, self.scene.config, self.scene.fps)
        trusted = with_trust(normal, change, self.variables.sigma)
        return self.variables.stepped(self.state, solve(trusted, smooth, damping))


def halved(views: Sequence[View], times: int) -> Sequence[View]:
    """Return views at half their size, so many times."""
    for _ in range(times):
        views = [view.halved() for view in views]
    return views


def _mixed(old: BodyState, new: BodyState, keep: Bool[np.ndarray, " F"]) -> BodyState:
    """The new state, but for the frames of a mask."""

    def of(name: str) -> np.ndarray:
        values = getattr(new, name).copy()
        values[keep] = getattr(old, name)[keep]
        return values

    return BodyState(of("rotations"), of("transl"), new.betas, of("expression"))
