"""Decide which masks to trust: silhouettes of one body agree, and masks that contradict them are dropped.

A voxel of the body lies inside every correct mask, so that without faulty masks the visual hull covers every mask. One
mask that lacks an arm removes the arm from the hull, and every other view then shows an arm that the hull does not
explain. So the hull is computed with k dissenting views allowed at each voxel, for the smallest k that explains the
masks. While k is above 0, the view is dropped whose vote leaves most of the other masks unexplained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from smplxpp.core.errors import InputError
from smplxpp.reconstruct.views import LEAST_VIEWS, UNSEEN, Box, Silhouette, least_shown

# Smallest share of a mask that the hull of the trusted views must explain. It trades faulty masks that are missed
# against good ones that are dropped, since cameras and masks are never exact.
_OWN_EXPLAINED = 0.80
# Largest share of the views that may be dropped; if more contradict each other, no majority can be trusted.
_MOST_WRONG = 1.0 / 3.0


@dataclass(frozen=True, eq=False)
class Consensus:
    """The views whose masks agree with the majority.

    Attributes:
        trusted: whether a view is kept.
        reasons: why the others were dropped, by name.
        explained: share of each view's mask that the hull of the trusted views explains.
        box: around the body, with a margin.
    """

    trusted: Bool[np.ndarray, " V"]
    reasons: dict[str, str]
    explained: Float64[np.ndarray, " V"]
    box: Box


def body_box(silhouettes: Sequence[Silhouette]) -> Box:
    """Return a cube around the point where the rays through the masks' centroids meet.

    The point minimises the sum of distances to the rays by iteratively reweighted least squares, which is robust to a
    few wrong masks; the size is the median of the masks' extents at its depth, with half as much again.
    """
    # The ray of each mask's centroid in world coordinates.
    eyes = np.stack([one.camera.position for one in silhouettes])
    rays = []
    for one in silhouettes:
        rows, columns = np.nonzero(one.distance > 0)
        x = np.array([columns.mean() + one.corner[0] + 0.5, rows.mean() + one.corner[1] + 0.5, 1.0])
        ray = one.camera.cam_from_world[:3, :3].T @ np.linalg.solve(one.camera.K, x)
        rays.append(ray / np.linalg.norm(ray))
    # Projections perpendicular to the rays; the weights 1 / distance turn squares into distances.
    across = np.eye(3) - np.einsum("vi,vj->vij", np.stack(rays), np.stack(rays))
    weight, center = np.ones(len(eyes)), np.zeros(3)
    for _ in range(20):
        matrix = np.einsum("v,vij->ij", weight, across)
        center = np.linalg.solve(matrix, np.einsum("v,vij,vj->i", weight, across, eyes))
        off = np.linalg.norm(np.einsum("vij,vj->vi", across, center - eyes), axis=1)
        weight = 1.0 / (off + 0.1 * np.median(off) + 1e-6)
    # Metres that each mask's window spans at the depth of the point.
    sizes = []
    for one in silhouettes:
        z = float((one.camera.cam_from_world[:3] @ np.append(center, 1.0))[2])
        sizes.append(max(one.distance.shape) * one.pixel * max(z, 0.0))
    half = 0.75 * float(np.median(sizes))
    return Box(center - half, center + half)


def find_consensus(silhouettes: Sequence[Silhouette]) -> Consensus:
    """Find the views whose masks agree, and the box of the body.

    Raises:
        InputError: fewer than two thirds of the masks agree, or no body is left.
    """
    # Once in a box around the rays' meeting point, once in the box of the body that was found, at its resolution.
    box = body_box(silhouettes)
    for _ in range(2):
        points, shape, cell = _grid(box)
        votes = _Votes.of(silhouettes, points, shape, cell)
        trusted, reasons = _agreeing(votes, silhouettes)
        inside, explained = _without_the_unexplained(votes, trusted, reasons, silhouettes)
        if not inside.any():
            _refuse(reasons, len(silhouettes))
        margin = 2.0 * cell
        held = points[inside].astype(np.float64)
        box = Box(held.min(axis=0) - margin, held.max(axis=0) + margin)
    return Consensus(trusted, reasons, explained, box)


def _without_the_unexplained(
    votes: _Votes, trusted: np.ndarray, reasons: dict[str, str], silhouettes: Sequence[Silhouette]
) -> tuple[np.ndarray, np.ndarray]:
    """Drop masks of which the hull explains too little, worst first; return the hull and the explained shares."""
    while True:
        inside = votes.accepted(trusted, 0)
        explained = votes.explained(inside)
        worst = int(np.where(trusted, explained, np.inf).argmin())
        if explained[worst] >= _OWN_EXPLAINED or trusted.sum() <= LEAST_VIEWS or not inside.any():
            return inside, explained
        trusted[worst] = False
        share = 100 * (1 - explained[worst])
        reasons[silhouettes[worst].name] = f"{share:.0f} % of it is nowhere in the other views' hull"


def _grid(box: Box) -> tuple[np.ndarray, tuple[int, ...], float]:
    """Return the voxels' centres, 72 along the longest side of the box, the grid's shape and the voxels' size."""
    size = box.high - box.low
    cell = float(size.max()) / 72
    axes = [
        low + cell * (np.arange(int(np.ceil(extent / cell))) + 0.5) for low, extent in zip(box.low, size, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    return points.reshape(-1, 3), points.shape[:3], cell


@dataclass(frozen=True, eq=False)
class _Votes:
    """The votes of V views on N voxels.

    Attributes:
        shape: of the grid of voxels.
        inside: (V, N) whether a view accepts the voxel or does not show it.
        place: (V, N) int32, the coarse pixel in which a view shows the voxel; -1 if it does not.
        pixels: number of coarse pixels of each view.
        masks: coarse pixels of each view that are well inside its mask.
    """

    shape: tuple[int, ...]
    inside: np.ndarray
    place: np.ndarray
    pixels: tuple[int, ...]
    masks: tuple[np.ndarray, ...]

    @staticmethod
    def of(silhouettes: Sequence[Silhouette], points: np.ndarray, shape: tuple[int, ...], cell: float) -> _Votes:
        """Project all voxels into all views."""
        inside, place, counts, masks = [], [], [], []
        for one in silhouettes:
            # A voxel is accepted if it is inside by more than minus half its size and three pixels of mask error.
            depth = one.depth(points)
            z = points @ one.projection[2, :3].astype(np.float32) + np.float32(one.projection[2, 3])
            slack = 0.5 * cell + 3.0 * one.pixel * np.maximum(z, 0)
            inside.append(depth > -slack)
            # Coarse pixels have the size of a voxel in the middle of the box, so that voxels leave no holes in them.
            step = max(1.0, cell / (one.pixel * max(float(np.median(z)), 1e-6)))
            screen = one.camera.screen_from_world(points)
            shown = depth < UNSEEN
            columns = int(one.camera.width / step) + 1
            rows = int(one.camera.height / step) + 1
            x = np.where(shown, screen[:, 0], 0) / step
            y = np.where(shown, screen[:, 1], 0) / step
            place.append(np.where(shown, y.astype(np.int32) * columns + x.astype(np.int32), -1))
            counts.append(rows * columns)
            masks.append(_coarse_mask(one, step, rows, columns))
        return _Votes(shape, np.stack(inside), np.stack(place, dtype=np.int32), tuple(counts), tuple(masks))

    def accepted(self, trusted: np.ndarray, dissent: int) -> np.ndarray:
        """Return (N,) the voxels that all but `dissent` of the trusted views accept, where enough views show them.

        Of several connected components, the one that most views show is kept; the others lie in front of single
        cameras, where the other views do not reach.
        """
        shown = (self.place[trusted] >= 0).sum(axis=0)
        kept = (shown >= least_shown(int(trusted.sum()))) & ((~self.inside[trusted]).sum(axis=0) <= dissent)
        piece, count = ndimage.label(kept.reshape(self.shape))
        if count < 2:
            return kept
        piece = piece.ravel()
        return piece == np.bincount(piece[kept], (shown[kept] == shown[kept].max()).astype(float)).argmax()

    def explained(self, kept: np.ndarray) -> np.ndarray:
        """Return (V,) the share of each mask that the kept voxels cover; 1 for a mask outside the box."""
        out, voxels = np.ones(len(self.masks)), np.flatnonzero(kept)
        for v, mask in enumerate(self.masks):
            covered = np.zeros(self.pixels[v] + 1, dtype=bool)
            covered[self.place[v, voxels]] = True
            if mask.any():
                out[v] = covered[:-1][mask].mean()
        return out


def _coarse_mask(one: Silhouette, step: float, rows: int, columns: int) -> np.ndarray:
    """Return (rows * columns,) coarse pixels whose centre is well inside the mask."""
    y, x = np.mgrid[:rows, :columns]
    column = ((x + 0.5) * step - one.corner[0]).astype(np.int64)
    row = ((y + 0.5) * step - one.corner[1]).astype(np.int64)
    height, width = one.distance.shape
    there = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside = np.zeros(there.shape, dtype=bool)
    inside[there] = one.distance[row[there], column[there]] > 0.25 * step
    return inside.ravel()


def _agreeing(votes: _Votes, silhouettes: Sequence[Silhouette]) -> tuple[np.ndarray, dict[str, str]]:
    """Drop views until no dissent is needed to explain the masks of the rest."""
    count = len(silhouettes)
    most = int(count * _MOST_WRONG)
    trusted, reasons = np.ones(count, dtype=bool), dict[str, str]()
    while True:
        # The smallest dissent k whose hull explains the median mask by 97 % and most masks by their least share.
        for k in range(most + 1 - len(reasons)):
            accepted = votes.accepted(trusted, k)
            explained = votes.explained(accepted)[trusted]
            if np.median(explained) >= 0.97 and (explained >= _OWN_EXPLAINED).mean() >= 0.5:
                break
        else:
            _refuse(reasons, count)
        if k == 0:
            return trusted, reasons
        # What each view's vote costs the others: the share of their masks that is unexplained without the voxels it
        # rejects.
        cost = np.full(count, -1.0)
        for v in np.flatnonzero(trusted):
            others = trusted.copy()
            others[v] = False
            lost = 1.0 - votes.explained(accepted & votes.inside[v])[others]
            cost[v] = lost.mean()
        worst = int(cost.argmax())
        trusted[worst] = False
        reasons[silhouettes[worst].name] = f"{100 * cost[worst]:.0f} % of the other views' masks lie outside of it"


def _refuse(reasons: dict[str, str], count: int) -> None:
    """Raise the error of masks that contradict each other."""
    raise InputError(
        "masks to reconstruct from",
        expected=f"silhouettes of one body: masks of at least {count - int(count * _MOST_WRONG)} of {count} views that "
        "agree, through their cameras",
        received="; ".join(f"{name}: {why}" for name, why in reasons.items()) or "masks that contradict each other",
        remedy="look at the masks over the photographs; if they are right, the cameras are not (`smplxpp capture "
        "check`)",
    )
