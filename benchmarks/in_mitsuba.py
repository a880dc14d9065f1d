"""A room of `two_rooms` as a scene of Mitsuba 3, and its pictures by path tracing.

The rooms are drawn by short integrators of Mitsuba's parts, written here, that follow light from the eye through glass
to the first surface that is not. In the emissive room that is all. In the lit one the surface is lit directly: by one
sample of the lamp or the sky and one of the surface, weighted (Veach's power heuristic), so that matt surfaces do not
light each other, which would hide everything else that differs between two renderers. `Light` says what glass does to
light on its way to that surface. Mitsuba's own `path` finds the same in the emissive room (`tests/test_peers.py`), but
does more work for it: these integrators look for nothing that is not there. A scalar variant has `path` alone.

Nothing here is imported before `library` is called: Mitsuba is an extra.
"""

from __future__ import annotations

import importlib
import random
import subprocess
import sys
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from refract_core.errors import UsageError
from refract_core.scene import F32

from .in_refract import looking
from .two_rooms import IOR, Colour, Eye, Finish, Globe, Glow, Lamp, Room, Solid, Sun

DEPTH = 64
"""Interfaces that a path may meet."""
_FAR = 1e4
"""Of a sun [m]"""
_THROWN = 1 << 21
"""Rays that each lamp throws at glass, for every call"""
_SQUARES = 400
"""Of a metre, that keep what is thrown"""


class Light(StrEnum):
    """What glass does to light from the lamp and the sky. In a room without a lamp all are the same."""

    STRAIGHT = "straight"
    """Nothing: glass casts no shadow and no caustic, and the lamp is seen only as the highlight on the outside of
    glass. It tells, beside the next, what caustics touch."""
    WORLD = "world"
    """All it does: shadows, caustics, the lamp through glass. Only matt surfaces still do not light each other. Not in
    rooms with `others`."""
    PATH = "path"
    """The same, and matt surfaces light each other: Mitsuba's own `path`, as anybody would use it."""
    ONCE = "once"
    """As WORLD, but lamps are what they are to refract: they hide nothing, and are seen in mirror pictures alone."""
    THROWN = "thrown"
    """The same with little noise, in rooms with `others`: lamps throw their light through glass onto what is flat."""


class Loaded(NamedTuple):
    """A room in Mitsuba, ready to be drawn."""

    mi: Any
    scene: Any
    integrators: dict[Light, Any]
    silhouette: Any
    """the same scene, in which glass is white and all else black"""


def library(variant: str = "llvm_ad_rgb", jobs: int = 0) -> Any:
    """Mitsuba in one of its variants, on `jobs` threads (0: all cores).

    Raises:
        UsageError: it is not installed, or the variant does not work here.
    """
    try:
        mi = importlib.import_module("mitsuba")
    except ImportError as error:
        raise UsageError("this benchmark needs the package 'mitsuba'; pip install 'usd-refract[bench]'") from error
    if variant not in mi.variants():
        raise UsageError(f"Mitsuba has no variant '{variant}'; choose from {', '.join(mi.variants())}")
    if variant.startswith("llvm"):
        _try_llvm(variant)
    mi.set_variant(variant)
    if jobs:
        importlib.import_module("drjit").set_thread_count(jobs)
    return mi


def _try_llvm(variant: str) -> None:
    """Compile one line in a process of its own: an LLVM that is too old for it ends the process.

    Raises:
        UsageError: it did.
    """
    # A number that no kernel was ever made for, lest one be found on disk.
    line = f"drjit.eval(drjit.maximum(drjit.arange(mitsuba.Float, 3), {random.random()}))"
    code = f"import mitsuba, drjit; mitsuba.set_variant('{variant}'); {line}"
    if subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode != 0:
        hint = "set DRJIT_LIBLLVM_PATH to the libLLVM.so of a newer one (19 does)"
        raise UsageError(f"Mitsuba's variant '{variant}' finds no LLVM here that can compile its code; {hint}")


