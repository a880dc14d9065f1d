"""Laws of optics that every picture of glass obeys, measured in small rooms."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import (
    ROOM,
    box,
    camera,
    checker_room,
    constant_room,
    dome,
    draw,
    glass,
    light,
    material,
    position_room,
    quad,
    scene,
    snell,
    surrounding,
    turned,
    view_rays,
    wall_hit,
    where,
)

from refract_core.scene import LightKind, Material, Mesh, Model, Probe, Scene, Sphere, Volume
from refract_core.settings import named_settings

F32 = NDArray[np.float32]

MODELS = [Model.SPHERE, Model.BOX, Model.THIN, Model.TRACED, Model.SINGLE]
BALL = Sphere("/ball", (0.1, -0.1, 0.2), 0.8, 1)
CUBE = box("/cube", (0.6, 0.5, 0.4), 1, turned((1, 2, 3), 40))
DIRECT = 1.0
"""Cut that sends all light the way of what goes through: one path, whose end tells where it went."""


def in_positions(what: Material, *things: Mesh | Sphere, **fields: Any) -> Scene:
    walls, materials = position_room()
    meshes = [t for t in things if isinstance(t, Mesh)]
    return scene([*walls, *meshes], [*materials, what], [t for t in things if isinstance(t, Sphere)], **fields)


# --- Nothing there --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("thing", [BALL, CUBE], ids=["ball", "cube"])
def test_glass_of_ior_one_is_not_there(model: Model, thing: Mesh | Sphere) -> None:
    """Snell and Fresnel at n = 1: no bending, no reflection. By rays, to the rounding of float32 positions.

    HDRP's box is as long as 1 / cos t: at grazing pixels its exit lies behind the walls, where there is nothing to see.
    """
    picture = draw(in_positions(glass(model, 1.0), thing))
    empty = draw(in_positions(glass(model, 1.0)))
    within = picture["path_length"] < 1.6  # from the object no wall is nearer
    assert (within & (picture["mask"] > 0)).mean() > 0.1
    assert model is Model.BOX or within.all()
    np.testing.assert_allclose(picture["beauty"][within], empty["beauty"][within], atol=2e-5)


@pytest.mark.parametrize(("screen", "tiers"), [("march", ("screen", "ray")), ("traced", ("screen",))])
def test_glass_of_ior_one_is_not_there_for_the_screen(screen: str, tiers: tuple[str, ...]) -> None:
    """Where the screen answers whole. The walls' colour is linear in place, so bilinear reads are exact."""
    picture = draw(in_positions(glass(Model.TRACED, 1.0), BALL), tiers=tiers, screen=screen)
    empty = draw(in_positions(glass(Model.TRACED, 1.0)))
    here = (picture["mask"] > 0) & (picture["weight.screen"] > 0.999)
    assert here.mean() > 0.1
    # Half a pixel at the far wall, 5.5 m off: 5.5 / 64 / 2 m, in colours 1 / 6 of that. Edges of walls need it.
    error = np.abs(picture["beauty"] - empty["beauty"]).max(-1)
    assert error[here if screen == "traced" else ...].max() < 0.5 * 5.5 / 64 / 6
    assert np.median(error[here]) < 1e-4


FLOOR = quad("/floor", [(-3, -1, 3), (3, -1, 3), (3, -1, -3), (-3, -1, -3)], 0)
LAMP = light(LightKind.RECT, (0, 1.5, -2.5), (0, -1, 0.8), (1.0, 1.0), 8.0)


