"""Files that readers parse themselves: OpenCV's YAML, COLMAP's models; lists of numbered files."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smplxpp.capture.calibrations.camera_files import read_opencv_yaml
from smplxpp.capture.files import FileSeries, image_name
from smplxpp.capture.readers.colmap import read_model
from smplxpp.core.errors import InputError
from tests.capture.scene import make_scene
from tests.capture.writers import write_colmap_binary, write_colmap_text


def test_yaml_as_opencv_writes_it(tmp_path):
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / "intri.yml"
    K, lens = np.random.default_rng(0).normal(size=(3, 3)) * 1e3, np.array([[0.1, np.nan, np.inf, -1e-9, 2.0]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("names", ["1", "02"])
    storage.write("K_1", K)
    storage.write("dist_1", lens)
    storage.write("H_1", 1080)
    storage.release()
    read = read_opencv_yaml(path)
    assert read["names"] == ["1", "02"] and read["H_1"] == 1080
    np.testing.assert_allclose(read["K_1"], K, rtol=1e-15)
    np.testing.assert_allclose(read["dist_1"], lens)


def test_yaml_by_hand(tmp_path):
    path = tmp_path / "a.yml"
    path.write_text(
        '%YAML:1.0\n---\n# cameras\nnames: ["A", B]\nK_A: !!opencv-matrix\n   rows: 1\n   cols: 3\n'
        "   dt: d\n   data: [ 1.5000000000000000e+00, 2.,\n       .5 ]\ntitle: rig\n"
    )
    read = read_opencv_yaml(path)
    assert read["names"] == ["A", "B"] and read["title"] == "rig"
    np.testing.assert_array_equal(read["K_A"], [[1.5, 2.0, 0.5]])


@pytest.fixture(scope="module")
def colmap_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("colmap")
    binary = write_colmap_binary(make_scene(square_pixels=True), folder / "binary") / "sparse"
    text = write_colmap_text(make_scene(lens=(-0.2, 0.05, 0.001, 0.002, 0.0)), folder / "text") / "sparse" / "0"
    return {"bin": binary, "txt": text}


@settings(max_examples=60, deadline=None)
@given(data=st.data(), kind=st.sampled_from(["bin", "txt"]), name=st.sampled_from(["cameras", "images"]))
def test_broken_colmap_files_are_refused_or_read(colmap_files, tmp_path_factory, data, kind, name):
    """Cut anywhere, or with a byte changed: an InputError that names the file, or a model, never another error."""
    folder = tmp_path_factory.mktemp("broken")
    for path in colmap_files[kind].glob(f"*.{kind}"):
        (folder / path.name).write_bytes(path.read_bytes())
    path = folder / f"{name}.{kind}"
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content = content[:at]
    else:
        content[at] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content))
    try:
        cameras, images = read_model(folder)
    except InputError as error:
        assert path.name in str(error)
    else:
        assert isinstance(cameras, dict) and isinstance(images, list)


def test_a_number_of_points_beyond_all_memory_is_refused(colmap_files, tmp_path):
    for path in colmap_files["bin"].glob("*.bin"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    content = bytearray((tmp_path / "images.bin").read_bytes())
    name_ends = content.index(b"\0", 8 + 64)
    content[name_ends + 1 : name_ends + 9] = b"\xff" * 8
    (tmp_path / "images.bin").write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"images\.bin"):
        read_model(tmp_path)


def test_numbered_files(tmp_path):
    for name in ("A_rgb000007.jpg", "A_rgb000002.PNG", "A_rgb12.jpg", "A_rgb000002.jpg", "B_rgb1.jpg", "A_rgbx.jpg"):
        (tmp_path / name).touch()
    series = FileSeries.find(tmp_path, image_name("A_rgb"))
    assert series.numbers.tolist() == [2, 7, 12] and len(series) == 3
    assert series.path(2).name == "A_rgb000002.PNG" and series.path(12).name == "A_rgb12.jpg"
    assert series.path(3) is None and series.path(99) is None
    assert series.has(np.array([1, 2, 7, 8])).tolist() == [False, True, True, False]
    assert len(FileSeries.find(tmp_path / "nowhere", image_name())) == 0
    unusual = FileSeries.from_names(tmp_path, {3: "später/bild 3.jpg"})
    assert unusual.path(3) == tmp_path / "später/bild 3.jpg"


@pytest.mark.long
def test_importing_captures_is_light():
    heavy = ("torch", "PIL", "trimesh", "onnxruntime")
    code = f"import sys, smplxpp.capture; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True)
    assert done.stdout.strip() == "[]"
