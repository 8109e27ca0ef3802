"""Places on the body are continuous: they go on between the body's vertices."""

from __future__ import annotations

import numpy as np

from smplxpp.body import load_body
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.segment.by_body_chart import LEG, chart_of_body, chart_of_scan


def test_heights_go_on_between_the_vertices_of_a_shin():
    """Clothes 20 mm off the body: the heights of their corners, from the centres of small faces about them."""
    body = load_body()
    params = BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions)
    skin = body.mesh(body.forward(params).vertices[0])
    own = chart_of_body(body, params)
    legs = np.flatnonzero((own.region[skin.faces] == LEG).all(axis=1) & (own.height[skin.faces] < 0.4).all(axis=1))
    # The middle of each edge, 20 mm outside, carries the mean height of its two ends.
    a, b = skin.faces[legs][:, [0, 1, 2]].ravel(), skin.faces[legs][:, [1, 2, 0]].ravel()
    normal = skin.vertex_normals[a] + skin.vertex_normals[b]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    middle = 0.5 * (skin.vertices[a] + skin.vertices[b]) + 0.02 * normal
    # Small faces there, whose normals are the body's.
    side = np.cross(normal, [1.0, 0.3, 0.2])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(normal, side)
    corners = np.stack([middle + 1e-4 * side, middle + 1e-4 * up, middle - 1e-4 * (side + up)], axis=1)
    cloth = TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(middle)).reshape(-1, 3))
    found = chart_of_scan(cloth, body, params)
    true = 0.5 * (own.height[a] + own.height[b])
    error = np.abs(found.height - true)
    ends = 0.5 * np.abs(own.height[a] - own.height[b])  # what the nearest end alone leaves
    assert np.median(error) < 0.0015 < np.median(ends)
    assert np.percentile(error, 95) < 0.006 < np.percentile(ends, 95)
