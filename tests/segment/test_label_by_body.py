"""Labels of a clothed scan from geometry, colours and the fitted body."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest

from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.build.locate import certain_labels
from smplxpp.clean import simplify
from smplxpp.core.errors import InputError
from smplxpp.core.labels import HAIR, LABELS, LOWER, OUTER, SHOE, SKIN, UPPER
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.segment import UNSURE, SegmentedScan, label_by_body, read_labels, segment_scan
from smplxpp.segment.by_body_colors import fit_skin
from smplxpp.segment.by_body_outfit import NAT, RUNS, OutfitConfig, find_outfit, label_shares
from smplxpp.segment.by_body_rings import ARM_START, COLUMN_END, STEP, Rings, cloth_against_skin
from smplxpp.synth.tracker import tracker_noise

PERSON = Path(__file__).resolve().parents[2] / "data/fixtures/person"
_SKIN_RGB, _BLUE, _GREY = (222, 176, 150), (58, 98, 170), (90, 90, 94)


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body()


@pytest.fixture(scope="module")
def scanned(body) -> tuple[TriangleMesh, np.ndarray, np.ndarray, BodyParams]:
    """The fixture's scan with a seventh of its faces, its colours, true labels of faces, and its body's parameters."""
    file = read_mesh(PERSON / "scans/scan_000000.ply")
    labels = read_labels(
        PERSON / "scans/scan_000000_labels.npz",
        vertex_count=file.mesh.vertex_count,
        face_count=file.mesh.face_count,
        label_set="capture",
    )
    coarse = simplify(file.mesh, 12_000)
    corner = labels[coarse.source_vertex][coarse.mesh.faces]
    truth = np.where(corner[:, 1] == corner[:, 2], corner[:, 1], corner[:, 0])
    params = load_params(PERSON / "params/params.npz", body=body).frame(0)
    return coarse.mesh, file.vertex_colors[coarse.source_vertex], truth, params


@pytest.fixture(scope="module")
def labelled(body, scanned) -> SegmentedScan:
    """That scan's labels."""
    mesh, colors, _, params = scanned
    return label_by_body(mesh, body, params, colors=colors)


def accuracy(mesh: TriangleMesh, labels: np.ndarray, truth: np.ndarray) -> float:
    return float(mesh.face_areas @ (labels == truth) / mesh.face_areas.sum())


def test_a_clothed_scan_is_labelled_though_the_body_is_a_little_wrong(body, scanned):
    mesh, colors, truth, params = scanned
    wrong = tracker_noise(params, seed=3, degrees=2.5, transl=0.01, betas=0.4)
    result = label_by_body(mesh, body, wrong, colors=colors)
    assert accuracy(mesh, result.face_labels, truth) > 0.95
    right = result.face_labels == truth
    sure = result.confidence > np.median(result.confidence)
    assert right[sure].mean() > right[~sure].mean()
    assert result.seen.mean() > 0.9
    again = label_by_body(mesh, body, wrong, colors=colors)
    assert np.array_equal(again.face_labels, result.face_labels)


def test_the_direction_she_faces_does_not_matter(body, scanned, labelled):
    mesh, colors, _, params = scanned
    angle = np.radians(110.0)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    root = body.forward(params).joints[0, 0]
    vertices = (mesh.vertices - root) @ turn.T + root
    turned = replace(params, global_orient=rotvec_from_matrix(turn @ matrix_from_rotvec(params.global_orient)))
    after = label_by_body(mesh.with_vertices(vertices), body, turned, colors=colors)
    assert accuracy(mesh, after.face_labels, labelled.face_labels) > 0.999


def test_without_colours_it_says_so(body, scanned):
    mesh, colors, _, params = scanned
    for given in (None, np.full_like(colors, 128)):
        result = label_by_body(mesh, body, params, colors=given)
        assert any("no colours" in note for note in result.notes)


