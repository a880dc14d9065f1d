"""UsdGeomPoints, and spheres in many places, as exact spheres of one record."""

from __future__ import annotations

import numpy as np
import pytest
from scene_reading import read, texts, to_stage

from refract_core.errors import StageError
from refract_core.scene import Balls, Model, Scene
from refract_core.usd.geometry import dots
from refract_core.usd.geometry.place import NOTHING_LEFT

THREE = 'def Points "P" {{ point3f[] points = [(0, 0, 0), (4, 0, 0), (0, 6, 0)] \n {extra} }}'


def points(extra: str = "") -> Scene:
    return read(THREE.format(extra=extra))


def only(scene: Scene) -> Balls:
    (balls,) = scene.balls
    assert not scene.meshes
    assert not scene.spheres
    assert not scene.instances
    return balls


def test_widths_are_diameters_of_each_point() -> None:
    scene = points("float[] widths = [1, 2, 4]")
    balls = only(scene)
    assert balls.radii.tolist() == [0.5, 1.0, 2.0]
    np.testing.assert_allclose(to_stage(scene, balls.centres), [(0, 0, 0), (4, 0, 0), (0, 6, 0)], atol=1e-6)
    assert list(balls.paths) == ["/P/[0]", "/P/[1]", "/P/[2]"]
    low, high = to_stage(scene, scene.bounds)
    assert (low.tolist(), high.tolist()) == ([-2, -1, -2], [5, 8, 2])


@pytest.mark.parametrize(
    ("extra", "radii"),
    [
        ('float[] widths = [3] ( interpolation = "constant" )', [1.5] * 3),
        ("float[] widths = [1, 2, 4]\n float[] primvars:widths = [2, 2, 6] ( interpolation = 'vertex' )", [1, 1, 3]),
        ("float[] widths = [1, 0, 4]", [0.5, 2.0]),
        ("float[] widths = [1, nan, -1]", [0.5]),
    ],
)
def test_widths_of_other_kinds(extra: str, radii: list[float]) -> None:
    assert only(points(extra)).radii.tolist() == radii


def test_what_has_no_width_is_named() -> None:
    scene = points("float[] widths = [1, 0, 4]")
    assert list(only(scene).paths) == ["/P/[0]", "/P/[2]"]
    assert "1 of its points are skipped" in texts(scene, "/P")
    assert "no widths; they are drawn 1 scene unit wide" in texts(points(), "/P")
    assert only(points()).radii.tolist() == [0.5] * 3
    assert "2 widths for 3 points" in texts(points("float[] widths = [1, 2]"), "/P")
    assert not points("float[] widths = [1, 2]").balls


def test_velocities_without_a_time_move_nothing() -> None:
    """USD counts seconds from the sample that they are of."""
    scene = points("vector3f[] velocities = [(1, 0, 0), (1, 0, 0), (1, 0, 0)]")
    np.testing.assert_allclose(to_stage(scene, only(scene).centres), [(0, 0, 0), (4, 0, 0), (0, 6, 0)], atol=1e-6)


def test_each_point_has_its_colour() -> None:
    colours = '[(1, 0, 0), (0, 1, 0), (0, 0, 1)] ( interpolation = "vertex" )'
    balls = only(points(f"float[] widths = [1, 0, 4]\n color3f[] primvars:displayColor = {colours}"))
    assert balls.primvars["displayColor"].tolist() == [[1, 0, 0], [0, 0, 1]]
    constant = only(points("color3f[] primvars:displayColor = [(1, 0, 0)]"))
    assert constant.primvars["displayColor"].tolist() == [[[1, 0, 0]]]


def test_they_may_be_glass() -> None:
    text = """def Material "M" { token outputs:surface.connect = </M/S.outputs:surface>
        def Shader "S" { uniform token info:id = "UsdPreviewSurface"
            float inputs:opacity = 0 \n token outputs:surface } }
    def Points "P" ( prepend apiSchemas = ["MaterialBindingAPI"]
    ) { point3f[] points = [(0, 0, 0)] \n float[] widths = [1] \n rel material:binding = </M> }"""
    scene = read(text)
    assert scene.materials[only(scene).material].model is Model.TRACED


