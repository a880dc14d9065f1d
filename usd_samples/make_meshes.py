"""Write the larger meshes of the samples: `python usd_samples/make_meshes.py` (needs scipy). Always the same files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

F64 = NDArray[np.float64]
FOLDER = Path(__file__).parent / "good" / "parts"


def main() -> None:
    """Write every mesh."""
    _write("gem", "A brilliant cut, 1.24 m wide.", *gem())
    _write("ring", "A torus around y, 1.18 m wide.", *ring())
    _write("vase", "An open surface of revolution, 1.05 m tall.", *vase())


def gem(size: float = 0.62) -> tuple[F64, list[list[int]], None]:
    """Convex hull of the corners of a brilliant; its flat facets are merged into polygons."""
    levels = [  # corners, turn in steps, radius, height
        (8, 0.5, 0.56, 0.34),
        (8, 0.0, 0.80, 0.20),
        (16, 0.0, 1.0, 0.02),
        (16, 0.0, 1.0, -0.04),
        (8, 0.5, 0.45, -0.50),
        (1, 0.0, 0.0, -0.86),
    ]
    corners = size * np.vstack([_circle(n, radius, height, turn) for n, turn, radius, height in levels])
    hull = ConvexHull(corners)
    facets: dict[tuple[float, ...], set[int]] = {}
    for triangle, plane in zip(hull.simplices, hull.equations, strict=True):
        facets.setdefault(tuple(np.round(plane, 3) + 0.0), set()).update(triangle.tolist())
    used = sorted(set().union(*facets.values()))
    faces = [
        [used.index(i) for i in _around(corners, sorted(facet), np.array(plane[:3]))]
        for plane, facet in sorted(facets.items())
    ]
    return corners[used], faces, None


def ring(
    radius: float = 0.42, tube: float = 0.17, around: int = 48, across: int = 24
) -> tuple[F64, list[list[int]], F64]:
    """A torus with smooth normals."""
    a = 2.0 * np.pi * np.arange(around)[:, None] / around
    b = 2.0 * np.pi * np.arange(across)[None, :] / across
    normals = np.stack([np.cos(b) * np.cos(a), np.sin(b) + 0.0 * a, np.cos(b) * np.sin(a)], axis=-1)
    centres = radius * np.stack([np.cos(a), 0.0 * a, np.sin(a)], axis=-1)
    number = np.arange(around * across).reshape(around, across)
    right, up = np.roll(number, -1, axis=1), np.roll(number, -1, axis=0)
    faces = np.stack([number, right, np.roll(up, -1, axis=1), up], axis=-1).reshape(-1, 4)
    return (centres + tube * normals).reshape(-1, 3), faces.tolist(), normals.reshape(-1, 3)


def vase(around: int = 32, rows: int = 14) -> tuple[F64, list[list[int]], F64]:
    """A bellied vase without a bottom, with smooth normals."""
    t = np.arange(rows + 1) / rows
    radius = 0.24 + 0.17 * np.sin(np.pi * np.minimum(1.0, 1.15 * t)) + 0.10 * (np.maximum(0.0, t - 0.72) / 0.28) ** 2
    height = 1.05 * t
    points = np.vstack([_circle(around, r, y) for r, y in zip(radius, height, strict=True)])
    slope = np.stack([np.gradient(height), -np.gradient(radius)], axis=-1)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    normals = np.vstack([_circle(around, outward, up) for outward, up in slope])
    number = np.arange(len(points)).reshape(rows + 1, around)
    beside = np.roll(number, -1, axis=1)
    faces = np.stack([number[:-1], number[1:], beside[1:], beside[:-1]], axis=-1).reshape(-1, 4)
    return points, faces.tolist(), normals


def _circle(count: int, radius: float, height: float, turn: float = 0.0) -> F64:
    """Points around the y axis, the first turned by that many steps."""
    angle = 2.0 * np.pi * (np.arange(count) + turn) / count
    return np.stack([radius * np.cos(angle), np.full(count, height), radius * np.sin(angle)], axis=-1)


def _around(corners: F64, facet: list[int], normal: F64) -> list[int]:
    """The corners of a facet, counter-clockwise seen from outside."""
    at = corners[facet] - corners[facet].mean(axis=0)
    angle = np.arctan2(at @ np.cross(normal, at[0]) / np.linalg.norm(at[0]), at @ at[0] / np.linalg.norm(at[0]))
    return [facet[i] for i in np.argsort(angle)]


def _text(rows: F64 | list[F64]) -> str:
    return ", ".join("(" + ", ".join(f"{value + 0.0:.4g}" for value in row) + ")" for row in np.round(rows, 6))


def _write(name: str, doc: str, points: F64, faces: Sequence[Sequence[int]], normals: F64 | None) -> None:
    title = name.capitalize()
    lines = [
        f'#usda 1.0\n(\n    defaultPrim = "{title}"\n    doc = "{doc} Written by make_meshes.py."',
        f'    metersPerUnit = 1\n    upAxis = "Y"\n)\n\ndef Mesh "{title}"\n{{',
        '    uniform token subdivisionScheme = "none"',
        f"    int[] faceVertexCounts = {[len(face) for face in faces]}",
        f"    int[] faceVertexIndices = {[index for face in faces for index in face]}",
        f"    point3f[] points = [{_text(points)}]",
        f"    float3[] extent = [{_text([points.min(axis=0), points.max(axis=0)])}]",
    ]
    if normals is not None:
        lines.append(f'    normal3f[] normals = [{_text(normals)}] (\n        interpolation = "vertex"\n    )')
    (FOLDER / f"{name}.usda").write_text("\n".join([*lines, "}"]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
