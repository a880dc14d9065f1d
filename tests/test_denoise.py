"""The planes that a denoiser reads, and pictures without their noise."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import F32, box, camera, constant_room, dome, draw, glass, light, material, quad, scene
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import UsageError
from refract_core.images import denoise
from refract_core.images.pictures import read_planes
from refract_core.scene import LightKind, Material, Mesh, Model, Sphere, Texture
from refract_core.scene import Source as Input

SAMPLE = str(Path(__file__).parents[1] / "usd_samples" / "good" / "marble.usda")
WALL = quad("/wall", [(-3, -3, -1), (3, -3, -1), (3, 3, -1), (-3, 3, -1)], 0)
PANE = box("/pane", (2.0, 2.0, 0.05), 1, centre=(0, 0, 1))
_ODD = np.kron(np.indices((4, 4)).sum(0) % 2, np.ones((64, 64)))[..., None]
CHECKERS = Texture("checkers", np.where(_ODD == 1, [0.8, 0.5, 0.2, 1.0], [0.1, 0.1, 0.1, 1.0]).astype(np.float32))


def installed() -> bool:
    try:
        return bool(metadata.version("pyoidn"))
    except metadata.PackageNotFoundError:
        return False


needs_oidn = pytest.mark.skipif(not installed(), reason="the extra `denoise` is not installed")


def before_a_wall(meshes: tuple[Mesh, ...], kinds: tuple[Material, ...], **fields: Any) -> rc.Scene:
    """A checkered wall, square to the camera, and what stands before it."""
    painted = material("/wall", DIFFUSE=Input(texture=0, uv_primvar="st"))
    return scene([WALL, *meshes], [painted, *kinds], textures=(CHECKERS,), environment=dome(0.25), **fields)


def features(what: rc.Scene, width: int = 32, height: int = 32, **settings: Any) -> tuple[F32, F32]:
    planes = draw(what, width, height, features=True, **settings)
    return planes["albedo"], planes["denoising_normal"]


# --- the planes -----------------------------------------------------------------------------------------------------


def test_albedo_of_what_is_opaque_is_its_texture() -> None:
    """Pixel by pixel: the wall fills the picture, and each pixel's middle lies within one square."""
    albedo, normal = features(before_a_wall((), ()))
    reach = 3.5 * 0.5  # half the height of the wall that is seen
    x = reach * (2 * (np.arange(32) + 0.5) / 32 - 1)
    square = np.floor((x + 3.0) / 6.0 * 4).astype(int)
    odd = (square[None, :] + square[::-1, None]) % 2  # rows go down, t goes up; four squares: parity is kept
    near = np.abs((x + 3.0) / 6.0 * 4 - np.round((x + 3.0) / 6.0 * 4)) < 0.15  # filtered there
    clear = ~(near[:, None] | near[None, :])
    expected = np.where(odd[..., None] == 1, [0.8, 0.5, 0.2], [0.1, 0.1, 0.1])
    either = [np.abs(albedo - expected)[clear].max(), np.abs(albedo - expected[::-1])[clear].max()]
    assert min(either) < 1e-3
    np.testing.assert_allclose(normal, np.broadcast_to([0.0, 0.0, 1.0], normal.shape), atol=1e-6)


def test_a_metal_has_what_it_mirrors_and_a_lamp_its_own_light_up_to_one() -> None:
    gold = material("/wall", DIFFUSE=(0.9, 0.6, 0.2), METALLIC=1.0, ROUGHNESS=0.0)
    bright = material("/wall", DIFFUSE=0.3, EMISSIVE=(0.5, 4.0, 0.0))
    for kind, expected in ((gold, (0.9, 0.6, 0.2)), (bright, (0.8, 1.0, 0.3))):
        albedo, _ = features(scene([WALL], [kind], environment=dome(0.25)), 4, 4)
        np.testing.assert_allclose(albedo, np.broadcast_to(expected, albedo.shape), rtol=1e-6)


def test_where_nothing_is_there_is_nothing() -> None:
    away = camera((0, 0, 2.5), (0, 0, 9))
    albedo, normal = features(replace(before_a_wall((), ()), environment=None, cameras=(away,)))
    assert not albedo.any()
    assert not normal.any()


@pytest.mark.parametrize("model", [Model.TRACED, Model.BOX, Model.THIN])
def test_glass_of_ior_one_changes_neither(model: Model) -> None:
    bare = features(before_a_wall((), ()), samples=4)
    behind = features(before_a_wall((PANE,), (glass(model, 1.0, THICKNESS=0.1),)), samples=4)
    for one, other in zip(bare, behind, strict=True):
        np.testing.assert_allclose(other, one, atol=2e-3)


