"""Assembly: the layout of the template, the layers' order, and the captures' true layers."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from smplxpp.assemble import AssemblyConfig, CanonicalPart, assemble_template
from smplxpp.assemble.body_inside import part_lips
from smplxpp.body import load_body
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.labels import HAIR, LOWER, SHOE, SKIN, UPPER
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.skin_weights import SkinWeights
from tests.assemble.worn_body import BETAS, params, shell, worn_parts


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.mark.long
def test_body_first_then_parts(body):
    parts = worn_parts(body)
    template, report = assemble_template(body, params(), parts)
    count = body.vertex_count
    assert template.part_names == ("body", "tunic", "cap")
    assert np.array_equal(template.vertices[:count], body.forward(params()).rest_vertices[0])
    assert np.array_equal(template.faces[: len(body.faces)], body.faces)
    assert np.array_equal(template.body_index[:count], np.arange(count))
    assert (template.scan_index[:count] == -1).all()
    assert (template.vertex_labels[:count] == SKIN.id).all()
    for name, label in (("tunic", UPPER), ("cap", HAIR)):
        of_part = template.vertex_part == template.part_names.index(name)
        assert (template.vertex_labels[of_part] == label.id).all()
        assert np.array_equal(template.scan_index[of_part], parts[name].scan_index)
        assert np.array_equal(template.vertex_colors[of_part], parts[name].vertex_colors)
        assert np.array_equal(template.weights.dense()[of_part], parts[name].weights.dense())
        assert np.array_equal(template.part_mesh(name).faces, parts[name].mesh.faces)
    assert template.cloth_mask.sum() == parts["tunic"].mesh.vertex_count
    assert np.allclose(template.joints, body.rest_joints(params())[0])
    parted = part_lips(body).weights  # the body's own but for a few vertices of its lips
    assert np.allclose(template.weights.dense()[:count], parted, atol=1e-15)
    assert (parted != body.weights).any(axis=1).sum() < 30
    assert report.penetrating_after == 0
    # The nearest body vertex of a shell is the one that it was cut from, but for sharp folds.
    apart = np.linalg.norm(template.vertices - template.vertices[template.body_index], axis=1)
    assert apart.max() < 0.0041


@pytest.mark.long
def test_what_no_betas_express_is_in_the_canonical_body(body):
    """`v_shape` of the reference frame: in the T-pose, its joints, and not a second time when the template is posed."""
    own = np.random.default_rng(4).normal(size=(1, body.vertex_count, 3)) * 0.002
    reference = replace(params(), v_shape=own)
    template, _ = assemble_template(body, reference, {})
    rest = body.forward(reference)
    np.testing.assert_array_equal(template.vertices, rest.rest_vertices[0])
    assert np.allclose(template.joints, rest.rest_joints[0])
    assert np.abs(template.vertices - body.forward(params()).rest_vertices[0]).max() > 0.005
    np.testing.assert_allclose(template.pose(reference), template.pose(params()), atol=1e-12)


@pytest.mark.long
def test_a_part_within_the_body_comes_out(body):
    parts = worn_parts(body, offset=-0.003)
    template, report = assemble_template(body, params(), parts, config=AssemblyConfig(clearance=0.0015))
    assert report.parts["tunic"].before[0].vertices > 0.9 * parts["tunic"].mesh.vertex_count
    assert report.penetrating_after == 0
    assert 0.004 < report.max_push < 0.02
    assert report.as_dict()["parts"]["tunic"]["after"][0]["vertices"] == 0
    assert report.parts["tunic"].flipped_faces == 0
    assert np.array_equal(template.vertices[: body.vertex_count], body.forward(params()).rest_vertices[0])


@pytest.mark.long
def test_a_body_that_does_not_fit_is_named_and_not_pushed_through(body):
    """A tracker's body was 60 mm off: the repair pushed the garment through it, and nobody was told where."""
    parts = worn_parts(body)
    tunic = parts["tunic"].mesh
    parts["tunic"] = replace(parts["tunic"], mesh=tunic.with_vertices(tunic.vertices + [0.0, 0.0, 0.06]))
    with pytest.warns(GeometryWarning, match=r"'tunic': \d+ vertices stay inside.*mm deep, near "):
        _, report = assemble_template(body, params(), parts)
    tunic = report.parts["tunic"]
    assert 0.010 <= tunic.push_limit <= 0.031 and tunic.max_push == pytest.approx(tunic.push_limit, rel=1e-6)
    assert tunic.remaining.vertices == tunic.after[0].vertices > 50
    assert tunic.remaining.depth == tunic.after[0].depth_max > 0.005
    assert sum(tunic.remaining.where.values()) == tunic.remaining.vertices
    assert set(tunic.remaining.where) <= {"pelvis", "spine1", "spine2", "spine3", "left_hip", "right_hip", "neck"}
    assert report.remaining_where.startswith("tunic: ") and "cap" not in report.remaining_where
    assert report.max_push_where.startswith("tunic, near ")
    assert report.parts["cap"].remaining.vertices == 0 and report.parts["cap"].remaining.where == {}


