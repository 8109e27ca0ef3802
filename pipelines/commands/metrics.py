"""`smplxpp metrics A B`: distances between two meshes, or between two folders of frames, one row a frame."""

from __future__ import annotations

import csv
import io
import json as json_format
import re
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Shaped
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from pipelines.commands.options import OptionalPath, OptionalText, frame_numbers
from smplxpp.core import GeometryWarning, InputError, as_mesh, require_at_least
from smplxpp.core.files.array_file import read_array, read_arrays
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.mesh_files.mesh_io import MeshFile, read_mesh
from smplxpp.metrics import CompareConfig, MeshComparison, compare, doubtful_pair, presets

# A folder's frames are its geometry files; arrays (which also hold labels) only where there is nothing else.
FRAME_SUFFIXES = ((".ply", ".obj", ".glb", ".gltf", ".stl", ".off"), (".pkl",), (".npz",))
LABEL_KEYS = ("face_labels", "vertex_labels", "labels", "label")
Preset = Literal["smplxpp", "pifuhd-cm", "icon-cm", "now-mm", "occnet-l1", "occnet-l2", "pytorch3d"]


@dataclass(frozen=True)
class Metrics:
    """Distances between a predicted and a true surface: P2S, Chamfer, p95, Hausdorff, normals, F-score, per label."""

    a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="A")]
    """The predicted mesh, or a folder of frames."""
    b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="B")]
    """The true mesh, or a folder of frames, matched with those of A by name or else by frame number."""
    frames: OptionalText = None
    """Frames of two folders to compare, by the last number of their names: numbers and ranges START:STOP:STEP with
    commas; by default all."""
    samples: int = 100_000
    """Points taken of each mesh, area-weighted."""
    seed: int = 0
    """Seed of the points: the same seed gives the same numbers, bit for bit."""
    preset: Preset = "smplxpp"
    """Definition of P2S and Chamfer, which the output states. All other distances are in mm."""
    visible_only: bool = False
    """Measure from the outer surface of each mesh alone: skin hidden under clothes is left out."""
    threshold_mm: tuple[float, ...] = (5.0,)
    """Distances within which a point counts for precision, recall and F-score, one or several."""
    units: Literal["m", "cm", "mm"] = "m"
    """Units of both meshes' coordinates."""
    labels_a: OptionalPath = None
    """Labels of A's faces or vertices (.npy, or .npz with face_labels, vertex_labels, labels or label), 0 skin, 1 hair,
    2 shoe, 3 upper, 4 lower, 5 outer, 6 object; or a folder of them. Without it, a PLY property `label` counts."""
    labels_b: OptionalPath = None
    """Labels of B, given in the same ways."""
    out: OptionalPath = None
    """Write the result there as well: .json (all of it) or .csv (a row a frame)."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> dict[str, Any]:
        """Compare, print a table unless `json`, write `out`; returns what the JSON holds.

        Raises:
            InputError: missing paths, a file against a folder, no frame that could be compared.
        """
        if self.out is not None and self.out.suffix.lower() not in (".json", ".csv"):
            raise InputError("output file", expected=".json or .csv", received=str(self.out))
        require_at_least("option seed", self.seed, 0)
        pairs, skipped = pair_frames(self.a, self.b)
        wanted = frame_numbers(self.frames)
        if wanted is not None:
            numbers = {str(number).zfill(12) for number in wanted}
            pairs = [pair for pair in pairs if frame_number(pair[1]) in numbers]
            skipped = [one for one in skipped if frame_number(Path(one["frame"])) in numbers]
        # Compare pair by pair; the progress bar is of use for folders only.
        frames = []
        console = Console(stderr=True)
        hidden = self.json or len(pairs) == 1
        for name, a, b in track(pairs, "comparing", console=console, transient=True, disable=hidden):
            try:
                start = time.perf_counter()
                result = self._compare(a, b)
            except (InputError, OSError) as error:
                # One bad frame among thousands is named and left out; a single pair is the user's whole question.
                if not self.a.is_dir():
                    raise
                skipped.append({"frame": name, "reason": str(error)})
                continue
            seconds = time.perf_counter() - start
            frames.append({"frame": name, "a": str(a), "b": str(b), "seconds": seconds, **result.as_dict()})
        if not frames:
            raise InputError(
                f"folders {self.a} and {self.b}",
                expected="at least one frame that can be compared",
                received="; ".join(f"{s['frame']}: {s['reason']}" for s in skipped[:3]) or "no frames",
            )
        report = self._report(frames, skipped)
        if self.out is not None:
            # JSON holds the whole report, CSV one flat row for each frame.
            as_csv = self.out.suffix.lower() == ".csv"
            atomic_write_text(self.out, _csv(frames) if as_csv else json_format.dumps(report, indent=1) + "\n")
        if not self.json:
            _print(report, Console())
        return report

    def _compare(self, path_a: Path, path_b: Path) -> MeshComparison:
        plausible_metres = 20.0  # bounding-box diagonal above which the units are probably wrong
        meshes, labels = [], []
        for path, given in ((path_a, self.labels_a), (path_b, self.labels_b)):
            # Convert to metres, the unit of all metrics.
            file = read_mesh(path)
            mesh = as_mesh(file.mesh, unit=self.units)
            if mesh.bbox_diagonal > plausible_metres:
                warnings.warn(
                    f"{path} is {mesh.bbox_diagonal:.0f} m across: are its units {self.units}? See --units",
                    GeometryWarning,
                    stacklevel=2,
                )
            meshes.append(mesh)
            labels.append(_labels(file, given, path))
        warning = doubtful_pair(*meshes)
        if warning:
            warnings.warn(f"{path_a.name}, {path_b.name}: {warning}", GeometryWarning, stacklevel=2)
        return compare(
            *meshes,
            samples=self.samples,
            seed=self.seed,
            preset=self.preset,
            pred_labels=labels[0],
            gt_labels=labels[1],
            config=CompareConfig(threshold_mm=self.threshold_mm, visible_only=self.visible_only, certified=True),
        )

    def _report(self, frames: list[dict[str, Any]], skipped: list[dict[str, str]]) -> dict[str, Any]:
        convention = presets()[self.preset]
        return {
            "preset": convention.name,
            "unit": convention.unit,
            "definition": convention.definition,
            "source": convention.source,
            "samples": self.samples,
            "seed": self.seed,
            "threshold_mm": list(self.threshold_mm),
            "visible_only": self.visible_only,
            "frames": frames,
            "over_frames": over_frames(frames),
            "skipped": skipped,
        }


def over_frames(frames: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return mean, deviation and count of each number over frames; those that a frame lacks are left out."""
    rows = [flat_row(frame) for frame in frames]
    keys = dict.fromkeys(key for row in rows for key in row)
    known = {key: [row[key] for row in rows if row.get(key) is not None] for key in keys}
    return {
        key: {"mean": float(np.mean(values)), "std": float(np.std(values)), "count": len(values)}
        for key, values in known.items()
        if values and key != "frame"
    }


