"""A scan without a unit gets the stature that its user states, in whatever pose the person stands."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import smplxpp
from pipelines.runs.artefacts import load_located, save_located
from pipelines.runs.layout import LOCATE_STAGE
from pipelines.stages import template_stages
from pipelines.stages.build_config import BuildContext
from smplxpp.build import locate
from smplxpp.build.config import BuildConfig
from smplxpp.build.data import LocatedInScan
from smplxpp.build.inputs import plan_build
from smplxpp.build.request import BuildRequest
from smplxpp.core import BodyParams, InputError, StageOutput, TriangleMesh

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
BOX = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


@pytest.fixture(scope="module")
def body() -> smplxpp.BodyModel:
    return smplxpp.load_body()


def tall(body: smplxpp.BodyModel, height: float) -> BodyParams:
    """A body of that stature, by the direction of the shape that changes it most."""
    at = [locate.stature(body, BodyParams.rest(betas=np.eye(20)[0] * beta)) for beta in (0.0, 1.0)]
    return BodyParams.rest(betas=np.eye(20)[0] * (height - at[0]) / (at[1] - at[0]))


def test_the_stature_is_the_bodys_and_not_the_scans_extent(body, monkeypatch):
    """With raised hands the extent is 1.25 statures: the scan has to grow by that, and landmarks with it."""
    seen: list[float] = []

    def found(scan, body, landmarks, detector, start):
        extent = float(np.ptp(scan.clean.mesh.vertices[:, 1]))
        seen.append(float(landmarks["nose"][1]) / extent)
        # A shape prior draws the stature by a third towards the mean's.
        mean = locate.stature(body, BodyParams.rest())
        shown = mean + 0.7 * (extent / 1.25 - mean)
        return LocatedInScan(tall(body, shown), np.zeros(4, int), np.zeros(4, bool)), StageOutput([], {})

    monkeypatch.setattr(locate, "_located", found)
    scan = smplxpp.read_scan(TriangleMesh(BOX[0] * 7.0, BOX[1]), height=1.75)
    assert np.ptp(scan.clean.mesh.vertices[:, 1]) == pytest.approx(1.75) and scan.units == "250 mm"
    located, output = locate.locate_in_scan(scan, body, landmarks={"nose": [0.0, 1.6, 0.0]}, height=1.75)
    scaled = scan.scaled(located.scale)
    assert np.ptp(scaled.clean.mesh.vertices[:, 1]) / 1.25 == pytest.approx(1.75, rel=0.02)
    assert output.numbers["stature"] == pytest.approx(1.75, rel=0.01)
    assert output.numbers["scale"] == located.scale > 1.15
    assert np.ptp(seen) < 1e-9 and len(seen) <= 4
    assert scan.scaled(1.0) is scan


def test_a_height_beside_what_states_the_size_is_refused():
    config = BuildConfig(height=1.75)
    with pytest.raises(InputError, match=r"option height.*a capture"):
        plan_build(BuildRequest(capture=FIXTURE, config=config))
    scan = FIXTURE / "scans" / "scan_000000.ply"
    with pytest.raises(InputError, match=r"option height.*parameters"):
        plan_build(BuildRequest(scan=scan, params=FIXTURE / "params" / "params.npz", config=config))
    assert plan_build(BuildRequest(scan=scan, config=config)).config.height == 1.75
    for wrong in (BuildConfig, lambda **options: smplxpp.read_scan(scan, **options)):
        with pytest.raises(InputError, match=r"1\.75 is one metre"):
            wrong(height=175.0)


def test_gltf_is_in_metres_unless_nobody_is_that_high(tmp_path, body):
    """A kneeling person of 1.1 m in a GLB is not asked about, because the format states its unit."""
    from smplxpp.core.mesh_files.mesh_io import write_ply

    rest = body.mesh()
    low = TriangleMesh(rest.vertices * 0.62, rest.faces)
    write_ply(tmp_path / "low.ply", low)
    with pytest.raises(InputError, match=r"scan low.ply: size.*--height"):
        smplxpp.read_scan(tmp_path / "low.ply", units="auto", up="y")
    for name, mesh, units in (("low", low, "m"), ("cm", TriangleMesh(rest.vertices * 100, rest.faces), "cm")):
        _write_glb(tmp_path / f"{name}.glb", mesh)
        assert smplxpp.read_scan(tmp_path / f"{name}.glb", units="auto", up="y").units == units


def _write_glb(path: Path, mesh: TriangleMesh) -> None:
    trimesh = pytest.importorskip("trimesh")
    path.write_bytes(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="glb"))


def test_a_run_scales_the_scan_as_its_search_did(tmp_path, body):
    """The stage that prepares the scan takes the scale from the files of the stage that found the body."""
    scan = tmp_path / "scan.npz"
    np.savez(scan, vertices=body.v_template * 7.0, faces=body.faces)
    run, out = tmp_path / "run", tmp_path / "out"
    (run / LOCATE_STAGE).mkdir(parents=True)
    out.mkdir()
    count = body.vertex_count
    found = LocatedInScan(BodyParams.rest(), np.zeros(count, int), np.zeros(count, bool), 1.1)
    save_located(run / LOCATE_STAGE, found)
    assert load_located(run / LOCATE_STAGE).params.betas.shape == (1, 10)
    plan = plan_build(BuildRequest(scan=scan, config=BuildConfig(height=1.75, up="y")))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", smplxpp.GeometryWarning)  # the body's mesh has open borders
        template_stages.capture(out, BuildContext(run, plan.inputs, plan.config))
    with np.load(out / "scan.npz") as arrays:
        vertices = arrays["scan/vertices"] if "scan/vertices" in arrays else arrays[arrays.files[0]]
    assert np.ptp(vertices[:, 1]) == pytest.approx(1.1 * 1.75, rel=1e-3)
