"""Omniverse's own MDL materials as `Surface` records: OmniPBR, OmniGlass, OmniSurface.

MDL itself is not read: these are known by name, and their inputs mean what docs.omniverse.nvidia.com says of the
templates. A picture is an asset on the shader itself, looked up at the mesh's texture coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from pxr import UsdShade

from ...scene import Channel, Param, Source
from .coordinates import Uv
from .folding import linear, product, spread
from .nodes import in_tiles, picture_index, read_source
from .sources import (
    Context,
    Value,
    constant,
    is_constant,
    note,
    producer,
    read_constant,
    read_number,
    read_numbers,
    scaled,
    single,
)
from .surfaces import Surface, clamped, lowest, read_preview_surface

_WHITE = (1.0, 1.0, 1.0)


def read_omni_pbr(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """OmniPBR and its kin: never glass; what opacity is left is coverage."""
    packed = _picture(context, shader, "ORM_texture") if _on(context, shader, "enable_ORM_texture") else None
    influence = _number(context, shader, "ao_to_diffuse", 0.0)
    shade = _either(context, packed, Channel.R, shader, "ao_texture")
    inputs = {
        Param.DIFFUSE: _albedo(context, shader),
        Param.ROUGHNESS: _influenced(context, shader, packed, Channel.G, "reflectionroughness_texture",
                                     "reflection_roughness", 0.5),
        Param.METALLIC: _influenced(context, shader, packed, Channel.B, "metallic_texture", "metallic", 0.0),
        Param.IOR: constant(_ior_of(_number(context, shader, "specular_level", 0.5))),
        Param.OCCLUSION: constant(1.0) if shade is None else scaled(shade, influence, 1.0 - influence),
        Param.EMISSIVE: _glow(context, shader),
    }  # fmt: skip
    _normal(context, shader, "normalmap_texture", inputs)
    if _on(context, shader, "enable_clearcoat"):
        inputs[Param.CLEARCOAT] = _input(context, shader, Param.CLEARCOAT, "clearcoat_weight", 1.0)
        inputs[Param.CLEARCOAT_ROUGHNESS] = _input(
            context, shader, Param.CLEARCOAT_ROUGHNESS, "clearcoat_reflection_roughness", 0.0
        )
    return _covered(context, shader, inputs)


def read_omni_glass(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """OmniGlass: always clear; its colour is taken for a tint.

    `depth`, the "volume absorption scale", is left: what length or strength it stands for is not published.
    """
    picture = _picture(context, shader, "glass_color_texture", color=True)
    rough = _picture(context, shader, "roughness_texture")
    share = _number(context, shader, "roughness_texture_influence", 1.0)
    frosting = _input(context, shader, Param.ROUGHNESS, "frosting_roughness", 0.0)
    if rough is not None and is_constant(frosting):
        frosting = scaled(single(rough, Channel.R), share, frosting.value[0] * (1.0 - share))
    tint = _input(context, shader, Param.TRANSMITTANCE, "glass_color", _WHITE)
    inputs = {
        Param.DIFFUSE: constant((0.0, 0.0, 0.0)),
        Param.ROUGHNESS: frosting,
        Param.IOR: _input(context, shader, Param.IOR, "glass_ior", 1.491),
        Param.TRANSMITTANCE: tint if picture is None else picture,
        Param.OPACITY: constant(0.0),
    }
    _normal(context, shader, "normal_map_texture", inputs)
    ignored = ("depth", "reflection_color", "enable_opacity", "cutout_opacity_texture")
    _note_authored(context, shader, "OmniGlass", ignored)
    return Surface(inputs=inputs, opacity_authored=True, glass=True, thin=_on(context, shader, "thin_walled"))


def read_omni_surface(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """OmniSurface and OmniSurfaceBase, Lite or not: modelled after Autodesk Standard Surface."""

    def mapped(param: Param, name: str, default: Value) -> Source:
        found = _picture(context, shader, f"{name}_image", color=isinstance(default, tuple))
        if found is None:
            return _input(context, shader, param, name, default)
        return found if isinstance(default, tuple) else single(found, Channel.R)

    color = mapped(Param.DIFFUSE, "diffuse_reflection_color", _WHITE)
    weight = max(_number(context, shader, "diffuse_reflection_weight", 0.8), 0.0)
    glow = _number(context, shader, "emission_weight", 0.0) * _number(context, shader, "emission_intensity", 1.0)
    inputs = {
        Param.DIFFUSE: scaled(color, weight),
        Param.METALLIC: mapped(Param.METALLIC, "metalness", 0.0),
        Param.ROUGHNESS: mapped(Param.ROUGHNESS, "specular_reflection_roughness", 0.2),
        Param.IOR: _input(context, shader, Param.IOR, "specular_reflection_ior", 1.5),
        Param.CLEARCOAT: mapped(Param.CLEARCOAT, "coat_weight", 0.0),
        Param.CLEARCOAT_ROUGHNESS: mapped(Param.CLEARCOAT_ROUGHNESS, "coat_roughness", 0.0),
        Param.EMISSIVE: scaled(mapped(Param.EMISSIVE, "emission_color", _WHITE), max(glow, 0.0)),
    }
    _normal(context, shader, "geometry_normal_image", inputs)
    ignored = ("specular_transmission_scattering_color", "subsurface_weight", "specular_retro_reflection_weight",
               "thin_film_thickness", "coat_color")  # fmt: skip
    _note_authored(context, shader, "OmniSurface", ignored)
    through = constant(0.0)
    if _on(context, shader, "enable_specular_transmission"):
        through = mapped(Param.OPACITY, "specular_transmission_weight", 0.0)
    if is_constant(through) and through.value[0] <= 0.0:
        names = ("geometry_opacity", "geometry_opacity_image", "geometry_opacity_threshold")
        return _covered(context, shader, inputs, *names)
    inputs[Param.OPACITY] = scaled(through, -1.0, 1.0)
    inputs[Param.TRANSMITTANCE] = mapped(Param.TRANSMITTANCE, "specular_transmission_color", _WHITE)
    depth = _number(context, shader, "specular_transmission_scattering_depth", 0.0) * unit
    return Surface(
        inputs=inputs,
        opacity_authored=True,
        glass=True,
        thin=_on(context, shader, "thin_walled"),
        absorption_distance=depth if depth > 0.0 else None,
        abbe=max(_number(context, shader, "specular_transmission_dispersion_abbe", 0.0), 0.0),
    )


def _preview(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    return read_preview_surface(context, shader)


READERS: dict[str, Callable[[Context, UsdShade.Shader, float], Surface]] = {
    "OmniPBR": read_omni_pbr,
    "OmniPBR_ClearCoat": read_omni_pbr,
    "OmniPBR_ClearCoat_Opacity": read_omni_pbr,
    "OmniPBR_Opacity": read_omni_pbr,
    "OmniPBR_Base": read_omni_pbr,
    "OmniPBRBase": read_omni_pbr,
    "OmniGlass": read_omni_glass,
    "OmniGlass_Opacity": read_omni_glass,
    "OmniSurface": read_omni_surface,
    "OmniSurfaceBase": read_omni_surface,
    "OmniSurfaceLite": read_omni_surface,
    "OmniSurfaceLiteBase": read_omni_surface,
    "OmniSurfaceUber": read_omni_surface,
    "UsdPreviewSurface": _preview,
}


def mdl_name(shader: UsdShade.Shader) -> str:
    """What a shader takes out of an MDL module, without the types of its parameters; '' where it is no MDL."""
    if shader.GetImplementationSource() != "sourceAsset":
        return ""
    name = str(shader.GetSourceAssetSubIdentifier("mdl") or "").partition("(")[0].rpartition("::")[2]
    if not name:  # a module's one material has the module's name
        asset = shader.GetSourceAsset("mdl")
        name = asset.path.rpartition("/")[2].removesuffix(".mdl") if asset else ""
    return name


# --- parts ---


def _input(context: Context, shader: UsdShade.Shader, param: Param, name: str, default: Value) -> Source:
    return clamped(context, param, read_source(context, shader.GetInput(name), default), f"inputs:{name}")


def _number(context: Context, shader: UsdShade.Shader, name: str, default: float) -> float:
    return read_number(context, shader.GetInput(name), default)


def _on(context: Context, shader: UsdShade.Shader, name: str) -> bool:
    return bool(read_constant(context, shader.GetInput(name), False))


def _picture(context: Context, shader: UsdShade.Shader, name: str, *, color: bool = False) -> Source | None:
    """The picture of an asset input, moved as all of the shader's are; None where it names none."""
    port = shader.GetInput(name)
    attribute = producer(context, port) if port else None
    if attribute is None or UsdShade.Output.IsOutput(attribute):
        return None
    value = attribute.Get(context.time)
    if value is None or not getattr(value, "path", ""):
        return None
    index = picture_index(context, attribute, "auto" if color else "raw", shader.GetPath())
    if index < 0:
        return None
    uv = _uv(context, shader)
    return in_tiles(context, Source(
        value=constant(_WHITE).value, texture=index, uv_primvar=uv.primvar, uv_value=uv.value, uv_matrix=uv.matrix
    ))  # fmt: skip


