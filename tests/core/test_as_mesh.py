"""Meshes, points and weights of other libraries are taken where ours are asked for, and ours are given back."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from dataclasses import fields, is_dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from scipy.sparse import csr_matrix

import avatar
import smplxpp
from smplxpp import clean, metrics, segment, skinning, transfer
from smplxpp.core import Camera, InputError, MissingExtraError, SkinWeights, TriangleMesh, as_mesh, as_points
from smplxpp.core.errors import one_line

ROOMS = (metrics, clean, transfer, segment, skinning)
BALL = trimesh.creation.icosphere(subdivisions=2)
MINE = TriangleMesh(BALL.vertices, BALL.faces)


class Tensor:
    """A tensor as open3d has it: neither an array nor a torch tensor."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def cpu(self) -> Tensor:
        return self

    def numpy(self) -> np.ndarray:
        return self._values


# The kinds of meshes by the attributes that their libraries give them.
KINDS = {
    "ours": MINE,
    "trimesh": BALL,
    "trimesh scene": trimesh.Scene(BALL),
    "pair": (BALL.vertices, BALL.faces),
    "lists": [BALL.vertices.tolist(), BALL.faces.tolist()],
    "torch": (torch.tensor(np.array(BALL.vertices), requires_grad=True), torch.tensor(np.array(BALL.faces))),
    "open3d": SimpleNamespace(vertices=BALL.vertices, triangles=BALL.faces.astype(np.int32)),
    "open3d tensors": SimpleNamespace(
        vertex={"positions": Tensor(np.array(BALL.vertices))}, triangle={"indices": Tensor(np.array(BALL.faces))}
    ),
    "pymeshlab": SimpleNamespace(vertex_matrix=lambda: BALL.vertices, face_matrix=lambda: BALL.faces),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_mesh_is_the_same_mesh(kind):
    found = as_mesh(KINDS[kind])
    assert np.array_equal(found.vertices, MINE.vertices) and np.array_equal(found.faces, MINE.faces)
    assert type(found.vertices) is np.ndarray
    thousand = as_mesh(KINDS[kind], unit="mm")
    assert np.allclose(1000 * thousand.vertices, MINE.vertices, atol=0, rtol=1e-15)
    assert (found is MINE) == (kind == "ours")


def test_clouds_are_points_with_their_normals():
    points, normals = np.eye(3), 2.0 * np.eye(3)
    tensors = {"positions": Tensor(points), "normals": Tensor(normals)}
    kinds = [
        (points, None),
        (torch.tensor(points), None),
        (trimesh.PointCloud(points), None),
        (SimpleNamespace(points=points, normals=normals), np.eye(3)),
        (SimpleNamespace(points=points, normals=np.zeros((0, 3))), None),
        (SimpleNamespace(point=tensors), np.eye(3)),
        (BALL, None),
    ]
    for given, unit in kinds:
        found, directions = as_points(given)
        assert np.array_equal(found, points if given is not BALL else BALL.vertices)
        assert (directions is None) if unit is None else np.array_equal(directions, unit)


def test_real_objects_of_open3d_and_pymeshlab_go_there_and_back():
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    pymeshlab = pytest.importorskip("pymeshlab", exc_type=ImportError)
    theirs = MINE.to_open3d()
    theirs.compute_vertex_normals()
    cloud = open3d.geometry.PointCloud(theirs.vertices)
    cloud.normals = theirs.vertex_normals
    tensors = open3d.t.geometry.TriangleMesh.from_legacy(theirs)
    assert np.array_equal(as_mesh(theirs).vertices, MINE.vertices)
    assert np.allclose(as_mesh(tensors).vertices, MINE.vertices, atol=1e-7)
    assert np.array_equal(as_mesh(pymeshlab.Mesh(*MINE.arrays())).faces, MINE.faces)
    for given in (cloud, open3d.t.geometry.PointCloud.from_legacy(cloud)):
        found = metrics.directed_distances(given, theirs)
        assert found.distance.max() < 1e-7 and found.angle.max() < 8.0
    # What they compute of ours is what we compute.
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensors)
    far = 1.5 * np.asarray(cloud.points)
    there = scene.compute_distance(far.astype(np.float32)).numpy()
    assert np.allclose(metrics.point_to_surface(cloud.scale(1.5, np.zeros(3)), theirs)[0], there, atol=1e-6)


