"""Make a synthetic capture with moving cloth from the fixture person, at any size and for a fixed seed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from smplxpp.body import load_body
from smplxpp.capture import open_capture
from smplxpp.capture.cameras import RigCamera, camera_rig
from smplxpp.capture.writers import (
    rounded,
    save_compact,
    view_path,
    write_actorshq_scene,
    write_calibration_csv,
    write_cameras_json,
    write_gray_png,
    write_jpeg,
    write_normal_png,
)
from smplxpp.core import ProgressCallback, TriangleMesh, ignore_progress, write_ply
from smplxpp.core.files import atomic_folder, atomic_write_text, read_json
from smplxpp.people.fixture_person import PART_LABELS, PART_NAMES, Person, person_of, read_layers
from smplxpp.people.outside import Outside, with_offsets
from smplxpp.people.scan_simulation import ScanConfig, SimulatedScan, merge_islands, simulate_scan
from smplxpp.raster.soft_light import Environment, LightConfig, vertex_light
from smplxpp.synth.checks import scan_checks, take_checks
from smplxpp.synth.config import SynthConfig, motion_kind, split_frames
from smplxpp.synth.simulate import Take, simulate
from smplxpp.synth.tracker import INPUTS, protocols, tracker_noise, write_estimated_labels, write_tracked_keypoints
from smplxpp.synth.views import Atlas, LitFrame, RenderedView, hidden_faces, normal_map, paint_atlas, render_view


def make_capture(
    out: Path,
    topology_file: Path,
    config: SynthConfig,
    *,
    environment: Environment | None = None,
    progress: ProgressCallback = ignore_progress,
) -> dict[str, float]:
    """Write a capture to the folder `out`, whole or not at all; an older capture there is replaced.

    Args:
        out: folder of the capture.
        topology_file: the person's layers, `geometry/topology.npz` of the fixture.
        config: settings.
        environment: light that replaces the stage's, for the same performance; None: the stage's.
        progress: called with the name of the current work and the share of it that is done.

    Returns:
        Figures about the capture, as in `checks.json`.

    Raises:
        InputError: the file of layers is missing or another person's.
    """
    # Dress the person and simulate her performance.
    layers = read_layers(topology_file, config.clothes, config.skirt_length)
    if config.outside:
        layers = with_offsets(layers, load_body(), Outside(noise=config.outside), seed=config.seed + 5)
    person = replace(person_of(layers, config.clothes, config.skirt_length), skirt_pattern=config.skirt_pattern)
    motion = motion_kind(config.motion).make(
        betas=person.betas,
        expression_names=person.body.expression_names,
        seconds=(config.frames - 1) / config.fps,
        seed=config.seed,
    )
    simulation = replace(config.simulation, fps=config.fps)
    take = simulate(person, motion, config.frames, simulation, lambda share: progress("cloth", share))
    take = replace(take, vertices=rounded(take.vertices))
    # Cameras that see all of it, and the parameters that a tracker would give.
    rig = _rig(person, take, config)
    noisy = tracker_noise(take.params, seed=config.seed + 3)
    checks = take_checks(person, take, noisy)
    with atomic_folder(out) as root:
        if config.layout == "actorshq":
            sequence = root / "Actor01" / "Sequence1"
            # The name under which fitted parameters lie beside ActorsHQ's scales.
            images, params = sequence / "1x", sequence / "smpl_params.npz"
            boxes = np.stack([take.vertices.min(axis=1), take.vertices.max(axis=1)], axis=1)
            write_actorshq_scene(sequence, boxes, config.fps)
        else:
            images, params = root, root / "params" / "params.npz"
        write_calibration_csv(images / "calibration.csv", rig)
        take.params.save(params)
        noisy.save(params.with_stem(f"{params.stem}_noisy"))
        # Skin under clothes is left out of images, and painted no cells in the atlas.
        hidden = hidden_faces(person, take.vertices[0])
        painted = (person, _atlas(person, hidden, config.texel, progress))
        if config.layout == "simple":
            write_cameras_json(root / "cameras.json", rig)
            _write_geometry(root / "geometry", layers, take, hidden, config)
            if config.scan_faces:
                progress("scan", 0.0)
                checks |= _write_scan(root / "scans", person, take, config)
                progress("scan", 1.0)
            manifest = _manifest(out, rig, config, environment)
            atomic_write_text(root / "manifest.json", json.dumps(manifest, indent=1) + "\n")
            atomic_write_text(root / "README.md", _readme(manifest, config))
        _write_views(
            images, _lit_frames(person, take, hidden, config.light, environment), painted, rig, config, progress
        )
        if config.layout == "simple":
            checks |= add_tracked_inputs(root, seed=config.seed, progress=progress)
            atomic_write_text(root / "checks.json", json.dumps(checks, indent=1) + "\n")
    return checks


def add_tracked_inputs(root: Path, *, seed: int, progress: ProgressCallback = ignore_progress) -> dict[str, float]:
    """Write a tracker's keypoints and a parser's label maps into a synthetic capture, from its own files.

    Args:
        root: folder of a capture that `make_capture` wrote in our layout; its manifest gets the protocols.
        seed: seed of the errors.
        progress: called with the name of the current work and the share of it that is done.

    Returns:
        The percentage of foreground pixels with a wrong label.
    """
    capture, body = open_capture(root, cache_bytes=0), load_body()
    params = {frame: found for frame in capture.frames if (found := capture.params(frame)) is not None}
    write_tracked_keypoints(root, capture, body, params, seed=seed, progress=lambda share: progress("keypoints", share))
    wrong = write_estimated_labels(root, capture, seed=seed, progress=lambda share: progress("labels", share))
    path = root / "manifest.json"
    manifest = read_json(path, subject="manifest") | {"protocols": protocols()}
    atomic_write_text(path, json.dumps(manifest, indent=1) + "\n")
    return {"labels_estimated_wrong_percent": 100 * wrong}


def _rig(person: Person, take: Take, config: SynthConfig) -> list[RigCamera]:
    hair = person.vertex_part == PART_NAMES.index("hair")
    rig = camera_rig(
        take.vertices[:, ::5].reshape(-1, 3),
        take.vertices[:, hair].reshape(-1, 3),
        count=config.cameras,
        size=config.size,
        seed=config.seed,
        aspect=config.aspect,
    )
    if config.layout == "simple":
        return rig
    # ActorsHQ numbers all its cameras alike.
    return [replace(item, camera=replace(item.camera, name=f"Cam{k + 1:03d}")) for k, item in enumerate(rig)]


def _atlas(person: Person, hidden: Bool[np.ndarray, " M"], texel: float, progress: ProgressCallback) -> Atlas | None:
    if not texel:
        return None
    progress("colours", 0.0)
    # Cells of the head are finer, because close-ups show it.
    atlas = paint_atlas(person, cell=texel, face_cell=0.45 * texel, shown=np.flatnonzero(~hidden))
    progress("colours", 1.0)
    return atlas


def _write_geometry(
    folder: Path, layers: dict[str, np.ndarray], take: Take, hidden: Bool[np.ndarray, " M"], config: SynthConfig
) -> None:
    arrays = layers | {"face_hidden": hidden, "pin": take.attachment.astype(np.float32)}
    save_compact(folder / "topology.npz", arrays)
    # The topology is the same in all frames; only vertices change.
    for frame in range(0, config.frames, config.truth_step):
        arrays = {"verts": take.vertices[frame].astype(np.float32)}
        save_compact(folder / f"frame_{frame:06d}.npz", arrays)


def _write_scan(folder: Path, person: Person, take: Take, config: SynthConfig) -> dict[str, float]:
    reference = TriangleMesh(take.vertices[0], person.tpose.faces)
    # Every part but the body is an open sheet.
    sheets = [person.face_part == part for part in range(1, len(PART_NAMES))]
    scan = simulate_scan(reference, sheets, ScanConfig(faces=config.scan_faces, seed=config.seed + 3))
    part, label, colors = _scan_attributes(person, scan)
    write_ply(folder / "scan_000000.ply", scan.mesh, vertex_colors=colors)
    save_compact(folder / "scan_000000_labels.npz", {"label": label, "part": part})
    return scan_checks(reference, scan)


def _scan_attributes(
    person: Person, scan: SimulatedScan
) -> tuple[UInt8[np.ndarray, " N"], UInt8[np.ndarray, " N"], UInt8[np.ndarray, "N 3"]]:
    """Return part, label and colour of each vertex of the scan, from the point of the layers that it shows."""
    corners = person.tpose.faces[scan.face]
    rest = scan.shown_on(person.tpose)
    nearest = corners[np.arange(len(corners)), np.argmax(scan.barycentric, axis=1)]
    shown, label = person.face_part[scan.face], person.vertex_label[nearest]
    colors = person.colors(rest, shown, label)
    part = merge_islands(scan.mesh, shown)
    return part, np.where(part == shown, label, PART_LABELS[part]), colors


def _lit_frames(
    person: Person, take: Take, hidden: Bool[np.ndarray, " M"], light: LightConfig, environment: Environment | None
) -> Iterator[LitFrame]:
    """Yield the lit frames of a take in order, without the hidden faces."""
    shown = np.flatnonzero(~hidden)
    faces = person.tpose.faces[shown]
    for vertices in take.vertices:
        mesh = TriangleMesh(vertices, faces)
        other = None if environment is None else environment.at(mesh, light)
        yield LitFrame(mesh, shown, vertex_light(mesh, light), other)


def _write_views(
    root: Path,
    lit_frames: Iterable[LitFrame],
    painted: tuple[Person, Atlas | None],
    rig: list[RigCamera],
    config: SynthConfig,
    progress: ProgressCallback,
) -> None:
    """Render every frame through every camera and write the files."""
    person, atlas = painted
    for frame, lit in enumerate(lit_frames):
        # Cameras of a frame are rendered in parallel; the next frame is lit after them.
        def one(item: RigCamera, lit: LitFrame = lit, frame: int = frame) -> None:
            view = render_view(person, lit, item.camera, supersampling=config.supersampling, atlas=atlas)
            _write_view(root, item.camera.name, frame, view, config)
            if config.layout == "simple" and frame % config.normals_step == 0:
                path = view_path(root, "normal", item.camera.name, frame, ".png")
                write_normal_png(path, normal_map(lit, item.camera))

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(one, rig))
        progress("views", (frame + 1) / config.frames)


def _write_view(root: Path, camera: str, frame: int, view: RenderedView, config: SynthConfig) -> None:
    write_jpeg(view_path(root, "image", camera, frame, ".jpg"), view.image, quality=config.quality)
    write_gray_png(view_path(root, "mask", camera, frame, ".png"), view.mask)
    if config.layout == "simple":
        write_gray_png(view_path(root, "label", camera, frame, ".png"), view.labels)


def _manifest(out: Path, rig: list[RigCamera], config: SynthConfig, environment: Environment | None) -> dict:
    kind = motion_kind(config.motion).kind if len(rig) == 1 else None
    train, novel = split_frames(config.frames) if kind is None else (config.frames, 0)
    everything, normals = list(range(config.frames)), list(range(0, config.frames, config.normals_step))
    names = [item.camera.name for item in rig]
    # Held-out frames follow the training frames; short captures have none.
    splits = {"train_frames": [0, train - 1]} | ({"novel_pose_frames": [train, config.frames - 1]} if novel else {})
    light = {}
    if environment is not None:
        light = {"light": {"panorama": environment.name, "turn": environment.turn, "exposure": environment.exposure}}
    return {
        "name": out.name,
        "frames": config.frames,
        "fps": config.fps,
        "seed": config.seed,
        "background": [0, 0, 0],
        "label_set": "capture",
        **({} if kind is None else {"kind": kind}),
        "inputs": INPUTS,
        **light,
        **splits,
        "train_views": [item.camera.name for item in rig if not item.novel],
        "novel_views": [item.camera.name for item in rig if item.novel],
        "truth_frames": list(range(0, config.frames, config.truth_step)),
        **{kind: dict.fromkeys(names, everything) for kind in ("images", "masks", "labels")},
        "normals": dict.fromkeys(names, normals),
    }


_TEXT = """# {name}

