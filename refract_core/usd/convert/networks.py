"""A mapped input written as a shading network: UsdUVTexture or UsdPrimvarReader, or their MaterialX twins."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

from pxr import Gf, Sdf, UsdShade

from ...images.spaces import AUTO, RAW, SRGB
from ...scene import Channel, Source, Texture
from ..materials.sources import is_constant, scaled
from ..materials.textures import is_made, of_key
from ..materials.udim import moved_out

_TYPES = Sdf.ValueTypeNames
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


class Mapped(NamedTuple):
    """A picture or primvar that drives an input, with all that is needed to write it down elsewhere."""

    source: Source
    texture: str
    """Key of the picture, as `textures.texture_key` makes it; '' for a primvar."""

    def told(self) -> str:
        """What it is, for a person."""
        return self.texture or f"primvars:{self.source.primvar}"


def mapped(source: Source, textures: dict[str, Texture]) -> Mapped:
    """A source of a stage that was read with these textures."""
    if source.texture < 0:
        return Mapped(source, "")
    key = list(textures)[source.texture]
    return Mapped(moved_out(source, textures[key]), key)


def writable(what: Mapped) -> bool:
    """A network of standard nodes says the same: a primvar's reader has no scale, a picture's coordinates no shear, and
    a picture lies in a file."""
    source = what.source
    if source.texture < 0:
        return is_constant(source) or source == replace(source, scale=(1.0,) * 4, bias=(0.0,) * 4)
    return not is_made(what.texture) and _moved(source.uv_matrix) is not None


def author(layer: Sdf.Layer, home: str, name: str, what: Mapped, *, color: bool, mtlx: bool = False) -> str:
    """Write the network of one input into a material.

    Args:
        layer: where it is written; Sdf alone, so that it is the same with or without any schema.
        home: path of the material, or of what a layer can reach of it.
        name: of the input; the new nodes begin with it.
        what: `writable`.
        color: three numbers are wanted, else one.
        mtlx: MaterialX nodes, else those of UsdPreviewSurface.

    Returns:
        Path of the output to connect to.
    """
    source, nodes = what.source, _Nodes(layer, Sdf.Path(home), name, mtlx)
    if source.texture < 0:
        kind = ("vector3" if mtlx else "float3") if color else "float"
        fallback = Gf.Vec3f(*source.value[:3]) if color else source.value[0]
        reader = nodes.make("primvar", f"UsdPrimvarReader_{kind}")
        _set(reader, "varname", _TYPES.String, source.primvar)
        _set(reader, "fallback", _TYPES.Float3 if color else _TYPES.Float, fallback)
        return _output(reader, "out" if mtlx else "result", _TYPES.Float3 if color else _TYPES.Float)
    path, space = of_key(what.texture)
    node = nodes.make("texture", "UsdUVTexture_23" if mtlx else "UsdUVTexture")
    file = _set(node, "file", _TYPES.Asset, Sdf.AssetPath(path))
    if mtlx:
        file.SetInfo("colorSpace", {RAW: "lin_rec709", SRGB: "srgb_texture", AUTO: "srgb_texture"}.get(space, space))
    elif space in (AUTO, RAW, SRGB):  # all that the node has words for
        _set(node, "sourceColorSpace", _TYPES.Token, space)
    else:
        _set(node, "sourceColorSpace", _TYPES.Token, AUTO)
        file.SetInfo("colorSpace", space)
    for axis, wrap in zip("ST", source.wrap, strict=True):
        word = "periodic" if mtlx and wrap.name == "REPEAT" else wrap.name.lower()
        _set(node, f"wrap{axis}", _TYPES.String if mtlx else _TYPES.Token, word)
    _set(node, "fallback", _TYPES.Float4, Gf.Vec4f(*source.value))
    for word, four, neutral in (("scale", source.scale, 1.0), ("bias", source.bias, 0.0)):
        if four != (neutral,) * 4:
            _set(node, word, _TYPES.Float4, Gf.Vec4f(*four))
    _connect(node, "st", _TYPES.Float2, _coordinates(nodes, source, mtlx))
    if source.channel is Channel.RGB:
        return _output(node, "rgb" if color else "r", _TYPES.Float3 if color else _TYPES.Float)
    return _output(node, source.channel.name.lower(), _TYPES.Float)


def author_normal(layer: Sdf.Layer, home: str, name: str, what: Mapped) -> str:
    """A tangent space normal as MaterialX has it: packed into 0 .. 1, and a `normalmap` that unpacks it."""
    packed = author(layer, home, name, what._replace(source=scaled(what.source, 0.5, 0.5)), color=True, mtlx=True)
    node = _Nodes(layer, Sdf.Path(home), name, True).make("map", "normalmap_float")
    _connect(node, "in", _TYPES.Float3, packed)
    return _output(node, "out", _TYPES.Float3)


def connect(layer: Sdf.Layer, path: str, name: str, kind: Sdf.ValueTypeName, output: str) -> None:
    """Drive an input of a prim by an output."""
    _connect(Sdf.CreatePrimInLayer(layer, path), name, kind, output)


class _Nodes(NamedTuple):
    """Makes the nodes of one input, each under a name of its own."""

    layer: Sdf.Layer
    home: Sdf.Path
    name: str
    mtlx: bool

    def make(self, part: str, identifier: str) -> Sdf.PrimSpec:
        base, count = f"Refract_{self.name}_{part}", 0
        path = self.home.AppendChild(base)
        while self.layer.GetPrimAtPath(path):
            count += 1
            path = self.home.AppendChild(f"{base}_{count}")
        spec = Sdf.CreatePrimInLayer(self.layer, path)
        spec.specifier, spec.typeName = Sdf.SpecifierDef, "Shader"
        attribute = Sdf.AttributeSpec(spec, "info:id", _TYPES.Token, Sdf.VariabilityUniform)
        attribute.default = f"ND_{identifier}" if self.mtlx else identifier
        return spec


def _coordinates(nodes: _Nodes, source: Source, mtlx: bool) -> str:
    """Output that gives a picture's coordinates."""
    out, kind = ("out", "vector2") if mtlx else ("result", "float2")
    reader = nodes.make("st", f"UsdPrimvarReader_{kind}")
    _set(reader, "varname", _TYPES.String, source.uv_primvar)
    if source.uv_value != (0.0, 0.0):
        _set(reader, "fallback", _TYPES.Float2, Gf.Vec2f(*source.uv_value))
    st = _output(reader, out, _TYPES.Float2)
    moved = _moved(source.uv_matrix)
    if moved is None or source.uv_matrix == _IDENTITY:
        return st
    node = nodes.make("transform", "UsdTransform2d")
    _connect(node, "in", _TYPES.Float2, st)
    angle, scale, translation = moved
    _set(node, "rotation", _TYPES.Float, angle)
    _set(node, "scale", _TYPES.Float2, Gf.Vec2f(*scale))
    _set(node, "translation", _TYPES.Float2, Gf.Vec2f(*translation))
    return _output(node, out, _TYPES.Float2)


