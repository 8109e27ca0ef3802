"""The template of the embedded person: holes of cut bridges are closed, and counted where a user looks."""

from __future__ import annotations

import json

from pipelines.runs.artefacts import load_parts
from pipelines.runs.layout import TEMPLATE
from smplxpp.metrics import mesh_quality
from smplxpp.template.template import Template


def test_holes_that_cuts_leave_are_closed_in_the_template_and_the_report_counts_them(person_run):
    filled = json.loads((person_run / "60_assemble" / "manifest.json").read_text())["numbers"]["darned"]
    assert filled["upper"]["holes"] == filled["upper"]["closed"] > 1
    template = Template.load(person_run / TEMPLATE)
    quality = mesh_quality(template.part_mesh("upper"))
    assert quality.border_loops == 4  # neck, cuffs, hem
    assert quality.nonmanifold_edges == quality.nonmanifold_vertices == 0
    cut = load_parts(person_run)["upper"].mesh
    assert quality.faces == cut.face_count + filled["upper"]["faces"]
    assert (template.scan_index[template.vertex_part == template.part_names.index("upper")] < 0).any()
    assert "holes of cuts" in (person_run / "report.html").read_text()
