"""LabelSession: labels and landmarks under correction, with undo, without any window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64, UInt8

from pipelines.runs.layout import CORRECTIONS_FILE, LANDMARKS_FILE
from smplxpp.core import LABELS, InputError, Labels, TriangleMesh, normalize_rows
from smplxpp.core.topology import component_labels
from smplxpp.register import write_landmarks
from smplxpp.segment import BoxCorrection, Corrections, FaceCorrection, StrokeCorrection
from smplxpp.segment.corrected_faces import ScanSurface
from smplxpp.segment.corrections import Correction, faces_of

_OF_SIDES = (
    "shoulder",
    "elbow",
    "wrist",
    "hip",
    "knee",
    "ankle",
    "heel",
    "big_toe",
    "index_tip",
    "thumb_tip",
    "ear",
)
_WITHIN = {"shoulder", "elbow", "wrist", "hip", "knee", "ankle"}
CHOICE: tuple[str, ...] = (
    "nose",
    "neck",
    "pelvis",
    *(f"{side}_{part}" for part in _OF_SIDES for side in ("left", "right")),
)
"""Landmarks by their usefulness: face and trunk determine the facing, limbs follow."""


def lies_within(name: str) -> bool:
    """Return whether a landmark is a joint's centre within the limb and not a point of the skin."""
    return name in ("neck", "pelvis") or name.removeprefix("left_").removeprefix("right_") in _WITHIN


UNCERTAIN = 0.6
"""Confidence below which a face is uncertain."""


@dataclass(frozen=True, eq=False)
class UncertainRegion:
    """Connected patch of uncertain faces.

    Attributes:
        label: label of most of its area.
        area: square metres.
        confidence: mean confidence.
        center: centroid, metres.
        normal: mean normal, outward, unit length.
    """

    label: int
    area: float
    confidence: float
    center: Float64[np.ndarray, " 3"]
    normal: Float64[np.ndarray, " 3"]


def uncertain_regions(
    surface: ScanSurface,
    labels: Int[np.ndarray, " M"],
    confidence: Float[np.ndarray, " M"],
    corrected: Bool[np.ndarray, " M"],
) -> list[UncertainRegion]:
    """Return connected patches of uncertain faces without manual labels, by area times (1 - confidence).

    Patches have at least 2 square centimetres, and there are at most 40 of them.
    """
    uncertain = (confidence < UNCERTAIN) & ~corrected
    mesh, pairs = surface.mesh, surface.pairs
    patch = component_labels(pairs[uncertain[pairs].all(axis=1)], mesh.face_count)
    area = mesh.face_areas * uncertain
    of_patch = np.bincount(patch, area)
    importance = np.bincount(patch, area * (1.0 - confidence))
    out = []
    for k in np.argsort(-importance, kind="stable")[:40]:
        if of_patch[k] < 2e-4:
            continue
        own = np.flatnonzero((patch == k) & uncertain)
        weight = mesh.face_areas[own]
        center = weight @ mesh.face_centers[own] / weight.sum()
        out.append(
            UncertainRegion(
                label=int(np.bincount(labels[own], weight).argmax()),
                area=float(weight.sum()),
                confidence=float(weight @ confidence[own] / weight.sum()),
                center=center,
                normal=normalize_rows((weight @ mesh.face_normals[own])[None])[0],
            )
        )
    return out


Line = tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]
"""Points and normals of a piece of a stroke."""


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """A run's scan as it is before any correction.

    Attributes:
        mesh: metres, +Y up. colors: of its vertices.
        labels, confidence: of its faces; None: the run has none yet.
        known: what ids of labels stand for.
    """

    mesh: TriangleMesh
    colors: UInt8[np.ndarray, "N 3"]
    labels: Int64[np.ndarray, " M"] | None
    confidence: Float64[np.ndarray, " M"] | None
    known: Labels = LABELS


@dataclass(frozen=True, eq=False)
class _State:
    """Immutable state for undo.

    Attributes:
        items: corrections, oldest first.
        faces: faces of each correction.
        landmarks: landmarks by name.
        action: description of the last action.
    """

    items: tuple[Correction, ...] = ()
    faces: tuple[Int64[np.ndarray, " _"], ...] = ()
    landmarks: Mapping[str, Float64[np.ndarray, " 3"]] = field(default_factory=dict)
    action: str = ""


