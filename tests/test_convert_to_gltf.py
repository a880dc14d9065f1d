"""Stages written as glTF and read back: the same triangles at the same places, the same glass."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from material_reading import write_png
from numpy.typing import NDArray
from scenes import draw
from test_convert import HEAD, ball, block, cone, glass, material, pane, run
from test_convert import stage as bound
from test_convert_pictures import AMBER, looks, mesh, vessel
from test_convert_pictures import ball as lit_ball
from test_convert_pictures import stage as pictured

from refract_core.errors import UsageError
from refract_core.scene import Mesh, Model, Param, Scene
from refract_core.usd.convert.gltf_write import quaternion
from refract_core.usd.stage import load_stage
from refract_core.verbs.convert import ConvertOrder, convert

pytest.importorskip("pygltflib")

API = '(prepend apiSchemas = ["RefractMaterialAPI"])'
HONEY = (
    'uniform token refraction:model = "traced"', "float inputs:refraction:ior = 1.33",
    "color3f inputs:refraction:transmittanceColor = (0.9, 0.6, 0.1)",
    "float inputs:refraction:absorptionDistance = 3.5", "float inputs:refraction:abbeNumber = 31",
)  # fmt: skip
WALL = ("color3f inputs:diffuseColor = (0.2, 0.3, 0.4)", "float inputs:metallic = 0.25", "float inputs:roughness = 0.6",
        "color3f inputs:emissiveColor = (4, 2, 1)", "float inputs:clearcoat = 0.5")  # fmt: skip


def shop(folder: Path, unit: float = 0.01) -> str:
    """A cone of honey, a ball, a pane and a wall, under transforms that turn, mirror, scale and shear; Z up."""
    clear = glass("Clear", "float inputs:opacity = 0.25", "float inputs:ior = 1.7", "float inputs:roughness = 0.3")
    materials = [glass("Honey", head=API, lines=HONEY), clear, glass("Window"), glass("Wall", *WALL)]
    move = "matrix4d xformOp:transform = {0}"
    order = 'uniform token[] xformOpOrder = ["xformOp:transform"]'

    def under(name: str, matrix: str, inside: str) -> str:
        return block(f'def Xform "{name}"', move.format(matrix), order, inside)

    prims = [
        under("Turned", "((0, 2, 0, 0), (-2, 0, 0, 0), (0, 0, 2, 0), (10, 20, 30, 1))", cone("Cone", "Honey")),
        under("Mirrored", "((-1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (-9, 0, 0, 1))", cone("Cone", "Honey")),
        under("Sheared", "((1, 0.5, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 9, 0, 1))", cone("Cone", "Wall")),
        ball("Ball", "Clear", 2.5, "double3 xformOp:translate = (20, 0, 0)",
             'uniform token[] xformOpOrder = ["xformOp:translate"]'), pane("Pane", "Window"),
    ]  # fmt: skip
    path = folder / "shop.usda"
    inside = block('def Xform "W"', block('def Scope "Looks"', *materials), *prims)
    path.write_text(f"{HEAD.format(unit=unit)}{inside}\n")
    return str(path)


def there_and_back(path: str, folder: Path, extension: str = ".glb", **options: Any) -> tuple[Scene, Scene, Path]:
    """The scene, what it is once written as glTF and converted again, and the file."""
    file, back = folder / f"file{extension}", folder / "back.usda"
    run(path, file, **options)
    run(str(file), back)
    return load_stage(path), load_stage(back), file


def document(path: Path) -> dict[str, Any]:
    content = path.read_bytes()
    if path.suffix == ".gltf":
        found: dict[str, Any] = json.loads(content)
        return found
    magic, version, length, size, kind = struct.unpack("<4sIII4s", content[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    assert length % 4 == size % 4 == 0
    loaded: dict[str, Any] = json.loads(content[20 : 20 + size])
    return loaded


def triangles(scene: Scene) -> NDArray[np.float64]:
    """Corners in the stage's world [m], Y up, each triangle from its least corner on; sorted."""
    found = []
    origin = -np.linalg.inv(scene.stage_from_engine)[:3, 3]
    for one in scene.meshes:
        corners = one.points[one.triangles.astype(np.int64)].astype(np.float64) + origin
        first = np.lexsort(np.moveaxis(np.round(corners, 5), -1, 0)[::-1], axis=1)[:, 0]
        found.append(np.stack([corners[np.arange(len(corners)), (first + k) % 3] for k in range(3)], axis=1))
    every = np.concatenate(found).reshape(-1, 9)
    return every[np.lexsort(np.round(every, 4).T[::-1])].reshape(-1, 3, 3)


