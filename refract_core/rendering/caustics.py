"""Caustics made ready: which glass throws them, how many photons, how fine they are kept."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.lanes import by_address, scratch
from ..models import Behind, Model
from ..scene import F64, Camera, LightKind, Scene
from ..settings import RenderSettings
from ..transport.crossing import Rules
from ..transport.photons import BANDS, SECTORS, PhotonScratch, Sources, photon_batch, weigh_sources
from ..transport.rays import ray_in_air
from ..transport.tree import TreeScratch
from ..view.camera import image_size
from ..world.caustics import (
    LEVELS,
    Caustics,
    Landings,
    add_photons,
    count_photons,
    new_caustics,
    new_tally,
    no_caustics,
    raise_levels,
)
from ..world.instances import around, instances_at
from ..world.solid import across, along_a_curve, encloses
from ..world.tables import GlassShade, World, balls_of, places_of, rows_of
from .work import Work

_CUT = 0.01
"""Weight below which a photon's branch is given to its sibling: a tenth gains nothing, and costs a third more."""
_LAYERS = 32
"""Surfaces that a photon may enter, whatever the picture's own limit is: light must get out."""
_BATCH = 1024
"""Photons that a thread follows at once."""
_WANTED, _OF = 2.0, 1 << 16
"""Photons in a texel, about, of so many: fewer are noise, more could be drawn finer. Of more, it is best to look at
more at once (Silverman, "Density Estimation", 1986, section 5.2); by the square root, as measured."""
_PIXELS = 1.2
"""Sides of a pixel that the smallest texel has, at least."""
_COARSE = 16.0
"""Sides of a pixel that the largest has, at least: what light falls on has edges and curves."""
_PLATE = 0.9
"""Part of a body's surface that looks one way or the opposite, from which on it is a plate, which
light leaves as it came."""
_MOST_SOURCES = 1 << 20
"""Pieces of glass that are weighed for themselves, for all lights together."""
_BENDING = [int(model) for model in Model if model.behind in (Behind.MESH, Behind.BALL)]


class Thrown(NamedTuple):
    """Light through glass, made ready."""

    glass: GlassShade
    table: Caustics


def _throws_caustics(world: World) -> NDArray[np.bool_]:
    """Which parts are bodies of glass that bend light: closed, and no plates, nor slabs by their model. Shape (G,)."""
    geometry, materials = world.geometry, world.materials
    casts = np.zeros(len(geometry.thing), np.bool_)
    for g in range(len(casts)):
        used = np.unique(geometry.material[rows_of(world.geometry, g)])
        own = materials.model[used]
        refractive = own.size > 0 and bool((own != 0).all()) and not materials.cutout[used].any()
        bends = bool(np.isin(materials.drawn[used], _BENDING).all())
        if refractive and bends and not geometry.sheet[g]:
            casts[g] = len(balls_of(geometry, g)) > 0 or not _is_plate(world, g)
    return casts


def _corners(world: World, part: int) -> F64:
    """Shape (T, 3, 3) [m]; in the frame of a part with many places."""
    corners: F64 = world.geometry.points[world.geometry.triangles[rows_of(world.geometry, part)]].astype(np.float64)
    return corners


def _spread(transforms: NDArray[np.float32], normals: F64) -> F64:
    """Areas of triangles in some places, shape (N, T) [m^2]. `normals`: as `solid.across`, in their own frame."""
    x, y, z = (transforms[:, k, :3].astype(np.float64) for k in range(3))
    cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
    area: F64 = 0.5 * np.linalg.norm(cofactors @ normals.T, axis=1)
    return area


def _is_plate(world: World, part: int) -> bool:
    """Of many places the first stands for all."""
    linear = places_of(world.geometry, part)[0, :, :3].astype(np.float64)
    normals = across(_corners(world, part) @ linear.T)
    area = np.linalg.norm(normals, axis=1)
    if not area.any():
        return True
    facing = normals[area.argmax()] / area.max()
    same_way = np.abs(normals @ facing) > 0.999 * area
    return bool(area[same_way].sum() > _PLATE * area.sum())


# --- sources ------------------------------------------------------------------------------------------------------


