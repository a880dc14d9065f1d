"""Skinned meshes in the pose of one time, by UsdSkel's own baking, without touching the caller's layers."""

from __future__ import annotations

from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdSkel

from ...scene import Notice
from ..ours import recognised

_NESTED_INSTANCES = 64
_CHANNELS = ("translations", "rotations", "scales", "blendShapeWeights")


def posed(stage: Usd.Stage, time: Usd.TimeCode, notices: list[Notice]) -> Usd.Stage:
    """The stage itself where nothing is skinned; else a second stage over the same layers with the skins baked."""
    if not _of_type(stage, UsdSkel.Root):
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
        prims = _of_type(copy, UsdSkel.Root) + _of_type(copy, UsdSkel.Animation)
        instances = {_instance_above(prim).GetPath() for prim in prims if prim.IsInstanceProxy()}
        if not instances:
            break
        for path in instances:
            copy.GetPrimAtPath(path).SetInstanceable(False)
    return copy


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


def _instance_above(proxy: Usd.Prim) -> Usd.Prim:
    while proxy.IsInstanceProxy():
        proxy = proxy.GetParent()
    return proxy
