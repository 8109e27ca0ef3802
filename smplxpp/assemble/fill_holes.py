"""Fill the holes that cut bridges (`smplxpp.clean.bridges`) left in a part, in the T-pose, where sides are apart."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from smplxpp.assemble.build import CanonicalPart
from smplxpp.assemble.patch import Patch, patch_loop
from smplxpp.core import InputError, SkinWeights, TriangleMesh, require_at_least, row_lengths
from smplxpp.core.topology import border_loops


@dataclass(frozen=True)
class FillHolesConfig:
    """Options of filling holes with `fill_holes`.

    Attributes:
        width: largest mean width of a patch, metres: twice its area divided by its perimeter. A jacket's side and
            sleeve that were fused from armpit to wrist have 0.12; a sail between them would have 0.3. 0 fills nothing.
    """

    width: float = 0.15

    def __post_init__(self) -> None:
        require_at_least("fill_holes: width", self.width, 0.0)


@dataclass(frozen=True)
class FilledHoles:
    """Counts of the holes that were filled in one part.

    Attributes:
        holes: number of holes that cuts left.
        closed: number of these that were filled.
        faces: number of added faces.
        area: area of the added faces, square metres.
    """

    holes: int = 0
    closed: int = 0
    faces: int = 0
    area: float = 0.0

    def __add__(self, other: FilledHoles) -> FilledHoles:
        return FilledHoles(*(a + b for a, b in zip(asdict(self).values(), asdict(other).values(), strict=True)))

    def as_dict(self) -> dict[str, float]:
        """Return the counts as plain numbers, for JSON."""
        return asdict(self)


def cut_holes(
    before: TriangleMesh,
    before_index: Int[np.ndarray, " N"],
    after: TriangleMesh,
    after_index: Int[np.ndarray, " M"],
    *,
    taken: Bool[np.ndarray, " S"] | None = None,
) -> list[Int[np.ndarray, " _"]]:
    """Return the border loops of `after` without a vertex that lay on a border of `before`.

    Loops that a cut has joined with an opening (a cuff, a hem) are openings.

    Args:
        before: the part before the cut.
        before_index: the scan's vertex of each of its vertices.
        after: the part after the cut.
        after_index: the scan's vertex of each of its vertices, which identifies vertices of both.
        taken: the scan's vertices at which a thing was taken off the part, which leaves no opening either.
    """
    at_openings = _at_openings(before, before_index, taken)
    return [loop for loop in border_loops(after.faces) if not np.isin(after_index[loop], at_openings).any()]


def _at_openings(
    before: TriangleMesh, before_index: Int[np.ndarray, " N"], taken: Bool[np.ndarray, " S"] | None
) -> Int[np.ndarray, " O"]:
    """Return the scan's vertices on the openings of a part before the cut."""
    openings = border_loops(before.faces)
    found = before_index[np.concatenate(openings)] if openings else np.zeros(0, dtype=np.int64)
    return found if taken is None else found[~taken[found]]


def cut_slits(
    before: TriangleMesh,
    before_index: Int[np.ndarray, " N"],
    after: TriangleMesh,
    after_index: Int[np.ndarray, " M"],
    *,
    taken: Bool[np.ndarray, " S"] | None = None,
    longest: float = 0.25,
    closing: float = 0.4,
) -> list[Int[np.ndarray, " _"]]:
    """Return polygons that close what cuts have opened towards openings: a sleeve and the side that it was fused with.

    A border after the cut is a cycle of runs along cuts and of segments of old openings. Where a sleeve was fused with
    the side from armpit to hem, the cut runs from the hem over the armpit to the cuff in front, round the rest of the
    cuff, and back behind the arm. A polygon joins such runs: it leaves out the segments between them, across whose ends
    it goes straight, and is closed straight, too, so that hem and cuff stay open. Segments with ends farther apart than
    `longest`, and nearly straight ones half as long (the hem round the person), separate polygons.

    Args:
        before: the part before the cut.
        before_index: the scan's vertex of each of its vertices.
        after: the part after the cut, in the T-pose.
        after_index: the scan's vertex of each of its vertices.
        taken: as for `cut_holes`.
        longest: distance of the ends of a segment, metres, from which it separates polygons; half for a straight one.
        closing: largest length of the straight edge that closes a polygon, metres: across the side of a hem.
    """
    at_openings = _at_openings(before, before_index, taken)
    linked = {(int(a), int(b)) for a, b in after.edges}
    out: list[np.ndarray] = []
    for loop in border_loops(after.faces):
        old = np.isin(after_index[loop], at_openings)
        if old.all() or not old.any():
            continue
        # Start at an old segment; then segments and the runs that follow them alternate.
        start = int(np.flatnonzero(old & ~np.roll(old, 1))[0])
        pieces = np.split(np.roll(loop, -start), np.flatnonzero(np.diff(np.roll(old, -start))) + 1)
        segments, runs = pieces[0::2], pieces[1::2]
        if max(map(len, segments)) <= _FEW:
            out.append(loop)
            continue
        # Segments that separate polygons: those with distant ends; where there is none, the longest.
        apart = [_separates(after.vertices, segment, longest) for segment in segments]
        if not any(apart):
            apart[int(np.argmax([len(segment) for segment in segments]))] = True
        for first in np.flatnonzero(apart):
            polygon, k = [segments[first][-1:], runs[first]], (first + 1) % len(runs)
            while not apart[k]:
                # A few vertices become part of the polygon; of longer segments only the two ends do.
                polygon += [segments[k] if len(segments[k]) <= _FEW else segments[k][[0, -1]], runs[k]]
                k = (k + 1) % len(runs)
            out.append(np.concatenate([*polygon, segments[k][:1]]))
            if not _closable(after.vertices, out[-1], linked, closing):
                out.pop()
    return out


