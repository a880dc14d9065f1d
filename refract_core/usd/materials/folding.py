"""Arithmetic of shading networks, folded into one `Source`: a picture or primvar times a number plus a number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ...scene import Channel, Source, Texture, Wrap
from .sources import Context, Four, constant, is_constant, scaled
from .textures import made

Numbers = Callable[[float, float], float]
_RAMP = made("ramp")


def spread(context: Context, source: Source) -> Source:
    """A picture of which one channel is used, as one whose red, green and blue are that channel, so that each can have
    a factor of its own. Any other source stays as it is."""
    if source.texture < 0 or source.channel is Channel.RGB:
        return source
    key = list(context.textures)[source.texture]
    texture = context.textures[key]
    plane = texture.pixels[..., source.channel]
    if not all(np.array_equal(plane, texture.pixels[..., other]) for other in range(3)):
        key = made(f"{source.channel.name} of {key}")
        if key not in context.textures:
            pixels: Any = np.repeat(plane[..., None], 4, axis=-1)
            curved = texture.srgb and source.channel is not Channel.A
            context.textures[key] = replace(texture, name=key, pixels=pixels, srgb=curved)
    c = source.channel
    return replace(
        source,
        texture=list(context.textures).index(key),
        channel=Channel.RGB,
        value=(source.value[c],) * 4,
        scale=(source.scale[c],) * 4,
        bias=(source.bias[c],) * 4,
    )


def linear(context: Context, source: Source, factor: float | Four, offset: float | Four = 0.0) -> Source:
    """`source * factor + offset`, whatever the source."""
    even = all(isinstance(part, float) or len(set(part[:3])) == 1 for part in (factor, offset))
    return scaled(source if even else spread(context, source), factor, offset)


def by_number(a: Source, b: Source, function: Numbers) -> Source | None:
    """A function of two constants, number by number; None where a picture or primvar drives one."""
    if not (is_constant(a) and is_constant(b)):
        return None
    try:
        x, y, z, w = (float(function(p, q)) for p, q in zip(a.value, b.value, strict=True))
    except (OverflowError, ValueError, ZeroDivisionError, TypeError):  # TypeError: a complex power
        return constant(0.0)
    return Source(value=(x, y, z, w)) if np.isfinite((x, y, z, w)).all() else constant(0.0)


def product(context: Context, a: Source, b: Source) -> Source | None:
    """`a * b`; None where both are driven."""
    if is_constant(b):
        return linear(context, a, b.value)
    return linear(context, b, a.value) if is_constant(a) else None


def total(context: Context, a: Source, b: Source, sign: float = 1.0) -> Source | None:
    """`a + sign * b`; None where both are driven."""
    if is_constant(b):
        return linear(context, a, 1.0, scaled(b, sign).value)
    return linear(context, b, sign, a.value) if is_constant(a) else None


def quotient(context: Context, a: Source, b: Source) -> Source | None:
    """`a / b`, 0 where b is 0; None where b is driven."""
    if not is_constant(b):
        return None
    x, y, z, w = (1.0 / value if value else 0.0 for value in b.value)
    return linear(context, a, (x, y, z, w))


def mixed(context: Context, front: Source, back: Source, share: Source) -> Source | None:
    """`front * share + back * (1 - share)`; None where more than one of the three is driven."""
    if front == back:
        return front
    if not is_constant(share):
        difference = total(context, front, back, -1.0)
        if difference is None or not (is_constant(front) and is_constant(back)):
            return None
        return linear(context, share, difference.value, back.value)
    if set(share.value[:3]) == {0.0}:
        return back
    if set(share.value[:3]) == {1.0}:
        return front
    rest = scaled(share, -1.0, 1.0)
    return total(context, linear(context, front, share.value), linear(context, back, rest.value))


def combined(context: Context, parts: list[Source]) -> Source | None:
    """Scalars as the parts of a colour or vector; None where they come of several pictures."""
    parts = [*parts, constant(0.0), constant(0.0)][:3]
    driven = [one for one in parts if not is_constant(one)]
    if not driven:
        return constant((parts[0].value[0], parts[1].value[0], parts[2].value[0]))
    first = driven[0]
    alike = [replace(one, value=first.value, scale=first.scale, bias=first.bias, channel=first.channel)
             for one in driven]  # fmt: skip
    if any(one != first for one in alike):
        return None
    in_order = all(is_constant(one) or one.channel == place for place, one in enumerate(parts))
    if not in_order and len({one.channel for one in driven}) > 1:
        return None
    whole = replace(first, channel=Channel.RGB) if in_order and first.texture >= 0 else spread(context, first)

    def gathered(name: str, of_constant: Callable[[Source], float]) -> Four:
        x, y, z = (of_constant(one) if is_constant(one) else getattr(one, name)[_at(one)] for one in parts)
        return (x, y, z, 1.0 if name == "scale" else 0.0)

    return replace(
        whole,
        scale=gathered("scale", lambda _one: 0.0),
        bias=gathered("bias", lambda one: one.value[0]),
        value=gathered("value", lambda one: one.value[0]),
    )


def _at(source: Source) -> int:
    """Which of its four numbers counts."""
    return 0 if source.texture < 0 or source.channel is Channel.RGB else int(source.channel)


def ramp(context: Context, start: Source, end: Source) -> Source | None:
    """From one colour to another along the first texture coordinate, 0 to 1; None where one is driven.

    A picture of two texels is a straight line between their middles, and even beyond.
    """
    if not (is_constant(start) and is_constant(end)):
        return None
    if _RAMP not in context.textures:
        pixels = np.array([[[0.0] * 4, [1.0] * 4]], np.float32)
        context.textures[_RAMP] = Texture(_RAMP, pixels)
    return Source(
        value=start.value,
        texture=list(context.textures).index(_RAMP),
        wrap=(Wrap.CLAMP, Wrap.CLAMP),
        scale=scaled(end, 1.0, scaled(start, -1.0).value).value,
        bias=start.value,
        uv_matrix=(0.5, 0.0, 0.25, 0.0, 1.0, 0.0),
    )
