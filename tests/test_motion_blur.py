"""Motion blur: a picture is the mean of what is seen while the camera's shutter is open."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pxr import Usd
from scene_reading import CUBE, F64, WALL_SEEN, stage_of, texts

import refract_core as rc
from refract_core.images.frame import Frame
from refract_core.kernels.sampling import pixel_offsets
from refract_core.rendering.shutter import MOST, moments_of
from refract_core.rendering.unfinished import FINISHED, Watch
from refract_core.scene import Camera, Scene
from refract_core.settings import RenderSettings
from refract_core.usd.settings import read_settings
from refract_core.usd.stage import scene_from_stage

OPEN = "double shutter:open = -0.5\ndouble shutter:close = 0.5"
SMALL = RenderSettings(image_width=40, image_height=40, samples=16, studio="none", caustics=0, jobs=1)


def moving(x0: float, x1: float) -> str:
    """Something that is at x0 when the shutter opens and at x1 when it closes."""
    keys = f"{{ -0.5: ({x0}, 0, 0), 0.5: ({x1}, 0, 0) }}"
    return f'double3 xformOp:translate.timeSamples = {keys}\nuniform token[] xformOpOrder = ["xformOp:translate"]'


def eye(extra: str = "", shutter: str = OPEN) -> str:
    """A square picture of four units, straight along -z."""
    return f"""def Xform "Rig" {{ {extra}
    def Camera "Eye" {{
        token projection = "orthographic"
        float horizontalAperture = 40
        float verticalAperture = 40
        float2 clippingRange = (0.1, 100)
        double3 xformOp:translate = (0, 0, 9)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        {shutter} }} }}
    """


def card(extra: str = "") -> str:
    """A unit square in the middle, that faces the camera."""
    return f"""def Mesh "Card" {{
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)]
        color3f[] primvars:displayColor = [(0.8, 0.4, 0.2)]
        {extra} }}
    """


def at(text: str, head: str = "") -> Callable[[float], Scene]:
    """Reads a stage; braces of time samples stay on their line, as USD's text format has it."""
    opened = re.sub(r"timeSamples = \{([^}]*)\}", r"timeSamples = <\1>", text)
    opened = opened.replace("{", "{\n").replace("}", "\n}\n")
    opened = re.sub(r"timeSamples = <([^>]*)>", r"timeSamples = {\1}", opened)
    stage = Usd.Stage.CreateInMemory()
    assert stage.GetRootLayer().ImportFromString(f'#usda 1.0\n(\nupAxis = "Y"\nmetersPerUnit = 1\n{head}\n)\n{opened}')
    return lambda time_code: scene_from_stage(stage, time_code=time_code)


def blurred(read: Callable[[float], Scene], settings: RenderSettings = SMALL) -> Frame:
    return rc.render(read(0.0), settings, scene_at=read)


def still(read: Callable[[float], Scene], time_code: float, settings: RenderSettings = SMALL) -> Frame:
    return rc.render(read(time_code), replace(settings, tolerance=0.0))


def mean_of_stills(read: Callable[[float], Scene], settings: RenderSettings = SMALL) -> F64:
    """Beauty of separate pictures at the same instants."""
    found = moments_of(read(0.0).cameras[0], settings, 0.0)
    return np.mean([still(read, moment.time_code, settings).planes["beauty"] for moment in found], axis=0)


def same(a: Frame, b: Frame) -> bool:
    return a.planes.keys() == b.planes.keys() and all(np.array_equal(a.planes[k], b.planes[k]) for k in a.planes)


# --- instants -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [2, 3, 16, 61, 100, 256])
@pytest.mark.parametrize("shutter", [(-0.5, 0.5), (0.0, 0.5), (-1.0, 0.0), (0.25, 0.75)])
def test_every_sample_has_an_instant_and_every_part_of_the_shutter_as_many(
    samples: int, shutter: tuple[float, float]
) -> None:
    camera = Camera("/c", np.eye(4), (-1, 1, -1, 1), shutter=shutter)
    found = moments_of(camera, RenderSettings(samples=samples), 10.0)
    assert sorted(sample for moment in found for sample in moment.samples) == list(range(samples))
    assert [moment.samples[0] for moment in found] == sorted(moment.samples[0] for moment in found)
    assert len(found) == min(samples, MOST)
    counts = [len(moment.samples) for moment in found]
    assert max(counts) - min(counts) <= 1
    opens, closes = shutter
    step = (closes - opens) / len(found)
    times = np.sort([moment.time_code - 10.0 for moment in found])
    assert (np.abs(times - (opens + step * (np.arange(len(found)) + 0.5))) <= step / 2 + 1e-9).all()
    # The data of the picture, which are those of sample 0, are of the frame itself, if the shutter is open then.
    assert found[0].time_code == pytest.approx(10.0 + min(max(0.0, opens), closes))


