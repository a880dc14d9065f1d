"""Materials written as a MaterialX file and read back by reference: the same glass, the same pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from material_reading import write_png
from test_convert import block, glass, material, run, several
from test_convert_to_gltf import shop

from refract_core.scene import Model, Param, Scene
from refract_core.usd.stage import load_stage

mx = pytest.importorskip("MaterialX")


def valid(path: Path) -> Any:
    """The file as MaterialX's own library reads it, every node of it by a definition of the standard library."""
    library, document = mx.createDocument(), mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    mx.readFromXmlFile(document, str(path))
    document.setDataLibrary(library)
    good, said = document.validate()
    assert good, said
    for node in document.getNodes():
        assert node.getNodeDef() is not None, node.getName()
        for port in node.getInputs():
            if other := port.getConnectedNode():
                output = port.getOutputString()
                kind = other.getType() if not output else other.getNodeDef().getActiveOutput(output).getType()
                assert kind == port.getType()
    return document


def back(path: str, folder: Path, names: list[str], unit: float, file: Path) -> Scene:
    """A stage of balls, each with a material of the file."""
    balls = []
    for name in names:
        balls.append(block(f'def Material "{name}" (references = @{file}@</MaterialX/Materials/{name}>)'))
        balls.append(block(f'def Sphere "{name}_ball" (prepend apiSchemas = ["MaterialBindingAPI"])',
                           f"rel material:binding = </{name}>"))  # fmt: skip
    stage = folder / "back.usda"
    stage.write_text(f"#usda 1.0\n(\n    metersPerUnit = {unit}\n    upAxis = \"Z\"\n)\n" + "\n".join(balls) + "\n")
    return load_stage(stage)


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_parameters_come_back(tmp_path: Path, unit: float) -> None:
    path, file = shop(tmp_path, unit), tmp_path / "out" / "shop.mtlx"
    file.parent.mkdir()
    run(path, file, to="mtlx")
    valid(file)
    names = ["Honey", "Clear", "Window", "Wall"]
    before, after = load_stage(path), back(path, tmp_path, names, unit, file)
    assert not [notice for notice in after.notices if "MaterialX" in notice.text]
    for name in names:
        old, new = material(before, name), material(after, name)
        for param in (Param.IOR, Param.TRANSMITTANCE, Param.ROUGHNESS, Param.METALLIC, Param.OPACITY, Param.CLEARCOAT):
            assert new.inputs[param].value == pytest.approx(old.inputs[param].value, abs=1e-5), (name, param)
        assert new.abbe == pytest.approx(old.abbe, rel=1e-5)
        if old.refractive and old.inputs[Param.TRANSMITTANCE].value[:3] != (1.0, 1.0, 1.0):
            assert new.absorption_distance == pytest.approx(old.absorption_distance, rel=1e-5)
        if not old.refractive:
            for param in (Param.DIFFUSE, Param.EMISSIVE):
                assert new.inputs[param].value == pytest.approx(old.inputs[param].value, abs=1e-5)
    models = [material(after, name).model for name in names]
    assert models == [Model.TRACED, Model.TRACED, Model.THIN, Model.NONE]  # a ball's model is no part of a material


MAPPED = """
    def Shader "T"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @./t.png@
        float4 inputs:scale = (0.5, 0.25, 1, 1)
        token inputs:wrapS = "mirror"
        token inputs:wrapT = "clamp"
        token inputs:sourceColorSpace = "sRGB"
        float2 inputs:st.connect = </W/Looks/Stained/X.outputs:result>
        float outputs:r
        float3 outputs:rgb
    }
    def Shader "N"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @./n.png@
        float4 inputs:scale = (2, 2, 2, 1)
        float4 inputs:bias = (-1, -1, -1, 0)
        token inputs:sourceColorSpace = "raw"
        float2 inputs:st.connect = </W/Looks/Stained/P.outputs:result>
        float3 outputs:rgb
    }
    def Shader "X"
    {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </W/Looks/Stained/P.outputs:result>
        float inputs:rotation = 30
        float2 inputs:scale = (2, 3)
        float2 inputs:translation = (0.25, 0.5)
        float2 outputs:result
    }
    def Shader "P"
    {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "map1"
        float2 outputs:result
    }
"""


