"""Sample Gaussians on a template: their density, size and initial colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from avatar.gaussians.binding import BoundGaussians, topology_digest
from avatar.gaussians.frames import MIN_EDGE
from smplxpp.cloth.cloth_mesh import find_opening_bridges
from smplxpp.core import TriangleMesh, require_at_least, require_between, require_choice, require_positive, row_lengths
from smplxpp.core.errors import InputError
from smplxpp.core.spherical_harmonics import coefficient_count
from smplxpp.raster import outer_visible_faces
from smplxpp.template.template import Template


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Number, density and initial attributes of the Gaussians.

    Attributes:
        count: total number of Gaussians.
        head_share: share of them on the head, by default TaoAvatar's 70k of 270k; None treats the head like the rest.
        spread_by: "area" for a uniform density, or "face" for the same number in every triangle (exactly k if `count`
            is k times the number of faces and neither head nor hidden faces are treated separately).
        hidden_density: density on faces invisible from outside in the T-pose, relative to visible ones. 0 leaves them
            bare; they need some, because motion uncovers legs under a skirt, and teeth.
        touch: initial standard deviation relative to the distance of neighbours.
        opacity: initial opacity.
        sh_degree: degree of the spherical harmonics, 0 to 3; the coefficients start at 0.
        seed: of all random draws.
    """

    count: int = 220_000
    head_share: float | None = 70 / 270
    spread_by: Literal["area", "face"] = "area"
    hidden_density: float = 0.25
    touch: float = 0.6
    opacity: float = 0.9
    sh_degree: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        coefficient_count(self.sh_degree)
        require_at_least("sampling: count", self.count, 1)
        if self.head_share is not None:
            require_between("sampling: head_share", self.head_share, 0.0, 1.0)
        require_choice("sampling: spread_by", self.spread_by, ("area", "face"))
        require_between("sampling: hidden_density", self.hidden_density, 0.0, 1.0)
        require_positive("sampling: touch", self.touch)
        if not 0.0 < self.opacity < 1.0:
            raise InputError("sampling: opacity", expected="a number inside (0, 1)", received=repr(self.opacity))


def sample_on_mesh(
    template: Template,
    config: SamplingConfig | None = None,
    *,
    density: Float[np.ndarray, " F"] | None = None,
) -> BoundGaussians:
    """Sample flat Gaussians, float32, on the faces of a template, with its colours.

    Every region (head, rest) gets its count in proportion to area or faces, hidden faces less, and faces that close an
    opening of the clothes none, because they are not cloth and would float when it swings. Samples are stratified
    along the faces' order and follow a low-discrepancy sequence inside each face. Tangential scales start at
    `touch / sqrt(density)`, so that neighbours overlap.

    Args:
        template: the clothed body.
        config: how many, where and how large.
        density: positive factors of each face's density relative to the others of its region; None: all 1.

    Raises:
        InputError: a share for the head of a body that has no joint "head", a region without a face to sample, or
            densities that are not one positive number a face.
    """
    config = config or SamplingConfig()
    mesh = template.mesh
    # Relative density of every face.
    weights = mesh.face_areas * 1.0 if config.spread_by == "area" else (mesh.face_areas > 0).astype(float)
    if density is not None:
        weights *= _positive(density, mesh.face_count)
    weights[find_opening_bridges(template)] = 0.0
    head = np.zeros(mesh.face_count, dtype=bool) if config.head_share is None else head_faces(template)
    if config.hidden_density < 1.0:
        weights *= np.where(seen_faces(mesh), 1.0, config.hidden_density)
    # Each region gets its count of samples; `expected` is their mean number a face.
    on_head = round(config.count * (config.head_share or 0.0))
    rng = np.random.Generator(np.random.PCG64(config.seed))
    expected = np.zeros(mesh.face_count)
    regions = []
    for name, region, count in (("rest", ~head, config.count - on_head), ("head", head, on_head)):
        if not count:
            continue
        inside = np.where(region, weights, 0.0)
        if not inside.any():
            raise InputError(
                f"sampling: {name}", expected="faces with some area", received="none", remedy="change head_share"
            )
        # Faces of the other region have weight 0 and get no sample.
        regions.append(_stratified(inside, count, rng))
        expected += inside * (count / inside.sum())
    face, barycentric = (np.concatenate(arrays) for arrays in zip(*regions, strict=True))
    # Gaussians in the order of faces; their size follows from the density, samples a square metre.
    order = np.argsort(face, kind="stable")
    each = np.divide(expected, mesh.face_areas, out=np.zeros_like(expected), where=expected > 0)
    return _initial_gaussians(template, face[order], barycentric[order], each, config)