def _moved(
    matrix: tuple[float, float, float, float, float, float],
) -> tuple[float, tuple[float, float], tuple[float, float]] | None:
    """Rotation [deg], scale and translation of a UsdTransform2d; None where no such one is the same."""
    a, b, x, c, d, y = matrix
    angle = math.atan2(c, a) if (a, c) != (0.0, 0.0) else math.atan2(-b, d)
    cos, sin = math.cos(angle), math.sin(angle)
    scale = a * cos + c * sin, d * cos - b * sin
    largest = max(map(abs, (a, b, c, d)))
    if abs(b * cos + d * sin) > 1.0e-5 * largest or abs(c * cos - a * sin) > 1.0e-5 * largest:
        return None
    return math.degrees(angle), scale, (x, y)


# --- specs ---


def _set(spec: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName, value: Any) -> Sdf.AttributeSpec:
    attribute = Sdf.AttributeSpec(spec, f"{UsdShade.Tokens.inputs}{name}", kind)
    attribute.default = value
    return attribute


def _connect(spec: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName, output: str) -> None:
    full = f"{UsdShade.Tokens.inputs}{name}"
    attribute = spec.attributes.get(full) or Sdf.AttributeSpec(spec, full, kind)
    attribute.connectionPathList.explicitItems = [Sdf.Path(output)]


def _output(spec: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName) -> str:
    full = f"{UsdShade.Tokens.outputs}{name}"
    if full not in spec.attributes:
        Sdf.AttributeSpec(spec, full, kind)
    return f"{spec.path}.{full}"
