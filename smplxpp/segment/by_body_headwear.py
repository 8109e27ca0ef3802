"""Find what a person wears on the head and what is no hair: glasses, hats with brims, headphones.

Hair, a beard and a hood stand off the head as well. What tells a thing from them is measured in the frame of the head,
whose body is first moved onto the scan's face alone, because a hat pulls any other fit:

- *glasses*: before both eyes surface stands 6 mm and more off the face, where neither hair nor features are; or a rim
  or lenses rise over the cheeks below both eyes, by distance or colour, in a ring as narrow as no feature is;
- *hats*: above the eyes, before the ears, a plate stands off the head, which has surface above and below it within
  2 cm, both level: a brim, or the peak of a cap. Undersides of buns are farther away, ponytails behind, edges of hoods
  narrow. The crown is what lies above the brim, down to the nearest fold or edge of colour;
- *headphones*: over both ears surface stands 15 mm and more off the head, within borders in folds. Hair over the ears
  goes on smoothly above them and below.

Each gives its faces evidence, in square centimetres, and one minimum cut gives their borders, as in `by_body_objects`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, TriangleMesh, row_lengths
from smplxpp.core.topology import component_labels
from smplxpp.segment.by_body_chart import HEAD, NECK, chart_of_body
from smplxpp.segment.by_body_objects import FoundObjects
from smplxpp.segment.graph_cut import PottsProblem, SmoothingConfig, edge_weights, minimize_potts


@dataclass(frozen=True, eq=False)
class _Around:
    """A scan in the frame of the head, whose origin lies between the eyes.

    Attributes:
        place: to the left, up and to the front, metres.
        normal: of each face.
        off: signed distance of each face to the head, metres.
        near: whether head or neck are nearest to a face.
        eye: distance of either eye from the origin, metres.
        ear: place of the left ear.
        area: of each face, square centimetres.
        rise: by what rims of glasses rise over the face beside them: the distance of each face to the head, a unit for
            1.3 mm, and with colours the distance of its colour to that of the face's skin, a unit for 0.1 in OKLab.
    """

    place: Float64[np.ndarray, "M 3"]
    normal: Float64[np.ndarray, "M 3"]
    off: Float64[np.ndarray, " M"]
    near: Bool[np.ndarray, " M"]
    eye: float
    ear: Float64[np.ndarray, " 3"]
    area: Float64[np.ndarray, " M"]
    rise: Float64[np.ndarray, " M"]


@dataclass(frozen=True)
class _Rises:
    """Rises of rims and lenses over the face about an eye, in units of `_Around.rise`.

    Attributes:
        unit: metres of distance from the face that count as much as 0.1 of colour in OKLab, twice the noise of either.
        rim: of glasses without lenses about both eyes; of 24 bare heads, with a body that misses the face, at most 1.4.
        lens: of lenses about both eyes; of those heads at most 2.3.
        certain: evidence of faces of either, whose borders need no folds, because a thin ring has much border.
    """

    unit: float = 0.0013
    rim: float = 1.6
    lens: float = 3.0
    certain: float = 8.0


def find_headwear(
    mesh: TriangleMesh,
    body: BodyModel,
    params: BodyParams,
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    *,
    lab: Float64[np.ndarray, "M 3"] | None = None,
) -> FoundObjects:
    """Find the faces of glasses, hats with brims and headphones.

    Args:
        mesh: the scan, M faces, metres.
        body: the body model; one without eyes has none of them found.
        params: one frame, in the pose of the scan.
        pairs: faces that share an edge.
        ends: the vertices of these edges.
        lab: colours of the faces in OKLab; None: the cut follows folds alone.
    """
    nothing = FoundObjects.none(mesh.face_count)
    head = _around_head(mesh, body, params, lab)
    if head is None:
        return nothing
    # Evidence of the head without things: what is none of them stays.
    none = -0.5
    evidence, kinds = np.full(mesh.face_count, none), []
    # Square centimetres: thin frames, a short peak with nothing above it, two small cups.
    for kind, least, find in (("glasses", 12.0, _glasses), ("a hat", 60.0, _hat), ("headphones", 60.0, _headphones)):
        own = find(head)
        if own is not None:
            evidence = np.where(own <= -_Rises.certain, own, np.maximum(evidence, own))
            kinds.append((kind, least, own > 0.5))
    if not kinds:
        return nothing
    # One cut; both terms are in square centimetres. A centimetre through smooth, plain surface costs 2 of them.
    folds = SmoothingConfig(smoothness=1.0, floor=0.0, eta_convex=0.0)
    length = 100.0 * row_lengths(mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]])
    bare, cost = (2.0 * length.mean() * edge_weights(mesh, pairs, ends, folds, lab=colors) for colors in (None, lab))
    unary = np.stack([np.zeros(mesh.face_count), -evidence * head.area], axis=1)
    unary -= unary.min(axis=1, keepdims=True)
    cut = minimize_potts(PottsProblem.from_costs(unary, pairs, cost))[0].astype(bool)
    # Pieces of each kind hold some of its own surface, and their borders lie in folds, as the edge of hair does not
    # that differs in colour from a face.
    piece = component_labels(pairs[cut[pairs].all(axis=1)], mesh.face_count)
    border = cut[pairs[:, 0]] != cut[pairs[:, 1]]
    beside = piece[np.where(cut[pairs[border, 0]], pairs[border, 0], pairs[border, 1])]
    count = int(piece.max(initial=0)) + 1
    paid, plain = (np.bincount(beside, value[border], count) for value in (bare, 2.0 * length))
    smooth = 0.6  # mean cost of a border as a share of a smooth one
    cut &= (paid <= smooth * plain)[piece] | np.isin(piece, piece[cut & (evidence >= _Rises.certain)])
    faces, notes = nothing.faces.copy(), []
    for kind, least, core in kinds:
        own = cut & np.isin(piece, piece[cut & core]) & ~faces
        area, left = float(head.area[own].sum()), float(head.area[own & (head.place[:, 0] > 0.0)].sum())
        # All of them are on both sides of the head.
        if area > least and min(left, area - left) > 0.25 * area:
            faces |= own
            notes.append(f"{kind} of {area:.0f} cm2 on the head: labelled object, stiff on it")
    return FoundObjects(faces, tuple(notes))


def _around_head(
    mesh: TriangleMesh, body: BodyModel, params: BodyParams, lab: Float64[np.ndarray, "M 3"] | None = None
) -> _Around | None:
    """Return the scan about the head, moved onto the scan's face; None where there is no face or it fits none.

    Of the scan's faces at x within 4 cm of the face, with nearest vertices v of normals n, the small motion (t, w) of
    the head minimises sum rho(n.(x - v - t - w x (v - c))) with Tukey's weights rho, which leave out what stands off.
    """
    names = list(body.joint_names)
    eyes = [k for k, name in enumerate(names) if "eye" in name]
    if "head" not in names or len(eyes) != 2:
        return None
    frame, own = body.forward(params), chart_of_body(body, params)
    posed, turn = body.mesh(frame.vertices[0]), frame.posed_from_rest[0][names.index("head")][:3, :3]
    vertices, normals = posed.vertices, posed.vertex_normals
    face = (own.region == HEAD) & (np.abs(own.azimuth) < 1.3) & (own.face_height > -0.1) & (own.face_height < 0.72)
    within, weight_of_normals = 0.04, 0.06  # metres
    near = cKDTree(vertices[face]).query(mesh.face_centers, distance_upper_bound=within)[0] < within
    if near.sum() < 50:
        return None
    points, looks, share = mesh.face_centers[near], mesh.face_normals[near], mesh.face_areas[near]
    center, spin, shift = vertices[face].mean(axis=0), np.eye(3), np.zeros(3)
    for k in range(8):
        moved, turned = (vertices[face] - center) @ spin.T + center + shift, normals[face] @ spin.T
        tree = cKDTree(np.concatenate([moved, weight_of_normals * turned], axis=1))
        at = tree.query(np.concatenate([points, weight_of_normals * looks], axis=1))[1]
        left = np.einsum("ij,ij->i", points - moved[at], turned[at])
        # Tukey's weights end at 2 cm, then at 1 cm; what lies 3 cm away is none of the face.
        weight = np.maximum(1.0 - (left / (0.02 if k < 3 else 0.01)) ** 2, 0.0) ** 2 * share
        weight[row_lengths(points - moved[at]) > 0.03] = 0.0
        rows = np.concatenate([turned[at], np.cross(moved[at] - center, turned[at])], axis=1)
        weight /= max(float(weight.sum()), 1e-12)
        # Little of the face may be seen: 5 mm and 4 degrees are usual, a thousandth of the face's own say.
        usual = 1e-6 * np.diag([0.005**-2] * 3 + [np.radians(4.0) ** -2] * 3)
        motion = np.linalg.solve((rows * weight[:, None]).T @ rows + usual, (rows * weight[:, None]).T @ left)
        step = _rotation(motion[3:])
        spin, shift = step @ spin, step @ shift + motion[:3]
    if 1e3 * float(np.sqrt(weight @ left**2)) > 6.0:
        return None
    vertices = (vertices - center) @ spin.T + center + shift
    turn = spin @ turn
    part = np.asarray(body.weights).argmax(axis=1)
    one, other = (vertices[part == k].mean(axis=0) for k in eyes)
    head = np.flatnonzero(np.isin(own.region, (HEAD, NECK)))
    middle = 0.5 * (one + other)
    distance, at = cKDTree(vertices).query(mesh.face_centers)
    along = np.einsum("ij,ij->i", mesh.face_centers - vertices[at], (normals @ spin.T)[at])
    local = (vertices[head] - middle) @ turn
    skull = local[own.region[head] == HEAD]
    off = np.where(distance < 0.02, along, np.copysign(distance, along))
    rise = off / _Rises.unit
    if lab is not None:
        rise = rise + row_lengths(lab - np.median(lab[near], axis=0)) / 0.1
    return _Around(
        (mesh.face_centers - middle) @ turn,
        mesh.face_normals @ turn,
        off,
        np.isin(own.region[at], (HEAD, NECK)),
        0.5 * float(np.linalg.norm(one - other)),
        skull[skull[:, 0].argmax()],
        1e4 * mesh.face_areas,
        rise,
    )


def _rotation(turn: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation nearest to the small turn I + [w]x + [w]x^2 / 2."""
    x, y, z = turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    u, _, v = np.linalg.svd(np.eye(3) + cross + 0.5 * cross @ cross)
    return np.asarray(u @ v)