def test_the_screen_shows_highlights_through_glass_of_ior_one() -> None:
    """As the eye sees them: the glass turns nothing, so that the pixel that knows a place is the one that asks."""
    glossy = material("/floor", DIFFUSE=0.2, ROUGHNESS=0.3, IOR=1.8)
    lens = camera((0, 0.2, 2.4), (0, -0.6, -0.5))
    pane = box("/pane", (2.0, 2.0, 0.05), 1, centre=(0, 0, 1.5))
    bare, through = (scene([FLOOR, *meshes], [glossy, glass(Model.TRACED, 1.0)], lights=(LAMP,), cameras=(lens,))
                     for meshes in ((), (pane,)))  # fmt: skip
    matt = replace(bare, materials=(material("/floor", DIFFUSE=0.2), bare.materials[1]))
    empty, picture = draw(bare), draw(through, tiers=("screen",))
    here = picture["weight.screen"] > 0.999
    assert here.mean() > 0.3
    assert (empty["beauty"] - draw(matt)["beauty"])[here].max() > 0.1
    np.testing.assert_allclose(picture["beauty"][here], empty["beauty"][here], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("roughness", "tier"), [(0.05, "ray"), (0.9, "screen")])
def test_what_mirrors_is_left_to_rays_where_there_are_any(roughness: float, tier: str) -> None:
    """Even where so little light comes from it that the screen is good enough for what is matt."""
    metal = material("/floor", DIFFUSE=0.6, METALLIC=1.0, ROUGHNESS=roughness)
    dark = glass(Model.TRACED, 1.0, TRANSMITTANCE=0.05, absorption_distance=0.1)
    pane = box("/pane", (2.0, 2.0, 0.05), 1, centre=(0, 0, 1.5))
    lens = camera((0, 0.2, 2.4), (0, -0.6, -0.5))
    what = scene([FLOOR, pane], [metal, dark], lights=(LAMP,), environment=dome(0.5), cameras=(lens,))
    picture = draw(what, tiers=("screen", "ray", "sky"))
    on_floor = picture["weight.sky"] < 0.5
    assert on_floor.mean() > 0.3
    assert np.median(picture[f"weight.{tier}"][on_floor]) == 1.0


def test_glass_of_ior_one_is_not_there_for_a_probe() -> None:
    """A probe whose proxy is the room finds the very point of the wall; texels blur what is not linear on a face."""
    room = Volume(np.eye(4), False, (ROOM,) * 3)
    probe = Probe("/probe", "baked", (0.0, 0.0, 0.0), room, room, resolution=64, clipping=(0.01, 100.0))
    picture = draw(in_positions(glass(Model.TRACED, 1.0), BALL, probes=(probe,)), tiers=("probe",))
    empty = draw(in_positions(glass(Model.TRACED, 1.0)))
    here = picture["mask"] > 0
    np.testing.assert_allclose(picture["weight.probe"][here], 1.0, atol=1e-5)
    # Captured from the middle of a cube every face shows one wall, on which place is linear: only the half texel
    # where faces meet differs, by less than a texel: 6 m / 64, in colours 1 / 64.
    error = np.abs(picture["beauty"] - empty["beauty"]).max(-1)
    assert error.max() < 1 / 64
    assert np.median(error[here]) < 1e-4


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    "settings",
    [
        {"tiers": ("ray",)},
        {"tiers": ("screen", "ray")},
        {"tiers": ("screen", "ray"), "screen": "proxy"},
        {"tiers": ("screen", "probe", "sky")},
        {"tiers": ("probe",)},
        {"tiers": ("probe", "screen", "ray")},
    ],
    ids=lambda s: "-".join(s["tiers"]) + s.get("screen", ""),
)
def test_white_furnace(model: Model, settings: dict[str, Any]) -> None:
    """Clear glass in a room of one radiance is invisible: what Fresnel takes from one direction comes from another."""
    walls, materials = constant_room(0.75)
    balls = [replace(BALL, centre=(0.5, 0.4, -0.8))]
    what = scene([*walls, CUBE], [*materials, glass(model)], balls, probes=(surrounding(),))
    picture = draw(what, **settings)
    assert picture["mask"].mean() > 0.1
    np.testing.assert_allclose(picture["beauty"][..., :3], 0.75, atol=1e-4)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("tiers", [("sky",), ("ray", "sky"), ("screen", "probe", "sky"), ("probe", "sky")])
def test_white_furnace_under_a_dome(model: Model, tiers: tuple[str, ...]) -> None:
    picture = draw(scene([CUBE], [material("/none"), glass(model)], environment=dome(0.75)), tiers=tiers)
    assert picture["mask"].mean() > 0.1
    np.testing.assert_allclose(picture["beauty"][..., :3], 0.75, atol=1e-4)


