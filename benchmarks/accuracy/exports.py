"""Measure what the files of a student cost: bundles by reduction, and splats in files of other programs.

python -m benchmarks exports bundles --run RUN --capture DIR [--frames 6] [--no-store]
python -m benchmarks exports splats --source ME.avatar [--frame 3] [--pictures DIR]
python -m benchmarks exports texture --runs RUN ... [--pictures DIR] [--no-store]
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean
from typing import Annotated

import numpy as np
import torch
import tyro
from PIL import Image

from avatar.data.sequence import AvatarSequence, MeasuredView
from avatar.export.bundle import BundleConfig, BundleExtras, write_bundle
from avatar.formats import Splats
from avatar.formats.webavatar import typical_pose
from avatar.losses.image_similarity import psnr_from_mse
from avatar.metrics.view_quality import view_quality
from avatar.models.model_file import load_avatar
from avatar.models.student import Student
from avatar.rendering.avatar_view import render_view
from avatar.runtime import AvatarPlayer
from avatar.runtime.skeleton import skeleton_body
from avatar.runtime.splatting import Splatter
from benchmarks.support.results import store_results
from pipelines.commands.export import Export
from pipelines.runs import layout
from pipelines.runs.artefacts import load_params_of_run, load_prepared_scan, load_scan_labels
from pipelines.stages.build_config import load_build
from smplxpp.body import load_body, load_params
from smplxpp.build.assemble import add_texture
from smplxpp.build.scan import raw_scan
from smplxpp.capture import open_capture
from smplxpp.cloth.garment_file import load_garments
from smplxpp.core import Camera, TriangleMesh
from smplxpp.core.colors import linear_from_srgb, srgb_from_linear
from smplxpp.core.spread import spread
from smplxpp.figures import VIEWS, fit_cameras
from smplxpp.raster import rasterize_mesh
from smplxpp.raster.viewpoints import turntable_cameras
from smplxpp.template.template import BODY_PART, Template
from smplxpp.template.texture import texture_paint
from smplxpp.texture.painted_scan import PaintedScan, pictures_of
from smplxpp.texture.photographs import Painter
from tests.formats.foreign import as_world, gsply_splats, pygltflib_splats, usd_splats, webavatar_splats

WAYS = {
    "exact, float32": BundleConfig(exact=True),
    "as exported": BundleConfig(),
    "blend shapes in steps of 0.1 mm, 2/1000": BundleConfig(position_step=1e-4, color_step=2e-3),
    "blend shapes in steps of 0.4 mm, 8/1000": BundleConfig(position_step=4e-4, color_step=8e-3),
}


@dataclass
class Row:
    """Figures of one variant over views, by kind."""

    psnr: dict[str, list[float]] = field(default_factory=dict)
    near: list[float] = field(default_factory=list)

    def add(self, kind: str, psnr: float, mse: float | None = None) -> None:
        self.psnr.setdefault(kind, []).append(psnr)
        if mse is not None:
            self.near.append(psnr_from_mse(mse))


@dataclass(frozen=True)
class BundleBenchmark:
    """Measure what the size of a bundle costs: megabytes and decibels of held-out views, by reduction.

    Each row is a student drawn in the same held-out views: by torch from the full file, and by the runtime from
    bundles of coarser and coarser numbers. `psnr` is that of the person against the photographs, `lost` what the full
    student has more, `worst view` the largest loss of any single view, `to the full student` the least PSNR of a
    picture against the torch student's. Loose clothes are where the field has them.
    """

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run."""
    capture: Path
    """Folder of its capture."""
    frames: int = 6
    """Frames of each kind whose held-out views are measured."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        template = Template.load(self.run_folder / layout.TEMPLATE)
        sequence = AvatarSequence(open_capture(self.capture), template)
        student = load_avatar(self.run_folder / layout.STUDENT, sequence.rig)
        assert isinstance(student, Student)
        garments = self.run_folder / layout.GARMENTS
        extras = BundleExtras(
            name="benchmark", garments=load_garments(garments, template) if garments.is_file() else ()
        )
        # Write a bundle of each precision, and open it as a player would: figures are of the file, not of the arrays.
        figures: dict[str, dict[str, float]] = {}
        with tempfile.TemporaryDirectory() as folder:
            players = {}
            for name, config in WAYS.items():
                sizes = write_bundle(Path(folder) / "a.avatar", student, extras, config)
                figures[name] = {"megabytes": sizes["total"] / 1e6}
                figures[name] |= {f"{part} kB": size / 1e3 for part, size in sizes.items() if part != "total"}
                players[name] = AvatarPlayer(Path(folder) / "a.avatar", threads=1)
        rows = {name: Row() for name in ("full student, torch", *WAYS)}
        for item in sequence.measured_views(self.frames):
            measure(rows, student, players, sequence, item)
        # All are compared with photographs, and the bundles also with the full student, whose error they share.
        full = rows["full student, torch"].psnr
        stored = (self.run_folder / layout.COMPACT_STUDENT).stat().st_size
        out = {"full student, torch": {"megabytes": stored / 1e6, **_means(full, full)}}
        for name in WAYS:
            out[name] = {**figures[name], **_means(rows[name].psnr, full), "to the full student": min(rows[name].near)}
        print(json.dumps(out, indent=1))
        if self.store:
            command = f"python -m benchmarks exports bundles --run {self.run_folder.name} --capture {self.capture.name}"
            store_results(f"bundle_{self.capture.name}", f"{command} --frames {self.frames}", out)


def _means(psnr: dict[str, list[float]], full: dict[str, list[float]]) -> dict[str, float]:
    out: dict[str, float] = {}
    for kind, values in psnr.items():
        losses = [a - b for a, b in zip(full[kind], values, strict=True)]
        words = kind.replace("_", " ")
        out |= {f"{words}, psnr": mean(values), f"{words}, lost": mean(losses), f"{words}, worst view": max(losses)}
        out[f"{words}, images"] = len(values)
    return out


@torch.no_grad()
def measure(
    rows: dict[str, Row],
    student: Student,
    players: dict[str, AvatarPlayer],
    sequence: AvatarSequence,
    item: MeasuredView,
) -> None:
    """Draw a view all ways."""
    frame = item.frame if item.kind == "novel_view" else None
    background = sequence.background
    params, camera = sequence.params(item.frame), item.view.camera
    posed = student(sequence.rig.pose(params, frame=frame), item.view.position[None])
    rendering = render_view(posed, 0, item.view, background)
    quality = view_quality(item.view, rendering.image, rendering.alpha, background, head=None)
    rows["full student, torch"].add(item.kind, quality.psnr)
    behind = tuple(background.tolist())
    for name, player in players.items():
        player.pose(params, frame=frame)
        image, alpha = (torch.from_numpy(one) for one in player.draw(camera, background=behind))
        psnr = view_quality(item.view, image, alpha, background, head=None).psnr
        rows[name].add(item.kind, psnr, float((image.clamp(0, 1) - rendering.image.clamp(0, 1)).square().mean()))


READERS: dict[str, Callable[[Path], Splats]] = {
    "a.ply": gsply_splats,
    "full.ply": gsply_splats,
    "a.spz": gsply_splats,
    "a.sog": gsply_splats,
    "a.glb": pygltflib_splats,
    "a.usdc": usd_splats,
}
_WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class ExportsBenchmark:
    """Measure splats in files of other programs: bytes, and decibels of what foreign readers get.

    Each file is written by `smplxpp export`, read by a program that is not ours (`tests.formats.foreign`) and drawn
    by our rasteriser in three views 640 pixels high. PSNR is over the pixels that the person covers, of the worst
    view.
    """

    source: Path
    """Bundle of an avatar."""
    frame: int = 0
    """Frame of its motion."""
    params: Path | None = None
    """Motion for WebAvatar's npz; by default the bundle's."""
    pictures: Path | None = None
    """Folder for the front views."""

    def run(self) -> None:
        """Print a row a format."""
        player = AvatarPlayer(self.source)
        assert player.motion is not None
        posed = player.pose(player.motion.frame(self.frame))
        views = [VIEWS[name] for name in ("front", "back", "three-quarter")]
        cameras = fit_cameras(posed.means.astype(float), directions=views, height=640)
        truth = [tuple(map(np.copy, player.draw(camera, background=_WHITE))) for camera in cameras]
        print(f"{len(posed.means)} splats, harmonics of {posed.sh.shape[1]} coefficients")
        with tempfile.TemporaryDirectory() as folder:
            self._webavatar(player, Path(folder) / "a.npz")
            for name, read in READERS.items():
                path = Path(folder) / name
                Export(self.source, out=path, frame=self.frame, full_harmonics=name.startswith("full"), json=True).run()
                drawn = [Splatter().draw(as_world(read(path)), camera, background=_WHITE)[0] for camera in cameras]
                pairs = zip(truth, drawn, strict=True)
                worst = min(_psnr(image, other, alpha) for (image, alpha), other in pairs)
                print(f"{name:9} {path.stat().st_size / 1e6:7.2f} MB  {worst:6.1f} dB", flush=True)
                if self.pictures is not None:
                    self.pictures.mkdir(parents=True, exist_ok=True)
                    shown = np.clip(np.hstack([truth[0][0], drawn[0]]), 0.0, 1.0)
                    Image.fromarray((255 * shown).astype(np.uint8)).save(self.pictures / f"{name}.png")

    def _webavatar(self, player: AvatarPlayer, path: Path) -> None:
        """Print a row a pose of WebAvatar's npz: where it is the student, and along the motion."""
        Export(self.source, out=path, format="webavatar", json=True).run()
        motion = player.motion if self.params is None else load_params(self.params)
        assert motion is not None
        poses = {"best": typical_pose(player)} | {str(k): motion.frame(k) for k in spread(range(len(motion)), 5)}
        for name, params in poses.items():
            posed = player.pose(params)
            camera = fit_cameras(posed.means.astype(float), directions=[VIEWS["front"]], height=640)[0]
            image, alpha = player.draw(camera, background=_WHITE)
            angles = skeleton_body(player.bundle).axis_angles(params)[0]
            splats = webavatar_splats(path, angles, params.transl[0])
            away = 1e3 * np.linalg.norm(splats.means - posed.means, axis=1)
            other = Splatter().draw(as_world(splats), camera, background=_WHITE)[0]
            psnr, (half, most) = _psnr(image, other, alpha), np.percentile(away, [50, 100])
            print(f"webavatar {name:4} {path.stat().st_size / 1e6:5.2f} MB  {psnr:6.1f} dB  {half:.1f}, {most:.1f} mm")