def _glasses(head: _Around) -> Float64[np.ndarray, " M"] | None:
    """Return evidence of glasses; None where neither lens nor frame is before both eyes."""
    left, up, front = head.place.T
    stands = 0.006  # metres off the face; of bare faces a hundredth about either eye is as far off
    enough = 0.12  # share of the surface about an eye, which frames without lenses have, too
    shares, certain = [], np.zeros(len(left), dtype=bool)
    for sign in (1.0, -1.0):
        eye = (np.abs(left - sign * head.eye) < 0.028) & (np.abs(up) < 0.024) & (front > 0) & (head.normal[:, 2] > 0.2)
        shares.append(head.area[eye & (head.off > stands)].sum() / max(float(head.area[eye].sum()), 1e-9))
    for lens, least in ((False, _Rises.rim), (True, _Rises.lens)):
        found = [_about_eye(head, sign, lens=lens) for sign in (1.0, -1.0)]
        if min(rise for rise, _ in found) > least:
            certain[np.concatenate([faces for _, faces in found])] = True
    if min(shares) < enough and not certain.any():
        return None
    # Before the eyes, and as far beside them as a frame is wide, all that stands off; behind, the temples, which are
    # thin, up to the ears.
    before = (front > 0.0) & (np.abs(left) < 0.08) & (np.abs(up) < np.interp(np.abs(left), (0.05, 0.06), (0.04, 0.025)))
    out = np.where(before, np.interp(head.off, (0.003, 0.005, 0.008), (-1.0, 0.0, 1.0)), -0.5)
    if certain.any():
        # Skin behind no lens and beside a frame is none of them.
        out[(head.off < 0.003) & (front > -0.03) & (np.abs(left) < 0.08) & (np.abs(up) < 0.05)] = -_Rises.certain
        out[certain] = _Rises.certain
    beside = (front <= 0.005) & (front > head.ear[2] + 0.005) & (np.abs(left) > 0.05) & (np.abs(up - 0.005) < 0.035)
    rows = np.flatnonzero(beside & head.near)
    out[rows] = _ridge(head, rows, axis=1)
    return out


