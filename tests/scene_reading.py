"""Small stages from text for the tests of the reader, and measures of what was read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Usd

import schemas
from refract_core.scene import Mesh, Scene
from refract_core.usd.stage import scene_from_stage

schemas.register()

F64 = NDArray[np.float64]

WALL_SEEN = """def Mesh "Wall" {
    uniform token subdivisionScheme = "none"
    int[] faceVertexCounts = [4, 4, 4, 4]
    int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4, 3, 4, 7, 6, 4, 5, 8, 7]
    point3f[] points = [(-4, -4, -3), (0, -4, -3), (4, -4, -3), (-4, 0, -3), (0, 0, -3), (4, 0, -3), (-4, 4, -3),
        (0, 4, -3), (4, 4, -3)]
    color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)] (interpolation = "uniform") }
def Camera "Cam" {
    double3 xformOp:translate = (0.3, 0.2, 8)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    float2 clippingRange = (0.1, 100)
    float focalLength = 60 }
"""
"""Four colours behind the origin, and a camera that sees what stands there bend them."""


def stage_of(text: str, *, unit: float | None = 1.0, up: str = "Y", head: str = "") -> Usd.Stage:
    """A stage in memory; braces may stand on the line of a statement, which USD's text format does not allow."""
    text = text.replace("{", "{\n").replace("}", "\n}\n")
    stage = Usd.Stage.CreateInMemory()
    units = "" if unit is None else f"metersPerUnit = {unit}"
    stage.GetRootLayer().ImportFromString(f'#usda 1.0\n(\nupAxis = "{up}"\n{units}\n{head}\n)\n{text}')
    return stage


def read(text: str, *, unit: float | None = 1.0, up: str = "Y", head: str = "", **options: Any) -> Scene:
    """The scene of a stage in memory."""
    return scene_from_stage(stage_of(text, unit=unit, up=up, head=head), **options)


def texts(scene: Scene, path: str) -> str:
    """All notices about a path."""
    return "\n".join(notice.text for notice in scene.notices if notice.path == path)


def to_stage(scene: Scene, points: ArrayLike) -> F64:
    """Engine points, shape (3,) or (N, 3), in the stage's world."""
    matrix = scene.stage_from_engine
    moved: F64 = np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def areas(points: ArrayLike, triangles: ArrayLike) -> F64:
    """Area vectors of triangles, shape (T, 3)."""
    at = np.asarray(points, np.float64)[np.asarray(triangles)]
    vectors: F64 = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]) / 2
    return vectors


def signed_volume(mesh: Mesh) -> float:
    """By the divergence theorem; positive where triangles face outward."""
    at = mesh.points[mesh.triangles].astype(np.float64)
    return float(np.einsum("ij,ij->i", at[:, 0], np.cross(at[:, 1], at[:, 2])).sum() / 6)


def solid(kind: str) -> tuple[list[tuple[int, int, int]], list[list[int]]]:
    """Points and faces, wound outward."""
    assert kind == "cube"
    points = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
    return points, [[1, 3, 7, 5], [2, 0, 4, 6], [3, 2, 6, 7], [0, 1, 5, 4], [4, 5, 7, 6], [2, 3, 1, 0]]


def CUBE(*, name: str = "C", scheme: str = "none", reverse: bool = False, extra: str = "") -> str:
    """A cube of size 2 as a Mesh, in text."""
    points, faces = solid("cube")
    flat = [index for face in faces for index in (face[::-1] if reverse else face)]
    return f"""def Mesh "{name}" {{
        uniform token subdivisionScheme = "{scheme}"
        int[] faceVertexCounts = {[4] * 6}
        int[] faceVertexIndices = {flat}
        point3f[] points = {points}
        {extra} }}
        """


def TWO_TRIANGLES(extra: str, *, name: str = "M") -> str:
    """Two triangles of a unit square facing +Z."""
    return f"""def Mesh "{name}" {{
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        {extra} }}
        """


def drawn(scene: Scene) -> dict[str, list[float]]:
    """Where every prim's middle is, in the stage's world."""
    meshes = {mesh.path: (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2 for mesh in scene.meshes}
    spheres = {sphere.path: np.array(sphere.centre) for sphere in scene.spheres}
    return {path: to_stage(scene, middle).round(4).tolist() for path, middle in (meshes | spheres).items()}
