"""RegisterConfig: every choice of a registration."""

from __future__ import annotations

from dataclasses import dataclass

from smplxpp.core.validation import require_at_least, require_positive


@dataclass(frozen=True)
class RegisterConfig:
    """How a body is registered. Sizes in metres and radians are of an adult; pixels are those of the images given.

    Attributes:
        keypoint_px: least error of a keypoint that is assumed, for an image 640 pixels high; else it is measured.
        landmark_m: error of a landmark in space on the skin; of one within a limb it is three times as much.
        silhouette_px: error of a mask's contour. silhouette_reach_m: farthest that a contour is believed to be that of
            the body's rim near it.
        scan_m: error of a scan where it shows skin. scan_reach_m: farthest skin that is believed.
        tight_m: least spread of the gap between a body and what covers it: how tightly clothes can hold a body.
        cloth_share: how much of a fully independent observation each point of clothes is; they move together.
        acceleration: of joints, radians a second squared, that is taken for ordinary; faster is allowed and costs less
            than its square.
        transl_acceleration: of the whole body, metres a second squared.
        pose_prior: weight of the pose prior in its own units; 0 leaves the bounds alone.
        scan_samples, rim_samples: points of a scan, and body vertices, that are looked at.
        joint_steps, surface_steps: Gauss-Newton steps on keypoints alone, and on everything.
        shape_frames: at most as many frames, evenly spread, tell the shape.
        window: frames that are solved together; longer takes go on in windows.
        seed: of samples.
    """

    keypoint_px: float = 1.0
    landmark_m: float = 0.005
    silhouette_px: float = 2.0
    silhouette_reach_m: float = 0.03
    scan_m: float = 0.003
    scan_reach_m: float = 0.03
    tight_m: float = 0.006
    cloth_share: float = 0.15
    acceleration: float = 6.0
    transl_acceleration: float = 1.5
    pose_prior: float = 1.0
    scan_samples: int = 4000
    rim_samples: int = 4000
    joint_steps: int = 15
    surface_steps: int = 10
    shape_frames: int = 60
    window: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        for name in (
            "keypoint_px",
            "landmark_m",
            "silhouette_px",
            "silhouette_reach_m",
            "scan_m",
            "scan_reach_m",
            "tight_m",
            "cloth_share",
            "acceleration",
            "transl_acceleration",
        ):
            require_positive(f"registration: {name}", getattr(self, name))
        for name in ("scan_samples", "rim_samples", "joint_steps", "shape_frames", "window"):
            require_at_least(f"registration: {name}", getattr(self, name), 1)
        for name in ("pose_prior", "surface_steps", "seed"):
            require_at_least(f"registration: {name}", getattr(self, name), 0)