def same_surface(a: NDArray[np.float64], b: NDArray[np.float64], tolerance: float) -> None:
    """Every triangle has a partner: by its middle, its normal and its corners."""
    assert len(a) == len(b)
    for one, other in ((a, b), (b, a)):
        near = np.argmin(((one.mean(1)[:, None] - other.mean(1)[None]) ** 2).sum(-1), axis=1)
        rolled = np.stack([np.roll(other[near], k, axis=1) for k in range(3)])
        assert np.abs(rolled - one).max(axis=(2, 3)).min(axis=0).max() < tolerance


@pytest.mark.parametrize("extension", [".glb", ".gltf"])
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_triangles_and_glass_come_back(tmp_path: Path, extension: str, unit: float) -> None:
    path = shop(tmp_path, unit)
    before, after, _ = there_and_back(path, tmp_path, extension)
    assert not [ball for ball in after.spheres]
    there = [one for one in before.meshes if not one.path.endswith("Ball")]
    back = [one for one in after.meshes if "Ball" not in one.path]
    first = triangles(Scene(tuple(there), before.materials, stage_from_engine=_origin(before)))
    second = triangles(Scene(tuple(back), after.materials, stage_from_engine=_origin(after)))
    same_surface(first, second, 1e-4 * unit * 30)
    for name in ("Honey", "Clear", "Window", "Wall"):
        old, new = material(before, name), material(after, name)
        for param in (Param.IOR, Param.TRANSMITTANCE, Param.ROUGHNESS, Param.METALLIC, Param.OPACITY, Param.CLEARCOAT):
            assert new.inputs[param].value == pytest.approx(old.inputs[param].value, abs=2e-5), (name, param)
        assert new.abbe == pytest.approx(old.abbe, rel=1e-5)
        if name == "Wall":
            for param in (Param.DIFFUSE, Param.EMISSIVE):
                assert new.inputs[param].value == pytest.approx(old.inputs[param].value, abs=2e-5)
        if old.inputs[Param.TRANSMITTANCE].value[:3] != (1.0, 1.0, 1.0):
            assert new.absorption_distance == pytest.approx(old.absorption_distance, rel=1e-5)
    models = {name: material(after, name).model for name in ("Honey", "Clear", "Window", "Wall")}
    assert models == {"Honey": Model.TRACED, "Clear": Model.SPHERE, "Window": Model.THIN, "Wall": Model.NONE}
    assert material(after, "Clear").inputs[Param.THICKNESS].value[0] == pytest.approx(5.0 * unit, rel=1e-3)


def _origin(scene: Scene) -> NDArray[np.float64]:
    """As if the stage were in metres and Y up: the engine's world moved back alone."""
    matrix = np.eye(4)
    linear = np.linalg.inv(scene.stage_from_engine)
    matrix[:3, 3] = -linear[:3, 3]
    return matrix


def test_the_extensions_say_it_in_their_own_words(tmp_path: Path) -> None:
    """Khronos: ior, attenuation colour and distance [m], dispersion = 20 / V_d, thickness of a ball its diameter."""
    file = tmp_path / "shop.glb"
    run(shop(tmp_path), file)
    made = document(file)
    honey = next(one for one in made["materials"] if one["name"] == "Honey")["extensions"]
    assert honey["KHR_materials_ior"] == {"ior": pytest.approx(1.33)}
    assert honey["KHR_materials_transmission"] == {"transmissionFactor": 1.0}
    assert honey["KHR_materials_volume"]["attenuationColor"] == pytest.approx([0.9, 0.6, 0.1])
    assert honey["KHR_materials_volume"]["attenuationDistance"] == pytest.approx(0.035)
    assert honey["KHR_materials_dispersion"]["dispersion"] == pytest.approx(20 / 31)
    window = next(one for one in made["materials"] if one["name"] == "Window")
    assert "KHR_materials_volume" not in window["extensions"]  # a wall
    assert window["doubleSided"] is True
    clear = next(one for one in made["materials"] if one["name"] == "Clear")["extensions"]
    assert clear["KHR_materials_transmission"]["transmissionFactor"] == pytest.approx(0.75)
    assert clear["KHR_materials_volume"]["thicknessFactor"] == pytest.approx(0.05, rel=1e-3)
    wall = next(one for one in made["materials"] if one["name"] == "Wall")
    assert wall["emissiveFactor"] == pytest.approx([1.0, 0.5, 0.25])
    assert wall["extensions"]["KHR_materials_emissive_strength"] == {"emissiveStrength": 4.0}
    assert set(made["extensionsUsed"]) == {
        name for one in made["materials"] for name in one.get("extensions", {})
    }  # fmt: skip
    assert made["asset"]["version"] == "2.0"


