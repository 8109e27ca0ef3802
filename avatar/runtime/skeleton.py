"""Convert a bundle to a body model and a template, prepare motions for its player, and simulate its loose clothes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from avatar.runtime.bundle import AvatarBundle
from smplxpp.body.model import BodyModel
from smplxpp.body.retarget import PoseRange
from smplxpp.cloth.driver import ClothDriver, ClothShape, DriverConfig
from smplxpp.cloth.garment_file import garments_from_arrays, simulation_from
from smplxpp.cloth.poses import pose_between
from smplxpp.cloth.quality import ClothQuality
from smplxpp.core import BodyParams, SkinWeights, require_positive
from smplxpp.template.template import Template


def skeleton_body(bundle: AvatarBundle) -> BodyModel:
    """Return a body model with the joints as vertices, which completes hands and applies expressions to joints."""
    count = bundle.sizes["J"]
    joints = bundle.tensors["skeleton.joints"].astype(np.float64)
    moved = bundle.tensors["skeleton.expression"].astype(np.float64)
    return _body(bundle, joints, moved, None, np.eye(count), np.eye(count))


def clothed_template(bundle: AvatarBundle) -> tuple[Template, Int64[np.ndarray, " V"]]:
    """Return a template of the bundle's vertices, and the index of each of them in it.

    Joints are appended to the body's vertices, because a bundle has too few vertices to regress them.
    """
    t, sizes = bundle.tensors, bundle.sizes
    vertices, parts, J = t["surface.vertices"], t["surface.parts"], sizes["J"]
    # Order of vertices: skin, joints, then the other parts.
    skin = int((parts == 0).sum())
    at = np.arange(len(vertices)) + J * (parts > 0)
    total = len(vertices) + J
    joints = slice(skin, skin + J)

    # Spread values of the bundle's vertices and of the joints over all vertices of the template.
    def over_all(values: np.ndarray, of_joints: object, dtype: type) -> np.ndarray:
        out = np.zeros((total, *values.shape[1:]), dtype=dtype)
        out[at], out[joints] = values, of_joints
        return out

    # Skin weights; a joint follows itself.
    dense = np.zeros((total, J))
    rows = np.repeat(at, t["surface.joint_indices"].shape[1])
    np.add.at(dense, (rows, t["surface.joint_indices"].ravel()), t["surface.joint_weights"].ravel())
    dense[joints] = np.eye(J)
    # Every joint is the vertex that stands for it, so that the regressor selects that vertex alone.
    expression, pose = (_dense_basis(bundle, name, skin) for name in ("expression", "pose"))
    regressor = np.zeros((J, skin + J))
    regressor[:, joints] = np.eye(J)
    # The body model has skin and joints; clothes follow in the template, bound by their own skin weights. A player
    # renders none of this: scan indices and shape coefficients are empty.
    places = over_all(vertices, t["skeleton.joints"], np.float64)
    body = _body(bundle, places[: skin + J], expression, pose, regressor, dense[: skin + J])
    template = Template(
        body=body,
        vertices=places,
        faces=at[t["surface.faces"]],
        vertex_labels=over_all(t["surface.labels"], 0, np.int32),
        vertex_part=over_all(parts, 0, np.int32),
        part_names=bundle.about.part_names,
        vertex_colors=over_all(t["surface.colors"], 0, np.uint8),
        weights=SkinWeights.from_dense(dense),
        betas=np.zeros(0),
        body_index=np.minimum(np.arange(total), skin + J - 1),
        scan_index=np.full(total, -1),
    )
    return template, at


def _dense_basis(bundle: AvatarBundle, name: str, skin: int) -> np.ndarray | None:
    """Return a dense basis over the vertices of the skin and the joints after them."""
    basis = bundle.tensors.get(f"surface.{name}")
    if basis is None:
        return None
    J = bundle.sizes["J"]
    out = np.zeros((skin + J, 3, basis.shape[2]))
    out[bundle.tensors[f"surface.{name}_rows"]] = basis
    if name == "expression":
        out[skin:] = bundle.tensors["skeleton.expression"]
    return out


def _body(
    bundle: AvatarBundle,
    vertices: np.ndarray,
    expression: np.ndarray | None,
    pose: np.ndarray | None,
    regressor: np.ndarray,
    weights: np.ndarray,
) -> BodyModel:
    # Shape, faces and labels are not used by players, so they are empty.
    count = len(vertices)

    # Hands are stored as PCA components with a mean; bundles of bodies without hands lack them.
    def of_hands(name: str) -> np.ndarray | None:
        value = bundle.tensors.get(f"skeleton.{name}")
        return None if value is None else value.astype(np.float64)

    return BodyModel(
        name=bundle.about.name,
        v_template=vertices,
        faces=np.zeros((0, 3), np.int64),
        shapedirs=np.zeros((count, 3, 0)),
        exprdirs=np.zeros((count, 3, 0)) if expression is None else expression,
        posedirs=pose,
        joint_regressor=regressor,
        parents=bundle.tensors["skeleton.parents"].astype(np.int64),
        joint_names=bundle.about.joint_names,
        weights=weights,
        part_labels=np.zeros(count, np.int64),
        part_label_names=("body",),
        expression_names=bundle.about.expression_names,
        left_hand_components=of_hands("left_hand_components"),
        right_hand_components=of_hands("right_hand_components"),
        left_hand_mean=of_hands("left_hand_mean"),
        right_hand_mean=of_hands("right_hand_mean"),
    )


class LooseClothes:
    """The cloth simulation of a bundle's garments, with indices of the bundle's own vertices."""

    def __init__(self, bundle: AvatarBundle, config: DriverConfig | None = None) -> None:
        # Garments in the types of their reader, and with the template's indices.
        template, at = clothed_template(bundle)
        wide = {
            name: value.astype(np.float64) if value.dtype == np.float32 and _is_wide(name) else value
            for name, value in bundle.garments.items()
        }
        # Garments index the bundle's vertices; shift them to the
        # template's, where the joints lie between skin and clothes.
        for name, value in wide.items():
            if name.split(".")[-1] in ("particles", "vertices", "collider_vertices"):
                inside = value.size == 0 or (value.dtype.kind in "iu" and 0 <= value.min() <= value.max() < len(at))
                wide[name] = at[value] if inside else np.full_like(value, -1)  # the reader refuses -1
        about, subject = bundle.garments_about, "garments of the avatar"
        garments = garments_from_arrays(wide, about, template, subject=subject)
        self._driver = ClothDriver(template, garments, config or simulation_from(about, subject=subject))
        self._place = np.full(template.vertex_count, -1, dtype=np.int64)
        self._place[at] = np.arange(len(at))

    @property
    def notes(self) -> list[str]:
        """Remarks on the simulation, a sentence each."""
        return self._driver.notes

    @property
    def quality(self) -> list[ClothQuality]:
        """What was measured of each garment since the player was made."""
        return self._driver.quality

    def step(self, params: BodyParams, seconds: float, path: Sequence[BodyParams] = ()) -> ClothShape:
        """Simulate to a pose, along a path of poses if there is one; see `ClothDriver.step` and `follow`."""
        # Along a path the clothes pass through all its poses, evenly
        # in time; without one a single step leads to the pose.
        driver = self._driver
        shape = driver.follow(path, seconds, params) if path else driver.step(params, seconds)
        return replace(shape, vertices=self._place[shape.vertices])

    @property
    def skinned(self) -> ClothShape:
        """The clothes after linear blend skinning, without simulation."""
        garments = self._driver.garments
        vertices = self._place[np.concatenate([one.vertices for one in garments])]
        share = np.concatenate([one.share() for one in garments])
        return ClothShape(vertices, np.zeros((len(vertices), 3), np.float32), share)

    def restart(self) -> None:
        """Discard the state; the next step starts a new simulation."""
        self._driver.restart()


def _is_wide(name: str) -> bool:
    """Return whether an array of garments is float64 in its own file."""
    return ".params." in name or name.split(".")[-1] in ("rest_vertices", "lengths", "depth", "vertex_depth")


def resampled(params: BodyParams, fps: float, *, source_fps: float | None = None) -> BodyParams:
    """Resample a motion to another frame rate, with spherical linear interpolation (slerp) of every joint.

    Different vectors of one rotation are the same pose, so that a joint never spins between them.

    Args:
        params: the motion.
        fps: frames a second of the result.
        source_fps: frames a second of `params`; None: their own.

    Raises:
        InputError: no positive rate.
    """
    rate = source_fps or params.fps or 0.0
    for name, value in (("frames a second", fps), ("frames a second of the motion", rate)):
        require_positive(name, value)
    # Interpolate between the two neighbouring frames of each new time.
    # The 1e-9 keeps the last frame where the duration is a whole number of new frames up to rounding.
    last = len(params) - 1
    frames = []
    for k in range(int(np.floor(last / rate * fps + 1e-9)) + 1):
        at = min(k * rate / fps, float(last))
        low = min(int(at), max(last - 1, 0))
        high = min(low + 1, last)
        frames.append(pose_between(params.frame(low), params.frame(high), at - low))
    return replace(BodyParams.concatenate([replace(one, fps=None) for one in frames]), fps=fps)


def pose_range(bundle: AvatarBundle) -> PoseRange | None:
    """Return the range of the training's poses in a bundle; None if it stores none."""
    known = bundle.tensors.get("poses.known")
    return None if known is None else PoseRange.of(known)
