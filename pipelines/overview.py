"""The picture at the head of the README: one run from scan to driven template and fitted Gaussians.

python -m pipelines.overview RUN --out docs/images/overview.png
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image

from pipelines.build_config import FIT_STAGE
from pipelines.fit_pictures import read_strip
from pipelines.pictures import blend_joint_colors, body_cameras, caption, encode_png, render_shaded, row
from pipelines.scan_stages import load_params_of_run, load_scan
from smplxpp.body.hard_poses import HARD_POSES, hard_poses
from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.labels import display_colors
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.template import Template

HEIGHT = 420


@dataclass(frozen=True)
class Overview:
    """Draw a finished run in one row."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` and `smplxpp fit-reference` wrote."""
    view: str = "Cam004"
    """Camera of the fit's previews to show."""
    out: Path = Path("docs/images/overview.png")
    """The picture."""

    def run(self) -> None:
        """Render and write the picture."""
        template = Template.load(self.run_folder / "60_assemble" / "smplxpp.npz")
        scan, colors, _ = load_scan(self.run_folder)
        with np.load(self.run_folder / "20_segment" / "labels.npz") as labels:
            label_colors = display_colors(labels["face_labels"])
        poses = dict(zip(HARD_POSES, template.pose(hard_poses(load_params_of_run(self.run_folder))), strict=True))
        step = template.mesh.with_vertices(poses["high_step"])
        looks = {"vertex_colors": template.vertex_colors}
        weights = {"vertex_colors": blend_joint_colors(template.weights)}
        cells = [
            ("scan", scan, {"vertex_colors": colors}),
            ("labels", scan, {"face_colors": label_colors}),
            ("skin weights", template.mesh, weights),
            ("T-pose", template.mesh, looks),
            ("high step", step, looks),
        ]
        pictures = [caption(_front(mesh, options), name) for name, mesh, options in cells]
        strip = read_strip(self.run_folder / FIT_STAGE / "previews" / f"{self.view}.png")
        photograph, rendered = _cut(strip[:2])
        pictures += [caption(photograph, "photograph, held out"), caption(rendered, "Gaussians")]
        atomic_write_bytes(self.out, encode_png(row(pictures, gap=4)))


def _cut(images: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """The same columns of each, those that the person in the first is in, at the height of the other pictures."""
    columns = np.flatnonzero((images[0] > 16).any(axis=(0, 2)))
    cut = [image[:, max(columns[0] - 4, 0) : columns[-1] + 5] for image in images]
    size = (round(cut[0].shape[1] * HEIGHT / len(cut[0])), HEIGHT)
    return [np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS)) for image in cut]


def _front(mesh: TriangleMesh, options: dict) -> np.ndarray:
    camera = body_cameras(mesh, views=("three-quarter",), height=HEIGHT)[0]
    return render_shaded(mesh, camera, **options)


if __name__ == "__main__":
    tyro.cli(Overview, prog="python -m pipelines.overview").run()
