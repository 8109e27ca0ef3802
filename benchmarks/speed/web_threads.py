"""Time a pose in the page and in the native library, on one thread and on two.

    python -m benchmarks web_threads --run RUN [--rounds 10] [--no-store]

Milliseconds of the clock, by part: the least of all poses, and the median of the whole. One and two threads take turns
pose by pose, the native library and Chromium round by round, so that ratios are of one machine in one state; where
other work has the cores, a second thread gains nothing. The page is served with isolation headers, and its worker runs
the player's own modules, whose threads are workers; records of both numbers of threads are compared, number by number.
Rows: the run's own student, and students of the run's sizes with Gaussians as they are sampled before any training.
Needs Node with `web/`'s tools (`npm ci` there) and Chromium.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from avatar.export.bundle import BundleExtras, write_bundle
from avatar.runtime import AvatarPlayer
from benchmarks.speed.runtime import poses_of, students_of
from benchmarks.speed.web_player import PARTS, WEB
from benchmarks.support.results import store_results
from pipelines.web.server import PageServer
from tests.web.chromium import Page

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
    """Time both."""

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
            command = f"python -m benchmarks web_threads --run {self.run_folder.name} --rounds {self.rounds}"
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
            for rows, more in zip(found["native"], native(players, POSES * k), strict=True):
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


def native(players: list[AvatarPlayer], first: int) -> list[list[Row]]:
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


if __name__ == "__main__":
    tyro.cli(WebThreadsBenchmark).run()
