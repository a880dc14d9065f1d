"""`Source` records: how they are made and folded, and what every reader of a shading network needs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from pxr import Usd, UsdShade

from ...scene import Channel, Notice, Source, Texture
from ..values import finite, numbers

Value = float | tuple[float, float, float]
"""A scalar, or a colour or vector of three."""
Four = tuple[float, float, float, float]


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
    known: dict[tuple[str, bool], Source]
    """What nodes gave that were followed before, by output, and whether three numbers were wanted: a network in which
    everything is used twice would take for ever."""

    @classmethod
    def of(cls, path: str, time: Usd.TimeCode, textures: dict[str, Texture], notices: list[Notice]) -> Context:
        """To read one material."""
        return cls(path, time, textures, notices, [], {})

    def trial(self) -> Context:
        """A copy whose findings can be thrown away."""
        return Context.of(self.path, self.time, dict(self.textures), list(self.notices))


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
    return not source.driven


def scaled(source: Source, factor: float | Four, offset: float | Four = 0.0) -> Source:
    """`source * factor + offset`, folded into its value, scale and bias. A picture of which one channel is used takes
    one number alone: see `folding.spread`."""
    by = four((factor,)) if isinstance(factor, float) else factor
    add = four((offset,)) if isinstance(offset, float) else offset

    def times(values: Four, more: Four) -> Four:
        r, g, b, a = (v * f + m for v, f, m in zip(values, by, more, strict=True))
        return (r, g, b, a)

    return replace(
        source,
        value=times(source.value, add),
        scale=times(source.scale, (0.0,) * 4),
        bias=times(source.bias, add),
    )


def single(source: Source, channel: Channel) -> Source:
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
        return single(source, Channel.R)
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


def kind_of(shader: UsdShade.Shader) -> str:
    """Whose shader it is, for a person: notices that begin with a kind are gathered."""
    return "MaterialX" if str(shader.GetShaderId()).startswith("ND_") else "shader"


def node_name(shader: UsdShade.Shader) -> str:
    """What to call a shader in a notice: its id, else its kind of source."""
    if identifier := shader.GetShaderId():
        return f"'{identifier}'"
    return "without info:id" if shader.GetImplementationSource() == "id" else "from a source asset"


def primvar_name(context: Context, shader: UsdShade.Shader) -> str:
    """Which primvar a node reads; '' and a notice where it names none."""
    port = shader.GetInput("varname") or shader.GetInput("geomprop")
    name = str(read_constant(context, port, "") if port else "").removeprefix("primvars:")
    if not name:
        note(context, "names no primvar (inputs:varname is empty); its fallback is used", shader.GetPath())
    return name
