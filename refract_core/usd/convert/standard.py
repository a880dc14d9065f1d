"""The nearest standard surface written back on refractive materials, so that other renderers show something sensible.

Nothing that is authored is changed: an own shader is made where the material has none for its output, and what an
existing one of the same kind leaves open is filled in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from pxr import Gf, Sdf, Usd, UsdShade

from ...models import Behind, Model
from ...scene import Material, Notice, Param, Source, Texture
from ..materials.read import read_material
from ..materials.sources import is_constant, scaled
from ..stage import stage_unit, time_range
from ..values import neat
from .find import editable, own_space
from .networks import author, author_normal, connect, mapped, writable


class _Target(NamedTuple):
    """One kind of standard surface."""

    identifier: str
    context: str
    """Render context of the output it stands on; '' is the universal one."""
    output: str
    prim: str
    """Name of a new shader."""


_TARGETS = {
    "preview": _Target("UsdPreviewSurface", "", "surface", "RefractPreview"),
    "openpbr": _Target("ND_open_pbr_surface_surfaceshader", "mtlx", "out", "RefractOpenPBR"),
    "gltf": _Target("ND_gltf_pbr_surfaceshader", "mtlx", "out", "RefractGltf"),
}
_KINDS = {float: Sdf.ValueTypeNames.Float, bool: Sdf.ValueTypeNames.Bool, tuple: Sdf.ValueTypeNames.Color3f}
_Inputs = dict[str, Any]


def write_surfaces(stage: Usd.Stage, target: str, paths: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Author the surfaces in a layer over a stage, or in a flat one.

    Args:
        stage: its root layer is what is to be written; RefractMaterialAPI is in it already.
        target: preview, openpbr or gltf.
        paths: materials.

    Returns:
        What was done, or why nothing, by material.
    """
    time = Usd.TimeCode(time_range(stage)[0])
    unit = stage_unit(stage, [])
    textures: dict[str, Texture] = {}
    told = {}
    for path in paths:
        material = UsdShade.Material(stage.GetPrimAtPath(path))
        notices: list[Notice] = []
        record = read_material(
            material, time, metres_per_unit=unit, closed=True, textures=textures, notices=notices
        )  # fmt: skip
        told[path] = tuple(_write(stage.GetRootLayer(), material, record, textures, _TARGETS[target], unit))
    return told


def write_open_pbr(
    layer: Sdf.Layer, material: UsdShade.Material, record: Material, textures: dict[str, Texture], unit: float
) -> Iterable[str]:
    """The OpenPBR surface of a material, opaque ones too, in a layer of its own.

    Returns:
        What cannot be said there; nothing where all of it is.
    """
    plain = record.model is Model.NONE
    told = list(_write(layer, material, record, textures, _TARGETS["openpbr"], unit, plain=plain))
    return [text for text in told if not text.endswith("is written on outputs:mtlx:surface")]


def _write(
    layer: Sdf.Layer, material: UsdShade.Material, record: Material, textures: dict[str, Texture], target: _Target,
    unit: float, *, plain: bool = False,
) -> Iterable[str]:  # fmt: skip
    """One material's surface; tells what was done, or why nothing.

    Args:
        plain: it is opaque, and written all the same.
    """
    where = f"outputs:{target.context + ':' if target.context else ''}surface"
    place = editable(material.GetPrim())
    if (record.model is Model.NONE and not plain) or place is None:
        yield f"no {target.identifier} is written: " + (
            "it is out of reach" if place is None else "it refracts nothing"
        )
        return
    essential, rest = _MAKERS[target.identifier](record, unit)
    drivers = {name: source for name, source in _driven(record, target, unit).items() if not is_constant(source)}
    for name in drivers.keys() - essential.keys() - rest.keys():
        rest[name] = (0.0, 0.0, 0.0) if name in _THREE else 0.0
    if lost := sorted(name for name, source in drivers.items() if not writable(mapped(source, textures))):
        yield f"no {target.identifier} is written: what drives {', '.join(lost)} cannot be written for it"
        return

    def drive(shader: UsdShade.Shader, name: str, kind: Sdf.ValueTypeName) -> None:
        what, home = mapped(drivers[name], textures), str(place)
        if name in _NORMALS and target.context:
            output = author_normal(layer, home, name, what)
        else:
            output = author(layer, home, name, what, color=name in _THREE, mtlx=bool(target.context))
        connect(layer, str(shader.GetPath()), name, kind, output)

    existing, taken = _existing(material, target)
    if existing is not None:
        yield from _fill(existing, essential, target, drivers, drive)
    elif taken:
        yield f"no {target.identifier} is written: {where} is {taken} already"
    else:
        home = UsdShade.Material(material.GetPrim().GetStage().GetPrimAtPath(place))
        shader = _make(home, target)
        for name, value in {**rest, **essential}.items():
            if name in drivers:
                drive(shader, name, _kind(name, value))
            else:
                _put(shader, name, value)
        yield f"{target.identifier} is written on {where}"