def pair_frames(a: Path, b: Path) -> tuple[list[tuple[str, Path, Path]], list[dict[str, str]]]:
    """Return pairs (name, file of A, file of B), and the frames without a partner as {"frame", "reason"}.

    Two files are one pair. Two folders pair files of the same stem, or, where no stem occurs in both, files whose names
    end in the same number.

    Raises:
        InputError: a path does not exist, one is a file and the other a folder, or two files of a folder collide.
    """
    for path in (a, b):
        if not path.exists():
            raise InputError("input", expected="an existing file or folder", received=str(path))
    if a.is_dir() != b.is_dir():
        raise InputError("inputs", expected="two files or two folders", received=f"{a} and {b}")
    if not a.is_dir():
        return [(a.stem, a, b)], []
    # Equal stems are the safest match; otherwise the frame numbers at the names' ends decide.
    files = [_frames(a), _frames(b)]
    stems = [{f.stem for f in found} for found in files]
    key = attrgetter("stem") if stems[0] & stems[1] else frame_number
    keyed = [_by_key(found, key, folder) for found, folder in zip(files, (a, b), strict=True)]
    common = sorted(keyed[0].keys() & keyed[1].keys())
    pairs = [(keyed[0][k].stem, keyed[0][k], keyed[1][k]) for k in common]
    # Frames without a partner are reported, not dropped in silence.
    skipped = [
        {"frame": path.name, "reason": f"no partner in {other}"}
        for own, theirs, other in ((0, 1, b), (1, 0, a))
        for k, path in sorted(keyed[own].items())
        if k not in keyed[theirs]
    ]
    return pairs, skipped


