"""Rules about the names of attributes in our namespaces: what is misspelt, or stands where nobody reads it, is in vain.

USD takes any name for an attribute, so `inputs:refraction:thicknes` is no error to it; and a renderer that knows no
such name draws the glass with its default.
"""

from __future__ import annotations

from collections.abc import Iterator
from difflib import SequenceMatcher
from functools import cache
from typing import NamedTuple

from pxr import Sdf, Usd, UsdRender, UsdShade

from .. import ours
from .findings import ERROR, WARNING, Finding, Rule

MISSPELT = Rule("refract.misspelt-name", ERROR, "An attribute is called as the schema calls it.")
STRANGE = Rule("refract.unknown-name", WARNING, "Names of our namespaces are those of the schema.")
ASTRAY = Rule("refract.misplaced-name", WARNING, "Our attributes stand on a prim that has the schema they are of.")

_NAMESPACES = ("refraction:", "inputs:refraction:", "outputs:refraction:", "probe:", "refract:")
_PRIMVARS = ("primvars:refraction:thickness", "primvars:refract:static")
"""What is read of prims that have none of our schemas."""
_ALIKE = 0.7
"""Share of letters in common from which on one name is taken for another."""


class _Known(NamedTuple):
    """A name that means something."""

    name: str
    owner: str
    """API schema that it is of; '' for primvars, which stand on anything"""


def name_findings(stage: Usd.Stage) -> list[Finding]:
    """What is wrong with the names in our namespaces, on all prims of a stage; a prototype's are told of once."""
    found: list[Finding] = []
    told: set[Sdf.Path] = set()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if prim.IsInstanceProxy():
            path = prim.GetPrimInPrototype().GetPath()
            if path in told:
                continue
            told.add(path)
        found += names_of_prim(prim)
    return found


def names_of_prim(prim: Usd.Prim) -> Iterator[Finding]:
    """What is wrong with the names of a prim's authored attributes and relationships."""
    for name in map(str, prim.GetAuthoredPropertyNames()):
        if name.startswith(_NAMESPACES):
            yield from _judged(prim, name)
        elif name.startswith("primvars:refract") and name not in _PRIMVARS and not name.endswith(":indices"):
            near = _nearest(name)  # primvars are anybody's to name: only what was meant to be ours is told
            if near is not None and near.name in _PRIMVARS:
                yield _misspelt(prim, name, near)


def _judged(prim: Usd.Prim, name: str) -> Iterator[Finding]:
    """One authored property in a namespace of ours."""
    exact = _by_name().get(name)
    if exact is None:
        near = _nearest(name)
        if near is not None:
            yield _misspelt(prim, name, near)
            return
        text = f"{name} is no attribute of ours, so it does nothing; the schemas have {_listed(name)}"
        yield STRANGE.broken(str(prim.GetPath()), text, f"rename {name}, or remove it", name)
    elif exact.owner not in ours.applied(prim) and not (name.startswith("refract:") and prim.IsA(UsdRender.Settings)):
        yield _astray(prim, name, exact.owner)


def _misspelt(prim: Usd.Prim, name: str, near: _Known) -> Finding:
    text = f"{name} is no attribute of ours, so it does nothing; did you mean {near.name}?"
    return MISSPELT.broken(str(prim.GetPath()), text, f"rename {name} to {near.name}", name)


def _astray(prim: Usd.Prim, name: str, owner: str) -> Finding:
    """A name that is right, on a prim where nobody reads it."""
    path = str(prim.GetPath())
    if owner == "RefractMaterialAPI" and not prim.IsA(UsdShade.Material):
        kind = prim.GetTypeName() or "prim without type"
        fix = f"author {name} on the Material, with RefractMaterialAPI applied"
        return ASTRAY.broken(path, f"{name} does nothing on a {kind}: only materials are asked for it", fix, name)
    text = f"{name} does nothing here: {owner} is not applied to the prim"
    return ASTRAY.broken(path, text, f"apply {owner}, or remove {name}", name)


@cache
def _by_name() -> dict[str, _Known]:
    """Every attribute and relationship of our schemas, and the primvars we read."""
    found = {name: _Known(name, "") for name in _PRIMVARS}
    for owner in ours.APPLIED:
        for name in ours.properties(owner):
            if name.startswith(_NAMESPACES):
                found[name] = _Known(name, owner)
    return found


def _last(name: str) -> str:
    """What of a name tells attributes apart, in small letters: all but the namespace that they share."""
    for space in ("primvars:refraction:", "primvars:refract:", "inputs:refraction:", "outputs:refraction:",
                  "refraction:", "refract:", "probe:"):  # fmt: skip
        if name.startswith(space):
            return name.removeprefix(space).lower()
    return name.lower()


def _nearest(name: str) -> _Known | None:
    """The known name of the same family that is most like one, if any is."""
    last, family = _last(name), _family(name)
    scored = [(_likeness(last, _last(known.name)), known) for known in _by_name().values()
              if _family(known.name) == family]  # fmt: skip
    best, known = max(scored, key=lambda pair: (pair[0], pair[1].name.startswith("inputs:")), default=(0.0, None))
    return known if best >= _ALIKE else None


def _family(name: str) -> str:
    """`refraction` with and without `inputs:` are one: which of them it is, is what people mistake."""
    words = name.split(":")
    kind = words[1] if words[0] in ("inputs", "outputs", "primvars") else words[0]
    return f"primvars:{kind}" if words[0] == "primvars" else kind


def _likeness(one: str, other: str) -> float:
    """0 to 1. The beginning of a long name, or its last word, is as good as most of it."""
    if one == other:
        return 1.0
    part = len(one) >= 4 and (other.startswith(one) or other.split(":")[-1] == one)
    return max(SequenceMatcher(None, one, other).ratio(), 0.9 if part else 0.0)


def _listed(name: str) -> str:
    """What the family has, as a sentence lists it."""
    names = sorted(known.name for known in _by_name().values() if _family(known.name) == _family(name))
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
