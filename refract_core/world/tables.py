"""A scene packed for kernels: one BVH, and flat tables of its geometry and materials."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError
from ..kernels.arrays import F32_1D, F32_2D, F32_3D, I32_1D, I32_2D, I32_3D, I64_1D, I64_2D, U8_1D, U32_2D
from ..models import BY_TOKEN
from ..scene import Balls, Instances, LightKind, Material, Mesh, Model, Param, Scene, Source, Sphere, prim_of
from . import embree
from .bounced import Bounced, no_bounced
from .caustics import Caustics, no_caustics
from .embree import (
    CASTER_SHIFTS,
    CUTOUT_MOVING,
    CUTOUT_STATIC,
    FIRST_CAPTURED_BIT,
    REFRACTIVE,
    SOLID_MOVING,
    SOLID_STATIC,
    Bvh,
    Part,
)
from .environment import EnvironmentTable
from .instances import bounds_of, numbered
from .lights import LightTable
from .textures import TextureTable

INPUTS = len(Param)


class Geometry(NamedTuple):
    """Everything hit-able. A *part* is one Embree geometry: the opaque or the refractive triangles of a mesh, in one
    place or in many, or a sphere; its number is Embree's geometry ID. G parts, T primitives, S primvar slots."""

    handle: int
    """RTCScene"""
    points: F32_2D
    """shape (V, 3) [m]; of a part with many places, in its own frame"""
    triangles: U32_2D
    """shape (T, 3); a sphere has one unused row"""
    material: I32_1D
    """shape (T,)"""
    first: I64_1D
    """shape (G,): row of a part's first primitive; parts may share theirs"""
    primitives: I64_1D
    """shape (G,): primitives of a part"""
    place: I64_1D
    """shape (G,): row of the first of its places in `transforms`; -1 for what stands where its points are"""
    places: I64_1D
    """shape (G,): in how many it stands"""
    transforms: F32_3D
    """shape (P, 3, 4): engine world from a part's own frame"""
    sphere: F32_2D
    """shape (G, 4): centre, radius [m]; radius 0 for triangles, and for many spheres"""
    ball: I64_1D
    """shape (G,): row of the first of many spheres in `balls`, each of which is one of its places; -1 for others"""
    balls: F32_2D
    """shape (B, 4): centre, radius [m]"""
    thing: I32_1D
    """shape (G,): index of the prim, meshes first, then spheres, instances, balls; a part's further places follow"""
    surface: I32_1D
    """shape (G,): number of a part's surface; those of its further places follow"""
    sheet: U8_1D
    """shape (G,): 1 where the surface is open, so that both of its sides face the air"""
    touched: U8_1D
    """shape (G,): 1 where the bounds of something opaque reach into those of a part of glass, so that they may touch"""
    normals: F32_3D
    """shape (N, 3, 3): corner normals"""
    first_normal: I64_1D
    """shape (G,): row of a part's first corner normals; -1 is flat"""
    primvars: F32_1D
    """flat pool"""
    primvar_first: I64_2D
    """shape (G, S): offset into the pool; -1 where the part has no such primvar"""
    primvar_stride: I64_2D
    """shape (G, S): floats from one triangle to the next; 0 where constant"""
    primvar_step: I64_2D
    """shape (G, S): floats from one place to the next; 0 where all have the same"""
    primvar_size: I64_2D
    """shape (G, S): floats per value"""


class MaterialTable(NamedTuple):
    """One row per material, one column per `Param`."""

    value: F32_3D
    """shape (M, I, 4)"""
    texture: I32_2D
    channel: I32_2D
    wrap: I32_3D
    """shape (M, I, 2)"""
    scale: F32_3D
    bias: F32_3D
    uv_slot: I32_2D
    uv_value: F32_3D
    uv_matrix: F32_3D
    primvar_slot: I32_2D
    driven: I32_1D
    """shape (M,): bit i is set where a texture or primvar drives input i"""
    model: I32_1D
    """shape (M,), as `scene.Model`: its own; NONE where it is opaque"""
    drawn: I32_1D
    """shape (M,): what it is drawn as, which the settings may say for all that is refractive"""
    specular_workflow: U8_1D
    presence: U8_1D
    threshold: F32_1D
    cutout: U8_1D
    absorption_distance: F32_1D
    abbe: F32_1D
    priority: I32_1D
    """as `refraction:priority`"""
    spreads: U8_1D
    """1 where a surface may send light back diffusely"""
    gleams: U8_1D
    """1 where what a surface shows depends on where it is seen from"""


