"""`smplxpp animate`: films of a template that is the naked body itself."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from pipelines.commands.animate import Animate
from pipelines.runs.layout import TEMPLATE
from smplxpp.body import load_body
from smplxpp.core import BodyParams, InputError, MissingExtraError, SkinWeights
from smplxpp.template.template import Template
from tests.full_disk import file_size_limit

FRAMES = 4
LEFT_SHOULDER = 15  # index among the 21 joints of body_pose


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with a template: the open body without clothes, its left half red."""
    body = load_body()
    count = len(body.v_template)
    colors = np.where(body.v_template[:, :1] > 0, (255, 0, 0), (0, 0, 255)).astype(np.uint8)
    folder = tmp_path_factory.mktemp("runs") / "person"
    path = folder / TEMPLATE
    path.parent.mkdir(parents=True)
    Template(
        vertices=body.v_template,
        faces=body.faces,
        vertex_labels=np.zeros(count),
        vertex_part=np.zeros(count),
        part_names=("body",),
        vertex_colors=colors,
        weights=SkinWeights.from_dense(body.weights),
        body=replace(
            body,
            posedirs=None,
            left_hand_components=None,
            right_hand_components=None,
            left_hand_mean=None,
            right_hand_mean=None,
        ),
        betas=np.zeros(20),
        body_index=np.arange(count),
        scan_index=np.full(count, -1),
    ).save(path)
    return folder


def motion(expressions=10, fps=30.0):
    """The left arm goes up."""
    pose = np.zeros((FRAMES, 63))
    pose[:, 3 * LEFT_SHOULDER + 2] = np.linspace(0, 1.2, FRAMES)
    rest = BodyParams.rest(expressions=expressions).select([0] * FRAMES)
    return replace(rest, body_pose=pose, fps=fps)


@pytest.fixture
def params(tmp_path):
    path = tmp_path / "wave.npz"
    motion().save(path)
    return path


def test_a_folder_of_pictures_shows_the_arm_going_up(run, params, tmp_path):
    out = tmp_path / "frames"
    result = Animate(run, params, out, height=120, json=True).run()
    names = sorted(p.name for p in out.iterdir())
    assert names == [f"frame_{k:06d}.png" for k in range(FRAMES)] and result["frames"] == FRAMES
    pictures = [np.asarray(Image.open(out / name)) for name in names]
    assert len({p.shape for p in pictures}) == 1 and len(pictures[0]) == 120
    center = pictures[0].shape[1] // 2
    # The subject's left is on the right of a front view; the raised hand fills the upper right corner at the end.
    corner = np.s_[:25, center + 15 :]
    covered = [(p[corner] != 255).any(-1).sum() for p in pictures]
    assert covered[0] == 0 and covered[-1] > 10
    again = Animate(run, params, out, height=120, start=1, stop=3, json=True).run()
    assert again["frames"] == 2 and len(list(out.iterdir())) == 2


@pytest.mark.long
def test_views_and_colours(run, params, tmp_path):
    def first(name, **options):
        Animate(run, params, tmp_path / name, height=100, stop=1, json=True, **options).run()
        return np.asarray(Image.open(tmp_path / name / "frame_000000.png")).astype(int)

    def red_side(picture):
        red = np.flatnonzero((picture[..., 0] - picture[..., 2] > 60).any(axis=0))
        return np.sign(red.mean() - picture.shape[1] / 2)

    assert red_side(first("front")) == 1 and red_side(first("back", view="back")) == -1
    for colors in ("labels", "semantic", "weights", "none"):
        assert (first(colors, colors=colors) != 255).any()


def test_a_turntable_turns(run, params, tmp_path):
    Animate(run, params, tmp_path / "turn", view="turntable", height=80, json=True).run()
    pictures = [np.asarray(Image.open(p)).astype(int) for p in sorted((tmp_path / "turn").iterdir())]
    red = [(p[..., 0] - p[..., 2] > 60).sum() for p in pictures]
    assert red[1] > 4 * red[3]  # from the left the left half is seen, from the right hardly


