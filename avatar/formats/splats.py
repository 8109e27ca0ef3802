"""World-space splats of one pose, the common input of all splat files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Float32, Float64

from avatar.runtime import AvatarPlayer
from avatar.runtime.splatting import WorldSplats
from smplxpp.cloth.play import ways
from smplxpp.core.errors import InputError, one_line
from smplxpp.core.params import DEFAULT_FPS, BodyParams
from smplxpp.core.spherical_harmonics import C0, MAX_DEGREE, coefficient_count, degree_of, rotate_sh

REST_COUNTS = (0, 9, 24, 45)
"""Numbers of `f_rest` values of a splat for degrees 0 to 3, three colours each."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Splats:
    """N Gaussians in world coordinates, stored as float32.

    Attributes:
        means: metres.
        normals: unit, or 0 where unknown.
        f_dc: coefficients of degree 0: the colour without view dependence is `0.5 + C0 f_dc`.
        f_rest: coefficients of degree 1 and up in the world's axes; K = 0, 3, 8 or 15.
        opacity_logits: before the sigmoid.
        log_scales: logarithms of the standard deviations in metres.
        quats: wxyz, any length but zero.

    Raises:
        InputError: inconsistent shapes, NaN or infinity, a quaternion of length 0.
    """

    means: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    f_dc: Float[np.ndarray, "N 3"]
    f_rest: Float[np.ndarray, "N K 3"]
    opacity_logits: Float[np.ndarray, " N"]
    log_scales: Float[np.ndarray, "N 3"]
    quats: Float[np.ndarray, "N 4"]

    __repr__ = one_line

    def __post_init__(self) -> None:
        # Convert first, so that values too large for float32 show as infinities below.
        for f in fields(self):
            object.__setattr__(self, f.name, np.ascontiguousarray(getattr(self, f.name), dtype=np.float32))
        N, K = len(self.means), self.f_rest.shape[1] if self.f_rest.ndim == 3 else -1
        shapes: dict[str, tuple[int, ...]] = {
            "means": (N, 3),
            "normals": (N, 3),
            "f_dc": (N, 3),
            "f_rest": (N, K, 3),
            "opacity_logits": (N,),
            "log_scales": (N, 3),
            "quats": (N, 4),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise InputError(f"splats: {name}", expected=f"shape {shape}", received=f"shape {value.shape}")
            if not np.isfinite(value).all():
                bad = int(np.argmin(np.isfinite(value.reshape(N, -1)).all(1)))
                raise InputError(
                    f"splats: {name}", expected="finite float32 values", received=f"others, first in splat {bad}"
                )
        # The layouts of all formats know degrees 0 to 3; readers divide by the quaternion's length.
        if 3 * K not in REST_COUNTS:
            raise InputError("splats: f_rest", expected="0, 3, 8 or 15 coefficients", received=str(K))
        if N and not self.quats.any(1).all():
            raise InputError("splats: quats", expected="quaternions of some length", received="zeros")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """The degree of the spherical harmonics, 0 to 3."""
        return degree_of(self.f_rest)

    @property
    def opacities(self) -> Float64[np.ndarray, " N"]:
        """The opacities of all splats, in (0, 1)."""
        return 1.0 / (1.0 + np.exp(-self.opacity_logits.astype(np.float64)))

    @property
    def unit_quats(self) -> Float32[np.ndarray, "N 4"]:
        """The quaternions wxyz of length 1, with w not negative."""
        quats = self.quats.astype(np.float64)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        return np.where(quats[:, :1] < 0, -quats, quats).astype(np.float32)

    def padded(self) -> Splats:
        """Return the same splats with harmonics of all three degrees, missing coefficients set to 0."""
        missing = coefficient_count(MAX_DEGREE) - self.f_rest.shape[1]
        return replace(self, f_rest=np.pad(self.f_rest, ((0, 0), (0, missing), (0, 0))))

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> Splats:
        """Return the splats rotated about the origin, with their spherical harmonics."""
        # Positions, normals and rotations turn, and so do the harmonics, whose axes are the world's.
        R = np.asarray(rotation, np.float64)
        return replace(
            self,
            means=self.means @ R.T,
            normals=self.normals @ R.T,
            f_rest=rotate_sh(self.f_rest, R[None], np.zeros(len(self), np.int64)),
            quats=_rotate_quats(R, self.quats),
        )


def world_splats(posed: WorldSplats) -> Splats:
    """Convert a pose of the player: rotate its spherical harmonics from the triangles' axes to the world's.

    Args:
        posed: splats of a player; its arrays are copied.
    """
    w, x, y, z = posed.quats.astype(np.float64).T
    # The normal is the first axis of a Gaussian, along which it is flat.
    normals = np.stack([w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    # Opacities keep 1e-7 from 0 and 1, where the logit is infinite.
    opacities = np.clip(posed.opacities.astype(np.float64), 1e-7, 1.0 - 1e-7)
    return Splats(
        means=posed.means.copy(),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        f_dc=(posed.dc.astype(np.float64) - 0.5) / C0,
        f_rest=rotate_sh(posed.sh, posed.rotations, posed.face),
        opacity_logits=np.log(opacities / (1.0 - opacities)),
        log_scales=np.log(posed.scales.astype(np.float64)),
        quats=posed.quats / np.linalg.norm(posed.quats, axis=1, keepdims=True),
    )


def _rotate_quats(R: Float[np.ndarray, "3 3"], quats: Float[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """Return the Hamilton products of a rotation's quaternion with others, wxyz."""
    # Rows of 4 q q^T; the one with the largest diagonal entry is the best conditioned.
    outer = np.array(
        [
            [1 + R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], 1 + R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], 1 - R[0, 0] + R[1, 1] - R[2, 2], R[2, 1] + R[1, 2]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], 1 - R[0, 0] - R[1, 1] + R[2, 2]],
        ]
    )
    row = outer[np.argmax(np.diag(outer))]
    w, x, y, z = row / np.linalg.norm(row)
    # The matrix of multiplication by q from the left: (q p) = L(q) p.
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray(quats, np.float64) @ left.T


PRE_ROLL = 0.7
"""Seconds of a motion before its first frame that loose clothes follow, so that they hang when it begins."""


def splats_along(
    player: AvatarPlayer,
    motion: BodyParams,
    rows: range,
    *,
    cloth: str = "simulate",
    notes: list[str] | None = None,
) -> Iterator[Splats]:
    """Yield the splats of rows of a motion; simulated clothes follow it from a moment before the first row.

    Args:
        player: of the avatar.
        motion: body parameters.
        rows: ascending.
        cloth: what moves loose clothes: "simulate", "field" or "skin".
        notes: receives the player's remarks on the simulation after the last row.
    """
    # Without a simulation every pose stands alone: clothes follow the field, or skinning.
    rate = motion.fps or DEFAULT_FPS
    if cloth != "simulate" or not player.has_clothes:
        skinned = player.skinned_clothes if cloth == "skin" else None
        for k in rows:
            yield world_splats(player.pose(motion.frame(k), cloth=skinned))
        return
    # A simulation has a state, so that rows before the first are stepped too and not written.
    begin = max(0, rows[0] - round(PRE_ROLL * rate))
    for k, path in enumerate(ways(motion.select(slice(begin, rows[-1] + 1)), rate), start=begin):
        posed = player.step(motion.frame(k), 1.0 / rate, path=path)
        if k in rows:
            yield world_splats(posed)
    if notes is not None:
        notes += player.notes
