"""Triton kernels of a student in a new pose: its field, and all that Gaussians need of a posed mesh, one launch each.

torch needs some sixty kernels for what follows skinning alone: frames of the triangles, blend shapes, Gaussians in the
world, and directions to the camera. Here a program computes all of it for a block of Gaussians and keeps it in
registers. Numbers of networks and bases may be float16; sums and geometry are float32.

The torch formulas of `avatar.gaussians` and `avatar.models.networks` are the oracle of both kernels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.gaussians import BoundGaussians
from avatar.gaussians.binding import THICKNESS, WorldGaussians
from avatar.gaussians.colors import sh_color
from avatar.gaussians.frames import MIN_EDGE
from avatar.models.networks.blend_shapes import BlendShapes
from avatar.models.networks.deformation_field import DeformationField, FieldNetwork
from smplxpp.core.errors import InputError

try:
    import triton
    import triton.language as tl
except ModuleNotFoundError:  # comes with torch's builds for CUDA
    triton = None

_BLOCK = {"points": 32, "gaussians": 128}
"""Rows of a program: 32 rows of a layer's products fit the registers; Gaussians are bound by memory."""

if triton is not None:

    @triton.jit
    def _field_kernel(
        of_point, of_frame, member, hidden, biases, last, last_bias, rows, moved, count,
        LAYERS: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
    ):  # fmt: skip
        """Add a network's displacements of `count` points to their rows of `moved`."""
        own = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
        column, there = tl.arange(0, WIDTH), own < count
        # First layer: the points' part is stored, the frame's is that of the point's set of joints.
        group = tl.load(member + own, mask=there, other=0)
        x = tl.load(of_point + own[:, None] * WIDTH + column[None, :], mask=there[:, None], other=0.0).to(tl.float32)
        x += tl.load(of_frame + group[:, None] * WIDTH + column[None, :]).to(tl.float32)
        x = tl.maximum(x, 0.0)
        for layer in tl.static_range(LAYERS):
            # Weights are stored as inputs x outputs.
            at = layer * WIDTH * WIDTH + column[:, None] * WIDTH + column[None, :]
            weight = tl.load(hidden + at)
            x = tl.dot(x.to(weight.dtype), weight, out_dtype=tl.float32, input_precision="ieee")
            x = tl.maximum(x + tl.load(biases + layer * WIDTH + column)[None, :].to(tl.float32), 0.0)
        row = tl.load(rows + own, mask=there, other=0)
        for axis in tl.static_range(3):
            weight = tl.load(last + axis * WIDTH + column).to(tl.float32)
            out = tl.sum(x * weight[None, :], axis=1) + tl.load(last_bias + axis).to(tl.float32)
            before = tl.load(moved + row * 3 + axis, mask=there, other=0.0)
            tl.store(moved + row * 3 + axis, before + out, mask=there)

    @triton.jit
    def _cross(ax, ay, az, bx, by, bz):
        return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx

    @triton.jit
    def _norm(x, y, z):
        return tl.sqrt(x * x + y * y + z * z)

    @triton.jit
    def _frame(ux, uy, uz, wx, wy, wz, MIN_EDGE: tl.constexpr):
        """Return unit normal, unit median, their cross product and the mean edge of triangles with edges u and w."""
        TOLERANCE: tl.constexpr = 1.1920928955078125e-05  # 100 epsilons of float32, see `triangle_frames_reference`
        cx, cy, cz = _cross(ux, uy, uz, wx, wy, wz)
        mx, my, mz = 0.5 * (ux + wx), 0.5 * (uy + wy), 0.5 * (uz + wz)
        length = (_norm(ux, uy, uz) + _norm(wx, wy, wz) + _norm(wx - ux, wy - uy, wz - uz)) / 3.0
        edge = tl.maximum(length, MIN_EDGE)
        # Without area: the longest direction, and an axis across it.
        flat = _norm(cx, cy, cz) <= TOLERANCE * edge * edge
        along = _norm(mx, my, mz) > TOLERANCE * length
        lx, ly, lz = tl.where(along, mx, ux), tl.where(along, my, uy), tl.where(along, mz, uz)
        short = _norm(lx, ly, lz) <= TOLERANCE * MIN_EDGE
        lx, ly, lz = tl.where(short, 1.0, lx), tl.where(short, 0.0, ly), tl.where(short, 0.0, lz)
        ax, ay, az = tl.abs(lx), tl.abs(ly), tl.abs(lz)
        on_x = (ax <= ay) & (ax <= az)
        on_y = (~on_x) & (ay <= az)
        ex, ey = tl.where(on_x, 1.0, 0.0), tl.where(on_y, 1.0, 0.0)
        tx, ty, tz = _cross(lx, ly, lz, ex, ey, 1.0 - ex - ey)
        cx, cy, cz = tl.where(flat, tx, cx), tl.where(flat, ty, cy), tl.where(flat, tz, cz)
        mx, my, mz = tl.where(flat, lx, mx), tl.where(flat, ly, my), tl.where(flat, lz, mz)
        c, m = _norm(cx, cy, cz), _norm(mx, my, mz)
        nx, ny, nz, qx, qy, qz = cx / c, cy / c, cz / c, mx / m, my / m, mz / m
        rx, ry, rz = _cross(nx, ny, nz, qx, qy, qz)
        return nx, ny, nz, qx, qy, qz, rx, ry, rz, edge

    @triton.jit
    def _quat(a, d, g, b, e, h, c, f, i):
        """Return unit quaternions wxyz of rotations with columns (a d g), (b e h), (c f i): Shepperd's rows."""
        ww, xx, yy, zz = 1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i
        best_w = (ww >= xx) & (ww >= yy) & (ww >= zz)
        best_x = (xx >= yy) & (xx >= zz)
        best_y = yy >= zz
        wx, wy, wz, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
        w = tl.where(best_w, ww, tl.where(best_x, wx, tl.where(best_y, wy, wz)))
        x = tl.where(best_w, wx, tl.where(best_x, xx, tl.where(best_y, xy, xz)))
        y = tl.where(best_w, wy, tl.where(best_x, xy, tl.where(best_y, yy, yz)))
        z = tl.where(best_w, wz, tl.where(best_x, xz, tl.where(best_y, yz, zz)))
        length = tl.sqrt(w * w + x * x + y * y + z * z)
        return w / length, x / length, y / length, z / length

    @triton.jit
    def _gaussians_kernel(
        vertices, corner_index, fixed, offsets, basis, row, part, gate, z, center, out, count, active,
        SHAPES: tl.constexpr, HEAD: tl.constexpr, THICKNESS: tl.constexpr, MIN_EDGE: tl.constexpr, BLOCK: tl.constexpr,
    ):  # fmt: skip
        """Write means, quaternions, scales, normals, offsets, colours and directions, a row of `out` a component."""
        g = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
        there = g < count
        # Blend shapes: sum_k gate_k z_k (U_k, C_k) of the Gaussian's row in the bases; -1: it has none.
        own, of_part = tl.load(row + g, mask=there, other=-1), tl.load(part + g, mask=there, other=0)
        head = tl.load(gate + g, mask=there, other=0.0)
        has = own >= 0
        d0, d1, d2 = (
            tl.load(offsets + g, mask=there),
            tl.load(offsets + count + g, mask=there),
            tl.load(offsets + 2 * count + g, mask=there),
        )
        c0, c1, c2 = (
            tl.load(offsets + 3 * count + g, mask=there),
            tl.load(offsets + 4 * count + g, mask=there),
            tl.load(offsets + 5 * count + g, mask=there),
        )
        for k in tl.static_range(SHAPES):
            weight = tl.load(z + of_part * SHAPES + k, mask=there, other=0.0)
            weight *= head if k < HEAD else tl.load(gate + count + g, mask=there, other=0.0)
            at = basis + k * 6 * active + own
            d0 += weight * tl.load(at, mask=has, other=0.0).to(tl.float32)
            d1 += weight * tl.load(at + active, mask=has, other=0.0).to(tl.float32)
            d2 += weight * tl.load(at + 2 * active, mask=has, other=0.0).to(tl.float32)
            c0 += weight * tl.load(at + 3 * active, mask=has, other=0.0).to(tl.float32)
            c1 += weight * tl.load(at + 4 * active, mask=has, other=0.0).to(tl.float32)
            c2 += weight * tl.load(at + 5 * active, mask=has, other=0.0).to(tl.float32)
        # Corners and frame of the triangle.
        i1 = 3 * tl.load(corner_index + g, mask=there, other=0)
        i2 = 3 * tl.load(corner_index + count + g, mask=there, other=0)
        i3 = 3 * tl.load(corner_index + 2 * count + g, mask=there, other=0)
        x1, y1, z1 = tl.load(vertices + i1), tl.load(vertices + i1 + 1), tl.load(vertices + i1 + 2)
        x2, y2, z2 = tl.load(vertices + i2), tl.load(vertices + i2 + 1), tl.load(vertices + i2 + 2)
        x3, y3, z3 = tl.load(vertices + i3), tl.load(vertices + i3 + 1), tl.load(vertices + i3 + 2)
        nx, ny, nz, qx, qy, qz, rx, ry, rz, edge = _frame(
            x2 - x1, y2 - y1, z2 - z1, x3 - x1, y3 - y1, z3 - z1, MIN_EDGE
        )
        # Means: the point of the triangle plus the offset in its frame; gamma acts along the normal.
        u, v = tl.load(fixed + g, mask=there), tl.load(fixed + count + g, mask=there)
        t, along = 1.0 - u - v, d0 + tl.load(fixed + 2 * count + g, mask=there)
        px = u * x1 + v * x2 + t * x3 + nx * along + qx * d1 + rx * d2
        py = u * y1 + v * y2 + t * y3 + ny * along + qy * d1 + ry * d2
        pz = u * z1 + v * z2 + t * z3 + nz * along + qz * d1 + rz * d2
        # Rotations: the frame's after the Gaussian's own.
        aw, ax, ay, az = _quat(nx, ny, nz, qx, qy, qz, rx, ry, rz)
        bw, bx = tl.load(fixed + 5 * count + g, mask=there, other=1.0), tl.load(fixed + 6 * count + g, mask=there)
        by, bz = tl.load(fixed + 7 * count + g, mask=there), tl.load(fixed + 8 * count + g, mask=there)
        w, x = aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by
        y, zz = aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw
        square = w * w + x * x + y * y + zz * zz
        # The direction from the camera, in the triangle's frame.
        vx, vy, vz = px - tl.load(center), py - tl.load(center + 1), pz - tl.load(center + 2)
        far = tl.maximum(_norm(vx, vy, vz), 1e-12)
        vx, vy, vz = vx / far, vy / far, vz / far
        tl.store(out + g, px, mask=there)
        tl.store(out + count + g, py, mask=there)
        tl.store(out + 2 * count + g, pz, mask=there)
        tl.store(out + 3 * count + g, w, mask=there)
        tl.store(out + 4 * count + g, x, mask=there)
        tl.store(out + 5 * count + g, y, mask=there)
        tl.store(out + 6 * count + g, zz, mask=there)
        tl.store(out + 7 * count + g, edge * THICKNESS, mask=there)
        tl.store(out + 8 * count + g, edge * tl.load(fixed + 3 * count + g, mask=there), mask=there)
        tl.store(out + 9 * count + g, edge * tl.load(fixed + 4 * count + g, mask=there), mask=there)
        tl.store(out + 10 * count + g, (w * w + x * x - y * y - zz * zz) / square, mask=there)
        tl.store(out + 11 * count + g, 2.0 * (x * y + w * zz) / square, mask=there)
        tl.store(out + 12 * count + g, 2.0 * (x * zz - w * y) / square, mask=there)
        tl.store(out + 13 * count + g, d0, mask=there)
        tl.store(out + 14 * count + g, d1, mask=there)
        tl.store(out + 15 * count + g, d2, mask=there)
        tl.store(out + 16 * count + g, c0, mask=there)
        tl.store(out + 17 * count + g, c1, mask=there)
        tl.store(out + 18 * count + g, c2, mask=there)
        tl.store(out + 19 * count + g, nx * vx + ny * vy + nz * vz, mask=there)
        tl.store(out + 20 * count + g, qx * vx + qy * vy + qz * vz, mask=there)
        tl.store(out + 21 * count + g, rx * vx + ry * vy + rz * vz, mask=there)


