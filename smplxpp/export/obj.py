"""A template as a Wavefront OBJ file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.template.template import Template


def write_obj(path: str | Path, template: Template) -> None:
    """Write the T-pose as an OBJ file with a group a part, whole or not at all.

    Colours follow the coordinates (`v x y z r g b`), sRGB in [0, 1], as MeshLab and Blender read them. Vertices keep
    the template's order, in metres to a tenth of a micrometre; indices count from 1 through all groups.

    Args:
        path: of the file.
        template: body and parts.
    """
    rows = np.hstack([template.vertices, template.vertex_colors / 255.0])
    text = [_lines("v %.7f %.7f %.7f %.4f %.4f %.4f\n", rows)]
    for name in template.part_names:
        text += [f"g {name}\n", _lines("f %d %d %d\n", template.faces[template.part_faces(name)] + 1)]
    atomic_write_text(path, "".join(text))


def _lines(pattern: str, rows: np.ndarray) -> str:
    """One line a row of (N, D); all in one formatting, several times as fast as `np.savetxt`."""
    return pattern * len(rows) % tuple(rows.ravel().tolist())