def frame_number(path: Path) -> str:
    """Return the last run of digits in a file's stem without leading zeros, or the stem where it has none."""
    digits = re.findall(r"\d+", path.stem)
    return str(int(digits[-1])).zfill(12) if digits else path.stem


def flat_row(frame: dict[str, Any]) -> dict[str, Any]:
    """Return one frame's numbers by flat name: `p2s`, `pred_to_gt.p95`, `upper.chamfer`, ..."""
    row = {"frame": frame["frame"]}
    for prefix, result in [("", frame), *((f"{name}.", r) for name, r in frame["labels"].items())]:
        for key in ("p2s", "chamfer", "hausdorff", "hausdorff_upper", "precision", "recall", "fscore"):
            row[prefix + key] = result[key]
        for scores in result["scores"]:
            row[f"{prefix}fscore@{scores['threshold_mm']:g}mm"] = scores["fscore"]
        # Normals are read for both directions together.
        for key in ("normal_angle_deg", "normal_consistency"):
            values = [(result[side] or {}).get(key) for side in ("pred_to_gt", "gt_to_pred")]
            known = [value for value in values if value is not None]
            row[prefix + key] = float(np.mean(known)) if len(known) == 2 else None
        for direction in ("pred_to_gt", "gt_to_pred"):
            for key, value in (result[direction] or {}).items():
                row[f"{prefix}{direction}.{key}"] = value
    return row


def _frames(folder: Path) -> list[Path]:
    """List the files of a folder that are frames."""
    for suffixes in FRAME_SUFFIXES:
        found = sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in suffixes)
        if found:
            return found
    raise InputError(f"folder {folder}", expected="mesh files", received="none")


def _by_key(files: list[Path], key: Callable[[Path], str], folder: Path) -> dict[str, Path]:
    keyed: dict[str, Path] = {}
    for path in files:
        other = keyed.setdefault(key(path), path)
        if other is not path:
            raise InputError(
                f"folder {folder}",
                expected="one file a frame",
                received=f"{other.name} and {path.name}",
                remedy="give the files of both folders the same names",
            )
    return keyed


def _labels(file: MeshFile, given: Path | None, mesh_path: Path) -> Shaped[np.ndarray, " N"] | None:
    """Return the labels of faces or vertices, from their own file or the mesh's; None where there are none."""
    if given is None:
        properties = {**file.vertex_properties, **file.face_properties}
        stored = next((properties[k] for k in ("label", "labels") if k in properties), None)
        # PLY files often store labels as floats.
        whole = stored is not None and np.array_equal(stored, np.round(stored))
        return stored.astype(np.int64) if stored is not None and whole else None
    # A folder of label files is matched to the meshes by frame number.
    if given.is_dir():
        same = [
            p
            for p in sorted(given.iterdir())
            if p.suffix in (".npz", ".npy") and frame_number(p) == frame_number(mesh_path)
        ]
        if len(same) != 1:
            raise InputError(
                f"labels of {mesh_path.name}", expected=f"one .npz or .npy in {given}", received=f"{len(same)}"
            )
        given = same[0]
    if given.suffix.lower() == ".npy":
        return read_array(given, subject="label file")
    data = read_arrays(given, subject="label file")
    key = next((k for k in LABEL_KEYS if k in data), None)
    if key is None:
        raise InputError(f"label file {given}", expected=f"a key of {LABEL_KEYS}", received=str(sorted(data)))
    return data[key]