def _uv(context: Context, shader: UsdShade.Shader) -> Uv:
    """The texture coordinates: turned [deg], scaled and moved."""
    if _on(context, shader, "project_uvw"):
        note(context, f"MDL {mdl_name(shader)} projects its pictures (project_uvw), which is not followed; "
             "the texture coordinates are used")  # fmt: skip
    index = int(_number(context, shader, "uv_space_index", 0.0))
    angle = math.radians(_number(context, shader, "texture_rotate", 0.0))
    x, y = read_numbers(context, shader.GetInput("texture_scale"), (1.0, 1.0))
    u, v = read_numbers(context, shader.GetInput("texture_translate"), (0.0, 0.0))
    c, s = math.cos(angle), math.sin(angle)
    return Uv(f"st{index}" if index > 0 else "st").moved((x * c, -x * s, u, y * s, y * c, v))


def _either(
    context: Context, packed: Source | None, channel: Channel, shader: UsdShade.Shader, name: str
) -> Source | None:
    """A channel of the packed picture, else the red one of the picture of its own."""
    if packed is not None:
        return single(packed, channel)
    own = _picture(context, shader, name)
    return None if own is None else single(own, Channel.R)


def _influenced(
    context: Context, shader: UsdShade.Shader, packed: Source | None, channel: Channel, picture: str, name: str,
    default: float,
) -> Source:  # fmt: skip
    """Between a constant and a picture, by the picture's influence."""
    share = _number(context, shader, f"{name}_texture_influence", 0.0)
    even = _number(context, shader, f"{name}_constant", default)
    param = Param.ROUGHNESS if name.startswith("reflection") else Param.METALLIC
    found = _either(context, packed, channel, shader, picture) if share > 0.0 else None
    if found is None:
        return clamped(context, param, constant(even), f"inputs:{name}_constant")
    return scaled(found, share, even * (1.0 - share))


