"""A part of a picture is bit by bit that part of the whole picture, whatever reaches it from elsewhere; parts join."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import camera, light, material, quad, scene, turned
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import UsageError
from refract_core.kernels import lanes
from refract_core.kernels.lanes import new_lanes
from refract_core.scene import LightKind, Scene
from refract_core.view.camera import Tile
from refract_core.view.crop import window_of
from refract_core.view.quiet import QuietScratch
from refract_core.world.embree import Packet

GOOD = Path(__file__).parents[1] / "usd_samples" / "good"
WAYS: dict[str, dict[str, Any]] = {
    "as it comes": {},
    "every pixel sampled": {"tolerance": 0.0, "samples": 3},
    "one sample": {"samples": 1},
    "hdrp": {"screen": "proxy", "tiers": ("screen", "probe", "sky"), "max_layers": 1, "samples": 2},
    "marched": {"screen": "march"},
    "rays alone": {"tiers": ("ray", "sky")},
    "light from walls": {"indirect": "one"},
}
SIZE = (150, 107)


@cache
def scene_of(name: str) -> Scene:
    return rc.load_stage(GOOD / f"{name}.usda")


def asked(**values: Any) -> rc.RenderSettings:
    return rc.RenderSettings(**{"image_width": SIZE[0], "image_height": SIZE[1], "caustics": 4096, **values})


def as_bits(plane: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(plane).view(np.uint32)


def assert_part(whole: rc.Frame, part: rc.Frame, window: Tile) -> None:
    x0, y0, x1, y1 = window
    assert part.place == (x0, y0, whole.width, whole.height)
    assert (part.width, part.height) == (x1 - x0, y1 - y0)
    for name, plane in whole.planes.items():
        differs = (as_bits(plane[y0:y1, x0:x1]) != as_bits(part.planes[name])).sum()
        assert differs == 0, f"{differs} numbers of {name}"


@pytest.mark.parametrize("way", WAYS)
def test_a_part_is_that_part_of_the_whole_picture(way: str) -> None:
    dice, session = random.Random(way), rc.Session()
    names = ("marble", "glass_behind_glass") if way == "as it comes" else ("two_probes",)
    for name in names:
        scene = scene_of(name)
        whole = rc.render(scene, asked(**WAYS[way]), session=session)
        assert (whole.planes["mask"] > 0.0).any()
        assert whole.place is None
        for _ in range(4):
            x0, y0 = dice.randrange(SIZE[0] - 1), dice.randrange(SIZE[1] - 1)
            window = x0, y0, dice.randrange(x0 + 1, SIZE[0]) + 1, dice.randrange(y0 + 1, SIZE[1]) + 1
            crop = tuple(float(at) for at in window)
            assert_part(whole, rc.render(scene, asked(**WAYS[way], crop=crop), session=session), window)


def soiled(record: Any, left: float) -> Any:
    """A thread's working memory as others may have left it, all but what Embree is told to do."""
    for field in record:
        if not isinstance(field, np.ndarray):
            soiled(field, left)
        elif not isinstance(record, Packet):
            field[...] = left if field.dtype.kind == "f" or math.isfinite(left) else 3
    return record


def half_shadows_at_the_edge() -> Scene:
    """Slanting half shadows, two to eight pixels wide, that run over the end of the floor and that of the picture."""
    turn = turned((0, 1, 0), 40)
    bars = [
        quad(f"/bar{k}", np.array([(x, 0.5, 9), (x + 0.3, 0.5, 9), (x + 0.3, 0.5, -9), (x, 0.5, -9)]) @ turn.T)
        for k, x in enumerate(np.arange(-2.0, 2.0, 0.5))
    ]
    floor = quad("/floor", [(-9, 0, 9), (0.9, 0, 9), (0.9, 0, -9), (-9, 0, -9)])
    lamps = [light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (width, 0.0), 1.0) for width in (0.1, 0.3)]
    lens = camera((0, 0.4, 0), (0, 0, 0), fov=1.0, orthographic=True)
    return scene([floor, *bars], [material("/white", DIFFUSE=1.0)], lights=tuple(lamps), cameras=(lens,))


def soiled_scene(name: str) -> Scene:
    return half_shadows_at_the_edge() if name == "half shadows" else scene_of(name)


@cache
def clean_picture_of(name: str) -> rc.Frame:
    return rc.render(soiled_scene(name), asked())