def load(mi: Any, room: Room, width: int) -> Loaded:
    """Hand a room to Mitsuba. `width`: of its pictures [pixels]; 16:9.

    Raises:
        UsageError: the room has a lamp, and the variant is a scalar one, for which integrators are C++ alone.
    """
    if room.lamp is not None and _is_scalar(mi):
        raise UsageError(f"the {room.name} room needs an llvm variant of Mitsuba, not {mi.variant()}")
    scene, silhouette = (mi.load_dict(_scene(mi, of, of.solids, width)) for of in (room, _silhouette(room)))
    if room.lamp is None:
        return Loaded(mi, scene, dict.fromkeys(Light, _shining(mi)), silhouette)
    without = tuple(solid for solid in room.solids if not solid.finish.glass)
    if room.others:
        integrators = {
            Light.STRAIGHT: _by_lamps(mi, room, without), Light.ONCE: _by_lamps(mi, room, room.solids),
            Light.THROWN: _by_lamps(mi, room, room.solids, thrown=_THROWN),
        }  # fmt: skip
    else:
        opaque = mi.load_dict(_scene(mi, room, without, width))
        integrators = {light: _once_lit(mi, light) for light in (Light.WORLD, Light.ONCE)}
        integrators[Light.STRAIGHT] = _once_lit(mi, Light.STRAIGHT, opaque)
    integrators[Light.PATH] = path(mi)
    return Loaded(mi, scene, integrators, silhouette)


def draw(loaded: Loaded, light: Light, samples: int, seed: int) -> F32:
    """A picture, shape (H, W, 3), linear. `samples`: a square, for the sampler is stratified."""
    image = loaded.mi.render(loaded.scene, integrator=loaded.integrators[light], spp=samples, seed=seed)
    return np.array(image, np.float32)


def glass_share(loaded: Loaded, samples: int) -> F32:
    """Share of every pixel in which glass is met first, shape (H, W)."""
    mi = loaded.mi
    image = mi.render(loaded.silhouette, integrator=_shining(mi), spp=samples, seed=1)
    return np.array(image, np.float32)[..., 0]


def _silhouette(room: Room) -> Room:
    white, black = Finish(radiance=(1.0, 1.0, 1.0)), Finish(albedo=(0.0, 0.0, 0.0))
    solids = tuple(solid._replace(finish=white if solid.finish.glass else black) for solid in room.solids)
    return room._replace(solids=solids, lamp=None, sky=(0.0, 0.0, 0.0))


def _is_scalar(mi: Any) -> bool:
    return bool(mi.variant().startswith("scalar"))


# ------------------------------------------------------------------------------------------------ the scene


def _scene(mi: Any, room: Room, solids: tuple[Solid, ...], width: int) -> dict[str, Any]:
    scene: dict[str, Any] = {"type": "scene", "sensor": _sensor(mi, room.eye, width)}
    scene |= {solid.name: _mesh(mi, solid, room) for solid in solids}
    if any(room.sky):
        scene["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": list(room.sky)}}
    return scene | _lamps(mi, room)


def _lamps(mi: Any, room: Room) -> dict[str, Any]:
    """All that has a place, or is a sun."""
    found = {} if room.lamp is None else {"lamp": _lamp(mi, room.lamp)}
    return found | {f"light{k}": _other(mi, light) for k, light in enumerate(room.others)}


def _sensor(mi: Any, eye: Eye, width: int) -> dict[str, Any]:
    """The box filter makes a pixel the mean over its own square, as ours is."""
    return {
        "type": "perspective",
        "fov": float(2.0 * np.degrees(np.arctan(eye.half_height))),
        "fov_axis": "y",
        "to_world": mi.ScalarTransform4f().look_at(origin=list(eye.place), target=list(eye.target), up=[0, 1, 0]),
        "film": {
            "type": "hdrfilm", "width": width, "height": width * 9 // 16, "pixel_format": "rgb",
            "component_format": "float32", "sample_border": False, "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter", "sample_count": 1},
    }  # fmt: skip


def _mesh(mi: Any, solid: Solid, room: Room) -> Any:
    found = mi.Properties()
    found["bsdf"] = mi.load_dict(_bsdf(mi, solid.finish, room))
    if solid.finish.radiance is not None:
        found["emitter"] = mi.load_dict({"type": "area", "radiance": _glow(mi, solid.finish.radiance, room)})
    mesh = mi.Mesh(
        solid.name, len(solid.points), len(solid.triangles), has_vertex_normals=solid.normals is not None,
        has_vertex_texcoords=solid.st is not None, props=found,
    )  # fmt: skip
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = solid.points.ravel()
    parameters["faces"] = solid.triangles.ravel()
    if solid.normals is not None:
        parameters["vertex_normals"] = solid.normals.ravel()
    if solid.st is not None:
        parameters["vertex_texcoords"] = solid.st.ravel()
    parameters.update()
    return mesh