def test_arrays_are_lent_writable():
    vertices, faces = MINE.arrays()
    assert torch.from_numpy(vertices).sum() == pytest.approx(vertices.sum()) and faces.flags.writeable
    assert not np.shares_memory(vertices, MINE.vertices)
    posed = skinning.pose(MINE.vertices, np.ones((len(vertices), 1)), np.eye(4)[None])
    weights = transfer.transfer_weights(MINE, np.ones((len(vertices), 1)), MINE)
    distances = metrics.directed_distances(MINE, MINE, samples=10)
    for array in (posed, weights.joint_weights, weights.distance, distances.closest, metrics.edge_stretch(MINE, MINE)):
        assert array.flags.writeable


def calls(mesh) -> dict[str, object]:
    """Every public function that takes a mesh, called with one."""
    count, faces = len(BALL.vertices), len(BALL.faces)
    ones, labels = np.ones((count, 1)), np.where(BALL.triangles_center[:, 1] > 0, 3, 4)
    outer = as_mesh(BALL).with_vertices(1.1 * MINE.vertices)
    front = np.eye(4)
    front[2, 3] = 4.0
    camera = Camera(K=np.array([[30.0, 0, 16], [0, 30.0, 16], [0, 0, 1]]), cam_from_world=front, width=32, height=32)
    views = [(camera, np.full((32, 32), 3))]
    half = np.arange(faces) < faces // 2
    origin, across = np.zeros(3), np.eye(3)[0]
    cut = MINE.submesh(half)[0]
    return {
        "compare": lambda: metrics.compare(mesh, outer, samples=100),
        "directed_distances": lambda: metrics.directed_distances(outer, mesh, samples=100).distance,
        "doubtful_pair": lambda: metrics.doubtful_pair(mesh, mesh),
        "edge_stretch": lambda: metrics.edge_stretch(mesh, outer),
        "far_patches": lambda: metrics.far_patches(mesh, half, mesh, far=0.1),
        "faulty_faces": lambda: metrics.faulty_faces(mesh),
        "flipped_faces": lambda: metrics.flipped_faces(mesh, outer),
        "hausdorff": lambda: metrics.hausdorff(mesh, outer).as_dict(),
        "interpenetration": lambda: metrics.interpenetration(mesh, outer),
        "mesh_quality": lambda: metrics.mesh_quality(mesh),
        "mirror_ratio": lambda: metrics.mirror_ratio(mesh, mesh, center=origin, across=across),
        "mirrored_by_views": lambda: metrics.mirrored_by_views(
            mesh, np.zeros((count, 3)), [(camera, np.zeros((32, 32, 3)))], body=mesh, center=origin, across=across
        ),
        "penetration": lambda: metrics.penetration(mesh, outer).as_dict(),
        "point_to_surface": lambda: metrics.point_to_surface(mesh, outer)[0],
        "sample_surface": lambda: metrics.sample_surface(mesh, 10).points,
        "self_intersections": lambda: metrics.self_intersections(mesh),
        "signed_distance": lambda: metrics.signed_distance(mesh, outer)[0],
        "stretch_report": lambda: metrics.stretch_report(mesh, outer),
        "uncovered_body": lambda: metrics.uncovered_body(mesh, mesh, samples=50, views=2, resolution=32).share,
        "check_human_scale": lambda: clean.check_human_scale(mesh),
        "clean_parts": lambda: clean.clean_parts(mesh, labels)["upper"].mesh.faces,
        "convert_points": lambda: clean.convert_points(mesh, units="cm"),
        "cut_bridges": lambda: clean.cut_bridges(mesh, half)[0].faces,
        "drop_specks": lambda: clean.drop_specks(mesh),
        "estimate_normals": lambda: clean.estimate_normals(mesh),
        "fill_pinholes": lambda: clean.fill_pinholes(mesh)[0].faces,
        "find_bridges": lambda: clean.find_bridges(mesh, mesh, outer, outer),
        "find_scan_frame": lambda: clean.find_scan_frame(mesh, units="m", up="y").note,
        "find_tears": lambda: clean.find_tears(mesh, mesh, outer, outer),
        "loop_lengths": lambda: clean.loop_lengths(mesh, [np.array([0, 1, 2])]),
        "roughness": lambda: clean.roughness(mesh),
        "sanitize": lambda: clean.sanitize(mesh).mesh.faces,
        "simplify": lambda: clean.simplify(mesh, 100).mesh.vertices,
        "smooth_if_rough": lambda: clean.smooth_if_rough(mesh).roughness,
        "solid_of_parts": lambda: (
            clean.solid_of_parts(mesh, {"cap": cut.with_vertices(1.01 * cut.vertices)}).mesh.faces
        ),
        "thickened": lambda: clean.thickened(mesh, inward=0.1).vertices,
        "wall_thickness": lambda: clean.wall_thickness(mesh)[:10],
        "rigid_weights": lambda: transfer.rigid_weights(mesh, ones, mesh, joint_names=("root",)).dense(),
        "shoe_weights": lambda: transfer.shoe_weights(
            SkinWeights.from_dense(np.full((count, len(LEGS)), 1.0 / len(LEGS))),
            mesh,
            np.arange(3.0 * len(LEGS)).reshape(-1, 3) ** 0.5,
            joint_names=LEGS,
        ).dense(),
        "transfer_weights": lambda: transfer.transfer_weights(mesh, ones, mesh).dense(),
        "label_by_body": None,  # needs a person: its first statement is `as_mesh`, as that of `segment_scan`
        "segment_scan": lambda: segment.segment_scan(mesh, face_labels=labels).face_labels,
        "vote_in_agreement": lambda: segment.vote_in_agreement(mesh, views).votes,
        "vote_on_faces": lambda: segment.vote_on_faces(mesh, views),
        "pose": lambda: skinning.pose(mesh, ones, np.eye(4)[None]),
        "unpose": lambda: skinning.unpose(mesh, ones, np.eye(4)[None]).vertices,
        "remesh": None,  # needs pymeshlab
        "surface_from_points": None,  # needs open3d
    }


