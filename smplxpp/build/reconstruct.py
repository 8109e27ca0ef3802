"""Reconstruct the person's surface in frames of a capture, from photographs, cameras and masks alone.

Held-out cameras and frames are never used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.body import BodyModel, load_body
from smplxpp.build.config import ReconstructInputs
from smplxpp.build.limits import MASKS_LEFT_OUT, SILHOUETTE, UNSEEN_SURFACE
from smplxpp.build.request import opened
from smplxpp.build.turning import turning_person
from smplxpp.capture import Capture
from smplxpp.capture.recording import TURNTABLE
from smplxpp.clean import sanitize
from smplxpp.core import Check, InputError, ProgressCallback, StageOutput
from smplxpp.core.files.json_file import as_number, as_numbers, as_object, read_json
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh, write_ply
from smplxpp.reconstruct import ReconstructConfig, Reconstruction, adopt_surface, reconstruct
from smplxpp.reconstruct.carried import PosedPerson
from smplxpp.reconstruct.neus2 import UnitCube, mesh_in_world
from smplxpp.reconstruct.turntable import reconstruct_turntable
from smplxpp.reconstruct.views import PhotoView, silhouette_agreement, usable_views

Maker = Callable[..., Reconstruction]
"""`make(views, progress=...)`: reconstructs the surface of a moment."""


def open_photographs(inputs: ReconstructInputs) -> Capture:
    """Open the capture of a reconstruction; body parameters are not read.

    Raises:
        InputError: no capture; one without cameras.
    """
    capture = opened(inputs.capture, masks=inputs.masks, protocol=inputs.protocol)
    if not capture.cameras:
        raise InputError(
            f"capture {capture.name}",
            expected="calibrated cameras",
            received="none",
            remedy="give cameras.json or calibration.csv (docs/captures.md)",
        )
    return capture


def usable_cameras(capture: Capture, hold_out: tuple[str, ...]) -> tuple[str, ...]:
    """Return the cameras that may be used: all but those in `hold_out`, or but those that the capture holds out.

    Raises:
        InputError: an unknown camera, or none is left.
    """
    # A misspelt name would leak a held-out camera into the surface.
    splits = capture.splits
    unknown = sorted(set(hold_out) - set(capture.cameras))
    if unknown:
        raise InputError(
            "option hold-out", expected=f"cameras among {', '.join(capture.cameras)}", received=", ".join(unknown)
        )
    # The same rule as in a registration, so that both see the same cameras.
    known = {*splits.train_cameras, *splits.novel_view_cameras}
    held_out = hold_out or splits.novel_view_cameras
    cameras = tuple(name for name in capture.cameras if name in known and name not in held_out)
    if not cameras:
        raise InputError("cameras", expected="some that are not held out", received="all held out")
    return cameras


def usable_frames(capture: Capture, frames: tuple[int, ...] | None) -> tuple[int, ...]:
    """Return the frames to reconstruct: those asked for, or all that are trained on.

    Raises:
        InputError: a frame that the capture has not, or one that is held out.
    """
    splits = capture.splits
    if frames is None:
        # Without a choice take all frames that are trained on and have images.
        frames = tuple(frame for frame in splits.train_frames if frame in set(capture.frames))
        if not frames:
            raise InputError(f"capture {capture.name}", expected="training frames with images", received="none")
        return frames
    unknown = sorted(set(frames) - set(capture.frames))
    # Frames named in an error.
    named = 6
    if unknown:
        have = f"{capture.frames[0]} to {capture.frames[-1]}" if capture.frames else "none"
        raise InputError(
            "--frame",
            expected=f"frames that capture {capture.name} has ({have})",
            received=", ".join(map(str, unknown[:named])),
        )
    # A surface from a held-out frame would show the avatar what it is tested on.
    held_out = sorted(set(frames) & set(splits.novel_pose_frames))
    if held_out:
        raise InputError(
            "--frame",
            expected="frames that are trained on",
            received=f"held-out {', '.join(map(str, held_out[:named]))}",
            remedy="choose others, or hold out other frames in the capture's split",
        )
    return tuple(sorted(set(frames)))


def check_masks(capture: Capture, cameras: tuple[str, ...], frames: tuple[int, ...]) -> None:
    """Refuse a capture without masks before any image is opened.

    Raises:
        InputError: no frame has masks of any camera.
    """
    # The visual hull is the start of every reconstruction; one mask anywhere shows that masks exist at all.
    for frame in frames:
        if any(capture.file(name, frame, "mask") is not None for name in cameras):
            return
    raise InputError(
        f"capture {capture.name}",
        expected="masks of its photographs",
        received="none",
        remedy="give a folder of masks with --masks, or make them with your matting model (docs/captures.md)",
    )


def photographs(capture: Capture, cameras: tuple[str, ...], frame: int) -> tuple[list[PhotoView], list[str]]:
    """Read the photographs and masks of a frame, with a note on each that is missing or cannot be read."""
    views, notes = [], []
    # Notes instead of errors, since the hull tolerates missing cameras; how many are needed is decided later.
    for name in cameras:
        if capture.file(name, frame) is None:
            continue
        try:
            color, opacity = capture.image(name, frame), capture.mask(name, frame)
        except InputError as error:
            notes.append(f"camera {name} left out: {error}")
            continue
        if opacity is None:
            notes.append(f"camera {name} left out: no mask")
            continue
        views.append(PhotoView(name, capture.cameras[name], color, opacity))
    return views, notes


def frames_read(capture: Capture, frames: tuple[int, ...]) -> tuple[int, ...]:
    """Return the frames whose photographs a surface is made of: of a turning person, all that are trained on."""
    return usable_frames(capture, None) if capture.kind == TURNTABLE else frames


def config_of(inputs: ReconstructInputs) -> ReconstructConfig:
    """Return the settings of the surface that the inputs ask for."""
    cell = None if inputs.cell_mm is None else 1e-3 * inputs.cell_mm
    return ReconstructConfig(cell=cell, dissent=inputs.dissent, refine=inputs.refine)


def surface_maker(inputs: ReconstructInputs) -> Maker:
    """Return what makes the surface of a moment: our sweep, or the adoption of another program's mesh."""
    if inputs.mesh is None:
        return partial(_sweep, config=config_of(inputs))
    return partial(_adopt, mesh=inputs.mesh, root=inputs.root)


