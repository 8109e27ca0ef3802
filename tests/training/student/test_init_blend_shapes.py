"""Blend shapes that start from a followed surface: closer to it, nothing else changed, the same bits every time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.binding import world_from_local
from avatar.gaussians.frames import triangle_frames
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.teacher import local_offsets
from avatar.models.student import Student, StudentConfig
from avatar.models.tracked_surface import ControlCage, Track
from avatar.training.student.compensate import _components, init_blend_shapes
from tests.dolls.dancing import dance, gaussians, sequence, varied, write_dance
from tests.dolls.tiny import TINY_FIELD
from tests.dolls.toy import copied, same_state

SHAPES = BlendShapeConfig(expression_size=2, head_shapes=2, body_shapes=3, width=16, jaw=True)
EYE = torch.tensor([[0.0, 0.8, 2.0]])


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> AvatarSequence:
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


def followed(frames: AvatarSequence, rank: int = 2, *, size: float = 0.02) -> Track:
    """Fixed fields of displacements, each times a number that the pose decides."""
    random = torch.Generator().manual_seed(5)
    cage = ControlCage(frames.rig, 24)
    fields = size * torch.randn(rank, 24, 3, generator=random)
    directions = torch.randn(rank, 63, generator=random)
    pose = torch.stack([frames.pose(frame).body_pose for frame in frames.train_frames])
    controls = torch.einsum("tr,rkc->tkc", torch.cos(3.0 * pose @ directions.T), fields)
    return Track({frame: row for row, frame in enumerate(frames.train_frames)}, controls, cage)


def student(frames: AvatarSequence, shapes: BlendShapeConfig = SHAPES, **config) -> Student:
    """A student whose field says something already, from the same start every time."""
    torch.manual_seed(0)
    made = Student(
        StudentConfig(**{"field": TINY_FIELD, "blend_shapes": shapes, **config}),
        frames.rig,
        varied(gaussians()),
        frames.train_frames,
    )
    if made.field is not None:
        with torch.no_grad():
            for value in (*made.field.parameters(), made.codes.codes):
                value.add_(0.03 * torch.randn(value.shape))
    return made


def error(frames: AvatarSequence, made: Student, track: Track) -> float:
    """Mean distance of the Gaussians from where they hang on the followed surface, over the training frames, metres."""
    distances = []
    with torch.no_grad():
        for frame in frames.train_frames:
            pose = frames.pose(frame)
            surface = frames.rig.skin(pose, track.displacements(frame))
            known = world_from_local(made.gaussians(), surface, frames.rig.faces).means
            distances.append((made(pose, EYE).gaussians.means - known).norm(dim=-1).mean())
    return float(torch.stack(distances).mean())


@pytest.mark.parametrize(
    ("shapes", "config"),
    [
        (SHAPES, {}),
        (SHAPES, {"field": None}),
        (SHAPES, {"control_points": 40}),
        (replace(SHAPES, parts=4), {}),
        (replace(SHAPES, body_shapes=20), {}),
        (replace(SHAPES, body_shapes=20, parts=4), {"field": None}),
    ],
    ids=["whole", "without a field", "control points", "parts", "fewer frames than columns", "parts, fewer frames"],
)
def test_the_gaussians_come_to_the_followed_surface(shapes, config, frames):
    made, track = student(frames, shapes, **config), followed(frames)
    before = error(frames, made, track)
    init_blend_shapes(made, frames, track)
    # What is left: poses are blurred for the networks, and blends of joints are no rotations.
    assert before > 0.01 and error(frames, made, track) < 0.25 * before


def test_what_is_left_over_is_the_way_from_the_students_mesh_to_the_surface(frames, monkeypatch):
    """In the triangles' frames of the T-pose, where both surfaces are looked at."""
    made, track, rig, seen = student(frames), followed(frames), frames.rig, []
    monkeypatch.setattr(
        "avatar.training.student.compensate._components",
        lambda shapes, left: seen.append(left) or _components(shapes, left),
    )
    init_blend_shapes(made, frames, track)
    rotations = triangle_frames(rig.vertices, rig.faces).rotations[made.gaussians.face_index]

    def at(displacements: torch.Tensor) -> torch.Tensor:
        return world_from_local(made.gaussians(), rig.vertices + displacements, rig.faces).means

    with torch.no_grad():
        for frame, left in zip(frames.train_frames, seen[0], strict=True):
            way = at(track.displacements(frame)) - at(made.displacements(frames.pose(frame)))
            torch.testing.assert_close(left, local_offsets(way, rotations), rtol=0, atol=1e-6)


def test_one_column_takes_what_there_is_of_one_field(frames):
    made, track = student(frames, replace(SHAPES, body_shapes=1), field=None), followed(frames, 1)
    before = error(frames, made, track)
    init_blend_shapes(made, frames, track)
    assert error(frames, made, track) < 0.25 * before


