"""One prim with a surface as triangles in its own space, checked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from ...scene import F32, F64, U32, Notice
from ...world.solid import across, looks_inwards
from . import curves, gprims
from .cages import (
    FINENESS,
    SUBDIVISION_ATTRIBUTES,
    Loops,
    cut_for_loop,
    integers,
    is_subdivided,
    read_cage,
    steps_of,
    without_repeats,
)
from .moving import FLIGHT, flies, points_at
from .primvars import LARGEST, WHOLE, Corners, Topology, Unusable, as_values, evaluate, to_corners
from .refined import Fineness, surface
from .traverse import CURVES
from .triangulate import (
    Index,
    Triangles,
    fans,
    fans_fit,
    has_area,
    is_closed,
    smooth_normals,
    triangulate,
    turned_over,
)

INWARDS = "the mesh is closed but its faces look inwards"
TURN = "turn its orientation attribute round, or reverse its faces"
"""What to do about it."""
_MESH_ATTRIBUTES = ("points", "faceVertexCounts", "faceVertexIndices", "holeIndices", "normals", *FLIGHT)
_HIDDEN = ", or touch a boundary and interpolateBoundary is none, or have no area"
_IDENTITY = np.eye(4)
_SMALL = 512
"""Face corners up to which a topology is kept: many small meshes are the same few shapes."""


@dataclass(frozen=True)
class Shape:
    """The triangles of one prim."""

    points: F32
    """shape (V, 3), in shape space"""
    triangles: U32
    """shape (T, 3), counter-clockwise seen from outside, as authored"""
    normals: Corners | None = None
    """Unit normals, or None: flat"""
    topology: Topology | None = None
    """None on gprims, where only constant primvars are defined."""
    natural: dict[str, Corners] = field(default_factory=dict)
    """Primvars a gprim has by its nature, used where the stage authors none of that name."""
    prim_from_shape: F64 = field(default_factory=lambda: _IDENTITY)
    """shape (4, 4), column vectors"""
    closed: bool = False
    double_sided: bool = False
    varying: bool = False
    """The geometry changes in time."""
    is_sphere: bool = False
    """Shape space holds the unit sphere about the origin."""
    cage: bool = False
    """The control cage of a subdivision surface, which would have too many triangles."""
    subdivided: bool = False
    """A subdivision surface, on its limit."""
    coarse: bool = False
    """A subdivision surface that took fewer steps than it was asked to."""
    inside_out: bool = False
    """Its faces looked inwards before they were turned; see `outwards`."""

    @property
    def outwards(self) -> Shape:
        """The same solid looking outwards: itself, unless it is a closed mesh that is inside out.

        Its total volume decides, so a hollow solid keeps its inner shell. Normals are judged as a whole too, not one by
        one: they were either made from the faces, and turn with them, or were right from the start.
        """
        turned = self._turned
        return self if turned is None else turned

    @cached_property
    def _turned(self) -> Shape | None:
        """Instances of a prototype share it. None where nothing is to turn: a shape that held itself would stay."""
        if not self.closed or self.topology is None:
            return None
        points = self.points.astype(np.float64)
        if not looks_inwards(points, self.triangles):
            return None
        triangles, normals = turned_over(self.triangles), self.normals
        if normals is not None and normals.rows is not None:
            rows = turned_over(normals.rows)
            against = _agreement(normals.values, rows, points, triangles) < 0.0
            normals = Corners(-normals.values if against else normals.values, rows)
        topology = self.topology.turned_over()
        return replace(self, triangles=triangles, normals=normals, topology=topology, inside_out=True)


def read_shape(
    prim: Usd.Prim, time: Usd.TimeCode, notices: list[Notice], fineness: Fineness = FINENESS["low"],
    cut: curves.Cut | None = None,
) -> Shape | None:  # fmt: skip
    """Triangles of a Mesh, gprim or curves at a time; None, with a notice that says why, where nothing is left to draw.

    Args:
        fineness: of subdivision surfaces
        cut: how finely curves are cut; None asks the prim alone, and `fineness`
    """
    try:
        if prim.GetTypeName() in CURVES:
            shape = _read_curves(prim, time, notices, fineness, cut)
        elif prim.GetTypeName() != "Mesh":
            shape = _read_gprim(prim, time)
        elif is_subdivided(prim, time):
            shape = _read_surface(UsdGeom.Mesh(prim), time, notices, fineness)
        else:
            shape = _read_mesh(UsdGeom.Mesh(prim), time, notices)
    except Unusable as reason:
        notices.append(Notice(str(prim.GetPath()), f"skipped: {reason}"))
        return None
    return shape


def varies(prim: Usd.Prim, names: tuple[str, ...]) -> bool:
    """Whether any of these attributes may be another one at another time."""
    authored = [name for name in prim.GetAuthoredPropertyNames() if name in names]
    found = map(prim.GetAttribute, authored)
    return any(one.ValueMightBeTimeVarying() or (one.GetName() in FLIGHT and flies(one)) for one in found)


def _read_gprim(prim: Usd.Prim, time: Usd.TimeCode) -> Shape:
    """A sphere, cube, cone ... as triangles, exactly a sphere where it is one."""
    gprim = gprims.read_gprim(prim, time)
    return Shape(
        points=gprim.solid.points,
        triangles=gprim.solid.triangles,
        normals=gprim.solid.normals,
        natural={"st": gprim.solid.st},
        prim_from_shape=gprim.prim_from_solid,
        closed=gprim.solid.closed,
        double_sided=bool(UsdGeom.Gprim(prim).GetDoubleSidedAttr().Get(time)),
        varying=varies(prim, gprims.ATTRIBUTES[prim.GetTypeName()]),
        is_sphere=gprim.is_sphere,
    )


def _read_curves(
    prim: Usd.Prim, time: Usd.TimeCode, notices: list[Notice], fineness: Fineness, cut: curves.Cut | None
) -> Shape:
    """Curves as tubes, which are solids, or as ribbons."""
    drawn = curves.read_curves(prim, time, notices, fineness, cut)
    return Shape(
        points=drawn.sides.points,
        triangles=drawn.sides.triangles,
        normals=Corners(drawn.sides.normals, drawn.sides.normal_rows),
        topology=drawn.topology,
        closed=drawn.round,
        double_sided=not drawn.round,
        varying=varies(prim, curves.ATTRIBUTES),
    )


@dataclass(frozen=True)
class _Faces:
    """The faces of a mesh that can be used."""

    points: F32
    indices: Index
    starts: Index
    counts: Index
    faces: Index
    """shape (F,): their numbers among all faces of the prim"""
    total: int
    """Faces of the prim, good or bad"""
    corner_total: int
    """Face corners of the prim, good or bad"""
    faults: dict[str, int]
    """What was left out, and how many"""
    known: _Topology | None = None
    """What was found out already about a mesh of the same topology"""
    holes: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """shape (total,): faces that are not drawn but shape the surface around them; of subdivision surfaces alone"""


class _Topology(NamedTuple):
    """Counts and indices with nothing wrong in them, and what follows from them alone."""

    counts: Index
    indices: Index
    starts: Index
    faces: Index
    cut: Triangles
    """Every polygon as a fan from its first corner"""
    vertices: Index
    """shape (T, 3): the points of `cut`"""
    loops: tuple[Index, ...]
    """Corners of the polygons, shape (F, n) for each n"""
    used: int
    """Points in use: these are the first so many"""
    closed: bool
    """By the indices alone"""


@lru_cache(maxsize=1024)
def _topology(count_bytes: bytes, index_bytes: bytes) -> _Topology | None:
    """A small mesh's topology; None where some polygon or index needs a closer look."""
    counts, indices = np.frombuffer(count_bytes, np.int64), np.frombuffer(index_bytes, np.int64)
    used = int(indices.max()) + 1 if len(indices) else 0
    if counts.min() < 3 or counts.sum() != len(indices) or not np.array_equal(np.unique(indices), np.arange(used)):
        return None
    starts = np.cumsum(counts) - counts
    cut, loops = fans(starts, counts)
    closed = is_closed(np.zeros((1, 3), np.float32), indices, starts, counts)
    return _Topology(counts, indices, starts, np.arange(len(counts)), cut, indices[cut.corners], loops, used, closed)


