"""Compare the picture of an exported PLY in another viewer with our own, by PSNR.

    python -m benchmarks viewer_check [--run RUN | --splats FILE] [--pictures DIR] [--no-store]

Gaussians are sampled on a template, given colours that depend on the view, posed, exported, and drawn by the web viewer
`@mkkellogg/gaussian-splats-3d` (three.js, WebGL) in a headless Chromium; our picture is drawn from the bound Gaussians,
so that writing and reading of the file are both tested. Needs npm and chromium; the viewer is put into `--tools` once.
The viewer cuts Gaussians at sqrt(8) standard deviations, stretches those that look round, and rounds colours to 8 bits:
the pictures cannot agree to the last bit.
"""

from __future__ import annotations

import functools
import http.server
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image

from avatar.export.posed import posed_splats
from avatar.formats import Splats, read_splat_ply, write_splat_ply
from avatar.gaussians.binding import BoundGaussians, world_from_frames
from avatar.gaussians.colors import sh_color, view_colors
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.losses.image_similarity import psnr_from_mse
from avatar.rendering import rasterize
from benchmarks.support.results import FIXTURE, store_results
from pipelines.runs import layout
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core import BodyParams, Camera
from smplxpp.core.spherical_harmonics import C0
from smplxpp.template.template import Template

PACKAGES = ("@mkkellogg/gaussian-splats-3d@0.4.7", "three@0.170.0")
CHROMIUM_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
)
PAGE = """<!doctype html><body style="margin:0"><script type="importmap">{"imports": {
"three": "/node_modules/three/build/three.module.js",
"splats": "/node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js"}}</script>
<script type="module">
const tell = (path, body) => fetch(path, {method: "POST", body});
try {
  const THREE = await import("three"), Splats = await import("splats");
  const job = await (await fetch("/job.json")).json();
  const renderer = new THREE.WebGLRenderer({preserveDrawingBuffer: true, antialias: false});
  renderer.setPixelRatio(1);
  renderer.setSize(job.size, job.size);
  renderer.setClearColor(0x000000, 1);
  document.body.appendChild(renderer.domElement);
  const camera = new THREE.PerspectiveCamera(job.fov, 1, 0.05, 100);
  const place = pose => {  // world from camera, columns as OpenCV's: three looks along -z with y up
    const m = new THREE.Matrix4().set(...pose.flat()).multiply(new THREE.Matrix4().makeScale(1, -1, -1));
    m.decompose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld(true);
  };
  place(job.poses[0]);
  const viewer = new Splats.Viewer({selfDrivenMode: false, renderer, camera, useBuiltInControls: false,
    gpuAcceleratedSort: false, sharedMemoryForWorkers: false, integerBasedSort: false,
    sphericalHarmonicsDegree: job.degree, inMemoryCompressionLevel: 0, ignoreDevicePixelRatio: true,
    sceneRevealMode: Splats.SceneRevealMode.Instant, logLevel: Splats.LogLevel.None});
  await viewer.addSplatScene("/splats.ply",
    {showLoadingUI: false, progressiveLoad: false, splatAlphaRemovalThreshold: 1});
  const frame = () => new Promise(requestAnimationFrame);
  for (let k = 0; k < job.poses.length; k++) {
    place(job.poses[k]);
    while (viewer.sortRunning) await frame();
    await viewer.runSplatSort(true, true);
    do { viewer.update(); viewer.render(); await frame(); } while (viewer.sortRunning || !viewer.splatRenderReady);
    viewer.update(); viewer.render();
    await tell("/image/" + k, await new Promise(done => renderer.domElement.toBlob(done, "image/png")));
  }
  await tell("/done", "");
} catch (error) { await tell("/failed", String(error && error.stack || error)); }
</script>"""

Draw = Callable[[Camera], tuple[np.ndarray, np.ndarray]]
"""A camera to an image (H, W, 3) in [0, 1] on black, and its alpha (H, W)."""


