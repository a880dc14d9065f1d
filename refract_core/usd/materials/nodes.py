"""Shading networks followed: what drives one input of a surface shader, as a `Source`.

UsdPreviewSurface's nodes, and those of MaterialX as far as they come to a picture or primvar times a number plus a
number; what does not is named, and what it drives has its default.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from pxr import Sdf, Usd, UsdShade

from ...errors import ImageError
from ...images.spaces import AUTO, canonical, linear, told
from ...scene import Channel, Source, Wrap
from ..values import finite, numbers, short
from . import folding
from .coordinates import Matrix, Uv, compose, placed, read_uv
from .sources import (
    Context,
    Four,
    Value,
    constant,
    four,
    is_constant,
    kind_of,
    node_name,
    note,
    primvar_name,
    producer,
    read_constant,
    read_number,
    read_numbers,
    scaled,
    shown,
    single,
)
from .textures import read_texture, resolve_asset, texture_key
from .udim import Tiled, moved_in

_CHANNELS = {"r": Channel.R, "g": Channel.G, "b": Channel.B, "a": Channel.A, "rgb": Channel.RGB}
_WRAPS = {"black": Wrap.BLACK, "clamp": Wrap.CLAMP, "repeat": Wrap.REPEAT, "mirror": Wrap.MIRROR}
_WRAPS |= {"periodic": Wrap.REPEAT}  # what MaterialX calls it
_ADDRESS_MODES = {"constant": Wrap.BLACK, "clamp": Wrap.CLAMP, "periodic": Wrap.REPEAT, "mirror": Wrap.MIRROR}
_MAX_DEPTH = 32


def read_source(context: Context, port: UsdShade.Input, default: Value, depth: int = 0) -> Source:
    """Follow what drives `port`: a constant, a texture or a primvar.

    Args:
        context: The material being read.
        port: An input of a surface shader; an invalid one gives `default`.
        default: The shader's own default. Its type says whether one number or three are wanted.
        depth: Nodes already passed; a network deeper than 32 is cut.
    """
    attribute = producer(context, port)
    if attribute is None:
        return constant(default)
    if not UsdShade.Output.IsOutput(attribute):
        size = len(default) if isinstance(default, tuple) else 1
        value = four(read_numbers(context, port, (default,) if size == 1 else default))  # type: ignore[arg-type]
        return Source(value=_in_rec709(context, attribute, value))
    key = str(attribute.GetPath()), isinstance(default, tuple)
    if key not in context.known:
        found = _node(context, UsdShade.Shader(attribute.GetPrim()), attribute.GetName(), default, depth)
        context.known[key] = constant(default) if found is None else found
    return context.known[key] if isinstance(default, tuple) else single(context.known[key], Channel.R)


def _node(context: Context, shader: UsdShade.Shader, name: str, default: Value, depth: int) -> Source | None:
    """What a node gives at one of its outputs; None, and a notice, where it cannot be followed."""
    reader = _READERS.get(node_kind(shader)) if depth <= _MAX_DEPTH else None
    source = reader(context, shader, name.removeprefix("outputs:"), default, depth) if reader else None
    if source is None:
        context.unsupported.append(str(shader.GetPath()))
        why = "comes to more than a picture or primvar times a number plus a number" if reader else "is not followed"
        what = f"{kind_of(shader)} node {node_name(shader)}"
        note(context, f"{what} {why}; what it drives has its default", shader.GetPath())
    return source


def node_kind(shader: UsdShade.Shader) -> str:
    """Shader id without MaterialX prefix and type suffix: ND_image_color3 -> image, UsdPrimvarReader_float -> ..."""
    parts = str(shader.GetShaderId() or "").removeprefix("ND_").split("_")
    return f"gltf_{parts[1]}" if parts[0] == "gltf" and len(parts) > 1 else parts[0]


def _file(shader: UsdShade.Shader) -> UsdShade.Input:
    return shader.GetInput("file") or shader.GetInput("filename")  # the second is Arnold's


def _texture_index(context: Context, shader: UsdShade.Shader, color_space: str) -> int:
    """Load the node's `file`; -1 with a notice where that fails."""
    return _loaded(context, producer(context, _file(shader)), color_space, shader.GetPath())