def painted(body: BodyModel, paint: dict[str, tuple]) -> tuple[TriangleMesh, np.ndarray, BodyParams]:
    """A naked body whose regions are painted: what colours alone say."""
    params = BodyParams.rest()
    posed = body.forward(params)
    mesh = body.mesh(posed.vertices[0])
    colors = np.tile(np.array(_SKIN_RGB, dtype=np.uint8), (mesh.vertex_count, 1))
    x, y, _ = mesh.vertices.T
    joint = dict(zip(body.joint_names, posed.joints[0], strict=True))
    where = {
        "hair": y > joint["head"][1] + 0.16,
        "shirt": (y > joint["pelvis"][1] + 0.05) & (y < joint["neck"][1] - 0.03) & (np.abs(x) < joint["left_elbow"][0]),
        "trousers": (y < joint["pelvis"][1] + 0.05) & (y > joint["left_ankle"][1] + 0.03),
        "shoes": y < joint["left_ankle"][1] + 0.03,
    }
    for name, rgb in paint.items():
        colors[where[name] & (np.abs(x) < joint["left_elbow"][0])] = rgb
    return mesh, colors, params


def test_a_bald_person_with_bare_feet_has_neither_hair_nor_shoes(body):
    mesh, colors, params = painted(body, {"shirt": _BLUE, "trousers": _GREY})
    labels = label_by_body(mesh, body, params, colors=colors).face_labels
    area = mesh.face_areas / mesh.face_areas.sum()
    share = np.array([area[labels == k].sum() for k in range(len(LABELS))])
    assert share[HAIR.id] < 0.002 and share[SHOE.id] < 0.002
    assert share[UPPER.id] > 0.2 and share[LOWER.id] > 0.2 and share[SKIN.id] > 0.15


def test_a_garment_that_may_be_one_or_two_is_not_sure(body):
    """Shirt and trousers of two colours, and the same of one: what is upper and what lower is a guess then."""
    sure = []
    for trousers in (_GREY, _BLUE):
        mesh, colors, params = painted(body, {"shirt": _BLUE, "trousers": trousers, "hair": _GREY})
        result = label_by_body(mesh, body, params, colors=colors)
        cloth = np.isin(result.face_labels, (UPPER.id, LOWER.id))
        sure.append(mesh.face_areas[cloth] @ result.confidence[cloth] / mesh.face_areas[cloth].sum())
    assert sure[0] > 0.88 and sure[1] < sure[0] - 0.05


def test_nothing_tells_a_closed_jacket_from_a_shirt(body, scanned):
    whole = read_mesh(PERSON / "scans/scan_000000.ply")  # with all of its faces, on which confidences lean
    result = label_by_body(whole.mesh, body, scanned[3], colors=whole.vertex_colors)
    assert result.confidence[result.face_labels == UPPER.id].max() < 0.95
    assert np.median(result.confidence[result.face_labels == LOWER.id]) > 0.95


def thick_clothes(body: BodyModel, calves: float) -> tuple[TriangleMesh, dict[str, np.ndarray], BodyParams]:
    """Shirt, shorts and shoes some centimetres above the body, and calves that no shape of it has; masks of faces."""
    params = BodyParams.rest()
    posed = body.forward(params)
    mesh = body.mesh(posed.vertices[0])
    joint = {name: posed.joints[0, k] for k, name in enumerate(body.joint_names)}
    x, y, _ = mesh.vertices.T
    inner = np.abs(x) < joint["left_elbow"][0] - 0.08
    ankle, knee, hip = (joint[f"left_{name}"][1] for name in ("ankle", "knee", "hip"))
    where = {
        "shoe": y < ankle + 0.02,
        "calf": (y >= ankle + 0.02) & (y < knee + 0.04),
        "shorts": (y >= knee + 0.04) & (y < hip + 0.03),
        "shirt": (y >= hip + 0.03) & (y < joint["neck"][1] - 0.04) & inner,
    }
    above = {"shoe": 0.012, "calf": calves, "shorts": 0.028, "shirt": 0.014}
    away = sum((above[name] * mask for name, mask in where.items()), np.zeros(len(y)))
    # The muscle rises from the ankle over half of the calf, and its widest place is 8 mm off the body.
    away[where["calf"]] *= np.clip((y[where["calf"]] - ankle - 0.02) / (0.5 * (knee - ankle)), 0.0, 1.0)
    outer = (body.part_labels == body.part_label_names.index("body"))[mesh.faces].all(axis=1)
    masks = {name: mask[mesh.faces].all(axis=1) & outer for name, mask in where.items()}
    return mesh.with_vertices(mesh.vertices + away[:, None] * mesh.vertex_normals), masks, params


