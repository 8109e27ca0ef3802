"""The gate of worn poses: trousers that stay behind a seated person are seen before anything is trained."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.build.validate import worn_checks
from smplxpp.core import SkinWeights
from smplxpp.people.garments.draped import draped_garments
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.template.template import Template


@pytest.fixture(scope="module")
def hakama():
    body = load_body()
    mannequin = Mannequin.of(body, np.zeros(body.num_betas))
    return mannequin, next(g for g in draped_garments(mannequin) if g.name == "hakama").cloth


def worn(mannequin: Mannequin, cloth, weights: np.ndarray) -> Template:
    """A template of the naked body in this garment."""
    body = mannequin.body
    skin = body.forward(mannequin.params).vertices[0]
    n, m = len(skin), len(cloth.vertices)
    return Template(
        body=body,
        vertices=np.concatenate([skin, cloth.vertices]),
        faces=np.concatenate([body.faces, cloth.faces + n]),
        vertex_labels=np.repeat([0, 4], [n, m]),
        vertex_part=np.repeat([0, 1], [n, m]),
        part_names=("body", "lower"),
        vertex_colors=np.full((n + m, 3), 200),
        weights=SkinWeights.from_dense(np.concatenate([body.weights, weights]), max_influences=8),
        betas=np.zeros(body.num_betas),
        body_index=np.concatenate([np.arange(n), np.zeros(m)]),
        scan_index=np.full(n + m, -1),
    )


@pytest.mark.long
def test_a_hakama_that_stays_with_the_waist_fails_and_one_that_sits_down_passes(hakama):
    mannequin, cloth = hakama
    right, _ = worn_checks(worn(mannequin, cloth, cloth.weights), mannequin.params)
    stays = cloth.vertices[:, 1] < mannequin.joints["left_knee"][1]
    wrong = np.where(stays[:, None], mannequin.rigid("pelvis", len(stays)), cloth.weights)
    left_behind, numbers = worn_checks(worn(mannequin, cloth, wrong), mannequin.params)
    status = {name: check.status for name, check in zip(("right", "wrong"), (right[0], left_behind[0]), strict=True)}
    assert status == {"right": "pass", "wrong": "fail"}
    assert numbers["lower"]["sit: rings off their limb, mm"] > 200
    assert numbers["lower"]["reach: rings off their limb, mm"] < 5  # the legs do not move there


@pytest.mark.long
def test_faces_in_the_body_are_counted_by_pose(hakama):
    """A garment shrunk to the axis of the legs lies within the thighs in every pose."""
    mannequin, cloth = hakama
    inside = mannequin.joints["left_hip"] + [0.0, -0.2, 0.0]
    tiny = cloth.with_vertices(inside + 0.02 * (cloth.vertices - inside))
    _, numbers = worn_checks(worn(mannequin, tiny, mannequin.rigid("left_hip", len(cloth.vertices))), mannequin.params)
    assert min(value for key, value in numbers["lower"].items() if key.endswith("body")) > 0.9
