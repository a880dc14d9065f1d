"""Asset paths: those in a layer, the files they lead to, and a layer's own way to a file."""

from __future__ import annotations

import os
from collections.abc import Callable

from pxr import Ar, Sdf, Tf, UsdUtils

from ...errors import StageError
from ..diagnostics import captured, words_of
from . import mtlx

# --- one path ----------------------------------------------------------------------------------------------------


def outer_of(path: str) -> str:
    """The file on disk that a path inside a package lies in; any other path as it is."""
    return Ar.SplitPackageRelativePathOuter(path)[0] if Ar.IsPackageRelativePath(path) else path


def absolute(path: str) -> str:
    """Path of a stage or layer, which may be inside a package, as every folder of this machine knows it."""
    outer = outer_of(path)
    return os.path.abspath(outer) + path[len(outer) :]


def anchored(asset: str, layer: Sdf.Layer) -> str:
    """An asset path of a layer, as it leads to the same file from anywhere else."""
    if not asset or is_expression(asset):
        return asset
    return str(Sdf.ComputeAssetPathRelativeToLayer(layer, asset))


def is_expression(asset: str) -> bool:
    """An asset path with variables, which USD evaluates where it is used."""
    return asset.startswith("`")


# --- the files of a stage ----------------------------------------------------------------------------------------


def dependencies(path: str) -> tuple[list[str], list[str]]:
    """Absolute paths of every file that a stage or layer is made of (itself, layers with all variants, packages,
    textures), as far as they exist; and the asset paths that lead nowhere.

    Raises:
        Tf.ErrorException: a part of it is damaged.
    """
    with captured():
        layers, assets, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(path))
    found = [path, *(layer.realPath for layer in layers), *map(str, assets)]
    found += [file for layer in layers for file in mtlx.replaced_in(layer)]
    for file in [one for one in found if one.lower().endswith(mtlx.EXTENSION)]:  # USD does not look into it
        found += mtlx.pictures_of(file)
    return _on_disk(found), [name for name in missing if not mtlx.stands_in(name)]


def files_of(path: str) -> list[str]:
    """The files of `dependencies`; of a stage with a damaged part itself alone, for opening it tells about that."""
    try:
        return dependencies(path)[0]
    except Tf.ErrorException:
        return _on_disk([path])


def documentation(path: str) -> str:
    """What a layer says of itself; '' where it says nothing or cannot be read."""
    with captured():
        try:
            layer = Sdf.Layer.FindOrOpen(path)
        except Tf.ErrorException:
            return ""
    return str(layer.documentation) if layer else ""


def _on_disk(paths: list[str]) -> list[str]:
    files = {os.path.abspath(outer_of(path)) for path in paths if path}
    return sorted(file for file in files if os.path.isfile(file))


# --- layers ------------------------------------------------------------------------------------------------------


def edit_asset_paths(layer: Sdf.Layer, edit: Callable[[str], str]) -> None:
    """Replace every asset path in a layer: sublayers, arcs, clips, values, metadata."""
    offsets = list(layer.subLayerOffsets)
    UsdUtils.ModifyAssetPaths(layer, edit)
    for index, offset in enumerate(offsets):  # USD forgets them when it replaces the path (usd-core 26.11)
        if layer.subLayerOffsets[index] != offset:
            layer.subLayerOffsets[index] = offset


def asset_paths(layer: Sdf.Layer) -> list[str]:
    """Every asset path in a layer, as `edit_asset_paths` meets them."""
    found: list[str] = []

    def note(asset: str) -> str:
        found.append(asset)
        return asset

    UsdUtils.ModifyAssetPaths(layer, note)  # which changes nothing, for nothing differs
    return list(dict.fromkeys(found))


def copy_of(layer: Sdf.Layer) -> Sdf.Layer:
    """The same content in memory, to be edited without anybody noticing."""
    copy = Sdf.Layer.CreateAnonymous("copy.usda")
    copy.TransferContent(layer)
    mtlx.as_authored(layer, copy)
    return copy


def export(layer: Sdf.Layer, path: str, out: str) -> None:
    """Write a layer to `path`; errors speak of `out`."""
    with captured():
        try:
            written = layer.Export(path)
        except Tf.ErrorException as error:
            reason = words_of(error.args[0])
            raise StageError(f"{out}: cannot be written: {reason}") from error
    if not written:
        raise StageError(f"{out}: cannot be written; is there space, and may the folder be written?")
