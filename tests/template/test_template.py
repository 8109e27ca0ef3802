"""Template: posing against the body model, the file bit for bit, and files that are none."""

from __future__ import annotations

import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.named_poses import stress_poses
from smplxpp.core import SKIN, UPPER, BodyParams, InputError, SkinWeights
from smplxpp.template.template import Template
from tests.export.templates import random_template


def template_of(body, betas: np.ndarray) -> Template:
    """The body, and a part: some of its own faces a centimetre out, with the body's own weights."""
    rest = body.forward(BodyParams.rest(betas=betas, expressions=0), flat_hand_mean=True).rest_vertices[0]
    mesh = body.mesh(rest)
    piece, used = mesh.submesh(np.arange(mesh.face_count) % 7 == 0)
    count, extra = body.vertex_count, len(used)
    dense = np.concatenate([body.weights, body.weights[used]])
    return Template(
        vertices=np.concatenate([rest, rest[used] + 0.01]),
        faces=np.concatenate([body.faces, piece.faces + count]),
        vertex_labels=np.repeat([SKIN.id, UPPER.id], [count, extra]),
        vertex_part=np.repeat([0, 1], [count, extra]),
        part_names=("body", "shirt"),
        vertex_colors=np.random.default_rng(0).integers(0, 256, (count + extra, 3)),
        weights=SkinWeights.from_dense(dense, policies=("matched",)),
        body=body,
        betas=betas,
        body_index=np.concatenate([np.arange(count), used]),
        scan_index=np.concatenate([np.full(count, -1), np.arange(extra)]),
        metadata={"body": body.name, "note": "ä"},
    )


@pytest.fixture(scope="module")
def open_body():
    return load_body(num_betas=4, num_expressions=6)


@pytest.fixture(scope="module")
def template(open_body):
    return template_of(open_body, np.array([0.5, -1.0, 0.3, 0.0]))


def test_the_body_poses_as_its_model(open_body, template):
    params = stress_poses(BodyParams.rest(betas=template.betas, expressions=6))
    expression = np.random.default_rng(1).uniform(0, 1, (len(params), 6))
    params = replace(params, expression=expression, transl=np.array([[0.1, 1.0, -2.0]] * len(params)))
    expected = open_body.forward(params)
    posed = template.pose(params)
    assert posed.shape == (len(params), template.vertex_count, 3)
    assert np.allclose(posed[:, : open_body.vertex_count], expected.vertices, atol=1e-6)
    # The part follows the joints alone: skinning of its own rest.
    of_part = template.vertex_part == 1
    transforms = np.einsum("vj,tjab->tvab", template.weights.dense()[of_part], template.posed_from_rest(params))
    rest = template.vertices[of_part]
    direct = np.einsum("tvab,vb->tva", transforms[..., :3, :3], rest) + transforms[..., :3, 3]
    assert np.allclose(posed[:, of_part], direct, atol=1e-12)


def test_the_identity_is_its_own(template):
    params = stress_poses(BodyParams.rest(betas=template.betas, expressions=6))
    other = replace(params, betas=np.full((len(params), 4), 3.0))
    assert np.array_equal(template.pose(params), template.pose(other))


def test_rest_is_the_t_pose(template):
    posed = template.pose(BodyParams.rest(betas=template.betas, expressions=6))[0]
    assert np.allclose(posed, template.vertices, atol=1e-12)
    assert np.allclose(template.joints, template.body.joint_regressor @ template.vertices[: template.body.vertex_count])


def test_who_stands_on_the_floor_is_lifted_in_every_pose(template):
    standing = template.on_floor()
    assert standing.vertices[np.unique(standing.faces), 1].min() == 0
    lift = standing.vertices - template.vertices
    np.testing.assert_allclose(standing.joints - template.joints, np.broadcast_to(lift[0], (55, 3)), atol=2e-6)
    rng = np.random.default_rng(3)
    turns = {"body_pose": rng.normal(0, 0.3, (1, 63)), "global_orient": rng.normal(0, 1, (1, 3))}
    params = replace(BodyParams.rest(betas=template.betas, expressions=6), **turns)
    np.testing.assert_allclose(standing.pose(params) - template.pose(params), lift[None], atol=2e-6)


