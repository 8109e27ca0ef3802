"""Inverse skinning: from the reference pose to the T-pose."""

from smplxpp.inverse_skinning.inverse_skin import UnposeConfig, Unposed, UnposeReport, pose, unpose

__all__ = ["UnposeConfig", "UnposeReport", "Unposed", "pose", "unpose"]
