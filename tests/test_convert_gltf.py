"""glTF files in: hierarchy, geometry, pictures, and the KHR extensions that make glass."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from material_reading import write_png
from numpy.testing import assert_array_equal
from numpy.typing import NDArray
from test_convert import material, plain, run
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import StageError, UsageError
from refract_core.images.pictures import read_planes
from refract_core.scene import Mesh, Model, Param
from refract_core.usd.convert.gltf_file import read_gltf
from refract_core.usd.geometry.gprims import Solid, _unit_cube, _unit_plane, unit_sphere
from refract_core.usd.stage import load_stage

pytest.importorskip("pygltflib")

VOLUME = {
    "KHR_materials_transmission": {"transmissionFactor": 0.9},
    "KHR_materials_ior": {"ior": 1.33},
    "KHR_materials_volume": {"thicknessFactor": 2.0, "attenuationDistance": 0.05, "attenuationColor": [0.9, 0.6, 0.1]},
    "KHR_materials_dispersion": {"dispersion": 0.4},
}
PICTURE = {
    "index": 0,
    "extensions": {"KHR_texture_transform": {"scale": [2, 3], "rotation": 0.5, "offset": [0.1, 0.2]}},
}
MATERIALS: list[dict[str, Any]] = [
    {"name": "Honey", "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.25}, "extensions": VOLUME},
    {"name": "Window", "pbrMetallicRoughness": {"baseColorFactor": [0.8, 1, 0.9, 1], "metallicFactor": 0},
     "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}}},
    {"name": "Wood", "pbrMetallicRoughness": {"baseColorTexture": PICTURE, "metallicFactor": 0}},
    {"name": "Leaf", "alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]}},
]  # fmt: skip


class Builder:
    """A small document with one buffer."""

    def __init__(self, folder: Path) -> None:
        self.blob = b""
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "bufferViews": [], "accessors": [],
            "materials": MATERIALS, "meshes": [], "nodes": [],
        }  # fmt: skip
        write_png(folder / "tile.png", [[(200, 100, 50, 255)] * 2] * 2)
        self.document["images"] = [{"bufferView": self.view((folder / "tile.png").read_bytes())}]
        self.document["textures"] = [{"source": 0, "sampler": 0}]
        self.document["samplers"] = [{"wrapS": 33071}]

    def view(self, content: bytes) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        views = self.document["bufferViews"]
        views.append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(content)})
        self.blob += content
        return len(views) - 1

    def accessor(self, values: NDArray[Any], kind: str, **more: Any) -> int:
        component = {"f": 5126, "I": 5125, "H": 5123}[values.dtype.char]
        self.document["accessors"].append(
            {"bufferView": self.view(values.tobytes()), "componentType": component, "count": len(values), "type": kind}
            | more
        )
        return len(self.document["accessors"]) - 1

    def mesh(self, name: str, solid: Solid, number: int) -> int:
        uv = np.ascontiguousarray(solid.points[:, :2] * 0.5 + 0.5, np.float32)
        attributes = {
            "POSITION": self.accessor(solid.points.astype(np.float32), "VEC3"),
            "TEXCOORD_0": self.accessor(uv, "VEC2"),
        }
        indices = self.accessor(solid.triangles.astype(np.uint32).ravel(), "SCALAR")
        primitive = {"attributes": attributes, "indices": indices, "material": number}
        self.document["meshes"].append({"name": name, "primitives": [primitive]})
        return len(self.document["meshes"]) - 1

    def node(self, **fields: Any) -> int:
        self.document["nodes"].append(fields)
        return len(self.document["nodes"]) - 1

    def glb(self, path: Path) -> str:
        document = {**self.document, "buffers": [{"byteLength": len(self.blob)}]}
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(blob))
        path.write_bytes(
            head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
        )
        return str(path)

    def text(self, path: Path) -> str:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        path.write_text(json.dumps({**self.document, "buffers": [{"byteLength": len(self.blob), "uri": uri}]}))
        return str(path)


def shop(folder: Path) -> Builder:
    """A ball of honey scaled to a tenth, a window, a table of wood, a leaf; a node above them stands 1 m up."""
    made = Builder(folder)
    made.node(name="Root", children=[1, 2, 3, 4], translation=[0, 1, 0])
    made.node(name="Ball", mesh=made.mesh("Ball", unit_sphere(), 0), scale=[0.1, 0.1, 0.1])
    made.node(name="Pane", mesh=made.mesh("Pane", _unit_plane(), 1), translation=[1, 0, 0])
    made.node(name="Table", mesh=made.mesh("Table", _unit_plane(), 2), rotation=[0.7071068, 0, 0, 0.7071068])
    made.node(name="Leaf", mesh=made.mesh("Leaf", _unit_cube(), 3))
    return made


def test_glass_comes_over_with_its_extensions(tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    rows = run(shop(tmp_path).glb(tmp_path / "shop.glb"), out)
    assert {name: row.model for name, row in rows.items()} == {"Honey": "sphere", "Window": "thin"}
    assert rows["Honey"].thickness == pytest.approx(0.2)  # thicknessFactor is in mesh space: 2 under a scale of 0.1
    scene = load_stage(out)
    honey, window = material(scene, "Honey"), material(scene, "Window")
    assert (honey.model, window.model) == (Model.SPHERE, Model.THIN)
    assert honey.inputs[Param.IOR].value[0] == pytest.approx(1.33)
    assert honey.inputs[Param.OPACITY].value[0] == pytest.approx(0.1)
    assert honey.inputs[Param.ROUGHNESS].value[0] == pytest.approx(0.25)
    assert honey.inputs[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.9, 0.6, 0.1))
    assert honey.absorption_distance == pytest.approx(0.05)
    assert honey.abbe == pytest.approx(20.0 / 0.4)
    assert window.inputs[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.8, 1.0, 0.9))
    leaf = material(scene, "Leaf")
    assert leaf.model is Model.NONE
    assert leaf.opacity_presence


def meshes(out: Path) -> dict[str, Mesh]:
    return {mesh.path.rsplit("/", 1)[-1]: mesh for mesh in load_stage(out).meshes}


def test_nodes_stand_where_they_stood(tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    run(shop(tmp_path).glb(tmp_path / "shop.glb"), out)
    scene = load_stage(out)
    move = scene.stage_from_engine[:3, 3]
    points = {mesh.path.rsplit("/", 1)[-1]: mesh.points + move for mesh in scene.meshes}
    assert points["Ball"].mean(axis=0) == pytest.approx((0, 1, 0), abs=1e-4)
    assert np.ptp(points["Ball"], axis=0) == pytest.approx((0.2, 0.2, 0.2), rel=1e-3)
    assert points["Pane"].mean(axis=0) == pytest.approx((1, 1, 0), abs=1e-5)
    assert points["Table"][:, 1] == pytest.approx(1.0, abs=1e-5)  # a quarter turn about x lays it flat


def test_pictures_are_read_where_gltf_reads_them(tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    run(shop(tmp_path).glb(tmp_path / "shop.glb"), out)
    source = material(load_stage(out), "Wood").inputs[Param.DIFFUSE]
    st = meshes(out)["Table"].primvars["st"].reshape(-1, 2).astype(np.float64)
    points = _unit_plane().points[_unit_plane().triangles.reshape(-1)]
    uv = points[:, :2] * 0.5 + 0.5
    c, s = math.cos(0.5), math.sin(0.5)
    # KHR_texture_transform with v downwards: offset + rotation (counter-clockwise on the picture) of the scaled uv.
    expected = (uv * (2, 3)) @ np.array([[c, s], [-s, c]]).T + (0.1, 0.2)
    matrix = np.array(source.uv_matrix).reshape(2, 3)
    found = st @ matrix[:, :2].T + matrix[:, 2]
    assert found[:, 0] == pytest.approx(expected[:, 0], abs=1e-5)
    assert 1.0 - found[:, 1] == pytest.approx(expected[:, 1], abs=1e-5)


@pytest.mark.parametrize("name", ["out.usda", "out.usdc", "out.usdz"])
def test_every_kind_of_out(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "made"
    folder.mkdir()
    run(shop(tmp_path).text(tmp_path / "shop.gltf"), folder / name)
    scene = load_stage(folder / name)
    assert [texture.pixels.shape for texture in scene.textures] == [(2, 2, 4)]
    beside = {entry.name for entry in folder.iterdir()} - {name}
    assert beside == (set() if name.endswith("usdz") else {"out.textures"})


def test_strips_fans_sparse_and_normalised_values(tmp_path: Path) -> None:
    made = Builder(tmp_path)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    moved = made.accessor(points, "VEC3")
    made.document["accessors"][moved]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": made.view(np.array([3], np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": made.view(np.array([[5, 5, 0]], np.float32).tobytes())},
    }
    uv = made.accessor(np.array([[0, 65535]] * 4, np.uint16), "VEC2", normalized=True)
    primitives = [{"attributes": {"POSITION": moved, "TEXCOORD_0": uv}, "mode": mode} for mode in (5, 6, 1)]
    made.document["meshes"].append({"primitives": primitives})
    made.node(mesh=0)
    found = read_gltf(made.glb(tmp_path / "a.glb"))
    strip, fan = found.meshes[0][1]
    assert strip.triangles.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert fan.triangles.tolist() == [[1, 2, 0], [2, 3, 0]]
    assert strip.points[3].tolist() == [5, 5, 0]
    assert strip.uvs[0][0].tolist() == [0.0, 1.0]
    assert any("points and lines" in notice.text for notice in found.notices)


def test_what_cannot_be_read_says_so(tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    (tmp_path / "bad.glb").write_bytes(b"nothing of the kind")
    with pytest.raises(StageError, match="glTF"):
        run(str(tmp_path / "bad.glb"), out)
    (tmp_path / "bad.glb").write_bytes(b"glTF")
    with pytest.raises(StageError, match="cut off"):
        run(str(tmp_path / "bad.glb"), out)
    made = shop(tmp_path)
    made.document["asset"]["version"] = "1.0"
    with pytest.raises(StageError, match=r"glTF 1\.0"):
        run(made.text(tmp_path / "old.gltf"), out)
    made = shop(tmp_path)
    made.document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    with pytest.raises(StageError, match="KHR_draco_mesh_compression"):
        run(made.glb(tmp_path / "draco.glb"), out)
    made = shop(tmp_path)
    made.document["accessors"][0]["count"] = 1 << 20
    with pytest.raises(StageError, match="beyond"):
        run(made.glb(tmp_path / "short.glb"), out)
    made = shop(tmp_path)
    made.document["nodes"][1]["children"] = [0]
    with pytest.raises(StageError, match="circle"):
        run(made.glb(tmp_path / "circle.glb"), out)
    assert not out.exists()


PERSPECTIVE = {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}
POINT = {"extensions": {"KHR_lights_punctual": {"light": 1}}}


@pytest.mark.parametrize(
    ("node", "document", "said"),
    [
        ({"mesh": 9}, {}, "mesh 9, and has 4"),
        ({"children": [7]}, {}, "node 7, and has 6"),
        ({"children": [-1]}, {}, "node -1, and has 6"),
        ({"camera": 1}, {"cameras": [PERSPECTIVE]}, "camera 1, and has 1"),
        ({"camera": 0}, {}, "camera 0, and has 0"),
        ({"camera": 0}, {"cameras": [{}]}, "type None"),
        ({"camera": 0}, {"cameras": [{**PERSPECTIVE, "type": "orthographic"}]}, "with its lens"),
        ({"camera": 0}, {"cameras": [{"type": "perspective", "perspective": {"yfov": 4, "znear": 0.1}}]}, "yfov is 4"),
        ({"camera": 0}, {"cameras": [{**PERSPECTIVE, "perspective": {"yfov": 1, "znear": 2, "zfar": 1}}]}, "nothing"),
        (POINT, {"extensions": {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}}, "light 1, and has 1"),
        (POINT, {}, "light 1, and has 0"),
        ({}, {"textures": [{"source": 3}]}, "image 3, and has 1"),
        ({}, {"textures": []}, "texture 0, and has 0"),
        ({}, {"materials": MATERIALS[:3]}, "material 3, and has 3"),
        ({}, {"scenes": [{"nodes": [6]}]}, "node 6, and has 6"),
    ],
)  # fmt: skip
def test_what_is_asked_for_and_not_there_is_named(
    tmp_path: Path, node: dict[str, Any], document: dict[str, Any], said: str
) -> None:
    made = shop(tmp_path)
    made.document["nodes"][0]["children"].append(made.node(**node))
    made.document |= document
    with pytest.raises(StageError, match=said):
        run(made.glb(tmp_path / "odd.glb"), tmp_path / "out.usda")


def test_a_file_is_drawn_without_being_converted_first(tmp_path: Path) -> None:
    """By the command, in Python, and to the pixel as what `convert` makes of it."""
    glb = shop(tmp_path).glb(tmp_path / "shop.glb")
    run(glb, tmp_path / "shop.usdz")
    small = ["--image-width", "24", "--samples", "1"]
    for name in ("shop.glb", "shop.usdz"):
        done = CliRunner().invoke(app, ["render", str(tmp_path / name), str(tmp_path / f"{name}.exr"), *small])
        assert done.exit_code == 0, done.output
    one, other = (read_planes(str(tmp_path / f"{name}.exr")) for name in ("shop.glb", "shop.usdz"))
    assert_array_equal(one["beauty"], other["beauty"])
    assert [mesh.path for mesh in rc.load_stage(glb).meshes] == [
        mesh.path for mesh in rc.load_stage(tmp_path / "shop.usdz").meshes
    ]
    assert rc.validate(glb).passed
    assert rc.inspect(glb)["glass"]


def test_what_a_file_has_and_a_stage_has_not_is_told(tmp_path: Path) -> None:
    made = shop(tmp_path)
    made.document["skins"] = [{"joints": [0]}]
    assert any("skins" in one.text for one in rc.load_stage(made.glb(tmp_path / "shop.glb")).notices)


def test_a_file_that_changed_is_read_anew(tmp_path: Path) -> None:
    made = shop(tmp_path)
    assert len(rc.load_stage(made.glb(tmp_path / "shop.glb")).meshes) == 4
    made.document["nodes"][0]["children"].pop()
    assert len(rc.load_stage(made.glb(tmp_path / "shop.glb")).meshes) == 3


@pytest.mark.parametrize("verb", ["bake thickness", "bake probes", "validate --fix"])
def test_a_layer_over_gltf_says_how_to_make_a_stage(tmp_path: Path, verb: str) -> None:
    glb, out = shop(tmp_path).glb(tmp_path / "shop.glb"), tmp_path / "over.usda"
    words = ["validate", glb, "--fix", str(out)] if verb.startswith("validate") else [*verb.split(), glb, str(out)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert f"refract convert {glb} shop.usdz" in " ".join(done.output.split())
    assert not out.exists()


def test_another_picture_is_not_replaced(tmp_path: Path) -> None:
    path, out = shop(tmp_path).glb(tmp_path / "shop.glb"), tmp_path / "out.usda"
    (tmp_path / "out.textures").mkdir()
    (tmp_path / "out.textures" / "0.png").write_bytes(b"mine")
    with pytest.raises(UsageError, match="--overwrite"):
        run(path, out)
    assert (tmp_path / "out.textures" / "0.png").read_bytes() == b"mine"
    assert not out.exists()


def test_plain_usd_core_finds_nothing_wrong(tmp_path: Path) -> None:
    out = tmp_path / "W.usda"
    path = shop(tmp_path)
    path.document["materials"] = [{**MATERIALS[0], "name": "Ball"}, *MATERIALS[1:]]
    run(path.glb(tmp_path / "W.glb"), out)
    assert plain(out) == ["sphere 0.2"]
