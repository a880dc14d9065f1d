"""Native instances and point instancers: where what they draw stands, and that many places of a mesh stay one mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt
from scene_reading import CUBE, drawn, read, texts, to_stage
from scene_reading import stage_of as to_usd

from refract_core.errors import StageError
from refract_core.scene import Mesh, Scene
from refract_core.usd.geometry import traverse
from refract_core.usd.stage import open_stage, scene_from_stage
from refract_core.world.instances import flat

# --- instances ------------------------------------------------------------------------------------------------------

NATIVE = (
    """class Xform "Proto" { def Sphere "Ball" { double radius = 0.5 } def Xform "In" (instanceable = true
        references = </Inner>) { double3 xformOp:translate = (0, 2, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"] } }
    class Xform "Inner" { """
    + CUBE()
    + """ }
    def Xform "A" (instanceable = true
        references = </Proto>) {}
    def Xform "B" (instanceable = true
        references = </Proto>) { double3 xformOp:translate = (10, 0, 0)
        color3f[] primvars:displayColor = [(1, 0, 0)]
        uniform token[] xformOpOrder = ["xformOp:translate"] }"""
)


def test_native_instances_are_expanded_where_they_stand() -> None:
    scene = read(NATIVE)
    assert drawn(scene) == {"/A/Ball": [0, 0, 0], "/A/In/C": [0, 2, 0], "/B/Ball": [10, 0, 0], "/B/In/C": [10, 2, 0]}


def test_native_instances_inherit_primvars_from_outside() -> None:
    colours = {sphere.path: sphere.primvars.get("displayColor") for sphere in read(NATIVE).spheres}
    assert colours["/A/Ball"] is None
    red = colours["/B/Ball"]
    assert red is not None
    assert red.ravel().tolist() == [1, 0, 0]


INSTANCER = """def PointInstancer "P" {{
    int[] protoIndices = [0, 1, 0, 0]
    point3f[] positions = [(0, 0, 0), (10, 0, 0), (20, 0, 0), (30, 0, 0)]
    float3[] scales = [(1, 1, 1), (2, 2, 2), (1, 1, 1), (1, 1, 1)]
    rel prototypes = [</P/Ball>, </P/Group>]
    {extra}
    double3 xformOp:translate = (0, 5, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Sphere "Ball" {{ double radius = 1 \n double3 xformOp:translate = (1, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"] }}
    def Xform "Group" {{ def Sphere "One" {{ double radius = 1 }}
        def Sphere "Two" {{ double radius = 1 \n double3 xformOp:translate = (0, 1, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"] }} }} }}"""


def test_point_instances_are_expanded_and_prototypes_not_drawn_themselves() -> None:
    scene = read(INSTANCER.format(extra=""))
    assert drawn(scene) == {
        "/P/[0]/Ball": [1, 5, 0],
        "/P/[1]/Group/One": [10, 5, 0],
        "/P/[1]/Group/Two": [10, 7, 0],
        "/P/[2]/Ball": [21, 5, 0],
        "/P/[3]/Ball": [31, 5, 0],
    }
    assert {sphere.path: sphere.radius for sphere in scene.spheres}["/P/[1]/Group/Two"] == pytest.approx(2)


def test_masked_instances_keep_the_numbers_of_the_others() -> None:
    scene = read(INSTANCER.format(extra="int64[] invisibleIds = [0, 2]"))
    assert set(drawn(scene)) == {"/P/[1]/Group/One", "/P/[1]/Group/Two", "/P/[3]/Ball"}


def test_instances_take_their_own_colour_from_the_instancer() -> None:
    extra = """color3f[] primvars:displayColor = [(0, 0, 0), (0.5, 0, 0), (0, 0, 1), (1, 0, 0)] (
        interpolation = "vertex")"""
    scene = read(INSTANCER.format(extra=extra))
    colours = {sphere.path: sphere.primvars["displayColor"].ravel().tolist() for sphere in scene.spheres}
    assert colours["/P/[2]/Ball"] == [0, 0, 1]
    assert colours["/P/[3]/Ball"] == [1, 0, 0]
    assert colours["/P/[1]/Group/One"] == colours["/P/[1]/Group/Two"] == [0.5, 0, 0]


def test_nested_instancers_multiply() -> None:
    scene = read("""def PointInstancer "P" {
        int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (100, 0, 0)]
        rel prototypes = </P/Q>
        def PointInstancer "Q" {
            int[] protoIndices = [0, 0, 0]
            point3f[] positions = [(0, 0, 0), (0, 10, 0), (0, 20, 0)]
            rel prototypes = </P/Q/Ball>
            def Sphere "Ball" {} } }""")
    expected = {f"/P/[{i}]/Q/[{j}]/Ball": [100 * i, 10 * j, 0] for i in range(2) for j in range(3)}
    assert drawn(scene) == expected


@pytest.mark.parametrize("name", ["pi", "pi_ni", "pi_ni2", "pi_pi", "pi_pi_xform", "pi_masking", "ni_pi", "pi_ni_pi"])
def test_instanced_stages_fill_the_bounds_usd_computes(assets: Path, name: str) -> None:
    path = assets / f"openusd_geom/PointInstancer/{name}.usda"
    stage = open_stage(path)
    scene = scene_from_stage(stage)
    cache = UsdGeom.BBoxCache(Usd.TimeCode(scene.time_code), ["default", "render"], useExtentsHint=False)
    box = cache.ComputeWorldBound(stage.GetPseudoRoot()).ComputeAlignedRange()
    found = to_stage(scene, scene.bounds)
    # USD bounds boxes of boxes, so where an instance is turned its bounds may only be larger.
    assert (found.min(axis=0) >= np.array(box.GetMin()) - 1e-3).all()
    assert (found.max(axis=0) <= np.array(box.GetMax()) + 1e-3).all()
    assert (np.ptp(found, axis=0) > 0.7 * np.array(box.GetSize()) - 1e-3).all()


def test_too_many_instances_are_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traverse, "MAX_INSTANCES", 4)
    with pytest.raises(StageError, match=r"^/P: point instancers expand to 5 prims"):
        read(INSTANCER.format(extra=""))
    monkeypatch.setattr(traverse, "MAX_INSTANCES", 3)
    with pytest.raises(StageError, match=r"^/P: the instancer has 4 instances"):
        read(INSTANCER.format(extra=""))


def test_an_instancer_among_its_own_prototypes_ends() -> None:
    scene = read("""def PointInstancer "P" {
        int[] protoIndices = [0, 1]
        point3f[] positions = [(0, 0, 0), (5, 0, 0)]
        rel prototypes = [</P>, </P/Ball>]
        def Sphere "Ball" {} }""")
    assert drawn(scene) == {"/P/[1]/Ball": [5, 0, 0]}
    assert "its own prototypes" in texts(scene, "/P")


def test_an_instancer_that_does_not_add_up_draws_nothing_and_says_so() -> None:
    scene = read(INSTANCER.format(extra="").replace("(30, 0, 0)]", "(30, 0, 0), (40, 0, 0)]"))
    assert not scene.spheres
    assert "4 protoIndices but 5 positions" in texts(scene, "/P")


# --- one mesh with many transforms ------------------------------------------------------------------------------------

MANY = """def PointInstancer "P" {{
    int[] protoIndices = {indices}
    point3f[] positions = {positions}
    quath[] orientations = {turns}
    float3[] scales = {scales}
    rel prototypes = [</P/Leaf>, </P/Group>]
    {extra}
    double3 xformOp:translate = (3, 5, 0)
    float3 xformOp:scale = (1, 2, 1)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    def Mesh "Leaf" {{ {leaf} }}
    def Xform "Group" {{
        def Mesh "One" {{ {leaf} double3 xformOp:translate = (0.5, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"] }}
        def Mesh "Two" {{ {leaf} uniform token orientation = "leftHanded" }} }} }}"""
LEAF = """point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
        uniform token subdivisionScheme = "none"
        normal3f[] normals = [(-1, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)] ( interpolation = "vertex" )
        """


def many(count: int = 20, extra: str = "", scales: list[tuple[float, ...]] | None = None) -> str:
    """An instancer of two prototypes with places of every kind, a third of which mirror."""
    rng = np.random.default_rng(count)
    turns = rng.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    if scales is None:
        sizes = rng.uniform(0.5, 2, (count, 3)) * np.where(np.arange(count)[:, None] % 3 == 0, (-1, 1, 1), 1)
        scales = [tuple(row) for row in sizes.tolist()]
    positions = [tuple(row) for row in rng.uniform(-9, 9, (count, 3)).tolist()]
    return MANY.format(
        indices=[k % 2 for k in range(count)], positions=positions, turns=[tuple(row) for row in turns.tolist()],
        scales=scales, extra=extra, leaf=LEAF,
    )  # fmt: skip


def as_meshes(text: str, monkeypatch: pytest.MonkeyPatch, few: int) -> tuple[Scene, dict[str, Mesh]]:
    """What is read where so many places are one mesh, and every place of it as a mesh, by its path."""
    monkeypatch.setattr(traverse, "FEW", few)
    monkeypatch.setattr(traverse, "SMALL", 1)
    scene = read(text)
    return scene, {mesh.path: mesh for mesh in flat(scene, 10**6).meshes}


def check_both(text: str, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Both ways of reading say the same. Returns the one with instances."""
    alone, expected = as_meshes(text, monkeypatch, 10**9)
    shared, found = as_meshes(text, monkeypatch, 2)
    assert not alone.instances
    assert shared.instances
    assert found.keys() == expected.keys()
    np.testing.assert_allclose(np.array(shared.bounds), np.array(alone.bounds), atol=1e-5)
    for path, mesh in expected.items():
        other = found[path]
        np.testing.assert_allclose(other.points, mesh.points, atol=1e-5)
        np.testing.assert_array_equal(other.triangles, mesh.triangles)
        assert (other.normals is None) == (mesh.normals is None)
        if mesh.normals is not None and other.normals is not None:
            np.testing.assert_allclose(other.normals, mesh.normals, atol=1e-5)
        assert other.primvars.keys() == mesh.primvars.keys()
        for name, values in mesh.primvars.items():
            np.testing.assert_array_equal(np.broadcast_to(other.primvars[name], values.shape), values)
        assert (other.closed, other.static, other.double_sided) == (mesh.closed, mesh.static, mesh.double_sided)
        named = [{alone.materials[m].name for m in mesh.materials}, {shared.materials[m].name for m in other.materials}]
        assert named[0] == named[1]
    return shared


def test_instances_stay_one_mesh_and_stand_where_meshes_would(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = check_both(many(), monkeypatch)
    assert sorted(len(one) for one in scene.instances) == [10, 10, 10]
    assert len(scene.meshes) == 0


def test_so_do_those_of_masked_and_coloured_instancers(monkeypatch: pytest.MonkeyPatch) -> None:
    colours = [(k / 20, 0.5, 0.25) for k in range(20)]
    extra = f"""int64[] invisibleIds = [0, 3, 7]
        color3f[] primvars:displayColor = {colours} ( interpolation = "vertex" )"""
    scene = check_both(many(extra=extra), monkeypatch)
    (leaf,) = (one for one in scene.instances if one.mesh.path.endswith("Leaf"))
    assert leaf.paths[0] == "/P/[2]/Leaf"
    np.testing.assert_allclose(leaf.primvars["displayColor"][0], (0.1, 0.5, 0.25), atol=1e-6)


def test_flat_and_empty_places_are_no_instances(monkeypatch: pytest.MonkeyPatch) -> None:
    """A place that flattens is a mesh of its own; one that leaves a line, or nothing, is left out and said."""
    scales: list[tuple[float, ...]] = [(1, 1, 1)] * 20
    scales[2], scales[4], scales[6] = (1, 1, 0), (0, 0, 0), (0, 0, 1)
    scene = check_both(many(scales=scales), monkeypatch)
    assert [mesh.path for mesh in scene.meshes] == ["/P/[2]/Leaf"]
    assert "scale of 0 (2 prims: /P/[4]/Leaf, /P/[6]/Leaf)" in texts(scene, "/P/[4]/Leaf")


def test_nested_instancers_are_one_level_of_transforms(monkeypatch: pytest.MonkeyPatch) -> None:
    inner = many(6).replace('"P"', '"Q"').replace("</P/", "</Outer/Q/")
    scene = check_both(f"""def PointInstancer "Outer" {{
        int[] protoIndices = [0, 0, 0]
        point3f[] positions = [(0, 0, 0), (50, 0, 0), (0, 0, 70)]
        float3[] scales = [(1, 1, 1), (-1, 2, 1), (1, 1, 1)]
        rel prototypes = </Outer/Q>
        {inner} }}""", monkeypatch)
    assert sorted(len(one) for one in scene.instances) == [9, 9, 9]
    assert "/Outer/[1]/Q/[2]/Leaf" in next(one for one in scene.instances if one.mesh.path.endswith("Leaf")).paths


def test_an_instancer_that_two_others_draw_has_its_colours_in_both(monkeypatch: pytest.MonkeyPatch) -> None:
    colours = [(k / 6, 0.5, 0.25) for k in range(6)]
    extra = f'color3f[] primvars:displayColor = {colours} ( interpolation = "vertex" )'
    inner = many(6, extra).replace('"P"', '"Q"').replace("</P/", "</Library/Q/")
    outer = "".join(
        f"""def PointInstancer "{name}" {{
            int[] protoIndices = [0]
            point3f[] positions = [({x}, 0, 0)]
            rel prototypes = </Library/Q> }}"""
        for name, x in (("A", 0), ("B", 50))
    )
    scene = check_both(f'class Scope "Library" {{ {inner} }} {outer}', monkeypatch)
    (leaf,) = (one for one in scene.instances if one.mesh.path.endswith("Leaf"))
    assert [leaf.paths[0], leaf.paths[3]] == ["/A/[0]/Q/[0]/Leaf", "/B/[0]/Q/[0]/Leaf"]
    np.testing.assert_allclose(leaf.primvars["displayColor"][[0, 1, 3, 4], 0], [0, 2 / 6, 0, 2 / 6], atol=1e-6)


def test_native_instances_share_a_mesh_by_how_they_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six, two of which are red by what is said around them; one holds its own paths."""
    places = "".join(
        f"""def Xform "I{k}" (instanceable = true
            references = </Proto>) {{ double3 xformOp:translate = ({k}, 0, 0)
            {'color3f[] primvars:displayColor = [(1, 0, 0)]' if k % 3 == 0 else ''}
            uniform token[] xformOpOrder = ["xformOp:translate"] }}"""
        for k in range(6)
    )
    scene = check_both(f'class Xform "Proto" {{ def Mesh "Leaf" {{ {LEAF} }} }} {places}', monkeypatch)
    assert sorted(list(one.paths) for one in scene.instances) == [
        ["/I0/Leaf", "/I3/Leaf"], ["/I1/Leaf", "/I2/Leaf", "/I4/Leaf", "/I5/Leaf"]
    ]
    first, second = scene.instances
    assert first.mesh.points is second.mesh.points


def test_a_mesh_that_is_a_light_has_a_mesh_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    places = "".join(
        f"""def Xform "I{k}" (instanceable = true
            references = </Proto>) {{ double3 xformOp:translate = ({k}, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"] }}"""
        for k in range(3)
    )
    light = 'prepend apiSchemas = ["MeshLightAPI"]'
    text = f"""class Xform "Proto" {{ def Mesh "Leaf" ({light}
        ) {{ {LEAF} float inputs:intensity = 3 }} }} {places}"""
    scene, found = as_meshes(text, monkeypatch, 2)
    assert not scene.instances
    assert {path: scene.materials[mesh.materials[0]].emits for path, mesh in found.items()} == {
        f"/I{k}/Leaf": True for k in range(3)
    }


def test_a_few_places_are_meshes_of_their_own() -> None:
    assert not read(many(7)).instances


def test_very_many_places_are_read_at_once() -> None:
    """Two hundred thousand, each with a path of its own."""
    count = 200_000
    stage = to_usd('def PointInstancer "P" { rel prototypes = </P/Leaf> \n def Mesh "Leaf" { ' + LEAF + " } }")
    instancer = UsdGeom.PointInstancer(stage.GetPrimAtPath("/P"))
    instancer.GetProtoIndicesAttr().Set(np.zeros(count, np.int32).tolist())
    at = np.stack([np.arange(count) % 500, np.arange(count) // 500, np.zeros(count)], axis=1)
    instancer.GetPositionsAttr().Set(Vt.Vec3fArray.FromNumpy(at.astype(np.float32)))
    scene = scene_from_stage(stage)
    (found,) = scene.instances
    assert len(found) == len(found.paths) == count
    assert found.paths[123_456] == "/P/[123456]/Leaf"
    np.testing.assert_allclose(to_stage(scene, scene.bounds), [(0, 0, 0), (500, 400, 1)], atol=1e-4)
