"""The parts of `python -m benchmarks gpu`, each run in a process of its own.

    python -m benchmarks.gpu.parts PART JOB.json

JOB.json holds a `Job`; what the part finds is written to `PART.json` in the job's folder after every figure, so that a
part that is stopped leaves what it had.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.gpu.timing import EnoughError, Probe, frames_a_second, largest_difference_mm, played, probed
from benchmarks.support.results import ROOT
from pipelines.runs.layout import BUILD_FILE, BUILD_STAGES, TEMPLATE
from smplxpp.capture import Capture, open_capture
from smplxpp.core.camera import Camera
from smplxpp.core.files import atomic_write_text, jsonable
from smplxpp.template.template import Template


@dataclass(frozen=True)
class Job:
    """Input of a part.

    Attributes:
        work: folder of this benchmark's files. run: with the template. capture: of the person.
        seconds: that the part should take at most; what is longer is stopped.
        device: "cuda", or "cpu" in a dry run, which takes toy sizes.
    """

    work: Path
    run: Path
    capture: Path
    seconds: float
    device: str

    @property
    def toy(self) -> bool:
        return self.device == "cpu"

    def save(self, path: Path) -> None:
        """Write it for the part's process."""
        path.write_text(json.dumps({name: str(value) for name, value in vars(self).items()}))

    @classmethod
    def load(cls, path: Path) -> Job:
        """Read what `save` wrote."""
        stored = json.loads(path.read_text())
        folders = {name: Path(stored[name]) for name in ("work", "run", "capture")}
        return cls(**folders, seconds=float(stored["seconds"]), device=stored["device"])


Note = Callable[..., None]


def mapping(job: Job, note: Note) -> None:
    """Our calls of gsplat draw what the float64 reference draws: the tests of the CUDA backend."""
    results = job.work / "mapping.xml"
    tests = [
        str(ROOT / "tests" / "rendering" / f"{name}.py")
        for name in ("test_gsplat_backend", "test_rasterize_invariance")
    ]
    chosen = tests[:1] if job.toy else tests
    tool = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", f"--junitxml={results}"]
    code = subprocess.run([*tool, *chosen], cwd=ROOT, check=False).returncode
    cases = list(ET.parse(results).iter("testcase"))
    outcome = {
        tag: [case.get("name", "") for case in cases if case.find(tag) is not None] for tag in ("failure", "skipped")
    }
    note(tests=len(cases), failed=outcome["failure"], skipped=outcome["skipped"])
    if code:
        raise RuntimeError(f"{len(outcome['failure'])} of {len(cases)} tests failed")
    if not job.toy and any("cuda" in name for name in outcome["skipped"]):
        raise RuntimeError("the comparison on CUDA was skipped")


def template(job: Job, note: Note) -> None:
    """The template that the parts after it need, built on the CPU unless the run has one."""
    if not (job.run / TEMPLATE).is_file():
        command("build", job.run, "--capture", job.capture, "--no-report", "--accept-failures")
    note(faces=len(_template(job).faces))


def demo(job: Job, note: Note) -> None:
    """The preset `demo`: a surface that is followed, loose clothes that are simulated; and its evaluation."""
    _to_the_end(job, note, "demo")


def cpu(job: Job, note: Note) -> None:
    """The preset `cpu` on the GPU, like `demo`."""
    _to_the_end(job, note, "cpu")


def steps(job: Job, note: Note) -> None:
    """Warm steps of every stage of `gpu` and `paper` at 1500x2000, and how busy the GPU is; then faster ones.

    `foretold_gib` is what a training foretells of the GPU's memory, to be held against `gib` of the stages.
    """
    import avatar

    size = (60, 80) if job.toy else (1500, 2000)
    capture = open_capture(enlarge(job.capture, job.work / "large", size, frames=3, cameras=4))
    rows: dict[str, Any] = {}
    foretold: dict[str, dict[str, float]] = {}
    note(width=size[0], height=size[1], rows=rows, foretold_gib=foretold)
    # Every stage first; of what may be faster the teacher alone, whose networks it changes.
    orders: list[tuple[str, str, str | None]]
    orders = [(preset, "plain", None) for preset in ("gpu", "paper")]
    orders += [(preset, way, "Teacher") for way in list(WAYS)[1:] for preset in ("gpu", "paper")]
    if job.toy:
        orders = [("gpu", "plain", None), ("paper", "plain", "Teacher"), ("gpu", "graphs", "Teacher")]
    for preset, way, last in orders:
        row = rows.setdefault(f"{preset}, {way}", {})
        seconds, profiled = (0.05, 1) if job.toy else (2.0, 2)
        probe = Probe(job.device, seconds, last, profiled, lambda _: note(rows=rows), row)
        config = avatar.TrainConfig(device=job.device, force=True, gaussians=300 if job.toy else None, **WAYS[way])
        begin = time.perf_counter()
        try:
            with probed(probe):
                chosen = _toy_preset(preset) if job.toy else preset
                foretold[f"{preset}, {way}"] = _foretold(config.recipe(chosen, cloth="none"), capture)
                out = job.work / "steps" / preset
                avatar.train(_template(job), capture, out, preset=chosen, refine="off", cloth="none", config=config)
        except EnoughError:
            pass
        except Exception as error:  # noqa: BLE001  the others are still worth their minutes
            row["error"] = f"{type(error).__name__}: {error}"[:500]
        row["whole_seconds"] = time.perf_counter() - begin
        note(rows=rows)
    if failed := [name for name, row in rows.items() if "error" in row]:
        raise RuntimeError(f"failed: {'; '.join(failed)}")


