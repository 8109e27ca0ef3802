"""The student's non-rigid field: displacements of the template's vertices from pose and frame code."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from avatar.models.networks.config_dict import MOST_LAYERS
from avatar.models.networks.control_points import ControlPoints
from avatar.models.networks.sparse_lookups import SparseRows
from smplxpp.core import InputError, require_at_least, require_between


@dataclass(frozen=True)
class FieldConfig:
    """Sizes of the field. The defaults are the paper's.

    Attributes:
        frequencies: number of bands L of the positional encoding.
        pose_size: length of theta (21 body joints, axis-angle).
        code_size: length of a frame's code z_t.
        width: of the layers of both MLPs.
        hidden_layers: number of them; one more layer gives the displacement.
        local_pose: number of steps along the skeleton from the joints that carry a point to the joints of theta that it
            depends on (`seen_joints`); the others are zero. 0, as published: all of them.
    """

    frequencies: int = 6
    pose_size: int = 63
    code_size: int = 32
    width: int = 64
    hidden_layers: int = 5
    local_pose: int = 0

    def __post_init__(self) -> None:
        for name in ("frequencies", "local_pose"):
            require_between(f"field {name}", getattr(self, name), 0, MOST_LAYERS)
        for name in ("pose_size", "code_size", "width"):
            require_at_least(f"field {name}", getattr(self, name), 1)
        require_between("field hidden_layers", self.hidden_layers, 1, MOST_LAYERS)

    @property
    def encoding_size(self) -> int:
        """Length of a point's positional encoding."""
        return 3 + 6 * self.frequencies


def positional_encoding(points: Float[Tensor, "*P 3"], frequencies: int) -> Float[Tensor, "*P E"]:
    """Return `phi(v) = (v, sin(2^l pi v), cos(2^l pi v) for l < L)` (Mildenhall et al. 2020, equation 4).

    Args:
        points: metres.
        frequencies: L; E is 3 + 6 L.
    """
    # Frequencies pi 2^l, outer product with x, y, z: (..., 3 L) angles.
    bands = math.pi * 2.0 ** torch.arange(frequencies, dtype=points.dtype, device=points.device)
    angles = (points[..., None, :] * bands[:, None]).flatten(-2)
    return torch.cat([points, torch.sin(angles), torch.cos(angles)], dim=-1)


class FieldNetwork(nn.Module):
    """MLP on the concatenation of phi(v), theta and z; hidden layers have He's initialisation, the last one is zero.

    The first layer is linear in its parts. Its part of pose and code is computed once a frame (and once for every set
    of joints), not once a vertex. PyTorch's default initialisation halves the signal in every layer and adds constants:
    after five layers points and frames were alike, and units died within some hundred steps.
    """

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.of_point = nn.Linear(config.encoding_size, config.width, bias=False)
        self.of_frame = nn.Linear(config.pose_size + config.code_size, config.width)
        hidden = [nn.Linear(config.width, config.width) for _ in range(config.hidden_layers - 1)]
        self.hidden = nn.ModuleList(hidden)
        self.last = nn.Linear(config.width, 3)
        fan_in = config.encoding_size + config.pose_size + config.code_size
        for layer in (self.of_point, self.of_frame):
            # The bound of a single layer of all inputs.
            nn.init.uniform_(layer.weight, -math.sqrt(6.0 / fan_in), math.sqrt(6.0 / fan_in))
        nn.init.zeros_(self.of_frame.bias)
        for layer in hidden:
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, encodings: Tensor, frames: Tensor, member: Tensor | None) -> Tensor:
        """Map (V, E) encodings, (B, U, pose + code) and a (V, U) one-hot, or None where U is 1, to (B, V, 3)."""
        # W [phi; theta; z] = W_p phi + W_f [theta; z]: points (V, width) plus frames (B, U, width), picked by set of
        # joints.
        of_frame = self.of_frame(frames)
        x = F.relu(self.of_point(encodings) + (of_frame if member is None else member @ of_frame))
        for layer in self.hidden:
            x = F.relu(layer(x))
        return self.last(x)


