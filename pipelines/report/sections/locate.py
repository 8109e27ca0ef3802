"""The report's section on the body found in a scan: how it stands there, what else it might have been, what is bare."""

from __future__ import annotations

import numpy as np

from pipelines.figures import body_cameras, encode_jpeg, render_overlay, render_shaded, row
from pipelines.report import CheckRow, Picture, Section, Table
from pipelines.runs.artefacts import values_of
from pipelines.runs.layout import LOCATION_FILE
from pipelines.runs.stage import StageRecord
from pipelines.stages.located import read_located
from smplxpp.body import BodyModel
from smplxpp.core.files.json_file import as_list, as_object, as_text, read_json
from smplxpp.core.mesh import TriangleMesh

HEIGHT = 560
_BARE, _COVERED = (226, 142, 96), (150, 150, 158)


def locate_section(record: StageRecord, body: BodyModel, scan: TriangleMesh) -> Section:
    """Show the body within a run's scan from three sides, and the table of what it might have been."""
    path = record.folder / LOCATION_FILE
    content = as_object(read_json(path, subject="location"), subject=f"location {path}")
    params, bare = read_located(record.folder, body)
    found = body.mesh(body.forward(params).vertices[0])
    cameras = body_cameras(scan, views=("front", "side", "back"), height=HEIGHT)
    glass = [render_overlay(found, scan, camera) for camera in cameras]
    shown = np.where(bare[:, None], _BARE, _COVERED).astype(np.uint8)
    bodies = [render_shaded(found, camera, vertex_colors=shown) for camera in cameras]
    with values_of(path):
        said = [as_text(content[name], subject=name) for name in ("said", "detector")]
        problems = [as_text(words, subject="problem") for words in as_list(content["problems"], subject="problems")]
        candidates = [
            as_object(one, subject="candidate") for one in as_list(content["candidates"], subject="candidates")
        ]
        rows = tuple(
            (
                f"{'chosen: ' if k == 0 else ''}{one['pose']}",
                one["facing_degrees"],
                one["cost"],
                one["covered"],
                one["shown"],
            )
            for k, one in enumerate(candidates)
        )
    header = (
        "search from",
        "facing, degrees from +Z",
        "cost, mm",
        "of the scan explained",
        "of hands, face, feet shown",
    )
    tables = [Table(header, rows, "ways to stand in the scan that were followed to the end; a lower cost is better")]
    if problems:
        tables.append(Table(("where it is unsure, and what to do",), tuple((words,) for words in problems)))
    return Section(
        title="Body found in the scan",
        text=(
            ". ".join(words for words in said if words),
            "Nothing but the surface said where the body is. Look at hands, feet and face: the body's own colour shows "
            "where it comes through. Landmarks placed with `smplxpp label` settle what is wrong.",
        ),
        pictures=(
            Picture("the body within the scan (glass)", encode_jpeg(row(glass))),
            Picture("the body that was found; bare skin in its colour", encode_jpeg(row(bodies))),
        ),
        tables=tuple(tables),
        legend=(("bare", _BARE), ("covered, or not sure", _COVERED)),
        checks=tuple(CheckRow.of(check, stage=record.folder.name) for check in record.manifest["checks"]),
    )
