"""What our schemas say of a prim, also where USD does not know them.

USD reads its table of schemas when the first stage of a process is opened or made, and never again. A program that had
opened a stage before it imported `refract_core` has prims of ours that are nothing to USD: typed probes are no Xforms,
`HasAPI` is False, and an attribute that is not authored is not there. What the schemas would have said is read from
their own file then, so a stage looks the same whatever was done before.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

from pxr import Sdf, Usd, UsdGeom

from ..schemas import APPLIED as _APPLIED
from ..schemas import TYPED as _TYPED
from .registering import FOLDER, register

APPLIED: tuple[str, ...] = _APPLIED
TYPED: tuple[str, ...] = _TYPED
PROBE = "RefractProbeAPI"
"""The schema that is built into the typed ones."""
_TYPES = "fallbackPrimTypes"
_HOLDER = Sdf.Path("/refract_collection")


class Collection(NamedTuple):
    """What a collection names, and the question whether it holds a path."""

    targets: tuple[Sdf.Path, ...]
    query: Usd.CollectionMembershipQuery


@cache
def known() -> bool:
    """USD knows our schemas. It reads its table here, if it has not yet."""
    register()
    registry = Usd.SchemaRegistry()
    return all(registry.FindAppliedAPIPrimDefinition(name) is not None for name in APPLIED)


def recognised(stage: Usd.Stage) -> Usd.Stage:
    """The same stage, where typed probes have a place as Xforms do: if USD does not know, its session layer says so."""
    if not known():
        session = stage.GetSessionLayer()
        said = dict(session.pseudoRoot.GetInfo(_TYPES)) if session.pseudoRoot.HasInfo(_TYPES) else {}
        session.pseudoRoot.SetInfo(_TYPES, said | fallback_types())
        # Prototypes take no fallback, or by chance (usd-core 26.11). Their instances are made prims of their own, the
        # outer ones first: an instance inside a prototype cannot be spoken of.
        while lost := _instances_of_lost_probes(stage):
            with Sdf.ChangeBlock():
                for path in lost:
                    Sdf.CreatePrimInLayer(session, path).SetInfo("instanceable", False)
    return stage


def _instances_of_lost_probes(stage: Usd.Stage) -> list[Sdf.Path]:
    """Where the prototypes stand that have typed probes in them, at any depth, which USD does not take for Xforms."""

    def loses(prototype: Usd.Prim) -> bool:
        return any(
            (prim.GetTypeName() in TYPED and not prim.IsA(UsdGeom.Xformable))
            or (prim.IsInstance() and loses(prim.GetPrototype()))
            for prim in Usd.PrimRange(prototype)
        )

    instances = (prim for prototype in stage.GetPrototypes() if loses(prototype) for prim in prototype.GetInstances())
    return [prim.GetPath() for prim in instances if not prim.IsInPrototype()]


def fallback_types() -> dict[str, Any]:
    """What programs without our schemas are to take for our typed prims: tokens by the name of a type."""
    return dict(_definitions().pseudoRoot.GetInfo(_TYPES))


def write_fallback_types(stage: Usd.Stage) -> None:
    """Author in the root layer what its `fallbackPrimTypes` lack, for every type that USD has and for ours."""
    stage.WriteFallbackPrimTypes()
    root = stage.GetRootLayer().pseudoRoot
    said = dict(root.GetInfo(_TYPES)) if root.HasInfo(_TYPES) else {}
    root.SetInfo(_TYPES, fallback_types() | said)


def applied(prim: Usd.Prim) -> list[str]:
    """Those of our API schemas that are applied to a prim, or built into its type."""
    if known():
        return [str(api) for api in prim.GetAppliedSchemas() if api in APPLIED]
    authored = [str(api) for api in prim.GetPrimTypeInfo().GetAppliedAPISchemas() if api in APPLIED]
    built_in = [PROBE] if prim.GetTypeName() in TYPED and PROBE not in authored else []
    return authored + built_in


def value(prim: Usd.Prim, name: str, time: Usd.TimeCode) -> Any:
    """Value of one of our attributes; None where that is nothing."""
    attribute = prim.GetAttribute(name)
    if known() or (attribute and attribute.HasAuthoredValue()):
        return attribute.Get(time)
    return fallback(prim, name)


def fallback(prim: Usd.Prim, name: str) -> Any:
    """What the schema says where nothing is authored; None where it says nothing."""
    for owner in (str(prim.GetTypeName()), *APPLIED):
        found = _definitions().GetAttributeAtPath(f"/{owner}.{name}") if owner else None
        if found is not None and found.default is not None:
            return found.default
    return None


def attributes(api: str) -> Iterator[Sdf.AttributeSpec]:
    """The attributes that an API schema of ours defines, by name."""
    specs = _definitions().GetPrimAtPath(f"/{api}").attributes
    yield from sorted(specs, key=lambda spec: str(spec.name))


def properties(api: str) -> list[str]:
    """Names of the attributes and relationships that an API schema of ours defines."""
    return sorted(str(spec.name) for spec in _definitions().GetPrimAtPath(f"/{api}").properties)


def collection(prim: Usd.Prim, name: str) -> Collection:
    """A collection that is built into our schemas."""
    own = Usd.CollectionAPI(prim, name)
    includes, excludes = own.GetIncludesRel().GetTargets(), own.GetExcludesRel().GetTargets()
    if known():
        return Collection((*includes, *excludes), own.ComputeMembershipQuery())
    # To USD, `own` is not applied and has no fallbacks. The same collection is made elsewhere: a query holds paths, no
    # prims, and only where one collection names another are the stage's own prims needed to answer it.
    nested = any(target.IsPropertyPath() for target in (*includes, *excludes))
    other = _again(prim.GetStage()) if nested else Usd.Stage.CreateInMemory()
    other.SetEditTarget(other.GetSessionLayer())
    made = Usd.CollectionAPI.Apply(other.OverridePrim(_HOLDER), name)
    made.CreateIncludesRel().SetTargets(includes)
    made.CreateExcludesRel().SetTargets(excludes)
    for kept in ("includeRoot", "expansionRule", "membershipExpression"):
        full = f"collection:{name}:{kept}"
        said = value(prim, full, Usd.TimeCode.Default())
        if said is not None:
            made.GetPrim().GetAttribute(full).Set(said)
    return Collection((*includes, *excludes), made.ComputeMembershipQuery())


def _again(stage: Usd.Stage) -> Usd.Stage:
    """A second stage over the same layers, to author in."""
    session = Sdf.Layer.CreateAnonymous("again.usda")
    if stage.GetSessionLayer():
        session.subLayerPaths.append(stage.GetSessionLayer().identifier)
    return Usd.Stage.Open(stage.GetRootLayer(), session, stage.GetPathResolverContext())


@cache
def _definitions() -> Sdf.Layer:
    return Sdf.Layer.OpenAsAnonymous(str(FOLDER / "generatedSchema.usda"))
