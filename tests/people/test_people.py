"""Procedural people: their truth, their variants, and that the cast is made of what there is."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest

from benchmarks.support.people import body_outside, captured, captured_names
from smplxpp.body import load_body
from smplxpp.core import LABEL_BY_NAME, BodyParams, InputError
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import border_loops, face_components
from smplxpp.people import CAST, OUTSIDERS, VARIANTS, access, people, person, variant
from smplxpp.people.bodies import BUILDS, STANCES, Posing, betas_of, fitting_mannequin
from smplxpp.people.cloth_mesh import ClothMesh
from smplxpp.people.garments.cut import sewn
from smplxpp.people.garments.loose import sewn_coat
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.people.garments.wardrobe import all_garments
from smplxpp.people.making import make_person
from smplxpp.people.outside import Outside, heel_blocks, outside_body, reachable
from smplxpp.people.paint import DYES, HAIR_COLORS, PATTERNS, SKIN_TONES
from smplxpp.people.scan_simulation import ScanConfig
from smplxpp.skinning import skin

pytestmark = pytest.mark.long

NAME = "man shirt trousers short hair, arms down"
COARSE = ScanConfig(cell=0.012, views=24, resolution=384, faces=12_000)


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def scan(body):
    """One person, scanned coarsely."""
    return make_person(NAME, CAST[NAME], body, seed=0, scan=COARSE)


def test_a_person_is_a_scan_with_its_truth(body, scan):
    assert abs(scan.mesh.face_count - COARSE.faces) < 0.05 * COARSE.faces
    assert scan.colors.shape == scan.mesh.vertices.shape
    np.testing.assert_array_equal(body.forward(scan.params).vertices[0], scan.body_vertices)
    assert scan.mesh.vertices[:, 1].min() == pytest.approx(0.0, abs=0.02)
    assert np.median(body_outside(scan)) < -0.003
    assert (body_outside(scan) > 0.01).mean() < 0.005


def test_labels_lie_where_they_are_worn(scan):
    height = scan.mesh.face_centers[:, 1] / scan.mesh.vertices[:, 1].max()

    def middle(name):
        return np.median(height[scan.face_labels == LABEL_BY_NAME[name].id])

    assert middle("shoe") < 0.1 < middle("lower") < 0.55 < middle("upper") < 0.85 < middle("hair")
    assert set(np.unique(scan.face_labels)) == {LABEL_BY_NAME[n].id for n in ("skin", "hair", "shoe", "upper", "lower")}
    assert 0.5 < scan.seen.mean() < 1.0


def test_a_person_is_the_same_again(body, scan):
    again = make_person(NAME, CAST[NAME], body, seed=0, scan=COARSE)
    np.testing.assert_array_equal(scan.mesh.vertices, again.mesh.vertices)
    np.testing.assert_array_equal(scan.colors, again.colors)


def test_a_folder_remembers_people(monkeypatch, tmp_path, scan):
    calls = []

    def make(name, *_, **__):
        calls.append(name)
        return scan

    monkeypatch.setattr(access, "make_person", make)
    made, read = (person(NAME, cache=tmp_path) for _ in range(2))
    assert calls == [NAME] and made is scan
    for field in ("face_labels", "seen", "colors", "body_vertices", "joints"):
        np.testing.assert_array_equal(getattr(read, field), getattr(scan, field))
    np.testing.assert_array_equal(read.mesh.vertices, scan.mesh.vertices)
    assert person(NAME, seed=1, cache=tmp_path).name == f"{NAME} (1)"
    assert len(calls) == 2
    everybody = [one.name for one in people(count=len(CAST) + 1, cache=tmp_path)]
    assert calls[2:] == [name for name in CAST if name != NAME] + [next(iter(CAST))]
    assert everybody[-1].endswith("(1)") and not everybody[-2].endswith("(1)")


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_keep_scan_and_truth_together(body, scan, name):
    """The nearest point of the surface to every joint is as far as it was."""
    changed = variant(scan, name)
    shown = changed.as_read()
    np.testing.assert_allclose(scan.body.forward(changed.params).vertices[0], changed.body_vertices, atol=1e-12)
    before, after = (
        np.sqrt(igl.point_mesh_squared_distance(one.joints, one.mesh.vertices, one.mesh.faces)[0])
        for one in (scan, shown)
    )
    exact = name in ("as it is", "turned", "z up", "in cm")
    places = np.arange(len(before))
    if name == "mirrored":
        places = np.array([body.joint_names.index(_other(n)) for n in body.joint_names])
    np.testing.assert_allclose(after[places], before, atol=1e-9 if exact else 0.012)
    assert len(shown.face_labels) == len(shown.seen) == shown.mesh.face_count
    assert len(shown.colors) == shown.mesh.vertex_count
    size = np.ptp(changed.mesh.vertices[:, 2 if name == "z up" else 1]) / np.ptp(scan.mesh.vertices[:, 1])
    assert size == pytest.approx(100.0 if name == "in cm" else 1.0, rel=0.02)


def _other(name: str) -> str:
    return name.replace("left", "right") if "left" in name else name.replace("right", "left")


def test_mirroring_twice_gives_the_person_back(scan):
    twice = variant(variant(scan, "mirrored"), "mirrored")
    np.testing.assert_allclose(twice.body_vertices, scan.body_vertices, atol=1e-9)
    np.testing.assert_array_equal(twice.mesh.vertices, scan.mesh.vertices)
    once = variant(replace(scan, mesh=scan.mesh), "mirrored")
    gap = igl.point_mesh_squared_distance(once.body_vertices * [-1, 1, 1], scan.body_vertices, load_body().faces)[0]
    assert np.sqrt(gap).max() < 0.006 and np.percentile(np.sqrt(gap), 99) < 0.001


def test_what_nobody_has_is_refused(scan):
    for ask in (lambda: person("nobody"), lambda: variant(scan, "eaten"), lambda: captured("nobody")):
        with pytest.raises(InputError):
            ask()


def test_the_cast_is_made_of_what_there_is(body):
    mannequin, _ = fitting_mannequin(body, betas_of(body, "mean", np.random.default_rng(0)))
    garments = all_garments(mannequin)
    for name, member in (CAST | OUTSIDERS).items():
        assert member.build in BUILDS and member.stance in STANCES and member.tone in SKIN_TONES, name
        for wear in member.wears:
            dyes = HAIR_COLORS if garments[wear.garment].label == "hair" else DYES
            assert wear.dye.color in dyes and wear.dye.second in DYES and wear.dye.pattern in PATTERNS, name


def test_noise_of_an_outsider_is_what_no_shape_has(body):
    """Whatever the betas, the body stays away from hers; ears and fingers keep their form, both sides alike."""
    other = outside_body(body, Outside(noise=0.01), seed=5)
    offsets = other.v_template - body.v_template
    found = np.linalg.lstsq(body.shapedirs.reshape(-1, body.num_betas), offsets.ravel(), rcond=None)[0]
    assert np.abs(found).max() < 1e-9
    params = Posing.of(body, "A", np.ones(20) * 0.3, facing=30.0, rng=np.random.default_rng(0)).params(1.0)
    near = reachable(body, other, params)
    apart = np.sqrt(
        igl.point_mesh_squared_distance(other.forward(params).vertices[0], body.forward(near).vertices[0], body.faces)[
            0
        ]
    )
    legs = body.weights[:, [body.joint_names.index(f"{side}_knee") for side in ("left", "right")]].sum(axis=1) > 0.9
    assert 0.003 < np.sqrt(np.mean(apart[legs] ** 2)) < 0.02
    fingers = body.weights[:, [k for k, name in enumerate(body.joint_names) if "index" in name]].sum(axis=1) > 0.9
    assert apart[fingers].max() < 0.008
    assert outside_body(body, Outside(fists=True), seed=5) is body


def test_longer_limbs_move_what_follows_them(body):
    other = outside_body(body, Outside(limbs=1.1), seed=0)
    joints = [one.joint_regressor @ one.v_template for one in (body, other)]

    def length(k: int, start: str, end: str) -> float:
        return float(np.linalg.norm(np.subtract(*(joints[k][body.joint_names.index(name)] for name in (start, end)))))

    for side in ("left", "right"):
        for start, end in ((f"{side}_knee", f"{side}_ankle"), (f"{side}_elbow", f"{side}_wrist")):
            assert length(1, start, end) / length(0, start, end) == pytest.approx(1.1, abs=0.02)
        assert length(1, f"{side}_hip", f"{side}_knee") == pytest.approx(
            length(0, f"{side}_hip", f"{side}_knee"), abs=4e-3
        )
        assert length(1, f"{side}_wrist", f"{side}_index1") == pytest.approx(
            length(0, f"{side}_wrist", f"{side}_index1"), abs=3e-3
        )


def test_heels_stand_on_the_floor_with_the_balls_of_the_feet(body):
    outside = Outside(heels=0.07)
    rest = BodyParams.rest(betas=np.zeros(body.num_betas), expressions=body.num_expressions)
    blocks = heel_blocks(body, rest, outside)
    posing = Posing.of(body, "T", np.zeros(body.num_betas), facing=0.0, rng=np.random.default_rng(0))
    posing = replace(posing, jitter=0.0 * posing.jitter, added=outside.turns())
    posed = body.forward(posing.params(1.0))
    low = skin(blocks.vertices, blocks.weights, posed.posed_from_rest[0])[:, 1].min()
    assert low == pytest.approx(posed.vertices[0][:, 1].min(), abs=1e-9)
    flat = body.forward(rest).vertices[0]
    heel = flat[:, 1] < flat[:, 1].min() + 0.03
    heel &= flat[:, 2] < flat[heel, 2].min() + 0.03
    assert posed.vertices[0][heel, 1].min() - posed.vertices[0][:, 1].min() == pytest.approx(0.07, abs=0.012)
    # Their faces look outwards.
    mesh = blocks.mesh
    side = mesh.face_centers - np.where(
        mesh.face_centers[:, :1] > 0, mesh.vertices[:48].mean(axis=0), mesh.vertices[48:].mean(axis=0)
    )
    around = (np.abs(mesh.face_normals[:, 1]) < 0.5) & (mesh.face_areas > 1e-9)
    assert (np.einsum("ij,ij->i", mesh.face_normals, side)[around] > 0).all()


def test_a_coat_is_sewn_of_one_piece_over_its_skirt(body):
    mannequin = Mannequin.of(body, np.zeros(body.num_betas))
    skirt = all_garments(mannequin)["long skirt"].cloth
    coat = sewn_coat(mannequin, skirt)
    assert face_components(coat.faces).max() == 0
    ways = np.concatenate([coat.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(ways, axis=0)) == len(ways), "all faces look out"
    assert len(border_loops(coat.faces)) == 3, "two cuffs; neckline, front and hem are one"
    where = SignedDistanceField(skirt.mesh, solid=False).query(coat.vertices)
    assert where.distance[~where.on_border].min() > 0.005
    hem, knee = coat.vertices[:, 1].min(), mannequin.joints["left_knee"][1]
    assert hem < knee < coat.vertices[:, 1].max() - 0.5


def test_edges_of_different_counts_are_sewn_without_a_gap():
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    sheet = ClothMesh(flat, np.array([[0, 1, 3], [0, 3, 2]]), np.ones((4, 1)))
    fine = ClothMesh(
        np.array([[0.0, 2, 0], [0.2, 2, 0], [1, 2, 0], [0.5, 3, 0]]), np.array([[0, 1, 3], [1, 2, 3]]), np.ones((4, 1))
    )
    whole = sewn(sheet, np.array([2, 3]), fine, np.array([0, 1, 2]))
    assert len(whole.faces) == 7
    assert whole.mesh.face_areas.sum() == pytest.approx(2.5)
    assert len(border_loops(whole.faces)) == 1


def test_another_seed_gives_another_body_of_that_build(body):
    one, other = (betas_of(body, "heavy man", np.random.default_rng(seed)) for seed in (0, 1))
    assert 0.1 < np.abs(one - other).max() < 4.0
    assert np.linalg.norm((one - other)[:6]) < np.linalg.norm(one[:6])


def test_stances_turn_the_person_to_her_left(body):
    posing = Posing.of(body, "T", np.zeros(body.num_betas), facing=90.0, rng=np.random.default_rng(0))
    joints = dict(zip(body.joint_names, body.forward(posing.params(1.0)).joints[0], strict=True))
    assert joints["left_wrist"][2] - joints["right_wrist"][2] < -1.0


def test_captures_are_read_with_their_truth():
    assert "fixture" in captured_names()
    scan = captured("fixture")
    assert (body_outside(scan) > 0.01).mean() < 0.02
    assert scan.seen.mean() > 0.5
    assert set(np.unique(scan.face_labels)) == {0, 1, 2, 3, 4}
