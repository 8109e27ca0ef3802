"""Hair as a scan shows it: shells over the head and locks that lie on shoulders, back and chest; beads about a neck."""

from __future__ import annotations

from functools import partial

import numpy as np

from smplxpp.people.cloth_mesh import ClothMesh, lift_outside, smooth
from smplxpp.people.garments.cut import Garment, facing_out, grid_faces, joined, layer, tube_along
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.people.textures import ramp


def hairstyles(mannequin: Mannequin) -> list[Garment]:
    """Return a bob on the shoulders, long hair down the back, hair over chest and arms, and a braid over the chest."""
    j = mannequin.joints
    head = "the head down to the chin; from there it passes smoothly to "

    def bob() -> ClothMesh:
        return _lying(mannequin, _curtain(mannequin, j["left_shoulder"][1] + 0.045, spread=0.05))

    def long() -> ClothMesh:
        return _hanging(mannequin, _curtain(mannequin, j["spine2"][1], spread=0.035, half=1.25), keeps=0.2)

    def wide() -> ClothMesh:
        return _hanging(mannequin, _curtain(mannequin, j["spine3"][1], spread=0.075, half=np.pi - 0.6), keeps=0.1)

    # Curtains that end higher lie on the shoulders; longer ones hang free.
    return [
        Garment("bob on the shoulders", "hair", bob, head + "the shoulders' skin straight below"),
        Garment("long loose hair", "hair", long, head + "0.8 of the trunk at its height"),
        Garment(
            "hair over chest and shoulders",
            "hair",
            wide,
            head + "0.9 of the trunk at its height; the arms move without it",
            beside_hands=True,
        ),
        Garment(
            "braid over the chest",
            "hair",
            lambda: _braid(mannequin),
            "by the place along the braid: the head down to the chin, the trunk at its height from 14 cm below",
        ),
    ]


def beards(mannequin: Mannequin) -> list[Garment]:
    """Return a full beard."""
    return [Garment("beard", "hair", partial(_beard, mannequin), "half jaw, half head")]


def beads(mannequin: Mannequin) -> Garment:
    """Return a string of beads about the neck that lies on the chest."""
    neck, t = mannequin.joints["neck"], np.append(np.linspace(0, 2 * np.pi, 120, endpoint=False), 0.0)
    front = np.sin(t)
    curve = np.column_stack(
        [0.085 * np.cos(t), neck[1] - 0.02 - 0.16 * (1 + front), neck[2] + 0.02 + 0.13 * front + 0.03 * (front > 0)]
    )

    def make() -> ClothMesh:
        points, faces = tube_along(curve, np.full(len(curve), 0.007), sides=10)
        cloth = facing_out(mannequin.unweighted(points, faces), np.repeat(curve, 10, axis=0))
        vertices = lift_outside(cloth.mesh, mannequin.skin.mesh, clearance=0.004, solid=True)
        return ClothMesh(vertices, cloth.faces, mannequin.trunk_weights(vertices))

    return Garment("string of beads", "upper", make, "trunk at the same height and azimuth", loose=True)


