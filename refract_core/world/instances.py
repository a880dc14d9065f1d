"""What stands in many places: its bounds, what of it is around a point, and single ones as meshes of their own.

Rays meet instances as they are (`tables`, `surface`). Whoever needs triangles in engine world asks here, and for as few
as will do: a million instances are as many triangles as no memory holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import accumulate
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..scene import F64, Balls, Instances, Mesh, Notice, Scene, Sphere, prim_of
from .solid import encloses

_SOME = 1 << 16
"""Places that are looked at together."""
_MOST_GLOWING = 1 << 21
"""Triangles that instances which glow have together, at most, to light the scene."""
_MOST_GLOWING_BALLS = 1 << 14
"""The same for exact spheres."""
_TRIANGLES_OF_A_BALL = 80


def linears(many: Instances, chosen: slice | NDArray[np.integer] = slice(None)) -> tuple[F64, F64]:
    """Linear parts (N, 3, 3) and origins (N, 3) [m] of some places."""
    some = many.transforms[chosen].astype(np.float64)
    return some[:, :, :3], some[:, :, 3]


def _steps(many: Instances) -> Iterator[slice]:
    return (slice(start, start + _SOME) for start in range(0, len(many), _SOME))


def bounds_of(many: Instances) -> tuple[F64, F64]:
    """Low and high corner [m] of a box that holds all of them; it may be larger than it need be."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    if not len(many.mesh.points) or not len(many):
        return np.zeros(3), np.zeros(3)
    ends = np.stack([many.mesh.points.min(axis=0), many.mesh.points.max(axis=0)]).astype(np.float64)
    middle, half = ends.mean(axis=0), (ends[1] - ends[0]) / 2
    for step in _steps(many):
        linear, origin = linears(many, step)
        at, reach = linear @ middle + origin, np.abs(linear) @ half
        low, high = np.minimum(low, (at - reach).min(axis=0)), np.maximum(high, (at + reach).max(axis=0))
    return low, high


def boxes(many: Instances, points: F64) -> tuple[F64, F64]:
    """Lowest and highest corner of each, shape (N, 3) [m]. `points`: shape (V, 3), the corners that count."""
    low, high = np.empty((len(many), 3)), np.empty((len(many), 3))
    step = max(1, (1 << 22) // max(1, 3 * len(points)))
    for start in range(0, len(many), step):
        linear, origin = linears(many, slice(start, start + step))
        at = linear @ points.T
        low[start : start + step] = at.min(axis=2) + origin
        high[start : start + step] = at.max(axis=2) + origin
    return low, high


def placed(many: Instances, k: int) -> Mesh:
    """One of them as a mesh in engine world."""
    mesh, (linear, origin) = many.mesh, (part[0] for part in linears(many, slice(k, k + 1)))
    order = [0, 2, 1] if np.linalg.det(linear) < 0.0 else [0, 1, 2]
    normals = mesh.normals
    if normals is not None:
        turned = normals.astype(np.float64) @ np.linalg.inv(linear)
        turned /= np.maximum(np.linalg.norm(turned, axis=2, keepdims=True), 1e-300)
        normals = np.ascontiguousarray(turned[:, order], np.float32)
    primvars = {name: v if v.shape[1] == 1 else np.ascontiguousarray(v[:, order]) for name, v in mesh.primvars.items()}
    primvars |= {name: values[k].reshape(1, 1, -1) for name, values in many.primvars.items()}
    return replace(
        mesh,
        path=many.paths[k],
        points=(mesh.points.astype(np.float64) @ linear.T + origin).astype(np.float32),
        triangles=np.ascontiguousarray(mesh.triangles[:, order]),
        normals=normals,
        primvars=primvars,
    )


def sphere(balls: Balls, k: int) -> Sphere:
    """One of many spheres by itself."""
    x, y, z = (float(c) for c in balls.centres[k])
    primvars = {name: v if v.ndim == 3 else v[k].reshape(1, 1, -1) for name, v in balls.primvars.items()}
    return Sphere(balls.paths[k], (x, y, z), float(balls.radii[k]), balls.material, primvars, balls.static)


def some_placed(many: Instances, most: int) -> Iterator[Mesh]:
    """As many as asked for, spread evenly over all of them."""
    return (placed(many, k) for k in _even(len(many), most))


def _even(count: int, most: int) -> list[int]:
    """At most so many numbers below `count`, evenly."""
    chosen: list[int] = np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.int64)).tolist()
    return chosen


