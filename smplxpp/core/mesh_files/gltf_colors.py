"""Compute the vertex colours of a glTF primitive: texture times vertex colours times base colour, in linear light."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64, Num, UInt8

from smplxpp.core.colors import decode_srgb, encode_srgb
from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import decode_image
from smplxpp.core.files.json_file import as_number, as_numbers, as_text
from smplxpp.core.mesh_files.gltf_document import GltfDocument
from smplxpp.core.mesh_files.raw_mesh import warn
from smplxpp.core.mesh_files.texture import CLAMP, MIRROR, REPEAT, bounded_places, sample_texture

if TYPE_CHECKING:
    from PIL.Image import Image

# Wrap modes by the OpenGL codes of a sampler's wrapS and wrapT.
_WRAPS = {10497: REPEAT, 33071: CLAMP, 33648: MIRROR}


def primitive_colors(document: GltfDocument, primitive: dict[str, Any], count: int) -> UInt8[np.ndarray, "N 3"] | None:
    """Return the vertex colours of a primitive; None if it has none, or, with a warning, if they are damaged.

    Texture, vertex colours and the factor of the base colour are multiplied (glTF 2.0, section 3.9.2).

    Args:
        document: file of the primitive.
        primitive: JSON object of the primitive.
        count: number of its vertices.
    """
    try:
        factor = _factor(document, primitive)
        found: list[np.ndarray] = [
            colors
            for colors in (_picture_colors(document, primitive, count), _vertex_colors(document, primitive, count))
            if colors is not None
        ]
        if factor is None and not found:
            return None
        # One source without a factor needs no arithmetic.
        if len(found) == 1 and found[0].dtype == np.uint8 and (factor is None or (factor == 1).all()):
            return found[0]  # the file's own bytes, which a round trip through linear light could change
        # Products are formed in linear light, as glTF 2.0 prescribes (section 3.9.2).
        light = np.ones((count, 3)) if factor is None else np.repeat(factor[None], count, axis=0)
        for colors in found:
            light *= _linear(colors) if colors.dtype == np.uint8 else colors
        return _srgb8(light)
    except InputError as error:
        warn(f"{document.subject}: colours of a primitive are lost: {error}")
        return None


def _surface(document: GltfDocument, primitive: dict[str, Any]) -> tuple[dict[str, Any], str, str]:
    """Return the surface description of a material, and its keys of the base colour's texture and factor."""
    if "material" not in primitive:
        return {}, "", ""
    material = document.entry("materials", primitive["material"])
    older = document.part(document.part(material, "extensions"), "KHR_materials_pbrSpecularGlossiness")
    if older:
        return older, "diffuseTexture", "diffuseFactor"
    return document.part(material, "pbrMetallicRoughness"), "baseColorTexture", "baseColorFactor"


def primitive_texture(
    document: GltfDocument, primitive: dict[str, Any], count: int
) -> tuple[Float32[np.ndarray, "N 2"], tuple[str, str], Callable[[], UInt8[np.ndarray, "H W 3"]]] | None:
    """Return texture coordinates (v downwards), wrap modes, and what loads the texture of a primitive's base colour.

    The factor of the base colour is multiplied in, `COLOR_0` is not. None without a texture or where it is damaged,
    which `primitive_colors` warns of.
    """
    try:
        use, uv = _texture_use(document, primitive, count)
        if use is None or uv is None:
            return None
        _picture(document, use)
        factor, index = _factor(document, primitive), _image_index(document, use)
    except InputError:
        return None

    def load() -> UInt8[np.ndarray, "H W 3"]:
        picture = np.array(_decoded(document, index).convert("RGB"))
        return picture if factor is None or (factor == 1).all() else _srgb8(_linear(picture) * factor)

    return bounded_places(uv), _wrap(document, use), load


def _picture_colors(document: GltfDocument, primitive: dict[str, Any], count: int) -> UInt8[np.ndarray, "N 3"] | None:
    """Sample the base colour's texture at the vertices; None without texture or texture coordinates."""
    use, uv = _texture_use(document, primitive, count)
    if use is None or uv is None:
        return None
    # glTF puts the origin of texture coordinates at the upper left corner.
    return sample_texture(_picture(document, use), uv, top_down=True, wrap=_wrap(document, use))


def _texture_use(
    document: GltfDocument, primitive: dict[str, Any], count: int
) -> tuple[dict[str, Any] | None, Float64[np.ndarray, "N 2"] | None]:
    """Return how a primitive uses the texture of its base colour, and its texture coordinates; None without them."""
    surface, name, _ = _surface(document, primitive)
    if name not in surface:
        return None, None
    use = document.part(surface, name)
    # The extension may name another set of texture coordinates than the texture's own.
    transform = document.part(document.part(use, "extensions"), "KHR_texture_transform")
    layer = document.number(transform if "texCoord" in transform else use, "texCoord", 0)
    attributes = document.part(primitive, "attributes")
    if f"TEXCOORD_{layer}" not in attributes:
        return use, None
    uv = document.accessor(attributes[f"TEXCOORD_{layer}"]).astype(np.float64)
    if uv.shape != (count, 2):
        raise InputError("texture coordinates", expected="two a vertex", received=f"shape {uv.shape}")
    return use, _transformed(uv, transform)


