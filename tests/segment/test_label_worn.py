"""What a painted or padded body wears is told: jackets, suits, dresses, boots, heels, and nothing at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import BodyModel, load_body
from smplxpp.build.locate import certain_labels
from smplxpp.core.labels import HAIR, LABELS, LOWER, OUTER, SHOE, SKIN, UPPER
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.segment import UNSURE, label_by_body

_SKIN_RGB, _BLUE, _GREY = (222, 176, 150), (58, 98, 170), (90, 90, 94)


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body()


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


@pytest.mark.long
def test_a_bald_person_with_bare_feet_has_neither_hair_nor_shoes(body):
    mesh, colors, params = painted(body, {"shirt": _BLUE, "trousers": _GREY})
    labels = label_by_body(mesh, body, params, colors=colors).face_labels
    area = mesh.face_areas / mesh.face_areas.sum()
    share = np.array([area[labels == k].sum() for k in range(len(LABELS))])
    assert share[HAIR.id] < 0.002 and share[SHOE.id] < 0.002
    assert share[UPPER.id] > 0.2 and share[LOWER.id] > 0.2 and share[SKIN.id] > 0.15


@pytest.mark.long
def test_a_garment_that_may_be_one_or_two_is_not_sure(body):
    """Shirt and trousers of two colours, and the same of one: what is upper and what lower is a guess then."""
    sure = []
    for trousers in (_GREY, _BLUE):
        mesh, colors, params = painted(body, {"shirt": _BLUE, "trousers": trousers, "hair": _GREY})
        result = label_by_body(mesh, body, params, colors=colors)
        cloth = np.isin(result.face_labels, (UPPER.id, LOWER.id))
        sure.append(mesh.face_areas[cloth] @ result.confidence[cloth] / mesh.face_areas[cloth].sum())
    assert sure[0] > 0.88 and sure[1] < sure[0] - 0.05


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
@pytest.mark.long
def test_calves_that_no_shape_of_the_body_has_are_no_trousers(body, calves):
    """Without colours: 4 mm off the body they were skin, at 8 mm trousers, whatever the shorts above."""
    mesh, masks, params = thick_clothes(body, calves)
    labels = label_by_body(mesh, body, params).face_labels
    area = mesh.face_areas
    for name, label in (("calf", SKIN), ("shorts", LOWER), ("shirt", UPPER)):
        own = masks[name]
        assert area[own] @ (labels[own] == label.id) > 0.85 * area[own].sum(), name


@pytest.mark.long
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
@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.parametrize("half", [0.0, 0.05])
@pytest.mark.long
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
@pytest.mark.long
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
@pytest.mark.long
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


@pytest.mark.long
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
