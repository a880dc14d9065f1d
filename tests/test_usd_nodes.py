"""MaterialX node graphs folded into one picture or primvar times a number plus a number."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from material_reading import HEADER, Reading, shader, write_png
from pxr import Usd

from refract_core.scene import F64, Channel, Param, Source, Wrap
from refract_core.world.textures import pack, sample

TEXELS: list[list[tuple[int, ...]]] = [[(51, 102, 204, 255), (255, 0, 153, 128)]]


def node(name: str, identifier: str, *inputs: str, kind: str = "color3f", output: str = "out") -> str:
    lines = "\n".join(inputs)
    return f'def Shader "{name}"\n{{\nuniform token info:id = "ND_{identifier}"\n{lines}\n{kind} outputs:{output}\n}}\n'


def wire(kind: str, name: str, source: str, output: str = "out") -> str:
    return f"{kind} inputs:{name}.connect = </M/{source}.outputs:{output}>"


IMAGE = node("I", "image_color3", "asset inputs:file = @./t.png@ (colorSpace = \"raw\")")
SCALAR = node("F", "image_float", "asset inputs:file = @./t.png@", kind="float")


def read(folder: Path, nodes: str, *, kind: str = "color3f", port: str = "base_color", of: str = "N",
         output: str = "out") -> Reading:  # fmt: skip
    write_png(folder / "t.png", TEXELS)
    surface = shader(wire(kind, port, of, output), identifier="ND_standard_surface_surfaceshader",
                     output="mtlx:surface")  # fmt: skip
    path = folder / "m.usda"
    path.write_text(f'{HEADER}def Material "M"\n{{\n{IMAGE}{SCALAR}{nodes}{surface}\n}}\n')
    return Reading(Usd.Stage.Open(str(path)))


def value(found: Reading, source: Source, s: float = 0.25, t: float = 0.5) -> F64:
    """What a kernel makes of a source at some coordinates: the same lookup, then scale and bias."""
    if source.texture < 0:
        return np.array(source.value[:3])
    a, b, c, d, e, f = source.uv_matrix
    table = pack(list(found.textures.values()))
    u, v = a * s + b * t + c, d * s + e * t + f
    texel = np.array(sample(table, source.texture, u, v, 0.0, *source.wrap))
    if source.channel is Channel.RGB:
        return (texel * source.scale + source.bias)[:3]
    channel = int(source.channel)
    return np.repeat(texel[channel] * source.scale[channel] + source.bias[channel], 3)


LEFT = np.array(TEXELS[0][0][:3]) / 255.0
"""The picture at (0.25, 0.5)."""


def color(name: str, *numbers: float) -> str:
    return f"color3f inputs:{name} = ({', '.join(map(str, numbers))})"


K = (0.5, 2.0, 0.25)
# name -> nodes that end in N, and what they make of a colour, by the nodedefs of MaterialX 1.39
GRAPHS = {
    "multiply": (node("N", "multiply_color3", wire("color3f", "in1", "I"), color("in2", *K)), LEFT * K),
    "multiply_by_float": (
        node("N", "multiply_color3FA", wire("color3f", "in1", "I"), "float inputs:in2 = 0.5"), LEFT * 0.5
    ),
    "multiply_default": (node("N", "multiply_color3", wire("color3f", "in1", "I")), LEFT),
    "add": (node("N", "add_color3", color("in1", *K), wire("color3f", "in2", "I")), LEFT + K),
    "subtract": (node("N", "subtract_color3", wire("color3f", "in1", "I"), color("in2", *K)), LEFT - K),
    "subtract_from": (node("N", "subtract_color3", color("in1", *K), wire("color3f", "in2", "I")), K - LEFT),
    "divide": (node("N", "divide_color3", wire("color3f", "in1", "I"), color("in2", *K)), LEFT / K),
    "mix_by_number": (
        node("N", "mix_color3", wire("color3f", "fg", "I"), color("bg", *K), "float inputs:mix = 0.25"),
        LEFT * 0.25 + np.array(K) * 0.75,
    ),
    "mix_by_picture": (
        node("N", "mix_color3", color("fg", *K), color("bg", 1, 0, 1), wire("float", "mix", "F")),
        np.array(K) * LEFT[0] + np.array((1, 0, 1)) * (1 - LEFT[0]),
    ),
    "mix_of_nothing": (
        node("N", "mix_color3", wire("color3f", "fg", "I"), wire("color3f", "bg", "X"), "float inputs:mix = 1")
        + node("X", "noise2d_color3"),
        LEFT,
    ),
    "invert": (node("N", "invert_color3", wire("color3f", "in", "I")), 1.0 - LEFT),
    "contrast": (
        node("N", "contrast_color3", wire("color3f", "in", "I"), color("amount", *K)),
        (LEFT - 0.5) * K + 0.5,
    ),
    "remap": (
        node("N", "remap_color3", wire("color3f", "in", "I"), color("inlow", *(0.1,) * 3), color("inhigh", *(0.6,) * 3),
             color("outlow", *(0.2,) * 3), color("outhigh", *(0.3,) * 3)),
        (LEFT - 0.1) / 0.5 * 0.1 + 0.2,
    ),
    "clamp": (node("N", "clamp_color3", wire("color3f", "in", "I")), LEFT),
    "constants": (
        node("N", "power_color3", color("in1", *K), color("in2", 2, 0.5, 1)), np.array((0.25, math.sqrt(2), 0.25))
    ),
    "max": (node("N", "max_color3", color("in1", *K), color("in2", 1, 1, 1)), np.array((1.0, 2.0, 1.0))),
    "chain": (
        node("N", "add_color3", wire("color3f", "in1", "A"), color("in2", 0.1, 0.1, 0.1))
        + node("A", "multiply_color3", wire("color3f", "in1", "B"), color("in2", *K))
        + node("B", "invert_color3", wire("color3f", "in", "I")),
        (1.0 - LEFT) * K + 0.1,
    ),
    "combine_in_order": (
        node("N", "combine3_color3", wire("float", "in1", "P", "outr"), "float inputs:in2 = 0.75",
             wire("float", "in3", "P", "outb"))
        + node("P", "separate3_color3", wire("color3f", "in", "I"), "float outputs:outb", kind="float", output="outr"),
        np.array((LEFT[0], 0.75, LEFT[2])),
    ),
    "combine_of_one": (
        node("N", "combine3_color3", wire("float", "in1", "E"), wire("float", "in2", "E"), "float inputs:in3 = 0.75")
        + node("E", "extract_color3", wire("color3f", "in", "I"), "int inputs:index = 1", kind="float"),
        np.array((LEFT[1], LEFT[1], 0.75)),
    ),
    "swizzle": (node("N", "swizzle_color3_color3", wire("color3f", "in", "I"), 'string inputs:channels = "ggg"'),
                LEFT[[1, 1, 1]]),
    "switch": (
        node("N", "switch_color3", color("in1", *K), wire("color3f", "in2", "I"), "float inputs:which = 1"), LEFT
    ),
    "convert": (node("N", "convert_float_color3", wire("float", "in", "F")), LEFT[[0, 0, 0]]),
}  # fmt: skip


@pytest.mark.parametrize("name", list(GRAPHS))
def test_a_graph_comes_to_what_its_nodedefs_say(tmp_path: Path, name: str) -> None:
    nodes, expected = GRAPHS[name]
    found = read(tmp_path, nodes)
    assert value(found, found[Param.DIFFUSE]) == pytest.approx(expected, abs=2e-6)


def test_one_channel_is_followed_into_a_scalar(tmp_path: Path) -> None:
    part = node("N", "separate3_color3", wire("color3f", "in", "I"), kind="float", output="outb")
    found = read(tmp_path, part, kind="float", port="specular_roughness", output="outb")
    assert found[Param.ROUGHNESS].channel is Channel.B


@pytest.mark.parametrize(("identifier", "ends"), [("ramplr", ("valuel", "valuer")), ("ramptb", ("valueb", "valuet"))])
def test_a_ramp_is_a_straight_line_and_even_beyond(tmp_path: Path, identifier: str, ends: tuple[str, str]) -> None:
    first, last = np.array((0.1, 0.2, 0.3)), np.array((1.0, 0.5, 0.0))
    found = read(tmp_path, node("N", f"{identifier}_color3", color(ends[0], *first), color(ends[1], *last)))
    source = found[Param.DIFFUSE]
    for at in (-0.5, 0.0, 0.25, 0.7, 1.0, 1.5):
        share = min(max(at, 0.0), 1.0)
        place = (at, 0.3) if identifier == "ramplr" else (0.3, at)
        assert value(found, source, *place) == pytest.approx(first + (last - first) * share, abs=1e-6)


def looked_up_at(coordinates: str) -> str:
    """The picture as node N."""
    moved = f"{wire('float2', 'texcoord', coordinates)}\ncolor3f outputs"
    return IMAGE.replace('"I"', '"N"').replace("color3f outputs", moved)


def rotated(x: float, y: float, degrees: float) -> tuple[float, float]:
    """mx_rotate_vector2 of MaterialX."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return c * x + s * y, -s * x + c * y


