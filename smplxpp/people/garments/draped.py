"""Wide trousers and draped garments: rings about one limb or none, with weights by rules in their own coordinates."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Float

from smplxpp.people.cloth_mesh import ClothMesh, lift_outside, submesh
from smplxpp.people.garments.cut import (
    Garment,
    around,
    facing_out,
    grid_faces,
    hang,
    joined,
    layer,
    skirt_weights,
)
from smplxpp.people.garments.loose import hung
from smplxpp.people.garments.mannequin import ARMS_DOWN, Mannequin, lowered, outlines_of, shares
from smplxpp.people.textures import ramp
from smplxpp.skinning import unpose

_LEGS = "the trunk down to the crotch; below it the mean of the leg's skin at the same height, however far off it is"


def draped_garments(mannequin: Mannequin) -> list[Garment]:
    """Return wide trousers, garments over hanging arms, and a sari."""
    trunk = "trunk at the same height and azimuth"

    def trousers(name: str, **cut: float) -> Garment:
        return Garment(name, "lower", partial(_trousers, mannequin, **cut), _LEGS, loose=True, beside_hands=True)

    return [
        trousers("wide trousers, hem 9.5 cm", hem=0.095),
        trousers("wide trousers, hem 15 cm", hem=0.15),
        trousers("wide trousers, hem 24 cm", hem=0.24),
        trousers("hakama", hem=0.27, pleats=0.06),
        trousers("overalls with wide legs", hem=0.17, above=0.2),
        Garment(
            "poncho", "outer", partial(_poncho, mannequin), f"{trunk}; up to 0.6 of the arm below it", True, pose="down"
        ),
        Garment(
            "coat with empty sleeves",
            "outer",
            partial(_coat_over_shoulders, mannequin),
            f"{trunk}, below as a skirt; sleeves: where they are sewn on, half collar bone, half upper spine",
            True,
            pose="down",
        ),
        Garment(
            "sari", "outer", partial(_sari, mannequin), f"{trunk}; over the shoulder its skin; below as a skirt", True
        ),
    ]


def hooded_cape(mannequin: Mannequin) -> Garment:
    """Return a cape over hanging arms, open in front, and its hood."""
    rule = "trunk at the same height and azimuth, below as a skirt; hood: head and neck"
    return Garment("cape with a hood", "outer", partial(_hooded_cape, mannequin), rule, True, pose="down")


def leg_weights(mannequin: Mannequin, points: Float[np.ndarray, "N 3"], side: str) -> Float[np.ndarray, "N J"]:
    """Return the mean weights around one leg at the height of each point; the foot counts as the ankle's height."""
    body, skin = mannequin.body, mannequin.skin
    own = shares(body, skin.weights, tuple(f"{side}_{joint}" for joint in ("hip", "knee", "ankle"))) > 0.5
    own &= skin.vertices[:, 1] > mannequin.joints["left_ankle"][1]
    # Means in bins of 1 cm of height, interpolated.
    height, weights = skin.vertices[own][:, 1], skin.weights[own]
    heights = np.arange(height.min() + 0.01, height.max() - 0.01, 0.01)
    kernel = np.exp(-0.5 * ((heights[:, None] - height) / 0.01) ** 2)
    rows = kernel @ weights / kernel.sum(axis=1, keepdims=True)
    out = np.stack([np.interp(points[:, 1], heights, row) for row in rows.T], axis=1)
    return out / out.sum(axis=1, keepdims=True)


