"""Read body model files of SMPL-X, SMPL-H and SMPL as npz or pickle, and the embedded open body."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.body.layout import HAND_WIDTH, JOINT_NAMES
from smplxpp.body.model import BodyModel
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer
from smplxpp.core.files.safe_pickle import dense_array, safe_load, safe_npz

_REQUIRED = ("v_template", "f", "shapedirs", "weights", "J_regressor", "kintree_table")
_OPTIONAL = (
    "posedirs",
    "vt",
    "ft",
    "hands_componentsl",
    "hands_componentsr",
    "hands_meanl",
    "hands_meanr",
    "num_betas",
    "num_expressions",
    "joint_names",
    "vertex_labels",
    "vertex_label_names",
    "expr_names",
    "coco_regressor",
    "coco_names",
    "lmk_faces_idx",
    "lmk_bary_coords",
)
# COCO's keypoints near these joints are not the joints themselves, so their names get a prefix.
_COCO, _COCO_JOINTS = "coco_", ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def load_body(
    path: str | Path | None = None, *, num_betas: int | None = None, num_expressions: int | None = None
) -> BodyModel:
    """Read a body model of the SMPL family from a file.

    Args:
        path: an npz or pkl file in the layout of SMPL-X (55 joints), SMPL-H (52) or SMPL (24), told apart by their
            joints. None: the open body that comes with the package (55 joints, 20 betas, 52 expressions).
            Pickles are read without executing anything from them.
        num_betas: number of shape directions to keep; None keeps all.
        num_expressions: number of expression directions to keep; None keeps all.

    Raises:
        InputError: a missing key, a wrong shape, weights that do not sum to 1, more directions asked than there are.

    Example:
        >>> body = smplxpp.load_body()
        >>> body.forward(smplxpp.BodyParams.rest(betas=0)).vertices.shape == (1, body.vertex_count, 3)
        True
    """
    if path is None:
        return _open_body(num_betas, num_expressions)
    path = Path(path)
    raw = _read(path)
    missing = [key for key in _REQUIRED if key not in raw]
    if missing:
        raise InputError(
            f"body file {path}",
            expected=f"the keys {', '.join(_REQUIRED)}",
            received=f"a file without {', '.join(missing)}",
            remedy="give a model file of SMPL-X, SMPL-H or SMPL, not a file of parameters",
        )
    return _Builder(path, raw).build(num_betas, num_expressions)


@lru_cache(maxsize=4)
def _open_body(num_betas: int | None, num_expressions: int | None) -> BodyModel:
    """Return the embedded body, cached; its arrays are read-only, so that callers can share them."""
    with resources.as_file(resources.files("smplxpp") / "data" / "open_body.npz") as embedded:
        return load_body(embedded, num_betas=num_betas, num_expressions=num_expressions)


def _read(path: Path) -> dict[str, Any]:
    keys = (*_REQUIRED, *_OPTIONAL)
    if path.suffix.lower() == ".npz":
        return safe_npz(path, keys=keys)
    if path.suffix.lower() not in (".pkl", ".pickle"):
        raise InputError(f"body file {path}", expected="an .npz or .pkl file", received=f"suffix {path.suffix!r}")
    content = safe_load(path)
    if not isinstance(content, dict):
        raise InputError(f"body file {path}", expected="a pickled dict", received=type(content).__name__)
    return {key: content[key] for key in keys if key in content}


class _Builder:
    """A converter of the raw values of one file to a BodyModel, with errors that name the key."""

    def __init__(self, path: Path, raw: dict[str, Any]) -> None:
        self.path, self.raw = path, raw

    def build(self, num_betas: int | None, num_expressions: int | None) -> BodyModel:
        """Check and convert all arrays, whose sizes follow from the skinning weights."""
        # The number of joints decides the family; bases are split into shape and expression.
        weights = self._array("weights", (None, None))
        vertex_count, joint_count = weights.shape
        if joint_count not in JOINT_NAMES:
            raise self._error(
                "weights", f"{sorted(JOINT_NAMES)} joints (SMPL, SMPL-H, SMPL-X)", f"{joint_count} columns"
            )
        shapedirs, exprdirs = self._bases(vertex_count, joint_count)
        names = self._names("joint_names", joint_count) or JOINT_NAMES[joint_count]
        weights = self._normalised(weights)
        labels, label_names = self._part_labels(weights, names)
        faces = self._faces(vertex_count)
        kept_expressions = self._first(exprdirs, num_expressions, "expressions")
        model = BodyModel(
            name=self.path.stem,
            v_template=self._array("v_template", (vertex_count, 3)),
            faces=faces,
            shapedirs=self._first(shapedirs, num_betas, "betas"),
            exprdirs=kept_expressions,
            posedirs=self._posedirs(vertex_count, joint_count),
            joint_regressor=self._array("J_regressor", (joint_count, vertex_count)),
            parents=self._parents(joint_count),
            joint_names=names,
            weights=weights,
            left_hand_components=self._optional("hands_componentsl", (None, HAND_WIDTH)),
            right_hand_components=self._optional("hands_componentsr", (None, HAND_WIDTH)),
            left_hand_mean=self._optional("hands_meanl", (HAND_WIDTH,)),
            right_hand_mean=self._optional("hands_meanr", (HAND_WIDTH,)),
            part_labels=labels,
            part_label_names=label_names,
            landmarks=self._landmarks(faces, vertex_count),
            expression_names=(self._names("expr_names", exprdirs.shape[2]) or ())[: kept_expressions.shape[2]],
            uv=self._uv(len(faces)),
        )
        # Read-only arrays let callers share one model.
        for value in (*vars(model).values(), *(array for pair in model.landmarks.values() for array in pair)):
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        return model

    def _error(self, key: str, expected: str, received: str, remedy: str = "") -> InputError:
        return InputError(f"body file {self.path}: {key}", expected=expected, received=received, remedy=remedy)

    def _array(self, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
        value = dense_array(self.raw[key], subject=f"body file {self.path}: {key}")
        if key == "hands_meanl" or key == "hands_meanr":
            value = value.reshape(-1)
        if value.dtype.kind not in "biuf":
            raise self._error(key, "numbers", f"values of type {value.dtype}")
        value = np.array(value, dtype=np.float64, order="C")
        if value.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, value.shape, strict=True)):
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise self._error(key, f"shape {wanted}", f"shape {value.shape}", "the file mixes models or is damaged")
        if not np.isfinite(value).all():
            raise self._error(key, "finite values", "NaN or infinity")
        return value

    def _optional(self, key: str, shape: tuple[int | None, ...]) -> np.ndarray | None:
        return self._array(key, shape) if key in self.raw else None

    def _count(self, key: str, most: int) -> int:
        """Return a count of directions that the file states."""
        value = np.asarray(dense_array(self.raw[key], subject=f"body file {self.path}: {key}"))
        number = value.item() if value.size == 1 else value.tolist()
        return as_integer(number, subject=f"body file {self.path}: {key}", least=0, most=most)

    def _names(self, key: str, count: int) -> tuple[str, ...] | None:
        if key not in self.raw:
            return None
        names = tuple(str(name) for name in np.ravel(self.raw[key]))
        if len(names) != count:
            raise self._error(key, f"{count} names", f"{len(names)}")
        return names

    def _bases(self, vertex_count: int, joint_count: int) -> tuple[np.ndarray, np.ndarray]:
        """Split the directions into shape and expression by the file's own counts, else by SMPL-X's convention.

        SMPL-X files of 400 directions and more have 300 of the shape; shorter ones have 10 and 10.
        """
        basis = self._array("shapedirs", (vertex_count, 3, None))
        width = basis.shape[2]
        # The file's own counts, else a body without expressions, else the two conventions of SMPL-X.
        if "num_betas" in self.raw:
            shape = self._count("num_betas", width)
            expression = self._count("num_expressions", width) if "num_expressions" in self.raw else width - shape
        elif joint_count != max(JOINT_NAMES):
            shape, expression = width, 0
        elif width >= 400:
            shape, expression = 300, width - 300
        else:
            shape, expression = 10, 10
        if shape + expression > width:
            raise self._error("shapedirs", f"{shape} shape and {expression} expression directions", f"{width}")
        return basis[..., :shape], basis[..., shape : shape + expression]

    def _first(self, basis: np.ndarray, count: int | None, what: str) -> np.ndarray:
        if count is not None and not 0 <= count <= basis.shape[2]:
            raise self._error("shapedirs", f"at most {basis.shape[2]} {what}", f"{count} asked for")
        return np.ascontiguousarray(basis[..., :count])

    def _posedirs(self, vertex_count: int, joint_count: int) -> np.ndarray | None:
        value = self._optional("posedirs", (vertex_count, 3, 9 * (joint_count - 1)))
        return value if value is not None and value.any() else None

    def _faces(self, vertex_count: int) -> np.ndarray:
        faces = self._array("f", (None, 3)).astype(np.int64)
        if faces.size and (faces.min() < 0 or faces.max() >= vertex_count):
            raise self._error("f", f"indices in [0, {vertex_count})", f"[{faces.min()}, {faces.max()}]")
        return faces

    def _uv(self, face_count: int) -> tuple[np.ndarray, np.ndarray] | None:
        # A file with coordinates outside the picture, as some tools' tiles are, is unwrapped anew like one without.
        if not {"vt", "ft"} <= self.raw.keys():
            return None
        uv, face_uv = self._array("vt", (None, 2)), self._array("ft", (face_count, 3)).astype(np.int64)
        if face_uv.size and (face_uv.min() < 0 or face_uv.max() >= len(uv)):
            raise self._error("ft", f"indices in [0, {len(uv)})", f"[{face_uv.min()}, {face_uv.max()}]")
        return (uv, face_uv) if ((uv >= 0) & (uv <= 1)).all() else None

    def _parents(self, joint_count: int) -> np.ndarray:
        # The root's parent is stored as -1 or as 2^32 - 1.
        parents = self._array("kintree_table", (2, joint_count))[0].astype(np.int64)
        parents[(parents < 0) | (parents >= joint_count)] = -1
        if not (parents[0] == -1 and (parents[1:] >= 0).all() and (parents[1:] < np.arange(1, joint_count)).all()):
            raise self._error("kintree_table", "one root first, every parent before its children", str(parents))
        return parents

    def _landmarks(self, faces: np.ndarray, vertex_count: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return detectors' keypoints in the file: COCO's (open body), and dlib's from 17 on (open body and SMPL-X)."""
        found = {}
        if "coco_regressor" in self.raw and "coco_names" in self.raw:
            regressor = self._array("coco_regressor", (None, vertex_count))
            for name, row in zip(self._names("coco_names", len(regressor)) or (), regressor, strict=True):
                used = np.flatnonzero(row)
                prefix = _COCO if name.partition("_")[2] in _COCO_JOINTS else ""
                found[prefix + name] = (used, row[used] / row.sum())
        if "lmk_faces_idx" in self.raw and "lmk_bary_coords" in self.raw:
            corners = self._array("lmk_faces_idx", (None,)).astype(np.int64)
            weights = self._array("lmk_bary_coords", (len(corners), 3))
            # The 51 points of dlib's 68 without the contour, which are the first 17.
            if len(corners) == 51 and corners.min() >= 0 and corners.max() < len(faces):
                for k, (corner, weight) in enumerate(zip(corners, weights, strict=True)):
                    found[f"face_{17 + k}"] = (faces[corner], weight / weight.sum())
        return found

    def _normalised(self, weights: np.ndarray) -> np.ndarray:
        """Normalise rows to sum to 1 in float64, so that a translation in the transforms is exact.

        Sums within 1e-3 of 1 are the rounding of float16; others are errors of the file.
        """
        total = weights.sum(axis=1)
        worst = int(np.argmax(np.abs(total - 1.0)))
        if weights.min() < 0 or abs(total[worst] - 1.0) > 1e-3:
            raise self._error(
                "weights",
                "non-negative rows that sum to 1",
                f"minimum {weights.min():.3g}, row {worst} sums to {total[worst]:.6g}",
                "normalise the rows of the file's weights",
            )
        return weights / total[:, None]

    def _part_labels(self, weights: np.ndarray, joint_names: tuple[str, ...]) -> tuple[np.ndarray, tuple[str, ...]]:
        if "vertex_labels" not in self.raw or "vertex_label_names" not in self.raw:
            return weights.argmax(axis=1), joint_names
        labels = self._array("vertex_labels", (len(weights),)).astype(np.int64)
        names = tuple(str(name) for name in np.ravel(self.raw["vertex_label_names"]))
        if labels.min() < 0 or labels.max() >= len(names):
            raise self._error("vertex_labels", f"labels in [0, {len(names)})", f"[{labels.min()}, {labels.max()}]")
        return labels, names
