"""Measure detected keypoints in photographs and in pictures of scans, bodies fitted to them, and masks.

    python -m benchmarks detection photographs --capture DIR
    python -m benchmarks detection scans
    python -m benchmarks detection masks --capture DIR

`photographs`: the training cameras' photographs with their masks' boxes; errors against the true body's landmarks as a
camera and a triangulation see them, and the body that `smplxpp.register` fits to these keypoints, with masks and
without, from nothing else. `scans`: landmarks of bare scans drawn all around (`smplxpp.build.scan_keypoints`), of
every capture and procedural person, as they are, after `smplxpp.people.VARIANTS`, without colours. `masks`: of
MediaPipe, and of empty plates: the captures are on black, so their people are put before made rooms, with noise, a
shadow on the floor and another exposure than the plate's. The truth is looked at in measuring alone.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import scipy.ndimage
import tyro
from jaxtyping import Bool, Float64, UInt8

from benchmarks.accuracy.registration import bare_and_under
from benchmarks.support.people import captured, captured_names
from benchmarks.support.results import store_results
from pipelines.commands.options import OptionalPath, OptionalText, selected_frames
from pipelines.stages.build_config import RegisterInputs
from smplxpp.body import BodyModel, load_body
from smplxpp.build.observe import observe
from smplxpp.build.scan_keypoints import ScanViews, facing, keypoints_of_scan
from smplxpp.capture import Capture, open_capture
from smplxpp.core import BodyParams, InputError
from smplxpp.detect import load_detector
from smplxpp.detect.mediapipe_detector import PersonSegmenter
from smplxpp.detect.plates import PlateModel
from smplxpp.footage.keypoints import detect_keypoints, detection_notes
from smplxpp.metrics.pose_error import pose_error
from smplxpp.people import PersonScan, people, variant
from smplxpp.register import LandmarkModel, Observations, RegisterConfig, register, triangulate

_MM = 1000.0
_SURE = 0.5
"""Confidence from which a point counts as found."""


@dataclass(frozen=True)
class Photographs:
    """2D and 3D errors of detected keypoints, and of the body registered to them."""

    capture: Path
    """Folder of a capture with exact parameters."""
    work: OptionalPath = None
    """Folder that keeps the keypoints; by default a new one in the working directory."""
    frames: OptionalText = None
    """Frames to look at; by default all."""
    register: bool = True
    """Fit the body, too."""
    detector: str = "mediapipe"
    """Name or model.onnx."""

    def run(self) -> None:
        """Print and store."""
        capture, body = open_capture(self.capture, cache_bytes=0), load_body()
        folder = self.work or Path(f"keypoints_{capture.name}")
        frames = selected_frames(self.frames, capture)
        detector = load_detector(self.detector)
        begin = time.perf_counter()
        found = detect_keypoints(capture, detector, folder, frames=frames)
        seconds = time.perf_counter() - begin
        # Files of an earlier run are kept, so that seconds count images that were looked at now.
        looked_at = sum(one.detected for one in found.values())
        kept = tuple(capture.frames if frames is None else frames)
        shown = open_capture(self.capture, keypoints=folder, cache_bytes=0)
        figures: dict[str, object] = {
            "detector": detector.identity,
            "cameras": len(found),
            "frames": len(kept),
            "seconds_an_image": seconds / looked_at if looked_at else None,
            "views_with_a_person": float(np.mean(np.concatenate([one.people > 0 for one in found.values()]))),
            "problems": detection_notes(found),
            **_point_errors(shown, body, kept),
        }
        print(figures, flush=True)
        if self.register:
            figures["registered"] = _registered(shown, self.capture, folder, body, kept)
        command = "python -m benchmarks detection photographs --capture DIR"
        print(f"stored {store_results(f'detection_{capture.name}', command, figures).name}")


@dataclass(frozen=True)
class Scans:
    """Landmarks of bare scans."""

    people: int = 12
    """Number of procedural people, beside the captures' scans."""
    views: int = 12
    """Pictures of each."""
    variants: tuple[str, ...] = ("as it is", "turned", "mirrored", "20 % of the faces", "3 mm noise")
    """Changes of the captures' scans; the people are taken as they are."""
    store: bool = True
    """Write benchmarks/results/detection_scans.json."""

    def run(self) -> None:
        """Print and store."""
        detector, body = load_detector(), load_body()
        model = LandmarkModel.of(body, detector.names)
        rows = {}
        for scan, colored in self._scans():
            name = scan.name if colored else f"{scan.name} | without colours"
            truth = dict(zip(model.names, model.points(scan.body_vertices, scan.joints), strict=True))
            begin = time.perf_counter()
            try:
                found = keypoints_of_scan(
                    scan.mesh, scan.colors if colored else None, detector, config=ScanViews(count=self.views)
                )
            except InputError as error:
                rows[name] = {"refused": str(error)}
                print(name, rows[name], flush=True)
                continue
            seconds = time.perf_counter() - begin
            apart = {key: _MM * float(np.linalg.norm(found[key][0] - truth[key])) for key in found if key in truth}
            # Angle between the facing of the detected and of the true points, because the registration starts from it.
            true = facing({key: (point, 1.0) for key, point in truth.items()})
            ours = facing(found)
            assert true is not None
            turn = None if ours is None else float(np.degrees(np.arccos(np.clip(true @ ours, -1.0, 1.0))))
            groups = {g: [apart[key] for key in apart if _group(key) == g] for g in _GROUPS}
            rows[name] = {
                **{f"{g}_mm": float(np.median(values)) if values else None for g, values in groups.items()},
                "worst_body_mm": max(groups["body"], default=None),
                "found": len(apart),
                "known": len(truth),
                "facing_off_degrees": turn,
                "seconds": seconds,
            }
            print(name, rows[name], flush=True)
        answered = {name: row for name, row in rows.items() if "found" in row}
        turns = [row["facing_off_degrees"] for row in answered.values()]
        medians = {g: [row[f"{g}_mm"] for row in answered.values() if row[f"{g}_mm"] is not None] for g in _GROUPS}
        figures = {
            "views": self.views,
            "scans": len(rows),
            "refused": len(rows) - len(answered),
            "facing_wrong": sum(turn is None or turn > 90 for turn in turns),
            "worst_facing_degrees": max((turn for turn in turns if turn is not None), default=None),
            **{f"{g}_mm": float(np.median(values)) if values else None for g, values in medians.items()},
            "rows": rows,
        }
        print({key: value for key, value in figures.items() if key != "rows"})
        if self.store:
            store_results("detection_scans", "python -m benchmarks detection scans", figures)

    def _scans(self) -> Iterator[tuple[PersonScan, bool]]:
        for name in captured_names():
            scan = captured(name)
            for change in self.variants:
                yield variant(scan, change).as_read(), True
            yield scan, False
        for scan in people(count=self.people):
            yield scan, scan.colors is not None


