"""Normals that hide edges: of glass that rays go through, they are its faces'; of all else they are as they came."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

import refract_core as rc
from refract_core.usd.geometry import edges

F64 = NDArray[np.float64]


def _turned(rng: np.random.Generator) -> F64:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return np.asarray(turn * np.sign(np.linalg.det(turn)))


def _ring(sides: int, wide: float, high: float) -> F64:
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return np.stack([wide * np.cos(angle), np.full(sides, high), wide * np.sin(angle)], axis=1)


def _prism(sides: int, wide: float, high: float) -> tuple[F64, list[list[int]]]:
    """Points, and faces that look outwards."""
    points = np.concatenate([_ring(sides, wide, -high), _ring(sides, wide, high)])
    walls = [[k, sides + k, sides + (k + 1) % sides, (k + 1) % sides] for k in range(sides)]
    return points, [*walls, list(range(sides)), list(range(2 * sides - 1, sides - 1, -1))]


def _cup(sides: int) -> tuple[F64, list[list[int]]]:
    """A cup with a wall of a twentieth: outside from its foot to its rim, and inside again."""
    profile = [(0.5, -1.0), (1.0, -0.8), (1.0, 1.0), (0.95, 1.0), (0.95, -0.7), (0.5, -0.9)]
    points = np.concatenate([_ring(sides, wide, high) for wide, high in profile])
    faces = []
    for k in range(len(profile) - 1):
        for n in range(sides):
            a, b = k * sides + n, k * sides + (n + 1) % sides
            faces.append([a, a + sides, b + sides, b])
    foot = list(range(sides))
    floor = [(len(profile) - 1) * sides + n for n in reversed(range(sides))]
    return points, [*faces, foot, floor]


def _averaged(points: F64, faces: list[list[int]]) -> F64:
    """Normals of points as exporters make them: sums over all faces around, whatever the angle, by area."""
    total = np.zeros_like(points)
    for face in faces:
        at = points[face]
        total[face] += np.cross(at, np.roll(at, -1, axis=0)).sum(axis=0)
    return np.asarray(total / np.linalg.norm(total, axis=1, keepdims=True))


def _of_faces(points: F64, faces: list[list[int]]) -> F64:
    """Normals of corners: of their faces."""
    found = []
    for face in faces:
        at = points[face]
        normal = np.cross(at, np.roll(at, -1, axis=0)).sum(axis=0)
        found += [normal / np.linalg.norm(normal)] * len(face)
    return np.array(found)


def _stage(points: F64, faces: list[list[int]], normals: F64, how: str = "vertex", **inputs: Any) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.Mesh.Define(stage, "/Glass")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([len(face) for face in faces])
    mesh.CreateFaceVertexIndicesAttr([place for face in faces for place in face])
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(how)
    material = UsdShade.Material.Define(stage, "/Clear")
    shader = UsdShade.Shader.Define(stage, "/Clear/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, value in {"opacity": 0.0, "ior": 1.5, "roughness": 0.0, **inputs}.items():
        shader.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return stage


def _told(stage: Usd.Stage) -> bool:
    return any(notice.text == edges.HIDDEN for notice in rc.load_stage(stage).notices)


def _corner_normals(stage: Usd.Stage) -> tuple[F64, F64]:
    """Corner normals as they were read, and the triangles' own, both of shape (T, 3, 3)."""
    (mesh,) = rc.load_stage(stage).meshes
    at = mesh.points[mesh.triangles].astype(np.float64)
    own = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    assert mesh.normals is not None
    return mesh.normals.astype(np.float64), np.repeat(own[:, None], 3, axis=1)


@pytest.mark.parametrize("seed", range(6))
def test_a_prism_of_few_sides_has_flat_walls(seed: int) -> None:
    """Of three to five sides, everywhere and turned anyhow: 60 degrees and less between neighbours is round."""
    rng = np.random.default_rng(seed)
    points, faces = _prism(3 + seed % 3, *rng.uniform(0.2, 3.0, 2))
    points = points @ _turned(rng)
    found, own = _corner_normals(_stage(points, faces, _averaged(points, faces)))
    assert found == pytest.approx(own, abs=1e-6)


@pytest.mark.parametrize("sides", [7, 12, 31])
def test_a_prism_of_many_sides_is_a_tube_with_flat_ends(sides: int) -> None:
    points, faces = _prism(sides, 1.0, 0.7)
    found, own = _corner_normals(_stage(points, faces, _averaged(points, faces)))
    ends = np.abs(own[..., 1]) > 0.5
    assert found[ends] == pytest.approx(own[ends], abs=1e-6)
    assert found[~ends][:, 1] == pytest.approx(0.0, abs=1e-6)
    # Half way between two walls: as far from both.
    assert (found * own).sum(axis=2)[~ends] == pytest.approx(np.cos(np.pi / sides), abs=1e-5)


