"""Image files that a stage names: on disk, inside a .usdz, relative to the layer that names them."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Ar, Sdf, Usd, UsdShade

from ...errors import ImageError
from ...images.spaces import AUTO, NAMES, RAW, SRGB, canonical, told
from ...scene import F64, Texture
from ..values import short
from .udim import Size, is_tiled, read_tiles

_MADE = "made: "
_URI = "data:"


def resolve_asset(attribute: Usd.Attribute, time: Usd.TimeCode) -> str:
    """Path that `read_texture` opens for an asset-valued attribute; '' where nothing is authored.

    The resolver anchors a relative path to the layer that authored it. A path it cannot find is tried once more with
    forward slashes (files written on Windows), and comes back anchored to its layer if that fails too.
    """
    asset = attribute.Get(time)
    if not isinstance(asset, Sdf.AssetPath) or not asset.path:
        return ""
    if asset.resolvedPath:
        return str(asset.resolvedPath)
    if asset.path.startswith(_URI):
        return str(asset.path)
    slashed = asset.path.replace("\\", "/")
    if is_tiled(slashed):  # what the resolver finds is a tile
        for spec in attribute.GetPropertyStack(time):
            if tiles := str(UsdShade.UdimUtils.ResolveUdimPath(slashed, spec.layer)):
                return tiles
    anchored = [str(spec.layer.ComputeAbsolutePath(slashed)) for spec in attribute.GetPropertyStack(time)]
    found = [path for path in anchored if Ar.GetResolver().Resolve(path)]
    return (found or anchored or [str(asset.path)])[0]


def texture_key(path: str, color_space: str) -> str:
    """Name of the texture `read_texture(path, color_space)` gives: the same file may be read both ways."""
    return path if color_space == AUTO else f"{path} ({color_space})"


def of_key(key: str) -> tuple[str, str]:
    """Path and colour space of a texture by its name: what `texture_key` was given."""
    for space in NAMES:
        if key.endswith(f" ({space})"):
            return key.removesuffix(f" ({space})"), space
    return key, AUTO


def made(what: str) -> str:
    """Name of a picture that no file holds, but that was made of others or of nothing."""
    return f"{_MADE}{what}"


def is_made(key: str) -> bool:
    """The texture of that name cannot be read from a file."""
    return key.startswith(_MADE)


def read_texture(path: str, color_space: str) -> Texture:
    """Decode one image file, or all the tiles of a name with <UDIM>: a `udim.Tiled`.

    Args:
        path: A file, or a file inside a package such as `a.usdz[tex/x.png]`.
        color_space: one of `spaces.NAMES`; `auto`: 8-bit files of three or four channels are sRGB, all else raw.

    Raises:
        ImageError: The file is absent, or cannot be decoded.
    """
    from ...images.pictures import read_texture as decode

    name = texture_key(path, color_space)
    if is_tiled(path) and not path.startswith(_URI):
        texel = None if color_space in (AUTO, RAW, SRGB) else 16
        return read_tiles(
            path, name, _there, lambda tile: _size(tile, texel),
            lambda tile: decode(file_of(tile), name=short(tile), color_space=color_space),
        )  # fmt: skip
    return decode(file_of(path), name=name, color_space=color_space)


def screen_of(path: str) -> F64:
    """The matrix a picture was projected by, shape (4, 4), row vectors, as `pictures.world_to_screen` has it.

    Raises:
        ImageError: the file is absent, cannot be read, or has none.
    """
    from ...images.pictures import world_to_screen

    return world_to_screen(file_of(path), short(path))


def _there(path: str) -> bool:
    """There is such a file, on disk or in its package."""
    if Ar.IsPackageRelativePath(path):
        return bool(Ar.GetResolver().Resolve(path))
    return os.path.isfile(path)


def _size(path: str, texel: int | None) -> Size:
    from ...images.pictures import texture_size

    width, height, is_small = texture_size(file_of(path), short(path))
    return Size(width, height, texel or (4 if is_small else 16))


def light_texture(attribute: Usd.Attribute, file: str) -> Texture:
    """The picture of a light or dome, in the colour space of its attribute's metadata, else as its format says.

    Raises:
        ImageError: it cannot be decoded, or has a colour space that is not known.
    """
    space = str(attribute.GetColorSpace()) if attribute.HasColorSpace() else AUTO
    if not (known := canonical(space)):
        raise ImageError(f"{short(file)}: {told(space)}")
    return read_texture(file, known)


def file_of(path: str) -> str | bytes:
    """What a picture is decoded from: the path of a file, or the bytes of one inside a package.

    Raises:
        ImageError: there is no such file.
    """
    if path.startswith(_URI):
        raise ImageError(f"{short(path)}: a picture inside of its name (a data: URI) is not read; save it as a file")
    if not Ar.IsPackageRelativePath(path):
        if not os.path.isfile(path):  # False for a name longer than any file system allows
            text = "no such file; check the path, which is relative to the layer that names it"
            raise ImageError(f"{short(path)}: {text}")
        return path
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if not asset:
        package, inner = Ar.SplitPackageRelativePathOuter(path)
        name = Path(package).name
        raise ImageError(f"{short(path)}: {name} holds no file '{short(inner)}'; look into it with `usdzip -l {name}`")
    return bytes(asset.GetBuffer())
