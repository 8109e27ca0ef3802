"""Read motions of skeletons from glTF files: animations of a .glb, .gltf or .vrm, and of VRM's own .vrma.

glTF 2.0, sections 3.11 (animations) and Appendix C (interpolation); VRMC_vrm and VRMC_vrm_animation 1.0 and VRM 0.x for
the names of a human's bones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from smplxpp.body.layout import PROGRAM_NAMES
from smplxpp.body.skeleton_motion import (
    SkeletonMotion,
    chosen_clip,
    moving_skeleton,
    rate_of_keys,
    rest_transforms,
)
from smplxpp.core.errors import InputError, warn_of_left_out
from smplxpp.core.files.json_file import as_object
from smplxpp.core.mesh_files.gltf_document import GltfDocument
from smplxpp.core.mesh_files.gltf_skins import Node, world_nodes

_PATHS = {"translation": 3, "rotation": 4, "scale": 3}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
_SPINE = ("spine1", "spine2", "spine3")  # whose heights differ: found on the path from pelvis to neck, not by name


@dataclass(frozen=True, eq=False)
class _Channel:
    """Keys of one property of a node: K times in seconds, and values (K, 3 or 4) or, for splines, (K, 3, 3 or 4)."""

    times: Float64[np.ndarray, " K"]
    values: np.ndarray
    interpolation: str

    def at(self, times: Float64[np.ndarray, " T"]) -> Float64[np.ndarray, "T C"]:
        """Return the property at times; before the first key and after the last it stays as it is there."""
        turns = self.values.shape[-1] == 4
        times = np.clip(times, self.times[0], self.times[-1])
        last = max(len(self.times) - 2, 0)
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, last)
        after = np.minimum(k + 1, len(self.times) - 1)
        step = self.times[after] - self.times[k]
        share = np.where(step > 0.0, (times - self.times[k]) / np.where(step > 0.0, step, 1.0), 0.0)[:, None]
        if self.interpolation == "CUBICSPLINE":
            # Rows of a key: incoming tangent, value, outgoing tangent; tangents are a second's.
            a, b = self.values[k, 1], self.values[after, 1]
            out, into = step[:, None] * self.values[k, 2], step[:, None] * self.values[after, 0]
            s2, s3 = share**2, share**3
            found = (2 * s3 - 3 * s2 + 1) * a + (s3 - 2 * s2 + share) * out + (3 * s2 - 2 * s3) * b + (s3 - s2) * into
        elif self.interpolation == "STEP":
            # Frames lie on keys up to rounding.
            found = self.values[np.where(share[:, 0] > 1.0 - 1e-3, after, k)]
        elif turns:
            # On the shorter arc from one quaternion to the next.
            first, second = (Rotation.from_quat(self.values[i]) for i in (k, after))
            found = (first * Rotation.from_rotvec(share * (first.inv() * second).as_rotvec())).as_quat()
        else:
            found = self.values[k] + share * (self.values[after] - self.values[k])
        return found


def read_gltf_motion(path: str | Path, *, clip: str | None = None) -> SkeletonMotion:
    """Read an animation of a skeleton from a glTF file.

    The skeleton is that of the skin whose joints move most often or, without a skin, all nodes that move. At rest it
    stands as the skin is bound, else as the nodes stand. Files keep keys, not frames: frames are taken at the rate of
    the keys (`rate_of_keys`). Bones that a VRM names as a human's are told as such.

    Args:
        path: of a .glb, .gltf, .vrm or .vrma.
        clip: name of the animation; None: the first one that moves a skeleton.

    Raises:
        InputError: no glTF 2.0, no animation of a skeleton, damaged keys, no animation of that name.

    Warns:
        GeometryWarning: animations that are not chosen; weights of morph targets, which are not read.
    """
    document = GltfDocument(Path(path))
    nodes = {node.index: node for node in world_nodes(document)}
    clips: dict[str, tuple[dict[tuple[int, str], _Channel], set[str]]] = {}
    for k in _range(document, "animations"):
        one = document.entry("animations", k)
        name = one.get("name")
        channels, left_out = _channels(document, one, nodes)
        if any(kind == "rotation" for _, kind in channels):
            named = isinstance(name, str) and name and name not in clips
            clips[str(name) if named else f"animation {k}"] = channels, left_out
    subject = f"motion {path}"
    if not clips:
        raise InputError(
            subject,
            expected="an animation of a skeleton",
            received=f"none among {len(nodes)} nodes",
            remedy="export it with its animation; a mesh alone is no motion",
        )
    channels, left_out = list(clips.values())[chosen_clip(list(clips), clip, subject)]
    warn_of_left_out(subject, sorted(left_out), reason="animated, and not read")
    joints = _joints(document, nodes, channels)
    times, fps = rate_of_keys([one.times for one in channels.values()], len(joints), subject)
    bound, standing = _bound(document, joints), {node: nodes[node].world for node in joints}
    motion = SkeletonMotion.from_transforms(
        _names(nodes, joints),
        np.array([joints.index(nodes[k].parent) if nodes[k].parent in joints else -1 for k in joints]),
        rest_transforms(joints, {node: one.parent for node, one in nodes.items()}, standing, bound),
        _world(nodes, joints, channels, times),
        fps=fps,
        stated=_human_bones(document, joints),
    )
    # VRM animations have no skin; their nodes stand as a T by definition.
    return replace(motion, neutral=bool(bound or motion.stated))


def _channels(
    document: GltfDocument, animation: dict[str, Any], nodes: dict[int, Node]
) -> tuple[dict[tuple[int, str], _Channel], set[str]]:
    """Return the channels of an animation by node and property, and what else it moves."""
    subject = f"motion {document.path}: animation"
    samplers = document.items(animation, "samplers")
    found: dict[tuple[int, str], _Channel] = {}
    others: set[str] = set()
    for channel in (as_object(one, subject=subject) for one in document.items(animation, "channels")):
        target = document.part(channel, "target")
        kind = target.get("path")
        if not isinstance(kind, str) or kind not in _PATHS or "node" not in target:
            others.add("morph targets (faces)" if kind == "weights" else repr(kind)[:40])
            continue
        node, index = document.number(target, "node"), document.number(channel, "sampler")
        if node not in nodes:
            continue
        if index >= len(samplers):
            raise InputError(subject, expected=f"a sampler below {len(samplers)}", received=str(index))
        sampler = as_object(samplers[index], subject=subject)
        times = document.accessor(sampler.get("input")).astype(np.float64).reshape(-1)
        values = document.accessor(sampler.get("output")).astype(np.float64)
        interpolation = sampler.get("interpolation", "LINEAR")
        rows = 3 if interpolation == "CUBICSPLINE" else 1
        width = _PATHS[kind]
        if interpolation not in _INTERPOLATIONS or values.shape != (rows * len(times), width) or not len(times):
            raise InputError(
                subject,
                expected=f"{width} numbers a key of {kind}, {' or '.join(_INTERPOLATIONS)}",
                received=f"{len(times)} keys, values of shape {values.shape}, {interpolation!r}"[:120],
            )
        if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) >= 0.0).all()):
            raise InputError(subject, expected="finite keys in the order of time", received="others")
        found[node, kind] = _Channel(times, values.reshape(-1, 3, width) if rows == 3 else values, interpolation)
        if kind == "rotation" and not (np.linalg.norm(values.reshape(-1, rows, 4)[:, rows // 2], axis=1) > 1e-6).all():
            raise InputError(subject, expected="quaternions", received="one of length 0")
    return found, others


def _joints(document: GltfDocument, nodes: dict[int, Node], channels: dict[tuple[int, str], _Channel]) -> list[int]:
    """Return the nodes of the skeleton that moves, parents before children."""
    moving = {node for node, kind in channels if kind == "rotation"}
    listed = [document.items(document.entry("skins", k), "joints") for k in _range(document, "skins")]
    skins = [{node for node in skin if isinstance(node, int) and node in nodes} for skin in listed]
    skins += [{node for node in _bones(document).values() if node in nodes}]
    return moving_skeleton({node: one.parent for node, one in nodes.items()}, skins, moving)


def _range(document: GltfDocument, kind: str) -> range:
    return range(len(document.items(document.json, kind)))


def _names(nodes: dict[int, Node], joints: list[int]) -> tuple[str, ...]:
    """Return the nodes' names; one that has none, or that of another, gets its number."""
    names: list[str] = []
    for index in joints:
        name = nodes[index].json.get("name")
        own = name if isinstance(name, str) and name else f"node {index}"
        names.append(own if own not in names else f"{own} ({index})")
    return tuple(names)


