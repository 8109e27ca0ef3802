"""Find the files of a capture's reference frame: its scan, body parameters and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from smplxpp.capture.files import IMAGE_SUFFIXES, FileSeries, require_folder
from smplxpp.capture.protocols import ProtocolFiles, choose_protocol, read_description
from smplxpp.capture.readers.simple import stacked_params
from smplxpp.core.errors import InputError

_MAPS = (".png", ".npy")


@dataclass(frozen=True)
class ReferenceFrame:
    """Files of one frame, found by name and not yet read.

    Attributes:
        subject: name of the capture's folder.
        frame: number of the frame.
        scan: file of the scan; None if there is none and none is needed.
        params: file of parameters; None if there is none and none is needed.
        params_frame: row of `params` of this frame.
        motion: parameters of all frames from the same source as `params`, or None.
        scan_labels: labels of the scan's vertices, or None.
        label_maps: label image by camera, without held-out cameras.
        photographs: image by camera, without held-out cameras.
        cameras_file: camera file of the capture, or None.
    """

    subject: str
    frame: int
    scan: Path | None
    params: Path | None
    params_frame: int
    motion: Path | None = None
    scan_labels: Path | None = None
    label_maps: dict[str, Path] = field(default_factory=dict)
    photographs: dict[str, Path] = field(default_factory=dict)
    cameras_file: Path | None = None


def find_reference(
    capture: str | Path,
    *,
    frame: int = 0,
    params: str | Path | None = None,
    protocol: str | None = None,
    fitted: bool = True,
    scanned: bool = True,
) -> ReferenceFrame:
    """Find the files of a frame in a capture folder of the simple layout.

    The layout: `scans/scan_FFFFFF.ply` (`.obj`), `scans/scan_FFFFFF_labels.npz`, `params/params.npz` (stacked) or
    `params/FFFFFF.npz`, `labels/CAM/CAM_labelFFFFFF.png`, `rgbs/CAM/CAM_rgbFFFFFF.jpg`, `cameras.json` or
    `calibration.csv`.

    Args:
        capture: folder of the capture.
        frame: number of the frame.
        params: another stacked parameter file (such as a tracker's), whose rows are then the motion.
        protocol: protocol whose parameters and labels are taken, with the scan's own labels only if it allows them.
        fitted: whether parameters are required; False where a registration makes them.
        scanned: whether a scan is required; False where it is reconstructed.

    Raises:
        InputError: no such folder, no such protocol, or scan or parameters missing.
    """
    root = Path(capture)
    require_folder(root)
    description = read_description(root)
    files = choose_protocol(root, description, protocol)
    number = f"{frame:06d}"
    # The scan, unless it is reconstructed.
    scan = _first(root / "scans", [f"scan_{number}{suffix}" for suffix in (".ply", ".obj", ".glb")])
    if scan is None and scanned:
        have = sorted(p.name for p in (root / "scans").glob("scan_*") if not p.name.endswith("_labels.npz"))
        raise InputError(
            f"capture {root.name}",
            expected=f"a scan scans/scan_{number}.ply",
            received=f"scans of {', '.join(have[:5]) or 'no frame'}",
            remedy="choose another frame with --frame, or build with --scan, --params and --labels",
        )
    # The parameters, unless the body is registered.
    params_file, row, motion = _parameters(root, files, params, frame)
    if fitted and params_file is None:
        raise InputError(
            f"protocol {files.name} of capture {root.name}",
            expected="a file of parameters",
            received="none",
            remedy="name one with --params, or register the body (--register on)",
        )
    if fitted and params_file is not None and not params_file.is_file():
        raise InputError(
            f"capture {root.name}",
            expected=f"params/{number}.npz or params/params.npz",
            received="neither" if params is None else str(params_file),
            remedy="convert your fit with `smplxpp params convert`",
        )
    # Label maps and images without the cameras that evaluations hold out.
    held_out = set(map(str, description.get("novel_views", ())))
    return ReferenceFrame(
        subject=root.resolve().name,
        frame=frame,
        scan=scan,
        params=params_file if params_file is not None and params_file.is_file() else None,
        params_frame=row,
        motion=motion,
        scan_labels=_first(root / "scans", [f"scan_{number}_labels.npz"]) if files.scan_labels else None,
        label_maps={} if files.labels is None else _by_camera(root / files.labels, f"label{number}", _MAPS, held_out),
        photographs=_by_camera(root / "rgbs", f"rgb{number}", IMAGE_SUFFIXES, held_out),
        cameras_file=_first(root, ["cameras.json", "calibration.csv"]),
    )


def _parameters(
    root: Path, files: ProtocolFiles, given: str | Path | None, frame: int
) -> tuple[Path | None, int, Path | None]:
    """Return the file of the frame's parameters, the row in it, and the file of all frames (None if unknown)."""
    if given is not None:
        named = stacked_params(root, given)
        return named, frame, named if named.is_file() else None
    if files.name is not None:
        chosen = files.parameter_file(root)
        return chosen, frame, chosen
    stacked, single = stacked_params(root), root / "params" / f"{frame:06d}.npz"
    motion = stacked if stacked.is_file() else None
    return (single, 0, motion) if single.is_file() else (stacked, frame, motion)


def _by_camera(folder: Path, tag: str, suffixes: Sequence[str], held_out: set[str]) -> dict[str, Path]:
    """Return the file `CAM/CAM_TAG` of each camera that is not held out."""
    found = {
        path.stem.removesuffix(f"_{tag}"): path
        for path in sorted(folder.glob(f"*/?*_{tag}.*"))
        if path.suffix.lower() in suffixes
    }
    return {name: path for name, path in found.items() if name not in held_out}


def _first(folder: Path, names: list[str]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def find_scans(capture: str | Path) -> dict[int, Path]:
    """Find the scans of a capture folder of the simple layout, `scans/scan_FFFFFF.ply` (`.obj`, `.glb`), by frame."""
    return scans_in(Path(capture) / "scans")


def scans_in(folder: str | Path) -> dict[int, Path]:
    """Find the scans `scan_FFFFFF.ply` (`.obj`, `.glb`) of a folder, by frame."""
    series = FileSeries.find(Path(folder), r"scan_(?P<frame>\d{6})\.(ply|obj|glb)")
    return {int(frame): series.required(int(frame)) for frame in series.numbers}
