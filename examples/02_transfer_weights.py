"""Skin weights from the body to a skirt, by three settings, against the weights that its author gave it."""

import argparse
import tempfile
from pathlib import Path

import numpy as np

import smplxpp
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core.mesh_files.mesh_io import write_ply
from smplxpp.metrics import stretch_report, weight_report
from smplxpp.skinning import pose, unpose

PERSON = Path(__file__).parents[1] / "data" / "fixtures" / "person"
SETTINGS = {
    "as published": smplxpp.TransferConfig.paper(),
    "default": smplxpp.TransferConfig(),
    "default for lower clothes": smplxpp.TransferConfig.for_label("lower"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    out = parser.parse_args().out or Path(tempfile.mkdtemp(prefix="smplxpp_"))
    out.mkdir(parents=True, exist_ok=True)
    body = smplxpp.load_body()
    params = smplxpp.load_params(PERSON / "params" / "params.npz").frame(0)
    posed = body.forward(params).frame(0)
    cut, authored = read_layer("lower")
    # As it was cut, skinned to the reference pose: the authored weights are exact for it.
    skirt = cut.with_vertices(pose(cut.vertices, authored, posed.posed_from_rest))

    driven = body.forward(stress_poses(params)).posed_from_rest[list(STRESS_POSES).index("high_step")]
    truth = pose(cut.vertices, authored, driven)
    for name, config in SETTINGS.items():
        weights = smplxpp.transfer_weights(body.mesh(posed.vertices), body.weights, skirt, config=config)
        rest = unpose(skirt.vertices, weights, posed.posed_from_rest).vertices
        moved = pose(rest, weights, driven)
        error = np.linalg.norm(moved - truth, axis=1) * 1e3
        stretch = stretch_report(skirt.with_vertices(rest), skirt.with_vertices(moved)).p999
        variation = weight_report(weights, reference=authored).reference.mean
        print(f"{name:25} matched {weights.matched.mean():.0%}, total variation {variation:.3f}; high step:")
        print(f"  {error.mean():.1f} mm off, p95 {np.percentile(error, 95):.1f}, edges x{stretch:.1f} (p99.9)")
        write_ply(out / f"{name.replace(' ', '_')}.ply", skirt.with_vertices(moved))
    print(f"written {out}/*.ply, the skirt in the high step")


def read_layer(name: str) -> tuple[smplxpp.TriangleMesh, np.ndarray]:
    """A true layer of the fixture in the T-pose, and its authored weights (N, 55)."""
    topology = np.load(PERSON / "geometry" / "topology.npz")
    part = topology["part_names"].tolist().index(name)
    mesh, used = smplxpp.TriangleMesh(topology["v_tpose"], topology["faces"]).submesh(topology["face_part"] == part)
    weights = topology["weights"][used].astype(np.float64)
    return mesh, weights / weights.sum(axis=1, keepdims=True)


if __name__ == "__main__":
    main()