def require_triton() -> None:
    """Raise InputError where Triton is not installed."""
    if triton is None:
        raise InputError(
            "fused kernels of a student",
            expected="Triton, which torch's builds for CUDA bring on Linux",
            received="none",
            remedy="leave fused out, or install such a build of torch",
        )


class FusedField:
    """A field's displacements of its points, one launch a network.

    Args:
        field: whose parameters must not change any more, on the device of the kernels.
    """

    def __init__(self, field: DeformationField) -> None:
        require_triton()
        self.field = field
        every = torch.arange(len(field.points), device=field.points.device)
        self._networks = [self._prepared(field.body, every), self._prepared(field.cloth, field.cloth_index)]

    def _prepared(self, network: FieldNetwork, rows: Tensor) -> dict[str, Any]:
        """Return a network's numbers for the points of some rows, layers filled up with zeros to a power of two."""
        width = max(16, triton.next_power_of_2(network.last.in_features))
        dtype, device = network.last.weight.dtype, rows.device
        own = network.last.in_features

        def filled(tensor: Tensor, *shape: int) -> Tensor:
            out = torch.zeros(shape, dtype=dtype, device=device)
            out[tuple(slice(size) for size in tensor.shape)] = tensor
            return out.contiguous()

        with torch.no_grad():
            layers = len(network.hidden)
            hidden = torch.zeros(max(layers, 1), width, width, dtype=dtype, device=device)
            biases = torch.zeros(max(layers, 1), width, dtype=dtype, device=device)
            for k, layer in enumerate(network.hidden):
                assert isinstance(layer, torch.nn.Linear)
                hidden[k, :own, :own], biases[k, :own] = layer.weight.T, layer.bias
            of_point = network.of_point(self.field.encodings[rows])
            member = self.field.member
            group = torch.zeros_like(rows) if member is None else member[rows].argmax(1)
            return {
                "network": network,
                "width": width,
                "layers": layers,
                "tensors": (filled(of_point, len(rows), width), group.to(torch.int32)),
                "weights": (hidden, biases, filled(network.last.weight, 3, width), network.last.bias.contiguous()),
                "rows": rows.to(torch.int32),
            }

    def at_points(self, pose: Float[Tensor, "1 T"], code: Float[Tensor, "1 Z"]) -> Float[Tensor, "1 K 3"]:
        """Return the displacements of one pose, metres, as `DeformationField.at_points` does, in float32."""
        sets = self.field.sets
        local = pose if sets is None else pose * sets
        frames = torch.cat([local, code.expand(len(local), -1)], dim=1)
        moved = torch.zeros(len(self.field.points), 3, device=frames.device)
        for one in self._networks:
            of_frame = torch.nn.functional.pad(
                one["network"].of_frame(frames), (0, one["width"] - one["network"].last.in_features)
            )
            count = len(one["rows"])
            if count:
                _field_kernel[(triton.cdiv(count, _BLOCK["points"]),)](
                    one["tensors"][0], of_frame.contiguous(), one["tensors"][1], *one["weights"], one["rows"], moved,
                    count, LAYERS=one["layers"], WIDTH=one["width"], BLOCK=_BLOCK["points"],
                )  # fmt: skip
        return moved[None]


