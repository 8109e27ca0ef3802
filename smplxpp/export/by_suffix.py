"""Export a template in the format that a path's suffix names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from smplxpp.core import BodyParams, InputError
from smplxpp.export.gltf import write_glb
from smplxpp.export.obj import write_obj
from smplxpp.export.usd import write_usd
from smplxpp.template.template import Template

_USD = (".usd", ".usda", ".usdc", ".usdz")
SUFFIXES = (".glb", *_USD, ".obj", ".npz")


def export_template(path: str | Path, template: Template, *, animation: BodyParams | None = None) -> Path:
    """Write a template as GLB, USD, OBJ or npz, by the suffix of the path; see `Template.export`.

    Args:
        path: of the file.
        template: body and parts in the T-pose.
        animation: T frames; OBJ takes one, npz none.

    Returns:
        The path.

    Raises:
        InputError: another suffix, or frames that the format cannot hold.
        MissingExtraError: USD without usd-core.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError("export path", expected=f"a suffix of {', '.join(SUFFIXES)}", received=path.name)
    # A file without motion holds the T-pose (npz), or one pose (OBJ).
    frames, most = 0 if animation is None else len(animation), {".npz": 0, ".obj": 1}.get(suffix)
    if most is not None and frames > most:
        raise InputError(
            "animation",
            expected=f"at most {most} frames in a file {suffix}",
            received=f"{frames} frames",
            remedy="export a motion as .glb or .usdc",
        )
    # A motion places the person by itself; in the T-pose she stands on the floor. Our own files keep the body's frame.
    if animation is None and suffix != ".npz":
        template = template.on_floor()
    if suffix == ".glb":
        write_glb(path, template, animation=animation)
    elif suffix in _USD:
        write_usd(path, template, animation=animation)
    elif suffix == ".obj":
        # OBJ has no skeleton, so that the one pose is baked into the vertices.
        posed = template if animation is None else replace(template, vertices=template.pose(animation)[0])
        write_obj(path, posed)
    else:
        template.save(path)
    return path
