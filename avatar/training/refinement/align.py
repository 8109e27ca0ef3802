"""The passes of a refinement: Levenberg-Marquardt over all frames, with resets of frames whose loss grew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64

from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians
from avatar.training.refinement.config import Level, RefineConfig
from avatar.training.refinement.nuisance import AppearanceUpdate, CameraCorrections
from avatar.training.refinement.photometric import Linearization, PhotometricLoss
from avatar.training.refinement.posing import PosedTemplate
from avatar.training.refinement.solve import Normal, changes, smoothness, solve, with_prior
from avatar.training.refinement.variables import CentreJacobian, Variables
from smplxpp.register import BodyState

Views = Callable[[int], Sequence[View]]
"""Returns the photographs of a frame at full size."""


@dataclass(frozen=True)
class PassReport:
    """Figures of one pass over all frames.

    Attributes:
        halvings: of the photographs.
        loss: mean over the frames.
        bad: number of frames whose loss grew, and that were reset.
    """

    halvings: int
    loss: float
    bad: int


@dataclass(frozen=True, eq=False)
class Scene:
    """The parts of the objective that all frames share.

    Attributes:
        posed: the template.
        photometric: the loss on photographs.
        config: of the refinement.
        cameras: corrections of the cameras; None: they are taken as exact.
        fps: frames a second; None where unknown.
    """

    posed: PosedTemplate
    photometric: PhotometricLoss
    config: RefineConfig
    cameras: CameraCorrections | None = None
    fps: float | None = None


class Alignment:
    """Aligns the poses of frames with their photographs by damped Gauss-Newton steps, all frames together.

    A pass renders every frame through all its cameras. Then poses, colours and cameras take one step each.

    Args:
        scene: the parts of the objective that all frames share.
        gaussians: bound to the template.
        frames: numbers, ascending.
        start: registered poses of the frames, a row each.
        views: returns the photographs of a frame.
        learns_appearance: whether colours and depths are updated.

    Attributes:
        state: current poses.
        gaussians: with the current colours and depths.
        history: figures of the passes.
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
        # Groups of the depths: one a label.
        self._views, self._cached, self._bytes = views, dict[tuple[int, int], list[View]](), 0
        labels = scene.posed.template.vertex_labels[scene.posed.template.faces[:, 0]]
        self._groups = torch.tensor(labels, dtype=torch.int64)[gaussians.face_index]
        self._jacobian = CentreJacobian(scene.posed, gaussians, self.variables)

    def run(self, levels: Sequence[Level], on_frame: Callable[[], None] = lambda: None) -> None:
        """Run the passes of all levels; `on_frame` is called after every frame of a pass."""
        for level in levels:
            self._run_level(level, on_frame)

    def losses(self, state: BodyState, on_frame: Callable[[], None] = lambda: None) -> Float64[np.ndarray, " F"]:
        """Return `PhotometricLoss.rigid_loss` of every frame in a state, at the size of the finest level."""
        halvings, out = self.scene.config.levels[-1].halvings, []
        for row in range(len(self.frames)):
            vertices = self.scene.posed.place(state, row).vertices.detach()
            views = self._photographs(row, halvings)
            rigid = self._jacobian.rigidity
            out.append(self.scene.photometric.rigid_loss(self.gaussians, vertices, rigid, views))
            on_frame()
        return np.array(out)

    def _run_level(self, level: Level, on_frame: Callable[[], None]) -> None:
        """Run the passes of a level: one more than steps, because the result of the last step is evaluated too."""
        # Levenberg-Marquardt damping: initial and least value, factors after a good and after a bad pass. The loss of a
        # bad frame grew by more than `worse`; less may come from the change of the shared colours.
        initial_damping, least_damping, good_factor, bad_factor, worse = 1e-2, 1e-4, 0.3, 10.0, 1.01
        F = len(self.frames)
        damping, best = np.full(F, initial_damping), np.full(F, np.inf)
        kept, normal = self.state, None
        for step in range(level.steps + 1):
            # Linearise the photometric loss of every frame about the current poses.
            appearance = AppearanceUpdate(self._groups, self._jacobian.rigidity)
            losses, gradients, curvatures = [], [], []
            for row in range(F):
                linear, gradient, curvature = self._linearize(row, level.halvings)
                appearance.add(linear)
                losses.append(linear.loss)
                gradients.append(gradient)
                curvatures.append(curvature)
                on_frame()
            found, loss = Normal(np.stack(gradients), np.stack(curvatures)), np.array(losses)
            # Reset frames whose loss grew, with their earlier normal equations, and damp them more.
            bad = loss > worse * best
            if normal is not None:
                self.state = _mixed(kept, self.state, bad)
                found = Normal(
                    np.where(bad[:, None], normal.gradient, found.gradient),
                    np.where(bad[:, None, None], normal.curvature, found.curvature),
                )
                damping = np.where(bad, damping * bad_factor, np.maximum(damping * good_factor, least_damping))
            best = np.where(bad, best, loss)
            kept, normal = self.state, found
            self.history.append(PassReport(level.halvings, float(loss.mean()), int(bad.sum())))
            # One step each of colours and depths, of poses, and of cameras.
            if self.learns_appearance:
                self.gaussians = appearance.stepped(self.gaussians, F)
            if step < level.steps:
                self.state = self._stepped(found, damping)
                if self.scene.cameras is not None:
                    self.scene.cameras.step()

    def _linearize(
        self, row: int, halvings: int
    ) -> tuple[Linearization, Float64[np.ndarray, " P"], Float64[np.ndarray, "P P"]]:
        """Return the linearised loss of a frame, and gradient and Gauss-Newton matrix of its unknowns."""
        posed, cameras = self.scene.posed, self.scene.cameras
        # Pose the template with leaves at zero steps, then linearise the photographs about it.
        placed = posed.place(self.state, row)
        linear = self.scene.photometric.linearize(
            self.gaussians,
            placed.vertices,
            self._photographs(row, halvings),
            halvings=halvings,
            each_camera=cameras is not None,
        )
        if cameras is not None:
            cameras.add(linear, self._jacobian.rigidity)
        # The chain rule takes the gradient of the vertices to the steps; the Gauss-Newton matrix is J^T M J.
        gradient = self.variables.packed(*posed.gradient(placed, linear.vertex_gradient))
        return linear, gradient, self._jacobian.curvature(placed, linear)

    def _photographs(self, row: int, halvings: int) -> list[View]:
        """Return the views of a frame at a level's size, with the current corrections of the cameras."""
        cached_bytes = 1 << 30  # bound of the cached photographs
        key = (row, halvings)
        if key not in self._cached:
            # Halved photographs are kept until the bound, then all are dropped: passes read the frames in one order,
            # so that
            # dropping the oldest alone would save nothing.
            views = list(halved(self._views(self.frames[row]), halvings))
            self._bytes += sum(view.foreground.numel() + view.alpha.numel() for view in views)
            if self._bytes > cached_bytes:
                self._cached, self._bytes = {}, 0
            self._cached[key] = views
        views = self._cached[key]
        # Corrections change after each pass, so the cache holds views without them.
        corrections = self.scene.cameras
        return views if corrections is None else [corrections.corrected(view) for view in views]

    def _stepped(self, normal: Normal, damping: Float64[np.ndarray, " F"]) -> BodyState:
        """Return the state after one Levenberg-Marquardt step of all frames."""
        # Gauss-Newton blocks of the photographs, plus the prior, plus the smoothness; then one banded solve.
        change = changes(self.variables, self.start, self.state)
        smooth = smoothness(self.variables, self.state, self.frames, self.scene.config, self.scene.fps)
        with_start = with_prior(normal, change, self.variables.sigma)
        return self.variables.stepped(self.state, solve(with_start, smooth, damping))


def halved(views: Sequence[View], times: int) -> Sequence[View]:
    """Return views at half their size, `times` times over."""
    for _ in range(times):
        views = [view.halved() for view in views]
    return views


def _mixed(old: BodyState, new: BodyState, keep: Bool[np.ndarray, " F"]) -> BodyState:
    """Return the new state, with the old one in the frames of a mask."""

    def of(name: str) -> np.ndarray:
        values = getattr(new, name).copy()
        values[keep] = getattr(old, name)[keep]
        return values

    return BodyState(of("rotations"), of("transl"), new.betas, of("expression"))
