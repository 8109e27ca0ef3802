import os

import pytest

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import check_name, path_inside, read_bytes, read_text, regular_file


def test_a_pipe_a_device_and_a_folder_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    for path in (tmp_path / "pipe.png", "/dev/zero", tmp_path):
        with pytest.raises(InputError, match="regular file"):
            regular_file(path)


@pytest.mark.parametrize("name", ["none.json", "a\0b", "x" * 5000, "file.txt/below"])
def test_paths_that_lead_nowhere_are_said(tmp_path, name):
    (tmp_path / "file.txt").write_text("")
    with pytest.raises(InputError):
        regular_file(f"{tmp_path}/{name}")


def test_a_link_to_a_file_is_a_file(tmp_path):
    (tmp_path / "a.txt").write_text("x")
    (tmp_path / "b.txt").symlink_to(tmp_path / "a.txt")
    assert regular_file(tmp_path / "b.txt") == tmp_path / "b.txt"


@pytest.mark.parametrize("name", ["a/b.png", "./a/b.png", "sub\\b.png", "a/../b.png", "../b.png"])
def test_names_below_the_root_are_found(tmp_path, name):
    assert path_inside(tmp_path, name, base=tmp_path / "train").is_relative_to(tmp_path)


@pytest.mark.parametrize(
    "name", ["", "/etc/passwd", "../../x", "..", "a\0b", "C:/x.png", "..\\..\\x", "a/../../../b", "x" * 300]
)
def test_names_that_leave_the_root_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="inside of"):
        path_inside(tmp_path / "in", name)


def test_a_root_whose_name_begins_like_another_is_not_it(tmp_path):
    with pytest.raises(InputError, match="inside of"):
        path_inside(tmp_path / "scan", "../scan_2/x.png")


@pytest.mark.parametrize("name", ["", " ", ".", "..", "a/b", "a\\b", "a\nb", "a\0", "\ud800", "x" * 300])
def test_names_that_no_file_can_have_are_refused(name):
    with pytest.raises(InputError, match="name"):
        check_name(name, subject="camera")
    assert check_name("Cam 01-é", subject="camera") == "Cam 01-é"


def test_what_is_read_whole_is_regular_and_bounded(tmp_path):
    file = tmp_path / "a.txt"
    file.write_bytes(b"\xef\xbb\xbfwords")
    assert read_text(file) == "words" and read_bytes(file, most=8).endswith(b"words")
    with pytest.raises(InputError, match="at most 7 bytes"):
        read_bytes(file, subject="list", most=7)
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="UTF-8"):
        read_text(file)
    with pytest.raises(InputError, match="regular file"):
        read_text("/dev/zero")