class GlassShade(NamedTuple):
    """What glass does to light on its way to a surface."""

    casts: U8_1D
    """shape (G,): 1 where the light that goes through a part, or off it, is in `World.caustics`; it stops all other"""
    walked: bool
    """some glass is looked through straight on; otherwise all of it stops light"""


class World(NamedTuple):
    """The whole scene as a kernel sees it."""

    geometry: Geometry
    materials: MaterialTable
    textures: TextureTable
    lights: LightTable
    environment: EnvironmentTable
    glass: GlassShade
    caustics: Caustics
    bounced: Bounced
    cutouts: bool
    """Some material is a cut-out, so that hits must be looked at."""
    lit: bool
    """Some light or the sky shines; otherwise all light is emitted, and falls on nothing."""
    gleams: bool
    """Some light has highlights in glass. The one that stands in at the eye has none: it would burn a white spot into
    whatever faces the eye."""


def world_of(
    geometry: Geometry,
    materials: MaterialTable,
    textures: TextureTable,
    lights: LightTable,
    environment: EnvironmentTable,
) -> World:
    """Put the tables together; light goes straight through all glass."""
    lit = len(lights.kind) > 0 or (environment.present and not environment.dark)
    walked = bool((materials.model != Model.NONE).any())
    glass = GlassShade(np.zeros(len(geometry.thing), np.uint8), walked)
    cutouts = bool(materials.cutout.any())
    gleams = bool(((lights.specular > 0.0) & (lights.kind != LightKind.CAMERA)).any())
    arrived = no_caustics(), no_bounced()
    return World(geometry, materials, textures, lights, environment, glass, *arrived, cutouts, lit, gleams)


def pack_materials(materials: Sequence[Material], slots: dict[str, int], drawn_as: str) -> MaterialTable:
    """Rows of sources as columns of arrays.

    Args:
        slots: gives primvar names their numbers.
        drawn_as: token of the model that all refractive materials are drawn as; '' for their own.
    """

    def column(get: Any, dtype: Any) -> NDArray[Any]:
        if not materials:
            return np.zeros((0, INPUTS, *np.shape(get(Source()))), dtype)
        return np.array([[get(source) for source in material.inputs] for material in materials], dtype)

    def per_material(get: Any, dtype: Any) -> NDArray[Any]:
        return np.array([get(material) for material in materials], dtype)

    return MaterialTable(
        value=column(lambda s: s.value, np.float32),
        texture=column(lambda s: s.texture, np.int32),
        channel=column(lambda s: int(s.channel), np.int32),
        wrap=column(lambda s: (int(s.wrap[0]), int(s.wrap[1])), np.int32),
        scale=column(lambda s: s.scale, np.float32),
        bias=column(lambda s: s.bias, np.float32),
        uv_slot=column(lambda s: slots.get(s.uv_primvar, -1), np.int32),
        uv_value=column(lambda s: s.uv_value, np.float32),
        uv_matrix=column(lambda s: s.uv_matrix, np.float32),
        primvar_slot=column(lambda s: slots.get(s.primvar, -1), np.int32),
        driven=per_material(_driven, np.int32),
        model=per_material(lambda m: int(m.model), np.int32),
        drawn=per_material(lambda m: int(BY_TOKEN[drawn_as] if drawn_as and m.refractive else m.model), np.int32),
        specular_workflow=per_material(lambda m: m.specular_workflow, np.uint8),
        presence=per_material(lambda m: m.opacity_presence, np.uint8),
        threshold=per_material(lambda m: m.opacity_threshold, np.float32),
        cutout=per_material(lambda m: m.cutout, np.uint8),
        absorption_distance=per_material(lambda m: m.absorption_distance, np.float32),
        abbe=per_material(lambda m: m.abbe, np.float32),
        priority=per_material(lambda m: m.priority, np.int32),
        spreads=per_material(_spreads, np.uint8),
        gleams=per_material(_gleams, np.uint8),
    )


