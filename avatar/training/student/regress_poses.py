"""Regression from poses to the surfaces that training found in its frames; what it hangs on is chosen on blocks."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from avatar.data.sequence import AvatarSequence
from avatar.models.networks.local_pose import joint_steps
from avatar.models.networks.pose_regression import PoseRegression
from avatar.models.student import Student
from smplxpp.core.labels import LABELS
from smplxpp.core.spread import spread_inside

log = logging.getLogger(__name__)

FRAMES = 256
"""At most as many, spread over the training's, are looked at."""
BEYOND = 0.25
"""Angles are believed beyond the training's by this share of their range."""
BLOCKS = 5
"""Of frames that follow each other, each left out once, and half as many beside it on either side: they are nearly its
own, in all that sways slowly, and to foretell them says nothing of new poses."""
FADES = (0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
"""How much less a joint's angle is worth with every step along the skeleton: to choose from."""
REACHES = (0.0, 0.02, 0.04)
"""Metres, standard deviation of means over neighbours that are learned in the surfaces' place: to choose from."""
AMOUNTS = tuple(10.0 ** (k / 2) for k in range(-8, 5))
"""lambda, radians squared: to choose from."""
LEFT_OVER = 5e-5
"""Metres, root mean square over poses as spread as the training's, that leaving out directions may cost."""
OTHER = 0.05
"""Radians, standard deviation of each angle by which new poses are other than the training's are."""


@dataclass(frozen=True)
class Chosen:
    """What a part's regression hangs on, and what it is worth in blocks of frames that it did not see.

    Attributes:
        fade, reach, amount: of `FADES`, `REACHES` and `AMOUNTS`.
        error, of_mean: metres, root mean square, of the regression, and of the other frames' mean in its place.
    """

    fade: float
    reach: float
    amount: float
    error: float
    of_mean: float


@torch.no_grad()
def regress_poses(student: Student, sequence: AvatarSequence) -> PoseRegression:
    """Make the regression of a student's new poses from its field in the training frames, codes and all."""
    field, codes, template = student.field, student.codes, student.rig.template
    assert field is not None and codes is not None, "a student with a field"
    frames = spread_inside(sequence.train_frames, FRAMES)
    poses = torch.stack([sequence.pose(frame).body_pose for frame in frames])
    surfaces = [field.at_points(pose[None], codes([frame]))[0] for frame, pose in zip(frames, poses, strict=True)]
    points = field.points.cpu().numpy()
    made, chosen = fit_pose_regression(
        poses.cpu().numpy(),
        torch.stack(surfaces).cpu().numpy(),
        template.vertices[points],
        joint_steps(template)[points],
        template.vertex_labels[points],
    )
    for label, own in chosen.items():
        log.info(
            "new poses of %s: %.1f mm off in training frames that are left out, their mean %.1f",
            *(LABELS[label].name, 1e3 * own.error, 1e3 * own.of_mean),
        )
    return made.to(student.rig.device)


def fit_pose_regression(
    poses: Float[np.ndarray, "T 63"],
    surfaces: Float[np.ndarray, "T K 3"],
    places: Float[np.ndarray, "K 3"],
    steps: Int[np.ndarray, "K 21"],
    parts: Int[np.ndarray, " K"],
) -> tuple[PoseRegression, dict[int, Chosen]]:
    """Fit `PoseRegression` to displacements of points in frames that follow each other.

    Ridge regression, `min |Y - F W|^2 + lambda |W|^2` with the features `f_j = fade^steps_j (theta_j - c_j)`: what far
    joints tell costs more. What is learned is how surfaces leave their mean, as means over neighbours: of what was
    followed frame by frame, much is chance from point to point. `fade`, `lambda` and the neighbours' reach are for each
    part those that predict blocks of left-out frames best; where poses tell nothing, that is the mean of the frames.

    Args:
        poses: radians, in the frames' order. surfaces: metres. places: of the points in the T-pose, metres.
        steps: along the skeleton, from each joint to the nearest that carries the point. parts: of the points.

    Returns:
        The regression, and what was chosen for each part.
    """
    poses, surfaces, places = (np.asarray(array, np.float64) for array in (poses, surfaces, places))
    center, level = poses.mean(axis=0), surfaces.mean(axis=0)
    weights = np.zeros((*level.shape, len(center)))
    chosen = {}
    for part in np.unique(parts):
        own = np.flatnonzero(parts == part)
        away = surfaces[:, own] - level[own]
        smooth = {reach: _means_of_neighbours(places[own], reach) for reach in REACHES}
        chosen[int(part)] = best = _chosen(poses, away, steps[own], smooth)
        away = smooth[best.reach](away)
        for points, scale in _alike(steps[own], best.fade):
            at = own[points]
            x, y = (poses - center) * scale, away[:, points].reshape(len(poses), -1)
            solved = np.linalg.solve(x.T @ x + best.amount * np.eye(len(center)), x.T @ y)
            weights[at] = (scale[:, None] * solved).T.reshape(len(at), 3, -1)
    basis, rows = _few_directions(weights, poses - center)
    beyond = BEYOND * np.ptp(poses, axis=0)
    given = (level, basis, rows, center, poses.min(axis=0) - beyond, poses.max(axis=0) + beyond)
    return PoseRegression(*(torch.as_tensor(value) for value in given)), chosen


Smooth = Callable[[np.ndarray], np.ndarray]


def _means_of_neighbours(places: Float[np.ndarray, "P 3"], reach: float) -> Smooth:
    """Weighted means of points' values (T, P, 3): a Gaussian of the distance, up to three deviations."""
    if reach == 0.0:
        return lambda values: values
    tree = cKDTree(places)
    weights = tree.sparse_distance_matrix(tree, 3.0 * reach, output_type="coo_matrix").tocsr()
    weights.data = np.exp(-0.5 * (weights.data / reach) ** 2)
    weights.setdiag(1.0)
    weights = weights.multiply(1.0 / weights.sum(axis=1)).tocsr()
    return lambda values: np.stack([weights @ one for one in values])


def _alike(steps: Int[np.ndarray, "P 21"], fade: float) -> Iterator[tuple[np.ndarray, Float[np.ndarray, " 63"]]]:
    """Points for which the joints count alike, and by how much the angles do."""
    kinds, kind_of = np.unique(steps, axis=0, return_inverse=True)
    for k, kind in enumerate(kinds):
        yield np.flatnonzero(kind_of.ravel() == k), np.repeat(fade ** kind.astype(float), 3)


def _chosen(
    poses: Float[np.ndarray, "T 63"],
    surfaces: Float[np.ndarray, "T P 3"],
    steps: Int[np.ndarray, "P 21"],
    smooth: Mapping[float, Smooth],
) -> Chosen:
    blocks = np.array_split(np.arange(len(poses)), min(BLOCKS, len(poses)))
    if len(blocks) < 2:  # one frame: nothing to be learned from poses
        return Chosen(1.0, 0.0, AMOUNTS[-1], 0.0, 0.0)
    wrong, of_mean = np.zeros((len(FADES), len(smooth), len(AMOUNTS))), 0.0
    smoothed = [one(surfaces) for one in smooth.values()]
    for block in blocks:
        beside = len(block) // 2
        kept = np.setdiff1d(np.arange(len(poses)), np.arange(block[0] - beside, block[-1] + 1 + beside))
        center, level = poses[kept].mean(axis=0), surfaces[kept].mean(axis=0)
        of_mean += float(((surfaces[block] - level) ** 2).sum())
        for f, fade in enumerate(FADES):
            for points, scale in _alike(steps, fade):
                x, asked = (poses[kept] - center) * scale, (poses[block] - center) * scale
                truth = (surfaces[block][:, points] - level[points]).reshape(len(block), -1)
                # One decomposition serves all that is learned.
                sizes, turned = np.linalg.eigh(x.T @ x)
                left = asked @ turned
                # |L D R - Y|^2 for all diagonal D of the amounts, from products without the points.
                shrunk = 1.0 / (np.maximum(sizes, 0.0) + np.array(AMOUNTS)[:, None])
                for r, learned in enumerate(smoothed):
                    y = learned[kept][:, points]
                    right = turned.T @ (x.T @ (y - y.mean(axis=0)).reshape(len(kept), -1))
                    squares = np.einsum("ai,ij,aj->a", shrunk, (left.T @ left) * (right @ right.T), shrunk)
                    both = np.einsum("ti,ti->i", left, truth @ right.T)
                    wrong[f, r] += squares - 2.0 * shrunk @ both + np.square(truth).sum()
    f, r, a = (int(k) for k in np.unravel_index(int(wrong.argmin()), wrong.shape))
    count = surfaces.shape[0] * surfaces.shape[1]
    error, of_mean = (float(np.sqrt(total / count)) for total in (wrong[f, r, a], of_mean))
    return Chosen(FADES[f], tuple(smooth)[r], AMOUNTS[a], error, of_mean)


def _few_directions(
    weights: Float[np.ndarray, "K 3 63"], poses: Float[np.ndarray, "T 63"]
) -> tuple[Float[np.ndarray, "K 3 r"], Float[np.ndarray, "r 63"]]:
    """Return B and A with `B A = W` but for what hardly moves anything in poses like these, centred, and about them."""
    sizes, turned = np.linalg.eigh(poses.T @ poses / len(poses))
    # Without what new poses add, W would be lost where fewer poses than angles do not reach.
    sizes = np.maximum(sizes, 0.0) + OTHER**2
    root = turned * np.sqrt(sizes)
    # Principal components of what the regression says of such poses.
    left, values, right = np.linalg.svd(weights.reshape(-1, weights.shape[2]) @ root, full_matrices=False)
    lost = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / len(weights))
    count = max(1, int((lost > LEFT_OVER).sum()))
    rows = (turned / np.sqrt(sizes) @ right[:count].T).T
    return (left[:, :count] * values[:count]).reshape(*weights.shape[:2], count), rows
