"""Read body parameters from files in the layouts of other programs and data sets: `load_params`."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float64

from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel
from smplxpp.body.param_layouts import LAYOUTS, Family, Frames, recognise, with_valid_frames
from smplxpp.body.param_records import NotedReads, of_one_person, warn_of_unread, with_known_names, without_gaps
from smplxpp.body.retarget import Skeleton
from smplxpp.body.skeleton_params import SKELETON_SUFFIXES, load_skeleton
from smplxpp.body.smpl_joints import is_open_body
from smplxpp.body.smpl_params import FAMILY_NAMES, from_smpl, rests_like_smpl, smpl_skeleton
from smplxpp.core import (
    BodyParams,
    GeometryWarning,
    InputError,
    matrix_from_rotvec,
    require_choice,
    rotvec_from_matrix,
)
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.safe_pickle import safe_load, safe_npy, safe_npz

LayoutName = Literal["auto", "smplx", "smpl", "amass", "easymocap", "avatarrex", "talkbody4d"]
_SERIES = (".npz", ".json", ".pkl")
_SUFFIXES = (*_SERIES, ".npy")
# Files of torch are programs, which only torch reads.
_TORCH = (".pt", ".pth")
_SCENES = (".usd", ".usda", ".usdc", ".usdz", ".dae", ".abc", ".blend")
UpAxis = Literal["x", "-x", "y", "-y", "z", "-z"]
# Axis-angle of the rotation about x or z that takes an axis to +y; z: (x, y, z) -> (x, z, -y), -y: (x, -y, -z).
_Y_UP_FROM: dict[str, tuple[float, float, float]] = {
    "x": (0.0, 0.0, np.pi / 2),
    "-x": (0.0, 0.0, -np.pi / 2),
    "-y": (np.pi, 0.0, 0.0),
    "z": (-np.pi / 2, 0.0, 0.0),
    "-z": (np.pi / 2, 0.0, 0.0),
}
# The axis that points up in a layout's own files, where that is always the same and not y.
_OWN_UP: dict[str, UpAxis] = {"talkbody4d": "-y"}
Whose = Literal["auto", "body", "smpl", "smplh", "smplx"]
"""Whose parameters a file has: those of the body that they will pose, of a family, or as the file tells."""


def load_params(
    path: str | Path,
    *,
    layout: LayoutName = "auto",
    body: BodyModel | None = None,
    person: int | None = None,
    up: UpAxis | None = None,
    flat_hand_mean: bool | None = None,
    max_betas: int | None = None,
    whose: Whose = "auto",
) -> BodyParams:
    """Read body parameters of any known layout.

    Layouts, told apart by their keys: `smplx` (SMPL-X names in npz or pickle: our own files, 4D-Dress), `smpl` (`pose`,
    `shape`), `amass` (SMPL+H and SMPL-X), `easymocap`, `avatarrex` (and THuman4), `talkbody4d`. A folder is read as one
    frame (or more) a file: all files whose names differ in their numbers alone, in their order; others are ignored. The
    motion of a skeleton (BVH, glTF, VRM) is brought to the body (`smplxpp.body.skeleton_params.load_skeleton`).

    Parameters of SMPL, SMPL-H and SMPL-X, where counts and keys tell them (docs/inputs.md), are exact for a model of
    that family. For the open body their joint rotations are converted, the pelvis keeps its position, and the shape
    is dropped (`smplxpp.body.smpl_params.from_smpl`): a start for a registration, or a motion.

    EasyMocap and TalkBody4D rotate and translate the posed body about the origin, `x = R(Rh) X + Th`, SMPL-X about its
    root joint J0. With the inner pose (R_g, t): `global_orient = R(Rh) R_g`, `transl = R(Rh) (J0 + t) + Th - J0`.

    Args:
        path: a file or a folder.
        layout: name of the layout, or "auto".
        body: the body that the parameters will pose; gives J0 where it is needed. None: the open body.
        person: id of the person, for files with several.
        up: the axis that points up in the file, which is rotated to y; None for the one that the file states (`up`), or
            that of the layout, which is z for AMASS, -y for TalkBody4D and y for all others.
        flat_hand_mean: overrides what the layout implies (see `BodyParams`).
        max_betas: number of betas to keep, for a body that has no more; None keeps all.
        whose: "body": the parameters are those of `body`, whatever they look like; a family: of that one; "auto": as
            the file's counts and keys tell.

    Raises:
        InputError: nothing readable, an unknown or ambiguous layout, several people and none chosen, wrong shapes, or
            what the body refuses that is needed.

    Warns:
        GeometryWarning: frames that hold nothing, which are interpolated (`register` writes them for frames that it was
            not asked for); frames without the chosen person, which are left out; betas that are cut and not zero, with
            their share; what a layout has that is not read; parameters of another body than the open body's; an AMASS
            file in which people stand along y.

    Example:
        >>> params = smplxpp.load_params("data/fixtures/person/params/params.npz")
        >>> len(params)
        16
    """
    if is_skeleton(path):
        return load_skeleton(path, Skeleton.of(load_body() if body is None else body), up=up)
    parts, name = _read_parts(Path(path), layout, person, filled=None)
    params = _joined(_cut(parts, max_betas), body, up or _OWN_UP.get(name), whose, str(path))
    return params if flat_hand_mean is None else replace(params, flat_hand_mean=flat_hand_mean)


def load_motion(
    path: str | Path, body: BodyModel, *, up: UpAxis | None = None, whose: Whose = "auto"
) -> tuple[BodyParams, Family | None, list[int]]:
    """Read a motion to be retargeted, with another frame in the place of those that hold NaN or infinity.

    Args:
        path: a file or a folder, as `load_params` takes it.
        body: body to move, of any kind with SMPL's joint names.
        up: axis that points up in the file; None: as `load_params` finds it.
        whose: whose parameters they are, as in `load_params`.

    Returns:
        The parameters, y up; the family that they are of, None where they are the body's or the body has the family's
        joints; and the frames of a single file that were replaced by others.

    Raises:
        InputError: as `load_params`.
    """
    filled: list[int] = []
    if is_skeleton(path):
        return load_skeleton(path, Skeleton.of(body), up=up), None, filled
    parts, name = _read_parts(Path(path), "auto", None, filled=filled)
    family = _family_of(parts, whose)
    # A body with SMPL's joints takes the family's rotations as they are.
    if family is not None and not is_open_body(body) and rests_like_smpl(Skeleton.of(body)):
        family = None
    return _upright(parts, body, up or _OWN_UP.get(name), family, str(path)), family, filled


def is_skeleton(path: str | Path) -> bool:
    """Whether a file's ending says that its motion is one of a skeleton of its own, as that of a .bvh."""
    return Path(path).suffix.lower() in SKELETON_SUFFIXES


