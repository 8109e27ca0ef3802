"""What the teacher says is asked for once, kept within bounds, and the same from memory."""

from __future__ import annotations

import pytest
import torch

from avatar.data.sequence import camera_centers_of
from avatar.training.student.pretrain import DistillationTargets
from tests.dolls.dancing import sequence, write_dance
from tests.training.engine.test_photometric_tasks import taught


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


def source(frames, **options) -> DistillationTargets:
    return DistillationTargets(taught(frames), frames, **{"eps2d": 0.1, "tau": 8.0, "normals": True, **options})


def test_targets_show_what_the_teacher_renders(frames):
    from avatar.rendering.avatar_view import render_view

    own, views = source(frames), [frames.view(name, 1) for name in ("Ring0", "Ring2")]
    targets = own.of_views(1, views)
    with torch.no_grad():
        posed = own.teacher(frames.pose(1), camera_centers_of(views))
    for index, (view, target) in enumerate(zip(views, targets, strict=True)):
        seen = render_view(posed, index, view, frames.background, normals=True, extra=own.labels)
        torch.testing.assert_close(target.target.image, seen.image, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(target.target.alpha, seen.alpha, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(target.labels, seen.extra, rtol=2e-3, atol=2e-3)
        known = target.target.normals.abs().sum(-1) > 0
        assert bool((seen.alpha[known] > 0.5).all()) and known.any()
    assert not any(p.requires_grad for p in own.teacher.parameters())


def test_maps_are_the_teachers(frames):
    own = source(frames)
    with torch.no_grad():
        maps = own.teacher.residual_maps(frames.pose(2), torch.zeros(1, 3))
    torch.testing.assert_close(own.displacements(2), maps.position[0], rtol=1e-3, atol=1e-6)


def test_a_target_is_drawn_once(frames, monkeypatch):
    own, views = source(frames), [frames.view("Ring1", 0)]
    first = own.of_views(0, views)[0]
    monkeypatch.setattr(DistillationTargets, "_draw", None)
    again = own.of_views(0, views)[0]
    assert torch.equal(first.target.image, again.target.image) and torch.equal(first.labels, again.labels)


def test_nothing_is_kept_without_memory_and_targets_are_the_same(frames):
    own, without = source(frames), source(frames, max_bytes=0)
    views = [frames.view("Ring0", 0)]
    key = (0, "Ring0", views[0].camera.width, views[0].camera.height)
    torch.testing.assert_close(own.of_views(0, views)[0].labels, without.of_views(0, views)[0].labels)
    assert key in own._cache and key not in without._cache


def test_without_normals_a_target_has_none(frames):
    target = source(frames, normals=False).of_views(0, [frames.view("Ring0", 0)])[0]
    assert target.target.normals is None and target.labels.shape[-1] == 3


def test_a_target_that_another_pushes_out_is_still_given(frames):
    whole = source(frames)
    views = [frames.view(name, 0) for name in ("Ring0", "Ring1")]
    first, second = whole.of_views(0, views)
    size = sum(t.numel() * t.element_size() for t in whole._cache.get((0, "Ring0", *sizes(views[0])), tuple))
    other = sum(t.numel() * t.element_size() for t in whole._cache.get((0, "Ring1", *sizes(views[1])), tuple))
    small = source(frames, max_bytes=size + other - 1)
    small.of_views(0, views[:1])  # the one that the next call finds, and loses
    for found, expected in zip(small.of_views(0, views), (first, second), strict=True):
        torch.testing.assert_close(found.target.image, expected.target.image)


def sizes(view) -> tuple[int, int]:
    return view.camera.width, view.camera.height