@pytest.mark.parametrize("pairs", [1, 50, 1 << 20])
def test_rims_do_not_bend_the_walls_of_a_cup(pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the seam where an unwrapping has cut it open is none; however many corners are looked at together."""
    monkeypatch.setattr(edges, "_AT_ONCE", pairs)
    points, faces = _cup(24)
    normals = _averaged(points, faces)
    first = len(points)
    points, normals = np.concatenate([points, points[::24]]), np.concatenate([normals, normals[::24]])
    faces = [[first + p // 24 if p % 24 == 0 and 23 in {q % 24 for q in face} else p for p in face] for face in faces]
    found, own = _corner_normals(_stage(points, faces, normals))
    walls = np.abs(own[..., 1]) < 1e-6
    assert walls.sum() == 24 * 2 * 2 * 3
    # The outside ends in a foot that bends by 22 degrees, which is round; the rim and all of the inside in edges.
    at = rc.load_stage(_stage(points, faces, normals)).meshes[0]
    height = at.points[at.triangles][..., 1].astype(np.float64)
    upper = walls & (height > height.max() - 1e-3)
    assert np.abs(found[upper][:, 1]).max() < 1e-6
    assert (found * own).sum(axis=2)[upper] == pytest.approx(np.cos(np.pi / 24), abs=1e-5)


def test_edges_that_are_told_stay_as_they_are() -> None:
    points, faces = _prism(5, 1.0, 1.0)
    stage = _stage(points, faces, _of_faces(points, faces), "faceVarying")
    found, own = _corner_normals(stage)
    assert found == pytest.approx(own, abs=1e-6)
    assert not _told(stage)


def test_what_is_round_or_opaque_keeps_its_normals() -> None:
    """A coarse globe, the tip of a cone, which is no edge, and what no ray goes through."""
    rings = [_ring(8, np.sin(angle), np.cos(angle)) for angle in np.linspace(0.0, np.pi, 7)[1:-1]]
    globe = np.concatenate([*rings, [[0.0, 1.0, 0.0]], [[0.0, -1.0, 0.0]]])
    rows = [(8 * k + n, 8 * k + (n + 1) % 8) for k in range(4) for n in range(8)]
    around = [[a, b, b + 8, a + 8] for a, b in rows]
    around += [[40, (n + 1) % 8, n] for n in range(8)] + [[41, 32 + n, 32 + (n + 1) % 8] for n in range(8)]
    tip = np.concatenate([_ring(100, 0.3, 0.0), [[0.0, 1.0, 0.0]]])
    cone = [[100, (n + 1) % 100, n] for n in range(100)]
    prism, faces = _prism(4, 1.0, 0.5)
    for stage, normals in (
        (_stage(globe, around, globe), globe),
        (_stage(tip, cone, _averaged(tip, cone)), _averaged(tip, cone)),
        (_stage(prism, faces, _averaged(prism, faces), opacity=1.0), _averaged(prism, faces)),
    ):
        assert not _told(stage)
        (mesh,) = rc.load_stage(stage).meshes
        assert mesh.normals is not None
        read = np.unique(mesh.normals.reshape(-1, 3).round(4) + 0.0, axis=0)
        assert read == pytest.approx(np.unique(normals.round(4) + 0.0, axis=0), abs=2e-4)


def test_a_pane_with_averaged_normals_is_drawn_as_one_with_its_own() -> None:
    points, faces = _prism(4, 1.0, 0.1)
    averaged = _stage(points, faces, _averaged(points, faces))
    pictures: list[NDArray[np.float32]] = []
    for stage in (averaged, _stage(points, faces, _of_faces(points, faces), "faceVarying")):
        floor = UsdGeom.Mesh.Define(stage, "/Floor")
        floor.CreatePointsAttr([Gf.Vec3f(x, -1.0, z) for x, z in ((-3, -3), (-3, 3), (3, 3), (3, -3))])
        floor.CreateFaceVertexCountsAttr([4])
        floor.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        stage.DefinePrim("/Dome", "DomeLight")
        assert _told(stage) == (stage is averaged)
        settings = rc.RenderSettings(image_width=48, image_height=36, samples=4, caustics=0)
        frame = rc.render(rc.load_stage(stage), settings)
        pictures.append(frame.planes["beauty"])
    assert pictures[0] == pytest.approx(pictures[1], abs=2e-3)
