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


def test_the_lid_that_the_scan_closes_the_skirt_with_is_no_part_of_the_template(person_run):
    numbers = json.loads((person_run / "40_transfer" / "manifest.json").read_text())["numbers"]
    assert numbers["lower"]["lid_faces"] > 500 and numbers["upper"]["lid_faces"] == numbers["hair"]["lid_faces"] == 0
    skirt = Template.load(person_run / TEMPLATE).part_mesh("lower")
    assert mesh_quality(skirt).border_loops == 2  # waist and hem
    # Of the skirt's area no more than a hem's fold looks down.
    assert skirt.face_areas[skirt.face_normals[:, 1] < -0.8].sum() < 0.01 * skirt.face_areas.sum()
