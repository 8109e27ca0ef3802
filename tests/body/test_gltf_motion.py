"""Motions inside of glTF files are read as those of other skeletons: any axes, units, keys and names."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.commands.params import ParamsConvert, ParamsInspect
from smplxpp.body import load_params
from smplxpp.body.gltf_motion import read_gltf_motion
from smplxpp.body.layout import PROGRAM_NAMES
from smplxpp.body.skeleton_motion import SkeletonMotion, rate_of_keys
from smplxpp.body.skeleton_params import load_skeleton, named_joints, skeleton_params
from smplxpp.core import InputError
from tests.body.test_skeletons import called, lively, motion, relative
from tests.body.walks import shaped

__all__ = ["motion"]
FPS = 25.0


class Scene:
    """A glTF document that is built up, with one buffer."""

    def __init__(self) -> None:
        self.data = b""
        self.json: dict = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}

    def accessor(self, values: np.ndarray, kind: str, component: int = 5126, **more: object) -> int:
        values = np.ascontiguousarray(values, {5126: "<f4", 5122: "<i2"}[component])
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        self.json["bufferViews"].append(view)
        self.data += values.tobytes() + b"\0" * (-values.nbytes % 4)
        one = {"bufferView": len(self.json["bufferViews"]) - 1, "componentType": component, "type": kind, **more}
        self.json["accessors"].append(one | {"count": len(values)})
        return len(self.json["accessors"]) - 1

    def write(self, path: Path) -> Path:
        text = json.dumps(self.json | {"buffers": [{"byteLength": len(self.data)}]}).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(self.data), 0x4E4942)
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(self.data)) + chunks + self.data)
        return path


def scene_of(
    motion: SkeletonMotion, *, kind: str = "LINEAR", skin: bool = True, standing: int | None = None, axes: bool = True
) -> Scene:
    """A scene whose joints have axes of their own, below a node that turns z up to y up and scales by 0.01.

    Args:
        kind: interpolation of the keys. skin: with bind matrices. standing: frame in which the nodes stand; None: rest.
        axes: whether the joints' own axes are any; else those of the world.
    """
    scene, count, frames = Scene(), len(motion.names), len(motion.root)
    own = Rotation.random(count, random_state=3).as_matrix() if axes else np.tile(np.eye(3), (count, 1, 1))
    above = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from y up to z up, which the armature undoes
    local, step = np.empty((frames, count, 3, 3)), np.empty((frames, count, 3))
    rest, rest_step = np.empty((count, 3, 3)), np.empty((count, 3))
    for k, parent in enumerate(motion.parents):
        base = above.T if parent < 0 else own[parent]
        local[:, k], rest[k] = base.T @ motion.rotations[:, k] @ own[k], base.T @ own[k]
        rest_step[k] = 100.0 * base.T @ motion.offsets[k]
        step[:, k] = 100.0 * motion.root @ base if parent < 0 else rest_step[k]
    nodes = [{"name": "Armature", "rotation": [-(0.5**0.5), 0, 0, 0.5**0.5], "scale": [0.01] * 3, "children": [1]}]
    chosen = (rest, rest_step) if standing is None else (local[standing], step[standing])
    for k, name in enumerate(motion.names):
        turn = Rotation.from_matrix(chosen[0][k]).as_quat().tolist()
        children = [int(child) + 1 for child in np.flatnonzero(motion.parents == k)]
        nodes.append({"name": name, "rotation": turn, "translation": chosen[1][k].tolist(), "children": children})
    scene.json |= {"nodes": nodes, "scenes": [{"nodes": [0]}], "scene": 0}
    if skin:
        world = np.tile(np.eye(4), (count, 1, 1))
        world[:, :3, :3], world[:, :3, 3] = 0.01 * own, motion.rest
        inverse = np.linalg.inv(world).transpose(0, 2, 1).reshape(count, 16)
        joints = list(range(1, count + 1))
        scene.json["skins"] = [{"joints": joints, "inverseBindMatrices": scene.accessor(inverse, "MAT4")}]
    times = scene.accessor(1.5 + np.arange(frames) / FPS, "SCALAR")
    samplers, channels = [], []
    for k in range(count):
        turns = Rotation.from_matrix(local[:, k]).as_quat()
        for path, values in (("rotation", turns), *((("translation", step[:, k]),) if k == 0 else ())):
            width = values.shape[1]
            if kind == "CUBICSPLINE":
                values = np.stack([np.zeros_like(values), values, np.zeros_like(values)], axis=1).reshape(-1, width)
            code = {"component": 5122, "normalized": True} if kind == "short" and width == 4 else {}
            values = np.rint(32767 * values) if code else values
            output = scene.accessor(values, f"VEC{width}", **code)
            samplers.append({"input": times, "output": output, "interpolation": "LINEAR" if kind == "short" else kind})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": k + 1, "path": path}})
    scene.json["animations"] = [{"name": "lively", "samplers": samplers, "channels": channels}]
    return scene


@pytest.mark.parametrize("kind", ["LINEAR", "STEP", "CUBICSPLINE", "short"])
def test_a_motion_comes_back(tmp_path, motion, kind):
    """Motions of scenes were refused; keys of every kind, and joints whose axes are any, give the pose back."""
    path = scene_of(called(motion, "unreal"), kind=kind).write(tmp_path / "a.glb")
    params = load_params(path)
    assert params.fps == pytest.approx(FPS, rel=1e-5) and len(params) == len(motion.root)
    np.testing.assert_allclose(relative(params), relative(lively()), atol=2e-4 if kind == "short" else 2e-5)
    way = [np.ptp(one.transl[:, 2]) for one in (params, lively())]
    assert way[0] == pytest.approx(way[1], abs=1e-4) and way[0] > 0.2


def test_nodes_that_stand_in_a_frame_are_no_rest_pose(tmp_path, motion):
    """The bind matrices tell the rest pose; without a skin a frame that stands does, with the soles on the floor."""
    theirs = called(motion, "humanik")
    bound = load_params(scene_of(theirs, standing=4).write(tmp_path / "a.glb"))
    np.testing.assert_allclose(relative(bound), relative(lively()), atol=2e-5)
    alone = load_params(scene_of(theirs, skin=False, standing=4).write(tmp_path / "b.glb"))
    np.testing.assert_allclose(relative(alone), relative(lively()), atol=0.03)
    foot = [one[:, 10] - one[:, 7] for one in (relative(alone), relative(lively()))]
    cosine = (foot[0] * foot[1]).sum(axis=1) / np.prod([np.linalg.norm(one, axis=1) for one in foot], axis=0)
    assert np.degrees(np.arccos(cosine.clip(-1.0, 1.0))).max() < 8.0


@pytest.mark.parametrize("version", ["VRMC_vrm", "VRMC_vrm_animation", "VRM"])
def test_a_vrm_says_which_bone_is_which(tmp_path, motion, version):
    """Names of nodes say nothing, sides of none are told by place: what the file states decides."""
    strange = replace(motion, names=tuple(f"bone.{k:03d}" for k in range(len(motion.names))))
    scene = scene_of(strange, skin=version != "VRMC_vrm_animation")
    bones = {PROGRAM_NAMES["vrm"][name]: k + 1 for k, name in enumerate(motion.names)}
    if version == "VRM":
        human = {"humanoid": {"humanBones": [{"bone": bone, "node": node} for bone, node in bones.items()]}}
    else:
        human = {"humanoid": {"humanBones": {bone: {"node": node} for bone, node in bones.items()}}}
    scene.json["extensions"] = {version: human}
    path = scene.write(tmp_path / "a.vrm")
    assert {name: motion.names[k - 1] for name, k in named_joints(read_gltf_motion(path)).items()} == {
        name: name for name in motion.names if not name.startswith("spine")
    }
    np.testing.assert_allclose(relative(load_skeleton(path, shaped(None))), relative(lively()), atol=2e-5)


def test_the_motion_of_another_person_and_of_things_is_left_out(tmp_path, motion):
    """Two animations and a face: the first is read, what is not is named, and --clip names another."""
    scene = scene_of(called(motion, "humanik"))
    one = scene.json["animations"][0]
    still = {**one, "name": "still", "channels": one["channels"][:1]}
    face = {"sampler": 0, "target": {"node": 2, "path": "weights"}}
    scene.json["animations"] = [{**one, "channels": [*one["channels"], face]}, still]
    scene.json["nodes"].append({"name": "Camera", "children": []})
    scene.json["scenes"][0]["nodes"].append(len(scene.json["nodes"]) - 1)
    path = scene.write(tmp_path / "a.glb")
    report = ParamsInspect(input=path, json=True).run()
    told = report["left_out"]
    assert report["kind"] == "glb" and report["fps"] == pytest.approx(FPS, rel=1e-5)
    assert any("first of 2 motions is read; --clip NAME chooses another: lively, still" in one for one in told)
    assert any("not read: morph targets (faces)" in one for one in told)
    ParamsConvert(input=path, out=tmp_path / "o.npz", clip="still").run()
    assert np.ptp(load_params(tmp_path / "o.npz").body_pose, axis=0).max() < 1e-5
    with pytest.raises(InputError, match="option clip: expected one of lively, still"):
        ParamsConvert(input=path, out=tmp_path / "o.npz", clip="run").run()


@pytest.mark.parametrize(
    ("times", "fps", "frames"),
    [
        (np.arange(5) / 24.0, 24.0, 5),
        ([0.0, 2 / 60, 3 / 60, 90 / 60], 60.0, 91),  # keys that others give are left out
        ([0.0, 0.5, 2.0], 30.0, 61),  # by hand, far apart
        ([0.0, 0.01, 0.0237, 1.0], 30.0, 31),  # on no grid
        ([3.0], 30.0, 1),
    ],
)
def test_the_rate_of_keys(times, fps, frames):
    found, rate = rate_of_keys([np.asarray(times, float)], 50, "motion a.glb")
    assert rate == pytest.approx(fps) and len(found) == frames and found[0] == times[0]


def test_what_is_no_motion_is_refused(tmp_path, motion):
    scene = scene_of(motion)
    sampler = scene.json["animations"][0]["samplers"][0]
    changes = {
        "an animation of a skeleton": {"animations": []},
        "a sampler below": {"animations": [{"channels": [{"sampler": 9, "target": {"node": 1, "path": "rotation"}}]}]},
        "numbers a key of rotation": {
            "animations": [
                {
                    "samplers": [sampler | {"interpolation": "BEZIER"}],
                    "channels": [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}],
                }
            ]
        },
    }
    for words, change in changes.items():
        other = scene_of(motion)
        other.json |= change
        with pytest.raises(InputError, match=words):
            load_params(other.write(tmp_path / "a.glb"))
    with pytest.raises(InputError, match="at most 41943 frames of 100 joints"):
        rate_of_keys([np.array([0.0, 0.02, 1e5])], 100, "motion a.glb")
    # A person of our own names, which a map overrules.
    path = scene.write(tmp_path / "own.glb")
    whole = read_gltf_motion(path)
    np.testing.assert_allclose(
        relative(skeleton_params(whole, named_joints(whole), shaped(None))), relative(lively()), atol=2e-5
    )
