"""Meshes and gprims as triangles: cutting, winding, normals, primvars, materials, and what bad input becomes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import UsdGeom
from scene_reading import CUBE, TWO_TRIANGLES, areas, read, signed_volume, stage_of, texts, to_stage
from scenes import draw

from refract_core.scene import Mesh, Scene

# --- winding and normals --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("scale", ["(1, 1, 1)", "(-1, 1, 1)", "(-1, -1, -2)", "(1, -1, -1)"])
def test_a_solid_faces_outward_whatever_its_orientation_and_scale(left_handed: bool, scale: str) -> None:
    orientation = 'uniform token orientation = "leftHanded"' if left_handed else ""
    scene = read(
        CUBE(
            reverse=left_handed,
            extra=f"""{orientation}
        double3 xformOp:scale = {scale}
        uniform token[] xformOpOrder = ["xformOp:scale"]""",
        )
    )
    (mesh,) = scene.meshes
    factor = abs(math.prod(map(float, scale.strip("()").split(","))))
    assert signed_volume(mesh) == pytest.approx(8 * factor)
    assert mesh.closed


def test_mirrored_corners_keep_their_own_primvars_and_normals() -> None:
    """Colour is the position in the prim, so every corner can tell where it came from."""
    points = "[(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]"
    for scale in (1, -1):
        scene = read(f"""def Mesh "M" {{
            uniform token subdivisionScheme = "none"
            int[] faceVertexCounts = [4]
            int[] faceVertexIndices = [0, 1, 2, 3]
            point3f[] points = {points}
            normal3f[] normals = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0)]
            color3f[] primvars:displayColor = {points} (interpolation = "vertex")
            double3 xformOp:scale = ({scale}, 1, 1)
            uniform token[] xformOpOrder = ["xformOp:scale"] }}""")
        (mesh,) = scene.meshes
        normals = mesh.normals
        assert normals is not None
        at = to_stage(scene, mesh.points[mesh.triangles].reshape(-1, 3)).reshape(-1, 3, 3)
        assert at * (scale, 1, 1) == pytest.approx(mesh.primvars["displayColor"], abs=1e-6)
        authored = {(0, 0): (1, 0, 0), (1, 0): (0, 1, 0), (1, 1): (0, 0, 1), (0, 1): (0.6, 0.8, 0)}
        for corner, normal in zip(mesh.primvars["displayColor"].reshape(-1, 3), normals.reshape(-1, 3), strict=True):
            expected = authored[(int(corner[0]), int(corner[1]))]
            assert normal == pytest.approx((expected[0] * scale, *expected[1:]), abs=1e-6)


@pytest.mark.parametrize("scale", ["(1, 1, 1)", "(-1, 1, 1)"])
@pytest.mark.parametrize("orientation", ["leftHanded", "rightHanded"])
def test_arrays_are_of_the_promised_types_and_in_c_order(scale: str, orientation: str) -> None:
    extra = f"""uniform token orientation = "{orientation}"
        color3f[] primvars:displayColor = {[(0, 0, 0)] * 8} (interpolation = "vertex")
        normal3f[] normals = {[(0, 0, 1)] * 8}
        double3 xformOp:scale = {scale}
        uniform token[] xformOpOrder = ["xformOp:scale"]"""
    (mesh,) = read(CUBE(extra=extra)).meshes
    assert mesh.normals is not None
    arrays: list[tuple[NDArray[Any], type, tuple[int, ...]]] = [
        (mesh.points, np.float32, (8, 3)),
        (mesh.triangles, np.uint32, (12, 3)),
        (mesh.materials, np.int32, (12,)),
        (mesh.normals, np.float32, (12, 3, 3)),
        (mesh.primvars["displayColor"], np.float32, (12, 3, 3)),
    ]
    for array, dtype, shape in arrays:
        assert (array.dtype, array.shape) == (np.dtype(dtype), shape)
        assert array.flags.c_contiguous


def test_normals_go_by_the_inverse_transpose() -> None:
    """A normal authored at right angles to a slope stays so when the slope is stretched."""
    scene = read("""def Mesh "M" {
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, -1), (0, 1, 0)]
        normal3f[] normals = [(3, 0, 3)] (interpolation = "constant")
        double3 xformOp:scale = (5, 1, 1)
        uniform token[] xformOpOrder = ["xformOp:scale"] }""")
    (mesh,) = scene.meshes
    assert mesh.normals is not None
    face = areas(mesh.points, mesh.triangles)[0]
    assert mesh.normals.reshape(-1, 3) == pytest.approx(np.tile(face / np.linalg.norm(face), (3, 1)), abs=1e-6)


@pytest.mark.parametrize(
    ("interpolation", "values"),
    [
        ("constant", [(0, 0, 1)]),
        ("uniform", [(0, 0, 1), (0, 1, 0)]),
        ("vertex", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0)]),
        ("varying", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0)]),
        ("faceVarying", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0.6, 0.8), (0.6, 0.8, 0), (0.8, 0, 0.6)]),
    ],
)
@pytest.mark.parametrize("name", ["normals", "primvars:normals"])
def test_authored_normals_reach_their_corners(
    name: str, interpolation: str, values: Sequence[tuple[float, ...]]
) -> None:
    scene = read(TWO_TRIANGLES(f'normal3f[] {name} = {values} (interpolation = "{interpolation}")'))
    (mesh,) = scene.meshes
    assert mesh.normals is not None
    assert mesh.normals == pytest.approx(spread_by_hand(interpolation, values))


def test_primvars_normals_wins_over_normals() -> None:
    scene = read(
        TWO_TRIANGLES("""normal3f[] normals = [(1, 0, 0)] (interpolation = "constant")
        normal3f[] primvars:normals = [(0, 1, 0)] (interpolation = "constant")""")
    )
    assert scene.meshes[0].normals is not None
    assert (scene.meshes[0].normals == (0, 1, 0)).all()


def test_without_normals_a_polygon_mesh_is_flat() -> None:
    assert read(TWO_TRIANGLES("")).meshes[0].normals is None


def test_a_zero_or_nan_normal_gives_way_to_that_of_its_face() -> None:
    scene = read(TWO_TRIANGLES("normal3f[] normals = [(0, 0, 0), (nan, 0, 0), (0, 1, 0), (1, 0, 0)]"))
    normals = scene.meshes[0].normals
    assert normals is not None
    assert normals[0] == pytest.approx(np.array([(0, 0, 1), (0, 0, 1), (0, 1, 0)]))
    assert np.linalg.norm(normals, axis=2) == pytest.approx(1.0)


def test_normals_that_do_not_fit_are_named_and_flat_shading_is_used() -> None:
    scene = read(TWO_TRIANGLES("normal3f[] normals = [(0, 0, 1), (0, 0, 1)]"))
    assert scene.meshes[0].normals is None
    assert "vertex, which takes 4 values" in texts(scene, "/M")


def test_normals_of_a_subdivision_surface_are_its_own() -> None:
    """Authored ones are of the cage, and USD says to leave them aside."""
    plain, ignored = (
        read(CUBE(scheme="catmullClark", extra=extra)).meshes[0] for extra in ("", "normal3f[] normals = [(9, 9, 9)]")
    )
    assert plain.normals is not None
    assert ignored.normals is not None
    np.testing.assert_array_equal(plain.normals, ignored.normals)


# --- primvars -------------------------------------------------------------------------------------------------------


def spread_by_hand(interpolation: str, values: Sequence[tuple[float, ...]]) -> NDArray[np.float64]:
    """What USD's definition of each interpolation gives the six corners of `TWO_TRIANGLES`."""
    pick = {
        "constant": [0] * 6,
        "uniform": [0, 0, 0, 1, 1, 1],
        "vertex": [0, 1, 2, 0, 2, 3],
        "varying": [0, 1, 2, 0, 2, 3],
        "faceVarying": [0, 1, 2, 3, 4, 5],
    }[interpolation]
    return np.array([values[i] for i in pick]).reshape(2, 3, -1)


