"""`smplxpp params convert` and `inspect`: body parameters of any known layout to ours; what a motion holds."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float64
from rich.console import Console

from pipelines.commands.driving import Driving
from pipelines.commands.options import OptionalFloat, OptionalInt, OptionalPath, OptionalText
from smplxpp.body import LayoutName, UpAxis, Whose, detect_layout, is_skeleton, load_body, load_params, smpl_joints
from smplxpp.body.motion_facts import inspect_motion
from smplxpp.body.skeleton_params import read_joint_map
from smplxpp.body.smpl_joints import BODY_JOINTS, is_open_body
from smplxpp.body.smpl_params import FAMILY_NAMES
from smplxpp.core import BodyParams, InputError, require_positive
from smplxpp.core.files.array_file import write_arrays

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ParamsConvert:
    """Options of the command."""

    input: tyro.conf.Positional[Path]
    """npz, json or pkl file, a folder of numbered frames, or a skeleton's file (.bvh, .glb, .vrm, .fbx)."""
    out: Path
    """npz file to write: SMPL-X names, stacked frames."""
    layout: LayoutName = "auto"
    """Layout of the input; auto tells it by its keys. 4D-Dress is smplx, THuman4 is avatarrex."""
    body: OptionalPath = None
    """Body model file that the parameters will pose; EasyMocap and TalkBody4D need its root joint. Default: the
    open body."""
    frames: OptionalText = None
    """Frames to keep, as START:STOP or START:STOP:STEP, which divides the frames a second (default: all)."""
    fps: OptionalFloat = None
    """Frames a second of the input, for a file that states none or a wrong rate (default: as it says)."""
    person: OptionalInt = None
    """Id of the person, for files with several."""
    up: UpAxis | None = None
    """Axis that points up in the input; the output has y up. By default as the input states, z for AMASS, -y for
    TalkBody4D, for a skeleton that along which it stands at rest, else y."""
    joint_map: OptionalPath = None
    """JSON of a skeleton's joints with unusual names, {"LeftUpLeg": "left_hip", ...}."""
    clip: OptionalText = None
    """Name of the motion, for a .glb or .vrm with several (default: the first)."""
    whose: Whose = "auto"
    """Whose parameters the input has. auto: as its counts and keys tell. body: those of --body. Parameters of SMPL,
    SMPL-H or SMPL-X are brought to the open body without their shape, as a start for a registration."""
    betas: OptionalInt = None
    """Number of leading betas to keep, for a body that has no more; the lost share is logged (default: all)."""
    joints: OptionalPath = None
    """Also write an npz of SMPL's 22 joints of the posed body (`joints`, frames x 22 x 3, metres, and `joint_names`):
    of the open body by a regressor, so that joint errors compare with those of SMPL's fits."""
    flat_hand_mean: bool | None = None
    """Whether the hands are complete without the model's mean hand (default: as the layout implies)."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Convert the parameters and return a summary."""
        if self.out.suffix.lower() != ".npz":
            raise InputError("--out", expected="a file name ending in .npz", received=str(self.out))
        if self.joints is not None and self.joints.suffix.lower() != ".npz":
            raise InputError("--joints", expected="a file name ending in .npz", received=str(self.joints))
        if self.fps is not None:
            require_positive("option fps", self.fps)
        # The motion of a skeleton is retargeted to the body; all other layouts are read as they are.
        kept, skeleton = _parse_frames(self.frames), None
        if is_skeleton(self.input):
            layout = self.input.suffix.lower()[1:]
            driving = Driving(up=self.up, joint_map=self.joint_map, clip=self.clip)
            params = driving.load(self.input, load_body(self.body), fps=self.fps)
            skeleton = driving.skeleton(self.input)
        else:
            layout = detect_layout(self.input) if self.layout == "auto" else self.layout
            params = load_params(
                self.input,
                layout=self.layout,
                body=None if self.body is None else load_body(self.body),
                person=self.person,
                up=self.up,
                flat_hand_mean=self.flat_hand_mean,
                max_betas=self.betas,
                whose=self.whose,
            )
        # The stated rate is the input's; keeping every n-th frame divides it.
        params = (params if self.fps is None else replace(params, fps=self.fps)).select(kept)
        if not len(params):
            raise InputError("--frames", expected="a range that holds frames", received=str(self.frames))
        params.save(self.out)
        if self.joints is not None:
            write_arrays(self.joints, {"joints": self._joints(params), "joint_names": np.array(BODY_JOINTS)})
        rate = f"{params.fps:g} a second" if params.fps else "no frame rate stated: --fps states one"
        frames = f"{len(params)} frames, {rate}" if len(params) > 1 else "1 frame"
        log.info("%s (%s, %s) -> %s", self.input, layout, frames, self.out)
        return _summary(self, layout, params) | ({} if skeleton is None else {"skeleton": skeleton.as_dict()})

    def _joints(self, params: BodyParams) -> Float64[np.ndarray, "T 22 3"]:
        """Return SMPL's joints of the posed body, which are a model's own in its family."""
        body = load_body(self.body)
        return smpl_joints(body, params) if is_open_body(body) else body.forward(params).joints[:, : len(BODY_JOINTS)]