@pytest.mark.parametrize("calves", [0.0, 0.004, 0.008])
def test_calves_that_no_shape_of_the_body_has_are_no_trousers(body, calves):
    """Without colours: 4 mm off the body they were skin, at 8 mm trousers, whatever the shorts above."""
    mesh, masks, params = thick_clothes(body, calves)
    labels = label_by_body(mesh, body, params).face_labels
    area = mesh.face_areas
    for name, label in (("calf", SKIN), ("shorts", LOWER), ("shirt", UPPER)):
        own = masks[name]
        assert area[own] @ (labels[own] == label.id) > 0.85 * area[own].sum(), name


def test_who_wears_nothing_wears_no_shirt(body):
    """Without colours the bare body was labelled shirt, shoes and hair; as leggings look the same, it is not sure."""
    params = BodyParams.rest()
    mesh = body.mesh(body.forward(params).vertices[0])
    result = label_by_body(mesh, body, params)
    labels = result.face_labels
    below = mesh.face_centers[:, 1] < body.forward(params).joints[0, body.joint_names.index("neck"), 1]
    area = mesh.face_areas[below]
    assert area @ (labels[below] == SKIN.id) > 0.99 * area.sum()
    trunk = np.abs(mesh.face_centers[:, 1] - body.forward(params).joints[0, body.joint_names.index("spine1"), 1]) < 0.05
    assert 0.76 * UNSURE < np.median(result.confidence[trunk]) <= result.confidence[trunk].max() < UNSURE
    assert (certain_labels(mesh, body, None, params)[trunk] == SKIN.id).mean() > 0.99  # the fit may lean on it
    assert any("no hem" in note for note in result.notes)


@pytest.mark.parametrize("open_by", [0.0, 0.12])
def test_a_jacket_ends_at_its_hem_and_not_at_the_waist(body, open_by):
    """A jacket's lower half was labelled trousers, closed by a hem at the hips or open over the waist of trousers."""
    params = BodyParams.rest()
    posed = body.forward(params)
    mesh = body.mesh(posed.vertices[0])
    joint = {name: posed.joints[0, k] for k, name in enumerate(body.joint_names)}
    x, y, z = mesh.vertices.T
    hip, sleeve = joint["left_hip"][1], np.abs(x) < joint["left_wrist"][0] - 0.02
    hem, waist = hip - 0.06, hip + 0.08
    above = np.where((y > hem) & (y < joint["neck"][1] - 0.03) & sleeve, 0.06 if open_by else 0.03, 0.0)
    above = np.where((y < hem) & sleeve, 0.01, above)
    # In the opening trousers reach up to the waist, and the shirt that hangs over them stands off by 3 cm more.
    strip = (np.abs(x) < open_by) & (z > 0) & (y > hem) & (y < joint["neck"][1] - 0.2)
    above = np.where(strip, np.where(y < waist, 0.0, 0.03), above)
    labels = label_by_body(mesh.with_vertices(mesh.vertices + above[:, None] * mesh.vertex_normals), body, params)
    trunk = np.abs(x) < joint["left_shoulder"][0]
    below = (hem + 0.02, waist - 0.01, LOWER, strip) if open_by else (hem - 0.3, hem - 0.03, LOWER, ~strip)
    places = [(hem + 0.03, hem + 0.2, UPPER, ~strip), below]
    for low, high, label, part in places:
        own = ((y > low) & (y < high) & trunk & part)[mesh.faces].all(axis=1)
        area = mesh.face_areas[own]
        assert area @ (labels.face_labels[own] == label.id) > 0.9 * area.sum(), label.name


