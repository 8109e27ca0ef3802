"""Skin-weight transfer on garments that no setting was made for: weights and driven positions against authored ones.

    python -m benchmarks.transfer_garments [--peer CHECKOUT] [--no-store]

26 garments are made by procedure on the open body, three persons of other shapes each, in the T-pose and, with a scan's
noise and simplified, in an A-pose and with the arms as low as they come before a hand touches the cloth
(`benchmarks.garments`). Their weights are painted by rules in the garments' own coordinates, none of which is a method
compared here; what lies on the skin keeps the weights of the skin that it was grown from. Weights are transferred from
the posed body, the garment is unposed with them and driven to the stress poses; errors are distances in mm to the same
garment driven by its authored weights.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.driving import nearest_point, nearest_vertex
from benchmarks.garments.wardrobe import SHAPES, Case, cases
from benchmarks.machine import store_results
from smplxpp.body import load_body
from smplxpp.body.model import BodyModel
from smplxpp.body.stress_poses import stress_poses
from smplxpp.core.errors import GeometryWarning
from smplxpp.core.mesh import TriangleMesh
from smplxpp.skinning import UnposeConfig, skin, unpose
from smplxpp.transfer import TransferConfig, transfer_weights

_ANY_DETERMINANT = UnposeConfig(warn_below=-np.inf, fail_below=-np.inf)  # baselines may fold a vertex: measure it

Method = Callable[[TriangleMesh, np.ndarray, TriangleMesh, str], np.ndarray]


def judge(body: BodyModel, case: Case, dense: np.ndarray) -> dict[str, np.ndarray]:
    """Per vertex: total variation of the weights, and driven errors (4 poses x N) in mm."""
    reference = body.forward(case.params).posed_from_rest[0]
    rest = unpose(case.mesh.vertices, dense, reference, config=_ANY_DETERMINANT).vertices
    true_rest = unpose(case.mesh.vertices, case.weights, reference, config=_ANY_DETERMINANT).vertices
    transforms = body.forward(stress_poses(replace(case.params, transl=np.zeros((1, 3))))).posed_from_rest
    errors = [1e3 * np.linalg.norm(skin(rest, dense, g) - skin(true_rest, case.weights, g), axis=1) for g in transforms]
    return {"tv": 0.5 * np.abs(dense - case.weights).sum(axis=1), "mm": np.array(errors)}
