"""A fingerprint of what a probe sees, which tells whether its baked picture is still true."""

from __future__ import annotations

import hashlib
import struct
import weakref
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import (
    Balls,
    Environment,
    Instances,
    Light,
    Material,
    Mesh,
    Notice,
    Param,
    Probe,
    Scene,
    Source,
    Sphere,
    Texture,
    prim_of,
)
from ..version import __version__
from ..world.instances import within

_UNSEEN = (Param.THICKNESS, Param.TRANSMITTANCE)  # of what is behind a surface; an opaque one does not ask

# Records are frozen, so what was hashed once stays true: id -> (the record, its digest).
_known: dict[int, tuple[weakref.ref[Any], bytes]] = {}


def probe_digest(scene: Scene, probe: Probe) -> str:
    """SHA-256, in hex, of everything that decides what a probe's picture shows.

    That is: the opaque surfaces it captures (static ones alone unless it is realtime; of them those in `captured`),
    with their geometry, materials, primvars and texture pixels; all lights and the environment; and the probe's own
    capture point, clipping range, resolution and background. Two scenes that differ in nothing else have the same
    digest, whatever prims, files and materials are called and in which order they come.

    Not in it: refractive things, which no probe sees; moving things, for a baked probe; where the probe serves; the
    picture it has. Nor how well the picture was drawn (samples) and by which version.

    In a stage without any light, one shines from the camera (`Scene.camera_light`). That it does is in the digest;
    where the camera stands is not: the picture keeps the light where it was when it was taken.

    Args:
        scene: at the time that the picture is of, with the default purposes.
        probe: of that scene.
    """
    wanted = None if probe.captured is None else frozenset(probe.captured)
    seen: list[bytes] = []
    things: tuple[Mesh | Sphere, ...] = (*scene.meshes, *scene.spheres)
    emits = [material.emits for material in scene.materials]
    for thing in things:
        if (thing.static or probe.mode == "realtime") and (wanted is None or prim_of(thing.path) in wanted):
            seen.append(_of_thing(scene, thing))
    for many in scene.instances:
        if many.mesh.static or probe.mode == "realtime":
            seen.append(_instances(scene, many if wanted is None else within(many, wanted)))
    for balls in scene.balls:
        if balls.static or probe.mode == "realtime":
            seen.append(_balls(scene, balls if wanted is None else within(balls, wanted)))
    total = hashlib.sha256()
    _feed(total, "capture", probe.capture_point, probe.clipping, probe.resolution)
    _feed(total, "background", () if probe.background is None else probe.background)
    _feed(total, "camera light", int(scene.camera_light))
    _feed_all(total, "seen", (one for one in seen if one))
    # What glows lights what the probe sees, though it may not see it.
    shining = [_of_thing(scene, thing) for thing in things if any(emits[m] for m in _used(thing))]
    shining += [_instances(scene, many) for many in scene.instances if any(emits[m] for m in _used(many.mesh))]
    shining += [_balls(scene, balls) for balls in scene.balls if emits[balls.material]]
    if any(shining):
        _feed_all(total, "glow", (one for one in shining if one))
    _feed_all(total, "lights", (_remembered(light, _light) for light in scene.lights))
    if scene.environment is not None:
        total.update(_remembered(scene.environment, _environment))
    return total.hexdigest()


def _used(thing: Mesh | Sphere) -> list[int]:
    """Rows of its materials."""
    return [int(m) for m in np.unique(thing.materials)] if isinstance(thing, Mesh) else [thing.material]


def _of_thing(scene: Scene, thing: Mesh | Sphere) -> bytes:
    return _mesh(scene, thing) if isinstance(thing, Mesh) else _sphere(scene, thing)


def stale_bake(scene: Scene, probe: Probe) -> Notice | None:
    """Say so where a probe's baked texture does not show what the probe sees now.

    Args:
        scene: the stage at `probe.bake.time_code`, read with the default purposes.
        probe: of that scene.
    """
    if probe.bake is None:
        return None
    if probe.bake.engine != __version__:
        why = f"refract {probe.bake.engine} baked it, this is {__version__}"
    elif probe_digest(scene, probe) != probe.bake.digest:
        why = "what it shows has changed since it was baked"
    else:
        return None
    return Notice(probe.path, f"probe:texture is stale: {why}. Run refract bake probes STAGE OUT again")


