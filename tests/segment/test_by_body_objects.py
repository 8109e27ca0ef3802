"""Things in hands are found where they are, and bound to the hand that holds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import igl
import numpy as np
import pytest
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel, PosedBody, load_body
from smplxpp.core import HAIR, OBJECT, SKIN, UPPER, BodyParams, InputError, TriangleMesh, concatenate_meshes
from smplxpp.core.topology import face_adjacency
from smplxpp.people.cloth_mesh import outer_faces
from smplxpp.people.scan_simulation import ScanConfig, simulate_scan
from smplxpp.people.things import THINGS, WORN, Thing, _joined, _tube, thing_mesh
from smplxpp.segment import by_body, by_body_objects, label_by_body
from smplxpp.segment.by_body_chart import chart_of_scan
from smplxpp.segment.by_body_confidence import notes_on_worn_things
from smplxpp.segment.by_body_headwear import find_headwear
from smplxpp.segment.by_body_objects import FoundObjects, _enclosed, _Where, find_objects
from smplxpp.segment.flat_patches import flat_share
from smplxpp.transfer import rigid_weights

_COARSE = ScanConfig(cell=0.015, views=14, resolution=256, faces=6000)


@pytest.fixture(scope="module")
def open_body() -> BodyModel:
    return load_body()


@pytest.fixture(scope="module")
def stance(open_body: BodyModel) -> tuple[BodyParams, PosedBody]:
    """The body with its arms 40 degrees below the horizon."""
    pose = np.zeros((1, open_body.joint_count, 3))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[0, open_body.joint_names.index(f"{side}_shoulder"), 2] = sign * np.radians(40.0)
    params = BodyParams.from_full_pose(
        pose,
        betas=np.zeros(open_body.num_betas),
        expression=np.zeros(open_body.num_expressions),
        transl=np.zeros(3),
    )
    return params, open_body.forward(params)


@pytest.fixture(scope="module")
def scan(open_body, stance):
    """A coarse scan of her with a case in the right hand, and which of its faces show the case."""
    _, posed = stance
    skin = open_body.mesh(posed.vertices[0])
    case = thing_mesh(Thing("case", "right"), open_body, posed)
    taken = simulate_scan(concatenate_meshes([skin, case]), [], _COARSE)
    shown = taken.face >= skin.face_count
    return taken.mesh, shown[taken.mesh.faces].sum(axis=1) >= 2


def test_a_case_in_the_hand_is_found_and_nothing_else(open_body, stance, scan):
    mesh, truth = scan
    found = find_objects(mesh, open_body, stance[0])
    area = mesh.face_areas
    assert area[found.faces & truth].sum() > 0.85 * area[truth].sum()
    assert area[found.faces & ~truth].sum() < 0.05 * area[truth].sum()
    assert len(found.notes) == 1 and "cm2 at a hand" in found.notes[0]


@pytest.mark.parametrize("kind", ["shoulder bag", "belt bag", "backpack"])
@pytest.mark.long
def test_a_bag_that_no_hand_touches_is_found(open_body, stance, kind):
    """A bag on a strap was shirt and trousers, which swung with a thigh."""
    params, posed = stance
    skin = open_body.mesh(posed.vertices[0])
    bag = thing_mesh(Thing(kind, "right"), open_body, posed)
    taken = simulate_scan(concatenate_meshes([skin, bag]), [], _COARSE)
    mesh, area = taken.mesh, taken.mesh.face_areas
    truth = (taken.face >= skin.face_count)[mesh.faces].sum(axis=1) >= 2
    found = find_objects(mesh, open_body, params)
    assert area[found.faces & truth].sum() > 0.75 * area[truth].sum()
    assert area[found.faces & ~truth].sum() < 0.05 * area[truth].sum()
    assert [note.endswith("worn off the hands is labelled object") for note in found.notes] == [True]
    weights = rigid_weights(skin, open_body.weights, bag, joint_names=open_body.joint_names)
    carries = open_body.joint_names[weights.dense()[weights.distance.argmax()].argmax()]
    assert carries == "pelvis" or carries.startswith("spine")


@pytest.mark.long
def test_the_thing_keeps_its_label_through_the_cut_and_is_no_cloth(open_body, stance, scan):
    mesh, truth = scan
    result = label_by_body(mesh, open_body, stance[0])
    own = result.face_labels == OBJECT.id
    assert mesh.face_areas[own & truth].sum() > 0.85 * mesh.face_areas[truth].sum()
    assert any("labelled object" in note for note in result.notes)


@pytest.mark.long
def test_a_folder_that_the_forearm_presses_is_found_on_both_sides_and_the_sleeve_is_no_part_of_it(open_body, stance):
    """A folder along the forearm lies nearer to the arm than cloth does: half of it stayed shirt and was torn."""
    _, posed = stance
    skin, folder = (
        open_body.mesh(posed.vertices[0]),
        thing_mesh(Thing("folder", "right"), open_body, posed),
    )
    taken = simulate_scan(concatenate_meshes([skin, folder]), [], _COARSE)
    mesh, area = taken.mesh, taken.mesh.face_areas
    truth = (taken.face >= skin.face_count)[mesh.faces].sum(axis=1) >= 2
    found = find_objects(mesh, open_body, stance[0]).faces
    assert area[found & truth].sum() > 0.9 * area[truth].sum()
    assert area[found & ~truth].sum() < 0.05 * area[truth].sum()


@pytest.mark.long
def test_a_stick_is_found_on_both_sides_of_the_fist_that_it_goes_on_smoothly_into(open_body, stance):
    """One end of it was skin, because the short border at the fist lies in no fold, and no colour tells it."""
    skin, stick = open_body.mesh(stance[1].vertices[0]), thing_mesh(Thing("stick", "left"), open_body, stance[1])
    taken = simulate_scan(concatenate_meshes([skin, stick]), [], _COARSE)
    mesh, area = taken.mesh, taken.mesh.face_areas
    truth = (taken.face >= skin.face_count)[mesh.faces].sum(axis=1) >= 2
    found = find_objects(mesh, open_body, stance[0])
    assert area[found.faces & truth].sum() > 0.75 * area[truth].sum()
    assert area[found.faces & ~truth].sum() < 0.05 * area[truth].sum()
    assert len(found.notes) == 2


@pytest.mark.long
@pytest.mark.parametrize("kind", ["bottle", "stick"])
def test_both_ends_of_what_is_in_a_fist_are_found_by_their_colour_and_the_fist_stays(open_body, stance, kind):
    """Fitted fingers bent into a bottle, so that one half of it was skin to which the next fit drew them."""
    skin, thing = open_body.mesh(stance[1].vertices[0]), thing_mesh(Thing(kind, "left"), open_body, stance[1])
    taken = simulate_scan(concatenate_meshes([skin, thing]), [], _COARSE)
    mesh, area = taken.mesh, taken.mesh.face_areas
    truth = (taken.face >= skin.face_count)[mesh.faces].sum(axis=1) >= 2
    pose = stance[0].full_pose.copy()
    fingers = [f"left_{name}{k}" for name in ("index", "middle", "ring", "pinky") for k in (1, 2, 3)]
    pose[0, [open_body.joint_names.index(name) for name in fingers], 2] = -0.5
    fitted = BodyParams.from_full_pose(
        pose, betas=stance[0].betas, expression=stance[0].expression, transl=stance[0].transl
    )
    lab = np.where(truth[:, None], (0.4, 0.05, 0.06), (0.7, 0.04, 0.04))
    lab += 0.01 * np.random.default_rng(0).normal(size=lab.shape)
    found = find_objects(mesh, open_body, fitted, lab=lab).faces
    assert area[found & truth].sum() > 0.95 * area[truth].sum()
    assert area[found & ~truth].sum() < 0.05 * area[truth].sum()
    # A colour that the person has about it tells nothing.
    alike, plain = (find_objects(mesh, open_body, fitted, lab=lab).faces for lab in (np.full_like(lab, 0.5), None))
    np.testing.assert_array_equal(alike, plain)


@pytest.mark.parametrize("other", ["none", "of cloth", "in a hand"])
def test_what_is_alike_at_both_arms_is_a_sleeve_unless_both_are_things(open_body, stance, other, monkeypatch):
    """One of a kimono's sleeves passed for a thing, because its border was shorter than the other's by a little."""

    params, posed = stance
    skin = open_body.mesh(posed.vertices[0])
    sides = ["right"] if other == "none" else ["right", "left"]
    plain = [thing_mesh(Thing("case", side), open_body, posed) for side in sides]
    things = [TriangleMesh(*igl.upsample(np.array(thing.vertices), np.array(thing.faces), 2)) for thing in plain]
    mesh = concatenate_meshes([skin, *things])
    ends = np.cumsum([skin.face_count, *(thing.face_count for thing in things)])
    accepted = by_body_objects._accepted

    def first_alone(*args, **keywords):
        found = accepted(*args, **keywords)
        if other == "of cloth":
            found.faces[ends[1] :] = False
        return found

    monkeypatch.setattr(by_body_objects, "_accepted", first_alone)
    found = find_objects(mesh, open_body, params).faces
    shares = [found[start:end].mean() for start, end in pairwise(ends)]
    assert min(shares) > 0.8 if other != "of cloth" else shares[0] < 0.1


def test_only_what_is_flat_over_ten_centimetres_is_a_board():
    """A sheet is flat from both sides, a tube of the radius of a thigh nowhere."""
    turn, along = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False), np.linspace(0.0, 0.4, 40))
    tube = grid_mesh(np.stack([0.08 * np.cos(turn), along, 0.08 * np.sin(turn)], axis=-1), closed=True)
    across, up = np.meshgrid(np.linspace(0.5, 0.8, 24), np.linspace(0.0, 0.4, 32))
    front = grid_mesh(np.stack([across, up, np.zeros_like(up)], axis=-1))
    back = TriangleMesh(front.vertices - [0.0, 0.0, 0.02], front.faces[:, ::-1])
    mesh = concatenate_meshes([tube, front, back])
    share = flat_share(mesh, np.ones(mesh.face_count, dtype=bool))
    sheet = np.arange(mesh.face_count) >= tube.face_count
    assert share[~sheet].max() == 0.0 and share[sheet].mean() > 0.9


def test_what_a_thing_goes_all_round_is_the_thing_unless_it_is_at_the_hand():
    """The inside of a folder, which an arm pressed, was a piece of the shirt and became a flap at the sleeve."""
    across, up = np.meshgrid(np.linspace(0.0, 0.4, 41), np.linspace(0.0, 0.4, 41))
    mesh = grid_mesh(np.stack([across, up, np.zeros_like(up)], axis=-1))
    x, y, _ = mesh.face_centers.T
    thing = (np.abs(x - 0.1) < 0.08) & (np.abs(y - 0.2) < 0.16)
    far, near = ((np.abs(x - 0.1) < 0.03) & (np.abs(y - at) < 0.03) for at in (0.28, 0.12))
    thing &= ~far & ~near
    pairs, _ = face_adjacency(mesh.faces)
    to_hand = np.hypot(x - 0.1, y - 0.12)
    none = np.zeros(mesh.face_count)
    where = _Where(none, to_hand, none.astype(int), none, none, pairs, *np.ones((2, len(pairs))))
    assert (_enclosed(mesh, thing, where) == far).all()


def grid_mesh(points: np.ndarray, *, closed: bool = False) -> TriangleMesh:
    """A surface through (rows, columns, 3) points; `closed` joins the last column to the first."""
    rows, columns = points.shape[:2]
    at = np.arange(rows * columns).reshape(rows, columns)
    after = np.roll(at, -1, axis=1)
    a, b, c, d = (x if closed else x[:, :-1] for x in (at[:-1], after[:-1], after[1:], at[1:]))
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return TriangleMesh(points.reshape(-1, 3), faces)


def test_empty_hands_hold_nothing(open_body, stance):
    params, posed = stance
    assert not find_objects(open_body.mesh(posed.vertices[0]), open_body, params).faces.any()


def test_a_hand_that_the_fit_misses_is_no_thing(open_body, stance):
    """Arms fitted 8 degrees too high: the scan's own hands lie 5 to 8 cm off the body's and were taken for things."""
    params, posed = stance
    pose = params.full_pose.copy()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        pose[0, open_body.joint_names.index(f"{side}_shoulder"), 2] += sign * np.radians(8.0)
    wrong = BodyParams.from_full_pose(pose, betas=params.betas, expression=params.expression, transl=params.transl)
    assert not find_objects(open_body.mesh(posed.vertices[0]), open_body, wrong).faces.any()


def test_what_stands_beside_the_person_is_no_thing_in_her_hand(open_body, stance):
    """The same case half a metre beside the hand."""
    params, posed = stance
    case = thing_mesh(Thing("case", "right"), open_body, posed)
    beside = case.with_vertices(case.vertices - [0.5, 0.0, 0.0])
    mesh = concatenate_meshes([open_body.mesh(posed.vertices[0]), beside])
    assert not find_objects(mesh, open_body, params).faces.any()


@pytest.mark.long
def test_a_skirt_that_stands_off_the_legs_all_round_is_no_thing(open_body, stance):
    """A cone from the hips to the ankles, half a metre wide at the hem, which begins at the hands."""
    params, posed = stance
    skin = open_body.mesh(posed.vertices[0])
    hands = posed.joints[0, [open_body.joint_names.index(f"{side}_wrist") for side in ("left", "right")]]
    pelvis, top = posed.joints[0, 0], hands[:, 1].max() + 0.05
    turn, down = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, 80, endpoint=False), np.linspace(0.0, 1.0, 40), indexing="ij"
    )
    wide = np.linalg.norm((hands - pelvis)[:, [0, 2]], axis=1).mean()
    radius = wide + 0.1 * down
    height = top + down * (skin.vertices[:, 1].min() + 0.1 - top)
    points = np.stack([pelvis[0] + radius * np.sin(turn), height, pelvis[2] + radius * np.cos(turn)], axis=-1)
    at = np.arange(80 * 40).reshape(80, 40)
    a, b, c, d = at[:, :-1], np.roll(at, -1, axis=0)[:, :-1], np.roll(at, -1, axis=0)[:, 1:], at[:, 1:]
    faces = np.concatenate([np.stack([a, d, b], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    skirt = TriangleMesh(points.reshape(-1, 3), faces)
    assert not find_objects(concatenate_meshes([skin, skirt]), open_body, params).faces.any()


@pytest.mark.long
def test_no_thing_is_sought_beside_a_body_that_is_not_at_the_face(open_body, stance, scan):
    mesh, _ = scan
    params, _ = stance
    elsewhere = replace(params, transl=params.transl + [0.0, 0.0, 0.25])
    result = label_by_body(mesh, open_body, elsewhere)
    assert not (result.face_labels == OBJECT.id).any() and any("no label can be trusted" in n for n in result.notes)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_thing_follows_the_wrist_that_holds_it_and_a_hat_the_head(open_body, stance, side):
    _, posed = stance
    skin = open_body.mesh(posed.vertices[0])
    held = thing_mesh(Thing("ball", side), open_body, posed)
    top = skin.vertices[skin.vertices[:, 1].argmax()]
    hat = held.with_vertices(held.vertices - held.vertices.mean(axis=0) + top + [0.0, 0.12, 0.0])
    weights = rigid_weights(skin, open_body.weights, concatenate_meshes([held, hat]), joint_names=open_body.joint_names)
    names = np.array(open_body.joint_names)[weights.dense().argmax(axis=1)]
    count = held.vertex_count
    assert set(names[:count]) == {f"{side}_wrist"} and set(names[count:]) == {"head"}
    assert weights.policies == (f"rigid:{side}_wrist", "rigid:head")
    # Rigid: all distances stay whatever the wrist does.
    assert (weights.dense().max(axis=1) == 1.0).all()


def test_things_are_closed_and_wound_outwards(open_body, stance):
    for kind in (*THINGS, *WORN):
        mesh = thing_mesh(Thing(kind), open_body, stance[1])
        assert len(mesh.border_edges) == 0, kind
        assert np.einsum("ij,ij->", mesh.face_centers - mesh.vertices.mean(axis=0), mesh.face_cross) > 0, kind


def test_what_is_worn_is_where_it_is_worn(open_body, stance):
    joints = dict(zip(open_body.joint_names, stance[1].joints[0], strict=True))
    bag = thing_mesh(Thing("shoulder bag", "left"), open_body, stance[1]).vertices
    # The strap passes over the right shoulder, outside of the skin, and the bag hangs beside the left hip.
    assert np.abs(bag[bag[:, 1].argmax(), [0, 1]] - joints["right_collar"][:2]).max() < 0.15
    assert bag[:, 0].max() > joints["left_hip"][0] + 0.1 and bag[:, 1].min() < joints["left_hip"][1]
    hat = thing_mesh(Thing("brimmed hat"), open_body, stance[1]).vertices
    assert hat[:, 1].min() > joints["left_eye_smplhf"][1] and np.ptp(hat[:, 0]) > 0.35
    glasses = thing_mesh(Thing("glasses"), open_body, stance[1]).vertices
    assert np.abs(glasses[:, 1] - joints["left_eye_smplhf"][1]).max() < 0.04


@pytest.fixture(scope="module")
def with_things(open_body, stance) -> Callable[..., tuple[TriangleMesh, np.ndarray, np.ndarray]]:
    """The skin with things as fine as a scan, which of the faces are theirs, and which of these show."""
    skin = open_body.mesh(stance[1].vertices[0])
    tree = cKDTree(skin.vertices)

    def made(*kinds: str) -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
        worn = [thing_mesh(Thing(kind), open_body, stance[1]) for kind in kinds]
        fine = [TriangleMesh(*igl.upsample(one.vertices, one.faces, 3)) for one in worn]
        mesh = concatenate_meshes([skin, *fine])
        distance, at = tree.query(mesh.face_centers)
        outside = np.einsum("ij,ij->i", mesh.face_centers - skin.vertices[at], skin.vertex_normals[at]) > 0.5 * distance
        own = np.arange(mesh.face_count) >= skin.face_count
        return mesh, own, own & outside & (distance > 0.01)

    return made


@pytest.fixture(scope="module")
def head(open_body, stance) -> TriangleMesh:
    """Her head alone, without what lies within it."""
    skin = open_body.mesh(stance[1].vertices[0])
    kept = (skin.face_centers[:, 1] > stance[1].joints[0, open_body.joint_names.index("neck"), 1]) & outer_faces(
        open_body
    )
    return skin.submesh(kept)[0]


def scanned_head(head: TriangleMesh, *worn: TriangleMesh, cell: float = 0.006) -> tuple[TriangleMesh, np.ndarray]:
    """A scan of a head with what it wears, and which of its faces show that; cells in metres."""
    taken = simulate_scan(
        concatenate_meshes([head, *worn]), [], ScanConfig(cell=cell, views=12, resolution=128, faces=4000)
    )
    return taken.mesh, (taken.face >= head.face_count)[taken.mesh.faces].sum(axis=1) >= 2


@pytest.mark.parametrize("kind", ["sunglasses", "goggles", "brimmed hat", "top hat", "cap", "headphones"])
@pytest.mark.long
def test_what_is_worn_on_the_head_is_an_object_and_stiff_on_it(open_body, stance, head, kind):
    """Glasses were skin, hats hair, and lenses that lie nearest to an eyeball turned with it."""
    worn = thing_mesh(Thing(kind), open_body, stance[1])
    # Lenses are thin; the others are as well found in a third of the cells.
    mesh, truth = scanned_head(head, worn, cell=0.006 if kind in ("sunglasses", "goggles") else 0.008)
    found = find_headwear(mesh, open_body, stance[0], *face_adjacency(mesh.faces))
    area = mesh.face_areas
    assert area[found.faces & truth].sum() > 0.85 * area[truth].sum()
    assert area[found.faces & ~truth].sum() < 0.1 * area[truth].sum()
    assert "on the head" in found.notes[0] and len(found.notes) == 1
    skin = open_body.mesh(stance[1].vertices[0])
    weights = rigid_weights(skin, open_body.weights, worn, joint_names=open_body.joint_names)
    assert {open_body.joint_names[k] for k in weights.dense().argmax(axis=1)} == {"head"}


@pytest.mark.long
def test_frames_without_lenses_are_glasses(open_body, stance, head):
    """Two characters with clear glasses wore none: a frame covers a sixth of the surface about an eye."""
    at = dict(zip(open_body.joint_names, stance[1].joints[0], strict=True))
    bars = []
    for eye in (at["left_eye_smplhf"], at["right_eye_smplhf"]):
        low, high = eye + [-0.026, -0.019, 0.026], eye + [0.026, 0.019, 0.026]
        corners = [low, [high[0], *low[1:]], high, [low[0], *high[1:]]]
        bars += [_tube(0.005, tuple(a), tuple(b)) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]
    mesh, truth = scanned_head(head, _joined(bars))
    found = find_headwear(mesh, open_body, stance[0], *face_adjacency(mesh.faces))
    assert mesh.face_areas[found.faces & truth].sum() > 0.5 * mesh.face_areas[truth].sum()


def rims(head: TriangleMesh, eyes: list[np.ndarray], *, off: float, lenses: bool) -> TriangleMesh:
    """Rims of 5.6 mm about both eyes that stand off the skin behind them, down to it, as scans show thin glasses."""
    turn, thick, pieces = np.linspace(0.0, 2.0 * np.pi, 21)[:-1], 0.0028, []
    for eye in eyes:
        ring = eye + np.stack([0.025 * np.cos(turn), 0.021 * np.sin(turn), 0.0 * turn], axis=1)
        for point in ring:
            behind = (np.hypot(*(head.vertices - point)[:, :2].T) < 0.005) & (head.vertices[:, 2] > point[2] - 0.03)
            point[2] = head.vertices[behind, 2].max() + off - thick
        tubes = [_tube(thick, tuple(a), tuple(b)) for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)]
        pieces += [np.concatenate([tube, tube - [0.0, 0.0, 0.01]]) for tube in tubes]
        pieces += [np.concatenate([ring, ring - [0.0, 0.0, 0.015]])] * lenses
    return _joined(pieces)


@pytest.mark.parametrize(
    ("off", "lenses", "colored"),
    [(0.006, False, False), (0.008, False, False), (0.004, False, True), (0.007, True, False), (0.005, True, True)],
)
@pytest.mark.long
def test_thin_glasses_that_a_scan_fused_with_the_face_are_found(open_body, stance, head, off, lenses, colored):
    """Glasses within 8 mm of the face were skin: a rim is a narrow ring on the cheeks, a lens a step down to them."""
    at = dict(zip(open_body.joint_names, stance[1].joints[0], strict=True))
    eyes = [at[f"{side}_eye_smplhf"] for side in ("left", "right")]
    mesh, truth = scanned_head(head, rims(head, eyes, off=off, lenses=lenses), cell=0.0055)
    lab = np.where(truth[:, None], [0.3, 0.0, 0.0], [0.7, 0.04, 0.05]) if colored else None
    found = find_headwear(mesh, open_body, stance[0], *face_adjacency(mesh.faces), lab=lab).faces
    assert mesh.face_areas[found & truth].sum() > 0.5 * mesh.face_areas[truth].sum()
    assert mesh.face_areas[found & ~truth].sum() < 0.5 * mesh.face_areas[truth].sum()


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.long
def test_a_bare_face_that_the_body_misses_wears_no_glasses(open_body, stance, head, dark):
    """A body of another shape misses cheeks and brows by millimetres; eyes, and what is under them, may be dark."""
    mesh, _ = scanned_head(head)
    eyes = [stance[1].joints[0, open_body.joint_names.index(f"{side}_eye_smplhf")] for side in ("left", "right")]
    off = np.min([np.hypot(*(mesh.face_centers - eye)[:, :2].T) for eye in eyes], axis=0)
    lab = np.array([0.7, 0.04, 0.05]) - np.interp(off, (0.01, 0.025), (0.4, 0.0))[:, None] * [1.0, 0.0, 0.0]
    for seed in range(3):
        betas = np.random.default_rng(seed).normal(0.0, 0.3, open_body.num_betas) * (
            np.arange(open_body.num_betas) < 16
        )
        params = replace(stance[0], betas=betas[None] if stance[0].betas.ndim == 2 else betas)
        moved = stance[1].joints[0] - open_body.forward(params).joints[0]
        params = replace(params, transl=params.transl + moved[open_body.joint_names.index("left_eye_smplhf")])
        found = find_headwear(mesh, open_body, params, *face_adjacency(mesh.faces), lab=lab if dark else None)
        assert not found.faces.any(), found.notes


@pytest.mark.long
def test_hair_hoods_and_bare_heads_wear_nothing(open_body, stance, head):
    """A bun, a ponytail behind, two buns over the ears, one beside a bulge, long hair and a hood round the face."""
    at = dict(zip(open_body.joint_names, stance[1].joints[0], strict=True))
    middle = 0.5 * (at["left_eye_smplhf"] + at["right_eye_smplhf"]) + [0.0, 0.02, -0.08]
    ball = TriangleMesh(*igl.upsample(*convex_ball(), 2))

    def blob(size: tuple[float, float, float], place: tuple[float, float, float]) -> TriangleMesh:
        return ball.with_vertices(ball.vertices * size + middle + place)

    def around(size: tuple[float, float, float], front: float) -> TriangleMesh:
        """All round the head but for the face, which comes out of it."""
        whole = blob(size, (0.0, -0.02, 0.0))
        return whole.with_vertices(np.minimum(whole.vertices, [np.inf, np.inf, middle[2] + front]))

    for worn in (
        [blob((0.045, 0.045, 0.045), (0.0, 0.1, -0.06)), blob((0.02, 0.02, 0.12), (0.0, 0.0, -0.2))],
        [blob((0.04, 0.05, 0.04), (sign * 0.1, 0.05, -0.01)) for sign in (1.0, -1.0)],
        [blob((0.03, 0.035, 0.035), (0.1, -0.02, 0.0)), blob((0.06, 0.13, 0.13), (-0.06, -0.02, 0.0))],
        [around((0.1, 0.16, 0.13), 0.03)],
        [around((0.13, 0.19, 0.16), 0.06)],
    ):
        mesh, _ = scanned_head(head, *worn)
        found = find_headwear(mesh, open_body, stance[0], *face_adjacency(mesh.faces))
        assert not found.faces.any(), found.notes


def convex_ball() -> tuple[np.ndarray, np.ndarray]:
    """An octahedron's vertices and faces refined to a ball of radius 1."""
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    points, faces = igl.upsample(corners, faces, 3)
    return points / np.linalg.norm(points, axis=1, keepdims=True), faces


