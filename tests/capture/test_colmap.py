"""COLMAP's camera models, its binary and text files, images' names, and files that are broken on purpose."""

from __future__ import annotations

import shutil
import struct

import numpy as np
import pytest
from PIL import Image

from smplxpp.capture import open_capture
from smplxpp.capture.readers.colmap import MODELS
from smplxpp.core.errors import GeometryWarning, InputError
from tests.capture.scene import make_scene
from tests.capture.writers import write_colmap_binary

F, FY, CX, CY = 50.0, 52.0, 41.5, 29.25
X, Y = 0.4, -0.7
R2, THETA = X**2 + Y**2, np.arctan(np.hypot(X, Y))


def radial(*k: float) -> tuple[float, float]:
    factor = 1 + sum(c * R2 ** (n + 1) for n, c in enumerate(k))
    return X * factor, Y * factor


def fisheye(*k: float) -> tuple[float, float]:
    factor = THETA * (1 + sum(c * THETA ** (2 * n + 2) for n, c in enumerate(k))) / np.sqrt(R2)
    return X * factor, Y * factor


def opencv() -> tuple[float, float]:
    x, y = radial(-0.1, 0.03)
    return x + 2 * 0.01 * X * Y - 0.02 * (R2 + 2 * X**2), y + 0.01 * (R2 + 2 * Y**2) - 2 * 0.02 * X * Y


ONE, TWO = (F, CX, CY), (F, FY, CX, CY)
# Parameters, and where the lens puts the point (X, Y, 1), as COLMAP's models.h states them.
READ = {
    "SIMPLE_PINHOLE": (ONE, (X, Y)),
    "PINHOLE": (TWO, (X, Y)),
    "SIMPLE_RADIAL": ((*ONE, -0.1), radial(-0.1)),
    "RADIAL": ((*ONE, -0.1, 0.03), radial(-0.1, 0.03)),
    "OPENCV": ((*TWO, -0.1, 0.03, 0.01, -0.02), opencv()),
    "OPENCV_FISHEYE": ((*TWO, 0.03, -0.01, 0.002, 0.001), fisheye(0.03, -0.01, 0.002, 0.001)),
    "FULL_OPENCV": ((*TWO, -0.1, 0.03, 0.01, -0.02, 0.0, 0.0, 0.0, 0.0), opencv()),
    "FOV": (
        (*TWO, 0.9),
        tuple(v / np.sqrt(R2) * np.arctan(2 * np.sqrt(R2) * np.tan(0.45)) / 0.9 for v in (X, Y)),
    ),
    "SIMPLE_RADIAL_FISHEYE": ((*ONE, 0.03), fisheye(0.03)),
    "RADIAL_FISHEYE": ((*ONE, 0.03, -0.01), fisheye(0.03, -0.01)),
    "SIMPLE_FISHEYE": (ONE, fisheye()),
    "FISHEYE": (TWO, fisheye()),
}


def write_model(root, model, params, *, binary, names=("a.png",)):
    number = [name for name, _ in MODELS].index(model) if model in dict(MODELS) else model
    folder = root / "sparse"
    folder.mkdir(parents=True, exist_ok=True)
    pose = (1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)
    if binary:
        camera = struct.pack(f"<QIiQQ{len(params)}d", 1, 7, number, 80, 60, *params)
        images = struct.pack("<Q", len(names))
        for k, name in enumerate(names):
            images += struct.pack("<I7dI", k + 1, *pose, 7) + name.encode() + struct.pack("<BQddq", 0, 1, 1.0, 2.0, -1)
        (folder / "cameras.bin").write_bytes(camera)
        (folder / "images.bin").write_bytes(images)
        # COLMAP 3.12 and later write these beside them.
        (folder / "rigs.bin").write_bytes(struct.pack("<QIIiI", 1, 1, 1, 0, 7))
        (folder / "frames.bin").write_bytes(struct.pack("<Q", 0))
    else:
        (folder / "cameras.txt").write_text(f"# list\n\n7 {model} 80 60 " + " ".join(map(repr, params)) + "\n")
        lines = [f"{k + 1} {' '.join(map(str, pose))} 7 {name}\n\n" for k, name in enumerate(names)]
        (folder / "images.txt").write_text("# list\n\n" + "".join(lines))
    return root


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", READ)
def test_every_model_that_is_read_puts_points_where_colmap_puts_them(tmp_path, model, binary):
    params, expected = READ[model]
    capture = open_capture(write_model(tmp_path, model, params, binary=binary))
    camera = capture.cameras["a"]
    one = len(params) < 4 or model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    np.testing.assert_array_equal(camera.K, [[F, 0, CX], [0, F if one else FY, CY], [0, 0, 1]])
    lens = capture.recording.distortions.get("a")
    point = np.array([[X, Y]])
    np.testing.assert_allclose((point if lens is None else lens.distort(point))[0], expected, atol=1e-14)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", [name for name, _ in MODELS if name not in READ])
