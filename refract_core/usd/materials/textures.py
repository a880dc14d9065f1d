"""Image files that a stage names: on disk, inside a .usdz, relative to the layer that names them."""

from __future__ import annotations

from pathlib import Path

from pxr import Ar, Sdf, Usd

from ...errors import ImageError
from ...scene import Texture

COLOR_SPACES = ("auto", "raw", "sRGB")
_MADE = "made: "


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
    slashed = asset.path.replace("\\", "/")
    anchored = [str(spec.layer.ComputeAbsolutePath(slashed)) for spec in attribute.GetPropertyStack(time)]
    found = [path for path in anchored if Ar.GetResolver().Resolve(path)]
    return (found or anchored or [str(asset.path)])[0]


def texture_key(path: str, color_space: str) -> str:
    """Name of the texture `read_texture(path, color_space)` gives: the same file may be read both ways."""
    return path if color_space == "auto" else f"{path} ({color_space})"


def of_key(key: str) -> tuple[str, str]:
    """Path and colour space of a texture by its name: what `texture_key` was given."""
    for space in COLOR_SPACES:
        if key.endswith(f" ({space})"):
            return key.removesuffix(f" ({space})"), space
    return key, "auto"


def made(what: str) -> str:
    """Name of a picture that no file holds, but that was made of others or of nothing."""
    return f"{_MADE}{what}"


def is_made(key: str) -> bool:
    """The texture of that name cannot be read from a file."""
    return key.startswith(_MADE)


def read_texture(path: str, color_space: str) -> Texture:
    """Decode one image file.

    Args:
        path: A file, or a file inside a package such as `a.usdz[tex/x.png]`.
        color_space: `raw`, `sRGB`, or `auto` (8-bit files of three or four channels are sRGB, all else raw).

    Raises:
        ImageError: The file is absent, is a set of UDIM tiles, or cannot be decoded.
    """
    from ...images.pictures import read_texture as decode

    if color_space not in COLOR_SPACES:
        raise ImageError(f"{path}: colour space '{color_space}' is not one of {', '.join(COLOR_SPACES)}")
    if "<UDIM>" in path:
        raise ImageError(f"{path}: UDIM tiles are not read; name a single image file")
    name = texture_key(path, color_space)
    return decode(file_of(path), name=name, color_space=color_space)


def file_of(path: str) -> str | bytes:
    """What a picture is decoded from: the path of a file, or the bytes of one inside a package.

    Raises:
        ImageError: there is no such file.
    """
    if not Ar.IsPackageRelativePath(path):
        if not Path(path).is_file():
            raise ImageError(f"{path}: no such file; check the path, which is relative to the layer that names it")
        return path
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
    if not asset:
        package, inner = Ar.SplitPackageRelativePathOuter(path)
        name = Path(package).name
        raise ImageError(f"{path}: {name} holds no file '{inner}'; look into it with `usdzip -l {name}`")
    return bytes(asset.GetBuffer())