@dataclass(frozen=True)
class TextureBenchmark:
    """Measure textures of templates: decibels against the scan in its own colours, stretch, texels, time and bytes.

    Template and scan are drawn without light in the scan's pose, in 12 views around the person 640 pixels high, four
    samples a pixel. PSNR is over the pixels that the scan covers, of all views together and of the worst. Beside it
    the template in the colours of its vertices. `lost`: the share of texels of clothes, hair and shoes, the mean over
    these parts, that take their colour from neighbours.
    """

    runs: tuple[Path, ...]
    """Runs of builds."""
    sizes: tuple[int, ...] = (1024, 2048, 4096)
    """Texels a side."""
    pictures: Path | None = None
    """Folder for pictures: the scan, the texture, the vertices."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store a row a run, by size."""
        rows = {run.name: {str(size): self._row(run, size) for size in self.sizes} for run in self.runs}
        print(json.dumps(rows, indent=1))
        if self.store:
            names = " ".join(run.name for run in self.runs)
            store_results("textures", f"python -m benchmarks exports texture --runs {names}", rows)

    def _row(self, run: Path, size: int) -> dict[str, object]:
        built = load_build(run)
        assert built is not None, "a run keeps its inputs"
        inputs, config = built[0], replace(built[1], texture_size=size)
        scan, params = load_prepared_scan(run), load_params_of_run(run)
        labels = load_scan_labels(run, scan.mesh.face_count)
        plain = replace(Template.load(run / layout.TEMPLATE), texture=None)
        begin = time.process_time()
        template, numbers = add_texture(plain, params, scan, labels, inputs, config, load_body(inputs.body))
        seconds = time.process_time() - begin
        assert template.texture is not None, numbers["texture"]
        raw = None if inputs.scan is None else raw_scan(inputs.scan)
        pictures = None if raw is None else pictures_of(raw, scan.mesh, scan.source_vertex, scan.source_face)
        painted = PaintedScan(scan.mesh, scan.colors, labels, pictures)
        posed = TriangleMesh(template.pose(params)[0], template.faces)
        textured = texture_paint(template)
        assert textured is not None
        paints = {"texture": textured, "vertices": _vertex_paint(template)}
        errors: dict[str, list[float]] = {name: [] for name in paints}
        shown = []
        for camera in turntable_cameras(scan.mesh.vertices, count=12, height=1280):
            whole = camera.cropped((0, 0, camera.width - camera.width % 2, camera.height))
            truth, mask = _unlit(scan.mesh, whole, painted.colors_at)
            images = {name: _unlit(posed, whole, paint)[0] for name, paint in paints.items()}
            for name, image in images.items():
                errors[name].append(float(np.square(image - truth)[mask].mean()))
            shown.append(np.hstack([truth, *images.values()]))
        if self.pictures is not None:
            self.pictures.mkdir(parents=True, exist_ok=True)
            sheet = (255 * np.vstack([shown[0], shown[5]])).clip(0, 255).astype(np.uint8)
            Image.fromarray(sheet).save(self.pictures / f"{run.name}_{size}.png")
        figures = {f"{name}, psnr": psnr_from_mse(mean(values)) for name, values in errors.items()}
        figures |= {f"{name}, worst view": psnr_from_mse(max(values)) for name, values in errors.items()}
        seen = numbers["texture_seen"]
        clothed = [share for name, share in seen.items() if name != BODY_PART]
        return {
            "size": size,
            "from": numbers["texture"],
            **figures,
            "stretch": numbers["texture_stretch"],
            "lost": 1.0 - mean(clothed) if clothed else 0.0,
            "skin seen": seen[BODY_PART],
            "cpu seconds": seconds,
            "megabytes": numbers["texture_bytes"] / 1e6,
        }


