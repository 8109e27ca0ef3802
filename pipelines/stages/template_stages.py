"""The stages that make a template: each reads what stands, calls a step of `smplxpp.build`, keeps the result.

Nothing is computed here. A stage's key counts the code of its step and of the files (`pipelines.stages.build.PARTS`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.runs.artefacts import (
    load_canonical,
    load_cleaned_parts,
    load_fit,
    load_labels,
    load_params_of_run,
    load_parts,
    load_prepared_scan,
    load_scan_labels,
    load_scan_scale,
    load_stacked_params,
    load_weights,
    save_arrays,
    save_canonical,
    save_fit,
    save_labels,
    save_located,
    save_parts,
    save_scan,
    save_weights,
)
from pipelines.runs.layout import (
    CORRECTIONS_FILE,
    LANDMARKS_FILE,
    LOCATED_PARAMS,
    LOCATION_FILE,
    NOT_FOUND_PICTURE,
    REGISTERED_PARAMS,
    TEMPLATE,
)
from pipelines.stages.build_config import BuildContext
from pipelines.stages.run_inputs import motion_of_build
from smplxpp.body import load_body, load_params
from smplxpp.build.assemble import add_texture, assemble_parts
from smplxpp.build.data import RestPart
from smplxpp.build.locate import LEAST_CONFIDENCE, locate_in_scan, require_found
from smplxpp.build.parts import clean_scan, transfer_to_parts, unpose_parts
from smplxpp.build.prepare import given_params, pose_fit, prepare_scan, registered_frame, start_params
from smplxpp.build.scan import ScanFile, read_scan
from smplxpp.build.segment import label_faces, label_source, vertex_labels
from smplxpp.build.validate import validate_template
from smplxpp.core import BodyParams, StageOutput, write_ply
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.export import write_glb, write_obj
from smplxpp.figures.colors import blend_joint_colors
from smplxpp.figures.sheets import encode_png
from smplxpp.metrics.comparison import MM
from smplxpp.register.locate import BodyNotFoundError
from smplxpp.segment import UNSURE, Corrections
from smplxpp.template.template import Template


def locate(folder: Path, build: BuildContext) -> StageOutput:
    """Write the parameters of the body found in the scan, what else it might have been, and how certain it is."""
    placed = build.run / LANDMARKS_FILE
    body = load_body(build.inputs.body)
    found, output = locate_in_scan(
        _read_scan(build),
        body,
        landmarks=placed if placed.exists() else None,
        detector=build.config.detector,
        height=build.config.height,
        start=start_params(build.inputs, body),
    )
    save_located(folder, found)
    (folder / LOCATION_FILE).write_text(json.dumps(output.numbers, indent=1) + "\n")
    return output


def require_body(build: BuildContext, found: Mapping[str, Any]) -> None:
    """Stop a build whose body has too little confidence or a shape of nobody, and leave a picture of it in the run.

    Args:
        build: the run and its choices.
        found: numbers of the stage that located the body.

    Raises:
        BodyNotFoundError: the confidence is too small or the shape is none, and failures are not accepted.
    """
    picture = build.run / NOT_FOUND_PICTURE
    picture.unlink(missing_ok=True)
    # Stages from before the shape was asked have no finding about it.
    believed = found["confidence"] >= LEAST_CONFIDENCE and found.get("strange_shape") is None
    if build.config.accept_failures or believed:
        return
    scan = _read_scan(build).scaled(found.get("scale", 1.0))
    try:
        require_found(
            *(scan.clean.mesh, load_body(build.inputs.body), load_params(build.run / LOCATED_PARAMS)),
            confidence=found["confidence"],
            findings=found["findings"] or found["problems"],
            picture_file=picture,
        )
    except BodyNotFoundError as error:
        if error.picture is not None:
            atomic_write_bytes(picture, encode_png(error.picture))
        raise


def capture(folder: Path, build: BuildContext) -> StageOutput:
    """Write the scan in metres, +Y up, repaired, and the frame's parameters."""
    # The stage that found the body has written by how much a scan without a unit has to be scaled.
    scale = 1.0 if build.config.height is None else load_scan_scale(build.run)
    scan, output = prepare_scan(_read_scan(build).scaled(scale))
    save_scan(folder, scan)
    _params_of_frame(build).save(folder / "params.npz")
    return output


def pose_body(folder: Path, build: BuildContext) -> StageOutput:
    """Write the posed body of the given fit, and how well the scan agrees with it."""
    scan = load_prepared_scan(build.run)
    fit, output = pose_fit(scan.mesh, load_body(build.inputs.body), load_params_of_run(build.run))
    save_fit(folder, fit)
    return output


