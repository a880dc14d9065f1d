"""What glass a stage has, by its own shaders: what `convert` decides from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from pxr import Sdf, Usd, UsdShade

from ...scene import Notice, Param, Source, Texture
from ..materials.read import has_api, read_surface, vendor_surfaces
from ..materials.sources import Context, is_constant, producer, scalar
from ..materials.surfaces import Surface
from ..materials.vendors import vendor_id

_SWITCHES = {
    "UsdPreviewSurface": "opacity",
    "ND_UsdPreviewSurface_surfaceshader": "opacity",
    "ND_open_pbr_surface_surfaceshader": "transmission_weight",
    "ND_standard_surface_surfaceshader": "transmission",
    "ND_gltf_pbr_surfaceshader": "transmission",
}
"""The input without which a shader is opaque."""
_COLORS = ("transmission_color", "attenuation_color", "base_color", "glass_color", "refractionColor")


@dataclass(frozen=True)
class Glass:
    """What a material's own shader says of light that passes through it. Lengths in scene units."""

    path: str
    edit: str
    """Path at which a stronger layer can say more about it; '' where none can (inside an instance)."""
    shader: str
    """Id of the shader; '' where none is understood."""
    applied: bool
    """RefractMaterialAPI is there already."""
    thin: bool
    """The shader says thin-walled."""
    surface: Surface
    ior: float
    color: tuple[float, float, float]
    """The constant, or the fallback of what drives it."""
    color_from: str
    """Path of the output that drives the colour, or ''."""
    distance: float | None
    """None where the colour tints at any depth."""
    abbe: float
    thickness: float
    """As authored on the shader (glTF); 0 where it says none."""
    authored: frozenset[str]
    """Names of our own attributes that are authored although the schema is not applied."""
    notes: tuple[str, ...]


def find_glass(stage: Usd.Stage, time: Usd.TimeCode, unit: float) -> list[Glass]:
    """Every material that transmits light or has RefractMaterialAPI, in the order of the stage.

    Args:
        unit: metres per scene unit.
    """
    found: list[Glass] = []
    seen: set[Sdf.Path] = set()
    textures: dict[str, Texture] = {}
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if prim.GetTypeName() != "Material":
            continue
        place = original(prim)
        if place in seen:
            continue
        seen.add(place)
        glass = _read(prim, time, unit, textures)
        if glass is not None:
            found.append(glass)
    return found


def original(prim: Usd.Prim) -> Sdf.Path:
    """Proxies of one prototype share its path."""
    return prim.GetPrimInPrototype().GetPath() if prim.IsInstanceProxy() else prim.GetPath()


def _read(prim: Usd.Prim, time: Usd.TimeCode, unit: float, textures: dict[str, Texture]) -> Glass | None:
    """What one material says; None where it lets no light through."""
    material = UsdShade.Material(prim)
    if not has_api(prim) and not _may_transmit(material):
        return None
    notices: list[Notice] = []
    context = Context(str(prim.GetPath()), time, textures, notices, [])
    surface, shader = read_surface(context, material, unit)
    applied = has_api(prim)
    if not (surface.glass or applied):
        return None
    ior, ior_note = _constant(surface, Param.IOR, 1.5)
    color = surface.inputs.get(Param.TRANSMITTANCE, Source(value=(1.0, 1.0, 1.0, 1.0)))
    driver, color_note = ("", "") if is_constant(color) else _driver(material, shader, context)
    thickness, thickness_note = _thickness(context, shader)
    notes = [note.text for note in notices] + [ior_note, color_note, thickness_note, *_warnings(prim, surface)]
    distance = surface.absorption_distance
    return Glass(
        path=str(prim.GetPath()),
        edit=str(editable(prim) or ""),
        shader=_name(shader),
        applied=applied,
        thin=surface.thin,
        surface=surface,
        ior=ior,
        color=(color.value[0], color.value[1], color.value[2]),
        color_from=driver,
        distance=None if distance is None else distance / unit,
        abbe=max(surface.abbe, 0.0),
        thickness=thickness,
        authored=frozenset(name for name in prim.GetAuthoredPropertyNames() if "refraction:" in name),
        notes=tuple(note for note in notes if note),
    )


def _may_transmit(material: UsdShade.Material) -> bool:
    """False where reading the whole material, its pictures too, could not make it glass."""
    shaders = [material.ComputeSurfaceSource(context)[0] for context in ("mtlx", "")]
    known = [shader for shader in shaders if shader and shader.GetShaderId() in _SWITCHES]
    if not known:
        return bool(vendor_surfaces(material))
    return any(shader.GetInput(_SWITCHES[shader.GetShaderId()]) for shader in known)


def _name(shader: UsdShade.Shader | None) -> str:
    if shader is None:
        return ""
    return str(shader.GetShaderId() or vendor_id(shader)).removeprefix("ND_").removesuffix("_surfaceshader")


def _constant(surface: Surface, param: Param, default: float) -> tuple[float, str]:
    source = surface.inputs.get(param)
    if source is None:
        return default, ""
    value = source.value[0]
    text = f"{param.name.lower()} is mapped, and the schema's is one number: {value:g}, the map's fallback, is used"
    return value, "" if is_constant(source) else text


def _driver(material: UsdShade.Material, shader: UsdShade.Shader | None, context: Context) -> tuple[str, str]:
    """Output inside the material that drives the colour, and a note where it cannot be connected from outside."""
    for name in _COLORS if shader is not None else ():
        attribute = producer(context, shader.GetInput(name)) if shader is not None else None
        if attribute is None or not UsdShade.Output.IsOutput(attribute):
            continue
        if attribute.GetPrim().GetParent() == material.GetPrim():
            return str(attribute.GetPath()), ""
        return "", f"{name} is driven from inside a node graph, where {material.GetPath().name} cannot reach it"
    return "", ""


def _thickness(context: Context, shader: UsdShade.Shader | None) -> tuple[float, str]:
    """Thickness of a glTF PBR shader, which is the only one that has it."""
    port = shader.GetInput("thickness") if shader is not None and "gltf_pbr" in str(shader.GetShaderId()) else None
    attribute = producer(context, port) if port else None
    if attribute is None:
        return 0.0, ""
    if UsdShade.Output.IsOutput(attribute):
        return 0.0, "thickness is mapped; the geometry's is used. Connect inputs:refraction:thickness to keep the map"
    value = attribute.Get(context.time)
    return (float(value), "") if isinstance(value, float) and value > 0.0 else (0.0, "")


def _warnings(prim: Usd.Prim, surface: Surface) -> Iterable[str]:
    opacity = surface.inputs.get(Param.OPACITY)
    if opacity is not None and not is_constant(opacity):
        yield "opacity is mapped: where the map means a cut-out, author opacityThreshold and leave it out with --only"
    elif surface.glass and opacity is not None and scalar(opacity).value[0] > 0.5:
        yield f"opacity is {opacity.value[0]:g}, so little of the refraction shows"
    if any(spec.path.ContainsPrimVariantSelection() for spec in prim.GetPrimStack()):
        yield "comes from a variant; what is added holds for every variant"


def editable(prim: Usd.Prim) -> Sdf.Path | None:
    """Where a layer on top of the stage can author opinions on a prim; None where it cannot.

    A prim inside a native instance has opinions only where the instance's source lies in the stage's own layers.
    """
    if not prim.IsInstanceProxy() and not prim.IsInPrototype():
        return prim.GetPath()
    inside = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
    own = prim.GetStage().GetLayerStack(False)
    for spec in inside.GetPrimStack():
        if spec.layer in own and not spec.path.ContainsPrimVariantSelection():
            return spec.path
    return None
