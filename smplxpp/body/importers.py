"""Read body parameters from files in the layouts of other programs and data sets: `load_params`."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from smplxpp.body.frame_gaps import without_gaps
from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel
from smplxpp.body.param_layouts import LAYOUTS, Frames, recognise, without_holes
from smplxpp.core import BodyParams, GeometryWarning, InputError, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.safe_pickle import safe_load, safe_npy, safe_npz

LayoutName = Literal["auto", "smplx", "amass", "easymocap", "avatarrex", "talkbody4d"]
_SERIES = (".npz", ".json", ".pkl")
_SUFFIXES = (*_SERIES, ".npy")
# Files of torch are programs, which only torch reads.
_TORCH = (".pt", ".pth")
UpAxis = Literal["x", "-x", "y", "-y", "z", "-z"]
# Axis-angle of the rotation about x or z that takes an axis to +y; z: (x, y, z) -> (x, z, -y), -y: (x, -y, -z).
_Y_UP_FROM: dict[UpAxis, tuple[float, float, float]] = {
    "x": (0.0, 0.0, np.pi / 2),
    "-x": (0.0, 0.0, -np.pi / 2),
    "-y": (np.pi, 0.0, 0.0),
    "z": (-np.pi / 2, 0.0, 0.0),
    "-z": (np.pi / 2, 0.0, 0.0),
}
# The axis that points up in a layout's own files, where that is always the same and not y.
_OWN_UP: dict[str, UpAxis] = {"talkbody4d": "-y"}


def load_params(
    path: str | Path,
    *,
    layout: LayoutName = "auto",
    body: BodyModel | None = None,
    person: int | None = None,
    up: UpAxis | None = None,
    flat_hand_mean: bool | None = None,
    max_betas: int | None = None,
    holes: list[int] | None = None,
) -> BodyParams:
    """Read body parameters of any known layout.

    Layouts, told apart by their keys: `smplx` (SMPL-X names in npz or pickle: our own files, 4D-Dress), `amass`
    (SMPL+H and SMPL-X), `easymocap`, `avatarrex` (and THuman4), `talkbody4d`. A folder is read as one frame (or more)
    a file: all files whose names differ in their numbers alone, in the order of these; other files are ignored.

    EasyMocap and TalkBody4D rotate and translate the posed body about the origin, `x = R(Rh) X + Th`, SMPL-X about its
    root joint J0. With the inner pose (R_g, t): `global_orient = R(Rh) R_g`, `transl = R(Rh) (J0 + t) + Th - J0`.

    Args:
        path: a file or a folder.
        layout: name of the layout, or "auto".
        body: the body that the parameters will pose; gives J0 where it is needed. None: the open body.
        person: id of the person, for files with several.
        up: the axis that points up in the file, which is rotated to y; None for that of the layout, which is -y for
            TalkBody4D and y for all others (AMASS has z up, but other users of its layout have not).
        flat_hand_mean: overrides what the layout implies (see `BodyParams`).
        max_betas: number of betas to keep, for a body that has no more; None keeps all.
        holes: takes the frames of a file of several that hold NaN or infinity; another frame stands in each of them.
            None: they are refused, except frames that hold nothing at all, which are interpolated (`register` writes
            them for frames that it was not asked for).

    Raises:
        InputError: nothing readable, an unknown or ambiguous layout, several people and none chosen, wrong shapes, or
            what the body refuses that is needed.

    Warns:
        GeometryWarning: frames that were interpolated; frames without the chosen person, which are left out; betas that
            are cut and not zero, with their share; what a layout has that is not read.

    Example:
        >>> params = smplxpp.load_params("data/fixtures/person/params/params.npz")
        >>> len(params)
        16
    """
    # Files of the frames, and the layout that the first of them has.
    path = Path(path)
    files = _frame_files(path)
    name = detect_layout(path) if layout == "auto" else layout
    if name not in LAYOUTS:
        raise InputError("layout", expected=f"auto, {', '.join(LAYOUTS)}", received=name)
    # Read file by file; frames without the person are noted.
    parts: list[Frames] = []
    absent: list[str] = []
    for file in files:
        content = _content(file)
        if holes is not None and len(files) == 1:
            content, empty = without_holes(content)
            holes += empty
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
            stacklevel=2,
        )
    params = _joined(_cut(parts, max_betas), body, up or _OWN_UP.get(name, "y"))
    return params if flat_hand_mean is None else replace(params, flat_hand_mean=flat_hand_mean)


def params_from_content(
    content: Any, *, source: str, layout: LayoutName = "auto", body: BodyModel | None = None
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
    return _joined([frames], body, _OWN_UP.get(name, "y"))


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


def _joined(parts: list[Frames], body: BodyModel | None, up: UpAxis) -> BodyParams:
    params = BodyParams.concatenate([part.params for part in parts])
    outer = [part.outer for part in parts if part.outer]
    if up != "y" and up not in _Y_UP_FROM:
        raise InputError("axis that points up", expected=f"y, {', '.join(_Y_UP_FROM)}", received=str(up))
    if not outer and up == "y":
        return params
    body = body or load_body()
    # Rigid motions are about the world's origin, parameters turn about the root joint: `_moved` needs the body for
    # that.
    if outer:
        params = _moved(params, body, *(np.concatenate(values) for values in zip(*outer, strict=True)))
    if up != "y":
        params = _moved(params, body, np.array(_Y_UP_FROM[up]), np.zeros(3))
    return params


def detect_layout(path: str | Path) -> str:
    """Detect the layout of a file, or of the first file of a folder (whose other files must have the same).

    Raises:
        InputError: nothing readable, an unknown or ambiguous layout.
    """
    file = _frame_files(Path(path))[0]
    return recognise(_content(file), source=f"file {file}")


def _moved(params: BodyParams, body: BodyModel, rotvec: np.ndarray, shift: np.ndarray) -> BodyParams:
    """Return the parameters of the posed body after `x -> R x + t` about the origin."""
    rotation = matrix_from_rotvec(rotvec)
    root = body.rest_joints(params)[:, 0]
    turned = (rotation @ (root + params.transl)[..., None])[..., 0]
    return replace(
        params,
        global_orient=rotvec_from_matrix(rotation @ matrix_from_rotvec(params.global_orient)),
        transl=turned + shift - root,
    )


def _read_content(content: Any, layout: str, person: int | None, source: str) -> Frames | None:
    try:
        return LAYOUTS[layout].read(content, person)
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


def _content(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return safe_npz(path)
    if suffix == ".pkl":
        return safe_load(path)
    if suffix == ".npy":
        return safe_npy(path)
    if suffix != ".json":
        remedy = "in Python: `found = torch.load(file, map_location='cpu')`, then `numpy.savez('params.npz', **{name: "
        remedy += "value.numpy() for name, value in found.items()})`, of the dictionary inside that has `body_pose`"
        raise InputError(
            f"file {path}",
            expected=f"one of {', '.join(_SUFFIXES)}",
            received=f"suffix {suffix!r}",
            remedy=remedy if suffix in _TORCH else "",
        )
    return read_json(path)


def _frame_files(path: Path) -> list[Path]:
    """The file itself, or the numbered files of a folder in order."""
    if not path.is_dir():
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
