"""Open a capture with the reader of its layout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from smplxpp.body import BodyModel
from smplxpp.capture.cache import ArrayCache
from smplxpp.capture.capture import Capture
from smplxpp.capture.keypoint_files import KeypointOptions
from smplxpp.capture.keypoints import with_keypoints
from smplxpp.capture.masks import with_masks
from smplxpp.capture.problems import lens_problems
from smplxpp.capture.readers import (
    actorshq,
    avatarrex,
    colmap,
    dress4d,
    easymocap,
    neus2,
    simple,
    talkbody4d,
    thuman4,
)
from smplxpp.capture.readers.common import ReaderOptions
from smplxpp.capture.splits import Splits
from smplxpp.capture.window import Window
from smplxpp.core import InputError, require_choice

_MODULES = (simple, actorshq, talkbody4d, avatarrex, thuman4, dress4d, neus2, easymocap, colmap)
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
        person: person whose keypoints are taken; None: in each frame the one of most confidence.
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
    if not root.is_dir():
        raise InputError("capture", expected="an existing folder", received=str(path))
    if format is not None:
        require_choice("format of the capture", format, FORMATS)
    options = ReaderOptions(
        params=None if params is None else Path(params), protocol=protocol, body=body, person=person
    )
    try:
        recording = READERS[format or detect_format(root)].read(root, options)
    except OSError as error:  # folders that may not be listed, names that are too long for a file
        raise InputError(f"capture {root}", expected="files that can be listed", received=str(error)[:300]) from None
    if recording.protocol != protocol:
        raise InputError(
            f"protocol {protocol} of capture {root.name}",
            expected=f"a capture of our own layout ({simple.NAME}), which can have protocols",
            received=f"one of the layout {recording.format}",
            remedy="name its parameters with --params, or convert it with `smplxpp capture convert`",
        )
    lost = lens_problems(recording.cameras, recording.distortions)
    recording = replace(recording, problems=(*recording.problems, *lost))
    if masks is not None:
        recording = with_masks(recording, Path(masks))
    if keypoints is not None:
        recording = with_keypoints(recording, Path(keypoints), KeypointOptions(person=person))
    splits = recording.splits or Splits.all_train(recording.cameras, recording.frames())
    if hold_out_every is not None:
        splits = splits.hold_out_cameras(hold_out_every)
    windows = {name: Window.full(camera) for name, camera in recording.cameras.items()}
    return Capture(recording, splits, windows, ArrayCache(cache_bytes))


def detect_format(path: str | Path) -> str:
    """Return the name of the only layout that matches a folder.

    Raises:
        InputError: no layout matches, or several do.
    """
    root = Path(path)
    fitting = [name for name, reader in READERS.items() if reader.detect(root)]
    if len(fitting) == 1:
        return fitting[0]
    looked_for = "; ".join(f"{name}: {reader.LOOKS_FOR}" for name, reader in READERS.items())
    have = sorted(entry.name for entry in root.iterdir())
    raise InputError(
        f"capture {root}",
        expected=f"the files of one layout ({looked_for})",
        received=f"a folder with {', '.join(have[:12]) or 'nothing'}"
        + (f", which fits {' and '.join(fitting)}" if fitting else ""),
        remedy="name the layout (format=...)" if fitting else "see docs/captures.md for what each layout needs",
    )
