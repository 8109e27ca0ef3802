"""Make a capture of many cameras and frames out of few images, by hard links, and time what a training does before it.

python -m benchmarks big_capture --out DIR --run RUN [--frames 600] [--cameras 60] [--size 1500 2000] [--store]

RUN holds a template of the embedded person (`smplxpp build RUN --capture data/fixtures/person`). Cameras and frames are
those of the embedded person again and again, so that silhouettes fit; each file has as many names as there are views.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.support.results import store_results
from smplxpp.body import load_params
from smplxpp.capture import Capture, open_capture
from smplxpp.core.files.atomic import atomic_write_text

PERSON = Path(__file__).parents[2] / "data" / "fixtures" / "person"
SHOWN_FRAMES = 4  # frames of the person that have files


def make_capture(out: Path, cameras: int, frames: int, size: tuple[int, int]) -> None:
    """Write a capture in our layout; every file beyond those of a few views is a hard link."""
    source = open_capture(PERSON)
    names = [name for name in source.cameras if name.startswith("Cam")]
    first = {
        (name, frame): _write_view(source, out, name, frame, size) for name in names for frame in range(SHOWN_FRAMES)
    }
    listed = []
    for number in range(cameras):
        own, name = names[number % len(names)], f"View{number:03d}"
        camera = source.cameras[own]
        scale = [size[0] / camera.width, size[1] / camera.height, 1.0]
        pose = camera.cam_from_world
        listed.append(
            {
                **{"name": name, "w": size[0], "h": size[1], "K": (np.diag(scale) @ camera.K).tolist()},
                **{"R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()},
            }
        )
        for kind, folder, suffix in (("rgb", "rgbs", ".jpg"), ("mask", "masks", ".png")):
            place = out / folder / name
            place.mkdir(parents=True)
            for frame in range(frames):
                os.link(first[own, frame % SHOWN_FRAMES][kind], place / f"{name}_{kind}{frame:06d}{suffix}")
    params = load_params(PERSON / "params" / "params_noisy.npz")
    (out / "params").mkdir()
    params.select([frame % SHOWN_FRAMES for frame in range(frames)]).save(out / "params" / "params.npz")
    atomic_write_text(out / "cameras.json", json.dumps({"cameras": listed}))
    held_out = frames // 10
    about = {
        **{"name": out.name, "fps": 10.0, "background": [0, 0, 0], "inputs": {"parameters": {"params.npz": "tracked"}}},
        **{"train_frames": [0, frames - held_out - 1], "novel_pose_frames": [frames - held_out, frames - 1]},
        **{"train_views": [c["name"] for c in listed[:-4]], "novel_views": [c["name"] for c in listed[-4:]]},
    }
    atomic_write_text(out / "capture.json", json.dumps(about))


def _write_view(source: Capture, out: Path, camera: str, frame: int, size: tuple[int, int]) -> dict[str, Path]:
    """Write image and mask of a view at another size."""
    from PIL import Image

    files = {}
    for kind, suffix in (("rgb", ".jpg"), ("mask", ".png")):
        pixels = source.image(camera, frame) if kind == "rgb" else source.mask(camera, frame)
        files[kind] = out / "files" / f"{camera}_{kind}{frame:06d}{suffix}"
        files[kind].parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).resize(size).save(files[kind], quality=95)
    return files


def measure(capture: Path, run: Path, checked: str) -> dict[str, dict[str, float]]:
    """Time opening, `capture check`, a dry run of a training, and opening for one; each in its own process."""
    given = ["--capture", str(capture), "--params", "params.npz"]
    scene = (
        "from pathlib import Path; from pipelines.stages.scene import TrainInputs, open_scene; "
        f"open_scene(Path({str(run)!r}), TrainInputs(Path({str(capture)!r}), Path('params.npz')), refined=False)"
    )
    check = ["capture", "check", str(capture), "--frames", checked, "--json"]
    commands = {
        "open": ["-c", f"import smplxpp; smplxpp.open_capture({str(capture)!r}).frames"],
        f"capture check of frames {checked}": ["-m", "pipelines.cli", *check],
        "train --dry-run": [
            "-m",
            "pipelines.cli",
            "train",
            str(run),
            *given,
            "--preset",
            "gpu",
            "--device",
            "cpu",
            "--dry-run",
            "--json",
        ],
        "open for a training": ["-c", scene],
    }
    return {name: _run([sys.executable, *words]) for name, words in commands.items()}


def _run(command: list[str]) -> dict[str, float]:
    """Run a command, and return its seconds, those of its cores, and its largest memory, MB."""
    begin = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    return {
        **{"seconds": round(time.perf_counter() - begin, 2), "core_seconds": round(used.ru_utime + used.ru_stime, 2)},
        **{"peak_mb": round(used.ru_maxrss / 1024, 1), "exit_status": os.waitstatus_to_exitcode(status)},
    }


def main() -> int:
    """Make a capture unless it is there, measure, and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--cameras", type=int, default=60)
    parser.add_argument("--size", type=int, nargs=2, default=(1500, 2000))
    parser.add_argument("--check", default="0:600:150", help="frames whose images `capture check` opens")
    parser.add_argument("--store", action="store_true", help="keep the figures in benchmarks/results")
    args = parser.parse_args()
    rows = {}
    if not args.out.exists():
        begin, own = time.perf_counter(), time.process_time()
        make_capture(args.out, args.cameras, args.frames, (args.size[0], args.size[1]))
        seconds = {"seconds": time.perf_counter() - begin, "core_seconds": time.process_time() - own}
        rows["make"] = {name: round(value, 2) for name, value in seconds.items()}
    rows |= measure(args.out, args.run, args.check)
    print(json.dumps(rows, indent=1))
    if args.store:
        given = (
            f"--frames {args.frames} --cameras {args.cameras} --size {args.size[0]} {args.size[1]} --check {args.check}"
        )
        command = f"python -m benchmarks big_capture --out DIR --run RUN {given}"
        store_results(f"big_capture_{args.cameras}_{args.frames}", command, {"rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
