"""Label maps that contradict the other views' are left out: a parser now and then takes a whole picture for another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Integer
from scipy.sparse import csr_matrix

from smplxpp.core.camera import Camera
from smplxpp.core.labels import LABELS
from smplxpp.core.mesh import TriangleMesh
from smplxpp.segment.votes import require_votes, votes_of_view

# A map whose votes the other views share by less is doubted; without it they must agree by so much.
_DOUBTED, _AGREED = 0.5, 0.75
# At most one of so many views is left out: beyond it nobody knows who errs.
_ONE_OF = 3


@dataclass(frozen=True, eq=False)
class AgreedVotes:
    """Votes of the views that agree.

    Attributes:
        votes: as of `vote_on_faces`, of the views that are kept.
        left_out: the others by name, each with the share of its votes that the rest agreed with.
    """

    votes: Float64[np.ndarray, "M L"]
    left_out: Mapping[str, float]


def vote_in_agreement(mesh: TriangleMesh, views: Sequence[tuple[Camera, Integer[np.ndarray, "_ _"]]]) -> AgreedVotes:
    """Votes as of `vote_on_faces`, without maps that the other views contradict.

    A view agrees on a face where it calls it what the sum of all others does. Of the views that agree on less than half
    of what others see too, the one goes whose absence makes the rest agree most, if they then agree on 75 %; and so
    on, while at most a third of the views is gone. Two views that contradict each other are both kept.

    Raises:
        InputError: as `vote_on_faces` does.
    """
    # Sparse: a view sees a part of the faces, and a studio has a hundred views.
    each = [csr_matrix(votes_of_view(mesh, camera, labels)) for camera, labels in views]
    require_votes(any(votes.nnz for votes in each))
    kept = [k for k, votes in enumerate(each) if votes.nnz]
    left_out: dict[str, float] = {}
    for _ in range(len(kept) // _ONE_OF):
        shared, agreed = _shares([each[k] for k in kept])
        doubted = [i for i in range(len(kept)) if shared[i] > 0 and agreed[i] < _DOUBTED * shared[i]]
        rests = {i: _mean_agreement([each[k] for k in kept if k != kept[i]]) for i in doubted}
        if not rests or max(rests.values()) < _AGREED:
            break
        worst = max(rests, key=lambda i: rests[i])
        left_out[views[kept[worst]][0].name or f"view {kept[worst]}"] = float(agreed[worst] / shared[worst])
        kept.pop(worst)
    votes = np.asarray(sum(each[k] for k in kept).todense())
    return AgreedVotes(votes.reshape(mesh.face_count, len(LABELS)), left_out)


def _shares(each: Sequence[csr_matrix]) -> tuple[np.ndarray, np.ndarray]:
    """Votes of every view on faces that another sees, and those of them that the others' sum agrees with."""
    total = np.asarray(sum(each).todense())
    shared, agreed = np.zeros(len(each)), np.zeros(len(each))
    for k, votes in enumerate(each):
        face = np.flatnonzero(np.diff(votes.indptr))
        own = votes[face].toarray()
        # Sums of floats leave crumbs of what was taken away.
        others = np.where(total[face] - own > 1e-9 * total[face], total[face] - own, 0.0)
        seen = others.any(axis=1)
        shared[k] = own[seen].sum()
        agreed[k] = own[seen, others[seen].argmax(axis=1)].sum()
    return shared, agreed


def _mean_agreement(each: Sequence[csr_matrix]) -> float:
    """Share of all views' votes that the others agree with; 0 where no face is seen twice."""
    shared, agreed = _shares(each)
    return float(agreed.sum() / shared.sum()) if shared.any() else 0.0
