"""Darning: what was cut out of a part because it bridged two limbs is closed again where the T-pose has room for it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Int

from smplxpp.assemble.build import CanonicalPart
from smplxpp.assemble.patch import Patch, patch_loop
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.core.topology import border_loops
from smplxpp.core.validation import require_at_least


@dataclass(frozen=True)
class DarnConfig:
    """Which holes are closed.

    Attributes:
        width: metres; a patch whose mean width, twice its area by its border's length, is more stays open: between a
            long sleeve and the side it would be a sail. 0 closes nothing.
    """

    width: float = 0.08

    def __post_init__(self) -> None:
        require_at_least("darning: width", self.width, 0.0)


@dataclass(frozen=True)
class Darning:
    """What was closed in one part.

    Attributes:
        holes: that cuts left. closed: of these. faces: added. area: of these, square metres.
    """

    holes: int = 0
    closed: int = 0
    faces: int = 0
    area: float = 0.0

    def as_dict(self) -> dict[str, float]:
        """Plain numbers, for JSON."""
        return asdict(self)


def cut_holes(
    before: TriangleMesh,
    before_index: Int[np.ndarray, " N"],
    after: TriangleMesh,
    after_index: Int[np.ndarray, " M"],
) -> list[Int[np.ndarray, " _"]]:
    """The border loops of `after` without a vertex that lay on a border of `before`.

    Loops that a cut has joined with an opening (a cuff, a hem) are openings.

    Args:
        before_index, after_index: the scan's vertex of each, which tells which are the same.
    """
    openings = border_loops(before.faces)
    at_openings = before_index[np.concatenate(openings)] if openings else np.zeros(0, dtype=np.int64)
    return [loop for loop in border_loops(after.faces) if not np.isin(after_index[loop], at_openings).any()]


def darn(
    part: CanonicalPart, holes: list[Int[np.ndarray, " _"]], *, config: DarnConfig | None = None
) -> tuple[CanonicalPart, Darning]:
    """Close holes of a part in the T-pose, where the sides of a cut have drawn apart.

    Nobody saw that cloth: a patch is the least surface over its border (`smplxpp.assemble.patch`), weights and colours
    are harmonic between those of the border. Vertices and faces of the part keep their numbers, new ones follow, with
    -1 for the scan's vertex. Borders that cannot be closed (`patch_loop`) stay open.
    """
    config = config or DarnConfig()
    patches = []
    for loop in holes:
        with suppress(InputError):
            patch = patch_loop(part.mesh, loop)
            if patch.width(part.mesh.vertices[loop]) <= config.width:
                patches.append((loop, patch))
    area = sum(patch.area(part.mesh.vertices[loop]) for loop, patch in patches)
    said = Darning(len(holes), len(patches), sum(len(patch.faces) for _, patch in patches), area)
    for loop, patch in patches:
        part = _with_patch(part, loop, patch)
    return part, said


def _with_patch(part: CanonicalPart, loop: Int[np.ndarray, " L"], patch: Patch) -> CanonicalPart:
    count, new = part.mesh.vertex_count, len(patch.from_rim)
    at = np.concatenate([loop, np.arange(count, count + new)])
    colors = patch.from_rim @ part.vertex_colors[loop]
    return replace(
        part,
        mesh=TriangleMesh(
            np.concatenate([part.mesh.vertices, patch.from_rim @ part.mesh.vertices[loop]]),
            np.concatenate([part.mesh.faces, at[patch.faces]]),
        ),
        weights=_with_rows(
            part.weights, patch.from_rim @ part.weights.dense()[loop], int(part.weights.component[loop[0]])
        ),
        vertex_colors=np.concatenate([part.vertex_colors, colors.round().astype(np.uint8)]),
        scan_index=np.concatenate([part.scan_index, np.full(new, -1)]),
    )


def _with_rows(weights: SkinWeights, rows: np.ndarray, component: int) -> SkinWeights:
    """Skin weights with as many influences, and rows behind those that are there."""
    count = len(rows)
    if not count:
        return weights
    slots = weights.joint_indices.shape[1]
    added = SkinWeights.from_dense(rows, max_influences=slots)
    missing = ((0, 0), (0, slots - added.joint_indices.shape[1]))
    unknown = np.full(count, np.nan)
    return replace(
        weights,
        joint_indices=np.concatenate([weights.joint_indices, np.pad(added.joint_indices, missing)]),
        joint_weights=np.concatenate([weights.joint_weights, np.pad(added.joint_weights, missing)]),
        matched=np.concatenate([weights.matched, np.zeros(count, dtype=bool)]),
        distance=np.concatenate([weights.distance, unknown]),
        angle=np.concatenate([weights.angle, unknown]),
        component=np.concatenate([weights.component, np.full(count, component, dtype=weights.component.dtype)]),
    )
