"""What glass a stage has, by its own shaders: what `convert` decides from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from pxr import Gf, Sdf, Usd, UsdShade

from ...scene import Notice, Param, Source, Texture
from ..materials.nodes import read_source
from ..materials.read import has_api, read_surface, vendor_surfaces
from ..materials.sources import Context, is_constant, scalar
from ..materials.surfaces import Surface, highest
from ..materials.vendors import vendor_id
from .networks import Mapped, mapped, writable

_SWITCHES = {
    "UsdPreviewSurface": "opacity",
    "ND_UsdPreviewSurface_surfaceshader": "opacity",
    "ND_open_pbr_surface_surfaceshader": "transmission_weight",
    "ND_standard_surface_surfaceshader": "transmission",
    "ND_gltf_pbr_surfaceshader": "transmission",
}
"""The input without which a shader is opaque."""
_DEEPEST = 32
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
    color_map: Mapped | None
    """What drives it, where no output can be connected to."""
    distance: float | None
    """None where the colour tints at any depth."""
    abbe: float
    thickness: float
    """As authored on the shader (glTF), or the largest that its map gives; 0 where it says none."""
    thickness_from: str
    """Path of the output that drives the thickness, or ''."""
    thickness_map: Mapped | None
    authored: frozenset[str]
    """Names of our own attributes that are authored although the schema is not applied."""
    notes: tuple[str, ...]
    space: str = ""
    """What the colours' space is called where the stage gives the prim another one (ColorSpaceAPI); else ''."""


def find_glass(stage: Usd.Stage, time: Usd.TimeCode, unit: float) -> list[Glass]:
    """Every material that transmits light or has RefractMaterialAPI, in the order of the stage.

    Args:
        unit: metres per scene unit.
    """
    textures: dict[str, Texture] = {}
    found = (_read(prim, time, unit, textures) for prim in every_material(stage))
    return [glass for glass in found if glass is not None]


def every_material(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """Every material, in the order of the stage; one that instances share comes once, as the first has it."""
    seen: set[Sdf.Path] = set()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if prim.GetTypeName() == "Material" and (place := original(prim)) not in seen:
            seen.add(place)
            yield prim


def original(prim: Usd.Prim) -> Sdf.Path:
    """Proxies of one prototype share its path."""
    return prim.GetPrimInPrototype().GetPath() if prim.IsInstanceProxy() else prim.GetPath()


def _read(prim: Usd.Prim, time: Usd.TimeCode, unit: float, textures: dict[str, Texture]) -> Glass | None:
    """What one material says; None where it lets no light through."""
    material = UsdShade.Material(prim)
    if not has_api(prim) and not _may_transmit(material):
        return None
    notices: list[Notice] = []
    context = Context.of(str(prim.GetPath()), time, textures, notices)
    surface, shader = read_surface(context, material, unit)
    applied = has_api(prim)
    if not (surface.glass or applied):
        return None
    ior, ior_note = _constant(surface, Param.IOR, 1.5)
    color = surface.inputs.get(Param.TRANSMITTANCE, Source(value=(1.0, 1.0, 1.0, 1.0)))
    driver, color_map, color_note = _color(context, material, shader, color)
    thickness, thickness_from, thickness_map, thickness_note = _thickness(context, material, shader)
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
        color_map=color_map,
        distance=None if distance is None else distance / unit,
        abbe=max(surface.abbe, 0.0),
        thickness=thickness,
        thickness_from=thickness_from,
        thickness_map=thickness_map,
        authored=frozenset(name for name in prim.GetAuthoredPropertyNames() if "refraction:" in name),
        notes=tuple(note for note in notes if note),
        space=own_space(prim),
    )


def own_space(prim: Usd.Prim) -> str:
    """The name of linear Rec. 709, which every colour is read as, where a prim says that its colours are of another
    space, or of this; '' where it says nothing."""
    return str(Gf.ColorSpaceNames.LinearRec709) if Usd.ColorSpaceAPI.ComputeColorSpaceName(prim, None) else ""


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
    name = str(shader.GetShaderId() or vendor_id(shader).removeprefix("mdl:"))
    return name.removeprefix("ND_").removesuffix("_surfaceshader")


def _constant(surface: Surface, param: Param, default: float) -> tuple[float, str]:
    source = surface.inputs.get(param)
    if source is None:
        return default, ""
    value = source.value[0]
    text = f"{param.name.lower()} is mapped, and the schema's is one number: {value:g}, the map's fallback, is used"
    return value, "" if is_constant(source) else text


def _driver(material: UsdShade.Material, port: UsdShade.Input) -> str:
    """Output right inside the material that drives an input of its shader; '' where there is none."""
    for _ in range(_DEEPEST):
        if not port or not port.HasConnectedSource():
            return ""
        info = port.GetConnectedSources()[0][0]
        prim = info.source.GetPrim()
        if info.sourceType != UsdShade.AttributeType.Input:
            inside = prim.GetParent() == material.GetPrim()
            return str(info.source.GetOutput(info.sourceName).GetAttr().GetPath()) if inside else ""
        port = info.source.GetInput(info.sourceName)  # of a node graph, or of the material
    return ""


def _color(
    context: Context, material: UsdShade.Material, shader: UsdShade.Shader | None, color: Source
) -> tuple[str, Mapped | None, str]:
    """Output that drives the colour, or what to write in its place, and a note where neither can be."""
    if shader is None or is_constant(color):
        return "", None, ""
    for name in _COLORS:
        port = shader.GetInput(name)
        driver = _driver(material, port) if port else ""
        if driver and read_source(context, port, (1.0, 1.0, 1.0)) == color:
            return driver, None, ""
    if writable(what := mapped(color, context.textures)):
        return "", what, ""
    return "", None, "what drives its colour cannot be written for the schema; the fallback is used"


def _thickness(
    context: Context, material: UsdShade.Material, shader: UsdShade.Shader | None
) -> tuple[float, str, Mapped | None, str]:
    """Thickness of a glTF PBR shader, which is the only one that has it: its number, and what drives it."""
    port = shader.GetInput("thickness") if shader is not None and "gltf_pbr" in str(shader.GetShaderId()) else None
    if not port:
        return 0.0, "", None, ""
    source = scalar(read_source(context, port, 0.0))
    if is_constant(source):
        return max(source.value[0], 0.0), "", None, ""
    most = highest(source, context.textures)
    if driver := _driver(material, port):
        return most, driver, None, ""
    if writable(what := mapped(source, context.textures)):
        return most, "", what, ""
    return most, "", None, "what drives its thickness cannot be written for the schema; one number is used"


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
