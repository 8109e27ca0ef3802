"""Avatars as files: what is read back is what was written, and what cannot be read is said."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from avatar.gaussians.tensor_file import TensorFile
from avatar.models import model_file
from avatar.models.model_file import HEADER, SCHEMA, load_avatar, save_avatar
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.pose_dependence import PoseRegression
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import ControlCage, Track
from avatar.rig.rig import Rig
from smplxpp.core.errors import InputError
from tests.dolls.dancing import dance, gaussians, template, varied
from tests.dolls.tiny import TINY_FIELD, TINY_TEACHER

EYES = torch.tensor([[0.0, 0.8, 2.0]])
SHAPES = BlendShapeConfig(expression_size=2, head_shapes=2, body_shapes=3, width=8)
KINDS = (
    *("teacher", "centred", "tracked", "student", "no field", "control points", "still body"),
    *("regression", "shapes", "local", "gated", "pruned"),
)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(template())


def followed(rig: Rig) -> Track:
    """A surface in frames that do not follow each other."""
    random = torch.Generator().manual_seed(4)
    controls = 0.05 * torch.randn(3, 24, 3, generator=random)
    sigma, drift = 0.01 * torch.rand(3, 24, generator=random), 0.02 * torch.rand(24, generator=random)
    return Track({1: 0, 4: 1, 7: 2}, controls, ControlCage(rig, 24), sigma, drift)


def make(kind: str, rig: Rig):
    torch.manual_seed(0)
    if kind in ("teacher", "tracked"):
        model = TeacherAvatar(replace(TINY_TEACHER, noise=True), rig, varied(gaussians()))
        if kind == "tracked":
            model.remember(followed(rig))
    elif kind == "centred":
        model = TeacherAvatar(
            replace(TINY_TEACHER, bottleneck=2, position_size=16, centred=True), rig, varied(gaussians())
        )
        model.centre(rig.pose(dance().frame(frame)) for frame in range(4))
    else:
        shapes = {
            "shapes": SHAPES,
            "local": replace(SHAPES, parts=4),
            "gated": replace(SHAPES, gated=True),
            "pruned": replace(SHAPES, parts=3, gated=True, jaw=True),
        }.get(kind)
        config = StudentConfig(
            None if kind == "no field" else TINY_FIELD,
            shapes,
            control_points=40 if kind in ("control points", "still body", "regression") else 0,
            still_body=kind == "still body",
        )
        model = Student(config, rig, varied(gaussians()), () if kind == "no field" else (0, 2, 3))
    with torch.no_grad():
        for name, value in model.named_parameters():
            if not name.startswith("gaussians."):
                value.add_(0.02 * torch.randn(value.shape))
    if kind == "regression":
        model.regression = random_regression(len(model.field.points))
    if kind == "pruned":
        model = model.with_blend_shapes(model.blend_shapes.pruned(torch.ones(3, 5), keep=0.3))
    return model


def random_regression(points: int) -> PoseRegression:
    """Three directions; angles beyond half a radian are held."""
    sizes = PoseRegression.shapes(points, 3)
    given = {name: 0.02 * torch.randn(size) for name, size in sizes.items()}
    given |= {"rows": torch.randn(sizes["rows"]), "low": -0.5 * torch.ones(63), "high": 0.5 * torch.ones(63)}
    return PoseRegression(**given)


def look(model, rig) -> list[torch.Tensor]:
    """What a frame of the training and a new pose show."""
    with torch.no_grad():
        seen = [model(rig.pose(dance().frame(k), frame=code), EYES) for k, code in ((3, 3), (4, None))]
    return [
        value
        for posed in seen
        for value in (
            posed.vertices,
            posed.gaussians.means,
            posed.gaussians.scales,
            posed.gaussians.quats,
            posed.gaussians.opacities,
            posed.colors,
        )
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_gives_the_same_avatar_bit_for_bit(kind, rig, tmp_path):
    model = make(kind, rig)
    size = save_avatar(tmp_path / "a.safetensors", model)
    assert size == (tmp_path / "a.safetensors").stat().st_size
    other = load_avatar(tmp_path / "a.safetensors", rig)
    assert type(other) is type(model) and other.config == model.config and not other.training
    own, read = model.state_dict(), other.state_dict()
    assert own.keys() == read.keys()
    assert all(value.dtype == read[name].dtype and torch.equal(value, read[name]) for name, value in own.items())
    for a, b in zip(look(model, rig), look(other, rig), strict=True):
        assert torch.equal(a, b)
    save_avatar(tmp_path / "b.safetensors", other)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_compact_file_is_within_half_precision_and_half_the_size(kind, rig, tmp_path):
    model = make(kind, rig)
    whole = save_avatar(tmp_path / "whole.safetensors", model)
    compact = save_avatar(tmp_path / "compact.safetensors", model, compact=True)
    assert compact < 0.6 * whole
    other = load_avatar(tmp_path / "compact.safetensors", rig)
    for (name, value), read in zip(model.state_dict().items(), other.state_dict().values(), strict=True):
        assert value.dtype == read.dtype
        torch.testing.assert_close(read, value, rtol=2.0**-10, atol=1e-6, msg=name)
    for a, b in zip(look(model, rig), look(other, rig), strict=True):
        torch.testing.assert_close(a, b, rtol=0.01, atol=0.01)


@pytest.mark.parametrize("fps", [None, 12.5])
def test_frames_that_have_a_code_and_their_rate_are_remembered(rig, tmp_path, fps):
    made = make("student", rig)
    made.fps = fps
    save_avatar(tmp_path / "a", made.with_blend_shapes(made.blend_shapes))
    again = load_avatar(tmp_path / "a", rig)
    assert again.frames == (0, 2, 3) and again.fps == fps


def test_a_teacher_comes_back_with_the_surface_that_it_remembers(rig, tmp_path):
    own = followed(rig)
    save_avatar(tmp_path / "whole", make("tracked", rig))
    save_avatar(tmp_path / "compact", make("tracked", rig), compact=True)
    whole, compact = (load_avatar(tmp_path / name, rig).track for name in ("whole", "compact"))
    assert whole.row == compact.row == own.row
    for frame in own.row:
        assert own.displacements(frame).abs().max() > 0.01
        assert torch.equal(whole.displacements(frame), own.displacements(frame))
        torch.testing.assert_close(compact.displacements(frame), own.displacements(frame), rtol=0, atol=0.05 * 2.0**-8)
        assert torch.equal(whole.confidence(frame), own.confidence(frame)) and own.confidence(frame).max() < 1.0
    assert torch.equal(whole.drift, own.drift)


def test_a_teacher_that_followed_no_surface_comes_back_without(rig, tmp_path):
    for kind in ("teacher", "centred"):
        save_avatar(tmp_path / kind, make(kind, rig))
        assert load_avatar(tmp_path / kind, rig).track is None


def test_what_is_remembered_last_is_saved(rig, tmp_path):
    teacher, own = make("tracked", rig), followed(rig)
    teacher.remember(Track({5: 0}, own.controls[1:2], own.cage))
    save_avatar(tmp_path / "a", teacher)
    track = load_avatar(tmp_path / "a", rig).track
    assert track.row == {5: 0} and torch.equal(track.displacements(5), own.displacements(4))
    assert track.sigma is None and track.drift is None and (track.confidence(5) == 1.0).all()


def changed(path, *, about=None, tensors=None, header=HEADER) -> None:
    """Rewrite a file with other metadata or tensors."""
    with safe_open(path, framework="pt") as file:
        own = json.loads(file.metadata()[HEADER])
        kept = {name: file.get_tensor(name) for name in file.keys()}
    save_file(
        {**kept, **(tensors or {})} if tensors is None or tensors else {},
        path,
        metadata={header: json.dumps({**own, **(about or {})})},
    )


def test_files_that_are_no_avatar_are_refused(rig, tmp_path):
    path = tmp_path / "a.safetensors"
    with pytest.raises(InputError, match="smplxpp train"):
        load_avatar(path, rig)
    path.write_bytes(b"not a model")
    with pytest.raises(InputError, match="smplxpp train"):
        load_avatar(path, rig)
    save_file({"x": torch.zeros(3)}, path)
    with pytest.raises(InputError, match="smplxpp train"):
        load_avatar(path, rig)
    save_avatar(path, make("student", rig))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="smplxpp train"):
        load_avatar(path, rig)


def test_a_newer_version_is_named(rig, tmp_path):
    path = tmp_path / "a.safetensors"
    save_avatar(path, make("student", rig))
    changed(path, about={"schema": SCHEMA + 1})
    with pytest.raises(InputError, match=f"version {SCHEMA + 1}.*[Uu]pdate"):
        load_avatar(path, rig)


def test_an_avatar_of_another_template_is_refused(rig, tmp_path):
    path = tmp_path / "a.safetensors"
    save_avatar(path, make("teacher", rig))
    other = replace(template(), faces=template().faces[::-1])
    with pytest.raises(InputError, match="of this template"):
        load_avatar(path, Rig(other))


def test_tensors_of_another_shape_are_named(rig, tmp_path):
    path = tmp_path / "a.safetensors"
    save_avatar(path, make("student", rig))
    changed(path, tensors={"codes.codes": torch.zeros(2, 4)})
    with pytest.raises(InputError, match=r"codes\.codes of shape"):
        load_avatar(path, rig)


def test_a_configuration_with_unknown_fields_is_refused(rig, tmp_path):
    path = tmp_path / "a.safetensors"
    save_avatar(path, make("teacher", rig))
    changed(path, about={"config": {"in_size": 16}})
    with pytest.raises(InputError, match="stored TeacherConfig"):
        load_avatar(path, rig)


@pytest.mark.parametrize("about", [{"topology": 3}, {"field": {}}, {"blend_shapes": {"parts": 2}}])
def test_metadata_that_makes_no_sense_is_refused(rig, tmp_path, about):
    path = tmp_path / "a.safetensors"
    save_avatar(path, make("student", rig))
    changed(path, about=about)
    with pytest.raises(InputError):
        load_avatar(path, rig)


def content(path) -> tuple[dict, dict[str, torch.Tensor]]:
    """What a file says of itself, and its tensors."""
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()[HEADER]), {name: file.get_tensor(name) for name in file.keys()}


@dataclass(frozen=True, eq=False)
class Packed:
    """A tensor as its file holds it: safetensors would turn hundreds of tensors into bytes for each of their faults."""

    dtype: str
    shape: list[int]
    data: bytes


DTYPES = {torch.float32: "F32", torch.float16: "F16", torch.int32: "I32", torch.int64: "I64", torch.bool: "BOOL"}


def packed(value: torch.Tensor) -> Packed:
    return Packed(DTYPES[value.dtype], list(value.shape), value.numpy().tobytes())


def written(path, about: object, tensors: Mapping[str, torch.Tensor | Packed]):
    """Write a file of safetensors: the length of a header in JSON, the header, all bytes."""
    header, parts, end = {"__metadata__": {HEADER: json.dumps(about)}}, [], 0
    for name, value in tensors.items():
        one = packed(value) if isinstance(value, torch.Tensor) else value
        begin, end = end, end + len(one.data)
        header[name] = {"dtype": one.dtype, "shape": one.shape, "data_offsets": [begin, end]}
        parts.append(one.data)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(len(text).to_bytes(8, "little") + text + b"".join(parts))
    return path


def test_a_file_that_a_test_writes_is_one_of_safetensors(rig, tmp_path):
    save_avatar(tmp_path / "good", make("pruned", rig), compact=True)
    about, tensors = content(written(tmp_path / "own", *content(tmp_path / "good")))
    own, truth = content(tmp_path / "good")
    assert about == own and tensors.keys() == truth.keys()
    assert all(torch.equal(value, truth[name]) and value.dtype == truth[name].dtype for name, value in tensors.items())


FULL = ("tracked", "centred", "student", "pruned")


# Two teachers have hundreds of tensors and one reader: each is read in one of the two precisions, and the networks
# whose shapes a file is held against are made once: making them anew took most of the time.
@pytest.mark.parametrize(
    ("kind", "compact"),
    [("tracked", False), ("centred", True), *((kind, compact) for kind in FULL[2:] for compact in (False, True))],
)
@pytest.mark.long
def test_every_tensor_is_needed_in_its_shape_finite_and_of_its_kind(kind, compact, rig, tmp_path, monkeypatch):
    monkeypatch.setattr(model_file, "Teacher", cache(model_file.Teacher))
    path = tmp_path / "good"
    save_avatar(path, make(kind, rig), compact=compact)
    _, tensors = content(path)

    def load(given: dict[str, torch.Tensor]) -> None:
        """As if the file had these tensors: writing and reading hundreds for each fault took most of the time."""
        monkeypatch.setattr(TensorFile, "tensors", lambda file: given)
        load_avatar(path, rig)

    for name, value in tensors.items():
        short = name.removeprefix("gaussians.")
        if name != "track_controls":  # without it a teacher has no track
            with pytest.raises(InputError, match=rf"{short}.*received n[o]"):
                load({other: kept for other, kept in tensors.items() if other != name})
        wrong = [value.new_zeros((*value.shape, 2)), ~value if value.dtype == torch.bool else value.to(torch.bool)]
        if value.is_floating_point():
            spoilt = value.clone()
            spoilt.view(-1)[-1] = float("nan")
            with pytest.raises(InputError, match=rf"{short}: expected finite values, received NaN or infinity in 1 of"):
                load(tensors | {name: spoilt})
            wrong.append(value.int())
        elif value.dtype != torch.bool:
            wrong.append(value.float())
        for other in wrong:
            with pytest.raises(InputError, match=short):
                load(tensors | {name: other})
    load(tensors)


@pytest.mark.parametrize("kind", FULL)
@pytest.mark.parametrize(
    "wrong", [None, [], {}, "x", -1, 1.5, float("nan"), 10**6, 10**9, 10**30, [10**30], [[]], {"a": 1}]
)
def test_metadata_of_another_kind_is_refused_before_anything_is_made(kind, wrong, rig, tmp_path):
    """Or gives the same model, where the value says the same; a size that the tensors do not have takes no memory."""
    save_avatar(tmp_path / "good", make(kind, rig))
    about, tensors = content(tmp_path / "good")
    raw = {name: packed(value) for name, value in tensors.items()}
    changed_abouts = [about | {name: wrong} for name in about]
    for name, value in about.items():
        if isinstance(value, dict):
            changed_abouts += [about | {name: value | {field: wrong}} for field in value]
    for changed_about in changed_abouts:
        try:
            model = load_avatar(written(tmp_path / "bad", changed_about, raw), rig)
        except InputError as error:
            assert str(tmp_path / "bad") in str(error)
            continue
        assert model.state_dict().keys() == tensors.keys()


@pytest.mark.parametrize("kind", FULL)
def test_metadata_that_lacks_an_entry_is_refused(kind, rig, tmp_path):
    save_avatar(tmp_path / "good", make(kind, rig))
    about, tensors = content(tmp_path / "good")
    for name in set(about) - {"null_code_shown", "still_body", "track_tells", "fps"}:  # older files lack these
        lacking = {other: value for other, value in about.items() if other != name}
        with pytest.raises(InputError, match=name if name != "topology" else "this template"):
            load_avatar(written(tmp_path / "bad", lacking, tensors), rig)


def test_a_track_says_what_it_tells_of_its_errors_or_tells_nothing(rig, tmp_path):
    save_avatar(tmp_path / "good", make("tracked", rig))
    about, tensors = content(tmp_path / "good")
    older = {name: value for name, value in about.items() if name != "track_tells"}
    with pytest.raises(InputError, match="received track_drift, track_sigma"):
        load_avatar(written(tmp_path / "bad", older, tensors), rig)
    kept = {name: tensor for name, tensor in tensors.items() if name not in ("track_drift", "track_sigma")}
    with pytest.raises(InputError, match="track_"):
        load_avatar(written(tmp_path / "bad", about, kept), rig)
    assert load_avatar(written(tmp_path / "older", older, kept), rig).state_dict().keys() == kept.keys()


@pytest.mark.long
def test_damaged_bytes_give_a_model_or_words(rig, tmp_path):
    save_avatar(tmp_path / "good", make("pruned", rig), compact=True)
    data = (tmp_path / "good").read_bytes()
    header = 8 + int.from_bytes(data[:8], "little")
    rng = np.random.default_rng(0)
    outcomes = {"read": 0, "refused": 0}
    for _ in range(300):
        changed_data = bytearray(data)
        for place in rng.integers(0, header if rng.random() < 0.7 else len(data), rng.integers(1, 4)):
            changed_data[place] = rng.integers(256)
        (tmp_path / "bad").write_bytes(changed_data[: rng.integers(len(data)) if rng.random() < 0.1 else len(data)])
        try:
            load_avatar(tmp_path / "bad", rig)
            outcomes["read"] += 1
        except InputError:
            outcomes["refused"] += 1
    assert outcomes["refused"] > 50 and outcomes["read"] > 5
