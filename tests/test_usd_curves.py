"""Curves of a stage: where they run by de Boor, de Casteljau and Barry and Goldman, what tubes and ribbons hold, and
what their primvars say along them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from pxr import Usd, UsdGeom, Vt
from scene_reading import F64, WALL_SEEN, areas, read, signed_volume, stage_of, texts, to_stage

import refract_core as rc
from refract_core.scene import F32, Mesh, Model, Scene
from refract_core.usd.geometry.along import Along
from refract_core.usd.geometry.cages import FINENESS
from refract_core.usd.geometry.curves import read_curves
from refract_core.usd.geometry.triangulate import is_closed
from refract_core.usd.stage import scene_from_stage

TIME = Usd.TimeCode.Default()
WAVE = [(0, 0, 0), (1, 2, 0), (2, -1, 1), (4, 0, 2), (5, 1, 0), (6, 3, -1), (8, 2, 0), (9, 0, 1), (10, 1, 1)]


def vectors(rows: Any) -> list[tuple[float, ...]]:
    return [tuple(map(float, row)) for row in rows]


def curves(
    points: Any, counts: Sequence[int], *, kind: str = "BasisCurves", said: str = "", **tokens: str
) -> str:
    """A prim of curves as text."""
    chosen = "\n".join(f'uniform token {name} = "{value}"' for name, value in tokens.items())
    return f"""def {kind} "C" {{
        {chosen}
        int[] curveVertexCounts = {list(counts)}
        point3f[] points = {vectors(points)}
        {said} }}"""


def widths(values: Sequence[float], interpolation: str = "constant") -> str:
    return f'float[] widths = {list(values)} (interpolation = "{interpolation}")'


def axis_points(text: str, complexity: str = "low") -> list[F64]:
    """The middles of the rings of each curve, in order: all corners of a ring average to it."""
    stage = stage_of(text)
    drawn = read_curves(stage.GetPrimAtPath("/C"), TIME, [], FINENESS[complexity])
    rings = drawn.sides.rings
    sides = len(drawn.sides.points) // (rings.max() + 1)
    middles = drawn.sides.points.reshape(-1, sides, 3).mean(axis=1, dtype=np.float64)
    along = drawn.topology.refinement
    assert isinstance(along, Along)
    return [middles[along.ring_curve == curve] for curve in range(len(along.curves))]


def de_casteljau(points: F64, u: float) -> F64:
    while len(points) > 1:
        points = (1 - u) * points[:-1] + u * points[1:]
    return points[0]


def de_boor(points: F64, u: float) -> F64:
    """Cubic, over four points, in the middle one of evenly spaced knots -2 .. 3."""
    points = np.array(points)
    for level in (1, 2, 3):
        for j in range(3, level - 1, -1):
            low, high = j - 3, j + 1 - level
            share = (u - low) / (high - low)
            points[j] = (1 - share) * points[j - 1] + share * points[j]
    return points[3]


def barry_goldman(points: F64, u: float) -> F64:
    """Catmull and Rom's curve with evenly spaced knots -1, 0, 1, 2."""
    for spans in ([(-1, 0), (0, 1), (1, 2)], [(-1, 1), (0, 2)], [(0, 1)]):
        pairs = zip(spans, points, points[1:], strict=False)
        points = np.array([((high - u) * a + (u - low) * b) / (high - low) for (low, high), a, b in pairs])
    found: F64 = points[0]
    return found


RULES = {"bezier": (de_casteljau, 3), "bspline": (de_boor, 1), "catmullRom": (barry_goldman, 1)}