A synthetic capture by `smplxpp synth`: motion `{motion}`, {frames} frames at {fps:g} a second, {cameras} cameras, seed
{seed}; {worn}; light: {light}. Axes: y up, z to the front, x to the subject's left; metres; floor y = 0. Frame 0 is the
reference: a relaxed A-pose, neutral face, cloth settled.

{split} The held-out cameras are named in `manifest.json`.

| path | content | frames |
|---|---|---|
| `rgbs/CAM/` | sRGB JPEG on black, colour times opacity | all |
| `masks/CAM/` | opacity, 8 bits | all |
| `labels/CAM/` | 0 background, 1 skin, 2 hair, 3 shoes, 4 upper, 5 lower, 6 other | all |
| `normals/CAM/` | 16-bit RGB, n = value / 65535 * 2 - 1, world axes, towards the camera | {normals} |
| `geometry/frame_FFFFFF.npz` | `verts` of `topology.npz`: the true surface, rounded to 2^-14 m | {truth} |
| `params/params.npz` | body parameters, a row a frame: exact | all |
| `params/params_noisy.npz` | as a tracker would give them | all |
| `keypoints/`, `labels_estimated/` | as a detector and a parser would give them | all |
{scan}
`manifest.json` has the splits and the protocols `exact` and `tracked`, `checks.json` figures measured at its making.
"""
_WORN = {
    "skirt": "she wears a striped half-loose shirt and a loose skirt{reach} (pattern: {pattern}), both simulated",
    "trousers": "she wears a striped half-loose shirt, simulated, over tight trousers that follow the skin",
}


def _readme(manifest: dict, config: SynthConfig) -> str:
    """Return the README of a capture with the given manifest."""
    train, novel = manifest["train_frames"], manifest.get("novel_pose_frames")
    split = f"Frames {train[0]} to {train[1]} are for training"
    split += f", {novel[0]} to {novel[1]} are held out as new poses." if novel else ", none is held out."

    def listed(frames: list[int]) -> str:
        # Frames are at an even step: all, the first three of them, or one.
        step = frames[1] - frames[0] if len(frames) > 1 else 0
        return "all" if step == 1 else f"{', '.join(map(str, frames[:3]))} ..." if step else str(frames[0])

    return _TEXT.format(
        name=manifest["name"],
        motion=config.motion,
        frames=manifest["frames"],
        fps=manifest["fps"],
        seed=manifest["seed"],
        cameras=len(manifest["images"]),
        light=manifest["light"]["panorama"] if "light" in manifest else "even, brighter from above",
        worn=_WORN[config.clothes].format(
            pattern=config.skirt_pattern, reach=" to the calves" if config.skirt_length == "calf" else ""
        ),
        split=split,
        normals=listed(next(iter(manifest["normals"].values()))),
        truth=listed(manifest["truth_frames"]),
        scan="| `scans/` | what a reconstruction of frame 0 would give, its labels | 0 |\n"
        if config.scan_faces
        else "",
    )
