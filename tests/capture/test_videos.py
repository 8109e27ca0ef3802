"""Videos of a rig, one file a camera: rates, offsets, sound, motion, rotation flags, and their conversion."""

from __future__ import annotations

import json
import re
import subprocess
import wave
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.commands.capture import CaptureConvertCommand
from smplxpp.capture import open_capture
from smplxpp.capture.readers.rig import find_videos
from smplxpp.capture.registry import detect_format
from smplxpp.capture.video_files import Video, probe_video, video_frames
from smplxpp.capture.video_sync import found_offsets, timeline
from smplxpp.core import InputError
from smplxpp.footage.turn_frames import sharpest_of_intervals
from tests.capture.calibration_writers import WRITERS
from tests.capture.calibration_writers import opencap as write_opencap
from tests.capture.calibration_writers import pose2sim as write_calibration
from tests.capture.test_calibrations import rig

ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra video reads videos")
WIDTH, HEIGHT, SECONDS = 160, 120, 8.0
EVENTS = np.cumsum(np.random.default_rng(3).uniform(0.2, 0.9, 12))  # seconds at which somebody claps


def picture(time: float, shade: int) -> np.ndarray:
    """A square that jumps at every clap, on a grey that tells the camera; its column tells the time."""
    out = np.full((HEIGHT, WIDTH, 3), shade, dtype=np.uint8)
    place = 12 * int((time >= EVENTS).sum())
    out[40:80, place : place + 40] = 250
    out[:8, : max(1, int(WIDTH * time / 12.0))] = 0
    return out


def sound(seconds: float, offset: float) -> bytes:
    """Claps in noise, from `offset` on."""
    rate, rng = 8000, np.random.default_rng(int(100 * offset))
    samples = rng.normal(0, 150, int(rate * seconds))
    for event in EVENTS - offset:
        start = int(event * rate)
        if 0 <= start < len(samples) - 800:
            samples[start : start + 800] += rng.normal(0, 9000, 800) * np.exp(-np.arange(800) / 160)
    return np.clip(samples, -32000, 32000).astype("<i2").tobytes()


def write_video(path: Path, *, fps: float, offset: float, shade: int, heard: bool = True) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    track = path.with_suffix(".wav")
    with wave.open(str(track), "wb") as out:
        out.setparams((1, 2, 8000, 0, "NONE", ""))
        out.writeframes(sound(SECONDS, offset))
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", str(fps), "-i", "-"]
    tracks = ["-i", str(track), "-c:a", "aac"] if heard else []
    command = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *raw, *tracks, "-c:v", "libx264", "-crf", "18"]
    frames = b"".join(picture(offset + k / fps, shade).tobytes() for k in range(round(SECONDS * fps)))
    subprocess.run([*command, "-pix_fmt", "yuv420p", "-t", str(SECONDS), str(path)], input=frames, check=True)
    track.unlink()
    return path


def time_shown(image: np.ndarray) -> float:
    """Seconds that the bar at the upper edge tells."""
    return float((image[3, :, 0] < 60).sum()) * 12.0 / WIDTH


@pytest.fixture(scope="module")
def take(tmp_path_factory) -> Path:
    """Three cameras that started at 0, 0.5 and 1.25 s; the third records 15 frames a second, the others 30."""
    root = tmp_path_factory.mktemp("take")
    cameras = {name: camera for name, camera in rig(count=3).items()}
    calibration = write_calibration(cameras, root)
    text = calibration.read_text().replace("[640.0, 480.0]", f"[{WIDTH}.0, {HEIGHT}.0]")
    # A quarter of the resolution: intrinsics are not looked at here.
    calibration.write_text(re.sub(r"distortions = .*", "distortions = [0.0, 0.0, 0.0, 0.0]", text))
    for k, (offset, fps) in enumerate(((0.0, 30.0), (0.5, 30.0), (1.25, 15.0))):
        write_video(root / "videos" / f"Camera{k + 1}.mp4", fps=fps, offset=offset, shade=60 + 40 * k)
        folder = root / "pose" / f"camera_{k + 1}_json"
        folder.mkdir(parents=True)
        for frame in range(0, round(SECONDS * fps)):
            # A face whose nose tells the number of the video's frame.
            rows = np.zeros((17, 3))
            rows[0] = [frame, 10.0, 0.9]
            entry = {"keypoints": rows[:, :2].tolist(), "keypoint_scores": rows[:, 2].tolist()}
            (folder / f"{frame:06d}.json").write_text(json.dumps([entry]))
    return root


def test_a_video_tells_what_it_holds(take):
    video = probe_video(take / "videos" / "Camera3.mp4")
    assert (video.width, video.height, video.fps, video.turned, video.sound) == (WIDTH, HEIGHT, 15.0, False, True)
    assert video.count == 120
    shown = dict(video_frames(video, [7, 90, 5000], (80, 60)))
    assert list(shown) == [7, 90] and shown[7].shape == (60, 80, 3)
    assert abs(float(np.median(shown[7])) - 140) < 4
    with pytest.raises(InputError, match="a video that ffmpeg reads"):
        probe_video(take / "Calib_scene.toml")


