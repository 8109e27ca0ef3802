"""People whose surface no shape of the body model has: shape noise, thick calves, other proportions, fists, heels.

A fit to such a person keeps a distance, as a fit to a real one does. The model's template gets an offset field that
is orthogonal to its shape space; clothes are cut on the changed body, so that labels and seams stay exact.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from smplxpp.body import BodyModel, PosedBody
from smplxpp.core import BodyParams, require_at_least, require_between
from smplxpp.people.cloth_mesh import ClothMesh
from smplxpp.people.textures import ramp, smooth_noise

_FINE = {"head": 0.4, "jaw": 0.4, "neck": 0.6, "wrist": 0.3, "ankle": 0.4, "foot": 0.25}
"""Share of the noise on small parts, which 10 mm would make unrecognisable."""


@dataclass(frozen=True, kw_only=True)
class Outside:
    """How a person differs from every shape of the body model.

    Attributes:
        noise: root mean square of smooth offsets along the normals of trunk and limbs, metres; waves of some 12 cm.
        calves: bulge at the back of the calves, metres; half of it in front.
        limbs: factor of the length of shins and forearms.
        fists: whether the fingers are closed.
        heels: height of the heels of the shoes, metres.

    Raises:
        InputError: out of range.
    """

    noise: float = 0.0
    calves: float = 0.0
    limbs: float = 1.0
    fists: bool = False
    heels: float = 0.0

    def __post_init__(self) -> None:
        require_between("noise", self.noise, 0.0, 0.03)
        require_between("calves", self.calves, 0.0, 0.03)
        require_between("factor of the limbs", self.limbs, 0.8, 1.25)
        require_at_least("heels", self.heels, 0.0)

    @property
    def pitch(self) -> float:
        """Pitch of the feet on their heels, radians."""
        # Metres; what the heel rises by over the ball of the foot, over the sine of the pitch.
        lever = 0.155
        return float(np.arcsin(min(self.heels / lever, 0.8)))

    def turns(self) -> dict[str, np.ndarray]:
        """Return the rotations (3, 3) that heels and fists add to a stance, by joint."""
        out = {}
        for side, sign in (("left", -1.0), ("right", 1.0)):
            if self.heels:
                out[f"{side}_ankle"] = Rotation.from_rotvec([self.pitch, 0, 0]).as_matrix()
                out[f"{side}_foot"] = Rotation.from_rotvec([-self.pitch, 0, 0]).as_matrix()
            for finger in ("index", "middle", "ring", "pinky") if self.fists else ():
                for k, degrees in ((1, 70.0), (2, 85.0), (3, 50.0)):
                    turn = Rotation.from_rotvec([0, 0, sign * np.radians(degrees)])
                    out[f"{side}_{finger}{k}"] = turn.as_matrix()
        return out


def seed_of(name: str, seed: int) -> int:
    """Return the seed of a person's offsets, from her name and her seed."""
    return int.from_bytes(hashlib.sha256(f"{name} {seed}".encode()).digest()[:4], "little")


def outside_body(body: BodyModel, outside: Outside, *, seed: int) -> BodyModel:
    """Return the body model whose template has the offsets of one person; the same one where there are none.

    Noise is the same left and right, as `mirrored` of a scan supposes.

    Args:
        body: the model that is fitted later.
        outside: how the person differs.
        seed: of the noise.

    Example:
        >>> from smplxpp.people.outside import Outside, outside_body
        >>> body = smplxpp.load_body()
        >>> other = outside_body(body, Outside(noise=0.01), seed=3)
        >>> 0.006 < np.sqrt(np.mean(np.sum((other.v_template - body.v_template) ** 2, axis=1))) < 0.01
        True
    """
    offsets = np.zeros_like(body.v_template)
    posed = body.forward(BodyParams.rest(betas=np.zeros(body.num_betas), expressions=body.num_expressions))
    if outside.noise:
        offsets += _without_shape(body, _noise(body, outside.noise, seed))
    if outside.calves:
        offsets += _calves(body, posed, outside.calves)
    if outside.limbs != 1.0:
        offsets += _longer(body, posed, outside.limbs - 1.0)
    return replace(body, v_template=body.v_template + offsets) if offsets.any() else body