def test_mp4(run, params, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "wave.mp4"
    result = Animate(run, params, out, fps=10, height=91, width=133, json=True).run()
    command = [ffmpeg.get_ffmpeg_exe(), "-i", str(out), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(command, capture_output=True, check=True)
    stream = next(line for line in decoded.stderr.decode().splitlines() if "Video:" in line)
    assert "h264" in stream and "yuv420p" in stream and "134x92" in stream and "10 fps" in stream
    assert len(decoded.stdout) == result["frames"] * 134 * 92 * 3 and result["frames"] == FRAMES
    assert {p.name for p in tmp_path.iterdir()} == {"wave.npz", "wave.mp4"}


def test_gif_has_the_time_of_the_parameters(run, tmp_path):
    motion(fps=10).save(tmp_path / "p.npz")
    result = Animate(run, tmp_path / "p.npz", tmp_path / "wave.gif", height=80, step=2, json=True).run()
    with Image.open(tmp_path / "wave.gif") as film:
        assert film.n_frames == 2 and film.info["duration"] == 200
    assert result["fps"] == 5


@pytest.mark.parametrize("name", ["wave.mp4", "wave.gif", "wave.glb", "pictures"])
def test_a_film_that_the_disk_does_not_take_is_no_film(name, run, params, tmp_path, capsys):
    if name.endswith(".mp4"):
        pytest.importorskip("imageio_ffmpeg")
    before = set(tmp_path.rglob("*"))
    with file_size_limit(1000):
        status = main(
            ["animate", str(run), "--params", str(params), "-o", str(tmp_path / name), "--height", "120", "--json"]
        )
    captured = capsys.readouterr()
    assert status == 2 and "File too large" in captured.err and "ulimit" in captured.err and name in captured.err
    assert json.loads(captured.out)["error"]["type"] == "OSError"
    assert set(tmp_path.rglob("*")) == before


def test_an_encoder_that_loses_frames_is_found_out(run, params, tmp_path, monkeypatch):
    """As one whose disk is full may do, and end with 0."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(ffmpeg, "count_frames_and_secs", lambda path: (FRAMES - 1, 0.0))
    with pytest.raises(OSError, match="whole film"):
        Animate(run, params, tmp_path / "wave.mp4", height=60, json=True).run()
    assert not (tmp_path / "wave.mp4").exists()


def test_mp4_without_its_extra(run, params, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError, match=r"extra video"):
        Animate(run, params, tmp_path / "wave.mp4", height=60, json=True).run()
    assert not (tmp_path / "wave.mp4").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"out": "film.avi"}, "output"),
        ({"start": 9}, "frames"),
        ({"step": 0}, "step"),
        ({"height": 3}, "height"),
        ({"width": 0}, "width"),
        ({"fps": -1.0}, "fps"),
        ({"run": "nowhere"}, "run"),
        ({"params": "nothing.npz"}, "nothing"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(run, params, tmp_path, options, message):
    values = {"run": run, "params": params, "out": "film.gif"} | options
    before = set(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=message):
        paths = {"run_folder": run / values.pop("run"), "params": tmp_path / values.pop("params")}
        Animate(**paths, **(values | {"out": tmp_path / values["out"]}), json=True).run()
    assert set(tmp_path.rglob("*")) == before


def test_a_run_without_a_template_says_how_to_make_one(tmp_path, params):
    with pytest.raises(InputError, match="smplxpp build"):
        Animate(tmp_path, params, tmp_path / "x.gif").run()


def test_parameters_of_another_body_are_refused(run, tmp_path):
    motion(expressions=100).save(tmp_path / "other.npz")
    with pytest.raises(InputError, match="expression"):
        Animate(run, tmp_path / "other.npz", tmp_path / "x.gif", json=True).run()
    assert not (tmp_path / "x.gif").exists()


def test_a_folder_with_other_things_is_not_replaced(run, params, tmp_path):
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="thesis"):
        Animate(run, params, out).run()
    assert (out / "thesis.tex").read_text() == "years of work"


def test_the_command_line(run, params, tmp_path, capsys):
    out = tmp_path / "wave.gif"
    status = main(
        ["animate", str(run), "--params", str(params), "-o", str(out), "--height", "60", "--stop", "1", "--json"]
    )
    assert status == 0 and json.loads(capsys.readouterr().out)["frames"] == 1 and out.is_file()
