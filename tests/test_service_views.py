"""From where a viewer starts: the camera of a stage, told in the numbers that a render takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from refract_core.usd.stage import load_stage
from service.views import start_of

CAMERA = """def Camera "Eye" {{
    double3 xformOp:translate = ({0}, {1}, {2})
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
"""
BALL = """def Sphere "{0}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
    rel material:binding = <{1}>
    double3 xformOp:translate = ({2}, {3}, {4})
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"]) {{ uniform token refraction:model = "sphere" }}
"""


def stage(folder: Path, text: str, unit: float = 1.0, up: str = "Y") -> Path:
    path = folder / "stage.usda"
    lines = text.replace("{", "{\n").replace("}", "\n}\n")
    path.write_text(f'#usda 1.0\n(\n metersPerUnit = {unit}\n upAxis = "{up}"\n)\n{lines}')
    return path


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_a_camera_looks_at_the_point_of_its_axis_nearest_to_the_glass(unit: float, tmp_path: Path) -> None:
    """Two units from a ball at (1, 2, -3), seen from the front, past a wall that reaches far behind the camera."""
    text = CAMERA.format(0, 2, 5) + BALL.format("Ball", "/Glass", 1, 2, -3) + 'def Cube "Room" { double size = 100 }'
    view = start_of(load_stage(stage(tmp_path, text, unit)), "")
    assert view is not None
    assert (view["camera"], view["orthographic"]) == ("/Eye", False)
    assert [view["azimuth"], view["elevation"]] == pytest.approx([0, 0], abs=1e-4)
    assert view["distance"] == pytest.approx(8)
    assert view["look_at"] == pytest.approx([0, 2, -3], abs=1e-3)
    assert view["width"] == pytest.approx(20.955 / 50)  # the fallbacks of UsdGeomCamera


def test_where_z_is_up_the_front_is_minus_y(tmp_path: Path) -> None:
    """A camera without a rotation looks down -Z, which is from above there."""
    text = CAMERA.format(0, 0, 7) + BALL.format("Ball", "/Glass", 0, 0, 0)
    view = start_of(load_stage(stage(tmp_path, text, up="Z")), "")
    assert view is not None
    assert view["elevation"] == pytest.approx(90, abs=1e-3)
    assert view["look_at"] == pytest.approx([0, 0, 0], abs=1e-3)


def test_without_glass_the_middle_is_that_of_everything_and_the_camera_has_no_path(tmp_path: Path) -> None:
    view = start_of(load_stage(stage(tmp_path, 'def Cube "Box" { double size = 2 }')), "")
    assert view is not None
    assert view["camera"] == ""
    assert np.abs(view["look_at"]).max() < 1e-3
