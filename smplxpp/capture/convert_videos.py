"""Write a rig's videos as a capture in our layout: images decoded at common times, keypoints, cameras, lenses."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from smplxpp.capture.capture import Capture
from smplxpp.capture.convert import Conversion, claim_folder
from smplxpp.capture.video_files import Video, probe_video, video_frames
from smplxpp.capture.video_sync import Timeline, found_offsets, timeline
from smplxpp.capture.writers import camera_entry, lens_entry, write_keypoints
from smplxpp.core import Camera, Keypoints2D
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress, require_between, require_choice
from smplxpp.core.files.atomic import atomic_write_bytes, atomic_write_text


@dataclass(frozen=True)
class VideoConfig:
    """Times and selection of a conversion of videos.

    Attributes:
        offsets: seconds at which cameras started, on a common clock; cameras that are not named started at 0.
        sync: "none" takes the offsets; "sound" and "motion" find them.
        frames: frames of the common time that are kept; None: all.
        cameras: cameras that are kept; None: all that have a video.
        quality: quality of the JPEG images.

    Raises:
        InputError: offsets beside a search for them, an unknown method of search, a quality out of range.
    """

    offsets: Mapping[str, float] = field(default_factory=dict)
    sync: str = "none"
    frames: tuple[int, ...] | None = None
    cameras: tuple[str, ...] | None = None
    quality: int = 92

    def __post_init__(self) -> None:
        require_choice("--sync", self.sync, ("none", "sound", "motion"))
        require_between("--quality", self.quality, 1, 100)
        if self.offsets and self.sync != "none":
            raise InputError("--sync", expected="none beside --offset", received=self.sync)


def convert_videos(
    capture: Capture,
    videos: Mapping[str, Path],
    out: Path,
    config: VideoConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> Conversion:
    """Decode the videos of a rig into a capture in our layout.

    Frame n of the capture is one moment in all cameras (`timeline`). Keypoints follow: those of a video's frame become
    those of the moment that shows it. Images keep their lens, which cameras.json states. Existing images are kept, so
    that an interrupted conversion continues.

    Args:
        capture: the opened rig, with its cameras and keypoints.
        videos: file of each camera.
        out: a new or an empty folder, or that of the same conversion, interrupted.
        config: times and selection.
        progress: called with the share of the frames that is written.

    Raises:
        InputError: cameras, frames or offsets that do not exist, videos of another shape than calibrated, or no
            common time.
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    config = config or VideoConfig()
    names = _chosen(capture, videos, config)
    probed = {name: probe_video(videos[name]) for name in names}
    stored = {name: _as_stored(probed[name], capture.cameras[name]) for name in names}
    offsets = config.offsets if config.sync == "none" else found_offsets(probed, config.sync)
    times = timeline(probed, offsets)
    frames = _frames(times, config)
    out = Path(out).absolute()
    record = {**asdict(config), "offsets": {name: round(offsets.get(name, 0.0), 4) for name in names}}
    claim_folder(capture, out, record)
    notes = [problem.message for problem in capture.problems if "videos, which" not in problem.message]
    if config.sync != "none":
        found = ", ".join(f"{name}={offsets[name]:.3f}" for name in names)
        notes.append(f"cameras started, by their {config.sync}, at {found} s (--offset names other times)")
    written, kept = 0, 0
    for done, name in enumerate(names):
        new, old, missing = _write_images(
            out, name, probed[name], times.sources[name][frames], (frames, capture.cameras[name]), stored[name], config
        )
        written, kept = written + new, kept + old
        if missing:
            notes.append(f"camera {name}: {missing} frames at the end could not be decoded")
        progress("videos", (done + 1) / len(names))
    _write_keypoints(capture, out, times, frames)
    # Cameras and description last: an unfinished folder is no capture.
    _write_cameras(capture, names, out)
    description = {"name": capture.name, "fps": times.fps, "background": None}
    atomic_write_text(out / "capture.json", json.dumps(description, indent=1) + "\n")
    return Conversion(out, written + kept, 0, written, kept, tuple(notes))