def _spreads(material: Material) -> bool:
    """Not all of it is black."""
    source = material.inputs[Param.DIFFUSE]
    return source.driven or any(source.value[:3])


def _gleams(material: Material) -> bool:
    """Some of it may be so smooth that it mirrors the scene; metals, and what has a specular colour, do so sooner."""

    def least(param: Param) -> float:
        source = material.inputs[param]
        return 0.0 if source.driven else source.value[0]

    metal = material.inputs[Param.METALLIC]
    strong = material.specular_workflow or metal.driven or metal.value[0] > 0.1
    return least(Param.ROUGHNESS) < (0.5 if strong else 0.2)


def _driven(material: Material) -> int:
    return sum(1 << i for i, source in enumerate(material.inputs) if source.driven)


def primvar_slots(materials: Sequence[Material]) -> dict[str, int]:
    """A number for every primvar that some material reads."""
    names = {name for m in materials for s in m.inputs for name in (s.uv_primvar, s.primvar) if name}
    return {name: i for i, name in enumerate(sorted(names))}


class _Pile:
    """Arrays gathered part by part, to be concatenated once."""

    def __init__(self, slots: dict[str, int]) -> None:
        self.slots = slots
        self.parts: list[Part] = []
        self.points: list[NDArray[np.float32]] = []
        self.triangles: list[NDArray[np.uint32]] = []
        self.material: list[NDArray[np.int32]] = []
        self.normals: list[NDArray[np.float32]] = []
        self.primvars: list[NDArray[np.float32]] = []
        self.transforms: list[NDArray[np.float32]] = []
        self.rows: list[tuple[int, int, int, int, int, tuple[float, ...], int, int, bool, int]] = []
        self.primvar_rows: list[list[tuple[int, int, int, int]]] = []
        self.bounds: list[tuple[Any, Any]] = []
        self.point_count = self.triangle_count = self.normal_count = self.primvar_count = 0
        self.balls: list[NDArray[np.float32]] = []
        self.place_count = self.surface_count = self.ball_count = 0
        self.shared: dict[Hashable, Any] = {}
        """What instances of one mesh have in common, by where its arrays are"""

    def once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """What is made from the same is made once. Keys that are addresses hold: the scene outlives the pile."""
        if key not in self.shared:
            self.shared[key] = make()
        return self.shared[key]

    def add_points(self, points: NDArray[np.float32]) -> int:
        """Number of the first of them."""
        self.points.append(points)
        self.point_count += len(points)
        return self.point_count - len(points)

    def add(self, part: Part, material: NDArray[np.int32], thing: int, sheet: bool,
            normals: NDArray[np.float32] | None, primvars: dict[str, NDArray[np.float32]],
            bounds: tuple[Any, Any], of_places: dict[str, NDArray[np.float32]] | None = None,
            share: Hashable = None) -> None:  # fmt: skip
        """One more part. `share`: parts with the same have their triangles and all that is of them in common."""
        self.bounds.append(bounds)
        self.parts.append(part)

        def rows() -> tuple[int, int, dict[str, tuple[int, int, int, int]]]:
            first, first_normal = self._add_triangles(part, material, normals)
            return first, first_normal, self._add_primvars(primvars)

        first, first_normal, known = rows() if share is None else self.once(share, rows)
        known = known | self._add_primvars(of_places or {}, shared=True)
        self.primvar_rows.append([known.get(name, (-1, 0, 0, 0)) for name in self.slots])
        count = 1 if part.triangles is None else len(part.triangles)
        place, places, ball = -1, 1, -1
        if part.transforms is not None:
            place, places = self._add_places(part.transforms), len(part.transforms)
        if part.balls is not None:
            ball, places = self.ball_count, len(part.balls)
            self.balls.append(part.balls)
            self.ball_count += places
        row = first, count, place, places, ball, part.sphere, thing, self.surface_count, sheet, first_normal
        self.rows.append(row)
        self.surface_count += places

    def _add_places(self, transforms: NDArray[np.float32]) -> int:
        """Parts of one mesh have their places in common."""

        def add() -> int:
            self.transforms.append(transforms)
            self.place_count += len(transforms)
            return self.place_count - len(transforms)

        return int(self.once(("places", id(transforms)), add))

    def _add_triangles(
        self, part: Part, material: NDArray[np.int32], normals: NDArray[np.float32] | None
    ) -> tuple[int, int]:
        """Rows at which they, and their normals, begin."""
        first, first_normal = self.triangle_count, -1
        if normals is not None:
            first_normal = self.normal_count
            self.normals.append(normals)
            self.normal_count += len(normals)
        triangles = part.triangles if part.triangles is not None else np.zeros((1, 3), np.uint32)
        self.triangles.append(triangles)
        self.material.append(material)
        self.triangle_count += len(triangles)
        return first, first_normal

    def join_triangles(self) -> NDArray[np.uint32]:
        """One table of all, and the parts' own are rows of it from then on: Embree reads what kernels read."""
        table = _joined(self.triangles) if self.triangles else np.zeros((0, 3), np.uint32)
        rows: dict[int, NDArray[np.uint32]] = {}  # parts that had one array still do
        for k, part in enumerate(self.parts):
            if part.triangles is not None:
                first = self.rows[k][0]
                own = rows.setdefault(id(part.triangles), table[first : first + len(part.triangles)])
                self.parts[k] = part._replace(triangles=own)
        self.triangles.clear()
        return table

    def _add_primvars(
        self, primvars: dict[str, NDArray[np.float32]], *, shared: bool = False
    ) -> dict[str, tuple[int, int, int, int]]:
        """Those that some material reads. `shared`: parts of one mesh have them in common."""
        read = {name: values for name, values in primvars.items() if name in self.slots}
        if not shared:
            return {name: self._add_primvar(values) for name, values in read.items()}
        return {name: self.once(("primvar", id(v)), partial(self._add_primvar, v)) for name, v in read.items()}

    def _add_primvar(self, values: NDArray[np.float32]) -> tuple[int, int, int, int]:
        """First float, stride, step and size. Values are of triangle corners, or (N, D) of places."""
        first, size = self.primvar_count, values.shape[-1]
        self.primvars.append(np.ascontiguousarray(values, np.float32).reshape(-1))
        self.primvar_count += values.size
        if values.ndim == 2:
            return first, 0, size, size
        return first, 0 if values.shape[1] == 1 else 3 * size, 0, size


