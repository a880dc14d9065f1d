"""Light through glass: what the glass takes arrives, where optics says, in the colour that is left (closed forms and
quadrature in plain numpy)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scenes import box, camera, dome, draw, glass, light, material, quad, scene, turned

import refract_core as rc
from refract_core.optics.arrays import fresnel_dielectric
from refract_core.rendering.caustics import caustics_of, plan_caustics
from refract_core.rendering.work import Work
from refract_core.scene import LightKind, Material, Mesh, Model, Scene, Shaping, Sphere
from refract_core.world import environment, textures
from refract_core.world.lamps import pack_lights
from refract_core.world.tables import pack_geometry, pack_materials, world_of

pytestmark = pytest.mark.draws

F64 = NDArray[np.float64]

WHITE = material("/white", DIFFUSE=0.8, SPECULAR=0.0, IOR=1.0)
FLOOR = quad("/floor", [(-50, 0, 50), (50, 0, 50), (50, 0, -50), (-50, 0, -50)])
SIZE = 48
SUN = light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (0.0, 0.0), 3.0)
BODIES: dict[str, Mesh | Sphere] = {
    "box": box("/body", (0.25, 0.2, 0.3), 1, centre=(0.05, 0.8, 0.0)),
    "turned box": box("/body", (0.25, 0.2, 0.3), 1, turned((1, 2, 3), 35), centre=(0.0, 0.8, 0.0)),
    "ball": Sphere("/body", (0.0, 0.8, 0.05), 0.3, 1),
}
_PAINTED = np.array([[[3, 1, 0.5], [0.5, 1, 2]], [[0.5, 2, 1], [2, 1, 1]]], np.float32)
LIGHTS: dict[str, dict[str, Any]] = {
    "sun": {"lights": (replace(SUN, size=(math.radians(2.0), 0.0)),)},
    "slanting sun": {"lights": (light(LightKind.DISTANT, (5, 9, 3), (-0.3, -1, -0.2), (0.02, 0.0), 900.0),)},
    "ball": {"lights": (light(LightKind.SPHERE, (0.2, 2.0, 0.1), (0, -1, 0), (0.1, 0.0), 60.0),)},
    "panel": {"lights": (light(LightKind.RECT, (0.3, 1.9, 0.0), (-0.1, -1, 0), (0.8, 0.5), 4.0),)},
    "disk": {"lights": (light(LightKind.DISK, (0.0, 2.2, 0.0), (0, -1, 0), (0.3, 0.0), 8.0),)},
    "dome": {"environment": dome(0.7)},
}
UNEVEN: dict[str, dict[str, Any]] = {
    "tube": {"lights": (light(LightKind.CYLINDER, (0.1, 2.0, 0.0), (0, -1, 0), (0.05, 0.8), 30.0),)},
    "spot": {"lights": (replace(light(LightKind.DISK, (0.3, 2.2, 0.0), (-0.1, -1, 0), (0.2, 0.0), 20.0),
                                shaping=Shaping(cone=0.5, softness=0.8, focus=4.0, focus_tint=(0.2, 0.4, 0.6))),)},
    "painted panel": {"lights": (replace(light(LightKind.RECT, (0.3, 1.9, 0.0), (-0.1, -1, 0), (0.8, 0.5), 4.0),
                                         shaping=Shaping(picture=_PAINTED)),)},
}  # fmt: skip


def under(fov: float, **fields: Any) -> Any:
    """Looks down from below the body, which so is not in the picture; a pixel is 2 fov / SIZE wide."""
    return camera((0, 0.35, 0), (0, 0, 0), fov, orthographic=True, **fields)


def lit(what: Material, bodies: Sequence[Mesh | Sphere], fov: float = 0.8, **fields: Any) -> Scene:
    meshes = [body for body in bodies if isinstance(body, Mesh)]
    balls = [body for body in bodies if isinstance(body, Sphere)]
    return scene([FLOOR, *meshes], [WHITE, what], balls, cameras=(under(fov),), **fields)


def arriving(of: Scene, photons: int = 1 << 17, **settings: Any) -> F64:
    """What the floor sends back, (SIZE, SIZE, 3)."""
    chosen = {"samples": 16, "tolerance": 0.03, "light_samples": 64, "caustics": photons, **settings}
    return draw(of, SIZE, SIZE, **chosen)["beauty"][..., :3].astype(np.float64)


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("shape", BODIES)
def test_glass_of_index_one_changes_no_light(name: str, shape: str) -> None:
    """It stops the lamps' own rays, and photons bring that back, at the same place, but for their texels' blur, and
    for near lamps that are partly hidden by their area."""
    bare = arriving(lit(WHITE, [], **LIGHTS[name]))
    through = arriving(lit(glass(Model.TRACED, 1.0), [BODIES[shape]], **LIGHTS[name]))
    assert through.mean() == pytest.approx(bare.mean(), rel=0.03)
    ratio = through / bare
    assert np.sqrt(np.square(ratio - 1.0).mean()) < 0.05
    blocks = ratio.reshape(12, 4, 12, 4, 3).mean((1, 3))
    assert np.abs(blocks - 1.0).max() < 0.12


def test_even_light_through_glass_is_quiet() -> None:
    """Under a wide box of index 1 in the sun some 10 photons fall on a pixel, which alone would stray by a third."""
    body = box("/body", (1.0, 0.2, 1.0), 1, centre=(0, 0.8, 0))
    bare = arriving(lit(WHITE, [], fov=0.3, lights=(SUN,)))
    through = arriving(lit(glass(Model.TRACED, 1.0), [body], fov=0.3, lights=(SUN,)), photons=1 << 15)
    assert (through / bare).std() < 0.03


@pytest.mark.parametrize("degrees", [20.0, 35.0, 44.0])
def test_a_slope_gets_as_much_as_without_the_glass(degrees: float) -> None:
    """Texels are squares seen along an axis of the world: on a slope they are larger than they look."""
    rise = 50.0 * math.tan(math.radians(degrees))
    slope = quad("/floor", [(-50, -rise, 50), (50, rise, 50), (50, rise, -50), (-50, -rise, -50)])
    ball = Sphere("/body", (0.0, 0.8, 0.05), 0.3, 1)
    bare, through = (
        scene([slope], [WHITE, glass(Model.TRACED, 1.0)], balls, cameras=(under(0.2),), lights=(SUN,))
        for balls in ([], [ball])
    )
    assert arriving(through).mean() == pytest.approx(arriving(bare).mean(), rel=0.02)


@pytest.mark.parametrize("name", UNEVEN)
def test_uneven_lights_lose_nothing_in_glass_of_index_one(name: str) -> None:
    """Photons start as bright as the cone, the picture and the tube are from there, colour by colour."""
    bare = arriving(lit(WHITE, [], **UNEVEN[name])).mean((0, 1))
    through = arriving(lit(glass(Model.TRACED, 1.0), [BODIES["ball"]], **UNEVEN[name])).mean((0, 1))
    assert through == pytest.approx(bare, rel=0.03)


def test_a_lamp_in_a_body_shines_out_of_it() -> None:
    lamp = light(LightKind.SPHERE, (0.05, 0.8, 0.0), (0, -1, 0), (0.05, 0.0), 90.0)
    bare = arriving(lit(WHITE, [], lights=(lamp,)))
    for name in ("ball", "box"):
        through = arriving(lit(glass(Model.TRACED, 1.0), [BODIES[name]], lights=(lamp,)))
        assert through.mean() == pytest.approx(bare.mean(), rel=0.02)
        assert np.sqrt(np.square(through / bare - 1.0).mean()) < 0.08


def test_a_body_takes_its_colour_from_the_light() -> None:
    """Straight down through a box: Beer and Lambert."""
    colour = (0.5, 0.25, 1.0)
    what = glass(Model.TRACED, 1.0, TRANSMITTANCE=colour)
    what = replace(what, absorption_distance=0.2)
    bare = arriving(lit(WHITE, [], lights=(SUN,)))
    through = arriving(lit(what, [box("/body", (0.4, 0.2, 0.4), 1, centre=(0, 0.8, 0))], lights=(SUN,)))
    middle = np.s_[16:32, 16:32]
    ratio = (through / bare)[middle].mean((0, 1))
    np.testing.assert_allclose(ratio, np.square(colour), rtol=0.01)


def ball_lens(ior: float, radius: float, away: float, within: ArrayLike) -> F64:
    """Share of the light that falls on a ball along its axis which lands `away` behind its middle, within each distance
    of the axis: two refractions of every ray, by Snell and Fresnel (no reflection within)."""
    h = radius * np.sqrt((np.arange(200_000) + 0.5) / 200_000)
    outer = np.arcsin(h / radius)
    inner = np.arcsin(np.sin(outer) / ior)
    turn = 2.0 * (outer - inner)
    # It leaves the ball at the polar angle 2 inner - outer behind the middle, and goes towards the axis.
    polar = 2.0 * inner - outer
    x, z = radius * np.sin(polar), radius * np.cos(polar)
    lands = np.abs(x - (away - z) * np.tan(turn))
    kept = (1.0 - fresnel_dielectric(np.cos(outer), 1.0 / ior)) ** 2
    return np.array([(kept * (lands < r)).mean() for r in np.atleast_1d(np.asarray(within, np.float64))])


@pytest.mark.parametrize("ior", [1.33, 1.5, 1.8])
def test_a_ball_focuses_as_two_refractions_say(ior: float) -> None:
    """How much of the light arrives within three distances of the axis, at the paraxial focus n R / (2 (n - 1))."""
    radius = 0.3
    focus = ior * radius / (2.0 * (ior - 1.0))
    ball = Sphere("/body", (0.0, focus, 0.0), radius, 1)
    fov = 0.24
    lens = camera((0, min(0.3, (focus - radius) / 2), 0), (0, 0, 0), fov, orthographic=True)
    what = replace(lit(glass(Model.TRACED, ior), [ball], lights=(SUN,)), cameras=(lens,))
    picture = draw(what, 96, 96, samples=16, tolerance=0.03, caustics=1 << 17)["beauty"][..., 1].astype(np.float64)
    bare = arriving(lit(WHITE, [], lights=(SUN,)))[..., 1].mean()
    places = (np.arange(96) + 0.5) / 48 * fov - fov
    away = np.hypot(places[:, None], places[None, :])
    pixel = (2 * fov / 96) ** 2
    within = np.array([0.08, 0.14, 0.22])
    found = np.array([picture[away < r].sum() * pixel / (bare * math.pi * radius**2) for r in within])
    expected = ball_lens(ior, radius, focus, within)
    np.testing.assert_allclose(found, expected, atol=0.025)


def test_each_colour_is_focused_by_its_own_index() -> None:
    """Dispersion: how much of blue and red arrives near the axis, at the focus of blue, by the indices at both lines:
    Cauchy's A + B / wavelength^2 through n_d = 1.6 and an Abbe number of 15, at 656.27 and 486.13 nm."""
    ior, abbe, radius, fov = 1.6, 15.0, 0.3, 0.1
    red, blue = 1.588, 1.628
    focus = blue * radius / (2.0 * (blue - 1.0))
    what = replace(glass(Model.TRACED, ior), abbe=abbe)
    lens = camera((0, 0.05, 0), (0, 0, 0), fov, orthographic=True)
    of = replace(lit(what, [Sphere("/body", (0.0, focus, 0.0), radius, 1)], lights=(SUN,)), cameras=(lens,))
    picture = draw(of, 64, 64, samples=16, tolerance=0.03, caustics=1 << 17)["beauty"].astype(np.float64)
    places = (np.arange(64) + 0.5) / 32 * fov - fov
    near = np.hypot(places[:, None], places[None, :]) < 0.04
    ratio = picture[near][:, 2].sum() / picture[near][:, 0].sum()
    expected = ball_lens(blue, radius, focus, 0.04)[0] / ball_lens(red, radius, focus, 0.04)[0]
    assert ratio == pytest.approx(expected, rel=0.08)
    assert abs(expected - 1.0) > 0.1  # without dispersion it would be 1