def _foretold(recipe: Any, capture: Capture) -> dict[str, float]:
    """Return the GiB of a GPU that the stages of a training are foretold to need at most, by the name of their step."""
    from avatar.training.engine.resources import foretell_memory

    splits, cameras = capture.splits, [capture.cameras[name] for name in capture.splits.train_cameras]
    needs = foretell_memory(
        recipe,
        megapixels=1e-6 * max(camera.width * camera.height for camera in cameras),
        images=len(cameras) * len(splits.train_frames),
        frames=len(splits.train_frames),
    )
    return {step: need.device for step, need in needs.items()}


WAYS: dict[str, dict[str, Any]] = {
    "plain": {},
    "bfloat16": {"precision": "bfloat16"},
    "graphs": {"compile": "graphs"},
    "graphs, bfloat16": {"compile": "graphs", "precision": "bfloat16"},
    "inductor, bfloat16": {"compile": "inductor", "precision": "bfloat16"},
}
"""Options of a training whose steps may be faster."""


def _toy_preset(name: str) -> Any:
    """Return a preset with networks and counts of a toy, and the steps that it needs to be timed."""
    from avatar.training.presets import training_preset

    small, like = training_preset("demo"), training_preset(name)
    joint = like.teacher.joint and replace(like.teacher.joint, control_points=800, iterations=100, frame_iterations=5)
    track = None if like.teacher.track is None else small.teacher.track
    teacher = replace(small.teacher, track=track, joint=joint)
    short = replace(small, teacher=teacher).shortened(0.1)
    return replace(short, fit=replace(short.fit, iterations=8))


def gpu(job: Job, note: Note) -> None:
    """The preset `gpu` on the embedded person, with as many of its steps as the time allows, and its evaluation."""
    preset, first = ("demo", 1e-9) if job.toy else ("gpu", 5e-4)
    begin = time.perf_counter()
    short = _train(job, "gpu_short", preset, "--cloth", "none", "--iterations-share", first)
    seconds = time.perf_counter() - begin
    note(preset=preset, short=_stages(short) | {"share": first, "seconds": seconds}, **_memory(job))
    of_steps = sum(stage["seconds_of_steps"] for stage in short["stages"].values())
    left = 0.6 * (job.seconds - seconds) - (seconds - of_steps)
    share = 0.01 if job.toy else min(1.0, first * left / of_steps)
    if share <= first:
        note(longer="no time left")
        return
    longer = _train(job, "gpu", preset, "--cloth", "none", "--iterations-share", share)
    note(longer=_stages(longer) | {"share": share, "finished": longer["finished"]}, **_memory(job))
    note(**_evaluated(job, "gpu"))


def loader(job: Job, note: Note) -> None:
    """Photographs of 1500x2000 a second by number of reading threads, from the disk's cache."""
    from concurrent.futures import ThreadPoolExecutor

    from avatar.data.views import read_view

    size, count = ((60, 80), 4) if job.toy else ((1500, 2000), 96)
    root = enlarge(job.capture, job.work / "large", size, frames=3, cameras=4)
    capture = open_capture(root, cache_bytes=0)
    views = itertools.islice(itertools.cycle(capture.views()), count)
    wanted, rates = list(views), {}
    for readers in (1, 2) if job.toy else (1, 2, 4, 8, 12):
        with ThreadPoolExecutor(readers) as pool:
            begin = time.perf_counter()
            list(pool.map(lambda view: read_view(capture, *view).cropped(12), wanted))
            rates[str(readers)] = count / (time.perf_counter() - begin)
        note(images_a_second=rates, cores=os.cpu_count())