def pack_geometry(
    scene: Scene, captured_sets: Sequence[frozenset[str] | None] = ()
) -> tuple[Geometry, Bvh, dict[str, int]]:
    """Split meshes into opaque and refractive parts, build the BVH, and lay the rest out for kernels.

    Args:
        scene: whose instances of one mesh all look the same to rays (`instances.settled`).
        captured_sets: prim paths that a restricted ray may see; set k gets mask bit `FIRST_CAPTURED_BIT + k`.

    Returns:
        The tables, the BVH that must stay alive as long as they are used, and the primvar slots.

    Raises:
        SceneError: a mesh breaks its contract; the message names its path.
    """
    slots = primvar_slots(scene.materials)
    pile, casters = _Pile(slots), caster_sets(scene)

    def mask(material: int, static: bool, path: str) -> int:
        return _mask(scene.materials[material], static, path, captured_sets, casters)

    def masks(mesh: Mesh, path: str) -> NDArray[np.int64]:
        used, which = np.unique(mesh.materials, return_inverse=True)
        return np.array([mask(m, mesh.static, path) for m in used], np.int64)[which]

    for thing, mesh in enumerate(scene.meshes):
        _check_mesh(mesh, len(scene.materials))
        _add_mesh(pile, mesh, thing, masks(mesh, mesh.path))
    for thing, ball in enumerate(scene.spheres, len(scene.meshes)):
        _add_sphere(pile, ball, thing, mask(ball.material, ball.static, ball.path))
    instances, clouds = numbered(scene)
    for thing, many in instances:
        _check_instances(many, len(scene.materials))
        told = [masks(many.mesh, owner) for owner in dict.fromkeys(owner for owner, _ in many.paths.owners())]
        if any((other != told[0]).any() for other in told[1:]):
            raise SceneError(f"{many.mesh.path}: some rays see some of its instances alone; settle the scene first")
        if len(many):
            _add_instances(pile, many, thing, told[0])
    for thing, balls in clouds:
        _check_balls(balls, len(scene.materials))
        seen = {mask(balls.material, balls.static, owner) for owner, _ in balls.paths.owners()}
        if len(seen) > 1:
            raise SceneError(f"{balls.paths[0]}: some rays see some of its spheres alone; settle the scene first")
        if len(balls):
            _add_balls(pile, balls, thing, seen.pop())
    triangles = pile.join_triangles()
    bvh = Bvh(np.concatenate(pile.points) if pile.points else np.zeros((0, 3), np.float32), pile.parts)
    columns: list[Any] = list(zip(*pile.rows, strict=True)) or [()] * 10
    first, count, place, places, ball, sphere, thing_of, surface, sheet, first_normal = columns
    primvar_rows = np.array(pile.primvar_rows, np.int64).reshape(len(pile.rows), len(slots), 4)
    geometry = Geometry(
        handle=bvh.handle,
        points=bvh.points,
        triangles=triangles,
        material=np.concatenate(pile.material) if pile.material else np.zeros(0, np.int32),
        first=np.array(first, np.int64),
        primitives=np.array(count, np.int64),
        place=np.array(place, np.int64),
        places=np.array(places, np.int64),
        transforms=_joined(pile.transforms) if pile.transforms else np.zeros((0, 3, 4), np.float32),
        sphere=np.array(sphere, np.float32).reshape(-1, 4),
        ball=np.array(ball, np.int64),
        balls=_joined(pile.balls) if pile.balls else np.zeros((0, 4), np.float32),
        thing=np.array(thing_of, np.int32),
        surface=np.array(surface, np.int32),
        sheet=np.array(sheet, np.uint8),
        touched=_touched(pile),
        normals=_joined(pile.normals) if pile.normals else np.zeros((0, 3, 3), np.float32),
        first_normal=np.array(first_normal, np.int64),
        primvars=np.concatenate(pile.primvars) if pile.primvars else np.zeros(0, np.float32),
        primvar_first=np.ascontiguousarray(primvar_rows[:, :, 0]),
        primvar_stride=np.ascontiguousarray(primvar_rows[:, :, 1]),
        primvar_step=np.ascontiguousarray(primvar_rows[:, :, 2]),
        primvar_size=np.ascontiguousarray(primvar_rows[:, :, 3]),
    )
    return geometry, bvh, slots