def test_boots_in_the_colour_of_dust_are_no_bare_feet_of_a_dark_person(body):
    """Tan boots are little lighter than dark skin in changing light: they became feet."""
    mesh, colors, params = painted(body, {"shirt": _BLUE, "trousers": _BLUE, "hair": (20, 18, 16)})
    skin = (colors == _SKIN_RGB).all(axis=1)
    # Skin of a dark person in light from above.
    rng = np.random.default_rng(0)
    shade = rng.uniform(0.6, 1.4, (mesh.vertex_count, 1))
    ankle = body.forward(params).joints[0, body.joint_names.index("left_ankle"), 1]
    boots = mesh.vertices[:, 1] < ankle + 0.1
    colors = np.where(skin[:, None], np.array([104, 68, 48]) * shade, colors)
    colors = np.where(boots[:, None], np.array([140, 100, 68]) * (0.8 + 0.25 * shade), colors).clip(0, 255)
    scan = mesh.with_vertices(mesh.vertices + np.where(boots, 0.011, 0.0)[:, None] * mesh.vertex_normals)
    for shod in (scan, mesh):
        labels = label_by_body(shod, body, params, colors=colors.astype(np.uint8)).face_labels
        foot = shod.face_centers[:, 1] < ankle
        assert (labels[foot] == (SHOE if shod is scan else SKIN).id).mean() > 0.9


def test_a_suit_of_one_colour_is_cut_at_the_jackets_hem(body):
    """A jacket in the colour of its trousers ended at the waist, below which the light on it fades."""
    mesh, colors, params = painted(body, {"shirt": _GREY, "trousers": _GREY, "hair": _GREY})
    joint = dict(zip(body.joint_names, body.forward(params).joints[0], strict=True))
    x, y, _ = mesh.vertices.T
    light = 1.0 - 0.1 * np.clip((joint["spine1"][1] - y) / 0.3 + 0.5, 0.0, 1.0)
    light += np.random.default_rng(1).normal(0.0, 0.08, len(y))
    grey = (colors == _GREY).all(axis=1)
    colors = np.where(grey[:, None], colors * light[:, None], colors).clip(0, 255).astype(np.uint8)
    hem, top = joint["left_hip"][1] - 0.06, joint["neck"][1] - 0.03
    inner = np.abs(x) < joint["left_elbow"][0]
    above = np.where(inner & (y < top), np.where(y > hem, 0.03, np.where(y > joint["left_ankle"][1], 0.008, 0.0)), 0.0)
    suit = mesh.with_vertices(mesh.vertices + above[:, None] * mesh.vertex_normals)
    labels = label_by_body(suit, body, params, colors=colors).face_labels
    trunk = np.abs(suit.face_centers[:, 0]) < joint["left_shoulder"][0]
    height = suit.face_centers[:, 1]
    for low, high, label in ((hem + 0.03, hem + 0.25, UPPER), (hem - 0.4, hem - 0.03, LOWER)):
        own = trunk & (height > low) & (height < high)
        assert suit.face_areas[own] @ (labels[own] == label.id) > 0.9 * suit.face_areas[own].sum(), label.name


def test_a_coat_to_the_knees_ends_over_trousers():
    """A doctor's coat was shirt and skirt, and her blue trousers were shoes."""
    places = STEP * np.arange(round(COLUMN_END / STEP))
    hem = 0.45
    # Two of ten shades.
    shade = np.where(places < hem, 1.0, 8.0)
    spread = np.exp(-0.5 * ((np.arange(10) - shade[:, None]) / 1.2) ** 2)
    ones = np.ones(len(places))
    colors, skin = spread / spread.sum(axis=1, keepdims=True), np.outer(ones, [0.0, 4.0])
    column = Rings(0.0, ones, colors, skin, np.where(places < hem, 0.015, 0.06), 0.003 * ones)
    arm = Rings(ARM_START, ones[:45], column.colors[-45:], column.skin[:45], column.distance[:45], column.spread[:45])
    # Mean of five rings of what is 1 where the surface goes round each leg.
    apart = np.convolve(places < hem, np.ones(5) / 5, mode="same")
    found = find_outfit(column, arm, OutfitConfig(), misfit=0.005, apart=apart)
    assert found.upper_start == found.lower_end == pytest.approx(hem, abs=0.02) and found.shoe_top < 0.2
    # Where nothing goes round each leg there are no trousers.
    assert not find_outfit(column, arm, OutfitConfig(), misfit=0.005, apart=0.0 * apart).has_lower