def test_albedo_is_tinted_by_the_glass_and_normals_are_not() -> None:
    """Beer and Lambert over the thickness of the pane; square to it, which the middle of the picture is."""
    tint = (0.9, 0.5, 0.2)
    pane = glass(Model.TRACED, 1.0, TRANSMITTANCE=tint, absorption_distance=0.2)
    what = scene([WALL, PANE], [material("/wall", DIFFUSE=0.6), pane], cameras=(camera(fov=0.01),))
    albedo, normal = features(what, 5, 5)
    np.testing.assert_allclose(albedo[2, 2], 0.6 * np.sqrt(tint), rtol=1e-3)
    np.testing.assert_allclose(normal[2, 2], (0, 0, 1), atol=1e-6)


def test_both_branches_count_by_their_light() -> None:
    """A pane before a black wall mirrors what is behind the camera: two surfaces, each with Fresnel's share."""
    behind = quad("/behind", [(3, -3, 4), (-3, -3, 4), (-3, 3, 4), (3, 3, 4)], 2)
    kinds = [material("/wall"), glass(Model.TRACED, 3.0), material("/behind", DIFFUSE=1.0)]
    albedo, normal = features(scene([WALL, PANE, behind], kinds, cameras=(camera(fov=0.01),)), 5, 5, cut=0.0)
    once = ((3.0 - 1.0) / (3.0 + 1.0)) ** 2
    both = 2 * once / (1 + once)  # of a pane, all its reflections together
    assert math.isclose(albedo[2, 2, 0], both, abs_tol=0.1)  # branches below a tenth go with their siblings
    assert albedo[2, 2, 0] > once
    np.testing.assert_allclose(normal[2, 2, 2], 1 - 2 * albedo[2, 2, 0], atol=1e-6)


def test_frosted_glass_stands_for_itself() -> None:
    rough = glass(Model.TRACED, 1.5, ROUGHNESS=0.6)
    albedo, normal = features(before_a_wall((PANE,), (rough,)), 8, 8)
    np.testing.assert_allclose(albedo, 1.0)
    np.testing.assert_allclose(normal, np.broadcast_to([0.0, 0.0, 1.0], normal.shape), atol=1e-6)


def test_the_planes_come_when_asked_for_and_change_nothing_else() -> None:
    what = before_a_wall((PANE,), (glass(Model.TRACED),))
    plain, asked = draw(what, 32, 24, samples=4), draw(what, 32, 24, samples=4, features=True)
    assert set(asked) - set(plain) == {"albedo", "denoising_normal"}
    for name, plane in plain.items():
        np.testing.assert_array_equal(plane, asked[name])


def test_the_planes_are_the_same_for_any_workers_and_tiles() -> None:
    what = before_a_wall((PANE,), (glass(Model.TRACED),))
    one = features(what, 70, 50, samples=4)
    for jobs, side in ((3, 8), (2, 64)):
        for a, b in zip(one, features(what, 70, 50, samples=4, jobs=jobs, tile_size=side), strict=True):
            np.testing.assert_array_equal(a, b)


# --- pictures without noise ----------------------------------------------------------------------------------------


def noisy(seed: int = 0) -> tuple[F32, F32, F32, F32]:
    """A picture of two flat surfaces with noise on it, and what is known of it."""
    truth = np.full((96, 128, 3), 0.1, np.float32)
    truth[:, 64:] = (0.8, 0.5, 0.2)
    grain = np.random.default_rng(seed).gamma(4.0, 0.25, truth.shape).astype(np.float32)
    normal = np.zeros_like(truth)
    normal[..., 2] = 1.0
    return truth, truth * grain, truth, normal


@needs_oidn
def test_noise_goes_and_edges_stay() -> None:
    truth, color, albedo, normal = noisy()
    quiet = denoise.denoised(color, albedo, normal)
    before, after = (float(np.sqrt(np.mean(((x - truth) / truth) ** 2))) for x in (color, quiet))
    assert after < before / 5


@needs_oidn
@pytest.mark.parametrize("level", [1e-3, 0.5, 30.0])
@pytest.mark.parametrize("size", [(1, 1), (5, 9), (64, 80)])
def test_a_constant_picture_stays(level: float, size: tuple[int, int]) -> None:
    flat = np.full((*size, 3), level, np.float32)
    normal = np.zeros_like(flat)
    normal[..., 2] = 1.0
    np.testing.assert_allclose(denoise.denoised(flat, np.full_like(flat, 0.5), normal), flat, rtol=0.01)


@needs_oidn
def test_a_lamp_that_is_seen_stays_as_it_is() -> None:
    """To its very edge, which is brighter than white; the wall around it loses its noise."""
    truth, color, albedo, normal = noisy()
    color, albedo = color.copy(), albedo.copy()
    lamp = np.s_[30:50, 40:60]
    color[lamp], albedo[lamp] = 17.0, 1.0
    quiet = denoise.denoised(color, albedo, normal)
    np.testing.assert_array_equal(quiet[lamp], color[lamp])
    assert np.abs(quiet - truth)[60:, :60].mean() < np.abs(color - truth)[60:, :60].mean() / 4


@needs_oidn
@pytest.mark.parametrize("shared", [False, True])
def test_bits_do_not_depend_on_threads(shared: bool) -> None:
    _, color, albedo, normal = noisy()
    one = denoise.denoised(color, albedo, normal, 1, shared=shared)
    for jobs in (2, 3, 0):
        np.testing.assert_array_equal(denoise.denoised(color, albedo, normal, jobs, shared=shared), one)


