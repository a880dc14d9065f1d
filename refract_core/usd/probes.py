"""Reflection probes: prims with RefractProbeAPI to `scene.Probe`, in metres, every value inside its range."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pxr import Usd, UsdGeom

from ..errors import ImageError, StageError
from ..scene import F64, Notice, Probe, Texture, Volume

API = "RefractProbeAPI"
PLANAR = "RefractPlanarProbe"
RESOLUTION = (8, 4096)
MIN_EXTENT = 1e-4
"""[m]; the thinnest proxy box, as HDRP's."""

_INF = math.inf
_SCALE_TOLERANCE = 1e-4

ReadTexture = Callable[[str, str], Texture]


@dataclass(frozen=True)
class _Source:
    """One probe prim and where to complain about it."""

    prim: Usd.Prim
    time: Usd.TimeCode
    notices: list[Notice]

    def say(self, text: str) -> None:
        self.notices.append(Notice(str(self.prim.GetPath()), text))


class _Place(NamedTuple):
    """Where a stage's units and axes lie in engine world."""

    engine_from_stage: F64
    metres_per_unit: float


class _Frame(NamedTuple):
    """A probe's own axes and origin in engine world; its axes are mirrored where the prim's transform mirrors."""

    axes: F64
    """shape (3, 3), columns, orthonormal"""
    origin: F64
    """shape (3,) [m]"""

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(self.axes) < 0.0)

    @property
    def world_from_volume(self) -> F64:
        """The frame with x turned round where it is mirrored: a box looks the same from both sides."""
        flip = np.diag([-1.0 if self.mirrored else 1.0, 1.0, 1.0])
        return _matrix(self.axes @ flip, self.origin)

    def per_face(self, faces: tuple[float, ...]) -> tuple[float, ...]:
        """Values for +x -x +y -y +z -z of the prim, as the volume's own faces."""
        return (faces[1], faces[0], *faces[2:]) if self.mirrored else faces


def read_probes(
    stage: Usd.Stage,
    time: Usd.TimeCode,
    *,
    engine_from_stage: F64,
    metres_per_unit: float,
    notices: list[Notice],
    read_texture: ReadTexture,
) -> tuple[Probe, ...]:
    """Every visible reflection probe of the stage, in stage order.

    Values out of range are replaced, and a notice says so.

    Args:
        engine_from_stage: shape (4, 4), float64, column vectors: stage world and units to engine world in metres
        metres_per_unit: the scale that is in `engine_from_stage`
        notices: grows by what was ignored, replaced or skipped
        read_texture: (path, colour space) to a decoded image; may raise ImageError

    Raises:
        StageError: a token is not one of those the schema allows.
    """
    place = _Place(np.asarray(engine_from_stage, np.float64), float(metres_per_unit))
    transforms = UsdGeom.XformCache(time)
    found = []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if not prim.HasAPI(API):
            continue
        source = _Source(prim, time, notices)
        frame = _frame_of(source, place, transforms) if _is_served(source) else None
        if frame is not None:
            found.append(_read_probe(source, place, frame, read_texture))
    return tuple(found)


def _is_served(source: _Source) -> bool:
    """Whether the prim is a probe that can be rendered; if not, and the author did not hide it, a notice says why."""
    prim = source.prim
    if not prim.IsA(UsdGeom.Xformable):
        source.say(f"{API} is applied to a prim that has no transform; the probe is ignored. Make it an Xform")
        return False
    if UsdGeom.Imageable(prim).ComputeVisibility(source.time) == UsdGeom.Tokens.invisible:
        return False
    if prim.GetTypeName() == PLANAR:
        source.say("planar probes are not rendered yet; the probe is ignored. Use a RefractProbe or --tiers with ray")
        return False
    above = prim
    while above:
        if above.IsA(UsdGeom.PointInstancer):
            source.say(f"the probe is a prototype of the point instancer {above.GetPath()}; it is ignored. Move it out")
            return False
        above = above.GetParent()
    return True


def _frame_of(source: _Source, place: _Place, transforms: UsdGeom.XformCache) -> _Frame | None:
    stage_from_prim = np.array(transforms.GetLocalToWorldTransform(source.prim), np.float64).T
    engine_from_prim = place.engine_from_stage @ stage_from_prim
    linear = engine_from_prim[:3, :3] / place.metres_per_unit
    if not np.isfinite(engine_from_prim).all():
        source.say("its transform is not finite; the probe is ignored. Correct its xformOps")
        return None
    # The nearest orthonormal matrix: what is left of the transform without scale and shear (polar decomposition).
    left, scales, right = np.linalg.svd(linear)
    if scales[2] < 1e-9 * max(scales[0], 1e-30):
        source.say("its transform is flat (a scale of 0); the probe is ignored. Correct its xformOps")
        return None
    if np.abs(scales - 1.0).max() > _SCALE_TOLERANCE:
        listed = ", ".join(f"{scale:.4g}" for scale in scales)
        source.say(f"its scale in the world ({listed}) is ignored; give the volumes their size in scene units instead")
    return _Frame(left @ right, engine_from_prim[:3, 3])