def test_nodes_turn_and_move_and_nothing_else(tmp_path: Path) -> None:
    """Scale, shear and mirroring are in the points, so that thickness is in metres; a rotation is of unit length."""
    file = tmp_path / "shop.glb"
    run(shop(tmp_path), file)
    made = document(file)
    named = {node["name"]: node for node in made["nodes"]}
    assert {"W", "Turned", "Mirrored", "Sheared", "Ball", "Pane"} <= set(named)
    for node in made["nodes"]:
        assert set(node) <= {"name", "mesh", "children", "translation", "rotation"}
        if "rotation" in node:
            assert np.linalg.norm(node["rotation"]) == pytest.approx(1.0)
    assert len(made["scenes"][0]["nodes"]) == 1
    for accessor in made["accessors"]:
        view = made["bufferViews"][accessor["bufferView"]]
        each, width = {5126: 4, 5123: 2, 5125: 4}, {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
        size = each[accessor["componentType"]] * width[accessor["type"]]
        assert accessor["count"] * size == view["byteLength"]
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= made["buffers"][0]["byteLength"]


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 1, 1), (1, -2, 0.5)])
@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.3, 3.0, np.pi])
def test_a_rotation_as_a_quaternion(axis: tuple[float, float, float], angle: float) -> None:
    n = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    x, y, z, w = quaternion(turn)
    wanted = np.array([*(n * np.sin(angle / 2)), np.cos(angle / 2)])
    assert abs(float(wanted @ (x, y, z, w))) == pytest.approx(1.0, abs=1e-9)


INSTANCED = """
def PointInstancer "I"
{
    rel prototypes = </W/I/P>
    int[] protoIndices = [0, 0, 0, 0]
    point3f[] positions = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]
    float3[] scales = [(0.2, 0.2, 0.2), (0.2, 0.2, 0.2), (0.2, 0.2, 0.2), (0.4, 0.4, 0.4)]
    def Xform "P"
    {
        BALL
    }
}
"""


def test_instances_of_one_size_share_a_mesh(tmp_path: Path) -> None:
    path = tmp_path / "in.usda"
    inside = block('def Xform "W"', block('def Scope "Looks"', glass("G")), INSTANCED.replace("BALL", cone("C", "G")))
    path.write_text(f"{HEAD.format(unit=1)}{inside}\n")
    before, after, file = there_and_back(str(path), tmp_path)
    assert len(document(file)["meshes"]) == 2
    assert sum("mesh" in node for node in document(file)["nodes"]) == 4
    assert len(after.meshes) == 4
    assert after.bounds[1] == pytest.approx(before.bounds[1], abs=1e-5)


TEXTURED = """
    def Shader "T"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @./t.png@
        token inputs:wrapS = "mirror"
        token inputs:wrapT = "clamp"
        token inputs:sourceColorSpace = "sRGB"
        float2 inputs:st.connect = </W/Looks/Stained/X.outputs:result>
        float3 outputs:rgb
    }
    def Shader "X"
    {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </W/Looks/Stained/P.outputs:result>
        float2 inputs:scale = (2, 1)
        float2 inputs:translation = (0.25, 0)
        float2 outputs:result
    }
    def Shader "P"
    {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
"""


@pytest.mark.parametrize("shape", ["pane", "slab"])
def test_stained_glass_keeps_its_picture(tmp_path: Path, shape: str) -> None:
    """A tint by texture: of a wall the base colour, of a body what is left after one thickness. The picture is in the
    file, and looked up at the same places."""
    write_png(tmp_path / "t.png", [[(255, 60, 30, 255), (30, 200, 60, 255)], [(20, 40, 250, 255), (250, 240, 40, 255)]])
    tint = "color3f inputs:refraction:transmittanceColor.connect = </W/Looks/Stained/T.outputs:rgb>"
    model = "thin" if shape == "pane" else "traced"
    lines = (f'uniform token refraction:model = "{model}"', tint, "float inputs:refraction:absorptionDistance = 0.2")
    clear = ("float inputs:opacity = 0", "float inputs:roughness = 0")
    stained = glass("Stained", *clear, head=API, lines=(*lines, TEXTURED))
    uv = "texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = \"vertex\")"
    points = "point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]"
    faces = "int[] faceVertexCounts = [4]\nint[] faceVertexIndices = [0, 1, 2, 3]"
    if shape == "slab":
        points = points.replace(")]", "), (-1, -1, -0.3), (1, -1, -0.3), (1, 1, -0.3), (-1, 1, -0.3)]")
        uv = uv.replace(")]", "), (0, 0), (1, 0), (1, 1), (0, 1)]")
        faces = ("int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]\nint[] faceVertexIndices = [0, 1, 2, 3, 5, 4, 7, 6, "
                 "4, 0, 3, 7, 1, 5, 6, 2, 3, 2, 6, 7, 4, 5, 1, 0]")  # fmt: skip
    thing = block('def Mesh "Glass" (prepend apiSchemas = ["MaterialBindingAPI"])', points, faces, uv,
                  'uniform token subdivisionScheme = "none"', "rel material:binding = </W/Looks/Stained>")  # fmt: skip
    path = Path(pictured(tmp_path, block('def Scope "Looks"', stained), thing))
    file, back = tmp_path / "file.glb", tmp_path / "sub" / "back.usda"
    back.parent.mkdir()
    run(str(path), file)
    (tmp_path / "t.png").rename(tmp_path / "gone.png")
    run(str(file), back, model=model)
    (tmp_path / "gone.png").rename(tmp_path / "t.png")
    # The glTF file has neither camera nor sky: those of the stage are put over it.
    over = tmp_path / "sub" / "over.usda"
    layer = path.read_text()
    start = layer.index('def Camera "C"')
    over.write_text('#usda 1.0\n(\n subLayers = [@./back.usda@]\n metersPerUnit = 1\n upAxis = "Y"\n)\n'
                    + block('def Xform "V"', layer[start : layer.rindex("}")]))  # fmt: skip
    before, after = (draw(load_stage(one), 48, 48)["beauty"][..., :3] for one in (path, over))
    assert np.ptp(before[12:36, 12:36], axis=(0, 1)).min() > 0.2  # it has colours
    assert np.abs(after - before).max() < 0.02


