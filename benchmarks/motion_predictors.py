"""Ways to tell a surface from a motion: the student's field, driven by poses, their past, or a latent with dynamics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.models.networks.deformation_field import DeformationField, FieldConfig, FrameCodes, show_null_code
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix

Drive = Literal["pose", "history", "autoregressive", "second order"]
LAGS = (0.1, 0.2, 0.4)
"""Seconds back of the poses that a history holds."""
WARM_UP = 1.5
"""Seconds before a frame from which on a latent is followed; it starts at rest."""
SUBSTEPS = 5
CODE, WIDTH = 32, 64
POSITION_SCALE = 0.05


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """How predictors learn: as the field does before the bake renders, on some of its points a step.

    Attributes:
        points: of the field, drawn anew for every step. null_share: of the poses that are shown without frame code.
    """

    iterations: int = 300
    batch: int = 12
    points: int = 500
    lr: float = 2e-3
    lr_final_factor: float = 0.02
    warmup: int = 20
    null_share: float = 0.2
    seed: int = 0


class MotionFeatures:
    """What predictors see of a motion, a row of threes for every frame.

    Args:
        params: of all frames of a motion in order, without gaps. fps: of them.

    Attributes:
        pose: (F, 63) theta. steps: (F, 132) theta, its change in the last frame, and the root's turn and way in it.
        history: theta, and for each lag theta's change and the root's turn and way in the root's own axes.
    """

    def __init__(self, params: BodyParams, fps: float) -> None:
        self.fps, self.frames = fps, len(params)
        theta, root = params.body_pose.reshape(self.frames, -1, 3), matrix_from_rotvec(params.global_orient)
        self._theta, self._root, self._transl = theta, root, params.transl
        self.pose = _flat(theta)
        self.steps = torch.cat([self.pose, self._changes(1)], dim=1)
        self.history = torch.cat([self.pose, *(self._changes(max(1, round(lag * fps))) for lag in LAGS)], dim=1)

    def _changes(self, lag: int) -> Tensor:
        """(F, 69) of theta and the root since `lag` frames ago; the motion stands still before its start."""
        now = np.arange(self.frames)
        before = np.maximum(now - lag, 0)
        turn = rotvec_from_matrix(np.swapaxes(self._root[before], 1, 2) @ self._root)
        way = np.einsum("fji,fj->fi", self._root, self._transl - self._transl[before])
        return _flat(np.concatenate([self._theta - self._theta[before], turn[:, None], way[:, None]], axis=1))


def _flat(rows: np.ndarray) -> Tensor:
    return torch.tensor(rows.reshape(len(rows), -1), dtype=torch.float32)


class Autoregressive(nn.Module):
    """`z_t = z_(t-1) + G(z_(t-1), u_t)`, with u_t the pose and its change."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.step = _mlp(CODE + inputs, CODE)

    def forward(self, u: Float[Tensor, "B W I"], seconds: float) -> Float[Tensor, "B Z"]:
        z = u.new_zeros(len(u), CODE)
        for k in range(u.shape[1]):
            z = z + self.step(torch.cat([z, u[:, k]], dim=1))
        return z


