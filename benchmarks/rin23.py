"""Runs the user's checkout of github.com/rin-23/RobustSkinWeightsTransferCode on today's libigl."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import igl
import numpy as np
import scipy.sparse as sp

from smplxpp.core.mesh import TriangleMesh


class _Igl:
    """libigl 2.6 under the names and signatures that the peer was written for; everything else passes through."""

    def __getattr__(self, name: str):
        return getattr(igl, name)

    @staticmethod
    def barycentric_coordinates_tri(p, a, b, c):
        return igl.barycentric_coordinates(*(np.ascontiguousarray(x) for x in (p, a, b, c)))

    @staticmethod
    def min_quad_with_fixed(q, b, known, values, _aeq, _beq, definite):
        n, columns = b.shape
        empty = sp.csc_matrix((0, n)), np.zeros((0, columns))
        return True, igl.min_quad_with_fixed(sp.csc_matrix(q), b, known, values, *empty, definite)


def load_peer(checkout: Path) -> ModuleType:
    """The peer's `src/utils.py` as a module."""
    spec = importlib.util.spec_from_file_location("rin23_utils", checkout / "src" / "utils.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.igl = _Igl()
    return module


def run_peer(
    peer: ModuleType, source: TriangleMesh, weights: np.ndarray, target: TriangleMesh
) -> tuple[np.ndarray, np.ndarray]:
    """Its matching and inpainting as its example calls them, thresholds included.

    Returns:
        (N, J) its weights as they come, (N,) matched.
    """
    v1, f1, v2, f2 = (np.array(x) for x in (source.vertices, source.faces, target.vertices, target.faces))
    n1, n2 = igl.per_vertex_normals(v1, f1), igl.per_vertex_normals(v2, f2)
    limit = (0.05 * igl.bounding_box_diagonal(v2)) ** 2
    matched, copied = peer.find_matches_closest_surface(v1, f1, n1, v2, f2, n2, weights, limit, 30)
    result, _ = peer.inpaint(v2, f2, copied, matched)
    return np.asarray(result), matched


def smooth_as_peer(peer: ModuleType, target: TriangleMesh, weights: np.ndarray, matched: np.ndarray) -> np.ndarray:
    """(N, J) its smoothing, the optional last step of its example, with the example's settings."""
    limit = 0.05 * igl.bounding_box_diagonal(np.array(target.vertices))
    smoothed, _ = peer.smooth(
        target.vertices, target.faces, weights, matched, limit, num_smooth_iter_steps=10, smooth_alpha=0.2
    )
    return smoothed
