"""A template as a Wavefront OBJ file."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.template import Template


def write_obj(path: str | Path, template: Template) -> None:
    """Write the T-pose as an OBJ file with a group a part, whole or not at all.

    Colours follow the coordinates (`v x y z r g b`), sRGB in [0, 1], as MeshLab and Blender read them. Vertices keep
    the template's order, in metres to a tenth of a micrometre; indices count from 1 through all groups.

    Args:
        path: of the file.
        template: body and parts.
    """
    buffer = io.BytesIO()
    rows = np.hstack([template.vertices, template.vertex_colors / 255.0])
    np.savetxt(buffer, rows, fmt="v %.7f %.7f %.7f %.4f %.4f %.4f")
    for name in template.part_names:
        buffer.write(f"g {name}\n".encode())
        np.savetxt(buffer, template.faces[template.part_faces(name)] + 1, fmt="f %d %d %d")
    atomic_write_bytes(path, buffer.getvalue())
