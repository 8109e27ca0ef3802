"""Recognise and read the layouts in which other programs and data sets write body parameters.

A reader turns the content of one file into `Frames`: parameters as SMPL-X understands them and, where the source
moves the posed body as a whole, that outer motion, still to be composed (it needs the body's root joint).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from smplxpp.core import ARRAY_NAMES, POSE_BLOCKS, BodyParams, GeometryWarning, InputError
from smplxpp.core.files.json_file import as_numbers
from smplxpp.core.rotations import axis_angle_rows

_JOINTS = dict(POSE_BLOCKS)
_WHOLE = (24, 52, 55)  # joints of a whole pose of SMPL, SMPL-H and SMPL-X
_EASYMOCAP_HAND_PCA = 6
# Largest number of radians or metres that is accepted; larger ones are damage.
_FARTHEST = 1e6
# Arrays that have a row a frame, one of which every layout of stacked frames has.
_STACKED = ("global_orient", "body_pose", "poses")
# Poses with all fingers: of SMPL-H and of SMPL-X. VPoser's numbers, which some of its models write instead.
_EASYMOCAP_COMPLETE, _EASYMOCAP_EMBEDDING = (156, 165), 32
# 66 numbers, a body without hands, are of any family.
_EASYMOCAP_FAMILIES: dict[int, Family] = {
    63: "smplh",
    69: "smpl",
    72: "smpl",
    78: "smplh",
    87: "smplx",
    156: "smplh",
    165: "smplx",
}
_SMPL_SHAPE, _SMPL_PLACE = ("betas", "shape", "shapes", "beta"), ("trans", "transl", "translation")
OPEN_BODY = "open_body"
"""What a file states as its `body` whose parameters are of the open body."""
Family = Literal["smpl", "smplh", "smplx"]
"""Body models whose joints and shape directions are not the open body's."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Body parameters with an outer motion, as a reader returns them.

    Attributes:
        params: T frames.
        outer: (T, 3) axis-angle and (T, 3) metres of `x_world = R x + t` about the origin, applied to the posed
            body; None where the layout has none.
        family: of the body that the parameters are of, as the layout's counts and keys tell; None: they do not.
        up: axis that points up, where the file states it or the layout defines it; None: they do not.
    """

    params: BodyParams
    outer: tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]] | None = None
    family: Family | None = None
    up: str | None = None


def with_valid_frames(content: Any) -> tuple[Any, list[int]]:
    """Replace frames with NaN or infinity by the last valid frame before; return the content and their numbers.

    Those at the start become the first valid frame. Other kinds of files, or without any valid frame, are unchanged.
    """
    if not isinstance(content, Mapping):
        return content, []
    arrays = {name: value for name, value in content.items() if isinstance(value, np.ndarray) and value.ndim > 1}
    # Only arrays with a row for each frame are repaired; values of the whole take have another length.
    counts = [len(arrays[name]) for name in _STACKED if name in arrays]
    count = counts[0] if counts else 0
    arrays = {name: value for name, value in arrays.items() if len(value) == count and value.dtype.kind == "f"}
    valid = np.ones(count, bool)
    for value in arrays.values():
        valid &= (np.abs(value.reshape(count, -1)) <= _FARTHEST).all(axis=1)
    if count < 2 or valid.all() or not valid.any():
        return content, []
    # Index of the last valid frame up to each frame; before the first valid one, the first.
    held = np.maximum.accumulate(np.where(valid, np.arange(count), np.argmax(valid)))
    return {**content, **{name: value[held] for name, value in arrays.items()}}, np.flatnonzero(~valid).tolist()


@dataclass(frozen=True)
class Layout:
    """A layout of body parameters with its reader.

    Attributes:
        name: that users choose.
        recognises: whether keys of a record, and whether it is in a list of records, fit the layout.
        read: from content and chosen person to frames; None if the person is not in the file.
    """

    name: str
    recognises: Callable[[set[str], bool], bool]
    read: Callable[[Any, int | None], Frames | None]


def _read_smplx(content: Mapping[str, Any], person: int | None, *, complete_hands: bool | None = None) -> Frames:
    """SMPL-X names: our own files, per-frame files, 4D-Dress; also SMPL's, whose body pose has two joints more.

    `complete_hands` holds where the file does not state `flat_hand_mean`.
    """
    values = {name: _flat_joints(name, content[name]) for name in ARRAY_NAMES if name in content}
    if "expressions" in content:
        values.setdefault("expression", np.asarray(content["expressions"]))
    family: Family | None = None
    body_pose = axis_angle_rows(np.asarray(content["body_pose"]), [21, 23], subject="parameter body_pose")
    if body_pose.shape[-1] == 69:
        values["body_pose"] = body_pose.reshape(-1, 69)[:, :63]
        family = "smpl"
    extras = {name: content[name] for name in ("fps", "flat_hand_mean", "v_shape") if content.get(name) is not None}
    if complete_hands is not None:
        extras.setdefault("flat_hand_mean", complete_hands)
    up = _text(content, "up", "up_axis")
    return Frames(BodyParams.from_mapping(values | extras), family=_family(content, family), up=up)


def _read_avatarrex(content: Mapping[str, Any], person: int | None) -> Frames:
    """AvatarReX, THuman4: SMPL-X names, one row of betas, no eyes, hands without the mean hand."""
    return _read_smplx(content, person, complete_hands=True)


def _read_talkbody4d(content: Mapping[str, Any], person: int | None) -> Frames:
    """TalkBody4D: SMPL-X names, then `verts R(Rh)^T + Th` about the origin; its readers take the hands as complete.

    `v_shape` is added to the shaped template, by its authors' own version of SMPL-X; what their `v_pose` is added to is
    not published.
    """
    if content.get("v_pose") is not None and np.any(content["v_pose"]):
        warnings.warn("TalkBody4D: `v_pose` is not read", GeometryWarning, stacklevel=2)
    params = _read_avatarrex(content, person).params
    return Frames(params, _outer(content, len(params)))


def _read_amass(content: Mapping[str, Any], person: int | None) -> Frames:
    """AMASS: `poses` of SMPL+H (156) or of SMPL-X (165), complete hands, z up by definition; SMPL's 72 in its names.

    Without `poses` its parts are read, of which only those of the root and the body must be there. Our own files state
    the body that they are of and their axis (`body`, `up`), which other programs may do as well.
    """
    whole = content["poses"] if "poses" in content else _poses_of_parts(content)
    poses = np.atleast_2d(axis_angle_rows(np.asarray(whole, np.float64), _WHOLE, subject="poses"))
    families: dict[int, Family] = {72: "smpl", 156: "smplh", 165: "smplx"}
    family = families.get(poses.shape[-1])
    if family is None:
        raise InputError(
            "poses", expected="shape (T, 156), (T, 165) or, of SMPL, (T, 72)", received=f"shape {poses.shape}"
        )
    rate = content.get("mocap_framerate", content.get("mocap_frame_rate", content.get("fps")))
    blocks = _split(_without_smpl_hands(poses, "poses"), face_first=True)
    # Speech motion (BEAT2, EMAGE) is AMASS with a row of expression coefficients for each frame.
    face = next((content[key] for key in ("expression", "expressions") if key in content), None)
    params = BodyParams.from_mapping(
        {**blocks, "betas": content["betas"], "transl": content["trans"], "flat_hand_mean": True}
        | ({} if rate is None else {"fps": rate})
        | ({} if face is None else {"expression": face})
    )
    up = _text(content, "up", "up_axis")
    return Frames(params, family=_family(content, family), up=up or (None if family == "smpl" else "z"))


def _poses_of_parts(content: Mapping[str, Any]) -> np.ndarray:
    """Return the whole poses of SMPL-X from AMASS' parts of them; zero where a part is missing."""
    parts = []
    for name, joints in (("root_orient", 1), ("pose_body", 21), ("pose_jaw", 1), ("pose_eye", 2), ("pose_hand", 30)):
        if name in content:
            given = np.asarray(content[name], np.float64)
            parts.append(np.atleast_2d(axis_angle_rows(given, [joints], subject=name)))
        else:
            parts.append(np.zeros((len(parts[0]), 3 * joints)))
    if len({len(part) for part in parts}) > 1:
        raise InputError("parts of poses", expected="as many frames in each", received=f"{[len(p) for p in parts]}")
    return np.concatenate(parts, axis=1)