def segment(folder: Path, build: BuildContext) -> StageOutput:
    """Write a label, a confidence and a seen flag for every face."""
    scan, path = load_prepared_scan(build.run), build.run / CORRECTIONS_FILE
    labels = build.inputs.labels_used
    labelled, output = label_faces(
        scan,
        build.inputs,
        load_body(build.inputs.body),
        load_params_of_run(build.run),
        corrections=Corrections.load(path, labels=labels) if path.exists() else None,
    )
    save_labels(folder, labels)
    # Keep the labels before corrections too: the report shows what was changed by hand.
    result, before = labelled.result, labelled.before
    assert result.corrected is not None
    np.savez(
        folder / "labels.npz",
        face_labels=result.face_labels,
        confidence=result.confidence,
        seen=result.seen,
        corrected=result.corrected,
        labels_before_hand=before.face_labels,
        confidence_before_hand=before.confidence,
    )
    # A coloured mesh for mesh viewers, pale where labels are uncertain, with labels as face properties.
    certain = np.ones(scan.mesh.vertex_count, dtype=bool)
    certain[scan.mesh.faces[result.confidence < UNSURE]] = False
    write_ply(
        folder / "labels.ply",
        scan.mesh,
        vertex_colors=labels.display_colors(vertex_labels(scan.mesh, result.face_labels), certain),
        face_properties={
            "label": result.face_labels,
            "confidence": result.confidence,
            "corrected": result.corrected.astype(np.uint8),
        },
    )
    return output


def clean(folder: Path, build: BuildContext) -> StageOutput:
    """Write one clean mesh within its face budget for every part that is not skin."""
    scan = load_prepared_scan(build.run)
    face_labels = load_scan_labels(build.run, scan.mesh.face_count)
    found = label_source(build.inputs) == "body"
    parts, output = clean_scan(scan, face_labels, build.config, load_labels(build.run), found=found)
    save_parts(folder, parts)
    return output


def transfer(folder: Path, build: BuildContext) -> StageOutput:
    """Write skin weights of every part from the posed body, and the parts without the bridges that the weights show."""
    body = load_body(build.inputs.body)
    cleaned, fit = load_cleaned_parts(build.run), load_fit(build.run, body)
    parts, weights, output = transfer_to_parts(cleaned, fit, body, build.config, load_labels(build.run))
    save_weights(folder, weights)
    save_parts(folder, parts)
    for name, part in parts.items():
        # Each vertex shows the blend of its joints' colours, so that a wrong weight stands out.
        write_ply(
            folder / f"{name}_weights.ply",
            part.mesh,
            vertex_colors=blend_joint_colors(weights[name]),
            vertex_properties={"matched": weights[name].matched.astype(np.int32)},
        )
    return output


def unpose(folder: Path, build: BuildContext) -> StageOutput:
    """Write the parts in the T-pose."""
    parts = load_parts(build.run)
    fit = load_fit(build.run, load_body(build.inputs.body))
    at_rest, output = unpose_parts(parts, load_weights(build.run, parts), fit)
    save_canonical(folder, at_rest)
    return output


def assemble(folder: Path, build: BuildContext) -> StageOutput:
    """Write body and parts as one `Template`, layers apart and painted: npz, GLB and OBJ."""
    body, scan, posed = load_body(build.inputs.body), load_prepared_scan(build.run), load_parts(build.run)
    # Weights and rest vertices are stored per part and matched by the part's name.
    at_rest, weights = load_canonical(build.run, posed), load_weights(build.run, posed)
    params, labels = load_params_of_run(build.run), load_scan_labels(build.run, scan.mesh.face_count)
    template, output = assemble_parts(
        body,
        params,
        scan,
        labels,
        load_fit(build.run, body),
        load_cleaned_parts(build.run),
        {name: RestPart(part, weights[name], at_rest[name].vertices) for name, part in posed.items()},
        build.config,
        labels=load_labels(build.run),
    )
    template, painted = add_texture(template, params, scan, labels, build.inputs, build.config, body)
    output = replace(output, numbers={**output.numbers, **painted})
    template.save(folder / "smplxpp.npz")
    # Other programs expect a figure that stands on the floor.
    write_glb(folder / "template.glb", template.on_floor())
    write_obj(folder / "template.obj", template.on_floor())
    return output


def validate(folder: Path, build: BuildContext) -> StageOutput:
    """Write distances to the scan in the reference pose; measure flips, and stretch under hard poses and the motion."""
    scan = load_prepared_scan(build.run)
    # Distances are kept per vertex for the report's histograms and error maps.
    found, output = validate_template(
        Template.load(build.run / TEMPLATE),
        load_params_of_run(build.run),
        scan,
        load_scan_labels(build.run, scan.mesh.face_count),
        load_parts(build.run),
        motion_of_build(build.run, build.inputs),
        build.inputs,
        build.config,
    )
    distances = {"template_to_scan": found.to_scan, "scan_to_template": found.to_template}
    save_arrays(
        folder / "errors.npz",
        {
            name: {"distance_mm": (d.distance * MM).astype(np.float32), "label": np.asarray(d.label).astype(np.int8)}
            for name, d in distances.items()
        },
    )
    return output


def _read_scan(build: BuildContext) -> ScanFile:
    config = build.config
    return read_scan(build.inputs.scan_file, units=config.units, up=config.up, height=config.height)


def _params_of_frame(build: BuildContext) -> BodyParams:
    """The reference frame's parameters: given, registered in the run, or of the body found in the scan.

    Raises:
        InputError: the frame could not be registered.
    """
    given = given_params(build.inputs, load_body(build.inputs.body))
    if given is not None:
        return given
    if not build.inputs.registers:
        return load_params(build.run / LOCATED_PARAMS)
    return registered_frame(build.inputs.frame, *load_stacked_params(build.run / REGISTERED_PARAMS))