def test_pose_correctives_hand_means_and_hand_components_survive_the_file(tmp_path):
    rng = np.random.default_rng(2)
    random = random_template(joint_count=55, pose_correctives=True)
    hands = {f"{side}_hand_components": rng.normal(scale=0.2, size=(12, 45)) for side in ("left", "right")}
    body = replace(random.body, **hands)
    template = template_of(body, np.array([0.4, -0.2]))
    params = replace(
        stress_poses(BodyParams.rest(betas=template.betas, expressions=3)),
        **{f"{side}_hand_pose": rng.normal(size=(4, 6)) for side in ("left", "right")},
    )
    expected = body.forward(params)
    assert np.abs(expected.pose_offsets).max() > 0.01
    posed = _round_trip(template, tmp_path).pose(params)
    assert np.allclose(posed[:, : body.vertex_count], expected.vertices, atol=1e-6)


def _round_trip(template: Template, folder) -> Template:
    template.save(folder / "template.npz")
    return Template.load(folder / "template.npz")


def _leaves(template: Template) -> dict[str, object]:
    """Every field of the template, of its body and of its weights."""
    parts = {"": template, "body.": template.body, "weights.": template.weights}
    return {
        prefix + f.name: getattr(part, f.name)
        for prefix, part in parts.items()
        for f in fields(part)
        if prefix + f.name not in ("body", "weights", "body._tensors")
    }


def test_the_file_gives_every_bit_back(tmp_path, template):
    loaded = _round_trip(template, tmp_path)
    for name, before in _leaves(template).items():
        after = _leaves(loaded)[name]
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype, name
            assert before.tobytes() == after.tobytes(), name
        else:
            assert before == after, name
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "template.npz").read_bytes()
    params = BodyParams.rest(betas=template.betas, expressions=6)
    assert np.array_equal(loaded.pose(params), template.pose(params))


def test_the_file_holds_no_pickle(tmp_path, template):
    template.save(tmp_path / "template.npz")
    with np.load(tmp_path / "template.npz", allow_pickle=False) as data:
        assert all(data[key].dtype != object for key in data.files)
    assert [p.name for p in tmp_path.iterdir()] == ["template.npz"]


def test_masks_colours_and_parts(template):
    of_part = template.vertex_part == 1
    assert np.array_equal(template.cloth_mask, of_part)
    assert (template.semantic_colors[of_part] == UPPER.semantic_rgb).all()
    assert (template.semantic_colors[~of_part] == SKIN.semantic_rgb).all()
    assert template.part_mesh("shirt").vertex_count == of_part.sum()
    assert template.part_mesh("shirt").face_count + template.body.faces.shape[0] == len(template.faces)
    with pytest.raises(InputError, match="'body' or 'shirt'"):
        template.part_mesh("hat")


def test_the_body_has_the_templates_surface_and_the_files_precision(open_body, template):
    count = open_body.vertex_count
    np.testing.assert_array_equal(template.body.v_template, template.vertices[:count])
    np.testing.assert_array_equal(template.body.faces, open_body.faces)
    np.testing.assert_array_equal(template.body.weights, template.weights.dense()[:count])
    np.testing.assert_array_equal(template.body.exprdirs, open_body.exprdirs.astype(np.float32))
    moved = replace(template, vertices=template.vertices + 0.5)
    np.testing.assert_array_equal(moved.body.v_template, moved.vertices[:count])


def test_arrays_cannot_be_written(template):
    with pytest.raises(ValueError, match="read-only"):
        template.vertices[0] = 0


