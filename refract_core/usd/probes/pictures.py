"""The picture that a probe brings along: read with the probe, and what a bake writes into a layer about it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from pxr import Ar, Sdf, Usd

from ...errors import ImageError
from ...scene import Bake, Cubemap
from ..diagnostics import captured
from ..layers.assets import anchored, copy_of, edit_asset_paths
from ..layers.write import is_over, overlay
from ..materials.textures import file_of, resolve_asset
from .attributes import ProbePrim

MADE = "bake probes"
"""What `layers.write` records of who made a layer."""
_TEXTURE, _RESOLUTION = "probe:texture", "probe:resolution"
_KEY = "refractBake"
"""Dictionary in a probe's customData: digest, engine and timeCode are read; stage and samples are for people."""

ReadCubemap = Callable[[str, int], Cubemap]

# --- reading ----------------------------------------------------------------------------------------------------------


def read_cubemap(path: str, resolution: int) -> Cubemap:
    """Read one file as a cubemap.

    Args:
        path: a file, or a file inside a package such as `a.usdz[tex/x.exr]`
        resolution: of its faces [pixels], whatever the file has

    Raises:
        ImageError: the file is absent, or is no picture that makes a cubemap.
    """
    from ...images.cubemaps import read_cubemap as decode

    return decode(file_of(path), path, resolution)


def picture_of(probe: ProbePrim, mode: str, resolution: int, read: ReadCubemap) -> tuple[Cubemap | None, Bake | None]:
    """The cubemap of a baked or custom probe, and what it was baked from; None means capture."""
    path = _texture_path(probe)
    if mode == "realtime":
        return None, None
    if not path:
        if mode == "custom":
            probe.say("probe:mode is 'custom' but probe:texture is not set; the surroundings are captured instead")
        return None, None
    try:
        cubemap = read(path, resolution)
    except ImageError as error:
        probe.say(f"probe:texture cannot be read; the surroundings are captured instead. {error}")
        return None, None
    return cubemap, _bake_of(probe) if mode == "baked" else None


def refuse_picture(probe: ProbePrim, mode: str) -> None:
    """Tell the author of a planar probe that it has no use for a picture."""
    given = ["probe:mode 'custom'"] * (mode == "custom") + ["probe:texture"] * bool(_texture_path(probe))
    if given:
        verb, them = ("are", "them") if len(given) > 1 else ("is", "it")
        probe.say(f"a planar probe is drawn for every picture; {' and '.join(given)} {verb} ignored. Remove {them}")


def _texture_path(probe: ProbePrim) -> str:
    return resolve_asset(probe.prim.GetAttribute(_TEXTURE), probe.time)


def _bake_of(probe: ProbePrim) -> Bake | None:
    record = probe.prim.GetCustomDataByKey(_KEY)
    if record is None:
        return None
    wrong = _what_is_wrong(record)
    if wrong:
        probe.say(f"customData {_KEY} {wrong}; whether its texture is up to date is not known. Bake it again")
        return None
    return Bake(record["digest"], record["engine"], float(record["timeCode"]))


def _what_is_wrong(record: Any) -> str:
    """'' where the record can be used."""
    if not isinstance(record, dict):
        return "is not a dictionary"
    for name in ("digest", "engine"):
        if not isinstance(record.get(name), str) or not record[name]:
            return f"has no {name}, which must be a text"
    time = record.get("timeCode")
    if isinstance(time, bool) or not isinstance(time, int | float) or not math.isfinite(time):
        return "has no timeCode, which must be a finite number"
    return ""


# --- bakes in layers --------------------------------------------------------------------------------------------------


class Baked(NamedTuple):
    """What a layer says about one probe."""

    texture: str
    """absolute path, which may be inside a package"""
    record: Mapping[str, Any]
    """the customData `refractBake`; empty where there is none"""
    resolution: int | None = None
    """[texels]; None leaves the stage's own"""


def earlier(stage: str, out: str) -> dict[str, Baked]:
    """What OUT says about each probe, where it is an earlier bake of the same stage; nothing where it is not."""
    if not is_over(out, stage, made=MADE):
        return {}
    with captured():
        layer = Sdf.Layer.FindOrOpen(os.path.abspath(out))
        if not layer:
            return {}
        layer.Reload()
    copy = copy_of(layer)
    edit_asset_paths(copy, lambda asset: anchored(asset, layer))
    found: dict[str, Baked] = {}

    def visit(path: Sdf.Path) -> None:
        if path.IsPropertyPath() and path.name == _TEXTURE:
            prim = copy.GetPrimAtPath(path.GetPrimPath())
            resolution = copy.GetAttributeAtPath(path.GetPrimPath().AppendProperty(_RESOLUTION))
            found[str(prim.path)] = Baked(
                copy.GetAttributeAtPath(path).default.path,
                dict(prim.customData.get(_KEY, {})),
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
            prim.customData = {_KEY: dict(baked.record)}
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
    try:
        return file_of(path)
    except ImageError:
        return None


def is_packed(path: str) -> bool:
    """The path leads into a package."""
    return bool(Ar.IsPackageRelativePath(path))