def _about_eye(head: _Around, sign: float, *, lens: bool) -> tuple[float, Int64[np.ndarray, " F"]]:
    """Return how far a rim or a lens about an eye rises over the skin beside it, and the faces of it.

    On rays from the eye the largest rise counts: of a rim over what is inside and outside of it (`_Around.rise`), of a
    lens over what is outside, in distance alone, because eyes differ from skin in colour. From below the nose's side
    round to the temple bare faces have neither brows nor narrow folds; glasses rise on most of these rays, so that
    their median is returned. Other rays only tell where the border is.
    """
    across, up, front = sign * head.place[:, 0] - head.eye, head.place[:, 1], head.place[:, 2]
    own = np.flatnonzero(head.near & (front > -0.035) & (np.abs(head.off) < 0.02) & (np.hypot(across, up) < 0.055))
    place, weight = np.stack([across[own], up[own]], axis=1), head.area[own]
    values = head.off[own] / _Rises.unit if lens else head.rise[own]
    angles, radius = np.radians(np.arange(-170.0, 171.0, 20.0)), np.arange(0.002, 0.050, 0.002)  # metres
    # By ray and radius: the rise there, and the value at half of it.
    rises, levels = np.zeros((2, len(angles), len(radius)))
    for n, angle in enumerate(angles):
        ray = np.array([np.cos(angle), np.sin(angle)])
        near = np.abs(place @ [-ray[1], ray[0]]) < 0.006
        # The mean of the faces about a place on the ray, with a spread of 2.5 mm; nothing where there is no face.
        share = np.exp(-0.5 * ((radius[:, None] - place[near] @ ray) / 0.0025) ** 2) * weight[near]
        total = share.sum(axis=1)
        mean = np.where(total > 1e-3, share @ values[near] / np.maximum(total, 1e-3), np.nan)
        for k in np.flatnonzero((radius >= 0.016) & (radius <= 0.036)):
            # The lowest from 6 to 12 mm farther out and in.
            sides = (mean[k + 3 : k + 7], *(() if lens else (mean[k - 6 : k - 2],)))
            if not any(np.isnan(side).all() for side in (mean[k : k + 1], *sides)):
                rises[n, k] = max(0.0, float(mean[k] - max(np.nanmin(side) for side in sides)))
                levels[n, k] = mean[k] - 0.5 * rises[n, k]
    # The ring of most rise in all whose radius changes by at most 4 mm from ray to ray, by dynamic programming.
    steps = np.array([np.roll(np.arange(len(radius)), step) for step in (-2, -1, 0, 1, 2)])
    most, came = rises[0], []
    for rise in rises[1:]:
        came.append(steps[most[steps].argmax(axis=0), np.arange(len(radius))])
        most = rise + most[steps].max(axis=0)
    ring = [int(most.argmax())]
    for back in reversed(came):
        ring.insert(0, int(back[ring[0]]))
    found, at = rises[np.arange(len(angles)), ring], np.array(ring)
    rise = float(np.median(found[(angles > np.radians(-160.0)) & (angles < np.radians(40.0))]))
    kept = found > 0.5 * rise
    if kept.sum() < 0.5 * len(kept):
        return 0.0, own[:0]
    # Of the faces there, those that rise by half of it, as skin behind a frame does not.
    turn = np.arctan2(place[:, 1], place[:, 0])
    of_rays = (radius[at], levels[np.arange(len(angles)), at])
    border, level = (np.interp(turn, angles[kept], of[kept], period=2.0 * np.pi) for of in of_rays)
    outwards = np.hypot(*place.T) - border
    there = outwards < 0.003 if lens else np.abs(outwards) < 0.005
    return rise, own[there & (values > level)]


