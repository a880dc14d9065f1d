"""Subdivision surfaces as they are read: against the rules written down in `subdivision_rules`, closed forms from the
papers, and Embree's own evaluation of the same surface."""

from __future__ import annotations

import ctypes
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import subdivision_rules as rules
from numpy.typing import NDArray
from scene_reading import CUBE, WALL_SEEN, areas, read, signed_volume, solid, stage_of, texts, to_stage
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree
from subdivision_rules import Net

import refract_core as rc
from refract_core.errors import UsageError
from refract_core.scene import Mesh, Scene
from refract_core.usd.stage import scene_from_stage
from refract_core.world.embree import library

F64 = NDArray[np.float64]
Faces = list[list[int]]
Crease = tuple[Sequence[int], float]


def MESH(
    points: Iterable[Sequence[float]] | F64,
    faces: Faces,
    *,
    scheme: str = "catmullClark",
    creases: Sequence[Crease] = (),
    corners: dict[int, float] | None = None,
    extra: str = "",
    name: str = "M",
) -> str:
    listed = ", ".join(f"({x!r}, {y!r}, {z!r})" for x, y, z in np.asarray(list(points), float).tolist())
    chains = [list(chain) for chain, _ in creases]
    return f"""def Mesh "{name}" {{
        uniform token subdivisionScheme = "{scheme}"
        int[] faceVertexCounts = {[len(face) for face in faces]}
        int[] faceVertexIndices = {[i for face in faces for i in face]}
        point3f[] points = [{listed}]
        int[] creaseIndices = {[i for chain in chains for i in chain]}
        int[] creaseLengths = {[len(chain) for chain in chains]}
        float[] creaseSharpnesses = {[sharpness for _, sharpness in creases]}
        int[] cornerIndices = {list(corners or {})}
        float[] cornerSharpnesses = {list((corners or {}).values())}
        {extra} }}
        """


def surface(points: Iterable[Sequence[float]] | F64, faces: Faces, **how: Any) -> tuple[Scene, Mesh, F64]:
    """A scene with one surface, that surface, and its points in the stage's world; those of the cage come first."""
    complexity = how.pop("complexity", "low")
    scene = read(MESH(points, faces, **how), complexity=complexity)
    (mesh,) = scene.meshes
    return scene, mesh, to_stage(scene, mesh.points)


