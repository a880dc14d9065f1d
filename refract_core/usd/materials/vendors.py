"""Glass in the shaders of single renderers, as `Surface` records: Arnold, OmniGlass, PxrSurface.

They are looked at where a material has no MaterialX or universal surface that is understood.
"""

from __future__ import annotations

from collections.abc import Callable

from pxr import UsdShade

from ...scene import Param, Source
from .glass import read_standard_surface
from .nodes import read_source
from .sources import Context, Value, constant, note, producer, read_constant, read_number, scalar, scaled
from .surfaces import Surface, clamped

CONTEXTS = ("arnold", "mdl", "ri")
"""Render contexts of the outputs these shaders stand on: outputs:<context>:surface."""
_WHITE = (1.0, 1.0, 1.0)


def read_omni_glass(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """OmniGlass (docs.omniverse.nvidia.com, Templates): always clear; its colour is taken for a tint.

    `depth`, the "volume absorption scale", is left: what length or strength it stands for is not published.
    """
    inputs = {
        Param.DIFFUSE: constant((0.0, 0.0, 0.0)),
        Param.ROUGHNESS: _read(context, shader, Param.ROUGHNESS, "frosting_roughness", 0.0),
        Param.IOR: _read(context, shader, Param.IOR, "glass_ior", 1.491),
        Param.TRANSMITTANCE: _read(context, shader, Param.TRANSMITTANCE, "glass_color", _WHITE),
        Param.OPACITY: constant(0.0),
    }
    textures = ("glass_color_texture", "roughness_texture", "normal_map_texture", "cutout_opacity_texture")
    _note_authored(context, shader, ("depth", "reflection_color", "enable_opacity", *textures))
    thin = bool(read_constant(context, shader.GetInput("thin_walled"), False))
    return Surface(inputs=inputs, opacity_authored=True, glass=True, thin=thin)


def read_pxr_surface(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """PxrSurface's glass lobe (rmanwiki.pixar.com): refraction gain, tint, roughness, index, thin glass."""
    gain = scalar(read_source(context, shader.GetInput("refractionGain"), 0.0))
    gain = clamped(context, Param.OPACITY, gain, "inputs:refractionGain")
    diffuse = read_source(context, shader.GetInput("diffuseColor"), (0.18, 0.18, 0.18))
    inputs = {
        Param.DIFFUSE: scaled(diffuse, max(read_number(context, shader.GetInput("diffuseGain"), 1.0), 0.0)),
        Param.ROUGHNESS: _read(context, shader, Param.ROUGHNESS, "glassRoughness", 0.1),
        Param.IOR: _read(context, shader, Param.IOR, "glassIor", 1.5),
        Param.TRANSMITTANCE: _read(context, shader, Param.TRANSMITTANCE, "refractionColor", _WHITE),
        Param.OPACITY: scaled(gain, -1.0, 1.0),
    }
    _note_authored(context, shader, ("reflectionGain", "refractionRoughness", "ssAlbedo", "extinction", "presence"))
    thin = bool(read_constant(context, shader.GetInput("thinGlass"), False))
    return Surface(inputs=inputs, opacity_authored=True, glass=True, thin=thin)


def _read(context: Context, shader: UsdShade.Shader, param: Param, name: str, default: Value) -> Source:
    return clamped(context, param, read_source(context, shader.GetInput(name), default), f"inputs:{name}")


def _note_authored(context: Context, shader: UsdShade.Shader, names: tuple[str, ...]) -> None:
    found = [name for name in names if producer(context, shader.GetInput(name)) is not None]
    if found:
        note(context, f"{', '.join(found)} of {vendor_id(shader)} is ignored; the renderer does not read it")


READERS: dict[str, Callable[[Context, UsdShade.Shader, float], Surface]] = {
    "arnold:standard_surface": read_standard_surface,
    "OmniGlass": read_omni_glass,
    "PxrSurface": read_pxr_surface,
}


def vendor_id(shader: UsdShade.Shader) -> str:
    """The key of a shader in `READERS`: its id, or what it takes out of an MDL module. '' if it is not one of them.

    A PxrSurface counts only where it refracts: the rest of it is not read.
    """
    name = str(shader.GetShaderId() or "")
    if not name and shader.GetImplementationSource() == "sourceAsset":
        name = str(shader.GetSourceAssetSubIdentifier("mdl") or "")
        if not name:  # a module's one material has the module's name
            asset = shader.GetSourceAsset("mdl")
            name = asset.path.rsplit("/", 1)[-1].removesuffix(".mdl") if asset else ""
    if name == "PxrSurface" and not _authored(shader, "refractionGain"):
        return ""
    return name if name in READERS else ""


def _authored(shader: UsdShade.Shader, name: str) -> bool:
    """Connected, or a number other than 0."""
    port = shader.GetInput(name)
    if not port:
        return False
    made = port.GetValueProducingAttributes()
    return bool(made) and (UsdShade.Output.IsOutput(made[0]) or bool(made[0].Get()))