def _ridge(head: _Around, rows: Int64[np.ndarray, " R"], *, axis: int) -> Float64[np.ndarray, " R"]:
    """Return evidence of a thin bar on the head: how far faces stand off it beyond what lies beside them on an axis.

    Beside a face are those 13 to 32 mm from it to either side; hair over which a bar goes stands as far off there.
    """
    out = np.full(len(rows), -0.5)
    if not len(rows):
        return out
    # One face in each cell of 4 mm, so that fine meshes take no longer.
    pool, own = (
        at[np.unique(np.floor(head.place[at] / 0.004), axis=0, return_index=True)[1]]
        for at in (np.flatnonzero(head.near), rows)
    )
    place, evidence = head.place[own], np.full(len(own), -0.5)
    for k, near in enumerate(cKDTree(head.place[pool]).query_ball_point(place, 0.035)):
        step = head.place[pool[near], axis] - place[k, axis]
        off = head.off[pool[near]]
        sides = [off[(sign * step > 0.013) & (sign * step < 0.032)] for sign in (1.0, -1.0)]
        # Hair over a skull that the scan shows, too, is the outer half of what is beside.
        level = max((_upper_quartile(side) for side in sides if len(side)), default=np.inf)
        evidence[k] = np.interp(head.off[own[k]] - level, (0.001, 0.003, 0.006), (-0.5, 0.0, 1.0))
    return np.asarray(evidence[cKDTree(place).query(head.place[rows])[1]])