class LabelSession:
    """Corrections of labels and landmarks of one scan.

    Args:
        scan: scan before any correction.
        corrections: existing corrections.
        landmarks: existing landmarks.
    """

    def __init__(
        self,
        scan: LabelledScan,
        corrections: Corrections | None = None,
        landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    ) -> None:
        self.scan, self.surface = scan, ScanSurface(scan.mesh)
        items = corrections.items if corrections is not None else ()
        faces = tuple(faces_of(item, self.surface, subject=f"correction {k + 1}") for k, item in enumerate(items))
        placed = {name: np.asarray(point, dtype=np.float64) for name, point in (landmarks or {}).items()}
        self._state = self._saved = _State(items, faces, placed)
        self._before: list[_State] = []

    # -- what is there

    @property
    def corrections(self) -> Corrections:
        """Return all corrections of the session."""
        return Corrections(self._state.items, self.scan.known)

    @property
    def landmarks(self) -> Mapping[str, Float64[np.ndarray, " 3"]]:
        """Return the landmarks by name, in metres."""
        return self._state.landmarks

    @property
    def changed(self) -> bool:
        """Return whether there are unsaved changes."""
        return self._state is not self._saved

    @property
    def has_labels(self) -> bool:
        """Whether the run has labels that can be corrected."""
        return self.scan.labels is not None

    def corrected(self) -> Bool[np.ndarray, " M"]:
        """Return the faces that some correction sets."""
        out = np.zeros(self.scan.mesh.face_count, dtype=bool)
        for faces in self._state.faces:
            out[faces] = True
        return out

    def labels(self) -> Int64[np.ndarray, " M"]:
        """Return the labels of the faces after corrections.

        Raises:
            InputError: the run has none.
        """
        out = np.array(self._labels())
        for item, faces in zip(self._state.items, self._state.faces, strict=True):
            out[faces] = item.label
        return out

    def confidence(self) -> Float64[np.ndarray, " M"]:
        """Of the faces: 1 where they are corrected."""
        given = self.scan.confidence
        return np.where(self.corrected(), 1.0, np.ones(self.scan.mesh.face_count) if given is None else given)

    # -- what a hand does

    def brush(self, label: int, lines: list[Line], radius: float) -> int:
        """Paint along lines on the surface; returns the number of faces under them."""
        items = [StrokeCorrection(label, points, radius, normals) for points, normals in lines]
        return self._add(items, f"{self.scan.known[label].name} painted")

    def patch(self, label: int, face: int) -> int:
        """Give the whole patch that has this face's label, as far as it reaches, another label."""
        labels, pairs = self.labels(), self.surface.pairs
        same = labels[pairs[:, 0]] == labels[pairs[:, 1]]
        patch = component_labels(pairs[same], len(labels))
        faces = np.flatnonzero(patch == patch[face])
        known = self.scan.known
        words = f"a patch of {known[int(labels[face])].name} to {known[label].name}"
        return self._add([FaceCorrection.of(self.scan.mesh, label, faces)], words)

    def box(
        self,
        label: int,
        center: Float[np.ndarray, " 3"],
        size: Float[np.ndarray, " 3"],
        rotation: Float[np.ndarray, "3 3"],
    ) -> int:
        """Give everything in a box a label; returns the number of faces in it, 0 changes nothing."""
        item = BoxCorrection(label, *(np.asarray(value, dtype=np.float64) for value in (center, size, rotation)))
        inside = np.abs((self.surface.centers - item.center) @ item.rotation) <= 0.5 * item.size
        return self._add([item], f"a box of {self.scan.known[label].name}") if inside.all(axis=1).any() else 0

    def remove(self, number: int) -> None:
        """Take back one correction, by its place among them."""
        state = self._state
        items, faces = list(state.items), list(state.faces)
        name = self.scan.known[items.pop(number).label].name
        faces.pop(number)
        self._now(_State(tuple(items), tuple(faces), state.landmarks, f"correction {number + 1} ({name}) removed"))

    def place(self, name: str, point: Float[np.ndarray, " 3"]) -> None:
        """Place a landmark, or move it."""
        placed = {**self._state.landmarks, name: np.array(point, dtype=np.float64)}
        self._now(_State(self._state.items, self._state.faces, placed, f"{name} placed"))

    def remove_landmark(self, name: str) -> None:
        """Remove a landmark by its name."""
        placed = {other: point for other, point in self._state.landmarks.items() if other != name}
        self._now(_State(self._state.items, self._state.faces, placed, f"{name} removed"))

    def undo(self) -> str:
        """Undo the last action and return its description, "" if nothing is left."""
        if not self._before:
            return ""
        action, self._state = self._state.action, self._before.pop()
        return action

    def save(self, run: Path) -> list[str]:
        """Write both files of a run whole; returns the names of those that were written."""
        out, state = [], self._state
        if state.items or (run / CORRECTIONS_FILE).exists():
            Corrections(state.items, self.scan.known).save(run / CORRECTIONS_FILE)
            out.append(CORRECTIONS_FILE)
        if state.landmarks or (run / LANDMARKS_FILE).exists():
            write_landmarks(run / LANDMARKS_FILE, state.landmarks)
            out.append(LANDMARKS_FILE)
        self._saved = state
        return out

    def _labels(self) -> Int64[np.ndarray, " M"]:
        if self.scan.labels is None:
            raise InputError(
                "labels",
                expected="a run whose scan has labels",
                received="none yet",
                remedy="place landmarks, save, and give `smplxpp build` again",
            )
        return self.scan.labels

    def _add(self, items: Sequence[Correction], action: str) -> int:
        self._labels()
        faces = [faces_of(item, self.surface) for item in items]
        if items:
            state = self._state
            self._now(_State((*state.items, *items), (*state.faces, *faces), state.landmarks, action))
        return len(np.unique(np.concatenate(faces))) if faces else 0

    def _now(self, state: _State) -> None:
        most_undone = 200
        self._before = [*self._before[-most_undone + 1 :], self._state]
        self._state = state