def _bsdf(mi: Any, finish: Finish, room: Room) -> dict[str, Any]:
    if finish.glass:
        return {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0}
    if finish.radiance is not None:
        return {"type": "conductor", "material": "none", "specular_reflectance": _colour((0.0, 0.0, 0.0))}
    assert finish.albedo is not None
    return {"type": "twosided", "matt": {"type": "diffuse", "reflectance": _glow(mi, finish.albedo, room)}}


def _glow(mi: Any, glow: Glow, room: Room) -> dict[str, Any]:
    if not isinstance(glow, str):
        return _colour(glow)
    # A bitmap's first row lies at v = 0 here.
    bitmap = mi.Bitmap(np.ascontiguousarray(room.images[glow][::-1]))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def _colour(rgb: Colour) -> dict[str, Any]:
    return {"type": "rgb", "value": list(rgb)}


def _lamp(mi: Any, lamp: Lamp) -> dict[str, Any]:
    """Mitsuba's rectangle reaches from -1 to 1 and shines along +Z, ours along -Z: the second axis is turned too."""
    m = lamp.world_from_lamp.copy()
    m[:3, 0] *= lamp.size[0] / 2.0
    m[:3, 1] *= -lamp.size[1] / 2.0
    m[:3, 2] *= -1.0
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(m), **_shines(lamp.radiance)}


def _shines(radiance: Colour) -> dict[str, Any]:
    black = {"type": "diffuse", "reflectance": _colour((0.0, 0.0, 0.0))}
    return {"bsdf": black, "emitter": {"type": "area", "radiance": _colour(radiance)}}


def _other(mi: Any, light: Globe | Sun) -> dict[str, Any]:
    """A sun is a disk as far away as float32 allows."""
    if isinstance(light, Globe):
        return {"type": "sphere", "center": list(light.centre), "radius": light.radius, **_shines(light.radiance)}
    towards = np.array(light.towards) / np.linalg.norm(light.towards)
    m = _FAR * looking(Eye(tuple(towards), (0.0, 0.0, 0.0), 1.0))
    m[:3, :3] *= float(np.tan(np.radians(light.angle / 2.0)))
    m[:3, 1:3] *= -1.0
    m[3, 3] = 1.0
    return {"type": "disk", "to_world": mi.ScalarTransform4f(m), **_shines(light.radiance)}


# ------------------------------------------------------------------------------------------------ integrators


def _shining(mi: Any) -> Any:
    """An integrator for what shines by itself. In scalar variants Python's own would be far too slow."""
    return path(mi) if _is_scalar(mi) else _through_glass(mi)


def path(mi: Any) -> Any:
    """Mitsuba's own integrator, without Russian roulette."""
    return mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": 2 * DEPTH})


def _follow(mi: Any, scene: Any, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any, Any, Any]:
    """Through glass, one branch at every interface, to what is not glass.

    Returns what is met, the weight, whether glass was met, and whether lamps show: 2 if the last of it was its outside,
    mirroring; 1 if it has mirrored on its inside since then; else 0.
    """
    dr = importlib.import_module("drjit")

    def goes_on(hit: Any, live: Any) -> Any:
        found = live & hit.is_valid()
        return found & mi.has_flag(hit.shape.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)

    def step(hit: Any, ray: Any, weight: Any, met: Any, shown: Any, depth: Any, live: Any, sampler: Any) -> Any:
        si = hit.compute_surface_interaction(ray, active=live)
        sample, factor = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(live), sampler.next_2d(live), live)
        shown = _shown_after(mi, sample, si, shown)
        ray = si.spawn_ray(si.to_world(sample.wo))
        hit = scene.ray_intersect_preliminary(ray, active=live)
        depth = depth + 1
        weight = dr.select(depth < DEPTH, weight * factor, 0.0)
        live = live & (depth < DEPTH) & goes_on(hit, live)
        return hit, ray, weight, mi.Bool(True), shown, depth, live, sampler

    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    state = (
        hit, mi.Ray3f(ray), mi.Spectrum(1.0), mi.Bool(False), mi.UInt32(0), mi.UInt32(0), goes_on(hit, active),
        sampler,
    )  # fmt: skip
    hit, ray, weight, met, shown, *_ = dr.while_loop(state, lambda *s: s[6], step)
    return hit.compute_surface_interaction(ray, active=active), weight, met, shown