class FusedGaussians:
    """Gaussians of a pose in the world with their blend shapes, and their colours for one camera, in one launch.

    Args:
        bound: without blend shapes.
        faces: of the mesh that they are bound to.
        shapes: their blend shapes, whose parameters must not change any more; None: none.
    """

    def __init__(self, bound: BoundGaussians, faces: Tensor, shapes: BlendShapes | None) -> None:
        require_triton()
        with torch.no_grad():
            self.bound, self._opacities = bound, bound.opacities
            # Rows by component, so that neighbouring Gaussians lie side by side.
            self._corners = faces[bound.face_index].T.to(torch.int32).contiguous()
            parts = (bound.barycentric, bound.normal_offset[:, None], bound.log_scales.exp(), bound.quats)
            self._fixed = torch.cat(parts, dim=1).T.contiguous()
            self._start = torch.cat([bound.offset, bound.dc], dim=1).T.contiguous()
            count, device = len(bound), bound.offset.device
            self._row = torch.full((count,), -1, dtype=torch.int32, device=device)
            self._part = torch.zeros(count, dtype=torch.int32, device=device)
            self._gate = torch.ones(2, count, device=device)
            self._basis, self._head, self._shapes = torch.zeros(1, 6, 1, device=device), 0, 0
            if shapes is not None:
                active = shapes.active
                self._row[active] = torch.arange(len(active), dtype=torch.int32, device=device)
                if shapes.part is not None:
                    self._part = shapes.part.to(torch.int32)
                if shapes.head_weight is not None:
                    self._gate = torch.stack([shapes.head_weight, 1.0 - shapes.head_weight]).float()
                # (M, 6, n) to (n, 6, M).
                self._basis = torch.cat([shapes.U, shapes.C], dim=1).permute(2, 1, 0).contiguous()
                self._head, self._shapes = shapes.config.head_shapes, shapes.config.shapes

    def __call__(
        self, vertices: Float[Tensor, "V 3"], z: Float[Tensor, "P n"] | None, center: Float[Tensor, " 3"]
    ) -> tuple[WorldGaussians, BoundGaussians, Float[Tensor, "1 N 3"]]:
        """Return the Gaussians in the world, those with blend shapes, and colours.

        Args:
            vertices: of the posed mesh, metres.
            z: coefficients of the blend shapes of every part; None without blend shapes.
            center: centre of projection in the world, metres.
        """
        count = len(self.bound)
        out = torch.empty(22, count, device=vertices.device)
        weights = self._gate[0, :1] if z is None else z.float().contiguous()
        _gaussians_kernel[(triton.cdiv(count, _BLOCK["gaussians"]),)](
            vertices.contiguous(), self._corners, self._fixed, self._start, self._basis, self._row, self._part,
            self._gate, weights, center.contiguous(), out, count, self._basis.shape[2],
            SHAPES=self._shapes, HEAD=self._head, THICKNESS=THICKNESS, MIN_EDGE=MIN_EDGE, BLOCK=_BLOCK["gaussians"],
        )  # fmt: skip
        means, quats, scales, normals, offset, dc, local = (
            one.T.contiguous() for one in out.split([3, 4, 3, 3, 3, 3, 3])
        )
        bound = replace(self.bound, offset=offset, dc=dc)
        return (
            WorldGaussians(means, quats, scales, self._opacities, normals),
            bound,
            sh_color(dc, bound.sh, local)[None],
        )