def _existing(material: UsdShade.Material, target: _Target) -> tuple[UsdShade.Shader | None, str]:
    """The shader of this kind on the output; else the name of what else stands there, or ''."""
    output = material.GetSurfaceOutput(target.context) if target.context else material.GetSurfaceOutput()
    if not output or not output.GetAttr().HasAuthoredConnections():
        return None, ""
    shader = material.ComputeSurfaceSource(target.context)[0]
    if shader and shader.GetShaderId() == target.identifier:
        return shader, ""
    return None, f"{shader.GetShaderId() or 'another shader'}" if shader else "connected"


def _make(material: UsdShade.Material, target: _Target) -> UsdShade.Shader:
    name, count = target.prim, 1
    while material.GetPrim().GetChild(name):
        name, count = f"{target.prim}_{count}", count + 1
    shader = UsdShade.Shader.Define(material.GetPrim().GetStage(), material.GetPath().AppendChild(name))
    shader.CreateIdAttr(target.identifier)
    made = shader.CreateOutput(target.output, Sdf.ValueTypeNames.Token)
    output = material.CreateSurfaceOutput(target.context) if target.context else material.CreateSurfaceOutput()
    output.ConnectToSource(made)
    return shader


def _kind(name: str, value: Any) -> Sdf.ValueTypeName:
    return Sdf.ValueTypeNames.Normal3f if name in _NORMALS else _KINDS[type(value)]


def _fill(
    shader: UsdShade.Shader, essential: _Inputs, target: _Target, drivers: dict[str, Source],
    drive: Callable[[UsdShade.Shader, str, Sdf.ValueTypeName], None],
) -> Iterable[str]:  # fmt: skip
    """Author what is left open; name what is authored otherwise and stays."""
    place = editable(shader.GetPrim())
    if place is None:
        yield f"{shader.GetPath()} is out of reach"
        return
    written, stays = [], []
    for name, value in essential.items():
        port = shader.GetInput(name)
        made = port.GetValueProducingAttributes() if port else []
        if not made:
            at = UsdShade.Shader(shader.GetPrim().GetStage().GetPrimAtPath(place))
            if name in drivers:
                drive(at, name, _kind(name, value))
            else:
                _put(at, name, value)
            written.append(name)
        elif UsdShade.Output.IsOutput(made[0]) or not _same(made[0].Get(), value):
            stays.append(name)
    if written:
        yield f"{target.identifier} gets {', '.join(written)}"
    if stays:
        yield f"{target.identifier} keeps its own {', '.join(stays)}"


def _put(shader: UsdShade.Shader, name: str, value: Any) -> None:
    """Author a number or colour, in the space that it was read in."""
    port = shader.CreateInput(name, _kind(name, value))
    port.Set(_value(value))
    if isinstance(value, tuple) and name not in _NORMALS and (space := own_space(shader.GetPrim())):
        port.GetAttr().SetColorSpace(space)


def _same(found: Any, wanted: Any) -> bool:
    a = tuple(found) if isinstance(wanted, tuple) and found is not None else (found,)
    b = wanted if isinstance(wanted, tuple) else (wanted,)
    return len(a) == len(b) and all(
        x is not None and abs(float(x) - float(y)) <= 1.0e-5 for x, y in zip(a, b, strict=True)
    )