def tied_and_short_hair(mannequin: Mannequin) -> list[Garment]:
    """Return three caps of short hair, a bun and a ponytail."""
    rigid, j = "the head", mannequin.joints

    def ball(centre: tuple[float, float, float], radius: float) -> ClothMesh:
        t = np.linspace(0.02, np.pi - 0.02, 24)
        # A sphere is a tube along its axis whose radius is that of its circles.
        curve = np.asarray(centre) + radius * np.column_stack([0 * t, np.cos(t), 0 * t])
        points, faces = tube_along(curve, radius * np.sin(t), sides=32)
        cloth = ClothMesh(points, faces, mannequin.rigid("head", len(points)))
        return facing_out(cloth, np.repeat(0 * curve + curve.mean(axis=0), 32, axis=0))

    def bun() -> ClothMesh:
        return joined(skull_cap(mannequin, ease=0.012), ball((0.0, j["head"][1] + 0.13, j["head"][2] - 0.105), 0.045))

    def tail() -> ClothMesh:
        t = np.linspace(0, 1, 50)
        back = j["head"][2] - 0.1
        curve = np.column_stack(
            [0 * t, j["head"][1] + 0.09 - 0.36 * t, back - 0.05 * np.sin(np.pi * np.minimum(1.4 * t, 1.0)) - 0.02]
        )
        points, faces = tube_along(curve, 0.012 + 0.024 * np.sin(np.pi * (0.08 + 0.88 * t)))
        # From the chin to 30 cm below it the trunk takes over 0.9 of the weight.
        chin = j["jaw"][1] - 0.045
        head = (1 - 0.9 * ramp(points[:, 1], chin, chin - 0.3))[:, None]
        weights = head * mannequin.rigid("head", len(points)) + (1 - head) * mannequin.trunk_weights(points)
        cloth = facing_out(ClothMesh(points, faces, weights), np.repeat(curve, 24, axis=0))
        return joined(skull_cap(mannequin, ease=0.011), cloth)

    caps = {"cropped hair": 0.006, "short hair": 0.014, "full short hair": 0.026}
    return [
        *(Garment(name, "hair", partial(skull_cap, mannequin, ease=ease), rigid) for name, ease in caps.items()),
        Garment("bun", "hair", bun, rigid),
        Garment("ponytail", "hair", tail, "the head down to the chin; from there it passes to 0.9 of the trunk"),
    ]


def skull_cap(mannequin: Mannequin, *, ease: float = 0.017) -> ClothMesh:
    """Return the hair on the skull, `ease` metres thick, rigid to the head."""
    j = mannequin.joints

    def level(p: np.ndarray) -> np.ndarray:
        # The hairline rises steeply towards the face.
        hairline = j["head"][1] + 0.02 + 1.25 * np.clip(p[:, 2] - j["head"][2] + 0.02, 0, None)
        return p[:, 1] - hairline

    cloth = layer(mannequin, level, ease=ease, fairing=12)
    return ClothMesh(cloth.vertices, cloth.faces, mannequin.rigid("head", len(cloth.vertices)))


def _curtain(mannequin: Mannequin, bottom: float, *, spread: float, half: float = np.pi - 0.95) -> ClothMesh:
    """Return a sheet about the back of the head, `half` radians to each side, that hangs and is pushed off the skin."""
    j = mannequin.joints
    top = j["head"][1] + 0.055
    heights, azimuths = np.linspace(top, bottom, 60), np.linspace(1.5 * np.pi - half, 1.5 * np.pi + half, 70)
    down = ((top - heights) / (top - bottom))[:, None]
    # The radius grows quadratically from the head down; ellipses are 15 % deeper than wide.
    radius = np.broadcast_to(0.096 + spread * down**2, (60, 70))
    centre = j["head"][2] + 0.005
    points = np.stack(
        np.broadcast_arrays(
            1.0 * radius * np.cos(azimuths), heights[:, None], centre + 1.15 * radius * np.sin(azimuths)
        ),
        axis=-1,
    ).reshape(-1, 3)
    cloth = mannequin.unweighted(points, grid_faces(60, 70, closed=False))
    inside = np.column_stack([0 * points[:, 0], points[:, 1], 0 * points[:, 0] + centre])
    cloth = facing_out(cloth, inside)
    # Push it off the skin, smooth it, and push out what smoothing brought too near.
    pushed = lift_outside(cloth.mesh, mannequin.skin.mesh, clearance=0.009, solid=True, reach=0.12)
    pushed = smooth(cloth.mesh, pushed, steps=4)
    return cloth.with_vertices(
        lift_outside(cloth.mesh.with_vertices(pushed), mannequin.skin.mesh, clearance=0.007, solid=True)
    )