def _positive(density: Float[np.ndarray, " F"], count: int) -> Float[np.ndarray, " F"]:
    if density.shape != (count,) or not (np.isfinite(density) & (density > 0)).all():
        received = f"shape {density.shape}, from {density.min(initial=np.inf):g} to {density.max(initial=-np.inf):g}"
        raise InputError("sampling: density", expected=f"{count} finite numbers above 0", received=received)
    return density


def head_faces(template: Template) -> Bool[np.ndarray, " F"]:
    """Return a mask of the faces with more than half their weight on the joint "head" and its children (jaw, eyes).

    Raises:
        InputError: no joint of that name.
    """
    if "head" not in template.body.joint_names:
        raise InputError(
            "template joints",
            expected="one named 'head', to give the head its share",
            received=f"{len(template.body.joint_names)} other names",
            remedy="set head_share to None",
        )
    # All descendants of the head: a pass over the joints adds one more generation, so joint_count passes reach every
    # depth of the tree. The root has the parent -1.
    head = template.body.joint_names.index("head")
    subtree = np.zeros(template.body.joint_count, dtype=bool)
    subtree[head] = True
    for _ in range(template.body.joint_count):
        subtree |= np.where(template.body.parents >= 0, subtree[template.body.parents], False)
    # Skinning weight of the subtree at each vertex (V,), then its mean over the corners of each face.
    weight = template.weights.dense()[:, subtree].sum(1)
    return weight[template.faces].mean(1) > 0.5


def seen_faces(mesh: TriangleMesh) -> Bool[np.ndarray, " F"]:
    """Return a mask of the faces visible from outside, and their neighbours, because small faces may cover no pixel."""
    # Faces that share a corner with a visible one count as visible.
    touched = np.zeros(mesh.vertex_count, dtype=bool)
    touched[mesh.faces[outer_visible_faces(mesh)]] = True
    return touched[mesh.faces].any(1)


def _stratified(weights: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw (count,) faces in proportion to `weights`, and (count, 2) barycentric u, v uniform inside them."""
    # One random number in each of `count` equal strata of the total weight; the face whose interval contains it is
    # hit.
    cumulative = np.cumsum(weights)
    share = (np.arange(count) + rng.random(count)) * (cumulative[-1] / count)
    face = np.searchsorted(cumulative, share, side="right")
    # A share that rounds up to the whole sum would fall after the last face with a weight.
    face = np.minimum(face, np.flatnonzero(weights)[-1])
    # The position of a share within its face's interval is uniform, and stratified over the samples of the face.
    across = np.clip((share - (cumulative - weights)[face]) / weights[face], 0.0, 1.0)
    # A Kronecker sequence with the golden ratio keeps consecutive points of a face apart.
    golden = (5.0**0.5 - 1.0) / 2.0
    along = (rng.random() + golden * np.arange(count)) % 1.0
    # Uniform on a triangle (Osada et al. 2002).
    root = np.sqrt(across)
    return face, np.stack([1.0 - root, root * (1.0 - along)], axis=1)


def _initial_gaussians(
    template: Template, face: np.ndarray, barycentric: np.ndarray, density: np.ndarray, config: SamplingConfig
) -> BoundGaussians:
    # Mean edge length of each face, metres, clamped as in `triangle_frames`.
    corners = template.mesh.triangles
    edges = np.maximum(sum(row_lengths(corners[:, k] - corners[:, k - 1]) for k in range(3)) / 3.0, MIN_EDGE)
    # Samples of density d are about 1 / sqrt(d) metres apart; scales are stored in edges of the face.
    scale = config.touch / (np.sqrt(density[face]) * edges[face])
    # Colours in [0, 1], interpolated from the 8-bit colours of the corners.
    weights = np.column_stack([barycentric, 1.0 - barycentric.sum(1)])
    colors = np.einsum("nk,nkc->nc", weights, template.vertex_colors[template.faces[face]] / 255.0)
    N = len(face)

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.tensor(array, dtype=torch.float32)

    return BoundGaussians(
        face_index=torch.tensor(face),
        barycentric=tensor(barycentric),
        normal_offset=torch.zeros(N),
        offset=torch.zeros(N, 3),
        log_scales=tensor(np.log(scale))[:, None].repeat(1, 2),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(N, 1),
        opacity_logits=torch.full((N,), float(np.log(config.opacity / (1.0 - config.opacity)))),
        dc=tensor(colors),
        sh=torch.zeros(N, coefficient_count(config.sh_degree), 3),
        face_count=template.mesh.face_count,
        topology=topology_digest(template.faces),
    )