def _read_smpl(content: Mapping[str, Any], person: int | None) -> Frames:
    """SMPL as fits of images and scans write it: `pose` (72; SMPL-H 156, SMPL-X 165), `betas` or `shape`, `trans`."""
    pose = np.atleast_2d(axis_angle_rows(np.asarray(content["pose"], np.float64), _WHOLE, subject="pose"))
    families: dict[int, Family] = {72: "smpl", 156: "smplh", 165: "smplx"}
    family = families.get(pose.shape[-1])
    if family is None:
        raise InputError("pose", expected="shape (T, 72), (T, 156) or (T, 165)", received=f"shape {pose.shape}")
    scale = np.asarray(content.get("scale", 1.0), dtype=np.float64)
    if np.abs(scale - 1.0).max(initial=0.0) > 1e-6:
        warnings.warn(
            f"parameters with a scale of {float(scale.ravel()[0]):.4g}, which the body has not: it is left out",
            GeometryWarning,
            stacklevel=2,
        )
    shape, place = (next(content[k] for k in keys if k in content) for keys in (_SMPL_SHAPE, _SMPL_PLACE))
    blocks = _split(_without_smpl_hands(pose, "pose"), face_first=True)
    values = {**blocks, "betas": shape, "transl": place, "flat_hand_mean": family != "smpl"}
    values |= {"fps": content["fps"]} if content.get("fps") is not None else {}
    return Frames(BodyParams.from_mapping(values), family=_family(content, family), up=_text(content, "up", "up_axis"))


