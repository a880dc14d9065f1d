"""Rules about the values of our attributes, looked at one by one; nothing of the stage needs to be drawn for that."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from pxr import Sdf, Usd, UsdShade

from ...models import BY_TOKEN, LEAST_THICKNESS, Model
from .. import ours
from ..stage import stage_unit
from ..values import finite, listed, numbers
from .findings import ERROR, WARNING, Finding, Repair, Rule

_MAX_SAMPLES = 10_000
"""Time samples of one attribute that are looked at."""

IOR = Rule("refract.ior-below-one", ERROR, "An index of refraction is 1 or more.", safe=True)
TOKEN = Rule("refract.unknown-token", ERROR, "A token is one of those the schema allows (case is mended).", safe=True)
FINITE = Rule("refract.not-finite", ERROR, "Numbers are neither NaN nor infinite.", safe=True)
RANGE = Rule("refract.out-of-range", ERROR, "Numbers are inside the range the schema gives.", safe=True)
THIN = Rule("refract.thin-ignores-thickness", WARNING, "The thin model is 5 mm thick; nothing else is authored for it.")
FALLBACK = Rule(
    "refract.no-fallback-types", WARNING, "A stage with our prim types says what programs without them take.", safe=True
)

_SIZED = " or ".join(f"'{model.token}'" for model in Model if model.sized)
# Where the lowest value itself is out of the range; the schema's limits cannot say so.
_ABOVE_ZERO = frozenset(
    f"inputs:refraction:{name}" for name in ("thickness", "thicknessMultiplier", "absorptionDistance")
) | {"probe:clippingRange", "probe:fadeDistance", "probe:influence:size", "probe:influence:radius",
     "probe:proxy:size", "probe:proxy:radius"}  # fmt: skip


class _Field(NamedTuple):
    """What the schema says of one attribute."""

    name: str
    tokens: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    fallback: Any


def _fields() -> dict[str, tuple[_Field, ...]]:
    """Attributes with tokens or numbers, by API schema."""
    found = {}
    for api in ours.APPLIED:
        rows = []
        for spec in ours.attributes(api):
            name, value = spec.name, spec.default
            if name.startswith("collection:") or value is None or isinstance(value, (bool, Sdf.AssetPath)):
                continue
            hard = dict(spec.GetInfo("limits") or {}).get("hard", {})
            low, high = (numbers(hard[end]) if end in hard else () for end in ("minimum", "maximum"))
            tokens = tuple(map(str, spec.GetInfo("allowedTokens") or ()))
            rows.append(_Field(str(name), tokens, low or (), high or (), value))
        found[api] = tuple(rows)
    return found


def value_findings(stage: Usd.Stage) -> list[Finding]:
    """What is wrong with the values of our attributes, on all prims of a stage and at all their times."""
    fields, found = _fields(), []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if applied := ours.applied(prim):
            found += _of_prim(prim, [field for api in applied for field in fields[api]])
    return found


def values_of_prim(prim: Usd.Prim) -> list[Finding]:
    """The same for one prim."""
    fields = _fields()
    return _of_prim(prim, [field for api in ours.applied(prim) for field in fields[api]])


def _of_prim(prim: Usd.Prim, fields: Sequence[_Field]) -> list[Finding]:
    """At most one finding for each attribute, those that others connect to included, and the thin model's."""
    found: list[Finding] = []
    unit = stage_unit(prim.GetStage(), [])
    for field in fields:
        attribute = _source(prim.GetAttribute(field.name))
        if attribute is not None and attribute.HasAuthoredValue():
            found += _of_attribute(attribute, field, unit)
    attribute = prim.GetAttribute("refraction:model")
    model = BY_TOKEN.get(str(attribute.Get())) if attribute else None
    if model and model.fixed_thickness:
        found += _of_fixed(prim, model)
    return found


def _source(attribute: Usd.Attribute) -> Usd.Attribute | None:
    """The attribute that holds the value of another; None where a shading node makes it."""
    if not attribute or not UsdShade.Input.IsInput(attribute):
        return attribute or None
    makers = UsdShade.Input(attribute).GetValueProducingAttributes()
    maker = makers[0] if makers else attribute
    return None if UsdShade.Output.IsOutput(maker) else maker


def _samples(attribute: Usd.Attribute) -> list[tuple[float | None, Any]]:
    times = attribute.GetTimeSamples()
    if not times:
        return [(None, attribute.Get())]
    return [(time, attribute.Get(time)) for time in times[:_MAX_SAMPLES]]


def _of_attribute(attribute: Usd.Attribute, field: _Field, unit: float) -> Iterator[Finding]:
    """At most one finding: the worst of its values."""
    samples = _samples(attribute)
    judged = [_judge(value, field, unit) for _, value in samples]
    bad = [place for place, (rule, _) in enumerate(judged) if rule is not None]
    if not bad:
        return
    rule = judged[bad[0]][0]
    assert rule is not None
    time, value = samples[bad[0]]
    when = "" if time is None else f" at time {time:g}"
    mended = all(better is not None for _, better in judged)
    repairs: tuple[Repair, ...] = ()
    if mended and not attribute.GetPrim().IsInstanceProxy():
        values = tuple((t, better) for (t, _), (_, better) in zip(samples, judged, strict=True))
        repairs = (Repair(str(attribute.GetPrim().GetPath()), attribute.GetName(), values),)
    where = str(attribute.GetPrim().GetPath())
    name = attribute.GetName()
    text = f"{name} is {_shown(value)}{when}; it must be {_wanted(field)}"
    better = judged[bad[0]][1]
    fix = f"author {name} = {_shown(better)}" if better is not None else f"author {name} {_wanted(field)}"
    yield rule.broken(where, text, fix, name, repairs)


