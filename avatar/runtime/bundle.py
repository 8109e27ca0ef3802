"""Read and write avatars for players: tensors by piece, their description, and the file `NAME.avatar`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from avatar.runtime.layout import BARE, NEEDED, PIECES, REMEDY, check_consistency, check_shapes, decode
from smplxpp.body.layout import HAND_WIDTH, SMPL_JOINTS
from smplxpp.core import BodyParams, InputError
from smplxpp.core.errors import one_line
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text, parse_json
from smplxpp.core.files.package_file import read_package, write_package
from smplxpp.core.files.tensor_bytes import pack_tensors, unpack_tensors
from smplxpp.core.params import ARRAY_NAMES

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


def read_motion(bundle: AvatarBundle, *, subject: str = "motion of the bundle") -> BodyParams | None:
    """Return the motion in a bundle, checked against its body; None if there is none.

    Raises:
        InputError: unknown arrays, wrong shapes or rates, a body's shape, or expressions and components of a hand that
            the body has not.
    """
    # Numbers of every type stand for themselves; the reader of parameters checks shapes, rate and size.
    if not bundle.motion:
        return None
    unknown = set(bundle.motion) - {*ARRAY_NAMES, "fps", "flat_hand_mean"}
    if unknown:
        raise InputError(
            subject, expected="arrays of body parameters", received=", ".join(sorted(unknown))[:200], remedy=REMEDY
        )
    numbers = {name: np.asarray(value, np.float64) for name, value in bundle.motion.items()}
    motion = BodyParams.from_mapping({"expression": np.zeros(0), **numbers}, source=subject)

    # A player has no shape of its own to change, and as many expressions and components of a hand as its skeleton.
    def require(name: str, fits: bool, expected: str) -> None:
        if not fits:
            received = f"shape {getattr(motion, name).shape}"
            raise InputError(f"{subject}: {name}", expected=expected, received=received, remedy=REMEDY)

    E = bundle.sizes["E"]
    require("global_orient", len(motion) > 0, "frames")
    require("betas", motion.betas.shape[1] == 0, "none: the shape is the avatar's")
    require("expression", not motion.expression[:, E:].any(), f"zeros beyond the {E} expressions of the avatar")
    for hand in ("left_hand", "right_hand") if bundle.sizes["J"] > len(SMPL_JOINTS) else ():
        width, components = getattr(motion, f"{hand}_pose").shape[1], bundle.tensors.get(f"skeleton.{hand}_components")
        fits = width == HAND_WIDTH or (components is not None and width <= len(components))
        require(f"{hand}_pose", fits, f"{HAND_WIDTH} angles, or as many components as the avatar has")
    return replace(motion, expression=motion.expression[:, :E])


def undressed(bundle: AvatarBundle, hidden: Collection[int]) -> AvatarBundle:
    """Return a bundle with parts taken off: their Gaussians are transparent, and the skin under them lies bare.

    Skin whose `gaussians.covered` names a hidden part takes offsets, rotations, scales and colours of `BARE`, and is
    opaque; harmonics and blend shapes, which were learned under clothes, do not count there. Everything else keeps its
    bits; without hidden parts the bundle itself is returned. Bundles without `BARE` lose the hidden parts alone.

    Args:
        bundle: the avatar.
        hidden: indices of parts, of `about.part_names`.
    """
    if not hidden:
        return bundle
    t = dict(bundle.tensors)
    off = np.isin(t["surface.parts"][t["surface.faces"][:, 0]], list(hidden)).repeat(t["gaussians.per_face"])
    t["gaussians.opacities"] = np.where(off, np.float32(0.0), t["gaussians.opacities"])
    if all(f"gaussians.{name}" in t for name in BARE):
        bare = np.isin(t["gaussians.covered"], [part for part in hidden if part > 0]) & ~off
        offset, quats, scale, dc = (t[f"gaussians.{name}"][bare] for name in BARE)
        laid = {"offset": offset, "quats": quats, "dc": dc, "log_scales": np.log(scale)[:, None]}
        for name, value in {**laid, "opacities": 1.0, "sh": 0.0}.items():
            t[f"gaussians.{name}"] = t[f"gaussians.{name}"].copy()
            t[f"gaussians.{name}"][bare] = value
        for side in (f"blend.{side}" for side in ("head", "body") if "blend" in bundle):
            t[f"{side}.values"] = t[f"{side}.values"].copy()
            t[f"{side}.values"][:, :, bare[t.get(f"{side}.rows", slice(None))]] = 0
    return replace(bundle, tensors=t)


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
        parse_json(data.pop(_MANIFEST), subject=f"{subject}: manifest", strict=True), subject=f"{subject}: manifest"
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
    check_consistency(about, tensors, sizes, subject)
    # A player checks garments, which it poses for that; a motion is checked here.
    garments, garments_about = raw.get(GARMENTS, ({}, {}))
    bundle = AvatarBundle(about, tensors, sizes, garments, garments_about, raw.get(MOTION, ({}, {}))[0])
    read_motion(bundle, subject=f"{subject}: motion")
    return bundle


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
