"""What glows is a light: as bright as the UsdLux light of its shape, everywhere, with the same shadows; against closed
forms and quadrature in plain numpy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import box, camera, dome, draw, glass, globe, light, material, quad, scene, view_rays

from refract_core.kernels.compile import kernel
from refract_core.kernels.pointer import Pointer
from refract_core.scene import Channel, Light, LightKind, Material, Mesh, Model, Scene, Source, Sphere, Texture
from refract_core.world import environment, textures
from refract_core.world.emitters import what_glows
from refract_core.world.lamps import pack_lights
from refract_core.world.lights import highlight, irradiance_factor, shadow_ray
from refract_core.world.tables import pack_geometry, pack_materials, world_of

pytestmark = pytest.mark.draws

F64 = NDArray[np.float64]

WHITE = material("/white", DIFFUSE=0.8, SPECULAR=0.0, IOR=1.0)
GLOW = material("/glow", EMISSIVE=(4.0, 2.0, 1.0), IOR=1.0)
FLOOR = quad("/floor", [(-50, 0, 50), (50, 0, 50), (50, 0, -50), (-50, 0, -50)])
CARD = quad("/card", [(-0.2, 0.5, 0.3), (0.4, 0.5, 0.3), (0.4, 0.5, -0.3), (-0.2, 0.5, -0.3)])
DOWN = camera((0, 0.35, 0), (0, 0, 0), 1.2, orthographic=True)
"""Looks at the floor alone."""


def floor(what: Scene, **settings: Any) -> F64:
    """The picture of it, (48, 48, 3)."""
    chosen = {"samples": 16, "tolerance": 0.03, "light_samples": 64, "emission_light": True, **settings}
    return draw(what, 48, 48, **chosen)["beauty"][..., :3].astype(np.float64)


def lit_by(*things: Mesh | Sphere, **fields: Any) -> Scene:
    meshes = [thing for thing in things if isinstance(thing, Mesh)]
    balls = [thing for thing in things if isinstance(thing, Sphere)]
    return scene([FLOOR, *meshes], [WHITE, GLOW], balls, **{"cameras": (DOWN,), **fields})


def lamp(kind: LightKind, centre: Any, size: tuple[float, float]) -> Any:
    return replace(light(kind, centre, (0, -1, 0), size), radiance=(4.0, 2.0, 1.0))


PANEL = quad("/panel", [(-0.5, 1.5, -0.3), (0.5, 1.5, -0.3), (0.5, 1.5, 0.3), (-0.5, 1.5, 0.3)], 1)
PAIRS: dict[str, tuple[Mesh | Sphere, Light]] = {
    "panel": (PANEL, lamp(LightKind.RECT, (0, 1.5, 0), (1.0, 0.6))),
    "ball": (Sphere("/ball", (0.1, 1.4, 0.0), 0.3, 1), lamp(LightKind.SPHERE, (0.1, 1.4, 0.0), (0.3, 0.0))),
    "globe": (globe("/globe", 0.3, 1, 24, (0.1, 1.4, 0.0)), lamp(LightKind.SPHERE, (0.1, 1.4, 0.0), (0.3, 0.0))),
}


@pytest.mark.parametrize("name", PAIRS)
def test_what_glows_lights_as_the_lamp_of_its_shape(name: str) -> None:
    """A globe's corners lie on the sphere, so it is smaller by a part of the square of its steps."""
    thing, of = PAIRS[name]
    ours, theirs = floor(lit_by(thing)), floor(lit_by(lights=(of,)))
    np.testing.assert_allclose(ours, theirs, rtol=0.015 if name == "globe" else 1e-4)
    assert ours.mean() > 0.05


@pytest.mark.parametrize("name", PAIRS)
def test_it_throws_the_shadow_of_the_lamp_of_its_shape(name: str) -> None:
    thing, of = PAIRS[name]
    ours, theirs = floor(lit_by(thing, CARD)), floor(lit_by(CARD, lights=(of,)))
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.02)
    assert np.sqrt(np.square(ours - theirs).mean()) < 0.03 * theirs.max()
    dark = theirs[..., 0] < 0.02 * theirs[..., 0].max()
    assert dark.any() or name == "panel"
    assert (ours[dark] < 0.05 * theirs.max()).all()


