"""The bundle's file: the same bytes for the same avatar, and words for whatever is wrong with one."""

from __future__ import annotations

import hashlib
import json
import shutil
import zipfile
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from avatar.runtime import AvatarPlayer, load_bundle
from avatar.runtime.bundle import VERSION
from smplxpp.core import BodyParams
from smplxpp.core.errors import InputError
from smplxpp.core.files.tensor_bytes import pack_tensors, unpack_tensors
from tests.runtime.bundles import EXACT, student, tampered, write, write_dressed
from tests.web.modules import TOOLS, node


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bundle") / "good.avatar"
    write(path, student("whole"), licence="CC0-1.0", provenance={"made by": "a test"})
    return path


def entries(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rewritten(path: Path, files: dict[str, bytes], *, digests: bool = True) -> Path:
    """A bundle of other pieces, their digests right unless they are to stay."""
    if digests:
        manifest = json.loads(files["manifest.json"])
        for entry in manifest["pieces"].values():
            content = files.get(entry["file"], b"")
            entry |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        files = files | {"manifest.json": json.dumps(manifest).encode()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def test_the_same_avatar_gives_the_same_bytes(good, tmp_path):
    write(tmp_path / "b.avatar", student("whole"), licence="CC0-1.0", provenance={"made by": "a test"})
    assert (tmp_path / "b.avatar").read_bytes() == good.read_bytes()


def test_it_says_what_it_is_and_what_its_pieces_take(good):
    manifest = json.loads(entries(good)["manifest.json"])
    assert manifest["format"] == "smplxpp-avatar" and manifest["version"] == VERSION
    assert manifest["model"]["licence"] == "CC0-1.0" and manifest["model"]["provenance"] == {"made by": "a test"}
    for name, entry in manifest["pieces"].items():
        content = entries(good)[entry["file"]]
        assert entry["bytes"] == len(content) and entry["sha256"] == hashlib.sha256(content).hexdigest(), name
    about = load_bundle(good).about
    assert about.name == "doll" and about.jaw and about.frames == (0, 1, 2) and set(about.reductions) >= {"blend"}
    sizes = write(good.with_name("again.avatar"), student("whole"))
    assert sum(size for name, size in sizes.items() if name != "total") < sizes["total"]


def test_safetensors_reads_its_pieces(good, tmp_path):
    from safetensors.numpy import load

    files = entries(good)
    for name in files:
        if name.endswith(".safetensors"):
            theirs, (ours, _) = load(files[name]), unpack_tensors(files[name], subject="piece")
            assert theirs.keys() == ours.keys()
            assert all(np.array_equal(theirs[key], ours[key]) for key in ours)


def test_truncated_and_foreign_files_are_refused(good, tmp_path):
    data, path = good.read_bytes(), tmp_path / "bad.avatar"
    with pytest.raises(InputError, match="existing file"):
        load_bundle(path)
    for content in (b"", data[:100], data[: len(data) // 2], data[:-10], b"x" * 1000):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"bad\.avatar.*smplxpp export"):
            load_bundle(path)
    rewritten(path, {"readme.txt": b"hello"}, digests=False)
    with pytest.raises(InputError, match=r"without manifest\.json"):
        load_bundle(path)


def test_a_piece_that_was_changed_is_named(good, tmp_path):
    files = entries(good)
    content = bytearray(files["blend.safetensors"])
    content[-1] ^= 1
    with pytest.raises(InputError, match=r"piece blend: expected the \d+ bytes.*changed or damaged"):
        load_bundle(rewritten(tmp_path / "a.avatar", files | {"blend.safetensors": bytes(content)}, digests=False))


def test_a_newer_version_and_another_format_are_named(good, tmp_path):
    files = entries(good)
    for change, words in (
        ({"version": VERSION + 1}, f"version {VERSION} or older.*Update smplxpp"),
        ({"format": "other"}, "another format"),
    ):
        manifest = json.loads(files["manifest.json"]) | change
        changed = files | {"manifest.json": json.dumps(manifest).encode()}
        with pytest.raises(InputError, match=words):
            load_bundle(rewritten(tmp_path / "a.avatar", changed, digests=False))


@pytest.mark.parametrize(
    "name", ["../evil.safetensors", "/etc/x.json", "a/b.json", "C:\\x.json", "x", "Ä.json", ".json"]
)
def test_names_that_are_paths_are_refused(name, good, tmp_path):
    with pytest.raises(InputError, match="plain names"):
        load_bundle(rewritten(tmp_path / "a.avatar", entries(good) | {name: b"{}"}))


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_piece_twice_and_one_too_many_are_refused(good, tmp_path):
    path = rewritten(tmp_path / "a.avatar", entries(good))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("blend.safetensors", b"")
    with pytest.raises(InputError, match="each once"):
        load_bundle(path)
    with pytest.raises(InputError, match="beside them"):
        load_bundle(rewritten(path, entries(good) | {"more.bin": b"1"}))
    without = {name: content for name, content in entries(good).items() if name != "blend.safetensors"}
    with pytest.raises(InputError, match=r"piece blend.*received none"):
        load_bundle(rewritten(path, without))


def test_what_unpacks_to_too_much_is_not_unpacked(good, tmp_path):
    bomb = rewritten(tmp_path / "a.avatar", entries(good) | {"bomb.bin": bytes(64 << 20)})
    assert bomb.stat().st_size < 1 << 20
    with pytest.raises(InputError, match="that unpack to"):
        load_bundle(bomb)
    # One that lies about its size: the central directory says a byte.
    data = bytearray(bomb.read_bytes())
    place = data.rindex(b"bomb.bin") - 46
    data[place + 24 : place + 28] = (1).to_bytes(4, "little")
    bomb.write_bytes(data)
    with pytest.raises(InputError, match=r"not the 1 bytes|BadZipFile"):
        load_bundle(bomb)


def _with(good: Path, piece: str, change) -> dict[str, bytes]:
    files = entries(good)
    tensors, about = unpack_tensors(files[f"{piece}.safetensors"], subject="piece")
    tensors = {name: value.copy() for name, value in tensors.items()}
    change(tensors)
    return files | {f"{piece}.safetensors": pack_tensors(tensors, about or None)}


CHANGES = {
    "NaN": ("gaussians", lambda t: t["offset"].__setitem__((0, 0), np.nan), "offset: expected finite"),
    "infinite step": ("blend", lambda t: t["body.step"].__setitem__((0, 0), np.inf), "body.step: expected finite"),
    "index beyond": ("surface", lambda t: t["faces"].__setitem__((0, 0), 65535), "surface.faces: expected indices"),
    "joint beyond": (
        "surface",
        lambda t: t["joint_indices"].__setitem__((0, 0), 200),
        "joint_indices: expected indices",
    ),
    "shape": ("field", lambda t: t.update(codes=t["codes"][:1]), r"field\.codes"),
    "missing": ("field", lambda t: t.pop("points"), r"field\.points"),
    "unknown": ("field", lambda t: t.update(extra=t["points"]), "received extra"),
    "kind": ("skeleton", lambda t: t.update(parents=t["joints"][:, 0]), "parents: expected integers"),
    "loop": ("skeleton", lambda t: t["parents"].__setitem__(1, 5), "every parent before"),
    "counts": ("gaussians", lambda t: t["per_face"].__setitem__(0, 200), "per_face"),
    "rows": ("blend", lambda t: t["head.rows"].__setitem__(0, 399), r"head\.rows"),
    "part": ("blend", lambda t: t["part"].__setitem__(0, 9), "coefficients"),
    "quaternion": ("gaussians", lambda t: t["quats"].__setitem__(0, 0), "quats"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_numbers_that_make_no_sense_are_refused(name, good, tmp_path):
    piece, change, words = CHANGES[name]
    with pytest.raises(InputError, match=words):
        load_bundle(rewritten(tmp_path / "a.avatar", _with(good, piece, change)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.update(low=t["high"] + 1), r"regression\.low"),
        (lambda t: t.update(rows=t["rows"][:1]), r"regression\.rows"),
        (lambda t: t.update(level=t["level"][:-1]), r"regression\.level"),
    ],
)
def test_a_regression_that_fits_nothing_is_refused(change, words, tmp_path):
    write(tmp_path / "good.avatar", student("regression"), EXACT)
    with pytest.raises(InputError, match=words):
        load_bundle(rewritten(tmp_path / "a.avatar", _with(tmp_path / "good.avatar", "regression", change)))


def test_a_regression_without_a_field_is_refused(tmp_path):
    write(tmp_path / "good.avatar", student("regression"), EXACT)
    files = entries(tmp_path / "good.avatar")
    manifest = json.loads(files["manifest.json"])
    del files[manifest["pieces"].pop("field")["file"]]
    with pytest.raises(InputError, match="a field whose points it moves"):
        load_bundle(rewritten(tmp_path / "a.avatar", files | {"manifest.json": json.dumps(manifest).encode()}))


def test_garments_of_another_avatar_are_refused(tmp_path):
    write_dressed(tmp_path, EXACT)

    def moved(tensors: dict) -> None:
        tensors["0.particles"][:] = tensors["0.particles"][::-1]

    with pytest.raises(InputError, match="garments of the avatar"):
        AvatarPlayer(rewritten(tmp_path / "a.avatar", _with(tmp_path / "me.avatar", "garments", moved)))


def _played(path: Path) -> bool:
    """Whether a player takes a bundle, with its clothes and its motion; anything but an `InputError` is a fault."""
    try:
        player = AvatarPlayer(path, threads=1)
    except InputError:
        return False
    return bool(player.pose(BodyParams.rest(betas=0) if player.motion is None else player.motion.frame(0)))


_IN_THE_PAGE = """
const result = {};
for (const name of given.names) {
  try {
    const avatar = await read(`${given.folder}/${name}`), deformer = new m.Deformer(avatar, undefined, new m.Native(1));
    if (avatar.garments.length) new m.ClothDriver(deformer, avatar.garments);
    const rest = m.restPose(avatar.skeleton.names.length, avatar.expressionNames.length);
    deformer.pose(avatar.motion ? m.poseAt(avatar.motion, 0) : rest);
    deformer.native.close();
    result[name] = true;
  } catch (error) {
    if (!(error instanceof m.BundleError)) throw new Error(`${name}: ${error.stack}`);
    result[name] = false;
  }
}"""


@pytest.mark.long
def test_both_players_take_and_refuse_the_same_bundles(good, tmp_path):
    """The page played 67 of 154 bundles that the runtime refuses: names of joints, versions, holes, float indices."""
    write_dressed(tmp_path)
    # One of twelve faults, others of each bundle: the tests of one fault each are above.
    bundles = [*islice(tampered(good), 0, None, 12), *islice(tampered(tmp_path / "me.avatar"), 5, None, 12)]
    names = {f"{k}.avatar": fault for k, (fault, _) in enumerate(bundles)}
    for name, (_, data) in zip(names, bundles, strict=True):
        (tmp_path / name).write_bytes(data)
    here = {name: _played(tmp_path / name) for name in names}
    assert here["0.avatar"] and 0.6 * len(here) < list(here.values()).count(False) < len(here)
    if shutil.which("node") is None or not (TOOLS / "esbuild").exists():
        pytest.skip("no node with web/'s tools: npm ci in web/")
    page = node(_IN_THE_PAGE, given={"folder": str(tmp_path), "names": list(names)})
    assert [names[name] for name in names if page[name] != here[name]] == []
