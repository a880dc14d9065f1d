"""Write the larger meshes of the samples: `python usd_samples/make_meshes.py` (needs scipy). Always the same files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

F64 = NDArray[np.float64]
FOLDER = Path(__file__).parent / "good" / "parts"
# Corners of what is turned on a lathe: radius and height in centimetres. They are a cage: the surface is the limit of
# its subdivision, so two corners close together are a sharp edge.
# A body that begins and ends on the axis is closed; one that does not is a ring.
LATHED: dict[str, tuple[str, list[tuple[float, float]]]] = {
    "bottle": (
        "The glass of a bottle, 24 cm tall: outside and inside are one closed surface.",
        [(0, 0.5), (2.2, 0.5), (2.9, 0), (3.55, 0), (3.7, 0.15), (3.7, 1), (3.7, 7), (3.7, 13), (3.7, 14.6), (3.3, 16),
         (1.7, 17.2), (1.35, 18.4), (1.3, 20.5), (1.3, 22.2), (1.7, 22.3), (1.75, 22.6), (1.75, 23.7), (1.6, 24),
         (1.15, 24), (0.95, 23.8), (0.95, 22), (0.95, 18.4), (1.3, 16.8), (2.9, 15.7), (3.35, 14.4), (3.35, 13),
         (3.35, 7), (3.35, 1.6), (3.2, 1.1), (2.2, 1.3), (0, 1.3)],
    ),
    "oil": (
        "What is in the bottle: it reaches into the glass, which has the higher priority.",
        [(0, 0.9), (2.3, 0.9), (3.3, 0.7), (3.5, 1), (3.5, 2), (3.5, 7), (3.5, 12.2), (3.5, 12.9), (3.5, 13), (3.3, 13),
         (2.5, 13), (0, 13)],
    ),
    "cork": (
        "A cork for the bottle.",
        [(0, 21.2), (0.8, 21.2), (0.94, 21.3), (0.94, 22), (0.94, 23.6), (1.1, 24.9), (1.1, 25.1), (0.95, 25.3),
         (0, 25.3)],
    ),
    "tumbler": (
        "A drinking glass, 12 cm tall, with a heavy foot.",
        [(0, 0.15), (2.3, 0.15), (2.6, 0), (2.9, 0), (3, 0.1), (3.02, 0.5), (3.2, 3), (3.5, 7), (3.78, 11.7),
         (3.8, 11.95), (3.7, 12.05), (3.6, 11.95), (3.57, 11.7), (3.28, 7), (2.98, 3), (2.9, 1.9), (2.7, 1.45),
         (1.8, 1.3), (0, 1.3)],
    ),
    "drink": (
        "What is in the tumbler: it reaches into the glass, which has the higher priority.",
        [(0, 0.9), (1.9, 0.9), (2.8, 1), (2.97, 1.6), (3.08, 3), (3.38, 7), (3.58, 9.6), (3.6, 9.95), (3.59, 10),
         (3.4, 10), (2, 10), (0, 10)],
    ),
    "lantern": (
        "A glass for a candle, 17 cm tall, open above: a closed surface with a thick bottom.",
        [(0, 0.1), (3.4, 0.1), (3.8, 0), (4.3, 0), (4.5, 0.2), (4.6, 0.8), (5.4, 4), (5.5, 8), (4.6, 12), (4.3, 14),
         (4.6, 16.8), (4.62, 17), (4.5, 17.05), (4.4, 16.9), (4.08, 14), (4.38, 12), (5.27, 8), (5.17, 4),
         (4.35, 1.6), (4.1, 1.3), (3.4, 1.2), (0, 1.2)],
    ),
    "candle": (
        "A candle with a hollow where the wax has melted.",
        [(0, 1.21), (2.2, 1.21), (2.4, 1.22), (2.5, 1.4), (2.5, 4), (2.5, 7.2), (2.45, 7.7), (2.3, 7.8), (2.0, 7.6),
         (1.4, 7.3), (0, 7.2)],
    ),
    "flame": (
        "A flame, 2.6 cm tall.",
        [(0, 7.75), (0.2, 7.8), (0.42, 8.3), (0.44, 8.8), (0.3, 9.5), (0.1, 10.3), (0, 10.6)],
    ),
    "jar": (
        "A vase of glass, 21 cm tall, with a wall of 3 mm and a thick bottom: a closed surface.",
        [(0, 0.15), (2.6, 0.15), (3, 0), (3.6, 0), (3.8, 0.2), (4, 0.8), (4.9, 4), (5, 7), (4, 11), (3, 15), (3.3, 18),
         (4.2, 20.6), (4.3, 20.85), (4.15, 20.95), (4, 20.8), (3.05, 18), (2.72, 15), (3.7, 11), (4.68, 7), (4.58, 4),
         (3.7, 1.8), (3.4, 1.4), (2.6, 1.3), (0, 1.3)],
    ),
    "water": (
        "What is in the vase: it reaches into the glass, which has the higher priority.",
        [(0, 0.9), (2.6, 0.9), (3.5, 1), (3.9, 1.8), (4.72, 4), (4.82, 7), (3.84, 11), (3.38, 12.9), (3.34, 13),
         (3.2, 13), (2, 13), (0, 13)],
    ),
    "reflector": (
        "The bowl of a headlight, a shell: a parabola whose focus is 2.5 cm above its bottom, 16 cm wide.",
        [(1.5, -1), (2, 0), (4.2, 1.3), (6.3, 3.4), (8.2, 6.4), (8.1, 6.5), (8, 6.4), (6, 3.6), (4, 1.6), (2, 0.4),
         (1.3, 0.17), (1.2, 0.15), (1.2, -1)],
    ),
    "cover": (
        "The clear cover of a headlight, 17 cm wide and 5 mm thick.",
        [(0, 8.8), (3, 8.6), (6, 7.9), (7.9, 7), (8.4, 6.8), (8.5, 6.9), (8.5, 7.1), (8.4, 7.25), (7.9, 7.5),
         (6, 8.42), (3, 9.1), (0, 9.3)],
    ),
    "bulb": (
        "The glass of a bulb, 2 cm wide: outside and inside are one closed surface.",
        [(0, 3.5), (0.6, 3.22), (0.9, 2.5), (0.85, 1.6), (0.56, 0.2), (0.5, -0.8), (0.57, -0.9), (0.64, -0.8),
         (0.66, 0.2), (0.95, 1.6), (1, 2.5), (0.7, 3.3), (0, 3.6)],
    ),
    "bezel": (
        "The ring around a headlight.",
        [(8.2, 5.5), (9.2, 5.4), (9.4, 5.6), (9.5, 6.4), (9.3, 7.3), (8.8, 7.6), (8.35, 7.4), (8.1, 6.9), (8.05, 6.2)],
    ),
    "pod": (
        "The body of a headlight, behind the ring.",
        [(0, -15), (1.5, -14.6), (4, -12), (7, -6), (8.8, 0), (9.3, 5.6), (9.2, 6), (9, 6), (8.9, 5.5), (8.4, 0),
         (6.6, -5.6), (3, -9), (0, -10)],
    ),
    "lens": (
        "A lens with two sides alike, 9 cm wide and 2 cm thick, lying on its lower side.",
        [(0, 0), (1.2, 0.06), (2.4, 0.27), (3.5, 0.58), (4.35, 0.88), (4.45, 0.92), (4.5, 0.96), (4.5, 1.04),
         (4.45, 1.08), (4.35, 1.12), (3.5, 1.42), (2.4, 1.73), (1.2, 1.94), (0, 2)],
    ),
}  # fmt: skip


def main() -> None:
    """Write every mesh."""
    _write("gem", "A brilliant cut, 1.24 m wide.", *gem())
    _write("drop", "A cut drop of crystal, 2 wide and 5 tall.", *drop())
    _write("ring", "A torus around y, 1.18 m wide.", *ring())
    _write("vase", "An open surface of revolution, 1.05 m tall.", *vase())
    for name, (doc, profile) in LATHED.items():
        _write(name, doc, *lathe(profile), None, unit=0.01, scheme="catmullClark")
    _write("daisy", "Twenty narrow petals.", *blossom(20, 0.16, 1.0, 0.16, 0.05), None, scheme="catmullClark")
    _write("tulip", "Six petals that make a cup.", *blossom(6, 0.5, 0.42, 1.15, 0.3), None, scheme="catmullClark")
    _write("leaf", "A leaf that bends down.", *blossom(1, 0.14, 1.0, -0.25, 0.1), None, scheme="catmullClark")
    _write("fish", "A fish, 4 long, that swims along +x.", *fish(), None, scheme="catmullClark")
    _write("tank", "Five panes of glass in one closed surface, 64 cm wide.", *tank(), None, unit=0.01)
    points, faces, colors = rose()
    tint = f"    color3f[] primvars:refraction:transmittanceColor = [{_text(colors)}] (\n"
    tint += '        interpolation = "uniform"\n    )'
    _write("rose", "The panes of a round window, 2 m wide, each with a colour.", points, faces, None, more=[tint])


def rose(sectors: int = 12, pieces: int = 4) -> tuple[F64, list[list[int]], F64]:
    """Panes in three rings in the plane z = 0, with the colour that is left of white after each."""
    palette = np.array(
        [(0.85, 0.05, 0.04), (0.04, 0.14, 0.75), (0.95, 0.6, 0.05), (0.05, 0.45, 0.16), (0.4, 0.06, 0.5)]
    )
    points, faces, colors = [], [], []
    rings = ((0.12, 0.34, 0.0, (2, 0)), (0.34, 0.68, 0.5, (1, 4)), (0.68, 1.0, 0.0, (0, 3, 1)), (0.0, 0.12, 0.0, (2,)))
    for inner, outer, turn, order in rings:
        for sector in range(sectors):
            angle = 2.0 * np.pi * (sector + turn + np.arange(pieces + 1) / pieces) / sectors
            arc = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
            pane = np.vstack([outer * arc, inner * arc[::-1] if inner else [[0.0, 0.0, 0.0]]])
            faces.append([len(points) + i for i in range(len(pane))])
            points.extend(pane)
            colors.append(palette[order[sector % len(order)]])
    return np.array(points), faces, np.array(colors)


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
    return _hull(size * np.vstack([_circle(n, radius, height, turn) for n, turn, radius, height in levels]))


def drop() -> tuple[F64, list[list[int]], None]:
    """Hull of two points and of three circles of eight, each turned against the next."""
    circles = [_circle(8, 0.55, 1.2), _circle(8, 1.0, -1.4, 0.5), _circle(8, 0.85, -2.1)]
    return _hull(np.concatenate([[(0.0, 2.0, 0.0), (0.0, -3.0, 0.0)], *circles]))


def blossom(petals: int, wide: float, far: float, tall: float, cup: float) -> tuple[F64, list[list[int]]]:
    """Cages of petals around y: half width, reach, height of the tips, and how far their edges stand up."""
    along, across = np.linspace(0.0, 1.0, 6), np.array([-1.0, 0.0, 1.0])
    half = wide * np.sin(np.pi * (0.08 + 0.86 * along)) ** 0.7
    points, faces = [], []
    for petal in range(petals):
        angle = 2.0 * np.pi * petal / petals
        lift = 1.0 + 0.25 * (petal % 2)
        out, beside = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([-np.sin(angle), 0, np.cos(angle)])
        for v, w in zip(along, half, strict=True):
            reach = far * (np.sin(2.3 * v) if tall > far else v)
            for u in across:
                points.append(out * (0.06 + reach) + beside * w * u + [0.0, lift * tall * v * v + cup * w * u * u, 0.0])
        number = np.arange(len(points) - 18, len(points)).reshape(6, 3)
        cells = (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
        faces += np.stack(cells, axis=-1).reshape(-1, 4).tolist()
    return np.array(points), faces


def fish() -> tuple[F64, list[list[int]]]:
    """The cage of a body, flat to both sides, whose last rings are the tail."""
    rings = [(2.0, 0.22, 0.16), (1.5, 0.62, 0.34), (0.6, 1.0, 0.44), (-0.5, 0.86, 0.34), (-1.2, 0.3, 0.14),
             (-1.5, 0.34, 0.08), (-2.0, 1.05, 0.05), (-2.1, 1.0, 0.04)]  # fmt: skip
    angle = 2.0 * np.pi * np.arange(8) / 8
    points = np.vstack([np.stack([0 * angle + x, h * np.sin(angle), w * np.cos(angle)], axis=-1) for x, h, w in rings])
    number = np.arange(len(points)).reshape(-1, 8)
    beside = np.roll(number, -1, axis=1)
    faces = np.stack([number[:-1], number[1:], beside[1:], beside[:-1]], axis=-1).reshape(-1, 4).tolist()
    return points, [*faces, number[0][::-1].tolist(), number[-1].tolist()]


def tank(x: float = 32.0, y: float = 36.0, z: float = 16.0, pane: float = 0.8) -> tuple[F64, list[list[int]]]:
    """A box without a lid, in centimetres: outside, inside and rim."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    levels = ((0.0, 0.0), (0.0, y), (pane, y), (pane, pane))  # how far inside, and the height
    points = np.array([(a * (x - off), h, b * (z - off)) for off, h in levels for a, b in square])
    number = np.arange(16).reshape(4, 4)
    beside = np.roll(number, -1, axis=1)
    faces = np.stack([number[:-1], number[1:], beside[1:], beside[:-1]], axis=-1).reshape(-1, 4).tolist()
    return points, [*faces, number[0].tolist(), number[-1][::-1].tolist()]