def test_the_candle_in_a_holder_is_the_same_after_glTF(tmp_path: Path) -> None:
    made = vessel("shell")
    assert isinstance(made, Mesh)
    path = pictured(tmp_path, looks(AMBER), mesh("Vessel", made.points, made.triangles), lit_ball("Lit", 0.3, "Candle"))
    before, after, _ = there_and_back(path, tmp_path)
    old, new = (next(m for m in one.materials if m.refractive) for one in (before, after))
    assert (new.model, new.inputs[Param.TRANSMITTANCE].value) == (old.model, old.inputs[Param.TRANSMITTANCE].value)
    assert new.absorption_distance == pytest.approx(old.absorption_distance, rel=1e-4)
    assert sum(len(one.triangles) for one in after.meshes if "Vessel" in one.path) == len(made.triangles)


def test_what_out_is_says_its_name(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="goes into a USD file"):
        ConvertOrder(stage="a.usda", out="b.glb", to="openpbr")
    with pytest.raises(UsageError, match=r"end the name of OUT with \.mtlx"):
        ConvertOrder(stage="a.usda", out="b.usda", to="mtlx")
    with pytest.raises(UsageError, match=r"end the name of OUT with \.mtlx"):
        ConvertOrder(stage="a.usda", out="b.glb", to="mtlx")
    path = shop(tmp_path)
    for name in ("out.txt", "out", ".glb", "glb"):
        with pytest.raises(UsageError, match=r"\.usda.*\.usdz, \.glb, \.gltf, \.mtlx"):
            run(path, tmp_path / name)
    (tmp_path / "there.glb").write_bytes(b"mine")
    with pytest.raises(UsageError, match="exists already"):
        run(path, tmp_path / "there.glb")
    assert (tmp_path / "there.glb").read_bytes() == b"mine"
    run(path, tmp_path / "there.glb", overwrite=True, to="gltf")
    assert document(tmp_path / "there.glb")["asset"]["version"] == "2.0"


@pytest.mark.parametrize("name", ["out.glb", "out.mtlx"])
def test_a_file_with_nothing_in_it_is_told(name: str, tmp_path: Path) -> None:
    (tmp_path / "in.usda").write_text("#usda 1.0\n")
    order = ConvertOrder(stage=str(tmp_path / "in.usda"), out=str(tmp_path / name))
    told = [notice.text for notice in convert(order).notices]
    assert any("there is nothing in the" in text for text in told), told


def test_what_is_left_out_of_an_opaque_material_is_told(tmp_path: Path) -> None:
    """It has no row, for it is no glass; what a file cannot say of it is lost all the same."""
    worked = glass("Shiny", "int inputs:useSpecularWorkflow = 1", "color3f inputs:specularColor = (0.5, 0.4, 0.1)",
                   "color3f inputs:diffuseColor.connect = </W/Looks/Shiny/V.outputs:result>")  # fmt: skip
    reader = block('def Shader "V"', 'uniform token info:id = "UsdPrimvarReader_float3"',
                   'string inputs:varname = "tints"', "float3 outputs:result")  # fmt: skip
    path = bound(tmp_path, [f"{worked.removesuffix('}')}{reader}\n}}"], [ball("S", "Shiny", 1.0)])
    made = convert(ConvertOrder(stage=path, out=str(tmp_path / "out.glb")))
    assert not made.rows
    texts = [notice.text for notice in made.notices if notice.path == "/W/Looks/Shiny"]
    assert any("specular colour is left out" in text for text in texts), texts
    assert any("primvar tints is left out" in text for text in texts), texts
