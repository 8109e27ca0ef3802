"""Draw the worst held-out views of a run, photograph and models side by side, for docs/evaluation.md.

python -m tools.worst_frames RUN --out docs/images/worst_frames_NAME.jpg
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import UInt8

from avatar.evaluation.report import EvalReport, view_key
from pipelines.runs.layout import EVALUATE_STAGE, HELD_OUT_VIEWS
from pipelines.runs.stage import read_manifest
from pipelines.stages.evaluate_inputs import REPORT_FILE
from smplxpp.core.errors import InputError
from smplxpp.core.files import atomic_write_bytes, path_inside
from smplxpp.figures import caption, encode_jpeg, row
from smplxpp.figures.drawings import enlarge, error_colors, read_tiles

HEIGHT = 480
MARGIN = 8


@dataclass(frozen=True)
class WorstFrames:
    """Draw the worst novel view and the worst novel pose of an evaluated run, a row each."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp evaluate` wrote into."""
    out: Path
    """The picture, a JPEG."""
    models: tuple[str, ...] = ()
    """Those to show; all that were measured by default."""

    def run(self) -> None:
        """Read the evaluation's pictures, write one.

        Raises:
            InputError: no evaluation, or one that kept no pictures.
        """
        folder = self.run_folder / EVALUATE_STAGE
        manifest = read_manifest(folder) if folder.is_dir() else None
        views = [] if manifest is None else manifest["numbers"]["views"]
        worst = [one for one in views if one.get("chosen") == "worst" and one["set"] in HELD_OUT_VIEWS]
        if not worst:
            raise InputError(
                f"evaluation of {self.run_folder}",
                expected="pictures of its worst views",
                received="none",
                remedy="run `smplxpp evaluate`, without `--shown 0`",
            )
        report = EvalReport.load(folder / REPORT_FILE)
        rows = [self._row(folder, view, report) for view in worst]
        width = max(len(one[0]) for one in rows)
        padded = [np.pad(one, ((0, 0), (0, width - len(one[0])), (0, 0)), constant_values=255) for one in rows]
        atomic_write_bytes(self.out, encode_jpeg(np.concatenate(padded), quality=88))

    def _row(self, folder: Path, view: dict[str, Any], report: EvalReport) -> UInt8[np.ndarray, "H W 3"]:
        names = list(report.models)
        truth, rendered = read_tiles(path_inside(folder, view["file"], subject="picture"), len(names))
        key = view_key(view["camera"], view["frame"])
        titles, pictures = ["photograph"], [truth]
        for name, image in zip(names, rendered, strict=True):
            if not self.models or name in self.models:
                titles.append(f"{name}, {report.models[name].views[view['set']][key].psnr:.1f} dB")
                pictures.append(image)
        titles.append(f"error of {titles[-1].split(',')[0]}")
        pictures.append(error_colors(truth, pictures[-1]))
        factor = max(1, round(HEIGHT / len(truth)))
        cut = _person(truth)
        tiles = [caption(enlarge(image[cut], factor), title) for image, title in zip(pictures, titles, strict=True)]
        return caption(row(tiles, gap=4), view["title"])


def _person(image: UInt8[np.ndarray, "H W 3"]) -> tuple[slice, slice]:
    """The window of what differs from the background in the corner."""
    there = (np.abs(image.astype(int) - image[0, 0]) > MARGIN).any(axis=2)
    bounds = []
    for axis in (1, 0):
        hit = np.flatnonzero(there.any(axis=axis))
        bounds.append(slice(max(hit[0] - MARGIN, 0), hit[-1] + 1 + MARGIN) if len(hit) else slice(None))
    return bounds[0], bounds[1]


if __name__ == "__main__":
    tyro.cli(WorstFrames, prog="python -m tools.worst_frames").run()
