"""Inverse skinning: from the reference pose to the T-pose."""

from smplxpp.unpose.inverse_skin import UnposeConfig, Unposed, UnposeReport, pose, unpose

__all__ = ["UnposeConfig", "UnposeReport", "Unposed", "pose", "unpose"]