def stale_bakes(probes: Iterable[Probe], scene_at: Callable[[float], Scene]) -> list[Notice]:
    """`stale_bake` of every probe that has a bake.

    Args:
        scene_at: the stage at a time code, read with the default purposes; asked once per time code.
    """
    notices: list[Notice | None] = []
    scenes: dict[float, Scene] = {}
    for probe in probes:
        if probe.bake is None:
            continue
        when = probe.bake.time_code
        if when not in scenes:
            scenes[when] = scene_at(when)
        then = next((other for other in scenes[when].probes if other.path == probe.path), probe)
        notices.append(stale_bake(scenes[when], replace(then, bake=probe.bake)))
    return [notice for notice in notices if notice is not None]


# --- things


def _mesh(scene: Scene, mesh: Mesh) -> bytes:
    """Digest of a mesh's opaque triangles; empty where it has none."""
    used = [int(m) for m in np.unique(mesh.materials)]
    opaque = [m for m in used if not scene.materials[m].refractive]
    if not opaque:
        return b""
    digests = {m: _material(scene, m) for m in opaque}
    names = {name for m in opaque for name in _primvars_of(scene.materials[m])}
    ranks = {m: rank for rank, m in enumerate(sorted(opaque, key=lambda m: digests[m]))}
    total = hashlib.sha256()
    total.update(_remembered(mesh, _geometry) if len(opaque) == len(used) else _part(mesh, opaque))
    keep = np.isin(mesh.materials, opaque)
    rank_of = np.zeros(used[-1] + 1, np.int32)
    for m, rank in ranks.items():
        rank_of[m] = rank
    _feed(total, "materials", *sorted(digests.values()))
    if len(opaque) > 1:
        _feed(total, "which", rank_of[mesh.materials[keep]])
    for name in sorted(names & mesh.primvars.keys()):
        values = mesh.primvars[name]
        _feed(total, name, values if values.shape[1] == 1 or keep.all() else values[keep])
    return total.digest()


def _geometry(mesh: Mesh) -> bytes:
    total = hashlib.sha256()
    _feed(total, "mesh", mesh.points, mesh.triangles, int(mesh.double_sided))
    if mesh.normals is not None:
        _feed(total, "normals", mesh.normals)
    return total.digest()


def _part(mesh: Mesh, materials: list[int]) -> bytes:
    """Digest of the triangles that have some of the materials; the others and their points leave no trace."""
    keep = np.isin(mesh.materials, materials)
    total = hashlib.sha256()
    _feed(total, "part", mesh.points[mesh.triangles[keep]], int(mesh.double_sided))
    if mesh.normals is not None:
        _feed(total, "normals", mesh.normals[keep])
    return total.digest()


def _sphere(scene: Scene, ball: Sphere) -> bytes:
    material = scene.materials[ball.material]
    if material.refractive:
        return b""
    total = hashlib.sha256()
    _feed(total, "sphere", ball.centre, ball.radius, _material(scene, ball.material))
    for name in sorted(set(_primvars_of(material)) & ball.primvars.keys()):
        _feed(total, name, ball.primvars[name])
    return total.digest()


def _instances(scene: Scene, many: Instances) -> bytes:
    """Digest of a mesh in many places, in whatever order; empty where it has nothing opaque, or no place."""
    mesh = _mesh(scene, many.mesh) if len(many) else b""
    if not mesh:
        return b""
    materials = [scene.materials[m] for m in _used(many.mesh)]
    read = {name for material in materials if not material.refractive for name in _primvars_of(material)}
    names = sorted(read & many.primvars.keys())
    columns = [many.transforms.reshape(len(many), -1), *(many.primvars[name] for name in names)]
    total = hashlib.sha256()
    _feed(total, "instances", mesh, *names, _sorted_rows(columns))
    return total.digest()


def _balls(scene: Scene, balls: Balls) -> bytes:
    """Digest of many spheres, in whatever order; empty where they are glass, or none."""
    material = scene.materials[balls.material]
    if material.refractive or not len(balls):
        return b""
    names = sorted(set(_primvars_of(material)) & balls.primvars.keys())
    every = [balls.primvars[name].reshape(-1, balls.primvars[name].shape[-1]) for name in names]
    values = [np.broadcast_to(value, (len(balls), value.shape[1])) for value in every]
    total = hashlib.sha256()
    rows = _sorted_rows([balls.centres, balls.radii[:, None], *values])
    _feed(total, "balls", _material(scene, balls.material), *names, rows)
    return total.digest()