def expected(points: ArrayLike, basis: str, wrap: str, segments: int) -> F64:
    """The curve at even steps over all of its pieces."""
    rule, step = RULES[basis]
    at = np.array(points, np.float64)
    if wrap == "periodic":
        at = np.concatenate((at, at[: 4 - step]))
    if wrap == "pinned" and basis != "bezier":
        at = np.concatenate(([2 * at[0] - at[1]], at, [2 * at[-1] - at[-2]]))
    pieces = (len(at) - 4) // step + 1
    found = []
    for j in range(segments + (wrap != "periodic")):
        piece = min(j * pieces // segments, pieces - 1)
        found.append(rule(at[step * piece : step * piece + 4], j * pieces / segments - piece))
    return np.array(found)


@pytest.mark.parametrize("wrap", ["nonperiodic", "periodic", "pinned"])
@pytest.mark.parametrize("basis", list(RULES))
def test_a_cubic_curve_runs_where_its_basis_says(basis: str, wrap: str) -> None:
    count = {"bezier": 9 if wrap == "periodic" else 7}.get(basis, 8)
    text = curves(WAVE[:count] + WAVE[:count], [count, count], type="cubic", basis=basis, wrap=wrap, said=widths([0.1]))
    first, second = axis_points(text)
    segments = len(first) - (wrap != "periodic")
    np.testing.assert_allclose(first, expected(WAVE[:count], basis, wrap, segments), atol=2e-6)
    np.testing.assert_array_equal(first, second)
    if wrap == "pinned" or (basis == "bezier" and wrap == "nonperiodic"):
        np.testing.assert_allclose(first[[0, -1]], np.array([WAVE[0], WAVE[count - 1]], float), atol=1e-6)


def test_a_linear_curve_has_rings_where_its_points_are() -> None:
    (found,) = axis_points(curves(WAVE, [9], type="linear", said=widths([0.01])))
    np.testing.assert_allclose(found, np.array(WAVE, float), atol=1e-6)


def test_hermite_curves_are_the_bezier_curves_with_handles_a_third_of_the_tangents() -> None:
    ends = np.array([(0, 0, 0), (2, 1, 0), (4, 0, 1)], float)
    tangents = np.array([(3, 3, 0), (3, 0, 3), (0, 3, 3)], float)
    said = f"vector3f[] tangents = {vectors(tangents)}\n{widths([0.1])}"
    (found,) = axis_points(curves(ends, [3], kind="HermiteCurves", said=said))
    handles = [ends[0], ends[0] + tangents[0] / 3, ends[1] - tangents[1] / 3, ends[1], ends[1] + tangents[1] / 3]
    handles += [ends[2] - tangents[2] / 3, ends[2]]
    np.testing.assert_allclose(found, expected(handles, "bezier", "nonperiodic", len(found) - 1), atol=2e-6)


def mesh_of(text: str, **options: Any) -> tuple[Mesh, Scene]:
    scene = read(text, **options)
    (mesh,) = scene.meshes
    return mesh, scene


def shading(mesh: Mesh) -> F32:
    assert mesh.normals is not None
    return mesh.normals


@pytest.mark.parametrize("complexity", ["low", "veryhigh"])
def test_a_straight_tube_has_the_area_and_volume_of_a_cylinder(complexity: str) -> None:
    text = curves([(0, 0, 0), (1, 2, 2), (3, 6, 6)], [3], type="linear", said=widths([0.5]))
    mesh, _ = mesh_of(text, complexity=complexity)
    assert mesh.closed
    radius, length = 0.25, 9.0
    flat = np.linalg.norm(areas(mesh.points, mesh.triangles), axis=1)
    sides = flat[np.abs(shading(mesh)[:, 0] @ np.array([1, 2, 2]) / 3) < 0.5]
    assert sides.sum() == pytest.approx(2 * math.pi * radius * length, rel=1e-5)
    assert signed_volume(mesh) == pytest.approx(math.pi * radius**2 * length, rel=4e-3)


def test_a_bent_tube_keeps_its_width_at_a_corner() -> None:
    """Pappus: a prism cut off square, whose cuts lie on its axis, has the volume of the straight one."""
    text = curves([(0, 0, 0), (4, 0, 0), (4, 5, 0), (4, 5, 6)], [4], type="linear", said=widths([0.5]))
    mesh, _ = mesh_of(text)
    assert signed_volume(mesh) == pytest.approx(math.pi * 0.25**2 * 15.0, rel=4e-3)
    along_x = shading(mesh)[:, :, 0]
    at = mesh.points[mesh.triangles]
    first = (at[:, :, 0].max(axis=1) - at[:, :, 0].min(axis=1)) > 3.0
    assert np.abs(along_x[first]).max() < 1e-6  # a sharp bend shows its edge


def test_a_cone_of_widths_has_its_volume_and_its_normals() -> None:
    text = curves([(0, 0, 0), (0, 4, 0)], [2], type="linear", said=widths([2.0, 0.0], "vertex"))
    mesh, _ = mesh_of(text, complexity="veryhigh")
    assert signed_volume(mesh) == pytest.approx(math.pi * 4 / 3, rel=2e-3)
    assert is_closed(mesh.points, mesh.triangles.astype(np.int64).ravel(), np.arange(len(mesh.triangles)) * 3,
                     np.full(len(mesh.triangles), 3))  # fmt: skip
    normals = shading(mesh)
    side = normals[normals[:, :, 1].min(axis=1) > -0.5]
    assert side[:, :, 1] == pytest.approx(math.sin(math.atan2(1.0, 4.0)), abs=1e-3)


CLOSED_TEXTS = {
    "wave": curves(WAVE, [9], type="cubic", basis="bspline", said=widths([0.3])),
    "ring": curves(WAVE, [9], type="cubic", basis="catmullRom", wrap="periodic", said=widths([0.1])),
    "polygon": curves(WAVE, [9], type="linear", wrap="periodic", said=widths([0.3])),
    "tapered": curves(WAVE, [4, 5], type="cubic", basis="bspline", said=widths([0.3, 0.0], "uniform")),
    "tip": curves(WAVE[:7], [7], type="cubic", basis="bezier", said=widths([0.3, 0.2, 0.0], "varying")),
    "there and back": curves([(0, 0, 0), (1, 0, 0), (0, 0, 0)], [3], type="linear", said=widths([0.1])),
    "doubled": curves([(0, 0, 0)] * 3 + [(1, 0, 0), (2, 1, 0)] + [(3, 1, 0)] * 3, [8], type="cubic", basis="bspline",
                      said=widths([0.1])),
}  # fmt: skip


@pytest.mark.parametrize("name", list(CLOSED_TEXTS))
def test_tubes_close_and_face_outwards(name: str) -> None:
    mesh, scene = mesh_of(CLOSED_TEXTS[name])
    count = len(mesh.triangles)
    assert is_closed(mesh.points, mesh.triangles.astype(np.int64).ravel(), np.arange(count) * 3, np.full(count, 3))
    assert mesh.closed
    assert np.isfinite(mesh.points).all()
    assert np.linalg.norm(shading(mesh), axis=2) == pytest.approx(1.0, abs=1e-5)
    agree = np.einsum("ik,ick->ic", areas(mesh.points, mesh.triangles), shading(mesh))
    if name != "there and back":
        assert signed_volume(mesh) > 0.0
        assert agree.min() > 0.0
    assert name == "tapered" or not texts(scene, "/C")


def test_a_periodic_tube_is_a_torus_where_its_points_lie_on_a_circle() -> None:
    """The ring of a uniform B-spline over points on a circle; area and volume by Pappus with its own length."""
    turn = np.arange(12) * (2 * math.pi / 12)
    circle = np.stack((3 * np.cos(turn), np.zeros(12), 3 * np.sin(turn)), axis=1)
    text = curves(circle, [12], type="cubic", basis="bspline", wrap="periodic", said=widths([0.5]))
    mesh, _ = mesh_of(text, complexity="veryhigh")
    (axis,) = axis_points(text, "veryhigh")
    assert np.ptp(np.linalg.norm(axis, axis=1)) < 0.01
    length = np.linalg.norm(np.diff(axis, axis=0, append=axis[:1]), axis=1).sum()
    assert signed_volume(mesh) == pytest.approx(math.pi * 0.25**2 * length, rel=2e-3)
    outward = areas(mesh.points, mesh.triangles).sum(axis=0)
    assert outward == pytest.approx((0, 0, 0), abs=1e-6)


def test_frames_turn_about_the_curve_as_little_as_may_be() -> None:
    """A plane curve never turns its frame: the corners of every ring stand at the same heights over its plane."""
    turn = np.linspace(0, 5, 40)
    flat = np.stack((turn * np.cos(turn), turn * np.sin(turn), np.zeros(40)), axis=1)
    stage = stage_of(curves(flat, [40], type="cubic", basis="catmullRom", said=widths([0.2])))
    drawn = read_curves(stage.GetPrimAtPath("/C"), TIME, [], FINENESS["low"])
    rings = drawn.sides.rings.max() + 1
    heights = drawn.sides.points.reshape(rings, -1, 3)[:, :, 2]
    assert np.ptp(heights, axis=0).max() < 1e-6


def test_widths_of_every_interpolation() -> None:
    for kind, values in {
        "constant": [0.5], "uniform": [0.5, 0.5], "varying": [0.5] * 4, "vertex": [0.5] * 8,
    }.items():  # fmt: skip
        text = curves(WAVE[:8], [4, 4], type="cubic", basis="bezier", said=widths(values, kind))
        mesh, scene = mesh_of(text)
        constant = mesh_of(curves(WAVE[:8], [4, 4], type="cubic", basis="bezier", said=widths([0.5])))[0]
        np.testing.assert_allclose(mesh.points, constant.points, atol=1e-6)
        assert not texts(scene, "/C")


def radii(text: str) -> tuple[list[F64], list[F64]]:
    """Place along x and radius of every ring of each curve; curves run along x."""
    stage = stage_of(text)
    drawn = read_curves(stage.GetPrimAtPath("/C"), TIME, [], FINENESS["veryhigh"])
    rings = drawn.sides.rings.max() + 1
    corners = drawn.sides.points.astype(np.float64).reshape(rings, -1, 3)
    along = drawn.topology.refinement
    assert isinstance(along, Along)
    spread = np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    curve = along.ring_curve
    every = range(curve.max() + 1)
    return [corners[curve == c, 0, 0] for c in every], [spread[curve == c] for c in every]


def test_varying_widths_are_linear_and_vertex_widths_follow_the_basis() -> None:
    line = [(x, 0, 0) for x in (0, 1, 2, 3)]
    places, found = radii(curves(line, [4], type="cubic", basis="bezier", said=widths([2.0, 4.0], "varying")))
    np.testing.assert_allclose(found[0], 1.0 + places[0] / 3.0, rtol=1e-3)
    bulge = [2.0, 8.0, 8.0, 2.0]
    places, found = radii(curves(line, [4], type="cubic", basis="bezier", said=widths(bulge, "vertex")))
    by_rule = [de_casteljau(np.array(bulge) / 2.0, u) for u in places[0] / 3.0]
    np.testing.assert_allclose(found[0], by_rule, rtol=1e-3)
    _, found = radii(curves([*line, *line], [4, 4], type="cubic", basis="bezier", said=widths([2.0, 6.0], "uniform")))
    assert found[0] == pytest.approx(1.0, rel=1e-3)
    assert found[1] == pytest.approx(3.0, rel=1e-3)


def test_a_primvar_of_widths_wins_over_the_attribute() -> None:
    said = widths([5.0]) + '\nfloat[] primvars:widths = [0.5] (interpolation = "constant")'
    mesh, _ = mesh_of(curves([(0, 0, 0), (10, 0, 0)], [2], type="linear", said=said))
    assert np.ptp(mesh.points, axis=0) == pytest.approx((10, 0.5, 0.5), rel=2e-3)


def test_instances_of_curves_are_where_they_should_be_and_share_what_they_may_have() -> None:
    line = curves([(0, 0, 0), (1, 0, 0)], [2], type="linear", said=widths([0.1]))
    text = f"""def PointInstancer "I" {{
        int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (0, 3, 0)]
        rel prototypes = </I/P>
        def Xform "P" {{ {line} }} }}"""
    scene = read(text)
    low = sorted(to_stage(scene, mesh.points)[:, 1].mean() for mesh in scene.meshes)
    assert low == pytest.approx([0.0, 3.0], abs=1e-5)
    assert len({len(mesh.triangles) for mesh in scene.meshes}) == 1


def test_curves_that_change_in_time_are_read_at_it_and_are_not_static() -> None:
    moving = curves([(0, 0, 0), (1, 0, 0)], [2], type="linear", said="float[] widths.timeSamples = { 0: [1], 10: [3] }")
    for time, width in ((0.0, 1.0), (10.0, 3.0)):
        mesh, _ = mesh_of(moving, time_code=time)
        assert np.ptp(mesh.points[:, 1]) == pytest.approx(width, rel=1e-3)
        assert not mesh.static


def test_what_says_no_width_has_one_unit_and_a_notice() -> None:
    mesh, scene = mesh_of(curves([(0, 0, 0), (10, 0, 0)], [2], type="linear"))
    assert signed_volume(mesh) == pytest.approx(math.pi / 4 * 10, rel=4e-3)
    assert "no widths" in texts(scene, "/C")


SIZES = [
    (kind, basis, wrap)
    for kind in ("linear", "cubic")
    for basis in ("bezier", "bspline", "catmullRom")
    for wrap in ("nonperiodic", "periodic", "pinned")
]


@pytest.mark.parametrize(("kind", "basis", "wrap"), SIZES)
def test_primvars_have_the_sizes_that_usd_says_and_their_values_stand_where_they_should(
    kind: str, basis: str, wrap: str
) -> None:
    counts = [6, 3] if basis == "bezier" and wrap == "periodic" and kind == "cubic" else [7, 4]
    text = curves([*WAVE, *WAVE][: sum(counts)], counts, type=kind, basis=basis, wrap=wrap, said=widths([0.1]))
    stage = stage_of(text)
    prim = UsdGeom.BasisCurves(stage.GetPrimAtPath("/C"))
    # Not ComputeVaryingDataSize: in OpenUSD 26.11 it forgets the phantom points of pinned curves, and that linear
    # curves have no basis. The schema's text says it so, and ComputeSegmentCounts follows it.
    size = sum(prim.ComputeSegmentCounts(TIME)) + (0 if wrap == "periodic" else len(counts))
    for interpolation, number in (("varying", size), ("vertex", sum(counts)), ("uniform", 2), ("constant", 1)):
        values = [(k, 2 * k, 1) for k in range(number)]
        said = f'color3f[] primvars:displayColor = {values} (interpolation = "{interpolation}")\n' + widths([0.1])
        changed = curves([*WAVE, *WAVE][: sum(counts)], counts, type=kind, basis=basis, wrap=wrap, said=said)
        mesh, scene = mesh_of(changed)
        assert not texts(scene, "/C")
        found = mesh.primvars["displayColor"]
        if interpolation == "constant":
            assert found.shape == (1, 1, 3)
            continue
        if interpolation == "uniform":
            assert set(np.unique(found[:, :, 0])) == {0.0, 1.0}
        elif interpolation == "varying" or kind == "linear":
            ends = np.unique(found[:, :, 0])
            assert ends[0] == 0.0
            assert ends[-1] == number - 1  # the last value of the last curve
        np.testing.assert_allclose(found[:, :, 1], 2 * found[:, :, 0], atol=1e-5)
        np.testing.assert_allclose(found[:, :, 2], 1.0, atol=1e-6)  # weights add up to 1


def test_vertex_primvars_lie_where_the_basis_puts_the_points() -> None:
    """A primvar that is the points themselves is the axis of the tube."""
    count = 8
    said = f'color3f[] primvars:displayColor = {WAVE[:count]} (interpolation = "vertex")\n{widths([0.001])}'
    for wrap in ("nonperiodic", "periodic", "pinned"):
        for basis in ("bspline", "catmullRom"):
            mesh, scene = mesh_of(curves(WAVE[:count], [count], type="cubic", basis=basis, wrap=wrap, said=said))
            where = to_stage(scene, mesh.points[mesh.triangles].reshape(-1, 3))
            axis = mesh.primvars["displayColor"].reshape(-1, 3)
            assert np.abs(where - axis).max() < 0.001


def test_texture_coordinates_are_read_along_the_curve() -> None:
    said = f'texCoord2f[] primvars:st = [(0, 0.25), (1, 0.25)] (interpolation = "varying")\n{widths([0.1])}'
    text = curves([(0, 0, 0), (4, 0, 0)], [2], type="linear", said=said) + _TEXTURED
    bound = 'def BasisCurves "C" (\n prepend apiSchemas = ["MaterialBindingAPI"]\n) {\n rel material:binding = </M>'
    mesh, scene = mesh_of(text.replace('def BasisCurves "C" {', bound))
    x = to_stage(scene, mesh.points[mesh.triangles].reshape(-1, 3))[:, 0]
    np.testing.assert_allclose(mesh.primvars["st"].reshape(-1, 2)[:, 0], x / 4, atol=1e-5)


_TEXTURED = """
def Material "M" {
    token outputs:surface.connect = </M/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </M/R.outputs:result>
        token outputs:surface
    }
    def Shader "R" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
}"""


# --- ribbons --------------------------------------------------------------------------------------------------------


def normals(values: Sequence[Any], interpolation: str) -> str:
    return f'normal3f[] normals = {values} (interpolation = "{interpolation}")'


@pytest.mark.parametrize(
    ("interpolation", "values"),
    [("constant", [(0, 0, 1)]), ("uniform", [(0, 0, 1)]), ("varying", [(0, 0, 1)] * 2), ("vertex", [(0, 0, 2)] * 4)],
)
def test_a_straight_ribbon_is_a_rectangle_that_faces_its_normals(interpolation: str, values: list[Any]) -> None:
    text = curves([(x, 0, 0) for x in range(4)], [4], type="cubic", basis="bezier",
                  said=normals(values, interpolation) + "\n" + widths([0.5]))  # fmt: skip
    mesh, scene = mesh_of(text)
    assert not mesh.closed
    assert mesh.double_sided
    assert areas(mesh.points, mesh.triangles).sum(axis=0) == pytest.approx((0, 0, 1.5), abs=1e-6)
    assert np.ptp(mesh.points, axis=0) == pytest.approx((3, 0.5, 0), abs=1e-6)
    assert np.abs(shading(mesh) - (0, 0, 1)).max() < 1e-6
    assert not texts(scene, "/C")


def test_a_twisted_ribbon_is_as_wide_everywhere_and_turns_with_its_normals() -> None:
    said = normals([(0, 0, 1), (0, 1, 0)], "varying") + "\n" + widths([0.5])
    mesh, scene = mesh_of(curves([(0, 0, 0), (4, 0, 0)], [2], type="linear", said=said))
    points = to_stage(scene, mesh.points)
    for x in (0.0, 4.0):
        (a, b) = points[np.abs(points[:, 0] - x) < 1e-5]
        assert np.linalg.norm(a - b) == pytest.approx(0.5)
    first = points[np.abs(points[:, 0]) < 1e-5]
    assert np.ptp(first[:, 2]) < 1e-6


# --- what is wrong --------------------------------------------------------------------------------------------------

LINE = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]
BAD = {
    "too few": (curves(LINE, [3, 1], type="cubic", basis="bezier", said=widths([1])), "is not 4, 7, 10", 0),
    "some too few": (curves(LINE, [2, 1], type="linear", said=widths([1])), "is not 2 or more", 1),
    "beyond": (curves(LINE, [2, 9], type="linear", said=widths([1])), "beyond the 4 points", 1),
    "left over": (curves(LINE, [2], type="linear", said=widths([1])), "belong to no curve", 1),
    "negative": (curves(LINE, [2, -2], type="linear", said=widths([1])), "negative", 0),
    "no counts": (curves(LINE, [], type="linear", said=widths([1])), "no curveVertexCounts", 0),
    "no points": (curves([], [2], type="linear", said=widths([1])), "no points", 0),
    "NaN": (curves(LINE, [2, 2], type="linear", said=widths([1])).replace("(3.0, 0.0, 0.0)", "(nan, 0, 0)"), "NaN", 1),
    "NaN width": (curves(LINE, [4], type="linear", said="float[] widths = [1, nan, 1, 1]"), "negative, NaN", 1),
    "negative width": (curves(LINE, [4], type="linear", said=widths([-1])), "negative, NaN or infinite", 0),
    "many widths": (curves(LINE, [4], type="linear", said=widths([1, 2, 3], "vertex")), "takes 4 values", 1),
    "normals": (curves(LINE, [4], type="linear", said=widths([1]) + "\n" + normals([(0, 0, 1)] * 3, "vertex")),
                "round tubes drawn", 1),
    "no length": (curves([(1, 1, 1)] * 4, [4], type="linear", said=widths([1])), "has a length", 0),
    "no width": (curves(LINE, [4], type="linear", said=widths([0])), "all 0", 0),
    "basis": (curves(LINE, [4], type="cubic", basis="power", said=widths([1])), "basis is 'power'", 0),
    "wrap": (curves(LINE, [4], type="linear", wrap="both", said=widths([1])), "wrap is 'both'", 0),
    "tangents": (curves(LINE, [4], kind="HermiteCurves", said=widths([1])), "0 tangents", 0),
    "ribbons along": (curves(LINE, [4], type="linear", said=widths([1]) + "\n" + normals([(1, 0, 0)], "constant")),
                      "", 1),
}  # fmt: skip


