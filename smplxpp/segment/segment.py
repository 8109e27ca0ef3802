"""Label a scan from votes or given labels by minimising a Potts energy along its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64, Num
from scipy.sparse import csr_matrix, identity

from smplxpp.core import BACKGROUND, LABELS, OUTER, SKIN, UPPER, InputError, Labels, MeshLike, TriangleMesh, as_mesh
from smplxpp.core.errors import one_line
from smplxpp.core.topology import face_adjacency
from smplxpp.segment.graph_cut import (
    COST_SCALE,
    PottsProblem,
    SmoothingConfig,
    absorb_islands,
    edge_weights,
    face_colors,
    minimize_potts,
)

_CERTAIN_PRIOR = 0.6  # confidence from which a prior's label counts as known


@dataclass(frozen=True)
class SegmentConfig(SmoothingConfig):
    """Options of `segment_scan`, beside those of smoothing.

    Attributes:
        pseudo_votes: votes added to every label, so that no probability is zero.
        full_votes: sum of votes from which a face is trusted fully.
        rings: rings of neighbours whose votes count for a face's confidence if its own are fewer. A pixel is often
            larger than a face, so that its vote falls on one face of several.
        label_trust: weight of the labels given with the scan, as a share of full votes.
        underside: cost, over sqrt(M), of any label but skin for a face without a vote that looks down (+Y is up). A
            scan closes a skirt from below; that surface is no cloth.
        prior_weight: weight of a prior where votes are certain, as a share of its weight where there are none.
    """

    pseudo_votes: float = 0.1
    full_votes: float = 3.0
    rings: int = 4
    label_trust: float = 0.75
    underside: float = 6.0
    prior_weight: float = 0.1


@dataclass(frozen=True, eq=False)
class SegmentedScan:
    """Labels of a scan's faces with their confidence.

    Attributes:
        face_labels: (M,) int64 label ids.
        confidence: (M,) in [0, 1]: the label's share of the votes, times their sum relative to full trust. Faces with
            fewer votes count those of their neighbours. 0 where no vote is near.
        seen: (M,) bool: whether a vote fell on the face.
        island_faces: number of faces relabelled because their patch was too small.
        energy_before: energy of the cheapest label of every face.
        energy_after: energy after the graph cut.
        corrected: (M,) bool: whether the label was set by hand (`Corrections.apply`); None without corrections.
        notes: remarks on uncertain labels; empty where labels were given, or votes cover the surface.
    """

    face_labels: Int64[np.ndarray, " M"]
    confidence: Float64[np.ndarray, " M"]
    seen: Bool[np.ndarray, " M"]
    island_faces: int
    energy_before: float
    energy_after: float
    corrected: Bool[np.ndarray, " M"] | None = None
    notes: tuple[str, ...] = ()

    __repr__ = one_line


def segment_scan(
    mesh: MeshLike,
    *,
    votes: Num[np.ndarray, "M L"] | None = None,
    vertex_labels: Num[np.ndarray, " N"] | None = None,
    face_labels: Num[np.ndarray, " M"] | None = None,
    colors: Num[np.ndarray, "N C"] | None = None,
    prior: SegmentedScan | None = None,
    config: SegmentConfig | None = None,
    labels: Labels = LABELS,
) -> SegmentedScan:
    """Label every face of a scan from one of: votes, labels of its vertices, labels of its faces.

    Minimises `sum_i U_i(l_i) + sum_(i,j) w_ij [l_i != l_j]` by alpha-expansion, with
    `U = -log p min(sum of votes, 3) / 3` and
    `w = 1.2 (edge length / mean) exp(-eta (1 - cos dihedral) / 0.1) + 0.05`, eta 0.15 at convex edges and 1 at concave
    ones, so that seams settle in folds. Labels given are three votes a face (one a corner), weighted by
    `label_trust`; -1 is no vote.

    Args:
        mesh: the scan.
        votes: (M, L) of `vote_on_faces`, in our ids.
        vertex_labels: (N,), in our ids.
        face_labels: (M,), in our ids.
        colors: sRGB of the vertices, bytes or 0..1; borders then settle on edges of colour, too.
        prior: labels of the same mesh by `label_by_body`, used where votes are few. Its labels are translated to what
            the votes call them where both exist: of a dress that views call a lower garment, the rest becomes lower,
            too.
        config: options.
        labels: what the ids stand for.

    Raises:
        InputError: none or several of the three, other lengths, unknown ids, or not a single label.
    """
    mesh = as_mesh(mesh, subject="mesh")
    config = config or SegmentConfig()
    given = {"votes": votes, "vertex_labels": vertex_labels, "face_labels": face_labels}
    present = [name for name, value in given.items() if value is not None]
    if len(present) != 1:
        raise InputError("segment_scan", expected=f"one of {', '.join(given)}", received=", ".join(present) or "none")
    trust = 1.0
    if votes is None:
        votes, trust = _votes_of_labels(mesh, vertex_labels, face_labels, len(labels)), config.label_trust
    votes = np.asarray(votes, dtype=np.float64)
    if votes.shape != (mesh.face_count, len(labels)) or not np.isfinite(votes).all() or (votes < 0).any():
        raise InputError(
            "votes",
            expected=f"finite, none negative, shape ({mesh.face_count}, {len(labels)})",
            received=f"shape {votes.shape}" if votes.ndim == 2 else f"{votes.ndim} dimensions",
        )
    if not votes.any():
        raise InputError("labels", expected="at least one labelled face", received="none")

    # The prior is translated into the votes' terms.
    likely = None
    if prior is not None:
        _check_prior(mesh, prior)
        votes = _votes_with_outer(votes, prior, labels)
        likely = _prior_as_voted(prior, votes, mesh.face_areas)
    lab = None if colors is None else face_colors(mesh, colors)
    total = votes.sum(axis=1)
    share = (votes + config.pseudo_votes) / (total + config.pseudo_votes * len(labels))[:, None]
    certainty = np.minimum(total, config.full_votes) / config.full_votes
    pairs, ends = face_adjacency(mesh.faces)
    weights = edge_weights(mesh, pairs, ends, config, lab=lab)
    # Unary costs: -log of the vote share, weighted by certainty, and the prior where votes are few. A label without any
    # vote cannot win unless the prior knows it.
    candidates = np.flatnonzero(votes.any(axis=0) | _known_to(likely))
    unary = -np.log(share) * (trust * certainty)[:, None]
    if likely is not None:
        unary += (1.0 - (1.0 - config.prior_weight) * certainty)[:, None] * -np.log(likely)
    below = (total == 0) & (mesh.face_normals[:, 1] < -0.3)  # a normal more than 17 degrees below the horizon
    # Borders have about sqrt(faces) edges; dividing by it cuts a finer scan in the same place.
    unary[below] += config.underside / np.sqrt(mesh.face_count) * (labels.kinds != SKIN.id)
    unary = unary[:, candidates]
    # Minimise the energy by graph cuts, and relabel patches that are too small.
    problem = PottsProblem.from_costs(unary, pairs, weights)
    before = problem.energy(unary.argmin(axis=1))
    index, after = minimize_potts(problem)
    cut = candidates[index]
    found = absorb_islands(mesh, cut, _confidence(votes, cut, pairs, config), pairs, ends, config, labels=labels)
    confidence = _confidence(votes, found, pairs, config)
    if likely is not None:
        confidence = np.where(total > 0, confidence, likely[np.arange(len(found)), found])
    return SegmentedScan(
        found,
        confidence,
        total > 0,
        int((found != cut).sum()),
        before / COST_SCALE,
        after / COST_SCALE,
        # The prior's notes hold for the labels if 5 % of the area and more have no vote.
        notes=() if prior is None or _left_to_prior(mesh, total) < 0.05 else prior.notes,
    )


def _check_prior(mesh: TriangleMesh, prior: SegmentedScan) -> None:
    if len(prior.face_labels) != mesh.face_count:
        raise InputError(
            "prior", expected=f"labels of the scan's {mesh.face_count} faces", received=f"{len(prior.face_labels)}"
        )


def _left_to_prior(mesh: TriangleMesh, votes: np.ndarray) -> float:
    """Return the share of the area without a vote."""
    return float(mesh.face_areas @ (votes == 0) / mesh.face_areas.sum())


def _known_to(likely: np.ndarray | None) -> Bool[np.ndarray, " L"]:
    """Return the labels that a prior is certain of somewhere."""
    if likely is None:
        return np.zeros(1, dtype=bool)
    return np.asarray((likely > _CERTAIN_PRIOR).any(axis=0))


def _prior_as_voted(
    prior: SegmentedScan, votes: Float64[np.ndarray, "M L"], area: Float64[np.ndarray, " M"]
) -> Float64[np.ndarray, "M L"]:
    """Return P(label) of every face; the prior's confidence goes to the voted label of faces that it labels alike."""
    own, rows = prior.face_labels, np.arange(len(area))
    # How votes translate each label of the prior. Its own word counts as votes on 1 % of the area; ties agree with it.
    called = np.where(votes[rows, own] >= votes.max(axis=1), own, votes.argmax(axis=1))
    voted = votes.any(axis=1)
    count = votes.shape[1]
    meaning = 0.01 * area.sum() * np.eye(count)
    np.add.at(meaning, (own[voted], called[voted]), area[voted])
    meaning /= meaning.sum(axis=1, keepdims=True)
    # Labels with more than 15 % of the votes are equal meanings, because the prior does not tell them apart.
    alike = meaning > 0.15
    meaning = np.where(alike, (meaning * alike).sum(axis=1, keepdims=True) / alike.sum(axis=1, keepdims=True), meaning)
    share = np.clip(prior.confidence, 1.0 / count, 0.99)[:, None]
    rest = (1.0 - share) / (count - 1)
    return rest + (share - rest) * meaning[own]


