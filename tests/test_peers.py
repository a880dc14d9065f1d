"""The benchmark beside a path tracer: its rooms, its arithmetic, and, where Mitsuba is installed, its truth."""

from __future__ import annotations

import importlib.util
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import refract_core as rc
from benchmarks import in_mitsuba, peers
from benchmarks.curves import Needed, Point, needed, svg, times_faster
from benchmarks.in_mitsuba import Light
from benchmarks.in_refract import looking, scene_of
from benchmarks.truth import CHUNK, Truth, converged
from benchmarks.two_rooms import ROOMS, Finish, Room, Solid
from refract_core.errors import UsageError
from refract_core.scene import F32
from refract_core.verbs.compare import displayed, psnr

SIZE = 96


@pytest.fixture(params=list(ROOMS))
def room(request: pytest.FixtureRequest) -> Room:
    return ROOMS[request.param]()


def volume(solid: Solid) -> float:
    """By the divergence theorem [m^3]: positive where triangles face outwards."""
    a, b, c = np.moveaxis(solid.points.astype(np.float64)[solid.triangles], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6.0)


def drawn(room: Room, **settings: Any) -> F32:
    frame = rc.render(scene_of(room), rc.RenderSettings(image_width=SIZE, jobs=1, **settings))
    assert not frame.notices
    return frame.planes["beauty"][..., :3]


# --- The rooms ------------------------------------------------------------------------------------------------------


def test_glass_is_closed_and_faces_outwards(room: Room) -> None:
    """Every edge has a partner in the other direction; what a body holds is positive, hollow or not."""
    glass = [solid for solid in room.solids if solid.finish.glass]
    assert len(glass) >= 4
    for solid in glass:
        order = solid.triangles.astype(np.int64)
        edges = np.concatenate([order[:, [0, 1]], order[:, [1, 2]], order[:, [2, 0]]])
        codes, back = (edge[:, 0] * len(solid.points) + edge[:, 1] for edge in (edges, edges[:, ::-1]))
        assert len(np.unique(codes)) == len(codes)
        assert set(codes.tolist()) == set(back.tolist())
        assert volume(solid) > 0.0


def test_normals_lean_the_way_that_triangles_face(room: Room) -> None:
    for solid in room.solids:
        if solid.normals is not None:
            a, b, c = np.moveaxis(solid.points[solid.triangles], 1, 0)
            facing = np.cross(b - a, c - a)
            assert (np.einsum("ti,tki->tk", facing, solid.normals[solid.triangles]) > 0.0).all()


