"""Data types that the stages exchange, the errors that they raise, and checks of numbers.

Names that most rooms need are exported here; the modules of the room hold the rest.
"""

from smplxpp.core.camera import Camera
from smplxpp.core.checks import Check, Gate, StageOutput
from smplxpp.core.errors import (
    GeometryWarning,
    InputError,
    MissingExtraError,
    ProgressCallback,
    ignore_progress,
    require_at_least,
    require_between,
    require_choice,
    require_known,
    require_positive,
)
from smplxpp.core.foreign import METRES_PER_UNIT, MeshLike, PointsLike, as_array, as_mesh, as_points
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.core.labels import (
    BACKGROUND,
    CLOTH_LABELS,
    HAIR,
    LABEL_BY_NAME,
    LABELS,
    LOWER,
    OBJECT,
    OUTER,
    SHOE,
    SKIN,
    UPPER,
    Label,
    Labels,
    display_colors,
)
from smplxpp.core.mesh import TriangleMesh, concatenate_meshes, normalize_rows, row_lengths
from smplxpp.core.mesh_files.mesh_io import read_mesh, write_ply
from smplxpp.core.params import ARRAY_NAMES, DEFAULT_FPS, POSE_BLOCKS, BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.skin_weights import SkinWeights, WeightsLike, dense_weights
from smplxpp.core.spread import spread

__all__ = [
    "ARRAY_NAMES",
    "BACKGROUND",
    "BodyParams",
    "CLOTH_LABELS",
    "Camera",
    "Check",
    "DEFAULT_FPS",
    "Gate",
    "GeometryWarning",
    "HAIR",
    "InputError",
    "Keypoints2D",
    "LABELS",
    "LABEL_BY_NAME",
    "LOWER",
    "Label",
    "Labels",
    "METRES_PER_UNIT",
    "MeshLike",
    "MissingExtraError",
    "OBJECT",
    "OUTER",
    "POSE_BLOCKS",
    "PointsLike",
    "ProgressCallback",
    "SHOE",
    "SKIN",
    "SkinWeights",
    "StageOutput",
    "TriangleMesh",
    "UPPER",
    "WeightsLike",
    "as_array",
    "as_mesh",
    "as_points",
    "concatenate_meshes",
    "dense_weights",
    "display_colors",
    "ignore_progress",
    "matrix_from_rotvec",
    "normalize_rows",
    "read_mesh",
    "require_at_least",
    "require_between",
    "require_choice",
    "require_known",
    "require_positive",
    "rotvec_from_matrix",
    "row_lengths",
    "spread",
    "write_ply",
]