def _read_mesh(mesh: UsdGeom.Mesh, time: Usd.TimeCode, notices: list[Notice], *, cage: bool = False) -> Shape:
    """A Mesh as triangles; faces that cannot be used are left out with a notice.

    Args:
        cage: of a surface that is too large to be subdivided; it has smooth normals
    """
    faces = _usable_faces(mesh, time)
    cut = _cut(faces, str(mesh.GetPath()), notices)
    left_handed = mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded
    corners = turned_over(cut.corners) if left_handed else cut.corners
    known = faces.known
    if known is not None and corners is known.cut.corners:
        vertices = known.vertices
        points, triangles = faces.points, vertices
    else:
        vertices = faces.indices[corners]
        points, triangles = _compact(faces.points, vertices)
    topology = Topology(corners, vertices, cut.faces, faces.corner_total, len(faces.points), faces.total)
    if cage:
        normals: Corners | None = Corners(smooth_normals(points, triangles), triangles)
    else:
        normals = _authored_normals(mesh, time, topology, notices)
    return Shape(
        points=points,
        triangles=np.ascontiguousarray(triangles, np.uint32),
        normals=_mended(normals, points, triangles),
        topology=topology,
        closed=(known is not None and known.closed)
        or is_closed(faces.points, faces.indices, faces.starts, faces.counts),
        double_sided=bool(mesh.GetDoubleSidedAttr().Get(time)),
        varying=varies(mesh.GetPrim(), _MESH_ATTRIBUTES),
        cage=cage,
    )


