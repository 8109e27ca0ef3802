"""Time of mesh maps and their gradients on a body of about 45k faces; prints a table and stores it.

    python -m benchmarks mesh_maps

The open body subdivided and simplified to 45k faces fills the image's height. Kernels beside the torch reference in one
process, in turns, all of torch's threads; images of 512 and 1024 pixels, 9 interpolated channels.
"""

from __future__ import annotations

from collections.abc import Callable

import fast_simplification
import numpy as np
import torch

from avatar.render.barycentrics import barycentrics_reference, interpolate_reference
from avatar.render.mesh_maps import mesh_maps
from benchmarks.speed.ssim import milliseconds
from benchmarks.support.results import store_results
from smplxpp.body import load_body
from smplxpp.core.camera import Camera
from smplxpp.raster import rasterize_triangles

FACES, CHANNELS = 45_000, 9


def body() -> tuple[torch.Tensor, torch.Tensor]:
    """The open body with `FACES` faces."""
    model = load_body()
    vertices, faces = np.asarray(model.v_template, np.float64), np.asarray(model.faces)
    while len(faces) < FACES:
        vertices, faces = subdivide(vertices, faces)
    points, corners = fast_simplification.simplify(
        vertices.astype(np.float32), faces.astype(np.int32), target_count=FACES
    )
    return torch.from_numpy(points).float(), torch.from_numpy(corners.astype(np.int64))


def subdivide(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face into four at the middles of its edges."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (inverse.reshape(-1, 3) + len(vertices)).T
    split = np.concatenate([np.stack(k, 1) for k in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return np.concatenate([vertices, vertices[unique].mean(1)]), split


def measure(vertices: torch.Tensor, faces: torch.Tensor, camera: Camera) -> dict[str, object]:
    """Times of one camera in milliseconds."""
    values = torch.rand(len(vertices), CHANNELS, generator=torch.Generator().manual_seed(0))
    maps = mesh_maps(vertices, faces, camera)
    numbers, corners = vertices.double().numpy(), faces.int().numpy()

    def gradients(render: Callable) -> None:
        v, a = vertices.clone().requires_grad_(), values.clone().requires_grad_()
        render(v, a).backward(ones)

    def reference(v: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        barycentric, _ = barycentrics_reference(v, faces, maps.face_id, camera)
        return interpolate_reference(a, barycentric, faces, maps.face_id)

    def native(v: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        return mesh_maps(v, faces, camera, a).attributes

    ones = torch.ones((*maps.face_id.shape, CHANNELS))
    times = milliseconds(
        {
            "z-buffer": lambda: rasterize_triangles(numbers, corners, camera, threads=torch.get_num_threads()),
            "interpolate": lambda: maps.interpolate(values),
            "maps": lambda: native(vertices, values),
            "maps and gradients": lambda: gradients(native),
            "torch at known faces": lambda: reference(vertices, values),
            "torch at known faces and gradients": lambda: gradients(reference),
        },
        repeats=9,
    )
    return {
        "size": (camera.width, camera.height),
        "orthographic": camera.orthographic,
        "covered_pixels": int(maps.mask.sum()),
        "times": times,
    }


def main() -> None:
    """Measure both cameras at both sizes."""
    vertices, faces = body()
    center = 0.5 * (vertices.amin(0) + vertices.amax(0)).double().numpy()
    rows = []
    for size in (512, 1024):
        for camera in (
            Camera.look_at(eye=center + [0.0, 0.0, 2.6], target=center, fov_y_deg=40, width=size, height=size),
            Camera.orthographic_view(center=center, direction=(0, 0, 1), half_extent=1.0, size=size),
        ):
            row = measure(vertices, faces, camera)
            rows.append(row)
            print(f"{size} px, {'orthographic' if camera.orthographic else 'perspective'}")
            for name, t in row["times"].items():
                print(f"  {name:<36} {t['median_ms']:>8.2f} ms (least {t['min_ms']:.2f})")
    figures = {"faces": len(faces), "channels": CHANNELS, "threads": torch.get_num_threads(), "rows": rows}
    print("stored", store_results("mesh_maps", "python -m benchmarks mesh_maps", figures))


if __name__ == "__main__":
    main()
