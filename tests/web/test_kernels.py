"""The page's WebAssembly gives the numbers of the runtime's native kernels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar.runtime import AvatarPlayer
from tests.dolls.dancing import dance
from tests.runtime.bundles import EXACT, KINDS, student, write, write_dressed
from tests.web.modules import NEEDS_BUILD, node

pytestmark = NEEDS_BUILD
FRAMES = (0, 2, 5)
EYE = (0.5, 0.8, 2.0)
POSED = """
const result = [];
for (const { path, frames, eye } of given) {
  const avatar = await read(path), deformer = new m.Deformer(avatar), out = [];
  for (const frame of frames) {
    deformer.pose(m.poseAt(avatar.motion, frame / avatar.motion.framesPerSecond));
    const { count } = deformer.order([0, 0, 1, 5], 0.01, [], false);
    out.push([...deformer.recordsFor(eye, count)]);
  }
  result.push(out);
}"""


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> dict[str, tuple[Path, np.ndarray]]:
    """Every kind of student, exact and as it is usually stored: its file, and its records in the page (T, N, 14)."""
    folder = tmp_path_factory.mktemp("kernels")
    paths = {}
    for name in (*KINDS, "rounded"):
        paths[name] = folder / f"{name.replace(' ', '_')}.avatar"
        write(paths[name], student("whole" if name == "rounded" else name), None if name == "rounded" else EXACT)
    asked = [{"path": str(path), "frames": FRAMES, "eye": EYE} for path in paths.values()]
    found = node(POSED, given=asked)
    return {
        name: (path, np.array(rows).reshape(len(FRAMES), -1, 14))
        for (name, path), rows in zip(paths.items(), found, strict=True)
    }


@pytest.mark.parametrize("kind", [*KINDS, "rounded"])
def test_gaussians_are_where_the_runtime_has_them(both, kind):
    path, records = both[kind]
    player = AvatarPlayer(path, threads=1)
    for frame, got in zip(FRAMES, records, strict=True):
        splats = player.pose(dance().frame(frame))
        axes = (
            Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].astype(np.float64)).as_matrix() * splats.scales[:, None, :]
        )
        covariance = (axes @ axes.transpose(0, 2, 1)).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        np.testing.assert_allclose(got[:, :3], splats.means, atol=3e-6)
        np.testing.assert_allclose(got[:, 3], splats.opacities, atol=1e-6)
        np.testing.assert_allclose(got[:, 4:10], covariance, atol=1e-4 * np.abs(covariance).max())
        np.testing.assert_allclose(got[:, 10:13], splats.colors(np.array(EYE, np.float32)), atol=2e-5)


def test_frames_differ(both):
    _, records = both["whole"]
    assert np.abs(records[1] - records[0])[:, :3].max() > 0.01


def test_the_order_is_that_of_depth_and_leaves_out_what_is_hidden(both):
    script = """
    const avatar = await read(given), deformer = new m.Deformer(avatar), part = [...avatar.gaussians.part];
    deformer.pose(m.poseAt(avatar.motion, 0));
    const shown = (hidden, near) => {
      const { count, depths } = deformer.order([0, 0, -1, 2], near, hidden, true);
      const rows = deformer.recordsFor([0, 0, 2], count);
      return { depths, z: Array.from({ length: count }, (_, k) => 2 - rows[14 * k + 2]) };
    };
    const z = Array.from({ length: part.length }, (_, k) => 2 - deformer.centers[3 * k + 2]);
    const middle = [...z].sort((a, b) => a - b)[z.length >> 1];
    const result = { z, part, middle, all: shown([], 0.01), some: shown([1], 0.01), far: shown([], middle) };"""
    found = node(script, given=str(both["whole"][0]))
    z, part = np.array(found["z"]), np.array(found["part"])
    assert 0 < (part == 1).sum() < len(part)
    step = (z.max() - z.min()) / 65535
    expected = {"all": z, "some": z[part != 1], "far": z[z >= found["middle"]]}
    for name, depths in expected.items():
        got = np.array(found[name]["z"])
        np.testing.assert_allclose(got, np.sort(depths), atol=2 * step)
        np.testing.assert_allclose(found[name]["depths"], [depths.min(), depths.max()], atol=1e-6)


def test_a_browser_without_vectors_is_told_so():
    script = """
    WebAssembly.Module = class { constructor() { throw new WebAssembly.CompileError("no SIMD"); } };
    let result = ""; try { new m.Native(); } catch (error) { result = error.message; }"""
    assert "no WebAssembly with SIMD" in node(script)


def test_skin_whose_clothes_are_off_lies_bare_as_in_the_runtime(tmp_path):
    """Trained under clothes, skin fills gaps between their Gaussians: bare, it had ragged edges, holes and stains."""
    write_dressed(tmp_path)
    script = """
    const avatar = await read(given), deformer = new m.Deformer(avatar);
    const records = (hidden) => {
      deformer.pose(m.poseAt(avatar.motion, 0), null, hidden);
      deformer.order([0, 0, 1, 5], 0.01, [], false);
      return [...deformer.recordsFor([0, 0, 2], avatar.gaussians.count)];
    };
    const result = { covered: [...avatar.gaussians.bare.covered], part: [...avatar.gaussians.part],
      first: records([]), bare: records([1]), again: records([]) };"""
    got = node(script, given=str(tmp_path / "me.avatar"))
    covered, part = np.array(got["covered"]), np.array(got["part"])
    assert 10 < (covered == 1).sum() < (part == 0).sum() and (part[covered > 0] == 0).all()
    first, bare = (np.array(got[name]).reshape(-1, 14) for name in ("first", "bare"))
    assert got["first"] == got["again"]
    np.testing.assert_array_equal(bare[covered == 0], first[covered == 0])
    assert (bare[covered == 1, 3] == 1.0).all() and (first[covered == 1, 3] < 1.0).all()
    # The runtime's, of which the page leaves out the hidden part itself.
    player = AvatarPlayer(tmp_path / "me.avatar", threads=1)
    player.hide([player.bundle.about.part_names[1]])
    splats, shown = player.pose(player.motion.frame(0)), part == 0
    assert (splats.opacities[~shown] == 0.0).all()
    np.testing.assert_allclose(bare[shown, :3], splats.means[shown], atol=3e-6)
    np.testing.assert_allclose(bare[shown, 10:13], splats.colors(np.float32([0, 0, 2]))[shown], atol=2e-5)
    axes = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].astype(np.float64)).as_matrix() * splats.scales[:, None, :]
    covariance = (axes @ axes.transpose(0, 2, 1)).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    np.testing.assert_allclose(bare[shown, 4:10], covariance[shown], atol=1e-4 * np.abs(covariance).max())