def reconstruct_frame(
    capture: Capture,
    cameras: tuple[str, ...],
    frame: int,
    make: Maker,
    progress: ProgressCallback,
    *,
    body: BodyModel | None = None,
) -> tuple[Reconstruction, dict[str, Any]]:
    """Reconstruct one frame, and measure its silhouettes against the masks.

    Args:
        capture: the photographs; of a person who turns before one camera, all frames are read.
        cameras: that may be used.
        frame: its number.
        make: gives the surface.
        progress: called with the running step and its share done.
        body: the model of a turning person's poses; None: the open body.

    Returns:
        The surface, and its numbers with notes under "problems".

    Raises:
        InputError: photographs that no surface can be made of.
    """
    if capture.kind == TURNTABLE:
        turn, notes = turning_person(capture, cameras[0], frame, body or load_body())
        result = make(turn.views, person=turn.person, progress=progress)
        return result, {**result.numbers, "problems": [*notes, *result.notes]}
    views, notes = photographs(capture, cameras, frame)
    result = make(views, progress=progress)
    # Intersection over union of the rendered surface and the mask, for the views that the reconstruction used.
    agreement = silhouette_agreement(result.mesh, [view for view in views if view.name in result.numbers["views"]])
    return result, {**result.numbers, "silhouettes": agreement, "problems": [*notes, *result.notes]}


def _sweep(
    views: list[PhotoView], *, config: ReconstructConfig, progress: ProgressCallback, person: PosedPerson | None = None
) -> Reconstruction:
    if person is not None:
        return reconstruct_turntable(views, person, config, progress=progress)
    return reconstruct(views, config, progress=progress)


