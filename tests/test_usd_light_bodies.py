"""Lights that the camera sees, as the attributes of other renderers say: bodies that shine as the lights do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scene_reading import stage_of

import refract_core as rc
from refract_core.usd.lights.bodies import NAMES

F32 = NDArray[np.float32]
FLOOR = """
def Mesh "Floor" (prepend apiSchemas = ["MaterialBindingAPI"]) {
    rel material:binding = </Matt>
    point3f[] points = [(-9, 0, -9), (-9, 0, 9), (9, 0, 9), (9, 0, -9)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
}
def Material "Matt" {
    token outputs:surface.connect = </Matt/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (0.5, 0.5, 0.5)
        int inputs:useSpecularWorkflow = 1
        token outputs:surface
    }
}
"""
EYE = """
def Camera "Cam" {
    float horizontalAperture = 20.955
    float verticalAperture = 20.955
    float focalLength = 20
    double3 xformOp:translate = (0, 1.5, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
SHAPES = {
    "SphereLight": "float inputs:radius = 0.5",
    "RectLight": "float inputs:width = 1.2\nfloat inputs:height = 0.8",
    "DiskLight": "float inputs:radius = 0.6",
    "CylinderLight": "float inputs:radius = 0.3\nfloat inputs:length = 1.4",
}


def lamp(kind: str, more: str = "", turn: float = 0.0) -> str:
    return f"""
def {kind} "Lamp" {{
    {SHAPES.get(kind, "")}
    float inputs:intensity = 2
    color3f inputs:color = (1, 0.5, 0.25)
    {more}
    double3 xformOp:translate = (0, 1.5, 0)
    float xformOp:rotateY = {180.0 + turn}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateY"]
}}
"""


def picture(*parts: str, **settings: Any) -> dict[str, F32]:
    scene = rc.load_stage(stage_of(EYE + "".join(parts)))
    wanted = {"image_width": 40, "image_height": 40, "samples": 4, "light_samples": 64, "studio": "none", **settings}
    return rc.render(scene, rc.RenderSettings(**wanted)).planes


SEEN = "bool inputs:visibility:camera = 1"


@pytest.mark.parametrize("kind", list(SHAPES))
def test_a_light_that_the_camera_sees_shows_its_radiance_and_lights_as_before(kind: str) -> None:
    """A flat one faces the camera; from behind it is black."""
    hidden, seen = (picture(FLOOR, lamp(kind, more, 0.0)) for more in ("", SEEN))
    middle = seen["beauty"][20, 20, :3]
    assert middle == pytest.approx((2.0, 1.0, 0.5), rel=1e-5)
    assert hidden["beauty"][20, 20, 0] != pytest.approx(2.0, rel=0.1)
    floor = (hidden["Z"] < 1e6) & (np.abs(hidden["P"][..., 1]) < 1e-3) & (np.abs(seen["P"][..., 1]) < 1e-3)
    floor[:26] = False
    assert floor.sum() > 300
    near, lit = hidden["beauty"][floor][:, 0], seen["beauty"][floor][:, 0]
    assert lit.mean() == pytest.approx(near.mean(), rel=0.005)
    if kind in ("RectLight", "DiskLight"):
        behind = picture(FLOOR, lamp(kind, SEEN, 180.0))
        assert not behind["beauty"][20, 20, :3].any()


@pytest.mark.parametrize("name", NAMES)
def test_every_renderer_has_a_name_for_it(name: str) -> None:
    for number, said in ((1, 2.0), (0, 0.0)):
        shown = picture(lamp("SphereLight", f"int {name} = {number}"))["beauty"][20, 20, 0]
        assert shown == pytest.approx(said, rel=1e-5)


def test_it_is_seen_through_glass() -> None:
    """A slab of n = 1.5 before it lets two sides' Fresnel through, and both sides' reflections: 2 F / (1 + F) less."""
    pane = """
def Mesh "Pane" (prepend apiSchemas = ["MaterialBindingAPI"]) {
    point3f[] points = [
        (-3, -3, 2), (3, -3, 2), (3, 4, 2), (-3, 4, 2), (-3, -3, 1.9), (3, -3, 1.9), (3, 4, 1.9), (-3, 4, 1.9)
    ]
    int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0, 1, 2, 3, 5, 4, 7, 6, 4, 0, 3, 7, 1, 5, 6, 2, 3, 2, 6, 7, 4, 5, 1, 0]
    uniform token subdivisionScheme = "none"
    rel material:binding = </Clear>
}
def Material "Clear" {
    token outputs:surface.connect = </Clear/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        float inputs:opacity = 0
        float inputs:roughness = 0
        float inputs:ior = 1.5
        token outputs:surface
    }
}
"""
    shown = picture(lamp("SphereLight", SEEN), pane)["beauty"][20, 20, 0]
    assert shown == pytest.approx(2.0 * (1.0 - 2.0 * 0.04 / 1.04), rel=2e-3)


@pytest.mark.parametrize(
    ("kind", "more", "why"),
    [
        ("SphereLight", "bool treatAsPoint = 1", "no size"),
        ("SphereLight", "float inputs:shaping:cone:angle = 30", "shaped"),
        ("RectLight", "float inputs:diffuse = 0.5", "inputs:diffuse"),
        ("DiskLight", "bool inputs:shadow:enable = 0", "shadows"),
    ],
)
def test_what_no_body_can_shine_like_stays_unseen_and_says_so(kind: str, more: str, why: str) -> None:
    scene = rc.load_stage(stage_of(EYE + lamp(kind, SEEN + "\n" + more)))
    (said,) = (notice.text for notice in scene.notices if "seen by the camera" in notice.text)
    assert why in said
    assert not scene.meshes
    assert not scene.spheres


def test_where_surfaces_light_nothing_it_shines_itself_and_is_unseen() -> None:
    for settings in ({"emission_light": False}, {"emission_light": False, "caustics": 0}):
        hidden, seen = (picture(FLOOR, lamp("SphereLight", more), **settings) for more in ("", SEEN))
        for name, plane in hidden.items():
            np.testing.assert_array_equal(plane, seen[name])


def test_a_sky_that_the_camera_does_not_see_lights_and_leaves_the_picture_open() -> None:
    sky = 'def DomeLight "Sky" {{ float inputs:intensity = 1\n {} }}\n'
    seen, hidden = (picture(FLOOR, sky.format(more)) for more in ("", "int primvars:arnold:camera = 0"))
    assert seen["beauty"][2, 2] == pytest.approx((1, 1, 1, 1))
    assert hidden["beauty"][2, 2] == pytest.approx((0, 0, 0, 0))
    np.testing.assert_allclose(hidden["beauty"][35], seen["beauty"][35], rtol=1e-5)
    both = picture(FLOOR, sky.format("int primvars:arnold:camera = 0"), sky.format("").replace('"Sky"', '"Other"'))
    assert both["beauty"][2, 2, 3] == 1.0