def _shown_after(mi: Any, sample: Any, si: Any, shown: Any) -> Any:
    """How lamps show behind an interface, as `_follow` returns it."""
    dr = importlib.import_module("drjit")
    mirrored = mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection)
    inside = mi.Frame3f.cos_theta(si.wi) < 0.0
    return dr.select(mirrored, dr.select(inside, mi.UInt32(1), 2), dr.select(shown == 1, mi.UInt32(1), 0))


def _through_glass(mi: Any) -> Any:
    """What shines behind any glass."""

    class ThroughGlass(mi.SamplingIntegrator):  # type: ignore[misc]
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            si, weight, _, _ = _follow(mi, scene, sampler, ray, active)
            return weight * si.emitter(scene, active).eval(si, active), active & si.is_valid(), []

    return ThroughGlass(mi.Properties())


def _once_lit(mi: Any, light: Light, opaque: Any | None = None) -> Any:
    """An integrator that lights the first matt surface behind any glass.

    Args:
        light: STRAIGHT, WORLD or ONCE.
        opaque: the scene without glass, in which light is looked for (`Light.STRAIGHT`); None: the scene itself.
    """
    least = {Light.STRAIGHT: 2, Light.WORLD: 0, Light.ONCE: 1}[light]
    dr = importlib.import_module("drjit")

    def power(a: Any, b: Any) -> Any:
        return dr.select(a > 0.0, a * a / (a * a + b * b), 0.0)

    class OnceLit(mi.SamplingIntegrator):  # type: ignore[misc]
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            si, weight, _, shown = _follow(mi, scene, sampler, ray, active)
            light = self.seen(scene, si, shown, active)
            surface = active & si.is_valid()
            light += self.by_lamp(scene, sampler, si, surface) + self.by_chance(scene, sampler, si, surface)
            return weight * light, active & si.is_valid(), []

        def seen(self, scene: Any, si: Any, shown: Any, active: Any) -> Any:
            """What shines by itself: the sky; the lamp where it counts."""
            return si.emitter(scene, active).eval(si, active & (~si.is_valid() | (shown >= least)))

        def by_lamp(self, scene: Any, sampler: Any, si: Any, active: Any) -> Any:
            """A sample of the lamp or the sky."""
            where = scene if opaque is None else opaque
            to, light = where.sample_emitter_direction(si, sampler.next_2d(active), False, active)
            active = active & (to.pdf > 0.0) & ~where.ray_test(si.spawn_ray_to(to.p), active=active)
            value, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(to.d), active)
            return dr.select(active, value * light * power(to.pdf, pdf), 0.0)

        def by_chance(self, scene: Any, sampler: Any, si: Any, active: Any) -> Any:
            """A sample of the matt surface; behind glass it alone can find the light."""
            sample, value = si.bsdf().sample(
                mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active
            )
            ray = si.spawn_ray(si.to_world(sample.wo))
            active = active & (sample.pdf > 0.0)
            where = scene if opaque is None else opaque
            end, weight, met, _ = _follow(mi, where, sampler, ray, active)
            emitter = end.emitter(where, active)
            to = mi.DirectionSample3f(where, end, si)
            some = emitter != None  # noqa: E711 - an array of pointers
            pdf = where.pdf_emitter_direction(si, to, active & ~met & some)
            share = dr.select(met, 1.0, power(sample.pdf, pdf))
            return dr.select(active, value * weight * emitter.eval(end, active) * share, 0.0)

    return OnceLit(mi.Properties())