def with_offsets(
    arrays: dict[str, np.ndarray], body: BodyModel, outside: Outside, *, seed: int
) -> dict[str, np.ndarray]:
    """Return the layers of a capture's person with a body that the model cannot reach; clothes and hair move along.

    Args:
        arrays: of `smplxpp.people.fixture_person.read_layers`; the body's vertices come first.
        body: the model that is fitted later.
        outside: how the person differs.
        seed: of the noise.
    """
    offsets = outside_body(body, outside, seed=seed).v_template - body.v_template
    places = arrays["v_tpose"]
    nearest = cKDTree(places[: body.vertex_count]).query(places)[1]
    return arrays | {"v_tpose": (places + offsets[nearest]).astype(places.dtype)}


def reachable(body: BodyModel, truth: BodyModel, params: BodyParams) -> BodyParams:
    """Return the parameters of the model whose shape is nearest to a person's: those that an ideal fit would find.

    Args:
        body: the model that is fitted.
        truth: the person's own, of `outside_body`.
        params: one frame, with `truth`.
    """
    directions = body.shapedirs.reshape(-1, body.num_betas)
    offsets = (truth.v_template - body.v_template).ravel()
    betas = params.betas + np.linalg.lstsq(directions, offsets, rcond=None)[0]
    near = replace(params, betas=betas)
    apart = truth.forward(params).vertices[0] - body.forward(near).vertices[0]
    return replace(near, transl=params.transl + np.median(apart, axis=0))


def heel_blocks(truth: BodyModel, params: BodyParams, outside: Outside) -> ClothMesh:
    """Return two blocks under the heels on the T-pose, which reach the floor once the feet are pitched.

    Args:
        truth: the person's body model.
        params: her T-pose.
        outside: height of the heels.
    """
    names = truth.joint_names
    pose = np.zeros((1, truth.joint_count, 3))
    for name, turn in outside.turns().items():
        pose[0, names.index(name)] = Rotation.from_matrix(turn).as_rotvec()
    posed = truth.forward(
        BodyParams.from_full_pose(pose, betas=params.betas, expression=params.expression, transl=params.transl)
    )
    floor = posed.vertices[0][:, 1].min()
    flat = truth.forward(params).vertices[0]
    ring = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    vertices, faces, weights = [], [], []
    for side in ("left", "right"):
        ankle = names.index(f"{side}_ankle")
        # The top is the middle of the heel's sole, which is found in the foot that stands flat.
        foot = np.flatnonzero(_share(truth, f"{side}_ankle") + _share(truth, f"{side}_foot") > 0.6)
        sole = foot[flat[foot, 1] < flat[foot, 1].min() + 0.012]
        sole = sole[flat[sole, 2] < flat[sole, 2].min() + 0.05]
        top = posed.vertices[0][sole].mean(axis=0) + [0.0, 0.004, 0.0]
        # Rings from the sole to the floor, the last one closed by its middle; then back to the T-pose.
        back = np.linalg.inv(posed.posed_from_rest[0, ankle])
        for k, (along, radius) in enumerate(((0.0, 0.026), (0.4, 0.021), (1.0, 0.019), (1.0, 0.0))):
            middle = top + along * np.array([0.0, floor - top[1], 0.0])
            points = middle + radius * np.stack([np.cos(ring), 0 * ring, np.sin(ring)], axis=1)
            vertices.append(points @ back[:3, :3].T + back[:3, 3])
            if k:
                first, n = 12 * (len(vertices) - 2), np.arange(12)
                a, b = first + n, first + (n + 1) % 12
                faces += [np.stack([a, b, a + 12], axis=1), np.stack([b, b + 12, a + 12], axis=1)]
        row = np.zeros(truth.joint_count)
        row[ankle] = 1.0
        weights.append(np.tile(row, (48, 1)))
    return ClothMesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int64), np.concatenate(weights))


