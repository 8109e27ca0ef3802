"""Pose a body of the SMPL family in numpy or, differentiably, in torch: `BodyModel`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from smplxpp.body.layout import HAND_WIDTH, POSE_NAMES
from smplxpp.core import ARRAY_NAMES, POSE_BLOCKS, BodyParams, InputError, TriangleMesh, matrix_from_rotvec
from smplxpp.core.rotations import Array, array_namespace
from smplxpp.skinning.linear_blend import forward_kinematics, skin

_WIDTHS = {name: 3 * joints for name, joints in POSE_BLOCKS} | {"transl": 3}


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A body in T poses; numpy float64, or torch tensors where the parameters were.

    `vertices = skin(rest_vertices, weights, posed_from_rest)` exactly: the translation is in the transforms, the
    pose correctives are in the rest vertices. Vertices are skinned when they are first asked for, because what cloth
    and players need of most poses are the transforms alone.

    Attributes:
        joints: posed joints, metres.
        rest_vertices: with shape, expression and pose correctives.
        rest_joints: joints of the shaped body, before posing.
        posed_from_rest: transforms of the joints.
        pose_offsets: the pose correctives within `rest_vertices`; None where the model has none.
        weights: skin weights of the model.
    """

    joints: Float[Array, "*T J 3"]
    rest_vertices: Float[Array, "*T V 3"]
    rest_joints: Float[Array, "*T J 3"]
    posed_from_rest: Float[Array, "*T J 4 4"]
    pose_offsets: Float[Array, "*T V 3"] | None
    weights: Float[Array, "V J"]

    @cached_property
    def vertices(self) -> Float[Array, "*T V 3"]:
        """Posed vertices, metres."""
        return skin(self.rest_vertices, self.weights, self.posed_from_rest)

    def __len__(self) -> int:
        return self.rest_vertices.shape[0]

    def __repr__(self) -> str:
        shape, joints = tuple(self.rest_vertices.shape), self.joints.shape[-2]
        return f"PosedBody(vertices of shape {shape}, {joints} joints)"

    def frame(self, index: int) -> PosedBody:
        """Return one frame, its arrays without the leading axis."""
        if not -len(self) <= index < len(self):
            raise InputError("frame", expected=f"an index below {len(self)}", received=str(index))
        offsets = None if self.pose_offsets is None else self.pose_offsets[index]
        return PosedBody(
            self.joints[index],
            self.rest_vertices[index],
            self.rest_joints[index],
            self.posed_from_rest[index],
            offsets,
            self.weights,
        )


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A body of the SMPL family (Loper et al. 2015, Pavlakos et al. 2019); float64, metres. Made by `load_body`.

    Attributes:
        name: of the file.
        v_template: mean shape in the rest pose.
        faces: corners of the triangles.
        shapedirs: metres a unit of beta.
        exprdirs: metres a unit of expression; E = 0 where the model has none.
        posedirs: pose correctives, P = 9 (J - 1); None where absent or zero.
        joint_regressor: rest joints of the vertices.
        parents: -1 at the root.
        joint_names: J names.
        weights: rows sum to 1.
        left_hand_components: principal components of the hand pose as rows; None where absent.
        right_hand_components: likewise.
        left_hand_mean: mean hand pose, axis-angle; None where absent.
        right_hand_mean: likewise.
        part_labels: indices into `part_label_names`: the file's own labels, else the joint of most weight.
        part_label_names: names of the parts.
        expression_names: E names; numbered where the file gives none.
        landmarks: points that detectors mark, by the names of `Keypoints2D`, as weighted means of vertices: indices and
            weights that sum to 1. Those that the file has: COCO's of the open body, faces of SMPL-X; else none.
        uv: texture coordinates in [0, 1], v upwards, and their rows at each corner of the faces; None where absent.

    Example:
        >>> smplxpp.load_body()
        BodyModel('open_body', 13,886 vertices, 27,676 faces, 55 joints, 20 betas, 52 expressions)
    """

    name: str
    v_template: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    shapedirs: Float64[np.ndarray, "V 3 B"]
    exprdirs: Float64[np.ndarray, "V 3 E"]
    posedirs: Float64[np.ndarray, "V 3 P"] | None
    joint_regressor: Float64[np.ndarray, "J V"]
    parents: Int64[np.ndarray, " J"]
    joint_names: tuple[str, ...]
    weights: Float64[np.ndarray, "V J"]
    left_hand_components: Float64[np.ndarray, "K 45"] | None
    right_hand_components: Float64[np.ndarray, "L 45"] | None
    left_hand_mean: Float64[np.ndarray, " 45"] | None
    right_hand_mean: Float64[np.ndarray, " 45"] | None
    part_labels: Int64[np.ndarray, " V"]
    part_label_names: tuple[str, ...]
    expression_names: tuple[str, ...] = ()
    landmarks: Mapping[str, tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]] = field(default_factory=dict)
    uv: tuple[Float64[np.ndarray, "U 2"], Int64[np.ndarray, "F 3"]] | None = None
    # Tensors of the arrays above, by (name, dtype, device).
    _tensors: dict = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.expression_names) != self.num_expressions:
            numbered = tuple(f"expression_{k:02d}" for k in range(self.num_expressions))
            object.__setattr__(self, "expression_names", numbered)
        self._check()

    def __repr__(self) -> str:
        counts = f"{len(self.v_template):,} vertices, {len(self.faces):,} faces, {len(self.parents)} joints"
        bases = f"{self.shapedirs.shape[-1]} betas, {self.exprdirs.shape[-1]} expressions"
        return f"BodyModel({self.name!r}, {counts}, {bases})"

    def _check(self) -> None:
        # Every array against V and J of the regressor and the tree; None in a shape leaves that axis open.
        V, J = self.joint_regressor.shape[-1], len(self.parents)
        shapes: dict[str, tuple[int | None, ...]] = {
            "v_template": (V, 3),
            "faces": (None, 3),
            "shapedirs": (V, 3, None),
            "exprdirs": (V, 3, None),
            "posedirs": (V, 3, 9 * (J - 1)),
            "joint_regressor": (J, V),
            "parents": (J,),
            "weights": (V, J),
            "left_hand_components": (None, HAND_WIDTH),
            "right_hand_components": (None, HAND_WIDTH),
            "left_hand_mean": (HAND_WIDTH,),
            "right_hand_mean": (HAND_WIDTH,),
            "part_labels": (V,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if len(value.shape) != len(shape) or any(
                b not in (None, a) for a, b in zip(value.shape, shape, strict=True)
            ):
                raise self._unfit(name, f"shape {shape}", f"shape {value.shape}")
        if len(self.joint_names) != J:
            raise self._unfit("joint_names", f"{J} names", f"{len(self.joint_names)}")
        # Parents before children, so that one pass over the joints composes all global transforms.
        if not (J and self.parents[0] == -1 and all(0 <= p < j for j, p in enumerate(self.parents.tolist()) if j)):
            raise self._unfit("parents", "one root first (-1), every parent before its children", "others")
        # Indices of labels and landmarks must exist.
        labels, names = self.part_labels, len(self.part_label_names)
        if labels.size and (labels.min() < 0 or labels.max() >= names):
            raise self._unfit("part_labels", f"indices in [0, {names})", "others")
        for name, (index, _) in self.landmarks.items():
            if index.size and (index.min() < 0 or index.max() >= V):
                raise self._unfit(f"landmark {name}", f"vertices in [0, {V})", "others")

    def _unfit(self, name: str, expected: str, received: str) -> InputError:
        return InputError(f"body model {self.name!r}: {name}", expected=expected, received=received)

    @property
    def vertex_count(self) -> int:
        return len(self.v_template)

    @property
    def joint_count(self) -> int:
        return len(self.parents)

    @property
    def num_betas(self) -> int:
        return self.shapedirs.shape[2]

    @property
    def num_expressions(self) -> int:
        return self.exprdirs.shape[2]

    @property
    def outer_skin(self) -> Bool[np.ndarray, " V"]:
        """Which vertices images and scans can show: all but those of eyes, teeth and tongue, by the names of parts."""
        inner = [any(word in name for word in ("eye", "teeth", "tongue")) for name in self.part_label_names]
        return ~np.array(inner, dtype=bool)[self.part_labels]

    def mesh(self, vertices: Float[np.ndarray, "V 3"] | None = None) -> TriangleMesh:
        """Return the body's faces on the given vertices, or on the mean shape."""
        return TriangleMesh(self.v_template if vertices is None else vertices, self.faces)

    def forward(self, params: BodyParams | Mapping[str, Array], *, flat_hand_mean: bool | None = None) -> PosedBody:
        """Pose the body by linear blend skinning.

        `v = v_template + shapedirs betas + v_shape + exprdirs expression`, `J = joint_regressor v`,
        `rest = v + posedirs vec(R_1.. - I)`, `x = sum_j w_j G_j(J, R) rest + transl`; the root turns about `J_0`.
        Hands narrower than 45 numbers are PCA coefficients of the first components. Parameters of joints that the
        model lacks are ignored (face for SMPL-H; face and fingers for SMPL).

        Args:
            params: T frames (numpy, float64), or a mapping of torch tensors (T, width) or (1, width) with the same
                names, missing ones zero (`v_shape` is taken of BodyParams alone); the result has their dtype and device
                and is differentiable.
            flat_hand_mean: do not add the model's mean hand. None: as the parameters say (`flat_hand_mean` of
                BodyParams; the key of a mapping; otherwise False).

        Returns:
            The posed body of T frames.

        Raises:
            InputError: more betas or expressions than the model has, `v_shape` of another number of vertices, hand PCA
                for a model without it, wrong shapes.
        """
        if flat_hand_mean is None:
            flat_hand_mean = (
                params.flat_hand_mean if isinstance(params, BodyParams) else bool(params.get("flat_hand_mean", False))
            )
        # Shape first: joints are regressed from the shaped vertices, before any pose corrective is added.
        arrays = _checked_arrays(params)
        rotations = matrix_from_rotvec(self._axis_angles(arrays, flat_hand_mean))
        shaped, rest_joints = self._shaped(arrays)
        offsets = self._pose_offsets(rotations)
        # Correctives belong to the rest pose, before skinning. The translation is in the transforms of the joints.
        rest = shaped if offsets is None else shaped + offsets
        posed_from_rest, joints = forward_kinematics(rest_joints, self.parents, rotations, transl=arrays["transl"])
        weights = self._constant("weights", rest)
        return PosedBody(joints, rest, rest_joints, posed_from_rest, offsets, weights)

    def axis_angles(self, params: BodyParams) -> Float64[np.ndarray, "T J 3"]:
        """Return every joint's axis-angle vector relative to its parent's frame, including the mean hand and PCA."""
        return self._axis_angles(_checked_arrays(params), params.flat_hand_mean)

    def joint_rotations(self, params: BodyParams) -> Float64[np.ndarray, "T J 3 3"]:
        """Return every joint's rotation relative to its parent's frame, hands complete (mean and PCA included)."""
        return matrix_from_rotvec(self.axis_angles(params))

    def rest_joints(self, params: BodyParams | Mapping[str, Array]) -> Float[Array, "T J 3"]:
        """Return the joints of the shaped body before posing, metres."""
        return self._shaped(_checked_arrays(params))[1]

    def _shaped(self, arrays: Mapping[str, Array]) -> tuple[Array, Array]:
        betas, expression = arrays["betas"], arrays["expression"]
        vertices = self._constant("v_template", betas) + self._blend("shapedirs", betas, "betas")
        # Joints are linear in the vertices, and so in the coefficients: no pose reads the regressor.
        joints = self._constant("_joints", betas) + self._blend("_joints_by_shape", betas, "betas")
        if self.num_expressions:
            vertices = self._with_expression(vertices, expression)
            joints = joints + self._blend("_joints_by_expression", expression, "expression")
        if "v_shape" in arrays:
            offsets = self._checked_offsets(arrays["v_shape"])
            vertices, joints = vertices + offsets, joints + self._constant("joint_regressor", offsets) @ offsets
        return vertices, joints

    def _with_expression(self, vertices: Array, expression: Array) -> Array:
        """Return vertices moved by an expression; with numpy only those of the face are touched."""
        rows, directions = self._expressive
        if not isinstance(expression, np.ndarray) or 2 * len(rows) > self.vertex_count:
            return vertices + self._blend("exprdirs", expression, "expression")
        moved = self._product(directions, expression, "expression")
        out = np.repeat(vertices, len(moved), axis=0) if len(vertices) < len(moved) else vertices.copy()
        out[:, rows] += moved
        return out

    @cached_property
    def _expressive(self) -> tuple[Int64[np.ndarray, " E"], Float64[np.ndarray, "E 3 n"]]:
        """The vertices that expressions move, and their directions."""
        rows = np.flatnonzero(self.exprdirs.any(axis=(1, 2)))
        return rows, self.exprdirs[rows]

    @cached_property
    def _joints(self) -> Float64[np.ndarray, "J 3"]:
        return self.joint_regressor @ self.v_template

    @cached_property
    def _joints_by_shape(self) -> Float64[np.ndarray, "J 3 n"]:
        return np.einsum("jv,vcn->jcn", self.joint_regressor, self.shapedirs, optimize=True)

    @cached_property
    def _joints_by_expression(self) -> Float64[np.ndarray, "J 3 n"]:
        return np.einsum("jv,vcn->jcn", self.joint_regressor, self.exprdirs, optimize=True)

    def _checked_offsets(self, offsets: Array) -> Array:
        if offsets.shape[1] != self.vertex_count:
            raise InputError(
                "parameter v_shape",
                expected=f"{self.vertex_count} vertices, as the body {self.name!r} has",
                received=f"{offsets.shape[1]}",
                remedy="use the body that the parameters were fitted with",
            )
        return offsets

    def _blend(self, basis_name: str, coefficients: Array, subject: str) -> Array:
        """Return offsets (T, V, 3) of the first n directions for (T, n) coefficients."""
        return self._product(self._constant(basis_name, coefficients), coefficients, subject)

    def _product(self, basis: Array, coefficients: Array, subject: str) -> Array:
        used, known = coefficients.shape[-1], basis.shape[-1]
        if used > known:
            raise InputError(
                f"parameter {subject}",
                expected=f"at most {known} numbers for the body {self.name!r}",
                received=f"{used}",
                remedy="use the body that the parameters were fitted with, or cut the parameters "
                "(smplxpp params convert --betas, load_params(max_betas=))",
            )
        # One matrix product over all vertices and axes; fewer coefficients than directions use the first of these.
        flat = basis.reshape(3 * len(basis), known)[:, :used]
        return (coefficients @ flat.T).reshape(-1, len(basis), 3)

    def _pose_offsets(self, rotations: Array) -> Array | None:
        if self.posedirs is None:
            return None
        identity = matrix_from_rotvec(_zeros(rotations, (3,)))  # of the rotations' kind, type and device
        # Correctives are linear in R_j - I of every joint but the root, whose rotation deforms nothing (Loper et al.
        # 2015).
        feature = rotations[:, 1:] - identity
        return self._blend("posedirs", feature.reshape(len(rotations), -1), "pose")

    def _axis_angles(self, arrays: Mapping[str, Array], flat_hand_mean: bool) -> Array:
        """Return the axis-angle vectors (T, J, 3) of all joints."""
        blocks = []
        for name in POSE_NAMES[self.joint_count]:
            value = arrays[name]
            blocks.append(self._full_hand(name, value, flat_hand_mean) if name.endswith("hand_pose") else value)
        full = array_namespace(blocks[0]).concatenate(blocks, -1).reshape(len(blocks[0]), -1, 3)
        # Joints beyond the named blocks, the two hands of SMPL, do not rotate.
        missing = self.joint_count - full.shape[1]
        if missing:
            full = array_namespace(full).concatenate([full, _zeros(full, (len(full), missing, 3))], 1)
        return full

    def _full_hand(self, name: str, value: Array, flat_hand_mean: bool) -> Array:
        side = name.removesuffix("_pose")
        width = value.shape[-1]
        if width < HAND_WIDTH:
            components = self._constant(f"{side}_components", value)
            if components is None or width > len(components):
                raise InputError(
                    f"parameter {name}",
                    expected=f"{HAND_WIDTH} axis-angle numbers: the body {self.name!r} has "
                    + ("no hand PCA" if components is None else f"{len(components)} hand components"),
                    received=f"{width} PCA coefficients",
                    remedy="load the body model that the parameters were fitted with",
                )
            # Coefficients of the first principal components, hence 45 axis-angle numbers of 15 joints.
            value = value @ components[:width]
        mean = None if flat_hand_mean else self._constant(f"{side}_mean", value)
        return value if mean is None else value + mean

    def _constant(self, name: str, like: Array) -> Array:
        """Return a field as an array of the kind, type and device of `like`."""
        value = getattr(self, name)
        if value is None or isinstance(like, np.ndarray):
            return value
        key = (name, like.dtype, like.device)
        if key not in self._tensors:
            torch = sys.modules["torch"]
            # A constant made under inference_mode could not take part in autograd later.
            with torch.inference_mode(False):
                self._tensors[key] = torch.tensor(value, dtype=like.dtype, device=like.device)
        return self._tensors[key]