# --- Absorption -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [Model.SPHERE, Model.BOX])
def test_twice_the_thickness_squares_transmittance(model: Model) -> None:
    colour = (0.9, 0.6, 0.3)
    one, two = (
        draw(in_positions(glass(model, THICKNESS=t, TRANSMITTANCE=colour), BALL))["transmittance"] for t in (0.4, 0.8)
    )
    assert one[32, 32, 2] < 0.8
    np.testing.assert_allclose(two, one**2, atol=1e-5)


@pytest.mark.parametrize("width", [0.2, 0.4, 0.8])
def test_a_traced_slab_absorbs_by_its_real_thickness(width: float) -> None:
    """Straight through a slab a = colour ^ (width / absorption distance), Beer and Lambert. With all that is mirrored
    in it a geometric series of ways: of the light that got in, (1 - F) a (1 + F a + (F a)^2 + ..) comes out again."""
    what = glass(Model.TRACED, TRANSMITTANCE=(0.9, 0.6, 0.3), absorption_distance=0.5)
    lens = camera((0, 0, 2.5), fov=0.5, orthographic=True)
    slab = in_positions(what, box("/slab", (1, 1, width / 2), 1), cameras=(lens,))
    once = np.array([0.9, 0.6, 0.3]) ** (width / 0.5)
    for cut, expected in ((DIRECT, once), (0.0, 0.96 * once / (1 - 0.04 * once))):
        picture = draw(slab, 8, 8, cut=cut)
        np.testing.assert_allclose(picture["path_length"], width, rtol=1e-4)
        np.testing.assert_allclose(picture["transmittance"], np.broadcast_to(expected, (8, 8, 3)), rtol=1e-4)


def test_a_thin_pane_tints_by_the_length_of_the_way_through_it() -> None:
    """Colour ^ (1 / cos t), with sin t = sin i / n: thickness and absorption distance of thin are the same 5 mm."""
    pane = quad("/pane", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], 1)
    lens = camera((1.5, 0.5, 1.5), (0, 0, 0))
    picture = draw(in_positions(glass(Model.THIN, TRANSMITTANCE=(0.8, 0.5, 0.2)), pane, cameras=(lens,)))
    _, d = view_rays(lens, 64, 64)
    cos_t = np.sqrt(1 - (1 - d[..., 2] ** 2) / 1.5**2)[..., None]
    here = picture["mask"] > 0
    assert here.mean() > 0.8
    expected = np.array([0.8, 0.5, 0.2]) ** (1 / cos_t)
    np.testing.assert_allclose(picture["transmittance"][here], expected[here], rtol=1e-4)


# --- Bending --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [Model.BOX, Model.TRACED])
def test_a_slab_shifts_and_does_not_turn(model: Model) -> None:
    """Exit parallel to entry, displaced along the face by t (tan i - tan t) (Hecht, Optics, 4.4)."""
    width, ior = 0.5, 1.5
    lens = camera((1.2, 0.4, 2.2), (0, 0, 0), fov=0.2)
    what = in_positions(glass(model, ior, THICKNESS=width), box("/slab", (2, 2, width / 2), 1), cameras=(lens,))
    picture = draw(what, 48, 48, cut=DIRECT)
    assert (picture["mask"] > 0).all()
    origin, d = view_rays(lens, 48, 48)
    cos_i = -d[..., 2]
    flat = d * [1, 1, 0] / np.linalg.norm(d[..., :2], axis=-1, keepdims=True)
    sin_i = np.sqrt(1 - cos_i**2)
    tan_t = sin_i / ior / np.sqrt(1 - (sin_i / ior) ** 2)
    entry = origin + d * ((width / 2 - origin[..., 2:]) / d[..., 2:])
    leave = entry + flat * (width * tan_t)[..., None] - [0, 0, width]
    np.testing.assert_allclose(where(picture["refraction"]), wall_hit(leave, d), atol=2e-4)
    shift = width * (sin_i / cos_i - tan_t)
    straight = wall_hit(origin, d)
    assert np.abs(straight - wall_hit(leave, d)).max() > 0.1  # the shift is there to be seen
    assert shift.min() > 0.05