@pytest.mark.parametrize("name", list(BAD))
def test_what_is_wrong_with_curves_is_said_once(name: str) -> None:
    text, words, meshes = BAD[name]
    scene = read(text)
    assert len(scene.meshes) == meshes
    for mesh in scene.meshes:
        assert np.isfinite(mesh.points).all()
        assert np.isfinite(shading(mesh)).all()
    said = [notice.text for notice in scene.notices if notice.path == "/C"]
    assert (len(said), words in said[0]) in ((1, True), (2, True)) if words else not said


# --- how finely -----------------------------------------------------------------------------------------------------


def fur(count: int, points: int = 4, seed: int = 1) -> Usd.Stage:
    stage = stage_of('def BasisCurves "C" {}')
    dice = np.random.default_rng(seed)
    roots = dice.uniform(-1, 1, (count, 1, 3)) * np.array([1.0, 0.0, 1.0])
    steps = dice.normal(0, 0.01, (count, points, 3)) + np.array([0.0, 0.05, 0.0])
    steps[:, 0] = 0.0
    prim = UsdGeom.BasisCurves(stage.GetPrimAtPath("/C"))
    prim.CreateTypeAttr("cubic")
    prim.CreateBasisAttr("bezier")
    prim.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(count, points, np.int32)))
    at = (roots + np.cumsum(steps, axis=1)).reshape(-1, 3).astype(np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(at))
    prim.CreateWidthsAttr(Vt.FloatArray([0.002]))
    prim.SetWidthsInterpolation("constant")
    return stage


