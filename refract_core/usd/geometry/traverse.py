"""Which prims of a stage are seen, and where: visibility, purpose, transforms, native and point instances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from ...errors import StageError
from ...scene import F64, I32, Notice, Run
from .gprims import ATTRIBUTES
from .moving import FLIGHT, flies
from .standins import INHERITED, MODES, StandIns, handed_down, takes
from .triangulate import Index

MAX_INSTANCES = 4_000_000
"""Prims that point instancers may stand for, in all."""
_SOME = 1 << 13
"""Instances whose transforms are multiplied together."""
FEW = 8
"""Places from which on a prim may stay one mesh."""
SMALL = 4096
"""Triangles that all of its places have together, from which on it does: less is as fast and as small as meshes of
their own, which everything else knows how to look at."""
MAX_PRIMS = 4_000_000
"""Prims looked at, native instances expanded."""

CURVES = ("BasisCurves", "HermiteCurves")
DRAWN = frozenset({"Mesh", *ATTRIBUTES, *CURVES})
POINTS = "Points"
"""Drawn too, but have no triangles"""
_INSTEAD = {
    "NurbsCurves": "convert it to BasisCurves of basis bspline, or to a Mesh",
    "TetMesh": "its surface as a Mesh is (UsdGeomTetMesh.ComputeSurfaceFaces)",
    "Volume": "smoke and fog are left out; a Mesh of a level, or absorption in glass, stands for a simple one",
    "ParticleField": "splats are left out; a Mesh or Points made from them can be drawn",
    "ParticleField3DGaussianSplat": "splats are left out; a Mesh or Points made from them can be drawn",
}
"""What to do about kinds of prims that are not drawn, where that is not to convert them to a Mesh."""
# Prototypes of a point instancer are often `over` or `class` prims, so that nothing else draws them.
_PROTOTYPES = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)
_INSTANCER_ATTRIBUTES = ("protoIndices", "positions", "orientations", "orientationsf", "scales", "invisibleIds")


def stays_one(places: int, triangles: int) -> bool:
    """A prim that is drawn in many places is one mesh with many transforms."""
    return places >= FEW and places * triangles >= SMALL


class Placement(NamedTuple):
    """One prim at one place, or at all to which a point instancer takes it."""

    prim: Usd.Prim
    run: Run
    """Where it is drawn: N paths, `/Instancer/[7]/Proto/Mesh` for what instance 7 of a point instancer draws"""
    worlds: F64
    """shape (N, 3, 4), in the stage's own world and units"""
    static: bool
    """Nothing that moves it varies in time, and `primvars:refract:static` is not 0."""
    instance: tuple[Usd.Prim, I32] | None = None
    """The innermost point instancer and, of shape (N,), the index in it."""
    stands_in: Usd.Stage | None = None
    """The stage of `prim`, where that stands for a model by its draw mode; it lives as long as this"""

    @property
    def path(self) -> str:
        """The first of its paths."""
        return self.run.path(0)

    @property
    def paths(self) -> str | Run:
        """As `scene.Paths` has them."""
        return self.run if self.run.numbers.shape[1] else self.path

    def at(self, rows: Index) -> Placement:
        """Some of its places."""
        instance = None if self.instance is None else (self.instance[0], self.instance[1][rows])
        run = Run(self.run.pieces, self.run.numbers[rows])
        return self._replace(run=run, worlds=self.worlds[rows], instance=instance)


_ONE = np.zeros((1, 0), np.int32)
"""The numbers in the one path of what no point instancer draws."""


class _Node(NamedTuple):
    prim: Usd.Prim
    world: Gf.Matrix4d
    """What its own transform is relative to; row vectors."""
    purpose: UsdGeom.Imageable.PurposeInfo
    static: bool
    mode: str = INHERITED
    """`model:drawMode` and `model:cardVisibility` from above"""
    cards: str = INHERITED


@dataclass
class _Walk:
    """What one walk through a stage knows and gathers."""

    time: Usd.TimeCode
    purposes: frozenset[str]
    notices: list[Notice]
    cache: UsdGeom.XformCache
    unsupported: dict[str, list[str]] = field(default_factory=dict)
    stand_ins: StandIns | None = None
    """What is drawn for models whose draw mode asks for bounds, an origin or cards; None: the models themselves, and no
    lights of point instancers"""
    drawn_otherwise: dict[str, list[str]] = field(default_factory=dict)
    """Those models, by their draw mode."""
    visited: int = 0
    expanded: int = 0
    within: tuple[Sdf.Path, ...] = ()
    """Point instancers being expanded, outermost first."""


