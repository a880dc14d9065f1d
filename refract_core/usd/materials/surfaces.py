"""UsdPreviewSurface as a `Surface` record, and the surface of what has no shader this renderer knows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from pxr import UsdShade

from ...scene import Channel, Param, Source, Texture, Wrap
from ..values import finite
from .nodes import read_source
from .sources import Context, Value, constant, is_constant, note, read_constant, read_number
from .udim import Tiled

GREY = 0.18
"""displayColor where none is authored, as UsdPreviewSurface's diffuseColor (Sdr definition of usd-core)."""

DEFAULTS: dict[Param, Value] = {
    Param.DIFFUSE: (GREY, GREY, GREY),
    Param.EMISSIVE: (0.0, 0.0, 0.0),
    Param.SPECULAR: (0.0, 0.0, 0.0),
    Param.METALLIC: 0.0,
    Param.ROUGHNESS: 0.5,
    Param.CLEARCOAT: 0.0,
    Param.CLEARCOAT_ROUGHNESS: 0.01,
    Param.OPACITY: 1.0,
    Param.IOR: 1.5,
    Param.NORMAL: (0.0, 0.0, 1.0),
    Param.OCCLUSION: 1.0,
    Param.THICKNESS: 1.0,
    Param.TRANSMITTANCE: (1.0, 1.0, 1.0),
}
"""UsdPreviewSurface's own defaults (Sdr definition of usd-core 26.11) and those of RefractMaterialAPI."""

_INPUTS = {
    "diffuseColor": Param.DIFFUSE,
    "emissiveColor": Param.EMISSIVE,
    "specularColor": Param.SPECULAR,
    "metallic": Param.METALLIC,
    "roughness": Param.ROUGHNESS,
    "clearcoat": Param.CLEARCOAT,
    "clearcoatRoughness": Param.CLEARCOAT_ROUGHNESS,
    "opacity": Param.OPACITY,
    "ior": Param.IOR,
    "normal": Param.NORMAL,
    "occlusion": Param.OCCLUSION,
}
RANGES: dict[Param, tuple[float, float]] = {
    Param.DIFFUSE: (0.0, math.inf),
    Param.EMISSIVE: (0.0, math.inf),
    Param.SPECULAR: (0.0, 1.0),
    Param.METALLIC: (0.0, 1.0),
    Param.ROUGHNESS: (0.0, 1.0),
    Param.CLEARCOAT: (0.0, 1.0),
    Param.CLEARCOAT_ROUGHNESS: (0.0, 1.0),
    Param.OPACITY: (0.0, 1.0),
    Param.IOR: (1.0, math.inf),
    Param.OCCLUSION: (0.0, 1.0),
    Param.THICKNESS: (1.0e-4, math.inf),
    Param.TRANSMITTANCE: (0.0, 1.0),
}
"""Valid range of constants; a constant outside is clamped with a notice. THICKNESS in metres."""


@dataclass(frozen=True)
class Surface:
    """What a surface shader says, before RefractMaterialAPI is looked at."""

    inputs: dict[Param, Source] = field(default_factory=dict)
    """Sources by param; absent ones take `DEFAULTS`."""
    opacity_authored: bool = False
    glass: bool = False
    """The shader alone says that light passes through."""
    thin: bool = False
    """The shader says thin-walled, whatever the mesh."""
    specular_workflow: bool = False
    opacity_presence: bool = False
    opacity_threshold: float = 0.0
    absorption_distance: float | None = None
    """[m]; None where the transmission colour is a tint without a distance."""
    abbe: float = 0.0


def clamped(context: Context, param: Param, source: Source, label: str) -> Source:
    """A constant brought into its range, with a notice if it was outside; textures and primvars pass."""
    low, high = RANGES.get(param, (-math.inf, math.inf))
    values = source.value[:3]
    if not is_constant(source) or all(low <= value <= high for value in values):
        return source
    kept = tuple(min(max(value, low), high) for value in values)
    shown = "(" + ", ".join(f"{v:g}" for v in values) + ")" if isinstance(DEFAULTS[param], tuple) else f"{values[0]:g}"
    above = f"{low:g} to {high:g}" if math.isfinite(high) else f"at least {low:g}"
    note(context, f"{label} is {shown}; the valid range is {above}; it is clamped")
    alpha = source.value[3] if isinstance(DEFAULTS[param], tuple) else kept[0]
    return replace(source, value=(kept[0], kept[1], kept[2], alpha))