@pytest.mark.parametrize("half", [0.0, 0.05])
def test_an_open_jacket_is_told_from_a_closed_one_by_its_lips(body, half):
    """Without colours every open jacket was a shirt, and a coat's tails were trousers."""
    params = BodyParams.rest()
    posed = body.forward(params)
    mesh = body.mesh(posed.vertices[0])
    joint = {name: posed.joints[0, k] for k, name in enumerate(body.joint_names)}
    x, y, z = mesh.vertices.T
    hem, sleeve = joint["left_hip"][1] - 0.06, np.abs(x) < joint["left_wrist"][0] - 0.02
    worn = (y > hem) & (y < joint["neck"][1] - 0.03) & sleeve
    strip = worn & (np.abs(x) < half) & (z > 0)
    above = np.where(strip, 0.006, np.where(worn, 0.03, np.where(sleeve & (y < hem), 0.01, 0.0)))
    scan = mesh.with_vertices(mesh.vertices + above[:, None] * mesh.vertex_normals)
    labels = label_by_body(scan, body, params).face_labels
    for part, label in ((worn & ~strip, OUTER if half else UPPER), (strip, UPPER)):
        own = (part & (y > hem + 0.03))[mesh.faces].all(axis=1)
        assert scan.face_areas[own] @ (labels[own] == label.id) >= 0.9 * scan.face_areas[own].sum(), label.name


@pytest.mark.parametrize("hem", [0.0, 0.015])
def test_a_front_in_the_colour_of_the_trousers_is_a_waistcoat_where_it_ends_over_them(body, hem):
    """A black waistcoat over a white shirt was labelled trousers, as a bib is that goes on above the waist."""
    mesh, colors, params = painted(body, {"shirt": (240, 240, 240), "trousers": _GREY, "hair": _GREY})
    joint = dict(zip(body.joint_names, body.forward(params).joints[0], strict=True))
    x, y, z = mesh.vertices.T
    trunk = (y > joint["pelvis"][1]) & (y < joint["neck"][1] - 0.06) & (np.abs(x) < joint["left_shoulder"][0])
    front = trunk & (z > joint["spine2"][2])
    colors[front] = _GREY
    moved = mesh.vertices + np.where(trunk, hem, 0.0)[:, None] * mesh.vertex_normals
    labels = label_by_body(mesh.with_vertices(moved), body, params, colors=colors).face_labels
    own = front[mesh.faces].all(axis=1) & (mesh.face_centers[:, 1] > joint["spine1"][1] + 0.05)
    share = mesh.face_areas[own] @ (labels[own] == (UPPER if hem else LOWER).id) / mesh.face_areas[own].sum()
    assert share > 0.8