def test_one_interface_sends_light_from_its_own_point() -> None:
    """Snell once, then straight to the wall, whatever the body is like behind the surface (Arm): its far side, which
    is there to be met, does nothing."""
    ior = 1.5
    lens = camera((1.2, 0.4, 2.2), (0, 0, 0), fov=0.2)
    what = in_positions(glass(Model.SINGLE, ior), box("/slab", (2, 2, 0.25), 1), cameras=(lens,))
    picture = draw(what, 48, 48, cut=DIRECT)
    origin, d = view_rays(lens, 48, 48)
    entry = origin + d * ((0.25 - origin[..., 2:]) / d[..., 2:])
    inside = d / ior  # Snell: what lies along the face is divided by n; the rest follows from the length, 1
    inside[..., 2] = -np.sqrt(1 - inside[..., 0] ** 2 - inside[..., 1] ** 2)
    np.testing.assert_allclose(where(picture["refraction"]), wall_hit(entry, inside), atol=2e-4)
    assert (picture["path_length"] == 0.0).all()
    assert (picture["layers"] == 1).all()


@pytest.mark.parametrize("depth", [0.3, 1.0])
def test_a_pool_seen_through_one_interface_is_the_traced_pool(depth: float) -> None:
    """Light that ends on the ground before it could leave meets one interface, whatever the model: water over a floor
    is where Arm's model is exact. Straight down the ground is at 1 / n of its depth (Hecht, Optics, 5.2)."""
    ior = 4 / 3
    water = box("/water", (ROOM + 0.5, depth / 2 + 0.25, ROOM + 0.5), 1, centre=(0, -ROOM + depth / 2 - 0.25, 0))
    for lens in (camera((0.5, 1.0, 2.0), (0, -ROOM, 0), fov=0.3), camera((0, 2, 0), (0, -ROOM, 0), fov=0.02)):
        one, real = (
            draw(in_positions(glass(model, ior), water, cameras=(lens,)), 32, 32, tiers=("ray",), cut=DIRECT)
            for model in (Model.SINGLE, Model.TRACED)
        )
        np.testing.assert_allclose(one["beauty"], real["beauty"], atol=1e-5)
        np.testing.assert_allclose(where(one["refraction"])[..., 1], -ROOM, atol=1e-4)
    place = where(one["refraction"])[..., 0]
    apart = 2 * 0.02 / 32 * (2 + ROOM - depth + depth / ior)  # of pixels, at the depth that seems to be
    np.testing.assert_allclose(np.abs(np.diff(place, axis=1)), apart, rtol=1e-3)


def test_arms_preset_is_one_interface_and_a_corrected_cubemap() -> None:
    """A ball in a room with a probe whose proxy is the room, against the closed form: from the ball's surface along the
    refracted ray to the wall. What stands behind the ball, of glass too, is not there, and the ball absorbs nothing."""
    preset = named_settings(preset="arm")
    engine = {"caustics": 0, "emission_light": False, "studio": "none"}
    assert preset == {"model": "single", "tiers": ("probe", "sky"), "max_layers": 1, **engine}
    walls, materials = position_room()
    stuff = glass(Model.TRACED, 1.5, TRANSMITTANCE=0.2, absorption_distance=0.1)
    other = box("/behind", (0.5, 0.5, 0.2), 1, centre=(0, 0, -1.5))
    ball = Sphere("/ball", (0.3, -0.2, 0.4), 0.8, 1)
    what = scene([*walls, other], [*materials, stuff], [ball], probes=(surrounding(),))
    picture = draw(what, 96, 96, cut=DIRECT, **preset)
    origin, d = view_rays(camera(), 96, 96)
    to = np.array(ball.centre) - origin
    along = (to * d).sum(-1)
    inside = ball.radius**2 - (to**2).sum(-1) + along**2
    point = origin + d * (along - np.sqrt(np.maximum(inside, 0)))[..., None]
    n = (point - ball.centre) / ball.radius
    cos_i = -(d * n).sum(-1)
    here = (inside > 0) & (cos_i > 0.2)
    assert here.mean() > 0.2
    assert (picture["weight.probe"][here] > 1 - 1e-5).all()
    out = [snell(ray, up, 1 / 1.5) for ray, up in zip(d[here], n[here], strict=True)]
    error = np.linalg.norm(where(picture["refraction"][here]) - wall_hit(point[here], np.array(out)), axis=-1)
    assert error.max() < 2 * ROOM / 64  # a texel of the probe, where two faces of it meet
    assert np.median(error) < 1e-3


