"""The fixture person from her files: no base mesh, no maker's extra."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipelines.synth.outfits import with_trousers
from pipelines.synth.person import PART_NAMES, PERSON_BETAS, Person, face_marks
from smplxpp.body import load_body
from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import read_arrays
from smplxpp.core.mesh import TriangleMesh

_NEEDED = ("v_tpose", "faces", "face_part", "vertex_part", "vertex_label", "weights", "betas", "part_names")


def load_person(topology_file: Path, clothes: str = "skirt") -> Person:
    """Read `geometry/topology.npz` of the fixture, and dress her.

    Raises:
        InputError: no such file, keys missing, or other parts than the fixture person's.
    """
    return person_of(read_layers(topology_file, clothes), clothes)


def read_layers(topology_file: Path, clothes: str = "skirt") -> dict[str, np.ndarray]:
    """Read the arrays of `geometry/topology.npz`, with the clothes that she wears.

    Raises:
        InputError: no such file, keys missing, or other parts than the fixture person's.
    """
    if not topology_file.is_file():
        raise InputError(
            "person",
            expected="a file geometry/topology.npz of the fixture person",
            received=str(topology_file),
            remedy="run in a checkout, or name the folder with --person",
        )
    arrays = read_arrays(topology_file, subject="person")
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise InputError(f"file {topology_file}", expected=f"the key {missing[0]}", received=", ".join(arrays))
    parts = tuple(arrays["part_names"].tolist())
    if parts != PART_NAMES:
        raise InputError(f"file {topology_file}", expected=f"parts {PART_NAMES}", received=str(parts))
    return arrays if clothes == "skirt" else with_trousers(arrays, load_body())


def person_of(arrays: dict[str, np.ndarray], clothes: str = "skirt") -> Person:
    """Make the person of the arrays of `read_layers`."""
    return Person(
        tpose=TriangleMesh(arrays["v_tpose"], arrays["faces"]),
        weights=arrays["weights"].astype(np.float64),
        vertex_part=arrays["vertex_part"],
        face_part=arrays["face_part"],
        vertex_label=arrays["vertex_label"],
        betas=arrays["betas"].astype(np.float64),
        body=load_body(),
        face=face_marks(face_landmarks()),
        clothes=clothes,
    )


def face_landmarks(betas: Float[np.ndarray, " B"] = PERSON_BETAS) -> Float[np.ndarray, "51 3"]:
    """Return the face landmarks on the open body's T-pose, by default at the person's shape; dlib's order from 17."""
    with resources.as_file(resources.files("smplxpp") / "data" / "open_body.npz") as path:
        data = read_arrays(path, subject="open body")
    shaped = data["v_template"] + data["shapedirs"][..., : len(betas)] @ betas
    corners = shaped[data["f"][data["lmk_faces_idx"]]]
    return np.einsum("lk,lkx->lx", data["lmk_bary_coords"], corners)
