"""The report's section on a registration: the body on photographs before and after, residuals, confidence, problems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from pipelines.report import CheckRow, Curve, KeyNumber, Picture, Report, Section, Table, write_report
from pipelines.report.builder import readable, readable_numbers
from pipelines.runs.artefacts import load_located, load_stacked_params, read_named, values_of
from pipelines.runs.layout import LOCATION_FILE, REGISTER_STAGE
from pipelines.runs.stage import StageRecord
from pipelines.stages.build_config import RegisterInputs, load_register
from smplxpp.body import BodyModel, PosedBody, load_body
from smplxpp.build.observe import open_inputs
from smplxpp.build.register import BODY_JOINTS, RESIDUALS
from smplxpp.build.scan import read_scan
from smplxpp.capture import Capture, find_scans
from smplxpp.core import BodyParams, Camera, InputError, TriangleMesh, spread
from smplxpp.core.files.json_file import as_list, as_object, as_text, read_json
from smplxpp.figures import body_cameras, caption, encode_jpeg, encode_png, render_overlay, render_shaded, row
from smplxpp.figures.drawings import body_on_photograph, draw_bones
from smplxpp.figures.sheets import heat_strip

HEIGHT = 560
REFERENCE_VIEWS, WORST_FRAMES = 2, 3
STRIP_COLUMNS = 240
NOTES_SHOWN = 20
_MARGIN, _WHOLE = 0.14, 0.95
_EYES = ("left_eye_smplhf", "right_eye_smplhf")


@dataclass(frozen=True, eq=False)
class _Fits:
    """The bodies before and after, by frame."""

    body: BodyModel
    before: Mapping[int, BodyParams]
    after: Mapping[int, BodyParams]

    def posed(self, frame: int) -> dict[str, PosedBody]:
        """The bodies of a frame, those that there are, by name."""
        both = (("before", self.before), ("after", self.after))
        return {name: self.body.forward(of[frame]).frame(0) for name, of in both if frame in of}


def register_section(run: Path, record: StageRecord) -> Section:
    """Show a registration from its files; without its capture there are no photographs."""
    content = read_json(record.folder / "registration.json", subject="registration")
    inputs = load_register(run)
    pictures: list[Picture] = []
    if inputs is not None:
        fits = _load_fits(record.folder, load_body(inputs.body))
        try:
            pictures = _pictures(inputs, fits, content)
        except InputError:  # the capture is no longer where it was: figures remain
            pictures = []
    named = read_named(record.folder / "confidence.npz", "confidence", "joint_names", "frames")
    pictures.append(_confidence_picture(named[0], named[1].tolist(), named[2]))
    found, absent = content["frames"], content["absent"]
    seen = content["seen"]
    what = [f"keypoints of {len(seen['keypoints'])} cameras"] if seen["keypoints"] else []
    what += [words for words, there in (("masks", seen["masks"]), ("label maps", seen["label_maps"])) if there]
    what += [f"{len(seen['scans'])} scans"] if seen["scans"] else []
    start = "a given fit" if seen["start"] else "keypoints alone"
    return Section(
        title="Registration",
        text=(
            f"The body fitted to {len(found)} frames of {len(content['cameras'])} training cameras"
            + (f" ({len(absent)} frames could not be)" if absent else "")
            + f": {', '.join(what) or 'priors alone'}; it started from {start}. Held-out cameras were not looked at; "
            f"{len(content['held_out_frames'])} held-out frames got their poses, and no say in the shape.",
        ),
        pictures=tuple(pictures),
        curves=_curves(content),
        tables=tuple(table for table in (_camera_table(content), _note_table(content)) if table is not None),
        checks=tuple(CheckRow.of(check, stage=REGISTER_STAGE) for check in record.manifest["checks"]),
    )


def write_register_report(path: Path, run: Path, record: StageRecord) -> None:
    """Write a page on a registration alone."""
    # A section that cannot be read becomes a note on the page instead of an error after minutes of work.
    section = readable(record, "Registration", lambda: register_section(run, record))
    inputs = load_register(run)
    source = None if inputs is None else inputs.root or inputs.scan_file
    report = Report(
        subject=run.name if source is None else source.resolve().stem,
        summary="The body registered to what was seen of a person.",
        key_numbers=readable_numbers(record, lambda: _key_numbers(record)),
        checks=section.checks,
        seconds={REGISTER_STAGE: record.manifest["seconds"]},
        sections=(section,),
        provenance={
            "configuration": record.manifest["config"],
            "versions": record.manifest["versions"],
            "inputs (SHA-256)": record.manifest["inputs"],
        },
        kind="registration",
    )
    write_report(path, report)


def _load_fits(folder: Path, body: BodyModel) -> _Fits:
    def rows(path: Path) -> dict[int, BodyParams]:
        if not path.is_file():
            return {}
        frames, params = load_stacked_params(path)
        return {frame: params.frame(k) for k, frame in enumerate(frames)}

    return _Fits(body, rows(folder / "initial.npz"), rows(folder / "params.npz"))


def _pictures(inputs: RegisterInputs, fits: _Fits, content: Mapping[str, Any]) -> list[Picture]:
    """The body on photographs of the reference frame and of the worst frames; on scans where there are no images."""
    frames = content["frames"]
    reference = inputs.frame if inputs.frame in frames else frames[0]
    worst = worst_frames(content, WORST_FRAMES)
    capture = None if inputs.capture is None else open_inputs(inputs, fits.body)
    pictures = []
    # The reference frame from several cameras shows the fit that the template is built on; a single view of each
    # worst frame shows where it fails.
    if capture is not None and content["cameras"]:
        chosen = [(reference, REFERENCE_VIEWS, "reference frame")]
        chosen += [(frame, 1, f"largest residual, {words}") for frame, words in worst if frame != reference]
        for frame, count, why in chosen:
            for name in _cameras_shown(capture, content["cameras"], frame, fits)[:count]:
                pictures.append(_on_photograph(capture, name, frame, fits, why))
    # A scan given by hand replaces the capture's own of that frame.
    scans = {} if inputs.root is None else find_scans(inputs.root)
    scans |= {} if inputs.scan_file is None else {inputs.frame: inputs.scan_file}
    if reference in scans:
        pictures.append(_on_scan(scans[reference], inputs, reference, fits))
    return pictures


def _key_numbers(record: StageRecord) -> tuple[KeyNumber, ...]:
    after = record.manifest["numbers"]["residuals"]["after"]
    return tuple(
        KeyNumber(residual.words, f"{after[name]:.1f} {residual.unit}", "median over frames")
        for name, residual in RESIDUALS.items()
        if name in after
    )


def _cameras_shown(capture: Capture, names: Sequence[str], frame: int, fits: _Fits) -> list[str]:
    """Two cameras with an image, if there are: of those that show the whole body the first, and one a quarter on."""
    seen = [name for name in names if capture.file(name, frame) is not None]
    joints = fits.posed(frame)["after"].joints
    whole = []
    for name in seen:
        camera = capture.cameras[name]
        pixels = camera.screen_from_world(joints)
        inside = (pixels[:, :2] >= 0) & (pixels[:, :2] <= (camera.width, camera.height))
        if (inside.all(axis=1) & (pixels[:, 2] > 0)).mean() > _WHOLE:
            whole.append(name)
    chosen = whole or seen
    return list(dict.fromkeys([chosen[0], chosen[len(chosen) // 4]])) if chosen else []


def worst_frames(content: Mapping[str, Any], count: int) -> list[tuple[int, str]]:
    """The frames with the largest residual of the first kind that was measured, the worst first, with it in words."""
    frames = content["frames"]
    for name, residual in RESIDUALS.items():
        values = np.array(content["residuals"]["after"].get(name, []), dtype=np.float64)
        known = np.flatnonzero(np.isfinite(values))
        if len(known):
            order = known[np.argsort(-values[known], kind="stable")][:count]
            return [(frames[k], f"{residual.words} {values[k]:.1f} {residual.unit}") for k in order]
    return []


def _on_photograph(capture: Capture, name: str, frame: int, fits: _Fits, why: str) -> Picture:
    posed = fits.posed(frame)
    points = np.concatenate([body.vertices for body in posed.values()])
    capture = capture.cropped({name: _box(capture.cameras[name], points)})
    capture = capture.resized(HEIGHT / capture.cameras[name].height)
    camera, photograph = capture.cameras[name], capture.image(name, frame)
    panels = [caption(photograph, "photograph")]
    without = [fits.body.joint_names.index(eye) for eye in _EYES if eye in fits.body.joint_names]
    for when, body in posed.items():
        over = body_on_photograph(photograph, camera, fits.body.mesh(body.vertices))
        panels.append(caption(draw_bones(over, camera, body.joints, fits.body.parents, without=without), when))
    return Picture(f"frame {frame}, camera {name}: {why}", encode_jpeg(row(panels)))


def _box(camera: Camera, points: np.ndarray) -> tuple[int, int, int, int]:
    """The part of an image that shows points with a margin; all of it where they are outside."""
    pixels = camera.screen_from_world(points)
    pixels = pixels[pixels[:, 2] > 0, :2]
    if not len(pixels):
        return 0, 0, camera.width, camera.height
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = _MARGIN * (high[1] - low[1])
    x0, y0 = np.maximum(np.floor(low - margin), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin), (camera.width, camera.height)).astype(int)
    return (int(x0), int(y0), int(x1), int(y1)) if x1 > x0 and y1 > y0 else (0, 0, camera.width, camera.height)


def _on_scan(path: Path, inputs: RegisterInputs, frame: int, fits: _Fits) -> Picture:
    scan = read_scan(path, units=inputs.units, up=inputs.up).clean.mesh
    panels = []
    for when, body in fits.posed(frame).items():
        cameras = body_cameras(scan, views=("front", "side"), height=HEIGHT)
        ghost = fits.body.mesh(body.vertices)
        panels += [caption(render_overlay(ghost, scan, camera), when) for camera in cameras]
    return Picture(f"frame {frame}: the body within the scan (glass)", encode_jpeg(row(panels)))


def _curves(content: Mapping[str, Any]) -> tuple[Curve, ...]:
    """Each residual over the frames, before and after."""
    frames, curves = np.array(content["frames"], dtype=np.float64), []
    residuals = content["residuals"]
    for name, after in residuals["after"].items():
        lines = {"after": np.array(after, dtype=np.float64)}
        if name in residuals["before"]:
            lines = {"before": np.array(residuals["before"][name], dtype=np.float64), **lines}
        if not any(np.isfinite(values).any() for values in lines.values()):
            continue
        shown = RESIDUALS.get(name)
        title, unit = (name, "") if shown is None else (shown.words, shown.unit)
        curves.append(Curve(title, {when: (frames, values) for when, values in lines.items()}, "frame", unit))
    return tuple(curves)


def _camera_table(content: Mapping[str, Any]) -> Table | None:
    """Keypoints against the body's joints, by camera."""
    rows = []
    for name, found in content["by_camera"].items():
        before, after = found.get("before", {}), found.get("after", {})
        rows.append((name, found["points"], before.get("median_px"), after.get("median_px"), after.get("p90_px")))
    header = ("camera", "keypoints", "before, median px", "after, median px", "after, p90 px")
    return Table(header, tuple(rows), "keypoints to the body's joints, by camera") if rows else None


