"""True surfaces of a capture's frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from smplxpp.capture.files import FileSeries
from smplxpp.core.errors import InputError
from smplxpp.core.files.safe_pickle import safe_npz
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh


@dataclass(frozen=True, eq=False)
class MeshFiles:
    """A mesh file for each frame."""

    files: FileSeries

    def read(self, frame: int) -> TriangleMesh | None:
        """The frame's mesh, None where there is none."""
        path = self.files.path(frame)
        return None if path is None else read_mesh(path).mesh


@dataclass(frozen=True, eq=False)
class PosedTopology:
    """One topology (`faces`, `face_hidden`) and, in a file each, the vertices (`verts`) of the frames.

    Faces that `face_hidden` marks (skin under clothes) are left out: the mesh is what the images show.
    """

    topology: Path
    files: FileSeries

    @cached_property
    def _faces(self) -> np.ndarray:
        arrays = safe_npz(self.topology, keys=("faces", "face_hidden"))
        if "faces" not in arrays:
            raise InputError(f"file {self.topology}", expected="an array `faces`", received=f"{sorted(arrays)}")
        faces = arrays["faces"]
        return faces[~arrays["face_hidden"]] if "face_hidden" in arrays else faces

    def read(self, frame: int) -> TriangleMesh | None:
        """The frame's mesh, None where there is none."""
        path = self.files.path(frame)
        if path is None:
            return None
        arrays = safe_npz(path, keys=("verts",))
        if "verts" not in arrays:
            raise InputError(f"file {path}", expected="an array `verts`", received="none")
        return TriangleMesh(arrays["verts"], self._faces)
