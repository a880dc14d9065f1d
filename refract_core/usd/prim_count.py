"""How many prims a stage would be composed of, told without composing it.

References, payloads, inherits, specializes, variants and instances multiply: 30 levels that each refer twice to the one
below are 2.7 kB of text and 2^30 prims, which USD takes minutes and gigabytes for, or never ends. The layers themselves
are small, so the count is a sum over their specs, each of which is looked at once:

    prims(site) = 1 + sum of prims(child) + sum of (prims(target) - 1) over its arcs

A site is a path in a layer stack. What a stage adds to a prim that is referenced (`over "wheel"`) is counted beside the
wheel, so the sum is never too low for the arcs it follows and, where many places speak of one prim, too high.
Of a variant set, the largest variant counts among those that some layer selects. Not followed: expressions in asset
paths, value clips, and classes inside of a referenced prim that the referencing layer adds to.
Source of the rules: OpenUSD's glossary, LIVRPS strength ordering.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from pxr import Sdf, Tf

from ..errors import StageError
from .diagnostics import captured, words_of
from .layers import mtlx

CEILING = 10**18
"""Numbers are cut here: 100,000 levels that double would have 30,000 digits."""
CIRCLES = 20_000
"""Ways through references that lead back to where they come from: they multiply as the orders of a set do, and nothing
is added up but by walking them. 20,000 take half a second; composing makes an error of each."""
_GROWTH = 64
"""Parts by which a path may become longer than all that are written in the layers, on its way through references."""
_ROOT = Sdf.Path.absoluteRootPath
_FILES = ("references", "payload")
_CLASSES = ("inheritPaths", "specializes")
_ARCS = frozenset((*_FILES, *_CLASSES))


class Count(NamedTuple):
    """What composing would make."""

    prims: int
    """Prims, instances expanded, and what point instancers draw."""
    opinions: int
    """Specs they are put together from: one prim may have many, and each costs what a prim costs."""
    more: bool = False
    """There are more; counting was stopped."""

    def __str__(self) -> str:
        """For messages: `over 20000 prims`."""
        return f"{'over ' if self.more or self.prims == CEILING else ''}{self.prims} prims"


class _Site(NamedTuple):
    """A prim, or a variant, in one layer stack."""

    stack: int
    path: Sdf.Path
    whole: bool = False
    """With what arcs of the prims above bring to it, for what is referred to from elsewhere."""

    @staticmethod
    def referred(stack: int, path: Sdf.Path) -> _Site:
        """As another prim refers to it."""
        return _Site(stack, path, whole=not path.IsRootPrimPath())


class _Term(NamedTuple):
    """A part of a sum: the largest of some sites."""

    sites: tuple[_Site, ...]
    same: bool
    """They are the prim itself once more, not others."""
    times: int = 0
    """How often a point instancer draws it; 0 for what is composed."""


@dataclass
class _Frame:
    """One site that is being counted."""

    site: _Site
    terms: list[_Term]
    leaves: int
    """Children that nothing is below of and that refer to nothing."""
    opinions: int
    waiting: list[_Site]
    values: dict[_Site, Count] = field(default_factory=dict)
    lowest: int = 1 << 60
    """Depth of the outermost unfinished site its value depends on."""


def count_prims(path: str | os.PathLike[str] | Sdf.Layer, *, stop: int = 5_000_000) -> Count:
    """Count what a stage would be composed of.

    Takes some 20 microseconds for each spec in the layers, whatever they multiply to. Arcs that lead back to where they
    come from are left out, as USD does; what lies between counts once for every way through, up to `CIRCLES`.

    Args:
        path: the root layer, or its file.
        stop: specs with something below them to look at before giving up with `Count.more`.

    Raises:
        StageError: the root layer cannot be read.
    """
    with captured():
        layer = _opened(path)
        layers = _Layers(layer)
        found = _Counting(layers, stop).count(_Site(0, _ROOT))
    return found._replace(prims=found.prims - (found.prims < CEILING))  # the root of all is no prim


def _opened(path: str | os.PathLike[str] | Sdf.Layer) -> Sdf.Layer:
    if isinstance(path, Sdf.Layer):
        return path
    name = os.fspath(path)
    try:
        layer = Sdf.Layer.FindOrOpen(name)
    except Tf.ErrorException as error:
        raise StageError(f"{name}: cannot be read as USD: {words_of(error.args[0])}") from error
    if layer is None:
        raise StageError(f"{name}: cannot be read as USD")
    return layer


class _Layers:
    """Every layer stack a stage is made of, by number; 0 is its own."""

    def __init__(self, root: Sdf.Layer) -> None:
        self.stacks: list[tuple[Sdf.Layer, ...]] = []
        self._number: dict[str, int] = {}
        self._found: dict[tuple[str, str], Sdf.Layer | None] = {}
        self.users: list[set[int]] = []
        """Stacks that refer to a stack, at any distance."""
        self._add(root)
        used: list[set[int]] = []
        for place, stack in enumerate(self.stacks):  # grows on the way
            used.append({
                number for layer in stack for name in layer.GetCompositionAssetDependencies()
                if (number := self.number_of(layer, str(name))) is not None and number != place
            })  # fmt: skip
        self.users = [set() for _ in self.stacks]
        for place in range(len(self.stacks)):
            waiting, seen = list(used[place]), {place}
            while waiting:
                other = waiting.pop()
                if other not in seen:
                    seen.add(other)
                    self.users[other].add(place)
                    waiting.extend(used[other])

    def number_of(self, anchor: Sdf.Layer, name: str) -> int | None:
        """The stack of a layer as another names it; None where there is none."""
        layer = self._layer(anchor, name)
        return None if layer is None else self._add(layer)

    def specs(self, site: _Site) -> list[Sdf.PrimSpec]:
        found = (layer.GetPrimAtPath(site.path) for layer in self.stacks[site.stack])
        return [spec for spec in found if spec]

    def _add(self, layer: Sdf.Layer) -> int:
        if layer.identifier not in self._number:
            self._number[layer.identifier] = len(self.stacks)
            self.stacks.append(tuple(self._with_sublayers(layer)))
        return self._number[layer.identifier]

    def _with_sublayers(self, root: Sdf.Layer) -> Iterator[Sdf.Layer]:
        waiting, seen = [root], {root.identifier}
        while waiting:
            layer = waiting.pop()
            yield layer
            for name in layer.subLayerPaths:
                below = self._layer(layer, str(name))
                if below is not None and below.identifier not in seen:
                    seen.add(below.identifier)
                    waiting.append(below)

    def _layer(self, anchor: Sdf.Layer, name: str) -> Sdf.Layer | None:
        key = (anchor.identifier, name)
        if key not in self._found:
            try:
                if mtlx.is_file(name):
                    self._found[key] = mtlx.layer_of(anchor, name)
                else:
                    self._found[key] = Sdf.Layer.FindOrOpenRelativeToLayer(anchor, name) if name else None
            except Tf.ErrorException:  # missing or damaged: USD composes what is left
                self._found[key] = None
        return self._found[key]

    @cached_property
    def selected(self) -> dict[str, set[str]]:
        """Variants that some spec of some layer selects, by the name of their set."""
        chosen: dict[str, set[str]] = {}
        for layer in {layer.identifier: layer for stack in self.stacks for layer in stack}.values():
            paths: list[Sdf.Path] = []
            layer.Traverse(_ROOT, paths.append)
            for path in paths:
                if not (path.IsPrimPath() or path.IsPrimVariantSelectionPath()):
                    continue
                spec = layer.GetPrimAtPath(path)
                if spec and spec.HasInfo("variantSelection"):
                    for name, variant in spec.variantSelections.items():
                        chosen.setdefault(str(name), set()).add(str(variant))
        return chosen


class _Counting:
    """The sum over all sites, depth first and without recursion: stages may be deep."""

    def __init__(self, layers: _Layers, stop: int) -> None:
        self.layers, self.stop = layers, stop
        self.known: dict[_Site, Count] = {}
        self.seen: set[_Site] = set()
        self.again = 0
        """Sites looked at once more, for what they count depends on how they are come by: they are in a circle."""
        self.longest = 0
        """Parts of the longest path that is written in the layers, as far as they have been looked at."""
        self.grows = False
        """Paths become longer and longer: references of several prims lead below one another."""

    def count(self, start: _Site) -> Count:
        frames = [self._begin(start)]
        active = {start: 0}
        while True:
            frame = frames[-1]
            if frame.waiting:
                site = frame.waiting.pop()
                if site in self.known:
                    frame.values[site] = self.known[site]
                elif site in active:  # a circle: USD leaves this arc out
                    frame.values[site] = Count(1, 0)
                    frame.lowest = min(frame.lowest, active[site])
                elif len(self.seen) >= self.stop or self.again >= CIRCLES or self.grows:
                    looked_at = len(self.seen) + self.again
                    return Count(looked_at, looked_at, more=True)
                else:
                    active[site] = len(frames)
                    frames.append(self._begin(site))
                continue
            found = _sum(frame)
            frames.pop()
            del active[frame.site]
            if frame.lowest >= len(frames):  # else it holds only here, inside of a circle
                self.known[frame.site] = found
            if not frames:
                return found
            frames[-1].values[frame.site] = found
            if frame.lowest < len(frames):
                frames[-1].lowest = min(frames[-1].lowest, frame.lowest)

    def _begin(self, site: _Site) -> _Frame:
        self.again += site in self.seen
        self.seen.add(site)
        if site.whole:
            terms, leaves, opinions = list(self._inherited(site)), 0, 0
        else:
            specs = self.layers.specs(site)
            self.longest = max(self.longest, site.path.pathElementCount if specs else 0)
            below, leaves, opinions = self._children(site, specs)
            terms, opinions = [*below, *self._arcs(site, specs), *_points(site, specs)], opinions + len(specs)
        return _Frame(site, terms, leaves, opinions, list({one for term in terms for one in term.sites}))

    def _children(self, site: _Site, specs: list[Sdf.PrimSpec]) -> tuple[list[_Term], int, int]:
        """Those to be counted; how many others there are, and how many specs these have."""
        above = [spec for spec in specs if spec.HasInfo("primChildren")]
        terms: list[_Term] = []
        leaves = opinions = 0
        for name in dict.fromkeys(name for spec in above for name in spec.GetInfo("primChildren")):
            child = _Site(site.stack, site.path.AppendChild(name))
            found = self.layers.specs(child)
            if all(_is_leaf(spec) for spec in found):
                leaves += 1
                opinions += len(found)
            else:
                terms.append(_Term((child,), same=False))
        return terms, leaves, opinions

    def _inherited(self, site: _Site) -> Iterator[_Term]:
        """The site itself, and what arcs above it bring to the same place."""
        yield _Term((_Site(site.stack, site.path),), same=True)
        above = site.path
        while not above.IsPrimVariantSelectionPath() and above.GetParentPath() != _ROOT and above != _ROOT:
            above = above.GetParentPath()
            here = _Site(site.stack, above)
            rest = _beyond(site.path, above)
            for term in self._arcs(here, self.layers.specs(here)):
                self.longest = max(self.longest, *(one.path.pathElementCount for one in term.sites))
                moved = tuple(_Site.referred(one.stack, _joined(one.path, rest)) for one in term.sites)
                self.grows |= max(one.path.pathElementCount for one in moved) > self.longest + _GROWTH
                yield _Term(moved, same=True)

    def _arcs(self, site: _Site, specs: list[Sdf.PrimSpec]) -> Iterator[_Term]:
        variants: dict[str, dict[str, None]] = {}
        once: set[Any] = set()
        for spec in specs:
            for name, choice in spec.variantSets.items() if spec.HasInfo("variantSetChildren") else ():
                variants.setdefault(str(name), {}).update(dict.fromkeys(map(str, choice.variants.keys())))
            keys = spec.ListInfoKeys()
            for key in _FILES:
                for item in _items(spec, key) if key in keys else ():
                    target = self._target(site, spec.layer, item)
                    if target is None or _leads_back(site, target):
                        continue
                    if (again := (target, item.layerOffset)) not in once:
                        once.add(again)
                        yield _Term((target,), same=True)
            for key in _CLASSES:
                for path in _items(spec, key) if key in keys else ():
                    for stack in (site.stack, *self.layers.users[site.stack]):
                        target = _Site.referred(stack, path)
                        if _leads_back(site, target):
                            continue
                        if target not in once and (stack == site.stack or self.layers.specs(target)):
                            once.add(target)
                            yield _Term((target,), same=True)
        for name, options in variants.items():
            chosen = self.layers.selected.get(name, set())
            anything = any("`" in word for word in chosen)  # an expression
            sites = tuple(_Site(site.stack, site.path.AppendVariantSelection(name, option)) for option in options
                          if anything or option in chosen)  # fmt: skip
            if sites:
                yield _Term(sites, same=True)

    def _target(self, site: _Site, layer: Sdf.Layer, item: Any) -> _Site | None:
        """What a reference or payload leads to."""
        stack = self.layers.number_of(layer, item.assetPath) if item.assetPath else site.stack
        if stack is None:
            return None
        path = item.primPath or self.layers.stacks[stack][0].GetDefaultPrimAsPath()
        return _Site.referred(stack, path) if path else None


def _leads_back(site: _Site, target: _Site) -> bool:
    """From a prim to one above or below it: USD makes an error of such an arc, and leaves it out."""
    here, there = site.path.StripAllVariantSelections(), target.path.StripAllVariantSelections()
    return site.stack == target.stack and (here.HasPrefix(there) or there.HasPrefix(here))


def _sum(frame: _Frame) -> Count:
    prims, opinions = 1 + frame.leaves, frame.opinions
    for term in frame.terms:
        values = [frame.values[site] for site in term.sites]
        most = max(value.prims for value in values)
        prims += most * term.times if term.times else most - term.same
        if not term.times:
            opinions += max(value.opinions for value in values)
    return Count(min(prims, CEILING), min(opinions, CEILING))


def _is_leaf(spec: Sdf.PrimSpec) -> bool:
    return (
        not spec.HasInfo("primChildren") and not spec.HasInfo("variantSetChildren")
        and _ARCS.isdisjoint(spec.ListInfoKeys()) and not _may_draw(spec)
    )  # fmt: skip


def _may_draw(spec: Sdf.PrimSpec) -> bool:
    """It may be a point instancer, for all that this spec says."""
    return spec.typeName in ("", "PointInstancer") and bool(_prototypes(spec))


def _prototypes(spec: Sdf.PrimSpec) -> list[Sdf.Path]:
    relationship = spec.layer.GetRelationshipAtPath(spec.path.AppendProperty("prototypes"))
    return list(relationship.targetPathList.GetAddedOrExplicitItems()) if relationship else []


def _items(spec: Sdf.PrimSpec, key: str) -> list[Any]:
    return list(spec.GetInfo(key).GetAddedOrExplicitItems())


def _points(site: _Site, specs: list[Sdf.PrimSpec]) -> Iterator[_Term]:
    """What a point instancer draws: its prototypes, as often as they are named at the busiest time."""
    specs = [spec for spec in specs if spec.typeName in ("", "PointInstancer")]
    targets = [path for spec in specs for path in _prototypes(spec)]
    if not targets:
        return
    drawn = np.zeros(len(targets), np.int64)
    for spec in specs:
        for numbers in _samples(spec.layer, spec.path.AppendProperty("protoIndices")):
            inside = numbers[(numbers >= 0) & (numbers < len(targets))]
            drawn = np.maximum(drawn, np.bincount(inside, minlength=len(targets)))
    for target, times in zip(targets, drawn.tolist(), strict=True):
        if times:
            yield _Term((_Site.referred(site.stack, target),), same=False, times=times)


def _samples(layer: Sdf.Layer, path: Sdf.Path) -> Iterator[Any]:
    """Values of an attribute of whole numbers, one at a time: shape (N,)."""
    spec = layer.GetAttributeAtPath(path)
    if not spec:
        return
    values: Iterable[Any] = (layer.QueryTimeSample(path, time) for time in layer.ListTimeSamplesForPath(path))
    for value in (spec.default, *values) if not layer.GetNumTimeSamplesForPath(path) else values:
        try:
            numbers = np.asarray(value)
        except (TypeError, ValueError):
            continue
        if numbers.ndim == 1 and np.issubdtype(numbers.dtype, np.integer):
            yield numbers


def _beyond(path: Sdf.Path, above: Sdf.Path) -> list[str]:
    """Names of the prims that lead from one site to one below it."""
    names: list[str] = []
    while path != above:
        names.append(path.name)
        path = path.GetParentPath()
    return names[::-1]


def _joined(path: Sdf.Path, names: list[str]) -> Sdf.Path:
    for name in names:
        path = path.AppendChild(name)
    return path
