"""Define SkinWeights, which the transfer of skin weights returns and skinning takes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Int, Int32
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix

from smplxpp.core.errors import InputError, require_at_least, require_known
from smplxpp.core.files.array_file import read_arrays, write_arrays
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_list, as_numbers, as_object, as_text, read_json
from smplxpp.core.foreign import as_array

_MEASURED = ("matched", "distance", "angle", "component")
_MOST_JOINTS = 10_000
"""Joints above which a file is refused: its dense matrix would fill the memory."""


@dataclass(frozen=True, eq=False)
class SkinWeights:
    """Sparse skinning weights of N vertices over J joints, with their provenance.

    Attributes:
        joint_indices: (N, K) int32.
        joint_weights: (N, K) float64, rows sum to 1, none negative; unused slots have weight 0.
        joint_count: J.
        matched: (N,) bool, taken from the source by correspondence (not inpainted).
        distance: (N,) float64 metres to the closest source point (NaN where unknown).
        angle: (N,) float64 radians between the normals there (NaN where unknown).
        component: (N,) int32 connected component of each vertex.
        policies: the policy taken for each component ("matched", "nearest", "rigid:head", ...).

    Example:
        >>> weights = smplxpp.SkinWeights.from_dense(np.array([[0.25, 0.75], [1.0, 0.0]]))
        >>> weights
        SkinWeights(2 vertices over 2 joints, at most 2 a vertex)
        >>> weights.dense()[0]
        array([0.25, 0.75])
    """

    joint_indices: Int32[np.ndarray, "N K"]
    joint_weights: Float64[np.ndarray, "N K"]
    joint_count: int
    matched: Bool[np.ndarray, " N"]
    distance: Float64[np.ndarray, " N"]
    angle: Float64[np.ndarray, " N"]
    component: Int32[np.ndarray, " N"]
    policies: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.joint_indices)

    def __repr__(self) -> str:
        slots = self.joint_indices.shape[-1]
        return f"SkinWeights({len(self):,} vertices over {self.joint_count} joints, at most {slots} a vertex)"

    def to_sparse(self) -> csr_matrix:
        """Return the weights as a sparse matrix (N, J) of float64; slots of weight 0 are left out."""
        row, slot = np.nonzero(self.joint_weights)
        column = self.joint_indices[row, slot]
        return csr_matrix((self.joint_weights[row, slot], (row, column)), (len(self), self.joint_count))

    def of(self, rows: Int[np.ndarray, " n"]) -> SkinWeights:
        """Return the weights of some of the vertices, with the policies of all components."""
        names = ("joint_indices", "joint_weights", "matched", "distance", "angle", "component")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def pruned(self, max_influences: int, *, least: float = 0.0) -> SkinWeights:
        """Return the weights with at most `max_influences` joints a vertex, none below `least`, rows summing to 1.

        A row's largest weight stays, however small. Game engines take 4 or 8.

        Raises:
            InputError: a number below 1, or a least weight that is negative or not finite.
        """
        require_at_least("max_influences", max_influences, 1)
        require_at_least("least weight", least, 0.0)
        dense = self.dense()
        small = (dense < least) & (dense < dense.max(axis=1, keepdims=True))
        return self._with_dense(np.where(small, 0.0, dense), max_influences)

    def reordered(
        self, joint_names: Sequence[str], wanted: Sequence[str], *, parents: Sequence[int] | None = None
    ) -> SkinWeights:
        """Return the weights over other joints, matched by name.

        Args:
            joint_names: names of the J joints of these weights.
            wanted: names of the joints of the result, in their order.
            parents: (J,) parents of these joints, -1 at the root. The weight of a joint that is not wanted goes to its
                nearest ancestor that is (fingers to the wrist of a skeleton without fingers).

        Raises:
            InputError: other numbers of names, or weight on a joint that is not wanted and has no wanted ancestor.

        Example:
            >>> weights = smplxpp.SkinWeights.from_dense(np.array([[0.25, 0.75, 0.0]]))
            >>> weights.reordered(["hip", "knee", "toe"], ["knee", "hip"], parents=[-1, 0, 1]).dense()
            array([[0.75, 0.25]])
        """
        if len(joint_names) != self.joint_count or (parents is not None and len(parents) != self.joint_count):
            raise InputError("joint names", expected=f"{self.joint_count} names", received=f"{len(joint_names)}")
        place = {name: k for k, name in enumerate(wanted)}
        used = np.zeros(self.joint_count, dtype=bool)
        used[self.joint_indices[self.joint_weights > 0]] = True
        dense, out = self.dense(), np.zeros((len(self), len(wanted)))
        for joint in np.flatnonzero(used).tolist():
            # Climb to the first ancestor that is wanted; a chain has at most J joints.
            owner, steps = joint, 0
            while joint_names[owner] not in place and parents is not None and parents[owner] >= 0:
                owner, steps = int(parents[owner]), steps + 1
                if steps > self.joint_count:
                    raise InputError("joint parents", expected="a tree", received="a circle")
            require_known("joints with weight", [joint_names[owner]], wanted)
            out[:, place[joint_names[owner]]] += dense[:, joint]
        return self._with_dense(out, None)

    def _with_dense(self, dense: np.ndarray, max_influences: int | None) -> SkinWeights:
        """Return other weights (N, J) with this provenance."""
        found = SkinWeights.from_dense(dense, max_influences=max_influences)
        return replace(
            self,
            joint_indices=found.joint_indices,
            joint_weights=found.joint_weights,
            joint_count=found.joint_count,
        )

    def save(self, path: str | Path, *, joint_names: Sequence[str] = ()) -> None:
        """Write the weights as `.npz`, with their provenance, or as `.json`, which any program reads.

        The JSON is `{"joint_names": [...], "joint_count": J, "joint_indices": [[...]], "joint_weights": [[...]]}`.

        Args:
            path: of the file; written whole or not at all.
            joint_names: names of the J joints, for those who read it.

        Raises:
            InputError: another suffix, or another number of names.
        """
        if len(joint_names) not in (0, self.joint_count):
            raise InputError("joint names", expected=f"{self.joint_count} or none", received=f"{len(joint_names)}")
        shared = {"joint_indices": self.joint_indices, "joint_weights": self.joint_weights}
        if _suffix(path) == ".npz":
            measured = {name: getattr(self, name) for name in _MEASURED}
            texts = {"joint_names": np.array(joint_names, str), "policies": np.array(self.policies, str)}
            write_arrays(path, {**shared, "joint_count": np.array(self.joint_count), **measured, **texts})
        else:
            tables = {name: array.tolist() for name, array in shared.items()}
            about = {"joint_names": list(joint_names), "joint_count": self.joint_count}
            atomic_write_text(path, json.dumps({**about, **tables}) + "\n")

    @staticmethod
    def load(path: str | Path) -> tuple[SkinWeights, tuple[str, ...]]:
        """Read the weights that `save` wrote, and the joints' names, empty where the file has none.

        Raises:
            InputError: another suffix, a damaged file, or rows that are no weights.

        Example:
            >>> weights = smplxpp.SkinWeights.from_dense(np.array([[0.25, 0.75]]))
            >>> weights.save("weights.json", joint_names=["hip", "knee"])
            >>> smplxpp.SkinWeights.load("weights.json")
            (SkinWeights(1 vertices over 2 joints, at most 2 a vertex), ('hip', 'knee'))
        """
        subject = f"skin weights {path}"
        data: dict[str, Any]
        if _suffix(path) == ".npz":
            data = {**read_arrays(path, subject="skin weights")}
            texts = {
                key: tuple(np.ravel(data.get(key, ())).astype(str).tolist()) for key in ("joint_names", "policies")
            }
        else:
            data = as_object(read_json(path, subject="skin weights"), subject=subject)
            names = as_list(data.get("joint_names", []), subject=f"{subject}: joint_names")
            texts = {"joint_names": tuple(as_text(name, subject=subject) for name in names), "policies": ()}
        missing = {"joint_indices", "joint_weights", "joint_count"} - data.keys()
        if missing:
            raise InputError(subject, expected="joint_indices, joint_weights, joint_count", received=f"no {missing}")
        # Indices and weights of one shape; the sum of a row is checked, and normalised, by `from_dense`.
        weights = as_numbers(data["joint_weights"], (None, None), subject=f"{subject}: joint_weights")
        indices = as_numbers(data["joint_indices"], weights.shape, subject=f"{subject}: joint_indices")
        count = int(as_numbers(data["joint_count"], (), subject=f"{subject}: joint_count"))
        if not 1 <= count <= _MOST_JOINTS or (indices != np.round(indices)).any():
            raise InputError(subject, expected=f"whole numbers, 1 to {_MOST_JOINTS} joints", received=f"{count} joints")
        if indices.size and not 0 <= indices.min() <= indices.max() < count:
            raise InputError(subject, expected=f"joints in [0, {count})", received="others")
        if len(texts["joint_names"]) not in (0, count):
            raise InputError(subject, expected=f"{count} joint names", received=f"{len(texts['joint_names'])}")
        row = np.repeat(np.arange(len(weights)), weights.shape[1])
        sparse = csr_matrix((weights.ravel(), (row, indices.ravel().astype(int))), (len(weights), count))
        found = SkinWeights.from_dense(sparse.toarray())
        measured = {name: data[name].astype(getattr(found, name).dtype) for name in _MEASURED if name in data}
        if any(array.shape != (len(weights),) for array in measured.values()):
            raise InputError(subject, expected=f"{len(weights)} values a vertex", received="other shapes")
        return replace(found, policies=texts["policies"], **measured), texts["joint_names"]

    def dense(self) -> Float64[np.ndarray, "N J"]:
        """Return the weights of all joints; every row sums to 1."""
        out = np.zeros((len(self), self.joint_count))
        np.add.at(out, (np.arange(len(self))[:, None], self.joint_indices), self.joint_weights)
        return out

    @staticmethod
    def from_dense(weights: ArrayLike, *, max_influences: int | None = None, **provenance) -> SkinWeights:
        """Keep the `max_influences` largest of each row of (N, J) weights, clip at 0, renormalise.

        The weights are an array, a torch tensor or a sparse matrix.

        Raises:
            InputError: a row without a positive weight, or NaN.
        """
        weights = np.asarray(as_array(weights), dtype=np.float64)
        if weights.ndim != 2 or not np.isfinite(weights).all():
            raise InputError("skinning weights", expected="finite (N, J)", received=f"shape {weights.shape} or NaN")
        n, joint_count = weights.shape
        # Negative weights are round-off of solvers.
        clipped = np.clip(weights, 0.0, None)
        # No row needs more slots than its number of positive weights.
        used = int((clipped > 0).sum(axis=1).max(initial=1))
        k = max(1, min(used, max_influences or joint_count))
        # Stable order: larger weight first, then lower joint index. Joints without any weight are not sorted, unless
        # they have to fill slots of weight 0.
        joints = np.flatnonzero(clipped.any(axis=0)) if n else np.arange(joint_count)
        joints = joints if len(joints) >= k else np.arange(joint_count)
        order = joints[np.argsort(-clipped[:, joints], axis=1, kind="stable")[:, :k]]
        # (N, k) weights in the order of `order`; dividing by their sum keeps the partition of unity.
        kept = np.take_along_axis(clipped, order, axis=1)
        total = kept.sum(axis=1, keepdims=True)
        if (total <= 0).any():
            raise InputError(
                "skinning weights",
                expected="a positive weight in every row",
                received=f"{int((total <= 0).sum())} rows without, first at vertex {int(np.argmax(total <= 0))}",
            )
        defaults = {
            "matched": np.ones(n, dtype=bool),
            "distance": np.full(n, np.nan),
            "angle": np.full(n, np.nan),
            "component": np.zeros(n, dtype=np.int32),
            "policies": (),
        }
        return SkinWeights(order.astype(np.int32), kept / total, joint_count, **{**defaults, **provenance})


WeightsLike: TypeAlias = SkinWeights | ArrayLike | csr_matrix
"""What public functions take as skin weights: `SkinWeights`, or (N, J) as an array, torch tensor or sparse matrix."""


def dense_weights(weights: WeightsLike) -> np.ndarray:
    """Return skin weights of any kind as an array (N, J), without a check of their values."""
    if isinstance(weights, SkinWeights):
        return weights.dense()
    return np.asarray(as_array(weights), dtype=np.float64)


def _suffix(path: str | Path) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in (".npz", ".json"):
        raise InputError(f"skin weights {path}", expected=".npz or .json", received=suffix or "no suffix")
    return suffix
