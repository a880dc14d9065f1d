"""Rules that a stage should keep, and what is found against them: the values of our attributes, looked at one by one.

A rule is *safe* to fix where the value as it is cannot have been meant: what is written over it is what the renderer
uses in its place, or the one word or orientation that was meant. Nothing is guessed, and no opinion is removed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from pxr import Sdf, Usd, UsdShade

from ...models import BY_TOKEN, LEAST_THICKNESS, Model
from .. import ours
from ..stage import stage_unit

ERROR, WARNING, INFO = "error", "warning", "info"
_MAX_SAMPLES = 10_000
"""Time samples of one attribute that are looked at."""


class Rule(NamedTuple):
    """What a stage should keep."""

    id: str
    severity: str
    says: str
    """The rule in one sentence."""
    safe: bool = False
    """`--fix` repairs it."""


class Repair(NamedTuple):
    """One attribute with other values; the path `/` and the name of a field stand for metadata of the stage."""

    path: str
    name: str
    values: tuple[tuple[float | None, Any], ...] = ()
    """By time code; None is the default value."""


class Finding(NamedTuple):
    """A place where a rule is broken."""

    rule: str
    severity: str
    path: str
    """Prim path, or the stage's file."""
    text: str
    """One sentence: what is wrong, and the range it should be in."""
    fix: str
    """What to do: a command, or what to author."""
    about: str = ""
    """The attribute; '' where it is the prim as a whole."""
    repairs: tuple[Repair, ...] = ()
    """Empty where it is not safe to repair without a person."""


IOR = Rule("refract.ior-below-one", ERROR, "An index of refraction is 1 or more.", safe=True)
TOKEN = Rule("refract.unknown-token", ERROR, "A token is one of those the schema allows (case is mended).", safe=True)
FINITE = Rule("refract.not-finite", ERROR, "Numbers are neither NaN nor infinite.", safe=True)
RANGE = Rule("refract.out-of-range", ERROR, "Numbers are inside the range the schema gives.", safe=True)
THIN = Rule("refract.thin-ignores-thickness", WARNING, "The thin model is 5 mm thick; nothing else is authored for it.")
FALLBACK = Rule(
    "refract.no-fallback-types", WARNING, "A stage with our prim types says what programs without them take.", safe=True
)

_ALLOWED = "allowedTokens"
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
            low, high = (_numbers(hard[end]) if end in hard else () for end in ("minimum", "maximum"))
            tokens = tuple(map(str, spec.GetInfo(_ALLOWED) or ()))
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
    text = f"{name} is {_shown(value)}{when}; {_range(field)}"
    better = judged[bad[0]][1]
    fix = f"author {name} = {_shown(better)}" if better is not None else f"author {name} {_wanted(field)}"
    yield Finding(rule.id, rule.severity, where, text, fix, name, repairs)


def _judge(value: Any, field: _Field, unit: float) -> tuple[Rule | None, Any]:
    """The rule that a value breaks, and the value to put in its place; the value itself where it is good."""
    if field.tokens:
        return _judge_tokens(value, field.tokens)
    numbers, wanted = _numbers(value), _numbers(field.fallback)
    if numbers is None or wanted is None:
        return None, value
    if len(numbers) != len(wanted):
        return RANGE, None
    if not all(map(math.isfinite, numbers)):
        return FINITE, field.fallback
    above = field.name in _ABOVE_ZERO
    low = field.low or (-math.inf,) * len(numbers)
    high = field.high or (math.inf,) * len(numbers)
    under = [n <= least if above else n < least for n, least in zip(numbers, low, strict=True)]
    over = [n > most for n, most in zip(numbers, high, strict=True)]
    if not any(under) and not any(over):
        return None, value
    if field.name == "inputs:refraction:ior":
        return IOR, 1.0
    if above:
        return RANGE, LEAST_THICKNESS / unit if field.name == "inputs:refraction:thickness" else field.fallback
    inside = [min(max(n, a), b) for n, a, b in zip(numbers, low, high, strict=True)]
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


def _numbers(value: Any) -> tuple[float, ...] | None:
    if isinstance(value, str):
        return None
    try:
        return tuple(float(part) for part in value) if hasattr(value, "__len__") else (float(value),)
    except (TypeError, ValueError):
        return None


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return f"'{value}'"
    numbers = _numbers(value)
    if numbers is None:
        return str(value) if not hasattr(value, "__len__") else ", ".join(map(str, value))
    listed = ", ".join(f"{number:g}" for number in numbers)
    return listed if len(numbers) == 1 else f"({listed})"


def _range(field: _Field) -> str:
    return f"it must be {_wanted(field)}"


def _wanted(field: _Field) -> str:
    if field.tokens:
        single = isinstance(field.fallback, str)
        return f"{'one' if single else 'some'} of {', '.join(field.tokens)}{'' if single else ', each at most once'}"
    count = len(_numbers(field.fallback) or ())
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
            yield Finding(THIN.id, THIN.severity, str(prim.GetPath()), text, fix, name)


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
    return [Finding(FALLBACK.id, FALLBACK.severity, path, text, fix, "fallbackPrimTypes", (repair,))]


def readable(stage: Usd.Stage, findings: Iterable[Finding]) -> Usd.Stage:
    """The stage with the schema's own word wherever an unknown token would keep it from being read. Writes nothing."""
    wrong = [finding for finding in findings if finding.rule == TOKEN.id]
    if not wrong:
        return stage
    session = Sdf.Layer.CreateAnonymous("known_tokens.usda")
    if stage.GetSessionLayer():
        session.subLayerPaths.append(stage.GetSessionLayer().identifier)
    other = ours.recognised(Usd.Stage.Open(stage.GetRootLayer(), session, stage.GetPathResolverContext()))
    other.SetEditTarget(session)
    for finding in wrong:
        prim = other.GetPrimAtPath(finding.path)
        value = ours.fallback(prim, finding.about)
        if value is not None and not prim.IsInstanceProxy():
            prim.GetAttribute(finding.about).Set(value)
    return other


def apply_repairs(layer: Sdf.Layer, repairs: Iterable[Repair]) -> None:
    """Write repairs into a layer that lies over the stage they were found on."""
    stage = Usd.Stage.Open(layer)
    stage.SetEditTarget(layer)
    for repair in repairs:
        if repair.path == "/":
            ours.write_fallback_types(stage)
            continue
        attribute = stage.GetPrimAtPath(repair.path).GetAttribute(repair.name)
        for time, value in repair.values:
            attribute.Set(value, Usd.TimeCode.Default() if time is None else Usd.TimeCode(time))
