"""What writing layers and packing them share: quiet calls into USD, asset paths, files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pxr import Ar, Sdf, Tf, UsdUtils

from ...errors import StageError


def words_of(diagnostic: Any) -> str:
    """What USD says, in one line. It quotes files, and those may hold bytes that are no text."""
    try:
        return " ".join(str(diagnostic.commentary).split())
    except UnicodeDecodeError:
        return "USD's own words quote bytes of the file that are not text"


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps USD's warnings off stderr."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()


def outer_of(path: str) -> str:
    """The file on disk that a path inside a package lies in; any other path as it is."""
    return Ar.SplitPackageRelativePathOuter(path)[0] if Ar.IsPackageRelativePath(path) else path


def is_expression(asset: str) -> bool:
    """An asset path with variables, which USD evaluates where it is used."""
    return asset.startswith("`")


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
    copy = Sdf.Layer.CreateAnonymous("copy.usda")
    copy.TransferContent(layer)
    return copy


def export(layer: Sdf.Layer, path: str, out: str) -> None:
    """Write a layer to `path`; errors speak of `out`."""
    with quiet():
        try:
            written = layer.Export(path)
        except Tf.ErrorException as error:
            reason = words_of(error.args[0])
            raise StageError(f"{out}: cannot be written: {reason}") from error
    if not written:
        raise StageError(f"{out}: cannot be written; is there space, and may the folder be written?")