def picture_index(context: Context, attribute: Usd.Attribute, unless: str, where: Sdf.Path) -> int:
    """Load the picture of an asset-valued attribute, in the colour space of its metadata.

    Args:
        unless: the colour space where it has none.
        where: what a notice is about.

    Returns:
        Its index in the context's textures; -1 with a notice where it cannot be read.
    """
    chosen = str(attribute.GetColorSpace()) if attribute.HasColorSpace() else unless
    return _loaded(context, attribute, _known_space(context, chosen, where), where)


def _loaded(context: Context, attribute: Usd.Attribute | None, color_space: str, where: Sdf.Path) -> int:
    path = resolve_asset(attribute, context.time) if attribute is not None else ""
    if not path:
        note(context, "has no file; its fallback colour is used", where)
        return -1
    key = texture_key(path, color_space)
    if key not in context.textures:
        try:
            context.textures[key] = read_texture(path, color_space)
        except ImageError as error:
            note(context, f"texture cannot be read: {error}; its fallback colour is used", where)
            return -1
        made = context.textures[key]
        if isinstance(made, Tiled) and made.grid.step > 1:
            text = f"the {len(made.grid.cells)} tiles of {short(path)} are read at 1/{made.grid.step} of their size"
            note(context, f"{text}: together they are more than one texture may be", where)
    return list(context.textures).index(key)


def _color_space(context: Context, shader: UsdShade.Shader) -> str:
    """The node's `sourceColorSpace`, else the `colorSpace` metadata of its file."""
    chosen = str(read_constant(context, shader.GetInput("sourceColorSpace"), "auto"))
    attribute = producer(context, _file(shader))
    if chosen == "auto" and attribute is not None and attribute.HasColorSpace():
        chosen = str(attribute.GetColorSpace())
    return _known_space(context, chosen, shader.GetPath())


def _known_space(context: Context, chosen: str, where: Sdf.Path) -> str:
    """One of `spaces.NAMES`, whatever a file calls it."""
    if not (known := canonical(chosen)):
        note(context, f"{told(chosen)}; it is read as '{AUTO}'", where)
    return known or AUTO


def _in_rec709(context: Context, attribute: Usd.Attribute, value: Four) -> Four:
    """A colour that a stage gives in another space: by the attribute's metadata, or by ColorSpaceAPI of its prim or
    of one above."""
    if attribute.GetRoleName() != "Color":
        return value
    space = str(Usd.ColorSpaceAPI.ComputeColorSpaceName(attribute, None))
    r, g, b = linear(value[:3], _known_space(context, space, attribute.GetPath()))
    return r, g, b, value[3]


def in_tiles(context: Context, source: Source) -> Source:
    """The source of a picture, which may be made of tiles."""
    return moved_in(source, list(context.textures.values())[source.texture])


def _wrap(context: Context, shader: UsdShade.Shader, name: str, default: str, known: dict[str, Wrap]) -> Wrap:
    token = str(read_constant(context, shader.GetInput(name), default))
    if token == "useMetadata" and name.startswith("wrap"):
        return Wrap.REPEAT  # what almost no file carries: the reader has no wrap metadata to look at
    if token not in known:
        note(context, f"{name} '{token}' is not one of {', '.join(known)}; repeat is used", shader.GetPath())
    return known.get(token, Wrap.REPEAT)


def _fallback(context: Context, shader: UsdShade.Shader, default: tuple[float, ...]) -> Four:
    """The node's fallback, filled up to four: nodes and files differ in how many numbers they give."""
    found = numbers(read_constant(context, shader.GetInput("fallback") or shader.GetInput("default"), default))
    if not found or not finite(found):
        note(context, f"inputs:fallback is {found}; finite numbers are needed, {shown(default)} is used",
             shader.GetPath())  # fmt: skip
        found = default
    return four(found)


