"""Places on the body are continuous, go on between the body's vertices, and leave out hands that are hidden."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core import BodyParams, TriangleMesh, concatenate_meshes
from smplxpp.segment.by_body_chart import HAND, LEG, TRUNK, chart_of_body, chart_of_scan, settled_body


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


def test_a_hand_under_a_cape_has_no_faces_and_a_bare_one_keeps_its_own():
    """The corner of a jacket behind a hand in a pocket was that hand's skin, and the jacket lost it."""
    body = load_body()
    pose = np.zeros((1, body.joint_count, 3))
    pose[0, body.joint_names.index("left_shoulder"), 2] = -np.radians(75.0)
    params = BodyParams.from_full_pose(
        pose, betas=np.zeros(body.num_betas), expression=np.zeros(body.num_expressions), transl=np.zeros(3)
    )
    skin = body.mesh(body.forward(params).vertices[0])
    own = chart_of_body(body, params)
    hand = (own.region == HAND) & (own.side == 1)
    # A cape from the shoulder to the knee, wide enough for the hanging hand; the other hand is stretched out of it.
    low, high = skin.vertices[own.height < 0.5, 1].max(), skin.vertices[:, 1].max() - 0.25
    turn, up = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False), np.linspace(low, high, 60), indexing="ij")
    wide = skin.vertices[hand, 0].max() + 0.04
    points = np.stack([wide * np.sin(turn), up, 0.3 * np.cos(turn)], axis=-1).reshape(-1, 3)
    corner = np.arange(96 * 60).reshape(96, 60)
    a, b = corner[:, :-1], np.roll(corner, -1, axis=0)[:, :-1]
    faces = np.concatenate([np.stack([a, b, b + 1], -1), np.stack([a, b + 1, a + 1], -1)]).reshape(-1, 3)
    right = ((own.region == HAND) & (own.side == -1))[skin.faces].all(axis=1)
    under = concatenate_meshes([TriangleMesh(points, faces), TriangleMesh(skin.vertices, skin.faces[right])])
    found = chart_of_scan(under, body, params)
    bare = chart_of_scan(skin, body, params)
    assert not ((found.region == HAND) & (found.side == 1)).any()
    assert (found.region[len(faces) :] == HAND).mean() > 0.95
    assert (bare.region[hand[skin.faces].all(axis=1)] == HAND).mean() > 0.95


@pytest.mark.long
def test_limbs_that_a_fit_turned_lie_within_their_clothes_again():
    """With joints off by 2 degrees limbs lay 3 cm off their cloth on one side, and bare skin was taken for a shirt."""
    body, rng = load_body(), np.random.default_rng(3)
    pose = np.zeros((1, body.joint_count, 3))
    right = BodyParams.from_full_pose(
        pose, betas=np.zeros(body.num_betas), expression=np.zeros(body.num_expressions), transl=np.zeros(3)
    )
    pose[0, 1:22] = np.radians(2.0) * rng.normal(size=(21, 3))
    turned = BodyParams.from_full_pose(
        pose, betas=right.betas[0], expression=right.expression[0], transl=np.array([0.01, -0.004, 0.008])
    )
    # A jacket of 15 mm over the trunk and trousers of 8 mm; the rest is bare.
    bare = body.mesh(body.forward(right).vertices[0])
    own = chart_of_body(body, right)
    thick = np.where(own.region == TRUNK, 0.015, np.where(own.region == LEG, 0.008, 0.0))
    scan = bare.with_vertices(bare.vertices + thick[:, None] * bare.vertex_normals)

    def misses(vertices: np.ndarray) -> np.ndarray:
        return np.abs(np.einsum("ij,ij->i", vertices - bare.vertices, bare.vertex_normals))

    before, after = misses(body.forward(turned).vertices[0]), misses(settled_body(scan, body, turned).vertices)
    assert before.mean() > 0.006 and after.mean() < 0.4 * before.mean()
    # A body that lies right stays, within a fifth of the jacket's thickness.
    assert misses(settled_body(scan, body, right).vertices).mean() < 0.003