def _bones(document: GltfDocument) -> dict[str, int]:
    """Return the nodes that a VRM names as bones of a human, by VRM's names."""
    extensions = document.part(document.json, "extensions")
    for name in ("VRMC_vrm_animation", "VRMC_vrm"):
        bones = document.part(document.part(document.part(extensions, name), "humanoid"), "humanBones")
        if bones:
            return {bone: document.number(document.part(bones, bone), "node") for bone in bones}
    older = document.items(document.part(document.part(extensions, "VRM"), "humanoid"), "humanBones")
    named = [as_object(one, subject=document.subject) for one in older]
    return {str(one.get("bone")): document.number(one, "node") for one in named}


def _human_bones(document: GltfDocument, joints: list[int]) -> dict[str, int]:
    """Return the rank in the skeleton of the joint for each of ours that a VRM names."""
    ours = {theirs: name for name, theirs in PROGRAM_NAMES["vrm"].items() if name not in _SPINE}
    # VRM 0.x calls the thumb's bones as those of other fingers.
    thumbs = {f"{side}ThumbIntermediate": f"{side}_thumb2" for side in ("left", "right")}
    bones = _bones(document)
    older = any(name in bones for name in thumbs)
    if older:
        ours |= thumbs | {f"{side}ThumbProximal": f"{side}_thumb1" for side in ("left", "right")}
    return {ours[bone]: joints.index(node) for bone, node in bones.items() if bone in ours and node in joints}