def test_other_models_are_refused_by_name_with_the_remedy(tmp_path, model, binary):
    root = write_model(tmp_path, model, (50.0,) * dict(MODELS)[model], binary=binary)
    with pytest.raises(InputError, match=rf"{model}\. Undistort with `colmap image_undistorter`"):
        open_capture(root)


def test_models_of_the_future_are_refused_with_the_remedy(tmp_path):
    with pytest.raises(InputError, match=r"number 18.*image_undistorter"):
        open_capture(write_model(tmp_path / "a", 18, (1.0, 1.0), binary=True))
    with pytest.raises(InputError, match=r"MEI.*image_undistorter"):
        open_capture(write_model(tmp_path / "b", "MEI", (1.0,), binary=False))


@pytest.mark.parametrize("binary", [True, False])
def test_images_of_one_stem_are_different_cameras(tmp_path, binary):
    """`x.jpg` beside `x.png`, and `a/b.png` beside `a_b.png`, kept one camera of each two."""
    names = ("x.jpg", "x.png", "a/b.png")
    capture = open_capture(write_model(tmp_path, "PINHOLE", TWO, binary=binary, names=names))
    assert sorted(capture.cameras) == ["a_b.png", "x.jpg", "x.png"]
    with pytest.raises(InputError, match=r"a/b\.png and a_b\.png|a_b\.png and a/b\.png"):
        open_capture(write_model(tmp_path / "b", "PINHOLE", TWO, binary=binary, names=("a/b.png", "a_b.png")))


def test_a_rigs_folders_are_cameras_and_their_numbers_frames(tmp_path):
    for name in ("cam/1/000007.png", "cam/1/000008.png", "rig/1/000007.png"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (80, 60)).save(tmp_path / "images" / name)
    write_model(tmp_path, "PINHOLE", TWO, binary=True, names=("cam/1/000007.png", "rig/1/000007.png"))
    capture = open_capture(tmp_path)
    assert list(capture.cameras) == ["cam_1", "rig_1"] and capture.frames == (7, 8)
    assert capture.file("rig_1", 8) is None


@pytest.mark.parametrize("name", ["../../secret.png", "/etc/secret.png", "..\\secret.png", "C:/secret.png"])
def test_images_outside_of_the_folder_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="a path inside of"):
        open_capture(write_model(tmp_path, "PINHOLE", TWO, binary=False, names=(name,)))


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("cameras.bin", b""),
        ("cameras.bin", struct.pack("<Q", 2**64 - 1)),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 7, 1, 2**63, 60, *TWO)),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 7, 1, 80, 60, np.nan, 1, 1, 1)),
        ("images.bin", struct.pack("<Q", 2**63)),
        ("images.bin", struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 7) + b"a" * 5000),
        ("images.bin", struct.pack("<QI7dI2sQ", 1, 1, 1, 0, 0, 0, 0, 0, 0, 7, b"a\0", 2**64 - 1)),
        ("images.bin", struct.pack("<QI7dI2sQ", 1, 1, 0, 0, 0, 0, 0, 0, 0, 7, b"a\0", 0)),
        ("images.bin", struct.pack("<QI7dI2sQ", 1, 1, 1, 0, np.inf, 0, 0, 0, 0, 7, b"a\0", 0)),
        ("images.bin", struct.pack("<QI7dI3sQ", 1, 1, 1, 0, 0, 0, 0, 0, 0, 7, b"\xff\xfe\0", 0)),
        ("images.bin", struct.pack("<QI7dI2sQ", 1, 1, 1, 0, 0, 0, 0, 0, 0, 8, b"a\0", 0)),
    ],
)
def test_hostile_binaries_are_refused(tmp_path, file, content):
    root = write_model(tmp_path, "PINHOLE", TWO, binary=True)
    (root / "sparse" / file).write_bytes(content)
    with pytest.raises(InputError):
        open_capture(root)


