"""The report's section on a reconstruction: hull against refined, where it is unsure, silhouettes over photographs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from pipelines.report import CheckRow, Curve, KeyNumber, Picture, Report, Section, Table, write_report
from pipelines.report.builder import readable, readable_numbers
from pipelines.runs.artefacts import read_named
from pipelines.runs.layout import RECONSTRUCT_STAGE
from pipelines.runs.stage import StageRecord
from pipelines.stages.build_config import ReconstructInputs, load_reconstruct
from smplxpp.build.reconstruct import open_photographs
from smplxpp.core import InputError, TriangleMesh, spread
from smplxpp.core.files.json_file import as_object, read_json
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.figures import body_cameras, caption, encode_jpeg, render_heat, render_shaded, row
from smplxpp.metrics.comparison import MM
from smplxpp.raster import rasterize_mesh

HEIGHT = 560
_MARGIN = 0.06
_SURFACE_COLOR, _MASK_COLOR = (255, 90, 40), (40, 200, 255)


def reconstruct_section(run: Path, record: StageRecord) -> Section:
    """Show a reconstruction from its files; without its capture there are no photographs."""
    content = as_object(read_json(record.folder / "reconstruction.json"), subject="reconstruction")
    frame = next(iter(content["frames"]))
    numbers = content["frames"][frame]
    raw = read_raw_mesh(record.folder / f"scan_{int(frame):06d}.ply")
    mesh = TriangleMesh(raw.vertices, raw.faces)
    arrays = read_named(
        record.folder / f"scan_{int(frame):06d}.npz", "confidence", "seen", "hull_vertices", "hull_faces"
    )
    confidence, seen, hull = arrays[0], arrays[1], TriangleMesh(arrays[2], arrays[3])
    pictures = _surfaces(mesh, raw.vertex_colors, hull, confidence, seen)
    inputs = load_reconstruct(run)
    if inputs is not None:
        try:
            pictures += _on_photographs(inputs, int(frame), numbers, mesh)
        except InputError:  # the capture is no longer where it was: figures remain
            pass
    frames = content["frames"]
    return Section(
        title="Reconstruction",
        text=(
            f"The surface of {len(frames)} frame{'s' if len(frames) > 1 else ''} from the photographs of "
            f"{len(numbers['views'])} cameras and their masks: the silhouettes' common volume on cells of "
            f"{numbers['cell_mm']:.1f} mm, moved along its normals to where the photographs agree. Held-out cameras "
            "were not looked at. Closed and manifold by manifold3d "
            f"(genus {numbers['genus']}). {100 * numbers['unseen']:.0f} % is seen by fewer than two cameras and "
            f"{100 * numbers['unsure']:.0f} % has no photograph that speaks for it: there it is the silhouettes' "
            "alone, with air under a skirt and between the legs.",
        ),
        pictures=tuple(pictures),
        curves=_curves(frames),
        tables=tuple(table for table in (_view_table(numbers), _problem_table(content)) if table is not None),
        checks=tuple(CheckRow.of(check, stage=RECONSTRUCT_STAGE) for check in record.manifest["checks"]),
    )


def reconstruct_key_numbers(record: StageRecord) -> tuple[KeyNumber, ...]:
    """The numbers for the head of a report."""
    numbers = record.manifest["numbers"]
    return (
        KeyNumber("surface", f"{numbers['vertices']:,} vertices", f"{numbers['frames']} frames"),
        KeyNumber("pixel", f"{numbers['pixel_mm']:.1f} mm", "in the middle of the person"),
        KeyNumber("moved by the photographs", f"{numbers['moved_mm']:.1f} mm", "mean"),
        KeyNumber("unsure", f"{100 * numbers['unsure']:.0f} %", "of the surface"),
    )


def write_reconstruct_report(path: Path, run: Path, record: StageRecord) -> None:
    """Write a page on a reconstruction alone."""
    # A section that cannot be read becomes a note on the page instead of an error after minutes of work.
    section = readable(record, "Reconstruction", lambda: reconstruct_section(run, record))
    inputs = load_reconstruct(run)
    report = Report(
        subject=run.name if inputs is None else inputs.root.resolve().stem,
        summary="A person's surface from photographs, cameras and masks alone.",
        key_numbers=readable_numbers(record, lambda: reconstruct_key_numbers(record)),
        checks=section.checks,
        seconds={RECONSTRUCT_STAGE: record.manifest["seconds"]},
        sections=(section,),
        provenance={
            "configuration": record.manifest["config"],
            "versions": record.manifest["versions"],
            "inputs (SHA-256)": record.manifest["inputs"],
        },
        kind="reconstruction",
    )
    write_report(path, report)


def _surfaces(
    mesh: TriangleMesh, colors: np.ndarray | None, hull: TriangleMesh, confidence: np.ndarray, seen: np.ndarray
) -> list[Picture]:
    """Return pictures of hull and surface side by side, of their difference, and of the confidence."""
    # The hull and the refined surface, from the front and the back.
    cameras = body_cameras(mesh, views=("front", "back"), height=HEIGHT)
    shaded = []
    for camera in cameras:
        shaded.append(caption(render_shaded(hull, camera), "silhouettes alone"))
        shaded.append(caption(render_shaded(mesh, camera), "photographs compared"))
    pictures = [Picture("the hull, and the surface after the search along its normals", encode_jpeg(row(shaded)))]
    # Colours and confidence of the surface.
    panels = []
    for camera in cameras:
        if colors is not None:
            panels.append(caption(render_shaded(mesh, camera, vertex_colors=colors), "colours"))
        panels.append(
            caption(
                render_heat(mesh, camera, confidence.astype(np.float64), cmap="weight", limits=(0, 1)), "confidence"
            )
        )
    pictures.append(
        Picture("colours from the photographs; confidence: 0 where no photographs agree", encode_jpeg(row(panels)))
    )
    panels = []
    moved_mm = 20.0
    # The distance moved exists only if the surface has the hull's vertices, not for a mesh of another program.
    if len(hull.vertices) == len(mesh.vertices):
        moved = MM * np.linalg.norm(mesh.vertices - hull.vertices, axis=1)
        panels = [caption(render_heat(mesh, one, moved, limits=(0, moved_mm), unit="mm"), "moved") for one in cameras]
    # Fewer than two cameras cannot triangulate a point.
    unseen = np.where(seen < 2, 1.0, 0.0)
    below = body_cameras(mesh, views=("front", "side"), height=HEIGHT)
    panels += [caption(render_heat(mesh, one, unseen, limits=(0, 1), bar=False), "unseen") for one in below]
    pictures.append(
        Picture("how far the photographs moved the hull; what fewer than two cameras see", encode_jpeg(row(panels)))
    )
    return pictures


def _on_photographs(
    inputs: ReconstructInputs, frame: int, numbers: Mapping[str, Any], mesh: TriangleMesh
) -> list[Picture]:
    """Draw the outlines of surface and mask on some photographs, including the worst and those left out."""
    capture = open_photographs(inputs)
    # Intersection over union of the surface's silhouette and the mask, by camera. The worst one is always shown,
    # others evenly spread, and at most two of those that were left out.
    agreement = numbers["silhouettes"]
    worst = min(agreement, key=agreement.get)
    photographs = 4
    names = list(dict.fromkeys([worst, *spread(list(agreement), photographs - 1)]))
    panels = []
    for name in [*names, *list(numbers["left_out"])[:2]]:
        photograph, mask, camera = capture.image(name, frame), capture.mask(name, frame), capture.cameras[name]
        drawn = rasterize_mesh(mesh, camera).mask
        picture = np.array(photograph)
        if mask is not None:
            picture[_outline(mask > 127)] = _MASK_COLOR
        picture[_outline(drawn)] = _SURFACE_COLOR
        # Crop to the person's height and a margin, because photographs of a rig are mostly background.
        rows = np.flatnonzero(drawn.any(axis=1))
        if len(rows):
            margin = int(_MARGIN * len(drawn))
            picture = picture[max(0, rows[0] - margin) : rows[-1] + margin]
        words = f"{name}: left out" if name in numbers["left_out"] else f"{name}: IoU {agreement[name]:.3f}"
        panels.append(caption(_of_height(picture), words))
    return [
        Picture(
            f"frame {frame}: outline of the surface (orange) and of the mask (blue) on photographs; {worst} fits worst",
            encode_jpeg(row(panels)),
        )
    ]


def _outline(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    outline = 2
    width = max(1, round(outline * len(mask) / 1000))
    return ndimage.binary_dilation(mask, iterations=width) & ~mask


def _of_height(picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    """The picture at the height of the others: every n-th pixel, or each n times."""
    places = (np.arange(HEIGHT) * len(picture) // HEIGHT).astype(np.int64)
    width = max(1, round(picture.shape[1] * HEIGHT / len(picture)))
    across = (np.arange(width) * picture.shape[1] // width).astype(np.int64)
    return picture[places][:, across]


def _curves(frames: Mapping[str, Any]) -> tuple[Curve, ...]:
    """Figures over the frames, where there are several."""
    if len(frames) < 2:
        return ()
    numbers = np.array([int(frame) for frame in frames], dtype=np.float64)
    fit = np.array([np.mean(list(one["silhouettes"].values())) for one in frames.values()])
    shares = {name: np.array([one[name] for one in frames.values()]) for name in ("unseen", "unsure")}
    return (
        Curve("silhouettes: IoU with the masks", {"mean over views": (numbers, fit)}, "frame"),
        Curve("share of the surface", {name: (numbers, values) for name, values in shares.items()}, "frame"),
    )


def _view_table(numbers: Mapping[str, Any]) -> Table:
    """Every view: how well the surface fills its mask, or why it was left out."""
    rows = [(name, f"{share:.4f}", "") for name, share in numbers["silhouettes"].items()]
    rows += [(name, "-", why) for name, why in numbers["left_out"].items()]
    return Table(("camera", "IoU", "left out because"), tuple(rows), "silhouettes of the surface against the masks")


def _problem_table(content: Mapping[str, Any]) -> Table | None:
    rows = [(frame, words) for frame, one in content["frames"].items() for words in one["problems"]]
    rows += list(content["absent"].items())
    return Table(("frame", "problem"), tuple(rows), "problems") if rows else None
