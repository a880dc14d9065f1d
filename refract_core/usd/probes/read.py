"""Reflection probes: prims with RefractProbeAPI to `scene.Probe`, in metres, every value inside its range."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from ...scene import F64, Cubemap, Notice, Probe, Volume
from ..ours import PROBE as API
from ..ours import applied, collection
from ..values import triple
from .attributes import INF, ProbePrim, fallback, flag, floats, forced, positive, token
from .pictures import ReadCubemap, picture_of, refuse_picture
from .volumes import Frame, Place, frame_of, own_volume, proxy_of

PLANAR = "RefractPlanarProbe"
MODES = ("baked", "realtime", "custom")
RESOLUTION = (8, 4096)
MAX_PROBES = 256
"""As many as HDRP considers; those beyond are dropped."""


def read_probes(
    stage: Usd.Stage,
    time: Usd.TimeCode,
    *,
    engine_from_stage: F64,
    metres_per_unit: float,
    notices: list[Notice],
    read_cubemap: ReadCubemap,
) -> tuple[Probe, ...]:
    """Every visible reflection probe of the stage, in stage order, MAX_PROBES at most.

    Values out of range are replaced, and a notice says so.

    Args:
        engine_from_stage: shape (4, 4), float64, column vectors: stage world and units to engine world in metres
        metres_per_unit: the scale that is in `engine_from_stage`
        notices: grows by what was ignored, replaced or skipped
        read_cubemap: (path, resolution) to a cubemap; may raise ImageError

    Raises:
        StageError: a token is not one of those the schema allows.
    """
    place = Place(np.asarray(engine_from_stage, np.float64), float(metres_per_unit))
    transforms = UsdGeom.XformCache(time)
    found = []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if API not in applied(prim):
            continue
        source = ProbePrim(prim, time, notices)
        frame = frame_of(source, place, transforms) if _is_served(source) else None
        if frame is not None:
            found.append((source, _read_probe(source, place, frame)))
    read_once = functools.cache(read_cubemap)  # several probes may share a file
    return tuple(_with_picture(source, probe, read_once) for source, probe in _first(found, notices))


def _first(found: list[tuple[ProbePrim, Probe]], notices: list[Notice]) -> list[tuple[ProbePrim, Probe]]:
    """The probes that are asked first: higher importance, then smaller influence volume, then as given (HDRP)."""

    def rank(pair: tuple[ProbePrim, Probe]) -> tuple[int, float]:
        return -pair[1].importance, math.prod(pair[1].influence.extents)

    dropped = [probe.path for _, probe in sorted(found, key=rank)[MAX_PROBES:]]
    if not dropped:
        return found
    text = f"the stage has {len(found)} probes, {MAX_PROBES} at most are used: the most important, then the smallest"
    notices.append(Notice(dropped[0], f"{text}. {len(dropped)} are ignored, this one first. Hide or remove some"))
    beyond = set(dropped)
    return [pair for pair in found if pair[1].path not in beyond]


def _is_served(source: ProbePrim) -> bool:
    """Whether the prim is a probe that can be rendered; if not, and the author did not hide it, a notice says why."""
    prim = source.prim
    if not prim.IsA(UsdGeom.Xformable):
        source.say(f"{API} is applied to a prim that has no transform; the probe is ignored. Make it an Xform")
        return False
    if UsdGeom.Imageable(prim).ComputeVisibility(source.time) == UsdGeom.Tokens.invisible:
        return False
    above = prim
    while above:
        if above.IsA(UsdGeom.PointInstancer):
            source.say(f"the probe is a prototype of the point instancer {above.GetPath()}; it is ignored. Move it out")
            return False
        above = above.GetParent()
    return True


def _read_probe(source: ProbePrim, place: Place, frame: Frame) -> Probe:
    """Everything but the picture."""
    unit = place.metres_per_unit
    planar = source.prim.GetTypeName() == PLANAR
    mode = token(source, "probe:mode", MODES)
    sphere = token(source, "probe:shape", ("box", "sphere")) == "sphere"
    influence = own_volume(source, place, frame, "influence", sphere)
    proxy, marched = proxy_of(source, place, frame, influence, planar)

    def number(name: str, high: float = INF) -> float:
        return floats(source, f"probe:{name}", (0.0,), (high,))[0]

    return Probe(
        path=source.path,
        mode="realtime" if planar and mode == "custom" else mode,
        capture_point=_capture_point(source, frame, unit, planar),
        influence=influence,
        proxy=proxy,
        marched=marched,
        resolution=int(floats(source, "probe:resolution", RESOLUTION[:1], RESOLUTION[1:])[0]),
        clipping=_clipping(source, unit),
        planar=planar,
        background=_background(source),
        distance_roughness=_distance_roughness(source, planar),
        sees_glass=_sees_glass(source, mode, planar),
        captured=_captured(source),
        importance=int(number("importance", 32767)),
        weight=number("weight", 1.0),
        multiplier=number("multiplier"),
        fade_distance=unit * positive(source, "probe:fadeDistance", 1)[0],
        **_edges(source, frame, unit, influence, planar),
    )


def _with_picture(source: ProbePrim, probe: Probe, read_cubemap: ReadCubemap) -> Probe:
    if probe.planar:
        refuse_picture(source, token(source, "probe:mode", MODES))
        return probe
    cubemap, bake = picture_of(source, probe.mode, probe.resolution, read_cubemap)
    return replace(probe, cubemap=cubemap, bake=bake, marched=probe.marched and _has_distances(source, cubemap))


def _has_distances(source: ProbePrim, cubemap: Cubemap | None) -> bool:
    """There is something to march; a notice where a picture that shows anything does not say how far away it is."""
    if cubemap is None or cubemap.levels[0][..., 4].any() or not cubemap.levels[0][..., 3].any():
        return True
    source.say(
        "probe:proxy is 'depth', but probe:texture has no distances (a channel Z in metres); the influence volume is "
        "used. Bake it with refract bake probes STAGE OUT, or set probe:proxy to 'influence' or 'volume'"
    )
    return False


def _edges(source: ProbePrim, frame: Frame, unit: float, influence: Volume, planar: bool) -> dict[str, Any]:
    """How the weight falls at the faces of the influence volume, as fields of `Probe`."""
    # In scene units: what a blend distance may be at each face.
    reach = [extent / unit for extent in influence.extents for _ in range(2)]
    if influence.sphere:
        reach[1:] = [INF] * 5

    def faces(name: str, high: Sequence[float]) -> tuple[float, ...]:
        return frame.per_face(floats(source, f"probe:influence:{name}", (0.0,) * 6, high))

    blend = tuple(unit * value for value in faces("blendDistance", reach))
    if planar:
        reason = "it is not for planar probes, as in HDRP"
        normal = forced(source, "probe:influence:blendNormalDistance", (0.0,) * 6, reason)
        fade = forced(source, "probe:influence:faceFade", (1.0,) * 6, reason)
    else:
        normal = tuple(unit * value for value in faces("blendNormalDistance", reach))
        fade = faces("faceFade", (1.0,) * 6)
    return {"blend_distance": blend, "blend_normal_distance": normal, "face_fade": fade}


def _capture_point(source: ProbePrim, frame: Frame, unit: float, planar: bool) -> tuple[float, float, float]:
    name = "probe:captureOffset"
    if planar:
        offset = forced(source, name, (0.0,) * 3, "a planar probe's pictures are taken from the eye")
    else:
        offset = floats(source, name, (-INF,) * 3, (INF,) * 3)
    return triple(frame.origin + frame.axes @ np.array(offset) * unit)


def _clipping(source: ProbePrim, unit: float) -> tuple[float, float]:
    name = "probe:clippingRange"
    near, far = positive(source, name, 2)
    if near >= far:
        source.say(f"{name} is ({near:g}, {far:g}); far must be above near; the schema's own range is used")
        near, far = fallback(source, name)
    return near * unit, far * unit


def _background(source: ProbePrim) -> tuple[float, float, float] | None:
    colour = floats(source, "probe:backgroundColor", (0.0,) * 3, (INF,) * 3)
    if token(source, "probe:clear", ("sky", "color")) == "sky":
        return None
    red, green, blue = colour
    return red, green, blue


def _distance_roughness(source: ProbePrim, planar: bool) -> bool:
    wanted = flag(source, "probe:distanceBasedRoughness")
    if wanted and planar:
        source.say("probe:distanceBasedRoughness is ignored: it is for cubemaps, not for planar probes. Remove it")
    return wanted and not planar


def _sees_glass(source: ProbePrim, mode: str, planar: bool) -> bool:
    wanted, name = flag(source, "probe:captureRefraction"), "probe:captureRefraction"
    if wanted and planar:
        source.say(f"{name} is ignored: it is for cubemaps, not for planar probes. Remove it")
    elif wanted and mode != "realtime":
        source.say(f"{name} is ignored: the mode is '{mode}', and only realtime probes see glass. Set probe:mode")
    return wanted and not planar and mode == "realtime"


def _captured(source: ProbePrim) -> tuple[str, ...] | None:
    """Paths of the drawable prims in the collection; None where nothing is left out."""
    stage = source.prim.GetStage()
    captured = collection(source.prim, "captured")
    for target in captured.targets:
        if not stage.GetObjectAtPath(target):
            source.say(f"its collection 'captured' names {target}, which does not exist; correct or remove the target")
    rules = captured.query.GetAsPathExpansionRuleMap()
    if rules and set(rules.values()) == {Usd.Tokens.expandPrims} and any(path.IsAbsoluteRootPath() for path in rules):
        return None
    included = Usd.CollectionAPI.ComputeIncludedPaths(captured.query, stage, Usd.TraverseInstanceProxies())
    drawn = (UsdGeom.Gprim, UsdGeom.PointInstancer)
    return tuple(str(path) for path in included if any(stage.GetPrimAtPath(path).IsA(kind) for kind in drawn))
