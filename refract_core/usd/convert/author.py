"""RefractMaterialAPI written on materials, in a layer over their stage or in a flat copy of it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from pxr import Gf, Sdf, Usd, UsdGeom

from ...scene import Notice
from ...settings import AS_IT_IS, Opening
from ..diagnostics import captured
from ..layers.assets import outer_of
from ..layers.write import RECORD, apply_api, overlay
from ..materials.read import API
from ..ours import recognised
from ..stage import open_stage, stage_unit, time_range
from .networks import Mapped, author

MADE = "convert"
"""What `write` records of who made a layer."""


class Work(NamedTuple):
    """A stage to look at, and the layer to write what is added to it."""

    stage: Usd.Stage
    layer: Sdf.Layer
    time: Usd.TimeCode
    unit: float
    """Metres per scene unit."""
    notices: tuple[Notice, ...]
    """What is missing from the stage, or was lost when it was made flat."""
    opening: Opening = AS_IT_IS
    """How to open the stage whose root the layer is, to see what was looked at; a flat layer holds that already."""


class Written(NamedTuple):
    """A file that is no USD, what it does not say, and what belongs beside it."""

    content: bytes
    notices: tuple[Notice, ...]
    notes: dict[str, tuple[str, ...]]
    """By material"""
    pictures: Mapping[str, bytes] = MappingProxyType({})
    """By path: what lay in a package, and is a file now"""


class Addition(NamedTuple):
    """What is added to one prim."""

    path: str
    applies: bool
    """RefractMaterialAPI is applied."""
    values: dict[str, Any]
    """Attribute -> value: a token, a float or a colour, by the type that the schema gives it."""
    connections: dict[str, str]
    """Attribute -> path of the output that drives it."""
    maps: Mapping[str, Mapped] = MappingProxyType({})
    """Attribute -> what drives it, where no output of the stage can be connected to: nodes are written for it."""
    space: str = ""
    """Colour space of the colours, where the stage gives the prim another one; '' where it gives it none."""


def begin(path: str, *, flatten: bool, opening: Opening = AS_IT_IS) -> Work:
    """Open a stage for conversion.

    Args:
        flatten: everything is composed into one layer, where instances can be reached too; else a layer on top.
        opening: session layer, variants and mask. A flat layer holds what they make of the stage, one on top does not.

    Raises:
        StageError: the stage cannot be opened.
    """
    stage = open_stage(path, opening)
    notices = []
    if errors := stage.GetCompositionErrors():
        text = f"{len(errors)} parts of the stage cannot be composed, such as: {' '.join(str(errors[0]).split())}"
        notices.append(Notice(path, text))
    if flatten:
        layer, lost = _flat(stage)
        notices += [Notice(path, f"USD says: {text}") for text in lost]
        stage = recognised(Usd.Stage.Open(layer))
    else:
        layer = overlay(path, made=MADE)
    layer.customLayerData = {**layer.customLayerData, RECORD: origin(path)}
    time, unit = Usd.TimeCode(time_range(stage)[0]), stage_unit(stage, notices)
    return Work(stage, layer, time, unit, tuple(notices), AS_IT_IS if flatten else opening)


def origin(path: str) -> dict[str, str]:
    """What a converted layer tells of where it comes from: no folder, as it may travel far from its stage."""
    outer = outer_of(path)
    return {"made": MADE, "stage": os.path.basename(outer) + path[len(outer) :]}


def _flat(stage: Usd.Stage) -> tuple[Sdf.Layer, list[str]]:
    """One layer with everything, and what USD says about that."""
    with captured() as said:
        layer = stage.Flatten(addSourceFileComment=False)  # it would name folders of this machine
    return layer, list(dict.fromkeys(said))


_TYPES = {
    "refraction:model": Sdf.ValueTypeNames.Token,
    "inputs:refraction:ior": Sdf.ValueTypeNames.Float,
    "inputs:refraction:thickness": Sdf.ValueTypeNames.Float,
    "inputs:refraction:transmittanceColor": Sdf.ValueTypeNames.Color3f,
    "inputs:refraction:absorptionDistance": Sdf.ValueTypeNames.Float,
    "inputs:refraction:abbeNumber": Sdf.ValueTypeNames.Float,
    "primvars:refraction:thickness": Sdf.ValueTypeNames.Float,
}


def add(layer: Sdf.Layer, additions: Iterable[Addition]) -> None:
    """Author the additions. Sdf knows no schemas: the layer is the same with or without ours registered."""
    with Sdf.ChangeBlock():
        for addition in additions:
            spec = Sdf.CreatePrimInLayer(layer, addition.path)
            if addition.applies:
                apply_api(spec, API)
            for name, value in addition.values.items():
                attribute = _attribute(spec, name)
                attribute.default = Gf.Vec3f(*value) if isinstance(value, tuple) else value
                if isinstance(value, tuple) and addition.space:
                    attribute.SetInfo("colorSpace", addition.space)
            driven = dict(addition.connections)
            for name, what in addition.maps.items():
                label, color = name.rpartition(":")[2], _TYPES[name] == Sdf.ValueTypeNames.Color3f
                driven[name] = author(layer, addition.path, label, what, color=color)
            for name, source in driven.items():
                _attribute(spec, name).connectionPathList.explicitItems = [Sdf.Path(source)]


def _attribute(spec: Sdf.PrimSpec, name: str) -> Sdf.AttributeSpec:
    known = spec.attributes.get(name)
    if known:
        return known
    uniform = Sdf.VariabilityUniform if name == "refraction:model" else Sdf.VariabilityVarying
    attribute = Sdf.AttributeSpec(spec, name, _TYPES[name], uniform)
    if name.startswith("primvars:"):
        attribute.SetInfo("interpolation", UsdGeom.Tokens.constant)
    return attribute
