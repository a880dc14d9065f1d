"""Baked probes in layers: what an earlier bake left behind, and writing a new one down."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from pxr import Ar, Sdf, Usd

from ...images.bake_files import Baked
from ..layers.edit import copy_of, edit_asset_paths, outer_of, quiet
from ..layers.write import is_over, overlay
from ..materials.textures import resolve_asset
from .pictures import BAKE_KEY

MADE = "bake probes"
_TEXTURE, _RESOLUTION = "probe:texture", "probe:resolution"


def earlier(stage: str, out: str) -> dict[str, Baked]:
    """What OUT says about each probe, where it is an earlier bake of the same stage; nothing where it is not."""
    if not is_over(out, stage, made=MADE):
        return {}
    with quiet():
        layer = Sdf.Layer.FindOrOpen(os.path.abspath(out))
        if not layer:
            return {}
        layer.Reload()
    copy = copy_of(layer)
    edit_asset_paths(copy, lambda asset: str(Sdf.ComputeAssetPathRelativeToLayer(layer, asset)) if asset else asset)
    found: dict[str, Baked] = {}

    def visit(path: Sdf.Path) -> None:
        if path.IsPropertyPath() and path.name == _TEXTURE:
            prim = copy.GetPrimAtPath(path.GetPrimPath())
            resolution = copy.GetAttributeAtPath(path.GetPrimPath().AppendProperty(_RESOLUTION))
            found[str(prim.path)] = Baked(
                copy.GetAttributeAtPath(path).default.path,
                dict(prim.customData.get(BAKE_KEY, {})),
                None if resolution is None else resolution.default,
            )

    copy.Traverse(Sdf.Path.absoluteRootPath, visit)
    return found


def layer_of(stage: str, bakes: Mapping[str, Baked]) -> Sdf.Layer:
    """A layer over the stage that gives probes their textures. Raises StageError."""
    layer = overlay(stage, made=MADE)
    for path, baked in sorted(bakes.items()):
        prim = Sdf.CreatePrimInLayer(layer, path)
        texture = Sdf.AttributeSpec(prim, _TEXTURE, Sdf.ValueTypeNames.Asset)
        texture.default = Sdf.AssetPath(baked.texture)
        if baked.resolution is not None:
            resolution = Sdf.AttributeSpec(prim, _RESOLUTION, Sdf.ValueTypeNames.Int, Sdf.VariabilityUniform)
            resolution.default = baked.resolution
        if baked.record:
            prim.customData = {BAKE_KEY: dict(baked.record)}
    return layer


def own_texture(stage: Usd.Stage, path: str, time_code: float) -> str:
    """The texture that the stage itself gives a probe; '' for none."""
    prim = stage.GetPrimAtPath(path)
    return resolve_asset(prim.GetAttribute(_TEXTURE), Usd.TimeCode(time_code)) if prim else ""


def instanced(stage: Usd.Stage, paths: Iterable[str]) -> set[str]:
    """Those of the prims that no layer can change, for they belong to an instance."""
    return {path for path in paths if stage.GetPrimAtPath(path).IsInstanceProxy()}


def read_asset(path: str) -> str | bytes | None:
    """A file to read: its path, or its bytes where it is inside a package; None where it is not there."""
    if not Ar.IsPackageRelativePath(path):
        return path if Path(path).is_file() else None
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path)) if Path(outer_of(path)).is_file() else None
    return bytes(asset.GetBuffer()) if asset else None


def is_packed(path: str) -> bool:
    return bool(Ar.IsPackageRelativePath(path))