def _picked(value: Four, channel: Channel) -> Four:
    return (*value[:3], 1.0) if channel is Channel.RGB else (value[channel],) * 4


def _uv_texture(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """A UsdUVTexture as a source: its picture, wrap, scale and bias, and the uv it is looked up at."""
    channel = _CHANNELS.get(output, Channel.RGB)
    fallback = _fallback(context, shader, (0.0, 0.0, 0.0, 1.0))
    texture = _texture_index(context, shader, _color_space(context, shader))
    if texture < 0:
        return Source(value=_picked(fallback, channel))
    uv = read_uv(context, shader.GetInput("st"), "", depth + 1)
    if not uv.primvar:
        note(context, f"inputs:st names no primvar; the texture is looked up at {uv.value} only", shader.GetPath())
    source = in_tiles(context, Source(
        value=fallback,
        texture=texture,
        wrap=(
            _wrap(context, shader, "wrapS", "useMetadata", _WRAPS),
            _wrap(context, shader, "wrapT", "useMetadata", _WRAPS),
        ),
        scale=four(read_numbers(context, shader.GetInput("scale"), (1.0, 1.0, 1.0, 1.0))),
        bias=four(read_numbers(context, shader.GetInput("bias"), (0.0, 0.0, 0.0, 0.0))),
        uv_primvar=uv.primvar,
        uv_value=uv.value,
        uv_matrix=uv.matrix,
    ))  # fmt: skip
    return source if channel is Channel.RGB else single(source, channel)


def _image(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """MaterialX `image` and `tiledimage`: colours follow the file's colour space, other types are raw."""
    uv = read_uv(context, shader.GetInput("texcoord"), "st", depth + 1)
    if node_kind(shader) == "tiledimage":
        tiling, offset, size, tile = (
            read_numbers(context, shader.GetInput(name), (neutral, neutral))
            for name, neutral in (
                ("uvtiling", 1.0), ("uvoffset", 0.0), ("realworldimagesize", 1.0), ("realworldtilesize", 1.0)
            )
        )  # fmt: skip
        x, y = (wanted / had if had else 1.0 for wanted, had in zip(tile, size, strict=True))
        uv = uv.moved((tiling[0] * x, 0.0, -offset[0] * x, 0.0, tiling[1] * y, -offset[1] * y))
    return _looked_up(context, shader, default, uv, depth)


def _looked_up(context: Context, shader: UsdShade.Shader, default: Value, uv: Uv, depth: int) -> Source:
    """A MaterialX picture at some coordinates."""
    kind = str(shader.GetShaderId())
    color = "color" in kind
    channel = Channel.R if "_float" in kind or not isinstance(default, tuple) else Channel.RGB
    value = constant(0.0).value
    if shader.GetInput("default"):
        value = read_source(context, shader.GetInput("default"), default, depth + 1).value
    texture = _texture_index(context, shader, _color_space(context, shader) if color else "raw")
    if texture < 0:
        return Source(value=value)
    wrap = tuple(_wrap(context, shader, n, "periodic", _ADDRESS_MODES) for n in ("uaddressmode", "vaddressmode"))
    return in_tiles(context, Source(
        value=value,
        texture=texture,
        channel=channel,
        wrap=(wrap[0], wrap[1]),
        uv_primvar=uv.primvar,
        uv_value=uv.value,
        uv_matrix=uv.matrix,
    ))  # fmt: skip


def _gltf_image(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    """MaterialX `gltf_image` and `gltf_colorimage` (gltf_pbr.mtlx): glTF's transform, then a factor."""

    def two(name: str, first: float, second: float) -> tuple[float, float]:
        s, t = read_numbers(context, shader.GetInput(name), (first, second))
        return s, t

    plain = node_kind(shader) != "gltf_colorimage"
    sx, sy = (1.0 / value if value else 0.0 for value in two("scale", 1.0, 1.0))
    x, y = two("offset", 0.0, 0.0)
    order = int(read_number(context, shader.GetInput("operationorder"), 0.0)) if plain else 0
    angle = read_number(context, shader.GetInput("rotate"), 0.0)
    moved: Matrix = placed(two("pivot", 0.0, 1.0), (sx, sy), -angle, (-x, y), order)
    uv = read_uv(context, shader.GetInput("texcoord"), "st", depth + 1).moved(moved)
    white = (1.0, 1.0, 1.0)
    found: Source | None = _looked_up(context, shader, white if not plain else default, uv, depth)
    if output == "outa":
        found = single(found, Channel.A) if found is not None else None
    for name in ("factor",) if plain else ("color", "geomcolor"):
        if found is not None and output != "outa":
            factor = read_source(context, shader.GetInput(name), white, depth + 1)
            found = folding.product(context, found, factor)
    return found


def _gltf_normal(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    found = _gltf_image(context, shader, "out", default, depth)
    return None if found is None else scaled(found, 2.0, -1.0)


def _arnold_image(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """Arnold's `image`: repeated, at the first coordinates unless `uvset` names others."""
    channel = _CHANNELS.get(output, Channel.RGB)
    texture = _texture_index(context, shader, "auto")
    if texture < 0:
        return Source(value=constant(default).value)
    name = str(read_constant(context, shader.GetInput("uvset"), "") or "st")
    s, t = (read_number(context, shader.GetInput(f"{axis}scale"), 1.0) for axis in "st")
    x, y = (read_number(context, shader.GetInput(f"{axis}offset"), 0.0) for axis in "st")
    factor, more = (
        read_source(context, shader.GetInput(word), (neutral,) * 3, depth + 1).value
        for word, neutral in (("multiply", 1.0), ("offset", 0.0))
    )
    source = in_tiles(context, Source(texture=texture, uv_primvar=name, uv_matrix=(s, 0.0, x, 0.0, t, y)))
    return single(scaled(source, factor, (*more[:3], 0.0)), channel) if channel < Channel.RGB else scaled(
        source, factor, (*more[:3], 0.0)
    )  # fmt: skip


def _primvar(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    return Source(value=_fallback(context, shader, (0.0,)), primvar=primvar_name(context, shader))


def _vertex_color(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    return Source(value=constant(default).value, primvar="displayColor")


_PARTS = {f"out{name}": place % 4 for place, name in enumerate("rgbaxyzw")}


def _extract(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    """One component of a colour or vector: `extract` by its index, `separate` by the name of the output."""
    inner = read_source(context, shader.GetInput("in"), (0.0, 0.0, 0.0), depth + 1)
    index = _PARTS.get(output)
    if index is None:
        index = int(read_number(context, shader.GetInput("index"), 0.0))
    return _part(inner, min(max(index, 0), 3))


def _part(source: Source, index: int) -> Source | None:
    if is_constant(source):
        return constant(source.value[index])
    if source.texture < 0:  # a kernel takes the first number of a primvar where one is wanted
        return source if index == 0 else None
    return single(source, Channel(index))


def _swizzle(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    """Components in another order, by letters; up to MaterialX 1.38."""
    inner = read_source(context, shader.GetInput("in"), (0.0, 0.0, 0.0), depth + 1)
    letters = str(read_constant(context, shader.GetInput("channels"), "rgb"))
    if letters in ("rgb", "xyz", "rgba", "xyzw"):
        return inner
    parts: list[Source | None] = [
        constant(float(letter)) if letter in "01" else _part(inner, _PARTS[f"out{letter}"])
        for letter in letters if letter in "01rgbaxyzw"
    ]  # fmt: skip
    found = [one for one in parts if one is not None]
    if not found or len(found) < len(parts):
        return None
    return found[0] if len(found) == 1 else folding.combined(context, found)


def _pass(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    return read_source(context, shader.GetInput("in"), default, depth + 1)


def _constant(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    return read_source(context, shader.GetInput("value"), default, depth + 1)


def _normal_map(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """MaterialX `normalmap`: [0, 1] to [-1, 1], its `scale` on x and y."""
    strength = read_numbers(context, shader.GetInput("scale"), (1.0, 1.0))
    source = scaled(read_source(context, shader.GetInput("in"), (0.5, 0.5, 1.0), depth + 1), 2.0, -1.0)
    even = all(math.isclose(value, 1.0) for value in strength)
    return source if even else scaled(source, (strength[0], strength[1], 1.0, 1.0))


def _unit(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    """MaterialX `normalize` of three numbers: of a picture or primvar it is left to who takes it as a normal."""
    if not str(shader.GetShaderId()).endswith("_vector3"):
        return None
    inner = read_source(context, shader.GetInput("in"), (0.0, 0.0, 0.0), depth + 1)
    length = math.hypot(*inner.value[:3])
    if not is_constant(inner) or length == 0.0:
        return inner
    x, y, z = (value / length for value in inner.value[:3])
    return constant((x, y, z))


def _geometric_normal(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """The surface's own normal, which in tangent space is straight up."""
    return constant((0.0, 0.0, 1.0))


# --- arithmetic ---


def _filled(default: Value, value: float) -> Value:
    """A number in the shape that is wanted."""
    return (value, value, value) if isinstance(default, tuple) else value


def _binary(
    first: float, second: float, fold: Callable[[Context, Source, Source], Source | None]
) -> Callable[[Context, UsdShade.Shader, str, Value, int], Source | None]:
    """A node of two inputs, in1 and in2, with their defaults."""

    def read(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
        a, b = (
            read_source(context, shader.GetInput(name), _filled(default, value), depth + 1)
            for name, value in (("in1", first), ("in2", second))
        )
        return fold(context, a, b)

    return read


def _of_numbers(function: folding.Numbers) -> Callable[[Context, Source, Source], Source | None]:
    return lambda _context, a, b: folding.by_number(a, b, function)


def _along(*words: str) -> Callable[[Context, UsdShade.Shader, str, Value, int], Source | None]:
    """A node that is a straight line of its input: the words are the inputs its two ends depend on."""

    def read(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
        inner = read_source(context, shader.GetInput("in"), _filled(default, 0.0), depth + 1)
        rest = [
            read_source(context, shader.GetInput(word), _filled(default, _NEUTRAL[word]), depth + 1) for word in words
        ]
        if not all(is_constant(one) for one in rest):
            return None
        lines = [_LINES[words](*numbers) for numbers in zip(*(one.value for one in rest), strict=True)]
        factor, offset = zip(*lines, strict=True)
        return folding.linear(context, inner, factor, offset)

    return read


_NEUTRAL = {"amount": 1.0, "pivot": 0.5, "inlow": 0.0, "inhigh": 1.0, "outlow": 0.0, "outhigh": 1.0}


def _remapped(inlow: float, inhigh: float, outlow: float, outhigh: float) -> tuple[float, float]:
    slope = (outhigh - outlow) / (inhigh - inlow) if inhigh != inlow else 0.0
    return slope, outlow - inlow * slope


_INVERT, _CONTRAST, _REMAP = ("amount",), ("amount", "pivot"), ("inlow", "inhigh", "outlow", "outhigh")
_LINES: dict[tuple[str, ...], Callable[..., tuple[float, float]]] = {
    _INVERT: lambda amount: (-1.0, amount),
    _CONTRAST: lambda amount, pivot: (amount, pivot - pivot * amount),
    _REMAP: _remapped,
}
"""Factor and offset, by number."""


def _mix(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    front, back, share = (
        read_source(context, shader.GetInput(name), _filled(default, 0.0), depth + 1) for name in ("fg", "bg", "mix")
    )
    return folding.mixed(context, front, back, share)


def _clamp(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    """Of a picture only where it takes nothing away that a colour or weight has."""
    inner, low, high = (
        read_source(context, shader.GetInput(name), _filled(default, value), depth + 1)
        for name, value in (("in", 0.0), ("low", 0.0), ("high", 1.0))
    )
    if not (is_constant(low) and is_constant(high)):
        return None
    if not is_constant(inner):
        return inner if max(low.value[:3]) <= 0.0 and min(high.value[:3]) >= 1.0 else None
    x, y, z, w = (min(max(v, a), b) for v, a, b in zip(inner.value, low.value, high.value, strict=True))
    return Source(value=(x, y, z, w))


def _combine(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    names = [name for name in ("in1", "in2", "in3") if shader.GetInput(name)]
    if "color3" in str(shader.GetShaderId()).split("_")[2:-1]:  # ND_combine2_color4CF: a colour and its alpha
        return read_source(context, shader.GetInput("in1"), default, depth + 1)
    return folding.combined(context, [read_source(context, shader.GetInput(name), 0.0, depth + 1) for name in names])


def _ramp(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source | None:
    """`ramplr` along the first coordinate, `ramptb` from the top (1) down the second."""
    across = node_kind(shader) == "ramplr"
    start, end = (
        read_source(context, shader.GetInput(name), _filled(default, 0.0), depth + 1)
        for name in (("valuel", "valuer") if across else ("valueb", "valuet"))
    )
    found = folding.ramp(context, start, end)
    if found is None:
        return None
    uv = read_uv(context, shader.GetInput("texcoord"), "st", depth + 1)
    matrix = uv.matrix if across else compose((0.0, 1.0, 0.0, 1.0, 0.0, 0.0), uv.matrix)
    matrix = compose(found.uv_matrix, matrix)
    return replace(found, uv_primvar=uv.primvar, uv_value=uv.value, uv_matrix=matrix)


def _switch(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    which = int(read_number(context, shader.GetInput("which"), 0.0))
    return read_source(context, shader.GetInput(f"in{which + 1}"), _filled(default, 0.0), depth + 1)


_READERS: dict[str, Callable[[Context, UsdShade.Shader, str, Value, int], Source | None]] = {
    "UsdUVTexture": _uv_texture,
    "UsdPrimvarReader": _primvar,
    "image": _image,
    "tiledimage": _image,
    "gltf_image": _gltf_image,
    "gltf_colorimage": _gltf_image,
    "gltf_normalmap": _gltf_normal,
    "arnold:image": _arnold_image,
    "geompropvalue": _primvar,
    "geomcolor": _vertex_color,
    "normal": _geometric_normal,
    "extract": _extract,
    "separate2": _extract,
    "separate3": _extract,
    "separate4": _extract,
    "swizzle": _swizzle,
    "combine2": _combine,
    "combine3": _combine,
    "combine4": _combine,
    "convert": _pass,
    "dot": _pass,
    "constant": _constant,
    "normalmap": _normal_map,
    "normalize": _unit,
    "multiply": _binary(0.0, 1.0, folding.product),
    "add": _binary(0.0, 0.0, folding.total),
    "subtract": _binary(0.0, 0.0, lambda context, a, b: folding.total(context, a, b, -1.0)),
    "divide": _binary(0.0, 1.0, folding.quotient),
    "power": _binary(0.0, 1.0, _of_numbers(lambda a, b: a**b)),
    "min": _binary(0.0, 0.0, _of_numbers(min)),
    "max": _binary(0.0, 0.0, _of_numbers(max)),
    "mix": _mix,
    "invert": _along(*_INVERT),
    "contrast": _along(*_CONTRAST),
    "remap": _along(*_REMAP),
    "clamp": _clamp,
    "ramplr": _ramp,
    "ramptb": _ramp,
    "switch": _switch,
}