def _judge(value: Any, field: _Field, unit: float) -> tuple[Rule | None, Any]:
    """The rule that a value breaks, and the value to put in its place; the value itself where it is good."""
    if field.tokens:
        return _judge_tokens(value, field.tokens)
    found, wanted = numbers(value), numbers(field.fallback)
    if found is None or wanted is None:
        return None, value
    if len(found) != len(wanted):
        return RANGE, None
    if not finite(found):
        return FINITE, field.fallback
    above = field.name in _ABOVE_ZERO
    low = field.low or (-math.inf,) * len(found)
    high = field.high or (math.inf,) * len(found)
    under = [n <= least if above else n < least for n, least in zip(found, low, strict=True)]
    over = [n > most for n, most in zip(found, high, strict=True)]
    if not any(under) and not any(over):
        return None, value
    if field.name == "inputs:refraction:ior":
        return IOR, 1.0
    if above:
        return RANGE, LEAST_THICKNESS / unit if field.name == "inputs:refraction:thickness" else field.fallback
    inside = [min(max(n, a), b) for n, a, b in zip(found, low, high, strict=True)]
    return RANGE, type(field.fallback)(*inside) if len(inside) > 1 else type(field.fallback)(inside[0])


def _judge_tokens(value: Any, allowed: tuple[str, ...]) -> tuple[Rule | None, Any]:
    several = not isinstance(value, str)
    words = [str(word) for word in value] if several else [value]
    if all(word in allowed for word in words) and len(set(words)) == len(words) > 0:
        return None, value
    mended = [word.strip().lower() for word in words]
    if not all(word in allowed for word in mended) or len(set(mended)) != len(mended) or not mended:
        return TOKEN, None
    return TOKEN, mended if several else mended[0]


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return f"'{value}'"
    found = numbers(value)
    if found is None:
        return str(value) if not hasattr(value, "__len__") else ", ".join(map(str, value))
    return listed(found)


def _wanted(field: _Field) -> str:
    """The range of an attribute in words."""
    if field.tokens:
        single = isinstance(field.fallback, str)
        return f"{'one' if single else 'some'} of {', '.join(field.tokens)}{'' if single else ', each at most once'}"
    count = len(numbers(field.fallback) or ())
    many = "" if count == 1 else f"{count} values, each "
    if field.name in _ABOVE_ZERO:
        return f"{many}above 0"
    if field.low and field.high:
        return f"{many}{field.low[0]:g} to {field.high[0]:g}"
    return f"{many}{field.low[0]:g} or more" if field.low else f"{many}a finite number"


def _of_fixed(prim: Usd.Prim, model: Model) -> Iterator[Finding]:
    for name in ("inputs:refraction:thickness", "inputs:refraction:absorptionDistance"):
        attribute = prim.GetAttribute(name)
        if attribute and (attribute.HasAuthoredValue() or attribute.HasAuthoredConnections()):
            fixed = f"the {model.token} model fixes it at {model.fixed_thickness * 1000:g} mm"
            text = f"{name} is authored but does nothing: {fixed}"
            fix = f"block {name}, or set refraction:model to {_SIZED} where the thickness matters"
            yield THIN.broken(str(prim.GetPath()), text, fix, name)


def fallback_findings(stage: Usd.Stage) -> list[Finding]:
    """A stage with our prim types that does not say what other programs are to take them for."""
    root = stage.GetRootLayer().pseudoRoot
    known = root.GetInfo("fallbackPrimTypes") if root.HasInfo("fallbackPrimTypes") else {}
    everything = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    used = {str(name) for name in {prim.GetTypeName() for prim in everything} if name in ours.TYPED}
    if used <= set(known):
        return []
    text = "fallbackPrimTypes is not authored: where our schema is not installed, probes lose their transform"
    fix = "run refract validate STAGE --fix OUT, or call WriteFallbackPrimTypes of the stage"
    repair = Repair("/", "fallbackPrimTypes")
    path = stage.GetRootLayer().identifier
    return [FALLBACK.broken(path, text, fix, "fallbackPrimTypes", (repair,))]


def readable(stage: Usd.Stage, findings: Iterable[Finding]) -> Usd.Stage:
    """The stage with the schema's own word wherever an unknown token would keep it from being read. Writes nothing."""
    wrong = [finding for finding in findings if finding.rule == TOKEN.id]
    if not wrong:
        return stage
    session = Sdf.Layer.CreateAnonymous("known_tokens.usda")
    if stage.GetSessionLayer():
        session.subLayerPaths.append(stage.GetSessionLayer().identifier)
    other = Usd.Stage.Open(stage.GetRootLayer(), session, stage.GetPathResolverContext())
    other.SetPopulationMask(stage.GetPopulationMask())
    other = ours.recognised(other)
    other.SetEditTarget(session)
    for finding in wrong:
        prim = other.GetPrimAtPath(finding.path)
        value = ours.fallback(prim, finding.about)
        if value is not None and not prim.IsInstanceProxy():
            prim.GetAttribute(finding.about).Set(value)
    return other