# --- energy -----------------------------------------------------------------------------------------------------------


def landed(of: Scene, photons: int) -> F64:
    """Flux of all that lands, colour by colour, where all surfaces face an axis of the world."""
    settings = rc.RenderSettings(image_width=64, caustics=photons, jobs=1)
    geometry, bvh, slots = pack_geometry(of)
    world = world_of(
        geometry, pack_materials(of.materials, slots, ""), textures.pack(of.textures),
        pack_lights(of, np.zeros(3)), environment.pack(of.environment),
    )  # fmt: skip
    with ThreadPoolExecutor(1) as executor:
        work = Work(executor, lambda _share, _stage: None, lambda: False)
        thrown = caustics_of(world, of, plan_caustics(world, of.cameras[0], settings), work)
    assert thrown is not None
    bvh.close()
    return thrown.table.flux.astype(np.float64).sum(0)


def room(*more: Mesh) -> list[Mesh]:
    hall = box("/hall", (3.0, 3.0, 3.0), 0)
    return [replace(hall, triangles=hall.triangles[:, ::-1].copy()), *more]


@pytest.mark.parametrize("ior", [1.3, 1.5, 2.4])
@pytest.mark.parametrize("shape", BODIES)
def test_all_light_that_falls_on_glass_lands(shape: str, ior: float) -> None:
    """A lamp in a closed room: what a clear body takes is what its solid angle says; mirrored, bent or caught for long,
    it arrives on the walls. Of a body that no formula knows, what it takes is found by rays in numpy."""
    body = BODIES[shape]
    meshes, balls = ([body], []) if isinstance(body, Mesh) else ([], [body])
    lamp = light(LightKind.SPHERE, (0.0, 2.2, 0.0), (0, -1, 0), (0.02, 0.0), 100.0)
    of = scene(room(*meshes), [WHITE, glass(Model.TRACED, ior)], balls, lights=(lamp,))
    intensity = 100.0 * math.pi * 0.02**2
    if isinstance(body, Sphere):
        distance = math.dist(body.centre, (0.0, 2.2, 0.0))
        taken = intensity * 2.0 * math.pi * (1.0 - math.sqrt(1.0 - (body.radius / distance) ** 2))
    else:
        corners = body.points[body.triangles].astype(np.float64) - (0.0, 2.2, 0.0)
        a, b, c = (corners[:, k] / np.linalg.norm(corners[:, k], axis=1, keepdims=True) for k in range(3))
        above = (a * np.cross(b, c)).sum(1)
        below = 1 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1)
        taken = intensity * 0.5 * np.abs(2.0 * np.arctan2(above, below)).sum()  # each side of a convex body once
    np.testing.assert_allclose(landed(of, 1 << 15), taken, rtol=0.01)