@pytest.mark.parametrize("order", [0, 1])
def test_place2d_is_its_node_graph(tmp_path: Path, order: int) -> None:
    (px, py), (sx, sy), angle, (ox, oy) = (0.5, 0.25), (2.0, 0.5), 30.0, (0.1, 0.2)
    place = node("L", "place2d_vector2", wire("float2", "texcoord", "T"), f"float2 inputs:pivot = ({px}, {py})",
                 f"float2 inputs:scale = ({sx}, {sy})", f"float inputs:rotate = {angle}",
                 f"float2 inputs:offset = ({ox}, {oy})", f"int inputs:operationorder = {order}",
                 kind="float2")  # fmt: skip
    image = looked_up_at("L")
    coordinates = node("T", "texcoord_vector2", "int inputs:index = 1", kind="float2")
    source = read(tmp_path, place + image + coordinates)[Param.DIFFUSE]
    assert source.uv_primvar == "st1"
    s, t = 0.3, 0.9
    x, y = s - px, t - py
    if order == 0:
        x, y = rotated(x / sx, y / sy, angle)
        x, y = x - ox, y - oy
    else:
        x, y = rotated(x - ox, y - oy, angle)
        x, y = x / sx, y / sy
    a, b, c, d, e, f = source.uv_matrix
    assert (a * s + b * t + c, d * s + e * t + f) == pytest.approx((x + px, y + py))


