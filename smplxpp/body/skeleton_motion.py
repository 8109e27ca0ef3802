"""A skeleton and its motion as files of animation programs hold them: what the readers of BVH, glTF and FBX return."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from smplxpp.core import DEFAULT_FPS, GeometryWarning, InputError


@dataclass(frozen=True, eq=False)
class SkeletonMotion:
    """A skeleton and its motion, in the file's own units and axes.

    Attributes:
        names: of the J joints, every parent before its children; end sites are left out.
        parents: index of each joint's parent, -1 for the root.
        offsets: of each joint from its parent at rest; that of the root from the origin.
        rotations: of each joint relative to its parent; the identity at rest.
        root: position of the root.
        fps: frames a second.
        positions: position relative to its parent of every other joint that moves against it, which replaces its
            offset, by the joint's index.
        tips: offset of the end site of every joint that has one, by the joint's index.
        stated: index of the joint for each of ours that the file itself names as a human's (VRM).
        neutral: whether the rest pose is one that the skeleton was made in, not a moment of some motion.
    """

    names: tuple[str, ...]
    parents: Int64[np.ndarray, " J"]
    offsets: Float64[np.ndarray, "J 3"]
    rotations: Float64[np.ndarray, "T J 3 3"]
    root: Float64[np.ndarray, "T 3"]
    fps: float
    positions: Mapping[int, Float64[np.ndarray, "T 3"]] = field(default_factory=dict)
    tips: Mapping[int, Float64[np.ndarray, " 3"]] = field(default_factory=dict)
    stated: Mapping[str, int] = field(default_factory=dict)
    neutral: bool = True

    @property
    def rest(self) -> Float64[np.ndarray, "J 3"]:
        """The positions of the joints at rest, with the root at its offset."""
        places = np.zeros_like(self.offsets)
        for joint, parent in enumerate(self.parents):
            places[joint] = self.offsets[joint] + (places[parent] if parent >= 0 else 0.0)
        return places

    @classmethod
    def from_transforms(
        cls,
        names: Sequence[str],
        parents: Int64[np.ndarray, " J"],
        rest: Float64[np.ndarray, "J 4 4"],
        world: Float64[np.ndarray, "T J 4 4"],
        *,
        fps: float,
        stated: Mapping[str, int] | None = None,
    ) -> SkeletonMotion:
        """Return the motion of joints by their transforms to the world, of which scales are left out.

        A joint's axes at rest are forgotten, as BVH has none: with `W_j` its rotation in the world and `B_j` that at
        rest, it turns by `W_j B_j^T`, of which its rotation relative to the parent's follows.

        Args:
            names: of the J joints.
            parents: every parent before its children, -1 for the root, which comes first.
            rest: transforms at rest.
            world: transforms in T frames.
            fps: frames a second.
            stated: index of the joint for each of ours that the file names.

        Raises:
            InputError: transforms that are not finite.

        Example:
            >>> rest = np.tile(np.eye(4), (2, 1, 1))
            >>> rest[1, 1, 3] = 2.0
            >>> motion = SkeletonMotion.from_transforms(["a", "b"], np.array([-1, 0]), rest, rest[None], fps=30.0)
            >>> motion.offsets[1].tolist(), motion.rotations[0, 1].tolist() == np.eye(3).tolist()
            ([0.0, 2.0, 0.0], True)
        """
        if not (np.isfinite(rest).all() and np.isfinite(world).all()):
            raise InputError("motion", expected="finite transforms of its joints", received="others")
        places = world[..., :3, 3]
        turns = _turns(world) @ np.swapaxes(_turns(rest), 1, 2)
        has = parents >= 0
        rotations, offsets = turns.copy(), rest[:, :3, 3].copy()
        rotations[:, has] = np.swapaxes(turns[:, parents[has]], 2, 3) @ turns[:, has]
        offsets[has] -= rest[parents[has], :3, 3]
        # Joints that keep their bone need no positions; rounding of single precision is no motion.
        step = np.zeros_like(places)
        step[:, has] = places[:, has] - places[:, parents[has]]
        step[:, has] = (np.swapaxes(turns[:, parents[has]], 2, 3) @ step[:, has, :, None])[..., 0]
        size, rounding = float(np.ptp(rest[:, :3, 3], axis=0).max()), 1e-4
        moved = np.abs(step - offsets).max(axis=(0, 2)) > rounding * size
        positions = {int(k): step[:, k] for k in np.flatnonzero(has & moved)}
        return cls(
            tuple(names), parents, offsets, rotations, places[:, 0].copy(), fps, positions, stated=dict(stated or {})
        )


def _turns(transforms: Float64[np.ndarray, "*batch 4 4"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """Return the rotations of transforms by their first two axes (Gram and Schmidt); the identity of flat ones."""
    x, y = transforms[..., :3, 0], transforms[..., :3, 1]
    flat = 1e-30  # square of an area: nodes that are scaled to nothing
    z = np.cross(x, y)
    whole = (z**2).sum(axis=-1) > flat
    x, z = np.where(whole[..., None], x, [1.0, 0.0, 0.0]), np.where(whole[..., None], z, [0.0, 0.0, 1.0])
    x, z = (axis / np.linalg.norm(axis, axis=-1, keepdims=True) for axis in (x, z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def rate_of_keys(
    times: Sequence[Float64[np.ndarray, " K"]], joints: int, subject: str
) -> tuple[Float64[np.ndarray, " T"], float]:
    """Return the times of the frames of a motion that is stored as keys, and frames a second.

    Exporters write a key for each frame, or leave out those that others give: the rate is that of the shortest step
    between keys, if all of them lie on its grid. Keys on no grid, or far apart, are animated by hand: frames are then
    taken at `DEFAULT_FPS`.

    Args:
        times: seconds of the keys of each animated property.
        joints: number of joints, which with the frames decides how much is made of them.
        subject: the file, for messages.

    Raises:
        InputError: more frames than any motion has.

    Example:
        >>> times, fps = rate_of_keys([np.array([0.0, 0.04, 0.12])], 1, "motion a.glb")
        >>> len(times), round(fps, 6)
        (4, 25.0)
    """
    every = np.unique(np.concatenate(list(times)))
    span = float(every[-1] - every[0])
    slowest, fastest = 5.0, 1000.0  # frames a second that recordings have
    steps = np.diff(every)
    steps = steps[steps > 1.0 / fastest]
    fps = DEFAULT_FPS
    if len(steps) and steps.min() < 1.0 / slowest:
        # Times are single floats and rounded by some writers: the whole span tells the rate best.
        count = max(round(span / float(steps.min())), 1)
        grid = (every - every[0]) * (count / span)
        near = 0.1  # of a frame
        fps = count / span if np.abs(grid - grid.round()).max() < near else DEFAULT_FPS
    frames = round(span * fps) + 1
    # Joints times frames: 20 minutes of a hundred joints, half a gigabyte. It bounds small files with keys far apart.
    most = 1 << 22
    if frames * joints > most:
        raise InputError(
            subject,
            expected=f"at most {most // joints} frames of {joints} joints",
            received=f"{frames} in {span:.6g} seconds",
            remedy="cut the motion in the program that wrote it",
        )
    return every[0] + np.arange(frames) / fps, fps


def chosen_clip(names: Sequence[str], clip: str | None, subject: str) -> int:
    """Return the number of the motion of a file that is to be read.

    Args:
        names: of the file's motions, of which there is one at least.
        clip: name of the one that is wanted; None: the first.
        subject: the file, for messages.

    Raises:
        InputError: no motion of that name.

    Warns:
        GeometryWarning: several motions and none chosen.
    """
    named = 20  # motions that a message names
    listed = ", ".join(names[:named]) + (f" and {len(names) - named} more" if len(names) > named else "")
    if clip is not None:
        if clip not in names:
            raise InputError(f"{subject}: option clip", expected=f"one of {listed}", received=repr(clip)[:80])
        return list(names).index(clip)
    if len(names) > 1:
        warnings.warn(
            f"{subject}: the first of {len(names)} motions is read; --clip NAME chooses another: {listed}",
            GeometryWarning,
            stacklevel=3,
        )
    return 0


def moving_skeleton(parents: Mapping[int, int], skins: Sequence[set[int]], moving: set[int]) -> list[int]:
    """Return the nodes of the skeleton in a scene that moves, from the scene's root on, parents before children.

    It is that of the skin whose joints move most, with all that moves, or is skinned to, below the node that all of
    these joints hang on; without such a skin, what moves.

    Args:
        parents: parent of each node of the scene, parents before children; none of them for a root.
        skins: joints of each skin.
        moving: nodes that turn, one at least.
    """
    chosen = max(skins, key=lambda skin: len(skin & moving), default=set())
    chosen = chosen if chosen & moving else moving
    lines = [_above(parents, node) for node in chosen]
    shared = set(lines[0]).intersection(*lines[1:])
    top = next((node for node in lines[0] if node in shared), None)
    if top is not None:
        chosen = {node for node in moving.union(*skins) if top in _above(parents, node)}
    else:
        # Joints under several roots: the root with most of them.
        roots = [line[-1] for line in lines]
        chosen = {node for node in chosen if _above(parents, node)[-1] == max(roots, key=roots.count)}
    whole = {above for node in chosen for above in _above(parents, node)}
    return [node for node in parents if node in whole]


def _above(parents: Mapping[int, int], node: int) -> list[int]:
    """Return a node and all above it, up to its root."""
    found = []
    while node in parents:
        found.append(node)
        node = parents[node]
    return found


def rest_transforms(
    joints: Sequence[int],
    parents: Mapping[int, int],
    standing: Mapping[int, Float64[np.ndarray, "4 4"]],
    bound: Mapping[int, Float64[np.ndarray, "4 4"]],
) -> Float64[np.ndarray, "J 4 4"]:
    """Return where joints stand at rest: as the skin is bound, in the scene's axes, else as the nodes stand.

    Nodes may stand in the first frame of a motion instead. Skins are bound in the mesh's own space, which may have
    other axes and another unit than the scene: one similarity takes all of them there.

    Args:
        joints: the J joints, parents before children.
        parents: parent of each node.
        standing: transform of each joint to the world, as the nodes stand.
        bound: transform of each joint to the mesh's space as the skin is bound; may be empty.
    """
    if not bound:
        return np.stack([standing[node] for node in joints])
    # Where the nodes stand as they are bound, all of them ask for the same similarity.
    to_scene = np.stack([standing[node] @ np.linalg.inv(matrix) for node, matrix in bound.items()])
    scale = np.cbrt(abs(float(np.linalg.det(to_scene[0, :3, :3]))))
    same = 1e-3  # rounding of single precision, as a share of the scale
    if np.abs(to_scene[:, :3, :3] - to_scene[0, :3, :3]).max() < same * scale:
        return np.stack([standing[node] for node in joints])
    # Else the axes' part of the turn between both: what is left of it is the pose's.
    group = Rotation.create_group("O")
    axes = min(group, key=lambda one: float(np.linalg.norm(one.as_matrix() - to_scene[0, :3, :3] / scale)))
    similarity = np.eye(4)
    similarity[:3, :3] = scale * axes.as_matrix()
    rest: dict[int, Float64[np.ndarray, "4 4"]] = {}
    for node in joints:
        parent = parents[node]
        if node in bound:
            rest[node] = similarity @ bound[node]
        elif parent in rest:
            rest[node] = rest[parent] @ np.linalg.inv(standing[parent]) @ standing[node]
        else:
            rest[node] = standing[node]
    # Joints above the bound ones stay where they stand: their turns and places are the pelvis' way.
    return np.stack([rest[node] for node in joints])
