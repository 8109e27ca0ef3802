"""The report's section on another light: the student before and after, and the light turned around it."""

from __future__ import annotations

from pathlib import Path

from pipelines.report import Comparison, Picture, Section
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import RELIGHT_STAGE, STUDENT, TEMPLATE
from pipelines.runs.stage import StageRecord, read_manifest
from smplxpp.core.files.paths import path_inside, read_bytes


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
        Picture(said, read_bytes(path_inside(record.folder, file, subject="picture of a light"), subject="picture"))
        for said, file in numbers["pictures"].items()
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
