"""Read a laboratory's rig: a calibration of any known tool, and beside it keypoints, images or videos, one folder or
file a camera, under any spelling of the cameras' names."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from smplxpp.capture.calibrations import find_calibration, read_calibration
from smplxpp.capture.calibrations.camera_files import OPENCAP_FILE
from smplxpp.capture.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, FileSeries, images_beside, matched_names, subfolders
from smplxpp.capture.keypoint_files import KeypointOptions
from smplxpp.capture.keypoints import KeypointFiles, find_places
from smplxpp.capture.readers.common import ReaderOptions, chosen_params
from smplxpp.capture.recording import Problem, Recording
from smplxpp.capture.video_files import probe_video
from smplxpp.core import Camera, InputError
from smplxpp.core.errors import MissingExtraError
from smplxpp.core.files.image_file import image_size

NAME = "rig"
LOOKS_FOR = "a calibration of a known tool, there or beside it, with keypoints, images or videos of its cameras"
# Where tools put keypoints, images, masks and videos; the first folder that holds something of the cameras is taken.
_KEYPOINTS = ("keypoints", "pose-associated", "pose-sync", "pose", "poses", "openpose", "json", ".")
_IMAGES = ("rgbs", "images", "imgs", "images_lr", "hdImgs", "kinect_color", "frames", ".")
_MASKS = ("masks", "mask", "fmask_lr", "fmask", "kinect_mask", "mattes")
_VIDEOS = ("videos", "video", "videos-raw", "recordings", "synchronized_videos", "hdVideos", ".")
_PARENTS = 2  # folders above in which a session's calibration is looked for
# The last number of a name is the frame: `cam01_000012.jpg`, `0005_img.jpg`.
_NUMBERED = rf"(?:.*\D)?(?P<frame>\d+)\D*\.(?i:{'|'.join(suffix[1:] for suffix in IMAGE_SUFFIXES)})"


def detect(root: Path) -> bool:
    """Tell whether a calibration is found, and videos, or keypoints or images in folders of cameras."""
    calibration = _calibration_near(root)
    if calibration is None:
        return False
    try:
        names = list(read_calibration(calibration).cameras)
    except InputError:
        return calibration.parent == root  # its error says more than that no layout fits
    return bool(find_keypoints(root, names) or find_series(root, names, _IMAGES) or find_videos(root, names))


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a rig. Videos are named by a note: `smplxpp capture convert` decodes them.

    Raises:
        InputError: no calibration, or nothing of its cameras.
    """
    calibration = options.rig.calibration or _calibration_near(root)
    if calibration is None:
        raise InputError(
            f"rig {root}",
            expected="a calibration in the folder, in one whose name has `calib`, or beside it",
            received=", ".join(sorted(path.name for path in root.iterdir())[:8]) or "nothing",
            remedy="name it with --calibration",
        )
    calibrated = read_calibration(calibration, units=options.rig.units, up=options.rig.up)
    names = list(calibrated.cameras)
    images = find_series(root, names, _IMAGES)
    videos = {} if images else find_videos(root, names)
    places, masks = find_keypoints(root, names), find_series(root, names, _MASKS)
    if not (places or images or videos):
        raise InputError(
            f"rig {root}",
            expected=f"keypoints, images or videos whose names tell the cameras {', '.join(names[:6])}",
            received=", ".join(sorted(path.name for path in root.iterdir())[:8]) or "nothing",
        )
    # Images may have another resolution than the calibration's.
    sizes = {name: image_size(series.required(int(series.numbers[0]))) for name, series in images.items()}
    sizes = sizes or _video_sizes(videos, calibrated.cameras)
    if sizes:
        calibrated = read_calibration(calibration, units=options.rig.units, up=options.rig.up, sizes=sizes)
    notes = [f"calibration {calibrated.path.name} ({calibrated.format}): {note}" for note in calibrated.notes]
    if videos:
        notes.append(f"{len(videos)} videos, which `smplxpp capture convert` decodes to images")
    for what, found in (("keypoints", places), ("images", images)):
        missing = [name for name in names if name not in found]
        if found and missing:
            notes.append(f"no {what} of the cameras {', '.join(missing[:8])}{' ...' if len(missing) > 8 else ''}")
    cameras = calibrated.cameras
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=calibrated.distortions,
        files={"image": images, "mask": masks},
        params=chosen_params(options),
        keypoints=KeypointFiles(places, KeypointOptions(person=options.person), sizes) if places else None,
        problems=tuple(Problem(note) for note in notes),
    )


def what_is_missing(root: Path) -> str | None:
    """Return what a folder lacks to be a rig, where something of a rig is there; None elsewhere."""
    calibration = _calibration_near(root)
    if calibration is not None and root in calibration.parents:
        names = ", ".join(list(read_calibration(calibration).cameras)[:6])
        return f"the calibration {calibration.name} is there; keypoints, images or videos named like {names} are not"
    videos = [p for name in _VIDEOS if (root / name).is_dir() for p in (root / name).iterdir()]
    folders = [folder for name in _KEYPOINTS if (root / name).is_dir() for folder in subfolders(root / name)]
    count = sum(path.suffix.lower() in VIDEO_SUFFIXES for path in videos)
    count = count or sum(name.lower().endswith("_json") for name in folders)
    if not count:
        few = 6  # photographs that a turn has at least
        places = (root / name for name in _IMAGES if (root / name).is_dir())
        if any(sum(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir()) >= few for folder in places):
            turn = "of a person who turns before one camera `smplxpp capture turntable` makes a capture"
            return f"photographs are there; a calibration (docs/rigs.md) is not: --calibration names it; {turn}"
        return None
    if calibration is not None:
        # It may belong to other recordings of the folder that both lie in.
        names = ", ".join(list(read_calibration(calibration).cameras)[:6])
        return f"videos or folders of keypoints are there, but not of two cameras of {calibration} ({names})"
    return "videos or folders of keypoints are there; a calibration (docs/rigs.md) is not: --calibration names it"