def _sorted_rows(columns: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Columns of many places side by side, in an order that does not depend on how the places came."""
    rows = np.ascontiguousarray(np.concatenate(columns, axis=1), np.float32)
    return rows[np.lexsort(rows.view(np.uint32).T)]


# --- materials and light


def _seen_inputs(material: Material) -> list[tuple[Param, Source]]:
    return [(param, source) for param, source in zip(Param, material.inputs, strict=True) if param not in _UNSEEN]


def _primvars_of(material: Material) -> Iterable[str]:
    for _, source in _seen_inputs(material):
        yield from (name for name in (source.primvar, source.uv_primvar) if name)


def _material(scene: Scene, index: int) -> bytes:
    """Digest of an opaque material and of the textures it shows."""
    material = scene.materials[index]
    total = hashlib.sha256()
    total.update(_remembered(material, _constants))
    for _, source in _seen_inputs(material):
        if source.texture >= 0:
            _feed(total, _remembered(scene.textures[source.texture], _texture))
    return total.digest()


def _constants(material: Material) -> bytes:
    total = hashlib.sha256()
    flags = int(material.specular_workflow), int(material.opacity_presence)
    _feed(total, "material", *flags, material.opacity_threshold)
    for param, source in _seen_inputs(material):
        _feed(total, param.name, *_source(source))
    return total.digest()


def _source(source: Source) -> tuple[Any, ...]:
    given: list[Any] = [source.value, source.primvar]
    if source.texture >= 0:
        given += [int(source.channel), *(int(way) for way in source.wrap), source.scale, source.bias]
        given += [source.uv_primvar, source.uv_value, source.uv_matrix]
    return tuple(given)


def _texture(texture: Texture) -> bytes:
    total = hashlib.sha256()
    _feed(total, "texture", texture.pixels, int(texture.srgb))
    return total.digest()


def _light(light: Light) -> bytes:
    total = hashlib.sha256()
    _feed(total, "light", int(light.kind), light.radiance, light.world_from_light, light.size)
    _feed(total, light.diffuse, light.specular)
    shaping, shadow = light.shaping, light.shadow
    _feed(total, shaping.focus, shaping.focus_tint, shaping.cone, shaping.softness)
    _feed(total, *(value for value in (shaping.profile, shaping.picture) if value is not None))
    _feed(total, int(light.casts_shadow), shadow.color, shadow.distance, shadow.falloff, shadow.gamma)
    for paths in (light.lit, light.casters):
        _feed(total, "linked" if paths is not None else "", *sorted(paths or ()))
    return total.digest()


def _environment(environment: Environment) -> bytes:
    total = hashlib.sha256()
    _feed(total, "environment", environment.pixels, environment.dome_from_world)
    return total.digest()


# --- bytes


def _remembered(record: Any, digest: Callable[[Any], bytes]) -> bytes:
    """`digest(record)`, worked out once for as long as the record lives."""
    key = id(record)
    found = _known.get(key)
    if found is not None and found[0]() is record:
        return found[1]
    value = digest(record)
    _known[key] = (weakref.ref(record, lambda _gone: _known.pop(key, None)), value)
    return value


def _feed_all(total: Any, label: str, digests: Iterable[bytes]) -> None:
    """Digests in an order that does not depend on how they came."""
    _feed(total, label, *sorted(digests))


def _feed(total: Any, *values: Any) -> None:
    """Values, each with its kind and size, so that no two sequences feed the same bytes."""
    for value in values:
        kind, data = _bytes_of(value)
        total.update(kind)
        total.update(struct.pack("<q", len(data)))
        total.update(data)


def _bytes_of(value: Any) -> tuple[bytes, Any]:
    if isinstance(value, bytes):
        return b"b", value
    if isinstance(value, str):
        return b"s", value.encode()
    if isinstance(value, int):
        return b"i", struct.pack("<q", value)
    if isinstance(value, float):
        return b"f", struct.pack("<d", value + 0.0)
    array: NDArray[Any] = np.ascontiguousarray(value if isinstance(value, np.ndarray) else np.array(value, np.float64))
    return f"a{array.dtype.str}{array.shape}".encode(), array.reshape(-1).view(np.uint8).data
