"""Move all layers of the person through a performance: skinning for body and shoes, dynamics for clothes and hair."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from smplxpp.core import BodyParams, TriangleMesh, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.people.fixture_person import PART_NAMES, Person, rest_joints
from smplxpp.people.textures import ramp
from smplxpp.synth.garment_dynamics import ContactSurface, GarmentConfig, GarmentDynamics
from smplxpp.synth.motion import Motion

UPPER, LOWER, HAIR = (PART_NAMES.index(name) for name in ("upper", "lower", "hair"))


@dataclass(frozen=True)
class SimulationConfig:
    """Time steps, distances and materials of a simulation.

    Attributes:
        fps: frames per second.
        tick: longest time between two poses that move the clothes, seconds.
        settle: seconds in which the clothes come to rest on the first pose before the motion starts.
        skin_margin: metres that cloth keeps from the skin.
        sheet_margin: metres that the shirt keeps from the skirt.
        substep: longest time step of each garment, seconds; the skirt hangs from its waist and needs shorter ones.
        stepping: material and time steps of the garments.
    """

    fps: float = 10.0
    tick: float = 1.0 / 50.0
    settle: float = 0.8
    skin_margin: float = 0.004
    sheet_margin: float = 0.003
    substep: Mapping[str, float] = field(default_factory=lambda: {"lower": 1.0 / 1000.0, "upper": 1.0 / 600.0})
    stepping: GarmentConfig = field(default_factory=GarmentConfig)


@dataclass(frozen=True, eq=False)
class Take:
    """The simulated frames of a performance.

    Attributes:
        params: exact parameters; the floor is y = 0.
        vertices: vertices of all layers.
        skinned: the same by linear blend skinning alone.
        attachment: share of skinning in each vertex's motion: 1 body, 0 free cloth.
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
    """Simulate frames of a performance; frame 0 is the first pose with settled clothes.

    Args:
        person: the dressed person.
        performance: her motion.
        frames: number of frames.
        config: time steps, distances and materials.
        progress: called with the share of the work that is done.
    """
    stage = _Stage(person, performance, config)
    ticks_per_frame = int(np.ceil(1.0 / (config.fps * config.tick)))
    settling = int(np.ceil(config.settle / config.tick))
    total = settling + ticks_per_frame * (frames - 1)
    # Let the clothes settle on the first pose, damped until the last ten ticks.
    for k in range(settling):
        stage.advance(0.0, config.tick, damped=k < settling - 10)
        progress((k + 1) / total)
    states = [stage.layers()]
    # Then play the motion, each frame in equal ticks.
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

    Clothes are attached where they are tight and carried: the skirt at the waist, the shirt on the shoulders and the
    upper sleeves. Tight means near the skin in the T-pose; trousers are tight all over.
    """
    vertices, part = person.tpose.vertices, person.vertex_part
    body = TriangleMesh(vertices[: person.body.vertex_count], person.body.faces)
    joint = rest_joints(person.body, body.vertices)
    out = np.ones(len(vertices))
    cloth = np.flatnonzero((part == UPPER) | (part == LOWER))
    # Tight cloth is within 11 mm of the skin; it is free from 20 mm on.
    distance = SignedDistanceField(body, solid=True).query(vertices[cloth]).distance
    tight = np.zeros(len(vertices))
    tight[cloth] = ramp(distance, 0.020, 0.011)
    # Carried cloth: the top of the skirt, shoulders and upper sleeves.
    x, y = np.abs(vertices[:, 0]), vertices[:, 1]
    waist = vertices[part == LOWER, 1].max()
    shoulder, elbow = joint["left_shoulder"], joint["left_elbow"]
    carried = np.where(
        part == LOWER,
        ramp(y, waist - 0.06, waist - 0.03),
        ramp(y, shoulder[1] - 0.16, shoulder[1] - 0.05)
        * ramp(x, shoulder[0] + 0.30 * (elbow[0] - shoulder[0]), shoulder[0] + 0.05 * (elbow[0] - shoulder[0])),
    )
    # The waistband holds whatever its distance.
    band = (part == LOWER) & (y > waist - 0.03)
    if person.clothes == "trousers":
        band = part == LOWER
    out[cloth] = np.where(band, 1.0, tight * carried)[cloth]
    out[out > 0.6] = 1.0
    return out


class HairLag:
    """The rotational lag of the hair behind the head: a damped spring.

    `w' = -stiffness a - damping w - gain (head's angular acceleration)`, `a' = w`, with `a` the lag as a rotation
    vector in the world, at most 9 degrees; semi-implicit Euler steps.

    Args:
        head: world_from_head at the start, at rest.
    """

    STIFFNESS, DAMPING, GAIN, LARGEST = 260.0, 9.0, 0.55, np.radians(9.0)

    def __init__(self, head: Float[np.ndarray, "3 3"]) -> None:
        self._head, self._spin = head, np.zeros(3)
        self._angle, self._rate = np.zeros(3), np.zeros(3)

    def advance(self, head: Float[np.ndarray, "3 3"], seconds: float) -> None:
        """Follow the head to `head` within `seconds`."""
        # Angular velocity of the head in this tick; the spring sees its change.
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
        """Rotate points of the hair about `pivot` by their share `looseness` of the lag."""
        turned = matrix_from_rotvec(looseness[:, None] * self._angle)
        return pivot + np.einsum("nij,nj->ni", turned, points - pivot)


class _Stage:
    """State of all moving layers at one instant."""

    def __init__(self, person: Person, performance: Motion, config: SimulationConfig) -> None:
        self.person, self.performance, self.config = person, performance, config
        self.hair = np.flatnonzero(person.vertex_part == HAIR)
        # Cloth is pushed out of the skin from half a limb's depth, out of the skirt from 2 cm.
        self._skin = ContactSurface(_contact_faces(person), config.skin_margin, deepest=0.05)
        self._head = person.body.joint_names.index("head")
        self._ankles = [person.body.joint_names.index(name) for name in ("left_ankle", "right_ankle")]
        self._planted: Float[np.ndarray, " 3"] | None = None
        _, layers, transforms = self.standing(np.zeros(1))
        self._layers = layers[0]
        self._pivot = self._head_joint(transforms[0])
        self.lag = HairLag(transforms[0, self._head, :3, :3])
        self._looseness = self._hair_looseness()
        self._skirt_vertices, self.skirt = self._garment(LOWER, [self._skin])
        sheet = ContactSurface(self.skirt.mesh.faces, config.sheet_margin, deepest=0.02)
        self._shirt_vertices, self.shirt = self._garment(UPPER, [self._skin, sheet])

    def standing(
        self, times: Float[np.ndarray, " T"]
    ) -> tuple[BodyParams, Float[np.ndarray, "T V 3"], Float[np.ndarray, "T 55 4 4"]]:
        """Return parameters with the lowest vertex at y = 0, all layers skinned, the joints' transforms."""
        params = self.performance.at(times)
        layers, posed_from_rest = self.person.posed(params)
        # Put the lowest vertex of every frame on the floor.
        up = np.round(-layers[..., 1].min(axis=1), 5)
        layers[..., 1] += up[:, None]
        transforms = posed_from_rest.copy()
        transforms[:, :, 1, 3] += up[:, None]
        transl = params.transl + np.stack([0 * up, up, 0 * up], axis=1)
        # Feet that stay: shift the body so that the ankles keep their place.
        if self.performance.feet_stay:
            aside = self._aside(transforms)
            transl += aside
            layers += aside[:, None]
            transforms[:, :, :3, 3] += aside[:, None]
        return replace(params, transl=transl), layers, transforms

    def _aside(self, transforms: Float[np.ndarray, "T 55 4 4"]) -> Float[np.ndarray, "T 3"]:
        """Return the horizontal shift that keeps the midpoint of the ankles at its first place."""
        body = self.person.body
        rest = body.joint_regressor[self._ankles] @ self.person.tpose.vertices[: body.vertex_count]
        of_ankles = transforms[:, self._ankles]
        middle = (np.einsum("tkij,kj->tki", of_ankles[..., :3, :3], rest) + of_ankles[..., :3, 3]).mean(axis=1)
        if self._planted is None:
            self._planted = middle[0]
        return np.round((self._planted - middle) * [1.0, 0.0, 1.0], 5)

    def advance(self, time: float, seconds: float, *, damped: bool = False) -> None:
        """Advance to `time`, `seconds` later: the skirt on the body, then the shirt on both.

        Args:
            time: instant of the performance, seconds.
            seconds: length of the tick.
            damped: whether to damp all velocities first.
        """
        # The body moves first; clothes see where it starts and ends.
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
        """Return the current vertices of all layers."""
        out = self._layers.copy()
        out[self._skirt_vertices], out[self._shirt_vertices] = self.skirt.position, self.shirt.position
        out[self.hair] = self.lag.applied(out[self.hair], self._looseness, self._pivot)
        return out

    def _garment(self, part: int, touches: list[ContactSurface]) -> tuple[Int[np.ndarray, " N"], GarmentDynamics]:
        """Return the vertices of a part among all, and the part as a garment on the first pose."""
        layers = TriangleMesh(self._layers, self.person.tpose.faces)
        rest, vertices = layers.submesh(self.person.face_part == part)
        stepping = self.config.stepping
        solver = replace(stepping.solver, substep=self.config.substep[PART_NAMES[part]])
        hold = attachment(self.person)[vertices]
        return vertices, GarmentDynamics(rest, hold, touches, replace(stepping, solver=solver))

    def _head_joint(self, transforms: Float[np.ndarray, "55 4 4"]) -> Float[np.ndarray, " 3"]:
        """Return the position of the head's joint, about which hair rotates."""
        body = self.person.body
        rest = body.joint_regressor[self._head] @ self.person.tpose.vertices[: body.vertex_count]
        return transforms[self._head, :3, :3] @ rest + transforms[self._head, :3, 3]

    def _hair_looseness(self) -> Float[np.ndarray, " H"]:
        """Return the share of the lag: 0 on the crown, 1 at the tips."""
        y = self.person.tpose.vertices[self.hair, 1]
        return ramp(y, y.max() - 0.10, y.min() + 0.02)


def _contact_faces(person: Person) -> Int[np.ndarray, "F 3"]:
    """Return the faces of the skin below the head, which cloth can touch."""
    body = person.body
    rest = person.tpose.vertices[: body.vertex_count]
    joint = body.joint_regressor @ rest
    outer = body.part_labels == body.part_label_names.index("body")
    low = rest[:, 1] < joint[body.joint_names.index("head"), 1]
    return body.faces[(outer & low)[body.faces].all(axis=1)]
