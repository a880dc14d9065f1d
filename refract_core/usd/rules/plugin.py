"""Our rules as UsdValidation validators. USD loads this module when it is asked for one of them.

It is named by schemas/validators/plugInfo.json, which lies apart from the schemas on purpose. A program that knows that
file but cannot import this package loses *all* its validators, for USD then refuses to load any; and two plugins
under one root make USD lose the schemas. So programs that have the package name the folder in PXR_PLUGINPATH_NAME:

    PXR_PLUGINPATH_NAME=.../schemas:.../schemas/validators

and Python that runs `refract_core.usd.rules.plugin.register()` needs no variable. Python validators exist in USD from
26.05 on; the command `refract validate` calls the rules themselves and needs none of this.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from pxr import Plug, Sdf, Usd

from ..registering import FOLDER
from .findings import ERROR, WARNING, Finding
from .stage import PLUGIN, scene_findings
from .values import values_of_prim

VALUES, SCENE = f"{PLUGIN}:Values", f"{PLUGIN}:Scene"


def register() -> None:
    """Make the validators known to USD. May be called any number of times."""
    from pxr import UsdValidation

    folder = FOLDER / "validators"
    Plug.Registry().RegisterPlugins(str(folder))
    registry = UsdValidation.ValidationRegistry()
    if not hasattr(registry, "RegisterPluginPrimValidator") or registry.HasValidator(VALUES):
        return
    if registry.GetValidatorMetadata(VALUES):
        registry.RegisterPluginPrimValidator(VALUES, _values)
        registry.RegisterPluginStageValidator(SCENE, _scene)
        return
    # USD reads the plugins' validators once, and that was before: these are then nobody's.
    (plugin,) = json.loads((folder / "plugInfo.json").read_text("utf-8"))["Plugins"]
    said = plugin["Info"]["Validators"]
    for name, add, check in (
        (VALUES, registry.RegisterPrimValidator, _values), (SCENE, registry.RegisterStageValidator, _scene)
    ):  # fmt: skip
        about = said[name.rpartition(":")[2]]
        add(
            UsdValidation.ValidatorMetadata(
                name=name, doc=about["doc"], keywords=said["keywords"], schemaTypes=about.get("schemaTypes", [])
            ),
            check,
        )


def _values(prim: Usd.Prim, _times: object) -> list[Any]:
    return _errors(prim.GetStage(), values_of_prim(prim))


def _scene(stage: Usd.Stage, _times: object) -> list[Any]:
    return _errors(stage, scene_findings(stage))


def _errors(stage: Usd.Stage, findings: Iterable[Finding]) -> list[Any]:
    """Findings as USD's own records; the rule's id without our name is the name of the error."""
    from pxr import UsdValidation

    kinds = UsdValidation.ValidationErrorType
    types = {ERROR: kinds.Error, WARNING: kinds.Warn}
    made = []
    for finding in findings:
        path = finding.path if Sdf.Path.IsValidPathString(finding.path) else "/"
        at = path if path.startswith("/") and stage.GetPrimAtPath(path) else "/"
        text = f"{finding.text}. {finding.fix}" if finding.fix else finding.text
        site = UsdValidation.ValidationErrorSite(stage, Sdf.Path(at))
        name = finding.rule.removeprefix("refract.")
        made.append(UsdValidation.ValidationError(name, types.get(finding.severity, kinds.Info), [site], text))
    return made


register()
