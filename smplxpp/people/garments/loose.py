"""Hanging garments: sheets laid out by height and azimuth, with weights by rules in those coordinates."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from smplxpp.core.topology import border_loops
from smplxpp.people.cloth_mesh import ClothMesh, lift_outside
from smplxpp.people.garments.cut import (
    Garment,
    around,
    facing_out,
    grid_faces,
    hang,
    joined,
    layer,
    sewn,
    skirt_weights,
)
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.people.textures import ramp

_SKIRT = (
    "trunk at the same height and azimuth down to the hips; from there to 22 cm below the thighs grow to {legs}, the "
    "rest stays with the pelvis; left and right by the place across the ring; below the knee the shins take up to "
    "{shins} of it"
)
_COAT = "body and sleeves as grown from the skin; panels as a skirt's with legs 0.7, shins 0.3"
_CAPE = "trunk at the same height and azimuth down to the hips, below that pelvis with up to 0.4 of the thighs"
_SLEEVES = "body as grown from the skin; sleeves: the arm's skin at the same place along the arm, however far they hang"


def loose_garments(mannequin: Mannequin) -> list[Garment]:
    """Return skirts, dresses, a coat, a cape and wide sleeves."""
    j = mannequin.joints
    waist, hip, knee, ankle = j["spine1"][1] + 0.04, j["left_hip"][1], j["left_knee"][1], j["left_ankle"][1]
    chest = j["spine3"][1] + 0.085

    def skirt(name: str, hem: float, *, label: str = "lower", top: float = waist, legs: float, shins: float, **cut):
        # `cut` holds the options of `hang`: flare, pleats and distance.
        make = partial(hung, mannequin, top, hem, legs=legs, shins=shins, **cut)
        return Garment(name, label, make, _SKIRT.format(legs=legs, shins=shins), loose=True, beside_hands=True)

    return [
        skirt("mini skirt", hip - 0.2, legs=0.9, shins=0.0, flare=0.05),
        skirt("knee skirt", knee + 0.02, legs=0.9, shins=0.3, flare=0.04),
        skirt("long skirt", ankle + 0.06, legs=0.85, shins=0.5, flare=0.06),
        skirt("flared skirt", knee + 0.04, legs=0.8, shins=0.3, flare=0.3, pleats=(9, 0.04)),
        skirt("full circle skirt", knee + 0.08, legs=0.6, shins=0.2, flare=0.8, pleats=(12, 0.08)),
        skirt("dress", knee + 0.03, label="upper", top=chest, legs=0.8, shins=0.3, flare=0.2, pleats=(8, 0.03)),
        skirt("dress labelled lower", ankle + 0.2, top=chest, legs=0.8, shins=0.4, flare=0.55, pleats=(11, 0.03)),
        Garment("open coat", "outer", partial(_coat, mannequin), _COAT, loose=True),
        Garment("cape", "outer", partial(_cape, mannequin), _CAPE, loose=True),
        Garment("wide sleeves", "upper", partial(_kimono, mannequin), _SLEEVES, loose=True),
    ]


def layered_garments(mannequin: Mannequin) -> list[Garment]:
    """Return a one-shoulder dress, a skirt over trousers, an apron, a tutu."""
    trunk = "trunk at the same height and azimuth, below the hips as a skirt"
    return [
        Garment(
            "one-shoulder dress", "upper", partial(_one_shoulder, mannequin), f"bodice as grown; {trunk}", loose=True
        ),
        Garment(
            "skirt over trousers", "lower", partial(_layers, mannequin), "trousers as grown; skirt as one", loose=True
        ),
        Garment("apron", "outer", partial(_apron, mannequin), trunk, loose=True),
        Garment(
            "tutu", "lower", partial(_tutu, mannequin), "pelvis, 0.15 of the thighs", loose=True, beside_hands=True
        ),
    ]


def peplum_blouse(mannequin: Mannequin) -> Garment:
    """Return a blouse without sleeves that falls wide from the waist and ends above the crotch."""
    hip, chest = mannequin.joints["left_hip"][1], mannequin.joints["spine3"][1] + 0.09
    cut = partial(hung, mannequin, chest, hip - 0.09, legs=0.5, shins=0.0, flare=0.5, pleats=(10, 0.03))
    return Garment("peplum blouse", "upper", cut, _SKIRT.format(legs=0.5, shins=0.0), loose=True)


def hung(
    mannequin: Mannequin,
    top: float,
    hem: float,
    *,
    legs: float,
    shins: float,
    gap: float = 0.0,
    front: float = 0.0,
    **cut,
) -> ClothMesh:
    """Return a skirt from `top` down to `hem`.

    It is open by `gap` radians to each side of the front, or covers only `front` radians to each side of it.
    """
    heights = np.linspace(top, hem, int((top - hem) / 0.014) + 2)  # rows 14 mm apart
    azimuths = around(100) if not gap else np.linspace(np.pi / 2 + gap, 2.5 * np.pi - gap, 100)
    if front:
        azimuths = np.linspace(np.pi / 2 - front, np.pi / 2 + front, 60)
    points, faces = hang(mannequin, heights, azimuths, closed=not gap and not front, **cut)
    # Weights follow from the points before they are pushed off the skin.
    cloth = facing_out(mannequin.unweighted(points, faces), mannequin.inner_points(points))
    cloth = cloth.with_vertices(lift_outside(cloth.mesh, mannequin.skin.mesh, clearance=0.004, solid=True))
    return ClothMesh(cloth.vertices, cloth.faces, skirt_weights(mannequin, points, legs=legs, shins=shins))


def _coat(mannequin: Mannequin) -> ClothMesh:
    """Return a long coat, open in front: body and sleeves to the hips, and panels from there down."""
    hip, knee = mannequin.joints["left_hip"][1], mannequin.joints["left_knee"][1]
    top = _coat_body(mannequin, hip + 0.06, ease=0.018)
    # The panels overlap the upper part by 1.5 cm.
    panels = hung(mannequin, hip + 0.075, knee - 0.05, legs=0.7, shins=0.3, gap=0.3, flare=0.15, stand_off=0.022)
    return joined(top, panels)


def _coat_body(mannequin: Mannequin, end: float, *, ease: float | Callable[[np.ndarray], np.ndarray]) -> ClothMesh:
    """Return body and sleeves of a coat, open in front, down to a height."""
    j = mannequin.joints

    def level(p: np.ndarray) -> np.ndarray:
        x, y, z = p.T
        # Open in front by 9 cm, with a round neckline, cut off at hips and wrists.
        front = np.where(z > mannequin.axis[1], np.abs(x) - 0.045, 1.0)
        neck = np.where(y > j["neck"][1] - 0.13, np.hypot(x, z - j["neck"][2] - 0.018) - 0.075, 1.0)
        below = np.minimum(y - end, j["neck"][1] + 0.03 - y)
        return np.minimum(np.minimum(front, neck), np.minimum(below, j["left_wrist"][0] - 0.02 - np.abs(x)))

    return layer(mannequin, level, ease=ease, fairing=10)


def sewn_coat(mannequin: Mannequin, over: ClothMesh) -> ClothMesh:
    """Return a long coat of one piece, open in front, that hangs from the shoulders over a skirt."""
    j = mannequin.joints
    knee, chest = j["left_knee"][1], j["spine3"][1]
    waist = j["spine1"][1] + 0.05

    def ease(p: np.ndarray) -> np.ndarray:
        # It lies on the shoulders and stands off the waistband.
        return 0.009 + 0.011 * ramp(p[:, 1], chest + 0.1, waist)

    top = _coat_body(mannequin, waist, ease=ease)
    panels = hung(mannequin, waist - 0.014, knee - 0.05, legs=0.7, shins=0.3, gap=0.3, flare=0.15, stand_off=0.024)
    (loop,) = (one for one in border_loops(top.faces) if top.vertices[one, 1].min() < waist + 0.01)
    x, y, z = top.vertices[loop].T
    # The lower edge runs around the back from one lower corner of the front opening to the other.
    left, right = (int(np.where((z > 0) & (side * x > 0), y + np.abs(x), np.inf).argmin()) for side in (1.0, -1.0))
    paths = [np.roll(loop, -a)[: (b - a) % len(loop) + 1] for a, b in ((left, right), (right, left))]
    edge = min(paths, key=lambda path: top.vertices[path, 1].max())
    edge = edge if edge[0] != loop[left] else edge[::-1]
    coat = sewn(top, edge, panels, np.arange(100))
    return coat.with_vertices(lift_outside(coat.mesh, over.mesh, clearance=0.006, solid=False))


def _cape(mannequin: Mannequin) -> ClothMesh:
    """Return a cape about the back, from the shoulders to the knees."""
    j = mannequin.joints
    top, hem = j["neck"][1] - 0.05, j["left_knee"][1] + 0.05
    heights = np.linspace(top, hem, 60)
    azimuths = np.linspace(np.pi + 0.12, 2 * np.pi - 0.12, 70)
    # A cape falls from the shoulders outwards, in folds that deepen downwards.
    reach = 0.125 + 0.16 * ((top - heights) / (top - hem)) ** 0.7
    outline = mannequin.outline(heights[:, None], azimuths[None, :]) * np.clip(-np.sin(azimuths), 0.75, 1.0) + 0.01
    radius = np.maximum(outline, reach[:, None] * (1 + 0.05 * np.sin(9 * azimuths) * (reach[:, None] / 0.2)))
    points = mannequin.at(heights[:, None], azimuths[None, :], np.maximum.accumulate(radius, axis=0)).reshape(-1, 3)
    faces = grid_faces(len(heights), len(azimuths), closed=False)
    cloth = facing_out(mannequin.unweighted(points, faces), mannequin.inner_points(points))
    cloth = cloth.with_vertices(lift_outside(cloth.mesh, mannequin.skin.mesh, clearance=0.006, solid=True))
    weights = skirt_weights(mannequin, points, legs=0.4, shins=0.0)
    return ClothMesh(cloth.vertices, cloth.faces, weights)


def _kimono(mannequin: Mannequin) -> ClothMesh:
    """Return a robe's upper part with sleeves that hang wide below the arms."""
    j = mannequin.joints
    hip, shoulder, wrist = j["left_hip"][1], j["left_shoulder"], j["left_wrist"]

    def level(p: np.ndarray) -> np.ndarray:
        x, y, z = p.T
        neck = np.where(y > j["neck"][1] - 0.13, np.hypot(x, z - j["neck"][2] - 0.03) - 0.085, 1.0)
        return np.minimum(
            np.minimum(neck, y - hip - 0.02), np.minimum(shoulder[0] + 0.12 - np.abs(x), j["neck"][1] + 0.03 - y)
        )

    pieces = [layer(mannequin, level, ease=0.014, fairing=8)]
    # Sleeves are tubes along the arms, wider downwards than upwards.
    along = np.linspace(shoulder[0] + 0.10, wrist[0] - 0.03, 40)
    angle = around(48)
    # Sleeves hang 7 cm below the arm at the shoulder, 26 cm at the wrist.
    hangs = 0.07 + 0.19 * ((along - along[0]) / (along[-1] - along[0])) ** 0.8
    drop = np.where(np.sin(angle)[None, :] < 0, hangs[:, None], 0.062)
    for sign in (1.0, -1.0):
        y = shoulder[1] + drop * np.sin(angle)[None, :]
        width = np.where(np.sin(angle) < 0, 0.06 * (1 + 0.5 * np.sin(angle)), 0.06)
        z = shoulder[2] + np.broadcast_to((width * np.cos(angle))[None, :], y.shape)
        points = np.stack(np.broadcast_arrays(sign * along[:, None], y, z), axis=-1).reshape(-1, 3)
        sleeve = ClothMesh(points, grid_faces(40, 48, closed=True), mannequin.arm_weights(points))
        middle = np.repeat(
            np.column_stack([sign * along, 0 * along + shoulder[1], 0 * along + shoulder[2]]), 48, axis=0
        )
        sleeve = facing_out(sleeve, middle)
        pieces.append(sleeve.with_vertices(lift_outside(sleeve.mesh, mannequin.skin.mesh, clearance=0.005, solid=True)))
    return joined(*pieces)