def _hull(corners: F64) -> tuple[F64, list[list[int]], None]:
    """The convex hull; its flat facets are merged into polygons."""
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


def lathe(profile: Sequence[tuple[float, float]], around: int = 16) -> tuple[F64, list[list[int]]]:
    """The cage of a closed body of revolution around y, whose limit has the radii that are given."""
    widen = 3.0 / (2.0 + np.cos(2.0 * np.pi / around))  # a cubic spline runs inside of its polygon
    radius, height = np.array(profile, dtype=np.float64).T
    if radius[0] > 0.0:  # a ring, whose last corner meets its first
        points = np.vstack([_circle(around, widen * r, y) for r, y in profile])
        number = np.arange(len(points)).reshape(-1, around)
        ahead, beside = np.roll(number, -1, axis=0), np.roll(number, -1, axis=1)
        cells = (number, ahead, np.roll(ahead, -1, axis=1), beside)
        return points, np.stack(cells, axis=-1).reshape(-1, 4).tolist()
    rings = [_circle(around, widen * r, y) for r, y in zip(radius[1:-1], height[1:-1], strict=True)]
    points = np.vstack([*rings, [[0.0, height[0], 0.0], [0.0, height[-1], 0.0]]])
    number = np.arange(len(rings) * around).reshape(-1, around)
    beside = np.roll(number, -1, axis=1)
    faces = np.stack([number[:-1], number[1:], beside[1:], beside[:-1]], axis=-1).reshape(-1, 4).tolist()
    first, last = len(points) - 2, len(points) - 1
    faces += [[first, here, there] for here, there in zip(number[0], beside[0], strict=True)]
    faces += [[last, there, here] for here, there in zip(number[-1], beside[-1], strict=True)]
    return points, [[int(index) for index in face] for face in faces]


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


def _write(
    name: str,
    doc: str,
    points: F64,
    faces: Sequence[Sequence[int]],
    normals: F64 | None,
    *,
    unit: float = 1,
    scheme: str = "none",
    more: Sequence[str] = (),
) -> None:
    title = name.capitalize()
    lines = [
        f'#usda 1.0\n(\n    defaultPrim = "{title}"\n    doc = "{doc} Written by make_meshes.py."',
        f'    metersPerUnit = {unit:g}\n    upAxis = "Y"\n)\n\ndef Mesh "{title}"\n{{',
        f'    uniform token subdivisionScheme = "{scheme}"',
        f"    int[] faceVertexCounts = {[len(face) for face in faces]}",
        f"    int[] faceVertexIndices = {[index for face in faces for index in face]}",
        f"    point3f[] points = [{_text(points)}]",
        f"    float3[] extent = [{_text([points.min(axis=0), points.max(axis=0)])}]",
    ]
    if normals is not None:
        lines.append(f'    normal3f[] normals = [{_text(normals)}] (\n        interpolation = "vertex"\n    )')
    (FOLDER / f"{name}.usda").write_text("\n".join([*lines, *more, "}"]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