@dataclass(frozen=True)
class Masks:
    """Intersection over union of masks that are made with the true ones."""

    capture: Path
    """Folder of a capture on black with masks."""
    frames: str = "0:60:20"
    """Frames."""
    rooms: int = 3
    """Made rooms; each has plates of its own."""

    def run(self) -> None:
        """Print and store."""
        capture, rows = open_capture(self.capture, cache_bytes=0), []
        frames = selected_frames(self.frames, capture)
        segmenter = PersonSegmenter()
        for number, camera in enumerate(capture.cameras):
            for k in range(self.rooms):
                size = capture.cameras[camera].width, capture.cameras[camera].height
                room = made_room(size, seed=100 * k + number)
                # The room is seen empty three times, with the noise of a sensor, then with the person in front of it.
                plates = [photograph_of(room, seed=k) for k in range(3)]
                model, one_plate = PlateModel(plates), PlateModel(plates[:1])
                for _, frame in capture.views([camera], frames):
                    mask = capture.mask(camera, frame)
                    assert mask is not None
                    photograph = photograph_of(person_before(room, capture, camera, frame), seed=frame + 7)
                    makers = {"plates": model, "one plate": one_plate, "mediapipe": segmenter}
                    for kind, made in makers.items():
                        rows.append((kind, camera, frame, k, _iou(made(photograph), mask)))
        figures = {}
        for kind in ("plates", "one plate", "mediapipe"):
            own = sorted((row for row in rows if row[0] == kind), key=lambda row: row[4])
            values = np.array([row[4] for row in own])
            figures[kind] = {
                "masks": len(own),
                "mean": float(values.mean()),
                "median": float(np.median(values)),
                "p5": float(np.percentile(values, 5)),
                "worst": {"iou": float(values[0]), "camera": own[0][1], "frame": own[0][2], "room": own[0][3]},
            }
            print(kind, figures[kind])
        command = "python -m benchmarks detection masks --capture DIR"
        store_results(f"detection_masks_{capture.name}", command, {"rooms": self.rooms, "iou": figures})