def test_a_lamp_in_glass_loses_nothing() -> None:
    lamp = light(LightKind.SPHERE, (0.1, 0.1, 0.0), (0, -1, 0), (0.03, 0.0), 50.0)
    of = scene(room(), [WHITE, glass(Model.TRACED, 1.5)], [Sphere("/ball", (0, 0, 0), 0.5, 1)], lights=(lamp,))
    np.testing.assert_allclose(landed(of, 1 << 15), 50.0 * math.pi * 4.0 * math.pi * 0.03**2, rtol=0.01)


def test_rough_and_dispersive_glass_loses_nothing() -> None:
    body = BODIES["ball"]
    assert isinstance(body, Sphere)
    lamp = light(LightKind.SPHERE, (0.0, 2.2, 0.0), (0, -1, 0), (0.02, 0.0), 100.0)
    clear, rough = (
        scene(room(), [WHITE, replace(glass(Model.TRACED, 1.5, ROUGHNESS=r), abbe=a)], [body], lights=(lamp,))
        for r, a in ((0.0, 0.0), (0.4, 20.0))
    )
    np.testing.assert_allclose(landed(rough, 1 << 15), landed(clear, 1 << 15), rtol=0.01)


# --- straight on ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0.0, 40.0, 65.0])
@pytest.mark.parametrize("kind", ["sheet", "plate", "body"])
def test_light_goes_straight_through_panes_and_what_throws_no_caustics(kind: str, degrees: float) -> None:
    """Fresnel once for a sheet, as where it is looked through, and once for each wall of a body; Beer and Lambert over
    the slant way inside: the sheet's bent, the body's straight."""
    ior, colour = 1.5, np.array([0.9, 0.6, 0.3])
    slope = math.tan(math.radians(degrees))
    sun = light(LightKind.DISTANT, (0, 9, 0), (slope, -1, 0), (0.0, 0.0), 3.0)
    if kind == "sheet":
        body = quad("/pane", [(-9, 1, 9), (9, 1, 9), (9, 1, -9), (-9, 1, -9)], 1)
        what = glass(Model.THIN, ior, TRANSMITTANCE=colour)
    else:
        half = 0.01 if kind == "plate" else 0.2
        body = box("/pane", (9.0, half, 9.0), 1, centre=(0, 1, 0))
        what = replace(glass(Model.TRACED, ior, TRANSMITTANCE=colour), absorption_distance=0.3)
    bare = arriving(lit(WHITE, [], lights=(sun,)), 0)
    # A plate goes straight though photons are asked for.
    through = arriving(lit(what, [body], lights=(sun,)), 1 << 14 if kind == "plate" else 0)
    cosine = math.cos(math.radians(degrees))
    walls = 1 if kind == "sheet" else 2
    kept = (1.0 - float(fresnel_dielectric(cosine, 1.0 / ior))) ** walls
    inside = math.sqrt(1.0 - (1.0 - cosine**2) / ior**2)
    power = {"sheet": 1.0 / inside, "plate": 0.02 / cosine / 0.3, "body": 0.4 / cosine / 0.3}[kind]
    np.testing.assert_allclose((through / bare).mean((0, 1)), kept * colour**power, rtol=2e-3)


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_what_is_there_by_chance_stops_its_share_of_what_glass_throws(share: float) -> None:
    """A card of `presence` between a box of glass and the floor: photons toss for it, each for itself."""
    card = quad("/card", [(-2, 0.45, 2), (2, 0.45, 2), (2, 0.45, -2), (-2, 0.45, -2)], 2)
    there = replace(material("/there", OPACITY=share, DIFFUSE=0.0, SPECULAR=0.0, IOR=1.0), opacity_presence=True)
    body = box("/body", (0.4, 0.2, 0.4), 1, centre=(0, 0.8, 0))
    clear, covered = (
        scene([FLOOR, body, *cards], [WHITE, glass(Model.TRACED, 1.0), there], cameras=(under(0.3),), lights=(SUN,))
        for cards in ([], [card])
    )
    found = arriving(covered).mean() / arriving(clear).mean()
    assert found == pytest.approx(1.0 - share, abs=0.02)


