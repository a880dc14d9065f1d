"""Six faces to and from flat layouts and files: what is copied stays, and every direction finds its own colour."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from refract_core.errors import ImageError, UsageError
from refract_core.images.cubemaps import read_cubemap, write_cubemap
from refract_core.images.layouts import LAYOUTS, arrange, face_directions, faces_of, halved, latlong_directions
from refract_core.scene import CUBE_LEVELS, F32, F64, Cubemap

AXES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def smooth(directions: F64) -> F32:
    """A colour for every direction, without two that look the same."""
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(d, -1, 0)
    colors = np.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.4 * z, 0.5 + 0.3 * x * y - 0.2 * z * z], -1)
    return colors.astype(np.float32)


def noise(resolution: int) -> F32:
    return np.random.default_rng(7).random((6, resolution, resolution, 5), np.float32)


def mirrored_by_hand(face: int, i: int, j: int, n: int) -> tuple[float, float, float]:
    """The contract of `scene.Cubemap`, written out once more."""
    x, y = (i + 0.5) / n * 2 - 1, (j + 0.5) / n * 2 - 1
    return ((1, -y, -x), (-1, -y, x), (x, 1, y), (x, -1, -y), (x, -y, 1), (-x, -y, -1))[face]


@pytest.mark.parametrize("n", [1, 2, 5])
def test_faces_look_where_the_contract_says(n: int) -> None:
    directions = face_directions(n)
    for face in range(6):
        for j in range(n):
            for i in range(n):
                assert directions[face, j, i] == pytest.approx(mirrored_by_hand(face, i, j, n))
    middle = face_directions(1)[:, 0, 0]
    assert middle == pytest.approx(np.array(AXES))


@pytest.mark.parametrize("layout", ["strip", "cross"])
@pytest.mark.parametrize("n", [1, 3, 8])
def test_strip_and_cross_come_back_exactly(layout: str, n: int) -> None:
    faces = noise(n)
    assert np.array_equal(faces_of(arrange(faces, layout), n), faces)


def test_sizes_of_the_layouts() -> None:
    shapes = {layout: arrange(noise(8), layout).shape for layout in LAYOUTS}
    assert shapes == {"strip": (48, 8, 5), "cross": (24, 32, 5), "latlong": (16, 32, 5)}


def test_a_strip_lies_or_stands() -> None:
    faces = noise(4)
    assert np.array_equal(faces_of(np.concatenate(list(faces), axis=1), 4), faces)
    assert np.array_equal(faces_of(np.concatenate(list(faces), axis=0), 4), faces)


def test_neighbours_in_a_cross_are_neighbours_in_the_world() -> None:
    n = 8
    cross = arrange(face_directions(n).astype(np.float32), "cross")
    cross /= np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), 1e-9)
    texel = 2.0 / n * 1.01
    row = cross[n : 2 * n]
    assert (np.linalg.norm(np.diff(row, axis=1), axis=-1) < texel).all()
    column = cross[:, n : 2 * n]
    assert (np.linalg.norm(np.diff(column, axis=0), axis=-1) < texel).all()


def test_an_upright_cross_joins_the_last_face_below() -> None:
    n = 8
    world = face_directions(n).astype(np.float32)
    upright = np.zeros((4 * n, 3 * n, 3), np.float32)
    upright[: 3 * n] = arrange(world, "cross")[:, : 3 * n]
    upright[3 * n :, n : 2 * n] = world[5, ::-1, ::-1]
    assert np.array_equal(faces_of(upright, n), world)
    column = upright[:, n : 2 * n] / np.linalg.norm(upright[:, n : 2 * n], axis=-1, keepdims=True)
    assert (np.linalg.norm(np.diff(column, axis=0), axis=-1) < 2.0 / n * 1.01).all()


def test_a_latlong_gives_every_direction_its_own_colour() -> None:
    latlong = smooth(latlong_directions(128, 256))
    for n in (16, 64, 128):
        assert faces_of(latlong, n) == pytest.approx(smooth(face_directions(n)), abs=4e-3)


def test_a_latlong_has_the_dome_lights_convention() -> None:
    """The formula is the one in `scene.Environment`."""
    x, y, z = np.moveaxis(latlong_directions(6, 12), -1, 0)
    assert 0.5 - np.arctan2(x, z) / (2 * np.pi) == pytest.approx(np.tile((np.arange(12) + 0.5) / 12, (6, 1)))
    assert np.arccos(y) / np.pi == pytest.approx(np.tile((np.arange(6)[:, None] + 0.5) / 6, 12))


def test_faces_of_a_latlong_with_one_bright_pixel_per_axis() -> None:
    """The middle of the picture is +Z, a quarter to the left +X, the top +Y (OpenEXR)."""
    latlong = np.zeros((32, 64, 1), np.float32)
    for row, column in ((15, 16), (15, 48), (15, 32), (15, 0)):
        latlong[row - 1 : row + 3, np.arange(column - 2, column + 2)] = 1.0 + column
    latlong[:3] = 100.0
    middle = faces_of(latlong, 15)[:, 7, 7, 0]
    assert middle == pytest.approx(np.array([17.0, 49.0, 100.0, 0.0, 33.0, 1.0]))


def test_poles_and_the_seam_of_a_latlong_are_smooth() -> None:
    """A texel at the pole or at -z looks at pixels from all sides of the picture."""
    faces = faces_of(smooth(latlong_directions(32, 64)), 32)
    assert faces == pytest.approx(smooth(face_directions(32)), abs=1e-2)


@pytest.mark.parametrize("n", [16, 32])
def test_there_and_back_over_a_latlong(n: int) -> None:
    faces = smooth(face_directions(n))
    assert arrange(faces, "latlong") == pytest.approx(smooth(latlong_directions(2 * n, 4 * n)), abs=6e-3)
    assert faces_of(arrange(faces, "latlong"), n) == pytest.approx(faces, abs=1e-2)


@pytest.mark.parametrize("layout", ["strip", "cross"])
@pytest.mark.parametrize(("n", "fewer"), [(8, 4), (9, 3), (10, 4), (7, 1)])
def test_shrinking_keeps_the_mean_of_every_face(layout: str, n: int, fewer: int) -> None:
    faces = noise(n)
    less = faces_of(arrange(faces, layout), fewer)
    assert less.mean(axis=(1, 2)) == pytest.approx(faces.mean(axis=(1, 2)), rel=1e-5)
    if n % fewer == 0:
        step = n // fewer
        assert less[0, 0, 0] == pytest.approx(faces[0, :step, :step].mean(axis=(0, 1)), rel=1e-5)


def test_a_checkered_latlong_averages_to_grey() -> None:
    """One sample per texel would give black and white."""
    j, i = np.mgrid[:256, :512]
    checker = ((i + j) % 2).astype(np.float32)[..., None]
    assert np.abs(faces_of(checker, 8) - 0.5).max() < 0.02


def test_a_fine_latlong_keeps_its_light() -> None:
    """Mean over the sphere of 0.5 + 0.4 y is 0.5, weighted by solid angle."""
    d = face_directions(8)
    solid = 1.0 / np.linalg.norm(d, axis=-1) ** 3
    faces = faces_of(smooth(latlong_directions(256, 512)), 8)
    mean = (faces * solid[..., None]).sum(axis=(0, 1, 2)) / solid.sum()
    assert mean[:3] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("layout", ["strip", "cross", "latlong"])
def test_growing_interpolates_without_seams(layout: str) -> None:
    small = arrange(smooth(face_directions(16)), layout)
    assert faces_of(small, 64) == pytest.approx(smooth(face_directions(64)), abs=2.5e-2)


def test_halves_are_averages_down_to_one_pixel() -> None:
    pixels = noise(6).reshape(36, 6, 5)
    half = halved(pixels)
    assert half.shape == (18, 3, 5)
    assert half[0, 0] == pytest.approx(pixels[:2, :2].mean(axis=(0, 1)), rel=1e-5)
    odd = halved(pixels[:5, :1])
    assert odd.shape == (2, 1, 5)
    assert odd.mean(axis=0) == pytest.approx(pixels[:5, :1].mean(axis=0), rel=1e-5)


@pytest.mark.parametrize("shape", [(10, 10), (5, 16), (4, 5), (7, 6), (0, 0)])
def test_other_shapes_are_named_and_the_layouts_listed(shape: tuple[int, int]) -> None:
    with pytest.raises(ImageError) as caught:
        faces_of(np.zeros((*shape, 3), np.float32), 8)
    if shape[0]:
        assert f"{shape[1]} x {shape[0]}" in str(caught.value)
        assert all(ratio in str(caught.value) for ratio in ("2:1", "1:6", "6:1", "4:3", "3:4"))


# --- files


def cubemap(resolution: int, levels: int = CUBE_LEVELS) -> Cubemap:
    """Noise that halves hold exactly, with distances beyond their precision; half of it is open to the sky."""
    rng = np.random.default_rng(3)
    made: list[F32] = []
    for level in range(levels):
        n = max(1, resolution >> level)
        texels = (rng.integers(0, 2048, (6, n, n, 5)) / 2048).astype(np.float32)
        texels[..., 3] = rng.integers(0, 2, (6, n, n))
        texels[..., :3] *= texels[..., 3:4]
        texels[..., 4] = (level + 1) / 3.0 * texels[..., 3]
        made.append(texels)
    return Cubemap(tuple(made))


def stored(path: Path, level: int = 0) -> Any:
    """A MIP level as any reader of textures sees it."""
    file: Any = oiio.ImageInput.open(str(path))
    pixels = file.read_image(0, level, 0, file.spec().nchannels, oiio.FLOAT)
    assert pixels is not None, file.geterror()
    file.close()
    return pixels


@pytest.mark.parametrize("resolution", [64, 128])
def test_a_strip_gives_every_level_back_as_it_was(tmp_path: Path, resolution: int) -> None:
    path = tmp_path / "a.exr"
    written = cubemap(resolution)
    write_cubemap(str(path), written, "strip")
    for source in (str(path), path.read_bytes()):
        read = read_cubemap(source, "a", resolution)
        assert len(read.levels) == CUBE_LEVELS
        assert read.resolution == resolution
        for one, other in zip(read.levels, written.levels, strict=True):
            assert np.array_equal(one, other)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_reader_of_textures_sees_tiles_names_and_mip_levels(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "a.exr"
    written = cubemap(64)
    write_cubemap(str(path), written, layout, {"refract:probe": "/World/Probe"})
    file: Any = oiio.ImageInput.open(str(path))
    spec = file.spec()
    assert tuple(spec.channelnames) == ("R", "G", "B", "A", "Z")
    assert [str(one) for one in spec.channelformats] == ["half"] * 4 + ["float"]
    assert spec.tile_width > 0
    assert spec.get_string_attribute("refract:layout") == layout
    assert spec.get_int_attribute("refract:levels") == CUBE_LEVELS
    assert spec.get_string_attribute("refract:probe") == "/World/Probe"
    width, height = spec.width, spec.height
    level = 0
    while file.seek_subimage(0, level):
        assert (file.spec().width, file.spec().height) == (max(1, width >> level), max(1, height >> level))
        level += 1
    assert level == int(np.log2(max(width, height))) + 1
    file.close()
    assert np.array_equal(stored(path, 2), arrange(written.levels[2], layout)) or layout == "latlong"
    smallest = stored(path, level - 1).ravel()
    assert smallest.size == 5
    assert 0.0 < smallest[4] <= CUBE_LEVELS / 3 + 1e-3


def test_equal_cubemaps_make_equal_files(tmp_path: Path) -> None:
    for name in ("a.exr", "b.exr"):
        write_cubemap(str(tmp_path / name), cubemap(32))
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


@pytest.mark.parametrize(("resolution", "levels"), [(100, CUBE_LEVELS), (8, CUBE_LEVELS), (64, 1)])
def test_a_chain_that_does_not_halve_gives_the_first_level_alone(tmp_path: Path, resolution: int, levels: int) -> None:
    path = tmp_path / "a.exr"
    written = cubemap(resolution, levels)
    write_cubemap(str(path), written)
    read = read_cubemap(str(path), "a", resolution)
    assert len(read.levels) == 1
    assert np.array_equal(read.levels[0], written.levels[0])


@pytest.mark.parametrize(("layout", "resolution"), [("cross", 64), ("cross", 16), ("strip", 32), ("latlong", 64)])
def test_our_other_layouts_and_sizes_are_resampled(tmp_path: Path, layout: str, resolution: int) -> None:
    path = tmp_path / "a.exr"
    texels = np.ones((6, 64, 64, 5), np.float32)
    texels[..., :3] = smooth(face_directions(64))[..., :3]
    texels[..., 4] = 0.1
    write_cubemap(str(path), Cubemap((texels,)), layout)
    read = read_cubemap(str(path), "a", resolution)
    assert len(read.levels) == 1
    assert read.levels[0][..., :3] == pytest.approx(smooth(face_directions(resolution))[..., :3], abs=6e-3)
    assert read.levels[0][..., 3] == pytest.approx(1.0)
    assert read.levels[0][..., 4] == pytest.approx(0.1)


def test_unknown_distances_do_not_shorten_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    texels = np.ones((6, 64, 64, 5), np.float32)
    texels[..., 4] = 7.0
    texels[:, ::2, :, 3:] = 0.0
    write_cubemap(str(path), Cubemap((texels,)))
    assert read_cubemap(str(path), "a", 16).levels[0][..., 3:] == pytest.approx(np.full((6, 16, 16, 2), (0.5, 7.0)))


def test_bright_colours_stay_finite(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    texels = np.full((6, 8, 8, 5), 1e6, np.float32)
    write_cubemap(str(path), Cubemap((texels,)))
    level = read_cubemap(str(path), "a", 8).levels[0]
    assert (level[..., :3] == 65504.0).all()
    assert (level[..., 4] == 1e6).all()


def save(path: Path, pixels: Any, kind: str, *, straight: bool = False) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.attribute("oiio:UnassociatedAlpha", int(straight))
    file: Any = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(pixels)
    file.close()


def test_anybodys_png_is_srgb_and_its_straight_alpha_is_coverage(tmp_path: Path) -> None:
    """sRGB 188 is linear 0.5 (IEC 61966-2-1)."""
    save(tmp_path / "a.png", np.full((16, 32, 4), (188, 188, 188, 51), np.uint8), "uint8", straight=True)
    read = read_cubemap(str(tmp_path / "a.png"), "a", 8)
    assert len(read.levels) == 1
    assert read.levels[0] == pytest.approx(np.full((6, 8, 8, 5), (0.1, 0.1, 0.1, 0.2, 0.0)), abs=1e-3)


def test_anybodys_exr_is_linear_and_premultiplied(tmp_path: Path) -> None:
    save(tmp_path / "a.exr", np.full((8, 48, 4), (0.5, 3.0, 0.0, 0.5), np.float32), "float")
    assert read_cubemap(str(tmp_path / "a.exr"), "a", 8).levels[0][0, 0, 0] == pytest.approx((0.5, 3.0, 0.0, 0.5, 0.0))
    save(tmp_path / "b.exr", np.full((8, 16, 3), (np.nan, np.inf, 1.0), np.float32), "float")
    assert read_cubemap(str(tmp_path / "b.exr"), "b", 4).levels[0][2, 1, 1] == pytest.approx((0, 65504, 1, 1, 0))


def test_what_cannot_be_read_or_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="my probe"):
        read_cubemap(str(tmp_path / "missing.exr"), "my probe", 8)
    with pytest.raises(ImageError, match="my probe"):
        read_cubemap(b"no picture", "my probe", 8)
    save(tmp_path / "square.png", np.zeros((8, 8, 3), np.uint8), "uint8")
    with pytest.raises(ImageError, match="my probe: 8 x 8"):
        read_cubemap(str(tmp_path / "square.png"), "my probe", 8)
    with pytest.raises(UsageError, match="strip, cross, latlong"):
        write_cubemap(str(tmp_path / "a.exr"), cubemap(8), "dice")
    with pytest.raises(UsageError, match=r"\.exr"):
        write_cubemap(str(tmp_path / "a.png"), cubemap(8))
    with pytest.raises(ImageError, match="cannot be written"):
        write_cubemap(str(tmp_path / "missing" / "a.exr"), cubemap(8))
    write_cubemap(str(tmp_path / "whole.exr"), cubemap(64))
    with pytest.raises(ImageError, match="damaged"):
        read_cubemap((tmp_path / "whole.exr").read_bytes()[:9000], "damaged", 64)


def test_a_failure_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.exr"
    path.write_bytes(b"old")

    def full(_self: Path, _data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ImageError, match="No space left"):
        write_cubemap(str(path), cubemap(8))
    monkeypatch.undo()
    assert os.listdir(tmp_path) == ["a.exr"]
    assert path.read_bytes() == b"old"