def test_instants_have_nothing_to_do_with_places_in_the_pixel() -> None:
    """Halves of the shutter by halves of the pixel: each quarter has its share of the samples."""
    samples = 64
    camera = Camera("/c", np.eye(4), (-1, 1, -1, 1), shutter=(0.0, 1.0))
    times = {s: m.time_code for m in moments_of(camera, RenderSettings(samples=samples), 0.0) for s in m.samples}
    late = np.array([times[s] > 0.5 for s in range(samples)])
    places = np.array(pixel_offsets(samples))
    for axis in (0, 1):
        assert (late & (places[:, axis] > 0)).sum() == pytest.approx(samples / 4, abs=3)


GLOWING = """def Material "Glow" { token outputs:surface.connect = </Glow/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (0, 0, 0)
        color3f inputs:emissiveColor = (0.5, 0.25, 1)
        token outputs:surface } }
"""
BOUND = '"Card" (prepend apiSchemas = ["MaterialBindingAPI"])'
GLOWING += card("rel material:binding = </Glow>\nMOVE").replace('"Card"', BOUND)


# --- closed forms ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("features", [False, True])
def test_a_card_that_moves_by_its_width_covers_a_triangle(features: bool) -> None:
    read = at((card(moving(-0.5, 0.5)) if features else GLOWING.replace("MOVE", moving(-0.5, 0.5))) + eye())
    frame = blurred(read, replace(SMALL, samples=32, features=features))
    x = (np.arange(40) + 0.5) / 10 - 2
    coverage = np.clip(1 - np.abs(x), 0, 1)
    alpha = frame.planes["beauty"][15:25, :, 3]
    assert np.abs(alpha - coverage).max() < 1 / 32 + 0.1 / 2  # a step of time, and half a pixel
    assert np.abs(alpha.mean(axis=1) - coverage.mean()).max() < 1e-3 + 1 / 32 / 40
    if not features:  # premultiplied: where it is half there, half its light is
        light = frame.planes["beauty"][15:25]
        assert np.allclose(light[..., :3], light[..., 3:] * (0.5, 0.25, 1.0), atol=1e-4)
    if features:
        assert np.abs(frame.planes["albedo"][15:25, :, 0] - 0.8 * coverage).max() < 1 / 32 + 0.1 / 2


def test_a_card_that_moves_by_three_widths_covers_a_trapezoid() -> None:
    frame = blurred(at(card(moving(-1.0, 1.0)) + eye()), replace(SMALL, samples=64))
    x = (np.arange(40) + 0.5) / 10 - 2
    coverage = np.clip((1.5 - np.abs(x)) / 2, 0, 0.5)
    assert np.abs(frame.planes["beauty"][15:25, :, 3] - coverage).max() < 1 / 64 + 0.1 / 2 / 2 + 1e-3


def test_a_camera_that_moves_is_a_world_that_moves_the_other_way() -> None:
    mine = blurred(at(CUBE(extra=moving(-0.3, 0.4)) + eye()))
    other = blurred(at(CUBE() + eye(moving(0.3, -0.4))))
    apart = np.abs(mine.planes["beauty"] - other.planes["beauty"])
    assert apart.mean() < 1e-3
    assert mine.planes["beauty"][20, ::2, 3].max() == 1.0


# --- the mean of stills ---------------------------------------------------------------------------------------------