@pytest.mark.parametrize("heels", [False, True])
def test_shoes_in_the_colour_of_skin_are_told_by_their_heels(body, heels):
    """Pumps in the colour of skin became bare feet; a person on tiptoe has them."""
    _, colors, params = painted(body, {"shirt": _BLUE, "trousers": _GREY, "hair": _GREY})
    pose = params.body_pose.copy()
    names = list(body.joint_names)
    for side in ("left", "right"):
        pose[0, 3 * names.index(f"{side}_ankle") - 3] = np.radians(45.0)
        pose[0, 3 * names.index(f"{side}_foot") - 3] = np.radians(-30.0)
    params = replace(params, body_pose=pose)
    posed = body.forward(params)
    feet = body.mesh(posed.vertices[0])
    points, faces = [feet.vertices], [feet.faces]
    floor = feet.vertices[:, 1].min()
    for side in ("left", "right") if heels else ():
        ankle = posed.joints[0, names.index(f"{side}_ankle")]
        # A post of 2 cm from the floor up to the heel, 4 cm behind the ankle.
        corner = np.array([[a, b, c] for a in (-0.01, 0.01) for b in (0.0, 1.0) for c in (-0.05, -0.03)])
        post = np.stack(
            [ankle[0] + corner[:, 0], floor + corner[:, 1] * (ankle[1] - 0.06 - floor), ankle[2] + corner[:, 2]], 1
        )
        sides = np.array(
            [
                [0, 1, 3],
                [0, 3, 2],
                [4, 6, 7],
                [4, 7, 5],
                [0, 4, 5],
                [0, 5, 1],
                [2, 3, 7],
                [2, 7, 6],
                [0, 2, 6],
                [0, 6, 4],
            ]
        )
        faces.append(sides + sum(map(len, points)))
        points.append(post)
    scan = TriangleMesh(np.concatenate(points), np.concatenate(faces))
    painted_too = np.concatenate([colors, np.tile(np.uint8(_SKIN_RGB), (scan.vertex_count - len(colors), 1))])
    labels = label_by_body(scan, body, params, colors=painted_too).face_labels
    toes = scan.face_centers[:, 1] < floor + 0.03
    assert (labels[toes] == (SHOE if heels else SKIN).id).mean() > 0.9


def test_a_dress_without_a_hem_at_the_waist_is_one_garment(body):
    """A dress was cut at the waist: what goes round both legs, with no hem above, is one garment, labelled upper."""
    params = BodyParams.rest()
    posed = body.forward(params)
    mesh = body.mesh(posed.vertices[0])
    joint = {name: posed.joints[0, k] for k, name in enumerate(body.joint_names)}
    x, y, z = mesh.vertices.T
    knee, waist, neck = joint["left_knee"][1], joint["spine1"][1], joint["neck"][1] - 0.04
    inner = np.abs(x) < joint["left_elbow"][0] - 0.08
    above = np.where((y > waist) & (y < neck) & inner, 0.012, 0.0)
    dressed = mesh.with_vertices(mesh.vertices + above[:, None] * mesh.vertex_normals)
    # The skirt, an elliptic frustum of 40 rings from the trunk's girth at the waist to the knees, hides the thighs.
    kept = ((y < knee) | (y > waist) | ~inner)[mesh.faces].all(axis=1)
    ring = (np.abs(y - waist) < 0.02) & inner
    half = np.array([np.abs(x[ring]).max(), np.ptp(z[ring]) / 2]) + 0.012
    turn, down = np.meshgrid(np.linspace(0, 2 * np.pi, 80, endpoint=False), np.linspace(0, 1, 40))
    size = 1.0 + down
    points = np.stack(
        [half[0] * size * np.sin(turn), waist - down * (waist - knee), half[1] * size * np.cos(turn)], axis=2
    )
    points[:, :, 2] += 0.5 * (z[ring].max() + z[ring].min())
    first = 80 * np.arange(39)[:, None] + np.arange(80)
    right = 80 * np.arange(39)[:, None] + (np.arange(80) + 1) % 80
    faces = np.concatenate(
        [np.stack(t, axis=2).reshape(-1, 3) for t in ((first, first + 80, right + 80), (first, right + 80, right))]
    )
    skirt = TriangleMesh(points.reshape(-1, 3), faces)
    scan = TriangleMesh(
        np.concatenate([dressed.vertices, skirt.vertices]),
        np.concatenate([dressed.faces[kept], skirt.faces + dressed.vertex_count]),
    )
    result = label_by_body(scan, body, params)
    of_skirt = result.face_labels[kept.sum() :]
    assert (of_skirt == UPPER.id).mean() > 0.9 and not (result.face_labels == LOWER.id).any()
    assert any("no seam at the waist" in note for note in result.notes)