def flat(scene: Scene, most: int) -> Scene:
    """The scene with instances as meshes and balls as spheres, at most so many of one mesh; of more, an even choice
    stands for all."""
    if not scene.instances and not scene.balls:
        return scene
    meshes = tuple(mesh for many in scene.instances for mesh in some_placed(many, most))
    spheres = tuple(sphere(balls, k) for balls in scene.balls for k in _even(len(balls), most))
    return replace(scene, meshes=scene.meshes + meshes, spheres=scene.spheres + spheres, instances=(), balls=())


def apart(scene: Scene, most: int) -> Scene:
    """The scene with instances as meshes and balls as spheres, as far as they have together no more triangles than so
    many, of which a sphere counts as some."""
    if not scene.instances and not scene.balls:
        return scene
    left = most

    def fits(many: Instances | Balls) -> bool:
        nonlocal left
        size = len(many) * (_TRIANGLES_OF_A_BALL if isinstance(many, Balls) else len(many.mesh.triangles))
        if size > left:
            return False
        left -= size
        return True

    return _loosened(scene, fits)


def _loosened(scene: Scene, chosen: Callable[[Instances | Balls], bool]) -> Scene:
    """The scene with some of its instances as meshes, and some of its balls as spheres. `chosen` is asked once of each,
    in order."""
    meshes, spheres = list(scene.meshes), list(scene.spheres)
    instances: list[Instances] = []
    balls: list[Balls] = []
    for many in scene.instances:
        if chosen(many):
            meshes.extend(placed(many, k) for k in range(len(many)))
        else:
            instances.append(many)
    for some in scene.balls:
        if chosen(some):
            spheres.extend(sphere(some, k) for k in range(len(some)))
        else:
            balls.append(some)
    left = replace(scene, instances=tuple(instances), balls=tuple(balls))
    return replace(left, meshes=tuple(meshes), spheres=tuple(spheres))


def around(many: Instances | Balls, point: Iterable[float]) -> list[int]:
    """Which of a closed mesh's places, or of many spheres, go round a point [m]."""
    at = np.array(tuple(point), np.float64)
    found: list[int] = []
    if isinstance(many, Balls):
        found = np.flatnonzero(np.linalg.norm(many.centres - at, axis=1) < many.radii).tolist()
        return found
    mesh = many.mesh
    if not len(mesh.points):
        return found
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    for step in _steps(many):
        linear, origin = linears(many, step)
        inside = np.linalg.solve(linear, (at - origin)[:, :, None])[:, :, 0]
        for k in np.flatnonzero(((inside > low) & (inside < high)).all(axis=1)):
            if encloses(mesh.points, mesh.triangles, inside[k]):
                found.append(step.start + int(k))
    return found


Many = TypeVar("Many", Instances, Balls)


def take(many: Many, chosen: NDArray[np.integer]) -> Many:
    """Those in places, which ascend."""
    primvars = {name: values[chosen] if values.ndim == 2 else values for name, values in many.primvars.items()}
    paths = many.paths.take(chosen)
    columns = {name: getattr(many, name)[chosen] for name in ("transforms", "centres", "radii") if hasattr(many, name)}
    return replace(many, paths=paths, primvars=primvars, **columns)


def within(many: Many, prims: frozenset[str]) -> Many:
    """Those that belong to some prims."""
    kept = [(owner in prims, count) for owner, count in many.paths.owners()]
    if all(keep for keep, _ in kept):
        return many
    return take(many, np.flatnonzero(np.repeat([keep for keep, _ in kept], [count for _, count in kept])))