def _value(value: Any) -> Any:
    return Gf.Vec3f(*value) if isinstance(value, tuple) else value


# --- inputs ---------------------------------------------------------------------------------------------------------


_NORMALS = ("normal", "geometry_normal")
_THREE = (
    "diffuseColor", "emissiveColor", "base_color", "emission_color", "emissive", "transmission_color",
    "attenuation_color", *_NORMALS,
)  # fmt: skip
"""Inputs that take three numbers."""
_NAMES: dict[str, dict[Param, str]] = {
    "UsdPreviewSurface": {
        Param.DIFFUSE: "diffuseColor", Param.EMISSIVE: "emissiveColor", Param.METALLIC: "metallic",
        Param.ROUGHNESS: "roughness", Param.CLEARCOAT: "clearcoat", Param.CLEARCOAT_ROUGHNESS: "clearcoatRoughness",
        Param.OPACITY: "opacity", Param.IOR: "ior", Param.NORMAL: "normal", Param.OCCLUSION: "occlusion",
    },
    "ND_open_pbr_surface_surfaceshader": {
        Param.DIFFUSE: "base_color", Param.EMISSIVE: "emission_color", Param.METALLIC: "base_metalness",
        Param.ROUGHNESS: "specular_roughness", Param.CLEARCOAT: "coat_weight",
        Param.CLEARCOAT_ROUGHNESS: "coat_roughness", Param.OPACITY: "transmission_weight",
        Param.IOR: "specular_ior", Param.NORMAL: "geometry_normal", Param.TRANSMITTANCE: "transmission_color",
    },
    "ND_gltf_pbr_surfaceshader": {
        Param.DIFFUSE: "base_color", Param.EMISSIVE: "emissive", Param.METALLIC: "metallic",
        Param.ROUGHNESS: "roughness", Param.CLEARCOAT: "clearcoat",
        Param.CLEARCOAT_ROUGHNESS: "clearcoat_roughness", Param.OPACITY: "transmission", Param.IOR: "ior",
        Param.NORMAL: "normal", Param.OCCLUSION: "occlusion", Param.TRANSMITTANCE: "attenuation_color",
        Param.THICKNESS: "thickness",
    },
}  # fmt: skip
"""What each shader calls the inputs that a picture may drive."""


def _driven(record: Material, target: _Target, unit: float) -> dict[str, Source]:
    """What drives each input of the shader. The surface's own colour is left where nothing of it shows."""
    opacity = record.inputs[Param.OPACITY]
    clear = is_constant(opacity) and opacity.value[0] <= 0.0
    thin = record.model.behind is Behind.SHEET
    found = {}
    for param, name in _NAMES[target.identifier].items():
        source = record.inputs[param]
        if param in (Param.DIFFUSE, Param.METALLIC, Param.OCCLUSION) and clear:
            continue
        if param is Param.OPACITY and record.model is Model.NONE:
            if not record.cutout:
                continue
            name = "geometry_opacity"
        elif param is Param.OPACITY and target.context:
            source = scaled(source, -1.0, 1.0)
        if param is Param.TRANSMITTANCE and record.model is Model.NONE:
            continue
        if param is Param.THICKNESS:
            source = scaled(source, 1.0 / unit)
            if thin or source.texture < 0:  # a typed number yields to a primvar that no standard surface knows
                continue
        found[name] = source
    if thin and "attenuation_color" in found:  # a wall without thickness has no volume; its colour is the base colour
        found["base_color"] = found.pop("attenuation_color")
    return found


def _one(record: Material, param: Param) -> float:
    return neat(record.inputs[param].value[0])


def _three(source: Source) -> tuple[float, float, float]:
    r, g, b = (neat(value) for value in source.value[:3])
    return r, g, b


def _body(record: Material, emission: str, coat: str, coat_roughness: str) -> _Inputs:
    """What a surface has beside its glass."""
    found: _Inputs = {}
    if (emitted := _three(record.inputs[Param.EMISSIVE])) != (0.0, 0.0, 0.0):
        found[emission] = emitted
    if (coated := _one(record, Param.CLEARCOAT)) > 0.0:
        found |= {coat: coated, coat_roughness: _one(record, Param.CLEARCOAT_ROUGHNESS)}
    return found


