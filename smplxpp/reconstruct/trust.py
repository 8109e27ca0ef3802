"""Which masks can be believed: silhouettes of one body agree with each other, and those that do not are named.

A body's voxel lies within every true mask. With no bad mask, the hull's silhouette covers every mask; one mask that
lacks an arm takes the arm from the hull, and all other views show arms that nothing explains. So the views are asked
what they could explain if `k` masks were wrong at each voxel; while `k` must be above 0, the view goes whose word
leaves most of the others' masks unexplained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from smplxpp.core.errors import InputError
from smplxpp.reconstruct.silhouettes import UNSEEN, Silhouette, least_shown
from smplxpp.reconstruct.views import LEAST_VIEWS

_CELLS = 72
"""Voxels along the longer side of the box in which views are compared."""
_EXPLAINED = 0.97
"""Share of a mask that the hull of views that agree explains, at least; the median over the views counts."""
_OWN = 0.80
_MOST_WRONG = 1.0 / 3.0
_SLACK_PIXELS = 3.0


@dataclass(frozen=True, eq=False)
class Box:
    """An upright box in the world, metres."""

    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class Consensus:
    """Views that agree.

    Attributes:
        trusted: by view.
        reasons: what is wrong with the others, by name.
        explained: share of each view's mask that the hull of the trusted ones explains.
        box: about the body, with a margin.
    """

    trusted: Bool[np.ndarray, " V"]
    reasons: dict[str, str]
    explained: Float64[np.ndarray, " V"]
    box: Box


def body_box(silhouettes: Sequence[Silhouette]) -> Box:
    """A cube about the point where the rays through the masks' middles meet, as large as the masks say.

    Robust to a few wrong ones: residuals are weighted anew, the size is a high quantile over the views.
    """
    eyes = np.stack([one.camera.position for one in silhouettes])
    rays = []
    for one in silhouettes:
        rows, columns = np.nonzero(one.distance > 0)
        x = np.array([columns.mean() + one.corner[0] + 0.5, rows.mean() + one.corner[1] + 0.5, 1.0])
        ray = one.camera.cam_from_world[:3, :3].T @ np.linalg.solve(one.camera.K, x)
        rays.append(ray / np.linalg.norm(ray))
    across = np.eye(3) - np.einsum("vi,vj->vij", np.stack(rays), np.stack(rays))
    weight, center = np.ones(len(eyes)), np.zeros(3)
    for _ in range(20):
        matrix = np.einsum("v,vij->ij", weight, across)
        center = np.linalg.solve(matrix, np.einsum("v,vij,vj->i", weight, across, eyes))
        off = np.linalg.norm(np.einsum("vij,vj->vi", across, center - eyes), axis=1)
        weight = 1.0 / (off + 0.1 * np.median(off) + 1e-6)
    sizes = []
    for one in silhouettes:
        z = float((one.camera.cam_from_world[:3] @ np.append(center, 1.0))[2])
        sizes.append(max(one.distance.shape) * one.pixel * max(z, 0.0))
    half = 0.75 * float(np.median(sizes))
    return Box(center - half, center + half)


def find_consensus(silhouettes: Sequence[Silhouette]) -> Consensus:
    """Find the views whose masks agree, and the body's box.

    Raises:
        InputError: masks contradict each other so that less than two thirds of them agree, or no body is left.
    """
    box = body_box(silhouettes)
    for _ in range(2):  # once to find the body, once at a resolution that fits it
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
    """Take masks away, the worst first, that show much of what is nowhere in the hull; the hull, what it explains."""
    while True:
        inside = votes.accepted(trusted, 0)
        explained = votes.explained(inside)
        worst = int(np.where(trusted, explained, np.inf).argmin())
        if explained[worst] >= _OWN or trusted.sum() <= LEAST_VIEWS or not inside.any():
            return inside, explained
        trusted[worst] = False
        share = 100 * (1 - explained[worst])
        reasons[silhouettes[worst].name] = f"{share:.0f} % of it is nowhere in the other views' hull"


def _grid(box: Box) -> tuple[np.ndarray, tuple[int, ...], float]:
    size = box.high - box.low
    cell = float(size.max()) / _CELLS
    axes = [
        low + cell * (np.arange(int(np.ceil(extent / cell))) + 0.5) for low, extent in zip(box.low, size, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    return points.reshape(-1, 3), points.shape[:3], cell


@dataclass(frozen=True, eq=False)
class _Votes:
    """What the views say of voxels that most of them may accept.

    Attributes:
        shape: of the grid, N in all.
        inside: (N, V) the view accepts the voxel or does not show it.
        place: (N, V) the coarse pixel in which a view shows the voxel; -1 where it does not.
        pixels: how many coarse ones a view has.
        masks: per view, the coarse pixels of its mask that voxels fall into.
    """

    shape: tuple[int, ...]
    inside: np.ndarray
    place: np.ndarray
    pixels: tuple[int, ...]
    masks: tuple[np.ndarray, ...]

    @staticmethod
    def of(silhouettes: Sequence[Silhouette], points: np.ndarray, shape: tuple[int, ...], cell: float) -> _Votes:
        inside, place, counts, masks = [], [], [], []
        for one in silhouettes:
            depth = one.depth(points)
            z = points @ one.projection[2, :3].astype(np.float32) + np.float32(one.projection[2, 3])
            slack = 0.5 * cell + _SLACK_PIXELS * one.pixel * np.maximum(z, 0)
            inside.append(depth > -slack)
            # Coarse pixels are as large as a voxel in the middle of the box.
            step = max(1.0, cell / (one.pixel * max(float(np.median(z)), 1e-6)))
            screen = one.camera.screen_from_world(points)
            shown = depth < UNSEEN
            columns = int(one.camera.width / step) + 1
            rows = int(one.camera.height / step) + 1
            x = np.where(shown, screen[:, 0], 0) / step
            y = np.where(shown, screen[:, 1], 0) / step
            place.append(np.where(shown, y.astype(np.int64) * columns + x.astype(np.int64), -1))
            counts.append(rows * columns)
            masks.append(_coarse_mask(one, step, rows, columns))
        return _Votes(shape, np.stack(inside, axis=1), np.stack(place, axis=1), tuple(counts), tuple(masks))

    def accepted(self, trusted: np.ndarray, dissent: int) -> np.ndarray:
        """(N,) the connected voxels that all but `dissent` of the trusted views accept, where enough show them.

        Of several pieces the one that most of the views show: others lie before single cameras, out of the others'
        sight.
        """
        shown = (self.place[:, trusted] >= 0).sum(axis=1)
        kept = (shown >= least_shown(int(trusted.sum()))) & ((~self.inside[:, trusted]).sum(axis=1) <= dissent)
        piece, count = ndimage.label(kept.reshape(self.shape))
        if count < 2:
            return kept
        piece = piece.ravel()
        return piece == np.bincount(piece[kept], (shown[kept] == shown[kept].max()).astype(float)).argmax()

    def explained(self, kept: np.ndarray) -> np.ndarray:
        """(V,) share of each mask that the kept voxels cover; 1 for a mask outside of the box."""
        out = np.ones(len(self.masks))
        for v, mask in enumerate(self.masks):
            covered = np.zeros(self.pixels[v] + 1, dtype=bool)
            covered[self.place[kept, v]] = True
            if mask.any():
                out[v] = covered[:-1][mask].mean()
        return out


def _coarse_mask(one: Silhouette, step: float, rows: int, columns: int) -> np.ndarray:
    """(rows * columns,) coarse pixels whose middle is well inside of the mask."""
    y, x = np.mgrid[:rows, :columns]
    column = ((x + 0.5) * step - one.corner[0]).astype(np.int64)
    row = ((y + 0.5) * step - one.corner[1]).astype(np.int64)
    height, width = one.distance.shape
    there = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside = np.zeros(there.shape, dtype=bool)
    inside[there] = one.distance[row[there], column[there]] > 0.25 * step
    return inside.ravel()


def _agreeing(votes: _Votes, silhouettes: Sequence[Silhouette]) -> tuple[np.ndarray, dict[str, str]]:
    """Take views away until no dissent is needed to explain the masks of the rest."""
    count = len(silhouettes)
    most = int(count * _MOST_WRONG)
    trusted, reasons = np.ones(count, dtype=bool), dict[str, str]()
    while True:
        for k in range(most + 1 - len(reasons)):
            accepted = votes.accepted(trusted, k)
            explained = votes.explained(accepted)[trusted]
            if np.median(explained) >= _EXPLAINED and (explained >= _OWN).mean() >= 0.5:
                break
        else:
            _refuse(reasons, count)
        if k == 0:
            return trusted, reasons
        # What each one's word costs the others.
        cost = np.full(count, -1.0)
        for v in np.flatnonzero(trusted):
            others = trusted.copy()
            others[v] = False
            lost = 1.0 - votes.explained(accepted & votes.inside[:, v])[others]
            cost[v] = lost.mean()
        worst = int(cost.argmax())
        trusted[worst] = False
        reasons[silhouettes[worst].name] = f"{100 * cost[worst]:.0f} % of the other views' masks lie outside of it"


def _refuse(reasons: dict[str, str], count: int) -> None:
    raise InputError(
        "masks to reconstruct from",
        expected=f"silhouettes of one body: masks of at least {count - int(count * _MOST_WRONG)} of {count} views that "
        "agree, through their cameras",
        received="; ".join(f"{name}: {why}" for name, why in reasons.items()) or "masks that contradict each other",
        remedy="look at the masks over the photographs; if they are right, the cameras are not (`smplxpp capture "
        "check`)",
    )