def _video_sizes(videos: Mapping[str, Path], cameras: Mapping[str, Camera]) -> dict[str, tuple[int, int]]:
    """Return the sizes of videos, in the orientation of their camera; nothing where ffmpeg is not installed."""
    try:
        probed = {name: probe_video(path) for name, path in videos.items()}
    except (MissingExtraError, InputError):
        return {}  # the conversion of the videos says why
    out = {}
    for name, video in probed.items():
        # A video that asks to be turned may have been calibrated as it is stored.
        swapped = video.turned and (video.width > video.height) != (cameras[name].width > cameras[name].height)
        out[name] = (video.height, video.width) if swapped else (video.width, video.height)
    return out


def find_keypoints(root: Path, names: list[str]) -> dict[str, Path]:
    """Return the keypoints of each camera in the first folder that has those of two cameras."""

    def there(folder: Path) -> dict[str, Path]:
        found = find_places(folder, names)
        return {name: path for name, path in found.items() if path.is_file() or any(path.glob("*.json"))}

    return _first(root, _KEYPOINTS, there)


def find_series(root: Path, names: list[str], folders: tuple[str, ...]) -> dict[str, FileSeries]:
    """Return the numbered images of each camera in the first folder that has those of two cameras.

    They lie in a folder a camera, or all in one with names that begin with the camera's.
    """

    def there(folder: Path) -> dict[str, FileSeries]:
        matched = matched_names(names, subfolders(folder))
        found = {name: FileSeries.find(folder / inside, _NUMBERED) for name, inside in matched.items()}
        return {name: series for name, series in found.items() if len(series)} or images_beside(folder, names)

    return _first(root, folders, there)


def find_videos(root: Path, names: list[str]) -> dict[str, Path]:
    """Return the video of each camera in the first folder that has those of two cameras.

    They lie in it, or in a folder a camera (`Cam0/InputMedia/walk/walk.mov`).

    Raises:
        InputError: folders of cameras hold several takes.
    """

    def there(folder: Path) -> dict[str, Path]:
        files = {path.stem: path for path in _videos_in(folder)}
        beside = {name: files[stem] for name, stem in matched_names(names, list(files)).items()}
        return beside or _videos_of_folders(folder, matched_names(names, subfolders(folder)))

    return _first(root, _VIDEOS, there)


def _videos_in(folder: Path, inside: str = "*") -> list[Path]:
    return sorted(p for p in folder.glob(inside) if p.suffix.lower() in VIDEO_SUFFIXES and p.is_file())


def _videos_of_folders(folder: Path, matched: Mapping[str, str]) -> dict[str, Path]:
    """Return the video in each camera's folder: the highest, and of a take and its synchronized copy the copy."""
    levels = ("*", "*/*", "*/*/*")  # OpenCap's lie in `InputMedia/TAKE`
    own = {name: next((v for at in levels if (v := _videos_in(folder / sub, at))), []) for name, sub in matched.items()}
    takes = sorted({re.sub("[_-]?sync.*", "", path.stem.lower()) for videos in own.values() for path in videos})
    if any(len(videos) > 1 for videos in own.values()) and len(takes) > 1:
        raise InputError(
            f"rig {folder}",
            expected="one video in the folder of each camera",
            received=f"several takes: {', '.join(takes[:6])}",
            remedy="copy those of one take and the cameras' calibration into a folder of its own",
        )
    return {
        name: next((path for path in videos if "sync" in path.stem.lower()), videos[0])
        for name, videos in own.items()
        if videos
    }


def _first(root: Path, folders: tuple[str, ...], there: Callable[[Path], dict]) -> dict:
    """Return what the first of some folders, named in any case, holds of at least two cameras; nothing without one."""
    spelled = {name.lower(): root / name for name in reversed(subfolders(root))}
    for name in folders:
        folder = root if name == "." else spelled.get(name.lower())
        if folder is not None and len(found := there(folder)) >= 2:
            return found
    return {}


def _calibration_near(root: Path) -> Path | None:
    """Return the calibration in a folder, in its folders with `calib` in the name, or in those of the folders above.

    OpenCap keeps a file in the folder of each camera.
    """
    found = find_calibration(root) or next(
        (path for at in ("*", "[Vv]ideos/*") for path in sorted(root.glob(f"{at}/{OPENCAP_FILE}"))), None
    )
    if found is not None:
        return found
    for folder in (root, *list(root.parents)[:_PARENTS]):
        for name in subfolders(folder):
            if re.search("calib", name, re.IGNORECASE) and (found := find_calibration(folder / name)) is not None:
                return found
    # Some tools keep it beside the takes, caliscope beside the folder of all takes.
    return next((f for folder in list(root.parents)[:_PARENTS] if (f := find_calibration(folder)) is not None), None)