def test_coordinates_times_and_plus(tmp_path: Path) -> None:
    nodes = node("A", "add_vector2", wire("float2", "in1", "B"), "float2 inputs:in2 = (0.1, 0.2)", kind="float2")
    nodes += node("B", "multiply_vector2FA", wire("float2", "in1", "T"), "float inputs:in2 = 3", kind="float2")
    nodes += node("T", "texcoord_vector2", kind="float2")
    image = looked_up_at("A")
    assert read(tmp_path, nodes + image)[Param.DIFFUSE].uv_matrix == pytest.approx((3, 0, 0.1, 0, 3, 0.2))


def test_a_gltf_image_turns_as_its_node_graph(tmp_path: Path) -> None:
    """NG_gltf_image: place2d about (0, 1), with the scale inverted, the turn negated, the offset (-x, y)."""
    image = node("N", "gltf_image_color3_color3_1_0", 'asset inputs:file = @./t.png@ (colorSpace = "raw")',
                 "float2 inputs:scale = (2, 4)", "float2 inputs:offset = (0.1, 0.2)",
                 color("factor", *K))  # fmt: skip
    source = read(tmp_path, image)[Param.DIFFUSE]
    s, t = 0.3, 0.9
    a, b, c, d, e, f = source.uv_matrix
    assert (a * s + b * t + c, d * s + e * t + f) == pytest.approx((s * 2 + 0.1, (t - 1) * 4 - 0.2 + 1))
    assert source.scale[:3] == K


def test_what_cannot_be_folded_is_named_once_for_each_kind(tmp_path: Path) -> None:
    product = node("N", "multiply_color3", wire("color3f", "in1", "I"), wire("color3f", "in2", "J"))
    found = read(tmp_path, product + IMAGE.replace('"I"', '"J"'))
    assert found[Param.DIFFUSE].texture < 0
    (notice,) = found.notices
    assert notice.path == "/M/N"
    assert notice.text.startswith("MaterialX node 'ND_multiply_color3'")