@pytest.mark.parametrize("shape", ["box", "ball"])
def test_inside_of_what_glows_all_that_is_convex_is_its_albedo(shape: str) -> None:
    """The white furnace: E = pi L wherever a surface looks, as long as it sees no other thing."""
    room: Mesh | Sphere = box("/room", (3, 2, 4), 1) if shape == "box" else Sphere("/room", (0.2, 0.1, 0.0), 5.0, 1)
    meshes = [room] if isinstance(room, Mesh) else []
    balls = [] if isinstance(room, Mesh) else [room]
    lens = camera((0, 0, 2), (0, 0, 0), 0.4)
    what = scene(meshes, [WHITE, GLOW], [*balls, Sphere("/thing", (0, 0, 0), 0.9, 0)], cameras=(lens,))
    seen = floor(what)[16:32, 16:32]
    np.testing.assert_allclose(seen, np.broadcast_to(0.8 * np.array([4.0, 2.0, 1.0]), seen.shape), rtol=0.02)


def albedo_of_lobe(alpha: float, cosine: float) -> float:
    """What a GGX surface without Fresnel sends back of light from everywhere: the lobe over the hemisphere."""
    wo = np.array([math.sqrt(1.0 - cosine**2), 0.0, cosine])
    up, turn = ((np.arange(k) + 0.5) / k for k in (400, 800))
    z, phi = np.meshgrid(up, 2.0 * math.pi * turn)
    wi = np.stack([np.sqrt(1.0 - z**2) * np.cos(phi), np.sqrt(1.0 - z**2) * np.sin(phi), z], axis=-1).reshape(-1, 3)
    return float(lobe(wi, np.array([0.0, 0.0, 1.0]), wo, alpha).mean() * 2.0 * math.pi)


@pytest.mark.parametrize("roughness", [0.55, 0.9])
@pytest.mark.parametrize("shape", ["box", "ball"])
def test_inside_of_what_glows_a_rough_metal_shines_by_its_lobe(shape: str, roughness: float) -> None:
    """It has no diffuse light; and it sends no mirror rays, which would see the room."""
    room: Mesh | Sphere = box("/room", (3, 2, 4), 1) if shape == "box" else Sphere("/room", (0.2, 0.1, 0.0), 5.0, 1)
    meshes = [room] if isinstance(room, Mesh) else []
    balls = [] if isinstance(room, Mesh) else [room]
    lens = camera((0, 0, 2), (0, 0, 0), 0.1)
    metal = material("/metal", DIFFUSE=(1.0, 1.0, 1.0), METALLIC=1.0, ROUGHNESS=roughness)
    what = scene(meshes, [metal, GLOW], [*balls, Sphere("/thing", (0, 0, 0), 0.9, 0)], cameras=(lens,))
    seen = floor(what)[20:28, 20:28]
    expected = albedo_of_lobe(roughness**2, 1.0) * np.array([4.0, 2.0, 1.0])
    np.testing.assert_allclose(seen, np.broadcast_to(expected, seen.shape), rtol=0.03)


def test_a_metal_between_smooth_and_rough_has_the_highlight_once_and_no_specks() -> None:
    """Its mirror rays see the rest of the room, and would meet a small thing that glows now and then."""
    lens = camera((0, 0, 2), (0, 0, 0), 0.4)
    room = quad("/room", [(-50, -50, -2), (50, -50, -2), (50, 50, -2), (-50, 50, -2)], 0)
    spot = quad("/spot", [(-0.3, 0.2, 3.0), (-0.3, 0.8, 3.0), (0.3, 0.8, 3.0), (0.3, 0.2, 3.0)], 2)
    shown = {}
    for roughness in (0.499, 0.501):
        metal = material("/metal", DIFFUSE=(1.0, 1.0, 1.0), METALLIC=1.0, ROUGHNESS=roughness)
        what = scene([room, spot], [WHITE, metal, GLOW], [Sphere("/thing", (0, 0, 0), 0.9, 1)], cameras=(lens,))
        shown[roughness] = floor(what, samples=16)[14:34, 14:34, 0]
    smooth, rough = shown[0.499], shown[0.501]
    assert rough.max() > 0.05
    assert smooth.mean() == pytest.approx(rough.mean(), rel=0.15)
    np.testing.assert_allclose(smooth, rough, atol=0.05 * rough.max())


