"""Ridge regression from poses to the surfaces of the training frames, with cross-validated hyperparameters.

New poses have no frame code. Their displacements are predicted from the joint angles by `min |Y - F W|^2 + lambda
|W|^2`, Y the field's displacements in the training frames and F features of the pose (`fit_pose_regression`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from avatar.data.sequence import AvatarSequence
from avatar.models.networks.pose_dependence import PoseRegression, joint_steps
from avatar.models.student import Student
from smplxpp.core.spread import spread_inside

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RegressionConfig:
    """Choices of the regression. The grids are searched by cross-validation, separately for each part of the template.

    Attributes:
        frames: number of training frames at most, evenly spread.
        blocks: number of contiguous cross-validation folds. Half a fold on each side is left out of the fit too,
            because neighbouring frames are nearly identical.
        fades: grid of factors on a joint angle's feature for every step along the skeleton.
        reaches: grid of the standard deviation of a spatial Gaussian filter of the surfaces, metres; 0: none.
        ridges: grid of lambda, radians squared.
        margin: new angles are clamped to the training's range, extended by this share of it.
        lost: RMS displacement that the low-rank form may lose, metres, over poses spread as the training's are.
        new_pose_sigma: assumed standard deviation of unseen pose variation per angle, radians.
    """

    frames: int = 256
    blocks: int = 5
    fades: tuple[float, ...] = (0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
    reaches: tuple[float, ...] = (0.0, 0.02, 0.04)
    ridges: tuple[float, ...] = tuple(10.0 ** (k / 2) for k in range(-8, 5))
    margin: float = 0.25
    lost: float = 5e-5
    new_pose_sigma: float = 0.05


DEFAULT = RegressionConfig()


@dataclass(frozen=True)
class CrossValidated:
    """Hyperparameters of a part's regression and its cross-validated errors.

    Attributes:
        fade: of `RegressionConfig.fades`.
        reach: of `RegressionConfig.reaches`, metres.
        ridge: of `RegressionConfig.ridges`, radians squared.
        error: RMS error of the regression in left-out blocks, metres.
        mean_error: RMS error of the other frames' mean in its place, metres.
    """

    fade: float
    reach: float
    ridge: float
    error: float
    mean_error: float


@torch.no_grad()
def regress_poses(student: Student, sequence: AvatarSequence) -> PoseRegression:
    """Fit the regression to a student's field, evaluated in the training frames with their codes.

    Args:
        student: with a field and codes.
        sequence: of the training frames.
    """
    field, codes, template = student.field, student.codes, student.rig.template
    assert field is not None and codes is not None, "a student with a field"
    frames = spread_inside(sequence.train_frames, DEFAULT.frames)
    poses = torch.stack([sequence.pose(frame).body_pose for frame in frames])
    # Displacements of the field's points in the training frames, with their codes.
    surfaces = [field.at_points(pose[None], codes([frame]))[0] for frame, pose in zip(frames, poses, strict=True)]
    # Regress each point from the joints near it, separately for each label (body, hair, each garment).
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
            "pose regression of %s: error %.1f mm in left-out training frames, %.1f mm with their mean in its place",
            *(template.labels[label].name, 1e3 * own.error, 1e3 * own.mean_error),
        )
    return made.to(student.rig.device)


def fit_pose_regression(
    poses: Float[np.ndarray, "T 63"],
    surfaces: Float[np.ndarray, "T K 3"],
    places: Float[np.ndarray, "K 3"],
    steps: Int[np.ndarray, "K 21"],
    parts: Int[np.ndarray, " K"],
    config: RegressionConfig = DEFAULT,
) -> tuple[PoseRegression, dict[int, CrossValidated]]:
    """Fit `PoseRegression` to displacements of points in consecutive frames.

    Ridge regression `min |Y - F W|^2 + lambda |W|^2` with the features `f_j = fade^steps_j (theta_j - c_j)`, c the mean
    pose: angles of distant joints are penalised more. Y are the deviations from the mean surface, filtered over
    neighbouring points, because much of what was tracked frame by frame is noise from point to point. `fade`, `lambda`
    and the filter's width are those with the least cross-validated error, separately for each part. Where poses predict
    nothing, a large lambda gives the mean of the frames.

    Args:
        poses: body poses, radians, in the frames' order.
        surfaces: displacements of the points, metres.
        places: of the points in the T-pose, metres.
        steps: along the skeleton, from each joint to the nearest one that carries the point.
        parts: number of each point's part.
        config: grids and tolerances.

    Returns:
        The regression in a low-rank form, and the hyperparameters of each part.
    """
    poses, surfaces, places = (np.asarray(array, np.float64) for array in (poses, surfaces, places))
    # Centre both sides, so that the regression needs no intercept: with W = 0 it gives the mean surface.
    center, level = poses.mean(axis=0), surfaces.mean(axis=0)
    weights = np.zeros((*level.shape, len(center)))
    chosen = {}
    for part in np.unique(parts):
        # Hyperparameters of the part by cross-validation.
        own = np.flatnonzero(parts == part)
        away = surfaces[:, own] - level[own]
        smooth = {reach: _gaussian_filter(places[own], reach) for reach in config.reaches}
        chosen[int(part)] = best = _cross_validate(poses, away, steps[own], smooth, config)
        # Normal equations (X^T X + lambda I) W = X^T Y on all frames, one solve for all points with equal features.
        away = smooth[best.reach](away)
        for points, kind in _feature_groups(steps[own]):
            at, scale = own[points], _scale(kind, best.fade)
            # Features (T, 63) of these points and their targets (T, 3 P); W then takes in the factors, because F =
            # scale theta.
            x, y = (poses - center) * scale, away[:, points].reshape(len(poses), -1)
            solved = np.linalg.solve(x.T @ x + best.ridge * np.eye(len(center)), x.T @ y)
            weights[at] = (scale[:, None] * solved).T.reshape(len(at), 3, -1)
    # Low-rank form, and the range to which new angles are clamped.
    basis, rows = _low_rank(weights, poses - center, config)
    margin = config.margin * np.ptp(poses, axis=0)
    given = (level, basis, rows, center, poses.min(axis=0) - margin, poses.max(axis=0) + margin)
    return PoseRegression(*(torch.as_tensor(value) for value in given)), chosen


Smooth = Callable[[np.ndarray], np.ndarray]


def _gaussian_filter(places: Float[np.ndarray, "P 3"], reach: float) -> Smooth:
    """Return a filter of points' values (T, P, 3): Gaussian weights of the distance, up to three deviations."""
    if reach == 0.0:
        return lambda values: values
    # Sparse matrix of weights exp(-d^2 / (2 reach^2)), rows normalised.
    tree = cKDTree(places)
    weights = tree.sparse_distance_matrix(tree, 3.0 * reach, output_type="coo_matrix").tocsr()
    weights.data = np.exp(-0.5 * (weights.data / reach) ** 2)
    weights.setdiag(1.0)
    weights = weights.multiply(1.0 / weights.sum(axis=1)).tocsr()
    return lambda values: np.stack([weights @ one for one in values])