def _sources(world: World, scene: Scene, casts: NDArray[np.bool_]) -> Sources:
    """Every piece of glass before every light; of very many, an even choice by area stands for all."""
    shadowing = _shadowing(world)
    parts, instances, primitives, area = _pieces(world, casts)
    most = max(1, _MOST_SOURCES // max(1, len(shadowing)))
    if len(area) > most:
        edges = np.cumsum(area) / area.sum()
        kept = np.searchsorted(edges, (np.arange(most) + 0.5) / most)
        parts, instances, primitives = parts[kept], instances[kept], primitives[kept]
        area = np.full(most, area.sum() / most)
    rows: list[list[Any]] = []
    for light in shadowing:
        within = _bodies_around(world, scene, light, np.flatnonzero(casts))
        lit_from_inside = np.flatnonzero(np.isin(world.geometry.surface[parts] + instances, within))
        for side, these in ((1.0, np.arange(len(parts))), (-1.0, lit_from_inside)):
            same = np.ones(len(these))
            rows.append([same * light, parts[these], instances[these], primitives[these], same * side, area[these]])
    columns: list[Any] = [np.concatenate(column) for column in zip(*rows, strict=True)]
    light_of, part, instance, primitive = (column.astype(np.int32) for column in columns[:4])
    return Sources(light_of, part, instance, primitive, columns[4], columns[5], np.zeros(len(part)))


def _shadowing(world: World) -> list[int]:
    """Lights that things stand before, by their rows; one more than the last is the sky."""
    count = len(world.lights.kind)
    found = [light for light in range(count) if world.lights.casts_shadow[light]]
    return [*found, count] if world.environment.present and not world.environment.dark else found


def _pieces(
    world: World, casts: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], F64]:
    """Part, place, primitive and area [m^2] of all triangles of glass, neighbours together, and of spheres' patches."""
    found: list[tuple[Any, Any, Any, Any]] = []
    for g in np.flatnonzero(casts):
        balls = balls_of(world.geometry, int(g)).astype(np.float64)
        places, primitives, area = _patches(balls) if len(balls) else _triangles(world, int(g))
        found.append((np.full(len(places), g), places, primitives, area))
    whose, instances, primitives, sizes = (np.concatenate(column) for column in zip(*found, strict=True))
    return whose, instances, primitives, sizes