def test_the_sphere_model_is_the_traced_exit_of_a_sphere() -> None:
    """Thickness = diameter, by rays, in a checkered room: within 1/255 where the ray does not graze (cos i > 0.3). The
    model knows no reflections inside, so they are left out."""
    walls, materials, textures = checker_room()
    pictures = []
    for model in (Model.SPHERE, Model.TRACED):
        ball = replace(BALL, material=6)
        what = scene(walls, [*materials, glass(model, THICKNESS=1.6)], [ball], textures=textures)
        pictures.append(draw(what, 96, 96, cut=DIRECT))
    a, b = pictures
    _, d = view_rays(camera(), 96, 96)
    here = (a["mask"] > 0) & ((-d * a["N"]).sum(-1) > 0.3)
    assert here.mean() > 0.2
    assert np.abs(a["beauty"] - b["beauty"])[here].max() < 1 / 255
    np.testing.assert_allclose(a["path_length"][here], b["path_length"][here], atol=1e-4)


@pytest.mark.parametrize(
    "settings",
    [
        {"tiers": ("screen",)},
        {"tiers": ("screen", "ray"), "screen": "march"},
        {"tiers": ("screen", "probe"), "screen": "proxy"},
    ],
)
def test_a_marble_shows_the_room_upside_down(settings: dict[str, Any]) -> None:
    """Behind its focus (n r / (2 (n - 1)) = 1.2 m from the centre) a ball shows the far wall turned by 180 degrees:
    the place seen moves left while the pixel moves right, and down while it moves up."""
    ball = Sphere("/ball", (0.0, 0.0, 0.5), 0.8, 1)
    picture = draw(in_positions(glass(Model.SPHERE, THICKNESS=1.6), ball), 96, 96, **settings)
    middle = np.s_[40:56, 40:56]
    assert picture["weight.screen"][middle].min() > 0.9
    place = where(picture["beauty"][middle])
    assert (np.diff(place[..., 0], axis=1) < 0).mean() > 0.95
    assert (np.diff(place[..., 1], axis=0) > 0).mean() > 0.95
    straight = where(draw(in_positions(glass(Model.SPHERE)), 96, 96)["beauty"][middle])
    assert (np.diff(straight[..., 0], axis=1) > 0).all()
    assert (np.diff(straight[..., 1], axis=0) < 0).all()


def test_a_mirror_angle_reflects_the_share_that_fresnel_says() -> None:
    """A black-backed view: reflection = F(cos i) times the radiance of the room, which is 1."""
    walls, materials = constant_room()
    lens = camera((2.0, 0.3, 1.0), (0, 0, 0))
    pane = quad("/pane", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], 1)
    picture = draw(scene([*walls, pane], [*materials, glass(Model.THIN, 1.8)], cameras=(lens,)))
    _, d = view_rays(lens, 64, 64)
    here = picture["mask"] > 0
    cos_i = np.abs(d[..., 2])[here]
    cos_t = np.sqrt(1 - (1 - cos_i**2) / 1.8**2)
    rs = (cos_i - 1.8 * cos_t) / (cos_i + 1.8 * cos_t)
    rp = (1.8 * cos_i - cos_t) / (1.8 * cos_i + cos_t)
    np.testing.assert_allclose(picture["reflection"][here][:, 0], (rs**2 + rp**2) / 2, atol=1e-4)