class SecondOrder(nn.Module):
    """`z'' = f(u) - k z - c z'`: a drive from pose and velocity, restored and damped, each number at its own rate.

    Semi-implicit steps; k starts at 2 Hz, c at half the critical damping.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.drive = _mlp(inputs, CODE)
        natural = 2.0 * math.pi * 2.0
        self.stiffness = nn.Parameter(torch.full((CODE,), math.log(natural**2)))
        self.damping = nn.Parameter(torch.full((CODE,), math.log(natural)))

    def forward(self, u: Float[Tensor, "B W I"], seconds: float) -> Float[Tensor, "B Z"]:
        stiffness, damping, h = self.stiffness.exp(), self.damping.exp(), seconds / SUBSTEPS
        # In units of the stiffness: a drive that stays leads z to f(u).
        pull = stiffness * self.drive(u)
        z = v = u.new_zeros(len(u), CODE)
        for k in range(u.shape[1]):
            for _ in range(SUBSTEPS):
                v = (v + h * (pull[:, k] - stiffness * z)) / (1.0 + h * damping)
                z = z + h * v
        return z


def _mlp(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, outputs)
    )


class Predictor(nn.Module):
    """The field on control points, with one of the drives.

    Args:
        vertices, cloth_mask, seen: of the template at K control points. seen: joints within three steps.
        features: of the motion. frames: numbers of those that have a frame code, where the drive is the pose.
    """

    def __init__(
        self,
        drive: Drive,
        vertices: Float[Tensor, "K 3"],
        cloth_mask: Tensor,
        seen: Tensor,
        features: MotionFeatures,
        frames: Sequence[int],
    ) -> None:
        super().__init__()
        self.drive, self.features = drive, features
        self.shown = features.history if drive == "history" else features.pose
        if drive == "history":
            of_root = seen.new_ones(len(seen), 2)
            seen = torch.cat([seen, *[torch.cat([seen, of_root], dim=1)] * len(LAGS)], dim=1)
        config = FieldConfig(pose_size=self.shown.shape[1], code_size=CODE, local_pose=3)
        self.field = DeformationField(config, vertices, cloth_mask, seen=seen)
        self.codes = FrameCodes(frames, CODE) if drive == "pose" else None
        show_null_code(self)
        inputs = features.steps.shape[1]
        self.latent = {"autoregressive": Autoregressive, "second order": SecondOrder}.get(drive, lambda _: None)(inputs)

    def code(self, rows: Sequence[int], coded: Sequence[bool]) -> Float[Tensor, "B Z"]:
        """Return the codes of frames: learned, or the null code; or the latent after what the motion did before."""
        if self.codes is not None:
            return self.codes([row if known else None for row, known in zip(rows, coded, strict=True)])
        if self.latent is None:
            return torch.zeros(len(rows), CODE)
        window = round(WARM_UP * self.features.fps)
        before = torch.tensor(rows)[:, None] - torch.arange(window).flip(0)
        return self.latent(self.features.steps[before.clamp(min=0)], 1.0 / self.features.fps)

    def forward(
        self, rows: Sequence[int], coded: Sequence[bool], points: Tensor | None = None
    ) -> Float[Tensor, "B K 3"]:
        """Return displacements, metres, at all control points or some."""
        field, pose, code = self.field, self.shown[list(rows)], self.code(rows, coded)
        if points is None:
            return field.at_points(pose, code)
        frames = torch.cat([pose[:, None] * field.sets, code[:, None].expand(-1, len(field.sets), -1)], dim=2)
        encodings, member = field.encodings[points], field.member[points]
        clothes = torch.nonzero(torch.isin(points, field.cloth_index))[:, 0]
        moved = field.body(encodings, frames, member)
        return moved.index_add(1, clothes, field.cloth(encodings[clothes], frames, member[clothes]))


def learn(predictor: Predictor, known: Mapping[int, Float[Tensor, "K 3"]], config: LearnConfig) -> None:
    """Fit a predictor to known displacements of some frames, metres; the loss is that of the field's pretraining."""
    rows = list(known)
    targets = torch.stack([known[row] for row in rows])
    groups: list[dict] = [{"params": [], "lr": config.lr, "start": config.lr}]
    for name, parameter in predictor.named_parameters():
        if name.startswith("codes"):
            groups.append({"params": [parameter], "lr": 5.0 * config.lr, "start": 5.0 * config.lr})
        else:
            groups[0]["params"].append(parameter)
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99))
    rng = np.random.default_rng(config.seed)
    batch, points = min(config.batch, len(rows)), min(config.points, targets.shape[1])
    order: list[int] = []
    for step in range(config.iterations):
        cosine = 0.5 * (1.0 + math.cos(math.pi * step / config.iterations))
        rate = min(1.0, (step + 1) / config.warmup) * (config.lr_final_factor + (1.0 - config.lr_final_factor) * cosine)
        for group in adam.param_groups:
            group["lr"] = rate * group["start"]
        if len(order) < batch:
            order = rng.permutation(len(rows)).tolist()
        chosen, order = order[:batch], order[batch:]
        at = torch.tensor(np.sort(rng.choice(targets.shape[1], points, replace=False)))
        coded = (rng.random(batch) >= config.null_share).tolist()
        found = predictor([rows[k] for k in chosen], coded, at)
        loss = (found - targets[chosen][:, at]).abs().sum(-1).mean() / POSITION_SCALE
        adam.zero_grad()
        loss.backward()
        adam.step()


def ridge(x: Tensor, y: Tensor, asked: Tensor, amount: float) -> Tensor:
    """Return ridge regression's answers to `asked` from rows `x` with answers `y`, inputs scaled to deviation 1."""
    center, level = x.mean(0), y.mean(0)
    scale = x.std(0).clamp(min=1e-3)
    x, asked = (x - center) / scale, (asked - center) / scale
    solved = torch.linalg.solve(x @ x.T + amount * x.shape[1] * torch.eye(len(x)), y - level)
    return asked @ x.T @ solved + level
