"""Broken meshes and prims that cannot be drawn: dropped, named, and never a crash."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_reading import CUBE, TWO_TRIANGLES, read, texts

from refract_core.usd.geometry.triangulate import has_area

# --- bad input ------------------------------------------------------------------------------------------------------


def test_holes_are_left_out_without_a_word() -> None:
    scene = read(TWO_TRIANGLES("int[] holeIndices = [0]"))
    (mesh,) = scene.meshes
    assert len(mesh.triangles) == 1
    assert not texts(scene, "/M")
    assert len(mesh.points) == 3


BAD = {
    "indices outside": ("[3, 3]", "[0, 1, 2, 0, 2, 9]", "", "1 faces with indices outside 0 .. 3", 1),
    "negative index": ("[3, 3]", "[0, 1, 2, 0, -2, 3]", "", "1 faces with indices outside 0 .. 3", 1),
    "too few indices": ("[3, 4]", "[0, 1, 2, 0, 2]", "", "1 faces whose faceVertexCounts go beyond", 1),
    "too many indices": ("[3]", "[0, 1, 2, 0, 2]", "", "2 faceVertexIndices that belong to no face", 1),
    "two corners": ("[3, 2]", "[0, 1, 2, 0, 2]", "", "1 faces with fewer than 3 vertices", 1),
    "NaN": ("[3, 3]", "[0, 1, 2, 0, 2, 4]", ", (nan, 0, 0)", "1 faces with points that are NaN", 1),
    "infinite": ("[3, 3]", "[0, 1, 2, 0, 2, 4]", ", (inf, 0, 0)", "1 faces with points that are NaN", 1),
    "a line": ("[3, 3]", "[0, 1, 2, 0, 2, 4]", ", (2, 2, 0)", "1 faces without area", 1),
    "a point": ("[3, 3]", "[0, 1, 2, 3, 3, 3]", "", "1 faces without area", 1),
    "no such hole": ("[3]", "[0, 1, 2]", "] int[] holeIndices = [5", "1 holeIndices that name no face", 1),
    "negative count": ("[3, -3]", "[0, 1, 2]", "", "negative", 0),
    "nothing left": ("[3, 3]", "[0, 1, 9, 0, 2, 8]", "", "none of its 2 faces can be drawn", 0),
    "no faces": ("[]", "[]", "", "no faces", 0),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_faces_are_dropped_with_one_notice_that_says_how_many_and_why(name: str) -> None:
    counts, indices, more, reason, left = BAD[name]
    points = f"(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0){more}".replace("] int", "]\nint")
    scene = read(f"""def Mesh "M" {{
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = {counts}
        int[] faceVertexIndices = {indices}
        point3f[] points = [{points}] }}""")
    assert sum(len(mesh.triangles) for mesh in scene.meshes) == left
    about = [notice.text for notice in scene.notices if notice.path == "/M"]
    assert len(about) == 1
    assert reason in about[0]
    for mesh in scene.meshes:
        assert np.isfinite(mesh.points).all()
        assert mesh.triangles.max() < len(mesh.points)
        assert not mesh.closed


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(-1, 6), max_size=8),
    st.lists(st.integers(-2, 7), max_size=24),
    st.lists(st.tuples(*[st.sampled_from([0.0, 1.0, -2.5, math.nan, math.inf, 1e38])] * 3), max_size=7),
)
def test_no_topology_is_so_broken_that_reading_fails(
    counts: list[int], indices: list[int], points: list[tuple[float, ...]]
) -> None:
    scene = read(f"""def Mesh "M" {{
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = {counts}
        int[] faceVertexIndices = {indices}
        point3f[] points = {points} }}""")
    for mesh in scene.meshes:
        assert np.isfinite(mesh.points).all()
        assert mesh.triangles.max() < len(mesh.points)
        assert len(mesh.triangles) == len(mesh.materials)
        assert has_area(mesh.points.astype(np.float64), mesh.triangles.astype(np.int64)).any()
    assert scene.meshes or texts(scene, "/M")


def test_a_flattening_scale_keeps_what_still_has_area() -> None:
    flat = 'double3 xformOp:scale = (1, 0, 1)\n uniform token[] xformOpOrder = ["xformOp:scale"]'
    scene = read(CUBE(extra=flat))
    (mesh,) = scene.meshes
    assert np.ptp(mesh.points, axis=0) == pytest.approx((2, 0, 2))
    nothing = flat.replace("(1, 0, 1)", "(0, 0, 1)")
    scene = read(CUBE(extra=nothing))
    assert not scene.meshes
    assert "scale of 0" in texts(scene, "/C")


@pytest.mark.parametrize("kind", ["NurbsCurves", "NurbsPatch", "TetMesh", "Volume", "ParticleField3DGaussianSplat"])
def test_what_is_not_rendered_is_named_once(kind: str) -> None:
    scene = read("".join(f'def {kind} "P{i}" {{}}\n' for i in range(4)))
    about = [notice.text for notice in scene.notices if kind in notice.text]
    assert len(about) == 1
    assert "not rendered" in about[0]
    assert "4 prims" in about[0]