# --- Layers ---------------------------------------------------------------------------------------------------------


def test_glass_behind_glass_needs_a_second_layer() -> None:
    """A clear pane before a green block: with one layer the block is missing, with two its colour is there."""
    walls, materials = constant_room()
    pane = quad("/pane", [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)], 1)
    block = box("/block", (0.5, 0.5, 0.25), 2)
    green = glass(Model.BOX, 1.0, THICKNESS=0.5, TRANSMITTANCE=(0.25, 1.0, 0.25), absorption_distance=0.5)
    what = scene([*walls, pane, block], [*materials, glass(Model.THIN, 1.0), green])
    one, two = (draw(what, tiers=("screen", "ray"), max_layers=n) for n in (1, 2))
    np.testing.assert_allclose(one["beauty"][32, 32, :3], 1.0, atol=1e-4)
    # The block's middle is crossed straight: 0.5 m at an absorption distance of 0.5 m. n = 1 reflects nothing.
    np.testing.assert_allclose(two["beauty"][32, 32, :3], [0.25, 1.0, 0.25], atol=2e-3)
    assert (one["layers"].max(), two["layers"].max()) == (1, 2)


@pytest.mark.parametrize("opacity", [0.0, 0.3, 1.0])
def test_opacity_is_how_much_of_the_surface_colour_is_left(opacity: float) -> None:
    """Emissive glass of ior 1 in a room of radiance 1: opacity times its own light, the rest the room's."""
    walls, materials = constant_room()
    what = scene([*walls, CUBE], [*materials, glass(Model.TRACED, 1.0, OPACITY=opacity, EMISSIVE=3.0)])
    picture = draw(what)
    here = picture["mask"] > 0
    np.testing.assert_allclose(picture["beauty"][here][:, 0], 3 * opacity + (1 - opacity), atol=1e-4)


def test_dispersion_spreads_red_and_blue_around_green() -> None:
    """n_F > n_d > n_C: through a prism blue is turned most, red least, and green as without dispersion."""
    tilted = box("/wedge", (0.6, 0.6, 0.6), 1, turned((0, 1, 0), 20))
    angle = math.radians(70)
    points = tilted.points.copy()
    points[:, 2] = np.where(points[:, 2] < 0, points[:, 2] + math.cos(angle) * points[:, 0], points[:, 2])
    wedge = replace(tilted, points=points)
    plain = draw(in_positions(glass(Model.TRACED), wedge))["refraction"]
    spread = draw(in_positions(glass(Model.TRACED, abbe=20.0), wedge))["refraction"]
    np.testing.assert_allclose(spread[..., 1], plain[..., 1], atol=1e-5)
    assert np.abs(spread[..., 0] - plain[..., 0]).max() > 1e-3


@pytest.mark.parametrize("dispersive", [range(1, 12), [8], [9]], ids=["all but the first", "one", "the other"])
def test_dispersion_belongs_to_the_face_that_is_hit(dispersive: Any) -> None:
    """Two glasses on one mesh, alike but for the Abbe number. Faces 8 and 9 are the front: each pixel of the two shows
    what a mesh wholly of the glass it enters would show, whatever the other faces are made of."""
    cube = box("/cube", (0.6, 0.6, 0.6), 1, turned((1, 2, 0), 20))
    plain, spread = glass(Model.TRACED), glass(Model.TRACED, abbe=20.0)
    materials = np.ones(12, np.int32)
    materials[list(dispersive)] = 2
    walls, base = position_room()

    def drawn(of: Any) -> F32:
        return draw(scene([*walls, replace(cube, materials=of)], [*base, plain, spread]))["refraction"]

    mixed, none, whole = drawn(materials), drawn(np.ones(12, np.int32)), drawn(np.full(12, 2, np.int32))
    through = np.abs(whole - none).max(-1) > 1e-3
    as_whole, as_none = (mixed == whole).all(-1), (mixed == none).all(-1)
    assert (as_whole | as_none).all()
    assert (through & as_whole).sum() > 10
    assert (through & as_none).any() == (len(dispersive) == 1)