SIZES = {"constant": 1, "uniform": 2, "vertex": 4, "varying": 4, "faceVarying": 6}


@pytest.mark.parametrize("interpolation", SIZES)
@pytest.mark.parametrize("indexed", [False, True])
def test_every_interpolation_plain_and_indexed(interpolation: str, indexed: bool) -> None:
    count = SIZES[interpolation]
    values = [(0.1 * i, 1 - 0.1 * i, 0.5) for i in range(count)]
    extra = f'color3f[] primvars:displayColor = {values} (interpolation = "{interpolation}")'
    if indexed:
        palette = values[::-1]
        extra = f"""color3f[] primvars:displayColor = {palette} (interpolation = "{interpolation}")
            int[] primvars:displayColor:indices = {list(range(count))[::-1]}"""
    (mesh,) = read(TWO_TRIANGLES(extra)).meshes
    found = mesh.primvars["displayColor"]
    assert found.shape == ((1, 1, 3) if interpolation == "constant" else (2, 3, 3))
    assert np.broadcast_to(found, (2, 3, 3)) == pytest.approx(spread_by_hand(interpolation, values), abs=1e-6)


def test_constant_primvars_are_inherited_and_others_are_not() -> None:
    scene = read(f"""def Xform "X" {{
        color3f[] primvars:displayColor = [(0.25, 0.5, 0.75)]
        {TWO_TRIANGLES("")} {TWO_TRIANGLES("color3f[] primvars:displayColor = [(1, 0, 0)]", name="Own")} }}
        def Xform "Y" {{
        color3f[] primvars:displayColor = [(1, 1, 0), (1, 1, 1)] (interpolation = "uniform")
        {TWO_TRIANGLES("")} }}""")
    by_path = {mesh.path: mesh for mesh in scene.meshes}
    assert by_path["/X/M"].primvars["displayColor"].ravel() == pytest.approx([0.25, 0.5, 0.75])
    assert by_path["/X/Own"].primvars["displayColor"].ravel() == pytest.approx([1, 0, 0])
    assert "displayColor" not in by_path["/Y/M"].primvars


