"""What a frame begins with: the last frames' motion carried on, blended with that of simulated clothes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import exp

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.data.cloth_motion import ClothMotions
from smplxpp.cloth import Garment, GarmentConfig, cut_garment
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.labels import CLOTH_LABELS
from smplxpp.core.params import DEFAULT_FPS, BodyParams
from smplxpp.template.template import Template

FADING = 0.3
"""Seconds in which what a forecast has wrong falls to 1/e: a simulation swings as the cloth does, out of step."""
JUDGED = 4
"""Frames, the last ones, by which forecasts are judged."""
PINNED = 0.014
"""Metres of cloth that a forecast holds to the body: less than players do, for what is found corrects it."""
DOUBT = 1e-3
"""Metres that every forecast may be wrong by: two that are better are alike."""


Solved = Mapping[int, tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3 3"] | None]]
"""Displacements of frames, metres, and the share of every direction that pictures told of them; None: all."""

Forecast = Callable[[int, Solved], Float[Tensor, "K 3"]]
"""Displacements of a frame, metres, from those of the frames that are done."""


@dataclass(frozen=True, eq=False)
class SimulatedControls:
    """Simulated clothes of frames at the control points of a cage.

    Attributes:
        displacements: (K, 3) by frame, metres along the axes of the T-pose, 0 off simulated clothes.
        share: in [0, 1]: how much of a control point's displacement the simulation can tell.
        part: of each control point, a number from 0 to P - 1; 0: not simulated.
    """

    displacements: Mapping[int, Float[Tensor, "K 3"]]
    share: Float[Tensor, " K"]
    part: Int[Tensor, " K"]


def simulate_controls(
    template: Template, poses: Mapping[int, BodyParams], fps: float, *, reference: BodyParams, controls: Tensor
) -> SimulatedControls | None:
    """Simulate the clothes of a template through frames, in the default material.

    Args:
        poses: one frame each, by its number. fps: of the numbers.
        reference: one frame, the pose in which the template is the surface.
        controls: (K,) the template's vertices that the control points are.

    Returns:
        None where no part of the clothes hangs from the body.
    """
    frames = sorted(poses)
    stride = int(np.gcd.reduce(np.diff(frames))) if len(frames) > 1 else 1
    number = {frame: (frame - frames[0]) // stride for frame in frames}
    # The stage that keeps garments says what is wrong with them; here they foresee, and photographs decide.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        garments = _loose_parts(template, reference)
        if not garments:
            return None
        by_number = {number[frame]: poses[frame] for frame in frames}
        clothes = ClothMotions(template, garments, params=by_number.get, frames=list(by_number), fps=fps / stride)
        clothes.simulate(list(by_number))
    rows = controls.cpu().numpy()
    displacements = {}
    for frame in frames:
        shape = clothes.shape(number[frame])
        whole = np.zeros((template.vertex_count, 3), np.float32)
        whole[shape.vertices] = shape.share[:, None] * shape.displacements
        displacements[frame] = torch.tensor(whole[rows], device=controls.device)
    share, part = np.zeros(template.vertex_count, np.float32), np.zeros(template.vertex_count, np.int64)
    for k, garment in enumerate(garments):
        share[garment.vertices], part[garment.vertices] = garment.share(), k + 1
    return SimulatedControls(
        displacements,
        torch.tensor(share[rows], device=controls.device),
        torch.tensor(part[rows], device=controls.device),
    )


def _loose_parts(template: Template, reference: BodyParams) -> list[Garment]:
    """The clothes that can be cut for simulation."""
    garments = []
    for name in (label.name for label in CLOTH_LABELS if label.name in template.part_names):
        with suppress(InputError):
            garments.append(cut_garment(template, name, reference, GarmentConfig(pin_depth=PINNED)))
    return garments


@dataclass(frozen=True, eq=False)
class Foresight:
    """Displacements that a frame begins with, from the frames that are done.

    Attributes:
        extrapolation: share of the motion between the two frames before that is carried on.
        simulated: clothes; None: nothing is simulated.
        reference: frame in which the template is the surface: what was found there is an error of the Gaussians.
        error: that error where it is known before; None: from the frames that are done.
        fps: frames a second of the frames' numbers.
    """

    extrapolation: float
    simulated: SimulatedControls | None = None
    reference: int | None = None
    error: Float[Tensor, "K 3"] | None = None
    fps: float = DEFAULT_FPS

    @property
    def share(self) -> Float[Tensor, "K 1 1"] | float:
        """How much of the displacements is simulated; 0 where nothing is."""
        return 0.0 if self.simulated is None else self.simulated.share[:, None, None]

    def start(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return what a frame begins with.

        Either forecast counts by the inverse square of how far it was from what was found in the last frames, in the
        directions in which pictures told.

        Args:
            solved: the frames that are done, at least one, in the order in which they were found.
        """
        return self._blended(frame, solved, self._carried_on)

    def anchor(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return where a frame's displacements are held as far as pictures do not tell.

        That is on skinning or on simulated clothes, with what the frame before differed from them, which fades: cloth
        that nothing checks would go on for ever, or stay where chance had brought it. Simulated clothes are believed
        wholly as long as they were no worse than skinning.
        """
        return self._blended(frame, solved, self._on_skinning, favour=2.0)

    def _blended(self, frame: int, solved: Solved, otherwise: Forecast, favour: float = 1.0) -> Tensor:
        """Return the simulated forecast and another, each by how far it was from what was found."""
        other = otherwise(frame, solved)
        if self.simulated is None:
            return other
        wrong = []
        for one in self._judged(frame, solved):
            found, told = solved[one]
            before = _until(one, solved)
            a, b = (forecast(one, before) - found for forecast in (otherwise, self._simulated))
            wrong.append((_seen(a, told), _seen(b, told)))
        trust = self.simulated.share * (favour * self._trust(wrong)).clamp(max=1.0)
        return other + trust[:, None] * (self._simulated(frame, solved) - other)

    def shape(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """Return the shape about which a frame's displacements are smooth: between skinning's, 0, and the simulated.

        Either counts by the inverse square of how far it was from what was found in the last frames.
        """
        if self.simulated is None:
            return torch.zeros_like(next(iter(solved.values()))[0])
        own, wrong = self.simulated.displacements, []
        for one in self._judged(frame, solved):
            found, told = solved[one]
            true = found - self._error(solved)
            wrong.append((_seen(true, told), _seen(own[one] - true, told)))
        trust = self._trust(wrong)
        return trust[:, None] * own[frame]

    def _trust(self, wrong: Sequence[tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3"]]]) -> Float[Tensor, " K"]:
        """How much the simulation counts at each control point, part by part, in [0, 1].

        Args:
            wrong: in each judged frame, how far the other forecast and the simulated one were from what was found.
        """
        assert self.simulated is not None
        share, part = self.simulated.share, self.simulated.part
        parts = int(part.max()) + 1
        weight = share.new_zeros(parts).index_add(0, part, share).clamp(min=1e-6)
        good = []
        for errors in ([pair[side] for pair in wrong] for side in (0, 1)):
            square = sum((share * error.square().sum(-1) for error in errors), torch.zeros_like(share))
            mean = share.new_zeros(parts).index_add(0, part, square) / weight / max(len(errors), 1)
            good.append(1.0 / (mean + DOUBT**2))
        return (good[1] / (good[0] + good[1]))[part]

    def _judged(self, frame: int, solved: Solved) -> list[int]:
        """The nearest done frames on the same side of the first one, those that had frames before them."""
        done = list(solved)
        first = done[0]
        side = [other for other in done[1:] if (other - first) * (frame - first) > 0]
        return sorted(side, key=lambda other: abs(other - frame))[:JUDGED]

    def _carried_on(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        """A share of the motion between the two frames before, carried on."""
        near = _nearest(frame, solved)
        last = solved[near][0]
        behind = [other for other in solved if (other - near) * (near - frame) > 0]
        if not behind:
            return last
        far = min(behind, key=lambda other: abs(other - near))
        return last + self.extrapolation * (frame - near) / (near - far) * (last - solved[far][0])

    def _on_skinning(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        zero = torch.zeros_like(next(iter(solved.values()))[0])
        return self._fading(frame, solved, zero, zero)

    def _simulated(self, frame: int, solved: Solved) -> Float[Tensor, "K 3"]:
        assert self.simulated is not None
        own = self.simulated.displacements
        return self._fading(frame, solved, own[frame], own[_nearest(frame, solved)])

    def _fading(
        self, frame: int, solved: Solved, there: Float[Tensor, "K 3"], before: Float[Tensor, "K 3"]
    ) -> Float[Tensor, "K 3"]:
        """A shape of the frame with what the nearest done one differs from its own, `before`, the less the later."""
        near, error = _nearest(frame, solved), self._error(solved)
        kept = exp(-abs(frame - near) / self.fps / FADING)
        return error + there + kept * (solved[near][0] - error - before)

    def _error(self, solved: Solved) -> Tensor:
        """What was found where the template is the surface."""
        if self.error is not None:
            return self.error
        if self.reference is None or self.reference not in solved:
            return torch.zeros_like(next(iter(solved.values()))[0])
        return solved[self.reference][0]


def _nearest(frame: int, solved: Solved) -> int:
    return min(solved, key=lambda other: abs(other - frame))


def _until(frame: int, solved: Solved) -> Solved:
    """What had been found before a frame was."""
    return dict(list(solved.items())[: list(solved).index(frame)])


def _seen(error: Float[Tensor, "K 3"], told: Float[Tensor, "K 3 3"] | None) -> Float[Tensor, "K 3"]:
    """The part of an error that pictures could tell."""
    return error if told is None else torch.einsum("kij,kj->ki", told, error)