def lowest(source: Source, textures: dict[str, Texture]) -> float:
    """Smallest value a scalar source may take; -inf where that is not known."""
    if source.primvar or (source.texture >= 0 and Wrap.BLACK in source.wrap and not _tiled(source, textures)):
        return -math.inf
    if source.texture < 0:
        return source.value[0]
    return min(_ends(source, textures))


def _ends(source: Source, textures: dict[str, Texture]) -> list[float]:
    """What a scalar picture's smallest and largest texel give."""
    channel = Channel.R if source.channel is Channel.RGB else source.channel
    texture = list(textures.values())[source.texture]
    # Between tiles and outside of them nothing is meant to be looked up.
    parts = list(texture.parts()) if isinstance(texture, Tiled) else [texture.pixels]
    full = 255.0 if texture.pixels.dtype.kind == "u" else 1.0
    least, most = min(part[..., channel].min() for part in parts), max(part[..., channel].max() for part in parts)
    return [float(end) / full * source.scale[channel] + source.bias[channel] for end in (least, most)]


def _tiled(source: Source, textures: dict[str, Texture]) -> bool:
    return isinstance(list(textures.values())[source.texture], Tiled)


def highest(source: Source, textures: dict[str, Texture]) -> float:
    """Largest value a scalar source may take, of a primvar its fallback; 0 where that is not above 0."""
    if source.texture < 0:
        return max(source.value[0], 0.0)
    ends = _ends(source, textures)
    return max(*ends, 0.0)


def read_preview_surface(context: Context, shader: UsdShade.Shader) -> Surface:
    """UsdPreviewSurface, or its MaterialX twin, with every input."""
    inputs = {p: read_source(context, shader.GetInput(name), DEFAULTS[p]) for name, p in _INPUTS.items()}
    inputs |= {p: clamped(context, p, inputs[p], f"inputs:{name}") for name, p in _INPUTS.items()}
    _check_normal(context, inputs)
    if _authored(shader, "displacement") and not _zero(context, shader, "displacement"):
        note(context, "displacement is ignored; tessellate and displace the mesh beforehand if its shape matters")
    threshold = read_number(context, shader.GetInput("opacityThreshold"), 0.0)
    mode = str(read_constant(context, shader.GetInput("opacityMode"), "transparent"))
    mode = {"0": "transparent", "1": "presence"}.get(mode, mode)  # MaterialX counts
    if mode not in ("transparent", "presence"):
        note(context, f"opacityMode is '{mode}'; it must be transparent or presence; transparent is used")
    presence = mode == "presence" and threshold <= 0.0
    see_through = lowest(inputs[Param.OPACITY], context.textures) < 1.0
    return Surface(
        inputs=inputs,
        opacity_authored=_authored(shader, "opacity"),
        glass=see_through and not presence and threshold <= 0.0,
        specular_workflow=bool(read_constant(context, shader.GetInput("useSpecularWorkflow"), 0)),
        opacity_presence=presence and see_through,
        opacity_threshold=max(threshold, 0.0),
    )


def display_color_inputs(*, has_opacity: bool) -> dict[Param, Source]:
    """Diffuse from primvars:displayColor, and opacity from primvars:displayOpacity where the mesh has it."""
    inputs = {Param.DIFFUSE: replace(constant((GREY, GREY, GREY)), primvar="displayColor")}
    if has_opacity:
        inputs[Param.OPACITY] = replace(constant(1.0), primvar="displayOpacity")
    return inputs


def _authored(shader: UsdShade.Shader, name: str) -> bool:
    port = shader.GetInput(name)
    return bool(port) and bool(port.GetValueProducingAttributes())


def _zero(context: Context, shader: UsdShade.Shader, name: str) -> bool:
    source = read_source(context, shader.GetInput(name), 0.0)
    return is_constant(source) and source.value[0] == 0.0


def _check_normal(context: Context, inputs: dict[Param, Source]) -> None:
    """Repair a constant that is no direction; name an 8-bit map that was not unpacked to [-1, 1]."""
    source = inputs[Param.NORMAL]
    if is_constant(source) and (not finite(source.value) or math.hypot(*source.value[:3]) == 0.0):
        note(context, "inputs:normal is no direction; (0, 0, 1) is used")
        inputs[Param.NORMAL] = constant(DEFAULTS[Param.NORMAL])
    if source.texture < 0 or any(bias < 0.0 for bias in source.bias[:3]):
        return
    texture = list(context.textures.values())[source.texture]
    if texture.pixels.dtype.kind == "u":
        note(context, f"normal map {texture.name} has no negative bias, so every normal leans one way; "
             "author inputs:scale = (2, 2, 2, 1) and inputs:bias = (-1, -1, -1, 0) on its UsdUVTexture")  # fmt: skip
