"""Shading networks as `Source` records: what drives one input of a surface shader."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from pxr import Usd, UsdShade

from ...errors import ImageError
from ...scene import Channel, Notice, Source, Texture, Wrap
from ..values import finite, numbers
from .textures import COLOR_SPACES, read_texture, resolve_asset, texture_key

Value = float | tuple[float, float, float]
"""A scalar, or a colour or vector of three."""
Four = tuple[float, float, float, float]
Matrix = tuple[float, float, float, float, float, float]

_CHANNELS = {"r": Channel.R, "g": Channel.G, "b": Channel.B, "a": Channel.A, "rgb": Channel.RGB}
_WRAPS = {"black": Wrap.BLACK, "clamp": Wrap.CLAMP, "repeat": Wrap.REPEAT, "mirror": Wrap.MIRROR}
_WRAPS |= {"periodic": Wrap.REPEAT}  # what MaterialX calls it
_ADDRESS_MODES = {"constant": Wrap.BLACK, "clamp": Wrap.CLAMP, "periodic": Wrap.REPEAT, "mirror": Wrap.MIRROR}
_IDENTITY: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_MAX_DEPTH = 32


class Context(NamedTuple):
    """What every reader of one material needs."""

    path: str
    """Prim path of the material, for notices."""
    time: Usd.TimeCode
    textures: dict[str, Texture]
    """Textures of the whole stage so far; a texture's index is its position."""
    notices: list[Notice]
    unsupported: list[str]
    """Prim paths of the nodes that could not be followed."""


class Uv(NamedTuple):
    """Where a texture's st comes from."""

    primvar: str = ""
    value: tuple[float, float] = (0.0, 0.0)
    matrix: Matrix = _IDENTITY


def note(context: Context, text: str, path: object = "") -> None:
    """Add a notice once, about `path` or else about the material."""
    notice = Notice(str(path) or context.path, text)
    if notice not in context.notices:
        context.notices.append(notice)


def four(value: tuple[float, ...]) -> Four:
    """Fill up to RGBA: a scalar repeats in all four, a pair or a triple gets b = 0 and a = 1."""
    if len(value) == 1:
        return (value[0],) * 4
    return (value[0], value[1], value[2] if len(value) > 2 else 0.0, value[3] if len(value) > 3 else 1.0)


def shown(value: Any) -> str:
    """A default as a person would write it."""
    return str(value[0]) if isinstance(value, tuple) and len(value) == 1 else str(value)


def constant(value: Value) -> Source:
    """A source that is the same everywhere."""
    return Source(value=four(value if isinstance(value, tuple) else (value,)))


def is_constant(source: Source) -> bool:
    """Neither a texture nor a primvar drives it."""
    return source.texture < 0 and not source.primvar


def scaled(source: Source, factor: float | Four, offset: float = 0.0) -> Source:
    """`source * factor + offset`, folded into its value, scale and bias."""
    by = four((factor,)) if isinstance(factor, float) else factor

    def times(values: Four, add: float) -> Four:
        r, g, b, a = (v * f + add for v, f in zip(values, by, strict=True))
        return (r, g, b, a)

    return replace(
        source,
        value=times(source.value, offset),
        scale=times(source.scale, 0.0),
        bias=times(source.bias, offset),
    )


def _single(source: Source, channel: Channel) -> Source:
    """One component of an RGB source, with the scale and bias of that component; others stay as they are."""
    if source.channel is not Channel.RGB or source.texture < 0:
        return source
    return replace(
        source,
        channel=channel,
        value=(source.value[channel],) * 4,
        scale=(source.scale[channel],) * 4,
        bias=(source.bias[channel],) * 4,
    )


def scalar(source: Source) -> Source:
    """The same source where one number is wanted: the mean of a colour constant, the red of a colour texture."""
    if not is_constant(source):
        return _single(source, Channel.R)
    return constant(sum(source.value[:3]) / 3.0)


def producer(context: Context, port: UsdShade.Input) -> Usd.Attribute | None:
    """The attribute that holds or makes the value of `port`, through interface inputs and node graphs."""
    if not port:
        return None
    attributes = port.GetValueProducingAttributes()
    if len(attributes) > 1:
        note(context, f"{port.GetFullName()} has {len(attributes)} connections; only the first is used")
    return attributes[0] if attributes else None


def read_constant(context: Context, port: UsdShade.Input, default: Any) -> Any:
    """The value of an input that cannot follow a shading network."""
    attribute = producer(context, port)
    if attribute is None:
        return default
    if UsdShade.Output.IsOutput(attribute):
        node = attribute.GetPrim().GetPath()
        note(context, f"{port.GetFullName()} is connected to {node}, but only a constant works here; "
             f"{shown(default)} is used")  # fmt: skip
        return default
    value = attribute.Get(context.time)
    return default if value is None else value