def _chosen(capture: Capture, videos: Mapping[str, Path], config: VideoConfig) -> list[str]:
    """Return the cameras to convert, in the order of the capture."""
    have = [name for name in capture.cameras if name in videos]
    for option, named in (("--cameras", config.cameras or ()), ("--offset", tuple(config.offsets))):
        unknown = [name for name in named if name not in have]
        if unknown:
            raise InputError(option, expected=f"cameras among {', '.join(have)}", received=", ".join(unknown))
    return [name for name in have if config.cameras is None or name in config.cameras]


def _frames(times: Timeline, config: VideoConfig) -> np.ndarray:
    """Return the frames of the common time to keep."""
    everything = np.arange(len(times))
    if config.frames is None:
        return everything
    outside = [frame for frame in config.frames if not 0 <= frame < len(times)]
    if outside:
        raise InputError(
            "--frames", expected=f"frames 0 to {len(times) - 1}", received=", ".join(map(str, outside[:6]))
        )
    return np.array(sorted(set(config.frames)), dtype=np.int64)


def _as_stored(video: Video, camera: Camera) -> bool:
    """Tell whether the camera was calibrated on frames without the rotation that the file asks for."""
    return video.turned and (video.width > video.height) != (camera.width > camera.height)


def _write_images(
    out: Path,
    name: str,
    video: Video,
    sources: np.ndarray,
    shown: tuple[np.ndarray, Camera],
    as_stored: bool,
    config: VideoConfig,
) -> tuple[int, int, int]:
    """Write the images of a camera; return how many are new, how many stood there, and how many the video lacks."""
    from PIL import Image

    frames, camera = shown
    paths = {int(f): out / "rgbs" / name / f"{name}_rgb{int(f):06d}.jpg" for f in frames}
    missing = {int(f): int(s) for f, s in zip(frames, sources, strict=True) if not paths[int(f)].is_file()}
    # Several frames of the capture may show one of a slow video.
    by_source: dict[int, list[int]] = {}
    for frame, source in missing.items():
        by_source.setdefault(source, []).append(frame)
    written = 0
    for number, picture in video_frames(video, list(by_source), (camera.width, camera.height), as_stored=as_stored):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "JPEG", quality=config.quality, subsampling=0)
        for frame in by_source[number]:
            atomic_write_bytes(paths[frame], buffer.getvalue())
            written += 1
    return written, len(frames) - len(missing), len(missing) - written


def _write_keypoints(capture: Capture, out: Path, times: Timeline, frames: np.ndarray) -> None:
    """Write the keypoints of the kept frames, in pixels of the images on disk."""
    source = capture.recording.keypoints
    for name in times.sources if source is not None else ():
        found = None if source is None else source.read(name)
        if found is None or not found.names:
            continue
        # Rows of the video's frames; frames that the detector left out have no row.
        row_of = {int(frame): row for row, frame in enumerate(found.frames)}
        rows = [row_of.get(int(s), -1) for s in times.sources[name][frames]]
        confidence = np.where(np.array(rows)[:, None] >= 0, found.confidence[rows], 0.0)
        points = np.where(confidence[..., None] > 0, found.points[rows], 0.0)
        write_keypoints(out / "keypoints" / f"{name}.npz", Keypoints2D(found.names, frames, points, confidence))


def _write_cameras(capture: Capture, names: Sequence[str], out: Path) -> None:
    """Write intrinsics, poses and distortion of the cameras to cameras.json."""
    recording = capture.recording
    entries = [
        camera_entry(recording.cameras[name], name) | lens_entry(recording.distortions.get(name)) for name in names
    ]
    atomic_write_text(out / "cameras.json", json.dumps({"cameras": entries}, indent=1) + "\n")