@pytest.mark.parametrize("by", ["sound", "motion"])
def test_offsets_are_found(take, by):
    videos = {f"c{k}": probe_video(take / "videos" / f"Camera{k}.mp4") for k in (1, 2, 3)}
    found = found_offsets(videos, by)
    # Motion is known to the frame of the slower video, sound to the block of 5 ms and its encoder's delay.
    np.testing.assert_allclose(list(found.values()), [0.0, 0.5, 1.25], atol=0.02 if by == "sound" else 0.05)


def test_recordings_without_a_common_event_are_refused(tmp_path):
    still = {}
    for k in range(2):
        path = write_video(tmp_path / f"c{k}.mp4", fps=10.0, offset=60.0 * (k + 1), shade=90, heard=False)
        still[f"c{k}"] = probe_video(path)
    with pytest.raises(InputError, match=r"an event that c0 and c1 share.*--offset CAM=SECONDS"):
        found_offsets(still, "motion")
    with pytest.raises(InputError, match="sound"):
        found_offsets(still, "sound")


def test_a_timeline_takes_the_common_time_at_the_lowest_rate():
    def video(fps: float, seconds: float) -> Video:
        return Video(Path("x.mp4"), 8, 8, fps, seconds, False, False)

    times = timeline({"a": video(60.0, 2.0), "b": video(30.0, 2.0)}, {"b": 0.5})
    assert times.fps == 30.0 and len(times) == 45
    np.testing.assert_array_equal(times.sources["a"][:3], [30, 32, 34])
    np.testing.assert_array_equal(times.sources["b"][:3], [0, 1, 2])
    with pytest.raises(InputError, match="a time that all of them show"):
        timeline({"a": video(60.0, 2.0), "b": video(30.0, 2.0)}, {"b": 2.5})


def test_frames_of_a_phone_are_where_their_stamps_say(tmp_path):
    """Frames of a film at a varying rate were taken for frames at its mean rate, .7 s off in 2.4."""
    stamps = np.r_[np.arange(20) * 0.02, 0.4 + np.arange(20) * 0.1]
    program, path = ffmpeg.get_ffmpeg_exe(), tmp_path / "phone.mp4"
    source = ["-f", "rawvideo", "-pix_fmt", "gray", "-s", "64x48", "-r", "20", "-i", "-"]
    late = ["-vf", "settb=1/1000,setpts=if(lt(N\\,20)\\,N*0.02\\,0.4+(N-20)*0.1)/TB", "-fps_mode", "passthrough"]
    command = [program, "-v", "error", *source, *late, "-enc_time_base", "1/1000", "-pix_fmt", "yuv420p", str(path)]
    subprocess.run(command, input=bytes(40 * 64 * 48), check=True, timeout=900)
    video = probe_video(path)
    np.testing.assert_allclose(video.times, stamps, atol=0.002)
    shown = timeline({"phone": video}, {}).sources["phone"]
    assert np.abs(video.times[shown] - np.arange(len(shown)) / video.fps).max() < 0.052
    # A turn goes by the clock: frames that are taken of it are evenly spaced in time.
    chosen = sharpest_of_intervals(np.zeros((40, 8, 8), np.uint8), video.times, 8)
    assert 0.14 < np.diff(video.times[chosen]).min() and np.diff(video.times[chosen]).max() < 0.46


def convert(take: Path, out: Path, **options: object) -> dict:
    return CaptureConvertCommand(take, out, json=True, **options).run()


@pytest.mark.long
def test_frames_of_the_conversion_are_moments(take, tmp_path):
    """Images and keypoints of all cameras show the same time, at the rate of the slowest."""
    out = tmp_path / "capture"
    done = convert(take, out, offset="cam_02=0.5,cam_03=1.25", frames="0,30,60")
    capture = open_capture(out)
    assert capture.format == "simple" and capture.fps == 15.0 and capture.frames == (0, 30, 60)
    assert done["views"] == 9 and capture.recording.background is None
    for frame in capture.frames:
        shown = [time_shown(capture.image(name, frame)) for name in capture.cameras]
        np.testing.assert_allclose(shown, 1.25 + frame / 15.0, atol=0.1)
        for name, (offset, fps) in zip(capture.cameras, ((0.0, 30), (0.5, 30), (1.25, 15)), strict=True):
            nose = capture.keypoints(name).select(("nose",), [frame])
            assert nose.points[0, 0, 0] - 0.5 == pytest.approx((1.25 + frame / 15.0 - offset) * fps, abs=0.51)
            assert nose.confidence[0, 0] == pytest.approx(0.9, abs=0.01)
    # The same command continues; another one is refused.
    assert convert(take, out, offset="cam_02=0.5,cam_03=1.25", frames="0,30,60")["kept"] == 9
    with pytest.raises(InputError, match="other offsets"):
        convert(take, out, offset="cam_02=0.6,cam_03=1.25", frames="0,30,60")


