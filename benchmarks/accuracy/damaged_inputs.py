"""Give damaged inputs: scans to builds, whose warnings are listed, and mutated files to every reader.

python -m benchmarks damaged_inputs scans [--names whole mirrored ...]
python -m benchmarks damaged_inputs files [--inputs 100000] [--door capture]
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import fast_simplification
import numpy as np
import tyro
from scipy.spatial import cKDTree

from benchmarks.support.results import FIXTURE, RESULTS, store_results
from smplxpp.body import load_body, load_params
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from tests.fuzz.campaign import campaign
from tests.fuzz.doors import doors
from tests.fuzz.examine import CLEAN, OUTCOMES, READ, Findings

SHOWN = 3


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan as arrays, with a label of the set `capture` a vertex."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    labels: np.ndarray

    def moved(self, vertices: np.ndarray) -> Scan:
        """The same surface with its vertices elsewhere."""
        return Scan(vertices, self.faces, self.colors, self.labels)

    def part(self, kept: np.ndarray) -> Scan:
        """The chosen faces alone."""
        used, faces = np.unique(self.faces[kept], return_inverse=True)
        return Scan(self.vertices[used], faces.reshape(-1, 3), self.colors[used], self.labels[used])

    def labelled(self, old: int, new: int) -> Scan:
        """The same with another label in one's place."""
        return Scan(self.vertices, self.faces, self.colors, np.where(self.labels == old, new, self.labels))

    def with_stray(self, place: float) -> Scan:
        """One vertex thrown far away."""
        vertices = self.vertices.copy()
        vertices[100] = place
        return self.moved(vertices)

    def noisy(self, metres: float) -> Scan:
        """Normally distributed noise on every coordinate."""
        noise = np.random.default_rng(2).normal(size=self.vertices.shape)
        return self.moved(self.vertices + metres * noise)

    def finer(self) -> Scan:
        """Every face in four."""
        corners = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        edges, index = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
        ab, bc, ca = (index.reshape(-1, 3) + len(self.vertices)).T
        a, b, c = self.faces.T
        faces = [np.stack(f, axis=1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        return Scan(
            np.concatenate([self.vertices, self.vertices[edges].mean(axis=1)]),
            np.concatenate(faces),
            np.concatenate([self.colors, self.colors[edges[:, 0]]]),
            np.concatenate([self.labels, self.labels[edges[:, 0]]]),
        )

    def coarser(self, faces: int) -> Scan:
        """Simplified by plain quadric collapses."""
        points, small = fast_simplification.simplify(self.vertices, self.faces.astype(np.int32), target_count=faces)
        near = cKDTree(self.vertices).query(points)[1]
        return Scan(points.astype(np.float64), small, self.colors[near], self.labels[near])

    def with_holes(self, share: float, radius: float) -> Scan:
        """Balls about random faces cut out until a share of the faces is gone."""
        middle, rng = self.vertices[self.faces].mean(axis=1), np.random.default_rng(0)
        gone = np.zeros(len(self.faces), dtype=bool)
        for k in rng.permutation(len(self.faces)):
            if gone.mean() >= share:
                break
            gone |= np.linalg.norm(middle - middle[k], axis=1) < radius
        return self.part(~gone)


def variants(scan: Scan, joints: dict[str, np.ndarray]) -> dict[str, Callable[[], Scan]]:
    """The scans by name; each is made when it is asked for."""
    x, y, _ = scan.vertices[scan.faces].mean(axis=1).T
    # Faces that look down, and heights and widths of joints, at which parts are cut off, in metres.
    down = TriangleMesh(scan.vertices, scan.faces).face_normals[:, 1] < -0.5
    neck, wrist, knee = joints["neck"][1] + 0.02, joints["right_wrist"][0], joints["right_knee"][1]
    lower = (scan.labels[scan.faces] == 5).all(axis=1)
    return {
        "whole": lambda: scan,
        "1.28 million faces": lambda: scan.finer().finer(),
        "1.28 million faces, 0.5 mm of noise": lambda: scan.finer().finer().noisy(0.5e-3),
        "without soles": lambda: scan.part(~(down & (y < 0.03))),
        "without what looks down": lambda: scan.part(~down),
        "open at the top of the head": lambda: scan.part(y < scan.vertices[:, 1].max() - 0.02),
        "1 mm of noise": lambda: scan.noisy(1e-3),
        "2 mm of noise": lambda: scan.noisy(2e-3),
        "5 mm of noise": lambda: scan.noisy(5e-3),
        "3 mm of noise, a fifth of the faces": lambda: scan.noisy(3e-3).coarser(len(scan.faces) // 5),
        "a vertex at 1e30": lambda: scan.with_stray(1e30),
        "a vertex at 1e9": lambda: scan.with_stray(1e9),
        "a vertex at infinity": lambda: scan.with_stray(np.inf),
        "a vertex 3 m away": lambda: scan.with_stray(3.0),
        # Reversed winding keeps the mirrored surface facing outward.
        "mirrored, pose symmetric": lambda: Scan(
            scan.vertices * [-1, 1, 1], scan.faces[:, ::-1], scan.colors, scan.labels
        ),
        "no head": lambda: scan.part(y < neck),
        "left half": lambda: scan.part(x > 0),
        "no right hand": lambda: scan.part(x > wrist),
        "no right shin": lambda: scan.part((x > 0) | (y > knee)),
        "15 % gone in balls of 5 cm": lambda: scan.with_holes(0.15, 0.05),
        "40 % gone in balls of 3 cm": lambda: scan.with_holes(0.4, 0.03),
        "40 % gone in balls of 8 cm": lambda: scan.with_holes(0.4, 0.08),
        "40 % gone, single faces": lambda: scan.part(np.random.default_rng(0).random(len(scan.faces)) > 0.4),
        "skirt cut out": lambda: scan.part(~lower),
        "skirt labelled skin": lambda: scan.labelled(5, 1),
        "shirt labelled skin": lambda: scan.labelled(4, 1),
        "hair labelled skin": lambda: scan.labelled(2, 1),
        "shoes labelled skin": lambda: scan.labelled(3, 1),
    }


@dataclass(frozen=True)
class NastyScans:
    """Build damaged, noisy, huge and mislabelled variants of the fixture's scan, and list the warnings of each build.

    Each build is a process of its own, with exact parameters. Whole scans, and those with holes as scanners leave
    them, are to build without a warning that is not about what was done to them; the others are to be told.
    """

    names: tuple[str, ...] = ()
    """Variants to build; by default all. The others keep what is stored of them."""

    def run(self) -> None:
        """Build, print and store."""
        made = variants(*_fixture())
        figures = {}
        for name in self.names or made:
            figures[name] = _verdict(made[name]())
            print(name, figures[name], flush=True)
        stored = RESULTS / "nasty_scans.json"
        if self.names and stored.is_file():
            figures = json.loads(stored.read_text())["figures"] | figures
        store_results("nasty_scans", "python -m benchmarks damaged_inputs scans", figures)


def _fixture() -> tuple[Scan, dict[str, np.ndarray]]:
    raw, body = read_raw_mesh(FIXTURE / "scans/scan_000000.ply"), load_body()
    with np.load(FIXTURE / "scans/scan_000000_labels.npz") as data:
        labels = data["label"]
    posed = body.forward(load_params(FIXTURE / "params/params.npz", body=body).frame(0)).frame(0)
    assert raw.vertex_colors is not None
    return Scan(raw.vertices, raw.faces, raw.vertex_colors, labels), dict(
        zip(body.joint_names, posed.joints, strict=True)
    )


def _verdict(scan: Scan) -> dict[str, object]:
    """Return the warnings and failures of a build, its seconds and its memory."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "scan.npz", vertices=scan.vertices, faces=scan.faces, vertex_colors=scan.colors)
        np.savez(folder / "labels.npz", label=scan.labels)
        command = [sys.executable, "-m", "pipelines.cli", "build", str(folder / "run")]
        command += ["--scan", str(folder / "scan.npz")]
        command += ["--labels", str(folder / "labels.npz"), "--label-set", "capture", "--no-report"]
        command += ["--params", str(FIXTURE / "params/params.npz"), "--accept-failures", "--json"]
        # wait4 gives this child's own time and memory.
        with (folder / "said").open("w") as printed:
            actions = [(os.POSIX_SPAWN_DUP2, printed.fileno(), 1), (os.POSIX_SPAWN_DUP2, printed.fileno(), 2)]
            child = os.posix_spawn(sys.executable, command, os.environ, file_actions=actions)
            _, status, usage = os.wait4(child, 0)
        cost = {"CPU seconds": usage.ru_utime + usage.ru_stime, "peak GiB": usage.ru_maxrss / 2**20}
        if status:
            printed = (folder / "said").read_text()
            error = json.loads(printed[printed.index("{") :])["error"]["message"]
            error = error.replace(str(folder / "scan.npz"), "scan.npz")
            return {"faces": len(scan.faces), "warn": None, "fail": None, "says": f"refused: {error}", **cost}
        checks = json.loads((folder / "run" / "metrics.json").read_text())["checks"]
        found = {kind: [c for c in checks if c["status"] == kind] for kind in ("fail", "warn")}
        words = [f"{c['name']} {c['value']:.3g}" for kind in ("fail", "warn") for c in found[kind]]
        more = [f"and {len(words) - SHOWN} more"] if len(words) > SHOWN else []
        return {
            "faces": len(scan.faces),
            "warn": len(found["warn"]),
            "fail": len(found["fail"]),
            "says": "; ".join(words[:SHOWN] + more) or "nothing",
            **cost,
        }


@dataclass(frozen=True)
class DamagedFiles:
    """Send mutations of every kind of file through its reader, and count crashes, hangs and unclear errors.

    A mutation is of bytes, of a text's tokens, of a structure's values, or of the file itself (a folder, a pipe or a
    device in its place). Each is to be read, as what it then says, or refused with an error that says what is wrong;
    one input may take 4 GiB of memory and a minute.

    Attributes:
        inputs: how many a door.
        first: the first seed; the same seed is the same input.
        door: doors alone whose names contain this.
        jobs: doors at once.
    """

    inputs: int = 1000
    first: int = 0
    door: str = ""
    jobs: int = 2

    def run(self) -> bool:
        """Print a line a door, with the place of what is neither read nor refused; true where there is nothing so."""
        names = [name for name in doors() if self.door in name]
        table: dict[str, dict[str, int]] = {}
        with ThreadPoolExecutor(self.jobs) as pool:
            for name, findings in zip(names, pool.map(self._tried, names), strict=True):
                table[name] = {"inputs": self.inputs, **{outcome: findings.counts[outcome] for outcome in OUTCOMES}}
                print(f"{name:24}", dict(findings.counts), flush=True)
                for what, text in findings.examples.items():
                    print(f"    {what}: {text.splitlines()[0]}")
        total = {key: sum(row[key] for row in table.values()) for key in ("inputs", *OUTCOMES)}
        if not self.door:
            command = f"python -m benchmarks damaged_inputs files --inputs {self.inputs} --first {self.first}"
            store_results("damaged_files", command, {**table, "all": total})
        return total["inputs"] == total[READ] + total[CLEAN]

    def _tried(self, name: str) -> Findings:
        return campaign(name, self.inputs, first=self.first)


if __name__ == "__main__":
    ran = tyro.extras.subcommand_cli_from_dict({"scans": NastyScans, "files": DamagedFiles}).run()
    sys.exit(1 if ran is False else 0)
