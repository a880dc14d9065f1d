"""Skinned meshes in the pose of one time, by UsdSkel's own baking, without touching the caller's layers."""

from __future__ import annotations

from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdSkel

from ...scene import Notice
from ..ours import recognised
from .traverse import refuse_too_many

_NESTED_INSTANCES = 64
_CHANNELS = ("translations", "rotations", "scales", "blendShapeWeights")


def posed(stage: Usd.Stage, time: Usd.TimeCode, notices: list[Notice]) -> Usd.Stage:
    """The stage itself where nothing is skinned; else a second stage over the same layers with the skins baked.

    Raises:
        StageError: its instances stand for more prims than can be looked at.
    """
    refuse_too_many(stage)
    if not _is_in(stage, UsdSkel.Root):
        return stage
    copy = _copy(stage)
    moving = _hold(copy, time)
    for root in _of_type(copy, UsdSkel.Root):
        path = str(root.GetPath())
        if moving:
            UsdGeom.PrimvarsAPI(root).CreatePrimvar("refract:static", Sdf.ValueTypeNames.Int).Set(0)
        _move_normals(root, time)
        try:
            baked = UsdSkel.BakeSkinning(UsdSkel.Root(root), Gf.Interval(time.GetValue(), time.GetValue()))
        except Tf.ErrorException:
            baked = False
        if not baked:
            notices.append(Notice(path, "skinning could not be applied; its meshes are drawn in their bind pose"))
    return copy


def _copy(stage: Usd.Stage) -> Usd.Stage:
    """The same layers under a session layer of our own; what is skinned is no instance there, to have its own pose."""
    session = Sdf.Layer.CreateAnonymous("posed.usda")
    session.subLayerPaths.append(stage.GetSessionLayer().identifier)
    copy = Usd.Stage.OpenMasked(stage.GetRootLayer(), session, stage.GetPopulationMask())
    copy.MuteAndUnmuteLayers(stage.GetMutedLayers(), [])
    copy.SetLoadRules(stage.GetLoadRules())
    recognised(copy)  # last, for each of these composes again
    copy.SetEditTarget(session)
    for _ in range(_NESTED_INSTANCES):
        instances = _outermost_instances(copy, _skinned_prototypes(copy))
        if not instances:
            break
        for path in instances:
            copy.GetPrimAtPath(path).SetInstanceable(False)
    return copy


def _skinned_prototypes(stage: Usd.Stage) -> set[Sdf.Path]:
    """Prototypes with a skeleton's root or animation in them, at any depth. Each is looked through once, whatever
    number of places its instances stand in."""
    inside = {prototype.GetPath(): list(Usd.PrimRange(prototype)) for prototype in stage.GetPrototypes()}
    users: dict[Sdf.Path, list[Sdf.Path]] = {path: [] for path in inside}
    for path, prims in inside.items():
        for prim in prims:
            if prim.IsInstance():
                users[prim.GetPrototype().GetPath()].append(path)
    waiting = [path for path, prims in inside.items() if any(map(_is_skinned, prims))]
    found: set[Sdf.Path] = set()
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting.extend(users[path])
    return found


def _outermost_instances(stage: Usd.Stage, prototypes: set[Sdf.Path]) -> list[Sdf.Path]:
    """Where prototypes stand in the stage itself: an instance inside of another cannot be spoken of."""
    prims = Usd.PrimRange.Stage(stage) if prototypes else ()
    return [prim.GetPath() for prim in prims if prim.IsInstance() and prim.GetPrototype().GetPath() in prototypes]


def _is_skinned(prim: Usd.Prim) -> bool:
    return bool(prim.IsA(UsdSkel.Root) or prim.IsA(UsdSkel.Animation))


def _hold(stage: Usd.Stage, time: Usd.TimeCode) -> bool:
    """Gives every animation one sample, at `time`, as baking looks at samples only; whether any animation moves."""
    moving = False
    for prim in _of_type(stage, UsdSkel.Animation):
        for attribute in map(prim.GetAttribute, _CHANNELS):
            value = attribute.Get(time)
            if value is not None:
                moving = moving or attribute.ValueMightBeTimeVarying()
                attribute.Set(value, time)
    return moving


def _move_normals(root: Usd.Prim, time: Usd.TimeCode) -> None:
    """Makes `primvars:normals` the attribute `normals`: baking turns only the latter, and the former would win."""
    for prim in Usd.PrimRange(root):
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
        if not (prim.IsA(UsdGeom.PointBased) and primvar and primvar.HasValue()):
            continue
        normals, interpolation = primvar.ComputeFlattened(time), primvar.GetInterpolation()
        primvar.GetAttr().Block()
        UsdGeom.PointBased(prim).GetNormalsAttr().Set(normals)  # without a time: baking overlooks a first sample
        UsdGeom.PointBased(prim).SetNormalsInterpolation(interpolation)


def _of_type(stage: Usd.Stage, kind: type) -> list[Usd.Prim]:
    return [prim for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()) if prim.IsA(kind)]


def _is_in(stage: Usd.Stage, kind: type) -> bool:
    """Whether a prim of a type is anywhere. Prototypes are looked through, not the places they stand in."""
    ranges = [Usd.PrimRange.Stage(stage), *(Usd.PrimRange(prototype) for prototype in stage.GetPrototypes())]
    return any(prim.IsA(kind) for one in ranges for prim in one)