def test_what_follows_the_field_alone_leaves_the_gaussians_where_they_are(frames):
    """A surface that the field has found already: nothing is left over."""
    made = student(frames, control_points=24)
    with torch.no_grad():
        found = [made.displacements(frames.pose(frame)) for frame in frames.train_frames]
    controls = torch.stack([moved[made.field.points] for moved in found])
    cage = ControlCage(frames.rig, 24)
    track = Track({frame: row for row, frame in enumerate(frames.train_frames)}, controls, cage)
    init_blend_shapes(made, frames, track)
    assert max(float(moved.abs().max()) for moved in found) > 0.005
    with torch.no_grad():
        for frame in frames.train_frames:
            moved = made.compensated(frames.pose(frame)).offset - made.gaussians().offset
            assert moved.abs().max() < 1e-6


@pytest.mark.parametrize("shapes", [SHAPES, replace(SHAPES, parts=4)], ids=["whole", "parts"])
def test_columns_of_the_body_and_their_network_change_and_nothing_else(shapes, frames):
    made = student(frames, shapes)
    with torch.no_grad():
        for value in (made.blend_shapes.U, made.blend_shapes.C):
            value.normal_()
    before = copied(made.state_dict())
    init_blend_shapes(made, frames, followed(frames))
    after = made.state_dict()
    changed = {name for name, value in after.items() if not torch.equal(value, before[name])}
    assert changed == {"blend_shapes.U", *(name for name in before if name.startswith("blend_shapes.body."))}
    head = shapes.head_shapes
    U, own = after["blend_shapes.U"], before["blend_shapes.U"]
    assert torch.equal(U[..., :head], own[..., :head])
    assert bool((U[..., head:] != own[..., head:]).any(dim=-1).all())


def test_the_same_bits_whatever_torchs_random_numbers_were(frames):
    made = [student(frames, replace(SHAPES, parts=4)) for _ in range(2)]
    for number, each in enumerate(made):
        torch.manual_seed(number)
        before = torch.random.get_rng_state()
        init_blend_shapes(each, frames, followed(frames))
        assert torch.equal(before, torch.random.get_rng_state())
    assert same_state(*(each.state_dict() for each in made))


def left_over(count: int, frame_count: int = 12) -> torch.Tensor:
    """(T, count, 3) of full rank."""
    return 0.01 * torch.randn(frame_count, count, 3, generator=torch.Generator().manual_seed(6))


@pytest.mark.parametrize("parts", [1, 4])
def test_columns_are_the_best_of_their_number(parts, frames):
    """U z is the residuals' singular value decomposition cut off (Eckart and Young), part by part."""
    shapes = student(frames, replace(SHAPES, parts=parts)).blend_shapes
    left = left_over(len(shapes.U))
    with torch.no_grad():
        found = _components(shapes, left)
    assert found.shape == (12, parts, 3)
    U = shapes.U.detach()[..., 2:].double()
    of_part = torch.zeros(len(U), dtype=torch.long) if parts == 1 else shapes.part
    for part in range(parts):
        rows, z = of_part == part, found[:, part].double()
        torch.testing.assert_close(z.T @ z / 12, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-5)
        own = left[:, rows].flatten(1).double().numpy()
        u, s, vt = np.linalg.svd(own, full_matrices=False)
        best = (u[:, :3] * s[:3]) @ vt[:3]
        np.testing.assert_allclose(torch.einsum("mck,tk->tmc", U[rows], z).flatten(1).numpy(), best, atol=1e-7)


def test_columns_beyond_the_frames_stay(frames):
    shapes = student(frames).blend_shapes
    with torch.no_grad():
        shapes.U.fill_(7.0)
        found = _components(shapes, left_over(len(shapes.U), frame_count=2))
    assert found[..., 2].abs().max() == 0 and bool((shapes.U[..., 4] == 7.0).all())
    moved = torch.einsum("mck,tk->tmc", shapes.U.detach()[..., 2:4], found[:, 0, :2])
    torch.testing.assert_close(moved, left_over(len(shapes.U), frame_count=2), rtol=0, atol=1e-7)


def test_poses_between_those_of_the_frames_have_displacements_between(frames):
    """Towards one side in one pose and towards the other in another: halfway there is little of both."""
    made = student(frames, replace(SHAPES, body_shapes=1), field=None)
    a, b = frames.train_frames[0], frames.train_frames[2]
    cage = ControlCage(frames.rig, 24)
    controls = torch.zeros(4, 24, 3)
    controls[:, :, 0] = torch.tensor([0.03, 0.0, -0.03, 0.0])[:, None]
    track = Track({frame: row for row, frame in enumerate(frames.train_frames)}, controls, cage)
    init_blend_shapes(made, frames, track)
    one, two = dance().frame(a), dance().frame(b)
    middle = frames.rig.pose(replace(one, body_pose=0.5 * (one.body_pose + two.body_pose)))
    at = [made.blend_shapes.body(m.body_pose).item() for m in (frames.pose(a), middle, frames.pose(b))]
    assert at[0] * at[2] < 0 and abs(at[1]) < 0.6 * min(abs(at[0]), abs(at[2]))


def test_many_more_frames_than_are_looked_at(frames, monkeypatch):
    monkeypatch.setattr("avatar.training.student.compensate.FRAMES", 2)
    seen = []
    track = followed(frames)
    monkeypatch.setattr(Track, "displacements", lambda self, frame: seen.append(frame) or self.cage(self.controls[0]))
    init_blend_shapes(student(frames), frames, track)
    assert seen == [frames.train_frames[1], frames.train_frames[3]]