def test_a_thing_before_a_lamp_is_dark_though_something_else_is_cut_out() -> None:
    """A card stops the sun, whether or not some material of the stage is a cut-out."""
    card = quad("/card", [(-0.3, 1, 0.3), (0.3, 1, 0.3), (0.3, 1, -0.3), (-0.3, 1, -0.3)])
    holes = replace(material("/leaf", OPACITY=1.0), opacity_threshold=0.5)
    leaf = quad("/leaf", [(20, 1, 1), (21, 1, 1), (21, 1, 0), (20, 1, 0)], 1)
    of = scene([FLOOR, card, leaf], [WHITE, holes], cameras=(under(0.8),), lights=(SUN,))
    picture = arriving(of, 0)
    assert picture[20:28, 20:28].max() == 0.0
    assert picture[:6].min() > 0.5


def test_threads_and_tiles_change_no_bit() -> None:
    of = lit(glass(Model.TRACED, 1.5), [BODIES["turned box"], Sphere("/more", (0.5, 0.6, 0.0), 0.3, 1)],
             lights=LIGHTS["panel"]["lights"], environment=dome(0.2))  # fmt: skip
    first = arriving(of, 1 << 13, jobs=1)
    np.testing.assert_array_equal(arriving(of, 1 << 13, jobs=2, tile_size=16), first)