def test_a_closed_body_shines_outwards_and_a_sheet_both_ways() -> None:
    upright = camera((0, 0.35, 0), (0, 0, 0), 1.2, orthographic=True)
    body = box("/body", (0.4, 0.05, 0.4), 1, centre=(0, 1.2, 0))
    quiet = floor(lit_by(body, cameras=(upright,)))
    bottom = lamp(LightKind.RECT, (0, 1.15, 0), (0.8, 0.8))
    alone = floor(lit_by(lights=(bottom,), cameras=(upright,)))
    assert (quiet >= alone * 0.999).all()  # its sides, too
    assert quiet[24, 24] == pytest.approx(alone[24, 24], rel=0.02)
    turned_over = replace(PANEL, triangles=PANEL.triangles[:, ::-1].copy())
    np.testing.assert_allclose(floor(lit_by(turned_over)), floor(lit_by(PANEL)), rtol=1e-6)


def test_a_picture_that_glows_lights_from_where_it_glows() -> None:
    """Its left half alone: as a panel half as wide."""
    picture = np.zeros((64, 64, 4), np.float32)
    picture[:, :32] = (4.0, 2.0, 1.0, 1.0)
    painted = material("/glow", EMISSIVE=Source(texture=0, channel=Channel.RGB, uv_primvar="st"), IOR=1.0)
    ours = floor(replace(lit_by(PANEL), materials=(WHITE, painted), textures=(Texture("glow", picture),)))
    half = quad("/half", [(-0.5, 1.5, -0.3), (0.0, 1.5, -0.3), (0.0, 1.5, 0.3), (-0.5, 1.5, 0.3)], 1)
    theirs = floor(lit_by(half))
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.01)
    np.testing.assert_allclose(ours, theirs, rtol=0.06)


def test_what_is_half_there_lights_half() -> None:
    half = replace(material("/glow", EMISSIVE=(4.0, 2.0, 1.0), IOR=1.0, OPACITY=0.5), opacity_presence=True)
    whole = lit_by(PANEL)
    ours = floor(replace(whole, materials=(WHITE, half)))
    np.testing.assert_allclose(ours, floor(whole) / 2, rtol=1e-4)


def test_many_things_share_lights_and_lose_nothing() -> None:
    """Eighty small bodies side by side, each as the ball light that sends out as much."""
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(-2, 2, 80), np.full(80, 1.5), rng.uniform(-2, 2, 80)])
    bodies = [globe(f"/globe{k}", 0.012, 1, 12, place) for k, place in enumerate(places)]
    a, b, c = (bodies[0].points[bodies[0].triangles[:, k]].astype(np.float64) for k in range(3))
    radius = math.sqrt(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 / (4.0 * math.pi))
    lamps = tuple(lamp(LightKind.SPHERE, place, (radius, 0.0)) for place in places)
    ours, theirs = floor(lit_by(*bodies)), floor(lit_by(lights=lamps))
    np.testing.assert_allclose(ours, theirs, rtol=0.03)
    assert len(table_of(lit_by(*bodies)).kind) <= 16


@pytest.mark.parametrize("count", [16, 17, 40])
def test_many_spheres_are_their_lamps(count: int) -> None:
    """Up to sixteen are lamps of their own, more are facets in a tree."""
    rng = np.random.default_rng(5)
    places = np.column_stack([rng.uniform(-2, 2, count), np.full(count, 1.5), rng.uniform(-2, 2, count)])
    balls = [Sphere(f"/ball{k}", (float(x), float(y), float(z)), 0.02, 1) for k, (x, y, z) in enumerate(places)]
    lamps = tuple(lamp(LightKind.SPHERE, place, (0.02, 0.0)) for place in places)
    np.testing.assert_allclose(floor(lit_by(*balls)), floor(lit_by(lights=lamps)), rtol=0.04)
    assert len(table_of(lit_by(*balls)).kind) <= 16


def test_what_is_no_number_lights_nothing_else_wrongly() -> None:
    """A picture with an infinity and a value that is none: the rest of it is as it is."""
    picture = np.ones((8, 8, 4), np.float32)
    picture[0, 0, :3], picture[7, 7, :3] = np.inf, np.nan
    painted = material("/glow", EMISSIVE=Source(texture=0, channel=Channel.RGB, uv_primvar="st"), IOR=1.0)
    found = floor(replace(lit_by(PANEL), materials=(WHITE, painted), textures=(Texture("glow", picture),)))
    assert np.isfinite(found).all()