def walk(
    stage: Usd.Stage, time: Usd.TimeCode, purposes: tuple[str, ...], notices: list[Notice],
    *, as_drawn: bool = False,
) -> list[Placement]:  # fmt: skip
    """Every visible prim with a surface, in the order of the stage.

    Args:
        as_drawn: models are drawn as their `model:drawMode` asks, else as what they are made of; and the lights of
            point instancers, which have no surface, are there, too

    Raises:
        StageError: where instances expand to more than `MAX_INSTANCES` or `MAX_PRIMS` prims.
    """
    state = _Walk(time, frozenset(purposes), notices, UsdGeom.XformCache(time))
    state.stand_ins = StandIns(stage, notices) if as_drawn else None
    start = _Node(stage.GetPseudoRoot(), Gf.Matrix4d(1.0), UsdGeom.Imageable.PurposeInfo(), True)
    found = list(_descend(state, start, Usd.TraverseInstanceProxies(), 0))
    for kind, paths in sorted(state.unsupported.items()):
        what = _INSTEAD.get(kind, "convert it to a Mesh")
        notices.append(Notice(paths[0], f"{kind} is not rendered; {what} ({some_of(paths)})"))
    for mode, paths in sorted(state.drawn_otherwise.items()):
        text = f"drawn as {mode} and not as what is in it, for its model:drawMode says so ({some_of(paths)})"
        notices.append(Notice(paths[0], text))
    return found


def refuse_too_many(stage: Usd.Stage) -> None:
    """Counts what native instances stand for, each prototype once: 30 of them, one in the other, may be 2^30 prims.

    Raises:
        StageError: they are more than `MAX_PRIMS`.
    """
    sizes: dict[Sdf.Path, int] = {}
    waiting = [*stage.GetPrototypes()]
    while waiting:
        path = waiting[-1].GetPath()
        prims = list(Usd.PrimRange(waiting[-1])) if path not in sizes else []
        nested = [prim.GetPrototype() for prim in prims if prim.IsInstance()]
        if below := {one.GetPath(): one for one in nested if one.GetPath() not in sizes}:
            waiting.extend(below.values())
            continue
        waiting.pop()
        sizes.setdefault(path, len(prims) + sum(sizes[one.GetPath()] - 1 for one in nested))
    if not sizes:
        return
    every = sum(sizes[prim.GetPrototype().GetPath()] if prim.IsInstance() else 1 for prim in Usd.PrimRange.Stage(stage))
    if every > MAX_PRIMS:
        text = f"the stage has {every} prims once its instances are expanded; at most {MAX_PRIMS} can be looked at"
        raise StageError(f"{stage.GetRootLayer().identifier}: {text}")


def some_of(paths: list[str]) -> str:
    """How many there are and the first few by name."""
    first = ", ".join(paths[:3]) + (", ..." if len(paths) > 3 else "")
    return f"{len(paths)} prim{'s' if len(paths) > 1 else ''}: {first}"


def told_of(paths: list[str], text: str) -> Notice:
    """What is said of all of these alike, at the first of them."""
    return Notice(paths[0], f"{text} ({some_of(paths)})" if len(paths) > 1 else text)


