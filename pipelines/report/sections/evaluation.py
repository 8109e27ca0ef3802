"""The report's section on an evaluation: photograph, fit, teacher and student beside each other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from avatar.evaluation.input_protocol import InputProtocol, counted
from pipelines.report import CheckRow, Comparison, Film, KeyNumber, Picture, Section, Table
from pipelines.report.sections.fit import HEAD_HEIGHT, head_box
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import (
    BEST_FIRST,
    EVALUATE_STAGE,
    HELD_OUT_VIEWS,
    MODEL_FILES,
    RELIGHT_STAGE,
    STUDENT,
    TALKING_FILM,
    TEMPLATE,
)
from pipelines.runs.stage import StageRecord, read_manifest
from smplxpp.core.files.paths import path_inside, read_bytes
from smplxpp.figures import encode_png, row
from smplxpp.figures.drawings import ERROR_LIMIT, SURFACE_LIMIT_MM, error_colors, error_legend, read_tiles


def standing_evaluation(run: Path, template_digest: str) -> StageRecord | None:
    """The evaluation in a run, None where there is none or one of another template or other models than there are."""
    manifest = read_manifest(run / EVALUATE_STAGE)
    if manifest is None or manifest["inputs"].get(TEMPLATE) != template_digest:
        return None
    if "counts" not in manifest["numbers"]:
        return None  # written by a version that did not count its images; the next evaluation replaces it
    measured = {name: digest for name, digest in manifest["inputs"].items() if name in MODEL_FILES.values()}
    if any(not (run / name).is_file() or sha256_file(run / name) != digest for name, digest in measured.items()):
        return None
    return StageRecord(run / EVALUATE_STAGE, manifest, ran=False)


def evaluation_key_numbers(record: StageRecord) -> tuple[KeyNumber, ...]:
    """The numbers for the head of the report: of the student, or of the teacher where there is no student."""
    models = record.manifest["numbers"]["models"]
    name = next((name for name in BEST_FIRST if name in models), None)
    if name is None:
        return ()
    figures, out = models[name], []
    for part, title in zip(HELD_OUT_VIEWS, ("novel views", "novel poses"), strict=True):
        if figures.get(f"{part}.psnr") is not None:
            note = f"SSIM {figures[f'{part}.ssim']:.3f}, {_counted(record.manifest['numbers'], part)}"
            out.append(KeyNumber(f"{name}, {title}: PSNR of the person", f"{figures[f'{part}.psnr']:.1f} dB", note))
    if figures.get("fps") is not None:
        out.append(KeyNumber("pictures a second", f"{figures['fps']:.1f}", f"{name}, deform and render"))
    return tuple(out)


def _counted(numbers: Mapping[str, Any], part: str) -> str:
    """The images of a set in words."""
    counts = numbers["counts"][part]
    return f"{counted(counts['images'], 'image')} of {counted(counts['frames'], 'frame')}"


def evaluation_figures(record: StageRecord) -> Section:
    """Tables with what their figures mean, and distances on the meshes."""
    numbers = record.manifest["numbers"]
    inputs = InputProtocol.from_dict(numbers["inputs"])
    distance = numbers["metric"] or "none was measured"
    return Section(
        title="Avatar: figures",
        text=(
            f"{_listed(list(numbers['models']))} on the same views. Training views: cameras and frames that were "
            "trained on. Novel views: held-out cameras at training frames. Novel poses: held-out cameras at held-out "
            f"frames. All figures, and these tables as text, CSV and LaTeX, lie in {EVALUATE_STAGE}.",
            f"What they rest on, in a word: {inputs.name}; {inputs.sentence()}. Perceptual distance: {distance}.",
            *(f"{name[0].upper()}{name[1:]}: {words}" for name, words in numbers["conventions"].items()),
        ),
        pictures=tuple(
            Picture(f"{shown['title']}, 0 to {SURFACE_LIMIT_MM:g} mm", read_bytes(_named(record, shown["file"])))
            for shown in numbers["surfaces"]
        ),
        # Cells are text: they keep the digits that make small differences visible.
        tables=tuple(
            Table(tuple(table["header"]), tuple(map(tuple, table["rows"])), table["caption"])
            for table in numbers["tables"]
        ),
        checks=tuple(CheckRow.of(check, stage=EVALUATE_STAGE) for check in record.manifest["checks"]),
    )


def evaluation_views(record: StageRecord) -> Section:
    """Held-out views, and one view of every other set: the first held-out one of a set also with a slider."""
    numbers = record.manifest["numbers"]
    models = list(numbers["models"])
    pictures, comparisons, seen = [], [], set()
    # All held-out views are shown. Of the other sets one view is enough, because training has seen their like.
    for shown in numbers["views"]:
        first, held_out = shown["set"] not in seen, shown["set"] in HELD_OUT_VIEWS
        seen.add(shown["set"])
        if not first and not held_out:
            continue
        truth, rendered = read_tiles(_named(record, shown["file"]), len(models))
        pictures += _view_pictures(shown, truth, rendered)
        # The slider compares the photograph with the last model, which is the student where there is one.
        if first and held_out:
            pair = Picture("photograph", encode_png(truth)), Picture(models[-1], encode_png(rendered[-1]))
            comparisons.append(Comparison(f"{shown['title']}, every pixel", *pair))
    pictures.append(Picture(f"error, of 255: 0 to {ERROR_LIMIT} and more", encode_png(error_legend())))
    return Section(
        title="Avatar: side by side",
        text=(
            f"Photograph, {', '.join(models)}; below each its error: the largest difference of a colour channel at a "
            f"pixel, from 0 (pale) to {ERROR_LIMIT} of 255 and more (dark).",
        ),
        pictures=tuple(pictures),
        comparisons=tuple(comparisons),
    )


def _named(record: StageRecord, name: str) -> Path:
    """A picture of the evaluation by the name that its manifest has for it."""
    return path_inside(record.folder, name, subject="picture of an evaluation")


def _view_pictures(
    shown: Mapping[str, Any], truth: UInt8[np.ndarray, "H W 3"], rendered: list[UInt8[np.ndarray, "H W 3"]]
) -> list[Picture]:
    """The view whole, and its head enlarged."""
    out = [Picture(shown["title"], encode_png(_with_errors(truth, rendered)))]
    if shown["head"] is not None:
        x0, y0, x1, y1 = head_box(shown["head"], truth)
        factor = max(1, round(HEAD_HEIGHT / (y1 - y0)))
        crops = [image[y0:y1, x0:x1] for image in (truth, *rendered)]
        picture = encode_png(_with_errors(crops[0], crops[1:], gap=1))
        out.append(Picture(f"{shown['title']}, head, {factor} times enlarged", picture, enlarged=factor))
    return out


def _with_errors(
    truth: UInt8[np.ndarray, "H W 3"], rendered: list[UInt8[np.ndarray, "H W 3"]], *, gap: int = 12
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Photograph and renderings in a row, errors under the renderings, `gap` pixels between them."""
    blank = np.full_like(truth, 255)
    errors = row([blank, *(error_colors(truth, image) for image in rendered)], gap=gap)
    images = row([truth, *rendered], gap=gap)
    return np.concatenate([images, np.full((gap, images.shape[1], 3), 255, np.uint8), errors])


