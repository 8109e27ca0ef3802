"""Garments that lie on the skin: grown from it, so that a vertex keeps the weights of the skin it was grown from."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.garments.cut import Garment, Level, facing_out, grid_faces, joined, layer, tube_along
from benchmarks.garments.mannequin import Mannequin
from pipelines.synth.cloth_mesh import ClothMesh, push_out, smooth
from pipelines.synth.noise import ramp

_GROWN = "the weights of the skin that each vertex was grown from"
_HOOD_UP = "the head from the chin up, from the neck's base down the shoulders' skin straight below, smooth between"
_HOOD_DOWN = "shirt: as grown; the hood's roll: spine3, at its sides half the collar bone"
_SCARF = "roll: neck 0.4 to 0.8 by height, else spine3; the end: the trunk's skin at its height and azimuth"


def fitted_garments(mannequin: Mannequin) -> list[Garment]:
    """All that keeps to the skin, and what is sewn to it."""
    j = mannequin.joints
    waist, crotch = j["spine1"][1] + 0.03, j["left_hip"][1] - 0.11
    knee, ankle, shoulder, elbow = j["left_knee"], j["left_ankle"], j["left_shoulder"], j["left_elbow"]

    def legs(p: np.ndarray, *, top: float, hem: float) -> np.ndarray:
        return np.minimum(np.minimum(top - p[:, 1], p[:, 1] - hem), shoulder[0] + 0.14 - np.abs(p[:, 0]))

    def shirt(p: np.ndarray, *, cuff: float, hem: float) -> np.ndarray:
        neck = np.hypot(p[:, 0], p[:, 2] - j["neck"][2] - 0.018) - 0.07
        neck = np.where(p[:, 1] > j["neck"][1] - 0.13, neck, 1.0)
        height = np.minimum(p[:, 1] - hem, j["neck"][1] + 0.03 - p[:, 1])
        return np.minimum(np.minimum(neck, height), cuff - np.abs(p[:, 0]))

    def overalls(p: np.ndarray) -> np.ndarray:
        trousers = legs(p, top=waist + 0.02, hem=ankle[1] + 0.02)
        x, y, z = p.T
        bib = np.minimum(0.115 - np.abs(x), np.minimum(z - mannequin.axis[1], j["spine3"][1] + 0.09 - y))
        strap = np.minimum(0.024 - np.abs(np.abs(x) - 0.088), j["neck"][1] + 0.03 - y)
        return np.maximum(trousers, np.minimum(np.maximum(bib, strap), y - waist))

    def boots(p: np.ndarray, *, top: float) -> np.ndarray:
        return np.minimum(top - p[:, 1], 1.0 - np.abs(p[:, 0]))

    def coat(p: np.ndarray, *, open_by: float) -> np.ndarray:
        front = np.where(p[:, 2] > mannequin.axis[1], np.abs(p[:, 0]) - open_by, 1.0)
        return np.minimum(shirt(p, cuff=j["left_wrist"][0] - 0.02, hem=crotch + 0.06), front)

    def suit(p: np.ndarray) -> np.ndarray:
        return np.minimum(shirt(p, cuff=j["left_wrist"][0] - 0.02, hem=ankle[1] + 0.02), 1.0)

    def glove(p: np.ndarray) -> np.ndarray:
        return np.abs(p[:, 0]) - elbow[0] - 0.1

    def grown(level: Level, *, ease: float, fairing: int = 4) -> Callable[[], ClothMesh]:
        return partial(layer, mannequin, level, ease=ease, fairing=fairing)

    tee = grown(lambda p: shirt(p, cuff=0.5 * (shoulder[0] + elbow[0]), hem=crotch + 0.08), ease=0.011)
    return [
        Garment("T-shirt", "upper", tee, _GROWN),
        Garment("trousers", "lower", grown(lambda p: legs(p, top=waist, hem=ankle[1]), ease=0.01), _GROWN),
        Garment("shorts", "lower", grown(lambda p: legs(p, top=waist, hem=crotch - 0.16), ease=0.014), _GROWN),
        Garment("overalls with straps", "lower", grown(overalls, ease=0.008), _GROWN),
        Garment("high boots", "shoe", grown(lambda p: boots(p, top=knee[1] + 0.12), ease=0.009), _GROWN),
        Garment("low shoes", "shoe", grown(lambda p: boots(p, top=ankle[1] + 0.01), ease=0.008), _GROWN),
        Garment("open jacket", "outer", grown(lambda p: coat(p, open_by=0.05), ease=0.017), _GROWN),
        Garment("jumpsuit", "upper", grown(suit, ease=0.009), _GROWN),
        Garment("long gloves", "upper", grown(glove, ease=0.004, fairing=2), _GROWN),
        Garment("hood up", "upper", partial(_hood_up, mannequin), _HOOD_UP),
        Garment("hood down", "upper", lambda: _hood_down(mannequin, tee()), _HOOD_DOWN),
        Garment("scarf", "upper", partial(_scarf, mannequin), _SCARF),
    ]


def _hood_up(mannequin: Mannequin) -> ClothMesh:
    """A hood over the head with a cape over the shoulders."""
    j = mannequin.joints

    def level(p: np.ndarray) -> np.ndarray:
        x, y, z = p.T
        face = np.hypot(x / 0.8, y - j["jaw"][1] - 0.035) - 0.095
        face = np.where(z > j["head"][2] + 0.01, face, 1.0)
        return np.minimum(face, np.minimum(y - j["spine3"][1] - 0.09, j["left_shoulder"][0] + 0.02 - np.abs(x)))

    cloth = layer(mannequin, level, ease=lambda p: 0.012 + 0.018 * ramp(p[:, 1], 0.6, 0.75), fairing=30)
    chin, base = j["jaw"][1] - 0.02, j["neck"][1] - 0.01
    head = ramp(cloth.vertices[:, 1], base, chin)[:, None]
    weights = head * mannequin.rigid("head", len(cloth.vertices)) + (1 - head) * mannequin.below(cloth.vertices)
    return ClothMesh(cloth.vertices, cloth.faces, weights)


def _hood_down(mannequin: Mannequin, shirt: ClothMesh) -> ClothMesh:
    """A shirt, and its hood as a roll about the nape."""
    j = mannequin.joints
    t = np.linspace(-0.75 * np.pi, 0.75 * np.pi, 50)
    height = j["neck"][1] + 0.012 - 0.03 * (1 + np.cos(t))
    curve = np.stack([0.115 * np.sin(t), height, j["neck"][2] - 0.02 - 0.095 * np.cos(t)], axis=1)
    points, faces = tube_along(curve, 0.016 + 0.026 * np.cos(t / 1.5) ** 2)
    roll = ClothMesh(points, faces, np.zeros((len(points), mannequin.body.joint_count)))
    roll = facing_out(roll, np.repeat(curve, 24, axis=0))
    vertices = push_out(roll.mesh, mannequin.skin.mesh, clearance=0.012, solid=True)
    collar = ramp(np.abs(vertices[:, 0]), 0.03, 0.16)[:, None]
    left = (vertices[:, 0] > 0)[:, None]
    side = np.where(left, mannequin.rigid("left_collar", len(points)), mannequin.rigid("right_collar", len(points)))
    weights = (1 - 0.5 * collar) * mannequin.rigid("spine3", len(points)) + 0.5 * collar * side
    return joined(shirt, ClothMesh(vertices, roll.faces, weights))


def _scarf(mannequin: Mannequin) -> ClothMesh:
    """A roll about the neck and one end that hangs down the chest."""
    j = mannequin.joints
    t = np.linspace(0, 2 * np.pi, 61)[:-1]
    height = 0.5 * (j["neck"][1] + j["head"][1]) - 0.025
    tilt = 0.03 * np.cos(t)
    curve = np.stack([0.088 * np.sin(t), height - tilt, j["neck"][2] + 0.022 + 0.09 * np.cos(t)], axis=1)
    curve = np.concatenate([curve, curve[:1]])
    points, faces = tube_along(curve, np.full(61, 0.03))
    ring = ClothMesh(points, faces, np.zeros((len(points), mannequin.body.joint_count)))
    ring = facing_out(ring, np.repeat(curve, 24, axis=0))
    vertices = push_out(ring.mesh, mannequin.skin.mesh, clearance=0.006, solid=True)
    up = ramp(vertices[:, 1], height - 0.05, height + 0.05)[:, None]
    count = len(vertices)
    weights = mannequin.rigid("neck", count) * (0.4 + 0.4 * up) + mannequin.rigid("spine3", count) * (0.6 - 0.4 * up)
    ring = ClothMesh(vertices, ring.faces, weights)

    drop, lateral = np.linspace(height - 0.04, height - 0.42, 40), np.linspace(0.085, 0.005, 10)
    front = mannequin.outline(drop, np.full(40, np.pi / 2)) + 0.012
    deep = mannequin.axis[1] + np.maximum.accumulate(front)[:, None]
    points = np.stack(np.broadcast_arrays(lateral[None, :], drop[:, None], deep), axis=-1).reshape(-1, 3)
    end = ClothMesh(points, grid_faces(40, 10, closed=False), mannequin.trunk_weights(points))
    end = facing_out(end, points - [0.0, 0.0, 1.0])
    pushed = push_out(end.mesh, mannequin.skin.mesh, clearance=0.008, solid=True)
    end = end.with_vertices(smooth(end.mesh, pushed, steps=2))
    return joined(ring, end)