def _by_lamps(mi: Any, room: Room, solids: tuple[Solid, ...], thrown: int = 0) -> Any:
    """An integrator for `Light.ONCE`: camera, glass, one matt surface, glass, lamp. Of the opaque solids alone it is
    `Light.STRAIGHT`.

    A matt surface asks a point of each lamp straight on, and sends one ray to glass, evenly over the cones of the balls
    around its bodies. Lamps are no part of the scene that rays meet, so they hide nothing.

    Args:
        solids: what light meets on its way; eyes look at all of the room.
        thrown: rays that each lamp throws at glass beforehand, in place of those that flat surfaces send
            (`Light.THROWN`).
    """
    dr = importlib.import_module("drjit")
    context = mi.BSDFContext()
    parts = {solid.name: _mesh(mi, solid, room) for solid in room.solids}
    things = mi.load_dict({"type": "scene", **parts})
    stops = mi.load_dict({"type": "scene", **{solid.name: parts[solid.name] for solid in solids}})
    lights = [light for light in (room.lamp, *room.others) if light is not None]
    lamps = [mi.load_dict({"type": "scene", "lamp": lamp}) for lamp in _lamps(mi, room).values()]
    shining = [_meets(mi, light) for light in lights]
    tints = [(mi.ShapePtr(parts[s.name]), np.log(s.finish.tint)) for s in room.solids if min(s.finish.tint) < 1.0]
    balls = [_ball_around(solid) for solid in solids if solid.finish.glass]
    flat = [(mi.ShapePtr(parts[s.name]), s.st.max(0).astype(int)) for s in room.solids if s.st is not None and thrown]

    def is_glass(si: Any, active: Any) -> Any:
        return active & si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)

    def let_through(si: Any, glass: Any) -> Any:
        """By the glass that a ray has gone through to its surface, by Beer and Lambert."""
        found, inside = mi.Spectrum(1.0), glass & (mi.Frame3f.cos_theta(si.wi) < 0.0)
        for shape, logarithm in tints:
            left = dr.exp(mi.Spectrum(*(100.0 * logarithm).tolist()) * si.t)
            found = dr.select(inside & (si.shape == shape), left, found)
        return found

    def of_lamps(ray: Any, before: Any, active: Any) -> Any:
        """Radiance of the lamps along a ray before a distance."""
        light = mi.Spectrum(0.0)
        for meets, radiance in shining:
            light += dr.select(active & meets(ray, before), mi.Spectrum(*radiance), 0.0)
        return light

    def follow(sampler: Any, si: Any, known: bool, active: Any) -> tuple[Any, Any, Any]:
        """One branch at every interface from the first hit on, to what is not glass; that, the weight, and the light of
        lamps on the way. Not `known`: lamps are seen once mirrored in glass, and in mirror pictures on its outside."""

        def step(si: Any, weight: Any, light: Any, shown: Any, depth: Any, live: Any, sampler: Any) -> Any:
            sample, factor = si.bsdf().sample(context, si, sampler.next_1d(live), sampler.next_2d(live), live)
            shown = shown if known else _shown_after(mi, sample, si, shown)
            ray = si.spawn_ray(si.to_world(sample.wo))
            weight = weight * factor
            si = things.ray_intersect(ray, live)
            light += weight * of_lamps(ray, si.t, live & (shown > 0))
            live = is_glass(si, live) & (depth < DEPTH)
            weight *= let_through(si, live)
            return si, weight, light, shown, depth + 1, live, sampler

        state = (si, mi.Spectrum(1.0), mi.Spectrum(0.0), mi.UInt32(1 if known else 0), mi.UInt32(0), active, sampler)
        si, weight, light, *_ = dr.while_loop(state, lambda *s: s[5], step)
        return si, weight, light

    def to_balls(sampler: Any, p: Any, active: Any) -> tuple[Any, Any]:
        """A direction evenly over the cones of all balls of glass, and the solid angle that it stands for."""
        cones, whole = [], mi.Float(0.0)
        for centre, radius in balls:
            axis = mi.Point3f(*centre) - p
            square = dr.squared_norm(axis)
            cosine = dr.select(square > radius**2, dr.sqrt(dr.maximum(0.0, 1.0 - radius**2 / square)), -1.0)
            cones.append((dr.normalize(axis), cosine))
            whole += 1.0 - cosine
        chosen, at = sampler.next_1d(active) * whole, sampler.next_2d(active)
        direction, begin, number = mi.Vector3f(0.0, 1.0, 0.0), mi.Float(0.0), mi.Float(0.0)
        for axis, cosine in cones:
            within = mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(at, cosine))
            direction = dr.select(chosen >= begin, within, direction)
            begin += 1.0 - cosine
        for axis, cosine in cones:
            number += dr.select(dr.dot(axis, direction) >= cosine, 1.0, 0.0)
        return direction, dr.two_pi * whole / dr.maximum(number, 1.0)

    def square_of(si: Any, metres: Any) -> Any:
        """Number of the square of a flat surface that a place lies in."""
        wide, high = (_SQUARES * int(one) for one in metres)
        i, j = (mi.UInt32(dr.clip(si.uv[k] * _SQUARES, 0, most - 1)) for k, most in enumerate((wide, high)))
        return i + wide * j

    class ByLamps(mi.SamplingIntegrator):  # type: ignore[misc]
        def render(self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, *rest: Any, **more: Any) -> Any:
            if thrown:
                self.kept = self.throw(int(dr.slice(seed)) if not isinstance(seed, int) else seed)
            return super().render(scene, sensor, seed, spp, *rest, **more)

        def throw(self, seed: int) -> list[Any]:
            """Irradiance by way of glass, for each flat surface."""
            kept = [dr.zeros(mi.Float, 3 * _SQUARES**2 * int(np.prod(metres))) for _, metres in flat]
            for k, light in enumerate(lights):
                sampler = mi.load_dict({"type": "independent"})
                sampler.seed(len(lights) * seed + k, thrown)
                ray, flux = _leaves(mi, light, balls, sampler, to_balls)
                first = things.ray_intersect(ray, mi.Bool(True))
                meets = is_glass(first, mi.Bool(True))
                si, weight, _ = follow(sampler, first, True, meets)
                weight *= flux * _SQUARES**2 / thrown
                for sums, (shape, metres) in zip(kept, flat, strict=True):
                    lands = meets & si.is_valid() & (si.shape == shape) & (mi.Frame3f.cos_theta(si.wi) > 0.0)
                    for c in range(3):
                        dr.scatter_add(sums, weight[c], 3 * square_of(si, metres) + c, lands)
                dr.eval(*kept)
            return kept

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            active = mi.Bool(active)
            si = things.ray_intersect(ray, active)
            si, weight, light = follow(sampler, si, False, is_glass(si, active))
            surface = active & si.is_valid() & ~is_glass(si, active)
            lit = self.straight_on(sampler, si, surface)
            waiting = mi.Bool(surface)
            for k, (shape, metres) in enumerate(flat):
                here = waiting & (si.shape == shape)
                found = [dr.gather(mi.Float, self.kept[k], 3 * square_of(si, metres) + c, here) for c in range(3)]
                lit += si.bsdf().eval(context, si, mi.Vector3f(0.0, 0.0, 1.0), here) * mi.Spectrum(*found)
                waiting &= ~here
            if balls:
                lit += self.through_glass(sampler, si, waiting)
            return light + dr.select(surface, weight * lit, 0.0), active, []

        def straight_on(self, sampler: Any, si: Any, active: Any) -> Any:
            """A point of each lamp."""
            found = mi.Spectrum(0.0)
            for lamp in lamps:
                to, light = lamp.sample_emitter_direction(si, sampler.next_2d(active), False, active)
                seen = active & (to.pdf > 0.0) & ~stops.ray_test(si.spawn_ray_to(to.p), active=active)
                found += dr.select(seen, si.bsdf().eval(context, si, si.to_local(to.d), seen) * light, 0.0)
            return found

        def through_glass(self, sampler: Any, si: Any, active: Any) -> Any:
            """One direction out of all that may meet glass."""
            direction, solid_angle = to_balls(sampler, si.p, active)
            first = things.ray_intersect(si.spawn_ray(direction), active)
            meets = is_glass(first, active)
            _, _, light = follow(sampler, first, True, meets)
            value = si.bsdf().eval(context, si, si.to_local(direction), meets)
            return dr.select(meets, value * light * solid_angle, 0.0)

    return ByLamps(mi.Properties())


