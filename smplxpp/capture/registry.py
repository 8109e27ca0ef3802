"""Open a capture with the reader of its layout."""

from __future__ import annotations

import re
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import cast

import numpy as np

from smplxpp.body import BodyModel, UpAxis
from smplxpp.body.rest_pose import upright_rotation
from smplxpp.capture.calibrations.world import UNITS
from smplxpp.capture.capture import Capture
from smplxpp.capture.files import require_folder, subfolders
from smplxpp.capture.keypoint_files import KeypointOptions
from smplxpp.capture.keypoints import KeypointFiles, with_keypoints
from smplxpp.capture.masks import with_masks
from smplxpp.capture.problems import lens_problems
from smplxpp.capture.readers import (
    actorshq,
    avatarrex,
    colmap,
    dress4d,
    easymocap,
    neus2,
    rig,
    simple,
    talkbody4d,
    thuman4,
)
from smplxpp.capture.readers.common import ReaderOptions, RigOptions
from smplxpp.capture.recording import Recording, Splits
from smplxpp.capture.sources import ParamFiles
from smplxpp.capture.subject import SubjectKeypoints
from smplxpp.capture.views import ArrayCache, read_alpha
from smplxpp.capture.window import Window
from smplxpp.core import InputError, require_choice

_MODULES = (simple, actorshq, talkbody4d, avatarrex, thuman4, dress4d, neus2, easymocap, colmap, rig)
# Names in an error: entries of a folder, files of its folders that are looked at, layouts that are shown.
_LISTED, _MOST_NAMES, _NEAREST = 12, 200, 3
# Words of `LOOKS_FOR` that name files (`intri.yml`, `transform*.json`) or folders (`rgbs/`).
_FILE_WORD = re.compile(r"(?<![\w/.])(?:[\w*]+\.\w+|[\w*]+/)(?!\w)")
READERS = {reader.NAME: reader for reader in _MODULES}
FORMATS: tuple[str, ...] = tuple(READERS)


def open_capture(
    path: str | Path,
    *,
    format: str | None = None,
    masks: str | Path | None = None,
    params: str | Path | None = None,
    keypoints: str | Path | None = None,
    person: int | None = None,
    subject: int | None = None,
    rig: RigOptions | None = None,
    body: BodyModel | None = None,
    hold_out_every: int | None = None,
    protocol: str | None = None,
    cache_bytes: int = 1 << 30,
) -> Capture:
    """Open a capture of any known layout, reading only calibration and lists of files.

    Args:
        path: folder of the capture; docs/captures.md names it for each data set.
        format: name of the layout; None: recognised by its files.
        masks: folder of mattes that replace the capture's masks, matched to the images by their names.
        params: body parameters that replace the capture's (such as a tracker's).
        keypoints: folder of keypoints that replace the capture's, with a file or a folder for each camera in a layout
            of docs/captures.md.
        person: id in the files of the person whose keypoints are taken, in each view by itself; None: the subject.
        subject: where several people are in view, the place of the one that is taken, in the order in which views agree
            on them, by size and nearness to the middle (`smplxpp.capture.subject`); None: the first.
        rig: calibration of a rig that has no layout of a data set; unit and upward axis of any capture's world.
        body: body model of the parameters, for layouts that rotate it about the origin; None: open body.
        hold_out_every: hold out every n-th training camera as a novel view.
        protocol: name of the capture's protocol whose files are read; `params` replaces its parameters.
        cache_bytes: bound of the cache of decoded images in each process.

    Raises:
        InputError: no such folder, no matching layout or several, an unknown protocol or one with missing files, or
            what the reader refuses.

    Example:
        >>> capture = smplxpp.open_capture("data/fixtures/person", protocol="tracked")
        >>> len(capture.cameras), len(capture.frames)
        (8, 16)
    """
    # Absolute, because a worker of a data loader may have another working directory.
    root = Path(path).absolute()
    require_folder(path)
    if format is not None:
        require_choice("format of the capture", format, FORMATS)
    options = ReaderOptions(
        params=None if params is None else Path(params),
        protocol=protocol,
        body=body,
        person=person,
        rig=rig or RigOptions(),
    )
    try:
        # A calibration that is named makes a rig of the folder.
        name = format or ("rig" if options.rig.calibration is not None else detect_format(root))
        recording = READERS[name].read(root, options)
    except OSError as error:  # folders that may not be listed, names that are too long for a file
        raise InputError(f"capture {root}", expected="files that can be listed", received=str(error)[:300]) from None
    if recording.protocol != protocol:
        raise InputError(
            f"protocol {protocol} of capture {root.name}",
            expected=f"a capture of our own layout ({simple.NAME}), which can have protocols",
            received=f"one of the layout {recording.format}",
            remedy="name its parameters with --params, or convert it with `smplxpp capture convert`",
        )
    if recording.format != "rig":
        recording = _upright(recording, options)
    lost = lens_problems(recording.cameras, recording.distortions)
    recording = replace(recording, problems=(*recording.problems, *lost))
    if masks is not None:
        recording = with_masks(recording, Path(masks))
    if keypoints is not None:
        recording = with_keypoints(recording, Path(keypoints), KeypointOptions(person=person))
    if person is None:
        recording = _with_subject(recording, subject)
    splits = recording.splits or Splits.all_train(recording.cameras, recording.frames())
    if hold_out_every is not None:
        splits = splits.hold_out_cameras(hold_out_every)
    windows = {name: Window.full(camera) for name, camera in recording.cameras.items()}
    return Capture(recording, splits, windows, ArrayCache(cache_bytes))