class DeformationField(nn.Module):
    """`dv_i = m_i S_c(g_i) + S_b(g_i)`, `g_i = phi(v_i) + theta + z_t` (+ joins vectors), metres in the canonical pose.

    S_b moves the whole template; S_c adds the motion of the clothes and is evaluated on them alone (m_i = 1). With
    control points both are evaluated there and interpolated. Vertices may be kept still: neither is evaluated there.

    Args:
        config: sizes.
        vertices: canonical vertices, metres.
        cloth_mask: m.
        control: control points of the same vertices, or None to evaluate the field on every vertex.
        seen: the joints of theta, J = pose_size / 3, that each vertex depends on, if `local_pose` is set.
        still: vertices that are not displaced, whole groups of the control points; None: none.

    Attributes:
        points: (K,) vertices that the networks are evaluated on.

    Raises:
        InputError: a mask, control points or seen joints of another number of vertices or joints; nothing that moves.
    """

    points: Tensor
    encodings: Tensor
    cloth_index: Tensor
    sets: Tensor | None
    member: Tensor | None

    def __init__(
        self,
        config: FieldConfig,
        vertices: Float[Tensor, "V 3"],
        cloth_mask: Bool[Tensor, " V"],
        *,
        control: ControlPoints | None = None,
        seen: Bool[Tensor, "V J"] | None = None,
        still: Bool[Tensor, " V"] | None = None,
    ) -> None:
        super().__init__()
        # Check that all arguments are of one template.
        if vertices.ndim != 2 or vertices.shape[1] != 3 or cloth_mask.shape != vertices.shape[:1]:
            raise InputError(
                "template of the field",
                expected="vertices of shape (V, 3) and a cloth mask of shape (V,)",
                received=f"shapes {tuple(vertices.shape)} and {tuple(cloth_mask.shape)}",
            )
        if control is not None and len(control.neighbours) != len(vertices):
            raise InputError(
                "control points",
                expected=f"those of {len(vertices)} vertices",
                received=f"those of {len(control.neighbours)}",
            )
        expected = (len(vertices), config.pose_size // 3) if config.local_pose else None
        if expected != (None if seen is None else tuple(seen.shape)):
            raise InputError(
                "joints that the vertices see",
                expected="none without local_pose" if expected is None else f"shape {expected}",
                received="none" if seen is None else f"shape {tuple(seen.shape)}",
            )
        if still is not None and (still.shape != cloth_mask.shape or bool(still.all())):
            raise InputError(
                "vertices that stay still",
                expected=f"some of {len(vertices)}, not all",
                received=f"{int(still.sum())} of {len(still)}",
            )
        # Networks, and the points on which they are evaluated.
        self.config = config
        self.body = FieldNetwork(config)
        self.cloth = FieldNetwork(config)
        where, self.rows = _evaluated(vertices, control, still)
        vertices, cloth_mask = vertices[where], cloth_mask[where]
        self.register_buffer("points", where, persistent=False)
        self.register_buffer("encodings", positional_encoding(vertices, config.frequencies), persistent=False)
        self.register_buffer("cloth_index", torch.nonzero(cloth_mask)[:, 0], persistent=False)
        # Distinct sets of joints, and the set of each point.
        sets = member = None
        if seen is not None:
            sets, group = torch.unique(seen[where], dim=0, return_inverse=True)
            sets = sets.to(vertices.dtype).repeat_interleave(3, dim=1)
            # A matrix product with one-hot rows, because the gradient of a gather is slow on a CPU.
            member = F.one_hot(group, len(sets)).to(vertices.dtype)
        self.register_buffer("sets", sets, persistent=False)
        self.register_buffer("member", member, persistent=False)

    def forward(self, pose: Float[Tensor, "B T"], code: Float[Tensor, "B Z"]) -> Float[Tensor, "B V 3"]:
        """Return the displacements of all vertices, metres along the canonical axes; see `at_points`."""
        return self.spread(self.at_points(pose, code))

    def spread(self, moved: Float[Tensor, "B K 3"]) -> Float[Tensor, "B V 3"]:
        """Interpolate displacements of the points to all vertices."""
        if self.rows is None:
            return moved
        # All poses in one table, side by side.
        spread = self.rows(moved.transpose(0, 1).flatten(1))
        return spread.unflatten(1, (len(moved), 3)).transpose(0, 1)

    def at_points(self, pose: Float[Tensor, "B T"], code: Float[Tensor, "B Z"]) -> Float[Tensor, "B K 3"]:
        """Return displacements where the networks are evaluated: at the K control points, or all vertices.

        Args:
            pose: theta, axis-angle, radians, of length `pose_size`.
            code: frame codes of length `code_size`.

        Returns:
            Metres along the canonical axes.

        Raises:
            InputError: poses or codes of another length or number.
        """
        expected = (self.config.pose_size, self.config.code_size)
        if pose.ndim != 2 or code.ndim != 2 or (pose.shape[1], code.shape[1]) != expected or len(pose) != len(code):
            raise InputError(
                "pose and code",
                expected=f"shapes (B, {expected[0]}) and (B, {expected[1]})",
                received=f"shapes {tuple(pose.shape)} and {tuple(code.shape)}",
            )
        # Mask theta by the joints that each set of points depends on, and append the code.
        local = pose[:, None] if self.sets is None else pose[:, None] * self.sets
        frames = torch.cat([local, code[:, None].expand(-1, local.shape[1], -1)], dim=2)
        # S_b on all points, plus S_c on the clothes.
        moved = self.body(self.encodings, frames, self.member)
        clothes = self.cloth_index
        member = None if self.member is None else self.member[clothes]
        return moved.index_add(1, clothes, self.cloth(self.encodings[clothes], frames, member))


def _evaluated(
    vertices: Float[Tensor, "V 3"], control: ControlPoints | None, still: Bool[Tensor, " V"] | None
) -> tuple[Tensor, SparseRows | None]:
    """Return the vertices on which the field is evaluated, and the interpolation from them; None: all vertices."""
    # Without control points the field is evaluated on all vertices.
    every = torch.arange(len(vertices), device=vertices.device)
    if control is None:
        if still is None:
            return every, None
        # Each vertex interpolates from itself alone.
        where, neighbours, weights = every, every[:, None], torch.ones_like(vertices[:, :1])
    else:
        where = torch.as_tensor(control.vertices, device=vertices.device)
        neighbours = torch.as_tensor(control.neighbours, device=vertices.device)
        weights = torch.as_tensor(control.weights, dtype=vertices.dtype, device=vertices.device)
    if still is not None:
        moves = ~still[where]
        # Renumber the points that move; all others drop out.
        number = moves.cumsum(0) - 1
        # Still vertices have weight 0 on an arbitrary row.
        neighbours, weights = number[neighbours] * ~still[:, None], weights * ~still[:, None]
        where = where[moves]
    return where, SparseRows(neighbours, weights, len(where))


class FrameCodes(nn.Module):
    """Learnable codes z_t, one for every frame of a sequence, initially zero.

    A pose without a frame has the *null code*: the zero vector if training used it in the place of some of the codes
    (`show_null_code`); else z_0, the code of the first frame, which the field has seen.

    Args:
        frames: numbers of the frames, each once.
        code_size: length of a code.

    Raises:
        InputError: no frames, or one twice.
    """

    def __init__(self, frames: Sequence[int], code_size: int) -> None:
        super().__init__()
        if not len(frames) or len(set(frames)) != len(frames):
            raise InputError("frames of the codes", expected="at least one, each once", received=str(list(frames)))
        self.frames = tuple(int(frame) for frame in frames)
        self.row = {frame: row for row, frame in enumerate(self.frames)}
        self.codes = nn.Parameter(torch.zeros(len(self.frames), code_size))
        self.null_code_shown = False

    def forward(self, frames: Sequence[int | None]) -> Float[Tensor, "B Z"]:
        """Return the code of each frame, the null code for None.

        Raises:
            InputError: a frame that has no code.
        """
        unknown = [frame for frame in frames if frame is not None and frame not in self.row]
        if unknown:
            raise InputError(
                "frame of a code",
                expected="one of the frames that were trained on, or None",
                received=", ".join(map(str, unknown)),
                remedy="drive new frames with the null code, or fit codes to them",
            )
        # None takes row 0, which is z_0, and is multiplied by 0 where training has shown the zero vector.
        if len(frames) == 1:
            # The usual case, without indices that would be copied to a GPU.
            (frame,) = frames
            row = 0 if frame is None else self.row[frame]
            return self.codes[row : row + 1] * float(frame is not None or not self.null_code_shown)
        rows = torch.tensor([0 if frame is None else self.row[frame] for frame in frames], device=self.codes.device)
        coded = [frame is not None or not self.null_code_shown for frame in frames]
        known = torch.tensor(coded, device=self.codes.device)
        return self.codes[rows] * known[:, None]


def show_null_code(model: nn.Module) -> None:
    """Mark all frame codes of a model: training uses the zero vector as the null code."""
    for module in model.modules():
        if isinstance(module, FrameCodes):
            module.null_code_shown = True