def _triangles(world: World, part: int) -> tuple[NDArray[np.int64], NDArray[np.int64], F64]:
    """Place, number and area [m^2] of a part's triangles; of very many places, an even choice stands for all."""
    corners, transforms = _corners(world, part), places_of(world.geometry, part)
    order, chosen = along_a_curve(corners.mean(axis=1)), along_a_curve(transforms[:, :, 3].astype(np.float64))
    most = max(1, _MOST_SOURCES // len(order))
    if len(chosen) > most:
        chosen = chosen[np.linspace(0, len(chosen) - 1, most).astype(np.int64)]
    area = len(transforms) / len(chosen) * _spread(transforms[chosen], across(corners))[:, order].ravel()
    return np.repeat(chosen, len(order)), np.tile(order, len(chosen)), area


def _patches(balls: F64) -> tuple[NDArray[np.int64], NDArray[np.int64], F64]:
    """Place, number and area [m^2] of patches of spheres; of very many spheres, an even choice stands for all.
    `balls`: shape (N, 4)."""
    chosen, count = along_a_curve(balls[:, :3]), BANDS * SECTORS
    squares = balls[:, 3] ** 2
    most = max(1, _MOST_SOURCES // count)
    if len(chosen) > most:  # of equal area each, about
        steps = np.cumsum(squares[chosen])
        chosen = chosen[np.searchsorted(steps / steps[-1], (np.arange(most) + 0.5) / most)]
    share = squares.sum() / squares[chosen].sum()
    area = np.repeat(share * 4.0 * math.pi * squares[chosen] / count, count)
    return np.repeat(chosen, count), np.tile(np.arange(count), len(chosen)), area


def _bodies_around(world: World, scene: Scene, light: int, parts: NDArray[np.int64]) -> list[int]:
    """The surfaces of bodies that a light stands in: its rays come to them from inside."""
    lamps = world.lights
    if light == len(lamps.kind) or lamps.kind[light] == LightKind.DISTANT:
        return []
    at = lamps.axes[light, 3]
    found = []
    for g in parts:
        thing, surface = int(world.geometry.thing[g]), int(world.geometry.surface[g])
        balls = balls_of(world.geometry, int(g)).astype(np.float64)
        if len(balls):
            inside = np.linalg.norm(balls[:, :3] - at, axis=1) < balls[:, 3]
            found += (surface + np.flatnonzero(inside)).tolist()
        elif world.geometry.place[g] >= 0:
            found += [surface + k for k in around(instances_at(scene, thing), at)]
        elif encloses(scene.meshes[thing].points, scene.meshes[thing].triangles, at):
            found.append(surface)
    return found


# --- how fine -----------------------------------------------------------------------------------------------------


def _bounds(world: World, part: int) -> tuple[F64, F64]:
    """Middles (N, 3) and radii (N,) of the boxes of a part in its places [m]."""
    balls = balls_of(world.geometry, part).astype(np.float64)
    if len(balls):
        return balls[:, :3], balls[:, 3]
    corners = _corners(world, part).reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    places = places_of(world.geometry, part).astype(np.float64)
    linear, origin = places[:, :, :3], places[:, :, 3]
    return linear @ ((low + high) / 2) + origin, np.linalg.norm(np.abs(linear) @ (high - low), axis=1) / 2


def _texels(world: World, casts: NDArray[np.bool_], camera: Camera, width: int) -> tuple[F64, NDArray[np.int32]]:
    """`Wanted.texel` and `finest`: powers of two, so that a camera that moves a little changes nothing."""
    finest, largest = np.zeros(len(casts), np.int32), 0.0
    wanted = np.full(len(casts), math.inf)
    left, right = camera.window[0], camera.window[1]
    for g in np.flatnonzero(casts):
        middle, radius = _bounds(world, int(g))
        away = np.maximum(np.linalg.norm(middle - camera.world_from_camera[:3, 3], axis=1), radius / 2)
        pixel = (np.ones(1) if camera.orthographic else away) * (right - left) / width
        wanted[g] = _PIXELS * pixel.min()
        largest = max(largest, float(np.minimum(radius, _COARSE * pixel).max()))
    top = 2.0 ** math.ceil(math.log2(largest))
    finest[casts] = np.clip(np.ceil(np.log2(top / wanted[casts])), 0, LEVELS - 1)
    texel: F64 = top * np.power(0.5, np.arange(int(finest.max()) + 1))
    return texel, finest


# --- the table ----------------------------------------------------------------------------------------------------


class Wanted(NamedTuple):
    """What caustics are made of: the same as long as the camera moves a little."""

    casts: NDArray[np.bool_]
    """shape (G,): parts that throw them"""
    texel: F64
    """sizes of texels [m], the largest first"""
    finest: NDArray[np.int32]
    """shape (G,): smallest level that is of use, by the glass that a photon came by first"""
    photons: int


def plan_caustics(world: World, camera: Camera, settings: RenderSettings) -> Wanted | None:
    """What is wanted, or None: no photons, no such glass, no light, nothing for it to fall on.

    Args:
        world: not by address.
    """
    if settings.caustics == 0 or not _shadowing(world):
        return None
    casts = _throws_caustics(world)
    used = world.geometry.material
    shows = (world.materials.model[used] == 0) & (world.materials.spreads[used] != 0)
    if not casts.any() or not shows.any():
        return None
    width, _ = image_size(camera, settings.image_width, settings.image_height)
    return Wanted(casts, *_texels(world, casts, camera, width), settings.caustics)


def caustics_of(world: World, scene: Scene, wanted: Wanted | None, work: Work) -> Thrown | None:
    """Send the photons."""
    if wanted is None:
        return None
    walked = bool(_glass_parts(world)[~wanted.casts].any())
    glass = GlassShade(wanted.casts.astype(np.uint8), walked)
    return Thrown(glass, _table(world._replace(glass=glass), scene, wanted, work))


def with_caustics(world: World, thrown: Thrown | None) -> World:
    """The world with the light that its glass throws."""
    return world if thrown is None else world._replace(glass=thrown.glass, caustics=thrown.table)


def _glass_parts(world: World) -> NDArray[np.bool_]:
    refractive = world.materials.model[world.geometry.material] != 0
    return np.array([refractive[rows_of(world.geometry, g)].any() for g in range(len(world.geometry.thing))], np.bool_)


def _table(world: World, scene: Scene, wanted: Wanted, work: Work) -> Caustics:
    seen, sources, photons = by_address(world), _sources(world, scene, wanted.casts), wanted.photons
    held = by_address(sources)
    rows = range(0, len(sources.area), 1 << 13)
    work.run(lambda first: weigh_sources(seen, held, first, min(first + (1 << 13), len(sources.area))), rows)
    flux = sources.flux
    if not flux.any():
        return no_caustics()
    # A piece that seems dark may get some light between the four places that were looked at.
    flux += 1e-3 * flux.sum() * sources.area / sources.area.sum()
    cdf = np.concatenate([[0.0], np.cumsum(flux) / flux.sum()])
    cdf[-1] = 1.0
    rules = by_address(Rules(_LAYERS, _CUT, True))
    in_air = by_address(ray_in_air())

    def follow(first: int) -> Landings:
        room = 8 * _BATCH
        while True:
            words = np.zeros(room, np.int32), np.zeros(room, np.int32)
            landings = Landings(np.zeros((room, 3)), np.zeros((room, 3)), np.zeros((room, 3)), *words)
            last = min(first + _BATCH, photons)
            landed = photon_batch(
                seen, held, cdf, rules, in_air, scratch(TreeScratch), scratch(PhotonScratch), first, last, photons,
                by_address(landings),
            )  # fmt: skip
            if landed <= room:
                columns: Any = (column[:landed] for column in landings)
                return Landings(*columns)
            room = landed

    all_landings = work.run(follow, range(0, photons, _BATCH))
    columns: Any = (np.concatenate(column) for column in zip(*all_landings, strict=True))
    landings = Landings(*columns)
    return _written(landings, wanted) if len(landings.part) else no_caustics()


def _written(landings: Landings, wanted: Wanted) -> Caustics:
    """Landings in a table that is large enough."""
    texel, finest, landed = wanted.texel, wanted.finest, by_address(landings)
    count = len(landings.part)
    slots = 1 << max(10, math.ceil(math.log2(count)))
    levels, limits, level, left = np.zeros(count, np.int32), finest[landings.part], 0, count
    enough = _WANTED * math.sqrt(wanted.photons / _OF)
    while left > 0:
        tally = by_address(new_tally(slots))
        if not count_photons(tally, landed, texel[level], levels, level):
            slots *= 2
            continue
        left = raise_levels(tally, landed, texel[level], limits, enough, levels, level)
        level += 1
    while True:
        table = new_caustics(slots, texel)
        if add_photons(by_address(table), landed, levels):
            return table
        slots *= 2
