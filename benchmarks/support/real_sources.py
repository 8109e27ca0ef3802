"""List public recordings of real people: where they come from, what their licences say, and what is known of them.

Nothing of them is stored in the project. Whoever wants to measure fetches them, and puts the files where this table
expects them below one folder. A source that is not there is left out of a run and said.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from smplxpp.core import InputError, require_known

Kind = Literal["scan", "rig", "motion", "speech", "turning photographs"]
KINDS: tuple[Kind, ...] = ("scan", "rig", "motion", "speech", "turning photographs")


@dataclass(frozen=True)
class Truth:
    """A body that others fitted to the same person.

    Attributes:
        surface: mesh of the fitted body, or a bare person's own surface, in the scan's units and axes.
        joints: npz whose `joints` begin with SMPL's 22 joints of the body; empty where none are known.
        what: what the surface is.
    """

    surface: str
    joints: str = ""
    what: str = ""


@dataclass(frozen=True)
class Source:
    """A recording of a real person, and the command that a user would give for it.

    Attributes:
        key: name of the row.
        person: who or what is to be seen.
        origin: repository or package that the files come from, and their path there.
        licence: of the files.
        kind: what was recorded.
        files: expected below the folder of sources; the first is the recording.
        command: words after `smplxpp`. `{file}` stands for the recording, `{folder}` for the folder of sources, `{out}`
            for the row's folder, `{run}` for the run in it, `{before}` for the folder of the source `after`.
        after: source whose result the command needs.
        truth: a known body.
        should_stop: whether no template is the right answer, as for half a person.
    """

    key: str
    person: str
    origin: str
    licence: str
    kind: Kind
    files: tuple[str, ...]
    command: str = "build {run} --scan {file}"
    after: str = ""
    truth: Truth | None = None
    should_stop: bool = False

    def present(self, folder: Path) -> bool:
        """Return whether all files of the source are there."""
        truth = () if self.truth is None else tuple(filter(None, (self.truth.surface, self.truth.joints)))
        return all((folder / name).exists() for name in (*self.files, *truth))


_POLYGON = "polygonjs/polygonjs-assets, models/resources/renderpeople.com, OBJ without texture coordinates"
_RENDERPEOPLE = "RenderPeople free sample: terms of renderpeople.com, no redistribution"
_POKER = "sevendeucepoker72-ai/poker-3d at 4b888d2, public/models, written as OBJ with the texture"
_CC_BY = "CC BY 4.0, RenderPeople (sketchfab.com/renderpeople)"
_CRAGL = "CraGL/Hyperspectral-Inverse-Skinning, models (Vlasic et al. 2008, performance capture from silhouettes)"
_FAUST = "DavidBoja/SMPL-Fitting, data/demo"
_MPI = "MPI FAUST: non-commercial research"
_ETCH = "boqian-li/ETCH, datafolder/4D-DRESS/data_processed"
_FILM = (
    "animate {before}/run --params {file} --step 24 --stop 1200 --view three-quarter --height 480 --out {out}/film.mp4"
)
_POSE2SIM = "rigs/p2s/Pose2Sim/Demo/S00_Demo_Session/S00_P00_Participant"
_SPEECH = "Uberi/speech_recognition, tests"

SOURCES: tuple[Source, ...] = (
    Source(
        "4D-Dress man",
        "a man in a shirt and shorts, arms lowered",
        _ETCH,
        "4D-Dress: non-commercial research",
        "scan",
        ("etch/00122_Inner_Take2_00011.obj",),
        truth=Truth(
            "etch/mesh_smpl_00122_Inner_Take2_00011.obj", "etch/info_00122_Inner_Take2_00011.npz", "the SMPL-H fit"
        ),
    ),
    Source(
        "Dennis",
        "a man in a suit, a hand in a pocket",
        _POLYGON,
        _RENDERPEOPLE,
        "scan",
        ("scans/rp_dennis_posed_004_30k.obj",),
    ),
    Source(
        "Mei",
        "a woman who walks in heels with a binder under an arm",
        _POLYGON,
        _RENDERPEOPLE,
        "scan",
        ("scans/rp_mei_posed_001_30k.obj",),
    ),
    Source(
        "Fabienne and Percy",
        "a woman who carries a child: two people",
        _POLYGON,
        _RENDERPEOPLE,
        "scan",
        ("scans/rp_fabienne_percy_posed_001_5k.obj",),
        should_stop=True,
    ),
    Source(
        "Carla",
        "a woman in a suit with a bun, arms apart; colours",
        _POKER,
        _CC_BY,
        "scan",
        ("people2/carla/carla.obj",),
    ),
    Source(
        "Claudia",
        "a woman in a blouse and trousers, arms apart; colours",
        _POKER,
        _CC_BY,
        "scan",
        ("people2/claudia/claudia.obj",),
    ),
    Source(
        "Eric",
        "a man in a suit, arms apart; colours",
        _POKER,
        _CC_BY,
        "scan",
        ("people2/eric/eric.obj",),
    ),
    Source(
        "Nathan",
        "a man who walks, centimetres",
        "mehulkapadia5/open-theft-auto, assets/characters/nathan, written as OBJ",
        _CC_BY,
        "scan",
        ("people2/nathan/nathan.obj",),
    ),
    Source(
        "Liam",
        "a man with a ponytail in waistcoat, rolled sleeves and tie, who explains something, millimetres",
        "XRFoundation/UniversalVolumetric, example/public/liam, frame 0, Draco decoded",
        "Common Public Attribution License 1.0 (of the repository)",
        "scan",
        ("volumetric/liam_00000.obj",),
    ),
    Source(
        "Liam, frame 200",
        "the same man eight seconds later",
        "XRFoundation/UniversalVolumetric, example/public/liam, Draco decoded",
        "Common Public Attribution License 1.0 (of the repository)",
        "scan",
        ("volumetric/liam_00200.obj",),
    ),
    Source(
        "samba, frame 0",
        "a woman in a dress",
        _CRAGL,
        "research data of MIT, no licence stated",
        "scan",
        ("cragl/samba.obj",),
    ),
    Source(
        "samba, frame 60",
        "the same woman dances, her dress swings",
        _CRAGL,
        "research data of MIT, no licence stated",
        "scan",
        ("cragl/samba_0060.obj",),
    ),
    Source(
        "crane, frame 0",
        "a man in a fleece and wide trousers",
        _CRAGL,
        "research data of MIT, no licence stated",
        "scan",
        ("cragl/crane.obj",),
    ),
    Source(
        "crane, frame 100",
        "the same man on one leg",
        _CRAGL,
        "research data of MIT, no licence stated",
        "scan",
        ("cragl/crane_0100.obj",),
    ),
    Source(
        "FAUST 000",
        "a man in underwear, a registration",
        _FAUST,
        _MPI,
        "scan",
        ("smpl_fitting/tr_reg_000.ply",),
        truth=Truth("smpl_fitting/tr_reg_000.ply", what="the registration itself"),
    ),
    Source(
        "FAUST 001",
        "the same man in another pose",
        _FAUST,
        _MPI,
        "scan",
        ("smpl_fitting/tr_reg_001.ply",),
        truth=Truth("smpl_fitting/tr_reg_001.ply", what="the registration itself"),
    ),
    Source(
        "bust",
        "head and shoulders of a man, photogrammetry: half a person",
        "polygonjs/polygonjs-assets, models/photogrammetry, Draco decoded",
        "no licence stated",
        "scan",
        ("photogrammetry/bust.obj",),
        should_stop=True,
    ),
    Source(
        "a man who turns",
        "8 photographs of a man who turns before one camera, with masks and keypoints",
        "thmoa/octopus, data/sample (People-Snapshot), masks made white",
        "non-commercial research",
        "turning photographs",
        ("turntable/octo_src/photos", "turntable/octo_src/masks", "turntable/octo_src/keypoints"),
        command=(
            "capture turntable {file} --masks {folder}/turntable/octo_src/masks "
            "--keypoints {folder}/turntable/octo_src/keypoints/cam --out {out}/capture"
        ),
    ),
    Source(
        "a man who turns, template",
        "the same man",
        "thmoa/octopus, data/sample (People-Snapshot)",
        "non-commercial research",
        "turning photographs",
        ("turntable/octo_src/photos",),
        command="build {run} --capture {before}/capture",
        after="a man who turns",
    ),
    Source(
        "a man who turns, avatar",
        "the same man",
        "thmoa/octopus, data/sample (People-Snapshot)",
        "non-commercial research",
        "turning photographs",
        ("turntable/octo_src/photos",),
        command="train {before}/run --capture {before}/../a_man_who_turns/capture --preset cpu",
        after="a man who turns, template",
    ),
    Source(
        "a man who turns, page",
        "the same man",
        "thmoa/octopus, data/sample (People-Snapshot)",
        "non-commercial research",
        "turning photographs",
        ("turntable/octo_src/photos",),
        command="web {before}/run --out {out}/page",
        after="a man who turns, template",
    ),
    Source(
        "a laboratory's balance",
        "a man balances before four cameras: TOML calibration, OpenPose BODY_25B",
        "pose2sim 0.6.0 (PyPI), Demo/S00_Demo_Session",
        "BSD-3-Clause",
        "rig",
        (f"{_POSE2SIM}/S00_P00_T01_BalancingTrial",),
        command="register {run} --capture {file}",
    ),
    Source(
        "a laboratory's standing man",
        "the same man stands still",
        "pose2sim 0.6.0 (PyPI), Demo/S00_Demo_Session",
        "BSD-3-Clause",
        "rig",
        (f"{_POSE2SIM}/S00_P00_T00_StaticTrial",),
        command="register {run} --capture {file}",
    ),
    Source(
        "a climb, played by the 4D-Dress man",
        "BVH 01_01 of CMU: a man climbs and jumps down; 50 frames of 10 seconds",
        "facebookresearch/fairmotion, tests/data",
        "CMU motion capture: free for any use",
        "motion",
        ("bvh/fairmotion_01_01.bvh",),
        command=_FILM,
        after="4D-Dress man",
    ),
    Source(
        "a climb, played by Liam",
        "the same motion",
        "facebookresearch/fairmotion, tests/data",
        "CMU motion capture: free for any use",
        "motion",
        ("bvh/fairmotion_01_01.bvh",),
        command=_FILM,
        after="Liam",
    ),
    Source(
        "exercises, played by the man of crane",
        "the BVH of aitviewer: a man stretches; 50 frames of 30 seconds",
        "eth-ait/aitviewer, examples/resources",
        "MIT (of the repository)",
        "motion",
        ("bvh/aitviewer_sample.bvh",),
        command=_FILM,
        after="crane, frame 0",
    ),
    Source(
        "English",
        "three numbers, spoken",
        _SPEECH,
        "BSD-3-Clause",
        "speech",
        ("speech/english.wav",),
        command="talk {before}/run --audio {file} --out {out}/motion.npz",
        after="4D-Dress man",
    ),
    Source(
        "French",
        "a French sentence in AIFF",
        _SPEECH,
        "BSD-3-Clause",
        "speech",
        ("speech/french.aiff",),
        command="talk {before}/run --audio {file} --out {out}/motion.npz",
        after="4D-Dress man",
    ),
    Source(
        "Chinese",
        "a Chinese sentence in FLAC",
        _SPEECH,
        "BSD-3-Clause",
        "speech",
        ("speech/chinese.flac",),
        command="talk {before}/run --audio {file} --out {out}/motion.npz",
        after="4D-Dress man",
    ),
)


def chosen_sources(folder: Path, only: tuple[str, ...] = ()) -> tuple[list[Source], list[Source]]:
    """Return the sources whose files are there, and those whose files are not.

    Args:
        folder: folder of sources.
        only: keys; by default all.

    Raises:
        InputError: an unknown key, or none of the sources is there.
    """
    require_known("source", only, {source.key: source for source in SOURCES})
    wanted = [source for source in SOURCES if not only or source.key in only]
    there = [source for source in wanted if source.present(folder)]
    if not there:
        raise InputError(
            f"folder of sources {folder}",
            expected=f"the files of a source, such as {wanted[0].files[0]}",
            received="none of them",
            remedy="benchmarks/support/real_sources.py says where they come from",
        )
    return there, [source for source in wanted if source not in there]