LEGS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ("knee", "ankle", "foot"))


@pytest.mark.long
def test_every_public_function_on_meshes_takes_those_of_others():
    theirs, ours = calls(BALL), calls(MINE)
    asked = set()
    for room in ROOMS:
        for name in room.__all__:
            kinds = inspect.signature(getattr(room, name)).parameters if inspect.isfunction(getattr(room, name)) else {}
            texts = {str(parameter.annotation) for parameter in kinds.values()}
            assert not any(text.startswith("TriangleMesh") for text in texts), f"{name} takes our meshes alone"
            if any("MeshLike" in text or "PointsLike" in text for text in texts):
                asked.add(name)
    assert asked == set(theirs)
    for name, call in theirs.items():
        if call is not None:
            np.testing.assert_equal(call(), ours[name](), err_msg=name)


def test_clouds_are_measured_as_points():
    """From a cloud: its distances to the surface. To a cloud: the nearest point, and no normals without any."""
    sphere, cloud = trimesh.creation.icosphere(subdivisions=3), 1.5 * np.asarray(BALL.vertices)
    found = metrics.compare(cloud, sphere, samples=500, pred_labels=np.arange(len(cloud)) % 2)
    assert found.pred_to_gt.count == len(cloud) and found.pred_to_gt.mean == pytest.approx(500, abs=10)
    brute = np.linalg.norm(metrics.sample_surface(sphere, 500).points[:, None] - cloud, axis=2).min(axis=1)
    assert found.gt_to_pred.mean == pytest.approx(1e3 * brute.mean(), rel=1e-12)
    assert found.pred_to_gt.normal_angle_deg is None and set(found.labels) == {"skin", "hair"}
    assert found.labels["skin"].pred_to_gt.count == (len(cloud) + 1) // 2
    both = metrics.compare(cloud, 2 * cloud, config=metrics.CompareConfig(unit="cm"))
    assert both.p2s == pytest.approx(15.0, rel=0.1)  # 1.5 cm
    with pytest.raises(InputError, match="point cloud"):
        metrics.compare(cloud, sphere, config=metrics.CompareConfig(visible_only=True))


