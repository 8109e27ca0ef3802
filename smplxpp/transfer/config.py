"""What skin-weight transfer does, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from smplxpp.core.errors import InputError


@dataclass(frozen=True)
class TransferConfig:
    """Settings of `transfer_weights`; every length is a fraction of a bounding box's diagonal, so units do not matter.

    Attributes:
        max_distance: a vertex is matched within this fraction of the target's bounding-box diagonal.
        max_angle_deg: ... and if the normals differ by at most this.
        length_scale: `l` of the inpainting energy, as a fraction of the source's bounding-box diagonal.
        laplacian: "cotangent" as given; "intrinsic" mollified and Delaunay; "auto" the latter where a face is bad.
        max_influences: joints kept at a vertex; None keeps all.
        unmatched: what a connected component without any match gets: "nearest" the closest source point's weights,
            "rigid:JOINT" (name or index) one joint, "raise" an error.
        allowed_joints: names or indices of the joints that the target may follow; None allows all. The source is
            restricted to the faces that these joints own.
        smoothing_steps: Jacobi averaging steps over unmatched vertices after inpainting.
        smoothing_rate: how far a step goes towards the neighbours' mean.
        joint_names: names for `allowed_joints`, `unmatched` and messages; indices are used without.
    """

    max_distance: float = 0.05
    max_angle_deg: float = 30.0
    length_scale: float = 0.4
    laplacian: Literal["auto", "cotangent", "intrinsic"] = "auto"
    max_influences: int | None = 8
    unmatched: str = "nearest"
    allowed_joints: tuple[str | int, ...] | None = None
    smoothing_steps: int = 0
    smoothing_rate: float = 0.2
    joint_names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("max_distance", "max_angle_deg", "length_scale"):
            if not getattr(self, name) > 0:
                raise InputError(f"config {name}", expected="a positive number", received=str(getattr(self, name)))
        if self.max_influences is not None and self.max_influences < 1:
            raise InputError("config max_influences", expected="at least 1, or None", received=str(self.max_influences))
        if self.unmatched not in ("nearest", "raise") and not self.unmatched.startswith("rigid:"):
            raise InputError(
                "config unmatched", expected='"nearest", "raise" or "rigid:JOINT"', received=repr(self.unmatched)
            )

    def joint_index(self, joint: str | int, joint_count: int) -> int:
        """Index of a joint given by name or number.

        Raises:
            InputError: no such joint.
        """
        names = self.joint_names or ()
        index = names.index(joint) if joint in names else int(joint) if str(joint).isdigit() else -1
        if not 0 <= index < joint_count:
            raise InputError(
                f"joint {joint!r}",
                expected=f"an index below {joint_count}" + (f" or one of {', '.join(names)}" if names else ""),
                received=repr(joint),
                remedy="" if names else "give TransferConfig(joint_names=...) to use names",
            )
        return index
