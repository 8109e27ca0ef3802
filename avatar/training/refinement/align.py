"""The passes of a refinement: Levenberg-Marquardt over all frames, with resets of frames whose loss grew."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64

from avatar.gaussians.binding import BoundGaussians
from avatar.training.refinement.board import Arrays, Board, OvertakenError, RefinementStoppedError, in_threads
from avatar.training.refinement.config import Level, RefineConfig
from avatar.training.refinement.nuisance import AppearanceUpdate, CameraCorrections, CameraEquations, Photographs, Views
from avatar.training.refinement.photometric import Linearization, PhotometricLoss
from avatar.training.refinement.posing import PosedTemplate
from avatar.training.refinement.solve import Normal, changes, smoothness, solve, with_prior
from avatar.training.refinement.variables import CentreJacobian, Variables
from smplxpp.core.files.array_file import read_arrays, write_arrays
from smplxpp.core.spread import split_frames
from smplxpp.register import BodyState


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


@dataclass(frozen=True, eq=False)
class _Carried:
    """What a pass hands to the next one of its level.

    Attributes:
        damping: Levenberg-Marquardt damping of every frame.
        best: least loss of every frame so far.
        kept: poses of those losses.
        normal: normal equations about them; None before the first pass.
    """

    damping: Float64[np.ndarray, " F"]
    best: Float64[np.ndarray, " F"]
    kept: BodyState
    normal: Normal | None


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
        board: shares the chunks of each pass with other processes; None: this one computes all.
        name: of the alignment on the board.

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
        board: Board | None = None,
        name: str = "frames",
    ) -> None:
        assert len(frames) == len(start), "a row a frame"
        chunks = split_frames(range(len(frames)), scene.config.chunk_frames)
        self._chunks = [chunk.kept for chunk in chunks]
        self._board, self._name = (board if len(chunks) > 1 else None), name
        self.scene, self.gaussians, self.frames = scene, gaussians, frames
        self.learns_appearance = learns_appearance
        self.start = self.state = start
        self.history: list[PassReport] = []
        body = scene.posed.body
        self.variables = Variables.of_body(body.joint_count, body.num_expressions, scene.config)
        self._photographs = Photographs(lambda row: views(frames[row]), scene.cameras)
        # Groups of the depths: one a label.
        labels = scene.posed.template.vertex_labels[scene.posed.template.faces[:, 0]]
        self._groups = torch.tensor(labels, dtype=torch.int64)[gaussians.face_index]
        self._jacobian = CentreJacobian(scene.posed, gaussians, self.variables)

    def run(
        self,
        levels: Sequence[Level],
        on_frame: Callable[[], None] = lambda: None,
        *,
        file: Path | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Run the passes of all levels, each one more than steps, because the result of the last step is evaluated too.

        Args:
            levels: from coarse to fine.
            on_frame: called after every frame of a pass.
            file: written after every pass; where it exists, the run continues from it, to the same bits.
            stop: whether to end after a pass.

        Raises:
            RefinementStoppedError: `stop` returned True before the last pass.
        """
        passes = sum(level.steps + 1 for level in levels)
        done, carried = self._restore(file) if file is not None and file.is_file() else (0, None)
        number = 0
        for level in levels:
            for step in range(level.steps + 1):
                number += 1
                if number <= done:
                    for _ in self.frames:
                        on_frame()
                    continue
                try:
                    before = self._begin() if carried is None or step == 0 else carried
                    carried = self._pass(level, before, on_frame, f"{self._name}_{number:02d}")
                except OvertakenError:
                    assert file is not None
                    done, carried = self._restore(file)
                    continue
                # One step each of poses and of cameras; nothing follows the last pass of a level.
                if step < level.steps:
                    assert carried.normal is not None
                    self.state = self._stepped(carried.normal, carried.damping)
                    if self.scene.cameras is not None:
                        self.scene.cameras.step()
                if file is not None:
                    self._keep(file, number, carried)
                if number < passes and stop():
                    raise RefinementStoppedError(f"stopped after {number} of {passes} passes")

    def losses(
        self, state: BodyState, on_frame: Callable[[], None] = lambda: None, *, name: str = "losses"
    ) -> Float64[np.ndarray, " F"]:
        """Return `PhotometricLoss.rigid_loss` of every frame in a state, at the size of the finest level."""
        halvings, rigid = self.scene.config.levels[-1].halvings, self._jacobian.rigidity

        def loss(row: int) -> float:
            vertices = self.scene.posed.place(state, row).vertices.detach()
            return self.scene.photometric.rigid_loss(
                self.gaussians, vertices, rigid, self._photographs.of(row, halvings)
            )

        def compute(rows: Sequence[int]) -> dict[str, np.ndarray]:
            return {"loss": np.array(list(in_threads(loss, rows, self._counted(on_frame))))}

        return np.concatenate([part["loss"] for part in self._gather(f"{self._name}_{name}", compute, on_frame)])

    def _begin(self) -> _Carried:
        """Return what a level's first pass starts from."""
        initial_damping, count = 1e-2, len(self.frames)
        return _Carried(np.full(count, initial_damping), np.full(count, np.inf), self.state, None)

    def _pass(self, level: Level, before: _Carried, on_frame: Callable[[], None], name: str) -> _Carried:
        """Evaluate all frames, reset those whose loss grew, and take a step of colours and depths."""
        # Levenberg-Marquardt damping: least value, factors after a good and after a bad pass. The loss of a bad frame
        # grew by more than `worse`; less may come from the change of the shared colours.
        least_damping, good_factor, bad_factor, worse = 1e-4, 0.3, 10.0, 1.01
        # Linearise the photometric loss of every frame about the current poses. What frames share is summed in their
        # order within a chunk, and then in that of the chunks, so that it does not matter who computes one.
        parts = self._gather(name, lambda rows: self._sums(rows, level.halvings, on_frame), on_frame)
        appearance = AppearanceUpdate(self._groups, self._jacobian.rigidity)
        if self.scene.cameras is not None:
            self.scene.cameras.clear()
        for part in parts:
            appearance.add_sums(part)
            if self.scene.cameras is not None:
                self.scene.cameras.add_sums(part)
        loss, *normal = (np.concatenate([part[key] for part in parts]) for key in ("loss", "slope", "block"))
        found = Normal(*normal)
        # Reset frames whose loss grew, with their earlier normal equations, and damp them more.
        bad, damping = loss > worse * before.best, before.damping
        if before.normal is not None:
            self.state = _mixed(before.kept, self.state, bad)
            found = Normal(
                np.where(bad[:, None], before.normal.gradient, found.gradient),
                np.where(bad[:, None, None], before.normal.curvature, found.curvature),
            )
            damping = np.where(bad, damping * bad_factor, np.maximum(damping * good_factor, least_damping))
        self.history.append(PassReport(level.halvings, float(loss.mean()), int(bad.sum())))
        if self.learns_appearance:
            self.gaussians = appearance.stepped(self.gaussians, len(self.frames))
        return _Carried(damping, np.where(bad, before.best, loss), self.state, found)

    def _sums(self, rows: Sequence[int], halvings: int, on_frame: Callable[[], None]) -> dict[str, np.ndarray]:
        """Linearise the loss of the frames of a chunk, and sum what they share."""
        appearance, cameras = AppearanceUpdate(self._groups, self._jacobian.rigidity), self.scene.cameras
        if cameras is not None:
            cameras.clear()
        losses, gradients, curvatures = [], [], []
        count = self._counted(on_frame)
        found = in_threads(lambda row: self._linearize(row, halvings), rows, count)
        for linear, gradient, curvature, equations in found:
            appearance.add(linear)
            if cameras is not None:
                cameras.add(equations)
            losses.append(linear.loss)
            gradients.append(gradient)
            curvatures.append(curvature)
        frames = {"loss": np.array(losses), "slope": np.stack(gradients), "block": np.stack(curvatures)}
        return {**frames, **appearance.sums(), **({} if cameras is None else cameras.sums())}

    def _gather(
        self, name: str, compute: Callable[[Sequence[int]], Arrays], on_frame: Callable[[], None]
    ) -> list[Arrays]:
        """Return what `compute` gives for the rows of each chunk, here or in other processes."""
        if self._board is None:
            return [compute(rows) for rows in self._chunks]
        board, own = self._board, set[int]()

        def counted(chunk: int) -> Arrays:
            own.add(chunk)
            return compute(self._chunks[chunk])

        found = board.gather(name, len(self._chunks), counted)
        for chunk, rows in enumerate(self._chunks):
            for _ in () if chunk in own else rows:
                on_frame()
        return found

    def _counted(self, on_frame: Callable[[], None]) -> Callable[[], None]:
        """Return what is called after each frame: its chunk's claim on the board is renewed, too."""

        def after() -> None:
            on_frame()
            if self._board is not None:
                self._board.touch()

        return after

    def _keep(self, file: Path, number: int, carried: _Carried) -> None:
        """Save the state after a pass, by one of the processes that share it."""
        name = f"{self._name}_{number:02d}"
        if self._board is None:
            self._save(file, number, carried)
        elif self._board.first(f"{name}.saved"):
            self._save(file, number, carried)
            self._board.end(name)

    def _save(self, file: Path, number: int, carried: _Carried) -> None:
        """Write everything that the passes after this number depend on, whole or not at all."""
        assert carried.normal is not None
        arrays: dict[str, Any] = {
            "number": np.int64(number),
            "history": np.array([[one.halvings, one.loss, one.bad] for one in self.history]),
            "dc": self.gaussians.dc.numpy(),
            "normal_offset": self.gaussians.normal_offset.numpy(),
            "damping": carried.damping,
            "best": carried.best,
            "gradient": carried.normal.gradient,
            "curvature": carried.normal.curvature,
        }
        if self.scene.cameras is not None:
            arrays["cameras"] = self.scene.cameras.motions
        for name, state in (("state", self.state), ("kept", carried.kept)):
            arrays |= {f"{name}.{field.name}": getattr(state, field.name) for field in fields(state)}
        write_arrays(file, arrays, packing=zipfile.ZIP_STORED)

    def _restore(self, file: Path) -> tuple[int, _Carried]:
        """Read what `_save` wrote; return the number of finished passes and what the last one hands on."""
        arrays: Mapping[str, np.ndarray] = read_arrays(file, subject="state of the refinement")
        names = [field.name for field in fields(self.state)]
        self.state, kept = (BodyState(*(arrays[f"{one}.{name}"] for name in names)) for one in ("state", "kept"))
        dc, depth = torch.from_numpy(arrays["dc"]), torch.from_numpy(arrays["normal_offset"])
        self.gaussians = replace(self.gaussians, dc=dc, normal_offset=depth)
        self.history = [PassReport(int(halvings), float(loss), int(bad)) for halvings, loss, bad in arrays["history"]]
        if self.scene.cameras is not None:
            self.scene.cameras.motions = arrays["cameras"]
        normal = Normal(arrays["gradient"], arrays["curvature"])
        return int(arrays["number"]), _Carried(arrays["damping"], arrays["best"], kept, normal)

    def _linearize(
        self, row: int, halvings: int
    ) -> tuple[Linearization, Float64[np.ndarray, " P"], Float64[np.ndarray, "P P"], dict[str, CameraEquations]]:
        """Return the linearised loss of a frame, and the normal equations of its unknowns and of its cameras."""
        posed, cameras = self.scene.posed, self.scene.cameras
        # Pose the template with leaves at zero steps, then linearise the photographs about it.
        placed = posed.place(self.state, row)
        linear = self.scene.photometric.linearize(
            self.gaussians,
            placed.vertices,
            self._photographs.of(row, halvings),
            halvings=halvings,
            each_camera=cameras is not None,
        )
        # The chain rule takes the gradient of the vertices to the steps; the Gauss-Newton matrix is J^T M J.
        gradient = self.variables.packed(*posed.gradient(placed, linear.vertex_gradient))
        equations = {} if cameras is None else cameras.normal_equations(linear, self._jacobian.rigidity)
        return linear, gradient, self._jacobian.curvature(placed, linear), equations

    def _stepped(self, normal: Normal, damping: Float64[np.ndarray, " F"]) -> BodyState:
        """Return the state after one Levenberg-Marquardt step of all frames."""
        # Gauss-Newton blocks of the photographs, plus the prior, plus the smoothness; then one banded solve.
        change = changes(self.variables, self.start, self.state)
        smooth = smoothness(self.variables, self.state, self.frames, self.scene.config, self.scene.fps)
        with_start = with_prior(normal, change, self.variables.sigma)
        return self.variables.stepped(self.state, solve(with_start, smooth, damping))


def _mixed(old: BodyState, new: BodyState, keep: Bool[np.ndarray, " F"]) -> BodyState:
    """Return the new state, with the old one in the frames of a mask."""

    def of(name: str) -> np.ndarray:
        values = getattr(new, name).copy()
        values[keep] = getattr(old, name)[keep]
        return values

    return BodyState(of("rotations"), of("transl"), new.betas, of("expression"))