def _albedo(context: Context, shader: UsdShade.Shader) -> Source:
    """(picture + add) * brightness * tint, or the constant colour for the picture."""
    found = _picture(context, shader, "diffuse_texture", color=True)
    color = _input(context, shader, Param.DIFFUSE, "diffuse_color_constant", (0.2, 0.2, 0.2))
    if found is not None:
        bright = _number(context, shader, "albedo_brightness", 1.0)
        color = scaled(found, bright, _number(context, shader, "albedo_add", 0.0) * bright)
        if _number(context, shader, "albedo_desaturation", 0.0) != 0.0:
            note(context, "MDL albedo_desaturation of a picture is ignored")
    tinted = product(context, color, _input(context, shader, Param.DIFFUSE, "diffuse_tint", _WHITE))
    return color if tinted is None else tinted


def _ior_of(level: float) -> float:
    """The index whose reflectance at normal incidence is 0.08 times the specular level."""
    root = math.sqrt(min(max(0.08 * level, 0.0), 0.9))
    return (1.0 + root) / (1.0 - root)


def _glow(context: Context, shader: UsdShade.Shader) -> Source:
    """Emissive colour times intensity, or its picture, or where its mask is."""
    if not _on(context, shader, "enable_emission"):
        return constant((0.0, 0.0, 0.0))
    intensity = max(_number(context, shader, "emissive_intensity", 40.0), 0.0)
    color = _picture(context, shader, "emissive_color_texture", color=True)
    if color is None:
        color = _input(context, shader, Param.EMISSIVE, "emissive_color", (1.0, 0.1, 0.1))
    mask = _picture(context, shader, "emissive_mask_texture")
    if mask is not None:
        masked = product(context, color, spread(context, single(mask, Channel.R)))
        if masked is None:
            note(context, "MDL emissive_mask_texture is ignored, for the colour it masks is a picture too")
        color = color if masked is None else masked
    return linear(context, color, intensity)


def _normal(context: Context, shader: UsdShade.Shader, name: str, inputs: dict[Param, Source]) -> None:
    """Add a picture of normals, by its strength; a switch turns its second axis round."""
    found = _picture(context, shader, name)
    if found is None:
        return
    strength = _number(context, shader, "bump_factor", 1.0)
    x = -1.0 if _on(context, shader, "flip_tangent_u") else 1.0
    y = 1.0 if read_constant(context, shader.GetInput("flip_tangent_v"), True) else -1.0
    inputs[Param.NORMAL] = scaled(scaled(found, 2.0, -1.0), (x * strength, y * strength, 1.0, 1.0))


def _covered(
    context: Context, shader: UsdShade.Shader, inputs: dict[Param, Source], name: str = "opacity_constant",
    picture: str = "opacity_texture", threshold: str = "opacity_threshold",
) -> Surface:  # fmt: skip
    """Opaque, cut out, or partly there."""
    if not _on(context, shader, "enable_opacity"):
        return Surface(inputs=inputs)
    found = _picture(context, shader, picture)
    opacity = _input(context, shader, Param.OPACITY, name, 1.0)
    if found is not None:
        alpha = int(_number(context, shader, "opacity_mode", 1.0)) == 0  # mono_alpha
        opacity = single(found, Channel.A if alpha else Channel.R)
    limit = max(_number(context, shader, threshold, 0.0), 0.0)
    partly = lowest(opacity, context.textures) < 1.0
    return replace(
        Surface(inputs=inputs | {Param.OPACITY: opacity}), opacity_authored=True,
        opacity_presence=partly and limit <= 0.0, opacity_threshold=limit,
    )  # fmt: skip


def _note_authored(context: Context, shader: UsdShade.Shader, name: str, inputs: tuple[str, ...]) -> None:
    found = [one for one in inputs if producer(context, shader.GetInput(one)) is not None]
    if found:
        note(context, f"MDL {name} input {', '.join(found)} is ignored; the renderer does not read it")