def test_glass_of_index_one_lets_it_through() -> None:
    """Photons start as bright as what glows is from there."""
    ball = Sphere("/lens", (0.1, 0.8, 0.0), 0.25, 2)
    bare = floor(lit_by(PANEL))
    through = lit_by(PANEL, ball)
    through = replace(through, materials=(*through.materials, glass(Model.TRACED, 1.0)))
    found = floor(through, caustics=1 << 17)
    assert found.mean() == pytest.approx(bare.mean(), rel=0.02)
    assert np.sqrt(np.square(found / bare - 1.0).mean()) < 0.05


def test_it_may_be_left_out_and_black_glows_not() -> None:
    with_dome = lit_by(PANEL, environment=dome(0.3))
    bare = lit_by(replace(PANEL, materials=np.zeros(2, np.int32)), environment=dome(0.3))
    np.testing.assert_array_equal(floor(with_dome, emission_light=False), floor(bare))
    black = replace(with_dome, materials=(WHITE, material("/glow", EMISSIVE=(0.0, 0.0, 0.0), DIFFUSE=0.0)))
    np.testing.assert_array_equal(floor(black), floor(bare))
    assert len(table_of(black).kind) == 0


# --- any triangles, any receivers ------------------------------------------------------------------------------------


@kernel
def _ask(lights, points, normals, draws, out, to):  # type: ignore[no-untyped-def]
    for k in range(points.shape[0]):
        p, n = (points[k, 0], points[k, 1], points[k, 2]), (normals[k, 0], normals[k, 1], normals[k, 2])
        for l in range(lights.kind.shape[0]):  # noqa: E741
            share = irradiance_factor(lights, l, p, n)
            for c in range(3):
                out[k, c] += share * lights.radiance[l, c]
        for i in range(draws.shape[0]):
            direction, distance, _ = shadow_ray(lights, 0, p, n, draws[i, 0], draws[i, 1])
            for c in range(3):
                to[k, i, c] = p[c] + distance * direction[c]


@kernel
def _ask_gleam(lights, points, normals, views, alphas, mirrors, out):  # type: ignore[no-untyped-def]
    for k in range(points.shape[0]):
        p, n = (points[k, 0], points[k, 1], points[k, 2]), (normals[k, 0], normals[k, 1], normals[k, 2])
        wo = (views[k, 0], views[k, 1], views[k, 2])
        for l in range(lights.kind.shape[0]):  # noqa: E741
            share = highlight(lights, l, p, n, wo, alphas[k], mirrors)
            for c in range(3):
                out[k, c] += share * lights.radiance[l, c]


def lobe(wi: F64, n: F64, wo: F64, alpha: float) -> F64:
    """GGX with Smith's height-correlated shadowing (Heitz 2014, equations 71, 72 and 99), times the cosine, without
    Fresnel [1 / sr]."""
    h = wi + wo
    h /= np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-12)
    l, v, m = wi @ n, wo @ n, h @ n  # noqa: E741
    d = alpha**2 / (math.pi * np.square(m * m * (alpha**2 - 1.0) + 1.0))
    def wide(x: Any) -> Any:
        return np.sqrt(alpha**2 + (1.0 - alpha**2) * x * x)
    up = np.maximum(l, 1e-12)
    result: F64 = np.where(l > 0.0, d * up * 0.5 / (up * wide(v) + v * wide(up)), 0.0)
    return result


def table_of(what: Scene, eye: Any = (0.0, 0.0, 60.0)) -> Any:
    """The light table with what glows in it."""
    geometry, bvh, slots = pack_geometry(what)
    lights = pack_lights(what, np.zeros(3))
    world = world_of(geometry, pack_materials(what.materials, slots, ""), textures.pack(what.textures), lights,
                     environment.pack(what.environment))  # fmt: skip
    table = pack_lights(what, np.zeros(3), what_glows(world, what, np.array(eye)))
    bvh.close()
    return table


def arrives(corners: F64, radiance: F64, point: F64, worth: Callable[[F64], F64], count: int = 24) -> F64:
    """What triangles bring that shine to the side from which they run counter-clockwise, where a direction (unit, ...)
    is worth so much per solid angle, by quadrature."""
    s = (np.arange(count) + 0.5) / count
    u, v = (grid.ravel() for grid in np.meshgrid(np.sqrt(s), s))
    a, b, c = (corners[:, k, None] for k in range(3))
    places = (1.0 - u)[:, None] * a + (u * (1.0 - v))[:, None] * b + (u * v)[:, None] * c
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    to = places - point
    d2 = np.square(to).sum(2)
    facing = np.maximum(0.0, -np.einsum("tqc,tc->tq", to, across)) / 2.0
    result: F64 = (worth(to / np.sqrt(d2)[..., None]) * facing / d2**1.5).mean(1) @ radiance
    return result


