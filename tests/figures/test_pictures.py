"""Pictures: geometry lands where the camera puts it, colours say what they stand for."""

import io

import numpy as np
import pytest
from PIL import Image

from smplxpp.core import Camera, InputError, SkinWeights, TriangleMesh
from smplxpp.core.colors import linear_from_oklab, linear_from_srgb, oklab_from_linear, srgb8_from_linear
from smplxpp.figures import (
    ShadeStyle,
    blend_joint_colors,
    body_cameras,
    caption,
    color_bar,
    colormap,
    contact_sheet,
    encode_jpeg,
    encode_png,
    fit_cameras,
    heat_colors,
    joint_palette,
    render_heat,
    render_overlay,
    render_shaded,
    row,
    turntable_cameras,
)

FLAT = ShadeStyle(relief=0.0, occlusion=0.0)


def sphere(radius=1.0, rings=24, sectors=48) -> TriangleMesh:
    theta = np.linspace(0, np.pi, rings + 1)[1:-1]
    phi = 2 * np.pi * np.arange(sectors) / sectors
    grid = np.stack(
        [
            np.outer(np.sin(theta), np.sin(phi)),
            np.outer(np.cos(theta), np.ones(sectors)),
            np.outer(np.sin(theta), np.cos(phi)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = radius * np.concatenate([[[0, 1, 0]], grid, [[0, -1, 0]]])
    i, j = np.meshgrid(np.arange(rings - 2), np.arange(sectors), indexing="ij")
    a, b = 1 + i * sectors + j, 1 + i * sectors + (j + 1) % sectors
    c, d = a + sectors, b + sectors
    k, k1 = np.arange(sectors), (np.arange(sectors) + 1) % sectors
    last = len(vertices) - 1
    faces = np.concatenate(
        [
            np.stack([a, c, b], -1).reshape(-1, 3),
            np.stack([b, c, d], -1).reshape(-1, 3),
            np.stack([np.zeros_like(k), 1 + k, 1 + k1], -1),
            np.stack([np.full_like(k, last), last - sectors + k1, last - sectors + k], -1),
        ]
    )
    return TriangleMesh(vertices, faces)


@pytest.fixture(scope="module")
def ball():
    return sphere()


@pytest.fixture(scope="module")
def front(ball):
    return body_cameras(ball, views=("front",), height=120)[0]


def foreground(picture):
    return (picture != 255).any(axis=-1)


@pytest.mark.parametrize("view", ["front", "side", "back", "three-quarter", "above"])
def test_a_fitted_camera_sees_everything_and_wastes_little(view):
    points = np.random.default_rng(0).normal(size=(500, 3)) * [0.3, 0.9, 0.2]
    mesh = TriangleMesh(points, np.arange(498).reshape(-1, 3))
    used = points[:498]
    camera = body_cameras(mesh, views=(view,), height=300, margin=0.05)[0]
    x, y, z = camera.screen_from_world(used).T[:3]
    assert (z > 0).all()
    assert x.min() >= 0 and x.max() <= camera.width and y.min() >= 0 and y.max() <= camera.height
    assert min(y.min(), camera.height - y.max()) == pytest.approx(0.05 * 300, abs=0.5)


def test_views_of_a_row_share_the_scale_and_a_given_width_binds():
    box = np.array([[x, y, z] for x in (-0.8, 0.8) for y in (0, 1.7) for z in (-0.2, 0.2)], float)
    cameras = fit_cameras(box, directions=[(0, 0, 1), (1, 0, 0)], height=400)
    assert cameras[0].K[1, 1] == cameras[1].K[1, 1]
    assert cameras[0].cam_from_world[2, 3] == pytest.approx(cameras[1].cam_from_world[2, 3])
    assert cameras[0].width > 2 * cameras[1].width
    narrow = fit_cameras(box, directions=[(0, 0, 1)], height=400, width=150)[0]
    x = narrow.screen_from_world(box)[:, 0]
    assert narrow.width == 150 and x.min() >= 0 and x.max() <= 150


def test_the_bodys_left_is_on_the_right_of_a_front_view():
    box = np.array([[x, y, z] for x in (-1, 1) for y in (0, 1) for z in (-1, 1)], float)
    front, back = fit_cameras(box, directions=[(0, 0, 1), (0, 0, -1)], height=100)
    left = np.array([[1.0, 0.5, 0.0]])
    assert front.screen_from_world(left)[0, 0] > front.width / 2
    assert back.screen_from_world(left)[0, 0] < back.width / 2
    high, low = front.screen_from_world(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]))[:, 1]
    assert high < low


def test_a_turntable_goes_once_around():
    cameras = turntable_cameras(np.random.default_rng(1).normal(size=(50, 3)), count=8, height=100)
    assert len({(c.width, c.height) for c in cameras}) == 1
    azimuth = np.unwrap([np.arctan2(-c.forward[0], -c.forward[2]) for c in cameras])
    np.testing.assert_allclose(np.diff(azimuth), 2 * np.pi / 8)


def test_unknown_view_and_empty_points():
    with pytest.raises(InputError, match="view"):
        body_cameras(sphere(rings=4, sectors=6), views=("below",))
    with pytest.raises(InputError, match="points"):
        fit_cameras(np.zeros((0, 3)), directions=[(0, 0, 1)])


def test_flat_colours_come_out_as_they_went_in(ball, front):
    colors = np.tile(np.array([[200, 40, 90]], np.uint8), (ball.vertex_count, 1))
    picture = render_shaded(ball, front, vertex_colors=colors, style=FLAT)
    assert picture.shape == (front.height, front.width, 3) and picture.dtype == np.uint8
    np.testing.assert_array_equal(picture[60, front.width // 2], (200, 40, 90))
    np.testing.assert_array_equal(picture[0, 0], (255, 255, 255))

    # Points painted one by one, as those of a texture: left half one colour, right half another, within a face, too.
    def halves(face, barycentric):
        x = np.einsum("nk,nk->n", barycentric, ball.triangles[face][:, :, 0])
        return np.where(x[:, None] > 0, (10, 20, 30), (200, 40, 90)).astype(np.uint8)

    painted = render_shaded(ball, front, paint=halves, style=FLAT)
    np.testing.assert_array_equal(painted[60, front.width // 2 + 3], (10, 20, 30))
    np.testing.assert_array_equal(painted[60, front.width // 2 - 3], (200, 40, 90))


def test_silhouettes_are_blended(ball, front):
    style = ShadeStyle(relief=0.0, occlusion=0.0, base_color=(0, 0, 0))
    tones = np.unique(render_shaded(ball, front, style=style))
    assert len(tones) == 5  # 0 to 4 of the four samples covered
    assert foreground(render_shaded(ball, front, style=style)).mean() == pytest.approx(
        np.pi * (0.46 * front.height) ** 2 / (front.width * front.height), rel=0.03
    )


def test_light_comes_from_above_left_and_occlusion_darkens_creases(ball, front):
    picture = render_shaded(ball, front).astype(int)
    center = front.width // 2
    assert picture[30, center].sum() > picture[95, center].sum()
    assert picture[60, center - 35].sum() > picture[60, center + 35].sum()
    # Two touching spheres: the crease between them is darker than without occlusion, their open sides are not.
    pair = TriangleMesh(
        np.concatenate([ball.vertices - [0.97, 0, 0], ball.vertices + [0.97, 0, 0]]) * 0.1,
        np.concatenate([ball.faces, ball.faces + ball.vertex_count]),
    )
    camera = body_cameras(pair, views=("front",), height=120)[0]
    with_ao = render_shaded(pair, camera).astype(int).sum(-1)
    without = render_shaded(pair, camera, style=ShadeStyle(occlusion=0.0)).astype(int).sum(-1)
    middle, quarter = camera.width // 2, camera.width // 4
    assert with_ao[60, middle - 6] < 0.93 * without[60, middle - 6]
    assert with_ao[60, quarter] > 0.97 * without[60, quarter]


def test_the_back_of_an_open_surface_is_darker():
    square = TriangleMesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    for make in (
        lambda d: fit_cameras(square.vertices, directions=[(0, 0, d)], height=40)[0],
        lambda d: Camera.orthographic_view(center=np.zeros(3), direction=(0, 0, d), half_extent=1.5, size=40),
    ):
        outside, inside = (render_shaded(square, make(d), style=FLAT)[20, 20].astype(int).sum() for d in (1, -1))
        assert inside < 0.9 * outside


def test_wireframe_draws_the_edges():
    square = TriangleMesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    camera = fit_cameras(square.vertices, directions=[(0, 0, 1)], height=100)[0]
    picture = render_shaded(square, camera, style=ShadeStyle(relief=0.0, occlusion=0.0, wireframe=True)).astype(int)
    tone, center = picture.sum(axis=-1), camera.width // 2
    on_diagonal, off = tone[48:52, center - 2 : center + 2].min(), tone[65:75, center + 15 : center + 25].min()
    assert on_diagonal < 0.8 * off


def test_colours_of_the_wrong_shape_are_refused(ball, front):
    with pytest.raises(InputError, match="vertex colours"):
        render_shaded(ball, front, vertex_colors=np.zeros((3, 3), np.uint8))
    with pytest.raises(InputError, match="face colours"):
        render_shaded(ball, front, face_colors=np.zeros((ball.face_count, 3)))
    with pytest.raises(InputError, match="heat"):
        render_heat(ball, front, np.zeros(5), limits=(0, 1))


def test_a_mesh_outside_the_picture_leaves_the_background(ball):
    away = Camera.look_at(eye=(0, 0, 5), target=(0, 0, 10), fov_y_deg=30, width=40, height=30)
    assert (render_shaded(ball, away) == 255).all()


def test_heat_maps_colour_values_and_mark_missing_ones(ball, front):
    values = ball.vertices[:, 1].copy()
    picture = render_heat(ball, front, values, cmap="signed", limits=(-1, 1), bar=False, style=FLAT).astype(int)
    center = front.width // 2
    assert picture[20, center, 0] > picture[20, center, 2]  # up: red
    assert picture[100, center, 2] > picture[100, center, 0]  # down: blue
    wide = render_heat(ball, front, np.full(ball.face_count, np.nan), limits=(0, 1), unit="mm", style=FLAT)
    assert wide.shape[1] > front.width
    np.testing.assert_array_equal(wide[60, center], (110, 110, 118))


def test_an_overlay_tints_only_where_the_ghost_is_in_front(ball, front):
    small = ball.with_vertices(0.6 * ball.vertices)
    style = ShadeStyle(relief=0.0, occlusion=0.0, base_color=(200, 200, 200))
    alone = render_shaded(ball, front, style=style)
    inside = render_overlay(ball, small, front, style=style)
    np.testing.assert_array_equal(inside, alone)  # a ghost inside the solid is hidden
    around = render_overlay(small, ball, front, style=style).astype(int)
    center = front.width // 2
    assert around[60, center, 2] - around[60, center, 0] > 15  # blue glass
    assert foreground(around).sum() == foreground(alone).sum()


def test_colour_maps_are_monotone_in_lightness_and_even():
    for name in ("weight", "error"):
        lab = oklab_from_linear(linear_from_srgb(colormap(name)))
        assert (np.diff(lab[:, 0]) < 2e-3).all()
        steps = np.linalg.norm(np.diff(lab[::15], axis=0), axis=1)
        assert steps.max() < 1.6 * steps.min()
    signed = oklab_from_linear(linear_from_srgb(colormap("signed")))
    assert abs(int(np.argmax(signed[:, 0])) - 127) <= 2
    with pytest.raises(InputError, match="colour map"):
        colormap("jet")


def test_heat_colours_clip_and_grey_out():
    colors = heat_colors(np.array([-5.0, 0.0, 1.0, 9.0, np.nan, np.inf]), cmap="error", limits=(0, 1))
    table = colormap("error")
    np.testing.assert_array_equal(colors[[0, 1]], table[[0, 0]])
    np.testing.assert_array_equal(colors[[2, 3]], table[[255, 255]])
    assert (colors[4] == colors[5]).all() and (np.abs(table.astype(int) - colors[4]).sum(1) > 0).all()
    with pytest.raises(InputError, match="limits"):
        heat_colors(np.zeros(2), cmap="error", limits=(1, 1))


def test_colour_spaces_round_trip():
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(srgb8_from_linear(linear_from_srgb(every)), every)
    rgb = np.random.default_rng(2).random((100, 3))
    np.testing.assert_allclose(linear_from_oklab(oklab_from_linear(rgb)), rgb, atol=1e-6)


def test_joint_colours_differ_between_neighbours_and_mix_by_weight():
    lab = oklab_from_linear(linear_from_srgb(joint_palette(55)))
    assert np.linalg.norm(np.diff(lab, axis=0), axis=1).min() > 0.12
    dense = np.array([[1.0, 0, 0], [0, 0.5, 0.5], [0.2, 0.5, 0.3]])
    colors = blend_joint_colors(dense)
    np.testing.assert_array_equal(colors[0], joint_palette(3)[0])
    mean = linear_from_srgb(joint_palette(3))[1:].mean(0)
    np.testing.assert_array_equal(colors[1], srgb8_from_linear(mean))
    sparse = SkinWeights.from_dense(dense)
    np.testing.assert_allclose(blend_joint_colors(sparse).astype(int), colors, atol=1)


def test_sheets_keep_their_pictures():
    red, blue = np.full((20, 30, 3), (250, 0, 0), np.uint8), np.full((10, 16, 3), (0, 0, 250), np.uint8)
    line = row([red, blue], gap=4)
    assert line.shape == (20, 50, 3)
    assert (line[:, :30] == red).all() and (line[:10, 34:] == blue).all() and (line[10:, 34:] == 255).all()
    sheet = contact_sheet([red, blue, red], columns=2, gap=0)
    assert sheet.shape == (40, 60, 3) and (sheet[20:, :30] == red).all()
    captioned = caption(red.repeat(4, axis=1), "Scan, front", size=16)
    assert len(captioned) > 20 and (captioned[20:] < 128).any()
    for call in (lambda: row([]), lambda: contact_sheet([]), lambda: contact_sheet([red], captions=("a", "b"))):
        with pytest.raises(InputError):
            call()


def test_a_colour_bar_runs_from_high_to_low():
    bar = color_bar(cmap="error", limits=(0, 3), unit="mm", height=200)
    column = bar[:, 10]
    ramp = column[(column != 255).any(-1)]
    np.testing.assert_array_equal(ramp[[0, -1]], colormap("error")[[255, 0]])


def test_encoded_pictures_are_what_they_say():
    image = np.random.default_rng(3).integers(0, 255, (12, 17, 3), dtype=np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encode_png(image)))), image)
    smooth = np.broadcast_to(np.linspace(0, 255, 64).astype(np.uint8)[:, None, None], (64, 64, 3))
    decoded = np.asarray(Image.open(io.BytesIO(encode_jpeg(smooth))))
    assert np.abs(decoded.astype(int) - smooth).mean() < 2


def test_the_same_mesh_gives_the_same_bytes(ball, front):
    colors = np.random.default_rng(4).integers(0, 255, (ball.vertex_count, 3), dtype=np.uint8)
    pictures = {encode_png(render_shaded(ball, front, vertex_colors=colors)) for _ in range(3)}
    assert len(pictures) == 1


def test_a_capture_fills_its_picture(captures):
    from smplxpp.core.mesh_files.mesh_io import read_mesh

    scan = read_mesh(captures / "man_casual" / "scans" / "scan_000000.ply")
    camera = body_cameras(scan.mesh, views=("front",), height=200)[0]
    hit = foreground(render_shaded(scan.mesh, camera, vertex_colors=scan.vertex_colors))
    rows = np.flatnonzero(hit.any(axis=1))
    assert 190 > rows[-1] - rows[0] > 170 and 0.15 < hit.mean() < 0.6