def _base(record: Material, clear: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> tuple[float, float, float]:
    """The colour of what is not transmitted; `clear` where all is, which in white disturbs no renderer."""
    opaque = record.inputs[Param.OPACITY].value[0] > 0.0
    return _three(record.inputs[Param.DIFFUSE]) if opaque else clear


def _preview(record: Material, unit: float) -> tuple[_Inputs, _Inputs]:
    opacity = _one(record, Param.OPACITY)
    tint = _three(record.inputs[Param.TRANSMITTANCE])
    rest: _Inputs = {
        "diffuseColor": _base(record, tint),
        "metallic": _one(record, Param.METALLIC),
        "roughness": _one(record, Param.ROUGHNESS),
    }
    rest |= _body(record, "emissiveColor", "clearcoat", "clearcoatRoughness")
    return {"opacity": opacity, "ior": _one(record, Param.IOR)}, rest


def _open_pbr(record: Material, unit: float) -> tuple[_Inputs, _Inputs]:
    """What makes it glass in OpenPBR 1.1, and what else it may have."""
    thin = record.model.behind is Behind.SHEET
    if record.model is Model.NONE:
        body: _Inputs = {"base_color": _three(record.inputs[Param.DIFFUSE]), "specular_ior": _one(record, Param.IOR)}
        if record.cutout:
            body["geometry_opacity"] = _one(record, Param.OPACITY)
        return body, _surface(record)
    glass: _Inputs = {
        "transmission_weight": neat(1.0 - _one(record, Param.OPACITY)),
        "specular_ior": _one(record, Param.IOR),
        "transmission_color": _three(record.inputs[Param.TRANSMITTANCE]),
        "transmission_depth": 0.0 if thin or record.tints else neat(record.absorption_distance / unit),
        "geometry_thin_walled": thin,
    }
    if record.abbe > 0.0:
        glass |= {"transmission_dispersion_scale": 1.0, "transmission_dispersion_abbe_number": neat(record.abbe)}
    return glass, {"base_color": _base(record)} | _surface(record)


def _surface(record: Material) -> _Inputs:
    """What an OpenPBR surface has, let light through or not."""
    found: _Inputs = {
        "base_metalness": _one(record, Param.METALLIC),
        "specular_roughness": _one(record, Param.ROUGHNESS),
    }
    found |= _body(record, "emission_color", "coat_weight", "coat_roughness")
    if "emission_color" in found or not is_constant(record.inputs[Param.EMISSIVE]):
        found["emission_luminance"] = 1.0
    return found


def _gltf(record: Material, unit: float) -> tuple[_Inputs, _Inputs]:
    """What makes it glass in glTF PBR, and what else it may have."""
    thin = record.model.behind is Behind.SHEET
    tint = _three(record.inputs[Param.TRANSMITTANCE])
    glass: _Inputs = {
        "transmission": neat(1.0 - _one(record, Param.OPACITY)),
        "ior": _one(record, Param.IOR),
        # A wall without thickness has no volume; its colour is the base colour.
        "thickness": 0.0 if thin else neat(record.inputs[Param.THICKNESS].value[0] / unit),
    }
    if not thin and (tint != (1.0, 1.0, 1.0) or not is_constant(record.inputs[Param.TRANSMITTANCE])):
        glass |= {"attenuation_color": tint, "attenuation_distance": neat(record.absorption_distance / unit)}
    if record.abbe > 0.0:
        glass["dispersion"] = neat(20.0 / record.abbe)
    rest: _Inputs = {
        # One colour for both: where some of the surface is left, other renderers tint the glass with it too.
        "base_color": _base(record, tint) if thin else _base(record),
        "metallic": _one(record, Param.METALLIC),
        "roughness": _one(record, Param.ROUGHNESS),
    }
    rest |= _body(record, "emissive", "clearcoat", "clearcoat_roughness")
    return glass, rest


_MAKERS = {
    "UsdPreviewSurface": _preview,
    "ND_open_pbr_surface_surfaceshader": _open_pbr,
    "ND_gltf_pbr_surfaceshader": _gltf,
}