def test_many_hairs_are_plain_tubes_and_say_so_and_one_is_round() -> None:
    one = scene_from_stage(fur(1))
    assert not texts(one, "/C")
    assert len(one.meshes[0].triangles) > 500
    many = scene_from_stage(fur(60_000))
    (mesh,) = many.meshes
    assert len(mesh.triangles) == 60_000 * (3 * 2 * 3 + 2)  # 3 sides and 3 segments of a hair, and its ends
    assert "3 sides" in texts(many, "/C")


def test_a_long_yarn_keeps_its_bends() -> None:
    """One curve of a million points is not hair: it loses sides and some points, but no coil."""
    turn = np.linspace(0.0, 2 * math.pi * 10_000, 1_000_000)
    at = np.stack((np.cos(turn), np.sin(turn), turn * 0.01), axis=1)
    stage = stage_of('def BasisCurves "C" {}')
    prim = UsdGeom.BasisCurves(stage.GetPrimAtPath("/C"))
    prim.CreateTypeAttr("linear")
    prim.CreateCurveVertexCountsAttr([len(at)])
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(at.astype(np.float32)))
    prim.CreateWidthsAttr([0.01])
    scene = scene_from_stage(stage)
    (mesh,) = scene.meshes
    assert len(mesh.triangles) <= 4_000_000
    points = to_stage(scene, mesh.points)
    assert np.hypot(points[:, 0], points[:, 1]).min() > 0.98  # chords of at least 25 to a coil
    assert "one segment for" in texts(scene, "/C")