def _feature_groups(steps: Int[np.ndarray, "P 21"]) -> Iterator[tuple[np.ndarray, Int[np.ndarray, " 21"]]]:
    """Yield groups of points with equal features: their indices, and their steps to each joint."""
    kinds, kind_of = np.unique(steps, axis=0, return_inverse=True)
    for k, kind in enumerate(kinds):
        yield np.flatnonzero(kind_of.ravel() == k), kind


def _scale(kind: Int[np.ndarray, " 21"], fade: float) -> Float[np.ndarray, " 63"]:
    """Return the factor `fade^steps` on each angle."""
    return np.repeat(fade ** kind.astype(float), 3)


def _cross_validate(
    poses: Float[np.ndarray, "T 63"],
    surfaces: Float[np.ndarray, "T P 3"],
    steps: Int[np.ndarray, "P 21"],
    smooth: Mapping[float, Smooth],
    config: RegressionConfig,
) -> CrossValidated:
    """Return the hyperparameters with the least squared error over contiguous left-out blocks of frames.

    With the eigendecomposition `X X^T = U S U^T` over the frames of a fit, predictions for all lambda share their
    products: `X' W = (X' X^T U) diag(1 / (s + lambda)) (U^T Y)`. This dual form is as large as the number of frames;
    with more frames than angles `X^T X = V S V^T` is smaller: `X' W = (X' V) diag(1 / (s + lambda)) (V^T X^T Y)`.
    """
    blocks = np.array_split(np.arange(len(poses)), min(config.blocks, len(poses)))
    if len(blocks) < 2:  # one frame determines no regression
        return CrossValidated(1.0, 0.0, config.ridges[-1], 0.0, 0.0)
    wrong, of_mean = np.zeros((len(config.fades), len(smooth), len(config.ridges))), 0.0
    smoothed = [one(surfaces) for one in smooth.values()]
    for block in blocks:
        # Frames of the fit: all but the block and half a block on either side.
        beside = len(block) // 2
        kept = np.setdiff1d(np.arange(len(poses)), np.arange(block[0] - beside, block[-1] + 1 + beside))
        center, level = poses[kept].mean(axis=0), surfaces[kept].mean(axis=0)
        of_mean += float(((surfaces[block] - level) ** 2).sum())
        for points, kind in _feature_groups(steps):
            truth = (surfaces[block][:, points] - level[points]).reshape(len(block), -1)
            fits = [learned[kept][:, points] for learned in smoothed]
            fits = [(y - y.mean(axis=0)).reshape(len(kept), -1) for y in fits]
            for f, fade in enumerate(config.fades):
                scale = _scale(kind, fade)
                x, asked = (poses[kept] - center) * scale, (poses[block] - center) * scale
                # One eigendecomposition serves all filters and all lambda.
                dual = len(x) < x.shape[1]
                sizes, turned = np.linalg.eigh(x @ x.T if dual else x.T @ x)
                left, onto = ((asked @ x.T) @ turned, turned.T) if dual else (asked @ turned, turned.T @ x.T)
                # |L D R - Y|^2 for the diagonals D of all lambda, from products summed over the points.
                shrunk = 1.0 / (np.maximum(sizes, 0.0) + np.array(config.ridges)[:, None])
                for r, y in enumerate(fits):
                    right = onto @ y
                    squares = np.einsum("ai,ij,aj->a", shrunk, (left.T @ left) * (right @ right.T), shrunk)
                    both = np.einsum("ti,ti->i", left, truth @ right.T)
                    wrong[f, r] += squares - 2.0 * shrunk @ both + np.square(truth).sum()
    # The least error of the grid, and the errors as RMS of a point's displacement.
    f, r, a = (int(k) for k in np.unravel_index(int(wrong.argmin()), wrong.shape))
    count = surfaces.shape[0] * surfaces.shape[1]
    error, of_mean = (float(np.sqrt(total / count)) for total in (wrong[f, r, a], of_mean))
    return CrossValidated(config.fades[f], tuple(smooth)[r], config.ridges[a], error, of_mean)


def _low_rank(
    weights: Float[np.ndarray, "K 3 63"], poses: Float[np.ndarray, "T 63"], config: RegressionConfig
) -> tuple[Float[np.ndarray, "K 3 r"], Float[np.ndarray, "r 63"]]:
    """Return B and A with `B A ~ W`, of the least rank that loses at most `config.lost` metres RMS.

    The error is measured over poses with the covariance of the training's (centred) poses plus `new_pose_sigma^2 I`.
    """
    sizes, turned = np.linalg.eigh(poses.T @ poses / len(poses))
    # Square root of the covariance. Without the isotropic part, directions that few training poses span would be lost.
    sizes = np.maximum(sizes, 0.0) + config.new_pose_sigma**2
    root = turned * np.sqrt(sizes)
    # Principal components of the predicted displacements of such poses.
    left, values, right = np.linalg.svd(weights.reshape(-1, weights.shape[2]) @ root, full_matrices=False)
    lost = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / len(weights))
    count = max(1, int((lost > config.lost).sum()))
    rows = (turned / np.sqrt(sizes) @ right[:count].T).T
    return (left[:, :count] * values[:count]).reshape(*weights.shape[:2], count), rows