# --- for rays -------------------------------------------------------------------------------------------------------


def settled(scene: Scene) -> Scene:
    """The scene as rays can meet it: what glows in many places are meshes, as each of its triangles is a light; and
    instances that collections tell apart, of what a probe sees or a light lights, are apart."""
    if not scene.instances and not scene.balls:
        return scene
    notices, left = list(scene.notices), _MOST_GLOWING

    def lights(many: Instances | Balls) -> bool:
        nonlocal left
        if not _glows(many, scene):
            return False
        if isinstance(many, Balls):
            if len(many) <= _MOST_GLOWING_BALLS:
                return True
            text = f"its {len(many)} spheres glow, but light nothing: at most {_MOST_GLOWING_BALLS} do"
        elif (size := len(many) * len(many.mesh.triangles)) <= left:
            left -= size
            return True
        else:
            text = f"its {len(many)} instances glow, but light nothing: they have {size} triangles together, and what "
            text += f"glows in many places may have {_MOST_GLOWING}"
        notices.append(Notice(many.paths[0], text))
        return False

    alone = _loosened(scene, lights)
    told = [frozenset(paths) for paths in _collections(scene)]
    return replace(
        alone,
        instances=tuple(one for many in alone.instances for one in (_apart(many, told) if told else [many])),
        balls=tuple(one for many in alone.balls for one in (_apart(many, told) if told else [many])),
        notices=tuple(notices),
    )


def _glows(many: Instances | Balls, scene: Scene) -> bool:
    used = [many.material] if isinstance(many, Balls) else np.unique(many.mesh.materials).tolist()
    return any(scene.materials[m].emits and not scene.materials[m].refractive for m in used)


def _collections(scene: Scene) -> Iterator[tuple[str, ...]]:
    said = [probe.captured for probe in scene.probes]
    said += [paths for light in scene.lights for paths in (light.lit, light.casters)]
    return (paths for paths in dict.fromkeys(said) if paths is not None)


def _apart(many: Many, collections: list[frozenset[str]]) -> list[Many]:
    """Instances, or balls, by the collections that they are in."""
    numbers: dict[tuple[bool, ...], int] = {}
    kinds, counts = [], []
    for owner, count in many.paths.owners():
        kinds.append(numbers.setdefault(tuple(owner in paths for paths in collections), len(numbers)))
        counts.append(count)
    if len(numbers) <= 1:
        return [many]
    which = np.repeat(kinds, counts)
    return [take(many, np.flatnonzero(which == kind)) for kind in range(len(numbers))]


def thing_count(scene: Scene) -> int:
    """Things that have a number: meshes, spheres, every instance, and every ball."""
    return len(scene.meshes) + len(scene.spheres) + sum(map(len, scene.instances)) + sum(map(len, scene.balls))


def numbered(scene: Scene) -> tuple[list[tuple[int, Instances]], list[tuple[int, Balls]]]:
    """Instances, and balls, each with the number that the first of its things has."""
    of_instances = list(accumulate(map(len, scene.instances), initial=len(scene.meshes) + len(scene.spheres)))
    of_balls = list(accumulate(map(len, scene.balls), initial=of_instances[-1]))
    return (
        list(zip(of_instances[:-1], scene.instances, strict=True)),
        list(zip(of_balls[:-1], scene.balls, strict=True)),
    )


def instances_at(scene: Scene, thing: int) -> Instances:
    """Those whose first has a number."""
    # Those of no places have the number of the next, who come after them and so are what is found.
    return dict(numbered(scene)[0])[thing]


def paths_of(scene: Scene) -> Iterator[tuple[str, int]]:
    """Prims that things belong to (`scene.prim_of`), in the order of their numbers, and how many in a row do."""
    alone: tuple[Mesh | Sphere, ...] = (*scene.meshes, *scene.spheres)
    yield from ((prim_of(thing.path), 1) for thing in alone)
    for paths in [many.paths for many in scene.instances] + [balls.paths for balls in scene.balls]:
        yield from paths.owners()