@pytest.mark.parametrize(
    ("authored", "reason"),
    [
        ('[(1, 0, 0)] (interpolation = "vertex")', "takes 4 values here, but has 1"),
        ('[(1, 0, 0)] (interpolation = "uniform")\n int[] primvars:displayColor:indices = [0, 3]', "0 to 3"),
        ('[(1, 0, 0)] (interpolation = "uniform")\n int[] primvars:displayColor:indices = [-1, 0]', "-1 to 0"),
        ("[]", "empty"),
    ],
)
def test_primvars_that_do_not_fit_are_dropped_by_name(authored: str, reason: str) -> None:
    scene = read(TWO_TRIANGLES(f"color3f[] primvars:displayColor = {authored}"))
    assert "displayColor" not in scene.meshes[0].primvars
    assert "primvars:displayColor is ignored" in texts(scene, "/M")
    assert reason in texts(scene, "/M")


def test_nan_in_a_primvar_becomes_zero_and_is_named() -> None:
    scene = read(TWO_TRIANGLES("color3f[] primvars:displayColor = [(nan, 1, inf)]"))
    assert scene.meshes[0].primvars["displayColor"].ravel().tolist() == [0, 1, 0]
    assert "2 values that are NaN or infinite" in texts(scene, "/M")


MATERIAL = """def Material "{name}" {{
    token outputs:surface.connect = </{name}/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        {extra}
        token outputs:surface }}
    {more} }}
    """


def material(name: str, extra: str = "", more: str = "") -> str:
    return MATERIAL.format(name=name, extra=extra, more=more)


def name_of(scene: Scene, mesh: Mesh, triangle: int) -> str:
    return scene.materials[mesh.materials[triangle]].name


def test_a_sphere_is_tessellated_only_for_a_texture_that_asks_for_st(tmp_path: Path) -> None:
    image = tmp_path / "grey.ppm"
    image.write_bytes(b"P6 1 1 255 " + bytes([90, 90, 90]))
    textured = material(
        "T",
        "color3f inputs:diffuseColor.connect = </T/Tex.outputs:rgb>",
        f"""def Shader "Tex" {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{image}@
            float2 inputs:st.connect = </T/Reader.outputs:result>
            float3 outputs:rgb }}
        def Shader "Reader" {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result }}""",
    )
    ball = 'def Sphere "{0}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{ rel material:binding = </{1}> }}\n'
    scene = read(textured + material("Plain") + ball.format("A", "T") + ball.format("B", "Plain"))
    assert [sphere.path for sphere in scene.spheres] == ["/B"]
    (mesh,) = scene.meshes
    assert mesh.path == "/A"
    st_values = mesh.primvars["st"]
    assert (st_values.min(), st_values.max()) == (0, 1)


# --- materials ------------------------------------------------------------------------------------------------------