def _point_errors(capture: Capture, body: BodyModel, frames: tuple[int, ...]) -> dict[str, object]:
    """Return errors of detected points, in pixels and in millimetres at the person, and of triangulated points."""
    keypoints = {name: found for name in capture.cameras if (found := capture.keypoints(name)) is not None}
    names = next(iter(keypoints.values())).names
    model = LandmarkModel.of(body, names)
    # The truth is the landmark on the exact body, projected into each camera.
    truth = np.stack([_landmarks(model, body, capture.params(frame)) for frame in frames])
    by_group: dict[str, list[tuple[float, float]]] = {group: [] for group in _GROUPS}
    possible = dict.fromkeys(_GROUPS, 0)
    for name, found in keypoints.items():
        camera, own = capture.cameras[name], found.select(model.names, frames)
        for row in range(len(frames)):
            screen = camera.screen_from_world(truth[row])
            pixels = np.linalg.norm(own.points[row] - screen[:, :2], axis=1)
            within = ((screen[:, :2] >= 0) & (screen[:, :2] <= (camera.width, camera.height))).all(axis=1)
            for k, key in enumerate(model.names):
                possible[_group(key)] += int(within[k])
                # A pixel error e at depth z is e z / f on the plane of the point, in metres.
                if own.confidence[row, k] >= _SURE:
                    by_group[_group(key)].append((pixels[k], pixels[k] * screen[k, 2] / camera.K[0, 0]))
    # Triangulation joins all cameras, so that outliers of single views should vanish.
    in_space = triangulate(
        keypoints, {name: capture.cameras[name] for name in keypoints}, names=model.names, frames=frames
    )
    apart = _MM * np.linalg.norm(in_space.points - truth, axis=-1)
    groups = np.array([_group(key) for key in model.names])
    return {
        "in_images": {
            group: _summary([e[0] for e in errors], unit="px")
            | _summary([_MM * e[1] for e in errors], unit="mm")
            | {"share_of_points_in_the_image": len(errors) / max(possible[group], 1)}
            for group, errors in by_group.items()
        },
        "in_space": {group: _of_points(apart[:, groups == group]) for group in _GROUPS},
        "triangulation_problems": in_space.notes,
    }


def _registered(
    capture: Capture, root: Path, folder: Path, body: BodyModel, frames: tuple[int, ...]
) -> dict[str, object]:
    """Errors of the body registered to what was detected, and to masks: no scan, no label map, no fit to start from."""
    inputs = RegisterInputs(capture=root, start=False, frames=frames, keypoints=folder)
    seen = replace(observe(inputs, body).observations, scans={}, labels=None)
    assert seen.initial is None
    cases: Mapping[str, Observations] = {"keypoints alone": replace(seen, mask=None), "keypoints, masks": seen}
    exact = BodyParams.concatenate([_exact(capture, frame) for frame in frames])
    covered = bare_and_under(root, body.vertex_count)[1]
    rows: dict[str, object] = {}
    for name, case in cases.items():
        begin, cpu = time.perf_counter(), time.process_time()
        fit = register(body, case, RegisterConfig())
        spent = {"seconds": time.perf_counter() - begin, "cpu_seconds": time.process_time() - cpu}
        own = exact.select(np.flatnonzero(np.isin(frames, fit.frames)))
        rows[name] = asdict(pose_error(fit.params, own, body, covered)) | spent | {"problems": fit.notes}
        print(name, rows[name], flush=True)
    return rows


