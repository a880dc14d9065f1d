"""Overrides of single materials: the same words mean the same in Python, on the command line and over HTTP."""

from __future__ import annotations

import importlib
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import box, glass, material
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.progress import reporting
from refract_core.scene import Model, Param, Source, Sphere
from refract_core.verbs.executors import Crew
from refract_core.verbs.override import FIELDS, LENGTHS, RANGES, OverrideError, override_notes
from refract_core.verbs.render_files import Order, render_files

SMALL = {"image_width": 32, "samples": 1, "jobs": 1}
STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 0.01
    upAxis = "Y"
    startTimeCode = 1
    endTimeCode = 3
)
def Xform "World"
{
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </World/Glass>
        double radius = 100
        token visibility.timeSamples = { 1: "inherited", 2: "invisible", 3: "inherited" }
    }
    def Cube "Back"
    {
        double size = 100
        double3 xformOp:translate = (50, 0, -300)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"])
    {
        uniform token refraction:model = "%(model)s"
        float inputs:refraction:ior = %(ior)s
        float inputs:refraction:thickness = %(thickness)s
        color3f inputs:refraction:transmittanceColor = (%(color)s)
        float inputs:refraction:absorptionDistance = %(distance)s
        float inputs:refraction:abbeNumber = %(abbe)s
    }
}
"""
AUTHORED = {"model": "sphere", "ior": 1.5, "thickness": 200.0, "color": "1, 1, 1", "distance": 100.0, "abbe": 0.0}


def scene() -> rc.Scene:
    """A matt box and a glass ball and box; lengths are in centimetres."""
    ball = glass(Model.SPHERE, THICKNESS=Source(texture=0), absorption_distance=1.0)
    return rc.Scene(
        (box("/box", (1, 1, 1), 0), box("/pane", (1, 1, 1), 1)), (material("/matt"), ball),
        (Sphere("/ball", (0, 0, 0), 1.0, 1),), metres_per_unit=0.01,
    )  # fmt: skip


def value(row: rc.scene.Material, param: Param) -> Any:
    return row.inputs[param].value[:3]


# --- the engine -----------------------------------------------------------------------------------------------------


def test_each_field_becomes_a_constant_in_metres() -> None:
    changes = {"model": "box", "ior": 1.2, "thickness": 3, "roughness": 0.25, "transmittanceColor": [1, 0.5, 0.25],
               "absorptionDistance": 7, "abbeNumber": 30}  # fmt: skip
    assert set(changes) == set(FIELDS)
    before = scene()
    matt, row = rc.override(before, {"/glass": changes}).materials
    assert matt is before.materials[0]
    assert row.model is Model.BOX
    assert value(row, Param.IOR) == (1.2,) * 3
    assert value(row, Param.THICKNESS) == pytest.approx((0.03,) * 3)
    assert row.inputs[Param.THICKNESS].texture == -1
    assert value(row, Param.ROUGHNESS) == (0.25,) * 3
    assert value(row, Param.TRANSMITTANCE) == (1, 0.5, 0.25)
    assert row.absorption_distance == pytest.approx(0.07)
    assert row.abbe == 30.0
    touched = {Param.IOR, Param.THICKNESS, Param.ROUGHNESS, Param.TRANSMITTANCE}
    for param in set(Param) - touched:
        assert row.inputs[param] == before.materials[1].inputs[param]


def test_a_material_is_reached_by_whatever_is_bound_to_it() -> None:
    found = [rc.override(scene(), {path: {"ior": 1.2}}).materials for path in ("/glass", "/ball", "/pane")]
    assert found[0] == found[1] == found[2] != scene().materials


def test_the_given_scene_stays_and_nothing_asked_is_nothing_done() -> None:
    before = scene()
    rc.override(before, {"/glass": {"ior": 1.2}})
    assert before.materials == scene().materials
    assert rc.override(before, {}) is before
    assert rc.override(before, {"/glass": {"ior": None}}).materials == before.materials


def test_the_order_of_paths_has_no_meaning() -> None:
    changes = {"/glass": {"ior": 1.2}, "/ball": {"ior": 1.3, "roughness": 0.5}, "/pane": {"ior": 1.4}}
    there = rc.override(scene(), changes)
    back = rc.override(scene(), dict(reversed(changes.items())))
    assert there.materials == back.materials
    assert override_notes(changes) == override_notes(dict(reversed(changes.items())))


def test_what_becomes_glass_is_clear_and_what_becomes_thin_is_thin() -> None:
    matt, _ = rc.override(scene(), {"/box": {"model": "traced"}}).materials
    assert (matt.model, value(matt, Param.OPACITY)) == (Model.TRACED, (0, 0, 0))
    _, thin = rc.override(scene(), {"/ball": {"model": "thin", "thickness": 9, "absorptionDistance": 9}}).materials
    assert value(thin, Param.THICKNESS) == (Model.THIN.fixed_thickness,) * 3
    assert thin.absorption_distance == Model.THIN.fixed_thickness


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ior": 0.5}, ["0.5", "1 to 10"]), ({"ior": float("nan")}, ["nan"]), ({"ior": True}, ["True"]),
        ({"ior": "1.5"}, ["1.5"]), ({"roughness": -0.1}, ["0 to 1"]), ({"thickness": 0}, ["above 0", "scene units"]),
        ({"absorptionDistance": float("inf")}, ["inf"]), ({"abbeNumber": -1}, ["0 to 1000"]),
        ({"model": "ball"}, ["none, sphere, box, thin, traced"]),
        ({"transmittanceColor": [1, 1]}, ["1.0,1.0", "three numbers"]), ({"transmittanceColor": [0, 0, 2]}, ["0 to 1"]),
        ({"transmittanceColor": 1}, ["three numbers"]), ({"colour": 1}, ["not known", *FIELDS]),
    ],
)  # fmt: skip
def test_a_bad_value_names_path_field_and_range(changes: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(OverrideError) as caught:
        rc.override(scene(), {"/glass": changes})
    (field,) = changes
    assert (caught.value.path, caught.value.field) == ("/glass", field)
    assert str(caught.value).startswith(f"/glass.{field} is ")
    for word in words:
        assert word in str(caught.value)


def test_a_path_that_names_nothing_tells_close_ones() -> None:
    with pytest.raises(rc.UsageError, match=r"/glas names no material.*did you mean /glass"):
        rc.override(scene(), {"/glas": {}})
    with pytest.raises(rc.UsageError, match="refract inspect"):
        rc.override(scene(), {"/elsewhere/altogether": {"ior": 1.2}})
    assert rc.override(scene(), {"/glas": {"ior": 1.2}}, strict=False).materials == scene().materials


def test_the_error_survives_a_pickle() -> None:
    error = OverrideError("/a.ior is 0", "/a", "ior")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.path, again.field) == (str(error), "/a", "ior")


def test_http_has_the_same_fields_and_ranges() -> None:
    models = pytest.importorskip("service.models")
    fields = models.Override.model_json_schema()["properties"]
    assert set(fields) == set(FIELDS)
    for name, (low, high) in RANGES.items():
        schema = fields[name]["anyOf"][0]
        schema = schema.get("items", schema)
        least = schema["exclusiveMinimum" if name in LENGTHS else "minimum"]
        assert (least, schema["maximum"]) == (low, high)


def test_http_points_at_what_the_engine_refuses() -> None:
    tasks = pytest.importorskip("service.tasks")
    for changes, where in (({"ior": 0.5}, "/overrides/~1a~0b/ior"), ({}, "/overrides/~1a~0b")):
        with pytest.raises(tasks.Problem) as caught:
            tasks.overridden(scene(), {"/a~b": changes})
        (error,) = caught.value.errors
        assert (caught.value.slug, caught.value.prim, error["pointer"]) == ("invalid-settings", "/a~b", where)


# --- pictures -------------------------------------------------------------------------------------------------------


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    (tmp_path / "stage.usda").write_text(STAGE % AUTHORED)
    return tmp_path / "stage.usda"


def pixels(path: Path) -> Any:
    pictures = importlib.import_module("refract_core.images.pictures")
    return pictures.read_texture(str(path), name="p", color_space="raw").pixels


def refract(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["render", *map(str, words)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stderr


CHANGED: dict[str, Any] = {"model": "box", "ior": 1.2, "thickness": 50, "transmittanceColor": "0.5,1,0.25",
                           "absorptionDistance": 25, "abbeNumber": 25}  # fmt: skip
FLAGS = [word for name, value in CHANGED.items() for word in ("--override", f"/World/Ball.{name}={value}")]
QUICK = ["-w", "32", "--samples", "1", "--jobs", "1", "--progress", "none"]


def test_an_override_draws_what_the_stage_would_if_it_were_authored(stage: Path, tmp_path: Path) -> None:
    color, distance, abbe = (CHANGED[name] for name in ("transmittanceColor", "absorptionDistance", "abbeNumber"))
    other = tmp_path / "other.usda"
    other.write_text(STAGE % {**CHANGED, "color": color, "distance": distance, "abbe": abbe})
    pictures = {}
    for name, of, flags in (("plain", stage, []), ("flags", stage, FLAGS), ("authored", other, [])):
        assert refract(of, tmp_path / f"{name}.png", *QUICK, *flags)[0] == 0
        pictures[name] = pixels(tmp_path / f"{name}.png")
    np.testing.assert_array_equal(pictures["flags"], pictures["authored"])
    assert (pictures["flags"] != pictures["plain"]).any()
    assert b"/World/Ball.ior=1.2 " in (tmp_path / "flags.png").read_bytes()
    assert b"refract:overrides" not in (tmp_path / "plain.png").read_bytes()


def test_frames_keep_it_also_where_the_thing_is_hidden_and_a_crew_makes_the_same_bytes(stage: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        for folder, crew in (("here", None), ("there", Crew(pool, lambda: 2, lambda data: data))):
            (stage.parent / folder).mkdir()
            out = str(stage.parent / folder / "p.#.png")
            changes = {"/World/Ball": {"model": "box", "ior": 1.2}}
            order = Order(stage=str(stage), out=out, frames="1:3", overrides=SMALL, materials=changes)
            with reporting("none") as report:
                render_files(order, report, lambda: False, crew)
    here, there = ({path.name: path.read_bytes() for path in (stage.parent / at).iterdir()} for at in ("here", "there"))
    assert here == there
    assert len(here) == 3
    first, second = (pixels(stage.parent / "here" / f"p.{frame}.png") for frame in (1, 2))
    assert (first != second).any()


def test_a_path_that_names_nothing_ends_a_crews_work_before_its_first_frame(stage: Path) -> None:
    changes = {"/World/Bal": {"ior": 1.2}}
    order = Order(stage=str(stage), out=str(stage.parent / "p.#.png"), frames="1:3", overrides=SMALL, materials=changes)
    with ThreadPoolExecutor(2) as pool, reporting("none") as report, pytest.raises(rc.UsageError, match="--override"):
        render_files(order, report, lambda: False, Crew(pool, lambda: 2, lambda data: data))
    assert not list(stage.parent.glob("p.*"))


@pytest.mark.parametrize(
    ("word", "parts"),
    [
        ("/World/Bal.ior=1.2", ["/World/Bal ", "did you mean /World/Ball"]),
        ("/World/Ball.colour=1", ["/World/Ball.colour", "not known", "transmittanceColor"]),
        ("/World/Ball.ior=0.5", ["/World/Ball.ior is 0.5", "1 to 10"]),
        ("/World/Ball.ior=glass", ["/World/Ball.ior is glass", "1 to 10"]),
        ("/World/Ball.ior=", ["/World/Ball.ior", "1 to 10"]),
        ("/World/Ball.thickness=-1", ["above 0"]), ("/World/Ball.roughness=nan", ["0 to 1"]),
        ("/World/Ball.transmittanceColor=1,1", ["three numbers"]), ("/World/Ball.model=prism", ["traced"]),
        ("/World/Ball=1.2", ["PATH.FIELD=VALUE"]), ("/World/Ball.ior", ["PATH.FIELD=VALUE"]),
        ("Ball.ior=1.2", ["PATH.FIELD=VALUE"]), ("", ["PATH.FIELD=VALUE"]),
    ],
)  # fmt: skip
def test_a_wrong_word_is_exit_code_2_and_one_sentence(stage: Path, word: str, parts: list[str]) -> None:
    code, said = refract(stage, stage.parent / "out.png", *QUICK, "--override", word)
    assert code == 2
    assert said.startswith("error: --override ")
    assert len(said.splitlines()) == 1
    for part in parts:
        assert part in said
    assert not (stage.parent / "out.png").exists()


def test_the_last_of_two_words_about_one_field_counts(stage: Path) -> None:
    out = stage.parent / "out.png"
    words = ["--override", "/World/Glass.ior=1.1", "--override", "/World/Glass.ior=1.9"]
    assert refract(stage, out, *QUICK, *words)[0] == 0
    assert b"/World/Glass.ior=1.9" in out.read_bytes()
    assert b"ior=1.1" not in out.read_bytes()