def _csv(frames: list[dict[str, Any]]) -> str:
    rows = [flat_row(frame) for frame in frames]
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(dict.fromkeys(k for row in rows for k in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _print(report: dict[str, Any], console: Console) -> None:
    unit, frames = report["unit"], report["frames"]
    single = len(frames) == 1
    # Column titles with the key of `flat_row` that each shows.
    columns = {
        f"P2S\n{unit}": "p2s",
        f"Chamfer\n{unit}": "chamfer",
        "A->B\nmean": "pred_to_gt.mean",
        "A->B\np95": "pred_to_gt.p95",
        "B->A\nmean": "gt_to_pred.mean",
        "B->A\np95": "gt_to_pred.p95",
        "Hausd.\n>=": "hausdorff",
        "Hausd.\n<=": "hausdorff_upper",
        "norm.\ndeg": "normal_angle_deg",
        "norm.\n|cos|": "normal_consistency",
        **{f"F\n{threshold:g} mm": f"fscore@{threshold:g}mm" for threshold in report["threshold_mm"]},
    }
    # A narrow terminal gets two tables, because numbers that are folded cannot be read.
    names = list(columns)
    groups = [names] if console.width > 100 else [names[:8], names[8:]]
    tables = []
    for group in groups:
        table = Table(padding=(0, 1 if console.width > 100 else 0))
        table.add_column("frame", no_wrap=True, min_width=9)
        for name in group:
            table.add_column(name, justify="right", overflow="fold")  # a number cut short is another number
        tables.append(table)

    def add(name: str, values: dict[str, Any], *, style: str | None = None, end_section: bool = False) -> None:
        for table, group in zip(tables, groups, strict=True):
            cells = ["-" if (value := values.get(columns[key])) is None else _short(value) for key in group]
            table.add_row(name, *cells, style=style, end_section=end_section)

    # A single pair also lists its labels; many frames list them under the mean.
    for frame in frames:
        row = flat_row(frame)
        add(frame["frame"], row, end_section=frame is frames[-1])
        if single:
            for label in frame["labels"]:
                add(f"  {label}", {k.removeprefix(f"{label}."): v for k, v in row.items() if k.startswith(f"{label}.")})
    if not single:
        labels = list(dict.fromkeys(label for frame in frames for label in frame["labels"]))
        for statistic in ("mean", "std"):
            values = {key: s[statistic] for key, s in report["over_frames"].items()}
            add(statistic, values, style="bold")
            if statistic == "mean":
                for label in labels:
                    start = f"{label}."
                    add(f"  {label}", {k.removeprefix(start): v for k, v in values.items() if k.startswith(start)})
    console.print(f"{report['preset']}: {report['definition']}", style="italic")
    for table in tables:
        console.print(table)
    console.print(
        "A->B: from A to the surface of B, mm; Hausdorff >=: samples and vertices, <=: certified bound, mm; "
        "norm.: angle of the normals and mean |cos|, both ways; F: F-score at the threshold"
    )
    for entry in report["skipped"]:
        console.print(f"[yellow]skipped[/] {escape(str(entry['frame']))}: {escape(entry['reason'])}", soft_wrap=True)


def _short(value: float) -> str:
    """Return a number in four digits, whole below a million, else in two digits with an exponent: seven characters."""
    text = f"{value:.0f}" if 1e4 <= abs(value) < 1e6 else f"{value:.4g}"
    return f"{value:.1e}" if "e" in text else text
