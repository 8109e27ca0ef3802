"""What is known of a frame before its photographs: predicted displacements, and lengths that cloth keeps."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import exp

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.data.cloth_motion import ClothMotions
from smplxpp.cloth import Garment, cut_garment
from smplxpp.cloth.garment import usual_config
from smplxpp.cloth.quality import ClothQuality
from smplxpp.core import DEFAULT_FPS, BodyParams, GeometryWarning, InputError
from smplxpp.template.template import Template

CORRECTION_DECAY = 0.3
"""Seconds in which the correction of a prediction falls to 1/e.

Errors of a simulated swing are a difference of phase, which changes sign within a swing; an old correction is wrong.
"""
COMPRESSION = 0.3
"""Weight of a compressed edge beside that of a stretched one: between its particles cloth buckles."""
ERROR_FLOOR = 1e-3
"""Metres added to every predictor's error; smaller errors are treated as equal."""

Observed = Callable[[], Float[Tensor, "K 3 3"]]
"""Returns the projection on what photographs determined; a call, because few of many frames are asked for it."""

Solved = Mapping[int, tuple[Float[Tensor, "K 3"], Observed | None]]
"""Displacements of solved frames, metres, and what photographs determined there; None: everything."""

Predictor = Callable[[int, Solved], Float[Tensor, "K 3"]]
"""Displacements of a frame, metres, from those of the solved frames."""


@dataclass(frozen=True, eq=False)
class ClothEdges:
    """Edges of clothes that can be simulated, and what they measure at rest.

    Attributes:
        ends: vertices of the template; the body carries at most one of the two.
        lengths: along the cloth in the reference pose, metres.
    """

    ends: Int[Tensor, "E 2"]
    lengths: Float[Tensor, " E"]

    @classmethod
    def of(cls, garments: Sequence[Garment], device: torch.device) -> ClothEdges:
        """Collect the edges of garments, those between two pinned particles left out."""
        # Metres; shorter edges count as that long: the strain of a sliver is the noise of its ends.
        shortest = 0.01
        free = [~garment.pinned[garment.rest.edges].all(axis=1) for garment in garments]
        ends = [one.particles[one.rest.edges[kept]] for one, kept in zip(garments, free, strict=True)]
        lengths = [np.maximum(one.lengths[kept], shortest) for one, kept in zip(garments, free, strict=True)]
        return cls(
            torch.tensor(np.concatenate(ends), device=device),
            torch.tensor(np.concatenate(lengths), dtype=torch.float32, device=device),
        )

    def strain(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, ""]:
        """Return the mean over edges of `max(s, 0)^2 + COMPRESSION max(-s, 0)^2`, `s = |x_i - x_j| / l - 1`.

        Clothes that the body carries wholly have no edges and no strain.

        Args:
            vertices: of the template in a pose, metres.
        """
        there = vertices[self.ends]
        strain = (there[:, 0] - there[:, 1]).norm(dim=-1) / self.lengths - 1.0
        squared = strain.clamp(min=0.0).square() + COMPRESSION * strain.clamp(max=0.0).square()
        return squared.sum() / max(len(squared), 1)


@dataclass(frozen=True, eq=False)
class SimulatedControls:
    """Displacements of simulated clothes at the control points of a cage, frame by frame.

    Attributes:
        displacements: (K, 3) by frame, metres along the axes of the T-pose, 0 off simulated clothes.
        share: in [0, 1], the simulation's share of a control point's displacement.
        part: garment of each control point, from 0 to P - 1; 0: not simulated.
        quality: what was measured of each garment.
        edges: of the garments; None: their lengths are not known.
    """

    displacements: Mapping[int, Float[Tensor, "K 3"]]
    share: Float[Tensor, " K"]
    part: Int[Tensor, " K"]
    quality: Sequence[ClothQuality] = ()
    edges: ClothEdges | None = None