def _descend(
    state: _Walk, start: _Node, predicate: Usd._PrimFlagsPredicate, cut: int, *, placed: bool = False
) -> Iterator[Placement]:
    """`start` and what is below it.

    Args:
        cut: length of the path prefix that is left out of `Placement.path`
        placed: the transform of `start` itself is already in `start.world`
    """
    stack = [start]
    while stack:
        node = stack.pop()
        prim = node.prim
        state.visited += 1
        if state.visited > MAX_PRIMS:
            raise StageError(f"{prim.GetPath()}: the stage has over {MAX_PRIMS} prims once its instances are expanded")
        if prim.IsPseudoRoot():
            stack.extend(_Node(child, *node[1:]) for child in reversed(prim.GetFilteredChildren(predicate)))
            continue
        if prim.HasAuthoredTypeName() and not prim.IsA(UsdGeom.Imageable):  # materials and the like: nothing to ask
            stack.extend(_Node(child, *node[1:]) for child in reversed(prim.GetFilteredChildren(predicate)))
            continue
        if prim.GetAttribute("visibility").Get(state.time) == UsdGeom.Tokens.invisible:
            continue
        here = _enter(state, node, moves=not (placed and node is start))
        label = str(prim.GetPath())[cut:]
        if state.stand_ins is not None and here.mode in MODES and takes(prim):
            yield from _stand_in(state, state.stand_ins, here, label)
            continue
        if prim.IsA(UsdGeom.PointInstancer):
            yield from _instances(state, here, label)
            continue
        if prim.IsA(UsdGeom.Gprim) and _wanted(state, here):
            kind = str(prim.GetTypeName())
            if kind in DRAWN or kind == POINTS:
                yield Placement(prim, Run((label,), _ONE), np.array(here.world).T[None, :3], here.static)
            else:
                state.unsupported.setdefault(kind, []).append(label)
        elif state.stand_ins is not None and state.within and prim.HasAPI(UsdLux.LightAPI) and _wanted(state, here):
            yield Placement(prim, Run((label,), _ONE), np.array(here.world).T[None, :3], here.static)
        children = prim.GetFilteredChildren(predicate)
        stack.extend(here._replace(prim=child) for child in reversed(children))


def _enter(state: _Walk, node: _Node, *, moves: bool) -> _Node:
    """What holds at the prim itself and is handed to its children."""
    prim, world, purpose, static, mode, cards = node
    imageable = UsdGeom.Imageable(prim)
    if imageable:
        purpose = imageable.ComputePurposeInfo(purpose)
    xformable = UsdGeom.Xformable(prim)
    if xformable and moves:
        local, resets = state.cache.GetLocalTransformation(prim)
        world = local if resets else local * world
        static = static and not xformable.TransformMightBeTimeVarying()
    if state.stand_ins is not None:
        mode, cards = handed_down(prim, "drawMode", mode), handed_down(prim, "cardVisibility", cards)
    said = prim.GetAttribute("primvars:refract:static")
    if said and said.HasAuthoredValue():
        static = bool(said.Get(state.time)) and static
    return _Node(prim, world, purpose, static, mode, cards)


def _stand_in(state: _Walk, stand_ins: StandIns, node: _Node, label: str) -> Iterator[Placement]:
    """What is drawn for a model instead of what is below it."""
    if not _wanted(state, node):
        return
    state.drawn_otherwise.setdefault(node.mode, []).append(label)
    drawn = stand_ins.of(node.prim, node.mode, node.cards)
    if drawn is not None:
        world = np.array(node.world).T[None, :3]
        yield Placement(drawn, Run((label,), _ONE), world, node.static, stands_in=stand_ins.stage)


def _wanted(state: _Walk, node: _Node) -> bool:
    return node.purpose.purpose in state.purposes or (not node.purpose.purpose and "default" in state.purposes)


def _instances(state: _Walk, node: _Node, label: str) -> Iterator[Placement]:
    """Everything a point instancer draws."""
    prim, path = node.prim, node.prim.GetPath()
    instancer = UsdGeom.PointInstancer(prim)
    if path in state.within:
        state.notices.append(Notice(str(path), "the instancer is among its own prototypes; it is not drawn there"))
        return
    numbers, prototypes, transforms = _placed_instances(state, instancer)
    varying = any(prim.GetAttribute(name).ValueMightBeTimeVarying() for name in _INSTANCER_ATTRIBUTES)
    static = node.static and not varying and not any(flies(prim.GetAttribute(name)) for name in FLIGHT)
    outer, state.within = state.within, (*state.within, path)
    world = np.array(node.world).T
    for place, target in enumerate(instancer.GetPrototypesRel().GetForwardedTargets()):
        chosen = np.flatnonzero(prototypes == place).astype(np.int32)
        parts = _prototype(state, node, target, static, drawn=len(chosen))
        for part in parts:
            yield _multiplied(part, prim, label, numbers[chosen], world, transforms, chosen)
    state.within = outer