def _one_shoulder(mannequin: Mannequin) -> ClothMesh:
    """Return a dress that one shoulder holds."""
    j = mannequin.joints

    def level(p: np.ndarray) -> np.ndarray:
        x, y, _ = p.T
        # The neckline rises from below the right armpit to the neck's left side.
        line = (j["spine3"][1] + 0.16) + 0.75 * (x + 0.02) - y
        strap = np.minimum(j["left_shoulder"][0] - 0.035 - x, x - 0.06)
        return np.minimum(
            np.maximum(line, np.where(y > j["spine3"][1], strap, -1.0)),
            np.minimum(y - j["left_hip"][1] - 0.06, np.minimum(0.185 - np.abs(x), j["neck"][1] + 0.03 - y)),
        )

    top = layer(mannequin, level, ease=0.009, fairing=6)
    below = hung(
        mannequin,
        j["left_hip"][1] + 0.075,
        j["left_knee"][1] - 0.1,
        legs=0.8,
        shins=0.35,
        flare=0.25,
        pleats=(7, 0.03),
        stand_off=0.014,
    )
    return joined(top, below)


def _layers(mannequin: Mannequin) -> ClothMesh:
    """Return close trousers and a flared skirt over them."""
    j = mannequin.joints
    waist = j["spine1"][1] + 0.03
    side = j["left_shoulder"][0] + 0.14

    def level(p: np.ndarray) -> np.ndarray:
        return np.minimum(np.minimum(waist - p[:, 1], p[:, 1] - j["left_ankle"][1]), side - np.abs(p[:, 0]))

    trousers = layer(mannequin, level, ease=0.01)
    skirt = hung(
        mannequin,
        waist + 0.01,
        j["left_knee"][1] + 0.08,
        legs=0.8,
        shins=0.2,
        flare=0.28,
        pleats=(9, 0.03),
        stand_off=0.018,
    )
    return joined(trousers, skirt)