def _checked_arrays(params: BodyParams | Mapping[str, Array]) -> dict[str, Array]:
    """Return every array by name with T rows; missing ones are zero."""
    if isinstance(params, BodyParams):
        arrays = {name: getattr(params, name) for name in ARRAY_NAMES}
        return arrays if params.v_shape is None else {**arrays, "v_shape": params.v_shape}
    given = {name: params[name] for name in ARRAY_NAMES if name in params}
    if not given:
        raise InputError(
            "parameters", expected=f"some of {', '.join(ARRAY_NAMES)}", received=f"keys {sorted(map(str, params))}"
        )
    for name, value in given.items():
        width = _WIDTHS.get(name)
        hand = name.endswith("hand_pose")
        if value.ndim != 2 or (width and value.shape[1] != width and not (hand and value.shape[1] < width)):
            raise InputError(
                f"parameter {name}", expected=f"shape (T, {width or 'any'})", received=f"shape {tuple(value.shape)}"
            )
    # A single row stands for all frames; broadcasting keeps it a view and the gradient flows back to the one row.
    frames = max(value.shape[0] for value in given.values())
    like = next(iter(given.values()))
    xp, out = array_namespace(like), {}
    for name in ARRAY_NAMES:
        value = given[name] if name in given else _zeros(like, (1, _WIDTHS.get(name, 0)))
        if value.shape[0] not in (1, frames):
            raise InputError(f"parameter {name}", expected=f"1 or {frames} frames", received=f"{value.shape[0]}")
        out[name] = xp.broadcast_to(value, (frames, value.shape[1]))
    return out


def _zeros(like: Array, shape: tuple[int, ...]) -> Array:
    return np.zeros(shape) if isinstance(like, np.ndarray) else like.new_zeros(shape)
