"""The engine against a second opinion: random scenes, pixel by pixel, every plane (`oracle`, `random_scenes`).

The oracle computes in double precision without an acceleration structure; the engine's rays and hits are float32. So a
pixel may differ where the picture itself is unsteady: the edge of a thing, of a shadow, of total reflection, of a texel
that is repeated, seen directly or through glass. Such a pixel is let pass only if the oracle's own answer changes by
half of the difference when it looks a thousandth of a pixel aside, or less, or if something that counts in it hangs
on the last digits: a ray that has met so many interfaces that none is left, a weight that is just at the cut, an angle
just at total reflection (`Pixel.unsure`); and no more than one pixel in fifty may need that.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from oracle import Oracle, Pixel
from random_scenes import random_scene, with_bent_normals
from scenes import box, camera, glass, light, material, position_room, quad, scene, turned

import refract_core as rc
from refract_core.scene import Channel, LightKind, Material, Model, Param, Probe, Scene, Source, Volume, Wrap

pytestmark = pytest.mark.draws

F32 = NDArray[np.float32]

WIDTH, HEIGHT = 16, 12
ALONE: dict[str, Any] = {"jobs": 1, "caustics": 0, "emission_light": False}
"""What the oracle knows: light that neither glass nor what glows brings to other things."""
SCENES = 60
_NUDGES = [
    (r * math.cos(k * math.pi / 4), r * math.sin(k * math.pi / 4)) for r in (1e-4, 1e-3) for k in range(8)
]
"""Of a pixel, which is 0.1 m wide: the lesser as far aside as float32 moves a ray, some 1e-6 m, in a few interfaces."""
# Relative, and below 0.1 absolute.
_TOLERANCE, _SMALL = 1e-3, 0.1
_LENGTHS = ("path_length", "Z", "P")
_LENGTH_TOLERANCE = 5e-5  # [m]


def settings_of(seed: int) -> rc.RenderSettings:
    """Every order of the tiers the oracle knows, few surfaces or many, one sample or two, fine and coarse cuts (none at
    all grows trees that take the oracle hours), HDRP's unmeasured models, one model for all."""
    chosen: dict[str, Any] = {"tiers": (("ray", "sky"), ("ray", "sky"), ("sky",), ("ray",), ("sky", "ray"))[seed % 5]}
    chosen["samples"] = 2 if seed % 7 == 3 else 1
    chosen["max_layers"] = {5: 1, 7: 16}.get(seed % 11, 4)
    chosen["cut"] = (0.02, 0.002, 0.2)[seed % 3]
    chosen["screen"] = "proxy" if seed % 13 == 6 else "traced"
    chosen["exposure"] = 1.0 if seed % 17 == 8 else 0.0
    chosen["model"] = {9: "box", 10: "traced", 11: "thin", 12: "sphere", 13: "single"}.get(seed % 19, "")
    return rc.RenderSettings(image_width=WIDTH, image_height=HEIGHT, tolerance=0.0, studio="none", **ALONE, **chosen)


def scene_of(seed: int) -> Scene:
    """A pane that lies on a table is in one place with it, and nothing says which of them a ray in air meets first."""
    return random_scene(seed, standing=settings_of(seed).model != "thin")


def differences(mine: Pixel, planes: dict[str, F32], x: int, y: int, unit: float) -> dict[str, float]:
    """Planes in which a pixel is not what the oracle says, and by how much."""
    found = {}
    for name, expected in mine.planes.items():
        error, allowed = 0.0, 0.0
        for a, b in zip(expected, np.atleast_1d(planes[name][y, x]).tolist(), strict=True):
            if a == b:
                continue
            error = max(error, abs(a - b)) if math.isfinite(a - b) else math.inf
            allowed = max(allowed, _TOLERANCE * max(abs(a), _SMALL))
        if name in _LENGTHS:
            allowed = max(allowed, _LENGTH_TOLERANCE / unit)
        if error > allowed:
            found[name] = error
    return found


def is_unsteady(oracle: Oracle, x: int, y: int, mine: Pixel, off: dict[str, float]) -> bool:
    """Whether a thousandth of a pixel explains the differences."""
    beside = [oracle.pixel(x, y, nudge).planes for nudge in _NUDGES]
    for name, error in off.items():
        pairs = [zip(near[name], mine.planes[name], strict=True) for near in beside]
        change = max(0.0 if a == b else abs(a - b) for pair in pairs for a, b in pair)
        if not change >= 0.5 * error:
            return False
    return True


