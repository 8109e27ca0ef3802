import json

import numpy as np
import pytest

from pipelines.cli import main
from pipelines.commands.params import ParamsConvert
from smplxpp.body import load_body, load_params, smpl_joints
from smplxpp.core import ARRAY_NAMES, BodyParams, InputError


@pytest.fixture
def amass_file(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "walk_poses.npz"
    np.savez(
        path, poses=rng.normal(size=(10, 156)), trans=rng.normal(size=(10, 3)), betas=np.ones(16), mocap_framerate=60
    )
    return path


def test_a_range_of_frames_is_converted(tmp_path, amass_file):
    out = tmp_path / "new" / "params.npz"
    summary = ParamsConvert(input=amass_file, out=out, frames="2:8:3", whose="body", up="y").run()
    assert (summary["layout"], summary["frames"], summary["fps"], summary["betas"]) == ("amass", 2, 20.0, 16)
    expected = load_params(amass_file, whose="body", up="y").select([2, 5])
    with np.load(out) as file:
        read = BodyParams.from_mapping(file)
    assert read.flat_hand_mean
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(read, name), getattr(expected, name))


def test_the_command_prints_json(tmp_path, amass_file, capsys):
    options = ["--out", str(tmp_path / "o.npz"), "--whose", "body", "--json"]
    assert main(["params", "convert", str(amass_file), *options]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 10


@pytest.mark.parametrize("frames", ["3", "a:b", "0:5:0", "1:2:3:4", "20:30"])
def test_bad_ranges_write_nothing(tmp_path, amass_file, frames):
    with pytest.raises(InputError, match="--frames"):
        ParamsConvert(input=amass_file, out=tmp_path / "o.npz", frames=frames, whose="body").run()
    with pytest.raises(InputError, match="--out"):
        ParamsConvert(input=amass_file, out=tmp_path / "o.pkl").run()
    assert not list(tmp_path.glob("o.*"))


def test_smpls_joints_are_written_beside(tmp_path, amass_file):
    out = tmp_path / "joints.npz"
    ParamsConvert(input=amass_file, out=tmp_path / "o.npz", frames="0:2", whose="body", joints=out).run()
    expected = smpl_joints(load_body(), load_params(tmp_path / "o.npz"))
    with np.load(out) as file:
        np.testing.assert_array_equal(file["joints"], expected)
        assert file["joint_names"][1] == "left_hip" and file["joints"].shape == (2, 22, 3)
    with pytest.raises(InputError, match="--joints"):
        ParamsConvert(input=amass_file, out=tmp_path / "o.npz", whose="body", joints=tmp_path / "j.csv").run()