@dataclass(frozen=True)
class ViewerCheck:
    """Compare an exported PLY in a web viewer with our own picture."""

    run: Path | None = None
    """Folder of a built template; the fixture's is built where none is given."""
    splats: Path | None = None
    """A PLY to check in place of a template."""
    pictures: Path | None = None
    """Folder for the pictures: ours, the viewer's, and four times their difference, side by side."""
    tools: Path = Path(tempfile.gettempdir()) / "smplxpp_viewer"
    """Folder with the viewer's npm packages."""
    count: int = 80_000
    """Gaussians on the template."""
    size: int = 640
    """Width and height of the pictures in pixels."""
    seconds: float = 150.0
    """Patience with the browser."""
    store: bool = True
    """Store the figures."""

    def __call__(self) -> None:
        chromium = require_tools(self.tools)
        with tempfile.TemporaryDirectory() as folder:
            ply = Path(folder) / "splats.ply"
            if self.splats is not None:
                splats = read_splat_ply(self.splats)
                draws = {"ours": functools.partial(draw_splats, splats)}
                shutil.copy(self.splats, ply)
            else:
                bound, vertices, faces = posed_template(self.run or build_fixture(Path(folder)), self.count)
                splats = posed_splats(bound, vertices, faces)
                draws = {
                    "ours": functools.partial(draw_bound, bound, vertices, faces),
                    # What the file would show if its harmonics were still in the triangles' frames.
                    "harmonics not turned": functools.partial(draw_splats, replace(splats, f_rest=bound.sh.numpy())),
                }
                write_splat_ply(ply, splats)
            cameras = {name: look(splats, azimuth, self.size) for name, azimuth in (("front", 20.0), ("back", 215.0))}
            theirs = photograph(ply, splats.f_rest.shape[1], cameras, self, chromium)
        figures = {"gaussians": len(splats), "views": {}}
        for name, camera in cameras.items():
            ours, alpha = draws["ours"](camera)
            figures["views"][name] = {key: compare(draw(camera)[0], theirs[name], alpha) for key, draw in draws.items()}
            if self.pictures is not None:
                self.pictures.mkdir(parents=True, exist_ok=True)
                sheet = np.concatenate([ours, theirs[name], 4.0 * np.abs(ours - theirs[name])], axis=1)
                to_picture(sheet).save(self.pictures / f"{name}.png")
        print(json.dumps(figures, indent=1))
        if self.store:
            figures["viewer"] = PACKAGES
            store_results("viewer_check", "python -m benchmarks viewer_check", figures)


def require_tools(folder: Path) -> str:
    """The browser's path; installs the viewer into `folder`, or ends with what is missing."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    npm = shutil.which("npm")
    if chromium is None or npm is None:
        missing = " and ".join(name for name, path in (("chromium", chromium), ("npm", npm)) if path is None)
        raise SystemExit(f"This check needs {missing} (Debian: apt install chromium npm).")
    if not (folder / "node_modules" / "@mkkellogg").is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "package.json").write_text("{}")
        subprocess.run([npm, "install", "--no-audit", "--no-fund", "--silent", *PACKAGES], cwd=folder, check=True)
    return chromium


def build_fixture(folder: Path) -> Path:
    """The template of the fixture person."""
    command = [sys.executable, "-m", "pipelines.cli", "build", str(folder / "run"), "--capture", str(FIXTURE)]
    subprocess.run([*command, "--no-report"], check=True, stdout=subprocess.DEVNULL)
    return folder / "run"


def posed_template(run: Path, count: int) -> tuple[BoundGaussians, torch.Tensor, torch.Tensor]:
    """Gaussians on a run's template in a high step, with a sheen that depends on the view."""
    template = Template.load(run / layout.TEMPLATE)
    bound = sample_on_mesh(template, SamplingConfig(count=count))
    sh = torch.zeros_like(bound.sh)
    # Brighter and redder where the triangle faces the camera, greener along its median.
    sh[:, 2] = torch.tensor([0.4, 0.2, 0.0])
    sh[:, 0] = torch.tensor([0.0, 0.3, -0.2])
    poses = stress_poses(BodyParams.rest(betas=0, expressions=0))
    vertices = template.pose(poses.frame(list(STRESS_POSES).index("high_step")))[0]
    # The viewer cuts every Gaussian's colour at 1 and we do not: keep below.
    bound = replace(bound, dc=0.7 * bound.dc, sh=sh)
    return bound, torch.tensor(vertices, dtype=torch.float32), torch.tensor(template.faces)


def look(splats: Splats, azimuth: float, size: int) -> Camera:
    """A camera that sees all splats from a direction, degrees from the front about the vertical."""
    low, high = (np.quantile(splats.means, q, axis=0).astype(float) for q in (0.0, 1.0))
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    angle = np.radians(azimuth)
    away = np.array([np.sin(angle), 0.15, np.cos(angle)])
    return Camera.look_at(eye=center + 2.6 * radius * away, target=center, fov_y_deg=40.0, width=size, height=size)


def draw_bound(bound: BoundGaussians, vertices: torch.Tensor, faces: torch.Tensor, camera: Camera) -> tuple:
    """Our picture of bound Gaussians, colours evaluated in the triangles' frames."""
    frames = triangle_frames(vertices, faces)
    world = world_from_frames(bound, frames)
    position = torch.tensor(camera.position, dtype=torch.float32)[None]
    colors = view_colors(bound, frames, world.means, position)
    return _draw(world.means, world.quats, world.scales, world.opacities, colors, camera)