@pytest.mark.parametrize("left", [-1.0, 1.0, math.nan])
@pytest.mark.parametrize("name", ["half shadows", "two_probes", "glass_behind_glass"])
def test_what_a_thread_has_left_behind_is_not_seen(name: str, left: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which thread draws which tile is chance: a kernel that read what the last tile left would draw by chance, too."""
    clean = clean_picture_of(name)
    made = []

    def new(record: type, count: int = lanes.LANES) -> Any:
        made.append(record)
        return soiled(new_lanes(record, count), left)

    monkeypatch.setattr(lanes, "new_lanes", new)
    for plane, values in rc.render(soiled_scene(name), asked()).planes.items():
        assert np.array_equal(as_bits(values), as_bits(clean.planes[plane])), plane
    assert QuietScratch in made


def test_a_part_through_a_lens_that_blurs_is_that_part_too() -> None:
    scene = scene_of("marble")
    camera = replace(scene.cameras[0], lens_radius=0.02, focus_distance=0.5)
    scene = replace(scene, cameras=(camera, *scene.cameras[1:]))
    window = 41, 37, 90, 70
    whole = rc.render(scene, asked(samples=2))
    assert_part(whole, rc.render(scene, asked(samples=2, crop=tuple(map(float, window)))), window)


def test_where_no_glass_is_the_rest_of_the_picture_is_not_drawn() -> None:
    """What a corner of the picture costs, in rays, hangs on what is there: glass asks all of the picture."""
    scene = scene_of("marble")
    wide = asked(image_width=640, image_height=360, caustics=0)
    whole = rc.render(scene, wide)
    glass = np.argwhere(whole.planes["mask"] > 0.0)
    assert len(glass)
    top = int(glass[:, 0].min())
    assert top > 70, "the sample has no glass in its upper corner"
    part = rc.render(scene, asked(image_width=640, image_height=360, caustics=0, crop=(0.0, 0.0, 64.0, 32.0)))
    assert_part(whole, part, (0, 0, 64, 32))
    assert float(part.metadata["refract:rays"]) < 0.25 * float(whole.metadata["refract:rays"])


# --- which pixels --------------------------------------------------------------------------------------------------


@given(st.integers(1, 400), st.integers(1, 300), st.integers(1, 7), st.integers(1, 7))
def test_tiles_cover_every_pixel_once(width: int, height: int, columns: int, rows: int) -> None:
    seen = np.zeros((height, width), int)
    if columns > width or rows > height:
        with pytest.raises(UsageError, match="tile_count"):
            window_of(asked(tile_count=(columns, rows)), width, height)
        return
    for index in range(columns * rows):
        x0, y0, x1, y1 = window_of(asked(tile_count=(columns, rows), tile_index=index), width, height)
        assert x1 > x0
        assert y1 > y0
        seen[y0:y1, x0:x1] += 1
    assert (seen == 1).all()


@given(st.lists(st.floats(0.001, 0.999), max_size=4), st.integers(10, 500))
def test_shares_that_touch_share_no_pixel(cuts: list[float], width: int) -> None:
    edges = [0.0, *sorted(set(cuts)), 1.0]
    count = 0
    for low, high in pairwise(edges):
        if math.ceil(low * width) == math.ceil(high * width):
            with pytest.raises(UsageError, match="holds no pixel"):
                window_of(asked(crop=(low, 0.0, high, 1.0)), width, 10)
            continue
        window = window_of(asked(crop=(low, 0.0, high, 1.0)), width, 10)
        assert window[0] == count
        count = window[2]
    assert count == width


def test_pixels_count_from_the_upper_left() -> None:
    assert window_of(asked(crop=(2.0, 3.0, 40.0, 50.0)), 100, 100) == (2, 3, 40, 50)
    assert window_of(asked(crop=(0.0, 0.0, 0.5, 0.25)), 100, 100) == (0, 0, 50, 25)
    assert window_of(asked(crop=(0.0, 0.0, 1.0, 1.0)), 100, 100) == (0, 0, 100, 100)


# --- files -----------------------------------------------------------------------------------------------------------

MARBLE = GOOD / "marble.usda"
SMALL = ("-w", "160", "--samples", "4", "--caustics", "off")


def refract(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


def pixels_of(path: Path, k: int = 0) -> np.ndarray:
    """As they are stored, of the data window."""
    kind = oiio.UINT8 if path.suffix == ".png" else oiio.FLOAT
    return np.asarray(oiio.ImageBuf(str(path), k, 0).get_pixels(kind))


def spec_of(path: Path, k: int = 0) -> Any:
    return oiio.ImageBuf(str(path), k, 0).spec()


@pytest.mark.parametrize("extension", ["exr", "png"])
def test_joined_tiles_are_the_whole_picture(tmp_path: Path, extension: str) -> None:
    mattes = ("--cryptomatte", "object") if extension == "exr" else ()
    for index in range(6):
        words = ("--tile-count", 3, 2, "--tile-index", index, *mattes)
        code, said = refract("render", MARBLE, tmp_path / f"part.{index}.{extension}", *words, *SMALL)
        assert code == 0, said
    parts = sorted(tmp_path.glob("part.*"), reverse=True)
    assert len(parts) == 6
    code, said = refract("join", tmp_path / f"joined.{extension}", *parts)
    assert code == 0, said
    assert refract("render", MARBLE, tmp_path / f"whole.{extension}", *mattes, *SMALL)[0] == 0
    whole, joined = (tmp_path / f"{name}.{extension}" for name in ("whole", "joined"))
    own = "refract:rays", "refract:seconds", "oiio:SourcePath"
    count = oiio.ImageBuf(str(whole)).nsubimages
    assert count == oiio.ImageBuf(str(joined)).nsubimages
    assert (count > 1) == (extension == "exr")
    for k in range(count):
        assert pixels_of(whole, k).tobytes() == pixels_of(joined, k).tobytes()
        specs = [spec_of(path, k) for path in (whole, joined)]
        assert specs[0].channelnames == specs[1].channelnames
        assert specs[0].format == specs[1].format
        assert specs[1].getattribute("refract:place") is None
        told = [{a.name: a.value for a in spec.extra_attribs if a.name not in own} for spec in specs]
        assert told[0] == told[1]


def test_an_exr_has_its_part_in_the_display_window(tmp_path: Path) -> None:
    code, said = refract("render", MARBLE, tmp_path / "p.exr", "--crop", "10,20,50,60", *SMALL)
    assert code == 0, said
    spec = spec_of(tmp_path / "p.exr")
    assert (spec.x, spec.y, spec.width, spec.height) == (10, 20, 40, 40)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 160, 90)
    code, said = refract("render", MARBLE, tmp_path / "p.jpg", "--crop", "0.1,0.2,0.5,0.6", *SMALL)
    assert code == 0, said
    assert pixels_of(tmp_path / "p.jpg").shape[:2] == (36, 64)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--crop", "a,b"), "--crop is 'a,b'"),
        (("--crop", "0,0,1"), "--crop is (0.0, 0.0, 1.0)"),
        (("--crop=-1,0,1,1",), "--crop is (-1.0"),
        (("--crop", "0.5,0,0.5,1"), "--crop is 0.5,0,0.5,1, which holds no pixel"),
        (("--crop", "0,0,900,10"), "--crop is 0,0,900,10, but the picture has 160 x 90"),
        (("--crop", "0,0,10.5,10"), "whole pixels"),
        (("--tile-count", "2", "2"), "--tile-count and --tile-index go together"),
        (("--tile-count", "2", "2", "--tile-index", "4"), "--tile-index is 4; it must be between 0 and 3"),
        (("--tile-count", "0", "2", "--tile-index", "0"), "--tile-count is 0"),
        (("--tile-count", "200", "2", "--tile-index", "0"), "--tile-count is 200 by 2, but the picture has 160 x 90"),
        (("--tile-count", "2", "2", "--tile-index", "0", "--crop", "0,0,1,1"), "give one of them"),
    ],
)
def test_a_part_that_cannot_be_is_said_in_one_sentence(tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    code, output = refract("render", MARBLE, tmp_path / "out.png", *words, *SMALL)
    assert code == 2
    assert said in output
    assert list(tmp_path.iterdir()) == []


def part(path: Path, *, place: tuple[int, int, int, int], size: tuple[int, int] = (4, 4), light: float = 0.5) -> Path:
    planes = {"beauty": np.full((size[1], size[0], 4), light, np.float32)}
    rc.Frame(*size, planes, place=place).save(path)  # type: ignore[arg-type]
    return path


def test_what_does_not_fit_together_is_not_joined(tmp_path: Path) -> None:
    out, left = tmp_path / "out.exr", part(tmp_path / "left.exr", place=(0, 0, 8, 4))
    right = part(tmp_path / "right.exr", place=(4, 0, 8, 4))
    assert refract("join", out, left, right)[0] == 0
    out.unlink()
    wrong = {
        "parts are missing: 50.0 % of the picture, pixel 4,0 first": (left,),
        "is part of 9 x 4 pixels": (left, part(tmp_path / "a.exr", place=(4, 0, 9, 4))),
        "has other pixels than a part before it": (left, part(tmp_path / "b.exr", place=(0, 0, 8, 4), light=0.25)),
        "lies outside": (left, part(tmp_path / "c.exr", place=(6, 0, 8, 4))),
        "no part that refract drew": (MARBLE.with_suffix(".png"), ),
        "is no .exr": (left, MARBLE.with_suffix(".png")),
        "gone.exr: there is no such file": (left, tmp_path / "gone.exr"),
    }
    for said, parts in wrong.items():
        target = out if parts[0].suffix == ".exr" else tmp_path / "out.png"
        code, output = refract("join", target, *parts)
        assert code in (1, 2)
        assert said in output
        assert not target.exists()
    assert "joined from and to" in refract("join", tmp_path / "out.jpg", left)[1]
