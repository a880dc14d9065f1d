"""UsdShade materials as rows of the material table: the bound surface shader, then RefractMaterialAPI over it.

Where a material has both, the MaterialX surface (outputs:mtlx:surface) wins over the universal one if every node
of it is understood; a single renderer's own surface (`vendors`) is looked at where neither is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pxr import Usd, UsdShade

from ...errors import StageError
from ...models import BY_TOKEN, DEFAULT, MODELS, SHEET, SOLID, Model
from ...scene import Material, Notice, Param, Source, Texture
from .glass import READERS
from .mdl import mdl_name
from .nodes import read_source
from .sources import Context, constant, is_constant, kind_of, node_name, note, producer, read_number, scaled
from .surfaces import DEFAULTS, Surface, clamped, display_color_inputs, lowest, read_preview_surface
from .vendors import CONTEXTS, vendor_id
from .vendors import READERS as VENDOR_READERS

API = "RefractMaterialAPI"
THICKNESS_PRIMVAR = "refraction:thickness"
_PREVIEW = ("UsdPreviewSurface", "ND_UsdPreviewSurface_surfaceshader")


def read_material(
    material: UsdShade.Material,
    time: Usd.TimeCode,
    *,
    metres_per_unit: float,
    closed: bool,
    textures: dict[str, Texture],
    notices: list[Notice],
) -> Material:
    """Read one material as it is on one kind of mesh.

    Args:
        material: The material prim.
        time: Time code of the frame.
        metres_per_unit: Lengths on the material times this are metres.
        closed: The mesh it is on encloses a volume: glass without RefractMaterialAPI is then solid, else thin.
        textures: Textures of the whole stage; new ones are added at the end.
        notices: What was ignored, replaced or guessed is added here.

    Raises:
        StageError: `refraction:model` is not a known token.
    """
    context = Context.of(str(material.GetPath()), time, textures, notices)
    surface, _ = read_surface(context, material, metres_per_unit)
    if has_api(material.GetPrim()):
        return _refraction(context, material, surface, metres_per_unit)
    row = _row(context.path, surface, metres_per_unit)
    if not surface.glass:
        return row
    return _shader_glass(context, row, surface, thin=surface.thin or not closed, unit=metres_per_unit)


def display_color_material(prim_path: str, *, has_opacity: bool) -> Material:
    """The material of a prim without one: primvars displayColor (else 0.18 grey) and displayOpacity."""
    surface = Surface(inputs=display_color_inputs(has_opacity=has_opacity), opacity_presence=has_opacity)
    return _row(prim_path, surface, 1.0)


def _row(path: str, surface: Surface, unit: float) -> Material:
    """The record, its lengths in metres, before any model is chosen."""
    sources = {param: constant(DEFAULTS[param]) for param in Param} | surface.inputs
    if Param.THICKNESS not in surface.inputs:
        sources[Param.THICKNESS] = _thickness_of(sources[Param.THICKNESS], unit)
    return Material(
        name=path,
        inputs=tuple(sources[param] for param in Param),
        specular_workflow=surface.specular_workflow,
        opacity_presence=surface.opacity_presence,
        opacity_threshold=surface.opacity_threshold,
        absorption_distance=unit,
        abbe=max(surface.abbe, 0.0),
    )


def _with(material: Material, changes: dict[Param, Source], **fields: Any) -> Material:
    inputs = tuple(changes.get(param, material.inputs[param]) for param in Param)
    return replace(material, inputs=inputs, **fields)


def _thickness_of(value: Source, factor: float) -> Source:
    """A thickness constant [scene units] as a source in metres, yielding to primvars:refraction:thickness."""
    return scaled(replace(value, primvar=THICKNESS_PRIMVAR), factor)


def has_api(prim: Usd.Prim) -> bool:
    """RefractMaterialAPI is applied, also where the schema is not registered."""
    return API in prim.GetAppliedSchemas() or API in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


# --- the surface shader ---------------------------------------------------------------------------------------------


def read_surface(context: Context, material: UsdShade.Material, unit: float) -> tuple[Surface, UsdShade.Shader | None]:
    """The MaterialX surface if it is fully understood, else the universal one, else displayColor (and no shader)."""
    found: list[UsdShade.Shader] = []
    for render_context in ("mtlx", ""):
        shader = material.ComputeSurfaceSource(render_context)[0]
        if shader and shader.GetPath() not in [known.GetPath() for known in found]:
            found.append(shader)
    known = [shader for shader in found if shader.GetShaderId() in (*_PREVIEW, *READERS)] or vendor_surfaces(material)
    for position, shader in enumerate(known):
        trial = context.trial()
        surface = _read_shader(trial, shader, unit)
        if not trial.unsupported or position == len(known) - 1:
            for key in list(trial.textures)[len(context.textures) :]:
                context.textures[key] = trial.textures[key]
            context.notices.extend(trial.notices[len(context.notices) :])
            return surface, shader
        note(context, f"{node_name(shader)} needs nodes that are not supported ({', '.join(trial.unsupported)}); "
             f"{node_name(known[position + 1])} of the same material is used")  # fmt: skip
    return _unknown_surface(context, material, found), None


def vendor_surfaces(material: UsdShade.Material) -> list[UsdShade.Shader]:
    """The first surface that is written for one renderer and understood, if there is one."""
    for context in CONTEXTS:
        shader = material.ComputeSurfaceSource(context)[0]
        if shader and vendor_id(shader):
            return [shader]
    return []


def _read_shader(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    reader = READERS.get(shader.GetShaderId()) or VENDOR_READERS.get(vendor_id(shader))
    return reader(context, shader, unit) if reader else read_preview_surface(context, shader)


def _unknown_surface(context: Context, material: UsdShade.Material, found: list[UsdShade.Shader]) -> Surface:
    """displayColor, with a notice that names what stands there; only roughness and opacity 0 under our API."""
    others = [o.GetFullName() for o in material.GetOutputs() if o.GetBaseName().rpartition(":")[2] == "surface"]
    shaders = [material.ComputeSurfaceSource(context)[0] for context in ("", *CONTEXTS)]
    modules = [name for shader in shaders if shader and (name := mdl_name(shader))]
    if modules:
        what = f"MDL material '{modules[0]}' is not read"
    elif found and kind_of(found[0]) == "MaterialX":
        what = f"MaterialX surface {node_name(found[0])} is not one this renderer reads"
    elif found:
        what = f"surface shader {found[0].GetPath()} {node_name(found[0])} is not one this renderer reads"
    elif others:
        what = f"{', '.join(others)} leads to no surface shader this renderer reads"
    else:
        what = "has no surface shader"
    if has_api(material.GetPrim()):
        if found or others:
            note(context, f"{what}; roughness 0 and opacity 0 are used")
        return Surface(inputs=display_color_inputs(has_opacity=False) | {Param.ROUGHNESS: constant(0.0)})
    note(context, f"{what}; displayColor is used; connect a UsdPreviewSurface to outputs:surface")
    return Surface(inputs=display_color_inputs(has_opacity=False))


def _shader_glass(context: Context, row: Material, surface: Surface, *, thin: bool, unit: float) -> Material:
    """Glass that its surface shader alone describes: thin-walled or open, else traced through the real mesh.

    A transmission colour without a distance (OpenPBR: depth 0) tints the surface once. The thin model reaches that
    colour after exactly its own 5 mm; a solid after the mean way through its bodies (`ways`), of which this knows
    nothing yet. The thin model has no other distance, so a colour with one is taken to 5 mm (Beer-Lambert).
    """
    if thin:
        color = _thin_color(context, row.inputs[Param.TRANSMITTANCE], surface.absorption_distance)
        changes = {Param.THICKNESS: constant(SHEET.fixed_thickness), Param.TRANSMITTANCE: color}
        return _with(row, changes, model=SHEET, absorption_distance=SHEET.fixed_thickness)
    tint = row.inputs[Param.TRANSMITTANCE]
    tints = surface.absorption_distance is None and tint != constant(DEFAULTS[Param.TRANSMITTANCE])
    return _with(row, {}, model=SOLID, absorption_distance=surface.absorption_distance or unit, tints=tints)


def _thin_color(context: Context, color: Source, distance: float | None) -> Source:
    """What is left after 5 mm of a medium that leaves `color` after `distance` [m]."""
    if distance is None or color == constant(DEFAULTS[Param.TRANSMITTANCE]):
        return color
    if not is_constant(color):
        note(context, f"its transmission colour is mapped, so it is read as left after {SHEET.fixed_thickness} m, "
             f"the {SHEET.token} model's own distance")  # fmt: skip
        return color
    r, g, b, a = color.value
    power = SHEET.fixed_thickness / distance
    return replace(color, value=(r**power, g**power, b**power, a))


# --- RefractMaterialAPI ---------------------------------------------------------------------------------------------


def _refraction(context: Context, material: UsdShade.Material, surface: Surface, unit: float) -> Material:
    """The attributes of RefractMaterialAPI over what the surface shader says."""
    model = _model(material)
    if model is Model.NONE:
        # Refraction is switched off by hand: what opacity is left is coverage.
        presence = surface.opacity_presence or surface.glass
        return replace(_row(context.path, surface, unit), opacity_presence=presence)
    row = _row(context.path, replace(surface, opacity_presence=False, opacity_threshold=0.0), unit)
    ior = read_source(context, material.GetInput("refraction:ior"), 1.5)
    color = read_source(context, material.GetInput("refraction:transmittanceColor"), (1.0, 1.0, 1.0))
    changes = {
        Param.IOR: clamped(context, Param.IOR, ior, "inputs:refraction:ior"),
        Param.TRANSMITTANCE: clamped(context, Param.TRANSMITTANCE, color, "inputs:refraction:transmittanceColor"),
        Param.OPACITY: _opacity(context, surface),
        Param.THICKNESS: _thickness(context, material, model, unit),
    }
    abbe = read_number(context, material.GetInput("refraction:abbeNumber"), 0.0)
    if abbe < 0.0:
        note(context, f"inputs:refraction:abbeNumber is {abbe}; the valid range is at least 0; 0 (none) is used")
    attribute = material.GetPrim().GetAttribute("refraction:priority")
    priority = int((attribute.Get() if attribute else None) or 0)
    return _with(
        row,
        changes,
        model=model,
        absorption_distance=_absorption_distance(context, material, model, unit),
        abbe=max(abbe, 0.0),
        priority=priority,
    )


def _model(material: UsdShade.Material) -> Model:
    attribute = material.GetPrim().GetAttribute("refraction:model")
    token = str((attribute.Get() if attribute else None) or DEFAULT.token)
    if token not in MODELS:
        raise StageError(
            f"{material.GetPath()}: refraction:model is '{token}'; author one of {', '.join(MODELS)}",
        )
    return BY_TOKEN[token]


def _opacity(context: Context, surface: Surface) -> Source:
    """1 - opacity is how much refraction replaces the surface; where no shader speaks of it, all of it."""
    if not surface.opacity_authored:
        return constant(0.0)
    source = surface.inputs[Param.OPACITY]
    if surface.opacity_presence or surface.opacity_threshold > 0.0:
        note(context, f"{API} is applied, so opacity says how much is refracted; "
             "opacityMode = presence and opacityThreshold are ignored")  # fmt: skip
    if lowest(source, context.textures) >= 1.0:
        note(context, f"{API} is applied but the surface's opacity is 1, so no refraction shows; author opacity 0")
    return source


def _thickness(context: Context, material: UsdShade.Material, model: Model, unit: float) -> Source:
    """Connected texture or primvar, then primvars:refraction:thickness, then the constant; in metres."""
    port = material.GetInput("refraction:thickness")
    if model.fixed_thickness:
        for name in ("thickness", "absorptionDistance"):
            if _is_authored(context, material.GetInput(f"refraction:{name}")):
                fixed = f"the {model.token} model fixes it at {model.fixed_thickness} m"
                note(context, f"inputs:refraction:{name} is ignored: {fixed}")
        return constant(model.fixed_thickness)
    multiplier = read_number(context, material.GetInput("refraction:thicknessMultiplier"), 1.0)
    if multiplier <= 0.0:
        note(context, f"inputs:refraction:thicknessMultiplier is {multiplier}; it must be above 0; 1 is used")
        multiplier = 1.0
    source = read_source(context, port, 1.0)
    if not is_constant(source):
        return scaled(source, unit * multiplier)
    label = "inputs:refraction:thickness in metres"
    metres = clamped(context, Param.THICKNESS, scaled(source, unit * multiplier), label)
    if producer(context, port) is not None and UsdShade.Output.IsOutput(producer(context, port)):
        return constant(metres.value[0])
    return replace(_thickness_of(source, unit * multiplier), value=metres.value)


def _absorption_distance(context: Context, material: UsdShade.Material, model: Model, unit: float) -> float:
    if model.fixed_thickness:
        return model.fixed_thickness
    distance = float(read_number(context, material.GetInput("refraction:absorptionDistance"), 1.0))
    if distance <= 0.0:
        note(context, f"inputs:refraction:absorptionDistance is {distance}; it must be above 0; 1 is used")
        distance = 1.0
    return distance * unit


def _is_authored(context: Context, port: UsdShade.Input) -> bool:
    if not port:
        return False
    attribute = producer(context, port)
    return attribute is not None and bool(UsdShade.Output.IsOutput(attribute) or attribute.HasAuthoredValue())