def test_a_fibre_beside_fur_stays_round() -> None:
    stage = fur(60_000)
    other = UsdGeom.BasisCurves.Define(stage, "/Fibre")
    other.CreateTypeAttr("linear")
    other.CreateCurveVertexCountsAttr([2])
    other.CreatePointsAttr([(0, 0, 0), (1, 0, 0)])
    other.CreateWidthsAttr([0.1])
    scene = scene_from_stage(stage)
    fibre = next(mesh for mesh in scene.meshes if mesh.path == "/Fibre")
    assert len(fibre.triangles) >= 4 * 24


# --- glass ----------------------------------------------------------------------------------------------------------

_ROOM = WALL_SEEN + """
def DistantLight "L" { float inputs:intensity = 50000 }
def Material "Glass" {
    token outputs:surface.connect = </Glass/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        float inputs:opacity = 0
        float inputs:roughness = 0
        float inputs:ior = 1.5
        token outputs:surface } }
"""
_OF_GLASS = ' (\n prepend apiSchemas = ["MaterialBindingAPI"]\n) {\n rel material:binding = </Glass>\n'


def test_a_straight_fibre_of_glass_refracts_as_the_cylinder_of_its_size() -> None:
    line = curves([(-0.5, -1, 0), (0.5, 1, 0.4)], [2], type="linear", said=widths([0.6]))
    fibre = line.replace('"C" {', '"C"' + _OF_GLASS)
    axis = np.array([1.0, 2.0, 0.4])
    length = float(np.linalg.norm(axis))
    z = axis / length
    x = np.cross((0.0, 1.0, 0.0), z)
    x /= np.linalg.norm(x)
    rows = ", ".join(str((*map(float, row), 0.0)) for row in (x, np.cross(z, x), z))
    rod = f"""def Cylinder "C" {_OF_GLASS}
        double radius = 0.3
        double height = {length}
        uniform token axis = "Z"
        matrix4d xformOp:transform = ( {rows}, (0, 0, 0.2, 1) )
        uniform token[] xformOpOrder = ["xformOp:transform"] }}"""
    settings = rc.RenderSettings(image_width=96, image_height=96, samples=64, tolerance=0.0, caustics=0)

    def picture(text: str) -> F32:
        found: F32 = rc.render(read(_ROOM + text, complexity="veryhigh"), settings).planes["beauty"][..., :3]
        return found

    ours, theirs, empty = picture(fibre), picture(rod), picture("")
    seen = np.abs(theirs - empty).max(axis=2) > 0.01
    assert seen.mean() > 0.05
    assert np.sqrt(((ours - theirs)[seen] ** 2).mean()) < 0.03 * np.sqrt(((theirs - empty)[seen] ** 2).mean())


def test_curves_of_glass_are_solids_and_ribbons_panes() -> None:
    line = curves([(-1, 0, 0), (1, 0, 0)], [2], type="linear", said=widths([0.6])).replace('"C" {', '"C"' + _OF_GLASS)
    flat = line.replace("float[] widths", "normal3f[] normals = [(0, 0, 1), (0, 0, 1)]\nfloat[] widths")
    models = [read(_ROOM + text).materials for text in (line, flat)]
    assert [next(m.model for m in rows if m.name == "/Glass") for rows in models] == [Model.TRACED, Model.THIN]