def soup(seed: int) -> tuple[Scene, F64, F64]:
    """Bodies and sheets that glow in colours of their own; their triangles and radiance, to each side they shine to."""
    rng = np.random.default_rng(seed)
    meshes: list[Mesh] = []
    materials: list[Material] = []
    corners, radiance = [], []
    for k in range(rng.integers(1, 5)):
        colour = rng.uniform(0.1, 4.0, 3)
        materials.append(material(f"/m{k}", EMISSIVE=tuple(colour), DIFFUSE=0.0))
        if rng.random() < 0.4:
            mesh = globe(f"/g{k}", rng.uniform(0.1, 0.4), k, int(rng.integers(3, 20)), rng.uniform(-1, 1, 3))
        else:
            mesh = quad(f"/q{k}", rng.uniform(-1, 1, 3) + rng.uniform(-0.5, 0.5, (4, 3)), k)
        sides = mesh.points[mesh.triangles].astype(np.float64)
        both = [sides] if mesh.closed else [sides, sides[:, ::-1]]
        corners += both
        radiance += [np.broadcast_to(colour, (len(side), 3)) for side in both]
        meshes.append(mesh)
    return scene(meshes, materials), np.concatenate(corners), np.concatenate(radiance)


@pytest.mark.parametrize("seed", range(12))
def test_what_arrives_of_any_triangles(seed: int) -> None:
    """At receivers of any place and direction; points for shadow rays are spread by what they bring."""
    what, corners, radiance = soup(seed)
    rng = np.random.default_rng(1000 + seed)
    points = rng.uniform(-3.0, 3.0, (40, 3))
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    table = table_of(what)
    found, to = np.zeros((40, 3)), np.zeros((40, 256, 3))
    s = (np.arange(16) + 0.5) / 16
    draws = np.stack([grid.ravel() for grid in np.meshgrid(s, s)], axis=1)
    _ask(Pointer(table), points, normals, draws, found, to)
    expected = np.array(
        [arrives(corners, radiance, p, lambda d: np.maximum(0.0, d @ n)) for p, n in zip(points, normals, strict=True)]  # noqa: B023
    )
    near = expected.sum(1) > 0.02 * expected.sum(1).max()
    np.testing.assert_allclose(found[near], expected[near], rtol=0.03)
    assert np.abs(found - expected).mean() < 0.005 * expected.mean()
    # Points lie on what glows, before the receiver.
    middle, half = (corners.max(1) + corners.min(1)) / 2, (corners.max(1) - corners.min(1)) / 2 + 1e-4
    k = int(expected.sum(1).argmax())
    assert (np.abs(to[k][:, None] - middle) <= half).all(2).any(1).all()


