"""Layers out: a thin layer over a stage, opinions in it, and its way to disk, whole or not at all."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

from pxr import Sdf, Tf

from ...errors import StageError, UsageError
from ...files import check_place, replacing
from ..diagnostics import captured
from .assets import absolute, anchored, copy_of, edit_asset_paths, export, files_of, is_expression, outer_of
from .package import pack, tiles

EXTENSIONS = (".usd", ".usda", ".usdc", ".usdz")
GLTF = (".glb", ".gltf")
RECORD = "refract"
"""Key in customLayerData that says what made a layer (`made`) and over which stage (`stage`)."""

# Composed from every layer of the stack, so that a copy in the stronger layer would apply it twice.
STAYS_BELOW = ("subLayers", "subLayerOffsets", "layerRelocates", "primOrder", "hasOwnedSubLayers", "sessionOwner")


# --- before the work ---------------------------------------------------------------------------------------------


def is_gltf(path: str) -> bool:
    """A file by its name."""
    return path.lower().endswith(GLTF)


def check_out(
    stage: str, out: str, *, overwrite: bool, ours: str = "", extensions: tuple[str, ...] = EXTENSIONS
) -> None:
    """Refuse, before any work, a place where no layer over `stage` can be written.

    Args:
        stage: path of the stage, which may be inside a package (`a.usdz[b.usda]`).
        out: path of the layer to write.
        overwrite: an existing file may be replaced.
        ours: what makes the new layer; an existing one that the same thing made over the same stage may be replaced.
        extensions: what OUT may end with.

    Raises:
        UsageError: the extension is unknown, OUT exists, or is the stage or one of the files it is made of.
        StageError: the folder is missing or cannot be written.
    """
    if os.path.splitext(out)[1].lower() not in extensions:
        raise UsageError(f"OUT '{out}' has no extension that is known; end it with one of {', '.join(extensions)}")
    check_place(out, StageError)
    if not os.path.lexists(out):
        return
    if _same(outer_of(stage), out) or any(_same(part, out) for part in files_of(stage)):
        raise UsageError(f"{out}: the stage {stage} is made of this file, and input is never changed; name another OUT")
    if not overwrite and not is_over(out, stage, made=ours):
        raise UsageError(f"{out}: exists already; choose another name, or replace it with --overwrite")


def is_over(out: str, stage: str, *, made: str) -> bool:
    """`out` is a layer over `stage` that `made` made."""
    if not made or not os.path.isfile(out):
        return False
    with captured():
        try:
            layer = Sdf.Layer.OpenAsAnonymous(out, metadataOnly=True)
        except Tf.ErrorException:
            return False
    record = layer.customLayerData.get(RECORD) if layer else None
    if not isinstance(record, dict) or record.get("made") != made:
        return False
    told = str(record.get("stage", ""))
    below = os.path.join(os.path.dirname(os.path.abspath(out)), told)
    return told == _placeless(stage) or _real(below) == _real(stage)


def _real(path: str) -> str:
    outer = outer_of(path)
    return os.path.realpath(outer) + path[len(outer) :]


def _same(path: str, other: str) -> bool:
    both = os.path.exists(path) and os.path.exists(other)
    return os.path.samefile(path, other) if both else _real(path) == _real(other)


# --- the layer ---------------------------------------------------------------------------------------------------


def overlay(stage: str, *, made: str) -> Sdf.Layer:
    """A new layer in memory over a stage: whatever is not authored in it composes as before.

    Its only sublayer is the stage (by absolute path), and it has the stage's own metadata, which USD takes from the
    root layer alone: units, axes, times, default prim and so on.

    Args:
        stage: path of the stage.
        made: what makes the layer, such as `bake probes`; `check_out` asks for it the next time.

    Raises:
        StageError: the stage's root layer cannot be read.
    """
    path = absolute(stage)
    with captured():
        try:
            below = Sdf.Layer.FindOrOpen(path)
        except Tf.ErrorException:
            below = None
        if not below:
            raise StageError(f"{stage}: cannot be read as .usd, .usda, .usdc or .usdz; check the path")
        if not below.dirty:
            below.Reload()  # USD keeps layers in memory; a changed file would show its old content
    layer = Sdf.Layer.CreateAnonymous("overlay.usda")
    layer.subLayerPaths.append(path)
    for key in below.pseudoRoot.ListInfoKeys():
        if key not in STAYS_BELOW:
            layer.pseudoRoot.SetInfo(key, below.pseudoRoot.GetInfo(key))
    # The metadata's asset paths are relative to the stage, and the new layer will lie elsewhere.
    edit_asset_paths(layer, lambda asset: asset if asset == path else anchored(asset, below))
    layer.customLayerData = {**layer.customLayerData, RECORD: {"made": made, "stage": path}}
    return layer


def apply_api(spec: Sdf.PrimSpec, name: str) -> None:
    """Put an API schema in front of those that a spec applies already."""
    known = spec.GetInfo("apiSchemas") if spec.HasInfo("apiSchemas") else Sdf.TokenListOp()
    if known.isExplicit:
        items = Sdf.TokenListOp.CreateExplicit([name, *(one for one in known.explicitItems if one != name)])
    else:
        items = Sdf.TokenListOp()
        items.prependedItems = [name, *(one for one in known.prependedItems if one != name)]
        items.appendedItems = known.appendedItems
        items.deletedItems = [one for one in known.deletedItems if one != name]
    spec.SetInfo("apiSchemas", items)


# --- the file ----------------------------------------------------------------------------------------------------


def save(layer: Sdf.Layer, out: str) -> None:
    """Write a layer in one step: the file appears whole, or not at all. The layer itself is not changed.

    .usda is text, .usdc and .usd are crate. Absolute asset paths become relative to OUT where both lie in one tree;
    relative ones are relative to OUT already. A .usdz holds everything the layer refers to: itself first, and what it
    takes from other packages as plain files beside it. What it names but is not there keeps its name alone: a package
    tells nobody how the folders lie that it was made in.

    Args:
        layer: as `overlay` gives it, with opinions added.
        out: path of the file; `check_out` says whether it will do.

    Raises:
        StageError: the file cannot be written, or something cannot be packed.
    """
    written = copy_of(layer)
    _record_relative(written, out)
    with replacing(out, StageError) as temporary:
        if out.lower().endswith(".usdz"):
            folder = os.path.dirname(os.path.abspath(out))
            edit_asset_paths(written, lambda asset: _found(_joined(folder, asset)))
            pack(written, temporary, out)
        else:
            edit_asset_paths(written, lambda asset: _relative(asset, out))
            export(written, temporary, out)


def packed(stage: str) -> bytes:
    """A .usdz with everything in it that a stage is made of, to be sent. Raises StageError where that cannot be."""
    if stage.lower().endswith(".usdz"):
        return Path(stage).read_bytes()
    with tempfile.TemporaryDirectory(prefix="refract-send-") as folder:
        file = os.path.join(folder, "stage.usdz")
        save(overlay(stage, made="send"), file)
        return Path(file).read_bytes()


def _joined(folder: str, asset: str) -> str:
    outer = outer_of(asset)
    if not asset or is_expression(asset) or "://" in asset or os.path.isabs(outer):
        return asset
    return os.path.normpath(os.path.join(folder, outer)) + asset[len(outer) :]


def _found(asset: str) -> str:
    """A path that leads nowhere, without its folder."""
    outer = outer_of(asset)
    if is_expression(asset) or not os.path.isabs(outer) or os.path.isfile(outer) or tiles(outer):
        return asset
    return f"./{os.path.basename(outer)}" + asset[len(outer) :]


def _record_relative(layer: Sdf.Layer, out: str) -> None:
    data: dict[str, Any] = dict(layer.customLayerData)
    record = data.get(RECORD)
    if isinstance(record, dict) and "stage" in record:
        stage = _relative(str(record["stage"]), out)
        if out.lower().endswith(".usdz") and os.path.isabs(outer_of(stage)):
            stage = _placeless(stage)
        layer.customLayerData = {**data, RECORD: {**record, "stage": stage}}


def _placeless(path: str) -> str:
    """A file's name and a digest of where it lies: enough to know it again, and no folder is told."""
    return f"{os.path.basename(path)} {hashlib.sha256(_real(path).encode()).hexdigest()[:16]}"


def _relative(asset: str, out: str) -> str:
    """An absolute path as seen from the folder of `out`, if there is a way that does not climb up to the root."""
    outer = outer_of(asset)
    if is_expression(asset) or not os.path.isabs(outer):
        return asset
    folder = os.path.dirname(os.path.abspath(out))
    try:
        shared = os.path.commonpath([folder, outer])
    except ValueError:  # another drive
        return asset
    if shared == os.path.dirname(shared) and folder != shared:
        return asset
    steps = Path(os.path.relpath(outer, folder)).as_posix()
    # Without the dot USD would look through its search path too.
    return (steps if steps.startswith("../") else f"./{steps}") + asset[len(outer) :]
