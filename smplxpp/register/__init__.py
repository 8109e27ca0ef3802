"""Register a body to keypoints, masks, label maps and scans, over all frames."""

from smplxpp.register.body_fit import BodyFit
from smplxpp.register.config import RegisterConfig
from smplxpp.register.fit import register
from smplxpp.register.landmark_file import read_landmarks, write_landmarks
from smplxpp.register.observations import Observations, ScanObservation
from smplxpp.register.triangulate import TriangulationConfig, triangulate

__all__ = [
    "BodyFit",
    "Observations",
    "RegisterConfig",
    "ScanObservation",
    "TriangulationConfig",
    "read_landmarks",
    "register",
    "triangulate",
    "write_landmarks",
]