def _multiplied(
    part: Placement, instancer: Usd.Prim, label: str, numbers: I32, world: F64, transforms: F64, chosen: I32
) -> Placement:
    """What one instance draws of a prim, for all of them: `chosen` rows of `transforms`, which have `numbers`."""
    places, each = len(chosen), len(part.worlds)
    worlds = np.empty((places, each, 3, 4))
    square = np.zeros((each, 4, 4))
    square[:, :3], square[:, 3, 3] = part.worlds, 1.0
    for start in range(0, places, _SOME):
        some = world @ transforms[chosen[start : start + _SOME]]
        worlds[start : start + _SOME] = (some[:, None] @ square)[:, :, :3]
    first, *rest = part.run.pieces
    inner = np.broadcast_to(part.run.numbers, (places, *part.run.numbers.shape))
    outer = np.broadcast_to(numbers[:, None, None], (places, each, 1))
    run = Run((f"{label}/[", f"]{first}", *rest), np.concatenate([outer, inner], axis=2).reshape(places * each, -1))
    instance = (instancer, numbers) if part.instance is None else (part.instance[0], np.tile(part.instance[1], places))
    return part._replace(run=run, worlds=worlds.reshape(-1, 3, 4), instance=instance)


def _prototype(state: _Walk, node: _Node, target: Sdf.Path, static: bool, *, drawn: int) -> list[Placement]:
    """What one instance of a prototype draws, relative to the prototype; `drawn` instances of it are wanted."""
    root = node.prim.GetStage().GetPrimAtPath(target)
    if not root:
        text = f"its prototype {target} does not exist; it draws nothing"
        state.notices.append(Notice(str(node.prim.GetPath()), text))
    if not root or not drawn:
        return []
    start = _Node(root, Gf.Matrix4d(1.0), node.purpose, static, *_modes_above(root))
    parts = list(_descend(state, start, _PROTOTYPES, len(str(target)) - len(target.name) - 1, placed=True))
    state.expanded += sum(len(part.worlds) for part in parts) * drawn
    if state.expanded > MAX_INSTANCES:
        raise StageError(
            f"{node.prim.GetPath()}: point instancers expand to {state.expanded} prims by here; at most "
            f"{MAX_INSTANCES} can be rendered. Deactivate some instances or merge the prototype's meshes"
        )
    return parts


def _modes_above(prim: Usd.Prim) -> tuple[str, str]:
    """Draw mode and card visibility that a prototype has from where it is, which may not be where it is drawn."""
    mode, cards = INHERITED, INHERITED
    for path in prim.GetPath().GetParentPath().GetPrefixes():
        above = prim.GetStage().GetPrimAtPath(path)
        mode, cards = handed_down(above, "drawMode", mode), handed_down(above, "cardVisibility", cards)
    return mode, cards


def _placed_instances(state: _Walk, instancer: UsdGeom.PointInstancer) -> tuple[I32, I32, F64]:
    """Number (N,), prototype (N,) and instancer_from_prototype (N, 4, 4) of every instance that is not masked out."""
    path = instancer.GetPath()
    nothing = np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 4, 4))
    prototypes = np.asarray(instancer.GetProtoIndicesAttr().Get(state.time) or [], np.int32)
    if not len(prototypes):
        state.notices.append(Notice(str(path), "the instancer has no protoIndices at this time; it draws nothing"))
        return nothing
    if len(prototypes) > MAX_INSTANCES:
        raise StageError(
            f"{path}: the instancer has {len(prototypes)} instances; at most {MAX_INSTANCES} can be rendered. "
            "Deactivate some of them"
        )
    numbers = np.arange(len(prototypes), dtype=np.int32)
    if mask := instancer.ComputeMaskAtTime(state.time):
        numbers = numbers[np.asarray(mask, bool)]
    rows = np.asarray(instancer.ComputeInstanceTransformsAtTime(state.time, state.time), np.float64)
    if len(rows) != len(numbers):
        positions = len(instancer.GetPositionsAttr().Get(state.time) or [])
        text = (
            f"the instancer has {len(prototypes)} protoIndices but {positions} positions, or orientations, scales, ids "
            "or prototypes that do not fit them; it draws nothing"
        )
        state.notices.append(Notice(str(path), text))
        return nothing
    return numbers, prototypes[numbers], rows.swapaxes(1, 2)