def read_numbers(context: Context, port: UsdShade.Input, default: tuple[float, ...]) -> tuple[float, ...]:
    """A constant of as many finite numbers as `default`; anything else becomes `default` with a notice."""
    value = read_constant(context, port, default)
    found = numbers(value)
    if found is not None and len(found) == 1:
        found = found * len(default)
    if found is None or len(found) < len(default) or not finite(found):
        note(context, f"{port.GetFullName()} is {value}; {len(default)} finite number(s) are needed, "
             f"{shown(default)} is used")  # fmt: skip
        return default
    return found[: len(default)]


def read_number(context: Context, port: UsdShade.Input, default: float) -> float:
    """One number, of an input that can only be constant."""
    return read_numbers(context, port, (default,))[0]


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
        return Source(value=four(read_numbers(context, port, (default,) if size == 1 else default)))  # type: ignore[arg-type]
    shader = UsdShade.Shader(attribute.GetPrim())
    reader = _READERS.get(node_kind(shader))
    if reader is None or depth > _MAX_DEPTH:
        what = node_name(shader)
        context.unsupported.append(str(shader.GetPath()))
        note(context, f"node {what} drives {port.GetFullName()} but is not supported; {default} is used",
             shader.GetPath())  # fmt: skip
        return constant(default)
    source = reader(context, shader, attribute.GetName().removeprefix("outputs:"), default, depth)
    return source if isinstance(default, tuple) else _single(source, Channel.R)


def node_kind(shader: UsdShade.Shader) -> str:
    """Shader id without MaterialX prefix and type suffix: ND_image_color3 -> image, UsdPrimvarReader_float -> ..."""
    return str(shader.GetShaderId() or "").removeprefix("ND_").split("_")[0]


def node_name(shader: UsdShade.Shader) -> str:
    """What to call a shader in a notice: its id, else its kind of source."""
    if identifier := shader.GetShaderId():
        return f"'{identifier}'"
    return "without info:id" if shader.GetImplementationSource() == "id" else "from a source asset"


def _texture_index(context: Context, shader: UsdShade.Shader, color_space: str) -> int:
    """Load the node's `file`; -1 with a notice where that fails."""
    attribute = producer(context, shader.GetInput("file"))
    path = resolve_asset(attribute, context.time) if attribute is not None else ""
    if not path:
        note(context, "has no file; its fallback colour is used", shader.GetPath())
        return -1
    key = texture_key(path, color_space)
    if key not in context.textures:
        try:
            context.textures[key] = read_texture(path, color_space)
        except ImageError as error:
            note(context, f"texture cannot be read: {error}; its fallback colour is used", shader.GetPath())
            return -1
    return list(context.textures).index(key)


def _color_space(context: Context, shader: UsdShade.Shader) -> str:
    """The node's `sourceColorSpace`, else the `colorSpace` metadata of its file, as raw, sRGB or auto."""
    chosen = str(read_constant(context, shader.GetInput("sourceColorSpace"), "auto"))
    attribute = producer(context, shader.GetInput("file"))
    if chosen == "auto" and attribute is not None and attribute.HasColorSpace():
        chosen = str(attribute.GetColorSpace())
    if chosen in COLOR_SPACES or not chosen:
        return chosen or "auto"
    lowered = chosen.lower()
    if lowered.startswith("srgb"):
        return "sRGB"
    if lowered in ("lin_rec709", "lin_rec709_scene", "linear", "data", "identity", "unknown"):
        return "raw"
    note(context, f"colour space '{chosen}' is not converted; it is read as 'auto'", shader.GetPath())
    return "auto"


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
    uv = _read_uv(context, shader.GetInput("st"), "", depth + 1)
    if not uv.primvar:
        note(context, f"inputs:st names no primvar; the texture is looked up at {uv.value} only", shader.GetPath())
    source = Source(
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
    )
    return source if channel is Channel.RGB else _single(source, channel)


