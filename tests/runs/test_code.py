"""What counts as the code of a stage."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipelines.runs import code
from pipelines.runs.code import code_of

ROOT = Path(__file__).resolve().parents[2]
POSE_BODY = "smplxpp.build.prepare"


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the packages' sources that may be changed."""
    for package in code.PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("data", "__pycache__"))

    def forget():
        for cached in (code._module, code._source, code._exports, code._native_digest):
            cached.cache_clear()

    monkeypatch.setattr(code, "_root", lambda package: tmp_path / package)
    forget()
    yield lambda path, old, new: (_edit(tmp_path / path, old, new), forget())
    monkeypatch.undo()
    forget()


def _edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_stage_has_the_modules_that_it_imports_and_no_others():
    found = code_of(POSE_BODY)
    assert {POSE_BODY, "smplxpp.body.model", "smplxpp.skinning.linear_blend", "smplxpp.core.errors"} <= set(found)
    assert not any(name.startswith(("avatar", "smplxpp.transfer", "smplxpp.export")) for name in found)
    assert "smplxpp" in found and "smplxpp.body" in found, "packages are run on the way to their modules"


def test_imports_within_functions_count_and_those_of_type_checkers_do_not():
    found = code_of("pipelines.commands.terminal")
    assert "pipelines.commands.terminal" in found and not any(name.startswith("avatar") for name in found)
    assert any(name.startswith("avatar") for name in code_of("pipelines.commands.train"))


def test_kernels_belong_to_what_calls_them():
    assert {"smplxpp.native/raster", "smplxpp.native/common"} <= set(code_of("smplxpp.raster.zbuffer"))
    assert "smplxpp.native/losses" not in code_of("smplxpp.raster.zbuffer")
    assert {"smplxpp.native/gaussians", "smplxpp.native/losses"} <= set(code_of("avatar.training.student.bake"))


@pytest.mark.parametrize(
    ("path", "old", "new"),
    [
        ("smplxpp/core/errors.py", "class InputError", "# A comment.\nclass InputError"),
        ("smplxpp/core/errors.py", '"""', '"""Other words. '),
        ("smplxpp/native/raster/zbuffer.cpp", "#include", "// A comment.\n#include"),
        ("avatar/losses/image_similarity.py", "def ssim(", "def other():\n    pass\n\n\ndef ssim("),
    ],
)
def test_what_does_nothing_or_is_elsewhere_changes_nothing(copy, path, old, new):
    before = code_of("smplxpp.raster.zbuffer", POSE_BODY)
    copy(path, old, new)
    assert code_of("smplxpp.raster.zbuffer", POSE_BODY) == before


@pytest.mark.parametrize(
    ("path", "old", "new", "named"),
    [
        ("smplxpp/core/errors.py", "class InputError", "LIMIT = 3\n\n\nclass InputError", "smplxpp.core.errors"),
        ("smplxpp/native/raster/zbuffer.cpp", "#include", "#include <cmath>\n#include", "smplxpp.native/raster"),
        ("smplxpp/native/common/parallel.hpp", "#pragma once", "#pragma once\nint x;", "smplxpp.native/common"),
    ],
)
def test_what_is_run_is_named_when_it_changes(copy, path, old, new, named):
    before = code_of("smplxpp.raster.zbuffer")
    copy(path, old, new)
    after = code_of("smplxpp.raster.zbuffer")
    assert {name for name in after if after[name] != before[name]} == {named}


@pytest.mark.long
def test_digests_are_kept_in_a_file_and_a_damaged_one_is_made_anew(tmp_path, monkeypatch):
    """Parsing all sources took every process two seconds."""

    def forget():
        for cached in (code._module, code._digests):
            cached.cache_clear()

    file = tmp_path / "kept" / "digests.json"
    monkeypatch.setattr(code, "_digests_file", lambda: file)
    monkeypatch.setattr(code.sys, "dont_write_bytecode", False)
    before = code_of("smplxpp.core.labels")
    for damage in ('{"0": [1, 2', '{"0": [1, 2, 3]}', "[]", ""):
        file.parent.mkdir(exist_ok=True)
        file.write_text(damage)
        forget()
        assert code_of("smplxpp.core.labels") == before and len(file.read_text()) > 100
    forget()
    monkeypatch.setattr(code, "_parsed", lambda *text: pytest.fail("parsed again"))
    assert code_of("smplxpp.core.labels") == before
    forget()


def test_an_unknown_module_is_an_error():
    with pytest.raises(ModuleNotFoundError, match="nonsense"):
        code_of("pipelines.nonsense")