def _adopt(
    views: list[PhotoView], *, mesh: Path, root: Path, progress: ProgressCallback, person: PosedPerson | None = None
) -> Reconstruction:
    """Bring another program's surface to the cameras' world and colour it."""
    if person is not None:
        raise InputError(
            "option mesh",
            expected="cameras that see one moment",
            received="a person who turns before one camera",
            remedy="build with --scan, and name the mesh there",
        )
    progress("masks", 0.0)
    raw = read_raw_mesh(mesh)
    # Other programs centre and scale the scene. Try the known normalisations and keep that whose silhouettes agree
    # best.
    usable, _ = usable_views(views)
    surface, space, shares = mesh_in_world(sanitize(raw.vertices, raw.faces).mesh, usable, unit_cube_of(root))
    progress("colours", 0.0)
    # Colours come from our own photographs, because meshes of neural fields often carry none.
    result = adopt_surface(surface, views)
    result.numbers.update(space=space, agreement_by_space=shares)
    return result


def write_surface(path: Path, result: Reconstruction) -> None:
    """Write a reconstructed surface as a PLY scan with colours, confidence and the number of cameras that see it."""
    extra = {"confidence": result.confidence, "seen": result.seen.astype(np.int32)}
    write_ply(path, result.mesh, vertex_colors=result.colors, vertex_properties=extra)


def reconstruction_output(
    found: dict[int, dict[str, Any]], notes: dict[int, str], cameras: Sequence[str]
) -> StageOutput:
    """Check the worst of the reconstructed frames, and average their numbers.

    Args:
        found: numbers by frame, as `reconstruct_frame` gives them.
        notes: why a frame has no surface.
        cameras: those that were used.
    """
    asked = len(found) + len(notes)
    return StageOutput(_checks(list(found.values()), asked), _summary(found, notes, cameras))


def _checks(frames: list[dict[str, Any]], asked: int) -> list[Check]:
    """Limits held by the worst frame of each number."""
    # The worst frame decides, because one bad frame spoils the motion. Silhouettes are averaged over a frame's views
    # first.
    unseen = max(one["unseen"] for one in frames)
    silhouettes = min(float(np.mean(list(one["silhouettes"].values()))) for one in frames)
    left_out = max(len(one["left_out"]) / (len(one["left_out"]) + len(one["views"])) for one in frames)
    names = sorted({name for one in frames for name in one["left_out"]})
    return [
        SILHOUETTE.check(
            "reconstructed surface on the masks, worst frame", silhouettes, explanation="mean over the views that count"
        ),
        UNSEEN_SURFACE.check(
            "share of the surface that fewer than two cameras see",
            unseen,
            explanation="the silhouettes' alone: under a skirt, between the legs, soles",
        ),
        MASKS_LEFT_OUT.check(
            "share of the masks that were left out",
            left_out,
            explanation=f"contradicted by the others: {', '.join(names)}" if names else "none contradicts the others",
        ),
        # Up to half of the frames may lack a surface: scans only refine a registration that has keypoints.
        Check(
            "frames without a surface",
            float(asked - len(frames)),
            "",
            0.0,
            0.5 * asked,
            explanation="their problems are named in reconstruction.json",
        ),
    ]


def _summary(found: dict[int, dict[str, Any]], notes: dict[int, str], cameras: Sequence[str]) -> dict[str, Any]:
    frames = list(found.values())
    return {
        "frames": len(found),
        "absent": sorted(notes),
        "vertices": int(np.mean([one["vertices"] for one in frames])),
        "cell_mm": float(np.mean([one["cell_mm"] for one in frames])),
        "pixel_mm": float(np.mean([one["pixel_mm"] for one in frames])),
        "moved_mm": float(np.mean([one["moved_mm"] for one in frames])),
        "unseen": float(np.mean([one["unseen"] for one in frames])),
        "unsure": float(np.mean([one["unsure"] for one in frames])),
        "problems": len(notes) + sum(len(one["problems"]) for one in frames),
        "seen": {"cameras": list(cameras), "frames": sorted(found)},
    }


def unit_cube_of(root: Path) -> UnitCube | None:
    """The unit cube that a capture's transform.json names for its trainer; None where it names none."""
    for path in sorted(root.glob("transform*.json")):
        content = as_object(read_json(path), subject=f"file {path}")
        if "scale" in content and "offset" in content:
            offset = as_numbers(content["offset"], (3,), subject=f"file {path}: offset")
            scale = as_number(content["scale"], subject=f"file {path}: scale")
            return UnitCube(scale, (float(offset[0]), float(offset[1]), float(offset[2])))
    return None
