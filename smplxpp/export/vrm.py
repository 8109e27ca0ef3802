"""A template as VRM 1.0, the avatar format of VTuber, chat and virtual-reality programs: a GLB that says what is what.

VRMC_vrm 1.0, https://github.com/vrm-c/vrm-specification (MIT): bones of a human, expressions as morph targets, gaze by
the eyes' bones, and under which terms the avatar may be used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from smplxpp.body.blendshapes import ARKIT, both_sides, transfer_blendshapes, with_arkit_names
from smplxpp.body.layout import FINGERS, OWN_NAMES, PROGRAM_NAMES
from smplxpp.core import BodyParams, InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.export.gltf import MorphTargets, rigged_gltf
from smplxpp.export.gltf_skin import with_joint_names
from smplxpp.skinning.linear_blend import forward_kinematics, skin
from smplxpp.template.template import BODY_PART, Template
from smplxpp.template.template_arrays import fitted_regressor

EXTENSION = "VRMC_vrm"
LICENCE = "https://vrm.dev/licenses/1.0/"
"""The licence that VRM itself offers; the fields of the file say what it permits, by default next to nothing."""
INFLUENCES = 4
"""Joints of a vertex: UniVRM and three.js read the first set of four alone."""
# What the fields of `meta` may say, and what they say by default (VRMC_vrm.meta.schema.json).
_CHOICES = {
    "avatarPermission": ("onlyAuthor", "onlySeparatelyLicensedPerson", "everyone"),
    "commercialUsage": ("personalNonProfit", "personalProfit", "corporation"),
    "creditNotation": ("required", "unnecessary"),
    "modification": ("prohibited", "allowModification", "allowModificationRedistribution"),
}
_FLAGS = (
    *("allowExcessivelyViolentUsage", "allowExcessivelySexualUsage", "allowPoliticalOrReligiousUsage"),
    *("allowAntisocialOrHateUsage", "allowRedistribution"),
)
_TEXTS = (
    *("name", "version", "copyrightInformation", "contactInformation", "thirdPartyLicenses", "licenseUrl"),
    "otherLicenseUrl",
)
_LISTS = ("authors", "references")
# Largest turn of an eye by gaze, degrees: further away the head follows.
_GAZE = {"rangeMapHorizontalInner": 25.0, "rangeMapHorizontalOuter": 25.0, "rangeMapVerticalDown": 20.0}
_GAZE |= {"rangeMapVerticalUp": 20.0}
_EYES = ("left_eye_smplhf", "right_eye_smplhf")
_NEEDED = ("hips", "spine", "head") + tuple(
    f"{side}{bone}"
    for side in ("left", "right")
    for bone in ("UpperLeg", "LowerLeg", "Foot", "UpperArm", "LowerArm", "Hand")
)
# A vertex that an expression moves by less, in metres, is left out of it.
_STILL = 1e-5


@dataclass(frozen=True)
class Expression:
    """A preset of VRM.

    Attributes:
        shapes: values of ARKit's blendshapes, those of both sides by the name without it.
        jaw: rotation of the jaw, radians.
        overrides: what the expression takes the place of: "Mouth" and "Blink".
    """

    shapes: Mapping[str, float]
    jaw: float = 0.0
    overrides: tuple[str, ...] = ()


def _vowel(jaw: float, round_: float = 0.0, spread: float = 0.0) -> Expression:
    """Return the mouth of a vowel as `avatar.speech` makes it: by how far the jaw hangs, lips are round, and spread."""
    shapes = {"jawOpen": 0.25 * jaw, "mouthLowerDown": 0.15 * jaw, "mouthPucker": 0.7 * round_}
    shapes |= {"mouthFunnel": 0.35 * round_, "mouthSmile": 0.3 * spread, "mouthStretch": 0.35 * spread}
    return Expression({name: value for name, value in shapes.items() if value}, jaw=0.15 * jaw)


_OVER_MOUTH = ("Mouth",)
PRESETS: dict[str, Expression] = {
    "aa": _vowel(1.0),
    "ih": _vowel(0.22, spread=0.7),
    "ou": _vowel(0.2, 1.0),
    "ee": _vowel(0.45, spread=0.5),
    "oh": _vowel(0.5, 0.8),
    "blink": Expression({"eyeBlink": 1.0}),
    "blinkLeft": Expression({"eyeBlinkLeft": 1.0}),
    "blinkRight": Expression({"eyeBlinkRight": 1.0}),
    "happy": Expression({"mouthSmile": 0.8, "cheekSquint": 0.6, "eyeSquint": 0.4, "mouthDimple": 0.2}),
    "angry": Expression({"browDown": 0.9, "noseSneer": 0.4, "eyeSquint": 0.3, "mouthFrown": 0.3, "mouthPress": 0.4}),
    "sad": Expression({"browInnerUp": 0.8, "mouthFrown": 0.7, "mouthShrugLower": 0.4, "eyeSquint": 0.2}),
    "relaxed": Expression({"eyeBlink": 0.3, "mouthSmile": 0.35, "browInnerUp": 0.15}),
    "surprised": Expression(
        {"browInnerUp": 0.8, "browOuterUp": 0.8, "eyeWide": 0.9, "jawOpen": 0.15}, jaw=0.1, overrides=_OVER_MOUTH
    ),
}
"""VRM's presets. The five vowels are those of speech (A, I, U, E, O of Japanese); the others were tuned by eye."""