def _upright(recording: Recording, options: ReaderOptions) -> Recording:
    """Return the recording in metres with y up, where unit and axis of its world are stated.

    Parameters that the options bring are of the world that results.

    Raises:
        InputError: meshes, normals or parameters that cannot be turned or scaled alike.
    """
    up, scale = options.rig.up, UNITS[options.rig.units or "m"]
    if up in (None, "y") and scale == 1.0:
        return recording
    own = None if options.params is not None else recording.params
    if recording.meshes or recording.files.get("normal") or not (own is None or isinstance(own, ParamFiles)):
        raise InputError(
            "--up and --units",
            expected="cameras and images, with a file of parameters for each frame at most",
            received=f"a capture of the layout {recording.format} with meshes, normals or stacked parameters",
            remedy="leave --up and --units away: their world is that of the cameras",
        )
    if isinstance(own, ParamFiles) and scale != 1.0:
        raise InputError("--units", expected="m: parameters are in metres", received=str(options.rig.units))
    # x_cam = R x + t, with x = U^T x' in the world that stands on y, and lengths times the unit.
    turn, cameras = upright_rotation(up or "y"), {}
    for name, camera in recording.cameras.items():
        pose = camera.cam_from_world.copy()
        pose[:3, :3], pose[:3, 3] = pose[:3, :3] @ turn.T, scale * pose[:3, 3]
        cameras[name] = replace(camera, cam_from_world=pose)
    params = replace(own, up=cast("UpAxis", up)) if isinstance(own, ParamFiles) and up else recording.params
    return replace(recording, cameras=cameras, params=params)


def _with_subject(recording: Recording, subject: int | None) -> Recording:
    """Return the recording with the keypoints of one person over all cameras and frames."""
    files = recording.keypoints
    if not isinstance(files, KeypointFiles):
        return recording
    masks = recording.files.get("mask", {})

    def mask(camera: str, frame: int) -> np.ndarray | None:
        path = masks[camera].path(frame) if camera in masks else None
        return None if path is None else np.asarray(read_alpha(path))

    chosen = SubjectKeypoints(files, recording.cameras, recording.distortions, subject, mask if masks else None)
    return replace(recording, keypoints=chosen)


def detect_format(path: str | Path) -> str:
    """Return the name of the only layout that matches a folder.

    Raises:
        InputError: no layout matches, or several do.
    """
    root = Path(path)
    fitting = [name for name, reader in READERS.items() if name != rig.NAME and reader.detect(root)]
    # A calibration file alone makes a rig of any folder that no layout of a data set fits; looking for one opens files.
    if not fitting and rig.detect(root):
        return rig.NAME
    if len(fitting) == 1:
        return fitting[0]
    have = sorted(entry.name for entry in root.iterdir())
    received = ", ".join(have[:_LISTED]) + (f" and {len(have) - _LISTED} more" if len(have) > _LISTED else "")
    if fitting:
        raise InputError(
            f"capture {root}",
            expected="the files of one layout",
            received=f"a folder with {received}, which fits {' and '.join(fitting)}",
            remedy="name the layout: --format",
        )
    error = InputError(
        f"capture {root}",
        expected="the files of one layout",
        received=f"a folder with {received or 'nothing'}",
        remedy="docs/captures.md has all layouts; the nearest follow",
    )
    for line in _nearest(root):
        error.add_note(line)
    raise error


def _nearest(root: Path) -> list[str]:
    """Describe the layouts that share most files with a folder, one a line: name, its files, those present.

    The words of a reader's `LOOKS_FOR` that name files or folders are looked for in the folder and in its folders.
    """
    inside = [path.name for path in root.iterdir()]
    for folder in subfolders(root)[:_LISTED]:
        inside += [path.name for path in (root / folder).iterdir()][:_MOST_NAMES]
    ranked = []
    for place, (name, reader) in enumerate(READERS.items()):
        files = _FILE_WORD.findall(reader.LOOKS_FOR)
        present = [word for word in files if any(fnmatch(one.lower(), word.rstrip("/").lower()) for one in inside)]
        ranked.append((-len(present) / max(1, len(files)), place, name, present))
    ranked.sort()
    missing = rig.what_is_missing(root)
    lines = [f"{rig.NAME}: {missing}"] if missing else []
    for _, _, name, present in ranked[: _NEAREST - len(lines)]:
        found = f" (there: {', '.join(present)})" if present else ""
        lines.append(f"{name}: {READERS[name].LOOKS_FOR}{found}")
    return lines