def test_the_eye_looks_at_its_target(room: Room) -> None:
    m = looking(room.eye)
    np.testing.assert_allclose(m[:3, :3] @ m[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(m[:3, :3]) == pytest.approx(1.0)
    towards = np.array(room.eye.target) - room.eye.place
    np.testing.assert_allclose(-m[:3, 2], towards / np.linalg.norm(towards), atol=1e-12)


def test_a_digest_changes_with_every_number(room: Room) -> None:
    solid = room.solids[-1]
    moved = solid._replace(points=solid.points + np.float32(1e-3))
    painted = solid._replace(finish=Finish(albedo=(0.1, 0.2, 0.3)))
    others = [room._replace(solids=(*room.solids[:-1], other)) for other in (moved, painted)]
    others += [room._replace(sky=(9.0, 9.0, 9.0)), room._replace(eye=room.eye._replace(half_height=0.1))]
    assert len({one.digest() for one in (room, *others)}) == 5
    assert room.digest() == ROOMS[room.name]().digest()


def test_ours_draw_the_rooms(room: Room) -> None:
    """Nothing burns out but the lamp in glass, nothing is black, and no notice complains."""
    shown = displayed(drawn(room, samples=1))
    assert (shown.max(-1) == 1.0).mean() < 0.02
    assert 0.3 < shown.mean() < 0.8


def test_every_level_is_settings() -> None:
    for level in (*peers.LEVELS.values(), peers.BEST[1]):
        rc.RenderSettings(**level)


# --- The arithmetic -------------------------------------------------------------------------------------------------


CURVE = [Point("c", 10.0, 40.0), Point("a", 0.1, 20.0), Point("b", 1.0, 30.0)]
"""Ten times the seconds for every 10 dB."""


@pytest.mark.parametrize(("decibels", "seconds"), [(25.0, 10**-0.5), (30.0, 1.0), (37.0, 10**0.7)])
def test_between_its_points_a_curve_is_straight_in_log_seconds(decibels: float, seconds: float) -> None:
    found = needed(CURVE, decibels)
    assert found.seconds == pytest.approx(seconds)
    assert not found.at_most


def test_beyond_its_points_a_curve_says_nothing_or_at_most() -> None:
    assert needed(CURVE, 15.0) == Needed(0.1, True)
    assert math.isnan(needed(CURVE, 41.0).seconds)
    assert math.isnan(needed([], 10.0).seconds)


def test_a_curve_that_falls_back_has_been_there() -> None:
    """More samples may be worse; the first time counts."""
    assert needed([*CURVE, Point("d", 100.0, 25.0)], 40.0).seconds == pytest.approx(10.0)


def test_ratios_say_what_they_do_not_know() -> None:
    known, early, never = Needed(2.0), Needed(2.0, True), Needed(math.nan)
    slow = Needed(50.0)
    assert [times_faster(a, b) for a, b in ((known, slow), (early, slow), (slow, early), (early, early))] == [
        "25", ">25", "<0.04", "~1",
    ]  # fmt: skip
    assert times_faster(never, known) == times_faster(known, never) == "-"


def test_a_chart_holds_every_point() -> None:
    tree = ElementTree.fromstring(svg("a < b", {"ours": CURVE, "theirs": [Point("x", 3.0, 33.0)]}))
    dots = tree.findall(".//{*}circle")
    assert len(dots) == 4
    x, y = (np.array([float(dot.attrib[key]) for dot in dots]) for key in ("cx", "cy"))
    assert x[1] - x[0] == pytest.approx(x[2] - x[1], abs=0.2)  # sorted by seconds: decades
    assert y[0] - y[1] == pytest.approx(y[1] - y[2], abs=0.2)
    assert "a < b" in {text.text for text in tree.findall(".//{*}text")}


def test_the_noise_of_a_mean_is_half_of_what_parts_its_halves() -> None:
    """Two grey pictures, 0.2 apart as displayed: the mean is 0.1 from each, which is 20 dB."""
    encoded = np.array([0.4, 0.6])
    linear = ((encoded + 0.055) / 1.055) ** 2.4
    halves = np.broadcast_to(linear[:, None, None, None], (2, 4, 4, 3))
    truth = Truth(halves, np.ones((4, 4), np.float32), 2)
    assert truth.noise(np.ones((4, 4), np.bool_)) == pytest.approx(20.0, abs=1e-4)


def test_regions_part_the_picture() -> None:
    share = np.zeros((20, 30), np.float32)
    share[:, :6] = 0.01
    straight = np.full((20, 30, 3), 0.5)
    world = straight.copy()
    world[:, 15:] *= 1.1
    two, three = peers.regions_of(share, straight, None), peers.regions_of(share, straight, world)
    assert list(two) == ["glass", "elsewhere"]
    assert list(three) == ["glass", "untouched", "touched"]
    for found in (two, three):
        assert (np.sum(list(found.values()), 0) == 1).all()
        assert (found["glass"] == (share > 0.0)).all()
    assert three["untouched"][:, 6:13].all()
    assert three["touched"][:, 13:].all()  # the window reaches two pixels out


def test_a_race_counts_no_first_turn_and_takes_medians() -> None:
    turns: list[int] = []

    def picture(turn: int) -> F32:
        turns.append(turn)
        return np.full((4, 4, 3), 0.1 * turn, np.float32)

    truth = np.full((4, 4, 3), 0.2)
    regions = {"all": np.ones((4, 4), np.bool_)}
    entrants = [peers.Entrant(name, "x", picture, truth) for name in ("one", "two")]
    runs = peers.race(entrants, regions, 3)
    assert turns == [0, 0, 1, 1, 2, 2, 3, 3]
    assert [run.program for run in runs] == ["one", "two"]
    expected = sorted(psnr(displayed(np.full((4, 4, 3), 0.1 * t)), displayed(truth)) for t in (1, 2, 3))[1]
    assert runs[0].scores["all"] == pytest.approx(expected, abs=1e-4)
    assert runs[0].seconds >= 0.0


# --- Beside Mitsuba -------------------------------------------------------------------------------------------------


needs_mitsuba = pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="mitsuba is not installed")


def test_without_mitsuba_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    with pytest.raises(UsageError, match=r"pip install 'usd-refract\[bench\]'"):
        in_mitsuba.library()


@pytest.fixture(scope="module")
def mi() -> Any:
    """Mitsuba compiled by LLVM."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("mitsuba is not installed")
    try:
        return in_mitsuba.library()
    except UsageError as error:
        pytest.skip(str(error))


@needs_mitsuba
def test_an_unknown_variant_is_refused() -> None:
    with pytest.raises(UsageError, match="no variant 'metal'"):
        in_mitsuba.library("metal")


def test_our_way_through_glass_is_that_of_the_path_integrator(mi: Any) -> None:
    """In the emissive room, where Mitsuba's own `path` looks for lights in vain."""
    loaded = in_mitsuba.load(mi, ROOMS["emissive"](), SIZE)
    stock = np.array(mi.render(loaded.scene, integrator=in_mitsuba.path(mi), spp=256, seed=3))
    found = in_mitsuba.draw(loaded, Light.STRAIGHT, 256, 4)
    assert psnr(displayed(found), displayed(stock)) > 36.0  # noise, of both
    np.testing.assert_allclose(found.mean((0, 1)), stock.mean((0, 1)), rtol=2e-3)


def test_direct_light_is_that_of_the_path_integrator(mi: Any) -> None:
    """Without glass, `path` of two edges sees direct light alone."""
    lit = ROOMS["lit"]()
    bare = lit._replace(solids=tuple(solid for solid in lit.solids if not solid.finish.glass))
    loaded = in_mitsuba.load(mi, bare, SIZE)
    stock = np.array(mi.render(loaded.scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=64, seed=3))
    for light in (Light.STRAIGHT, Light.WORLD):
        found = in_mitsuba.draw(loaded, light, 64, 4)
        np.testing.assert_allclose(found.mean((0, 1)), stock.mean((0, 1)), rtol=3e-3)


def test_glass_covers_the_same_pixels_in_both(mi: Any, room: Room) -> None:
    share = in_mitsuba.glass_share(in_mitsuba.load(mi, room, SIZE), 64)
    frame = rc.render(scene_of(room), rc.RenderSettings(image_width=SIZE, samples=16, jobs=1))
    apart = frame.planes["mask"] - share  # along edges, by how few samples find them
    assert abs(apart.mean()) < 0.001
    assert np.abs(apart).max() < 0.4


def test_both_see_the_same_where_there_is_no_glass(mi: Any, room: Room) -> None:
    loaded = in_mitsuba.load(mi, room, SIZE)
    bare = in_mitsuba.glass_share(loaded, 64) == 0.0
    theirs = in_mitsuba.draw(loaded, Light.STRAIGHT, 256, 5)
    assert psnr(displayed(drawn(room, samples=16)), displayed(theirs), bare) > 26.0


def test_more_samples_are_added_to_a_truth(mi: Any, tmp_path: Path) -> None:
    """Bit for bit what one run with all of them finds, in a file that a changed room does not find."""
    room = ROOMS["emissive"]()
    loaded = in_mitsuba.load(mi, room, SIZE)
    told: list[float] = []

    def truth(folder: str, samples: int, of: Room = room) -> Truth:
        return converged(of, Light.STRAIGHT, loaded, samples, tmp_path / folder, lambda done, _: told.append(done))

    assert truth("steps", 1).samples == 2 * CHUNK
    more, at_once = truth("steps", 4 * CHUNK), truth("once", 4 * CHUNK)
    assert more.samples == at_once.samples == 4 * CHUNK
    np.testing.assert_array_equal(more.halves, at_once.halves)
    assert told
    told.clear()
    np.testing.assert_array_equal(truth("steps", CHUNK).halves, more.halves)
    assert not told
    truth("steps", 1, room._replace(eye=room.eye._replace(half_height=0.3)))
    assert told


def test_a_small_run_prints_everything(mi: Any, room: Room, tmp_path: Path) -> None:
    options = peers.Options(SIZE, tuple(peers.LEVELS)[:1], (1, 4), CHUNK, 1, 1, tmp_path)
    found = peers.measure(mi, room, options)
    lines = peers.report(room, found, options)
    rows = [line.split(",")[0] for line in lines]
    assert rows.count("Mitsuba") == 2
    assert rows.count("Mitsuba path") == (2 if room.lamp is not None else 0)
    assert any("times faster" in line for line in lines)
    by_name = {(run.program, run.name): run for run in found.runs}
    assert by_name["Mitsuba", "4 spp"].scores["glass"] > by_name["Mitsuba", "1 spp"].scores["glass"]
    assert ("all glass does" in "".join(lines)) == (room.lamp is not None)


def test_a_lit_room_needs_a_compiled_variant() -> None:
    """Last, for it changes the variant of the process."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("mitsuba is not installed")
    with pytest.raises(UsageError, match="lit room needs an llvm variant"):
        in_mitsuba.load(in_mitsuba.library("scalar_rgb"), ROOMS["lit"](), SIZE)