def _note_table(content: Mapping[str, Any]) -> Table | None:
    notes = content["problems"]
    if not notes:
        return None
    rows = [(note,) for note in notes[:NOTES_SHOWN]]
    if len(notes) > NOTES_SHOWN:
        rows.append((f"and {len(notes) - NOTES_SHOWN} more in {REGISTER_STAGE}/registration.json",))
    return Table(("what was wrong, and what was done about it",), tuple(rows), "problems of the inputs")


def _confidence_picture(confidence: np.ndarray, names: Sequence[str], frames: np.ndarray) -> Picture:
    """Draw the confidence of the joints over the frames, with one row for the fingers of each hand."""
    # Sample the frames, so that a long sequence fits the width.
    columns = spread(range(len(frames)), STRIP_COLUMNS)
    rows = {name.replace("_", " "): confidence[:, k] for k, name in enumerate(names[:BODY_JOINTS])}
    if "jaw" in names:
        rows["jaw"] = confidence[:, names.index("jaw")]
    for side in ("left", "right"):
        # Single fingers have similar confidence, so that their mean represents the hand.
        fingers = [
            k for k, name in enumerate(names) if k >= BODY_JOINTS and name.startswith(f"{side}_") and "eye" not in name
        ]
        if fingers:
            rows[f"{side} fingers"] = confidence[:, fingers].mean(axis=1)
    strip: UInt8[np.ndarray, "H W 3"] = heat_strip(
        np.stack(list(rows.values()))[:, columns], list(rows), [int(frames[k]) for k in columns], limits=(0.0, 1.0)
    )
    return Picture("confidence of each joint, over frames: from 0, the priors alone, to 1", encode_png(strip))


