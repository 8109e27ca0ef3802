"""Body shapes and poses of procedural people by name.

Poses that bring a hand near something run from a start to an end. How far along the hand stops is found once the
clothes are on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from smplxpp.body import BodyModel
from smplxpp.core.params import BodyParams
from smplxpp.people.cloth_mesh import ClothMesh
from smplxpp.people.garments.mannequin import Mannequin

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
Turns = dict[str, np.ndarray]

# Leading shape coefficients of the open body: 0 is short (+) or tall (-), 1 and 2 man (-) or woman (+), 4 and 5 weight.
BUILDS: dict[str, tuple[float, ...]] = {
    "mean": (0.0,),
    "woman": (0.35, 1.4, 0.9, 0.6),
    "man": (-0.2, -1.4, -1.0, 0.3),
    "tall man": (-0.75, -1.2, -1.3, -0.6),
    "tall woman": (-0.3, 1.3, 1.0, -0.5, -0.6),
    "small woman": (0.95, 1.2, 1.1, 0.2),
    "tiny woman": (1.3, 0.9, 0.6, 0.0, -0.5),
    "child-sized": (2.1, -0.4, 0.3, -0.5, -0.8, -0.6),
    "thin woman": (0.1, 1.0, 1.0, -0.8, -1.7, -1.5),
    "thin man": (-0.3, -1.2, -0.9, -0.8, -1.7, -1.4),
    "heavy woman": (0.3, 1.0, 1.2, 1.0, 2.0, 2.2),
    "heavy man": (-0.3, -1.3, -1.0, 1.2, 2.2, 1.9),
    "broad man": (-0.45, -1.9, -1.8, 1.1, 0.9, 0.2),
    "short heavy man": (0.7, -1.2, -0.8, 0.6, 1.9, 1.6),
}


def betas_of(body: BodyModel, build: str, rng: np.random.Generator) -> Float[np.ndarray, " B"]:
    """Return shape coefficients of one of `BUILDS`, with random deviations that make it an individual."""
    betas = rng.normal(size=body.num_betas) * np.where(np.arange(body.num_betas) < 6, 0.12, 0.6)
    leading = BUILDS[build]
    betas[: len(leading)] += leading
    return betas


def fitting_mannequin(body: BodyModel, betas: Float[np.ndarray, " B"]) -> tuple[Mannequin, float]:
    """Return the person scaled to the height that garments are cut for, and the factor from there to her own size."""
    own = Mannequin.of(body, betas)
    scale = float(np.ptp(own.skin.vertices[:, 1])) / 1.76  # metres: the height that the lengths of garments fit
    skin = ClothMesh(own.skin.vertices / scale, own.skin.faces, own.skin.weights)
    joints = {name: joint / scale for name, joint in own.joints.items()}
    return Mannequin.cut_on(body, own.params, skin, joints), scale


@dataclass(frozen=True)
class Stance:
    """A pose, or a path from one to another.

    Attributes:
        at: returns rotations (3, 3) of joints by name at a share of the path, 0 to 1.
        touching: arms ("left", "right") that stop before they touch; the share is the largest that allows it.
    """

    at: Callable[[float], Turns]
    touching: tuple[str, ...] = ()


def _turn(*, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Return the rotation about the fixed axes x, then y, then z; degrees."""
    return Rotation.from_euler("xyz", [x, y, z], degrees=True).as_matrix()


def _arm(
    side: str, lower: float, *, forward: float = 0.0, twist: float = 0.0, elbow: float = 10.0, fore: float = 0.0
) -> Turns:
    """Return the rotations of an arm lowered from the T-pose, then swung forward about the shoulders' axis; degrees.

    Args:
        side: "left" or "right".
        lower: angle between T-pose and arm, downwards.
        forward: swing to the front.
        twist: rotation of the upper arm about itself, palm turning back.
        elbow: bend of the elbow.
        fore: bend of the elbow sideways, inwards.
    """
    swing = _turn(x=-forward) @ _turn(z=-0.88 * lower) @ _turn(x=twist)
    turns = {f"{side}_collar": _turn(z=-0.12 * lower), f"{side}_shoulder": swing}
    turns[f"{side}_elbow"] = _turn(y=-elbow, z=-fore)
    return turns if side == "left" else {name: _mirrored(turn) for name, turn in turns.items()}


