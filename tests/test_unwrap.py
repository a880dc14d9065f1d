"""Thickness pictures of meshes without uv: coordinates are made, and said to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from test_thickness import ball, box
from thickness_stages import from_picture, glass, mesh, new, run, scaled

from refract_core.thickness.picture import texels
from refract_core.thickness.unwrap import unwrap
from refract_core.usd.stage import load_stage

pytest.importorskip("xatlas")


def test_no_two_places_share_a_texel() -> None:
    points, triangles, normals = ball(1.0)
    uv, charts = unwrap(points, triangles, 128)
    assert charts > 1
    assert uv.shape == (len(triangles), 3, 2)
    assert uv.min() >= 0.0
    assert uv.max() <= 1.0
    covered = np.concatenate([texel for texel, _ in texels(uv, normals, 128)])
    assert len(np.unique(covered)) > 0.99 * len(covered)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quads", [False, True])
def test_a_box_without_uv_is_as_thick_as_its_sides(tmp_path: Path, mirrored: bool, quads: bool) -> None:
    """The thickness of a box at a face is its side across it: read back from the picture at every triangle."""
    stage = new(tmp_path / "in.usda")
    made = mesh(stage, "/W/Box", box(1.0, 2.0, 0.25), glass(stage, model="box"))
    if quads:
        points = UsdGeom.Mesh(made)
        cube = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) * (1.0, 2.0, 0.25)
        points.GetPointsAttr().Set(cube.astype(np.float32))
        points.GetFaceVertexCountsAttr().Set([4] * 6)
        faces = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
        points.GetFaceVertexIndicesAttr().Set(faces)
        made.GetPrim().RemoveProperty("normals")
    if mirrored:
        scaled(made, -1.0, 1.0, 1.0)
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda", texture=64)
    assert rows["Box"].how.endswith(".exr")
    assert "it had no uv: primvars:refraction:st was made, " in told
    found, drawn = from_picture(load_stage(tmp_path / "out.usda"), "Box")
    corners = drawn.points[drawn.triangles.astype(np.int64)]
    across = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).argmax(axis=1)
    np.testing.assert_allclose(found, np.array([1.0, 2.0, 0.25])[across], rtol=1e-3)


def test_what_was_made_is_used_again(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    mesh(stage, "/W/Ball", ball(1.0), glass(stage))
    stage.Save()
    run(tmp_path / "in.usda", tmp_path / "one.usda", texture=64)
    _, told = run(tmp_path / "one.usda", tmp_path / "two.usda", texture=64)
    assert "was made" not in told
    made = []
    for name in ("one.usda", "two.usda"):
        opened = Usd.Stage.Open(str(tmp_path / name))
        made.append(np.asarray(opened.GetPrimAtPath("/W/Ball").GetAttribute("primvars:refraction:st").Get()).copy())
    first, second = made
    assert np.array_equal(first, second)
    found, _ = from_picture(load_stage(tmp_path / "two.usda"), "Ball")
    np.testing.assert_allclose(found, 2.0, rtol=0.05)