def _share(body: BodyModel, name: str) -> Float64[np.ndarray, " V"]:
    """Return the weight of the joints whose name contains a part."""
    return body.weights[:, [k for k, joint in enumerate(body.joint_names) if name in joint]].sum(axis=1)


def _noise(body: BodyModel, metres: float, seed: int) -> Float64[np.ndarray, "V 3"]:
    mesh = body.mesh()
    points = mesh.vertices.copy()
    points[:, 0] = np.abs(points[:, 0])
    field = smooth_noise(points, scale=(0.05, 0.07, 0.05), seed=seed)
    fingers = sum(_share(body, finger) for finger in ("thumb", "index", "middle", "ring", "pinky"))
    kept = 1.0 - sum((1.0 - share) * _share(body, part) for part, share in _FINE.items()) - 0.85 * fingers
    eyes = np.array(["eye" in name or "teeth" in name for name in body.part_label_names])[body.part_labels]
    return (metres * field * np.clip(kept, 0.0, 1.0) * ~eyes)[:, None] * mesh.vertex_normals


def _without_shape(body: BodyModel, offsets: Float[np.ndarray, "V 3"]) -> Float64[np.ndarray, "V 3"]:
    """Return the offsets without their part in the shape space, which a fit would find."""
    directions = body.shapedirs.reshape(-1, body.num_betas)
    found = np.linalg.lstsq(directions, offsets.ravel(), rcond=None)[0]
    return (offsets.ravel() - directions @ found).reshape(-1, 3)


def _calves(body: BodyModel, posed: PosedBody, metres: float) -> Float64[np.ndarray, "V 3"]:
    """Return a bulge that rises and falls over 5 cm between ankle and knee, twice as high at the back."""
    at = {name: posed.joints[0][k] for k, name in enumerate(body.joint_names)}
    mesh = body.mesh(posed.vertices[0])
    height = mesh.vertices[:, 1]
    knee, ankle = at["left_knee"][1], at["left_ankle"][1]
    along = ramp(height, ankle + 0.03, ankle + 0.08) * ramp(height, knee - 0.02, knee - 0.07)
    back = 0.75 - 0.25 * mesh.vertex_normals[:, 2]
    legs = _share(body, "knee") + _share(body, "hip") + _share(body, "ankle")
    return (metres * along * back * (legs > 0.5))[:, None] * mesh.vertex_normals


def _longer(body: BodyModel, posed: PosedBody, share: float) -> Float64[np.ndarray, "V 3"]:
    """Return the offsets that stretch shins and forearms by a share; what follows them moves along."""
    out = np.zeros_like(body.v_template)
    at = {name: posed.joints[0][k] for k, name in enumerate(body.joint_names)}
    vertices = posed.vertices[0]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        own = sign * vertices[:, 0] > 0
        for start, end in (("knee", "ankle"), ("elbow", "wrist")):
            a, b = at[f"{side}_{start}"], at[f"{side}_{end}"]
            axis = (b - a) / np.linalg.norm(b - a)
            along = np.clip((vertices - a) @ axis, 0.0, np.linalg.norm(b - a))
            # Vertices of the trunk are left out: only the limb's own lie past its start.
            limb = own & (_share(body, f"{side}_{start}") + _beyond(body, side, end) > 0.02)
            out += np.where(limb, share * along, 0.0)[:, None] * axis
    return out


def _beyond(body: BodyModel, side: str, end: str) -> Float64[np.ndarray, " V"]:
    names = ("ankle", "foot") if end == "ankle" else ("wrist", "thumb", "index", "middle", "ring", "pinky")
    return np.sum([_share(body, f"{side}_{name}") for name in names], axis=0)