def test_subsets_take_their_materials_and_the_rest_that_of_the_mesh() -> None:
    scene = read(
        material("Red")
        + material("Blue")
        + """def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token subdivisionScheme = "none"
        rel material:binding = </Blue>
        int[] faceVertexCounts = [4, 3, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 4, 3, 4, 7, 6]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0), (0, 2, 0), (1, 2, 0)]
        def GeomSubset "s" (prepend apiSchemas = ["MaterialBindingAPI"]) {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [2, 1, 99]
            rel material:binding = </Red> } }"""
    )
    (mesh,) = scene.meshes
    assert [name_of(scene, mesh, t) for t in range(5)] == ["/Blue", "/Blue", "/Red", "/Red", "/Red"]
    assert "1 of its indices are ignored" in texts(scene, "/M/s")


def test_a_full_binding_wins_and_a_stronger_ancestor_wins_over_both() -> None:
    text = """def Xform "X" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        rel material:binding = </A> {strength}
        def Mesh "M" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
            rel material:binding = </B>
            rel material:binding:full = </C>
            rel material:binding:preview = </D>
            int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0, 1, 2]
            point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0)] }} }}"""
    all_four = "".join(map(material, "ABCD"))
    scene = read(all_four + text.format(strength=""))
    assert name_of(scene, scene.meshes[0], 0) == "/C"
    stronger = '(bindMaterialAs = "strongerThanDescendants")'
    scene = read(all_four + text.format(strength=stronger).replace(":full", ":other"))
    assert name_of(scene, scene.meshes[0], 0) == "/A"


def test_a_preview_binding_serves_where_nothing_else_is_bound() -> None:
    scene = read(
        material("A") + material("B") + TWO_TRIANGLES("rel material:binding:preview = </A>", name="M")
        + TWO_TRIANGLES("rel material:binding:preview = </A>\nrel material:binding = </B>", name="N")
    )  # fmt: skip
    assert [name_of(scene, mesh, 0) for mesh in scene.meshes] == ["/A", "/B"]


def test_a_binding_to_nothing_is_named_and_display_color_used() -> None:
    scene = read(TWO_TRIANGLES("rel material:binding = </Nowhere>"))
    assert "/Nowhere does not exist" in texts(scene, "/M")
    assert name_of(scene, scene.meshes[0], 0) == "/M"


def test_one_material_is_read_once_for_closed_and_once_for_open_meshes() -> None:
    bound = "rel material:binding = </Glass>"
    scene = read(
        material("Glass", "float inputs:opacity = 0")
        + "".join(CUBE(name=f"C{i}", extra=bound) for i in range(3))
        + TWO_TRIANGLES(bound, name="Open")
    )
    by_path = {mesh.path: int(mesh.materials[0]) for mesh in scene.meshes}
    assert len(scene.materials) == 2
    assert by_path["/C0"] == by_path["/C1"] == by_path["/C2"] != by_path["/Open"]
    assert scene.materials[by_path["/C0"]].model.name == "TRACED"
    assert scene.materials[by_path["/Open"]].model.name == "THIN"


# --- glass inside out -----------------------------------------------------------------------------------------------

GLASS = """def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"]) {
    uniform token refraction:model = "MODEL"
    color3f inputs:refraction:transmittanceColor = (0.3, 0.6, 0.9)
    float inputs:refraction:absorptionDistance = 1
    float inputs:refraction:thickness = 1 }
"""
BEHIND = """def Mesh "Wall" {
    uniform token subdivisionScheme = "none"
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-9, -9, -3), (9, -9, -3), (9, 9, -3), (-9, 9, -3)]
    color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)] (interpolation = "vertex") }
def DomeLight "Sky" { color3f inputs:color = (0.5, 0.6, 0.7) }
def Camera "Eye" {
    float focalLength = 24
    double3 xformOp:translate = (0.4, 0.7, 6)
    uniform token[] xformOpOrder = ["xformOp:translate"] }
"""
TURNED = """float3 xformOp:rotateXYZ = (20, 30, 40)
    float3 xformOp:scale = (SX, 0.9, 1.1)
    uniform token[] xformOpOrder = ["xformOp:rotateXYZ", "xformOp:scale"]
"""
LEFT = 'uniform token orientation = "leftHanded"\n'
CUBE_FACES = [[1, 3, 7, 5], [2, 0, 4, 6], [3, 2, 6, 7], [0, 1, 5, 4], [4, 5, 7, 6], [2, 3, 1, 0]]
"""Outwards; point i is (i % 2, i // 2 % 2, i // 4)."""