def _upper_quartile(values: Float64[np.ndarray, " n"]) -> float:
    """Return the 0.75 quantile of some values: that of `np.quantile`, which takes five times as long for a few."""
    values = np.sort(values)
    at = 0.75 * (len(values) - 1)
    below, share = int(at), at - int(at)
    low, high = float(values[below]), float(values[min(below + 1, len(values) - 1)])
    return low + (high - low) * share if share < 0.5 else high - (high - low) * (1.0 - share)


def _hat(head: _Around) -> Float64[np.ndarray, " M"] | None:
    """Return evidence of a hat; None where no brim stands off the head above the eyes."""
    left, up, front = head.place.T
    off, thin, level, reach = 0.025, 0.02, 0.6, 0.055  # metres; cosine to the vertical; metres
    may = head.near & (head.off > off) & (up > -0.01)
    above, below = (np.flatnonzero(may & (sign * head.normal[:, 1] > level)) for sign in (1.0, -1.0))
    if not (len(above) and len(below)):
        return None
    brim = np.zeros(len(up), dtype=bool)
    for own, other in ((above, below), (below, above)):
        brim[own] = cKDTree(head.place[other]).query(head.place[own])[0] < thin
    upper = brim & (head.normal[:, 1] > 0)
    # Before the ears at least as much as a short peak, as no ponytail has, and farther off than the edge of a hood.
    if (
        head.area[upper & (front > head.ear[2] + 0.02)].sum() < 25.0
        or head.area[upper & (head.off > reach)].sum() < 10.0
    ):
        return None
    # The band is where the brim meets the crown. A brim all round tells how the hat is tilted, a peak does not.
    place = head.place[upper & (head.off < reach)] if (upper & (head.off < reach)).any() else head.place[upper]
    around = np.unique(np.floor(np.arctan2(left[upper], front[upper] - head.ear[2]) / (np.pi / 6.0)))
    tilt = np.array([0.0, 1.0, 0.0])
    if len(around) >= 8:
        tilt = head.normal[upper].T @ head.area[upper]
        tilt /= np.linalg.norm(tilt)
    height = head.place @ tilt - float(np.median(place @ tilt))
    out = np.where(head.near & (head.off > -0.01), np.interp(height, (-0.045, -0.02, 0.01), (-0.5, 0.0, 1.0)), -0.5)
    out[brim] = 1.0
    return out


def _headphones(head: _Around) -> Float64[np.ndarray, " M"] | None:
    """Return evidence of headphones; None where no surface stands off both ears."""
    out = np.full(len(head.off), -0.5)
    stands, radius = 0.015, 0.055  # metres
    for sign in (1.0, -1.0):
        across = np.hypot(head.place[:, 1] - head.ear[1], head.place[:, 2] - head.ear[2])
        own = head.near & (sign * head.place[:, 0] > head.ear[0] - 0.03) & (across < radius)
        evidence = np.interp(head.off[own], (0.005, stands, 0.025), (-0.5, 0.0, 1.0))
        if (evidence > 0.5) @ head.area[own] < 25.0:
            return None
        out[own] = evidence
    # The band over the top of the head.
    beside = head.place - head.ear
    rows = np.flatnonzero(head.near & (np.abs(beside[:, 2]) < 0.045) & (beside[:, 1] > 0.03) & (head.off > 0.004))
    out[rows] = np.maximum(out[rows], _ridge(head, rows, axis=2))
    return out
