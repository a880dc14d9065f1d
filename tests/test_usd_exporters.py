"""What exporters get wrong all over a file: read as it was meant, and said once."""

from __future__ import annotations

import numpy as np
import pytest
from scene_reading import read, texts

QUAD = """def Mesh "{name}" {{
    uniform token subdivisionScheme = "none"
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    {extra}
}}
"""
COLORS = "color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)]"
NORMALS = "normal3f[] primvars:normals = [(0, 0, 1), (0, 1, 1), (1, 0, 1), (0, 0, 1)]"


def quad(size: int | None, authored: str = COLORS, extra: str = "", name: str = "Q") -> str:
    said = "" if size is None else f"elementSize = {size}\n"
    return QUAD.format(name=name, extra=f'{authored} (\n{said}interpolation = "faceVarying"\n)\n{extra}')


def test_the_size_of_the_whole_array_means_1() -> None:
    (plain,), (odd,) = read(quad(None)).meshes, read(quad(4)).meshes
    np.testing.assert_array_equal(plain.primvars["displayColor"], odd.primvars["displayColor"])


def test_so_it_does_of_normals() -> None:
    (plain,), scene = read(quad(None, NORMALS)).meshes, read(quad(4, NORMALS))
    np.testing.assert_array_equal(plain.normals, scene.meshes[0].normals)
    assert "elementSize" in texts(scene, "/Q")


@pytest.mark.parametrize("size", [4, 2])  # of the indices, of the values
def test_so_it_does_of_indexed_primvars(size: int) -> None:
    colors = "color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)]"
    indices = "int[] primvars:displayColor:indices = [0, 1, 0, 1]"
    (plain,), (odd,) = read(quad(None, colors, indices)).meshes, read(quad(size, colors, indices)).meshes
    np.testing.assert_array_equal(plain.primvars["displayColor"], odd.primvars["displayColor"])


def test_it_is_said_once_of_a_whole_stage() -> None:
    normals = f'{NORMALS} (\nelementSize = 4\ninterpolation = "faceVarying"\n)'
    scene = read("".join(quad(4, extra=normals, name=f"Q{n}") for n in range(50)))
    (said,) = [notice for notice in scene.notices if "elementSize" in notice.text]
    assert "50 prims" in said.text
    assert said.path == "/Q0"


def test_1_is_not_worth_a_word() -> None:
    assert not [notice for notice in read(quad(1)).notices if "elementSize" in notice.text]


def test_another_size_is_still_of_no_use() -> None:
    scene = read(quad(3))
    assert "displayColor" not in scene.meshes[0].primvars
    assert "elementSize is 3" in texts(scene, "/Q")


def test_bindings_without_their_schema_are_used_and_said_once() -> None:
    """USD warns of each; files of a whole exporter have no schema anywhere."""
    material = """def Material "M" {
        token outputs:surface.connect = </M/S.outputs:surface>
        def Shader "S" {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (1, 0, 0)
            token outputs:surface } }
    """
    scene = read(material + "".join(quad(1, extra="rel material:binding = </M>", name=f"Q{n}") for n in range(40)))
    (said,) = [notice for notice in scene.notices if "MaterialBindingAPI" in notice.text]
    assert (said.path, "40 prims" in said.text) == ("/Q0", True)
    assert {scene.materials[number].name for mesh in scene.meshes for number in mesh.materials} == {"/M"}