def _ball_around(solid: Solid) -> tuple[list[float], float]:
    """Centre and radius of a ball that holds a solid."""
    low, high = solid.points.min(0), solid.points.max(0)
    centre = (low + high) / 2.0
    return centre.tolist(), float(1.001 * np.linalg.norm(solid.points - centre, axis=1).max())


def _meets(mi: Any, light: Lamp | Globe | Sun) -> tuple[Any, Colour]:
    """(ray, distance) -> whether the ray meets the light's bright side before that; and its radiance. In plain
    arithmetic, which is many times faster than a scene."""
    if isinstance(light, Lamp):
        return _meets_lamp(mi, light), light.radiance
    return _meets_globe(mi, light) if isinstance(light, Globe) else _meets_sun(mi, light), light.radiance


def _meets_lamp(mi: Any, light: Lamp) -> Any:
    dr = importlib.import_module("drjit")

    def meets(ray: Any, before: Any) -> Any:
        x, y, z, at = (mi.Vector3f(*light.world_from_lamp[:3, k].tolist()) for k in range(4))
        cosine = -dr.dot(ray.d, z)
        t = dr.dot(ray.o - at, z) / cosine
        p = ray.o + t * ray.d - at
        within = (abs(dr.dot(p, x)) < light.size[0] / 2.0) & (abs(dr.dot(p, y)) < light.size[1] / 2.0)
        return within & (cosine < 0.0) & (t > 0.0) & (t < before)

    return meets


