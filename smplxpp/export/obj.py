"""A template as a Wavefront OBJ file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smplxpp.core.files.atomic import atomic_write_bytes, atomic_write_text
from smplxpp.template.template import Template
from smplxpp.template.texture import picture_files


def write_obj(path: str | Path, template: Template) -> None:
    """Write the T-pose as an OBJ file with a group a part, whole or not at all.

    Colours follow the coordinates (`v x y z r g b`), sRGB in [0, 1], as MeshLab and Blender read them. Vertices keep
    the template's order, in metres to a tenth of a micrometre, each with its normal, without which programs show every
    face flat; indices count from 1 through all groups. A texture has its coordinates as `vt`, and a material a picture
    in an MTL file beside; the pictures lie there, too.

    Args:
        path: of the file.
        template: body and parts.
    """
    path, texture = Path(path), template.texture
    rows = np.hstack([template.vertices, template.vertex_colors / 255.0])
    text = [_lines("v %.7f %.7f %.7f %.4f %.4f %.4f\n", rows)]
    text.append(_lines("vn %.4f %.4f %.4f\n", template.mesh.vertex_normals))
    if texture is not None:
        # Pictures and materials first, so that no OBJ names files that are not there.
        files = picture_files(texture, path.stem)
        for name, data in files.items():
            atomic_write_bytes(path.parent / name, data)
        atomic_write_text(path.with_suffix(".mtl"), _materials(list(files), len(texture.colors)))
        # OBJ's pictures begin at the lower left corner.
        text = [f"mtllib {path.stem}.mtl\n", *text, _lines("vt %.6f %.6f\n", texture.uv * [1, -1] + [0, 1])]
    for index, name in enumerate(template.part_names):
        chosen = template.part_faces(name)
        faces = template.faces[chosen] + 1
        if texture is None:
            corners = faces.repeat(2, axis=1)
            text += [f"g {name}\n", _lines("f %d//%d %d//%d %d//%d\n", corners)]
        else:
            corners = np.stack([faces, texture.face_uv[chosen] + 1, faces], axis=2).reshape(-1, 9)
            text.append(f"g {name}\nusemtl picture_{texture.picture[index]}\n")
            text.append(_lines("f %d/%d/%d %d/%d/%d %d/%d/%d\n", corners))
    atomic_write_text(path, "".join(text))


def _materials(files: list[str], count: int) -> str:
    """The MTL of `count` pictures of colours and, behind them, of normals if there are any."""
    out = []
    for k, color in enumerate(files[:count]):
        out += [f"newmtl picture_{k}", "Kd 1 1 1", "Ks 0 0 0", f"map_Kd {color}"]
        out += [f"norm {name}" for name in files[count + k : count + k + 1]]
    return "\n".join(out) + "\n"


def _lines(pattern: str, rows: np.ndarray) -> str:
    """One line a row of (N, D); all in one formatting, several times as fast as `np.savetxt`."""
    return pattern * len(rows) % tuple(rows.ravel().tolist())
