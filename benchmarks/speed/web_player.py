"""Time the page's WebAssembly kernels beside the native ones, by part and on one thread and two, and its renderers.

python -m benchmarks web_player parts --run RUN [--before MODULES] [--repeats 20] [--no-store]
python -m benchmarks web_player threads --run RUN [--rounds 10] [--no-store]
python -m benchmarks web_player cloth [--garments "knee skirt"] [--motions walk] [--no-store]
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
import tyro

from avatar.export.bundle import BundleExtras, write_bundle
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.runtime import AvatarPlayer
from avatar.runtime.skeleton import LooseClothes
from benchmarks.accuracy.cloth_stress import MOTIONS, dressed, motion, wardrobe
from benchmarks.speed.runtime import from_the_front, poses_of, students_of
from benchmarks.support.results import ROOT, store_results
from pipelines.runs import layout
from pipelines.web.page import PageContent, PageLight, single_page
from pipelines.web.server import PageServer
from smplxpp.body import load_body
from smplxpp.cloth import cut_garment
from smplxpp.cloth.garment_file import load_garments
from smplxpp.cloth.solver import ClothSolver
from smplxpp.core import BodyParams, Camera
from smplxpp.core.light import STUDIO, Irradiance, Relighting, panoramas
from smplxpp.people.garments.mannequin import Mannequin
from tests.web.chromium import Page, find_chromium

WEB = ROOT / "web"
PARTS = ("pose", "field", "blend", "world")
STEP = 1.0 / 30.0
# Both players have the same names for what they share; the older one has one function for a pose, and sorts elsewhere.
_SCRIPT = """
import { readFileSync } from "node:fs";
const [path, modules, repeats] = process.argv.slice(1), m = await import(modules);
const avatar = await m.readBundle(new Uint8Array(readFileSync(path))), N = avatar.gaussians.count;
const clock = () => { const { user, system } = process.cpuUsage(); return (user + system) / 1000; };
const best = {}, note = (part, ms) => { best[part] = Math.min(best[part] ?? Infinity, ms); };
const timed = (part, work) => { const start = clock(), out = work(); note(part, clock() - start); return out; };
const deformer = new m.Deformer(avatar, clock), row = [0, 0, -1, 3.5], eye = [0, 1, 3.5], near = 0.01;
const driver = m.ClothDriver && avatar.garments.length ? new m.ClothDriver(deformer, avatar.garments) : null;
const sorter = m.DepthSorter && new m.DepthSorter(N), records = new Float32Array(m.RECORD * N);
for (let k = 0; k < repeats; ++k) {
  const pose = m.poseAt(avatar.motion, (k % avatar.motion.frames) / avatar.motion.framesPerSecond);
  timed("all", () => {
    timed("pose to world", () => deformer.pose(pose));
    if (sorter) {
      const order = timed("sort", () => sorter.sort(deformer.centers, row, near, avatar.gaussians.part, new Set()));
      timed("records", () => deformer.records(eye, order, records));
    } else {
      const { count } = timed("sort", () => deformer.order(row, near, [], true));
      timed("records", () => deformer.recordsFor(eye, count));
    }
  });
  for (const [part, ms] of Object.entries(deformer.milliseconds ?? {})) note(part, ms);
}
for (let k = 0; driver && k < repeats; ++k) {
  const pose = m.poseAt(avatar.motion, Math.min(k / 30, (avatar.motion.frames - 1) / avatar.motion.framesPerSecond));
  timed(k ? "cloth, a step" : "cloth, a cold start", () => driver.step(pose, 1 / 30));
}
process.stdout.write(JSON.stringify(best));
"""
_PICTURES = """(async () => {
  const { player } = smplxppPlayer, best = {};
  const note = (part, ms) => { if (ms !== null) best[part] = Math.min(best[part] ?? Infinity, ms); };
  player.lit = %s;
  for (let k = 0; k < %d; ++k) {
    const start = performance.now();
    // Rates are means over pictures: those of this one alone.
    Object.assign(player.rates, { deform: 0, sort: 0 });
    await player.picture({ time: 0.1 * k, seconds: null, camera: %s });
    note("picture", performance.now() - start);
    note("pose and records", player.rates.deform);
    if (!player.renderer.sorts) note("sort", player.rates.sort);
    // A renderer knows the time of a picture when the next one comes.
    const { sorts, sorting, milliseconds } = player.renderer;
    if (k) note(sorts && sorting === null ? "sort and drawing" : "drawing", milliseconds);
    if (k) note("projection and sort", sorting);
  }
  return JSON.stringify(best);
})()"""


@dataclass(frozen=True)
class WebPlayerBenchmark:
    """Time the page's WebAssembly kernels beside the native ones, and both renderers of the page.

    Milliseconds by part, the least of all poses: of the processor's time on one thread for the native kernels
    (`avatar.runtime`) and for the same C++ as WebAssembly in Node, which other work on the machine disturbs little,
    and of the clock for pictures in Chromium, which it disturbs much. Rows: the run's own student, and students of
    the run's sizes with Gaussians as they are sampled before any training. `--before` is the modules of the player
    when it deformed in TypeScript: in a checkout of `dfe96b4`, `cd web && npm ci && node build.mjs --tests` makes
    `web/build/modules.mjs`. Needs Node with `web/`'s tools (`npm ci` there), and Chromium for the pictures.
    """

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run."""
    before: Path | None = None
    """Modules of the player that deformed in TypeScript."""
    repeats: int = 20
    """Poses of each."""
    pictures: int = 6
    """Pictures of each renderer; 0: none."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        students = students_of(self.run_folder)
        trained = next(iter(students.values()))
        template = trained.rig.template
        loose = self.run_folder / layout.GARMENTS
        garments = load_garments(loose, template) if loose.exists() else []
        subprocess.run(["node", "build.mjs", "--tests"], cwd=WEB, check=True)
        variants = {"WebAssembly": WEB / "build" / "modules.mjs"}
        variants |= {} if self.before is None else {"TypeScript": self.before.resolve()}
        figures: dict[str, Any] = {}
        with tempfile.TemporaryDirectory() as folder:
            for name, student in students.items():
                path = Path(folder) / "me.avatar"
                own = garments if student is trained else []
                extras = BundleExtras(name="benchmark", garments=own, motion=poses_of(student))
                write_bundle(path, student, extras)
                figures[f"{name} Gaussians, native"] = native(path, self.repeats)
                for variant, modules in variants.items():
                    figures[f"{name} Gaussians, {variant}"] = in_node(path, modules, self.repeats)
                if student is trained and self.pictures and find_chromium():
                    figures |= drawn(path, from_the_front(template), self.pictures)
        print(json.dumps(figures, indent=1))
        if self.store:
            command = f"python -m benchmarks web_player parts --run {self.run_folder.name}"
            store_results("web_player", command + (" --before MODULES" if self.before else ""), figures)


def native(path: Path, repeats: int) -> dict[str, float]:
    """Return the least milliseconds of the native kernels' parts, and of a step of the loose clothes."""
    player, best = AvatarPlayer(path, threads=1, clock=time.process_time), {}
    motion = player.motion
    assert motion is not None

    def note(part: str, ms: float) -> None:
        best[part] = min(best.get(part, float("inf")), ms)

    for k in range(repeats):
        player.pose(motion.frame(k % len(motion)))
        for part in PARTS:
            note(part, 1e3 * player.seconds[part])
        note("pose to world", 1e3 * sum(player.seconds[part] for part in PARTS))
    for k in range(repeats if player.bundle.garments else 0):
        frame: BodyParams = motion.frame(min(k, len(motion) - 1))
        begin = time.process_time()
        player.step(frame, STEP)
        spent = 1e3 * (time.process_time() - begin - sum(player.seconds[part] for part in PARTS))
        note("cloth, a step" if k else "cloth, a cold start", spent)
    return best


