"""All layers of the person through a performance: skinning for body and shoes, dynamics for clothes and hair."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from pipelines.synth.garment import Block, Garment, Stepping
from pipelines.synth.motion import Motion
from pipelines.synth.noise import ramp
from pipelines.synth.person import PART_NAMES, Person
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.signed_distance import SignedDistanceField

# Metres behind skin and skirt up to which cloth is pushed out of them: half a limb, little of a sheet.
_SKIN_DEPTH, _SHEET_DEPTH = 0.05, 0.02
UPPER, LOWER, HAIR = (PART_NAMES.index(name) for name in ("upper", "lower", "hair"))


@dataclass(frozen=True)
class SimulationConfig:
    """Steps in time, distances and materials of a simulation.

    Attributes:
        fps: of the frames.
        tick: longest time between two poses that move the clothes, seconds.
        settle: seconds in which the clothes come to rest on the first pose before the motion starts.
        skin_margin, sheet_margin: metres that cloth keeps from the skin, and the shirt from the skirt.
        substep: seconds at most, a garment: the skirt hangs from its waist alone and needs shorter ones.
        stepping: material, and how time is stepped.
    """

    fps: float = 10.0
    tick: float = 1.0 / 50.0
    settle: float = 0.8
    skin_margin: float = 0.004
    sheet_margin: float = 0.003
    substep: Mapping[str, float] = field(default_factory=lambda: {"lower": 1.0 / 1000.0, "upper": 1.0 / 600.0})
    stepping: Stepping = field(default_factory=Stepping)


@dataclass(frozen=True, eq=False)
class Take:
    """T frames of the person.

    Attributes:
        params: exact parameters; she stands on the floor, y = 0.
        vertices: all layers.
        skinned: the same by linear blend skinning alone.
        attachment: how much a vertex follows skinning: 1 wholly, 0 free cloth.
    """

    params: BodyParams
    vertices: Float[np.ndarray, "T V 3"]
    skinned: Float[np.ndarray, "T V 3"]
    attachment: Float[np.ndarray, " V"]


def simulate(
    person: Person,
    performance: Motion,
    frames: int,
    config: SimulationConfig,
    progress: Callable[[float], None] = lambda share: None,
) -> Take:
    """Play `frames` frames of the performance; frame 0 is the first pose with settled clothes.

    `progress` is called with the share of the work done.
    """
    stage = _Stage(person, performance, config)
    ticks_per_frame = int(np.ceil(1.0 / (config.fps * config.tick)))
    settling = int(np.ceil(config.settle / config.tick))
    total = settling + ticks_per_frame * (frames - 1)
    for k in range(settling):
        stage.advance(0.0, config.tick, damped=k < settling - 10)
        progress((k + 1) / total)
    states = [stage.layers()]
    for frame in range(1, frames):
        for k in range(ticks_per_frame):
            time = (frame - 1 + (k + 1) / ticks_per_frame) / config.fps
            stage.advance(time, 1.0 / (config.fps * ticks_per_frame))
            progress((settling + (frame - 1) * ticks_per_frame + k + 1) / total)
        states.append(stage.layers())
    params, skinned = stage.standing(np.arange(frames) / config.fps)[:2]
    return Take(replace(params, fps=config.fps), np.stack(states), skinned, attachment(person))


def attachment(person: Person) -> Float[np.ndarray, " V"]:
    """Return how much each vertex follows the body: 1 exactly, 0 where it is free.

    Clothes hold on where they are worn tight and something carries them: the skirt at the waist, the shirt on the
    shoulders and the upper sleeves. Tight is told by the distance to the skin in the T-pose; trousers are
    tight all over.
    """
    vertices, part = person.tpose.vertices, person.vertex_part
    body = TriangleMesh(vertices[: person.body.vertex_count], person.body.faces)
    joint = dict(zip(person.body.joint_names, person.body.joint_regressor @ body.vertices, strict=True))
    out = np.ones(len(vertices))
    cloth = np.flatnonzero((part == UPPER) | (part == LOWER))
    distance = SignedDistanceField(body, solid=True).query(vertices[cloth]).distance
    tight = np.zeros(len(vertices))
    tight[cloth] = ramp(distance, 0.020, 0.011)
    x, y = np.abs(vertices[:, 0]), vertices[:, 1]
    waist = vertices[part == LOWER, 1].max()
    shoulder, elbow = joint["left_shoulder"], joint["left_elbow"]
    carried = np.where(
        part == LOWER,
        ramp(y, waist - 0.06, waist - 0.03),
        ramp(y, shoulder[1] - 0.16, shoulder[1] - 0.05)
        * ramp(x, shoulder[0] + 0.30 * (elbow[0] - shoulder[0]), shoulder[0] + 0.05 * (elbow[0] - shoulder[0])),
    )
    # The waistband is tight by itself.
    band = (part == LOWER) & (y > waist - 0.03)
    if person.clothes == "trousers":
        band = part == LOWER
    out[cloth] = np.where(band, 1.0, tight * carried)[cloth]
    out[out > 0.6] = 1.0
    return out


class HairLag:
    """The rotation by which hair trails behind its head: a damped rotational spring.

    `w' = -stiffness a - damping w - gain (head's angular acceleration)`, `a' = w`, with `a` the lag as a rotation
    vector in the world; semi-implicit steps.

    Args:
        head: world_from_head at the start, at rest.
    """

    STIFFNESS, DAMPING, GAIN, LARGEST = 260.0, 9.0, 0.55, np.radians(9.0)

    def __init__(self, head: Float[np.ndarray, "3 3"]) -> None:
        self._head, self._spin = head, np.zeros(3)
        self._angle, self._rate = np.zeros(3), np.zeros(3)

    def advance(self, head: Float[np.ndarray, "3 3"], seconds: float) -> None:
        """Follow the head to `head` within `seconds`."""
        spin = rotvec_from_matrix(head @ self._head.T) / seconds
        push = self.GAIN * (spin - self._spin)
        self._rate += -push - seconds * (self.STIFFNESS * self._angle + self.DAMPING * self._rate)
        self._angle = self._angle + seconds * self._rate
        length = np.linalg.norm(self._angle)
        if length > self.LARGEST:
            self._angle *= self.LARGEST / length
        self._head, self._spin = head, spin

    def applied(
        self, points: Float[np.ndarray, "N 3"], looseness: Float[np.ndarray, " N"], pivot: Float[np.ndarray, " 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """Turn points of the hair about `pivot` by their share `looseness` of the lag."""
        turned = matrix_from_rotvec(looseness[:, None] * self._angle)
        return pivot + np.einsum("nij,nj->ni", turned, points - pivot)


class _Stage:
    """The moving things at one instant."""

    def __init__(self, person: Person, performance: Motion, config: SimulationConfig) -> None:
        self.person, self.performance, self.config = person, performance, config
        self.hair = np.flatnonzero(person.vertex_part == HAIR)
        self._skin = Block(_contact_faces(person), config.skin_margin, _SKIN_DEPTH)
        self._head = person.body.joint_names.index("head")
        self._ankles = [person.body.joint_names.index(name) for name in ("left_ankle", "right_ankle")]
        self._planted: Float[np.ndarray, " 3"] | None = None
        _, layers, transforms = self.standing(np.zeros(1))
        self._layers = layers[0]
        self._pivot = self._head_joint(transforms[0])
        self.lag = HairLag(transforms[0, self._head, :3, :3])
        self._looseness = self._hair_looseness()
        self._skirt_vertices, self.skirt = self._garment(LOWER, [self._skin])
        sheet = Block(self.skirt.mesh.faces, config.sheet_margin, _SHEET_DEPTH)
        self._shirt_vertices, self.shirt = self._garment(UPPER, [self._skin, sheet])

    def standing(
        self, times: Float[np.ndarray, " T"]
    ) -> tuple[BodyParams, Float[np.ndarray, "T V 3"], Float[np.ndarray, "T 55 4 4"]]:
        """Return parameters with the lowest vertex at y = 0, all layers skinned, the joints' transforms."""
        params = self.performance.at(times)
        layers, posed_from_rest = self.person.posed(params)
        up = np.round(-layers[..., 1].min(axis=1), 5)
        layers[..., 1] += up[:, None]
        transforms = posed_from_rest.copy()
        transforms[:, :, 1, 3] += up[:, None]
        transl = np.stack([0 * up, up, 0 * up], axis=1)
        if self.performance.feet_stay:
            aside = self._aside(transforms)
            transl += aside
            layers += aside[:, None]
            transforms[:, :, :3, 3] += aside[:, None]
        return replace(params, transl=transl), layers, transforms

    def _aside(self, transforms: Float[np.ndarray, "T 55 4 4"]) -> Float[np.ndarray, "T 3"]:
        """Return the level way that keeps the middle between the ankles where it was at first."""
        body = self.person.body
        rest = body.joint_regressor[self._ankles] @ self.person.tpose.vertices[: body.vertex_count]
        of_ankles = transforms[:, self._ankles]
        middle = (np.einsum("tkij,kj->tki", of_ankles[..., :3, :3], rest) + of_ankles[..., :3, 3]).mean(axis=1)
        if self._planted is None:
            self._planted = middle[0]
        return np.round((self._planted - middle) * [1.0, 0.0, 1.0], 5)

    def advance(self, time: float, seconds: float, *, damped: bool = False) -> None:
        """Go on to `time`, which is `seconds` later: the skirt on the body, then the shirt on both.

        `damped` takes most speed away first.
        """
        _, layers, transforms = self.standing(np.array([time]))
        before, after = self._layers, layers[0]
        skin, skirt = (before, after), self._skirt_vertices
        skirt_before = self.skirt.position
        self.skirt.advance(seconds, (before[skirt], after[skirt]), [skin], damped=damped)
        sheet, shirt = (skirt_before, self.skirt.position), self._shirt_vertices
        self.shirt.advance(seconds, (before[shirt], after[shirt]), [skin, sheet], damped=damped)
        self.lag.advance(transforms[0, self._head, :3, :3], seconds)
        self._pivot = self._head_joint(transforms[0])
        self._layers = after

    def layers(self) -> Float[np.ndarray, "V 3"]:
        """Return all layers as they are now."""
        out = self._layers.copy()
        out[self._skirt_vertices], out[self._shirt_vertices] = self.skirt.position, self.shirt.position
        out[self.hair] = self.lag.applied(out[self.hair], self._looseness, self._pivot)
        return out

    def _garment(self, part: int, touches: list[Block]) -> tuple[Int[np.ndarray, " N"], Garment]:
        """Return the vertices of a part among all, and the part as a garment on the first pose."""
        layers = TriangleMesh(self._layers, self.person.tpose.faces)
        rest, vertices = layers.submesh(self.person.face_part == part)
        stepping = self.config.stepping
        solver = replace(stepping.solver, substep=self.config.substep[PART_NAMES[part]])
        hold = attachment(self.person)[vertices]
        return vertices, Garment(rest, hold, touches, replace(stepping, solver=solver))

    def _head_joint(self, transforms: Float[np.ndarray, "55 4 4"]) -> Float[np.ndarray, " 3"]:
        """Return where the head's joint is: the hair's pivot."""
        body = self.person.body
        rest = body.joint_regressor[self._head] @ self.person.tpose.vertices[: body.vertex_count]
        return transforms[self._head, :3, :3] @ rest + transforms[self._head, :3, 3]

    def _hair_looseness(self) -> Float[np.ndarray, " H"]:
        """Return 0 on the crown, 1 at the tips."""
        y = self.person.tpose.vertices[self.hair, 1]
        return ramp(y, y.max() - 0.10, y.min() + 0.02)


def _contact_faces(person: Person) -> Int[np.ndarray, "F 3"]:
    """Return the faces of the skin below the head: what cloth can touch."""
    body = person.body
    rest = person.tpose.vertices[: body.vertex_count]
    joint = body.joint_regressor @ rest
    outer = body.part_labels == body.part_label_names.index("body")
    low = rest[:, 1] < joint[body.joint_names.index("head"), 1]
    return body.faces[(outer & low)[body.faces].all(axis=1)]