def family_of_params(path: str | Path, *, layout: LayoutName = "auto") -> Family | None:
    """Recognise parameters of SMPL, SMPL-H or SMPL-X by a file's counts and keys; None where these do not decide.

    Raises:
        InputError: as `load_params`.
    """
    frames = _first_frames(path, layout)
    return None if frames is None else frames.family


def up_of_params(path: str | Path) -> str:
    """Return the axis that points up in a file, as "z" or "-y": what it states, or what its layout defines.

    Raises:
        InputError: as `load_params`.
    """
    frames = _first_frames(path, "auto")
    return (None if frames is None else frames.up) or _OWN_UP.get(detect_layout(path)) or "y"


def _first_frames(path: str | Path, layout: LayoutName) -> Frames | None:
    """Return the frames of the first file of a path as they stand there; None for a frame without people."""
    file = _frame_files(Path(path))[0]
    content, source = _content(file), f"file {file}"
    content, _ = with_valid_frames(of_one_person(content, 0))
    name = recognise(content, source=source) if layout == "auto" else layout
    # Of several people the first one decides; a frame without people has no family.
    if isinstance(content, list):
        content = content[:1]
    if isinstance(content, list) and not content:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # given when the file is read for use
        return _read_content(content, name, None, source)


def _read_parts(path: Path, layout: str, person: int | None, *, filled: list[int] | None) -> tuple[list[Frames], str]:
    """Read all files of a path; return their frames and the layout.

    Frames that hold NaN or infinity are replaced by others and appended to `filled`; None refuses them.
    """
    # Files of the frames, and the layout that the first of them has.
    files = _frame_files(path)
    if layout != "auto" and layout not in LAYOUTS:
        raise InputError("layout", expected=f"auto, {', '.join(LAYOUTS)}", received=layout)
    first = _content(files[0])
    name = recognise(first, source=f"file {files[0]}") if layout == "auto" else layout
    # Read file by file; frames without the person are noted.
    parts: list[Frames] = []
    absent: list[str] = []
    for file in files:
        content = of_one_person(first if file is files[0] else _content(file), person, source=f"file {file}")
        if filled is not None and len(files) == 1:
            content, invalid = with_valid_frames(content)
            filled += invalid
        elif len(files) == 1:
            content = without_gaps(content, source=f"file {file}")
        frames = _read_content(content, name, person, f"file {file}")
        if frames:
            parts.append(frames)
        else:
            absent.append(file.name)
    if not parts:
        raise InputError(f"{path}", expected=f"frames of person {person}", received="none")
    if absent:
        warnings.warn(
            f"{path}: person {person} is missing in {len(absent)} of {len(files)} frames, left out (first {absent[0]})",
            GeometryWarning,
            stacklevel=3,
        )
    return parts, name


