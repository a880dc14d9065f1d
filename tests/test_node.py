"""`refract node`: numbers of the fact sheet, closed forms, and what it says to bad input."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from refract_core.cli import app


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["node", *arguments])


def ray(*arguments: str) -> dict[str, Any]:
    done = run("--json", *arguments)
    assert done.exit_code == 0, done.output
    return dict(json.loads(done.output)["ray"])


def incident(degrees: float) -> str:
    return f"{math.sin(math.radians(degrees))},{-math.cos(math.radians(degrees))},0"


@pytest.mark.parametrize(("degrees", "intensity"), [(0, 0.96), (30, 0.95996), (45, 0.95793), (60, 0.93), (80, 0.59009)])
def test_into_glass_the_intensity_is_a_transmittance(degrees: float, intensity: float) -> None:
    found = ray("--incident", incident(degrees), "--normal", "0,1,0")
    assert found["intensity"] == pytest.approx(intensity, abs=1e-5)
    assert found["angle"] == pytest.approx(degrees, abs=1e-9)
    sine = math.sin(math.radians(degrees)) / 1.5
    assert found["refracted_angle"] == pytest.approx(math.degrees(math.asin(sine)), abs=1e-9)
    assert found["deviation"] == pytest.approx(degrees - found["refracted_angle"], abs=1e-6)
    np.testing.assert_allclose(found["refracted"], [sine, -math.sqrt(1 - sine**2), 0], atol=1e-12)


@pytest.mark.parametrize(("degrees", "intensity"), [(0, 0.04), (30, 0.05519), (41, 0.37975), (41.8, 0.89077)])
def test_out_of_glass_the_intensity_is_a_reflectance(degrees: float, intensity: float) -> None:
    found = ray("--incident", incident(degrees), "--normal", "0,1,0", "--source", "1.5", "--medium", "1")
    assert found["intensity"] == pytest.approx(intensity, abs=1e-5)
    assert found["reflectance"] + found["transmittance"] == pytest.approx(1.0)


@pytest.mark.parametrize(("mode", "intensity"), [("safe", 0.0), ("critical", 1.0)])
def test_total_reflection(mode: str, intensity: float) -> None:
    """Safe gives eta (I - c N), which is tangential and eta sin i long; critical the mirrored ray."""
    common = ("--incident", incident(45), "--normal", "0,1,0", "--source", "1.5", "--medium", "1", "--mode", mode)
    found = ray(*common)
    assert found["total_reflection"]
    assert found["refracted_angle"] is None
    assert (found["intensity"], found["reflectance"]) == (intensity, pytest.approx(1.0))
    s = math.sqrt(0.5)
    np.testing.assert_allclose(found["refracted"], [1.5 * s, 0, 0] if mode == "safe" else [s, s, 0], atol=1e-12)
    assert "total internal reflection" in run(*common).output
    assert "41.8103" in run(*common).output


def test_vectors_are_normalised() -> None:
    long, unit = ray("--incident", "3,-3,0", "--normal", "0,9,0"), ray("--incident", incident(45), "--normal", "0,1,0")
    for name, value in unit.items():
        np.testing.assert_allclose(long[name], value, atol=1e-9)


def test_a_sweep_finds_brewster_and_grazing() -> None:
    done = run("--sweep", "--json")
    curve = json.loads(done.output)["sweep"]
    assert [round(one["angle"]) for one in curve] == list(range(0, 91, 5))
    assert curve[0]["reflectance"] == pytest.approx(0.04)
    assert curve[-1]["reflectance"] > 0.999
    reflectance = [one["reflectance"] for one in curve]
    assert reflectance == sorted(reflectance)
    table = run("--sweep").output.splitlines()
    assert len(table) == 20
    assert table[-1].endswith("#" * 40)


def test_an_ior_below_one_is_one_and_says_so() -> None:
    done = run("--source", "0.5")
    assert done.exit_code == 0
    assert "--source" in done.stderr
    assert "below 1" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("--incident", "1,2"), ("--incident", "x,y,z")),
        (("--normal", "0,0,0"), ("--normal", "not all 0")),
        (("--normal", "a,b,c"), ("--normal",)),
        (("--incident", "nan,0,1"), ("--incident",)),
        (("--source", "nan"), ("--source", "1 or more")),
        (("--medium", "-1"), ("--medium", "1 or more")),
        (("--mode", "fast"), ("--mode", "safe, critical")),
    ],
)
def test_bad_input_is_refused_by_name(arguments: tuple[str, ...], names: tuple[str, ...]) -> None:
    done = run(*arguments)
    assert done.exit_code == 2
    assert all(name in done.stderr for name in names)
    assert done.stdout == ""