def _unlit(mesh: TriangleMesh, camera: Camera, paint: Painter) -> tuple[np.ndarray, np.ndarray]:
    """Draw sRGB in [0, 1] on white, averaged over 2 x 2 samples in linear light; and the pixels that are covered."""
    maps = rasterize_mesh(mesh, camera)
    image = np.ones((camera.height, camera.width, 3), np.float32)
    image[maps.mask] = linear_from_srgb(paint(maps.face_id[maps.mask], maps.barycentric[maps.mask].astype(np.float64)))
    small = image.reshape(camera.height // 2, 2, camera.width // 2, 2, 3).mean(axis=(1, 3))
    covered = maps.mask.reshape(camera.height // 2, 2, camera.width // 2, 2).all(axis=(1, 3))
    return srgb_from_linear(small), covered


def _vertex_paint(template: Template) -> Painter:
    scan = PaintedScan(template.mesh, template.vertex_colors, template.vertex_labels[template.faces[:, 0]])
    return scan.colors_at


def _psnr(image: np.ndarray, other: np.ndarray, alpha: np.ndarray) -> float:
    """PSNR where the person is."""
    difference = np.clip(image, 0.0, 1.0) - np.clip(other, 0.0, 1.0)
    return float(-10.0 * np.log10(max(np.square(difference[alpha > 1 / 255]).mean(), 1e-20)))


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {"bundles": BundleBenchmark, "splats": ExportsBenchmark, "texture": TextureBenchmark}
    ).run()
