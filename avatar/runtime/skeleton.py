"""The skeleton of a bundle as a body model, its surface as a template: what takes parameters, what clothes need."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64

from avatar.runtime.bundle import AvatarBundle
from smplxpp.body.model import BodyModel
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.template.template import Template


def skeleton_body(bundle: AvatarBundle) -> BodyModel:
    """Return a body whose vertices are its joints: it completes hands, and moves joints with the expression."""
    count = bundle.sizes["J"]
    joints = bundle.tensors["skeleton.joints"].astype(np.float64)
    moved = bundle.tensors["skeleton.expression"].astype(np.float64)
    return _body(bundle, joints, moved, None, np.eye(count), np.eye(count))


def clothed_template(bundle: AvatarBundle) -> tuple[Template, Int64[np.ndarray, " V"]]:
    """Return a template of the bundle's vertices, and where in it each of them is.

    A joint is a vertex too, behind those of the body: so that few vertices give the same joints as all of them did.
    """
    t, sizes = bundle.tensors, bundle.sizes
    vertices, parts, J = t["surface.vertices"], t["surface.parts"], sizes["J"]
    skin = int((parts == 0).sum())
    at = np.arange(len(vertices)) + J * (parts > 0)
    total = len(vertices) + J
    joints = slice(skin, skin + J)

    def over_all(values: np.ndarray, of_joints: object, dtype: type) -> np.ndarray:
        out = np.zeros((total, *values.shape[1:]), dtype=dtype)
        out[at], out[joints] = values, of_joints
        return out

    dense = np.zeros((total, J))
    rows = np.repeat(at, t["surface.joint_indices"].shape[1])
    np.add.at(dense, (rows, t["surface.joint_indices"].ravel()), t["surface.joint_weights"].ravel())
    dense[joints] = np.eye(J)
    expression, pose = (_dense_basis(bundle, name, skin) for name in ("expression", "pose"))
    regressor = np.zeros((J, skin + J))
    regressor[:, joints] = np.eye(J)
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
    """A basis over the skin's vertices and the joints behind them."""
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
    count = len(vertices)

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