def _wrap(document: GltfDocument, use: dict[str, Any]) -> tuple[str, str]:
    """Return the wrap modes of a texture along u and v."""
    texture = document.entry("textures", use.get("index"))
    sampler = document.entry("samplers", texture["sampler"]) if "sampler" in texture else {}
    modes = [_WRAPS.get(document.number(sampler, name, 10497), REPEAT) for name in ("wrapS", "wrapT")]
    return modes[0], modes[1]


def _picture(document: GltfDocument, use: dict[str, Any]) -> UInt8[np.ndarray, "H W 3"]:
    """Return the decoded image of a texture; raises what `_image_index` raises, and for a missing or damaged file."""
    index = _image_index(document, use)
    return document.pictures.get(index, lambda: _decoded(document, index))


def _image_index(document: GltfDocument, use: dict[str, Any]) -> int:
    """Return the number of the image of a texture.

    Raises:
        InputError: pictures of formats alone that are not read (KTX2, AVIF, DDS).
    """
    texture = document.entry("textures", use.get("index"))
    extensions = document.part(texture, "extensions")
    webp = document.part(extensions, "EXT_texture_webp")
    if "source" not in texture and not webp and extensions:
        # KHR_texture_basisu (KTX2), EXT_texture_avif, MSFT_texture_dds without a picture for other readers.
        raise InputError(
            "texture",
            expected="a PNG, JPEG or WebP picture",
            received=f"only the pictures of {', '.join(sorted(map(str, extensions)))}",
            remedy="export the mesh with PNG or JPEG textures, or with one beside the compressed picture",
        )
    return document.number({"source": texture.get("source", webp.get("source"))}, "source")


def _decoded(document: GltfDocument, index: int) -> Image:
    image = document.entry("images", index)
    if "bufferView" in image:
        data: bytes | None = bytes(document.view(image["bufferView"])[0])
        name = f"image {image.get('name', '')}".strip()
    else:
        name = as_text(image.get("uri"), subject="uri of an image")
        data = document.resource(name)
    if data is None:
        raise InputError("picture", expected="a file in the mesh file's folder", received=repr(name[:80]))
    # A picture of another format may stand in the place of PNG or JPEG, too: its first bytes tell.
    known = {b"\xabKTX 20\xbb": "KTX2", b"DDS ": "DDS"}
    kind = next((kind for start, kind in known.items() if data.startswith(start)), "")
    kind = "AVIF" if data[4:12] in (b"ftypavif", b"ftypavis") else kind
    if kind:
        raise InputError(
            f"picture {name[:80]!r}",
            expected="PNG, JPEG or WebP",
            received=kind,
            remedy="export the mesh with PNG or JPEG textures",
        )
    return decode_image(data, subject=f"picture {name[:80]!r}")


def _transformed(uv: Float64[np.ndarray, "N 2"], transform: dict[str, Any]) -> Float64[np.ndarray, "N 2"]:
    """Apply KHR_texture_transform: scale, then rotation, then offset."""
    if not transform:
        return uv
    scale, offset = (
        as_numbers(transform.get(name, default), (2,), subject=f"texture {name}")
        for name, default in (("scale", [1, 1]), ("offset", [0, 0]))
    )
    # Counter-clockwise rotation in a frame whose v points down (KHR_texture_transform).
    angle = as_number(transform.get("rotation", 0), subject="texture rotation")
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    with np.errstate(all="ignore"):
        return (uv * scale) @ turn.T + offset


def _vertex_colors(document: GltfDocument, primitive: dict[str, Any], count: int) -> Num[np.ndarray, "N 3"] | None:
    """Return the vertex colours as sRGB bytes, or as linear floats."""
    attributes = document.part(primitive, "attributes")
    if "COLOR_0" not in attributes:
        return None
    colors = document.accessor(attributes["COLOR_0"])
    if len(colors) != count or colors.shape[1] not in (3, 4):
        raise InputError("vertex colours", expected="one a vertex", received=f"shape {colors.shape}")
    stored = document.entry("accessors", attributes["COLOR_0"]).get("componentType")
    rgb = colors[:, :3].astype(np.float64)
    if stored == 5121:
        # glTF defines vertex colours as linear, but 8-bit ones are in practice sRGB bytes of another file.
        return np.rint(rgb * (255.0 if colors.dtype.kind == "f" else 1.0)).astype(np.uint8)
    # Normalised 16-bit integers.
    rgb = rgb if colors.dtype.kind == "f" else rgb / 65535.0
    return np.clip(np.nan_to_num(rgb), 0.0, 1.0)


def _factor(document: GltfDocument, primitive: dict[str, Any]) -> Float64[np.ndarray, " 3"] | None:
    """Return the linear factor of the base colour; None if the material states none."""
    surface, _, factor = _surface(document, primitive)
    if factor not in surface:
        return None
    return as_numbers(surface[factor], (4,), subject="base colour")[:3]


def _linear(colors: UInt8[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Convert 8-bit sRGB to linear RGB in [0, 1], float64."""
    return decode_srgb(colors / 255.0)


def _srgb8(colors: Num[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
    """Convert linear RGB in [0, 1] to 8-bit sRGB; NaN becomes 0."""
    return np.rint(255 * encode_srgb(np.clip(np.nan_to_num(colors), 0.0, 1.0))).astype(np.uint8)