def _bound(document: GltfDocument, joints: list[int]) -> dict[int, Float64[np.ndarray, "4 4"]]:
    """Return how skins are bound to joints: transforms from a joint to the mesh's own space."""
    bound: dict[int, Float64[np.ndarray, "4 4"]] = {}
    for k in _range(document, "skins"):
        skin = document.entry("skins", k)
        own = document.items(skin, "joints")
        if "inverseBindMatrices" not in skin:
            continue
        inverse = document.accessor(skin["inverseBindMatrices"]).astype(np.float64)
        if inverse.shape != (len(own), 16):
            continue
        for node, matrix in zip(own, inverse.reshape(-1, 4, 4).transpose(0, 2, 1), strict=True):
            if isinstance(node, int) and node in joints and abs(float(np.linalg.det(matrix[:3, :3]))) > 0.0:
                bound.setdefault(node, np.linalg.inv(matrix))
    return bound


def _world(
    nodes: dict[int, Node],
    joints: list[int],
    channels: dict[tuple[int, str], _Channel],
    times: Float64[np.ndarray, " T"],
) -> Float64[np.ndarray, "T J 4 4"]:
    """Return the transforms of the joints to the world at times."""
    world = np.empty((len(times), len(joints), 4, 4))
    place = {node: k for k, node in enumerate(joints)}
    for k, index in enumerate(joints):
        node = nodes[index]
        above = nodes[node.parent].world if node.parent >= 0 else np.eye(4)
        local = np.tile(_local(above, node.world), (len(times), 1, 1))
        own = {kind: channels[index, kind].at(times) for kind in _PATHS if (index, kind) in channels}
        if "rotation" in own or "scale" in own:
            # A node that is animated has no matrix, so that its columns are its axes times its scale.
            size = np.linalg.norm(local[0, :3, :3], axis=0)
            turns = Rotation.from_quat(own["rotation"]).as_matrix() if "rotation" in own else local[:, :3, :3] / size
            local[:, :3, :3] = turns * own.get("scale", size[None])[:, None, :]
        if "translation" in own:
            local[:, :3, 3] = own["translation"]
        world[:, k] = world[:, place[node.parent]] @ local if node.parent in place else local
    return world


def _local(above: Float64[np.ndarray, "4 4"], world: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Return a node's transform to its parent; the identity where the parent is squeezed flat."""
    if not abs(float(np.linalg.det(above[:3, :3]))) > 0.0:
        return np.eye(4)
    return np.linalg.inv(above) @ world