def student(job: Job, note: Note) -> None:
    """Frames a second of a student with the paper's sizes, pose included: float32, half, fused, without a graph.

    Those of its bundle in a player end with the picture in the CPU's memory.
    """
    import avatar
    from avatar.models.networks.blend_shapes import BlendShapeConfig
    from avatar.models.student import StudentConfig

    count, pictures = (300, 2) if job.toy else (270_000, 100)
    sizes = ((48, 64),) if job.toy else ((1500, 2000), (512, 512))
    rig = avatar.Rig(_template(job), job.device)
    bound = avatar.sample_on_mesh(rig.template, avatar.SamplingConfig(count=count)).to(device=job.device)
    config = StudentConfig(blend_shapes=BlendShapeConfig(expression_size=rig.expression_size))
    model = avatar.Student(config, rig, bound, (0,)).eval()
    _shake(model)
    capture = open_capture(job.capture)
    params = [found for frame in capture.frames[:16] if (found := capture.params(frame)) is not None]
    camera = next(iter(capture.cameras.values()))
    center = torch.tensor(camera.position[None], dtype=torch.float32, device=job.device)
    with torch.no_grad():
        truth = model(rig.pose(params[-1]), center)
    note(gaussians=count, vertices=len(rig.vertices), trained=False, rows={})
    rows: dict[str, Any] = {}
    for name, dtype in (("float32", torch.float32), ("half", torch.float16)):
        for way, graph, fused in (("graph", True, False), ("fused graph", True, True), ("eager", False, False)):
            fast = model.compiled(dtype=dtype, graph=graph, fused=fused and not job.toy)
            # Half precision must not move Gaussians visibly: the largest distance from the plain student, millimetres.
            row: dict[str, Any] = {"difference_mm": largest_difference_mm(fast(params[-1], camera.position), truth)}
            row |= {"recorded": fast.recorded, "fused": fast.fused}
            rows[f"{name}, {way}"] = row
            for width, height in sizes:
                seen = fitted(camera, width, height)
                row[f"{width}x{height}"] = frames_a_second(fast, params, seen, pictures=pictures)
                note(rows=rows)
    avatar.export_student(model, job.work / "student.avatar")
    player = avatar.load(job.work / "student.avatar", device=job.device)
    rows["player"] = {f"{w}x{h}": played(player, params, fitted(camera, w, h), pictures=pictures) for w, h in sizes}
    note(rows=rows, **_memory(job))


def nccl(job: Job, note: Note) -> None:
    """Communication of processes by NCCL, with one process (gloo in a dry run)."""
    import torch.distributed as dist

    from avatar.training.engine.processes import join_processes

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), WORLD_SIZE="1", RANK="0", LOCAL_RANK="0")
    with join_processes(job.device) as together:
        # `Distributed` sends nothing where there is one process: the same messages, sent here.
        gradient = torch.full((1 << (10 if job.toy else 24),), 2.0, device=together.device)
        begin = time.perf_counter()
        dist.all_reduce(gradient)
        gathered = [torch.empty_like(gradient)]
        dist.all_gather(gathered, gradient)
        dist.broadcast(gradient, src=0)
        right = bool((gradient == 2.0).all() and (gathered[0] == 2.0).all())
        note(backend=dist.get_backend(), device=str(together.device), right=right, seconds=time.perf_counter() - begin)
    if not right:
        raise RuntimeError("messages came back changed")


PARTS: dict[str, Callable[[Job, Note], None]] = {
    part.__name__: part for part in (mapping, template, steps, student, gpu, loader, nccl, demo, cpu)
}
"""Parts, the most important first."""


def command(*arguments: object) -> dict[str, Any]:
    """The answer of `smplxpp ARGUMENTS --json`.

    Raises:
        RuntimeError: the command's own message.
    """
    from pipelines.cli import main

    words = io.StringIO()
    with redirect_stdout(words):
        code = main([*map(str, arguments), "--json"])
    text = words.getvalue()
    answer = json.loads(text) if text.strip() else {}
    if code:
        raise RuntimeError(answer.get("error", {}).get("message", f"exit status {code}: {text[-500:]}"))
    return answer


def _to_the_end(job: Job, note: Note, preset: str) -> None:
    """A whole training, and the evaluation of its student."""
    begin = time.perf_counter()
    size = ("--iterations-share", 0.01) if job.toy else ()
    answer = _train(job, preset, "demo" if job.toy else preset, "--cloth", "auto", *size)
    note(**_stages(answer), seconds=time.perf_counter() - begin, **_memory(job))
    note(**_evaluated(job, preset))


def _evaluated(job: Job, name: str) -> dict[str, Any]:
    """Return figures of the student of a run in the work folder, on held-out views and poses."""
    begin = time.perf_counter()
    views = ("--every", 8, "--samples", 300) if job.toy else ()
    run = ("evaluate", job.work / name, "--capture", job.capture, "--device", job.device, "--no-report")
    student = command(*run, *views)["models"]["student"]
    return {
        "views": {name: {key: mean[key] for key in ("psnr", "ssim")} for name, mean in student["mean"].items()},
        "counts": student["counts"],
        "seconds_of_evaluation": time.perf_counter() - begin,
    }