def part_legs(
    part: CanonicalPart, old: Bool[np.ndarray, " M"], leg: Float[np.ndarray, " M"]
) -> tuple[CanonicalPart, list[Int[np.ndarray, " _"]]]:
    """Return the inner sides of trouser legs that were cut apart from hem to hem, as polygons to be filled.

    The border of such a cut runs down one leg in front, up behind, and over the other leg back; where it reaches the
    hem, round that. It changes legs twice, in front of the crotch and behind it; a row of new vertices joins these
    places. Each polygon consists of that row, a leg's two sides of the cut, and straight lines across its hem.

    Args:
        part: after the cut, in the T-pose.
        old: vertices that were on openings before.
        leg: what a vertex follows of the left leg less what it follows of the right one.

    Returns:
        The part with the rows' vertices, and two polygons for each such border.
    """
    polygons: list[np.ndarray] = []
    for loop in border_loops(part.mesh.faces):
        # Vertices between the legs follow both a little: the mean over nine along the border tells the leg.
        if len(loop) < 9:
            continue
        left = np.convolve(np.pad(leg[loop], 4, mode="wrap"), np.ones(9) / 9, mode="valid") > 0
        changes = np.flatnonzero(left != np.roll(left, 1))
        if len(changes) != 2 or old[loop[changes]].any():
            continue
        arcs = [np.roll(loop, -k)[: (m - k) % len(loop) + 1] for k, m in (changes, changes[::-1])]
        if min(np.ptp(part.mesh.vertices[arc, 1]) for arc in arcs) < LEG_CUT:
            continue
        ends = part.mesh.vertices[loop[changes]]
        usual = float(np.median(row_lengths(np.diff(part.mesh.vertices[part.mesh.edges], axis=1)[:, 0])))
        count = max(int(np.round(np.linalg.norm(ends[1] - ends[0]) / usual)), 1) - 1
        share = np.arange(1, count + 1)[:, None] / (count + 1)
        row = part.mesh.vertex_count + np.arange(count)
        part = _with_vertices(part, loop[changes], np.concatenate([1.0 - share, share], axis=1))
        old, leg = (np.concatenate([values, np.zeros(count, dtype=values.dtype)]) for values in (old, leg))
        polygons += [np.concatenate([_across(arcs[0], old), row[::-1]]), np.concatenate([_across(arcs[1], old), row])]
    return part, polygons


def _across(arc: Int[np.ndarray, " A"], old: Bool[np.ndarray, " M"]) -> Int[np.ndarray, " B"]:
    """Return an arc of a border without its openings but their ends, across which it goes straight."""
    pieces = np.split(arc, np.flatnonzero(np.diff(old[arc])) + 1)
    return np.concatenate([p if len(p) <= _FEW or not old[p[0]] else p[[0, -1]] for p in pieces])


LEG_CUT = 0.2
"""Metres that a cut reaches down both legs from which on it parts them; a hole between the thighs is closed across.

Shorter stretches of fused legs are not cut at all (`smplxpp.build.parts`)."""
_FEW = 3
"""Vertices of an old segment up to which it is part of the polygon: the opening that was left would be a pinhole."""


def _span(vertices: np.ndarray, segment: Int[np.ndarray, " S"]) -> float:
    return float(np.linalg.norm(vertices[segment[0]] - vertices[segment[-1]]))


def _separates(vertices: np.ndarray, segment: Int[np.ndarray, " S"], longest: float) -> bool:
    """Return whether a segment of an opening lies between two limbs: ends far apart, or nearly straight (the hem behind
    two fused arms). That of a cuff goes round the limb."""
    span, along = _span(vertices, segment), float(row_lengths(np.diff(vertices[segment], axis=0)).sum())
    return span > longest or (span > 0.5 * longest and along < 1.5 * span)