def _joined(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """One array of all; itself where there is but one, as a million places are worth not to be copied."""
    return np.ascontiguousarray(arrays[0] if len(arrays) == 1 else np.concatenate(arrays))


def _touched(pile: _Pile) -> NDArray[np.uint8]:
    """`Geometry.touched`, by bounds that are wider than any margin of `offsets`."""
    touched = np.zeros(len(pile.parts), np.uint8)
    if not pile.parts:
        return touched
    low, high = (np.array([bounds[k] for bounds in pile.bounds], np.float64) for k in range(2))
    margin = 2e-4 * np.maximum(np.abs(low), np.abs(high)).max(axis=1, keepdims=True) + 2e-5
    low, high = low - margin, high + margin
    glass = np.array([bool(part.mask & int(REFRACTIVE)) for part in pile.parts])
    for k in np.flatnonzero(glass):
        touched[k] = ((low[~glass] <= high[k]) & (high[~glass] >= low[k])).all(axis=1).any()
    return touched


def rows_of(geometry: Geometry, part: int) -> slice:
    """A part's primitives, as rows of `Geometry.triangles`."""
    first = int(geometry.first[part])
    return slice(first, first + int(geometry.primitives[part]))


def places_of(geometry: Geometry, part: int) -> NDArray[np.float32]:
    """A part's places, shape (N, 3, 4): engine world from where its points are."""
    k = int(geometry.place[part])
    return geometry.transforms[k : k + int(geometry.places[part])] if k >= 0 else np.eye(3, 4, dtype=np.float32)[None]


def balls_of(geometry: Geometry, part: int) -> NDArray[np.float32]:
    """Centres and radii of the spheres that a part is, shape (N, 4) [m]; none of triangles."""
    k = int(geometry.ball[part])
    if k >= 0:
        return geometry.balls[k : k + int(geometry.places[part])]
    return geometry.sphere[part : part + 1] if geometry.sphere[part, 3] > 0.0 else geometry.balls[:0]


def caster_sets(scene: Scene) -> list[frozenset[str]]:
    """Paths of the prims that cast the shadows of some light, for lights whose shadows not everything casts; at most as
    many as there are `CASTER_SHIFTS`, which readers see to."""
    return list(dict.fromkeys(frozenset(light.casters) for light in scene.lights if light.casters is not None))


def _mask(
    material: Material, static: bool, path: str, captured_sets: Sequence[frozenset[str] | None],
    casters: Sequence[frozenset[str]],
) -> int:  # fmt: skip
    if material.refractive:
        return int(REFRACTIVE)
    still, moving = (CUTOUT_STATIC, CUTOUT_MOVING) if material.cutout else (SOLID_STATIC, SOLID_MOVING)
    mask = int(still if static else moving)
    for k, paths in enumerate(captured_sets):
        if paths is None or prim_of(path) in paths:
            mask |= 1 << (FIRST_CAPTURED_BIT + k)
    for shift, paths in zip(CASTER_SHIFTS, casters, strict=False):
        if prim_of(path) in paths:
            mask |= int(still if static else moving) << shift
    return mask


class _Cut(NamedTuple):
    """The triangles of a mesh that have one mask."""

    mask: int
    triangles: NDArray[np.uint32]
    materials: NDArray[np.int32]
    normals: NDArray[np.float32] | None
    primvars: dict[str, NDArray[np.float32]]


def _cuts(mesh: Mesh, base: int, mask_of_triangle: NDArray[np.int64]) -> list[_Cut]:
    """By their masks. `base`: row of the mesh's first point."""
    cuts = []
    for mask in np.unique(mask_of_triangle):
        keep = slice(None) if (mask_of_triangle == mask).all() else np.flatnonzero(mask_of_triangle == mask)
        primvars = {k: v if v.shape[1] == 1 else v[keep] for k, v in mesh.primvars.items()}
        triangles = (mesh.triangles[keep] + np.uint32(base)).astype(np.uint32)
        normals = None if mesh.normals is None else mesh.normals[keep]
        cuts.append(_Cut(int(mask), triangles, mesh.materials[keep].astype(np.int32), normals, primvars))
    return cuts


def _add_mesh(pile: _Pile, mesh: Mesh, thing: int, mask_of_triangle: NDArray[np.int64]) -> None:
    bounds = (mesh.points.min(axis=0), mesh.points.max(axis=0)) if len(mesh.points) else (np.zeros(3), np.zeros(3))
    for cut in _cuts(mesh, pile.add_points(mesh.points), mask_of_triangle):
        part = Part(cut.mask, cut.triangles)
        pile.add(part, cut.materials, thing, not mesh.closed, cut.normals, cut.primvars, bounds)


def _add_instances(pile: _Pile, many: Instances, thing: int, mask_of_triangle: NDArray[np.int64]) -> None:
    """What is the same of other instances is there once."""
    mesh, bounds = many.mesh, bounds_of(many)
    base = pile.once((id(mesh.points),), lambda: pile.add_points(mesh.points))
    _, pattern = np.unique(mask_of_triangle, return_inverse=True)
    arrays = mesh.triangles, mesh.materials, mesh.normals, *mesh.primvars.values()
    key = base, pattern.tobytes(), tuple(mesh.primvars), tuple(map(id, arrays))
    cuts = pile.once(key, lambda: _cuts(mesh, base, pattern))
    # Embree has one hierarchy for all that have the same array of triangles, whatever their materials.
    bare = pile.once((base, pattern.tobytes(), id(mesh.triangles)), lambda: [cut.triangles for cut in cuts])
    for k, (cut, triangles) in enumerate(zip(cuts, bare, strict=True)):
        mask = int(mask_of_triangle[pattern == cut.mask][0])
        part = Part(mask, triangles, transforms=many.transforms)
        pile.add(
            part, cut.materials, thing, not mesh.closed, cut.normals, cut.primvars, bounds, many.primvars, (*key, k)
        )


def _add_sphere(pile: _Pile, ball: Sphere, thing: int, mask: int) -> None:
    part = Part(mask, None, (*ball.centre, ball.radius))
    centre = np.array(ball.centre)
    bounds = (centre - ball.radius, centre + ball.radius)
    pile.add(part, np.array([ball.material], np.int32), thing, False, None, ball.primvars, bounds)


def _add_balls(pile: _Pile, balls: Balls, thing: int, mask: int) -> None:
    table = np.concatenate([balls.centres, balls.radii[:, None]], axis=1).astype(np.float32)
    wide = float(balls.radii.max())
    bounds = (balls.centres.min(axis=0) - wide, balls.centres.max(axis=0) + wide)
    same = {name: values for name, values in balls.primvars.items() if values.ndim == 3}
    own = {name: values for name, values in balls.primvars.items() if values.ndim == 2}
    part = Part(mask, None, (0.0, 0.0, 0.0, 0.0), balls=table)
    pile.add(part, np.array([balls.material], np.int32), thing, False, None, same, bounds, own)


def _check_balls(balls: Balls, material_count: int) -> None:
    count, path = len(balls.radii), balls.paths[0] if len(balls.paths) else "spheres"
    if balls.centres.shape != (count, 3) or balls.radii.shape != (count,) or len(balls.paths) != count:
        raise SceneError(f"{path}: centres must have shape (N, 3), radii (N,), and paths be N")
    if not 0 <= balls.material < material_count:
        raise SceneError(f"{path}: material must be an index below {material_count}")
    for name, values in balls.primvars.items():
        if values.shape[:-1] not in ((count,), (1, 1)):
            raise SceneError(f"{path}: primvar {name} must have shape ({count}, D) or (1, 1, D)")
    bad = np.flatnonzero(~np.isfinite(balls.centres).all(axis=1) | ~np.isfinite(balls.radii) | (balls.radii <= 0.0))
    if len(bad):
        raise SceneError(f"{balls.paths[int(bad[0])]}: a sphere must be finite with a radius above 0")


def _check_instances(many: Instances, material_count: int) -> None:
    count = len(many.transforms)
    _check_mesh(many.mesh, material_count)
    if len(many.paths) != count:
        raise SceneError(f"{many.mesh.path}: {count} transforms but {len(many.paths)} paths")
    for name, values in many.primvars.items():
        if values.ndim != 2 or len(values) != count or name in many.mesh.primvars:
            raise SceneError(f"{many.mesh.path}: primvar {name} of instances must be new, and of shape ({count}, D)")
    try:
        embree.check_transforms(many.transforms)
    except SceneError as error:
        raise SceneError(f"{many.mesh.path}: {error}") from None


def _check_mesh(mesh: Mesh, material_count: int) -> None:
    t = len(mesh.triangles)
    if mesh.materials.shape != (t,) or (t and not 0 <= mesh.materials.min() <= mesh.materials.max() < material_count):
        raise SceneError(f"{mesh.path}: materials must be {t} indices below {material_count}")
    if mesh.normals is not None and mesh.normals.shape != (t, 3, 3):
        raise SceneError(f"{mesh.path}: normals must have shape ({t}, 3, 3), not {mesh.normals.shape}")
    for name, values in mesh.primvars.items():
        if values.ndim != 3 or values.shape[:2] not in ((t, 3), (1, 1)):
            raise SceneError(f"{mesh.path}: primvar {name} must have shape ({t}, 3, D) or (1, 1, D)")
    try:
        embree.check_parts(mesh.points, [Part(0, mesh.triangles)])
    except SceneError as error:
        raise SceneError(f"{mesh.path}: {error}") from None