def checked_meta(meta: Mapping[str, Any] | None, *, name: str) -> dict[str, Any]:
    """Return the fields of VRM's `meta` for an avatar, with the most restrictive terms where nothing is stated.

    Args:
        meta: fields by their names in VRM, such as "name", "authors", "licenseUrl", "commercialUsage".
        name: of the avatar, where `meta` has none.

    Raises:
        InputError: a field or a value that VRM does not have.

    Example:
        >>> from smplxpp.export.vrm import checked_meta
        >>> checked_meta({"authors": ["Anna"]}, name="me")["commercialUsage"]
        'personalNonProfit'
    """
    stated: dict[str, Any] = {"name": name, "version": "1", "authors": ["unknown"], "licenseUrl": LICENCE}
    stated |= {key: choices[0] for key, choices in _CHOICES.items()} | dict.fromkeys(_FLAGS, False)
    for key, value in (meta or {}).items():
        subject = f"VRM meta {key}"
        if key in _CHOICES:
            expected, fits = " or ".join(_CHOICES[key]), value in _CHOICES[key]
        elif key in _FLAGS:
            expected, fits = "true or false", isinstance(value, bool)
        elif key in _TEXTS:
            expected, fits = "a text", isinstance(value, str) and bool(value.strip())
        elif key in _LISTS:
            texts = isinstance(value, list | tuple) and all(isinstance(one, str) and one.strip() for one in value)
            expected, fits = "one or more texts", bool(texts and value)
        else:
            known = ", ".join((*_TEXTS, *_LISTS, *_CHOICES, *_FLAGS))
            raise InputError(subject, expected=f"one of {known}", received="a field that VRM does not have")
        if key.endswith("Url"):
            expected, fits = "an address, https://...", fits and value.startswith(("https://", "http://"))
        if not fits:
            raise InputError(subject, expected=expected, received=repr(value)[:100])
        stated[key] = list(value) if key in _LISTS else value
    return stated