def params_from_content(
    content: Any, *, source: str, layout: LayoutName = "auto", body: BodyModel | None = None, whose: Whose = "auto"
) -> BodyParams:
    """Convert the content of a file that was read already, arrays by name or JSON, to body parameters; see
    `load_params`.

    Args:
        content: what the file holds.
        source: the file, for messages.

    Raises:
        InputError: as `load_params`; more than one person.
    """
    name = recognise(content, source=source) if layout == "auto" else layout
    frames = _read_content(content, name, None, source)
    if frames is None:
        raise InputError(source, expected="frames of a person", received="none")
    return _joined([frames], body, _OWN_UP.get(name), whose, source)


def _cut(parts: list[Frames], max_betas: int | None) -> list[Frames]:
    """Keep the first betas and warn about the share that is lost; millimetres would need a body with all directions."""
    if max_betas is None:
        return parts
    if max_betas < 0:
        raise InputError("number of betas to keep", expected="0 or more", received=str(max_betas))
    # Sums of squares over all frames, of the coefficients that stay and of those that go.
    kept, dropped = (
        sum(float(np.square(part.params.betas[:, columns]).sum()) for part in parts)
        for columns in (slice(max_betas), slice(max_betas, None))
    )
    if dropped > 0:
        most = max(part.params.betas.shape[1] for part in parts)
        warnings.warn(
            f"{most} betas are cut to {max_betas}: {100 * np.sqrt(dropped / (kept + dropped)):.1f} % of their length "
            "is lost (root of the squares; a body with all of them would say how many millimetres)",
            GeometryWarning,
            stacklevel=3,
        )
    return [replace(part, params=replace(part.params, betas=part.params.betas[:, :max_betas])) for part in parts]


def _joined(parts: list[Frames], body: BodyModel | None, up: str | None, whose: Whose, source: str) -> BodyParams:
    """Return all frames in one world, y up, for the body: composed with outer motions, turned, brought to it."""
    family = _family_of(parts, whose)
    body = load_body() if body is None and family is not None else body
    # Only the open body needs a conversion: other bodies are models of the family.
    if body is None or not is_open_body(body):
        family = None
    params = _upright(parts, body, up, family, source)
    if family is None:
        return params
    assert body is not None
    if whose == "auto":
        _warn_of_another_body(params, family, source)
    return from_smpl(params, family, body)


def _family_of(parts: list[Frames], whose: Whose) -> Family | None:
    """Return the family of the parameters: the caller's choice, else the one recognised in the file."""
    require_choice("option whose", whose, get_args(Whose))
    if whose == "auto":
        return parts[0].family
    return None if whose == "body" else whose


def _upright(
    parts: list[Frames], body: BodyModel | None, up: str | None, family: Family | None, source: str
) -> BodyParams:
    """Return all frames with y up, still as parameters of `family`; None: of the body."""
    params = BodyParams.concatenate([part.params for part in parts])
    outer = [part.outer for part in parts if part.outer]
    # An axis stated by the caller, by the file, or by the layout's definition; only the last may not hold for a file.
    stated = up or parts[0].up or "y"
    if stated != "y" and stated not in _Y_UP_FROM:
        raise InputError("axis that points up", expected=f"y, {', '.join(_Y_UP_FROM)}", received=str(stated))
    if up is None and stated == "z":
        _warn_of_people_along_y(params, source)
    if not outer and stated == "y":
        return params
    # Motion about the origin needs the root joint of the body that the parameters are of.
    if family is not None:
        root = np.repeat(smpl_skeleton(family).places[:1], len(params), axis=0)
    else:
        root = (body or load_body()).rest_joints(params)[:, 0]
    if outer:
        params = _moved(params, root, *(np.concatenate(values) for values in zip(*outer, strict=True)))
    if stated != "y":
        params = _moved(params, root, np.array(_Y_UP_FROM[stated]), np.zeros(3))
    return params


