"""Bind what is stiff: a bag or a binder to the hand that holds it, a shoe to the ankle and the ball of the foot."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from smplxpp.core import MeshLike, SkinWeights, WeightsLike, as_mesh, dense_weights, require_choice
from smplxpp.transfer.anchors import smooth_step
from smplxpp.transfer.correspond import vertex_components

_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_HOLDS = 0.03
"""Metres from a hand within which a piece is held by it, whatever else it touches."""


def rigid_weights(
    source: MeshLike,
    source_weights: WeightsLike,
    target: MeshLike,
    *,
    joint_names: tuple[str, ...],
    joint: str | None = None,
) -> SkinWeights:
    """Return skin weights with which every piece of `target` follows one joint of the body, as it is in the scan.

    A piece that comes within 3 cm of a hand is held by it and follows its wrist, because fingers that bend would tear
    it; of two hands, the one that is near to more of it holds it. Every other piece (a hat) follows the joint with the
    largest weight in the body nearest to it, and one beside thigh and trunk (a bag on a strap) the trunk.

    Args:
        source: the posed body.
        source_weights: its skin weights.
        target: the thing, in the same place, one or several connected pieces.
        joint_names: names of the J joints, for which hands are looked for.
        joint: name of the joint that all pieces follow; None: each that of the body nearest to it.

    Raises:
        InputError: no joint of this name.

    Example:
        >>> body = smplxpp.load_body()
        >>> box = body.mesh().submesh(np.arange(100))[0]
        >>> weights = rigid_weights(body.mesh(), body.weights, box, joint_names=body.joint_names)
        >>> len(np.unique(weights.dense().argmax(axis=1)))
        1
    """
    source = as_mesh(source, subject="source")
    target = as_mesh(target, subject="target")
    # Fingers count as the wrist that they belong to, eyes as the head: glasses lie nearest to them.
    names = list(joint_names)
    if joint is not None:
        require_choice("rigid joint", joint, names)
    owner = np.arange(len(names))
    for k, name in enumerate(names):
        side = name.partition("_")[0]
        if any(finger in name for finger in _FINGERS) and f"{side}_wrist" in names:
            owner[k] = names.index(f"{side}_wrist")
        if "eye" in name and "head" in names:
            owner[k] = names.index("head")
    own = dense_weights(source_weights)
    folded = np.zeros((len(own), len(names)))
    np.add.at(folded.T, owner, own.T)
    limb = folded.argmax(axis=1)
    distance, nearest = cKDTree(source.vertices).query(target.vertices)
    trunk = [k for k, name in enumerate(names) if name.startswith(("pelvis", "spine"))]
    hands = [k for k, name in enumerate(names) if name.endswith("_wrist") and (limb == k).any()]
    held = np.zeros((len(hands), target.vertex_count), dtype=bool)
    for row, hand in enumerate(hands):
        held[row] = cKDTree(source.vertices[limb == hand]).query(target.vertices)[0] < _HOLDS
    # One joint for every connected piece.
    component = vertex_components(target)
    follows = np.zeros(target.vertex_count, dtype=np.int64)
    policies = []
    for piece in range(int(component.max(initial=-1)) + 1):
        own = component == piece
        touches = held[:, own].sum(axis=1)
        if joint is not None:
            follows[own] = names.index(joint)
        elif touches.any():
            follows[own] = hands[int(touches.argmax())]
        else:
            # The tenth of it that is nearest to the body, by the sum of the weights there.
            close = own & (distance <= np.quantile(distance[own], 0.1))
            follows[own] = int(folded[nearest[close]].sum(axis=0).argmax())
            # A bag that hangs beside a hip is carried by the shoulder and does not swing with the thigh, as a holster
            # does. The trunk is nearest to a sixth of such a bag and more.
            beside = np.isin(limb[nearest[own]], trunk)
            if names[follows[own][0]].endswith("_hip") and beside.mean() > 0.15:
                follows[own] = trunk[int(folded[nearest[own]][beside][:, trunk].sum(axis=0).argmax())]
        policies.append(f"rigid:{names[follows[own][0]]}")
    dense = np.zeros((target.vertex_count, len(names)))
    dense[np.arange(len(follows)), follows] = 1.0
    return SkinWeights.from_dense(
        dense,
        max_influences=1,
        matched=np.zeros(len(follows), dtype=bool),
        distance=distance,
        angle=np.full(len(follows), np.nan),
        component=component,
        policies=tuple(policies),
    )


_BALL = (-0.01, 0.03)
"""Metres beyond the joint of the toes between which a shoe begins to follow them; a sole bends over such a length."""
_TOES_IN_SHOES = 0.5
"""Share of the toes' turn that a shoe makes; a pump taken off its heel would else be straightened like a foot."""
_SHAFT = (0.0, 0.05)
"""Metres above the ankle between which a shoe begins to follow the leg, as the shaft of a boot does."""


def shoe_weights(
    weights: SkinWeights,
    mesh: MeshLike,
    joints: Float[np.ndarray, "J 3"],
    *,
    joint_names: tuple[str, ...],
) -> SkinWeights:
    """Return the weights of shoes that do not bend but at the ball of the foot, and above the ankle as they did.

    A heel hangs centimetres below the skin that transferred weights come from, near to heel and toes alike, so that it
    would bend with both. Below the ankle a vertex follows the toes by how far it lies before their joint, along the
    foot, and the ankle with the rest:

        w_toes = 0.5 s(t; ball),  w_ankle = 1 - w_toes,
        t = (x - ankle) . (toes - ankle) / |toes - ankle| - |toes - ankle|

    with s a smooth step.

    Args:
        weights: as transferred, which tell the shoes of both feet apart.
        mesh: the shoes in the pose of the joints.
        joints: posed joints of the body.
        joint_names: their names.

    Example:
        >>> from smplxpp.transfer import shoe_weights
        >>> body = smplxpp.load_body()
        >>> given = smplxpp.SkinWeights.from_dense(body.weights)
        >>> joints = body.joint_regressor @ body.v_template
        >>> stiff = shoe_weights(given, body.mesh(), joints, joint_names=body.joint_names)
        >>> heel = body.v_template[:, 1].argmin()
        >>> float(stiff.dense()[heel].max())
        1.0
    """
    mesh = as_mesh(mesh, subject="shoes")
    dense, names = weights.dense(), list(joint_names)
    out = dense.copy()
    legs = {side: [names.index(f"{side}_{joint}") for joint in ("knee", "ankle", "foot")] for side in ("left", "right")}
    left = dense[:, legs["left"]].sum(axis=1) >= dense[:, legs["right"]].sum(axis=1)
    for side, own in (("left", left), ("right", ~left)):
        knee, ankle, toes = legs[side]
        foot, shin = joints[toes] - joints[ankle], joints[knee] - joints[ankle]
        offset = mesh.vertices[own] - joints[ankle]
        length = float(np.linalg.norm(foot))
        share = _TOES_IN_SHOES * smooth_step(offset @ foot / length - length, *_BALL)
        above = smooth_step(offset @ shin / np.linalg.norm(shin), *_SHAFT)[:, None]
        stiff = np.zeros((int(own.sum()), len(names)))
        stiff[:, ankle], stiff[:, toes] = 1.0 - share, share
        out[own] = above * dense[own] + (1.0 - above) * stiff
    return SkinWeights.from_dense(
        out,
        max_influences=weights.joint_indices.shape[1],
        matched=weights.matched,
        distance=weights.distance,
        angle=weights.angle,
        component=weights.component,
        policies=weights.policies,
    )
