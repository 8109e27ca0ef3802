import numpy as np
import pytest

from smplxpp.core.mesh import TriangleMesh
from smplxpp.reconstruct import SweepLevel
from smplxpp.reconstruct.hull import zero_surface
from smplxpp.reconstruct.photographs import Pyramids, sight
from smplxpp.reconstruct.sweep import (
    PatchConfig,
    mean_of_neighbours,
    refine_surface,
    smooth_normals,
    sparse_laplacian,
    sweep_scores,
    taubin,
)
from tests.reconstruct.scene import BOX, inside_ball, inside_dented, photograph, ring

LEVEL = SweepLevel(0.1, 0.01, 0.005, 0.06)


@pytest.fixture(scope="module")
def ball():
    return zero_surface(inside_ball, BOX, cell=0.04)


@pytest.fixture(scope="module")
def photographs():
    mesh = zero_surface(inside_ball, BOX, cell=0.0125)
    return Pyramids.of([photograph(mesh, camera, "") for camera in ring()])


def everywhere(points):
    return np.ones(len(points), np.float32)


def test_the_agreement_is_best_where_the_surface_is(ball, photographs):
    normals = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    seen = sight(ball, normals, photographs.cameras)
    offsets = np.array([-0.04, -0.02, 0.0, 0.02, 0.04])
    scores = sweep_scores(ball.vertices, normals, seen, photographs, offsets, PatchConfig())
    watched = (seen.cosine > 0.3).sum(axis=1) >= 2
    assert watched.mean() > 0.9
    assert (scores[watched].argmax(axis=1) == 2).mean() > 0.95
    assert scores[watched, 2].mean() > 0.8
    assert (scores[~watched] == -1).all()
    assert scores.max() <= 1.0


def test_an_exposure_changes_no_agreement(ball, photographs):
    from dataclasses import replace

    normals = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    seen = sight(ball, normals, photographs.cameras)
    dim = photographs.values.reshape(-1, 4) * np.array([0.5, 0.5, 0.5, 1], np.float32)
    found = [
        sweep_scores(ball.vertices, normals, seen, one, np.zeros(1), PatchConfig())
        for one in (photographs, replace(photographs, values=dim.ravel()))
    ]
    assert found[1] == pytest.approx(found[0], abs=0.02)


@pytest.mark.long
def test_the_search_finds_a_dent_that_no_silhouette_shows():
    ball = zero_surface(inside_ball, BOX, cell=0.02)
    truth = zero_surface(inside_dented, BOX, cell=0.0125)
    pyramids = Pyramids.of([photograph(truth, camera, "") for camera in ring()])
    found = refine_surface(ball, pyramids, LEVEL, everywhere, most_views=6, smoothness=0.3)
    before, after = (np.abs(inside_dented(v)) for v in (ball.vertices, found.vertices))
    dent = before > 0.02
    assert before[dent].mean() > 0.04 and after[dent].mean() < 0.15 * before[dent].mean()
    assert after[~dent].mean() < 0.001


@pytest.mark.long
def test_without_texture_the_surface_stays(ball):
    truth = zero_surface(inside_dented, BOX, cell=0.0125)
    pyramids = Pyramids.of([photograph(truth, camera, "", plain=True) for camera in ring(8)])
    found = refine_surface(ball, pyramids, LEVEL, everywhere, most_views=6, smoothness=0.3)
    assert np.abs(found.moved).max() < 1e-4


def test_the_surface_does_not_leave_the_silhouettes(ball, photographs):
    small = TriangleMesh(0.95 * ball.vertices, ball.faces)
    level = SweepLevel(0.01, 0.04, 0.005, 0.06)
    free = refine_surface(small, photographs, level, everywhere, most_views=6, smoothness=0.3)
    held = refine_surface(
        small, photographs, level, lambda p: 0.95 * 0.5 - np.linalg.norm(p, axis=1), most_views=6, smoothness=0.3
    )
    assert np.linalg.norm(free.vertices, axis=1).mean() > 0.49
    assert np.linalg.norm(held.vertices, axis=1).max() < 0.48


def test_the_same_bits_for_any_number_of_threads(ball, photographs, monkeypatch):
    from smplxpp.reconstruct import sweep

    found = []
    for threads in (1, 3):
        monkeypatch.setattr(sweep, "thread_count", lambda threads=threads: threads)
        found.append(refine_surface(ball, photographs, LEVEL, everywhere, most_views=6, smoothness=0.3).vertices)
    assert (found[0] == found[1]).all()


def test_sight_counts_what_is_before(ball):
    cameras = ring(6)
    normals = smooth_normals(ball, mean_of_neighbours(ball))
    found = sight(ball, normals, cameras)
    for k, camera in enumerate(cameras):
        to = camera.position - ball.vertices
        facing = np.einsum("ij,ij->i", to, normals) / np.linalg.norm(to, axis=1)
        assert found.cosine[facing < -0.05, k].max() == 0
        assert (found.cosine[facing > 0.3, k] > 0).mean() > 0.99
    chosen = found.chosen(3, least_cosine=0.3)
    assert chosen.shape == (ball.vertex_count, 3)
    first = np.take_along_axis(found.cosine, np.maximum(chosen, 0), axis=1)
    assert (np.diff(np.where(chosen < 0, 0, first), axis=1) <= 1e-7).all()


def test_taubin_keeps_a_sphere_and_removes_noise(ball):
    noise = np.random.default_rng(0).normal(0, 0.004, ball.vertices.shape)
    mean = mean_of_neighbours(ball)
    assert np.asarray(mean.sum(axis=1)).ravel() == pytest.approx(1.0)
    assert np.abs(sparse_laplacian(ball) @ np.ones(ball.vertex_count)).max() < 1e-12
    smooth = taubin(ball.with_vertices(ball.vertices + noise), mean, steps=5)
    off = [np.abs(inside_ball(v)) for v in (ball.vertices + noise, smooth.vertices)]
    assert off[1].mean() < 0.5 * off[0].mean()
    assert np.linalg.norm(taubin(ball, mean, steps=5).vertices, axis=1) == pytest.approx(0.5, abs=0.002)


@pytest.mark.long
def test_coarser_patches_are_asked_where_fine_ones_convince_nobody_and_nowhere_else(ball, monkeypatch):
    from smplxpp.reconstruct import sweep

    above = [camera for camera in ring() if camera.position[1] > 0]  # nobody sees the bottom
    photographs = Pyramids.of([photograph(ball, camera, "") for camera in above])
    asked, whole = [], sweep.sweep_scores

    def counted(points, *rest):
        asked.append(len(points))
        return whole(points, *rest)

    monkeypatch.setattr(sweep, "sweep_scores", counted)
    level = SweepLevel(0.1, 0.01, 0.01, 0.06, (1.0, 2.0, 4.0))
    fine = refine_surface(
        ball, photographs, SweepLevel(0.1, 0.01, 0.01, 0.06), everywhere, most_views=6, smoothness=0.3
    )
    found = refine_surface(ball, photographs, level, everywhere, most_views=6, smoothness=0.3)
    assert asked[:2] == [ball.vertex_count] * 2
    assert len(asked) > 2 and max(asked[2:]) < ball.vertex_count
    sure = fine.agreement > 0.4
    assert 0.3 < sure.mean() < 0.95
    assert (found.agreement[sure] == fine.agreement[sure]).all()