_BARE, _COVERED = (226, 142, 96), (150, 150, 158)


def locate_section(record: StageRecord, body: BodyModel, scan: TriangleMesh) -> Section:
    """Show the body within a run's scan from three sides, and the table of candidate poses."""
    path = record.folder / LOCATION_FILE
    content = as_object(read_json(path, subject="location"), subject=f"location {path}")
    located = load_located(record.folder)
    bare = located.bare_of(body)
    found = body.mesh(body.forward(located.params).vertices[0])
    cameras = body_cameras(scan, views=("front", "side", "back"), height=HEIGHT)
    # The body within a transparent scan, then the body alone with bare skin marked.
    glass = [render_overlay(found, scan, camera) for camera in cameras]
    shown = np.where(bare[:, None], _BARE, _COVERED).astype(np.uint8)
    bodies = [render_shaded(found, camera, vertex_colors=shown) for camera in cameras]
    # The first candidate is the chosen one.
    with values_of(path):
        sentences = [as_text(content[name], subject=name) for name in ("said", "detector")]
        notes = [as_text(note, subject="problem") for note in as_list(content["problems"], subject="problems")]
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
    if notes:
        tables.append(Table(("uncertainties, and remedies",), tuple((note,) for note in notes)))
    return Section(
        title="Body found in the scan",
        text=(
            ". ".join(sentence for sentence in sentences if sentence),
            "The body was located from the surface alone. Check hands, feet and face: the body's own colour shows "
            "where it penetrates the scan. Landmarks placed with `smplxpp label` correct it.",
        ),
        pictures=(
            Picture("the body within the scan (glass)", encode_jpeg(row(glass))),
            Picture("the body that was found; bare skin in its colour", encode_jpeg(row(bodies))),
        ),
        tables=tuple(tables),
        legend=(("bare", _BARE), ("covered, or uncertain", _COVERED)),
        checks=tuple(CheckRow.of(check, stage=record.folder.name) for check in record.manifest["checks"]),
    )
