"""Vote on the labels of a scan's faces by the label maps of views, and leave out maps that contradict the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Integer
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix

from smplxpp.core import BACKGROUND, LABELS, Camera, InputError, Labels, MeshLike, TriangleMesh, as_mesh
from smplxpp.core.errors import one_line
from smplxpp.raster import MeshMaps, rasterize_mesh


def vote_on_faces(
    mesh: MeshLike, views: Sequence[tuple[Camera, Integer[np.ndarray, "_ _"]]], *, labels: Labels = LABELS
) -> Float64[np.ndarray, "M L"]:
    """Sum `cos(view, normal) clip(d / 4, 0.1, 1)` over the views' pixels that show a face, for each label.

    d is the pixel's distance to the silhouette of the labelled foreground, in pixels, because parsers err there.
    Background pixels do not vote; faces that look away from the camera get nothing (the far side of an open sheet). A
    visible face smaller than a pixel may own none; it gets the vote of the pixel at its centre, times its share of it.

    Args:
        mesh: the scan.
        views: (camera, label map) pairs; a map is (H, W) in our ids, background -1, of its camera's size.
        labels: what the ids stand for.

    Raises:
        InputError: sizes that do not agree, unknown ids, or no vote at all.
    """
    mesh = as_mesh(mesh, subject="mesh")
    votes = np.zeros((mesh.face_count, len(labels)))
    for camera, shown in views:
        votes += votes_of_view(mesh, camera, shown, label_count=len(labels))
    require_votes(bool(votes.any()))
    return votes


def votes_of_view(
    mesh: TriangleMesh, camera: Camera, labels: Integer[np.ndarray, "_ _"], *, label_count: int = len(LABELS)
) -> Float64[np.ndarray, "M L"]:
    """Return the votes of one view, as defined in `vote_on_faces`.

    Raises:
        InputError: sizes that do not agree, or unknown ids.
    """
    labels = np.asarray(labels)
    if labels.shape != (camera.height, camera.width):
        raise InputError(
            f"label map of camera {camera.name!r}",
            expected=f"shape ({camera.height}, {camera.width})",
            received=f"{labels.shape}",
            remedy="scale the camera's intrinsics to the map's size",
        )
    if labels.min() < BACKGROUND or labels.max() >= label_count:
        raise InputError(
            f"label map of camera {camera.name!r}",
            expected=f"ids -1 to {label_count - 1}",
            received=f"{labels.min()} to {labels.max()}",
            remedy="map them with map_labels first",
        )
    # Pixels of visible faces, and the pixels of faces that are smaller than a pixel.
    maps = rasterize_mesh(mesh, camera)
    foreground = labels != BACKGROUND
    row, col = np.nonzero(maps.mask & foreground)
    hit, share = maps.face_id[row, col], np.ones(len(row))
    small, small_row, small_col, small_share = _smaller_than_a_pixel(mesh, camera, maps, foreground)
    hit, share = np.concatenate([hit, small]), np.concatenate([share, small_share])
    row, col = np.concatenate([row, small_row]), np.concatenate([col, small_col])
    # Distance to the silhouette. The image is padded with background, because its edge cuts the person off like a
    # silhouette.
    inside = distance_transform_edt(np.pad(foreground, 1))[1:-1, 1:-1][row, col]
    cosine = -np.einsum("ij,ij->i", _rays(camera, row, col), mesh.face_normals[hit])
    weight = share * np.maximum(cosine, 0.0) * np.clip(inside / 4.0, 0.1, 1.0)
    votes = np.bincount(hit * label_count + labels[row, col], weight, minlength=mesh.face_count * label_count)
    # `bincount` of no pixels returns integers.
    return votes.astype(np.float64).reshape(mesh.face_count, label_count)


def require_votes(some: bool) -> None:
    """Refuse views that do not vote on any face.

    Raises:
        InputError: there is none.
    """
    if not some:
        raise InputError(
            "label maps",
            expected="views that see the scan",
            received="no labelled pixel on any face",
            remedy="check the cameras' convention (OpenCV, world to camera), units and the winding of the faces",
        )


def _smaller_than_a_pixel(
    mesh: TriangleMesh, camera: Camera, maps: MeshMaps, foreground: Bool[np.ndarray, "H W"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the visible faces that own no pixel: indices, rows and columns of their centres, and shares of a pixel."""
    # Faces without a pixel whose centres lie within the image.
    owns = np.zeros(mesh.face_count, dtype=bool)
    owns[maps.face_id[maps.mask]] = True
    face = np.flatnonzero(~owns)
    x, y, depth = camera.screen_from_world(mesh.face_centers[face]).T[:3]
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    face, depth = face[inside], depth[inside]
    row, col = y[inside].astype(np.int64), x[inside].astype(np.int64)
    focal = np.sqrt(abs(np.linalg.det(camera.K[:2, :2])))
    pixel = np.full(len(face), 1.0 / focal) if camera.orthographic else depth / focal
    # A face is visible if it lies at most two pixel sizes behind the surface that the pixel shows, which may slope.
    seen = foreground[row, col] & (depth < maps.depth[row, col] + 2.0 * pixel)
    face, row, col = face[seen], row[seen], col[seen]
    share = mesh.face_areas[face] / pixel[seen] ** 2
    return face, row, col, np.minimum(share, 1.0)


