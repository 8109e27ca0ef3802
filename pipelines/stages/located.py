"""What the stage that finds the body in a scan leaves for a registration: a place to begin, and where skin is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64

from pipelines.runs.artefacts import read_named, values_of
from smplxpp.body import BodyModel, load_params
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams

PARAMS_FILE, LABELS_FILE = "params.npz", "labels.npz"
LOCATED_FILES = (PARAMS_FILE, LABELS_FILE)


def write_located(
    folder: Path, params: BodyParams, labels: Int64[np.ndarray, " N"], bare: Bool[np.ndarray, " V"]
) -> None:
    """Keep one row of parameters, what is sure of the scan's vertices (-1: not sure), and the body's bare vertices."""
    params.save(folder / PARAMS_FILE)
    np.savez(folder / LABELS_FILE, labels=labels, bare=bare)


def read_located(folder: Path, body: BodyModel) -> tuple[BodyParams, Bool[np.ndarray, " V"]]:
    """The parameters, and the body's vertices that are bare.

    Raises:
        InputError: files of another version, or of another body.
    """
    (bare,) = read_named(folder / LABELS_FILE, "bare")
    with values_of(folder / LABELS_FILE):
        if bare.shape != (body.vertex_count,):
            raise InputError("bare", expected=f"shape ({body.vertex_count},)", received=f"shape {bare.shape}")
        return load_params(folder / PARAMS_FILE, body=body), bare.astype(bool)


def read_located_labels(folder: Path, vertices: int) -> Int64[np.ndarray, " N"] | None:
    """Labels of the scan's vertices, -1 where they are not sure; None where it was another scan."""
    (labels,) = read_named(folder / LABELS_FILE, "labels")
    return labels.astype(np.int64) if labels.shape == (vertices,) else None