def _meets_globe(mi: Any, light: Globe) -> Any:
    dr = importlib.import_module("drjit")

    def meets(ray: Any, before: Any) -> Any:
        to = mi.Point3f(*light.centre) - ray.o
        along = dr.dot(to, ray.d)
        inner = light.radius**2 - dr.squared_norm(to - along * ray.d)
        return (inner > 0.0) & (along > 0.0) & (along - dr.sqrt(dr.maximum(inner, 0.0)) < before)

    return meets


def _meets_sun(mi: Any, light: Sun) -> Any:
    dr = importlib.import_module("drjit")

    def meets(ray: Any, before: Any) -> Any:
        towards = dr.normalize(mi.Vector3f(*light.towards))
        return (dr.dot(ray.d, towards) > np.cos(np.radians(light.angle / 2.0))) & dr.isinf(before)

    return meets


def _leaves(mi: Any, light: Lamp | Globe | Sun, balls: Any, sampler: Any, to_balls: Any) -> tuple[Any, Any]:
    """A ray from a light to glass, and the flux that it stands for."""
    dr = importlib.import_module("drjit")
    at = sampler.next_2d()
    if isinstance(light, Sun):
        half = float(np.cos(np.radians(light.angle / 2.0)))
        frame = mi.Frame3f(dr.normalize(mi.Vector3f(*light.towards)))
        d = -frame.to_world(mi.warp.square_to_uniform_cone(at, half))
        whole = sum(radius**2 for _, radius in balls)
        chosen, place = sampler.next_1d() * whole, mi.warp.square_to_uniform_disk(sampler.next_2d())
        origin, begin, number = mi.Point3f(0.0), 0.0, mi.Float(0.0)
        for centre, radius in balls:
            middle = mi.Point3f(*centre) - 10.0 * d
            across = mi.Frame3f(d).to_world(mi.Vector3f(radius * place.x, radius * place.y, 0.0))
            origin = dr.select(chosen >= begin, middle + across, origin)
            begin += radius**2
        for centre, radius in balls:
            number += dr.select(dr.squared_norm(dr.cross(mi.Point3f(*centre) - origin, d)) < radius**2, 1.0, 0.0)
        flux = dr.two_pi * (1.0 - half) * dr.pi * whole / dr.maximum(number, 1.0)
        return mi.Ray3f(origin, d), mi.Spectrum(*light.radiance) * flux
    if isinstance(light, Globe):
        n = mi.warp.square_to_uniform_sphere(at)
        p, area = mi.Point3f(*light.centre) + light.radius * n, 4.0 * dr.pi * light.radius**2
    else:
        x, y, z, middle = (mi.Vector3f(*light.world_from_lamp[:3, k].tolist()) for k in range(4))
        p = mi.Point3f(middle + (at.x - 0.5) * light.size[0] * x + (at.y - 0.5) * light.size[1] * y)
        n, area = -z, light.size[0] * light.size[1]
    d, solid_angle = to_balls(sampler, p, mi.Bool(True))
    return mi.Ray3f(p, d), mi.Spectrum(*light.radiance) * (dr.maximum(0.0, dr.dot(d, n)) * area * solid_angle)