def test_options_that_do_not_fit_are_refused_before_anything_is_decoded(take, tmp_path):
    for words, options in (
        ("--offset.*cam_01, cam_02, cam_03", {"offset": "cam_9=1"}),
        ("--offset.*CAM=SECONDS", {"offset": "cam_01"}),
        ("--sync.*none beside", {"offset": "cam_01=1", "sync": "sound"}),
        ("--layout.*simple for videos", {"layout": "actorshq"}),
        ("--frames.*frames 0 to 239", {"frames": "999", "cameras": "cam_01"}),
    ):
        with pytest.raises(InputError, match=words):
            convert(take, tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()


def test_videos_and_calibrations_in_a_folder_of_each_camera(tmp_path):
    """OpenCap's session: pickles in the cameras' folders, and below them a take with its synchronized copy."""
    cameras = {f"Cam{k}": replace(camera, width=WIDTH, height=HEIGHT) for k, camera in enumerate(rig(count=2).values())}
    session = tmp_path / "session"
    write_opencap(cameras, session)
    for k, name in enumerate(cameras):
        folder = session / "Videos" / name / "InputMedia" / "walk"
        write_video(folder / "walk.mov", fps=10.0, offset=0.0, shade=90 + 50 * k, heard=False)
        (folder / "walk_sync.mp4").write_bytes((folder / "walk.mov").read_bytes())
    for root in (session, session / "Videos"):
        found = find_videos(root, list(cameras))
        assert [path.name for path in found.values()] == ["walk_sync.mp4"] * 2 and list(found) == ["Cam0", "Cam1"]
        out = tmp_path / f"out_{root.name}"
        convert(root, out, frames="0,5")
        assert len(open_capture(out).views()) == 4
    (folder / "run.mov").write_bytes(b"")
    with pytest.raises(InputError, match="several takes: run, walk"):
        open_capture(session)


@pytest.mark.parametrize(
    ("tool", "take", "calibration", "name"),
    [
        ("caliscope", "recordings/walk", ".", "port_{}.mp4"),
        ("anipose", "2026-01-01", "2026-01-01/calibration", "videos-raw/vid1-cam{}.mp4"),
        ("opencv", "Trial", "Calibration", "Videos/GH{}.MP4"),
    ],
)
def test_videos_where_tools_keep_them(tool, take, calibration, name, tmp_path):
    """The calibration beside the folder of all takes, in one of its own; folders in any case."""
    (tmp_path / calibration).mkdir(parents=True, exist_ok=True)
    cameras = {f"cam_{k}": camera for k, camera in enumerate(rig(count=3).values(), start=1)}
    WRITERS[tool](cameras, tmp_path / calibration)
    for k in range(1, 4):
        video = tmp_path / take / name.format(k)
        video.parent.mkdir(parents=True, exist_ok=True)
        video.write_bytes(b"")
    assert detect_format(tmp_path / take) == "rig"
    assert [path.stem[-1] for path in find_videos(tmp_path / take, list(cameras)).values()] == ["1", "2", "3"]


def test_a_rotation_flag_is_followed_as_the_calibration_was(tmp_path):
    """A phone on end stores lying frames and a flag; a calibration of either orientation finds its frames."""
    lying = write_video(tmp_path / "lying.mp4", fps=10.0, offset=0.0, shade=80, heard=False)
    phone = tmp_path / "videos" / "cam1.mp4"
    phone.parent.mkdir()
    command = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-display_rotation", "90", "-i", str(lying)]
    subprocess.run([*command, "-c", "copy", str(phone)], check=True)
    (phone.parent / "cam2.mp4").write_bytes(phone.read_bytes())
    video = probe_video(phone)
    assert video.turned and (video.width, video.height) == (HEIGHT, WIDTH)
    for size in ((HEIGHT, WIDTH), (WIDTH, HEIGHT)):
        text = write_calibration(rig(count=2), tmp_path).read_text()
        text = text.replace("[640.0, 480.0]", f"[{size[0]}.0, {size[1]}.0]")
        (tmp_path / "Calib_scene.toml").write_text(text)
        out = tmp_path / f"out{size[0]}"
        convert_options = {"frames": "2", "up": "z"}
        root = tmp_path / "take"
        root.mkdir(exist_ok=True)
        for part in ("videos", "Calib_scene.toml"):
            if not (root / part).exists():
                (root / part).symlink_to(tmp_path / part)
        convert(root, out, **convert_options)
        image = np.asarray(Image.open(out / "rgbs" / "cam_01" / "cam_01_rgb000002.jpg"))
        assert image.shape == (size[1], size[0], 3)
        # The bar that tells the time lies at the upper edge of stored frames, at another edge of turned ones.
        assert (image[3, :2, 0] < 60).all() == (size == (WIDTH, HEIGHT)) or image[3, -2:, 0].max() < 60