def simulate_controls(
    template: Template, poses: Mapping[int, BodyParams], fps: float, *, reference: BodyParams, controls: Tensor
) -> SimulatedControls | None:
    """Simulate the clothes of a template through frames with the default material.

    Args:
        template: the clothed body.
        poses: parameters by frame number, one frame each.
        fps: frames a second of the numbers.
        reference: parameters of the frame in which the template is the surface.
        controls: (K,) vertices of the template that are the control points.

    Returns:
        None where no part of the clothes hangs from the body.
    """
    # Number the frames without gaps, so that every second frame of a capture is simulated at half the rate.
    frames = sorted(poses)
    stride = int(np.gcd.reduce(np.diff(frames))) if len(frames) > 1 else 1
    number = {frame: (frame - frames[0]) // stride for frame in frames}
    # Warnings about garments come from the stage that writes them; here they only predict, and photographs decide.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        garments = _loose_parts(template, reference)
        if not garments:
            return None
        by_number = {number[frame]: poses[frame] for frame in frames}
        clothes = ClothMotions(template, garments, params=by_number.get, frames=list(by_number), fps=fps / stride)
        clothes.simulate(list(by_number))
    # Simulated displacements at the control points, 0 off the garments.
    rows = controls.cpu().numpy()
    displacements = {}
    for frame in frames:
        shape = clothes.shape(number[frame])
        whole = np.zeros((template.vertex_count, 3), np.float32)
        whole[shape.vertices] = shape.share[:, None] * shape.displacements
        displacements[frame] = torch.tensor(whole[rows], device=controls.device)
    # Share and garment of every control point.
    share, part = np.zeros(template.vertex_count, np.float32), np.zeros(template.vertex_count, np.int64)
    for k, garment in enumerate(garments):
        share[garment.vertices], part[garment.vertices] = garment.share(), k + 1
    return SimulatedControls(
        displacements,
        torch.tensor(share[rows], device=controls.device),
        torch.tensor(part[rows], device=controls.device),
        clothes.quality,
        ClothEdges.of(garments, controls.device),
    )


def _loose_parts(template: Template, reference: BodyParams) -> list[Garment]:
    """Return the garments of all clothes that can be cut for simulation."""
    # Shallower pins than players have: photographs correct what a freer simulation gets wrong.
    pin_depth = 0.014  # metres of cloth, measured along it, that the body carries
    garments = []
    for name in template.loose_parts:
        with suppress(InputError):
            garments.append(
                cut_garment(template, name, reference, replace(usual_config(template, name), pin_depth=pin_depth))
            )
    return garments


@dataclass(frozen=True, eq=False)
class ClothPrediction:
    """Predicts a frame's displacements from those of the solved frames.

    Two predictors of frame t from the nearest solved frame n, with the reference frame's displacement e (an error of
    the Gaussians, the same in all frames):

        extrapolated:  d_n + extrapolation (t - n) / (n - m) (d_n - d_m)     m: the solved frame before n
        simulated:     e + s_t + exp(-|t - n| / (fps CORRECTION_DECAY)) (d_n - e - s_n)

    s is the simulated cloth. With s = 0 the second one is skinning plus a decaying correction.

    Attributes:
        extrapolation: share of the velocity of the two frames before that is continued.
        simulated: simulated clothes; None: extrapolation alone.
        reference: frame in which the template is the surface, so that its displacements are an error of the Gaussians.
        offset: those displacements where they are known in advance; None: taken from the solved frames.
        fps: frames a second of the frames' numbers.
    """

    extrapolation: float
    simulated: SimulatedControls | None = None
    reference: int | None = None
    offset: Float[Tensor, "K 3"] | None = None
    fps: float = DEFAULT_FPS

    @property
    def share(self) -> Float[Tensor, "K 1 1"] | float:
        """The simulation's share of each control point's displacements; 0 without a simulation."""
        return 0.0 if self.simulated is None else self.simulated.share[:, None, None]

    def start(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return the displacements at which the optimisation of a frame starts.

        The mean of the extrapolated and the simulated prediction, each weighted by the inverse of its mean squared
        error in the last solved frames, in the directions that photographs determined there.

        Args:
            frame: its number.
            solved: the solved frames, at least one, in the order in which they were solved.
        """
        return self._combined(frame, solved, self._extrapolated)

    def anchor(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return the centre of the Gaussian prior of a frame's displacements.

        Skinning or simulated clothes, plus the last frame's correction, which decays. Without the decay, errors in
        directions that photographs do not determine would accumulate. The simulation has its full weight as long as it
        was no worse than skinning.
        """
        return self._combined(frame, solved, self._decaying, preference=2.0)

    def _combined(self, frame: int, solved: Solved, other: Predictor, preference: float = 1.0) -> Tensor:
        """Return the weighted mean of the simulated prediction and another one.

        Args:
            frame: its number.
            solved: the solved frames.
            other: the other predictor.
            preference: factor on the weight of the simulation, which is at most 1.
        """
        base = other(frame, solved)
        if self.simulated is None:
            return base
        # Errors that both predictors would have made in the last solved frames, from what was solved before them.
        errors = []
        for one in self._recent(frame, solved):
            found, observed = solved[one]
            before = _until(one, solved)
            a, b = (predict(one, before) - found for predict in (other, self._simulated))
            errors.append((_observed_part(a, observed), _observed_part(b, observed)))
        weight = self.simulated.share * (preference * self._simulation_weight(errors)).clamp(max=1.0)
        return base + weight[:, None] * (self._simulated(frame, solved) - base)

    def _simulation_weight(
        self, errors: Sequence[tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3"]]]
    ) -> Float[Tensor, " K"]:
        """Return the inverse-variance weight of the simulation at each control point, in [0, 1], garment by garment.

        `w = p_b / (p_a + p_b)`, p = 1 / (mean squared error of the garment + ERROR_FLOOR^2).

        Args:
            errors: for each recent frame, errors (a, b) of the other prediction and of the simulated one, metres.
        """
        assert self.simulated is not None
        share, part = self.simulated.share, self.simulated.part
        parts = int(part.max()) + 1
        total = share.new_zeros(parts).index_add(0, part, share).clamp(min=1e-6)
        precision = []
        for one_side in ([pair[side] for pair in errors] for side in (0, 1)):
            # Mean squared error of a garment over its control points, weighted by their simulated share, and frames.
            square = sum((share * error.square().sum(-1) for error in one_side), torch.zeros_like(share))
            mean = share.new_zeros(parts).index_add(0, part, square) / total / max(len(one_side), 1)
            precision.append(1.0 / (mean + ERROR_FLOOR**2))
        return (precision[1] / (precision[0] + precision[1]))[part]

    def _recent(self, frame: int, solved: Solved) -> list[int]:
        """Return the nearest solved frames on the same side of the first one that had solved frames before them."""
        recent_frames = 4  # number of last solved frames in which predictors are compared
        # Frames before the first one were predicted from other neighbours than frames after it.
        done = list(solved)
        first = done[0]
        side = [other for other in done[1:] if (other - first) * (frame - first) > 0]
        return sorted(side, key=lambda other: abs(other - frame))[:recent_frames]

    def _extrapolated(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return the last frame's displacements, continued with a share of the last velocity."""
        # Constant velocity from the nearest frame and the one behind it.
        near = _nearest(frame, solved)
        last = solved[near][0]
        behind = [other for other in solved if (other - near) * (near - frame) > 0]
        if not behind:
            return last
        far = min(behind, key=lambda other: abs(other - near))
        return last + self.extrapolation * (frame - near) / (near - far) * (last - solved[far][0])

    def _decaying(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return skinning plus the last frame's decaying displacements."""
        zero = torch.zeros_like(next(iter(solved.values()))[0])
        return self._corrected(frame, solved, zero, zero)

    def _simulated(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return the simulated displacements plus the last frame's decaying correction."""
        assert self.simulated is not None
        own = self.simulated.displacements
        return self._corrected(frame, solved, own[frame], own[_nearest(frame, solved)])

    def _corrected(
        self, frame: int, solved: Solved, model: Float[Tensor, "K 3"], before: Float[Tensor, "K 3"]
    ) -> Float[Tensor, "K 3"]:
        """Return a model's displacements plus its error in the nearest solved frame, which decays with time.

        Args:
            frame: its number.
            solved: the solved frames.
            model: displacements that a model predicts in the frame.
            before: those that it predicts in the nearest solved frame.
        """
        near, offset = _nearest(frame, solved), self._reference_offset(solved)
        kept = exp(-abs(frame - near) / self.fps / CORRECTION_DECAY)
        return offset + model + kept * (solved[near][0] - offset - before)

    def _reference_offset(self, solved: Solved) -> Tensor:
        """Return the displacements found in the reference frame, 0 as long as there are none."""
        if self.offset is not None:
            return self.offset
        if self.reference is None or self.reference not in solved:
            return torch.zeros_like(next(iter(solved.values()))[0])
        return solved[self.reference][0]


def _nearest(frame: int, solved: Solved) -> int:
    return min(solved, key=lambda other: abs(other - frame))


def _until(frame: int, solved: Solved) -> Solved:
    """Return the frames that had been solved before a frame was."""
    return dict(list(solved.items())[: list(solved).index(frame)])


def _observed_part(error: Float[Tensor, "K 3"], observed: Observed | None) -> Float[Tensor, "K 3"]:
    """Return the components of an error that photographs determined."""
    return error if observed is None else torch.einsum("kij,kj->ki", observed(), error)