def _read_probe(source: _Source, place: _Place, frame: _Frame, read_texture: ReadTexture) -> Probe:
    unit = place.metres_per_unit
    mode = _token(source, "probe:mode", ("baked", "realtime", "custom"))
    sphere = _token(source, "probe:shape", ("box", "sphere")) == "sphere"
    influence = _own_volume(source, place, frame, "influence", sphere)
    # In scene units: what a blend distance may be at each face.
    reach = [extent / unit for extent in influence.extents for _ in range(2)]
    if sphere:
        reach[1:] = [_INF] * 5

    def faces(name: str, high: Sequence[float]) -> tuple[float, ...]:
        return frame.per_face(_numbers(source, f"probe:influence:{name}", (0.0,) * 6, high))

    def number(name: str, high: float = _INF) -> float:
        return _numbers(source, f"probe:{name}", (0.0,), (high,))[0]

    offset = np.array(_numbers(source, "probe:captureOffset", (-_INF,) * 3, (_INF,) * 3)) * unit
    return Probe(
        path=str(source.prim.GetPath()),
        mode=mode,
        capture_point=_triple(frame.origin + frame.axes @ offset),
        influence=influence,
        proxy=_proxy(source, place, frame, influence),
        resolution=int(_numbers(source, "probe:resolution", RESOLUTION[:1], RESOLUTION[1:])[0]),
        clipping=_clipping(source, unit),
        texture=_texture(source, mode, read_texture),
        captured=_captured(source),
        blend_distance=tuple(unit * value for value in faces("blendDistance", reach)),
        blend_normal_distance=tuple(unit * value for value in faces("blendNormalDistance", reach)),
        face_fade=faces("faceFade", (1.0,) * 6),
        importance=int(number("importance", 32767)),
        weight=number("weight", 1.0),
        multiplier=number("multiplier"),
        fade_distance=unit * _positive(source, "probe:fadeDistance", 1)[0],
    )


def _own_volume(source: _Source, place: _Place, frame: _Frame, which: str, sphere: bool) -> Volume:
    if sphere:
        extents = _positive(source, f"probe:{which}:radius", 1) * 3
    else:
        extents = tuple(0.5 * size for size in _positive(source, f"probe:{which}:size", 3))
    x, y, z = (place.metres_per_unit * extent for extent in extents)
    return Volume(frame.world_from_volume, sphere, (x, y, z))


def _proxy(source: _Source, place: _Place, frame: _Frame, influence: Volume) -> Volume | None:
    kind = _token(source, "probe:proxy", ("influence", "volume", "infinite"))
    targets = source.prim.GetRelationship("probe:proxy:prim").GetForwardedTargets()
    if targets and kind != "volume":
        source.say(f"probe:proxy:prim is ignored, for probe:proxy is '{kind}'; set that to 'volume' to use it")
    if kind == "influence":
        return influence
    if kind == "infinite":
        return None
    if not targets:
        return _own_volume(source, place, frame, "proxy", influence.sphere)
    box = _bounds(source, place, targets)
    return influence if box is None else box


def _bounds(source: _Source, place: _Place, targets: Sequence[Any]) -> Volume | None:
    """The world-aligned box of the first target; None, and a notice, where it has none."""
    if len(targets) > 1:
        source.say(f"probe:proxy:prim has {len(targets)} targets; only the first, {targets[0]}, is used. Name one prim")
    prim = source.prim.GetStage().GetPrimAtPath(targets[0].GetPrimPath())
    if not prim:
        source.say(f"probe:proxy:prim names {targets[0]}, which does not exist; the influence volume is the proxy")
        return None
    cache = UsdGeom.BBoxCache(source.time, [UsdGeom.Tokens.default_, UsdGeom.Tokens.render])
    box = cache.ComputeWorldBound(prim).ComputeAlignedRange()
    corners = np.array([box.GetMin(), box.GetMax()], np.float64)
    if box.IsEmpty() or not np.isfinite(corners).all():
        source.say(f"probe:proxy:prim names {targets[0]}, which has no bounds; the influence volume is the proxy")
        return None
    half = 0.5 * (corners[1] - corners[0]) * place.metres_per_unit
    if half.min() < MIN_EXTENT:
        source.say(f"probe:proxy:prim names {targets[0]}, which is flat; the proxy is made {2 * MIN_EXTENT} m thick")
    # Stage axes stay the box's own axes: engine world may be turned against them (Z up).
    axes = place.engine_from_stage[:3, :3] / place.metres_per_unit
    centre = place.engine_from_stage @ np.array([*corners.mean(axis=0), 1.0])
    return Volume(_matrix(axes, centre[:3]), False, _triple(np.maximum(half, MIN_EXTENT)))