def _leg(side: str, *, forward: float = 0.0, out: float = -4.0, knee: float = 0.0, foot: float = 0.0) -> Turns:
    turns = {
        f"{side}_hip": _turn(z=out) @ _turn(x=-forward),
        f"{side}_knee": _turn(x=knee),
        f"{side}_ankle": _turn(x=-foot),
    }
    return turns if side == "left" else {name: _mirrored(turn) for name, turn in turns.items()}


def _mirrored(turn: np.ndarray) -> np.ndarray:
    flip = np.diag([-1.0, 1.0, 1.0])
    return flip @ turn @ flip


def _arms(lower: float, **kwargs: float) -> Turns:
    return _arm("left", lower, **kwargs) | _arm("right", lower, **kwargs)


def _legs(**kwargs: float) -> Turns:
    return _leg("left", **kwargs) | _leg("right", **kwargs)


def _hip_hand(side: str, share: float) -> Turns:
    return _arm(side, 48.0, forward=-12.0, twist=55.0, elbow=40.0 + 85.0 * share)


def _hanging(side: str, share: float, *, forward: float = 4.0, elbow: float = 12.0) -> Turns:
    return _arm(side, 40.0 + 46.0 * share, forward=forward, elbow=elbow)


def _contrapposto(share: float) -> Turns:
    trunk = {"pelvis": _turn(z=5.0), "spine1": _turn(z=-4.0), "spine3": _turn(z=-4.0, y=6.0), "head": _turn(y=-12.0)}
    legs = _leg("left", out=-9.0) | _leg("right", forward=16.0, knee=28.0, out=-1.0, foot=-10.0)
    return trunk | legs | _hanging("left", share) | _hanging("right", share, elbow=25.0)


def _step(share: float, *, length: float = 24.0) -> Turns:
    legs = _leg("left", forward=length, knee=6.0) | _leg("right", forward=-0.7 * length, knee=22.0, foot=-8.0)
    trunk = {"spine2": _turn(y=-6.0), "spine1": _turn(x=3.0)}
    arms = _hanging("left", share, forward=-18.0) | _hanging("right", share, forward=24.0, elbow=25.0)
    return legs | trunk | arms


