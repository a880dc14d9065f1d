"""Shaders of single renderers, as `Surface` records: Arnold, Omniverse (`mdl`), the glass of PxrSurface.

They are looked at where a material has no MaterialX or universal surface that is understood.
"""

from __future__ import annotations

from collections.abc import Callable

from pxr import UsdShade

from ...scene import Param, Source
from . import mdl
from .glass import read_standard_surface
from .nodes import read_source
from .sources import Context, Value, note, producer, read_constant, read_number, scalar, scaled
from .surfaces import Surface, clamped

CONTEXTS = ("arnold", "mdl", "ri")
"""Render contexts of the outputs these shaders stand on: outputs:<context>:surface."""
_WHITE = (1.0, 1.0, 1.0)


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
    "PxrSurface": read_pxr_surface,
    **{f"mdl:{name}": reader for name, reader in mdl.READERS.items()},
}


def vendor_id(shader: UsdShade.Shader) -> str:
    """The key of a shader in `READERS`: its id, or `mdl:` and what it takes out of an MDL module. '' if it is none.

    A PxrSurface counts only where it refracts: the rest of it is not read.
    """
    name = str(shader.GetShaderId() or "")
    if not name and (inside := mdl.mdl_name(shader)):
        name = f"mdl:{inside}"
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