def _train(job: Job, name: str, preset: str, *options: object) -> dict[str, Any]:
    """A training in a run of its own with the template of the job's, and what a build knows beside it."""
    run = job.work / name
    for stage in BUILD_STAGES:
        if (job.run / stage).is_dir():
            shutil.copytree(job.run / stage, run / stage, dirs_exist_ok=True)
    if (job.run / BUILD_FILE).is_file():
        shutil.copyfile(job.run / BUILD_FILE, run / BUILD_FILE)
    toy = ("--gaussians", 300) if job.toy else ()
    where = (run, "--capture", job.capture, "--device", job.device, "--no-report")
    return command("train", *where, "--preset", preset, *toy, *options)


def _stages(answer: dict[str, Any]) -> dict[str, Any]:
    """Return steps, seconds, steps a second and PSNR of held-out views of each stage."""
    out = {}
    for name, numbers in answer["stages"].items():
        done, seconds = numbers["iterations_done"], numbers["seconds_of_steps"]
        held_out = numbers.get("novel_view") or numbers.get("mean", {}).get("held_out", {})
        out[name] = {
            "steps": done,
            "seconds": seconds,
            "steps_a_second": done / max(seconds, 1e-9),
            "psnr": held_out.get("psnr"),
        }
    return {"stages": out}


def _template(job: Job) -> Template:
    return Template.load(job.run / TEMPLATE)


def _shake(model: torch.nn.Module) -> None:
    """Give every parameter that starts at zero some value, so that nothing is left out."""
    torch.manual_seed(0)
    with torch.no_grad():
        for name, value in model.named_parameters():
            if not name.startswith("gaussians.") and not bool(value.any()):
                value.normal_(0.0, 1e-3)


def _memory(job: Job) -> dict[str, float]:
    return {} if job.toy else {"gpu_memory_gib": torch.cuda.max_memory_allocated() / 2**30}


def enlarge(source: Path, folder: Path, size: tuple[int, int], *, frames: int = 2, cameras: int = 3) -> Path:
    """A few views of a capture, cut to the shape of `size` (width, height) and enlarged to it, in our own layout.

    The last camera is held out.
    """
    capture = open_capture(source)
    about: dict[str, Any] = {"cameras": []}
    chosen = [*capture.splits.train_cameras[: cameras - 1], *capture.splits.novel_view_cameras[:1]]
    shown = capture.splits.train_frames[:frames]
    for name in chosen:
        # Cut to the wanted aspect first, then enlarge: intrinsics scale with the pixels.
        box, camera = cut(capture.cameras[name], size)
        for frame in shown:
            pictures = {"rgb": capture.image(name, frame), "mask": capture.mask(name, frame)}
            for tag, image in pictures.items():
                assert image is not None, f"{name} has no mask of frame {frame}"
                path = folder / f"{tag}s" / name / f"{name}_{tag}{frame:06d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                eight = image if image.dtype == np.uint8 else np.round(255.0 * image).astype(np.uint8)
                Image.fromarray(eight).crop(box).resize(size, Image.Resampling.BICUBIC).save(path)
        R, T = camera.cam_from_world[:3, :3].tolist(), camera.cam_from_world[:3, 3].tolist()
        about["cameras"].append({"name": name, "w": size[0], "h": size[1], "K": camera.K.tolist(), "R": R, "T": T})
    (folder / "params").mkdir(parents=True, exist_ok=True)
    for frame in shown:
        params = capture.params(frame)
        assert params is not None
        params.save(folder / "params" / f"{frame:06d}.npz")
    atomic_write_text(folder / "cameras.json", json.dumps(about))
    atomic_write_text(folder / "capture.json", json.dumps({"name": "large", "novel_views": chosen[cameras - 1 :]}))
    return folder


def cut(camera: Camera, size: tuple[int, int]) -> tuple[tuple[int, int, int, int], Camera]:
    """The largest box (left, top, right, bottom) with the shape of `size`, and the camera of it, enlarged."""
    unit = min(camera.width / size[0], camera.height / size[1])
    width, height = round(unit * size[0]), round(unit * size[1])
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    K = camera.K.copy()
    K[:2, 2] -= left, top
    K[:2] *= np.array([[size[0] / width], [size[1] / height]])
    return (left, top, left + width, top + height), replace(camera, K=K, width=size[0], height=size[1])


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """The camera with the largest part of its image that has the shape of another size."""
    return cut(camera, (width, height))[1]


def main() -> int:
    """Run one part; its error ends the process."""
    name, job = sys.argv[1], Job.load(Path(sys.argv[2]))
    found: dict[str, Any] = {}

    def note(**figures: Any) -> None:
        found.update(figures)
        atomic_write_text(job.work / f"{name}.json", json.dumps(jsonable(found)))

    PARTS[name](job, note)
    return 0


if __name__ == "__main__":
    sys.exit(main())
