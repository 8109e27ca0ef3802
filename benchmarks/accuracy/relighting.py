"""Compare a student in another light with the person that was rendered in it: decibels of held-out views.

    python -m benchmarks relighting --run RUN [--capture DIR] [--no-store]

The run's student was trained in the stage's soft light. The capture's maker draws the same frames, from the true
surfaces, in three panoramas, and that is the truth; the panoramas are as bright in the mean as the stage. Rows: nothing
done; relit as TaoAvatar does, the picture taken for the base colour (white light, the same from everywhere, divided
out); relit with the stage's own light divided out; and the last for the true picture in the stage's light with true
normals, which is what nine harmonics without shadows can come to at best. `own light` is the student in the light
that it was trained in, against its photographs. PSNR of the person, dB, over views of the cameras that training held
out, in the frames that have true surfaces.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from avatar.runtime import AvatarPlayer
from benchmarks.support.results import FIXTURE, store_results
from pipelines.commands.templates import export_bundle
from pipelines.stages.run_inputs import params_in_use
from smplxpp.capture import Capture, open_capture
from smplxpp.core.light import Irradiance, Relighting, panoramas
from smplxpp.core.mesh import TriangleMesh
from smplxpp.people.fixture_person import person_of, read_layers
from smplxpp.raster.soft_light import LightConfig, environment_light, stage_light, vertex_light
from smplxpp.synth.views import LitFrame, hidden_faces, normal_map, render_view

_LIGHT = LightConfig(directions=144)


@dataclass(frozen=True)
class RelightingBenchmark:
    """Measure all panoramas."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Trained run of a capture that `smplxpp synth` made."""
    capture: Path = FIXTURE
    """Capture of the run, with true surfaces in geometry/."""
    store: bool = True
    """Store the figures."""

    def run(self) -> None:
        """Print and store the figures."""
        capture = open_capture(self.capture, params=params_in_use(self.run_folder, None))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "me.avatar"
            export_bundle(self.run_folder, path, name=None, licence="", params=None, exact=True)
            figures = measure(capture, AvatarPlayer(path), panoramas())
        print(json.dumps(figures, indent=1))
        if self.store:
            store_results("relighting", f"python -m benchmarks relighting --run {self.run_folder.name}", figures)


def measure(capture: Capture, player: AvatarPlayer, lights: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Return mean decibels by panorama and method."""
    person = person_of(read_layers(capture.root / "geometry" / "topology.npz", "skirt"), "skirt")
    scores: dict[tuple[str, str], list[float]] = {}
    for frame in capture.frames:
        file = capture.root / "geometry" / f"frame_{frame:06d}.npz"
        params = capture.params(frame)
        if not file.is_file() or params is None or frame not in capture.splits.train_frames:
            continue
        with np.load(file) as arrays:
            vertices = arrays["verts"].astype(np.float64)
        # The true person of the frame, with the light of her stage at every vertex.
        shown = np.flatnonzero(~hidden_faces(person, vertices))
        mesh = TriangleMesh(vertices, person.tpose.faces[shown])
        stage = LitFrame(mesh, shown, vertex_light(mesh, _LIGHT))
        player.pose(params.without_shape(), frame=frame)
        for name, panorama in lights.items():
            light = Irradiance.of_environment(panorama)
            # Scale the panorama to the mean of the stage, so that errors are of direction and colour.
            scale = stage_light().mean / light.mean
            lit = LitFrame(mesh, shown, stage.light, environment_light(mesh, _LIGHT, scale * panorama))
            for camera_name in capture.splits.novel_view_cameras:
                camera = capture.cameras[camera_name]
                truth, before = (render_view(person, one, camera, supersampling=3) for one in (lit, stage))
                inside, wanted = truth.mask == 255, truth.image / 255.0
                # What is divided out matters: white light is the default, the stage's own light is the truth here.
                white, own = (Relighting(light.exposed(scale), one) for one in (Irradiance.uniform(), stage_light()))
                pictures = {
                    "nothing done": player.draw(camera)[0],
                    "relit, white light divided out": player.draw(camera, relighting=white)[0],
                    "relit, the stage's light divided out": player.draw(camera, relighting=own)[0],
                    "true picture and normals, relit": own.colors(before.image / 255.0, normal_map(stage, camera)),
                }
                for method, picture in pictures.items():
                    scores.setdefault((name, method), []).append(decibels(picture, wanted, inside))
                in_stage = decibels(pictures["nothing done"], before.image / 255.0, inside)
                scores.setdefault((name, "own light"), []).append(in_stage)
    return {
        name: {method: round(float(np.mean(values)), 2) for (of, method), values in scores.items() if of == name}
        for name in lights
    }


def decibels(picture: np.ndarray, truth: np.ndarray, inside: np.ndarray) -> float:
    """PSNR within a mask."""
    return float(-10.0 * np.log10(np.square(np.clip(picture, 0.0, 1.0) - truth)[inside].mean()))


if __name__ == "__main__":
    tyro.cli(RelightingBenchmark).run()