def _welded(cloth: ClothMesh) -> ClothMesh:
    """Return the mesh with vertices at the same place (0.01 mm) made one, without faces that this leaves empty."""
    _, first, index = np.unique(np.round(cloth.vertices, 5), axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[cloth.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return ClothMesh(cloth.vertices[first], faces[whole], cloth.weights[first])


def _trousers(mannequin: Mannequin, *, hem: float, above: float = 0.0, pleats: float = 0.0) -> ClothMesh:
    """Return trousers of which each leg widens to a hem of radius `hem`; inner sides stop at the middle plane.

    Args:
        mannequin: the person.
        hem: radius, metres.
        above: how far they reach above the waist, metres.
        pleats: depth of the pleats at the hem, metres.
    """
    j = mannequin.joints
    top, crotch, low = j["spine1"][1] + 0.04 + above, j["left_hip"][1] - 0.125, j["left_ankle"][1] + 0.03
    # Around the trunk, half of them on each leg.
    columns = 96
    # The trunk: a closed ring of columns that starts at the back.
    azimuths = 2 * np.pi * np.arange(columns) / columns - np.pi / 2
    heights = np.linspace(top, crotch, int((top - crotch) / 0.014) + 2)
    points, faces = hang(mannequin, heights, azimuths, closed=True, stand_off=0.014)
    points = np.array(
        lift_outside(
            facing_out(mannequin.unweighted(points, faces), mannequin.inner_points(points)).mesh,
            mannequin.skin.mesh,
            clearance=0.006,
            solid=True,
        )
    )
    half = columns // 2
    # The ends of the seam between the legs lie on the middle plane.
    points[-columns::half, 0] = 0.0
    ring = points[-columns:]
    pieces = [mannequin.unweighted(points, faces)]
    inside = [mannequin.inner_points(points)]
    for side, sign, outer in (
        ("left", 1.0, ring[: half + 1]),
        ("right", -1.0, np.concatenate([ring[half:], ring[:1]])),
    ):
        # The first ring of a leg: half of the trunk's last ring, and back along the seam between the legs.
        t = np.linspace(0, 1, half // 2 + 2)[1:-1, None]
        seam = outer[-1] + t * (outer[0] - outer[-1]) - [0, 0.02, 0] * np.sin(np.pi * t)
        first = np.concatenate([outer, seam])
        count = len(first)
        hip, knee, ankle = (j[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
        rows = np.linspace(crotch, low, int((crotch - low) / 0.016) + 2)
        # The angle of each column from its place on the first ring.
        middle = first.mean(axis=0)
        angle = np.unwrap(np.arctan2(first[:, 2] - middle[2], first[:, 0] - middle[0]))
        even = angle[0] + np.sign(angle[-1] - angle[0]) * 2 * np.pi * np.arange(count) / count
        sheet = [first]
        for y in rows[1:]:
            down = (crotch - y) / (crotch - low)
            axis_x, axis_z = (
                np.interp(-y, [-hip[1], -knee[1], -ankle[1]], [hip[k], knee[k], ankle[k]]) for k in (0, 2)
            )
            radius = 0.105 + (hem - 0.105) * down + pleats * down * np.sin(9 * even) ** 2
            round_ring = np.stack(
                [axis_x + radius * np.cos(even), 0 * even + y, axis_z + radius * np.sin(even)], axis=1
            )
            share = ramp(np.array([down]), 0.0, 0.35)[0]
            row = (1 - share) * (first + [0, y - crotch, 0]) + share * round_ring
            # Both legs stop 4 mm before the middle plane.
            row[:, 0] = sign * np.maximum(sign * row[:, 0], 0.004)
            sheet.append(row)
        points = np.concatenate(sheet)
        faces = grid_faces(len(rows), count, closed=True)
        centre = np.repeat([s.mean(axis=0) for s in sheet], count, axis=0)
        piece = facing_out(mannequin.unweighted(points, faces), centre)
        lifted = np.array(lift_outside(piece.mesh, mannequin.skin.mesh, clearance=0.005, solid=True))
        lifted[:count] = first
        pieces.append(piece.with_vertices(lifted))
        inside.append(centre)
    pieces[0] = facing_out(pieces[0], inside[0])
    whole = _welded(joined(*pieces))
    p = whole.vertices
    left = p[:, 0] > 0
    legs = np.where(left[:, None], leg_weights(mannequin, p, "left"), leg_weights(mannequin, p, "right"))
    # At the seam both legs count alike.
    other = np.where(left[:, None], leg_weights(mannequin, p, "right"), leg_weights(mannequin, p, "left"))
    near = 0.5 * ramp(np.abs(p[:, 0]), 0.05, 0.0) * ramp(p[:, 1], crotch - 0.1, crotch)
    legs = legs + near[:, None] * (other - legs)
    above_crotch = ramp(p[:, 1], crotch - 0.03, crotch + 0.05)[:, None]
    return ClothMesh(p, whole.faces, above_crotch * mannequin.trunk_weights(p) + (1 - above_crotch) * legs)


def _arms_down(mannequin: Mannequin) -> tuple[Mannequin, np.ndarray]:
    """Return a mannequin whose outlines hold hanging arms, and the transforms (J, 4, 4) of that pose."""
    body = mannequin.body
    posed = body.forward(lowered(mannequin, ARMS_DOWN))
    # The skin is a submesh of the body: find its vertices by place.
    rest = body.forward(mannequin.params).vertices[0]
    used = np.unique(body.faces[(body.part_labels == body.part_label_names.index("body"))[body.faces].all(axis=1)])
    assert np.allclose(rest[used], mannequin.skin.vertices)
    points = posed.vertices[0][used]
    lower = points[points[:, 1] < mannequin.joints["neck"][1] - 0.03]
    low, outlines = outlines_of(lower, mannequin.joints["pelvis"][2])
    skin = ClothMesh(points, mannequin.skin.faces, mannequin.skin.weights)
    return Mannequin(body, mannequin.params, skin, mannequin.joints, outlines, low), posed.posed_from_rest[0]


def _over_arms(
    mannequin: Mannequin, hem: float, azimuths: np.ndarray, *, closed: bool, neck: float, flare: float, rows: int = 60
) -> tuple[ClothMesh, np.ndarray, Mannequin]:
    """Return cloth that falls from the neck over shoulders and hanging arms, the pose's transforms, its mannequin."""
    down, transforms = _arms_down(mannequin)
    j = mannequin.joints
    top = j["neck"][1] - 0.005
    shoulder = j["left_shoulder"][1] - 0.03
    # From the neckline outwards to the shoulder's outline, then down.
    t = np.linspace(0, 1, 18)[:, None]
    edge = down.outline(np.full((1, len(azimuths)), shoulder - 0.02), azimuths[None, :]) + 0.02
    radius = neck + (edge - neck) * np.sin(0.5 * np.pi * t)
    height = shoulder - 0.02 + (top - shoulder + 0.02) * np.cos(0.5 * np.pi * t) + 0 * radius
    heights = np.linspace(shoulder - 0.034, hem, rows)
    fall = np.maximum.accumulate(
        down.outline(heights[:, None], azimuths[None, :]) + 0.018 + flare * (shoulder - heights)[:, None], axis=0
    )
    fall = np.maximum(fall, edge)
    height = np.concatenate([height, np.repeat(heights[:, None], len(azimuths), axis=1)])
    points = down.at(height, azimuths[None, :], np.concatenate([radius, fall])).reshape(-1, 3)
    cloth = mannequin.unweighted(points, grid_faces(len(height), len(azimuths), closed=closed))
    cloth = facing_out(cloth, mannequin.inner_points(points) - [0, 0.1, 0])
    return cloth.with_vertices(lift_outside(cloth.mesh, down.skin.mesh, clearance=0.006, solid=True)), transforms, down


def _poncho(mannequin: Mannequin) -> ClothMesh:
    """Return a poncho over hanging arms, in the T-pose."""
    j = mannequin.joints
    cloth, transforms, _ = _over_arms(
        mannequin, j["left_hip"][1] + 0.02, around(110), closed=True, neck=0.105, flare=0.06
    )
    p = cloth.vertices
    weights = _shoulder_cloth_weights(mannequin, p)
    # Beside the trunk the arm under it carries it.
    arm = (0.6 * ramp(np.abs(p[:, 0]), 0.13, 0.26))[:, None]
    side = np.where(
        (p[:, 0] > 0)[:, None], mannequin.rigid("left_shoulder", len(p)), mannequin.rigid("right_shoulder", len(p))
    )
    weights = (1 - arm) * weights + arm * side
    return ClothMesh(unpose(p, weights, transforms).vertices, cloth.faces, weights)


def _shoulder_cloth_weights(mannequin: Mannequin, points: np.ndarray) -> np.ndarray:
    """Return weights of cloth that lies on the shoulders: their skin above, the trunk below."""
    top = mannequin.joints["left_shoulder"][1]
    above = ramp(points[:, 1], top - 0.1, top + 0.03)[:, None]
    upper = 0.6 * mannequin.rigid("spine3", len(points))
    side = ramp(points[:, 0], -0.15, 0.15)[:, None]
    upper += 0.4 * (
        side * mannequin.rigid("left_collar", len(points)) + (1 - side) * mannequin.rigid("right_collar", len(points))
    )
    return above * upper + (1 - above) * mannequin.trunk_weights(points)


def _coat_over_shoulders(mannequin: Mannequin) -> ClothMesh:
    """Return a coat over the shoulders, the arms under it and its sleeves empty, in the T-pose."""
    j = mannequin.joints
    hip, shoulder = j["left_hip"][1], j["left_shoulder"][1]
    azimuths = np.linspace(np.pi / 2 + 0.45, 2.5 * np.pi - 0.45, 100)
    body, transforms, down_form = _over_arms(
        mannequin, j["left_knee"][1] + 0.05, azimuths, closed=False, neck=0.1, flare=0.04, rows=64
    )
    p = body.vertices
    below = ramp(p[:, 1], hip + 0.05, hip - 0.05)[:, None]
    weights = (1 - below) * _shoulder_cloth_weights(mannequin, p) + below * skirt_weights(
        mannequin, p, legs=0.4, shins=0.0
    )
    # Each sleeve is sewn into a square armhole: ten rows and ten columns at the side of the shoulder.
    row, column = np.divmod(np.arange(len(p)), len(azimuths))
    t, pieces, holes = np.arange(-5, 5), [], np.zeros(len(body.faces), dtype=bool)
    rim = np.concatenate([np.stack(np.broadcast_arrays(*pair), 1) for pair in ((-5, t), (t, 5), (5, -t), (-t, -5))])
    for name, sign, azimuth in (("left", 1.0, 2 * np.pi), ("right", -1.0, np.pi)):
        middle = int(np.argmin(np.abs(azimuths - azimuth)))
        inside = (np.abs(row - 25) <= 5) & (np.abs(column - middle) <= 5)
        holes |= inside[body.faces].all(axis=1)
        # Rings from the armhole's rim out and down to a round cuff.
        first = p[(rim[:, 0] + 25) * len(azimuths) + middle + rim[:, 1]]
        angle = np.arctan2(-rim[:, 0], sign * rim[:, 1])
        down = np.linspace(0, 1, 40)[:, None]
        height = first[:, 1].mean() - 0.02 - 0.48 * down
        out = down_form.outline(height, np.full((40, 1), azimuth)) + 0.09 + 0.04 * (shoulder - height)
        out = np.maximum.accumulate(out, axis=0)
        ring = np.stack(
            np.broadcast_arrays(
                sign * (out + 0.055 * np.sin(angle)), height, first[:, 2].mean() + 0.055 * np.cos(angle)
            ),
            axis=-1,
        )
        share = ramp(down[:, 0], 0.0, 0.25)[:, None, None]
        points = ((1 - share) * first + share * ring).reshape(-1, 3)
        tube = facing_out(
            mannequin.unweighted(points, grid_faces(40, len(rim), closed=True)),
            np.repeat(points.reshape(40, -1, 3).mean(axis=1), len(rim), axis=0),
        )
        rows = 0.5 * mannequin.rigid(f"{name}_collar", len(points)) + 0.5 * mannequin.rigid("spine3", len(points))
        weights[inside] = rows[0]
        pieces.append(ClothMesh(points, tube.faces, rows))
    whole = _welded(joined(submesh(ClothMesh(p, body.faces, weights), ~holes), *pieces))
    return ClothMesh(unpose(whole.vertices, whole.weights, transforms).vertices, whole.faces, whole.weights)


def _hooded_cape(mannequin: Mannequin) -> ClothMesh:
    """Return the cape with its hood, in the T-pose."""
    j = mannequin.joints
    hip, neck, chin = j["left_hip"][1], j["neck"][1], j["jaw"][1] - 0.02
    azimuths = np.linspace(np.pi / 2 + 0.35, 2.5 * np.pi - 0.35, 110)
    cloth, transforms, _ = _over_arms(
        mannequin, j["left_knee"][1] + 0.1, azimuths, closed=False, neck=0.1, flare=0.1, rows=64
    )
    p = cloth.vertices
    below = ramp(p[:, 1], hip + 0.05, hip - 0.05)[:, None]
    weights = (1 - below) * _shoulder_cloth_weights(mannequin, p) + below * skirt_weights(
        mannequin, p, legs=0.4, shins=0.0
    )

    def level(q: np.ndarray) -> np.ndarray:
        x, y, z = q.T
        face = np.where(z > j["head"][2] + 0.02, np.hypot(x / 0.9, y - j["jaw"][1] - 0.04) - 0.08, 1.0)
        return np.minimum(face, y - neck)

    hood = layer(mannequin, level, ease=0.03, fairing=20)
    count = len(hood.vertices)
    head = ramp(hood.vertices[:, 1], neck - 0.01, chin)[:, None]
    own = head * mannequin.rigid("head", count) + (1 - head) * mannequin.rigid("neck", count)
    cape = ClothMesh(unpose(p, weights, transforms).vertices, cloth.faces, weights)
    return joined(cape, ClothMesh(hood.vertices, hood.faces, own))


def _sari(mannequin: Mannequin) -> ClothMesh:
    """Return a sari: a long skirt, and its end from the right hip over the left shoulder down the back."""
    j = mannequin.joints
    waist, ankle = j["spine1"][1] + 0.03, j["left_ankle"][1]
    skirt = hung(mannequin, waist, ankle + 0.05, legs=0.85, shins=0.5, flare=0.1, pleats=(5, 0.02))
    # The end: a band whose middle runs over the shoulder.
    t = np.linspace(0, 1, 80)
    shoulder = j["left_shoulder"]
    keys = np.array(
        [
            [-0.13, waist - 0.02, 0.16],
            [-0.02, j["spine3"][1] - 0.02, 0.19],
            [0.09, j["spine3"][1] + 0.15, 0.16],
            [shoulder[0] - 0.05, shoulder[1] + 0.085, shoulder[2]],
            [shoulder[0] - 0.04, j["spine3"][1] + 0.1, -0.14],
            [shoulder[0] - 0.04, j["left_hip"][1], -0.17],
            [shoulder[0] - 0.04, j["left_knee"][1] + 0.2, -0.2],
        ]
    )
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(keys, axis=0), axis=1))])
    middle = np.stack([np.interp(t * length[-1], length, keys[:, k]) for k in range(3)], axis=1)
    for _ in range(30):
        middle[1:-1] = 0.25 * middle[:-2] + 0.5 * middle[1:-1] + 0.25 * middle[2:]
    tangent = np.gradient(middle, axis=0)
    # Across the band: sideways on chest and back, horizontal everywhere.
    across = np.cross(tangent, middle - mannequin.inner_points(middle) + [0, 0.12, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    width = np.linspace(-0.07, 0.07, 14)
    points = (middle[:, None] + width[None, :, None] * across[:, None]).reshape(-1, 3)
    band = facing_out(
        mannequin.unweighted(points, grid_faces(80, 14, closed=False)), mannequin.inner_points(points) - [0, 0.1, 0]
    )
    vertices = lift_outside(band.mesh, mannequin.skin.mesh, clearance=0.012, solid=True)
    weights = _shoulder_cloth_weights(mannequin, vertices)
    hip = j["left_hip"][1]
    below = ramp(vertices[:, 1], hip + 0.05, hip - 0.05)[:, None]
    weights = (1 - below) * weights + below * skirt_weights(mannequin, vertices, legs=0.4, shins=0.0)
    return joined(skirt, ClothMesh(vertices, band.faces, weights))