def test_the_mean_hand_leaves_no_correctives_in_the_t_pose(body):
    # Pose correctives as SMPL-X has them, and a mean hand that would set them off at the zero pose.
    width = 9 * (body.joint_count - 1)
    curled = replace(
        body,
        posedirs=np.broadcast_to(np.float64(0.01), (body.vertex_count, 3, width)),
        left_hand_mean=np.full(45, 0.2),
        right_hand_mean=np.full(45, -0.2),
    )
    template, _ = assemble_template(curled, params(), {})
    assert np.array_equal(template.vertices, body.forward(params()).rest_vertices[0])


def test_outer_garments_leave_inner_ones(body):
    hips = ["pelvis", "spine1"]
    parts = {
        "upper": shell(body, ["pelvis", "spine1", "spine2"], offset=0.004, label=UPPER.id),
        "lower": shell(body, hips, offset=0.006, label=LOWER.id),
    }
    template, report = assemble_template(body, params(), parts)
    # The mapping's order stays; the repair goes from the skin outwards.
    assert template.part_names == ("body", "upper", "lower")
    assert list(report.parts) == ["lower", "upper"]
    assert report.parts["lower"].max_push == 0.0
    found = {p.inner: p.vertices for p in report.parts["upper"].before}
    assert found["body"] == 0
    assert found["lower"] > 100
    assert report.penetrating_after == 0


def test_bad_parts_are_named(body):
    tunic = worn_parts(body)["tunic"]
    count = tunic.mesh.vertex_count
    for bad, message in [
        (replace(tunic, label=SKIN.id), "label"),
        (replace(tunic, vertex_colors=np.zeros((3, 3), np.uint8)), "colours"),
        (replace(tunic, scan_index=np.zeros(3, int)), "scan indices"),
        (replace(tunic, weights=SkinWeights.from_dense(np.ones((3, 55)))), "weights of"),
        (replace(tunic, weights=SkinWeights.from_dense(np.ones((count, 4)))), "55 joints"),
        (replace(tunic, mesh=TriangleMesh(tunic.mesh.vertices, np.zeros((0, 3), int))), "faces"),
    ]:
        with pytest.raises(InputError, match=message):
            assemble_template(body, params(), {"tunic": bad})
    with pytest.raises(InputError, match="another name"):
        assemble_template(body, params(), {"body": tunic})
    two = BodyParams.rest(betas=BETAS).select([0, 0])
    with pytest.raises(InputError, match="one frame"):
        assemble_template(body, two, {"tunic": tunic})


@pytest.mark.slow
@pytest.mark.parametrize("subject", ["woman_casual", "man_casual"])
def test_true_layers_of_the_captures(captures, body, subject):
    names = {1: SKIN, 2: HAIR, 3: SHOE, 4: UPPER, 5: LOWER}
    with np.load(captures / subject / "geometry" / "topology.npz") as data:
        d = {
            key: data[key] for key in ("v_tpose", "faces", "face_part", "part_names", "part_label", "weights", "betas")
        }
    parts = {}
    for index, name in enumerate(d["part_names"]):
        if d["part_label"][index] not in (2, 3, 4, 5):
            continue
        whole = TriangleMesh(d["v_tpose"].astype(float), d["faces"][d["face_part"] == index])
        mesh, used = whole.submesh(np.ones(whole.face_count, bool))
        parts[str(name)] = CanonicalPart(
            mesh=mesh,
            weights=SkinWeights.from_dense(d["weights"][used]),
            label=names[int(d["part_label"][index])].id,
            vertex_colors=np.zeros((len(used), 3), np.uint8),
            scan_index=np.full(len(used), -1),
        )
    with warnings.catch_warnings():
        # Hair cards are crossing slivers; some turn over.
        warnings.simplefilter("ignore")
        template, report = assemble_template(body, BodyParams.rest(betas=d["betas"]), parts)
    assert report.penetrating_before > 0
    assert report.penetrating_after == 0
    assert all(report.parts[name].flipped_faces == 0 for name in parts if name != "hair")
    own, true = template.vertices[: body.vertex_count], d["v_tpose"][: body.vertex_count].astype(float)
    drawn_in = np.abs(own - true).max(axis=1) >= 2e-5
    ankles = [k for k, name in enumerate(body.joint_names) if "ankle" in name or "foot" in name]
    # Feet alone yield, and shrink: a toe may be smoothed into the gap beside it, most of what moved moved inwards.
    assert (body.weights[drawn_in][:, ankles].sum(axis=1) > 0.0).all()
    skin = SignedDistanceField(TriangleMesh(true, body.faces), solid=True)
    assert np.median(skin.query(own[drawn_in]).distance) < 0.0