def draw_splats(splats: Splats, camera: Camera) -> tuple:
    """Our picture of what a file holds, by 3DGS's formulas."""
    means, quats, f_dc, f_rest = (torch.from_numpy(a) for a in (splats.means, splats.quats, splats.f_dc, splats.f_rest))
    position = torch.tensor(camera.position, dtype=torch.float32)
    directions = torch.nn.functional.normalize(means - position, dim=-1)
    colors = sh_color(0.5 + C0 * f_dc, f_rest, directions)[None]
    scales, opacities = torch.from_numpy(splats.log_scales).exp(), torch.from_numpy(splats.opacity_logits).sigmoid()
    return _draw(means, quats, scales, opacities, colors, camera)


def _draw(means, quats, scales, opacities, colors, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    viewmat, K = (torch.tensor(a, dtype=torch.float32)[None] for a in (camera.cam_from_world, camera.K))
    with torch.no_grad():
        image, alpha, _ = rasterize(means, quats, scales, opacities, colors, viewmat, K, camera.width, camera.height)
    return image[0].clamp(0, 1).numpy(), alpha[0, ..., 0].numpy()


def compare(ours: np.ndarray, theirs: np.ndarray, alpha: np.ndarray) -> dict[str, float]:
    """PSNR inside the silhouette and over the picture, and how large differences get, in 8-bit steps."""
    error = ours - theirs
    inside = error[alpha > 0.5]
    return {
        "psnr_silhouette": round(psnr_from_mse(float((inside**2).mean())), 2),
        "psnr_picture": round(psnr_from_mse(float((error**2).mean())), 2),
        "mean_steps": round(255.0 * float(np.abs(inside).mean()), 2),
        "p99_steps": round(255.0 * float(np.quantile(np.abs(inside), 0.99)), 2),
    }


def photograph(ply: Path, coefficients: int, cameras: dict[str, Camera], options: ViewerCheck, chromium: str) -> dict:
    """The viewer's pictures by camera name."""
    first = next(iter(cameras.values()))
    job = {
        "size": options.size,
        "fov": float(np.degrees(2.0 * np.arctan(0.5 * first.height / first.K[1, 1]))),
        "degree": round((coefficients + 1) ** 0.5) - 1,
        "poses": [np.linalg.inv(camera.cam_from_world).tolist() for camera in cameras.values()],
    }
    with serve(
        options.tools, {"/": PAGE.encode(), "/job.json": json.dumps(job).encode(), "/splats.ply": ply.read_bytes()}
    ) as site:
        with tempfile.TemporaryDirectory() as profile, tempfile.TemporaryFile() as log:
            command = [chromium, *CHROMIUM_FLAGS, f"--user-data-dir={profile}", site.url]
            browser = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
            try:
                # The browser sends its pictures back over HTTP, and is killed with its children in any case.
                ended = site.finished.wait(options.seconds)
            finally:
                os.killpg(browser.pid, signal.SIGKILL)
                browser.wait()
    if not ended or site.failure:
        raise SystemExit(f"the viewer did not finish: {site.failure or f'nothing for {options.seconds:.0f} s'}")
    return {
        name: np.asarray(Image.open(io.BytesIO(site.images[k])).convert("RGB"), dtype=np.float32) / 255.0
        for k, name in enumerate(cameras)
    }


@dataclass
class Site:
    """Return what the page reports."""

    url: str
    images: dict[int, bytes]
    finished: threading.Event
    failure: str = ""


@contextmanager
def serve(folder: Path, pages: dict[str, bytes]):
    """A local web server over `folder` and some pages, which takes the page's reports."""
    site = Site("", {}, threading.Event())

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

        def do_GET(self) -> None:
            if self.path not in pages:
                super().do_GET()
                return
            self.send_response(200)
            self.send_header("Content-Type", "text/html" if self.path == "/" else "application/octet-stream")
            self.send_header("Content-Length", str(len(pages[self.path])))
            self.end_headers()
            self.wfile.write(pages[self.path])

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(204)
            self.end_headers()
            if self.path.startswith("/image/"):
                site.images[int(self.path.rsplit("/", 1)[1])] = body
            else:
                site.failure = body.decode()
                site.finished.set()

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
    site.url = f"http://127.0.0.1:{server.server_port}/"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()


def to_picture(image: np.ndarray) -> Image.Image:
    """Values in [0, 1] as 8 bits."""
    return Image.fromarray((image.clip(0, 1) * 255.0 + 0.5).astype(np.uint8))


if __name__ == "__main__":
    tyro.cli(ViewerCheck, prog="python -m benchmarks viewer_check")()
