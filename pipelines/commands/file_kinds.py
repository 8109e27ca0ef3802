"""Say what a file or a folder is, by its content."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from pipelines.report.model import Step
from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.json_file import as_object, read_json
from smplxpp.core.files.paths import read_bytes


def print_kind(path: Path, *, console: Console | None) -> dict[str, Any]:
    """Return `what_it_is` and print it, if there is a console."""
    found = what_it_is(path)
    if console is not None:
        console.print(Text(found["kind"], "bold") + Text(f"  {path}", "dim"), soft_wrap=True)
        for fact in found["facts"]:
            console.print(Text(fact), soft_wrap=True)
        for step in found["next"]:
            words = Text(f"   {step['purpose']}", "dim")
            console.print(Text("next    ") + Text(step["command"]) + words, soft_wrap=True)
    return found


def what_it_is(path: Path) -> dict[str, Any]:
    """Say what a file or a folder without a run is, by its content: `kind`, `facts` in words, `next` commands.

    Each reader is asked in turn; what none knows is known by its ending.

    Raises:
        InputError: a folder that is neither a run nor a capture.
    """
    here = shlex.quote(str(path))
    kinds: dict[str, tuple[Callable[[Path], list[str]], tuple[Step, ...]]] = {
        "avatar": (_avatar_facts, (Step("play it in the browser", f"smplxpp web {here} --serve"),)),
        "template": (_template_facts, (Step("test it", f"smplxpp check {here}"),)),
        "splats of a pose, for other programs": (_splat_facts, ()),
        "mesh": (
            _mesh_facts,
            (Step("test it", f"smplxpp check {here}"), Step("build on it", f"smplxpp build RUN --scan {here}")),
        ),
        "body parameters": (_params_facts, (Step("film them", f"smplxpp animate RUN --params {here} --out me.mp4"),)),
        "picture": (_picture_facts, ()),
        "JSON": (_json_facts, ()),
    }
    if path.is_dir():
        kinds = {"capture": (_capture_facts, (Step("build on it", f"smplxpp build RUN --capture {here}"),))}
    problem = None
    for kind, (read, steps) in kinds.items():
        try:
            facts = read(path)
        except (InputError, MissingExtraError) as error:
            # The reader that the name's ending asks for says what is wrong.
            if path.is_dir() or path.suffix.lower() in _ENDINGS.get(kind, ()):
                problem = error
            continue
        return {"path": str(path), "kind": kind, "facts": facts, "next": [step.__dict__ for step in steps]}
    if path.is_dir():
        raise InputError(
            "run folder",
            expected="a folder with stages or a metrics.json, or a capture",
            received=f"{path} with neither",
            remedy="make a run with `smplxpp build RUN --capture DIR`",
        )
    kind = _OTHERS.get(path.suffix.lower(), "nothing that is known here")
    facts = [shown_bytes(path.stat().st_size), *([] if problem is None else [f"damaged: {problem}"])]
    return {"path": str(path), "kind": kind, "facts": facts, "next": []}


_ENDINGS = {
    "avatar": (".avatar",),
    "mesh": (".ply", ".obj", ".glb", ".gltf", ".stl", ".off", ".fbx"),
    "picture": (".png", ".jpg", ".jpeg", ".webp"),
    "JSON": (".json",),
}
_OTHERS = {
    ".mp4": "film",
    ".html": "page, for a browser",
    ".safetensors": "weights of a model or Gaussians: a stage of a run holds them",
    **dict.fromkeys((".spz", ".sog"), "splats of a pose, for other programs"),
    ".onnx": "step from pose to splats, for other programs",
    ".usdc": "scene, for other programs",
    **dict.fromkeys((".bvh", ".vrma"), "motion of a skeleton: give it to `smplxpp animate RUN --params`"),
    ".wav": "sound",
}
"""What is known by its ending alone."""


def _avatar_facts(path: Path) -> list[str]:
    from avatar.runtime import load_bundle

    bundle = load_bundle(path)
    return [f"{bundle.sizes['N']:,} Gaussians on {bundle.sizes['F']:,} faces, {shown_bytes(path.stat().st_size)}"]


def _template_facts(path: Path) -> list[str]:
    from smplxpp.template.template import Template

    template = Template.load(path)
    parts = ", ".join(f"{name} {int(template.part_faces(name).sum()):,}" for name in template.part_names)
    return [f"{len(template.vertices):,} vertices, {len(template.faces):,} faces", f"parts by faces: {parts}"]


def _splat_facts(path: Path) -> list[str]:
    # The header of a PLY names their colours, the JSON of a glTF file its extension; 64 kB hold both.
    head = read_bytes(path)[: 1 << 16] if path.suffix.lower() in (".ply", ".glb") else b""
    if not (head.startswith(b"ply") and b" f_dc_0" in head) and b"KHR_gaussian_splatting" not in head:
        raise InputError(f"splats {path}", expected="a PLY or GLB of Gaussians", received="another file")
    return [f"Gaussians without a surface, {shown_bytes(path.stat().st_size)}"]


def _mesh_facts(path: Path) -> list[str]:
    from smplxpp.core.mesh_files.mesh_io import read_mesh

    file = read_mesh(path)
    size = " x ".join(f"{side:.4g}" for side in np.ptp(file.mesh.vertices, axis=0))
    facts = "coloured" if file.vertex_colors is not None else "no colours"
    facts += f", {len(file.rig.names)} joints" if file.rig is not None else ""
    counts = f"{file.mesh.vertex_count:,} vertices, {file.mesh.face_count:,} faces"
    return [f"{counts}, {facts}", f"{size} along x, y and z, in the units of the file"]


def _params_facts(path: Path) -> list[str]:
    from smplxpp.body import load_params

    params = load_params(path)
    rate = f" at {params.fps:g} a second" if params.fps else ""
    betas, expressions = params.betas.shape[-1], params.expression.shape[-1]
    return [f"{len(params):,} frames{rate}", f"{betas} betas, {expressions} expressions"]


def _picture_facts(path: Path) -> list[str]:
    from smplxpp.core.files.image_file import image_size

    return ["{} x {} pixels".format(*image_size(path))]


def _json_facts(path: Path) -> list[str]:
    content = as_object(read_json(path), subject="JSON")
    return [f"keys: {', '.join(list(content)[:8])}{', ...' if len(content) > 8 else ''}"]


def _capture_facts(path: Path) -> list[str]:
    from smplxpp.capture import open_capture

    capture = open_capture(path)
    return [f"{len(capture.cameras)} cameras, {len(capture.frames)} frames, in the layout {capture.recording.format}"]


def shown_bytes(count: int) -> str:
    """Return a size in words.

    Example:
        >>> shown_bytes(2_500_000)
        '2.5 MB'
    """
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.1f} kB"
