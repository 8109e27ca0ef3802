"""Draw the picture at the head of the README: one run from scan to driven template and trained student.

python -m tools.overview RUN --out docs/images/overview.png
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import UInt8
from PIL import Image

from pipelines.runs.artefacts import load_labels, load_params_of_run, load_scan
from pipelines.runs.layout import EVALUATE_STAGE
from pipelines.runs.stage import read_manifest
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.figures import blend_joint_colors, body_cameras, caption, encode_png, render_shaded, row
from smplxpp.figures.drawings import read_tiles
from smplxpp.template.template import Template

HEIGHT = 420


@dataclass(frozen=True)
class Overview:
    """Draw a finished run in one row."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build`, `smplxpp train` and `smplxpp evaluate` wrote."""
    out: Path = Path("docs/images/overview.png")
    """The picture."""

    def run(self) -> None:
        """Render and write the picture."""
        template = Template.load(self.run_folder / "60_assemble" / "smplxpp.npz")
        scan, colors, _ = load_scan(self.run_folder)
        with np.load(self.run_folder / "20_segment" / "labels.npz") as labels:
            label_colors = load_labels(self.run_folder).display_colors(labels["face_labels"])
        poses = dict(zip(STRESS_POSES, template.pose(stress_poses(load_params_of_run(self.run_folder))), strict=True))
        step = template.mesh.with_vertices(poses["high_step"])
        looks = template.vertex_colors
        pictures = [
            caption(_front(scan, vertex_colors=colors), "scan"),
            caption(_front(scan, face_colors=label_colors), "labels"),
            caption(_front(template.mesh, vertex_colors=blend_joint_colors(template.weights)), "skin weights"),
            caption(_front(template.mesh, vertex_colors=looks), "T-pose"),
            caption(_front(step, vertex_colors=looks), "high step"),
        ]
        photograph, skinned, student = _cut(held_out_view(self.run_folder))
        pictures += [caption(photograph, "held-out view")]
        pictures += [caption(skinned, "Gaussians, skinned"), caption(student, "student")]
        atomic_write_bytes(self.out, encode_png(row(pictures, gap=4)))


def held_out_view(
    run: Path,
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W 3"]]:
    """Return the photograph, one frame's Gaussians and the student in the last novel view that the evaluation shows."""
    manifest = read_manifest(run / EVALUATE_STAGE)
    numbers = {"views": [], "models": {}} if manifest is None else manifest["numbers"]
    views = [shown for shown in numbers["views"] if (shown["set"], shown.get("chosen")) == ("novel_view", "evenly")]
    models = list(numbers["models"])
    if not views or not {"fit", "student"} <= set(models):
        raise InputError(
            "evaluation of the run",
            expected="a fit and a student, measured on novel views",
            received=f"{', '.join(models) or 'none'}, {len(views)} novel views",
            remedy="run `smplxpp train` and `smplxpp evaluate`",
        )
    photograph, rendered = read_tiles(run / EVALUATE_STAGE / views[-1]["file"], len(models))
    return photograph, rendered[models.index("fit")], rendered[models.index("student")]


def _cut(images: tuple[UInt8[np.ndarray, "H W 3"], ...]) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Cut the columns that the person in the first is in out of each, at the height of the other pictures."""
    columns = np.flatnonzero((images[0] > 16).any(axis=(0, 2)))
    cut = [image[:, max(columns[0] - 4, 0) : columns[-1] + 5] for image in images]
    size = (round(cut[0].shape[1] * HEIGHT / len(cut[0])), HEIGHT)
    return [np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS)) for image in cut]


def _front(
    mesh: TriangleMesh,
    *,
    vertex_colors: UInt8[np.ndarray, "V 3"] | None = None,
    face_colors: UInt8[np.ndarray, "F 3"] | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a mesh from the front with colours of its vertices or faces."""
    camera = body_cameras(mesh, views=("three-quarter",), height=HEIGHT)[0]
    return render_shaded(mesh, camera, vertex_colors=vertex_colors, face_colors=face_colors)


if __name__ == "__main__":
    tyro.cli(Overview, prog="python -m tools.overview").run()