def test_a_distance_on_the_body_is_skin_and_a_centimetre_above_it_cloth():
    """Densities against numbers by hand, and no jump where the body itself is uncertain."""
    ratio = cloth_against_skin(np.array([0.0, 0.0035, 0.014, 0.03]), np.zeros(4))
    by_hand = np.log(14 / 49 * np.exp(-2.0)) - np.log(0.5 / (8 * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (14 / 8) ** 2))
    assert ratio[0] < -3.0 and abs(ratio[1]) < 0.2 and ratio[3] == 3.0
    assert ratio[2] == pytest.approx(by_hand, abs=1e-6)
    wide = cloth_against_skin(np.array([0.014]), np.array([0.02]))
    assert 0.0 < wide[0] < ratio[2]


def test_legs_alone_wear_a_lower_garment(body, scanned):
    mesh, colors, truth, params = scanned
    kept = mesh.face_centers[:, 1] < mesh.vertices[:, 1].min() + 0.5 * np.ptp(mesh.vertices[:, 1])
    part, index = mesh.submesh(kept)
    found = label_by_body(part, body, params, colors=colors[index]).face_labels
    assert accuracy(part, found, truth[kept]) > 0.95 and not (found == UPPER.id).any()


def test_bare_arms_in_changing_light_are_no_sleeves():
    """A girl's bare arms, in shades of skin from the shoulder to the wrist with stains on each, were sleeves."""
    count = 45
    shade = np.linspace(1.0, 3.0, count)
    colors = np.exp(-0.5 * ((np.arange(5) - shade[:, None]) / 0.9) ** 2)
    colors = np.hstack([colors / colors.sum(axis=1, keepdims=True), np.zeros((count, 1))])
    skin = np.tile([3.0, 0.45], (count, 1))
    arm = Rings(ARM_START, np.ones(count), colors, skin, np.full(count, 0.002), np.full(count, 0.005))
    rings = round(COLUMN_END / STEP)
    red = np.tile(np.eye(6)[5], (rings, 1))
    shirt = Rings(0.0, np.ones(rings), red, np.tile([0.0, 3.9], (rings, 1)), np.full(rings, 0.015), np.zeros(rings))
    assert find_outfit(shirt, arm, OutfitConfig(), misfit=0.008).cuff <= 0.0


@pytest.mark.parametrize("ball_is_a_thing", [True, False])
def test_what_a_hand_holds_does_not_give_the_colour_of_skin(ball_is_a_thing):
    # 100 faces of each: the face with as much brown hair, the left hand, and the right hand behind a brown ball.
    rng = np.random.default_rng(0)
    skin, brown = np.array([0.75, 0.04, 0.05]), np.array([0.4, 0.03, 0.03])
    lab = np.repeat([skin, brown, skin, skin, brown, brown], (100, 100, 100, 20, 80, 100), axis=0)
    lab = lab + rng.normal(0, 0.005, lab.shape)
    rows = np.arange(500)
    face, left, right = rows < 200, (rows >= 200) & (rows < 300), (rows >= 300)
    area = np.ones(500)
    if ball_is_a_thing:
        area[320:] = 0.0
    else:
        face = face & (rows < 150)
    found = fit_skin(lab, face, (left, right), area)
    assert found.found and found.hands
    np.testing.assert_allclose(found.center, skin, atol=0.01)


def test_gloves_are_no_skin():
    skin, glove = np.array([0.75, 0.04, 0.05]), np.array([0.3, 0.0, 0.0])
    lab = np.repeat([skin, glove], 100, axis=0) + np.random.default_rng(0).normal(0, 0.005, (200, 3))
    rows = np.arange(200)
    found = fit_skin(lab, rows < 100, ((rows >= 100) & (rows < 150), rows >= 150), np.ones(200))
    assert found.hands is False
    np.testing.assert_allclose(found.center, skin, atol=0.01)


