"""Spheres, cubes, cylinders, cones, capsules and planes against their closed formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scene_reading import areas, read, signed_volume, texts, to_stage

from refract_core.usd.geometry.triangulate import is_closed

# --- gprims ---------------------------------------------------------------------------------------------------------

# Volumes by the closed formulas; a tessellation lies inside a curved surface, by less than 0.2 %.
VOLUMES = {
    'Sphere "P" { double radius = 2 \n double3 xformOp:scale = (1, 1, 3) }': 4 / 3 * math.pi * 8 * 3,
    'Cube "P" { double size = 3 }': 27.0,
    'Cylinder "P" { double radius = 0.5 \n double height = 4 \n token axis = "X" }': math.pi,
    'Cylinder_1 "P" { double radiusTop = 1 \n double radiusBottom = 2 \n double height = 3 }': math.pi * 7,
    'Cone "P" { double radius = 2 \n double height = 3 \n token axis = "Y" }': math.pi * 4,
    'Capsule "P" { double radius = 1 \n double height = 2 \n token axis = "Y" }': math.pi * (4 / 3 + 2),
    'Capsule_1 "P" { double radiusTop = 1 \n double radiusBottom = 2 \n double height = 3 }': (
        math.pi * (7 + 2 / 3 * 1 + 2 / 3 * 8)
    ),
}


@pytest.mark.parametrize("text", VOLUMES)
def test_gprims_are_closed_wound_outward_and_of_the_right_volume(text: str) -> None:
    order = 'uniform token[] xformOpOrder = ["xformOp:scale"]' if "xformOp" in text else ""
    scene = read("def " + text.replace("}", "\n" + order + "}"))
    (mesh,) = scene.meshes
    assert mesh.closed
    counts = np.full(len(mesh.triangles), 3)
    assert is_closed(mesh.points, mesh.triangles.ravel().astype(np.int64), np.cumsum(counts) - 3, counts)
    assert VOLUMES[text] * 0.998 < signed_volume(mesh) < VOLUMES[text] * 1.00001
    assert not scene.notices or all("camera" in notice.text for notice in scene.notices)


def test_normals_of_an_ellipsoid_are_its_gradient() -> None:
    scene = read("""def Sphere "S" { double radius = 2
        double3 xformOp:scale = (1, 2, 3)
        uniform token[] xformOpOrder = ["xformOp:scale"] }""")
    (mesh,) = scene.meshes
    assert mesh.normals is not None
    at = mesh.points[mesh.triangles].astype(np.float64)
    radii = np.array([2.0, 4.0, 6.0])
    assert np.abs((at / radii) ** 2).sum(axis=2) == pytest.approx(1.0, abs=1e-5)
    gradient = at / radii**2
    gradient /= np.linalg.norm(gradient, axis=2, keepdims=True)
    # On the axis a corner takes the normal of the pole from every side.
    assert np.abs(mesh.normals - gradient).max() < 1e-5


@pytest.mark.parametrize(("axis", "tip"), [("X", (1, 0, 0)), ("Y", (0, 1, 0)), ("Z", (0, 0, 1))])
def test_a_cone_points_along_its_axis(axis: str, tip: tuple[int, int, int]) -> None:
    scene = read(f'def Cone "C" {{ double height = 4 \n double radius = 1 \n token axis = "{axis}" }}')
    (mesh,) = scene.meshes
    along = mesh.points @ np.array(tip, np.float32)
    assert (along == along.max()).sum() == 1
    assert along.max() - along.min() == pytest.approx(4.0)
    across = mesh.points - along[:, None] * np.array(tip, np.float32)
    assert np.linalg.norm(across, axis=1).max() == pytest.approx(1.0)


@pytest.mark.parametrize(("axis", "size"), [("X", (0.0, 3.0, 2.0)), ("Y", (2.0, 0.0, 3.0)), ("Z", (2.0, 3.0, 0.0))])
def test_a_plane_lies_as_its_schema_says_and_faces_along_its_axis(axis: str, size: tuple[float, ...]) -> None:
    """Width along x (z for axis X), length along y (z for axis Y): documentation of UsdGeomPlane."""
    scene = read(f'def Plane "P" {{ double width = 2 \n double length = 3 \n token axis = "{axis}" }}')
    (mesh,) = scene.meshes
    assert np.ptp(mesh.points, axis=0) == pytest.approx(size)
    assert areas(mesh.points, mesh.triangles).sum(axis=0) == pytest.approx([6.0 * (axis == a) for a in "XYZ"])
    assert mesh.double_sided
    assert not mesh.closed


def test_a_sphere_stays_exact_under_rotation_mirror_and_even_scale() -> None:
    scene = read("""def Sphere "S" { double radius = 2
        double3 xformOp:translate = (1, 2, 3)
        float3 xformOp:rotateXYZ = (10, 20, 30)
        double3 xformOp:scale = (-3, 3, 3)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"] }""")
    assert not scene.meshes
    (sphere,) = scene.spheres
    assert sphere.radius == pytest.approx(6.0)
    assert to_stage(scene, sphere.centre) == pytest.approx((1, 2, 3))
    assert to_stage(scene, scene.bounds) == pytest.approx(np.array([[-5, -4, -3], [7, 8, 9]]))


@pytest.mark.parametrize("text", ['Sphere "P" { double radius = 0 }', 'Cube "P" { double size = -1 }',
                                  'Cylinder "P" { double height = nan }', 'Cone "P" { token axis = "W" }'])  # fmt: skip
def test_a_gprim_without_a_size_is_skipped_by_name(text: str) -> None:
    scene = read("def " + text)
    assert not scene.meshes
    assert not scene.spheres
    assert "skipped" in texts(scene, "/P")