def test_weights_come_and_go_as_tables_files_and_other_joints(tmp_path):
    rng = np.random.default_rng(0)
    dense = rng.dirichlet([0.3] * 5, 50)
    weights = SkinWeights.from_dense(dense)
    assert np.allclose(weights.dense(), dense, atol=1e-15)
    for table in (csr_matrix(dense), torch.tensor(dense), weights.to_sparse()):
        assert np.allclose(SkinWeights.from_dense(table).dense(), dense, atol=1e-15)
        assert metrics.total_variation(table, weights).max() < 1e-15
    names = ["hip", "knee", "ankle", "heel", "toe"]
    for suffix in (".npz", ".json"):
        weights.save(tmp_path / f"w{suffix}", joint_names=names)
        found, read = SkinWeights.load(tmp_path / f"w{suffix}")
        assert read == tuple(names) and np.allclose(found.dense(), dense, atol=1e-15)
    four = weights.pruned(2, least=0.05)
    kept = np.sort(dense, axis=1)[:, ::-1][:, :2]
    kept[:, 1][kept[:, 1] < 0.05] = 0.0
    assert np.allclose(np.sort(four.dense(), axis=1)[:, ::-1][:, :2], kept / kept.sum(axis=1, keepdims=True))
    # Heel and toe are the ankle's where a skeleton has neither.
    moved = weights.reordered(names, ["ankle", "spine", "knee", "hip"], parents=[-1, 0, 1, 2, 2]).dense()
    assert np.allclose(moved, np.stack([dense[:, 2:].sum(axis=1), 0 * dense[:, 0], dense[:, 1], dense[:, 0]], axis=1))
    with pytest.raises(InputError, match="heel"):
        weights.reordered(names, ["ankle", "knee", "hip", "toe"])
    (tmp_path / "w.json").write_text('{"joint_count": 2, "joint_indices": [[5]], "joint_weights": [[1.0]]}')
    with pytest.raises(InputError, match=r"joints in \[0, 2\)"):
        SkinWeights.load(tmp_path / "w.json")


def test_other_things_are_refused_by_name():
    with pytest.raises(InputError, match=r"gt.*|true mesh"):
        metrics.compare(trimesh.creation.box(), "scan.ply")
    with pytest.raises(InputError, match="unit"):
        as_mesh(BALL, unit="miles")


def test_a_mesh_goes_to_trimesh_its_viewer_and_open3d(monkeypatch):
    mesh = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]], [[0, 1, 2]])
    theirs = mesh.to_trimesh()
    assert theirs.vertices.shape == (4, 3) and theirs.faces.tolist() == [[0, 1, 2]]
    monkeypatch.setattr(trimesh.Trimesh, "show", lambda shown, **options: (len(shown.faces), options))
    assert mesh.show(smooth=False) == (1, {"smooth": False})
    for package in ("trimesh", "open3d"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match="pip install trimesh"):
        mesh.to_trimesh()
    with pytest.raises(MissingExtraError, match=r"extra scan"):
        mesh.to_open3d()


def test_every_public_result_is_described_in_one_line():
    """A class with arrays, tensors or meshes prints their shapes, not their numbers."""
    seen = set()
    for package in (smplxpp, avatar):
        rooms = [found.name for found in pkgutil.walk_packages(package.__path__, package.__name__ + ".") if found.ispkg]
        for room in (package, *map(importlib.import_module, rooms)):
            for name in getattr(room, "__all__", ()):
                kind = getattr(room, name)
                if inspect.isclass(kind) and is_dataclass(kind):
                    seen.add(kind)
    # Classes with words of their own are read by their own tests.
    seen = {kind for kind in seen if kind.__repr__ is one_line or hasattr(kind.__repr__, "__wrapped__")}
    assert len(seen) > 100
    table = np.arange(3000.0).reshape(1000, 3)
    stand_ins = {"ndarray": table, "Tensor": torch.tensor(table), "Mesh": MINE}
    for kind in seen:
        made = object.__new__(kind)
        for field in fields(kind):
            value = next((v for text, v in stand_ins.items() if text in str(field.type)), "text")
            object.__setattr__(made, field.name, value)
        text = repr(made)
        assert "\n" not in text and len(text) < 1000, f"{kind.__module__}.{kind.__qualname__}: {text[:200]}"
        assert text.startswith(kind.__name__)
