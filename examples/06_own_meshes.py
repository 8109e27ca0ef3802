"""Skin weights from any body to any garment, in any unit, as any program reads them; main() is all that it takes.

    python examples/06_own_meshes.py body.ply weights.npz garment.obj --unit cm

Weights are `.npz` or `.json` of `SkinWeights.save`; `SkinWeights.from_dense` makes them of a table (V, J). Without
files it writes a body, its weights and a skirt in centimetres and takes these.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import trimesh

import smplxpp
from smplxpp.metrics import weight_report


def main(body: Path, weights: Path, garment: Path, unit: str, out: Path) -> None:
    source = smplxpp.as_mesh(trimesh.load(body, process=False), unit=unit)
    target = smplxpp.as_mesh(trimesh.load(garment, process=False), unit=unit)
    given, names = smplxpp.SkinWeights.load(weights)
    found = smplxpp.transfer_weights(source, given, target)
    report = weight_report(found, edges=target.edges)
    print(f"{found}: valid {report.valid}, {found.matched.mean():.0%} on the skin, largest step {report.edges.max:.2f}")
    found.pruned(4).save(out / "garment_weights.json", joint_names=names)


def own_files(folder: Path) -> tuple[Path, Path, Path]:
    """The open body in the T-pose, its weights, and the fixture's skirt, as another program would write them."""
    body = smplxpp.load_body()
    person = Path(__file__).parents[1] / "data" / "fixtures" / "person" / "geometry"
    topology = np.load(person / "topology.npz")
    layers = smplxpp.TriangleMesh(topology["v_tpose"], topology["faces"])
    files = folder / "body.ply", folder / "weights.npz", folder / "skirt.obj"
    for kind, path in (("body", files[0]), ("lower", files[2])):
        layer, used = layers.submesh(topology["face_part"] == topology["part_names"].tolist().index(kind))
        layer.with_vertices(100.0 * layer.vertices).to_trimesh().export(path)
        if kind == "body":
            weights = smplxpp.SkinWeights.from_dense(topology["weights"][used])
            weights.save(files[1], joint_names=body.joint_names)
    return files


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=Path, nargs="*", help="body, weights, garment")
    parser.add_argument("--unit", default="cm", help="of both meshes")
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    given = parser.parse_args()
    folder = given.out or Path(tempfile.mkdtemp(prefix="smplxpp_"))
    folder.mkdir(parents=True, exist_ok=True)
    main(*(given.files or own_files(folder)), unit=given.unit, out=folder)
    print(f"written {folder}/garment_weights.json")