def _read_surface(mesh: UsdGeom.Mesh, time: Usd.TimeCode, notices: list[Notice], fineness: Fineness) -> Shape:
    """A subdivision surface as triangles on its limit; its cage, where even one step would make too many.

    Raises:
        Unusable: nothing of it is left to draw.
    """
    path = str(mesh.GetPath())
    faces = _usable_faces(mesh, time, surface=True)
    faults = dict(faces.faults)
    loops = without_repeats(Loops(faces.indices, faces.starts, faces.counts, faces.faces), faults)
    loops = cut_for_loop(mesh, time, faces.points, loops, notices)
    if not len(loops.counts):
        raise Unusable(_nothing(faces, faults))
    cage = read_cage(mesh, time, loops, len(faces.points), notices)
    steps = steps_of(cage, fineness)
    if steps < 0:
        return _read_mesh(mesh, time, notices, cage=True)
    made = surface(faces.points, cage, faces.holes[loops.faces], steps)
    if made.lost:
        notices.append(Notice(path, f"{made.lost} of its creases are ignored: they run along no edge"))
    last = made.refinement.last
    points, normals = made.points.astype(np.float32), made.normals.astype(np.float32)
    corners = made.corners[has_area(points, last.vertices[made.corners])]
    if not len(corners):
        raise Unusable(_nothing(faces, faults) + ("" if faults else _HIDDEN))
    if faults:
        notices.append(Notice(path, _left_out(faces, faults)))
    if mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded:
        corners, normals = turned_over(corners), -normals
    vertices = last.vertices[corners]
    used, triangles = _compact(points, vertices)
    of_triangle = loops.faces[last.root[last.owner[corners[:, 0]]]]
    size = faces.corner_total, len(faces.points), faces.total
    return Shape(
        points=used,
        triangles=np.ascontiguousarray(triangles, np.uint32),
        normals=_mended(Corners(normals, corners), used, triangles),
        topology=Topology(corners, vertices, of_triangle, *size, made.refinement),
        closed=made.closed or _closes(made.corners, last.vertices, points),
        double_sided=bool(mesh.GetDoubleSidedAttr().Get(time)),
        varying=varies(mesh.GetPrim(), (*_MESH_ATTRIBUTES, *SUBDIVISION_ATTRIBUTES)),
        subdivided=True,
        coarse=steps < fineness.steps,
    )


def _closes(corners: Index, vertices: Index, points: F32) -> bool:
    """Whether triangles close a volume; corners as shape (T, 3)."""
    flat = corners.ravel()
    return is_closed(points, vertices[flat], np.arange(len(corners)) * 3, np.full(len(corners), 3))