@dataclass(frozen=True)
class ParamsInspect:
    """Options of the command."""

    input: tyro.conf.Positional[Path]
    """Body parameters in any layout that `params convert` reads, a folder of numbered frames, or a skeleton's file."""
    body: OptionalPath = None
    """Body model file that shall move; by default the open body."""
    person: OptionalInt = None
    """Id of the person, for files with several."""
    up: UpAxis | None = None
    """Axis that points up in the input, where it is not the one that is found."""
    joint_map: OptionalPath = None
    """JSON of a skeleton's joints with unusual names, {"LeftUpLeg": "left_hip", ...}."""
    clip: OptionalText = None
    """Name of the motion, for a .glb or .vrm with several (default: the first)."""
    json: bool = False
    """Print the facts as JSON."""

    def run(self) -> dict:
        """Say what the motion holds; prints it unless `json`."""
        facts = inspect_motion(
            self.input,
            body=None if self.body is None else load_body(self.body),
            joint_map=None if self.joint_map is None else read_joint_map(self.joint_map),
            person=self.person,
            up=self.up,
            clip=self.clip,
        )
        report = {"input": str(self.input), **facts.as_dict()}
        if not self.json:
            for line in _in_words(report):
                Console().print(line, markup=False, highlight=False, soft_wrap=True)
        return report


def _in_words(report: dict) -> list[str]:
    rate = "no rate stated" if report["fps"] is None else f"{report['fps']:g} a second"
    whose = f", parameters of {FAMILY_NAMES[report['family']]}" if report["family"] else ""
    lines = [
        f"{report['input']}: {report['kind']}{whose}, {report['frames']} frames, {rate}, {report['seconds']:.2f} s"
    ]
    lines += [f"unit      {report['unit']}", f"up        {report['up']}"]
    skeleton = report["skeleton"]
    if "joints" in skeleton:
        lines += [f"rest      {skeleton['rest']}"]
        body = {ours: own for ours, own in skeleton["joints"].items() if ours[-1] not in "123"}
        lines += [f"  {ours:15} {' + '.join(theirs)}" for ours, theirs in body.items()]
        lines.append(f"fingers   {len(skeleton['joints']) - len(body)} joints")
        lines += [f"missing   {', '.join(skeleton['missing'])}"] if skeleton["missing"] else []
    for name, value in report["ranges"].items():
        shown = ", ".join(f"{k} {v:g}" for k, v in value.items()) if isinstance(value, dict) else value
        lines.append(f"{name:15} {shown}")
    lines += [f"left out  {one}" for one in report["left_out"]]
    return [*lines, *(f"look at   {one}" for one in report["mistakes"])]


def _parse_frames(text: str | None) -> slice:
    if text is None:
        return slice(None)
    try:
        numbers = [int(part) if part.strip() else None for part in text.split(":")]
        if len(numbers) not in (2, 3) or numbers[2:] == [0]:
            raise ValueError
    except ValueError:
        raise InputError("--frames", expected="START:STOP or START:STOP:STEP", received=text) from None
    return slice(*numbers)


def _summary(command: ParamsConvert, layout: str, params: BodyParams) -> dict:
    return {
        "input": str(command.input),
        "out": str(command.out),
        "layout": layout,
        "body": str(command.body) if command.body else "open body",
        "frames": len(params),
        "fps": params.fps,
        "betas": params.betas.shape[1],
        "expressions": params.expression.shape[1],
        "hand_numbers": params.left_hand_pose.shape[1],
        "v_shape": params.v_shape is not None,
        "flat_hand_mean": params.flat_hand_mean,
    }