def compare(what: Scene, settings: rc.RenderSettings, width: int, height: int) -> tuple[list[str], int]:
    """What differs without an excuse, in words, and how many pixels have one."""
    planes = rc.render(what, settings).planes
    oracle = Oracle(what, settings, width, height)
    wrong, excused = [], 0
    for y in range(height):
        for x in range(width):
            mine = oracle.pixel(x, y)
            off = differences(mine, planes, x, y, what.metres_per_unit)
            if not off:
                continue
            if mine.unsure or is_unsteady(oracle, x, y, mine, off):
                excused += 1
                continue
            for name, error in off.items():
                said = [round(v, 5) for v in mine.planes[name]]
                wrong.append(f"({x}, {y}) {name}: engine {planes[name][y, x]}, oracle {said}, off by {error:.2g}")
    return wrong, excused


@pytest.mark.parametrize("seed", range(SCENES))
def test_the_engine_draws_what_the_oracle_sees(seed: int) -> None:
    wrong, excused = compare(scene_of(seed), settings_of(seed), WIDTH, HEIGHT)
    assert not wrong, f"{len(wrong)} differences, among them\n" + "\n".join(wrong[:12])
    assert excused <= WIDTH * HEIGHT / 50


def polished(m: Material) -> Material:
    """The same, but smooth if it is glass."""
    inputs = list(m.inputs)
    inputs[Param.ROUGHNESS] = Source((0.0,) * 4)
    return replace(m, inputs=tuple(inputs)) if m.refractive else m


def proxy_scene(seed: int) -> Scene:
    """Smooth glass, and a probe that lends a turned box, a sphere or infinity as proxy."""
    what = random_scene(seed)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = turned((1, 2, 3), 10.0 * seed), (0.05, 0.1, -0.2)
    everywhere = Volume(np.eye(4), False, (1e3, 1e3, 1e3))
    proxy = [Volume(turn, False, (2.0, 1.3, 1.8)), Volume(turn, True, (1.7, 1.7, 1.7)), None][seed % 3]
    probe = Probe("/probe", "realtime", (0.0, 0.0, 0.0), everywhere, proxy)
    return replace(what, materials=tuple(polished(m) for m in what.materials), probes=(probe,))


BY_PROXY = replace(settings_of(0), tiers=("screen", "ray", "sky"), screen="proxy", max_layers=1)
PROXY_SCENES = range(105, 114)


@pytest.mark.parametrize("seed", PROXY_SCENES)
def test_the_screen_by_proxy_is_what_the_oracle_finds_there(seed: int) -> None:
    """Place on the proxy, reprojection, foreground rule, edge fade, confidence. Reflections are marched for, so beauty
    and reflection are compared on opaque pixels only."""
    wrong, excused = compare(proxy_scene(seed), BY_PROXY, WIDTH, HEIGHT)
    assert not wrong, f"{len(wrong)} differences, among them\n" + "\n".join(wrong[:12])
    assert excused <= WIDTH * HEIGHT / 50


def test_the_screen_answers_in_most_of_its_scenes() -> None:
    answers = [rc.render(proxy_scene(seed), BY_PROXY).planes["weight.screen"].max() for seed in PROXY_SCENES]
    assert (np.array(answers) > 0.1).mean() > 0.7


def test_the_scenes_hold_something_of_everything() -> None:
    """The comparison is worth what its scenes show: every model, driven inputs of every kind, both workflows, ..."""
    scenes = [scene_of(seed) for seed in range(SCENES)]
    materials = [m for s in scenes for m in s.materials]
    sources = [source for m in materials for source in m.inputs]
    assert {m.model for m in materials} == set(Model)
    assert {m.specular_workflow for m in materials} == {True, False}
    assert any(m.abbe > 0 for m in materials)
    assert any(m.cutout and m.refractive for m in materials)
    assert any(m.cutout and not m.refractive for m in materials)
    for column in range(len(Param)):
        of = [m.inputs[column] for m in materials]
        assert any(s.texture >= 0 for s in of)
        assert column == Param.NORMAL or any(s.primvar for s in of)
    assert {w for s in sources if s.texture >= 0 for w in s.wrap} == set(Wrap)
    assert {s.channel for s in sources if s.texture >= 0} == set(Channel)
    assert {light.kind for s in scenes for light in s.lights} == {kind for kind in LightKind if kind.usd_type}
    lamps = [light for s in scenes for light in s.lights]
    shapings = [light.shaping for light in lamps]
    assert any(s.cone < 1.0 and s.softness == 0.0 for s in shapings)
    assert any(s.cone < 1.0 and s.softness == 1.0 for s in shapings)
    assert any(s.focus > 0.0 for s in shapings)
    assert {s.profile.shape[1] for s in shapings if s.profile is not None} == {1, 5}
    assert any(s.picture is not None for s in shapings)
    assert any(max(light.shadow.color) > 0.0 for light in lamps)
    assert any(light.shadow.falloff > 0.0 for light in lamps)
    assert {light.casts_shadow for light in lamps} == {True, False}
    assert any(light.lit is not None for light in lamps)
    assert any(light.casters is not None for light in lamps)
    assert {s.environment is None for s in scenes} == {True, False}
    assert {s.cameras[0].orthographic for s in scenes} == {True, False}
    assert len({m.priority for m in materials if m.refractive}) > 3
    glass = [[materials[m].refractive for m in set(mesh.materials.tolist())] for s in scenes for mesh in s.meshes]
    assert any(len(kinds) == 2 for kinds in glass)
    bodies = [(mesh.path, s.materials[mesh.materials[0]].model.name) for s in scenes for mesh in s.meshes]
    bodies += [(ball.path, s.materials[ball.material].model.name) for s in scenes for ball in s.spheres]
    expected = {"/outer": "TRACED SPHERE BOX", "/inner": "TRACED SPHERE BOX THIN NONE", "/overlap": "TRACED"}
    for place, models in expected.items():
        assert {model for path, model in bodies if path.startswith(place)} == set(models.split())
    depths = {len(Oracle(s, settings_of(0), WIDTH, HEIGHT).around) for s in scenes}
    assert depths == {0, 1, 2}
    assert any(s.cameras[0].orthographic for s in scenes if any(mesh.path.startswith("/around") for mesh in s.meshes))