def body(
    kind: str, *, reverse: bool = False, left: bool = False, scale: int = 1, normals: str = "", extra: str = ""
) -> str:
    """A cube, or one with a cubic hollow whose faces look into it, of glass.

    Args:
        reverse: the faces run the other way round, and with them their authored normals find their corners
        normals: '' for none, or the side that they look to: outwards, inwards
        scale: 1, or -1 to mirror it
    """
    cube = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float64)
    shells = [(cube, CUBE_FACES)]
    if kind == "hollow":
        shells.append((0.6 * cube, [face[::-1] for face in CUBE_FACES]))
    points: list[tuple[float, ...]] = []
    indices: list[int] = []
    vectors: list[tuple[float, ...]] = []
    for corners, faces in shells:
        for face in faces:
            a, b, c = corners[face[:3]]
            across = np.cross(b - a, c - b)
            outwards = across / np.linalg.norm(across)
            order = face[::-1] if reverse else face
            indices += [len(points) + k for k in order]
            vectors += [tuple((outwards if normals == "outwards" else -outwards).tolist())] * 4
        points += [tuple(p) for p in corners.tolist()]
    told = f'normal3f[] normals = {vectors} (interpolation = "faceVarying")\n' if normals else ""
    places = [points[k] for k in indices]
    return f"""def Mesh "Body" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token subdivisionScheme = "none"
        rel material:binding = </Glass>
        int[] faceVertexCounts = {[4] * (len(indices) // 4)}
        int[] faceVertexIndices = {indices}
        point3f[] points = {points}
        float[] primvars:refraction:thickness = {[x + 2 * y + 3 * z + 7 for x, y, z in places]} (
            interpolation = "faceVarying" )
        {told}{LEFT if left else ""}{TURNED.replace("SX", str(scale))}{extra} }}
        """


def of_glass(text: str, model: str = "traced") -> Scene:
    return read(BEHIND + text + GLASS.replace("MODEL", model))


def body_of(scene: Scene) -> Mesh:
    (mesh,) = [mesh for mesh in scene.meshes if mesh.path == "/Body"]
    return mesh


@pytest.mark.parametrize("scale", [1, -1])
@pytest.mark.parametrize("left", [False, True])
@pytest.mark.parametrize("kind", ["cube", "hollow"])
def test_closed_glass_looks_outwards_however_it_is_authored(kind: str, left: bool, scale: int) -> None:
    """A hollow body as a whole: its outer shell outwards, its inner shell into the hollow."""
    volume = 8.0 * 0.9 * 1.1 * (1.0 - 0.6**3 if kind == "hollow" else 1.0)
    for reverse in (False, True):
        scene = of_glass(body(kind, reverse=reverse, left=left, scale=scale))
        mesh = body_of(scene)
        assert mesh.closed
        assert signed_volume(mesh) == pytest.approx(volume, rel=1e-5)
        assert mesh.inside_out is (reverse is not left)
        assert ("faces look inwards" in texts(scene, "/Body")) is mesh.inside_out


@pytest.mark.parametrize("normals", ["", "outwards", "inwards"])
@pytest.mark.parametrize("kind", ["cube", "hollow"])
def test_glass_inside_out_has_the_arrays_of_the_right_one(kind: str, normals: str) -> None:
    """Inside out by its orientation alone, the corners keep their order: everything is equal to the bit.

    Normals that look inwards were made from the faces and turn with them; others were right, and stay.
    """
    right = body_of(of_glass(body(kind, normals=normals and "outwards")))
    wrong = body_of(of_glass(body(kind, normals=normals, left=True)))
    np.testing.assert_array_equal(wrong.triangles, right.triangles)
    np.testing.assert_array_equal(wrong.points, right.points)
    np.testing.assert_array_equal(wrong.primvars["refraction:thickness"], right.primvars["refraction:thickness"])
    if normals:
        assert wrong.normals is not None
        assert right.normals is not None
        np.testing.assert_array_equal(wrong.normals, right.normals)
    else:
        assert wrong.normals is None


@pytest.mark.parametrize("normals", ["", "inwards"])
@pytest.mark.parametrize("scale", [1, -1])
def test_reversed_corners_keep_their_own_primvars_and_normals(scale: int, normals: str) -> None:
    """The thickness tells the place in the prim, and the normal of a flat face is that of its triangle."""
    text = body("hollow", reverse=True, scale=scale, normals=normals)
    scene, stage = of_glass(text), stage_of(text)
    mesh = body_of(scene)
    matrix = np.array(UsdGeom.Xformable(stage.GetPrimAtPath("/Body")).GetLocalTransformation()).T
    at = to_stage(scene, mesh.points[mesh.triangles].reshape(-1, 3)) @ np.linalg.inv(matrix[:3, :3]).T
    told = mesh.primvars["refraction:thickness"].ravel()
    assert told == pytest.approx(at @ (1, 2, 3) + 7, abs=1e-5)
    if mesh.normals is not None:
        faces = areas(mesh.points, mesh.triangles)
        faces /= np.linalg.norm(faces, axis=1, keepdims=True)
        assert mesh.normals == pytest.approx(np.repeat(faces[:, None], 3, axis=1), abs=1e-5)