def _cut(faces: _Faces, path: str, notices: list[Notice]) -> Triangles:
    """Triangles with an area, and one notice about everything that is not drawn.

    Raises:
        Unusable: where none is left.
    """
    if faces.known is not None and fans_fit(faces.points, faces.indices, faces.known.loops):
        return faces.known.cut
    cut = triangulate(faces.points, faces.indices, faces.starts, faces.counts, faces.faces)
    drawn = np.bincount(cut.faces, minlength=faces.total)[faces.faces] > 0
    faults = dict(faces.faults)
    if flat := int((~drawn).sum()):
        faults["faces without area"] = flat
    if not len(cut.faces):
        raise Unusable(_nothing(faces, faults))
    if faults:
        notices.append(Notice(path, _left_out(faces, faults)))
    return cut


def _nothing(faces: _Faces, faults: dict[str, int]) -> str:
    listed = ", ".join(f"{count} {what}" for what, count in faults.items()) or "all are holes"
    return f"none of its {faces.total} faces can be drawn: {listed}"


def _left_out(faces: _Faces, faults: dict[str, int]) -> str:
    listed = ", ".join(f"{count} {what}" for what, count in faults.items())
    return f"not everything in its {faces.total} faces can be used; left out: {listed}"


def _usable_faces(mesh: UsdGeom.Mesh, time: Usd.TimeCode, *, surface: bool = False) -> _Faces:
    """Reads the topology and leaves out what cannot be drawn.

    Args:
        surface: keeps holes as faces, and says which they are

    Raises:
        Unusable: where there are no points or faces, or a count is negative, so that no face can be told from another.
    """
    values = as_values(points_at(mesh.GetPrim(), time))
    counts = integers(mesh.GetFaceVertexCountsAttr().Get(time))
    indices = integers(mesh.GetFaceVertexIndicesAttr().Get(time))
    if values is None or not len(values) or values.shape[1] != 3:
        raise Unusable("it has no points at this time")
    if not len(counts):
        raise Unusable("it has no faces at this time")
    holes = integers(mesh.GetHoleIndicesAttr().Get(time))
    if len(indices) <= _SMALL and not len(holes) and not surface:
        known = _topology(counts.tobytes(), indices.tobytes())
        if known is not None and known.used == len(values) and _tame(values):
            shared = known.indices, known.starts, known.counts, known.faces
            return _Faces(values, *shared, len(counts), len(indices), {}, known)
    if counts.min() < 0:
        raise Unusable(f"faceVertexCounts has {int((counts < 0).sum())} negative values")
    ends = np.cumsum(counts)
    starts = ends - counts
    if counts.min() >= 3 and ends[-1] == len(indices) and not len(holes) and _sound(values, indices):
        every, none = np.arange(len(counts)), np.zeros(len(counts), bool)
        return _Faces(values, indices, starts, counts, every, len(counts), len(indices), {}, None, none)
    faults: dict[str, int] = {}
    usable = np.ones(len(counts), bool)
    _exclude(usable, counts >= 3, "faces with fewer than 3 vertices", faults)
    text = f"faces whose faceVertexCounts go beyond the {len(indices)} faceVertexIndices"
    _exclude(usable, ends <= len(indices), text, faults)
    if ends[-1] < len(indices):
        faults["faceVertexIndices that belong to no face"] = int(len(indices) - ends[-1])
    wrong = (indices < 0) | (indices >= len(values))
    outside = _any_of_face(wrong, starts, counts)
    _exclude(usable, ~outside, f"faces with indices outside 0 .. {len(values) - 1}", faults)
    wild = ~np.all(np.abs(values) <= LARGEST, axis=1)
    if wild.any():
        bad = _any_of_face(wild[np.where(wrong, 0, indices)], starts, counts)
        _exclude(usable, ~bad, "faces with points that are NaN, infinite or over 1e15", faults)
    named = (holes >= 0) & (holes < len(counts))
    if not named.all():
        faults["holeIndices that name no face"] = int((~named).sum())
    hidden = np.zeros(len(counts), bool)
    hidden[holes[named]] = True
    if not surface:
        usable &= ~hidden
    faces = np.flatnonzero(usable)
    kept = starts[faces], counts[faces], faces
    return _Faces(values, indices, *kept, len(counts), len(indices), faults, None, hidden)