@pytest.mark.parametrize("opacity", [0.25, 0.6])
def test_a_present_share_is_the_same_share_everywhere(opacity: float) -> None:
    """A card of partial presence before a wall: which rays it stops is a function of pixel and sample alone."""
    card = quad("/card", [(-0.9, -0.6, 0), (0.9, -0.6, 0), (0.9, 0.6, 0.1), (-0.9, 0.6, 0.1)], 0)
    wall = quad("/wall", [(-3, -3, -1), (3, -3, -1), (3, 3, -1), (-3, 3, -1)], 1)
    here = material("/card", EMISSIVE=(0.1, 0.6, 0.2), OPACITY=Source((opacity,) * 4), opacity_presence=True)
    there = material("/wall", EMISSIVE=(0.7, 0.1, 0.3))
    lens = camera((0.2, 0.3, 2.4), aspect=4 / 3)
    what = scene([card, wall], [here, there], cameras=(lens,))
    settings = rc.RenderSettings(image_width=24, image_height=18, samples=1, tiers=("ray",), studio="none", **ALONE)
    wrong, excused = compare(what, settings, 24, 18)
    assert not wrong, "\n".join(wrong[:12])
    assert excused <= 24 * 18 / 50


@pytest.mark.parametrize("seed", range(4))
def test_steep_normals_send_no_ray_to_the_wrong_side(seed: int) -> None:
    """Corner normals up to 60 degrees off, on glass seen directly and through a slab: where Snell's law or a mirror by
    the shading normal would leave light on the wrong side of a face, the true normal decides."""
    walls, materials = position_room()
    rng = np.random.default_rng(seed)
    slab = box("/slab", (1.5, 1.5, 0.05), 1, centre=(0, 0, 1.2))
    near = with_bent_normals(box("/near", (0.3, 0.3, 0.3), 2, turned((1, 2, 3), 40), (0.5, 0, 1.7)), 1.0, rng)
    far = with_bent_normals(box("/far", (0.5, 0.5, 0.5), 2, turned((3, 1, 2), 50), (-0.3, 0, 0)), 1.0, rng)
    glasses = [glass(Model.TRACED, 1.0), glass(Model.TRACED, 1.08)]
    what = scene([*walls, slab, near, far], [*materials, *glasses], cameras=(camera((0, 0.3, 2.6), aspect=4 / 3),))
    settings = rc.RenderSettings(image_width=24, image_height=18, samples=1, tiers=("ray",), studio="none", **ALONE)
    wrong, excused = compare(what, settings, 24, 18)
    assert not wrong, f"{len(wrong)} differences, among them\n" + "\n".join(wrong[:12])
    assert excused <= 24 * 18 / 50


def test_the_oracle_is_awake() -> None:
    """What the comparison must notice, it notices: a light one hundredth brighter than the oracle's."""
    floor = quad("/floor", [(-2, -1, 2), (2, -1, 2), (2, -1, -2), (-2, -1, -2)], 0)
    lamp = light(LightKind.RECT, (0, 2, 0), (0, -1, 0), (1.0, 1.0), 2.0)
    dim = scene([floor], [material("/grey", DIFFUSE=0.5)], lights=(lamp,))
    bright = replace(dim, lights=(replace(lamp, radiance=(2.02, 2.02, 2.02)),))
    settings = settings_of(0)
    planes = rc.render(bright, settings).planes
    oracle = Oracle(dim, settings, WIDTH, HEIGHT)
    noticed = [bool(differences(oracle.pixel(x, 10), planes, x, 10, 1.0)) for x in range(WIDTH)]
    assert all(noticed)