def write_vrm(
    path: str | Path, template: Template, *, meta: Mapping[str, Any] | None = None, joint_names: str = OWN_NAMES
) -> None:
    """Write the template as a VRM 1.0 file, whole or not at all.

    A GLB in VRM's T-pose (facing +Z, soles on y = 0, arms, hands and fingers straightened) with four joints a vertex
    and `VRMC_vrm`: all bones of a human that the skeleton has, `PRESETS` as morph targets of every part that they move
    (beards, too), a body's blendshapes of ARKit by their own names, and gaze by the eyes' bones.

    Args:
        path: of the file.
        template: body and parts in the T-pose.
        meta: see `checked_meta`; the name is by default that of the file.
        joint_names: names of the nodes, which VRM leaves free.

    Raises:
        InputError: a skeleton without the bones that VRM requires, or fields of `meta` that VRM does not have.
    """
    stated = checked_meta(meta, name=Path(path).stem)
    bones = {
        PROGRAM_NAMES["vrm"][name]: k
        for k, name in enumerate(template.body.joint_names)
        if name in PROGRAM_NAMES["vrm"]
    }
    missing = [bone for bone in _NEEDED if bone not in bones]
    if missing:
        raise InputError(
            "skeleton for VRM", expected=f"joints that stand for {', '.join(_NEEDED)}", received=f"no {missing[0]}"
        )
    template = in_vrm_pose(template).on_floor()
    template = replace(template, weights=template.weights.pruned(INFLUENCES))
    shapes = preset_displacements(template)
    # ARKit's expressions, of numbered ones as far as they are reached; the numbers themselves say nothing to a player.
    body = with_arkit_names(template.body)
    told = [k for k, name in enumerate(body.expression_names) if not name.startswith("expression_")]
    names = tuple(body.expression_names[k] for k in told)
    template = replace(template, body=replace(body, exprdirs=body.exprdirs[..., told], expression_names=names))
    named = bool(set(ARKIT) & set(template.body.expression_names))
    gltf, buffers, joint_nodes, part_nodes = rigged_gltf(
        with_joint_names(template, joint_names), morph_targets=named, shapes=shapes
    )
    targets = {
        node: list((gltf.meshes[gltf.nodes[node].mesh].extras or {}).get("targetNames", ())) for node in part_nodes
    }
    expressions: dict[str, Any] = {"preset": {name: _bound(targets, name) for name in shapes}}
    if named:
        own = {node: names for node, names in targets.items() if gltf.nodes[node].name == BODY_PART}
        expressions["custom"] = {name: _bound(own, name) for name in _moving(template) if name in ARKIT}
    gltf.extensions = {
        EXTENSION: {
            "specVersion": "1.0",
            "meta": stated,
            "humanoid": {"humanBones": {bone: {"node": int(joint_nodes[k])} for bone, k in bones.items()}},
            "firstPerson": {"meshAnnotations": [{"node": node, "type": "auto"} for node in part_nodes]},
            **({"lookAt": _gaze(template)} if set(_EYES) <= set(template.body.joint_names) else {}),
            "expressions": expressions,
        }
    }
    gltf.extensionsUsed = [EXTENSION]
    atomic_write_bytes(path, buffers.glb())


def _bound(targets: Mapping[int, list[str]], name: str) -> dict[str, Any]:
    """Return an expression that moves the morph targets of its name, a node each."""
    binds = [
        {"node": node, "index": names.index(name), "weight": 1.0} for node, names in targets.items() if name in names
    ]
    overrides = PRESETS[name].overrides if name in PRESETS else ()
    return {"morphTargetBinds": binds, "isBinary": False} | {f"override{what}": "blend" for what in overrides}


def _moving(template: Template) -> list[str]:
    """Return the names of the expressions that move anything."""
    used = np.abs(template.body.exprdirs).max(axis=(0, 1)) > _STILL
    return [name for name, moves in zip(template.body.expression_names, used, strict=True) if moves]


def _gaze(template: Template) -> dict[str, Any]:
    """Return `lookAt`: the eyes turn towards the target itself, up to `_GAZE`."""
    joints, names = template.joints, template.body.joint_names
    between = joints[[names.index(eye) for eye in _EYES]].mean(axis=0) - joints[names.index("head")]
    ranges = {name: {"inputMaxValue": most, "outputScale": most} for name, most in _GAZE.items()}
    return {"type": "bone", "offsetFromHeadBone": between.tolist()} | ranges