def _clipping(source: _Source, unit: float) -> tuple[float, float]:
    near, far = _positive(source, "probe:clippingRange", 2)
    if near >= far:
        source.say(
            f"probe:clippingRange is ({near:g}, {far:g}); far must be above near; the schema's own range is used"
        )
        near, far = _fallback(source, "probe:clippingRange")
    return near * unit, far * unit


def _texture(source: _Source, mode: str, read_texture: ReadTexture) -> Texture | None:
    if mode == "realtime":
        return None
    asset = source.prim.GetAttribute("probe:texture").Get(source.time)
    path = str(asset.resolvedPath or asset.path) if asset else ""
    if not path:
        if mode == "custom":
            source.say("probe:mode is 'custom' but probe:texture is not set; the surroundings are captured instead")
        return None
    try:
        return read_texture(path, "auto")
    except ImageError as error:
        source.say(f"probe:texture cannot be read; the surroundings are captured instead. {error}")
        return None


def _captured(source: _Source) -> tuple[str, ...] | None:
    """Paths of the drawable prims in the collection; None where nothing is left out."""
    stage = source.prim.GetStage()
    collection = Usd.CollectionAPI(source.prim, "captured")
    relationships = (collection.GetIncludesRel(), collection.GetExcludesRel())
    for target in (target for relationship in relationships for target in relationship.GetTargets()):
        if not stage.GetObjectAtPath(target):
            source.say(f"its collection 'captured' names {target}, which does not exist; correct or remove the target")
    query = collection.ComputeMembershipQuery()
    rules = query.GetAsPathExpansionRuleMap()
    if rules and set(rules.values()) == {Usd.Tokens.expandPrims} and any(path.IsAbsoluteRootPath() for path in rules):
        return None
    included = Usd.CollectionAPI.ComputeIncludedPaths(query, stage, Usd.TraverseInstanceProxies())
    drawn = (UsdGeom.Gprim, UsdGeom.PointInstancer)
    return tuple(str(path) for path in included if any(stage.GetPrimAtPath(path).IsA(kind) for kind in drawn))


# ---- values


def _fallback(source: _Source, name: str) -> tuple[float, ...]:
    """What the schema says where nothing is authored."""
    return _floats(source.prim.GetPrimDefinition().GetAttributeFallbackValue(name)) or ()


def _floats(value: Any) -> tuple[float, ...] | None:
    try:
        return tuple(float(part) for part in value) if hasattr(value, "__len__") else (float(value),)
    except (TypeError, ValueError):
        return None


def _numbers(
    source: _Source, name: str, low: Sequence[float], high: Sequence[float], *, above: bool = False
) -> tuple[float, ...]:
    """Value of an attribute in the schema's units, brought into its range.

    Args:
        low: the least value of each component; its length is how many there must be
        high: the largest value of each component
        above: `low` itself is out of range
    """
    value = source.prim.GetAttribute(name).Get(source.time)
    numbers = _fallback(source, name) if value is None else _floats(value)
    limits = list(zip(low, high, strict=True))
    used = _within(numbers, limits, above) or _fallback(source, name)
    if used != numbers:
        source.say(f"{name} is {value}; it must be {_range_text(limits, above)}; {_text(used)} is used")
    return used


def _within(
    numbers: tuple[float, ...] | None, limits: list[tuple[float, float]], above: bool
) -> tuple[float, ...] | None:
    """The numbers, clamped to their limits; None where that gives nothing sensible."""
    if numbers is None or len(numbers) != len(limits) or not all(map(math.isfinite, numbers)):
        return None
    pairs = [(number, *limit) for number, limit in zip(numbers, limits, strict=True)]
    if above and any(number <= low for number, low, _ in pairs):
        return None
    return tuple(min(max(number, low), high) for number, low, high in pairs)


def _positive(source: _Source, name: str, count: int) -> tuple[float, ...]:
    return _numbers(source, name, (0.0,) * count, (_INF,) * count, above=True)


def _token(source: _Source, name: str, allowed: tuple[str, ...]) -> str:
    value = source.prim.GetAttribute(name).Get(source.time)
    if value not in allowed:
        raise StageError(f"{source.prim.GetPath()}: {name} is '{value}'; choose from {', '.join(allowed)}")
    return str(value)


def _range_text(limits: list[tuple[float, float]], above: bool) -> str:
    count = {1: "a number", 2: "two numbers", 3: "three numbers", 6: "six numbers"}[len(limits)]
    low, high = limits[0][0], [most for _, most in limits]
    if above:
        return f"{count} above {low:g}"
    if math.isinf(low):
        return f"{count}, all finite"
    if len(set(high)) == 1:
        return f"{count} of {low:g} or more" if math.isinf(high[0]) else f"{count} between {low:g} and {high[0]:g}"
    return f"{count} between {low:g} and {_text(high)}"


def _text(numbers: Sequence[float]) -> str:
    listed = ", ".join(f"{number:g}" for number in numbers)
    return listed if len(numbers) == 1 else f"({listed})"


def _matrix(axes: F64, origin: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    matrix[:3, 3] = origin
    return matrix


def _triple(vector: F64) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in vector)
    return x, y, z
