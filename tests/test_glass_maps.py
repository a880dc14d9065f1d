"""Pictures and primvars on every input that glass has: read, converted, and written back."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from material_reading import HEADER, Reading, write_png
from pxr import Usd
from test_convert import block, material, run
from test_convert_gltf import Builder, shop
from test_convert_shaders import stage

from refract_core.scene import Channel, Material, Param, Scene, Source
from refract_core.usd.stage import load_stage

GLASSES = {"open_pbr_surface": "transmission_weight", "standard_surface": "transmission", "gltf_pbr": "transmission"}
ROUGHNESS = {
    "open_pbr_surface": "specular_roughness", "standard_surface": "specular_roughness", "gltf_pbr": "roughness"
}  # fmt: skip
COLOR = {
    "open_pbr_surface": "transmission_color", "standard_surface": "transmission_color", "gltf_pbr": "base_color"
}  # fmt: skip


def image(name: str, kind: str = "color3") -> str:
    value = {"color3": "color3f", "float": "float"}[kind]
    return block(f'def Shader "{name}"', f'uniform token info:id = "ND_image_{kind}"',
                 "asset inputs:file = @./panes.png@", f"{value} outputs:out")  # fmt: skip


def panes(folder: Path) -> None:
    """Red and blue glass, in linear light 1 and 0."""
    write_png(folder / "panes.png", [[(255, 0, 0, 255), (0, 0, 255, 255)]])


def surface(identifier: str, *inputs: str) -> str:
    more = ("float inputs:metallic = 0",) if identifier == "gltf_pbr" else ()
    return block('def Shader "S"', f'uniform token info:id = "ND_{identifier}_surfaceshader"', *more, *inputs,
                 "token outputs:out")  # fmt: skip


def same(found: Source, wanted: Source) -> bool:
    """Two sources give the same everywhere, whatever the place of their picture."""
    numbers = (found.scale, found.bias, found.uv_matrix)
    return (
        found.channel is wanted.channel and found.wrap == wanted.wrap and found.primvar == wanted.primvar
        and found.uv_primvar == wanted.uv_primvar
        and all(np.allclose(a, b, atol=1e-5) for a, b in zip(
            numbers, (wanted.scale, wanted.bias, wanted.uv_matrix), strict=True))
    )  # fmt: skip


def glass_of(scene: Scene) -> Material:
    return material(scene, "M")


@pytest.mark.parametrize("identifier", list(GLASSES))
@pytest.mark.parametrize("inside", [False, True])
def test_mapped_glass_stays_mapped_when_converted(tmp_path: Path, identifier: str, inside: bool) -> None:
    panes(tmp_path)
    weight, rough, color = (table[identifier] for table in (GLASSES, ROUGHNESS, COLOR))
    nodes = "\n".join((image("I"), image("W", "float"), image("R", "float")))
    home = "/M/N" if inside else "/M"
    shader = surface(
        identifier,
        f"color3f inputs:{color}.connect = <{home}/I.outputs:out>",
        f"float inputs:{weight}.connect = <{home}/W.outputs:out>",
        f"float inputs:{rough}.connect = <{home}/R.outputs:out>",
    )
    if inside:  # the whole shader in a graph: nothing outside can be connected to what is in it
        graph = block('def NodeGraph "N"', "token outputs:surface.connect = </M/N/S.outputs:out>", shader, nodes)
        path = stage(tmp_path, "mtlx:", graph, "Plane")
        Path(path).write_text(Path(path).read_text().replace("</M/S.outputs:out>", "</M/N.outputs:surface>"))
    else:
        path = stage(tmp_path, "mtlx:", f"{shader}\n{nodes}", "Plane")
    out = tmp_path / "out.usda"
    assert run(path, out)["M"].color_from
    before, after = glass_of(load_stage(path)), glass_of(load_stage(out))
    assert before.refractive
    for param in (Param.TRANSMITTANCE, Param.OPACITY, Param.ROUGHNESS):
        assert before.inputs[param].texture >= 0
        assert same(after.inputs[param], before.inputs[param]), param


@pytest.mark.parametrize("target", ["preview", "openpbr", "gltf"])
def test_maps_are_written_back_and_read_the_same(tmp_path: Path, target: str) -> None:
    panes(tmp_path)
    shader = surface(
        "open_pbr_surface",
        "float inputs:transmission_weight = 1",
        "color3f inputs:transmission_color.connect = </M/I.outputs:out>",
        "float inputs:specular_roughness.connect = </M/R.outputs:out>",
        "vector3f inputs:geometry_normal.connect = </M/N.outputs:out>",
    )
    bumps = block('def Shader "N"', 'uniform token info:id = "ND_normalmap_float"',
                  "vector3f inputs:in.connect = </M/V.outputs:out>", "vector3f outputs:out")  # fmt: skip
    vector = image("V").replace("ND_image_color3", "ND_image_vector3").replace("color3f", "vector3f")
    place = "mtlx:" if target == "preview" else ""  # the other one must be free
    path = stage(tmp_path, place, f"{shader}\n{image('I')}\n{image('R', 'float')}\n{bumps}\n{vector}", "Plane")
    run(path, tmp_path / "plain.usda")
    run(path, tmp_path / "to.usda", to=target, flatten=True)
    plain, to = (glass_of(load_stage(tmp_path / name)) for name in ("plain.usda", "to.usda"))
    for param in (Param.TRANSMITTANCE, Param.ROUGHNESS, Param.NORMAL):
        assert plain.inputs[param].texture >= 0
        assert same(to.inputs[param], plain.inputs[param]), param
    if target != "preview":  # without the schema the new shader says it too
        bare = (tmp_path / "to.usda").read_text().replace('prepend apiSchemas = ["RefractMaterialAPI"]', "")
        (tmp_path / "bare.usda").write_text(bare)
        again = glass_of(load_stage(tmp_path / "bare.usda"))
        for param in (Param.TRANSMITTANCE, Param.ROUGHNESS, Param.NORMAL):
            assert same(again.inputs[param], plain.inputs[param]), param


def test_a_primvar_colours_glass_through_the_schema(tmp_path: Path) -> None:
    reader = block('def Shader "P"', 'uniform token info:id = "UsdPrimvarReader_float3"',
                   'string inputs:varname = "tint"', "float3 outputs:result")  # fmt: skip
    text = f"""{HEADER}def Material "M" (prepend apiSchemas = ["RefractMaterialAPI"])
    {{
        color3f inputs:refraction:transmittanceColor = (0.5, 0.5, 0.5)
        color3f inputs:refraction:transmittanceColor.connect = </M/P.outputs:result>
        {reader}
    }}"""
    opened = Usd.Stage.CreateInMemory()
    opened.GetRootLayer().ImportFromString(text)
    assert Reading(opened)[Param.TRANSMITTANCE].primvar == "tint"


def test_metal_by_a_map_lets_no_light_through(tmp_path: Path) -> None:
    panes(tmp_path)
    shader = surface("standard_surface", "float inputs:transmission = 0.75",
                     "float inputs:metalness.connect = </M/W.outputs:out>")  # fmt: skip
    path = stage(tmp_path, "mtlx:", f"{shader}\n{image('W', 'float')}")
    opacity = glass_of(load_stage(path)).inputs[Param.OPACITY]
    of = [value * opacity.scale[0] + opacity.bias[0] for value in (0.0, 1.0)]
    assert of == pytest.approx([0.25, 1.0])


def test_base_colour_and_volume_of_gltf_are_one_colour() -> None:
    """KHR_materials_volume: a ray through one thickness keeps base * attenuation^(thickness / distance)."""
    base, left, thickness, distance, unit = 0.5, 0.25, 2.0, 4.0, 0.1
    text = surface(
        "gltf_pbr", "float inputs:transmission = 1", f"float inputs:thickness = {thickness}",
        f"color3f inputs:base_color = ({base}, {base}, {base})", f"float inputs:attenuation_distance = {distance}",
        f"color3f inputs:attenuation_color = ({left}, {left}, {left})",
    )  # fmt: skip
    opened = Usd.Stage.CreateInMemory()
    opened.GetRootLayer().ImportFromString(
        f'{HEADER}def Material "M"\n{{\ntoken outputs:mtlx:surface.connect = </M/S.outputs:out>\n{text}\n}}'
    )
    found = Reading(opened, metres_per_unit=unit)
    way = thickness * unit
    kept = found[Param.TRANSMITTANCE].value[0] ** (way / found.material.absorption_distance)
    assert kept == pytest.approx(base * left ** (thickness / distance))


# --- glTF files


def changed(folder: Path, **materials: dict[str, Any]) -> Path:
    """The shop of glass with some of its materials replaced, converted."""
    made = shop(folder)
    document = json.loads(json.dumps(made.document["materials"]))
    for one in document:
        one.update(materials.get(one["name"], {}))
    made.document["materials"] = document
    out = folder / "out.usda"
    run(made.glb(folder / "shop.glb"), out)
    return out


def test_a_stained_window_keeps_its_picture(tmp_path: Path) -> None:
    pane = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 1, 1, 1], "metallicFactor": 0}
    out = changed(tmp_path, Window={"pbrMetallicRoughness": pane})
    source = material(load_stage(out), "Window").inputs[Param.TRANSMITTANCE]
    assert source.texture >= 0
    assert source.channel is Channel.RGB
    assert source.scale[:3] == pytest.approx((0.5, 1, 1))


def test_thickness_by_picture_is_that_of_the_mesh_in_the_world(tmp_path: Path) -> None:
    volume = {"thicknessFactor": 2.0, "thicknessTexture": {"index": 0}}
    honey = {"KHR_materials_transmission": {"transmissionFactor": 1}, "KHR_materials_volume": volume}
    out = changed(tmp_path, Honey={"extensions": honey})
    source = material(load_stage(out), "Honey").inputs[Param.THICKNESS]
    assert source.texture >= 0
    assert source.channel is Channel.G  # KHR_materials_volume: thicknessTexture, green channel
    assert source.scale[1] == pytest.approx(0.2)  # in mesh space: 2 under a scale of 0.1


def test_transmission_stops_where_a_picture_says_metal(tmp_path: Path) -> None:
    core = {"metallicRoughnessTexture": {"index": 0}, "metallicFactor": 1}
    out = changed(tmp_path, Window={"pbrMetallicRoughness": core})
    source = material(load_stage(out), "Window").inputs[Param.OPACITY]
    assert source.channel is Channel.B
    assert [value * source.scale[2] + source.bias[2] for value in (0.0, 1.0)] == pytest.approx([0.0, 1.0])


def test_colours_of_the_vertices_tint(tmp_path: Path) -> None:
    made = Builder(tmp_path)
    factor = [0.5, 1.0, 1.0, 1.0]
    made.document["materials"] = [
        {"name": "Paint", "pbrMetallicRoughness": {"baseColorFactor": factor, "metallicFactor": 0},
         "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}}}
    ]  # fmt: skip
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    attributes = {"POSITION": made.accessor(points, "VEC3"), "COLOR_0": made.accessor(colors, "VEC3")}
    made.document["meshes"].append({"primitives": [{"attributes": attributes, "material": 0}]})
    made.node(mesh=0)
    out = tmp_path / "out.usda"
    run(made.glb(tmp_path / "a.glb"), out)
    scene = load_stage(out)
    found = material(scene, "Paint").inputs[Param.TRANSMITTANCE]
    assert found.primvar == "displayColor"
    mesh = scene.meshes[0]
    assert mesh.primvars["displayColor"].reshape(-1, 3) == pytest.approx(colors * factor[:3])
    assert math.isclose(material(scene, "Paint").absorption_distance, 0.005)