def test_shares_of_labels_are_sums_over_all_outlines():
    rng = np.random.default_rng(0)
    rings = 5
    there = np.triu(np.ones((rings + 1, rings + 1), dtype=bool))
    order = [np.where(there, rng.uniform(0, 20, there.shape), np.inf) for _ in RUNS]
    expected, total = np.zeros((rings, len(LABELS))), 0.0
    for inner in combinations_with_replacement(range(rings + 1), len(RUNS) - 1):
        cuts = (0, *inner, rings)
        weight = np.exp(-sum(cost[a, b] for cost, a, b in zip(order, cuts[:-1], cuts[1:], strict=True)) / NAT)
        total += weight
        for label, a, b in zip(RUNS, cuts[:-1], cuts[1:], strict=True):
            expected[a:b, label.id] += weight
    shares = label_shares(order)
    np.testing.assert_allclose(shares, expected / total, atol=1e-12)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)


def test_wrong_input_is_refused(body, scanned):
    mesh, colors, _, params = scanned
    with pytest.raises(InputError, match="one frame"):
        label_by_body(mesh, body, BodyParams.concatenate([params, params]), colors=colors)
    with pytest.raises(InputError, match="vertex colours"):
        label_by_body(mesh, body, params, colors=colors[:-1])
    with pytest.raises(InputError, match="out of range"):
        label_by_body(mesh, body, params, colors=colors.astype(np.float64))


def test_a_body_that_is_not_in_the_scan_leaves_nothing_sure(body, scanned):
    mesh, colors, _, params = scanned
    elsewhere = replace(params, transl=params.transl + 0.5)
    result = label_by_body(mesh, body, elsewhere, colors=colors)
    assert result.confidence.max() < 0.5
    assert any("no label can be trusted" in note for note in result.notes)


def test_a_head_alone_is_labelled_and_nothing_at_all_is_refused(body, scanned):
    mesh, colors, truth, params = scanned
    kept = mesh.face_centers[:, 1] > 1.42
    part, index = mesh.submesh(kept)
    found = label_by_body(part, body, params, colors=colors[index]).face_labels
    assert accuracy(part, found, truth[kept]) > 0.9
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    with pytest.raises(InputError, match="faces"):
        label_by_body(empty, body, params)


def test_votes_of_few_views_are_completed_by_the_body(scanned, labelled):
    mesh, colors, truth, _ = scanned
    votes = np.zeros((mesh.face_count, len(LABELS)))
    front = mesh.face_normals[:, 2] > 0.3
    votes[np.flatnonzero(front), truth[front]] = 3.0
    prior = labelled
    alone = segment_scan(mesh, votes=votes)
    both = segment_scan(mesh, votes=votes, colors=colors, prior=prior)
    assert accuracy(mesh, both.face_labels, truth) > max(accuracy(mesh, alone.face_labels, truth), 0.98)
    assert (both.face_labels == truth)[front].mean() > 0.995
    with pytest.raises(InputError, match="prior"):
        segment_scan(mesh.submesh(np.arange(1000))[0], votes=votes[:1000], prior=prior)


@pytest.mark.parametrize("boots", [False, True])
def test_light_that_fades_along_trousers_is_no_top_of_boots(boots):
    """A real man in black had boots: light faded along his trousers more than it changed at his shoes."""
    places = STEP * np.arange(round(COLUMN_END / STEP))
    # Shade among 30 neighbouring ones: shoes 0 to 2; trousers from 3 on, lighter by one every 15 cm; shirt.
    shade = np.where(places < 0.09, 1.0, 4.0 + np.clip(places - 0.09, 0.0, 0.9) / 0.15)
    shade = np.where(places > 0.96, 25.0, shade)
    if boots:
        shade = np.where(places < 0.40, 1.0, 12.0)
    spread = np.exp(-0.5 * ((np.arange(30) - shade[:, None]) / 1.2) ** 2)
    ones = np.ones(len(places))
    column = Rings(
        0.0, ones, spread / spread.sum(axis=1, keepdims=True), np.outer(ones, [0.0, 4.0]), 0.012 * ones, 0.003 * ones
    )
    arm = Rings(ARM_START, ones[:45], column.colors[-45:], column.skin[:45], column.distance[:45], column.spread[:45])
    found = find_outfit(column, arm, OutfitConfig(), misfit=0.005)
    assert found.shoe_top == pytest.approx(0.40 if boots else 0.09, abs=0.02)