INSTANCER = """def PointInstancer "I" {{
    int[] protoIndices = [{indices}]
    point3f[] positions = [{positions}]
    float3[] scales = [{scales}]
    rel prototypes = </I/Proto>
    {proto} }}"""


def instanced(count: int, scales: str, proto: str) -> Scene:
    positions = ", ".join(f"({10 * i}, 0, 0)" for i in range(count))
    return read(INSTANCER.format(
        indices=", ".join("0" * count), positions=positions, scales=", ".join([scales] * count), proto=proto
    ))


def test_points_of_an_instancer_are_multiplied() -> None:
    scene = instanced(2, "(2, 2, 2)", THREE.replace('"P"', '"Proto"').format(extra="float[] widths = [1, 2, 4]"))
    balls = only(scene)
    assert balls.radii.tolist() == [1, 2, 4] * 2
    assert list(balls.paths)[::4] == ["/I/[0]/Proto/[0]", "/I/[1]/Proto/[1]"]
    expected = [(x + 10 * i, y, 0) for i in range(2) for x, y in ((0, 0), (8, 0), (0, 12))]
    np.testing.assert_allclose(to_stage(scene, balls.centres), expected, atol=1e-5)


def test_stretched_points_are_ellipsoids() -> None:
    scene = instanced(2, "(1, 2, 1)", THREE.replace('"P"', '"Proto"').format(extra="float[] widths = [1, 2, 4]"))
    (many,) = scene.instances
    assert len(many) == 6
    assert list(many.paths)[::4] == ["/I/[0]/Proto/[0]", "/I/[1]/Proto/[1]"]
    low, high = to_stage(scene, scene.bounds)
    np.testing.assert_allclose([low[:2], high[:2]], [(-2, -2), (15, 16)], atol=1e-2)


def test_points_that_a_transform_leaves_nothing_of_are_named() -> None:
    proto = THREE.replace('"P"', '"Proto"').format(extra="")
    scene = instanced(2, "(1, 1, 0)", proto)
    assert not scene.balls
    assert not scene.instances
    assert texts(scene, "/I/[0]/Proto") == f"{NOTHING_LEFT} (2 prims: /I/[0]/Proto, /I/[1]/Proto)"
    assert NOTHING_LEFT not in texts(instanced(2, "(1, 1, 2)", proto), "/I/[0]/Proto")


def test_sphere_prototypes_in_many_places_are_exact() -> None:
    scene = instanced(100, "(2, 2, 2)", 'def Sphere "Proto" { double radius = 0.5 }')
    balls = only(scene)
    np.testing.assert_allclose(balls.radii, 1.0, rtol=1e-6)
    assert balls.paths[7] == "/I/[7]/Proto"
    np.testing.assert_allclose(to_stage(scene, balls.centres[7]), (70, 0, 0), atol=1e-4)
    few = instanced(3, "(2, 2, 2)", 'def Sphere "Proto" { double radius = 0.5 }')
    assert len(few.spheres) == 3


def test_native_instances_of_a_sphere_are_one_record() -> None:
    places = "".join(
        f"""def Xform "I{k}" (instanceable = true
            references = </Proto>) {{ double3 xformOp:translate = ({k}, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"] }}"""
        for k in range(100)
    )
    scene = read(f'class Xform "Proto" {{ def Sphere "Ball" {{ double radius = 0.25 }} }} {places}')
    balls = only(scene)
    assert list(balls.paths) == [f"/I{k}/Ball" for k in range(100)]
    np.testing.assert_allclose(to_stage(scene, balls.centres)[:, 0], np.arange(100), atol=1e-5)
    np.testing.assert_allclose(balls.radii, 0.25)


def test_too_many_points_are_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dots, "MOST", 5)
    with pytest.raises(StageError, match=r"^/I/\[0\]/Proto: 6 points are drawn; at most 5"):
        instanced(2, "(1, 1, 1)", THREE.replace('"P"', '"Proto"').format(extra=""))
    monkeypatch.setattr(dots, "MOST", 2)
    with pytest.raises(StageError, match=r"^/P: it has 3 points; at most 2"):
        points()