@pytest.mark.parametrize(
    "line",
    [
        "7 PINHOLE 80 60 1 2 3",
        "7 PINHOLE 80 1e400 1 2 3 4",
        f"{'9' * 5000} PINHOLE 80 60 1 2 3 4",
        "7 PINHOLE",
        "\0",
        "7 PINHOLE 80 60 1_0 2 3 4",
    ],
)
def test_hostile_texts_are_refused(tmp_path, line):
    root = write_model(tmp_path, "PINHOLE", TWO, binary=False)
    (root / "sparse" / "cameras.txt").write_text(line + "\n")
    with pytest.raises(InputError):
        open_capture(root)


def test_a_fisheye_reconstruction_gives_pinhole_images_and_keypoints(tmp_path):
    """A ramp drawn through the lens comes out straight, and a keypoint of the image on disk moves with it."""
    params, _ = READ["OPENCV_FISHEYE"]
    root = write_model(tmp_path, "OPENCV_FISHEYE", params, binary=True)
    (root / "images").mkdir()
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    capture = open_capture(root)
    camera, lens = capture.cameras["a"], capture.recording.distortions["a"]
    plane = lens.undistort(np.stack([(x.ravel() - CX) / F, (y.ravel() - CY) / FY], axis=1))
    column = np.clip(plane[:, 0].reshape(60, 80) * F + CX, 0, 80) * 3
    Image.fromarray(np.repeat(np.round(column).astype(np.uint8)[..., None], 3, axis=2)).save(root / "images/a.png")
    shown = open_capture(root).image("a", 0)[..., 0].astype(float)
    np.testing.assert_allclose(shown[15:45, 20:60], (x * 3)[15:45, 20:60], atol=1.5)
    (root / "keypoints").mkdir()
    bent = lens.distort(np.array([[0.3, 0.2]]))[0] * (F, FY) + (CX, CY)
    points = np.array([[[*bent, 1.0], [CX + 3 * F, CY, 1.0]]])  # the second: behind the camera
    np.savez(root / "keypoints" / "a.npz", keypoints=points, joint_names=np.array(["nose", "left_eye"]))
    found = open_capture(root, keypoints=root / "keypoints").keypoints("a")
    np.testing.assert_allclose(found.points[0, 0], (0.3 * F + CX, 0.2 * FY + CY), atol=1e-9)
    assert found.confidence[0].tolist() == [1.0, 0.0] and camera.width == 80


def test_what_a_reconstruction_leaves_out_is_named(tmp_path):
    """A second model, and photographs that no camera registers, were passed over without a word."""
    root = write_colmap_binary(make_scene(square_pixels=True), tmp_path / "set")
    for number in ("0", "1"):
        shutil.copytree(root / "sparse", tmp_path / number, ignore=shutil.ignore_patterns("[01]"))
        shutil.move(tmp_path / number, root / "sparse" / number)
    for k in range(14):
        (root / "images" / "lost").mkdir(exist_ok=True)
        (root / "images" / "lost" / f"{k:03d}.JPG").write_bytes(b"")
    with pytest.warns(GeometryWarning) as caught:
        open_capture(root)
    words = [str(one.message).partition(": ")[2] for one in caught]
    assert words[0] == "models that are not taken beside 0: 1"
    assert words[1].startswith("14 images that no camera registers: lost/000.JPG, ") and words[1].endswith("and 2 more")
    assert len(words) == 2