def grid(side: int, height: F64 | None = None) -> tuple[F64, Faces]:
    """A square of side x side quads in the xy plane, facing +z."""
    at = np.arange((side + 1) ** 2)
    points = np.stack((at % (side + 1), at // (side + 1), np.zeros(len(at))), axis=1).astype(float)
    if height is not None:
        points[:, 2] = height
    row = side + 1
    faces = [
        [y * row + x, y * row + x + 1, (y + 1) * row + x + 1, (y + 1) * row + x]
        for y in range(side)
        for x in range(side)
    ]
    return points, faces


def random_cage(seed: int, *, triangles: bool = False) -> tuple[F64, Faces]:
    """A closed cage around the origin with polygons of many sizes and points of many valences."""
    rng = np.random.default_rng(seed)
    points, faces = solid("cube")
    net = rules.finer(Net([np.array(p, float) for p in points], faces))
    shape, faces = [np.array(p) for p in net.points], net.faces
    for _ in range(6):  # a point in the middle of a face
        face = faces.pop(int(rng.integers(len(faces))))
        shape.append(np.mean([shape[i] for i in face], axis=0) * 1.1)
        faces += [[a, b, len(shape) - 1] for a, b in zip(face, face[1:] + face[:1], strict=True)]
    for _ in range(6):  # two faces with one edge between them become one
        edges = [pair for pair in Net(shape, faces).edges().values()]
        one, other = edges[int(rng.integers(len(edges)))]
        shared = set(faces[one]) & set(faces[other])
        if len(shared) == 2 and all(sum(i in face for face in faces) > 3 for i in shared):
            first, second = (turned(faces[number], shared) for number in (one, other))
            faces = [face for number, face in enumerate(faces) if number not in (one, other)]
            faces.append(first + second[1:-1])
    if triangles:
        faces = [[face[0], b, c] for face in faces for b, c in pairwise(face[1:])]
    return np.array(shape) + 0.08 * rng.normal(size=(len(shape), 3)), faces


def turned(face: list[int], edge: set[int]) -> list[int]:
    """A face that begins after one end of an edge and comes to it last."""
    for start in range(len(face)):
        found = face[start:] + face[:start]
        if {found[0], found[-1]} == edge:
            return found
    raise AssertionError


def net_of(points: F64, faces: Faces, creases: Sequence[Crease] = (), corners: dict[int, float] | None = None) -> Net:
    sharp = {
        frozenset(pair): sharpness
        for chain, sharpness in creases
        for pair in pairwise(chain)
    }
    return Net([np.array(p, float) for p in points], faces, sharp, dict(corners or {}))


def limit_by_formula(net: Net, i: int, loop: bool = False) -> F64:
    """Halstead, Kass and DeRose 1993 for quads around a smooth point; Hoppe et al. 1994 for triangles."""
    v = net.points[i]
    others = [net.points[j] for edge in net.edges() if i in edge for j in edge - {i}]
    n = len(others)
    if loop:
        beta = (5 / 8 - (3 / 8 + math.cos(2 * math.pi / n) / 4) ** 2) / n
        share = 1 / (3 / (8 * beta) + n)
        return (1 - n * share) * v + share * np.sum(others, axis=0)
    across = [net.points[face[(face.index(i) + 2) % 4]] for face in net.faces if i in face]
    return (n * n * v + 4 * np.sum(others, axis=0) + np.sum(across, axis=0)) / (n * (n + 5))


# --- positions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("complexity", ["low", "medium"])
@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_cages_of_any_kind_end_where_the_formula_says(seed: int, loop: bool, complexity: str) -> None:
    points, faces = random_cage(seed, triangles=loop)
    scheme = "loop" if loop else "catmullClark"
    _, _, found = surface(points, faces, scheme=scheme, complexity=complexity)
    net = rules.finer(net_of(points.astype(np.float32), faces), loop)  # so that all are quads
    expected = [limit_by_formula(net, i, loop) for i in range(len(points))]
    assert found[: len(points)] == pytest.approx(np.array(expected), abs=2e-6)


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_creases_that_are_sharp_for_a_while(seed: int, loop: bool) -> None:
    """Three steps of the written rules leave nothing sharp but what stays so; then the formulas hold."""
    rng = np.random.default_rng(seed)
    points, faces = random_cage(seed, triangles=loop)
    if seed % 2:
        faces = faces[:-4]  # open
    edges = [sorted(edge) for edge in net_of(points, faces).edges()]
    picked = rng.choice(len(edges), 8, replace=False)
    creases: list[Crease] = [(edges[k], float(rng.choice([0.3, 1, 1.7, 2.6, 10]))) for k in picked]
    corners = {int(faces[0][0]): 2.5, int(faces[3][1]): 10.0}
    how: dict[str, Any] = {"scheme": "loop" if loop else "catmullClark", "creases": creases, "corners": corners}
    _, _, found = surface(points, faces, extra='uniform token interpolateBoundary = "edgeOnly"', **how)
    net = net_of(points.astype(np.float32), faces, creases, corners)
    net.pinned |= dict.fromkeys(touching(net), 10.0)
    near = rules.after(net, 3, loop)
    of_edge = near.edges()
    checked = Counter[str]()
    used = sorted({i for face in faces for i in face})
    for place, i in enumerate(used):
        mine = [edge for edge in of_edge if i in edge]
        sharp = [edge for edge in mine if near.sharp.get(edge, 0) > 0 or len(of_edge[edge]) == 1]
        if near.pinned.get(i, 0) > 0 or len(sharp) > 2:
            expected, kind = near.points[i], "corner"
        elif len(sharp) == 2:
            ends = [near.points[j] for edge in sharp for j in edge - {i}]
            expected, kind = (4 * near.points[i] + ends[0] + ends[1]) / 6, "crease"
        elif not sharp:
            expected, kind = limit_by_formula(near, i, loop), "smooth"
        else:
            continue
        checked[kind] += 1
        assert found[place] == pytest.approx(expected, abs=2e-6), (i, kind)
    assert checked["corner"] >= 1
    assert checked["smooth"] >= 5


def touching(net: Net) -> list[int]:
    """Points where surfaces only touch: their faces do not make one fan."""
    found = []
    for i in range(len(net.points)):
        mine = [set(face) for face in net.faces if i in face]
        links = [pair for edge, pair in net.edges().items() if i in edge and len(pair) == 2]
        if mine and len(links) < len(mine) - 1:
            found.append(i)
    return found


def test_inside_of_a_regular_grid_is_the_bicubic_b_spline() -> None:
    rng = np.random.default_rng(3)
    points, faces = grid(7, rng.normal(size=64))
    _, mesh, found = surface(points, faces)
    heights = points[:, 2].astype(np.float32).reshape(8, 8)
    knots = np.arange(12.0) - 2.0  # so that the parameter is the position
    spline = BSpline(knots, heights.astype(float), 3)
    inner = np.all((found[:, :2] >= 2) & (found[:, :2] <= 5), axis=1)
    assert inner.sum() >= 13 * 13
    for x, y, z in found[inner]:
        rows = spline(y)
        assert z == pytest.approx(float(BSpline(knots, rows, 3)(x)), abs=1e-5)
    assert (areas(mesh.points, mesh.triangles)[:, 2] > 0).all()


@pytest.mark.parametrize("rule", ["edgeOnly", "edgeAndCorner", "none"])
@pytest.mark.parametrize("scheme", ["catmullClark", "loop"])
def test_boundaries(rule: str, scheme: str) -> None:
    """A cubic B-spline along the boundary, whose corners are sharp, round, or not there at all."""
    points, faces = grid(5, np.random.default_rng(1).normal(size=36))
    if scheme == "loop":
        faces = [part for a, b, c, d in faces for part in ([a, b, d], [b, c, d])]
    _, mesh, found = surface(points, faces, scheme=scheme, extra=f'uniform token interpolateBoundary = "{rule}"')
    exact = points.astype(np.float32).astype(float)
    if rule == "none":
        # Around what is left there is a ring of faces that only shape it.
        open_too = 'uniform token interpolateBoundary = "edgeOnly"'
        _, whole_mesh, whole = surface(points, faces, scheme=scheme, extra=open_too)
        assert cKDTree(whole).query(found)[0].max() < 1e-6
        left = [face for face in faces if all(0 < i % 6 < 5 and 0 < i // 6 < 5 for i in face)]
        assert len(mesh.triangles) * len(faces) == len(whole_mesh.triangles) * len(left)
        return
    assert found[1:5] == pytest.approx((exact[0:4] + 4 * exact[1:5] + exact[2:6]) / 6, abs=1e-6)
    two_faces = scheme == "loop"  # which one of the two at this corner is cut off
    for corner, beside in ((0, (1, 6)), (35, (34, 29))):
        rounded = (4 * exact[corner] + exact[beside[0]] + exact[beside[1]]) / 6
        assert found[corner] == pytest.approx(exact[corner] if rule == "edgeAndCorner" else rounded, abs=1e-6)
    if two_faces:
        rounded = (4 * exact[5] + exact[4] + exact[11]) / 6
        assert found[5] == pytest.approx(rounded, abs=1e-6)  # two faces make no corner


def test_an_endless_crease_is_a_b_spline_and_has_two_normals() -> None:
    points, faces = solid("cube")
    ring = [i for i, p in enumerate(points) if p[2] > 0]
    a, b, c, d = (next(i for i in ring if points[i][:2] == at) for at in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    _, mesh, found = surface(points, faces, creases=[((a, b, c, d, a), 10.0)], complexity="high")
    on_top = np.isclose(found[:, 2], 1.0, atol=1e-6)
    knots = np.arange(-3.0, 8.0)
    curve = BSpline(knots, np.array([points[i] for i in (a, b, c, d, a, b, c)], float), 3)
    on_curve = curve(np.arange(64) / 16)
    assert cKDTree(found).query(on_curve)[0].max() < 1e-6
    rim = cKDTree(on_curve).query(found)[0] < 1e-6
    assert mesh.normals is not None
    # The lid is flat, so one side of the rim looks up; the other one looks away from it.
    at_rim = rim[mesh.triangles]
    lid = on_top[mesh.triangles].all(axis=1)
    ups = mesh.normals[..., 2]
    assert ups[lid] == pytest.approx(1.0, abs=1e-5)
    assert at_rim[~lid].any()
    assert np.abs(ups[~lid][at_rim[~lid]]).max() < 0.9


def test_a_crease_may_have_a_sharpness_for_each_of_its_edges() -> None:
    points, faces = solid("cube")
    each = 'float[] creaseSharpnesses = [0.5, 4]'
    text = MESH(points, faces, creases=[((0, 1, 3), 9.0)]).replace("float[] creaseSharpnesses = [9.0]", each)
    apart = MESH(points, faces, creases=[((0, 1), 0.5), ((1, 3), 4.0)])
    one, other = (read(some).meshes[0] for some in (text, apart))
    np.testing.assert_array_equal(one.points, other.points)


def test_all_sharp_is_the_cage_itself() -> None:
    points, faces = random_cage(5)
    corners = dict.fromkeys(range(len(points)), 10.0)
    creases: list[Crease] = [(sorted(edge), 10.0) for edge in net_of(points, faces).edges()]
    _, mesh, found = surface(points, faces, creases=creases, corners=corners)
    assert found[: len(points)] == pytest.approx(points, abs=1e-6)
    on_edges = [points[i] + (points[j] - points[i]) * t for (i, j), _ in creases for t in (0.25, 0.5, 0.75)]
    assert cKDTree(found).query(np.array(on_edges))[0].max() < 1e-6
    assert mesh.closed


def test_smooth_triangles_pull_less_on_their_edges() -> None:
    """OpenSubdiv's `smooth`: the middle of a triangle weighs 0.470 in the point of an edge, not 1/4."""
    points, faces = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)], [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
    plain, smooth = (
        surface(points, faces, extra=f'uniform token triangleSubdivisionRule = "{rule}"')[2]
        for rule in ("catmullClark", "smooth")
    )
    at = np.array(points, float)
    net = rules.finer(net_of(at, faces))
    for k, (edge, beside) in enumerate(sorted(net_of(at, faces).edges().items(), key=lambda item: sorted(item[0]))):
        a, b = sorted(edge)
        means = sum(at[faces[number]].mean(axis=0) for number in beside)
        place = next(i for i, p in enumerate(net.points) if np.allclose(p, (at[a] + at[b] + means) / 4))
        net.points[place] = (1 - 2 * 0.470) * (at[a] + at[b]) / 2 + 0.470 * means
        assert k < 6
    expected = np.array([limit_by_formula(net, i) for i in range(4)])
    assert smooth[:4] == pytest.approx(expected, abs=1e-6)
    assert np.abs(plain[:4] - smooth[:4]).max() > 1e-3


# --- normals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["catmullClark", "loop"])
def test_normals_are_those_of_the_surface(scheme: str) -> None:
    """Of ever smaller triangles at the same place, ever closer."""
    points, faces = random_cage(2, triangles=scheme == "loop")
    worst = []
    for complexity in ("low", "high"):
        _, mesh, _ = surface(points, faces, scheme=scheme, complexity=complexity)
        flat = areas(mesh.points, mesh.triangles)
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        assert mesh.normals is not None
        cosines = np.einsum("tcj,tj->tc", mesh.normals, flat)
        worst.append(np.degrees(np.arccos(np.clip(np.percentile(cosines, 1), -1, 1))))
        assert np.linalg.norm(mesh.normals, axis=2) == pytest.approx(1.0, abs=1e-5)
    assert worst[1] < 0.4 * worst[0]
    assert worst[1] < 6


def zoomed(net: Net, i: int, loop: bool) -> tuple[F64, F64]:
    """Where the written rules take a point in the end, and the normals of the faces around it there, in their order.

    A ring needs nothing but itself. What is far away is left behind, what is left is made as large as before."""
    origin, scale = np.zeros(3, np.longdouble), np.longdouble(1.0)
    net = Net([p.astype(np.longdouble) for p in net.points], net.faces, net.sharp, net.pinned)
    for _ in range(40):
        net = rules.finer(Net(net.points, [face for face in net.faces if i in face], net.sharp, net.pinned), loop)
        net.faces = [face for face in net.faces if i in face]
        used = sorted({j for face in net.faces for j in face} - {i})
        number = {i: 0} | {j: k + 1 for k, j in enumerate(used)}
        here = net.points[i]
        size = max(np.abs(net.points[j] - here).max() for j in used)
        origin, scale = origin + scale * here, scale * size
        net = Net(
            [(net.points[j] - here) / size for j in (i, *used)],
            [[number[j] for j in face] for face in net.faces],
            {frozenset(number[j] for j in edge): sharp for edge, sharp in net.sharp.items() if edge <= number.keys()},
            {0: net.pinned.get(i, 0.0)},
        )
        i = 0
    turned_round = [face[face.index(0) :] + face[: face.index(0)] for face in net.faces]
    normals = np.array([np.cross(net.points[face[1]], net.points[face[-1]]) for face in turned_round])
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    return origin.astype(np.float64), normals.astype(np.float64)


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_normals_and_positions_where_creases_run_and_end(seed: int, loop: bool) -> None:
    """By the written rules, forty steps deep, for each face at each point of the cage."""
    rng = np.random.default_rng(100 + seed)
    points, faces = random_cage(seed, triangles=loop)
    if not loop:  # quads alone, so that a ring is one from the start
        net = rules.finer(net_of(points, faces))
        points, faces = np.array(net.points), net.faces
    if seed % 3 == 2:
        faces = faces[: len(faces) * 3 // 4]
    edges = [sorted(edge) for edge in net_of(points, faces).edges()]
    picked = rng.choice(len(edges), len(edges) // 6, replace=False)
    creases: list[Crease] = [(edges[k], float(rng.choice([0.6, 1.5, 10, 10]))) for k in picked]
    text = primvar("displayColor", "color3f", [(float(k), 0.0, 0.0) for k in range(len(faces))], "uniform")
    text += 'uniform token interpolateBoundary = "edgeOnly"'
    how: dict[str, Any] = {"scheme": "loop" if loop else "catmullClark", "creases": creases}
    _, mesh, found = surface(points, faces, extra=text, **how)
    net = net_of(points.astype(np.float32), faces, creases)
    used = sorted({i for face in faces for i in face})
    assert mesh.normals is not None
    owner = np.broadcast_to(mesh.primvars["displayColor"][..., 0], mesh.triangles.shape).astype(int)
    touched = set(touching(net))
    kinds = Counter[str]()
    for place, i in enumerate(used):
        mine = {edge: beside for edge, beside in net.edges().items() if i in edge}
        endless = sum(len(beside) == 1 or net.sharp.get(edge, 0) >= 10 for edge, beside in mine.items())
        around = [k for k, face in enumerate(faces) if i in face]
        if i in touched or endless > 2 or len(around) < 3 or len(around) > 7:
            continue
        position, normals = zoomed(net, i, loop)
        assert found[place] == pytest.approx(position, abs=2e-6), i
        if endless == 2 and len(mine) > len(around) > 3:
            continue  # the rules themselves are slow to settle there
        kinds[("smooth", "end", "crease")[endless]] += 1
        for face, normal in zip(around, normals, strict=True):
            ours = mesh.normals[(mesh.triangles == place) & (owner == face)]
            assert ours @ normal == pytest.approx(1.0, abs=2e-4), (i, face, endless)
    assert kinds["smooth"] > 2
    assert kinds["end"] + kinds["crease"] > 3


def test_the_tip_of_a_cone_has_a_normal_for_each_face() -> None:
    points, faces = solid("cube")
    _, mesh, _ = surface(points, faces, corners={7: 10.0})
    assert mesh.normals is not None
    at_tip = np.unique(mesh.normals[mesh.triangles == 7].round(5), axis=0)
    assert len(at_tip) == 3
    turned_once = np.roll(at_tip, 1, axis=1)  # the cube is its own picture when x becomes y, y z and z x
    assert cKDTree(at_tip).query(turned_once)[0].max() < 1e-4


def test_smooth_surfaces_have_one_normal_at_each_point() -> None:
    points, faces = random_cage(4)
    _, mesh, _ = surface(points, faces, creases=[(faces[0][:2], 3.0)])
    assert mesh.normals is not None
    first = np.zeros((len(mesh.points), 3))
    first[mesh.triangles.ravel()] = mesh.normals.reshape(-1, 3)
    assert first[mesh.triangles] == pytest.approx(mesh.normals, abs=1e-6)


def test_a_cubes_normals_by_its_symmetry() -> None:
    """At the corner of a cube the diagonal, in the middle of a face its axis; turned with the orientation."""
    for hand, sign in (("right", 1), ("left", -1)):
        scene = read(CUBE(scheme="catmullClark", extra=f'uniform token orientation = "{hand}Handed"'))
        (mesh,) = scene.meshes
        at = mesh.points[mesh.triangles] - mesh.points.mean(axis=0)
        assert mesh.normals is not None
        lengths = np.linalg.norm(at, axis=2)
        corners = np.isclose(np.abs(at), 0.5, atol=1e-6).all(axis=2)
        assert corners.sum() >= 24
        assert mesh.normals[corners] == pytest.approx(sign * at[corners] / lengths[corners][:, None], abs=1e-6)
        middles = np.isclose(np.sort(np.abs(at), axis=2)[..., 1], 0.0, atol=1e-6)
        assert mesh.normals[middles] == pytest.approx(sign * at[middles] / lengths[middles][:, None], abs=1e-6)
        assert np.sign(signed_volume(mesh)) == sign


def test_a_boundary_of_a_plane_looks_straight_up() -> None:
    for scheme in ("catmullClark", "loop"):
        points, faces = grid(3)
        if scheme == "loop":
            faces = [part for a, b, c, d in faces for part in ([a, b, d], [b, c, d])]
        for rule in ("edgeOnly", "edgeAndCorner"):
            _, mesh, _ = surface(points, faces, scheme=scheme, extra=f'uniform token interpolateBoundary = "{rule}"')
            assert mesh.normals is not None
            assert mesh.normals == pytest.approx(np.broadcast_to((0.0, 0.0, 1.0), mesh.normals.shape), abs=1e-6)


# --- Embree as a witness --------------------------------------------------------------------------------------------


class _Interpolate(ctypes.Structure):
    """RTCInterpolateArguments."""

    _fields_ = [
        ("geometry", ctypes.c_void_p), ("face", ctypes.c_uint), ("u", ctypes.c_float), ("v", ctypes.c_float),
        ("buffer", ctypes.c_int), ("slot", ctypes.c_uint), ("P", ctypes.c_void_p), ("dPdu", ctypes.c_void_p),
        ("dPdv", ctypes.c_void_p), ("ddPdudu", ctypes.c_void_p), ("ddPdvdv", ctypes.c_void_p),
        ("ddPdudv", ctypes.c_void_p), ("count", ctypes.c_uint),
    ]  # fmt: skip


def by_embree(points: F64, faces: Faces, side: int) -> tuple[F64, F64]:
    """Limit positions and normals on a grid in each quad, by Embree's evaluation of its own subdivision geometry."""
    lib = library()
    lib.rtcInterpolate.restype, lib.rtcInterpolate.argtypes = None, [ctypes.c_void_p]
    device = lib.rtcNewDevice(None)
    scene, geometry = lib.rtcNewScene(device), lib.rtcNewGeometry(device, 8)
    vertices = np.zeros((len(points) + 2, 3), np.float32)
    vertices[: len(points)] = points
    counts = np.array([len(face) for face in faces], np.uint32)
    indices = np.array([i for face in faces for i in face], np.uint32)
    for kind, layout, array, stride, count in (
        (16, 0x5001, counts, 4, len(counts)),
        (0, 0x5001, indices, 4, len(indices)),
        (1, 0x9003, vertices, 12, len(points)),
    ):
        lib.rtcSetSharedGeometryBuffer(geometry, kind, 0, layout, array.ctypes.data, 0, stride, count)
    lib.rtcCommitGeometry(geometry)
    lib.rtcAttachGeometryByID(scene, geometry, 0)
    lib.rtcCommitScene(scene)
    assert lib.rtcGetDeviceError(device) == 0
    out = np.zeros((3, 4), np.float32)
    found = []
    for face in range(len(faces)):
        for u in np.linspace(0, 1, side):
            for v in np.linspace(0, 1, side):
                rows = [out[k].ctypes.data for k in range(3)]
                asked = _Interpolate(geometry, face, u, v, 1, 0, *rows, None, None, None, 3)
                lib.rtcInterpolate(ctypes.byref(asked))
                found.append(out[:, :3].astype(np.float64))
    lib.rtcReleaseGeometry(geometry)
    lib.rtcReleaseScene(scene)
    lib.rtcReleaseDevice(device)
    positions, du, dv = np.stack(found, axis=1)
    normals = np.cross(du, dv)
    return positions, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(3))
def test_embree_finds_the_same_surface(seed: int) -> None:
    """Smooth quads, which it knows exactly but for the derivatives at points of odd valence, where it stops early."""
    points, faces = random_cage(seed)
    net = rules.finer(net_of(points, faces))
    points, faces = np.array(net.points), net.faces
    _, mesh, found = surface(points, faces)
    positions, normals = by_embree(points, faces, 5)
    apart, nearest = cKDTree(found).query(positions)
    assert apart.max() < 2e-6
    assert cKDTree(positions).query(found)[0].max() < 2e-6
    ours = np.zeros((len(found), 3))
    assert mesh.normals is not None
    ours[mesh.triangles.ravel()] = mesh.normals.reshape(-1, 3)
    cosines = np.einsum("ij,ij->i", ours[nearest], normals)
    regular = nearest >= len(points)
    assert cosines[regular].min() > math.cos(math.radians(0.05))
    assert cosines.min() > math.cos(math.radians(3.0))


# --- what is closed stays closed ------------------------------------------------------------------------------------


def edge_uses(mesh: Mesh) -> Counter[tuple[int, int]]:
    corners = mesh.triangles.astype(int)
    return Counter(map(tuple, np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]).tolist()))


@pytest.mark.parametrize("scheme", ["catmullClark", "loop"])
@pytest.mark.parametrize("seed", range(4))
def test_closed_cages_make_closed_surfaces(seed: int, scheme: str) -> None:
    points, faces = random_cage(seed, triangles=scheme == "loop")
    creases: list[Crease] = [(faces[1][:3], 10.0), (faces[4][:2], 1.3)]
    volumes = []
    for complexity in ("low", "high"):
        _, mesh, _ = surface(points, faces, scheme=scheme, creases=creases, complexity=complexity)
        uses = edge_uses(mesh)
        assert set(uses.values()) == {1}
        assert all((b, a) in uses for a, b in uses)
        assert len(mesh.points) - len(uses) // 2 + len(mesh.triangles) == 2  # Euler's number of a ball
        assert mesh.closed
        volumes.append(signed_volume(mesh))
    assert volumes[1] == pytest.approx(volumes[0], rel=0.05)
    assert volumes[0] > 0


def test_a_torus_stays_a_torus_whose_rings_stay_in_their_planes() -> None:
    n, m = 6, 5
    angles = [(2 * math.pi * i / n, 2 * math.pi * j / m) for i in range(n) for j in range(m)]
    points = [((2 + math.cos(b)) * math.cos(a), (2 + math.cos(b)) * math.sin(a), math.sin(b)) for a, b in angles]
    faces = [
        [i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m]
        for i in range(n)
        for j in range(m)
    ]
    _, mesh, _ = surface(points, faces)
    assert mesh.closed
    assert len(mesh.points) - len(edge_uses(mesh)) // 2 + len(mesh.triangles) == 0


def test_seams_of_points_at_one_place_stay_together_where_both_sides_are_alike() -> None:
    """Six squares that only lie side by side: each stays flat, and the box stays shut."""
    points, faces = solid("cube")
    apart = [points[i] for face in faces for i in face]
    _, mesh, _ = surface(apart, [[4 * k, 4 * k + 1, 4 * k + 2, 4 * k + 3] for k in range(6)])
    assert mesh.closed
    assert signed_volume(mesh) == pytest.approx(8)


def test_holes_are_left_out_and_change_nothing_else() -> None:
    points, faces = random_cage(6)
    _, whole, all_points = surface(points, faces)
    _, mesh, found = surface(points, faces, extra="int[] holeIndices = [0, 5]")
    corners = sum(map(len, faces))
    assert len(mesh.triangles) * corners == len(whole.triangles) * (corners - len(faces[0]) - len(faces[5]))
    assert cKDTree(all_points).query(found)[0].max() < 1e-6
    assert whole.closed
    assert not mesh.closed


# --- what it carries ------------------------------------------------------------------------------------------------


def primvar(name: str, kind: str, values: Any, interpolation: str) -> str:
    return f'{kind}[] primvars:{name} = {values} (interpolation = "{interpolation}")\n'


def carried(points: F64, faces: Faces, text: str, **how: Any) -> tuple[F64, F64]:
    """displayColor per triangle corner, and where these corners are."""
    _, mesh, found = surface(points, faces, extra=text, **how)
    values = mesh.primvars["displayColor"]
    return np.broadcast_to(values, (len(mesh.triangles), 3, values.shape[-1])).astype(float), found[mesh.triangles]


def test_vertex_values_follow_the_points() -> None:
    """Whose values are the points' own places end where the points do."""
    points, faces = random_cage(1)
    own = [tuple(p) for p in points.astype(np.float32).tolist()]
    text = primvar("displayColor", "color3f", own, "vertex")
    values, at = carried(points, faces, text, creases=[(faces[0][:3], 2.5)])
    assert values == pytest.approx(at, abs=1e-5)


def test_varying_values_are_linear_between_points() -> None:
    points, faces = grid(4, np.random.default_rng(0).normal(size=25))
    places = [(x, y, 0.0) for x, y, _ in points.tolist()]
    values, at = carried(points, faces, primvar("displayColor", "color3f", places, "varying"))
    # A quad's parts have their corners at 16ths of it, or at fewer places.
    assert (values * 16)[..., :2] == pytest.approx(np.round(values * 16)[..., :2], abs=1e-5)
    inner = np.all((at[..., :2] > 1.01) & (at[..., :2] < 2.99), axis=2)
    assert values[inner][:, :2] == pytest.approx(at[inner][:, :2], abs=1e-5)  # there points move straight up


def test_uniform_and_constant_values_stay_with_their_faces() -> None:
    points, faces = random_cage(7)
    numbers = [(float(k), 0.0, 0.0) for k in range(len(faces))]
    values, _ = carried(points, faces, primvar("displayColor", "color3f", numbers, "uniform"))
    assert (values[..., 0] == values[:, :1, 0]).all()
    found = Counter(values[:, 0, 0].astype(int).tolist())
    each = len(values) // sum(map(len, faces))
    assert found == {k: each * len(face) for k, face in enumerate(faces)}
    values, _ = carried(points, faces, primvar("displayColor", "color3f", [(1.0, 2.0, 3.0)], "constant"))
    assert (values == (1.0, 2.0, 3.0)).all()


@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize("rule", ["all", "cornersPlus1", "cornersPlus2", "cornersOnly", "boundaries", "none"])
def test_face_varying_values(rule: str, indexed: bool) -> None:
    """Two charts with a seam at x = 2: values jump there and nowhere else, and keep or round their corners."""
    points, faces = grid(4)
    values = [(x + (10.0 if max(points[i][0] for i in face) > 2 else 0.0), y, 0.0)
              for face in faces for x, y, _ in (points[i].tolist() for i in face)]  # fmt: skip
    text = primvar("displayColor", "color3f", values, "faceVarying")
    if indexed:
        kinds = sorted(set(values))
        text = primvar("displayColor", "color3f", kinds, "faceVarying")
        text += f"int[] primvars:displayColor:indices = {[kinds.index(v) for v in values]}\n"
    text += f'uniform token faceVaryingLinearInterpolation = "{rule}"'
    found, at = carried(points, faces, text)
    right = at[..., 0].mean(axis=1) > 2
    assert (found[right][..., 0] > 11).all()
    assert (found[~right][..., 0] < 3).all()
    local = found - np.where(right, 10.0, 0.0)[:, None, None] * (1.0, 0.0, 0.0)
    chart = local[~right][..., :2].reshape(-1, 2)
    corner = np.abs(chart - (2.0, 0.0)).sum(axis=1).min()
    if rule == "none":
        # The corner of a chart is rounded as that of an edgeOnly boundary: (4 c + a + b) / 6.
        rounded = (4 * np.array((2, 0)) + (1, 0) + (2, 1)) / 6
        assert np.abs(chart - rounded).sum(axis=1).min() < 1e-5
        assert corner > 0.2
    else:
        assert corner < 1e-5
    if rule in ("all", "boundaries"):
        # Linear all along the seam: steps of one size, though the points of the boundary itself are not so far apart.
        edge = np.unique(chart[np.isclose(chart[:, 0], 2.0)][:, 1].round(4))
        assert len(edge) >= 5
        assert (rule != "all") or np.diff(edge) == pytest.approx(np.full(len(edge) - 1, 4 / (len(edge) - 1)), abs=1e-4)


@pytest.mark.parametrize(
    ("charts", "kept"),
    [
        ([0, 0, 1, 2], ("cornersPlus1", "cornersPlus2")),  # three charts meet
        ([0, 0, 1, 0], ("cornersPlus2",)),  # a chart around the corner of another one
        ([0, 0, 1, 1], ()),  # a seam that goes straight on
    ],
)
@pytest.mark.parametrize("rule", ["none", "cornersOnly", "cornersPlus1", "cornersPlus2", "boundaries", "all"])
def test_which_corners_of_a_chart_stay(charts: list[int], kept: tuple[str, ...], rule: str) -> None:
    """In the middle of four faces, of the chart of the first two: pinned, or a cubic B-spline along its seam."""
    points, faces = grid(2)
    rng = np.random.default_rng(0)
    of_chart = rng.normal(size=(3, 9, 3)).astype(np.float32)
    values = [tuple(of_chart[chart, i].tolist()) for chart, face in zip(charts, faces, strict=True) for i in face]
    text = primvar("displayColor", "color3f", values, "faceVarying")
    found, at = carried(points, faces, f'{text}uniform token faceVaryingLinearInterpolation = "{rule}"')
    middle = np.isclose(at, (1.0, 1.0, 0.0)).all(axis=2) & (at[..., 1].mean(axis=1) < 1)[:, None]
    mine = of_chart[0]
    ends = (3, 5) if charts[3] else (3, 7)
    pinned = rule in (*kept, "boundaries", "all")
    expected = mine[4] if pinned else (4 * mine[4] + mine[ends[0]] + mine[ends[1]]) / 6
    assert found[middle] == pytest.approx(np.broadcast_to(expected, found[middle].shape), abs=1e-5)


@pytest.mark.parametrize("rule", ["cornersPlus1", "cornersPlus2"])
def test_where_a_seam_ends(rule: str) -> None:
    """Values differ at one end of one edge only: its other end is inside of the chart, and pinned by cornersPlus2."""
    points, faces = grid(2)
    of_point = np.random.default_rng(2).normal(size=(10, 3)).astype(np.float32)
    faces_of_values = [[9 if (i == 7 and k == 3) else i for i in face] for k, face in enumerate(faces)]
    values = [tuple(of_point[i].tolist()) for face in faces_of_values for i in face]
    text = primvar("displayColor", "color3f", values, "faceVarying")
    found, at = carried(points, faces, f'{text}uniform token faceVaryingLinearInterpolation = "{rule}"')
    middle = np.isclose(at, (1.0, 1.0, 0.0)).all(axis=2)
    spline = (4 * of_point[4] + of_point[7] + of_point[9]) / 6
    expected = of_point[4] if rule == "cornersPlus2" else spline
    assert found[middle] == pytest.approx(np.broadcast_to(expected, found[middle].shape), abs=1e-5)


def test_face_varying_of_one_chart_is_as_smooth_as_the_surface() -> None:
    """On a closed surface without a seam, what is the points' places at the corners is their places at the limit."""
    points, faces = random_cage(8)
    single = points.astype(np.float32).tolist()
    values = [tuple(single[i]) for face in faces for i in face]
    creases: list[Crease] = [(faces[2][:3], 10.0), (faces[5][:2], 1.6)]
    found, at = carried(points, faces, primvar("displayColor", "color3f", values, "faceVarying"), creases=creases)
    assert found == pytest.approx(at, abs=1e-5)


def test_values_that_are_no_numbers_stay_alone() -> None:
    points, faces = grid(6)
    values = [(1.0, 1.0, 1.0)] * 48 + [(float("nan"), 1.0, 1.0)]
    scene, mesh, _ = surface(points, faces, extra=primvar("displayColor", "color3f", values, "vertex"))
    assert "has 1 values that are NaN" in texts(scene, "/M")
    found = mesh.primvars["displayColor"][..., 0]
    assert np.isfinite(found).all()
    assert (found > 0.999).mean() > 0.8


def test_materials_of_faces_go_to_what_they_become() -> None:
    points, faces = random_cage(9)
    chosen = [1, 4, 6]
    subset = f"""def GeomSubset "s" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = {chosen}
        rel material:binding = </Glass> }}"""
    scene = read(MESH(points, faces, extra=subset) + GLASS)
    (mesh,) = scene.meshes
    glass = [scene.materials[number].refractive for number in mesh.materials.tolist()]
    assert sum(glass) * sum(map(len, faces)) == len(glass) * sum(len(faces[k]) for k in chosen)


GLASS = """def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"]) {
    token refraction:model = "traced"
    token outputs:surface.connect = </Glass/S.outputs:surface>
    def Shader "S" {
        uniform token info:id = "UsdPreviewSurface"
        float inputs:opacity = 0.0
        float inputs:ior = 1.5
        float inputs:roughness = 0.0
        token outputs:surface } }
    """


# --- how fine -------------------------------------------------------------------------------------------------------


def test_complexity_says_how_fine() -> None:
    """Four times as many each; a few faces of a small cage are parted more often than many of a large one."""
    sizes = []
    for side in (1, 12):
        text = MESH(*grid(side))
        counts = [
            len(read(text, complexity=complexity).meshes[0].triangles)
            for complexity in ("low", "medium", "high", "veryhigh")
        ]
        assert counts == [counts[0] * 4**k for k in range(4)]
        sizes.append(counts[0] / side**2)
    assert sizes == [2 * 256, 2 * 16]
    with pytest.raises(UsageError, match="veryhigh"):
        read(text, complexity="extreme")


EIGHT = [[a, b, c] for a in (0, 3) for b in (1, 4) for c in (2, 5)]
OCTAHEDRON = (
    [(1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, -1)],
    [face[:: 1 if sum(i > 2 for i in face) % 2 == 0 else -1] for face in EIGHT],
)


@pytest.mark.parametrize(("cage", "scheme"), [(solid("cube"), "catmullClark"), (OCTAHEDRON, "loop")])
@pytest.mark.parametrize("pixels", [1024, 1920, 4096, 7680])
def test_outlines_are_round_in_large_pictures_too(cage: Any, scheme: str, pixels: int) -> None:
    """A surface that fills nine sixteenths of the longer side has chords that leave it by a pixel at most."""
    mesh = read(MESH(*cage, scheme=scheme), pixels=pixels).meshes[0]
    assert mesh.normals is not None
    ends = mesh.points[mesh.triangles].astype(np.float64)
    along = np.roll(ends, -1, axis=1) - ends
    bent = np.roll(mesh.normals, -1, axis=1).astype(np.float64) - mesh.normals
    sagitta = np.abs(np.einsum("tki,tki->tk", along, bent)) / 8.0
    pixel = np.ptp(mesh.points, axis=0).max() / (9.0 / 16.0 * pixels)
    assert sagitta.max() < pixel


def test_a_picture_of_a_usual_size_has_the_surface_of_none_in_particular() -> None:
    """So what is read without a picture (probes, what they were baked from) is what is drawn."""
    text = MESH(*solid("cube"))
    usual, other, large = (read(text, pixels=pixels).meshes[0] for pixels in (0, 1024, 3840))
    np.testing.assert_array_equal(usual.points, other.points)
    assert len(large.triangles) == 4 * len(usual.triangles)


def test_a_dense_cage_takes_fewer_steps_and_says_so() -> None:
    side = 200
    text = MESH(*grid(side)) + MESH(*solid("cube"), name="Small")
    scene = read(text)
    dense, small = (next(mesh for mesh in scene.meshes if mesh.path == path) for path in ("/M", "/Small"))
    assert len(dense.triangles) == 2 * side * side
    assert len(small.triangles) == 12 * 4**4
    assert "subdivided fewer than 2 times" in texts(scene, "/M")
    assert "131,072" in texts(scene, "/M")
    # Its points are on the limit all the same.
    at = to_stage(scene, dense.points)
    assert at[side + 2] == pytest.approx((1.0, 1.0, 0.0), abs=1e-5)


def test_instances_of_one_surface_are_as_fine_as_it() -> None:
    """1000 times 32 x 32 quads would be 32 million triangles, but they stand there once."""
    places = ", ".join(f"({i}, 0, 0)" for i in range(1000))
    text = f"""def PointInstancer "I" {{
        rel prototypes = </I/P>
        int[] protoIndices = {[0] * 1000}
        point3f[] positions = [{places}]
        def Xform "P" {{ {MESH(*grid(32))} }} }}"""
    scene = read(text)
    (many,) = scene.instances
    (alone,) = read(MESH(*grid(32))).meshes
    assert (len(many), len(scene.meshes)) == (1000, 0)
    assert len(many.mesh.triangles) == len(alone.triangles)
    assert not any("4,000,000 of all" in notice.text for notice in scene.notices)


def test_many_surfaces_are_coarser_together() -> None:
    """200 times 32 x 32 quads, in four pieces each twice, would be 6.5 million triangles."""
    scene = read("".join(MESH(*grid(32), name=f"M{i}") for i in range(200)))
    assert len(scene.meshes) == 200
    assert len(scene.meshes[0].triangles) < 2 * 128 * 128
    assert any("4,000,000 of all" in notice.text for notice in scene.notices)


def test_what_large_pictures_ask_for_is_given_up_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("refract_core.usd.geometry.parts.MOST_IN_ALL", 10_000)
    scene = read("".join(MESH(*solid("cube"), name=f"M{i}") for i in range(2)), pixels=4096)
    assert [len(mesh.triangles) for mesh in scene.meshes] == [3072, 3072]
    assert not any("of all" in notice.text for notice in scene.notices)


def test_points_that_move_are_subdivided_where_they_are() -> None:
    points, faces = solid("cube")
    moved = [(x, y, z + 5) for x, y, z in points]
    text = f"""def Mesh "M" {{
        uniform token subdivisionScheme = "catmullClark"
        int[] faceVertexCounts = {[4] * 6}
        int[] faceVertexIndices = {[i for face in faces for i in face]}
        point3f[] points.timeSamples = {{ 0: {points}, 1: {moved} }} }}"""
    stage = stage_of(text)
    for time in (0.0, 0.5, 1.0):
        scene = scene_from_stage(stage, time_code=time)
        (mesh,) = scene.meshes
        assert to_stage(scene, mesh.points)[:, 2].mean() == pytest.approx(5 * time, abs=1e-5)
        assert not mesh.static


# --- what is wrong --------------------------------------------------------------------------------------------------


def test_edges_of_three_faces_and_points_that_only_touch() -> None:
    """Three leaves on one edge, and two cubes with one corner: sharp there, and nothing fails."""
    points = [(0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 0, 1), (-1, 1, 0), (-1, 1, 1), (-1, -1, 0), (-1, -1, 1)]
    _, mesh, found = surface(points, [[0, 2, 3, 1], [0, 4, 5, 1], [0, 6, 7, 1]])
    assert found[:2] == pytest.approx(np.array(points[:2], float), abs=1e-6)
    assert np.isfinite(mesh.points).all()
    cube, faces = solid("cube")
    other = [(x + 2, y + 2, z + 2) for x, y, z in cube]
    shared = cube.index((1, 1, 1))
    at = {k: shared if p == (1, 1, 1) else 8 + k for k, p in enumerate(other)}
    _, mesh, found = surface(cube + other, faces + [[at[i] for i in face] for face in faces])
    assert found[shared] == pytest.approx((1, 1, 1), abs=1e-6)
    assert mesh.closed


@pytest.mark.parametrize("scheme", ["catmullClark", "loop"])
@pytest.mark.parametrize("seed", range(6))
def test_nonsense_is_drawn_or_named(seed: int, scheme: str) -> None:
    """Faces of any points at all, doubled, wound against each other, with points that are no numbers."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(9, 3)).tolist()
    faces = [rng.integers(0, 9, size=rng.integers(2, 7)).tolist() for _ in range(12)]
    faces += [faces[0], faces[1][::-1]]
    text = MESH(points, faces, scheme=scheme, creases=[((0, 1), 1.5), ((2, 3, 4), 10.0)], corners={1: 0.4})
    if seed % 2:
        text = text.replace(f"({points[3][0]!r},", "(nan,")
    scene = read(text + CUBE())
    assert {"/C"} <= {mesh.path for mesh in scene.meshes}
    for mesh in scene.meshes:
        assert np.isfinite(mesh.points).all()
        assert mesh.normals is None or np.linalg.norm(mesh.normals, axis=2) == pytest.approx(1.0, abs=1e-4)
    assert "faces with fewer than 3" in texts(scene, "/M")


def test_points_at_one_place_and_points_that_no_face_uses() -> None:
    points, faces = solid("cube")
    _, mesh, found = surface([*points[:-1], points[0], (1e30, 0.0, 0.0)], faces)
    assert np.abs(found).max() <= 1.0
    assert mesh.triangles.max() < len(mesh.points)


def CREASE(indices: str, lengths: str, sharpness: str) -> str:
    return f"int[] creaseIndices = {indices}\nint[] creaseLengths = {lengths}\nfloat[] creaseSharpnesses = {sharpness}"


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (CREASE("[0, 1]", "[3]", "[1]"), "creaseLengths"),
        (CREASE("[0, 1]", "[2]", "[1, 2]"), "2 values"),
        (CREASE("[0, 99]", "[2]", "[1]"), "1 of its creases"),
        (CREASE("[0, 7]", "[2]", "[1]"), "along no edge"),
        ("int[] cornerIndices = [-1]\nfloat[] cornerSharpnesses = [1]", "1 of its corners"),
        ("int[] cornerIndices = [1, 2]\nfloat[] cornerSharpnesses = [1]", "2 cornerIndices"),
        ("int[] cornerIndices = [1]\nfloat[] cornerSharpnesses = [nan]", "1 of its corners"),
    ],
)
def test_creases_that_make_no_sense_are_named_and_ignored(extra: str, said: str) -> None:
    plain = read(CUBE(scheme="catmullClark")).meshes[0]
    scene = read(CUBE(scheme="catmullClark", extra=extra))
    assert said in texts(scene, "/C")
    np.testing.assert_array_equal(scene.meshes[0].points, plain.points)


def test_loop_on_polygons_cuts_them_and_says_so() -> None:
    scene = read(CUBE(scheme="loop"))
    assert "loop, which is for triangles" in texts(scene, "/C")
    assert len(scene.meshes[0].triangles) == 12 * 4**4
    assert scene.meshes[0].closed


def test_nothing_left_is_named() -> None:
    points, faces = grid(2)
    scene = read(MESH(points, faces, extra='uniform token interpolateBoundary = "none"') + CUBE())
    assert "interpolateBoundary is none" in texts(scene, "/M")
    assert [mesh.path for mesh in scene.meshes] == ["/C"]


def test_points_of_high_valence_and_polygons_of_many_sides() -> None:
    """A cylinder with 100 sides, and a double cone whose tips have 100 faces."""
    n = 100
    turn = [2 * math.pi * k / n for k in range(n)]
    ring = [(math.cos(a), math.sin(a), 0.0) for a in turn]
    cylinder = ring + [(x, y, 1.0) for x, y, _ in ring]
    faces = [list(range(n))[::-1], list(range(n, 2 * n))] + [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    _, mesh, _ = surface(cylinder, faces)
    assert mesh.closed
    assert 0 < signed_volume(mesh) < math.pi
    tips = [[k, (k + 1) % n, n] for k in range(n)] + [[(k + 1) % n, k, n + 1] for k in range(n)]
    _, mesh, found = surface([*ring, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)], tips)
    assert mesh.closed
    assert found[n, :2] == pytest.approx((0, 0), abs=1e-6)  # by symmetry
    assert mesh.normals is not None
    assert mesh.normals[mesh.triangles == n] == pytest.approx(np.broadcast_to((0, 0, 1.0), (2 * n, 3)), abs=1e-5)


# --- as glass -------------------------------------------------------------------------------------------------------


@pytest.mark.draws
def test_a_glass_cube_refracts_as_its_limit() -> None:
    """The picture of a cube that is subdivided is that of a fine mesh on the limit, with normals of its own making."""
    head = 'def DistantLight "L" { float inputs:intensity = 3 }\n'
    bound = "rel material:binding = </Glass>"
    points, faces = solid("cube")
    net = rules.after(net_of(np.array(points, float), faces), 4)
    fine = np.array([limit_by_formula(net, i) for i in range(len(net.points))])
    normals = np.zeros_like(fine)
    for a, b, c, d in net.faces:
        for i in (a, b, c, d):
            normals[i] += np.cross(fine[c] - fine[a], fine[d] - fine[b])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    listed = ", ".join(f"({x!r}, {y!r}, {z!r})" for x, y, z in normals.tolist())
    by_hand = MESH(fine, net.faces, scheme="none", extra=f'{bound}\nnormal3f[] normals = [{listed}]')
    settings = rc.RenderSettings(image_width=48, image_height=48, samples=4, camera="/Cam")
    ours, expected, cage = (
        rc.render(read(head + WALL_SEEN + GLASS + text, complexity="high"), settings).planes["beauty"][..., :3]
        for text in (MESH(points, faces, extra=bound), by_hand, MESH(points, faces, scheme="none", extra=bound))
    )
    assert np.abs(ours - expected).mean() < 0.01 * expected.mean()
    assert np.abs(ours - cage).mean() > 0.05 * expected.mean()