STANCES: dict[str, Stance] = {
    "A": Stance(lambda _: _arms(45.0) | _legs(out=-3.0)),
    "T": Stance(lambda _: _arms(2.0, elbow=2.0)),
    "wide A": Stance(lambda _: _arms(30.0) | _legs(out=4.0)),
    "arms down": Stance(lambda s: _hanging("left", s) | _hanging("right", s) | _legs(), ("left", "right")),
    "at attention": Stance(
        lambda s: _hanging("left", s, forward=0.0) | _hanging("right", s, forward=0.0) | _legs(out=-8.5),
        ("left", "right"),
    ),
    "hands on hips": Stance(lambda s: _hip_hand("left", s) | _hip_hand("right", s) | _legs(), ("left", "right")),
    "left hand on hip": Stance(
        lambda s: _hip_hand("left", s) | _hanging("right", s) | _leg("left", out=-2) | _leg("right", out=-7),
        ("left", "right"),
    ),
    "right arm raised": Stance(lambda s: _arm("right", -62.0, elbow=12.0) | _hanging("left", s) | _legs(), ("left",)),
    "waving": Stance(
        lambda s: _arm("left", 8.0, twist=-80.0, elbow=95.0) | _hanging("right", s) | _legs() | {"head": _turn(y=15.0)},
        ("right",),
    ),
    "pointing": Stance(
        lambda s: _arm("right", 75.0, forward=78.0, elbow=6.0) | _hanging("left", s) | _legs(out=-5.0), ("left",)
    ),
    "arms forward": Stance(lambda _: _arms(70.0, forward=80.0, elbow=8.0) | _legs()),
    "arms up": Stance(lambda _: _arms(-58.0, elbow=15.0) | _legs(out=-2.0)),
    "elbows bent": Stance(lambda _: _arms(62.0, forward=8.0, elbow=80.0) | _legs(out=-5.0)),
    "contrapposto": Stance(_contrapposto, ("left", "right")),
    "step": Stance(_step, ("left", "right")),
    "long step": Stance(lambda s: _step(s, length=36.0), ("left", "right")),
    "knees bent": Stance(
        lambda _: (
            _legs(forward=52.0, knee=78.0, foot=24.0, out=2.0)
            | _arms(58.0, forward=30.0, elbow=30.0)
            | {"pelvis": _turn(x=14.0)}
        )
    ),
    "leg raised": Stance(lambda _: _leg("left", forward=62.0, knee=75.0) | _leg("right") | _arms(38.0, elbow=20.0)),
    "head turned": Stance(lambda _: _arms(42.0) | _legs() | {"neck": _turn(y=25.0), "head": _turn(y=30.0, x=6.0)}),
    "looking down": Stance(lambda _: _arms(50.0) | _legs() | {"neck": _turn(x=18.0), "head": _turn(x=16.0)}),
    "twisted": Stance(
        lambda _: (
            _arms(46.0, elbow=18.0)
            | _legs()
            | {"spine1": _turn(y=14.0), "spine2": _turn(y=12.0), "spine3": _turn(y=8.0, z=4.0)}
        )
    ),
    "leaning": Stance(
        lambda s: (
            _hanging("left", s)
            | _hanging("right", 0.7 * s)
            | _legs(out=-1.0)
            | {"spine1": _turn(z=9.0), "spine2": _turn(z=8.0), "head": _turn(z=-8.0)}
        ),
        ("left", "right"),
    ),
}


@dataclass(frozen=True, eq=False)
class Posing:
    """A stance as one person takes it, as a function of the share of its path.

    Attributes:
        body: the body model.
        stance: the stance.
        betas: her shape coefficients.
        facing: rotation about the vertical to her left, degrees.
        added: rotations (3, 3) after those of the stance, by joint: heels, fists.
        jitter: rotation vectors added at every joint, radians.
    """

    body: BodyModel
    stance: Stance
    betas: Float[np.ndarray, " B"]
    facing: float
    jitter: Float[np.ndarray, "J 3"]
    added: Turns = field(default_factory=dict)

    @staticmethod
    def of(
        body: BodyModel, stance: str, betas: Float[np.ndarray, " B"], *, facing: float, rng: np.random.Generator
    ) -> Posing:
        """Return one of `STANCES` with small random deviations of joints and fingers."""
        names = body.joint_names
        jitter = np.radians(2.5) * rng.normal(size=(len(names), 3))
        jitter[names.index("jaw") :] = 0.0
        jitter[names.index("pelvis")] *= 0.5
        curl = np.radians(rng.uniform(4.0, 22.0))
        for side, sign in (("left", -1.0), ("right", 1.0)):
            for joint in (f"{side}_{finger}{k}" for finger in FINGERS[1:] for k in (1, 2, 3)):
                jitter[names.index(joint), 2] = sign * curl * rng.uniform(0.6, 1.4)
        return Posing(body, STANCES[stance], betas, facing, jitter)

    def params(self, share: float) -> BodyParams:
        """Return the parameters at a share of the path, without translation."""
        turns = self.stance.at(share)
        pose = np.zeros((1, len(self.body.joint_names), 3))
        for k, name in enumerate(self.body.joint_names):
            turn = Rotation.from_rotvec(self.jitter[k]) * Rotation.from_matrix(turns.get(name, np.eye(3)))
            if name in self.added:
                turn = Rotation.from_matrix(self.added[name]) * turn
            if name == "pelvis":
                turn = Rotation.from_euler("y", self.facing, degrees=True) * turn
            pose[0, k] = turn.as_rotvec()
        expression = np.zeros(self.body.num_expressions)
        return BodyParams.from_full_pose(pose, betas=self.betas, expression=expression, transl=np.zeros(3))
