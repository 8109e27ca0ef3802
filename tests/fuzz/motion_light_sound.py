"""The doors of an avatar in use: motions of other programs, panoramas, recordings, curves of a face."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from avatar.speech.curves import read_curves
from smplxpp.body import load_body
from smplxpp.body.retarget import Skeleton
from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.body.skeleton_params import load_skeleton, read_joint_map
from smplxpp.core.files.panorama_file import read_panorama
from smplxpp.core.files.sound_file import Sound, read_sound, wave_bytes
from smplxpp.core.light import Irradiance
from smplxpp.core.params import BodyParams
from smplxpp.export.motion_files import write_bvh
from tests.body.test_fbx_motion import scene_of as fbx_of
from tests.body.test_gltf_motion import scene_of
from tests.core.files.openexr import write_openexr
from tests.core.files.radiance import write_radiance
from tests.core.files.test_wave_file import coded, file_of
from tests.fuzz.examine import Door
from tests.speech.test_curves import LIVE, live_link, waving


def motion_doors() -> list[Door]:
    """A skeleton of another program with its motion, and names for its joints."""
    body = load_body()
    skeleton = Skeleton.of(body)
    names = {"Hips": "pelvis", "LeftUpLeg": "left_hip"}
    return [
        Door(
            "motion bvh",
            lambda folder: write_bvh(folder / "m.bvh", body, BodyParams.rest(betas=0, expressions=0)),
            lambda folder: load_skeleton(folder / "m.bvh", skeleton),
        ),
        Door(
            "motion glb",
            lambda f: scene_of(_still()).write(f / "m.glb"),
            lambda f: load_skeleton(f, skeleton),
        ),
        Door("motion fbx", lambda f: fbx_of(_still(), f / "m.fbx"), lambda f: load_skeleton(f, skeleton)),
        Door(
            "joint map", lambda f: (f / "m.json").write_text(json.dumps(names)), lambda f: read_joint_map(f / "m.json")
        ),
    ]


def _still() -> SkeletonMotion:
    """The open body at rest, in three frames."""
    skeleton = Skeleton.of(load_body())
    parents = np.asarray(skeleton.parents)
    offsets = skeleton.places - np.where(parents[:, None] >= 0, skeleton.places[parents], 0.0)
    turns = np.tile(np.eye(3), (3, len(parents), 1, 1))
    return SkeletonMotion(skeleton.names, parents, offsets, turns, np.zeros((3, 3)), 30.0)


def light_doors() -> list[Door]:
    """Panoramas, with flat rows and with packed ones, and of OpenEXR in both of its common codings."""

    def write(path: Path, packed: bool) -> None:
        write_radiance(path, np.random.default_rng(1).uniform(0.0, 5.0, (9, 18, 3)), packed=packed)

    return [
        Door(
            f"panorama {kind}",
            lambda folder, kind=kind: write(folder / "x.hdr", kind == "packed"),
            lambda folder: Irradiance.of_environment(read_panorama(folder / "x.hdr")),
        )
        for kind in ("flat", "packed")
    ] + [
        Door(
            f"panorama exr {kind}",
            lambda folder, kind=kind: write_openexr(
                folder / "x.exr", np.random.default_rng(1).uniform(0.0, 5.0, (9, 18, 3)), kind=kind
            ),
            lambda folder: Irradiance.of_environment(read_panorama(folder / "x.exr")),
        )
        for kind in ("zip", "piz")
    ]


def face_doors() -> list[Door]:
    """Curves of a face: Live Link Face, Audio2Face, arrays."""
    table = live_link(waving(4))
    stored = json.dumps({"exportFps": 30.0, "facsNames": LIVE, "weightMat": waving(4).tolist()})
    return [
        Door("curves csv", lambda f: (f / "c.csv").write_text(table), lambda f: read_curves(f / "c.csv")),
        Door("curves json", lambda f: (f / "c.json").write_text(stored), lambda f: read_curves(f / "c.json")),
        Door(
            "curves npz",
            lambda f: np.savez(f / "c.npz", blendshapes=waving(4), fps=np.array(30.0)),
            lambda f: read_curves(f / "c.npz"),
        ),
    ]


def sound_doors() -> list[Door]:
    """Recordings in 16-bit integers, and in floats of two channels."""
    samples = 0.5 * np.sin(np.arange(400) * 0.2).astype(np.float32)
    stereo = file_of(coded(np.repeat(samples, 2), 3, 32), 3, 32, channels=2)
    return [
        Door(
            f"sound {kind}",
            lambda folder, data=data: (folder / "x.wav").write_bytes(data),
            lambda folder: read_sound(folder / "x.wav").at_rate(8000),
        )
        for kind, data in (("integers", wave_bytes(Sound(samples, 16_000))), ("floats", stereo))
    ]
