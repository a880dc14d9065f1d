"""The measurements that write pages: their tables from numbers made up here, and each part once, very small."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

import refract_core as rc
from benchmarks import accuracy, instanced, loading, pages, peers, performance
from benchmarks.frame import Warm
from refract_core.errors import RefractError
from refract_core.scene import Light, LightKind
from refract_core.verbs.compare import displayed, psnr

pytestmark = pytest.mark.draws

TINY = accuracy.Options(width=32, reference_samples=4, jobs=1)


def row(name: str, glass: float, rays: float = 44.0) -> accuracy.Row:
    scores = {level: accuracy.Score(glass, 50.0, 1.25) for level in accuracy.LEVELS}
    return accuracy.Row(name, scores, rays)


# --- Blocks of pages ------------------------------------------------------------------------------------------------


def test_a_block_replaces_what_stood_under_its_name_and_nothing_else() -> None:
    text = "a\n<!-- x -->\nold\nlines\n<!-- end of x -->\nb\n<!-- y -->\n<!-- end of y -->\nc\n"
    put = pages.put(pages.put(text, "x", "new"), "y", "more\nlines")
    assert put == "a\n<!-- x -->\nnew\n<!-- end of x -->\nb\n<!-- y -->\nmore\nlines\n<!-- end of y -->\nc\n"
    assert pages.put(put, "x", "new") == put
    assert pages.block_of(put, "y") == "more\nlines"


@pytest.mark.parametrize("text", ["", "<!-- x -->\n", "<!-- end of x -->\n<!-- x -->\n", "<!-- x -->\n" * 2])
def test_a_page_without_a_place_is_told(text: str) -> None:
    with pytest.raises(ValueError, match="no place for 'x'"):
        pages.put(text, "x", "new")


def test_a_page_is_left_alone_if_one_place_is_missing(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- x -->\n<!-- end of x -->\n", "utf-8")
    with pytest.raises(ValueError, match="no place for 'y'"):
        pages.write(page, {"x": "new", "y": "new"})
    assert "new" not in page.read_text("utf-8")


def test_every_measurement_has_its_place() -> None:
    for name in performance.PARTS:
        pages.block_of(performance.PAGE.read_text("utf-8"), name)
    for name in ("samples", "assets"):
        pages.block_of(accuracy.PAGE.read_text("utf-8"), name)
    for name in ("frame", "cold", "peers", "accuracy"):
        pages.block_of(pages.README.read_text("utf-8"), name)


# --- Accuracy -------------------------------------------------------------------------------------------------------


def test_who_is_low_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(accuracy.REASONS, "murky", "it is murky.")
    rows = [row("clear", 35.0), row("murky", 34.9), row("odd", 20.0)]
    told = accuracy.table(rows).splitlines()
    assert [line.split()[1:3] for line in told[2:5]] == [["`clear`", "|"], ["`murky`", "*"], ["`odd`", "*"]]
    assert "- `murky`: it is murky." in told
    assert accuracy.unexplained(rows) == ["odd"]
    assert "Below" not in accuracy.table(rows[:1])


def test_what_is_no_number_is_a_word() -> None:
    cells = accuracy.table([accuracy.Row("all", {k: accuracy.Score(math.inf, math.nan, 0.5) for k in accuracy.LEVELS},
                                         math.inf)]).splitlines()[2]  # fmt: skip
    assert cells.count("same / -") == 3
    assert "0.50 / 0.50 / 0.50" in cells


def test_the_summary_counts() -> None:
    said = accuracy.summary([row("a", 30.0), row("b", 40.0), row("c", 50.0)])
    assert "Of 3 samples, 2 have 35 dB" in said
    assert "lowest 30.0 dB, median 40.0 dB" in said


def test_glass_that_is_measured_is_the_stages_own() -> None:
    found = accuracy.measure(accuracy.Stage("marble", accuracy.SAMPLES / "marble.usda"), TINY)
    assert list(found.scores) == list(accuracy.LEVELS)
    assert all(15.0 < score.glass < 80.0 and score.seconds > 0.0 for score in found.scores.values())
    assert found.rays > 15.0


def test_only_stages_that_show_glass_are_found_among_other_peoples(tmp_path: Path) -> None:
    """Through folders, in any format; what cannot be read is told, and left out."""
    (tmp_path / "in").mkdir()
    preview = accuracy.SAMPLES / "preview_surface.usda"
    for part in ("parts", "textures"):
        (tmp_path / "in" / part).symlink_to(accuracy.SAMPLES / part, target_is_directory=True)
    shutil.copy(preview, tmp_path / "in" / "glass.usda")
    (tmp_path / "plain.usda").write_text('#usda 1.0\ndef Sphere "ball"\n{\n}\n', "utf-8")
    (tmp_path / "broken.usda").write_text("no stage", "utf-8")
    (tmp_path / "notes.txt").write_text("glass", "utf-8")
    assert [one.name for one in accuracy.assets(tmp_path)] == ["in/glass.usda"]


def test_the_page_names_every_sample_and_no_reason_is_missing() -> None:
    for name in ("samples", "assets"):
        block = pages.block_of(accuracy.PAGE.read_text("utf-8"), name)
        assert accuracy.UNKNOWN not in block, "run `python -m benchmarks.accuracy --write`"
        if name == "samples":
            assert {stage.name for stage in accuracy.samples() if f"| `{stage.name}`" not in block} == set()


def test_a_stage_that_is_not_there_is_an_error() -> None:
    with pytest.raises(RefractError):
        accuracy.measure(accuracy.Stage("none", Path("none.usda")), TINY)


# --- Performance ----------------------------------------------------------------------------------------------------


def test_a_cut_lamp_fills_the_place_of_the_whole_one() -> None:
    """Area, centre and the middles of its parts; what they light is lit as before."""
    turned = np.eye(4)
    turned[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    turned[:3, 3] = (1.0, 2.0, 3.0)
    lamp = Light("/lamp", LightKind.RECT, (1.0, 2.0, 3.0), turned, (2.0, 1.0))
    parts = performance.cut(lamp, 4)
    assert len({part.path for part in parts}) == len(parts) == 16
    assert sum(part.size[0] * part.size[1] for part in parts) == pytest.approx(2.0)
    places = np.array([part.world_from_light[:3, 3] for part in parts])
    np.testing.assert_allclose(places.mean(0), (1.0, 2.0, 3.0))
    np.testing.assert_allclose(np.ptp(places, axis=0), (0.0, 1.5, 0.75))  # its x is the world's y, its y the world's z
    assert {part.radiance for part in parts} == {lamp.radiance}


def test_many_lights_draw_the_picture_of_the_one() -> None:
    settings = rc.RenderSettings(image_width=48, jobs=1)
    one, many = (displayed(rc.render(performance.lamps(k), settings).planes["beauty"][..., :3]) for k in (1, 2))
    assert psnr(many, one) > 35.0


def test_turns_are_fair_and_the_first_does_not_count() -> None:
    called: list[str] = []
    found = performance.by_turns({name: lambda name=name: called.append(name) for name in "ab"}, 2)  # type: ignore[misc]
    assert called == ["a", "b"] * 3
    assert list(found) == ["a", "b"]


def test_tables_of_performance() -> None:
    frames = {("room_of_checkers", "`good`"): Warm((640, 360), (0.5, 0.4, 0.9), 2_000_000, 0.2)}
    whole = performance.frame_table(frames, short=False)
    assert "640 x 360 | 0.50 s | 2.0 M | 4.0 M | 2.5 |" in whole
    assert "`good` | 0.50 s | 2.5 |" in performance.frame_table(frames, short=True)
    assert "| 64 | 2.00 s | 4.0 |" in performance.lights_table({"1": 0.5, "64": 2.0})
    assert "| 1.00 s | 0.50 s | 2.00 |" in performance.threads_table({"marble": {"1": 1.0, "2": 0.5}})
    cold = {320: (1.0, 1.1), 1280: (2.0, 2.2)}
    assert "| 1280 pixels wide | 2.00 s | 2.20 s |" in performance.cold_table(cold, "")
    assert "when the package was built" in performance.cold_table(cold, "")
    assert "by numba" in performance.cold_table(cold, "it is a checkout")
    assert "1.0 s at 320 pixels and 2.0 s at 1280 pixels" in performance.cold_sentence(cold)
    marks = {name: instanced.Mark(0.5, 0.4, 2**20, 2**21) for name in (*loading.STEPS, "load")}
    steps = loading.Loaded(1, 900_000, marks, {"scene": 60.0, "embree": 180.0, "peak": 190.0})
    assert "| 900,000 | 0.50 s | 0.50 s | 0.50 s | 0.50 s | 180 | 190 |" in performance.loading_table({"one": steps})
    many = instanced.Many(1000, 960, {"load": marks["load"]}, {"load": 273.0})
    assert "| load | 0.50 s | 1 MiB | 2 MiB | 273 |" in performance.places_table(many)


@pytest.mark.slow
def test_a_small_stage_is_loaded_and_measured() -> None:
    found = loading.loaded(10, 64)
    assert found.triangles == 10 * 48
    assert all(mark.held > 0.0 and mark.peak > 0.0 for mark in found.steps.values())


def test_the_short_table_of_peers_has_a_column_for_each_room() -> None:
    def runs(decibels: float) -> list[peers.Run]:
        programs = ((peers.OURS, "good"), (peers.THEIRS, "4 spp"), (peers.PATH, "4 spp"))
        return [peers.Run(*names, 0.25, {"glass": decibels, "elsewhere": 50.0}) for names in programs]

    told = performance.peers_table({"emissive": runs(40.0), "lit": runs(35.0)}).splitlines()
    assert "| refract, good | 40.0 dB, 0.25 s | 35.0 dB, 0.25 s |" in told
    assert len(told) == 4  # what only one room has is left out


@pytest.mark.parametrize("name", ["frame", "lights", "threads"])
def test_a_part_at_a_tiny_size(name: str) -> None:
    part = performance.PARTS[name](performance.Options(width=32, repeat=1, jobs=1))
    assert "|" in part.page
    assert ("|" in part.readme) == (name == "frame")


def test_what_is_put_stands_in_both_pages(tmp_path: Path) -> None:
    text = "<!-- cold -->\n<!-- end of cold -->\n"
    page, readme = tmp_path / "page.md", tmp_path / "readme.md"
    for path in (page, readme):
        path.write_text(text, "utf-8")
    options = performance.Options(repeat=3)
    performance.put({"cold": performance.Part("long", "short")}, options, page, readme)
    for path, word in ((page, "long"), (readme, "short")):
        assert pages.block_of(path.read_text("utf-8"), "cold").endswith(f"medians of 3:\n\n{word}")
