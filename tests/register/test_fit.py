"""Registrations of small scenes: what is found, from where, and what clothes may not do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core import SKIN, UPPER, BodyParams, InputError, TriangleMesh, rotvec_from_matrix
from smplxpp.register import BodyFit, Observations, RegisterConfig, ScanObservation, register, solver
from tests.register.people import disturbed, keypoints, masks, moving, ring, vertex_error_mm

BODY = load_body()
FRAMES = 6
SMALL = RegisterConfig(scan_samples=1500, rim_samples=1500, surface_steps=6)


@pytest.fixture(scope="module")
def person():
    return moving(BODY, FRAMES)


@pytest.fixture(scope="module")
def cameras():
    return ring(6)


@pytest.fixture(scope="module")
def exact(person, cameras) -> Observations:
    return Observations(tuple(range(FRAMES)), cameras, keypoints=keypoints(BODY, person, cameras), fps=20.0)


@pytest.fixture(scope="module")
def of_exact(exact) -> BodyFit:
    return register(BODY, exact, SMALL)


@pytest.fixture(scope="module")
def noisy(person, cameras) -> Observations:
    return Observations(tuple(range(FRAMES)), cameras, keypoints=keypoints(BODY, person, cameras, px=2.0), fps=20.0)


@pytest.fixture(scope="module")
def of_noisy(noisy) -> BodyParams:
    return register(BODY, noisy, SMALL).params


def test_exact_keypoints_give_the_pose(person, of_exact):
    fit = of_exact
    true, found = BODY.forward(person).joints, BODY.forward(fit.params).joints
    assert 1e3 * np.linalg.norm(true - found, axis=2).mean() < 4.0
    assert (fit.params.betas == fit.params.betas[0]).all()  # one shape
    assert fit.residuals["keypoints_px"].max() < 1.0
    assert not fit.initial_residuals and not fit.notes


@pytest.mark.long
def test_noisy_keypoints_and_masks(person, cameras, noisy, of_noisy):
    mask = masks(BODY, person, cameras)
    start = disturbed(person, degrees=2.0, metres=0.01, betas=0.3)
    both = register(BODY, replace(noisy, mask=lambda c, f: mask[c, f], initial=start), SMALL)
    assert vertex_error_mm(BODY, both.params, person) < vertex_error_mm(BODY, of_noisy, person) < 15.0
    assert np.nanmean(both.residuals["silhouette_px"]) < np.nanmean(both.initial_residuals["silhouette_px"])
    assert both.confidence.shape == (FRAMES, BODY.joint_count)
    assert (both.confidence[:, :22] > 0.5).all()


def degrees_away(fitted, true):
    """Mean angle of the body's joints between two fits."""
    a, b = (BODY.joint_rotations(params)[:, :22] for params in (fitted, true))
    return np.degrees(np.linalg.norm(rotvec_from_matrix(a.transpose(0, 1, 3, 2) @ b), axis=2)).mean()


@pytest.mark.long
def test_a_fit_beside_keypoints_tells_the_turns_that_they_do_not(person, noisy, of_noisy):
    starts = (disturbed(person, degrees=d, metres=0.01, betas=0.3) for d in (1.0, 15.0))
    helped, misled = (register(BODY, replace(noisy, initial=start), SMALL).params for start in starts)
    assert degrees_away(helped, person) < 0.7 * degrees_away(of_noisy, person)
    assert vertex_error_mm(BODY, misled, person) < 1.5 * vertex_error_mm(BODY, of_noisy, person)


@pytest.mark.long
def test_windows_join(exact, of_exact):
    """A take longer than the window is solved piece by piece and comes to the same."""
    pieces = register(BODY, exact, RegisterConfig(window=2, shape_frames=4))
    assert vertex_error_mm(BODY, pieces.params, of_exact.params) < 2.0


@pytest.mark.long
def test_chunks_of_one_shape_join(person, cameras):
    """Chunks of a take that get its shape need no shape of their own, and meet in the frames that both have."""
    seen = keypoints(BODY, person, cameras, px=1.0)
    observed = Observations(tuple(range(FRAMES)), cameras, keypoints=seen, fps=20.0)
    whole = register(BODY, observed, SMALL)
    chunks = [
        register(BODY, replace(observed, frames=frames, shape=whole.params.betas[0]), SMALL).params
        for frames in ((0, 1, 2, 3, 4), (1, 2, 3, 4, 5))
    ]
    assert all((one.betas == whole.params.betas[0]).all() for one in chunks)
    joined = BodyParams.concatenate([chunks[0].select([0, 1, 2]), chunks[1].select([2, 3, 4])])
    assert vertex_error_mm(BODY, joined, whole.params) < 2.0
    with pytest.raises(InputError, match="finite betas"):
        register(BODY, replace(observed, shape=np.full(BODY.num_betas, np.nan)), SMALL)


def test_same_bits_in_whatever_order_threads_take_the_frames(person, monkeypatch):
    two, cameras = person.select([0, 1]), ring(2, height=160)
    mask = masks(BODY, two, cameras)
    observed = Observations(
        (0, 1),
        cameras,
        keypoints=keypoints(BODY, two, cameras, px=1.0),
        mask=lambda c, f: mask[c, f],
        initial=disturbed(two, degrees=2.0, metres=0.01, betas=0.3),
    )
    config = RegisterConfig(rim_samples=300, joint_steps=4, surface_steps=2)
    first = register(BODY, observed, config).params
    taken: list[int] = []

    def from_the_last(work, items):
        taken.extend(reversed(items))
        return [work(item) for item in reversed(items)][::-1]

    monkeypatch.setattr(solver, "map_in_threads", from_the_last)
    second = register(BODY, observed, config).params
    assert taken[:2] == [1, 0]
    assert all((a == b).all() for a, b in zip(first.as_dict().values(), second.as_dict().values(), strict=True))