def _image(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """MaterialX `image` and `tiledimage`: colours follow the file's colour space, other types are raw."""
    kind = str(shader.GetShaderId()).rsplit("_", 1)[-1]
    channel = Channel.R if kind == "float" or not isinstance(default, tuple) else Channel.RGB
    value = constant(0.0).value
    if shader.GetInput("default"):
        value = read_source(context, shader.GetInput("default"), default, depth + 1).value
    space = _color_space(context, shader)
    texture = _texture_index(context, shader, space if kind.startswith("color") else "raw")
    if texture < 0:
        return Source(value=value)
    uv = _read_uv(context, shader.GetInput("texcoord"), "st", depth + 1)
    if node_kind(shader) == "tiledimage":
        tiling = read_numbers(context, shader.GetInput("uvtiling"), (1.0, 1.0))
        offset = read_numbers(context, shader.GetInput("uvoffset"), (0.0, 0.0))
        uv = uv._replace(matrix=_compose((tiling[0], 0.0, -offset[0], 0.0, tiling[1], -offset[1]), uv.matrix))
    wrap = tuple(_wrap(context, shader, n, "periodic", _ADDRESS_MODES) for n in ("uaddressmode", "vaddressmode"))
    return Source(
        value=value,
        texture=texture,
        channel=channel,
        wrap=(wrap[0], wrap[1]),
        uv_primvar=uv.primvar,
        uv_value=uv.value,
        uv_matrix=uv.matrix,
    )


def _primvar_name(context: Context, shader: UsdShade.Shader) -> str:
    port = shader.GetInput("varname") or shader.GetInput("geomprop")
    name = str(read_constant(context, port, "") if port else "").removeprefix("primvars:")
    if not name:
        note(context, "names no primvar (inputs:varname is empty); its fallback is used", shader.GetPath())
    return name


def _primvar(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    return Source(value=_fallback(context, shader, (0.0,)), primvar=_primvar_name(context, shader))


def _extract(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """One component of a colour or vector."""
    index = int(read_number(context, shader.GetInput("index"), 0.0))
    inner = read_source(context, shader.GetInput("in"), (0.0, 0.0, 0.0), depth + 1)
    channel = Channel(min(max(index, 0), 3))
    if inner.primvar:
        context.unsupported.append(str(shader.GetPath()))
        note(context, "takes one component of a primvar, which is not supported", shader.GetPath())
        return constant(default)
    return _single(inner, channel) if inner.texture >= 0 else constant(inner.value[channel])


def _pass(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    return read_source(context, shader.GetInput("in"), default, depth + 1)


def _constant(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    return read_source(context, shader.GetInput("value"), default, depth + 1)


def _normal_map(context: Context, shader: UsdShade.Shader, output: str, default: Value, depth: int) -> Source:
    """MaterialX `normalmap`: [0, 1] to [-1, 1], its `scale` on x and y."""
    strength = read_number(context, shader.GetInput("scale"), 1.0)
    source = scaled(read_source(context, shader.GetInput("in"), (0.5, 0.5, 1.0), depth + 1), 2.0, -1.0)
    return source if math.isclose(strength, 1.0) else scaled(source, (strength, strength, 1.0, 1.0))


_READERS: dict[str, Callable[[Context, UsdShade.Shader, str, Value, int], Source]] = {
    "UsdUVTexture": _uv_texture,
    "UsdPrimvarReader": _primvar,
    "image": _image,
    "tiledimage": _image,
    "geompropvalue": _primvar,
    "extract": _extract,
    "convert": _pass,
    "dot": _pass,
    "constant": _constant,
    "normalmap": _normal_map,
}


def _read_uv(context: Context, port: UsdShade.Input, default: str, depth: int) -> Uv:
    """Follow texture coordinates to a primvar; `default` names the primvar of an unconnected input."""
    attribute = producer(context, port)
    if attribute is None:
        return Uv(default)
    if not UsdShade.Output.IsOutput(attribute):
        s, t = read_numbers(context, port, (0.0, 0.0))
        return Uv("", (s, t))
    shader = UsdShade.Shader(attribute.GetPrim())
    kind = node_kind(shader)
    if kind in ("UsdPrimvarReader", "geompropvalue"):
        found = _primvar(context, shader, "result", (0.0, 0.0, 0.0), depth)
        return Uv(found.primvar, found.value[:2])
    if kind == "texcoord":
        index = int(read_number(context, shader.GetInput("index"), 0.0))
        return Uv(f"st{index}" if index else "st")
    if kind == "UsdTransform2d" and depth <= _MAX_DEPTH:
        inner = _read_uv(context, shader.GetInput("in"), "", depth + 1)
        return inner._replace(matrix=_compose(_transform_2d(context, shader), inner.matrix))
    context.unsupported.append(str(shader.GetPath()))
    note(context, f"node {node_name(shader)} drives texture coordinates but is not supported; primvar st is used",
         shader.GetPath())  # fmt: skip
    return Uv("st")


def _transform_2d(context: Context, shader: UsdShade.Shader) -> Matrix:
    """UsdTransform2d: scale, then rotate counter-clockwise [deg], then translate (UsdPreviewSurface proposal)."""
    angle = math.radians(read_number(context, shader.GetInput("rotation"), 0.0))
    sx, sy = read_numbers(context, shader.GetInput("scale"), (1.0, 1.0))
    tx, ty = read_numbers(context, shader.GetInput("translation"), (0.0, 0.0))
    c, s = math.cos(angle), math.sin(angle)
    return (c * sx, -s * sy, tx, s * sx, c * sy, ty)


def _compose(outer: Matrix, inner: Matrix) -> Matrix:
    """Row-major 2x3 of `outer` after `inner`."""
    a, b, c, d, e, f = outer
    g, h, i, j, k, m = inner
    return (a * g + b * j, a * h + b * k, a * i + b * m + c, d * g + e * j, d * h + e * k, d * i + e * m + f)
