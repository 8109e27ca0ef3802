"""Read and write avatars for players: tensors by piece, their description, and the file `NAME.avatar`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from avatar.runtime.layout import MAX_GAUSSIANS, NEEDED, PIECES, REMEDY, check_shapes, decode
from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core import BodyParams, InputError
from smplxpp.core.errors import one_line
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text, parse_json
from smplxpp.core.files.package_file import read_package, write_package
from smplxpp.core.files.tensor_bytes import pack_tensors, unpack_tensors

FORMAT, VERSION = "smplxpp-avatar", 2
"""Version 2 added a regression for poses without a code."""
SUFFIX = ".avatar"
GARMENTS, MOTION = "garments", "motion"
_MANIFEST = "manifest.json"
_EXPECTED = "an avatar that `smplxpp export` wrote"


@dataclass(frozen=True, kw_only=True)
class AboutAvatar:
    """The description of an avatar in its bundle.

    Attributes:
        name: of the person or the run.
        licence: of the avatar.
        provenance: short texts on its sources and training.
        joint_names: of the skeleton.
        expression_names: of the expressions.
        part_names: of the parts of the surface.
        frames: frames with a code, in the order of the codes.
        null_code_shown: whether new poses use the zero code; else that of the first frame.
        jaw: whether the jaw's rotation also drives the head's blend shapes.
        eps2d: blur of the splats in training, pixels squared.
        reductions: quantisation of the tensors, by piece.
    """

    name: str
    licence: str = ""
    provenance: Mapping[str, str] = field(default_factory=dict)
    joint_names: tuple[str, ...]
    expression_names: tuple[str, ...] = ()
    part_names: tuple[str, ...] = ()
    frames: tuple[int, ...] = ()
    null_code_shown: bool = False
    jaw: bool = False
    eps2d: float = 0.1
    reductions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class AvatarBundle:
    """The decoded content of an avatar's file.

    Attributes:
        about: description.
        tensors: by "piece.name" (`avatar.runtime.layout.PIECES`), float32 and int32; blend shapes may stay int8.
        sizes: numbers of joints J, vertices V, faces F, Gaussians N, expressions E and the other letters of `PIECES`.
        garments: arrays of the loose clothes for their own reader; empty: none.
        garments_about: metadata of the garments' file.
        motion: arrays of a motion for their own reader; empty: none.
    """

    about: AboutAvatar
    tensors: Mapping[str, np.ndarray]
    sizes: Mapping[str, int]
    garments: Mapping[str, np.ndarray] = field(default_factory=dict)
    garments_about: Mapping[str, Any] = field(default_factory=dict)
    motion: Mapping[str, np.ndarray] = field(default_factory=dict)

    __repr__ = one_line

    def __contains__(self, piece: str) -> bool:
        return any(name.startswith(f"{piece}.") for name in self.tensors)


def save_bundle(
    path: str | Path, about: AboutAvatar, pieces: Mapping[str, tuple[Mapping[str, np.ndarray], Mapping[str, Any]]]
) -> dict[str, int]:
    """Write a bundle; the same content gives the same bytes, and a failed write leaves no file.

    Args:
        path: the file.
        about: description of the avatar.
        pieces: tensors as they are stored, and metadata, by the name of the piece.

    Returns:
        Bytes of each piece in the file, and of the whole file as "total".
    """
    # The manifest records size and digest of every piece, so that a reader finds damage before it decodes anything.
    data = {f"{name}.safetensors": pack_tensors(tensors, metadata) for name, (tensors, metadata) in pieces.items()}
    packed = write_package(path, {_MANIFEST: _manifest(asdict(about), data), **data})
    return {**{file.split(".")[0]: size for file, size in packed.items()}, "total": Path(path).stat().st_size}


def save_with_motion(path: str | Path, bundle: str | Path, motion: BodyParams) -> None:
    """Write a copy of a bundle with another motion; all other pieces keep their bytes.

    Raises:
        InputError: as `load_bundle`.
    """
    # Check the source first; then copy its pieces as bytes, and replace the motion alone.
    load_bundle(bundle)
    data = read_package(bundle, subject="avatar", expected=_EXPECTED, remedy=REMEDY)
    manifest = parse_json(data[_MANIFEST], subject=f"avatar {bundle}: manifest")
    pieces = {f"{name}.safetensors": data[entry["file"]] for name, entry in manifest["pieces"].items()}
    pieces[f"{MOTION}.safetensors"] = pack_tensors(motion_tensors(motion), {})
    write_package(path, {_MANIFEST: _manifest(manifest["model"], pieces), **pieces})


def motion_tensors(motion: BodyParams) -> dict[str, np.ndarray]:
    """Return the piece `motion` of a bundle: body parameters without the shape, which the bundle has."""
    return {name: np.asarray(value, np.float32) for name, value in motion.without_shape().as_dict().items()}


def _manifest(model: Mapping[str, Any], data: Mapping[str, bytes]) -> bytes:
    pieces = {
        file.split(".")[0]: {"file": file, "bytes": len(value), "sha256": hashlib.sha256(value).hexdigest()}
        for file, value in data.items()
    }
    manifest = {"format": FORMAT, "version": VERSION, "model": model, "pieces": pieces}
    return json.dumps(manifest, indent=1).encode()


def load_bundle(path: str | Path) -> AvatarBundle:
    """Read a bundle, and check every piece against its digest and every tensor against `PIECES`.

    Digests reveal damage, but no change of both a piece and the manifest.

    Raises:
        InputError: a missing, damaged, changed or foreign file, a newer version, more than half a GiB
            unpacked, numbers that are not finite or inconsistent.
    """
    # The manifest first: format and version decide whether the rest can be read at all.
    subject = f"avatar {path}"
    data = read_package(path, subject="avatar", expected=_EXPECTED, remedy=REMEDY)
    if _MANIFEST not in data:
        raise InputError(subject, expected=_EXPECTED, received=f"a zip without {_MANIFEST}", remedy=REMEDY)
    manifest = as_object(
        parse_json(data.pop(_MANIFEST), subject=f"{subject}: manifest"), subject=f"{subject}: manifest"
    )
    _check_version(manifest, subject)
    raw = _checked_pieces(manifest, data, subject)
    # Quantised tensors become floats, and shapes define the sizes (J, V, N ...) that all pieces must share.
    about = _about(as_object(manifest.get("model"), subject=f"{subject}: model"), f"{subject}: model")
    tensors: dict[str, np.ndarray] = {}
    there = tuple(piece for piece in PIECES if piece in raw or piece in NEEDED)
    for piece in there:
        own = decode(raw.get(piece, ({}, {}))[0], piece, f"{subject}: {piece}")
        tensors |= {f"{piece}.{name}": value for name, value in own.items()}
    sizes = check_shapes(tensors, there, subject)
    _check_consistency(about, tensors, sizes, subject)
    # Garments and motion have checks of their own, in the modules that use them.
    garments, garments_about = raw.get(GARMENTS, ({}, {}))
    return AvatarBundle(about, tensors, sizes, garments, garments_about, raw.get(MOTION, ({}, {}))[0])


def _check_version(manifest: Mapping[str, Any], subject: str) -> None:
    if manifest.get("format") != FORMAT:
        raise InputError(subject, expected=_EXPECTED, received="a manifest of another format", remedy=REMEDY)
    version = as_integer(manifest.get("version"), subject=f"{subject}: version", least=1)
    if version > VERSION:
        raise InputError(
            subject,
            expected=f"version {VERSION} or older",
            received=f"version {version}",
            remedy="update smplxpp to the version that wrote it",
        )


def _checked_pieces(
    manifest: Mapping[str, Any], data: Mapping[str, bytes], subject: str
) -> dict[str, tuple[dict[str, np.ndarray], dict[str, Any]]]:
    # Every piece of the manifest has to be a known one, with the digest of its bytes.
    entries = as_object(manifest.get("pieces"), subject=f"{subject}: pieces")
    out, files = {}, set()
    for name, value in entries.items():
        entry = as_object(value, subject=f"{subject}: piece {name}")
        file = as_text(entry.get("file"), subject=f"{subject}: piece {name}")
        files.add(file)
        content = data.get(file)
        if content is None or name not in (*PIECES, GARMENTS, MOTION):
            raise InputError(
                f"{subject}: piece {name}",
                expected="one of its version, in the file",
                received="none" if content is None else "another",
                remedy=REMEDY,
            )
        digest = hashlib.sha256(content).hexdigest()
        if entry.get("bytes") != len(content) or entry.get("sha256") != digest:
            raise InputError(
                f"{subject}: piece {name}",
                expected=f"the {entry.get('bytes')!r} bytes that the manifest's digest is of",
                received=f"{len(content)} bytes with SHA-256 {digest[:16]}...",
                remedy="the file was changed or damaged: use the original",
            )
        out[name] = unpack_tensors(content, subject=f"{subject}: {name}", remedy=REMEDY)
    # A file without an entry has no digest, so that it cannot be trusted.
    if set(data) - files:
        raise InputError(
            subject,
            expected="the pieces of its manifest alone",
            received=f"{min(set(data) - files)} beside them",
            remedy=REMEDY,
        )
    return out


def _about(stored: Mapping[str, Any], subject: str) -> AboutAvatar:
    def texts(name: str) -> tuple[str, ...]:
        return tuple(
            as_text(one, subject=f"{subject}: {name}")
            for one in as_list(stored.get(name), subject=f"{subject}: {name}")
        )

    def notes(name: str) -> dict[str, str]:
        values = as_object(stored.get(name), subject=f"{subject}: {name}")
        return {key: as_text(value, subject=f"{subject}: {name}") for key, value in values.items()}

    # The description comes from JSON, so that every field is checked for its type; unknown fields are ignored.
    for name in ("null_code_shown", "jaw"):
        if not isinstance(stored.get(name), bool):
            raise InputError(f"{subject}: {name}", expected="true or false", received=repr(stored.get(name))[:80])
    frames = as_list(stored.get("frames"), subject=f"{subject}: frames")
    return AboutAvatar(
        name=as_text(stored.get("name"), subject=f"{subject}: name"),
        licence=as_text(stored.get("licence"), subject=f"{subject}: licence"),
        provenance=notes("provenance"),
        joint_names=texts("joint_names"),
        expression_names=texts("expression_names"),
        part_names=texts("part_names"),
        frames=tuple(as_integer(frame, subject=f"{subject}: frames", least=0) for frame in frames),
        null_code_shown=stored["null_code_shown"],
        jaw=stored["jaw"],
        eps2d=as_number(stored.get("eps2d"), subject=f"{subject}: eps2d", least=0.0, most=100.0),
        reductions=notes("reductions"),
    )


def _check_consistency(
    about: AboutAvatar, tensors: Mapping[str, np.ndarray], sizes: Mapping[str, int], subject: str
) -> None:
    """Check the values of tensors, and their agreement with the description, where shapes do not suffice."""

    def require(condition: bool, what: str, expected: str, received: object) -> None:
        if not condition:
            raise InputError(f"{subject}: {what}", expected=expected, received=str(received)[:200], remedy=REMEDY)

    # Skeleton, then Gaussians, surface, field, regression and blend shapes.
    parents, faces, count = tensors["skeleton.parents"], tensors["gaussians.per_face"], sizes["N"]
    require(sizes["J"] in JOINT_NAMES, "joints", f"{' or '.join(map(str, JOINT_NAMES))} of them", sizes["J"])
    # Forward kinematics goes through the joints once, and needs each parent before its children.
    ordered = parents[0] == -1 and bool((parents[1:] >= 0).all() and (parents[1:] < np.arange(1, sizes["J"])).all())
    require(ordered, "skeleton.parents", "the root first, every parent before its children", parents.tolist())
    for what, names, letter in (
        ("joint_names", about.joint_names, "J"),
        ("expression_names", about.expression_names, "E"),
    ):
        require(len(names) == sizes[letter], what, f"{sizes[letter]} names", len(names))
    require(0 < count <= MAX_GAUSSIANS, "gaussians", f"1 to {MAX_GAUSSIANS}", count)
    require(
        bool((faces >= 0).all()) and int(faces.sum()) == count, "gaussians.per_face", f"counts of {count}", "others"
    )
    # Spherical harmonics of degree 1 to d have (d + 1)^2 - 1 coefficients.
    require(sizes["K"] in (0, 3, 8, 15), "gaussians.sh", "0, 3, 8 or 15 coefficients", sizes["K"])
    require(
        bool((np.square(tensors["gaussians.quats"]).sum(1) > 1e-6).all()), "gaussians.quats", "lengths above 0", "0"
    )
    # Weights are stored in 16 bits, and may miss a sum of 1 by rounding.
    opacity, weights = tensors["gaussians.opacities"], tensors["surface.joint_weights"]
    require(bool((opacity >= 0).all() and (opacity <= 1).all()), "gaussians.opacities", "values in [0, 1]", "others")
    sums = weights.sum(1)
    positive = bool((weights >= 0).all() and (np.abs(sums - 1.0) < 0.01).all())
    require(positive, "surface.joint_weights", "rows that sum to 1", "others")
    for name, most in (("parts", len(about.part_names)), ("labels", 256), ("colors", 256)):
        value = tensors[f"surface.{name}"]
        require(
            not value.size or (value.min() >= 0 and value.max() < most),
            f"surface.{name}",
            f"values in [0, {most})",
            "others",
        )
    # The skin's vertices come first, since expressions and pose correctives index them alone.
    body_first = bool((np.diff(tensors["surface.parts"]) >= 0).all())
    require(body_first, "surface.parts", "the parts one after the other", "another order")
    if "P" in sizes:
        require(sizes["P"] == 9 * (sizes["J"] - 1), "surface.pose", f"{9 * (sizes['J'] - 1)} directions", sizes["P"])
    # A positional encoding has 3 + 6 L numbers: the point, and L sines and cosines of three coordinates.
    if "field.points" in tensors:
        bands, inputs = sizes["X"] - 3, 63 + sizes["Z"]
        require(bands % 6 == 0 and 0 <= bands <= 96, "field", "bands of sines and cosines", f"{bands} inputs")
        require(sizes["Y"] == inputs, "field of_frame", f"{inputs} inputs", sizes["Y"])
        require(sizes["T"] == len(about.frames) > 0, "field.codes", f"{len(about.frames)} codes", sizes["T"])
    # Angles are clamped to [low, high], which has to be an interval.
    if "regression.level" in tensors:
        require("field.points" in tensors, "regression", "a field whose points it moves", "none")
        low, high = tensors["regression.low"], tensors["regression.high"]
        require(bool((low <= high).all()), "regression.low", "at most `high`", "more")
    if "blend.head.values" in tensors:
        _check_blend(about, tensors, sizes, require)


def _check_blend(about: AboutAvatar, tensors: Mapping[str, np.ndarray], sizes: Mapping[str, int], require: Any) -> None:
    # The head is driven by the expression, or by it and the jaw's three angles; the body by 63 pose angles.
    part = tensors.get("blend.part")
    parts = 1 if part is None else int(part.max()) + 1
    require(part is None or part.min() >= 0, "blend.part", "no negative number", "one")
    inputs = {"head": None if about.jaw else sizes["head_i"], "body": 63}
    if about.jaw:
        inputs["head"] = max(sizes["head_i"], 4)
    for side in ("head", "body"):
        shapes, rows = sizes[f"{side}_n"], tensors.get(f"blend.{side}.rows")
        outputs, values = sizes[f"{side}_o"], tensors[f"blend.{side}.values"]
        # The network gives all shapes' coefficients for each part, one part after the other.
        fits = outputs % max(shapes, 1) == 0 and outputs >= parts * shapes
        require(fits, f"blend.{side}", f"{parts} x {shapes} coefficients", outputs)
        require(sizes[f"{side}_i"] == inputs[side], f"blend.{side}", f"{inputs[side]} inputs", sizes[f"{side}_i"])
        if rows is None:
            require(sizes[f"{side}_m"] == sizes["N"], f"blend.{side}", f"{sizes['N']} rows", sizes[f"{side}_m"])
        else:
            require(bool((np.diff(rows) > 0).all()), f"blend.{side}.rows", "increasing numbers", "others")
        # Integers need steps to become numbers again; an exponent
        # of at most 24 keeps 127 * 2^24 steps well within float32.
        steps = tensors.get(f"blend.{side}.step")
        require((values.dtype == np.int8) == (steps is not None), f"blend.{side}.step", "steps of integers", "others")
        exponents = tensors.get(f"blend.{side}.exponent")
        require(
            exponents is None or bool(((exponents >= 0) & (exponents <= 24)).all()),
            f"blend.{side}.exponent",
            "0 to 24",
            "others",
        )