def _closable(vertices: np.ndarray, polygon: np.ndarray, linked: set[tuple[int, int]], longest: float) -> bool:
    """Return whether no vertex occurs twice, and the closing edge is new and short enough."""
    ends = min(int(polygon[0]), int(polygon[-1])), max(int(polygon[0]), int(polygon[-1]))
    alone = len(np.unique(polygon)) == len(polygon) >= 3 and ends not in linked
    return alone and _span(vertices, polygon) <= longest


def fill_holes(
    part: CanonicalPart, holes: list[Int[np.ndarray, " _"]], *, config: FillHolesConfig | None = None
) -> tuple[CanonicalPart, FilledHoles]:
    """Fill holes of a part in the T-pose, where the sides of a cut have moved apart.

    The scan does not show that cloth. A patch is therefore the surface of least area over its border
    (`smplxpp.assemble.patch`); its weights and colours are harmonic functions of the border's. Vertices and faces of
    the part keep their indices; new ones follow, with -1 for the scan's vertex. Borders that `patch_loop` cannot close
    stay
    open.
    """
    config = config or FillHolesConfig()
    # Close each loop, and keep patches that are narrow enough; loops that cannot be closed are skipped.
    report = FilledHoles(holes=len(holes))
    for hole in holes:
        with suppress(InputError):
            dense, loop = _with_dense_edges(part, hole)
            patch = patch_loop(dense.mesh, loop)
            rim = dense.mesh.vertices[loop]
            if patch.width(rim) <= config.width:
                part = _with_patch(dense, loop, patch)
                report += FilledHoles(closed=1, faces=len(patch.faces), area=patch.area(rim))
    return part, report


def _with_dense_edges(part: CanonicalPart, loop: Int[np.ndarray, " L"]) -> tuple[CanonicalPart, Int[np.ndarray, " K"]]:
    """Divide the straight edges of a polygon over openings to the length of the part's; a patch can then bend there.

    Returns:
        The part with the new vertices, linear between the ends of their edge, and the polygon through them.
    """
    following = np.roll(loop, -1)
    length = row_lengths(part.mesh.vertices[following] - part.mesh.vertices[loop])
    usual = float(np.median(row_lengths(np.diff(part.mesh.vertices[part.mesh.edges], axis=1)[:, 0])))
    # Edges of the mesh stay whole, because a new vertex on one would be none of its face.
    own = np.sort(np.stack([loop, following], axis=1)) @ np.array([part.mesh.vertex_count, 1])
    straight = ~np.isin(own, part.mesh.edges @ np.array([part.mesh.vertex_count, 1]))
    pieces = np.where(straight, np.maximum(np.round(length / usual).astype(int), 1), 1)
    # Shares of both ends in each vertex of the new polygon; the first of each edge is the old vertex.
    edge = np.repeat(np.arange(len(loop)), pieces)
    step = np.arange(len(edge)) - (np.cumsum(pieces) - pieces)[edge]
    share = step / pieces[edge]
    coefficients = np.zeros((len(edge), len(loop)))
    coefficients[np.arange(len(edge)), edge] = 1.0 - share
    coefficients[np.arange(len(edge)), (edge + 1) % len(loop)] += share
    out = loop[edge]
    out[step > 0] = part.mesh.vertex_count + np.arange(int((step > 0).sum()))
    return _with_vertices(part, loop, coefficients[step > 0]), out


def _with_patch(part: CanonicalPart, loop: Int[np.ndarray, " L"], patch: Patch) -> CanonicalPart:
    # The patch's vertices are the loop's, then new ones.
    at = np.concatenate([loop, part.mesh.vertex_count + np.arange(len(patch.from_rim))])
    out = _with_vertices(part, loop, patch.from_rim)
    return replace(out, mesh=TriangleMesh(out.mesh.vertices, np.concatenate([out.mesh.faces, at[patch.faces]])))


def _with_vertices(
    part: CanonicalPart, loop: Int[np.ndarray, " L"], from_loop: Float[np.ndarray, "K L"]
) -> CanonicalPart:
    """Append vertices whose attributes are linear in those of a loop."""
    colors = from_loop @ part.vertex_colors[loop]
    return replace(
        part,
        mesh=TriangleMesh(np.concatenate([part.mesh.vertices, from_loop @ part.mesh.vertices[loop]]), part.mesh.faces),
        weights=_with_rows(part.weights, from_loop @ part.weights.dense()[loop], int(part.weights.component[loop[0]])),
        vertex_colors=np.concatenate([part.vertex_colors, colors.round().astype(np.uint8)]),
        scan_index=np.concatenate([part.scan_index, np.full(len(from_loop), -1)]),
    )


def _with_rows(weights: SkinWeights, rows: np.ndarray, component: int) -> SkinWeights:
    """Append rows to skin weights, with as many influences as before."""
    count = len(rows)
    if not count:
        return weights
    # New rows are padded to the same number of influences; they are unmatched, with unknown distance and angle.
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