def _votes_with_outer(votes: np.ndarray, prior: SegmentedScan, labels: Labels) -> np.ndarray:
    """Copy the votes of upper to outer clothes if votes never name these and the prior does.

    Such a label set may not distinguish coats from shirts; the prior decides between the two.
    """
    outer = labels.kinds == OUTER.id
    certain = outer[prior.face_labels] & (prior.confidence > _CERTAIN_PRIOR)
    if votes[:, outer].any() or not certain.any():
        return votes
    votes = votes.copy()
    votes[:, prior.face_labels[certain][0]] = votes[:, labels.kinds == UPPER.id].max(axis=1)
    return votes


def _confidence(
    votes: Float64[np.ndarray, "M L"], labels: Int64[np.ndarray, " M"], pairs: np.ndarray, config: SegmentConfig
) -> Float64[np.ndarray, " M"]:
    """Return the share of votes for each face's label, over as many rings around it as full trust needs."""
    own = np.stack([votes.sum(axis=1), votes[np.arange(len(labels)), labels]], axis=1)
    few = np.flatnonzero(own[:, 0] < config.full_votes)
    ones = np.ones(len(pairs), dtype=np.int8)
    touching = csr_matrix((ones, pairs.T), shape=(len(labels),) * 2)
    near = touching + touching.T + identity(len(labels), dtype=np.int8, format="csr")
    reached = near[few]
    for _ in range(config.rings):
        if not len(few):
            break
        reached.data[:] = 1
        total = np.asarray(reached @ votes.sum(axis=1))
        own[few] = np.stack([total, (reached @ votes)[np.arange(len(few)), labels[few]]], axis=1)
        left = total < config.full_votes
        few, reached = few[left], reached[left] @ near
    total, agreeing = own.T
    certainty = np.minimum(total, config.full_votes) / config.full_votes
    return np.where(total > 0, agreeing / np.maximum(total, 1e-300), 0.0) * certainty


def _votes_of_labels(
    mesh: TriangleMesh, vertex_labels: np.ndarray | None, face_labels: np.ndarray | None, label_count: int
) -> np.ndarray:
    """Return (M, L) votes of given labels: three a face, fewer where corners are unlabelled."""
    name, labels, count = (
        ("vertex labels", vertex_labels, mesh.vertex_count)
        if face_labels is None
        else ("face labels", face_labels, mesh.face_count)
    )
    labels = np.asarray(labels)
    if labels.shape != (count,):
        raise InputError(name, expected=f"shape ({count},)", received=f"shape {labels.shape}")
    known = (labels >= BACKGROUND) & (labels < label_count)
    if labels.dtype.kind not in "iu" or not known.all():
        raise InputError(
            name,
            expected=f"integers from -1 to {label_count - 1}",
            received=f"{labels.dtype}, {int((~known).sum())} values out of range",
            remedy="map them with map_labels first",
        )
    corner = labels[mesh.faces] if face_labels is None else np.repeat(labels[:, None], 3, axis=1)
    face, _ = np.nonzero(corner >= 0)
    slot = face * label_count + corner[corner >= 0]
    return np.bincount(slot, minlength=mesh.face_count * label_count).reshape(-1, label_count).astype(np.float64)
