"""What the wardrobe lacks for whole outfits: tight and wide, short and long, and what goes over other clothes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.garments.cut import Level, joined, layer, tube_along
from benchmarks.garments.hair import skull_cap
from benchmarks.garments.mannequin import Mannequin
from benchmarks.garments.wardrobe import garments_of
from pipelines.synth.cloth_mesh import ClothMesh
from pipelines.synth.noise import ramp
from smplxpp.core.mesh import TriangleMesh

Make = Callable[[], ClothMesh]
_TAIL_WITH_TRUNK = 0.9  # of the weight of a ponytail's end


@dataclass(frozen=True)
class Cut:
    """Attributes: the label of a garment, and what makes it in the T-pose at the mannequin's size."""

    label: str
    make: Make


def all_cuts(mannequin: Mannequin) -> dict[str, Cut]:
    """Every garment and hairstyle by name: the wardrobe's and those made here."""
    cuts = {garment.name: Cut(garment.label, garment.make) for garment in garments_of(mannequin)}
    return cuts | _uppers(mannequin) | _lowers(mannequin) | _hair(mannequin)


def _uppers(mannequin: Mannequin) -> dict[str, Cut]:
    j = mannequin.joints
    crotch, shoulder, elbow, wrist = j["left_hip"][1] - 0.11, j["left_shoulder"], j["left_elbow"], j["left_wrist"]
    waist = j["spine1"][1] + 0.03

    def shirt(*, cuff: float, hem: float, neck: float = 0.07, deep: float = 0.13, gap: float = 0.0) -> Level:
        def level(p: np.ndarray) -> np.ndarray:
            x, y, z = p.T
            open_at = np.hypot(x, z - j["neck"][2] - 0.018) - neck
            open_at = np.where(y > j["neck"][1] - deep, open_at, 1.0)
            inside = np.minimum(np.minimum(open_at, cuff - np.abs(x)), np.minimum(y - hem, j["neck"][1] + 0.03 - y))
            return np.minimum(inside, np.where(z > mannequin.axis[1], np.abs(x) - gap, 1.0)) if gap else inside

        return level

    def vest(p: np.ndarray) -> np.ndarray:
        holes = np.hypot(p[:, 1] - shoulder[1] + 0.02, p[:, 2] - shoulder[2]) - 0.105
        holes = np.where(np.abs(p[:, 0]) > shoulder[0] - 0.025, holes, 1.0)
        return np.minimum(shirt(cuff=shoulder[0] + 0.01, hem=crotch + 0.07, neck=0.1, deep=0.17)(p), holes)

    def grown(level: Level, *, ease: float | Callable, fairing: int = 4) -> Make:
        return lambda: layer(mannequin, level, ease=ease, fairing=fairing)

    def loose(at_chest: float, at_hem: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda p: at_chest + (at_hem - at_chest) * ramp(p[:, 1], shoulder[1] - 0.1, crotch)

    long, half = wrist[0] - 0.015, 0.5 * (shoulder[0] + elbow[0])
    hoodie = grown(shirt(cuff=long, hem=crotch + 0.05, neck=0.075), ease=loose(0.018, 0.028), fairing=10)
    cuts = {
        "tight top": grown(shirt(cuff=long, hem=waist - 0.06), ease=0.004, fairing=2),
        "undershirt": grown(vest, ease=0.006),
        "wide T-shirt": grown(
            shirt(cuff=elbow[0] - 0.02, hem=crotch + 0.01, neck=0.085), ease=loose(0.016, 0.04), fairing=14
        ),
        "long-sleeved shirt": grown(shirt(cuff=long, hem=crotch + 0.04), ease=loose(0.009, 0.016)),
        "crop top": grown(shirt(cuff=half - 0.05, hem=waist + 0.09, deep=0.15), ease=0.007),
        "sweater": grown(shirt(cuff=long + 0.01, hem=crotch + 0.07, neck=0.065), ease=0.024, fairing=12),
        "sweatshirt": hoodie,
    }
    outers = {
        "closed jacket": grown(shirt(cuff=long, hem=crotch + 0.06, neck=0.068), ease=0.027, fairing=12),
        "waistcoat": grown(
            lambda p: np.minimum(vest(p), shirt(cuff=2.0, hem=crotch + 0.12, neck=0.1, deep=0.2, gap=0.03)(p)),
            ease=0.018,
        ),
    }
    return {name: Cut("upper", make) for name, make in cuts.items()} | {
        name: Cut("outer", make) for name, make in outers.items()
    }


def _lowers(mannequin: Mannequin) -> dict[str, Cut]:
    j = mannequin.joints
    waist, crotch = j["spine1"][1] + 0.03, j["left_hip"][1] - 0.11
    knee, ankle, shoulder = j["left_knee"], j["left_ankle"], j["left_shoulder"]

    def legs(*, top: float = waist, hem: float) -> Level:
        return lambda p: np.minimum(np.minimum(top - p[:, 1], p[:, 1] - hem), shoulder[0] + 0.14 - np.abs(p[:, 0]))

    def boots(top: float) -> Level:
        return lambda p: top - p[:, 1]

    def wide(at_knee: float, at_hem: float) -> Callable[[np.ndarray], np.ndarray]:
        def ease(p: np.ndarray) -> np.ndarray:
            down = ramp(p[:, 1], crotch, knee[1])
            return 0.008 + (at_knee - 0.008) * down + (at_hem - at_knee) * ramp(p[:, 1], knee[1], ankle[1])

        return ease

    def sole(ease: float) -> Callable[[np.ndarray], np.ndarray]:
        floor = mannequin.skin.vertices[:, 1].min()
        return lambda p: ease + 0.012 * ramp(p[:, 1], floor + 0.03, floor)

    def made(label: str, level: Level, ease: float | Callable, fairing: int = 4) -> Cut:
        return Cut(label, lambda: layer(mannequin, level, ease=ease, fairing=fairing))

    return {
        "leggings": made("lower", legs(hem=ankle[1] + 0.03), 0.003, 1),
        "tight trousers": made("lower", legs(top=waist - 0.06, hem=ankle[1] + 0.01), 0.006),
        "wide trousers": made("lower", legs(hem=ankle[1] - 0.02), wide(0.03, 0.05), 10),
        "joggers": made("lower", legs(top=waist - 0.06, hem=ankle[1] + 0.02), wide(0.022, 0.01), 8),
        "knee-length trousers": made("lower", legs(top=waist - 0.05, hem=knee[1] - 0.06), wide(0.02, 0.02), 6),
        "hot pants": made("lower", legs(top=waist - 0.05, hem=crotch - 0.04), 0.008),
        "sneakers": made("shoe", boots(ankle[1] + 0.02), sole(0.011), 8),
        "ankle boots": made("shoe", boots(ankle[1] + 0.11), sole(0.012), 6),
        "knee boots": made("shoe", boots(knee[1] - 0.03), sole(0.012), 8),
    }


def _hair(mannequin: Mannequin) -> dict[str, Cut]:
    j = mannequin.joints

    def cap(ease: float) -> Make:
        return lambda: skull_cap(mannequin, ease=ease)

    def ball(centre: tuple[float, float, float], radius: float) -> ClothMesh:
        t = np.linspace(0.02, np.pi - 0.02, 24)
        curve = np.asarray(centre) + radius * np.column_stack([0 * t, np.cos(t), 0 * t])
        points, faces = tube_along(curve, radius * np.sin(t), sides=32)
        return ClothMesh(
            points, _outward(points, faces, 0 * curve + curve.mean(axis=0)), mannequin.rigid("head", len(points))
        )

    def bun() -> ClothMesh:
        return joined(skull_cap(mannequin, ease=0.012), ball((0.0, j["head"][1] + 0.13, j["head"][2] - 0.105), 0.045))

    def tail() -> ClothMesh:
        t = np.linspace(0, 1, 50)
        back = j["head"][2] - 0.1
        curve = np.column_stack(
            [0 * t, j["head"][1] + 0.09 - 0.36 * t, back - 0.05 * np.sin(np.pi * np.minimum(1.4 * t, 1.0)) - 0.02]
        )
        points, faces = tube_along(curve, 0.012 + 0.024 * np.sin(np.pi * (0.08 + 0.88 * t)))
        chin = j["jaw"][1] - 0.045
        head = (1 - _TAIL_WITH_TRUNK * ramp(points[:, 1], chin, chin - 0.3))[:, None]
        trunk = mannequin.trunk_weights(points)
        weights = head * mannequin.rigid("head", len(points)) + (1 - head) * trunk
        return joined(skull_cap(mannequin, ease=0.011), ClothMesh(points, _outward(points, faces, curve), weights))

    makes = {"cropped hair": cap(0.006), "short hair": cap(0.014), "full short hair": cap(0.026)}
    return {name: Cut("hair", make) for name, make in (makes | {"bun": bun, "ponytail": tail}).items()}


def _outward(points: np.ndarray, faces: np.ndarray, line: np.ndarray) -> np.ndarray:
    """The faces of a tube wound outward, seen from the (R, 3) line that it was made along."""
    inner = np.repeat(line, len(points) // len(line), axis=0)
    normals = TriangleMesh(points, faces).vertex_normals
    return faces if (normals * (points - inner)).sum() > 0 else faces[:, ::-1]