@pytest.mark.long
def test_glasses_outlive_the_removal_of_fragments_and_pull_no_body(open_body, stance, with_things):
    """They are smaller than any garment; a hat pulled the body that is moved onto the scan 15 mm off the face."""
    mesh, _, shown = with_things("glasses", "cap")
    result = label_by_body(mesh, open_body, stance[0])
    found = result.face_labels == OBJECT.id
    assert mesh.face_areas[found & shown].sum() > 0.9 * mesh.face_areas[shown].sum()
    assert sum("on the head" in note for note in result.notes) == 2
    assert not any("misses face and hands" in note for note in result.notes)


@pytest.mark.long
def test_under_a_hat_the_face_is_found_and_a_bag_on_a_strap_is_told(open_body, stance, with_things, monkeypatch):
    """A brim was taken for the face, so that no label was trusted; a bag was clothes in silence."""
    monkeypatch.setattr(by_body, "find_headwear", lambda mesh, *_, **__: FoundObjects.none(mesh.face_count))
    mesh, worn, _ = with_things("brimmed hat")
    chart = chart_of_scan(mesh, open_body, stance[0])
    hat = label_by_body(mesh, open_body, stance[0])
    assert not any("no label can be trusted" in note for note in hat.notes)
    assert (hat.face_labels[worn] == HAIR.id).mean() > 0.7
    # What of its brim hangs over the face was skin.
    assert (hat.face_labels[worn & (chart.distance > 0.04)] == HAIR.id).mean() > 0.995
    mesh, *_ = with_things("shoulder bag")
    chart = chart_of_scan(mesh, open_body, stance[0])
    # The bag as a shirt, as skin, and on both sides, as a coat would stand off.
    for label, words in ((UPPER, "off the left side alone"), (SKIN, "labelled skin stand more than 5 cm off")):
        labels = np.full(mesh.face_count, label.id)
        (note,) = notes_on_worn_things(chart, mesh.face_areas, labels, misfit=0.005)
        assert words in note
        assert not notes_on_worn_things(chart, mesh.face_areas, labels, misfit=0.06)
    both = replace(chart, side=np.where(np.arange(mesh.face_count) % 2, 1, -1))
    assert not notes_on_worn_things(both, mesh.face_areas, np.full(mesh.face_count, UPPER.id), misfit=0.005)


def test_unknown_things_and_hands_are_refused():
    with pytest.raises(InputError, match="thing: expected one of binder"):
        Thing("anvil")
    with pytest.raises(InputError, match="hand"):
        Thing("ball", "both")