@pytest.mark.parametrize("shape", ["globe", "box", "bent"])
def test_from_far_away_a_body_is_one_thing(shape: str) -> None:
    """At receivers that are 17 to 60 of its radii away and look at it: as by quadrature, its depth and all."""
    rng = np.random.default_rng(11)
    middle = rng.uniform(-1.0, 1.0, 3)
    body = box("/body", (0.05, 0.11, 0.08), 0, centre=tuple(middle))
    if shape != "box":
        body = globe("/body", 0.1, 0, 16, tuple(middle))
    if shape == "bent":  # a boat, that is not round, nor like itself from behind
        points = body.points - middle
        points = points * (1.0, 0.5, 2.0) + (0.0, 6.0, 0.0) * points[:, 2:] ** 2 + middle
        body = replace(body, points=points.astype(np.float32))
    what = scene([body], [material("/m", EMISSIVE=1.0, DIFFUSE=0.0)])
    corners = body.points[body.triangles].astype(np.float64)
    radius = np.linalg.norm(corners - corners.mean((0, 1)), axis=2).max()
    ways = rng.normal(size=(60, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = corners.mean((0, 1)) + ways * radius * rng.uniform(17.0, 60.0, (60, 1))
    normals = -ways + rng.uniform(-0.5, 0.5, (60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found, to = np.zeros((60, 3)), np.zeros((60, 1, 3))
    _ask(Pointer(table_of(what)), points, normals, np.full((1, 2), 0.5), found, to)
    white = np.ones((len(corners), 3))
    expected = np.array(
        [arrives(corners, white, p, lambda d: np.maximum(0.0, d @ n), 8) for p, n in zip(points, normals, strict=True)]  # noqa: B023
    )
    np.testing.assert_allclose(found, expected, rtol=0.04)  # where a face just comes into sight
    assert np.abs(found - expected).mean() < 0.008 * expected.mean()
    assert found.mean() == pytest.approx(expected.mean(), rel=0.007)


@pytest.mark.parametrize("alpha", [0.05, 0.15, 0.4, 0.9])
@pytest.mark.parametrize("seed", range(6))
def test_the_highlight_of_any_triangles(seed: int, alpha: float) -> None:
    """On rough surfaces of any place, direction and roughness; those that mirror the scene have none. Where one looks
    along the surface the lobe is narrow across, and is not held to this."""
    what, corners, radiance = soup(seed)
    rng = np.random.default_rng(2000 + seed)
    points = rng.uniform(-3.0, 3.0, (20, 3))
    # Half of them mirror a place on what glows, and a bit beside it.
    to = corners.mean(1)[rng.integers(len(corners), size=20)] - points + rng.normal(0.0, 0.05, (20, 3))
    normals, views = rng.normal(size=(2, 20, 3))
    for some in (normals, views, to):
        some /= np.linalg.norm(some, axis=1, keepdims=True)
    normals *= np.sign((to * normals).sum(1, keepdims=True))
    views[::2] = (2.0 * (to * normals).sum(1, keepdims=True) * normals - to)[::2]
    views *= np.sign((views * normals).sum(1, keepdims=True))
    table, found, none = table_of(what), np.zeros((20, 3)), np.zeros((20, 3))
    _ask_gleam(Pointer(table), points, normals, views, np.full(20, alpha), False, found)
    _ask_gleam(Pointer(table), points, normals, views, np.full(20, alpha), True, none)
    assert not none.any()
    fine = max(12, int(math.sqrt(2e5 / len(corners))))
    expected = np.array(
        [arrives(corners, radiance, p, lambda d: lobe(d, n, wo, alpha), fine)  # noqa: B023
         for p, n, wo in zip(points, normals, views, strict=True)]
    )  # fmt: skip
    steep = (views * normals).sum(1) > 0.1
    found, expected = found[steep], expected[steep]
    assert np.abs(found - expected).mean() < 0.02 * expected.mean()
    bright = expected.sum(1) > 0.05 * expected.sum(1).max()
    np.testing.assert_allclose(found[bright], expected[bright], rtol=0.12)


@pytest.mark.parametrize("gap", [0.1, 0.01, 0.002])
def test_a_sheet_that_hangs_below_a_ceiling_lights_it_around_itself(gap: float) -> None:
    """Its upper side is seen at a slant, by the rule of rectangles. Rays to it start off the ceiling, so nearer to the
    sheet than the place that is lit, and must not end in it for that."""
    ceiling = quad("/ceiling", [(-4, 0, 4), (-4, 0, -4), (4, 0, -4), (4, 0, 4)], 0)
    sheet = quad("/sheet", [(-1, -gap, -1), (1, -gap, -1), (1, -gap, 1), (-1, -gap, 1)], 1)
    paint = [material("/grey", DIFFUSE=0.8, IOR=1.0), material("/glow", DIFFUSE=0.0, IOR=1.0, EMISSIVE=1.0)]
    eye = np.array([1.5, -3.0, 0.0])
    lens = camera(eye, (1.5, 0, 0), 0.1)
    what = scene([ceiling, sheet], paint, cameras=(lens,))
    _, d = view_rays(lens, 32, 32)
    at = eye - d * (eye[1] / d[..., 1:2])
    u, v = np.meshgrid(*[(np.arange(1000) + 0.5) / 500 - 1.0] * 2)
    for x, y in [(16, 4), (16, 16), (3, 20), (29, 9)]:
        away2 = (u - at[x, y, 0]) ** 2 + (v - at[x, y, 2]) ** 2 + gap * gap
        form = (gap * gap / away2**2).mean() * 4.0 / np.pi
        for settings in ({"samples": 1}, {"samples": 16, "tolerance": 0.03}):
            seen = draw(what, 32, 32, emission_light=True, **settings)["beauty"][x, y, 0]
            assert seen == pytest.approx(0.8 * form, rel=0.02)