@pytest.mark.parametrize("model", ["traced", "box", "sphere"])
@pytest.mark.parametrize("kind", ["cube", "hollow"])
def test_glass_inside_out_is_the_picture_of_the_right_one(kind: str, model: str) -> None:
    right = draw(of_glass(body(kind), model), 40, 40)
    for how in ({"left": True}, {"reverse": True}, {"left": True, "normals": "inwards"}):
        wrong = draw(of_glass(body(kind, **how), model), 40, 40)
        assert right["mask"].any()
        for name in ("beauty", "thickness", "path_length"):
            np.testing.assert_allclose(wrong[name], right[name], atol=1e-5, err_msg=f"{name} {how}")


def test_a_surface_inside_out_is_smooth_the_right_way_round() -> None:
    extra = 'rel material:binding = </Glass>\nuniform token orientation = "{}Handed"'
    right, wrong = (
        read(CUBE(scheme="catmullClark", extra=extra.format(hand)) + GLASS.replace("MODEL", "traced")).meshes[0]
        for hand in ("right", "left")
    )
    assert wrong.normals is not None
    assert right.normals is not None
    np.testing.assert_array_equal(wrong.triangles, right.triangles)
    np.testing.assert_allclose(wrong.normals, right.normals, atol=1e-6)


def test_what_is_opaque_or_open_is_left_as_it_is_authored() -> None:
    (opaque,) = read(CUBE(reverse=True)).meshes
    assert signed_volume(opaque) == pytest.approx(-8)
    scene = read(TWO_TRIANGLES(f"rel material:binding = </Glass>\n{LEFT}") + GLASS.replace("MODEL", "thin"))
    (sheet,) = scene.meshes
    assert areas(sheet.points, sheet.triangles)[:, 2] == pytest.approx((-0.5, -0.5))
    assert not opaque.inside_out
    assert not sheet.inside_out
    assert "inwards" not in texts(scene, "/M")


def test_a_sheet_folded_onto_itself_has_no_inside_to_be_out() -> None:
    """Both ways round its volume is rounding and no more."""
    for order in (1, -1):
        front, back = [0, 1, 2, 3][::order], [3, 2, 1, 0][::order]
        scene = read(f"""def Mesh "M" {{
            uniform token subdivisionScheme = "none"
            rel material:binding = </Glass>
            int[] faceVertexCounts = [4, 4]
            int[] faceVertexIndices = {front + back}
            point3f[] points = [(0.1, 0.2, 0.3), (1.1, 0.3, 0.7), (1.3, 1.2, 1.9), (0.3, 1.1, 1.5)] }}
            """ + GLASS.replace("MODEL", "traced"))
        (mesh,) = scene.meshes
        assert mesh.closed
        assert not mesh.inside_out


def test_part_of_a_mesh_that_is_glass_turns_all_of_it() -> None:
    subset = """def GeomSubset "s" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [0, 1]
        rel material:binding = </Glass> }"""
    scene = read(CUBE(reverse=True, extra=subset) + GLASS.replace("MODEL", "traced"))
    (mesh,) = scene.meshes
    assert signed_volume(mesh) == pytest.approx(8)
    assert "faces look inwards" in texts(scene, "/C")


def test_instances_inside_out_are_counted_in_one_notice() -> None:
    shared = f"""class "Proto" {{ {CUBE(reverse=True, extra="rel material:binding = </Glass>")} }}"""
    places = [f"""def "I{i}" ( instanceable = true
        references = </Proto> ) {{ }}""" for i in range(3)]  # fmt: skip
    scene = read(shared + "\n".join(places) + GLASS.replace("MODEL", "traced"))
    assert [signed_volume(mesh) for mesh in scene.meshes] == pytest.approx([8, 8, 8])
    (notice,) = [notice for notice in scene.notices if "faces look inwards" in notice.text]
    assert notice.path == "/I0/C"
    assert "3 prims" in notice.text
    assert "refract validate" in notice.text
