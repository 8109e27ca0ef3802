"""Data types that the stages exchange, and the errors that they raise."""

from smplxpp.core.camera import Camera
from smplxpp.core.errors import GeometryWarning, InputError, MissingExtraError, ProgressCallback
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh, write_ply
from smplxpp.core.params import DEFAULT_FPS, BodyParams
from smplxpp.core.skin_weights import SkinWeights

__all__ = [
    "DEFAULT_FPS",
    "BodyParams",
    "Camera",
    "GeometryWarning",
    "InputError",
    "MissingExtraError",
    "ProgressCallback",
    "SkinWeights",
    "TriangleMesh",
    "read_mesh",
    "write_ply",
]
