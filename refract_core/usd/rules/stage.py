"""A whole stage against the rules: ours, what the reader had to say, and those that USD brings with it."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

from pxr import Tf, Usd, UsdGeom, UsdLux

from ...errors import StageError
from ...scene import Notice, Scene
from ..diagnostics import captured, words_of
from ..layers import mtlx
from ..stage import scene_from_stage
from .findings import ERROR, INFO, WARNING, Finding, Repair, Rule
from .glass import FLAT_SPHERE, INSIDE_OUT, NO_UV, OPEN, SIZE, TRACED_OPEN, UNITS, Glass, glass_findings, glass_of
from .names import ASTRAY, MISSPELT, STRANGE, name_findings
from .probes import INSIDE, MISSING, OUTSIDE, STALE, UNBAKED, SceneAt, probe_findings
from .values import FALLBACK, FINITE, IOR, RANGE, THIN, TOKEN, fallback_findings, readable, value_findings

UNREADABLE = Rule("refract.unreadable", ERROR, "The renderer can read the stage.")
READER = Rule("refract.reader", WARNING, "The renderer uses what is authored as it is authored.")

RULES = {
    rule.id: rule
    for rule in (
        IOR, TOKEN, FINITE, RANGE, THIN, MISSPELT, STRANGE, ASTRAY, FALLBACK, OPEN, FLAT_SPHERE, TRACED_OPEN,
        SIZE, UNITS, INSIDE_OUT, NO_UV, MISSING, UNBAKED, STALE, OUTSIDE, INSIDE, READER, UNREADABLE,
    )
}  # fmt: skip

PLUGIN = "refract_core.usd.rules.plugin"
"""The module of our validators, by which USD knows them."""


def stage_findings(stage: Usd.Stage) -> list[Finding]:
    """Everything our rules find on a stage, at its first time code. The stage is not changed."""
    return [*value_findings(stage), *scene_findings(stage)]


def scene_findings(stage: Usd.Stage) -> list[Finding]:
    """What is found once the stage is read as a renderer does; see `value_findings` for what needs no reading."""
    values, found = value_findings(stage), [*name_findings(stage), *fallback_findings(stage)]
    other = readable(stage, values)
    # An asset stands in other stages, which have the camera and the light.
    asset = not any(prim.IsA(UsdGeom.Camera) or prim.HasAPI(UsdLux.LightAPI) for prim in other.Traverse())
    try:
        scene = scene_from_stage(other, orbits=asset)
    except StageError as error:
        return [*found, UNREADABLE.broken(stage.GetRootLayer().identifier, str(error))]
    glass = glass_of(scene)
    found += glass_found(stage, scene, glass, values)
    found += probe_findings(other, scene, glass, scenes_of(other, scene))
    return [*found, *reader_findings(scene.notices, [*values, *found])]


def glass_found(stage: Usd.Stage, scene: Scene, glass: list[Glass], values: list[Finding]) -> list[Finding]:
    """What is wrong with the glass of a stage, with repairs where they are safe.

    Args:
        values: what `value_findings` found; a thickness that is wrong in itself tells nothing about the size.
    """
    unsure = {finding.path for finding in values if finding.about == "inputs:refraction:thickness"}
    return [_with_repair(finding, stage) for finding in glass_findings(scene, glass, unsure)]


def scenes_of(stage: Usd.Stage, scene: Scene) -> SceneAt:
    """Scenes of a stage at other times, each read once."""

    @lru_cache(maxsize=4)
    def at(time_code: float) -> Scene:
        return scene if time_code == scene.time_code else scene_from_stage(stage, time_code=time_code)

    return at


def reader_findings(notices: Iterable[Notice], known: list[Finding]) -> list[Finding]:
    """What the reader noticed and no other rule has told already."""
    told: dict[str, list[str]] = {}
    for finding in known:
        told.setdefault(finding.path, []).append(finding.about)
    return [
        READER.broken(notice.path, notice.text)
        for notice in notices
        if not any(about and about in notice.text for about in told.get(notice.path, []))
    ]


def _with_repair(finding: Finding, stage: Usd.Stage) -> Finding:
    """With the repair that needs the prim: the other orientation."""
    prim = stage.GetPrimAtPath(finding.path) if "[" not in finding.path else None
    if finding.rule != INSIDE_OUT.id or not prim or prim.IsInstanceProxy() or not prim.IsA(UsdGeom.Mesh):
        return finding
    left, right = UsdGeom.Tokens.leftHanded, UsdGeom.Tokens.rightHanded
    other = right if UsdGeom.Mesh(prim).GetOrientationAttr().Get() == left else left
    return finding._replace(repairs=(Repair(finding.path, "orientation", ((None, other),)),))


def stock_findings(stage: Usd.Stage) -> list[Finding]:
    """What the validators say that come with USD, and any other that is installed."""
    from pxr import UsdValidation

    registry = UsdValidation.ValidationRegistry()
    names = [
        data.name
        for data in registry.GetAllValidatorMetadata()
        if not data.isSuite and not data.name.startswith(f"{PLUGIN}:")
    ]
    context = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(sorted(names)))
    kinds = UsdValidation.ValidationErrorType
    severities = {kinds.Error: ERROR, kinds.Warn: WARNING}
    with captured():  # what they warn of, they also return
        try:
            errors = context.Validate(stage)
        except Tf.ErrorException as error:  # damaged values, which none of them expects
            said = " ".join(dict.fromkeys(words_of(part) for part in error.args))
            return [UNREADABLE.broken("/", f"USD's own validators gave up: {said}")]
    return [
        Finding(
            str(error.GetIdentifier()),
            severities.get(error.GetType(), INFO),
            _site(error, stage),
            " ".join(str(error.GetMessage()).split()),
            "",
        )
        for error in errors
        if not _is_materialx(error)
    ]


def _is_materialx(error: object) -> bool:
    """About a MaterialX node that is not in the registry, for usd-core brings no definitions of them; or about a file
    that is read by us, for it has no reader of them either."""
    name, text = str(error.GetName()), str(error.GetMessage())  # type: ignore[attr-defined]
    return (name == "MissingShaderIdInRegistry" and "'ND_" in text) or mtlx.stands_in(text)


def _site(error: object, stage: Usd.Stage) -> str:
    """The first prim, property or layer an error is about."""
    for site in error.GetSites():  # type: ignore[attr-defined]
        if site.IsProperty():
            return str(site.GetProperty().GetPath())
        if site.IsPrim():
            return str(site.GetPrim().GetPath())
        if site.GetLayer():
            return str(site.GetLayer().identifier)
    return str(stage.GetRootLayer().identifier)
