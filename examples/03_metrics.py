"""Distances between two surfaces, by several definitions, and the other measures of a template's geometry."""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from smplxpp import TriangleMesh, metrics, read_mesh
from smplxpp.segment import map_labels

PERSON = Path(__file__).parents[1] / "data" / "fixtures" / "person"
SAMPLES = 20_000  # the default is 100,000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    out = parser.parse_args().out or Path(tempfile.mkdtemp(prefix="smplxpp_"))
    out.mkdir(parents=True, exist_ok=True)

    # The person's true layers, naked body within, against a scan of their outside.
    topology = np.load(PERSON / "geometry" / "topology.npz")
    layers = TriangleMesh(np.load(PERSON / "geometry" / "frame_000000.npz")["verts"], topology["faces"])
    labels = map_labels(topology["vertex_label"], "capture")
    scan = read_mesh(PERSON / "scans" / "scan_000000.ply").mesh

    visible = metrics.CompareConfig(visible_only=True)
    for name, config in (("whole meshes", None), ("visible surface", visible)):
        result = metrics.compare(layers, scan, pred_labels=labels, samples=SAMPLES, config=config)
        print(
            f"{name:16} P2S {result.p2s:.3f}, Chamfer {result.chamfer:.3f}, Hausdorff {result.hausdorff:.1f} mm, "
            f"F(5 mm) {result.fscore:.3f}"
        )
    for label, part in result.labels.items():
        print(f"  {label:8} layers to scan {part.pred_to_gt.mean:.3f} mm, p95 {part.pred_to_gt.p95:.3f}")
    (out / "comparison.json").write_text(json.dumps(result.as_dict(), indent=1))

    print("the same two meshes by other papers' definitions:")
    for name in ("pifuhd-cm", "icon-cm", "occnet-l2", "pytorch3d"):
        result = metrics.compare(layers, scan, samples=SAMPLES, preset=name)
        print(f"  {name:10} P2S {result.p2s:.4g}, Chamfer {result.chamfer:.4g} {result.unit}")

    body, shirt = (layers.submesh(topology["face_part"] == k)[0] for k in (0, 1))
    quality = metrics.mesh_quality(shirt)
    print(
        f"shirt: manifold {quality.manifold}, {quality.border_loops} border loops, p95 aspect {quality.aspect_p95:.2f}"
    )
    print(f"shirt inside the body: {metrics.penetration(shirt, body).as_dict()}")
    rest = layers.with_vertices(topology["v_tpose"])
    stretch = metrics.stretch_report(rest, layers)
    print(f"T-pose to reference: edges stretch x{stretch.p99:.2f} (p99), {stretch.flipped_faces} faces turn over")
    weights = metrics.weight_report(topology["weights"], edges=layers.edges)
    print(f"weights: valid {weights.valid}, rows off 1 by {weights.row_sum_error:.0e}")
    print(f"written {out}/comparison.json")


if __name__ == "__main__":
    main()