@needs_oidn
def test_noise_that_neighbours_share_goes_when_they_are_taken_apart() -> None:
    """As in a picture that is made from corners: every pixel is the mean of four, and a corner is in four pixels."""
    truth, color, albedo, normal = noisy()
    grain = np.pad(1 + (color / truth - 1) / 8, ((0, 1), (0, 1), (0, 0)), "edge")
    shared: F32 = (truth * (grain[:-1, :-1] + grain[1:, :-1] + grain[:-1, 1:] + grain[1:, 1:]) / 4).astype(np.float32)
    quiet = [denoise.denoised(shared, albedo, normal, shared=told) for told in (False, True)]
    left = [float(np.mean((one / truth - 1) ** 2)) for one in quiet]
    assert left[1] < 0.8 * left[0]


@needs_oidn
def test_only_the_picture_changes_and_not_its_alpha() -> None:
    lamp = light(LightKind.RECT, (0, 1.5, 1.0), (0, -0.5, -1), (1.0, 1.0), 8.0)
    what = replace(before_a_wall((PANE,), (glass(Model.TRACED),)), environment=None, lights=(lamp,))
    ball = Sphere("/ball", (0.3, 0.0, -0.4), 0.3, 0)
    what = replace(what, spheres=(ball,), cameras=(camera(fov=1.2),))
    raw, quiet = draw(what, 48, 48, light_samples=1), draw(what, 48, 48, light_samples=1, denoise=True)
    assert set(raw) == set(quiet)
    for name in set(raw) - {"beauty"}:
        np.testing.assert_array_equal(raw[name], quiet[name])
    np.testing.assert_array_equal(raw["beauty"][..., 3], quiet["beauty"][..., 3])
    assert (raw["beauty"] != quiet["beauty"]).any()


@needs_oidn
def test_a_denoised_picture_is_the_same_for_any_workers() -> None:
    what = before_a_wall((PANE,), (glass(Model.TRACED),))
    one = draw(what, 70, 50, samples=4, denoise=True)["beauty"]
    many = draw(what, 70, 50, samples=4, denoise=True, jobs=3, tile_size=8)["beauty"]
    np.testing.assert_array_equal(one, many)


@needs_oidn
def test_an_even_room_stays_even() -> None:
    """Glass in a room of one radiance cannot be seen, denoised or not, but for what a network leaves of its normals."""
    walls, kinds = constant_room(0.5)
    ball = Sphere("/ball", (0.0, 0.0, 0.0), 0.8, 1)
    picture = draw(scene(walls, [*kinds, glass(Model.TRACED)], [ball]), 64, 64, denoise=True)["beauty"]
    np.testing.assert_allclose(picture[..., :3], 0.5, rtol=0.04)
    assert math.isclose(float(picture[..., :3].mean()), 0.5, rel_tol=0.003)


# --- asking for it --------------------------------------------------------------------------------------------------


@pytest.fixture
def without_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "files", absent)
    denoise._file.cache_clear()


@pytest.fixture(autouse=True)
def looked_for_anew() -> Any:
    yield
    denoise._file.cache_clear()


@pytest.mark.usefixtures("without_extra")
def test_without_the_extra_one_sentence_says_what_to_install(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"pip install 'usd-refract\[denoise\]'"):
        draw(before_a_wall((), ()), 4, 4, denoise=True)
    found = CliRunner().invoke(app, ["render", SAMPLE, str(tmp_path / "x.png"), "-w", "8", "--denoise"])
    assert found.exit_code == 2
    assert "--denoise needs the extra `denoise`: pip install 'usd-refract[denoise]'" in " ".join(found.output.split())
    assert not list(tmp_path.iterdir())


def described(file: str) -> Any:
    """OpenImageIO's description of a file."""
    import OpenImageIO as oiio

    opened: Any = oiio.ImageInput.open(file)
    return opened.spec()


def test_files_hold_the_planes_that_are_named(tmp_path: Path) -> None:
    small = ["-w", "16", "--samples", "1", "--caustics", "off"]
    named, whole = str(tmp_path / "named.exr"), str(tmp_path / "all.exr")
    for file, more in ((named, ["--aovs", "beauty,albedo,denoising_normal"]), (whole, [])):
        assert CliRunner().invoke(app, ["render", SAMPLE, file, *small, *more]).exit_code == 0
    assert set(read_planes(named)) == {"beauty", "albedo", "denoising_normal"}
    assert "albedo" not in read_planes(whole)


@needs_oidn
def test_a_file_says_that_it_was_denoised(tmp_path: Path) -> None:
    file = str(tmp_path / "quiet.exr")
    found = CliRunner().invoke(app, ["render", SAMPLE, file, "-w", "16", "--quality", "draft", "--denoise"])
    assert found.exit_code == 0
    assert described(file).getattribute("refract:denoised") == "Open Image Denoise"