def _handed_over(mannequin: Mannequin, cloth: ClothMesh, below: np.ndarray, *, keeps: float, over: float) -> ClothMesh:
    """Weight hair to the head down to the chin, to `below` from `over` metres under it but for the head's share."""
    chin = mannequin.joints["jaw"][1] - 0.045
    head = (keeps + (1 - keeps) * ramp(cloth.vertices[:, 1], chin - over, chin))[:, None]
    weights = head * mannequin.rigid("head", len(cloth.vertices)) + (1 - head) * below
    return ClothMesh(cloth.vertices, cloth.faces, weights)


def _lying(mannequin: Mannequin, curtain: ClothMesh) -> ClothMesh:
    lower = _handed_over(mannequin, curtain, mannequin.below(curtain.vertices), keeps=0.0, over=0.10)
    return joined(skull_cap(mannequin), lower)


def _hanging(mannequin: Mannequin, curtain: ClothMesh, *, keeps: float) -> ClothMesh:
    lower = _handed_over(mannequin, curtain, mannequin.trunk_weights(curtain.vertices), keeps=keeps, over=0.16)
    return joined(skull_cap(mannequin), lower)


def _braid(mannequin: Mannequin) -> ClothMesh:
    """Return a braid from behind the left ear over the shoulder down the chest."""
    j = mannequin.joints
    t = np.linspace(0, 1, 70)
    knots = np.array(
        [
            [0.075, j["head"][1] + 0.03, j["head"][2] - 0.075],
            [0.095, j["neck"][1] + 0.05, j["neck"][2] - 0.01],
            [0.098, j["neck"][1] - 0.01, j["neck"][2] + 0.075],
            [0.095, j["spine3"][1] + 0.12, mannequin.axis[1] + 0.14],
            [0.090, j["spine2"][1] + 0.02, mannequin.axis[1] + 0.15],
        ]
    )
    # A polyline through the knots, smoothed into a curve.
    curve = np.column_stack([np.interp(t, np.linspace(0, 1, 5), knots[:, k]) for k in range(3)])
    for _ in range(30):
        curve[1:-1] = 0.5 * curve[1:-1] + 0.25 * (curve[:-2] + curve[2:])
    points, faces = tube_along(curve, 0.02 + 0.003 * np.sin(40 * t) - 0.008 * t)
    cloth = facing_out(mannequin.unweighted(points, faces), np.repeat(curve, 24, axis=0))
    cloth = cloth.with_vertices(lift_outside(cloth.mesh, mannequin.skin.mesh, clearance=0.003, solid=True, reach=0.08))
    # Weights follow from the centre line, so that a ring of the braid moves rigidly.
    middle = np.repeat(curve, 24, axis=0)
    line = ClothMesh(middle, cloth.faces, cloth.weights)
    weights = _handed_over(mannequin, line, mannequin.trunk_weights(middle), keeps=0.0, over=0.14).weights
    return joined(skull_cap(mannequin), ClothMesh(cloth.vertices, cloth.faces, weights))


def _beard(mannequin: Mannequin) -> ClothMesh:
    """Return a beard from the jaw down before neck and chest."""
    j = mannequin.joints
    drop, azimuth = np.linspace(0, 1, 26), np.linspace(-1.3, 1.3, 30)
    jaw = j["jaw"]
    # From the jaw line, an arc about the jaw joint, down and together.
    radius = 0.085 + 0.03 * np.sin(np.pi * drop)[:, None] + 0 * azimuth
    x = radius * np.sin(azimuth) * (1 - 0.55 * drop[:, None])
    z = jaw[2] + 0.02 + radius * np.cos(azimuth) * (1 - 0.15 * drop[:, None])
    y = jaw[1] - 0.03 - 0.05 * np.cos(azimuth) - 0.2 * drop[:, None] * (0.4 + 0.6 * np.cos(0.9 * azimuth))
    points = np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3)
    cloth = facing_out(mannequin.unweighted(points, grid_faces(26, 30, closed=False)), points - [0, 0, 1])
    vertices = lift_outside(cloth.mesh, mannequin.skin.mesh, clearance=0.006, solid=True)
    weights = 0.5 * mannequin.rigid("jaw", len(points)) + 0.5 * mannequin.rigid("head", len(points))
    return ClothMesh(vertices, cloth.faces, weights)
