"""Texture coordinates of shading networks: the primvar they come from, and how it is moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from pxr import UsdShade

from .sources import Context, kind_of, node_name, note, primvar_name, producer, read_number, read_numbers

Matrix = tuple[float, float, float, float, float, float]
_IDENTITY: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_Pair = Callable[[str, float], tuple[float, float]]
_MAX_DEPTH = 32


class Uv(NamedTuple):
    """Where a texture's st comes from."""

    primvar: str = ""
    value: tuple[float, float] = (0.0, 0.0)
    matrix: Matrix = _IDENTITY

    def moved(self, matrix: Matrix) -> Uv:
        """The same, moved once more."""
        return self._replace(matrix=compose(matrix, self.matrix))


def read_uv(context: Context, port: UsdShade.Input, default: str, depth: int) -> Uv:
    """Follow texture coordinates to a primvar; `default` names the primvar of an unconnected input."""
    attribute = producer(context, port)
    if attribute is None:
        return Uv(default)
    if not UsdShade.Output.IsOutput(attribute):
        s, t = read_numbers(context, port, (0.0, 0.0))
        return Uv("", (s, t))
    shader = UsdShade.Shader(attribute.GetPrim())
    kind = str(shader.GetShaderId() or "").removeprefix("ND_").split("_")[0]
    if kind in ("UsdPrimvarReader", "geompropvalue"):
        fallback = shader.GetInput("fallback") or shader.GetInput("default")
        s, t = read_numbers(context, fallback, (0.0, 0.0))
        return Uv(primvar_name(context, shader), (s, t))
    if kind == "texcoord":
        index = int(read_number(context, shader.GetInput("index"), 0.0))
        return Uv(f"st{index}" if index else "st")
    if depth <= _MAX_DEPTH:
        found = _followed(context, shader, kind, default, depth)
        if found is not None:
            return found
    context.unsupported.append(str(shader.GetPath()))
    what = f"{kind_of(shader)} node {node_name(shader)}"
    note(context, f"{what} drives texture coordinates and is not followed; primvar st is used", shader.GetPath())
    return Uv("st")


def _followed(context: Context, shader: UsdShade.Shader, kind: str, default: str, depth: int) -> Uv | None:
    """Coordinates that a node makes of others; None where it is not known."""

    def inner(name: str) -> Uv:
        return read_uv(context, shader.GetInput(name), default, depth + 1)

    def two(name: str, neutral: float) -> tuple[float, float]:
        s, t = read_numbers(context, shader.GetInput(name), (neutral, neutral))
        return s, t

    if kind == "UsdTransform2d":
        return read_uv(context, shader.GetInput("in"), "", depth + 1).moved(_transform_2d(context, shader))
    if kind in ("dot", "convert"):
        return inner("in")
    if kind == "rotate2d":
        return inner("in").moved(turned(read_number(context, shader.GetInput("amount"), 0.0)))
    if kind == "place2d":
        order = int(read_number(context, shader.GetInput("operationorder"), 0.0))
        angle = read_number(context, shader.GetInput("rotate"), 0.0)
        return inner("texcoord").moved(placed(two("pivot", 0.0), two("scale", 1.0), angle, two("offset", 0.0), order))
    if kind in ("multiply", "divide", "add", "subtract"):
        return _arithmetic(context, shader, kind, inner, two)
    return None


def _arithmetic(
    context: Context, shader: UsdShade.Shader, kind: str, inner: Callable[[str], Uv], two: _Pair
) -> Uv | None:
    """One input is coordinates, the other a pair of numbers."""
    made = producer(context, shader.GetInput("in1"))
    driven = made is not None and UsdShade.Output.IsOutput(made)
    if not driven and kind in ("divide", "subtract"):
        return None
    coordinates, numbers = ("in1", "in2") if driven else ("in2", "in1")
    uv, (s, t) = inner(coordinates), two(numbers, 1.0 if kind in ("multiply", "divide") else 0.0)
    if kind in ("add", "subtract"):
        sign = 1.0 if kind == "add" else -1.0
        return uv.moved((1.0, 0.0, sign * s, 0.0, 1.0, sign * t))
    if kind == "divide":
        s, t = (1.0 / value if value else 0.0 for value in (s, t))
    return uv.moved((s, 0.0, 0.0, 0.0, t, 0.0))


def _transform_2d(context: Context, shader: UsdShade.Shader) -> Matrix:
    """UsdTransform2d: scale, then rotate counter-clockwise [deg], then translate (UsdPreviewSurface proposal)."""
    angle = math.radians(read_number(context, shader.GetInput("rotation"), 0.0))
    sx, sy = read_numbers(context, shader.GetInput("scale"), (1.0, 1.0))
    tx, ty = read_numbers(context, shader.GetInput("translation"), (0.0, 0.0))
    c, s = math.cos(angle), math.sin(angle)
    return (c * sx, -s * sy, tx, s * sx, c * sy, ty)


def turned(degrees: float) -> Matrix:
    """MaterialX `rotate2d`: clockwise."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return (c, s, 0.0, -s, c, 0.0)


def placed(
    pivot: tuple[float, float], scale: tuple[float, float], degrees: float, offset: tuple[float, float], order: int
) -> Matrix:
    """MaterialX `place2d`: about a pivot, divided by scale, turned, less offset (order 0); else the other way round."""
    x, y = (1.0 / value if value else 0.0 for value in scale)
    steps: list[Matrix] = [
        (x, 0.0, 0.0, 0.0, y, 0.0), turned(degrees), (1.0, 0.0, -offset[0], 0.0, 1.0, -offset[1])
    ]  # fmt: skip
    found: Matrix = (1.0, 0.0, -pivot[0], 0.0, 1.0, -pivot[1])
    for step in steps if order == 0 else reversed(steps):
        found = compose(step, found)
    return compose((1.0, 0.0, pivot[0], 0.0, 1.0, pivot[1]), found)


def compose(outer: Matrix, inner: Matrix) -> Matrix:
    """Row-major 2x3 of `outer` after `inner`."""
    a, b, c, d, e, f = outer
    g, h, i, j, k, m = inner
    return (a * g + b * j, a * h + b * k, a * i + b * m + c, d * g + e * j, d * h + e * k, d * i + e * m + f)