def _rays(camera: Camera, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Return the unit viewing directions (P, 3) in the world through pixel centres."""
    if camera.orthographic:
        return np.broadcast_to(camera.forward, (len(row), 3))
    pixel = np.stack([col + 0.5, row + 0.5, np.ones(len(row))], axis=1)
    ray = pixel @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class AgreedVotes:
    """Votes of the views that agree with each other.

    Attributes:
        votes: votes of the views that are kept, as `vote_on_faces` returns them.
        left_out: the other views by name, each with the share of its votes that the rest agreed with.
    """

    votes: Float64[np.ndarray, "M L"]
    left_out: Mapping[str, float]

    __repr__ = one_line


def vote_in_agreement(
    mesh: MeshLike, views: Sequence[tuple[Camera, Integer[np.ndarray, "_ _"]]], *, labels: Labels = LABELS
) -> AgreedVotes:
    """Sum votes as `vote_on_faces` does, without the label maps that the other views contradict.

    A view agrees on a face if its label wins the sum of all other views. A view is a candidate for exclusion if it
    agrees on less than half of its votes on faces that others see. The candidate whose absence makes the rest agree
    most is excluded, if the rest then agrees on 75 %. This repeats until no candidate is left or a third of the views
    is gone; with more, the majority would be unknown. Two views that contradict each other are both kept.

    Raises:
        InputError: as `vote_on_faces` does.
    """
    mesh = as_mesh(mesh, subject="mesh")
    # Sparse matrices, because a view sees a part of the faces, and a studio has a hundred views.
    each = [csr_matrix(votes_of_view(mesh, camera, shown, label_count=len(labels))) for camera, shown in views]
    require_votes(any(votes.nnz for votes in each))
    kept = [k for k, votes in enumerate(each) if votes.nnz]
    left_out: dict[str, float] = {}
    for _ in range(len(kept) // 3):
        # Exclude the candidate whose absence leaves the best agreement.
        shared, agreed = _shares([each[k] for k in kept])
        candidates = [i for i in range(len(kept)) if shared[i] > 0 and agreed[i] < 0.5 * shared[i]]
        rests = {i: _mean_agreement([each[k] for k in kept if k != kept[i]]) for i in candidates}
        if not rests or max(rests.values()) < 0.75:
            break
        worst = max(rests, key=lambda i: rests[i])
        left_out[views[kept[worst]][0].name or f"view {kept[worst]}"] = float(agreed[worst] / shared[worst])
        kept.pop(worst)
    votes = np.asarray(sum(each[k] for k in kept).todense())
    return AgreedVotes(votes.reshape(mesh.face_count, len(labels)), left_out)


def _shares(each: Sequence[csr_matrix]) -> tuple[np.ndarray, np.ndarray]:
    """Return each view's sum of votes on faces that others see, and the part of it that agrees with the others' sum."""
    total = np.asarray(sum(each).todense())
    shared, agreed = np.zeros(len(each)), np.zeros(len(each))
    for k, votes in enumerate(each):
        face = np.flatnonzero(np.diff(votes.indptr))
        own = votes[face].toarray()
        # Subtracting from a floating-point sum leaves rounding errors, which are no votes.
        others = np.where(total[face] - own > 1e-9 * total[face], total[face] - own, 0.0)
        seen = others.any(axis=1)
        shared[k] = own[seen].sum()
        agreed[k] = own[seen, others[seen].argmax(axis=1)].sum()
    return shared, agreed


def _mean_agreement(each: Sequence[csr_matrix]) -> float:
    """Return the share of all views' votes that the others agree with; 0 if no face is seen twice."""
    shared, agreed = _shares(each)
    return float(agreed.sum() / shared.sum()) if shared.any() else 0.0