def _apron(mannequin: Mannequin) -> ClothMesh:
    """Return an apron: a bib, and a sheet about the front down to the knees."""
    j = mannequin.joints
    waist = j["spine1"][1] + 0.03
    sheet = hung(
        mannequin, waist, j["left_knee"][1] - 0.02, legs=0.75, shins=0.25, front=1.35, flare=0.08, stand_off=0.014
    )
    bib = hung(mannequin, j["spine3"][1] + 0.1, waist + 0.004, legs=0.75, shins=0.25, front=0.8, stand_off=0.012)
    return joined(sheet, bib)


def _tutu(mannequin: Mannequin) -> ClothMesh:
    """Return a stiff skirt that stands off the hips."""
    hip = mannequin.joints["left_hip"][1]
    cloth = hung(mannequin, hip + 0.1, hip - 0.03, legs=0.0, shins=0.0, flare=3.0, stand_off=0.01)
    p = cloth.vertices
    left = ramp(p[:, 0], -0.12, 0.12)[:, None]
    thighs = left * mannequin.rigid("left_hip", len(p)) + (1 - left) * mannequin.rigid("right_hip", len(p))
    return ClothMesh(p, cloth.faces, 0.85 * mannequin.rigid("pelvis", len(p)) + 0.15 * thighs)
