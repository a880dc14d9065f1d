"""Other values in single materials of a scene: what if this ball were water?"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any

from ..errors import UsageError
from ..models import BY_TOKEN, MODELS, Model
from ..scene import Material, Param, Scene, Source

Overrides = Mapping[str, Mapping[str, Any]]
"""Path of a material, or of a mesh or sphere bound to it -> field -> value. Lengths in scene units."""

RANGES = {
    "ior": (1.0, 10.0), "thickness": (0.0, 1e9), "roughness": (0.0, 1.0), "transmittanceColor": (0.0, 1.0),
    "absorptionDistance": (0.0, 1e9), "abbeNumber": (0.0, 1000.0),
}  # fmt: skip
"""Valid numbers, both ends included, but a length is never 0. Lengths in scene units."""
LENGTHS = ("thickness", "absorptionDistance")
COLORS = ("transmittanceColor",)
FIELDS = ("model", *RANGES)
_PARAMS = {"ior": Param.IOR, "roughness": Param.ROUGHNESS, "transmittanceColor": Param.TRANSMITTANCE,
           "thickness": Param.THICKNESS}  # fmt: skip


class OverrideError(UsageError):
    """An override cannot be done. The text begins with its path."""

    def __init__(self, text: str, path: str, field: str = "") -> None:
        super().__init__(text, path, field)
        self.text, self.path, self.field = text, path, field

    def __str__(self) -> str:
        return self.text


def override(scene: Scene, overrides: Overrides, *, strict: bool = True) -> Scene:
    """Put other values into some materials; everything bound to them changes.

    A value is a constant: it replaces a texture or primvar too. Where two paths reach one material, the later one in
    the alphabet wins; the order they are given in has no meaning.

    Args:
        overrides: fields are `model`, `ior`, `thickness`, `roughness`, `transmittanceColor`, `absorptionDistance` and
            `abbeNumber` (0 is no dispersion); a value of None is passed over.
        strict: False passes over paths that name nothing, as for things that are hidden at the scene's time.

    Raises:
        OverrideError: a path names nothing that is drawn, a field is not known, or a value is out of its range.
    """
    check_overrides(overrides)
    materials = list(scene.materials)
    for path in sorted(overrides):
        rows = _rows(scene, path)
        if strict and not rows:
            raise OverrideError(f"{path} names no material and no shape that is drawn{_close(scene, path)}", path)
        for row in rows:
            materials[row] = _overridden(materials[row], overrides[path], scene.metres_per_unit)
    return replace(scene, materials=tuple(materials)) if overrides else scene


def check_overrides(overrides: Overrides) -> None:
    """Check fields and values, for which no scene is needed.

    Raises:
        OverrideError: a field is not known, or a value is out of its range.
    """
    for path, changes in overrides.items():
        for field, value in changes.items():
            if field not in FIELDS:
                raise OverrideError(f"{path}.{field} is not known; choose from {', '.join(FIELDS)}", path, field)
            if value is not None and not _is_valid(field, value):
                raise OverrideError(f"{path}.{field} is {_shown(value)}; it must be {_range_of(field)}", path, field)


def override_notes(overrides: Overrides) -> dict[str, str | float]:
    """Overrides as metadata of a picture, in the words of `refract render --override`; nothing where there are none."""
    words = [
        f"{path}.{field}={_shown(overrides[path][field])}"
        for path in sorted(overrides)
        for field in FIELDS
        if overrides[path].get(field) is not None
    ]
    return {"refract:overrides": " ".join(words)} if words else {}


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, Sequence):
        return ",".join(_shown(one) for one in value)
    return str(float(value)) if _is_number(value) else str(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_valid(field: str, value: Any) -> bool:
    if field == "model":
        return value in MODELS
    low, high = RANGES[field]
    if field in COLORS:
        three = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 3
        return three and all(_is_number(one) and low <= one <= high for one in value)
    return _is_number(value) and math.isfinite(value) and low <= value <= high and (value > 0 or field not in LENGTHS)


def _range_of(field: str) -> str:
    if field == "model":
        return f"one of {', '.join(MODELS)}"
    low, high = RANGES[field]
    if field in COLORS:
        return f"three numbers from {low:g} to {high:g}: red, green, blue"
    return f"a length in scene units, above 0 and at most {high:g}" if field in LENGTHS else (
        f"a number from {low:g} to {high:g}")  # fmt: skip


def _rows(scene: Scene, path: str) -> list[int]:
    """Rows of the material table that a path means. One material of the stage may have several."""
    rows = {int(row) for mesh in scene.meshes if mesh.path == path for row in set(mesh.materials.tolist())}
    found = (many.mesh for many in scene.instances if path in many.paths)
    rows |= {int(row) for mesh in found for row in set(mesh.materials.tolist())}
    rows |= {balls.material for balls in scene.balls if path in balls.paths}
    rows |= {sphere.material for sphere in scene.spheres if sphere.path == path}
    names = {scene.materials[row].name for row in rows} or {path}
    return [row for row, material in enumerate(scene.materials) if material.name in names]


def _close(scene: Scene, path: str) -> str:
    things: Iterable[Any] = (*scene.meshes, *scene.spheres, *(many.mesh for many in scene.instances))
    known = {material.name for material in scene.materials} | {thing.path for thing in things}
    found = difflib.get_close_matches(path, sorted(known), 3, cutoff=0.8)
    return f"; did you mean {' or '.join(found)}?" if found else "; `refract inspect` lists the glass of a stage"


def _overridden(material: Material, changes: Mapping[str, Any], unit: float) -> Material:
    """A material with other values. `unit`: metres per scene unit."""
    inputs = list(material.inputs)
    given = {field: value for field, value in changes.items() if value is not None}
    for field, param in _PARAMS.items():
        if field in COLORS and field in given:
            red, green, blue = map(float, given[field])
            inputs[param] = Source(value=(red, green, blue, 1.0))
        elif field in given:
            inputs[param] = _scalar(given[field] * (unit if field in LENGTHS else 1.0))
    distance = given["absorptionDistance"] * unit if "absorptionDistance" in given else material.absorption_distance
    model = BY_TOKEN[given["model"]] if "model" in given else material.model
    if model is not Model.NONE and not material.refractive:
        inputs[Param.OPACITY] = _scalar(0.0)  # it had no opacity of glass to begin with
    if model.fixed_thickness:
        inputs[Param.THICKNESS] = _scalar(model.fixed_thickness)
        distance = model.fixed_thickness
    abbe = float(given.get("abbeNumber", material.abbe))
    return replace(material, inputs=tuple(inputs), model=model, absorption_distance=distance, abbe=abbe)


def _scalar(value: float) -> Source:
    return Source(value=(float(value),) * 4)
