"""What confident vertices imply for the others, and when that replaces the body's weights."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer import TransferConfig, transfer_weights
from smplxpp.transfer.anchors import anchor_share, anchor_weights, turned_away

FAR = (0.1, 0.2)
SCARCE, ADMISSIBLE = 0.2, 0.9


@pytest.mark.parametrize(
    ("distance", "degrees", "admissible", "least", "most"),
    [
        (0.05, 0, ADMISSIBLE, 0.0, 0.0),
        (0.25, 0, ADMISSIBLE, 1.0, 1.0),
        (0.15, 0, ADMISSIBLE, 0.4, 0.6),
        (0.05, 0, 0.0, 1.0, 1.0),
        (0.05, 120, ADMISSIBLE, 0.0, 0.0),  # a lining: it faces away, and its anchor weights agree
        (0.05, 20, SCARCE, 0.0, 0.0),  # what it covers may contradict
        (0.05, 120, SCARCE, 0.7, 1.0),
        (0.0, np.nan, SCARCE, 0.0, 0.0),
    ],
)
def test_far_contradicted_and_isolated_vertices_take_the_anchor_weights(distance, degrees, admissible, least, most):
    share = anchor_share(np.array([distance]), np.radians([degrees]), np.array([admissible]), far=FAR)
    assert least <= share[0] <= most


def test_vertices_face_away_the_more_they_turn():
    away = turned_away(np.radians([0.0, 15.0, 30.0, 45.0, 180.0, np.nan]))
    assert (np.diff(away[:5]) >= 0).all()
    assert away[[0, 3, 4, 5]].tolist() == [0.0, 1.0, 1.0, 0.0]


def _strip(length: float = 1.0, count: int = 41) -> TriangleMesh:
    """A narrow sheet that hangs down from y = 0."""
    y = np.linspace(0.0, -length, count)
    points = np.stack(np.broadcast_arrays(np.array([-0.02, 0.02])[None, :], y[:, None], 0.0), axis=-1).reshape(-1, 3)
    a = 2 * np.arange(count - 1)
    faces = np.concatenate([np.stack([a, a + 2, a + 1], 1), np.stack([a + 1, a + 2, a + 3], 1)])
    return TriangleMesh(points, faces)


def test_a_short_anchor_length_keeps_what_the_waist_follows_where_a_long_one_continues_the_trend():
    """Known at the top: a share that grows downwards. Both keep it there; far below only the long length saturates."""
    mesh = _strip()
    known = mesh.vertices[:, 1] > -0.2
    share = np.clip(0.2 - 2.0 * mesh.vertices[:, 1], 0, 1)
    copied = np.where(known[:, None], np.stack([share, 1 - share], axis=1), [1.0, 0.0])
    short, long = (anchor_weights(mesh, copied, known, length=length, laplacian="cotangent") for length in (0.05, 1.0))
    hem = mesh.vertices[:, 1] < -0.9
    assert np.abs(short[known] - copied[known]).max() < 1e-9
    assert short[hem, 0].max() < 0.85 < long[hem, 0].min()
    assert np.allclose(short.sum(axis=1), 1)


def test_what_touches_a_limb_with_its_side_is_not_pinned_to_it():
    """A sheet over a plate that one joint moves; a plate of another joint stands on edge and touches the sheet."""
    plate = np.array([[-0.5, 0, -0.5], [-0.5, 0, 0.5], [0.5, 0, 0.5], [0.5, 0, -0.5]])
    side = np.array([[0.0, 0.012, -0.1], [0.0, 0.012, 0.1], [0.0, 0.4, 0.1], [0.0, 0.4, -0.1]])
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    source = TriangleMesh(np.concatenate([plate, side]), np.concatenate([quad, quad + 4]))
    weights = np.repeat(np.eye(2), 4, axis=0)
    x, z = np.meshgrid(np.linspace(-0.45, 0.45, 31), np.linspace(-0.45, 0.45, 31))
    points = np.stack([x, np.full_like(x, 0.012), z], axis=-1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(30), np.arange(30)))
    a = j * 31 + i
    sheet = TriangleMesh(
        points, np.concatenate([np.stack([a, a + 31, a + 1], 1), np.stack([a + 1, a + 31, a + 32], 1)])
    )
    followed = {
        turned: transfer_weights(source, weights, sheet, config=TransferConfig(turned=turned)).dense()[:, 1].max()
        for turned in (0.0, 0.04)
    }
    assert followed[0.04] < 0.1
    assert followed[0.04] <= followed[0.0]