def _without_smpl_hands(poses: np.ndarray, name: str) -> np.ndarray:
    """Return 66 of the 72 numbers of SMPL's poses, without its two hand joints; others as they are."""
    if poses.shape[1] != 72:
        return poses
    if poses[:, 66:].any():
        warnings.warn(f"{name}: the rotations of SMPL's two hand joints are dropped", GeometryWarning, stacklevel=4)
    return poses[:, :66]


def _family(content: Mapping[str, Any], family: Family | None) -> Family | None:
    """Return the family of a file's counts, unless the file states that its parameters are of the open body."""
    return None if _text(content, "body") == OPEN_BODY else family


def _text(content: Mapping[str, Any], *names: str) -> str | None:
    """Return the first of these entries that is a text, in lower case; None without one."""
    for name in names:
        value = content.get(name)
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.item()
        if isinstance(value, str):
            return value.strip().lower()
    return None


def _read_easymocap(content: Any, person: int | None) -> Frames | None:
    """EasyMocap: one record a person, `V = R(Rh) X + Th` about the origin, where X is posed with `poses`.

    Numbers of `poses`, as its `bodymodel` and its older `smplmodel` write them: without a root 63 (SMPL-H: the body,
    hands in `handl` and `handr`, PCA or axis-angle) and 69 (SMPL); with a root, which is zero, 66, 72 (SMPL), 78
    (SMPL-H) and 87 (SMPL-X, hands of 6 PCA numbers before the face), and complete 156 (SMPL-H) and 165 (SMPL-X).
    """
    records = content if isinstance(content, list) else content.get("annots", [content])
    ids = [record.get("id", 0) for record in records]
    if person is None and len(records) != 1:
        raise InputError(
            "people", expected="one person", received=f"ids {ids}", remedy="choose one by its id: person, --person"
        )
    if person is not None and person not in ids:
        return None
    record = records[0 if person is None else ids.index(person)]
    poses = np.asarray(record["poses"], dtype=np.float64).reshape(1, -1)
    full = poses.shape[1] in _EASYMOCAP_COMPLETE
    blocks = _split(_easymocap_poses(poses), face_first=full)
    for name, key in (("left_hand_pose", "handl"), ("right_hand_pose", "handr")):
        # Its models take complete poses as they are, whatever else the record has.
        hand = record.get(key)
        if hand is not None and not full:
            blocks[name] = hand
    values = {**blocks, "betas": record["shapes"], "transl": np.zeros(3), "flat_hand_mean": full}
    if "expression" in record:
        values["expression"] = record["expression"]
    family = _family(record, _EASYMOCAP_FAMILIES.get(poses.shape[1]))
    return Frames(BodyParams.from_mapping(values), _outer(record, 1), family)


def _easymocap_poses(poses: np.ndarray) -> np.ndarray:
    """Poses with their root, as `_split` takes them."""
    width = poses.shape[1]
    if width in (63, 69):
        poses = np.pad(poses, ((0, 0), (3, 0)))
    elif width not in (66, 72, 66 + 2 * _EASYMOCAP_HAND_PCA, 75 + 2 * _EASYMOCAP_HAND_PCA, *_EASYMOCAP_COMPLETE):
        raise InputError(
            "poses",
            expected="63, 66, 69, 72, 78, 87, 156 or 165 numbers",
            received=f"{width}",
            remedy="decode the pose embedding first" if width == _EASYMOCAP_EMBEDDING else "",
        )
    # SMPL: its two hand joints have no counterpart.
    return _without_smpl_hands(poses, "EasyMocap")


LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout(
            "smplx",
            lambda keys, is_list: (
                {"global_orient", "body_pose", "betas", "transl"} <= keys
                and not {"Rh", "Th"} & keys
                and not ("jaw_pose" in keys and "leye_pose" not in keys)
            ),
            _read_smplx,
        ),
        Layout(
            "avatarrex",
            lambda keys, is_list: (
                {"global_orient", "body_pose", "betas", "transl", "jaw_pose"} <= keys
                and not {"Rh", "Th", "leye_pose"} & keys
            ),
            _read_avatarrex,
        ),
        Layout(
            "talkbody4d",
            lambda keys, is_list: {"body_pose", "betas", "Rh", "Th"} <= keys and not is_list,
            _read_talkbody4d,
        ),
        Layout(
            "smpl",
            lambda keys, is_list: (
                "pose" in keys and bool(keys & {*_SMPL_SHAPE}) and bool(keys & {*_SMPL_PLACE}) and not is_list
            ),
            _read_smpl,
        ),
        Layout(
            "amass",
            lambda keys, is_list: (
                {"trans", "betas"} <= keys and ("poses" in keys or {"root_orient", "pose_body"} <= keys) and not is_list
            ),
            _read_amass,
        ),
        Layout(
            "easymocap",
            lambda keys, is_list: {"poses", "shapes", "Rh", "Th"} <= keys or "annots" in keys,
            _read_easymocap,
        ),
    )
}


def recognise(content: Any, *, source: str) -> str:
    """Return the name of the one layout that fits a file's content.

    Raises:
        InputError: none fits, or several.
    """
    is_list = isinstance(content, list)
    record = next(iter(content), {}) if is_list else content
    keys = set(map(str, record)) if isinstance(record, Mapping) else set()
    fitting = [layout.name for layout in LAYOUTS.values() if layout.recognises(keys, is_list)]
    # An EasyMocap frame without people is an empty list.
    if is_list and not content:
        fitting = ["easymocap"]
    if len(fitting) != 1:
        seen = f"keys {', '.join(sorted(keys)) or 'none'}" + (" in a list" if is_list else "")
        raise InputError(
            source,
            expected=f"the keys of one of the layouts {', '.join(LAYOUTS)}",
            received=f"{seen}, which fit {' and '.join(fitting) or 'none'}",
            remedy=(
                "convert it with `smplxpp params convert --layout NAME`"
                if fitting
                else "check that this is a file of body parameters"
            ),
        )
    return fitting[0]


def _split(poses: np.ndarray, *, face_first: bool) -> dict[str, np.ndarray]:
    """Split rows of concatenated joints into blocks: root, body, then face and hands in either order, if present.

    Hands share what the face leaves: 45 axis-angle numbers each, or PCA coefficients. 156 = no face.
    """
    blocks = {"global_orient": poses[:, :3], "body_pose": poses[:, 3:66]}
    rest = poses[:, 66:]
    # SMPL-X rows end in (165) or hold (87) nine face numbers; the others have none.
    face_width = 9 if poses.shape[1] in (165, 75 + 2 * _EASYMOCAP_HAND_PCA) else 0
    face, hands = (
        (rest[:, :face_width], rest[:, face_width:])
        if face_first
        else (rest[:, rest.shape[1] - face_width :], rest[:, : rest.shape[1] - face_width])
    )
    if face_width:
        blocks |= {"jaw_pose": face[:, :3], "leye_pose": face[:, 3:6], "reye_pose": face[:, 6:]}
    if hands.shape[1]:
        blocks["left_hand_pose"], blocks["right_hand_pose"] = np.split(hands, 2, axis=1)
    return blocks


def _outer(record: Mapping[str, Any], frames: int) -> tuple[np.ndarray, np.ndarray]:
    rotvec, shift = (as_numbers(record[key], subject=key) for key in ("Rh", "Th"))
    for key, value in (("Rh", rotvec), ("Th", shift)):
        if value.size not in (3, 3 * frames) or not (np.abs(value) <= _FARTHEST).all():
            raise InputError(
                key,
                expected=f"3 numbers within {_FARTHEST:g} for each of {frames} frames",
                received=f"{value.size} numbers up to {np.abs(value).max(initial=0.0):g}",
            )
    return np.broadcast_to(rotvec.reshape(-1, 3), (frames, 3)), np.broadcast_to(shift.reshape(-1, 3), (frames, 3))


def _flat_joints(name: str, value: Any) -> np.ndarray:
    """Return a block of the pose as one axis-angle row a frame, whatever form it has; other arrays as they are."""
    joints = _JOINTS.get(name)
    return axis_angle_rows(np.asarray(value), [joints], subject=f"parameter {name}") if joints else np.asarray(value)
