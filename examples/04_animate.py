"""A template moves: an animated GLB, one pose as a mesh, and pictures of hard poses.

Without --template it makes one from layers that are in the T-pose already.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

import smplxpp
from smplxpp.assemble import CanonicalPart, assemble_template
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core.labels import LABEL_BY_NAME
from smplxpp.core.mesh_files.mesh_io import write_ply
from smplxpp.figures import VIEWS, encode_png, fit_cameras, render_shaded

PERSON = Path(__file__).parents[1] / "data" / "fixtures" / "person"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--template", type=Path, help="smplxpp.npz of a run")
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp(prefix="smplxpp_"))
    out.mkdir(parents=True, exist_ok=True)

    motion = smplxpp.load_params(PERSON / "params" / "params.npz")
    template = smplxpp.Template.load(options.template) if options.template else from_layers(motion.frame(0))
    smplxpp.write_glb(out / "motion.glb", template, animation=motion)
    print(f"motion.glb: {len(motion)} frames at {motion.fps:g} a second")

    poses = stress_poses(motion)  # the template has its own shape: betas in the parameters are not looked at
    vertices = template.pose(poses)  # (T, V, 3)
    write_ply(out / "squat.ply", template.mesh.with_vertices(vertices[0]), vertex_colors=template.vertex_colors)
    cameras = fit_cameras(vertices.reshape(-1, 3), directions=[VIEWS["three-quarter"]], height=480)
    for name, points in zip(STRESS_POSES, vertices, strict=True):
        picture = render_shaded(template.mesh.with_vertices(points), cameras[0], vertex_colors=template.vertex_colors)
        (out / f"{name}.png").write_bytes(encode_png(picture))
    print(f"written {out}/motion.glb, squat.ply, {', '.join(f'{name}.png' for name in STRESS_POSES)}")


def from_layers(params: smplxpp.BodyParams) -> smplxpp.Template:
    """A template of layers that already have a T-pose and weights, with no scan: here the skirt."""
    topology = np.load(PERSON / "geometry" / "topology.npz")
    chosen = topology["face_part"] == topology["part_names"].tolist().index("lower")
    mesh, used = smplxpp.TriangleMesh(topology["v_tpose"], topology["faces"]).submesh(chosen)
    weights = smplxpp.SkinWeights.from_dense(topology["weights"][used], max_influences=8)
    colors, source = np.full((len(used), 3), (150, 60, 60), np.uint8), np.full(len(used), -1)
    part = CanonicalPart(mesh, weights, LABEL_BY_NAME["lower"].id, colors, source)
    return assemble_template(smplxpp.load_body(), params, {"skirt": part})[0]


if __name__ == "__main__":
    main()