def _rewritten(source, target, **changes) -> None:
    with np.load(source) as data:
        arrays = {key: data[key] for key in data.files}
    np.savez(target, **{key: value for key, value in (arrays | changes).items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"smplxpp_template_schema": None}, "written by Template.save"),
        ({"smplxpp_template_schema": np.int64(99)}, "version 99.*[Uu]pdate"),
        ({"vertices": None}, "template"),
        ({"weights_joint_indices": None}, "weights_joint_indices: expected integers with 2 axes, received none"),
        ({"metadata": np.array("{")}, "metadata: expected JSON"),
        ({"scan_index": np.zeros(3)}, "scan_index"),
        ({"faces": np.array([[0, 1, 10**7]])}, "faces"),
        ({"vertices": np.full((3, 3), np.nan)}, "template"),
        ({"part_names": np.array(["shirt", "body"])}, "part_names"),
        ({"smplxpp_template_schema": np.array([1, 2])}, "version 1 or older"),
        ({"smplxpp_template_schema": np.array("one")}, "version 1 or older"),
        ({"metadata": np.array("[1]")}, "metadata: expected an object"),
        ({"metadata": np.array('{"body": 3}')}, "metadata body: expected a text"),
        ({"metadata": np.array(3)}, "metadata: expected texts"),
        ({"betas": np.array(["a"])}, "betas: expected floats"),
        ({"faces": np.zeros((3, 3))}, "faces: expected integers"),
        ({"vertex_labels": np.zeros((2, 2), int)}, "vertex_labels: expected integers with 1 axes"),
        ({"parents": np.array([1, 0])}, "parents: expected a tree"),
        ({"parents": np.array([-1, 5])}, r"parents: expected joints in \[0, 2\)"),
        ({"parents": np.zeros(0, int)}, "no joints"),
        ({"weights_joint_count": np.int64(10**9)}, "weights: expected 22777 vertices"),
        ({"weights_matched": np.ones(3, bool)}, "weights_matched: expected 22777"),
        ({"joint_regressor": np.full((1, 1), np.inf)}, "template file"),
    ],
)
def test_foreign_newer_and_incomplete_files(tmp_path, template, changes, message):
    template.save(tmp_path / "good.npz")
    _rewritten(tmp_path / "good.npz", tmp_path / "bad.npz", **changes)
    with pytest.raises(InputError, match=message):
        Template.load(tmp_path / "bad.npz")


def test_weights_and_skeletons_that_make_no_sense(tmp_path, template):
    template.save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as data:
        arrays = {name: data[name] for name in data.files}
    indices, weights, parents = (
        arrays[f"{name}"] for name in ("weights_joint_indices", "weights_joint_weights", "parents")
    )
    circle = parents.copy()
    circle[[1, 2]] = 2, 1
    for changes, message in (
        ({"weights_joint_indices": indices + len(parents)}, "joints in"),
        ({"weights_joint_indices": indices[:, :1]}, "weights: expected"),
        ({"weights_joint_weights": weights * np.nan}, "rows that sum to 1"),
        ({"weights_joint_weights": weights * 2}, "rows that sum to 1"),
        ({"parents": circle}, "joint 1 above itself"),
        ({"parents": np.r_[parents[0], [99] * (len(parents) - 1)]}, "parents"),
        ({"shape_basis": arrays["shape_basis"] * np.nan}, "body.shapedirs: expected finite"),
        ({"vertex_part": arrays["vertex_part"] + 99}, "vertex_part: expected indices"),
    ):
        _rewritten(tmp_path / "good.npz", tmp_path / "bad.npz", **changes)
        with pytest.raises(InputError, match=message) as caught:
            Template.load(tmp_path / "bad.npz")
        assert str(tmp_path / "bad.npz") in caught.value.subject


def test_damaged_files(tmp_path, template):
    template.save(tmp_path / "good.npz")
    data = (tmp_path / "good.npz").read_bytes()
    bad = tmp_path / "bad.npz"
    middle = len(data) // 2
    objects = np.array([object()], dtype=object)
    for content in (b"", b"not an archive", data[:middle], data[:middle] + bytes(64) + data[middle + 64 :]):
        bad.write_bytes(content)
        with pytest.raises(InputError, match="template file"):
            Template.load(bad)
    np.savez(bad, smplxpp_template_schema=1, vertices=objects, allow_pickle=True)
    with pytest.raises(InputError, match="plain arrays"):
        Template.load(bad)
    with zipfile.ZipFile(bad, "w") as archive:
        archive.writestr("text.txt", "hello")
    with pytest.raises(InputError, match="template file"):
        Template.load(bad)
    with pytest.raises(InputError, match="existing file"):
        Template.load(tmp_path / "none.npz")