def _exact(capture: Capture, frame: int) -> BodyParams:
    params = capture.params(frame)
    assert params is not None
    return params


def _landmarks(model: LandmarkModel, body: BodyModel, params: BodyParams | None) -> Float64[np.ndarray, "K 3"]:
    assert params is not None
    posed = body.forward(params)
    return model.points(posed.vertices[0], posed.joints[0])


_GROUPS = ("body", "head", "feet", "hands", "face")
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def _group(name: str) -> str:
    if name.startswith("face_"):
        return "face"
    if "toe" in name or "heel" in name:
        return "feet"
    if any(finger in name for finger in _FINGERS):
        return "hands"
    return "body" if name.startswith("coco_") else "head"


def _summary(values: list[float], *, unit: str) -> dict[str, float]:
    """Median and 95th percentile."""
    if not values:
        return {f"median_{unit}": float("nan"), f"p95_{unit}": float("nan"), "found": 0}
    median, high = np.percentile(values, [50, 95])
    return {f"median_{unit}": float(median), f"p95_{unit}": float(high), "found": len(values)}


def _of_points(apart: Float64[np.ndarray, "*F K"]) -> dict[str, float]:
    there = np.isfinite(apart)
    return _summary(apart[there].tolist(), unit="mm") | {"share_triangulated": float(there.mean())}


def _iou(matte: UInt8[np.ndarray, "H W"], mask: UInt8[np.ndarray, "H W"]) -> float:
    ours: Bool[np.ndarray, "H W"] = matte > 127
    true = mask > 127
    return float((ours & true).sum() / max((ours | true).sum(), 1))


def made_room(size: tuple[int, int], *, seed: int) -> Float64[np.ndarray, "H W 3"]:
    """A wall with soft patches, panels and a floor."""
    width, height = size
    rng = np.random.default_rng(seed)
    soft = scipy.ndimage.gaussian_filter(rng.normal(size=(height, width, 3)), (height / 9, width / 9, 0))
    room = 130 + 45 * soft / soft.std() + rng.uniform(-25, 25, 3)
    for x in rng.integers(0, width, 4):
        room[:, x : x + width // 12] += rng.uniform(-40, 40)
    room[int(0.8 * height) :] *= 0.8
    return np.clip(room, 25, 235)


def person_before(
    room: Float64[np.ndarray, "H W 3"], capture: Capture, camera: str, frame: int
) -> Float64[np.ndarray, "H W 3"]:
    """The person before a room, with a shadow about the feet and a slightly other exposure than the plate's."""
    colour, alpha = capture.foreground(camera, frame)
    opacity = alpha[..., None] / 255.0
    rows, columns = np.nonzero(alpha > 127)
    y, x = np.mgrid[: len(alpha), : alpha.shape[1]]
    wide, low = np.ptp(columns), rows.max()
    shadow = np.exp(-(((x - columns.mean() - 0.2 * wide) / (0.5 * wide)) ** 2 + ((y - low) / (0.05 * len(alpha))) ** 2))
    shaded = room * (1.0 - 0.4 * shadow[..., None])
    return 0.96 * (colour + (1.0 - opacity) * shaded)


def photograph_of(clean: Float64[np.ndarray, "H W 3"], *, seed: int) -> UInt8[np.ndarray, "H W 3"]:
    """A photograph with the noise of a camera indoors."""
    noise = np.random.default_rng(seed).normal(0.0, 4.0, clean.shape)
    return np.clip(clean + noise, 0, 255).astype(np.uint8)


if __name__ == "__main__":
    Command = (
        Annotated[Photographs, tyro.conf.subcommand("photographs")]
        | Annotated[Scans, tyro.conf.subcommand("scans")]
        | Annotated[Masks, tyro.conf.subcommand("masks")]
    )
    tyro.cli(Command).run()  # type: ignore[arg-type]