def _warn_of_another_body(params: BodyParams, family: Family, source: str) -> None:
    """Warn that shape and expression of a family's parameters are lost, with the remedy."""
    # Files of frames get one text, so that it is shown once.
    source = re.sub(r"\d{4,}", "#", source)
    warnings.warn(
        f"{source}: parameters of {FAMILY_NAMES[family]}, not of the open body: their turns and the pelvis' place are "
        f"kept, their shape ({params.betas.shape[1]} betas) and expression are not. With the model's file (--body, "
        "body=) they are exact; if they are the open body's, say --whose body (whose='body')",
        GeometryWarning,
        stacklevel=4,
    )


def _warn_of_people_along_y(params: BodyParams, source: str) -> None:
    """Warn where a layout has z up by definition and the bodies' own upward axis points along y."""
    upward = matrix_from_rotvec(params.global_orient)[:, :, 1]
    along_y, along_z = np.abs(upward[:, 1:]).mean(axis=0)
    if along_y > 0.8 and along_z < 0.4:
        warnings.warn(
            f"{source}: this layout has z up, which is turned to y, but its people stand along y: if the file has y "
            "up, state it with --up y (up='y')",
            GeometryWarning,
            stacklevel=4,
        )


def detect_layout(path: str | Path) -> str:
    """Detect the layout of a file, or of the first file of a folder (whose other files must have the same).

    Raises:
        InputError: nothing readable, an unknown or ambiguous layout.
    """
    file = _frame_files(Path(path))[0]
    return recognise(_content(file), source=f"file {file}")


def _moved(params: BodyParams, root: Float64[np.ndarray, "T 3"], rotvec: np.ndarray, shift: np.ndarray) -> BodyParams:
    """Return the parameters of the posed body after `x -> R x + t` about the origin; `root` is its root at rest."""
    rotation = matrix_from_rotvec(rotvec)
    turned = (rotation @ (root + params.transl)[..., None])[..., 0]
    return replace(
        params,
        global_orient=rotvec_from_matrix(rotation @ matrix_from_rotvec(params.global_orient)),
        transl=turned + shift - root,
    )


def _read_content(content: Any, layout: str, person: int | None, source: str) -> Frames | None:
    # Readers get records that note what is looked at: what no reader looks at is named.
    if isinstance(content, Mapping):
        content = NotedReads(content)
    elif isinstance(content, list):
        content = [NotedReads(one) if isinstance(one, Mapping) else one for one in content]
    try:
        frames = LAYOUTS[layout].read(content, person)
    except InputError as error:
        raise InputError(
            f"{source}: {error.subject}", expected=error.expected, received=error.received, remedy=error.remedy
        ) from error
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise InputError(
            source,
            expected=f"the layout {layout}",
            received=f"{type(error).__name__}: {error}",
            remedy="see the layouts in `smplxpp params convert --help`",
        ) from error
    if frames is not None:
        warn_of_unread([content] if isinstance(content, NotedReads) else content, layout, source)
    return frames


def _content(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return safe_npz(path)
    if suffix == ".pkl":
        return with_known_names(safe_load(path))
    if suffix == ".npy":
        return safe_npy(path)
    if suffix != ".json":
        torch = "in Python: `found = torch.load(file, map_location='cpu')`, then `numpy.savez('params.npz', **{name: "
        torch += "value.numpy() for name, value in found.items()})`, of the dictionary inside that has `body_pose`"
        scene = "open it in Blender, File > Export > glTF 2.0 (.glb), and give that file"
        raise InputError(
            f"file {path}",
            expected=f"one of {', '.join((*_SUFFIXES, *SKELETON_SUFFIXES))}",
            received=f"suffix {suffix!r}",
            remedy=torch if suffix in _TORCH else scene if suffix in _SCENES else "",
        )
    return read_json(path)


def _frame_files(path: Path) -> list[Path]:
    """The file itself, or the numbered files of a folder in order."""
    if not os.path.isdir(path):  # False, too, for a name that is too long for the system
        return [path]
    # Files that differ in their numbers alone form one series.
    series: dict[str, list[Path]] = {}
    others = 0
    for file in path.iterdir():
        if file.suffix.lower() in _SERIES and re.search(r"\d", file.stem):
            series.setdefault(re.sub(r"\d+", "#", file.name), []).append(file)
        else:
            others += 1
    if len(series) != 1:
        raise InputError(
            f"folder {path}",
            expected=f"one series of numbered {', '.join(_SERIES)} files",
            received=f"{', '.join(sorted(series)) or 'no such file'} ({others} other entries)",
            remedy="give one file, or a folder that holds the frames alone",
        )
    return sorted(next(iter(series.values())), key=lambda f: [int(n) for n in re.findall(r"\d+", f.stem)])
