"""A scan, a body fit and labels become a template, step by step: what `smplxpp build` does, in Python."""

import argparse
import tempfile
from pathlib import Path

import smplxpp
from smplxpp.assemble import CanonicalPart, assemble_template
from smplxpp.clean import PartsConfig, check_human_scale, clean_parts, sanitize
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.segment import read_labels, segment_scan
from smplxpp.skinning import unpose

PERSON = Path(__file__).parents[1] / "data" / "fixtures" / "person"
BUDGETS = {"upper": 4_000, "lower": 4_000, "hair": 1_500, "shoe": 1_500}  # faces; the defaults are larger and slower


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    out = parser.parse_args().out or Path(tempfile.mkdtemp(prefix="smplxpp_"))
    out.mkdir(parents=True, exist_ok=True)

    body = smplxpp.load_body()  # the open body; or load_body("SMPLX_NEUTRAL.npz")
    params = smplxpp.load_params(PERSON / "params" / "params.npz", body=body).frame(0)
    posed = body.forward(params).frame(0)

    raw = read_raw_mesh(PERSON / "scans" / "scan_000000.ply")  # metres, +Y up; else smplxpp.clean.convert_points
    clean = sanitize(raw.vertices, raw.faces)
    check_human_scale(clean.mesh.vertices)
    print(f"scan     {clean.mesh.face_count} faces; repairs: {clean.report}")

    # One label a vertex of the file, so they follow the vertices that the repair kept.
    counts = {"vertex_count": len(raw.vertices), "face_count": len(raw.faces)}
    labels = read_labels(PERSON / "scans" / "scan_000000_labels.npz", **counts, label_set="capture")
    segmented = segment_scan(clean.mesh, vertex_labels=labels[clean.source_vertex])
    colors = raw.vertex_colors[clean.source_vertex]
    budgets = PartsConfig(face_budgets=BUDGETS)
    pieces = clean_parts(clean.mesh, segmented.face_labels, config=budgets, vertex_colors=colors)

    parts = {}
    for name, piece in pieces.items():
        config = smplxpp.TransferConfig.for_label(name)
        weights = smplxpp.transfer_weights(body.mesh(posed.vertices), body.weights, piece.mesh, config=config)
        rest = unpose(piece.mesh.vertices, weights, posed.posed_from_rest)
        mesh, source = piece.mesh.with_vertices(rest.vertices), clean.source_vertex[piece.source_vertex]
        parts[name] = CanonicalPart(mesh, weights, piece.label, piece.vertex_colors, source)
        matched, error = weights.matched.mean(), rest.report.round_trip_max
        print(f"{name:8} {piece.mesh.face_count} faces, {matched:.0%} matched, round trip {error:.0e} m")

    template, report = assemble_template(body, params, parts)
    before, after = report.penetrating_before, report.penetrating_after
    print(f"template {template.vertex_count} vertices; {before} inside an inner layer before the repair, {after} after")
    template.save(out / "smplxpp.npz")
    smplxpp.write_glb(out / "template.glb", template)
    print(f"written {out}/smplxpp.npz, template.glb")


if __name__ == "__main__":
    main()
