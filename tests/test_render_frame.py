"""A frame as a whole: weights, determinism, progress, cancelling, and one picture in every unit and axis."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scene_reading import read
from scenes import box, camera, checker_room, draw, glass, light, material, quad, scene, shell, turned

import refract_core as rc
from refract_core.errors import Cancelled, UsageError
from refract_core.kernels.sampling import pixel_offsets
from refract_core.scene import LightKind, Model, Scene, Sphere

F32 = NDArray[np.float32]
WEIGHTS = [f"weight.{name}" for name in ("screen", "ray", "probe", "sky", "none")]


@pytest.fixture(scope="module")
def mixed() -> Scene:
    """Emissive walls, a lit floor, a rough cube and a smooth ball behind it: something of everything."""
    walls, materials, textures = checker_room()
    floor = quad("/floor", [(-2, -1, 2), (2, -1, 2), (2, -1, -2), (-2, -1, -2)], 6)
    cube = box("/cube", (0.4, 0.4, 0.4), 7, turned((1, 1, 0), 30), (-0.4, -0.2, 0.5))
    rough = glass(Model.BOX, ROUGHNESS=0.3, THICKNESS=0.6, TRANSMITTANCE=(0.7, 0.9, 1.0))
    ball = Sphere("/ball", (0.7, 0.2, -0.6), 0.6, 8)
    lamp = light(LightKind.RECT, (0, 2, 0), (0, -1, 0), (1.0, 1.0), 2.0)
    grey = material("/grey", DIFFUSE=0.5, ROUGHNESS=0.4, IOR=1.5)
    return scene(
        [*walls, floor, cube], [*materials, grey, rough, glass(Model.TRACED)], [ball], textures=textures, lights=(lamp,)
    )


@pytest.mark.parametrize(
    "settings",
    [
        {"tiers": ("screen", "probe", "sky")},
        {"tiers": ("screen", "probe", "sky"), "screen": "proxy"},
        {"tiers": ("ray", "sky")},
        {"tiers": ("probe", "screen", "ray")},
        {"tiers": ("screen",)},
    ],
    ids=lambda s: "-".join(s["tiers"]) + s.get("screen", ""),
)
def test_weights_sum_to_one_where_there_is_glass(mixed: Scene, settings: dict[str, Any]) -> None:
    planes = draw(mixed, samples=2, **settings)
    here = planes["mask"] > 0
    assert here.mean() > 0.1
    total = np.sum([planes[name] for name in WEIGHTS], axis=0)
    np.testing.assert_allclose(total[here], 1.0, atol=1e-5)
    assert all((planes[name] >= -1e-6).all() for name in WEIGHTS)
    for name, tier in zip(WEIGHTS[:4], ("screen", "ray", "probe", "sky"), strict=True):
        if tier not in settings["tiers"]:
            assert not planes[name].any()
    for name in (*WEIGHTS, "refraction", "reflection", "transmittance", "thickness", "path_length"):
        assert not planes[name][~here].any()


def assert_same(a: dict[str, F32], b: dict[str, F32]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


CHANGES = [{"jobs": 2}, {"tile_size": 4}, {"tile_size": 100}, {"jobs": 2, "tile_size": 12}, {}]


@pytest.mark.parametrize("change", CHANGES)
def test_the_picture_does_not_depend_on_workers_or_tiles(mixed: Scene, change: dict[str, int]) -> None:
    """Bit-equal, on a size that no tile divides."""
    settings: dict[str, Any] = {"samples": 2, "tiers": ("screen", "probe", "sky")}
    assert_same(draw(mixed, 75, 53, **settings), draw(mixed, 75, 53, **{**settings, **change}))


@pytest.fixture(scope="module")
def meshes() -> Scene:
    """Glass as meshes of every kind in a checkered room: hollow, turned inside out, open, touching the floor; the
    samples of a pixel meet front faces, back faces and edges."""
    walls, materials, textures = checker_room()
    floor = quad("/floor", [(-2, -1, 2), (2, -1, 2), (2, -1, -2), (-2, -1, -2)], 6)
    hollow = shell("/hollow", 0.55, 0.4, 7)
    hollow = replace(hollow, points=(hollow.points + np.array([-0.6, -0.2, 0.2])).astype(np.float32))
    wrong = box("/wrong", (0.3, 0.3, 0.3), 7, turned((0, 1, 0), 25), (0.5, 0.3, 0.1))
    wrong = replace(wrong, triangles=np.ascontiguousarray(wrong.triangles[:, ::-1]))
    standing = box("/standing", (0.3, 0.35, 0.3), 8, turned((0, 1, 0), 40), (0.6, -0.65, 0.5))
    pane = quad("/pane", [(-1.2, 0.2, 0.9), (0.2, 0.2, 0.7), (0.2, 1.0, 0.7), (-1.2, 1.0, 0.9)], 9)
    tinted = glass(Model.TRACED, ROUGHNESS=0.2, TRANSMITTANCE=(0.9, 0.5, 0.4), absorption_distance=0.5)
    grey = material("/grey", DIFFUSE=0.5, ROUGHNESS=0.4, IOR=1.5)
    lamp = light(LightKind.RECT, (0, 2, 0), (0, -1, 0), (1.0, 1.0), 2.0)
    return scene(
        [*walls, floor, hollow, wrong, standing, pane],
        [*materials, grey, glass(Model.TRACED), tinted, glass(Model.THIN)],
        textures=textures, lights=(lamp,),
    )  # fmt: skip


@pytest.mark.parametrize("change", [{"jobs": 2}, {"tile_size": 8}, {"tile_size": 20, "jobs": 3}])
def test_meshes_at_sixteen_samples_do_not_depend_on_workers_or_tiles(meshes: Scene, change: dict[str, int]) -> None:
    settings: dict[str, Any] = {"samples": 16, "tiers": ("screen", "ray", "sky")}
    assert_same(draw(meshes, 75, 53, **settings), draw(meshes, 75, 53, **{**settings, **change}))


def test_a_given_executor_draws_the_same(mixed: Scene) -> None:
    plain: dict[str, Any] = {"samples": 1, "tiers": ("ray", "sky"), "caustics": 0, "emission_light": False}
    settings = rc.RenderSettings(image_width=40, image_height=40, **plain)
    with ThreadPoolExecutor(3) as executor:
        given = rc.render(mixed, settings, executor=executor).planes
    assert_same(given, draw(mixed, 40, 40))


def test_more_samples_keep_data_planes_and_change_edges(mixed: Scene) -> None:
    """Data planes hold the sample nearest to the pixel's centre, as a camera sees it that is turned there; coverage
    becomes fractional at silhouettes only."""
    one, four = draw(mixed, samples=1), draw(mixed, samples=4, tolerance=0.0)
    offset = pixel_offsets(4)[0]
    lens = mixed.cameras[0]
    left, right, bottom, top = lens.window
    dx, dy = offset[0] * (right - left) / 64, -offset[1] * (top - bottom) / 64  # rows count downwards
    there = replace(lens, window=(left + dx, right + dx, bottom + dy, top + dy))
    alone = draw(replace(mixed, cameras=(there,)), samples=1)
    for name in ("Z", "N", "P", "thickness", "path_length", "layers"):
        same = np.isclose(alone[name], four[name], rtol=1e-4, atol=1e-5)
        assert same.mean() > 0.995, name  # a ray at an edge may meet either side
    assert set(np.unique(one["mask"])) <= {0.0, 1.0}
    assert ((four["mask"] > 0) & (four["mask"] < 1)).any()


def test_data_planes_made_from_corners_are_those_of_the_middle(mixed: Scene) -> None:
    """To the second order, but for pixels that an edge goes through."""
    one, many = draw(mixed, samples=1), draw(mixed)
    whole = many["mask"] == one["mask"]
    assert whole.mean() > 0.9
    for name, margin in (("Z", 0.01), ("P", 0.02), ("N", 0.05), ("path_length", 0.05), ("thickness", 0.01)):
        near = np.isclose(one[name], many[name], rtol=margin, atol=margin)[whole]
        assert near.mean() > 0.97, name


def test_progress_grows_to_one(mixed: Scene) -> None:
    told: list[tuple[float, str]] = []
    settings = rc.RenderSettings(image_width=32, image_height=32, samples=3, jobs=1)
    rc.render(mixed, settings, progress=lambda f, s: told.append((f, s)))
    fractions = [f for f, _ in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert fractions[0] >= 0.0
    assert all(stage for _, stage in told)


@pytest.mark.parametrize("after", [0, 2])
def test_cancel_stops_the_render(mixed: Scene, after: int) -> None:
    asked = iter(range(1000))
    settings = rc.RenderSettings(image_width=64, image_height=64, samples=64, jobs=1)
    with pytest.raises(Cancelled):
        rc.render(mixed, settings, cancel=lambda: next(asked) >= after)


def test_an_unknown_camera_is_refused(mixed: Scene) -> None:
    with pytest.raises(UsageError, match="/camera"):
        rc.render(mixed, rc.RenderSettings(camera="/nowhere", image_width=8))


def test_exposure_doubles_per_stop(mixed: Scene) -> None:
    plain, brighter = draw(mixed, 32, 32), draw(mixed, 32, 32, exposure=1.0)
    for name in ("beauty", "refraction", "reflection"):
        np.testing.assert_allclose(brighter[name][..., :3], 2 * plain[name][..., :3], rtol=1e-6)
    np.testing.assert_array_equal(brighter["beauty"][..., 3], plain["beauty"][..., 3])


def test_data_planes_name_what_is_there() -> None:
    """A wall 2.5 m before a camera at z = 2.5: Z is 2.5 everywhere, P lies on z = 0, N faces the eye."""
    wall = quad("/wall", [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)])
    planes = draw(scene([wall], [material("/m")], camera_light=True), 24, 16)
    np.testing.assert_allclose(planes["Z"], 2.5, rtol=1e-6)
    np.testing.assert_allclose(planes["P"][..., 2], 0.0, atol=1e-5)
    np.testing.assert_allclose(planes["N"], np.broadcast_to([0, 0, 1.0], (16, 24, 3)), atol=1e-6)
    assert not planes["mask"].any()
    assert (planes["beauty"][..., 3] == 1).all()


def test_nothing_is_black_and_transparent() -> None:
    wall = quad("/wall", [(50, 0, 0), (51, 0, 0), (51, 1, 0), (50, 1, 0)])
    planes = draw(scene([wall], [material("/m")], cameras=(camera(),)), 8, 8)
    assert not planes["beauty"].any()
    assert np.isinf(planes["Z"]).all()


# --- One stage in every unit and axis ---------------------------------------------------------------------------------

STAGE = """#usda 1.0
(
    metersPerUnit = {metres}
    upAxis = "{up}"
    defaultPrim = "World"
)
def Xform "World"
{{
    double3 xformOp:translate = ({ox}, {oy}, {oz})
    float xformOp:rotateX = {turn}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    def Mesh "Floor"
    {{
        int[] faceVertexCounts = [4, 4, 4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4, 3, 4, 7, 6, 4, 5, 8, 7]
        point3f[] points = [{points}]
        color3f[] primvars:displayColor = [(0.9, 0.2, 0.1), (0.1, 0.8, 0.3), (0.2, 0.3, 0.9), (0.8, 0.8, 0.7)] (
            interpolation = "uniform"
        )
        uniform token subdivisionScheme = "none"
    }}
    def Cube "Block"
    {{
        double size = {size}
        double3 xformOp:translate = ({bx}, {by}, {bz})
        uniform token[] xformOpOrder = ["xformOp:translate"]
        color3f[] primvars:displayColor = [(0.7, 0.6, 0.2)]
    }}
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        double radius = {radius}
        double3 xformOp:translate = (0, {radius}, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        rel material:binding = </World/Glass>
    }}
    def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"])
    {{
        uniform token refraction:model = "traced"
        float inputs:refraction:ior = 1.5
        float inputs:refraction:absorptionDistance = {radius}
        color3f inputs:refraction:transmittanceColor = (0.6, 0.8, 0.9)
        token outputs:surface.connect = </World/Glass/Surface.outputs:surface>
        def Shader "Surface"
        {{
            uniform token info:id = "UsdPreviewSurface"
            float inputs:opacity = 0
            float inputs:roughness = 0
            token outputs:surface
        }}
    }}
    def DistantLight "Sun"
    {{
        float inputs:intensity = 2
        float inputs:angle = 0
        float xformOp:rotateX = -50
        uniform token[] xformOpOrder = ["xformOp:rotateX"]
    }}
    def Camera "Eye"
    {{
        float focalLength = 35
        float horizontalAperture = 24
        float verticalAperture = 24
        float2 clippingRange = ({near}, {far})
        double3 xformOp:translate = (0, {ey}, {ez})
        float xformOp:rotateX = -20
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    }}
}}
"""


def stage_text(unit: float = 1.0, up: str = "Y", offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> str:
    """The same scene with numbers for metersPerUnit = `unit`; `offset` in metres."""

    def u(x: float) -> float:
        return x / unit

    points = ", ".join(f"({u(x)}, 0, {u(z)})" for z in (4, 0, -4) for x in (-4, 0, 4))
    return STAGE.format(
        metres=unit, up=up, turn=90 if up == "Z" else 0, points=points, size=u(1), bx=u(1.25), by=u(0.5), bz=u(-1),
        radius=u(0.75), near=u(0.125), far=u(100), ey=u(2), ez=u(4), ox=u(offset[0]), oy=u(offset[1]), oz=u(offset[2]),
    )  # fmt: skip


def picture_of(text: str, folder: Path) -> dict[str, F32]:
    path = folder / "stage.usda"
    path.write_text(text)
    settings = rc.RenderSettings(image_width=64, image_height=64, samples=1, jobs=1, camera="/World/Eye")
    return rc.render(rc.load_stage(path), settings).planes


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, F32]:
    return picture_of(stage_text(), tmp_path_factory.mktemp("plain"))


@pytest.mark.parametrize(
    ("unit", "up", "offset"),
    [(1.0, "Z", (0.0, 0.0, 0.0)), (0.01, "Y", (0.0, 0.0, 0.0)), (1.0, "Y", (10_000.0, 0.0, -10_000.0)),
     (0.01, "Z", (10_000.0, 5_000.0, 0.0))],
    ids=["z-up", "centimetres", "10 km away", "all of it"],
)  # fmt: skip
def test_axis_unit_and_place_do_not_change_the_picture(
    unit: float, up: str, offset: tuple[float, float, float], plain: dict[str, F32], tmp_path: Path
) -> None:
    """Silhouette pixels may fall to either side by the last bit of a float; all others agree."""
    other = picture_of(stage_text(unit, up, offset), tmp_path)
    assert plain["mask"].mean() > 0.05
    assert plain["beauty"][..., :3].max() > 0.1
    difference = np.abs(other["beauty"] - plain["beauty"]).max(-1)
    assert (difference > 1e-3).mean() < 2e-3
    assert (other["mask"] != plain["mask"]).mean() < 2e-3
    # Lengths are in the stage's own units.
    seen = np.isfinite(plain["Z"]) & (difference < 1e-3)
    np.testing.assert_allclose(other["Z"][seen] * unit, plain["Z"][seen], rtol=1e-3)


@pytest.mark.parametrize("intensity", [1e-3, 1e6])
def test_a_picture_far_out_of_range_tells_the_exposure_that_shows_it(intensity: float) -> None:
    """Taken at its word, there is something to see, and nothing more to say."""
    sun = f'def DistantLight "L" {{ float inputs:intensity = {intensity}\nfloat inputs:angle = 0 }}'
    ball = read(f'def Sphere "S" {{ }}\n{sun}')
    settings = rc.RenderSettings(image_width=24, image_height=24, samples=1, studio="none")
    (told,) = [notice.text for notice in rc.render(ball, settings).notices if "--exposure" in notice.text]
    assert ("nearly black" in told) == (intensity < 1.0)
    stops = float(told.partition("--exposure ")[2].split()[0])
    shown = rc.render(ball, replace(settings, exposure=stops))
    assert 0.05 < np.percentile(shown.planes["beauty"][..., :3].max(axis=-1), 95) < 3.0
    assert not [notice for notice in shown.notices if "--exposure" in notice.text]


def test_where_there_is_no_light_no_exposure_is_told() -> None:
    ball = read('def Sphere "S" { }\ndef DistantLight "L" { float inputs:intensity = 0 }')
    settings = rc.RenderSettings(image_width=24, image_height=24, samples=1, studio="none")
    assert not [notice for notice in rc.render(ball, settings).notices if "--exposure" in notice.text]