def test_pictures_come_back_with_their_coordinates(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", [[(255, 0, 0, 255), (0, 255, 0, 255)]])
    write_png(tmp_path / "n.png", [[(128, 128, 255, 255)]])
    path = Path(several(tmp_path))
    inputs = ("float inputs:opacity = 0", "normal3f inputs:normal.connect = </W/Looks/Stained/N.outputs:rgb>",
              "float inputs:roughness.connect = </W/Looks/Stained/T.outputs:r>")  # fmt: skip
    lines = ("color3f inputs:refraction:transmittanceColor.connect = </W/Looks/Stained/T.outputs:rgb>", MAPPED)
    stained = glass("Stained", *inputs, head='(prepend apiSchemas = ["RefractMaterialAPI"])', lines=lines)
    thing = ('def Sphere "S" (prepend apiSchemas = ["MaterialBindingAPI"])\n{\n'
             "rel material:binding = </W/Looks/Stained>\n}\n")  # fmt: skip
    text = path.read_text().replace('def Scope "Looks"\n{', f'def Scope "Looks"\n{{\n{stained}').rstrip()
    path.write_text(f"{text[:-1]}{thing}}}\n")
    file = tmp_path / "sub" / "out.mtlx"
    file.parent.mkdir()
    run(str(path), file)
    valid(file)
    assert "../t.png" in file.read_text()
    before, after = load_stage(path), back(str(path), tmp_path, ["Stained"], 1.0, file)
    old, new = material(before, "Stained"), material(after, "Stained")
    for param in (Param.TRANSMITTANCE, Param.ROUGHNESS, Param.NORMAL):
        a, b = old.inputs[param], new.inputs[param]
        assert (b.wrap, b.uv_primvar, b.channel) == (a.wrap, a.uv_primvar, a.channel), param
        assert b.uv_matrix == pytest.approx(a.uv_matrix, abs=1e-5)
        used = slice(0, 3) if param is not Param.ROUGHNESS else slice(0, 1)
        assert b.scale[used] == pytest.approx(a.scale[used], abs=1e-6)
        assert b.bias[used] == pytest.approx(a.bias[used], abs=1e-6)
        one, other = before.textures[a.texture], after.textures[b.texture]
        assert (one.pixels == other.pixels).all()
        assert one.srgb == other.srgb


def test_names_are_unique_and_the_stage_is_left_alone(tmp_path: Path) -> None:
    path = several(tmp_path)
    content = Path(path).read_bytes()
    run(path, tmp_path / "out.mtlx")
    document = valid(tmp_path / "out.mtlx")
    materials = [node.getName() for node in document.getMaterialNodes()]
    assert sorted(materials) == ["Ball", "Cone", "Pane", "Wall"]
    assert Path(path).read_bytes() == content


def test_a_material_that_instances_share_is_one(tmp_path: Path) -> None:
    one = 'def Xform "{}" (\n    instanceable = true\n    inherits = </Kind>\n)\n{{\n}}'
    shared = glass("Amber").replace("/W/Looks/", "/Kind/")
    text = block('class Xform "Kind"', shared) + "\n" + block('def Xform "W"', one.format("A"), one.format("B"))
    path = tmp_path / "in.usda"
    path.write_text(f'#usda 1.0\n(\n    defaultPrim = "W"\n)\n{text}\n')
    assert list(run(str(path), tmp_path / "out.mtlx")) == ["Amber"]
    assert [node.getName() for node in valid(tmp_path / "out.mtlx").getMaterialNodes()] == ["Amber"]