def preset_displacements(template: Template) -> MorphTargets:
    """Return how `PRESETS` displace the vertices of a template, metres; none for a body without a face.

    The template is posed by the expressions and the jaw, so that teeth, tongue and a beard go with them. Numbered
    expressions (SMPL-X) are combined to ARKit's by `transfer_blendshapes`.
    """
    body = template.body
    names = list(body.expression_names)
    if not names or "jaw" not in body.joint_names:
        return {}
    if set(ARKIT) & set(names):
        arkit = np.array([[float(name == own) for own in names] for name in ARKIT])
    else:
        arkit = transfer_blendshapes(body).coefficients
    rest = template.vertices
    out = {}
    for name, expression in PRESETS.items():
        values = np.zeros(len(ARKIT))
        for shape, value in expression.shapes.items():
            values[[ARKIT.index(side) for side in both_sides(shape)]] = value
        params = replace(
            BodyParams.rest(betas=0, expressions=len(names)),
            expression=(values @ arkit)[None],
            jaw_pose=np.array([[expression.jaw, 0.0, 0.0]]),
            flat_hand_mean=True,
        )
        moved = template.pose(params)[0] - rest
        moved[np.linalg.norm(moved, axis=1) < _STILL] = 0.0
        out[name] = moved
    return out


def in_vrm_pose(template: Template) -> Template:
    """Return the template at rest in VRM's T-pose: arms, hands and fingers along x, thumbs half way to z, feet along z.

    SMPL's rest pose is a T-pose but for hands at ease and toes turned a little outward. Every bone that has a direction
    is turned there by the smallest rotation, what hangs on it follows, and the result becomes the rest pose.
    """
    joints, parents, names = template.joints, template.body.parents, list(template.body.joint_names)
    turned = np.tile(np.eye(3), (len(names), 1, 1))
    aims = {names.index(a): (names.index(b), kind) for a, b, kind in _aims() if a in names and b in names}
    # Global rotations, parents before children; a joint without a direction of its own follows its parent.
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            turned[joint] = turned[parent]
        if joint in aims:
            child, kind = aims[joint]
            bone = joints[child] - joints[joint]
            turned[joint] = _smallest_turn(bone, _direction(bone, kind))
    above = np.where((parents >= 0)[:, None, None], turned[parents], np.eye(3))
    moves, placed = forward_kinematics(joints[None], parents, (above.swapaxes(-1, -2) @ turned)[None])
    vertices = skin(template.vertices, template.weights.dense(), moves)[0]
    body, count = template.body, template.body.vertex_count
    regressor = fitted_regressor(
        body.joint_regressor,
        vertices[:count],
        body.exprdirs,
        joints=placed[0],
        moved=np.tensordot(body.joint_regressor, body.exprdirs, axes=1),
        sums=body.joint_regressor.sum(axis=1),
    )
    return replace(template, vertices=vertices, body=replace(body, joint_regressor=regressor))


def _aims() -> list[tuple[str, str, str]]:
    """Return (joint, the joint that it points at, where to: "arm", "thumb" or "foot")."""
    out = []
    for side in ("left", "right"):
        chain = [f"{side}_{name}" for name in ("shoulder", "elbow", "wrist", "middle1")]
        out += [(a, b, "arm") for a, b in pairwise(chain)]
        for finger in FINGERS:
            bones = [f"{side}_{finger}{k}" for k in (1, 2, 3)]
            kind = "thumb" if finger == "thumb" else "arm"
            out += [(a, b, kind) for a, b in pairwise(bones)]
        out.append((f"{side}_ankle", f"{side}_foot", "foot"))
    return out


def _direction(bone: Float64[np.ndarray, " 3"], kind: str) -> Float64[np.ndarray, " 3"]:
    """Return where VRM's T-pose has a bone point."""
    if kind == "foot":
        return np.array([0.0, bone[1], np.hypot(bone[0], bone[2])])
    side = np.sign(bone[0])
    return np.array([side, 0.0, 1.0 if kind == "thumb" else 0.0])


def _smallest_turn(bone: Float64[np.ndarray, " 3"], towards: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation that takes one direction to another, which is less than half a turn away."""
    a, b = bone / np.linalg.norm(bone), towards / np.linalg.norm(towards)
    axis = np.cross(a, b)
    length = np.linalg.norm(axis)
    angle = np.arctan2(length, a @ b)
    return Rotation.from_rotvec(angle * axis / max(length, 1e-12)).as_matrix()