def in_node(path: Path, modules: Path, repeats: int) -> dict[str, float]:
    """Return the least milliseconds of the page's parts."""
    command = ["node", "--input-type=module", "-e", _SCRIPT, str(path), modules.as_uri(), str(repeats)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def drawn(path: Path, camera: Camera, pictures: int) -> dict[str, dict[str, float]]:
    """Return the least milliseconds of a picture, its bytes read back, and of its parts, by renderer and light."""
    K = camera.K
    view = {"view": camera.cam_from_world[:3].ravel().tolist(), "width": camera.width, "height": camera.height}
    view |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    out = {}
    with tempfile.TemporaryDirectory() as folder, Page(Path(folder) / "profile") as page:
        file = Path(folder) / "player.html"
        studio = Irradiance.of_environment(panoramas()[STUDIO]).exposed()
        light = PageLight(STUDIO, Relighting(studio, Irradiance.uniform()))
        file.write_bytes(single_page(path.read_bytes(), PageContent(name="benchmark", light=light)))
        for renderer in ("webgl2", "webgpu"):
            page.go(f"{file.as_uri()}?renderer={renderer}")
            page.evaluate("smplxppPlayer.player.playing = false")
            name = page.evaluate("smplxppPlayer.player.renderer.name")
            for lit in (False, True):
                best = json.loads(page.evaluate(_PICTURES % (json.dumps(lit), pictures, json.dumps(view))))
                words = ", in another light" if lit else ""
                out[f"pictures of {camera.width}x{camera.height} by {name} on SwiftShader{words}"] = best
    return out


THREADS = (1, 2)
POSES = 8
WHOLE = "pose to world"
_PAGE = """<!doctype html><script>
const worker = new Worker("worker.js", { type: "module" });
const reply = () => new Promise((resolve, reject) => {
  worker.onmessage = ({ data }) => resolve(data);
  worker.onerror = (event) => reject(new Error(event.message));
});
const ready = reply();
const round = (first) => { const rows = reply(); worker.postMessage(first); return rows; };
</script>"""
_WORKER = """
import * as m from "./modules.js";
const avatar = await m.readBundle(new Uint8Array(await (await fetch("me.avatar")).arrayBuffer()));
const clock = () => performance.now(), { frames, framesPerSecond } = avatar.motion;
const deformers = %s.map((threads) => new m.Deformer(avatar, clock, new m.Native(threads)));
self.onmessage = ({ data: first }) => {
  const rows = deformers.map(() => []), seen = [];
  for (let k = first; k < first + %d; ++k) {
    const pose = m.poseAt(avatar.motion, (k %% frames) / framesPerSecond);
    deformers.forEach((deformer, which) => {
      deformer.pose(pose);
      const { count } = deformer.order([0, 0, -1, 3.5], 0.01, [], true), start = clock();
      const records = deformer.recordsFor([0, 1, 3.5], count);
      rows[which].push({ ...deformer.milliseconds, records: clock() - start });
      seen[which] = Float32Array.from(records);
      if (seen[which].some((value, i) => value !== seen[0][i])) throw new Error("threads change numbers");
    });
  }
  self.postMessage({ rows, helped: deformers.map(({ native }) => native.helped) });
};
self.postMessage("ready");
"""
Row = dict[str, float]


@dataclass(frozen=True)
class WebThreadsBenchmark:
    """Time a pose in the page and in the native library, on one thread and on two.

    Milliseconds of the clock, by part: the least of all poses, and the median of the whole. One and two threads take
    turns pose by pose, the native library and Chromium round by round, so that ratios are of one machine in one
    state; where other work has the cores, a second thread gains nothing. The page is served with isolation headers,
    and its worker runs the player's own modules, whose threads are workers; records of both numbers of threads are
    compared, number by number. Rows: the run's own student, and students of the run's sizes with Gaussians as they
    are sampled before any training. Needs Node with `web/`'s tools (`npm ci` there) and Chromium.
    """

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run."""
    rounds: int = 10
    """Rounds of eight poses of each."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        subprocess.run(["node", "build.mjs", "--tests"], cwd=WEB, check=True)
        figures: dict[str, Row] = {}
        with tempfile.TemporaryDirectory() as folder:
            for name, student in students_of(self.run_folder).items():
                path = Path(folder) / "me.avatar"
                write_bundle(path, student, BundleExtras(name="benchmark", motion=poses_of(student)))
                for variant, rows in compare(path, self.rounds).items():
                    figures[f"{name} Gaussians, {variant}"] = rows
        print(json.dumps(figures, indent=1))
        if self.store:
            command = f"python -m benchmarks web_player threads --run {self.run_folder.name} --rounds {self.rounds}"
            store_results("web_threads", command, figures)


def compare(path: Path, rounds: int) -> dict[str, Row]:
    """Return milliseconds of a bundle's poses by variant and number of threads, and how many times as fast two are."""
    files = {
        "index.html": _PAGE.encode(),
        "worker.js": (_WORKER % (json.dumps(THREADS), POSES)).encode(),
        "modules.js": (WEB / "build" / "modules.mjs").read_bytes(),
        "me.avatar": path.read_bytes(),
    }
    players = [AvatarPlayer(path, threads=threads, clock=time.perf_counter) for threads in THREADS]
    found: dict[str, list[list[Row]]] = {variant: [[] for _ in THREADS] for variant in ("native", "WebAssembly")}
    with (
        PageServer(files) as server,
        tempfile.TemporaryDirectory() as folder,
        Page(Path(folder) / "profile") as page,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page.send("Page.navigate", url=server.address)
        page.evaluate(_WAIT)
        for k in range(rounds):
            for rows, more in zip(found["native"], native_poses(players, POSES * k), strict=True):
                rows += more
            reported = json.loads(page.evaluate(f"round({POSES * k}).then(JSON.stringify)"))
            for rows, more in zip(found["WebAssembly"], reported["rows"], strict=True):
                rows += more
        assert reported["helped"][1] > 0, "no second thread took part"
        server.shutdown()
    out: dict[str, Row] = {}
    for variant, by_threads in found.items():
        one, two = (summary(rows) for rows in by_threads)
        out |= {f"{variant}, 1 thread": one, f"{variant}, 2 threads": two}
        out[f"{variant}, times as fast"] = {part: one[part] / two[part] for part in one}
    return out


_WAIT = """new Promise((done) => {
  const look = () => typeof ready === "undefined" ? setTimeout(look, 50) : done(ready);
  look();
})"""


def native_poses(players: list[AvatarPlayer], first: int) -> list[list[Row]]:
    """Return milliseconds of some poses, a list a player; the players take turns."""
    rows: list[list[Row]] = [[] for _ in players]
    for k in range(first, first + POSES):
        for player, own in zip(players, rows, strict=True):
            assert player.motion is not None
            player.pose(player.motion.frame(k % len(player.motion)))
            own.append({part: 1e3 * player.seconds[part] for part in PARTS})
    return rows


def summary(rows: list[Row]) -> Row:
    """Return the least of each part and of the whole, and the median of the whole."""
    whole = [sum(row[part] for part in PARTS) for row in rows]
    least = {part: min(row[part] for row in rows) for part in rows[0]}
    return {**least, WHOLE: min(whole), f"{WHOLE}, median": float(np.median(whole))}


_CLOTH = """<!doctype html><script type="module">
import * as m from "./modules.js";
const avatar = await m.readBundle(new Uint8Array(await (await fetch("me.avatar")).arrayBuffer()));
const driver = new m.ClothDriver(new m.Deformer(avatar), avatar.garments), { framesPerSecond } = avatar.motion;
window.step = (k) => {
  const pose = m.poseAt(avatar.motion, k / framesPerSecond), start = performance.now();
  driver.step(pose, 1 / framesPerSecond);
  return performance.now() - start;
};
</script>"""


@dataclass(frozen=True)
class WebClothBenchmark:
    """Time a step of loose clothes in the page and in the runtime: garments of `cloth_stress` in its motions.

    Milliseconds of a step of 1/30 s from pose to displacements, the least of each frame's runs, cold starts aside: of
    the processor in headless Chromium, with the call that asks for it, by the clock there, of the processor in the
    runtime, which measures the cloth in every step, and in the solver's kernel alone. Needs Chromium.
    """

    garments: tuple[str, ...] = ("mini skirt", "knee skirt", "cape")
    motions: tuple[str, ...] = ("walk", "squat", "dance")
    runs: int = 3
    """Runs of each motion."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        subprocess.run(["node", "build.mjs", "--tests"], cwd=WEB, check=True)
        mannequin = Mannequin.of(body := load_body(), np.zeros(body.num_betas))
        figures: dict[str, Row] = {}
        for name, which in product(self.garments, self.motions):
            garment = wardrobe(mannequin)[name]
            template = dressed(mannequin, garment)
            cut = cut_garment(template, garment.label, mannequin.params)
            config = StudentConfig(FieldConfig(width=8, hidden_layers=2, code_size=4), None, control_points=40)
            student = Student(config, Rig(template), sample_on_mesh(template, SamplingConfig(count=2000)), (0,))
            params = motion(body, MOTIONS[which], mannequin.params.betas[0]).without_shape()
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "me.avatar"
                write_bundle(path, student, BundleExtras(name="benchmark", garments=[cut], motion=params))
                runs = [in_chromium(path, len(params)) | natively(path) for _ in range(self.runs)]
            row = figures[f"{name}, {which}"] = {"particles": float(len(cut.particles))}
            for part in runs[0]:
                least = np.min([run[part] for run in runs], axis=0)[1:]
                row |= {part: float(np.median(least)), f"{part}, 95 %": float(np.quantile(least, 0.95))}
            print(name, which, row, flush=True)
        if self.store:
            store_results("web_cloth", "python -m benchmarks web_player cloth", figures)


def in_chromium(path: Path, frames: int) -> dict[str, list[float]]:
    """Return milliseconds of the steps along a bundle's motion in a page, of the processor and of the clock."""
    modules = (WEB / "build" / "modules.mjs").read_bytes()
    files = {"index.html": _CLOTH.encode(), "modules.js": modules, "me.avatar": path.read_bytes()}
    out: dict[str, list[float]] = {"page": [], "page, clock": []}
    with PageServer(files) as server, tempfile.TemporaryDirectory() as folder, Page(Path(folder) / "profile") as page:

        def spent() -> float:
            metrics = page.send("Performance.getMetrics")["metrics"]
            return next(1e3 * one["value"] for one in metrics if one["name"] == "ThreadTime")

        threading.Thread(target=server.serve_forever, daemon=True).start()
        page.send("Performance.setTimeDomain", timeDomain="threadTicks")
        page.send("Performance.enable")
        page.send("Page.navigate", url=server.address)
        page.evaluate(_WAIT.replace("ready", "step").replace("done(step)", "done(0)"))
        for k in range(frames):
            before = spent()
            out["page, clock"].append(page.evaluate(f"step({k})"))
            out["page"].append(spent() - before)
        server.shutdown()
    return out


def natively(path: Path) -> dict[str, list[float]]:
    """Return the same of the runtime, and of the solver in it, of the processor."""
    out: dict[str, list[float]] = {"runtime": [], "solver": []}
    player, advance, spent = AvatarPlayer(path, threads=1), ClothSolver.advance, [0.0]
    assert player.motion is not None

    def timed(*args: Any) -> None:
        begin = time.process_time()
        advance(*args)
        spent[0] += time.process_time() - begin

    with patch.object(ClothSolver, "advance", timed):
        clothes = LooseClothes(player.bundle)
        for k in range(len(player.motion)):
            spent[0], begin = 0.0, time.process_time()
            clothes.step(player.motion.frame(k), STEP)
            out["runtime"].append(1e3 * (time.process_time() - begin))
            out["solver"].append(1e3 * spent[0])
    return out


if __name__ == "__main__":
    parts = {"parts": WebPlayerBenchmark, "threads": WebThreadsBenchmark, "cloth": WebClothBenchmark}
    tyro.extras.subcommand_cli_from_dict(parts).run()