def evaluation_hero(record: StageRecord) -> tuple[Picture, ...]:
    """The first view of new poses, else of new cameras, as photograph and as the last model draws it."""
    numbers = record.manifest["numbers"]
    sets = [shown["set"] for shown in numbers["views"]]
    chosen = next((name for name in reversed(HELD_OUT_VIEWS) if name in sets), None)
    if chosen is None:
        return ()
    models = list(numbers["models"])
    shown = numbers["views"][sets.index(chosen)]
    truth, rendered = read_tiles(_named(record, shown["file"]), len(models))
    return (Picture(f"{shown['title']}: photograph, {models[-1]}", encode_png(row([truth, rendered[-1]]))),)


def _listed(names: list[str]) -> str:
    """Names in a sentence, the first with a capital."""
    text = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    return text[0].upper() + text[1:]


def standing_relighting(run: Path, template_digest: str) -> StageRecord | None:
    """The pictures in a run, None where there are none or those of another template or student than it has now."""
    manifest = read_manifest(run / RELIGHT_STAGE)
    if manifest is None or manifest["inputs"].get(TEMPLATE) != template_digest or not (run / STUDENT).is_file():
        return None
    if manifest["inputs"].get(STUDENT) != sha256_file(run / STUDENT):
        return None
    return StageRecord(run / RELIGHT_STAGE, manifest, ran=False)


def relight_section(record: StageRecord) -> Section:
    """All pictures, and the first two with a slider."""
    numbers = record.manifest["numbers"]
    pictures = [
        Picture(title, read_bytes(path_inside(record.folder, file, subject="picture of a light"), subject="picture"))
        for title, file in numbers["pictures"].items()
    ]
    return Section(
        title="Avatar: another light",
        text=(
            f"The student in the light of a panorama ({numbers['light']}), turned about the vertical: harmonics of "
            "its irradiance on drawn normals, the capture's light taken for white unless its panorama was given. "
            "Shadows stay as they were captured.",
        ),
        pictures=tuple(pictures),
        comparisons=(Comparison(f"{pictures[0].caption}, and {pictures[1].caption}", pictures[0], pictures[1]),),
    )


_MOST_BYTES = 1_000_000
"""A film of more bytes is left out: base64 makes it a third of the page that `pipelines.report.pictures` allows."""


def talking_section(run: Path) -> tuple[Section, ...]:
    """The film with its sound; none where there is no film, or one too large to be part of a page."""
    path = run / TALKING_FILM
    if not path.is_file() or path.stat().st_size > _MOST_BYTES:
        return ()
    text = (
        "A text to a made voice; its phonemes to mouth and jaw, its stresses to gestures. The capture has none of it."
    )
    film = Film("the student, drawn by the runtime; press play for the sound", read_bytes(path, subject="film"))
    return (Section("It talks", text=(text,), films=(film,)),)
