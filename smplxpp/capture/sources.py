"""Read the body parameters and true meshes of a capture from their files, on request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from smplxpp.body import BodyModel, LayoutName, UpAxis, load_params, params_from_content
from smplxpp.capture.files import FileSeries
from smplxpp.core import ARRAY_NAMES, BodyParams, InputError, TriangleMesh, read_mesh
from smplxpp.core.files.safe_pickle import safe_npz

# Arrays with a row for each frame in the layouts that stack frames.
_STACKED = (*ARRAY_NAMES, "poses", "trans")
# Row indices of frames whose row is damaged, or empty.
_DAMAGED, _ABSENT = -1, -2


@dataclass(frozen=True, eq=False)
class StackedParams:
    """An npz file whose row index is the frame number.

    NaN or infinity make only their own row unusable. A row of NaN only is not damaged but empty, as `smplxpp register`
    and pose refinement write it for frames without parameters.

    Attributes:
        path: path of the file.
        layout: layout for `load_params`.
        body: body model with the root joint that some layouts need.
    """

    path: Path
    layout: LayoutName = "auto"
    body: BodyModel | None = None

    @cached_property
    def _rows(self) -> tuple[BodyParams, np.ndarray]:
        """The valid rows, and for every row its index among them (`_DAMAGED`, `_ABSENT`: none)."""
        arrays = safe_npz(self.path)
        matrices = {name: arrays[name] for name in _STACKED if name in arrays and np.ndim(arrays[name]) == 2}
        # A row is good if it is finite in all arrays, and present if it is not NaN throughout.
        rows = max(map(len, matrices.values()), default=1)
        stacked = {name: array for name, array in matrices.items() if len(array) == rows and array.dtype.kind == "f"}
        good, there = np.ones(rows, dtype=bool), np.full(rows, not stacked)
        if rows > 1:
            for array in stacked.values():
                good &= np.isfinite(array).all(axis=1)
                there |= ~np.isnan(array).all(axis=1)
        offsets = np.asarray(arrays.get("v_shape", ()))
        if rows > 1 and offsets.ndim == 3 and len(offsets) == rows:
            stacked["v_shape"] = offsets
        kept = arrays if good.all() else {**arrays, **{name: array[good] for name, array in stacked.items()}}
        if not good.any():
            raise InputError(f"file {self.path}", expected="finite values", received="NaN or infinity in every row")
        params = params_from_content(kept, source=f"file {self.path}", layout=self.layout, body=self.body)
        return params, np.where(good, np.cumsum(good) - 1, np.where(there, _DAMAGED, _ABSENT))

    def frames(self) -> Int64[np.ndarray, " F"]:
        """Return the frames with parameters, ascending."""
        return np.flatnonzero(self._rows[1] != _ABSENT)

    def read(self, frame: int) -> BodyParams:
        """Read the parameters of one frame with parameters.

        Raises:
            InputError: NaN or infinity in the row, or in all rows.
        """
        params, index = self._rows
        if index[frame] < 0:
            raise InputError(f"file {self.path}: row {frame}", expected="finite values", received="NaN or infinity")
        return params.frame(int(index[frame]))


@dataclass(frozen=True, eq=False)
class ParamFiles:
    """A file of parameters for each frame, read once: a simulation asks for the frames of a run again and again.

    Attributes:
        files: files by frame.
        layout: layout for `load_params`.
        body: body model with the root joint that some layouts need.
        up: up axis for `load_params`; None: that of the layout.
    """

    files: FileSeries
    layout: LayoutName = "auto"
    body: BodyModel | None = None
    up: UpAxis | None = None

    def frames(self) -> Int64[np.ndarray, " F"]:
        """Return the frames with parameters, ascending."""
        return self.files.numbers

    @cached_property
    def _known(self) -> dict[int, BodyParams]:
        """Frames that have been read; a frame is some kilobytes."""
        return {}

    def read(self, frame: int) -> BodyParams:
        """Read the parameters of one frame with a file."""
        if frame not in self._known:
            file = self.files.required(frame)
            self._known[frame] = load_params(file, layout=self.layout, body=self.body, up=self.up)
        return self._known[frame]


@dataclass(frozen=True, eq=False)
class FrameParams:
    """Parameters in memory, one frame of them for each frame number, such as those that a registration gives.

    Attributes:
        rows: parameters of one frame by its number.
        estimated: whether they were fitted to images or scans; `avatar.train` refines such poses first.
    """

    rows: Mapping[int, BodyParams]
    estimated: bool = True

    def frames(self) -> Int64[np.ndarray, " F"]:
        """Return the frames that there are, ascending."""
        return np.array(sorted(self.rows), dtype=np.int64)

    def read(self, frame: int) -> BodyParams:
        """Return the parameters of one frame."""
        return self.rows[frame]


def find_params(path: Path, *, body: BodyModel | None, layout: LayoutName = "auto") -> StackedParams | ParamFiles:
    """Find parameters at a path: an npz file with a row for each frame, or a folder with a numbered file for each.

    Raises:
        InputError: neither of them.
    """
    if path.is_dir():
        files = FileSeries.find(path, r"\D*(?P<frame>\d+)\D*\.(json|npz|pkl)")
        if len(files):
            return ParamFiles(files, layout, body)
    elif path.is_file() and path.suffix.lower() == ".npz":
        return StackedParams(path, layout, body)
    raise InputError(
        "body parameters of the capture",
        expected="an npz file with a row a frame, or a folder with a numbered json, npz or pkl file a frame",
        received=f"{path}" + ("" if path.exists() else ", which does not exist"),
        remedy="convert other files with `smplxpp params convert`",
    )


@dataclass(frozen=True, eq=False)
class MeshFiles:
    """Mesh files, one for each frame."""

    files: FileSeries

    def read(self, frame: int) -> TriangleMesh | None:
        """Read the mesh of a frame; None without one."""
        path = self.files.path(frame)
        return None if path is None else read_mesh(path).mesh


@dataclass(frozen=True, eq=False)
class PosedTopology:
    """One topology file (`faces`, `face_hidden`) and a file of vertices (`verts`) for each frame.

    Faces marked by `face_hidden` (skin under clothes) are left out, so that the mesh is the visible surface.
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
        """Read the mesh of a frame; None without one."""
        path = self.files.path(frame)
        if path is None:
            return None
        arrays = safe_npz(path, keys=("verts",))
        if "verts" not in arrays:
            raise InputError(f"file {path}", expected="an array `verts`", received="none")
        return TriangleMesh(arrays["verts"], self._faces)