GLASS = """def Material "Glass" { token outputs:surface.connect = </Glass/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        float inputs:ior = 1.5
        float inputs:opacity = 0
        token outputs:surface } }
def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"]) {
    rel material:binding = </Glass>
    double radius = 0.7
    MOVE }
"""
PIECE = 'uniform token[] xformOpOrder = ["xformOp:rotateZ"]'
KINDS = {
    "xform": card(f"float xformOp:rotateZ.timeSamples = {{ -0.5: 0, 0.5: 80 }}\n{PIECE}"),
    "points": card().replace(
        "point3f[] points = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)]",
        "point3f[] points.timeSamples = { -0.5: [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)], "
        "0.5: [(-0.5, -0.5, 0), (0.5, -0.5, 0), (1.5, 1.5, 0), (-1.5, 1.5, 0)] }",
    ),
    "instancer": 'def PointInstancer "P" { rel prototypes = </P/Card>\nint[] protoIndices = [0, 0]\n'
    "point3f[] positions.timeSamples = { -0.5: [(-1, 0, 0), (1, 0, 0)], 0.5: [(-1, -1, 0), (1, 1, 0)] }\n"
    + card() + "}",
    "velocities": card("vector3f[] velocities.timeSamples = { 0: [(20, 0, 0), (20, 0, 0), (20, 9, 0), (20, 0, 0)] }")
    .replace("points = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)]",
             "points.timeSamples = { 0: [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)] }"),
    "visibility": card('token visibility.timeSamples = { -0.5: "inherited", 0.1: "invisible" }'),
    "skeleton": 'def SkelRoot "Body" { '
    + card("""rel skel:skeleton = </Body/Bones>
        int[] primvars:skel:jointIndices = [0, 0, 0, 0] (elementSize = 1
            interpolation = "vertex")
        float[] primvars:skel:jointWeights = [1, 1, 1, 1] (elementSize = 1
            interpolation = "vertex")""").replace('"Card"', '"Card" (prepend apiSchemas = ["SkelBindingAPI"])')
    + """def Skeleton "Bones" (prepend apiSchemas = ["SkelBindingAPI"]) {
        uniform token[] joints = ["a"]
        uniform matrix4d[] bindTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))]
        uniform matrix4d[] restTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))]
        rel skel:animationSource = </Body/Walk> }
    def SkelAnimation "Walk" {
        uniform token[] joints = ["a"]
        float3[] translations.timeSamples = { -0.5: [(-0.5, 0, 0)], 0.5: [(0.5, 0.4, 0)] }
        quatf[] rotations = [(1, 0, 0, 0)]
        half3[] scales = [(1, 1, 1)] } }
    """,
    "colour": card().replace("displayColor = [(0.8, 0.4, 0.2)]",
                             "displayColor.timeSamples = { -0.5: [(0.1, 0.4, 0)], 0.5: [(0.9, 0, 0.2)] }"),
    "light": card() + 'def DistantLight "L" { float inputs:intensity.timeSamples = { -0.5: 0, 0.5: 4 } }',
    "glass": WALL_SEEN.partition("def Camera")[0] + GLASS.replace("MOVE", moving(-0.5, 0.8)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_picture_is_the_mean_of_stills(kind: str) -> None:
    read = at(KINDS[kind] + eye())
    frame, stills = blurred(read).planes["beauty"], mean_of_stills(read)
    assert frame.mean() == pytest.approx(stills.mean(), rel=0.01)
    apart = np.abs(frame - stills).mean()
    assert apart < 0.015
    assert np.abs(still(read, 0.0).planes["beauty"] - stills).mean() > 2 * apart  # it does move


# --- velocities -----------------------------------------------------------------------------------------------------


def flying(kind: str, said: str) -> str:
    """Two points, or as many corners as a kind needs, with samples at 0 and 2 of different numbers of points."""
    faces = "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\n"
    faces += "uniform token subdivisionScheme = 'none'"
    curves = "int[] curveVertexCounts = [3]\nuniform token type = 'linear'"
    more = {"Mesh": faces, "Points": "", "BasisCurves": curves}[kind]
    return f"""def {kind} "F" {{ {more}
        float[] widths = [0.1] (interpolation = "constant")
        point3f[] points.timeSamples = {{ 0: [(0, 0, 0), (1, 0, 0), (0, 1, 0)],
            2: [(9, 0, 0), (9, 1, 0), (9, 0, 1), (9, 9, 9)] }}
        {said} }}"""


def middle(scene: Scene) -> F64:
    """Of the bounds of everything, in the stage's world."""
    (low, high), matrix = scene.bounds, scene.stage_from_engine
    return (np.asarray(low) + np.asarray(high)) / 2.0 @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("kind", ["Mesh", "Points", "BasisCurves"])
@pytest.mark.parametrize("fast", [False, True])
def test_points_fly_by_their_velocities_and_accelerations(kind: str, fast: bool) -> None:
    """p + v t + a t^2 / 2, t in seconds since the sample before, whatever the next sample is."""
    v, a, rate = np.array([24.0, 0.0, -12.0]), np.array([0.0, 96.0, 0.0]) * fast, 24.0
    said = f"vector3f[] velocities.timeSamples = {{ 0: {[tuple(v.tolist())] * 3}, 2: {[tuple(v.tolist())] * 4} }}\n"
    if fast:
        said += f"vector3f[] accelerations.timeSamples = {{ 0: {[tuple(a.tolist())] * 3}, "
        said += f"2: {[tuple(a.tolist())] * 4} }}"
    read = at(flying(kind, said))
    start = middle(read(0.0))
    for code in (0.5, 1.0, 1.75):
        t = code / rate
        np.testing.assert_allclose(middle(read(code)) - start, v * t + a * t * t / 2.0, atol=1e-5)
    assert middle(read(2.0))[0] > 8.0  # the next sample is where it says


@pytest.mark.parametrize("kind", ["Mesh", "Points", "BasisCurves"])
def test_without_velocities_what_changes_its_number_of_points_steps(kind: str) -> None:
    read = at(flying(kind, ""))
    np.testing.assert_allclose(middle(read(1.9)), middle(read(0.0)), atol=1e-6)


def test_velocities_win_over_the_next_sample() -> None:
    here, there = "[(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]", "[(5, 5, 5), (6, 5, 5), (6, 6, 5), (5, 6, 5)]"
    up = [(0, 24, 0)] * 4
    text = card(f"vector3f[] velocities.timeSamples = {{ 0: {up}, 1: {up} }}").replace(
        "points = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)]",
        f"points.timeSamples = {{ 0: {here}, 1: {there} }}",
    )
    np.testing.assert_allclose(middle(at(text)(0.5)), (0.5, 1.0, 0.0), atol=1e-5)


def test_what_ended_long_ago_stands() -> None:
    """A cache of one frame seen at others: as far as a shutter around its ends is open, and no farther."""
    corners, fast = "[(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]", [(24, 0, 0)] * 4
    text = card(f"vector3f[] velocities.timeSamples = {{ 10: {fast} }}").replace(
        "points = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)]",
        f"points.timeSamples = {{ 10: {corners} }}",
    )
    read = at(text + eye())
    for code, moved in ((0.0, 0.0), (9.5, -0.5), (10.0, 0.0), (10.5, 0.5), (50.0, 0.0)):
        np.testing.assert_allclose(middle(read(code)), (0.5 + moved, 0.5, 0.0), atol=1e-5)
    assert read(10.0).cameras[0].shutter == (-0.5, 0.5)
    assert read(50.0).cameras[0].shutter == (0.0, 0.0)


def test_velocities_of_another_length_are_named_and_not_used() -> None:
    scene = at(flying("Mesh", "vector3f[] velocities.timeSamples = { 0: [(24, 0, 0)], 2: [(24, 0, 0)] }"))(1.0)
    assert any("velocities" in notice.text and "/F" in notice.text for notice in scene.notices)
    np.testing.assert_allclose(middle(scene), middle(at(flying("Mesh", ""))(1.0)), atol=1e-6)


def test_a_card_that_flies_looks_like_one_that_is_moved() -> None:
    """One sample of its points, and its velocity: 24 units a second are one unit a frame of 1/24 s."""
    corners = "[(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)]"
    flies = card("vector3f[] velocities.timeSamples = { 0: [(24, 0, 0), (24, 0, 0), (24, 0, 0), (24, 0, 0)] }").replace(
        f"points = {corners}", f"points.timeSamples = {{ 0: {corners} }}"
    )
    mine, other = blurred(at(flies + eye())), blurred(at(card(moving(-0.5, 0.5)) + eye()))
    assert np.abs(mine.planes["beauty"] - other.planes["beauty"]).mean() < 1e-3


# --- nothing to blur ------------------------------------------------------------------------------------------------

STANDS = {
    "closed": card(moving(-0.5, 0.5)) + eye(shutter=""),
    "closed later": card(moving(-0.5, 0.5)) + eye(shutter=OPEN.replace("-0.5", "0.5")),
    "nothing moves": card() + eye(),
    "it says the same again": card(moving(0.2, 0.2)) + eye(),
    "it moves at other times": card(moving(-0.5, 0.5).replace("-0.5:", "3:").replace(" 0.5:", " 4:")) + eye(),
    "velocities of nothing": card("vector3f[] velocities.timeSamples = { 0: [(0, 0, 0), (0, 0, 0)] }") + eye(),
    "nothing that is drawn": card("custom float frame.timeSamples = { -0.5: 0, 0.5: 1 }") + eye(),
}


@pytest.mark.parametrize("name", STANDS)
def test_where_nothing_moves_the_picture_is_that_of_one_instant(name: str) -> None:
    asked: list[float] = []
    read = at(STANDS[name])

    def scene_at(time_code: float) -> Scene:
        asked.append(time_code)
        return read(time_code)

    scene = read(0.0)
    assert scene.cameras[0].shutter == (0.0, 0.0)
    assert same(rc.render(scene, SMALL, scene_at=scene_at), rc.render(scene, SMALL))
    assert not asked
    assert "shutter" not in texts(scene, "/Rig/Eye")


def test_a_shutter_that_closes_before_it_opens_is_told() -> None:
    scene = at(card(moving(-0.5, 0.5)) + eye(shutter="double shutter:open = 0.5\ndouble shutter:close = 0.25"))(0.0)
    assert "no span of time" in texts(scene, "/Rig/Eye")
    assert scene.cameras[0].shutter == (0.0, 0.0)


def test_it_can_be_switched_off() -> None:
    read = at(card(moving(-0.5, 0.5)) + eye())
    off = replace(SMALL, motion_blur=False)
    frame = rc.render(read(0.0), off, scene_at=read)
    assert same(frame, rc.render(read(0.0), SMALL))
    assert not [notice for notice in frame.notices if "shutter" in notice.text]


@pytest.mark.parametrize("name", ["disableMotionBlur", "instantaneousShutter"])
@pytest.mark.parametrize("value", [0, 1])
def test_render_settings_say_so(name: str, value: int) -> None:
    text = f'def RenderSettings "R" {{ uniform bool {name} = {value} }}'
    found = read_settings(stage_of(text), "/R")
    assert found == {"motion_blur": not value}
    assert read_settings(stage_of('def RenderSettings "R" {}'), "/R") == {}


def test_what_is_not_drawn_is_told() -> None:
    read = at(card(moving(-0.5, 0.5)) + eye())

    def told(**how: Any) -> str:
        settings = replace(SMALL, **how.pop("settings", {}))
        return "\n".join(notice.text for notice in rc.render(read(0.0), settings, **how).notices)

    assert "one instant" in told()
    assert "one sample" in told(scene_at=read, settings={"samples": 1})
    assert "16 instants" in told(scene_at=read)
    assert "shutter" not in told(scene_at=read, settings={"samples": 64})
    # A camera of its own has no shutter.
    assert "shutter" not in told(scene_at=read, settings={"azimuth": 30.0})


# --- the rest of a picture ------------------------------------------------------------------------------------------


def test_data_are_of_the_frame_itself() -> None:
    read = at(card(moving(-0.5, 0.7)) + eye())
    frame, now = blurred(read), still(read, 0.0)
    for name in ("Z", "N", "P"):
        assert np.array_equal(frame.planes[name], now.planes[name])
    assert frame.metadata["refract:timeCode"] == 0.0
    assert frame.camera == now.camera


def test_tiles_threads_sessions_and_crops_change_no_bit() -> None:
    read = at(KINDS["glass"] + eye())
    settings = replace(SMALL, samples=4, image_width=48, image_height=40)
    whole = blurred(read, settings)
    assert same(whole, blurred(read, replace(settings, jobs=2, tile_size=8)))
    assert same(whole, rc.render(read(0.0), settings, scene_at=read, session=rc.Session()))
    part = blurred(read, replace(settings, crop=(5.0, 7.0, 30.0, 31.0)))
    for name, plane in part.planes.items():
        assert np.array_equal(plane, whole.planes[name][7:31, 5:30])


def test_a_picture_that_is_stopped_is_the_mean_of_what_was_drawn() -> None:
    read = at(card(moving(-0.5, 0.5)) + eye())
    looks: list[Frame] = []
    watch = Watch(wanted=lambda: True, take=looks.append)
    frame = rc.render(read(0.0), SMALL, scene_at=read, watch=watch)
    assert same(frame, blurred(read))
    assert [look.metadata[FINISHED] for look in looks] == [k / 16 for k in range(1, 16)]
    # The instants of the first half are spread over the whole shutter.
    half, full = looks[7].planes["beauty"][..., 3], frame.planes["beauty"][..., 3]
    assert np.abs(half - full).mean() < 0.02