def test_a_network_where_everything_is_used_twice_ends(tmp_path: Path) -> None:
    """2^30 ways through 30 nodes."""
    nodes = ""
    for i in range(30):
        twice = (wire("color3f", name, f"N{i + 1}") for name in ("in1", "in2"))
        nodes += node(f"N{i}" if i else "N", "add_color3", *twice)
    nodes += node("N30", "constant_color3", color("value", 2.0**-30, 0.0, 0.0))
    found = read(tmp_path, nodes)  # walking each way would take days
    assert found[Param.DIFFUSE].value[0] == pytest.approx(1.0)


def test_a_scalar_map_takes_a_colour(tmp_path: Path) -> None:
    """One channel of a colourful picture times a colour: each channel has its own factor."""
    surface = shader(f"{wire('float', 'emission', 'F')}\n{color('emission_color', *K)}",
                     identifier="ND_standard_surface_surfaceshader", output="mtlx:surface")  # fmt: skip
    write_png(tmp_path / "t.png", TEXELS)
    (tmp_path / "m.usda").write_text(f'{HEADER}def Material "M"\n{{\n{SCALAR}{surface}\n}}\n')
    found = Reading(Usd.Stage.Open(str(tmp_path / "m.usda")))
    assert value(found, found[Param.EMISSIVE]) == pytest.approx(LEFT[0] * np.array(K))


def test_what_scatters_below_the_surface_has_its_colour(tmp_path: Path) -> None:
    colors = f"{color('base_color', 1, 0, 0)}\n{color('subsurface_color', 0, 0, 1)}"
    surface = shader(f"float inputs:subsurface = 0.5\nfloat inputs:base = 1\n{colors}",
                     identifier="ND_standard_surface_surfaceshader", output="mtlx:surface")  # fmt: skip
    (tmp_path / "m.usda").write_text(f'{HEADER}def Material "M"\n{{\n{surface}\n}}\n')
    found = Reading(Usd.Stage.Open(str(tmp_path / "m.usda")))
    assert found[Param.DIFFUSE].value[:3] == pytest.approx((0.5, 0.0, 0.5))
    assert "MaterialX subsurface" in found.texts


def test_arnold_images_are_followed(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", TEXELS)
    image = 'def Shader "N"\n{\nuniform token info:id = "arnold:image"\nasset inputs:filename = @./t.png@\n' \
            "float inputs:sscale = 3\ncolor3f inputs:multiply = (0.5, 0.5, 0.5)\ncolor3f outputs:out\n}\n"
    surface = shader(f"float inputs:transmission = 1\n{wire('color3f', 'transmission_color', 'N')}",
                     identifier="arnold:standard_surface", output="arnold:surface")  # fmt: skip
    (tmp_path / "m.usda").write_text(f'{HEADER}def Material "M"\n{{\n{image}{surface}\n}}\n')
    source = Reading(Usd.Stage.Open(str(tmp_path / "m.usda")))[Param.TRANSMITTANCE]
    assert source.texture == 0
    assert source.scale[:3] == (0.5, 0.5, 0.5)
    assert source.uv_matrix[0] == 3.0
    assert source.wrap == (Wrap.REPEAT, Wrap.REPEAT)


def test_a_normal_is_made_a_unit_vector_by_who_takes_it(tmp_path: Path) -> None:
    """`normalize` of numbers is theirs; of a picture, as `normalmap` in object space becomes, it is the picture."""
    graph = node("P", "image_vector3", "asset inputs:file = @./t.png@", kind="float3")
    wired = graph + node("N", "normalize_vector3", wire("float3", "in", "P"), kind="float3")
    found = read(tmp_path, wired, kind="float3", port="normal")
    np.testing.assert_allclose(value(found, found[Param.NORMAL]), LEFT, atol=1e-6)
    numbers = node("N", "normalize_vector3", "float3 inputs:in = (0, 3, 4)", kind="float3")
    found = read(tmp_path, numbers, kind="float3")
    np.testing.assert_allclose(value(found, found[Param.DIFFUSE]), (0.0, 0.6, 0.8), atol=1e-6)