def _sound(points: F32, indices: Index) -> bool:
    """Nothing wrong with any of them."""
    return bool(indices.min() >= 0 and indices.max() < len(points)) and _tame(points)


def _tame(points: F32) -> bool:
    """No NaN, no infinity, nothing beyond `LARGEST`."""
    return bool(points.min() >= -LARGEST and points.max() <= LARGEST)


def _exclude(usable: NDArray[np.bool_], good: NDArray[np.bool_], why: str, faults: dict[str, int]) -> None:
    """Takes the faces that are not `good` out of `usable` and counts those that were still in."""
    if count := int((usable & ~good).sum()):
        faults[why] = count
    usable &= good


def _any_of_face(corner_flags: NDArray[np.bool_], starts: Index, counts: Index) -> NDArray[np.bool_]:
    """Whether a flag is set at any corner of each face; corners that do not exist have none."""
    if not corner_flags.any():
        return np.zeros(len(counts), bool)
    running = np.concatenate(([0], np.cumsum(corner_flags)))
    last = len(corner_flags)
    found: NDArray[np.bool_] = running[np.minimum(starts + counts, last)] > running[np.minimum(starts, last)]
    return found


def _agreement(normals: F32, rows: Index, points: F64, triangles: U32) -> float:
    """Sum of area times cosine between the faces and the normals at their corners: negative if most look against."""
    faces = across(points[triangles])
    return float(sum(np.einsum("ij,ij->", faces, normals[rows[:, corner]]) for corner in range(3)))


def _compact(points: F32, vertices: Index) -> tuple[F32, Index]:
    """Without the points no triangle uses."""
    used = np.zeros(len(points), bool)
    used[vertices.ravel()] = True
    if used.all():
        return points, vertices
    return points[used], (np.cumsum(used) - 1)[vertices]


def _authored_normals(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, topology: Topology, notices: list[Notice]
) -> Corners | None:
    """`primvars:normals`, else `normals`."""
    path = str(mesh.GetPath())
    attribute = mesh.GetPrim().GetAttribute("primvars:normals")
    primvar = UsdGeom.Primvar(attribute) if attribute else None
    try:
        if primvar and primvar.HasValue():
            normals = evaluate(primvar, time, topology)
            if primvar.GetElementSize() != 1:
                notices.append(Notice(path, WHOLE))
        else:
            values = as_values(mesh.GetNormalsAttr().Get(time))
            if values is None or not len(values):
                return None
            normals = to_corners(values, None, mesh.GetNormalsInterpolation(), topology)
        if normals is None or normals.values.shape[1] != 3:
            raise Unusable("they are not vectors of 3")
    except Unusable as reason:
        notices.append(Notice(path, f"the attribute normals is ignored and flat shading used: {reason}"))
        return None
    if normals.rows is None:
        return Corners(normals.values, np.zeros(topology.corners.shape, np.int64))
    return normals


def _mended(normals: Corners | None, points: F32, triangles: Index) -> Corners | None:
    """Unit normals; where one is zero or NaN, that of the triangle."""
    if normals is None or normals.rows is None:
        return None
    lengths = np.sqrt((normals.values.astype(np.float64) ** 2).sum(axis=1))
    bad = ~(np.isfinite(lengths) & (lengths > 0.0))
    lengths[bad] = 1.0
    unit = (normals.values / lengths[:, None]).astype(np.float32)
    if not bad.any():
        return Corners(unit, normals.rows)
    unit[bad] = (0.0, 0.0, 1.0)  # no corner takes it any more
    at = bad[normals.rows]
    rows = np.flatnonzero(at.any(axis=1))
    around = points[triangles[rows]].astype(np.float64)
    flat = across(around)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    picks = normals.rows.copy()
    picks[rows] = np.where(at[rows], len(unit) + np.arange(len(rows))[:, None], picks[rows])
    return Corners(np.concatenate((unit, flat.astype(np.float32))), picks)
