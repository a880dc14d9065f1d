"""Native instances and point instancers, expanded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scene_reading import CUBE, drawn, read, texts, to_stage

from refract_core.errors import StageError
from refract_core.usd.geometry import traverse
from refract_core.usd.stage import open_stage, scene_from_stage

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
