"""Garments that lie on the skin: grown from it, so that a vertex keeps the weights of the skin it was grown from."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from smplxpp.people.cloth_mesh import ClothMesh, lift_outside, smooth
from smplxpp.people.garments.cut import Garment, Level, around, facing_out, grid_faces, joined, layer, tube_along
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.people.textures import ramp

_HOOD_UP = "the head from the chin up, from the neck's base down the shoulders' skin straight below, smooth between"
_HOOD_DOWN = "shirt: as grown; the hood's roll: spine3, at its sides half the collar bone"
_SCARF = "roll: neck 0.4 to 0.8 by height, else spine3; the end: the trunk's skin at its height and azimuth"

Ease = float | Callable[[np.ndarray], np.ndarray]
"""Metres off the skin, or a function that returns them (N,) for points (N, 3)."""


def fitted_garments(mannequin: Mannequin) -> list[Garment]:
    """Return the garments of the transfer benchmark that keep to the skin, and what is sewn to them."""
    j = mannequin.joints
    waist, crotch, knee, ankle = *_trunk_heights(mannequin), j["left_knee"], j["left_ankle"]
    shoulder, elbow, wrist = j["left_shoulder"], j["left_elbow"], j["left_wrist"]
    legs, shirt = partial(_legs, mannequin), partial(_shirt, mannequin)

    def overalls(p: np.ndarray) -> np.ndarray:
        trousers = legs(top=waist + 0.02, hem=ankle[1] + 0.02)(p)
        x, y, z = p.T
        # A bib of 23 cm and two straps of 5 cm, joined to the trousers at the waist.
        bib = np.minimum(0.115 - np.abs(x), np.minimum(z - mannequin.axis[1], j["spine3"][1] + 0.09 - y))
        strap = np.minimum(0.024 - np.abs(np.abs(x) - 0.088), j["neck"][1] + 0.03 - y)
        return np.maximum(trousers, np.minimum(np.maximum(bib, strap), y - waist))

    def glove(p: np.ndarray) -> np.ndarray:
        return np.abs(p[:, 0]) - elbow[0] - 0.1

    # Levels are positive inside a garment; `ease` is its distance from the skin in metres.
    tee = _grown(mannequin, "T-shirt", "upper", shirt(cuff=0.5 * (shoulder[0] + elbow[0]), hem=crotch + 0.08), 0.011)
    grown = partial(_grown, mannequin)
    return [
        tee,
        grown("trousers", "lower", legs(top=waist, hem=ankle[1]), 0.01),
        grown("shorts", "lower", legs(top=waist, hem=crotch - 0.16), 0.014),
        grown("overalls with straps", "lower", overalls, 0.008),
        grown("high boots", "shoe", _boots(knee[1] + 0.12), 0.009),
        grown("low shoes", "shoe", _boots(ankle[1] + 0.01), 0.008),
        grown("open jacket", "outer", shirt(cuff=wrist[0] - 0.02, hem=crotch + 0.06, gap=0.05), 0.017),
        grown("jumpsuit", "upper", shirt(cuff=wrist[0] - 0.02, hem=ankle[1] + 0.02), 0.009),
        grown("long gloves", "upper", glove, 0.004, 2),
        Garment("hood up", "upper", partial(_hood_up, mannequin), _HOOD_UP),
        Garment("hood down", "upper", lambda: _hood_down(mannequin, tee.make()), _HOOD_DOWN),
        Garment("scarf", "upper", partial(_scarf, mannequin), _SCARF),
    ]


def tops(mannequin: Mannequin) -> list[Garment]:
    """Return tight and wide, short and long garments of the trunk, and what is worn over them."""
    j = mannequin.joints
    (waist, crotch), shoulder, elbow = _trunk_heights(mannequin), j["left_shoulder"], j["left_elbow"]
    grown, shirt = partial(_grown, mannequin), partial(_shirt, mannequin)
    long, half = j["left_wrist"][0] - 0.015, 0.5 * (shoulder[0] + elbow[0])

    def vest(p: np.ndarray) -> np.ndarray:
        # Armholes of 10 cm radius around the shoulder joints.
        holes = np.hypot(p[:, 1] - shoulder[1] + 0.02, p[:, 2] - shoulder[2]) - 0.105
        holes = np.where(np.abs(p[:, 0]) > shoulder[0] - 0.025, holes, 1.0)
        return np.minimum(shirt(cuff=shoulder[0] + 0.01, hem=crotch + 0.07, neck=0.1, deep=0.17)(p), holes)

    def waistcoat(p: np.ndarray) -> np.ndarray:
        return np.minimum(vest(p), shirt(cuff=2.0, hem=crotch + 0.12, neck=0.1, deep=0.2, gap=0.03)(p))

    def loose(at_chest: float, at_hem: float) -> Ease:
        return lambda p: at_chest + (at_hem - at_chest) * ramp(p[:, 1], shoulder[1] - 0.1, crotch)

    # Loose garments stand off more at the hem than at the chest, and are smoothed more.
    wide = shirt(cuff=elbow[0] - 0.02, hem=crotch + 0.01, neck=0.085)
    sweatshirt = shirt(cuff=long, hem=crotch + 0.05, neck=0.075)
    return [
        grown("tight top", "upper", shirt(cuff=long, hem=waist - 0.06), 0.004, 2),
        grown("undershirt", "upper", vest, 0.006),
        grown("wide T-shirt", "upper", wide, loose(0.016, 0.04), 14),
        grown("long-sleeved shirt", "upper", shirt(cuff=long, hem=crotch + 0.04), loose(0.009, 0.016)),
        grown("crop top", "upper", shirt(cuff=half - 0.05, hem=waist + 0.09, deep=0.15), 0.007),
        grown("sweater", "upper", shirt(cuff=long + 0.01, hem=crotch + 0.07, neck=0.065), 0.024, 12),
        grown("sweatshirt", "upper", sweatshirt, loose(0.018, 0.028), 10),
        grown("closed jacket", "outer", shirt(cuff=long, hem=crotch + 0.06, neck=0.068), 0.027, 12),
        grown("waistcoat", "outer", waistcoat, 0.018),
    ]


def bottoms(mannequin: Mannequin) -> list[Garment]:
    """Return tight and wide, short and long garments of the legs, and shoes."""
    j = mannequin.joints
    (waist, crotch), knee, ankle = _trunk_heights(mannequin), j["left_knee"], j["left_ankle"]
    grown, legs = partial(_grown, mannequin), partial(_legs, mannequin)

    # Trousers stand off the skin more from crotch to knee, and again to the hem.
    def wide(at_knee: float, at_hem: float) -> Ease:
        def ease(p: np.ndarray) -> np.ndarray:
            down = ramp(p[:, 1], crotch, knee[1])
            return 0.008 + (at_knee - 0.008) * down + (at_hem - at_knee) * ramp(p[:, 1], knee[1], ankle[1])

        return ease

    # Soles are 12 mm thicker than the shoe, over the lowest 3 cm.
    def sole(ease: float) -> Ease:
        floor = mannequin.skin.vertices[:, 1].min()
        return lambda p: ease + 0.012 * ramp(p[:, 1], floor + 0.03, floor)

    return [
        grown("leggings", "lower", legs(top=waist, hem=ankle[1] + 0.03), 0.003, 1),
        grown("tight trousers", "lower", legs(top=waist - 0.06, hem=ankle[1] + 0.01), 0.006),
        grown("wide trousers", "lower", legs(top=waist, hem=ankle[1] - 0.02), wide(0.03, 0.05), 10),
        grown("joggers", "lower", legs(top=waist - 0.06, hem=ankle[1] + 0.02), wide(0.022, 0.01), 8),
        grown("knee-length trousers", "lower", legs(top=waist - 0.05, hem=knee[1] - 0.06), wide(0.02, 0.02), 6),
        grown("hot pants", "lower", legs(top=waist - 0.05, hem=crotch - 0.04), 0.008),
        grown("sneakers", "shoe", _boots(ankle[1] + 0.02), sole(0.011), 8),
        grown("ankle boots", "shoe", _boots(ankle[1] + 0.11), sole(0.012), 6),
        grown("knee boots", "shoe", _boots(knee[1] - 0.03), sole(0.012), 8),
    ]


def worn_things(mannequin: Mannequin) -> list[Garment]:
    """Return a headscarf, a backpack with straps and plates of armour."""
    straps = "sack: spine3; straps: as grown"
    return [
        Garment("hijab", "upper", partial(_hijab, mannequin), "the head down to the chin; below it the skin under it"),
        Garment("backpack with straps", "outer", partial(_backpack, mannequin), straps),
        Garment("plates of armour", "outer", partial(_armour, mannequin), "each plate one joint"),
    ]


def _trunk_heights(mannequin: Mannequin) -> tuple[float, float]:
    """Return the heights of waist and crotch, metres."""
    return mannequin.joints["spine1"][1] + 0.03, mannequin.joints["left_hip"][1] - 0.11


def _grown(mannequin: Mannequin, name: str, label: str, level: Level, ease: Ease, fairing: int = 4) -> Garment:
    """Return a garment grown from the skin; see `layer`."""
    return Garment(name, label, partial(layer, mannequin, level, ease=ease, fairing=fairing))


def _legs(mannequin: Mannequin, *, top: float, hem: float) -> Level:
    """Return the level of trousers between two heights."""
    side = mannequin.joints["left_shoulder"][0] + 0.14  # the arms of a T-pose lie farther out
    return lambda p: np.minimum(np.minimum(top - p[:, 1], p[:, 1] - hem), side - np.abs(p[:, 0]))


def _boots(top: float) -> Level:
    """Return the level of shoes up to a height."""
    return lambda p: top - p[:, 1]


def _shirt(
    mannequin: Mannequin, *, cuff: float, hem: float, neck: float = 0.07, deep: float = 0.13, gap: float = 0.0
) -> Level:
    """Return the level of a top.

    Args:
        mannequin: the person.
        cuff: distance of the cuffs from the middle plane, metres.
        hem: height of the hem.
        neck: radius of the neckline.
        deep: metres below the neck's joint down to which the neckline reaches.
        gap: half the width of the opening in front; 0: closed.
    """
    joint = mannequin.joints["neck"]

    def level(p: np.ndarray) -> np.ndarray:
        x, y, z = p.T
        # A round neckline, cuffs, hem and shoulders; the smallest distance decides.
        open_at = np.hypot(x, z - joint[2] - 0.018) - neck
        open_at = np.where(y > joint[1] - deep, open_at, 1.0)
        inside = np.minimum(np.minimum(open_at, cuff - np.abs(x)), np.minimum(y - hem, joint[1] + 0.03 - y))
        return np.minimum(inside, np.where(z > mannequin.axis[1], np.abs(x) - gap, 1.0)) if gap else inside

    return level


def _hood_up(mannequin: Mannequin) -> ClothMesh:
    """Return a hood over the head with a cape over the shoulders."""
    j = mannequin.joints

    def level(p: np.ndarray) -> np.ndarray:
        x, y, z = p.T
        face = np.hypot(x / 0.8, y - j["jaw"][1] - 0.035) - 0.095
        face = np.where(z > j["head"][2] + 0.01, face, 1.0)
        return np.minimum(face, np.minimum(y - j["spine3"][1] - 0.09, j["left_shoulder"][0] + 0.02 - np.abs(x)))

    # The hood widens upwards, and is smoothed until no face shows in it.
    cloth = layer(mannequin, level, ease=lambda p: 0.012 + 0.018 * ramp(p[:, 1], 0.6, 0.75), fairing=30)
    chin, base = j["jaw"][1] - 0.02, j["neck"][1] - 0.01
    # Weights pass from the shoulders at the neck's base to the head at the chin.
    head = ramp(cloth.vertices[:, 1], base, chin)[:, None]
    weights = head * mannequin.rigid("head", len(cloth.vertices)) + (1 - head) * mannequin.below(cloth.vertices)
    return ClothMesh(cloth.vertices, cloth.faces, weights)


def _hood_down(mannequin: Mannequin, shirt: ClothMesh) -> ClothMesh:
    """Return a shirt with its hood as a roll about the nape."""
    j = mannequin.joints
    t = np.linspace(-0.75 * np.pi, 0.75 * np.pi, 50)
    height = j["neck"][1] + 0.012 - 0.03 * (1 + np.cos(t))
    curve = np.stack([0.115 * np.sin(t), height, j["neck"][2] - 0.02 - 0.095 * np.cos(t)], axis=1)
    points, faces = tube_along(curve, 0.016 + 0.026 * np.cos(t / 1.5) ** 2)
    roll = facing_out(mannequin.unweighted(points, faces), np.repeat(curve, 24, axis=0))
    vertices = lift_outside(roll.mesh, mannequin.skin.mesh, clearance=0.012, solid=True)
    # The roll follows the upper spine, its sides half the collar bone of their side.
    collar = ramp(np.abs(vertices[:, 0]), 0.03, 0.16)[:, None]
    left = (vertices[:, 0] > 0)[:, None]
    side = np.where(left, mannequin.rigid("left_collar", len(points)), mannequin.rigid("right_collar", len(points)))
    weights = (1 - 0.5 * collar) * mannequin.rigid("spine3", len(points)) + 0.5 * collar * side
    return joined(shirt, ClothMesh(vertices, roll.faces, weights))


def _scarf(mannequin: Mannequin) -> ClothMesh:
    """Return a roll about the neck with one end that hangs down the chest."""
    j = mannequin.joints
    # The roll: a closed tube, tilted forwards, pushed off the skin.
    t = np.linspace(0, 2 * np.pi, 61)[:-1]
    height = 0.5 * (j["neck"][1] + j["head"][1]) - 0.025
    tilt = 0.03 * np.cos(t)
    curve = np.stack([0.088 * np.sin(t), height - tilt, j["neck"][2] + 0.022 + 0.09 * np.cos(t)], axis=1)
    curve = np.concatenate([curve, curve[:1]])
    points, faces = tube_along(curve, np.full(61, 0.03))
    ring = facing_out(mannequin.unweighted(points, faces), np.repeat(curve, 24, axis=0))
    vertices = lift_outside(ring.mesh, mannequin.skin.mesh, clearance=0.006, solid=True)
    # Weights pass from the upper spine to the neck over the height of the roll.
    up = ramp(vertices[:, 1], height - 0.05, height + 0.05)[:, None]
    count = len(vertices)
    weights = mannequin.rigid("neck", count) * (0.4 + 0.4 * up) + mannequin.rigid("spine3", count) * (0.6 - 0.4 * up)
    ring = ClothMesh(vertices, ring.faces, weights)

    # The end: a strip down the chest that never falls back inwards.
    drop, lateral = np.linspace(height - 0.04, height - 0.42, 40), np.linspace(0.085, 0.005, 10)
    front = mannequin.outline(drop, np.full(40, np.pi / 2)) + 0.012
    deep = mannequin.axis[1] + np.maximum.accumulate(front)[:, None]
    points = np.stack(np.broadcast_arrays(lateral[None, :], drop[:, None], deep), axis=-1).reshape(-1, 3)
    end = ClothMesh(points, grid_faces(40, 10, closed=False), mannequin.trunk_weights(points))
    end = facing_out(end, points - [0.0, 0.0, 1.0])
    pushed = lift_outside(end.mesh, mannequin.skin.mesh, clearance=0.008, solid=True)
    end = end.with_vertices(smooth(end.mesh, pushed, steps=2))
    return joined(ring, end)


def _hijab(mannequin: Mannequin) -> ClothMesh:
    """Return a cloth about head and neck that falls over shoulders and chest."""
    j = mannequin.joints

    def level(p: np.ndarray) -> np.ndarray:
        x, y, z = p.T
        face = np.hypot(x / 0.85, y - j["jaw"][1] - 0.025) - 0.075
        face = np.where(z > j["head"][2] + 0.01, face, 1.0)
        return np.minimum(face, np.minimum(y - j["spine3"][1] - 0.03, j["left_shoulder"][0] + 0.05 - np.abs(x)))

    neck = j["neck"][1]
    cloth = layer(mannequin, level, ease=lambda p: 0.01 + 0.025 * ramp(p[:, 1], neck - 0.02, neck + 0.05), fairing=24)
    head = ramp(cloth.vertices[:, 1], neck - 0.01, j["jaw"][1] - 0.02)[:, None]
    low = ramp(cloth.vertices[:, 1], j["left_shoulder"][1] - 0.09, j["left_shoulder"][1] - 0.02)[:, None]
    below = low * mannequin.below(cloth.vertices) + (1 - low) * mannequin.trunk_weights(cloth.vertices)
    return ClothMesh(
        cloth.vertices, cloth.faces, head * mannequin.rigid("head", len(cloth.vertices)) + (1 - head) * below
    )


def _backpack(mannequin: Mannequin) -> ClothMesh:
    """Return a sack on the back and two straps over the shoulders."""
    j = mannequin.joints
    top, low = j["left_shoulder"][1] + 0.02, j["spine1"][1] - 0.02
    t = np.linspace(0.03, np.pi - 0.03, 40)
    # A rounded sack: a superellipse at every height.
    angle = around(60)
    shape = 1.0 / (np.abs(np.cos(angle)) ** 4 + np.abs(np.sin(angle)) ** 4) ** 0.25
    y = 0.5 * (top + low) + 0.5 * (top - low) * np.cos(t)
    grow = np.sin(t) ** 0.4
    x = 0.14 * grow[:, None] * shape * np.cos(angle)
    z = -0.225 + 0.085 * grow[:, None] * shape * np.sin(angle)
    points = np.stack(np.broadcast_arrays(x, y[:, None], z), axis=-1).reshape(-1, 3)
    sack = facing_out(mannequin.unweighted(points, grid_faces(40, 60, closed=True)), 0 * points + points.mean(axis=0))
    sack = ClothMesh(
        lift_outside(sack.mesh, mannequin.skin.mesh, clearance=0.006, solid=True),
        sack.faces,
        mannequin.rigid("spine3", len(points)),
    )

    def strap(p: np.ndarray) -> np.ndarray:
        return np.minimum(0.025 - np.abs(np.abs(p[:, 0]) - 0.105), p[:, 1] - j["spine3"][1] + 0.02)

    return joined(sack, layer(mannequin, strap, ease=0.008))


def _armour(mannequin: Mannequin) -> ClothMesh:
    """Return a breastplate, two plates on the thighs, two on the shins and two on the upper arms."""
    j = mannequin.joints

    def band(axis: int, sign: float, low: float, high: float):
        def level(p: np.ndarray) -> np.ndarray:
            front = p[:, 2] - (j["left_hip"][2] - 0.01) if axis == 1 else p[:, 1] - j["left_shoulder"][1] - 0.005
            side = sign * p[:, 0] - 0.03 if axis == 1 else 1.0
            return np.minimum(
                np.minimum(front, side),
                np.minimum(sign * p[:, 0] - low, high - sign * p[:, 0])
                if axis == 0
                else np.minimum(p[:, 1] - low, high - p[:, 1]),
            )

        return level

    def breast(p: np.ndarray) -> np.ndarray:
        return np.minimum(
            np.minimum(p[:, 2] - mannequin.axis[1] - 0.01, 0.15 - np.abs(p[:, 0])),
            np.minimum(p[:, 1] - j["spine2"][1], j["spine3"][1] + 0.15 - p[:, 1]),
        )

    pieces = [(breast, "spine3")]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        hip, knee, ankle = j["left_hip"][1], j["left_knee"][1], j["left_ankle"][1]
        pieces.append((band(1, sign, knee + 0.09, hip - 0.1), f"{side}_hip"))
        pieces.append((band(1, sign, ankle + 0.07, knee - 0.06), f"{side}_knee"))
        pieces.append((band(0, sign, j["left_shoulder"][0] + 0.05, j["left_elbow"][0] - 0.05), f"{side}_shoulder"))
    out = []
    for level, joint in pieces:
        cloth = layer(mannequin, level, ease=0.012, fairing=4)
        out.append(ClothMesh(cloth.vertices, cloth.faces, mannequin.rigid(joint, len(cloth.vertices))))
    return joined(*out)
