"""Stage 60: body and parts as one template, holes of cut webs closed, layers apart; npz, GLB and OBJ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import (
    load_canonical,
    load_cleaned_parts,
    load_params_of_run,
    load_parts,
    load_posed_body,
    load_scan,
    load_scan_labels,
    load_weights,
    values_of,
)
from pipelines.runs.layout import PARTS_WITHOUT_WEBS
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from smplxpp.assemble import (
    AssemblyConfig,
    CanonicalPart,
    assemble_template,
    body_colors_from_scan,
    cut_holes,
    darn,
)
from smplxpp.body import BodyModel, load_body
from smplxpp.core.checks import Check
from smplxpp.core.labels import SKIN
from smplxpp.export import write_glb, write_obj
from smplxpp.metrics.distance import MM
from smplxpp.template.mouth import MOUTH_COLOR, inside_of_mouth
from smplxpp.template.template import Template


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write body and parts as one `Template`, layers apart; npz, GLB and OBJ."""
    body = load_body(build.inputs.body)
    cut, parts, darned = load_parts(build.run), {}, {}
    canonical, weights = load_canonical(build.run, cut), load_weights(build.run, cut)
    _, _, source_vertex = load_scan(build.run)
    for name, (cleaned, before) in load_cleaned_parts(build.run).items():
        mesh, arrays = cut[name]
        with values_of(build.run / PARTS_WITHOUT_WEBS):
            scan_index = source_vertex[arrays["source_vertex"]]
        part = CanonicalPart(
            mesh=canonical[name],
            weights=weights[name],
            label=int(arrays["label"]),
            vertex_colors=arrays["colors"],
            scan_index=scan_index,
        )
        holes = cut_holes(cleaned, before["source_vertex"], mesh, arrays["source_vertex"])
        parts[name], darned[name] = darn(part, holes, config=build.config.darning)
    template, report = assemble_template(
        body, load_params_of_run(build.run), parts, config=AssemblyConfig(clearance=build.config.clearance_mm / MM)
    )
    template = _colored_body(template, build.run, body)
    template.save(folder / "smplxpp.npz")
    write_glb(folder / "template.glb", template)
    write_obj(folder / "template.obj", template)
    checks = [
        Check(
            "outer vertices inside an inner layer at rest",
            report.penetrating_after,
            "",
            0,
            0,
            explanation="after the repair",
        ),
        Check(
            "depth of what the repair leaves inside",
            report.left_depth * MM,
            "mm",
            0.0,
            5.0,
            explanation=f"the body does not fit the scan here: register first. {report.left_where}"
            if report.left_where
            else "nothing needs a push beyond what its part stands off the body",
        ),
        Check(
            "largest push of the repair",
            report.max_push * MM,
            "mm",
            15.0,
            60.0,
            explanation=f"{report.max_push_where or 'none'}; no part is pushed farther than it stands off the body "
            "(10 to 30 mm) and the clearance",
        ),
    ]
    return StageOutput(checks, report.as_dict() | {"darned": {name: one.as_dict() for name, one in darned.items()}})


def _colored_body(template: Template, run: Path, body: BodyModel) -> Template:
    """The template with the scan's colours on the skin that the scan shows, and a mouth that is dark inside."""
    scan, colors, source_vertex = load_scan(run)
    skin = load_scan_labels(run, scan.face_count) == SKIN.id
    posed, _ = load_posed_body(run, body)
    body_colors, body_index = body_colors_from_scan(posed, scan, colors, skin)
    count = body.vertex_count
    # The scan's nearest skin is that of the lips.
    mouth = inside_of_mouth(template)[:count]
    body_colors[mouth], body_index[mouth] = MOUTH_COLOR, -1
    scan_index = np.where(body_index >= 0, source_vertex[body_index], -1)
    return replace(
        template,
        vertex_colors=np.concatenate([body_colors, template.vertex_colors[count:]]),
        scan_index=np.concatenate([scan_index, template.scan_index[count:]]),
    )
