"""LocateConfig: every choice in the search for a body."""

from __future__ import annotations

from dataclasses import dataclass

from smplxpp.core.validation import require_at_least


@dataclass(frozen=True)
class LocateConfig:
    """How a body is searched for in a bare surface.

    Attributes:
        directions: that the person may face at first, evenly about the vertical axis.
        starts: poses and directions that are followed. limbs_tried: of these, whose arms and legs are tried one by one.
        candidates: of these, followed to the end.
        coarse_points, fine_points: of the surface, drawn by area, for the search and for the fit.
        dress_steps, finish_steps: Gauss-Newton steps of every candidate, and of the one that is chosen.
        pose_prior: weight of the pose prior while the one that is chosen is fitted; clothes hide more of the joints
            than the surface's points, each a witness, let on.
        seed: of the drawn points.
    """

    directions: int = 12
    starts: int = 24
    limbs_tried: int = 8
    candidates: int = 3
    coarse_points: int = 600
    fine_points: int = 6000
    dress_steps: int = 8
    finish_steps: int = 12
    pose_prior: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("directions", "starts", "limbs_tried", "candidates", "dress_steps", "finish_steps"):
            require_at_least(f"search for a body: {name}", getattr(self, name), 1)
        for name in ("coarse_points", "fine_points"):
            require_at_least(f"search for a body: {name}", getattr(self, name), 100)
        for name in ("pose_prior", "seed"):
            require_at_least(f"search for a body: {name}", getattr(self, name), 0)