def dressed(person: BodyParams, standoff: float) -> ScanObservation:
    """A scan of the first frame: skin where it is bare, a wide shirt that stands off the trunk."""
    body_mesh = BODY.mesh(BODY.forward(person).vertices[0])
    names = np.array(BODY.joint_names)
    trunk = np.isin(np.argmax(BODY.weights, axis=1), np.flatnonzero([_of_trunk(n) for n in names]))
    vertices = body_mesh.vertices + standoff * trunk[:, None] * body_mesh.vertex_normals
    outer = BODY.part_labels == BODY.part_label_names.index("body")
    faces = BODY.faces[outer[BODY.faces].all(axis=1)]
    return ScanObservation(TriangleMesh(vertices, faces), np.where(trunk, UPPER.id, SKIN.id))


def _of_trunk(name: str) -> bool:
    return name == "pelvis" or name.startswith("spine") or name.endswith(("collar", "hip"))


@pytest.mark.long
def test_clothes_do_not_fatten_the_body(person):
    """Attracted both ways, a wide shirt pulls the body onto itself (ETCH, Li et al. 2025); kept off, it does not."""
    one = person.select([0])
    scan = dressed(one, 0.035)
    start = disturbed(one, degrees=1.0, metres=0.005, betas=0.2)
    shape = (0,)
    ours = register(BODY, Observations((0,), scans={0: scan}, initial=start, shape_frames=shape), SMALL)
    as_skin = ScanObservation(scan.mesh, np.full(scan.mesh.vertex_count, SKIN.id))
    both_ways = register(
        BODY,
        Observations((0,), scans={0: as_skin}, initial=start, shape_frames=shape),
        replace(SMALL, scan_reach_m=0.2),
    )
    kept, pulled = (vertex_error_mm(BODY, fit.params, one) for fit in (ours, both_ways))
    assert kept < vertex_error_mm(BODY, start, one)
    assert kept < 0.5 * pulled
    assert ours.residuals["skin_mm"][0] < 2.0


@pytest.mark.long
def test_a_body_does_not_stand_out_of_its_clothes(person):
    one = person.select([0])
    scan = dressed(one, 0.01)
    fat = BodyParams.from_full_pose(
        one.full_pose,
        betas=one.betas + np.array([[0.0, 2.0] + [0.0] * (one.betas.shape[1] - 2)]),
        expression=one.expression,
        transl=one.transl,
    )
    fit = register(BODY, Observations((0,), scans={0: scan}, initial=fat), SMALL)
    assert fit.residuals["inside_mm"][0] < 0.3
    assert fit.residuals["inside_mm"][0] <= fit.initial_residuals["inside_mm"][0]


def test_dents_of_a_rough_scan_starve_nobody(person, cameras):
    """Eleven cameras on a real man in a wide shirt: his rough surface, without labels, left skin and bones of him.

    Here betas reached a mean square of 8 and the body was 23 mm off.
    """
    one = person.select([0])
    mesh = BODY.mesh(BODY.forward(one).vertices[0])
    bumps = np.prod(np.sin(mesh.vertices @ np.random.default_rng(3).normal(size=(3, 2)) * 40.0), axis=1)
    rough = mesh.with_vertices(mesh.vertices + (0.015 + 0.06 * bumps)[:, None] * mesh.vertex_normals)
    seen = keypoints(BODY, one, cameras, px=2.0)
    observed = Observations((0,), cameras, keypoints=seen, scans={0: ScanObservation(rough)})
    found = register(BODY, observed, replace(SMALL, scan_samples=1000, surface_steps=4)).params
    assert (found.betas**2).mean() < 2.0
    assert vertex_error_mm(BODY, found, one) < 12.0


@pytest.mark.long
def test_a_missing_mask_is_named_and_the_rest_goes_on(person, cameras):
    mask = masks(BODY, person.select([0, 1]), cameras)
    observed = Observations(
        (0, 1),
        cameras,
        keypoints=keypoints(BODY, person.select([0, 1]), cameras),
        mask=lambda c, f: None if (c, f) == ("C2", 1) else mask[c, f],
    )
    fit = register(BODY, observed, SMALL)
    assert any("camera C2" in problem and "frame 1" in problem for problem in fit.notes)
    assert np.isfinite(fit.residuals["silhouette_px"]).all()


@pytest.mark.parametrize(
    ("observed", "words"),
    [
        (Observations(()), "at least one frame"),
        (Observations((0,)), "keypoints, landmarks, masks, scans or a fit"),
        (Observations((0,), mask=lambda c, f: None), "a fit to start from"),
        (Observations((0, 1), initial=BodyParams.rest(betas=20, expressions=52)), "2 frames"),
        (Observations((0,), initial=BodyParams.rest(betas=np.ones(100), expressions=52)), "at most 20 numbers"),
    ],
)
def test_what_cannot_be_registered_is_refused(observed, words):
    with pytest.raises(InputError, match=words):
        register(BODY, observed)
