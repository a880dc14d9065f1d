"""OpenPBR, standard_surface and glTF PBR authored as UsdShade ND_* nodes, as `Surface` records."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from pxr import UsdShade

from ...scene import Param, Source
from .folding import mixed, product
from .nodes import read_source
from .sources import (
    Context,
    Value,
    constant,
    is_constant,
    kind_of,
    note,
    producer,
    read_constant,
    read_number,
    scalar,
    scaled,
)
from .surfaces import Surface, clamped, lowest

Named = tuple[str, Value]
"""An input's name and the nodedef's default; '' where the shader has no such input."""
_WHITE = (1.0, 1.0, 1.0)
_BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Naming:
    """How one shader calls what all of them have. Defaults are those of the MaterialX 1.39 nodedefs."""

    base_color: Named
    metallic: Named
    roughness: Named
    ior: Named
    emission_weight: Named
    emission_color: Named
    transmission: Named
    transmission_color: Named
    transmission_depth: Named
    coat: Named
    coat_roughness: Named
    normal: Named
    opacity: Named
    base_weight: Named = ("", 1.0)
    specular_weight: Named = ("", 1.0)
    occlusion: Named = ("", 1.0)
    subsurface: Named = ("", 0.0)
    subsurface_color: Named = ("", _WHITE)
    ignored: tuple[Named, ...] = ()
    """Inputs this renderer has no answer to, with the value that switches each off."""


OPEN_PBR = Naming(
    base_weight=("base_weight", 1.0),
    base_color=("base_color", (0.8, 0.8, 0.8)),
    metallic=("base_metalness", 0.0),
    roughness=("specular_roughness", 0.3),
    ior=("specular_ior", 1.5),
    specular_weight=("specular_weight", 1.0),
    emission_weight=("emission_luminance", 0.0),
    emission_color=("emission_color", _WHITE),
    transmission=("transmission_weight", 0.0),
    transmission_color=("transmission_color", _WHITE),
    transmission_depth=("transmission_depth", 0.0),
    coat=("coat_weight", 0.0),
    coat_roughness=("coat_roughness", 0.0),
    normal=("geometry_normal", (0.0, 0.0, 1.0)),
    opacity=("geometry_opacity", 1.0),
    subsurface=("subsurface_weight", 0.0),
    subsurface_color=("subsurface_color", (0.8, 0.8, 0.8)),
    ignored=(
        ("specular_color", _WHITE),
        ("specular_roughness_anisotropy", 0.0),
        ("transmission_scatter", _BLACK),
        ("fuzz_weight", 0.0),
        ("thin_film_weight", 0.0),
        ("coat_color", _WHITE),
    ),
)
STANDARD_SURFACE = Naming(
    base_weight=("base", 1.0),
    base_color=("base_color", (0.8, 0.8, 0.8)),
    metallic=("metalness", 0.0),
    roughness=("specular_roughness", 0.2),
    ior=("specular_IOR", 1.5),
    specular_weight=("specular", 1.0),
    emission_weight=("emission", 0.0),
    emission_color=("emission_color", _WHITE),
    transmission=("transmission", 0.0),
    transmission_color=("transmission_color", _WHITE),
    transmission_depth=("transmission_depth", 0.0),
    coat=("coat", 0.0),
    coat_roughness=("coat_roughness", 0.1),
    normal=("normal", (0.0, 0.0, 1.0)),
    opacity=("opacity", _WHITE),
    subsurface=("subsurface", 0.0),
    subsurface_color=("subsurface_color", _WHITE),
    ignored=(
        ("specular_color", _WHITE),
        ("specular_anisotropy", 0.0),
        ("transmission_scatter", _BLACK),
        ("transmission_extra_roughness", 0.0),
        ("sheen", 0.0),
        ("thin_film_thickness", 0.0),
        ("coat_color", _WHITE),
    ),
)
GLTF_PBR = Naming(
    base_color=("base_color", _WHITE),
    metallic=("metallic", 1.0),
    roughness=("roughness", 1.0),
    ior=("ior", 1.5),
    specular_weight=("specular", 1.0),
    emission_weight=("emissive_strength", 1.0),
    emission_color=("emissive", _BLACK),
    transmission=("transmission", 0.0),
    transmission_color=("attenuation_color", _WHITE),
    transmission_depth=("attenuation_distance", 0.0),
    coat=("clearcoat", 0.0),
    coat_roughness=("clearcoat_roughness", 0.0),
    normal=("normal", (0.0, 0.0, 1.0)),
    opacity=("alpha", 1.0),
    occlusion=("occlusion", 1.0),
    ignored=(
        ("specular_color", _WHITE),
        ("sheen_color", _BLACK),
        ("iridescence", 0.0),
        ("anisotropy_strength", 0.0),
    ),
)


def _source(context: Context, shader: UsdShade.Shader, named: Named) -> Source:
    return read_source(context, shader.GetInput(named[0]), named[1]) if named[0] else constant(named[1])


def _weight(context: Context, shader: UsdShade.Shader, named: Named) -> float:
    """A constant factor, at least 0."""
    assert isinstance(named[1], float)
    return max(read_number(context, shader.GetInput(named[0]), named[1]), 0.0) if named[0] else named[1]


def _product(context: Context, shader: UsdShade.Shader, color: Named, weight: Named) -> Source:
    """A colour times its weight, where at least one of them is a constant."""
    tint, factor = _source(context, shader, color), _source(context, shader, weight)
    if is_constant(factor):
        return scaled(tint, max(factor.value[0], 0.0))
    if (both := product(context, tint, factor)) is not None:
        return both
    note(context, f"{color[0]} and {weight[0]} are both mapped; the map of {weight[0]} is ignored")
    return tint


def _common(context: Context, shader: UsdShade.Shader, naming: Naming) -> dict[Param, Source]:
    """Everything that maps onto a UsdPreviewSurface input one to one."""
    inputs = {
        Param.DIFFUSE: _diffuse(context, shader, naming),
        Param.EMISSIVE: _product(context, shader, naming.emission_color, naming.emission_weight),
        Param.METALLIC: _source(context, shader, naming.metallic),
        Param.ROUGHNESS: _source(context, shader, naming.roughness),
        Param.CLEARCOAT: _source(context, shader, naming.coat),
        Param.CLEARCOAT_ROUGHNESS: _source(context, shader, naming.coat_roughness),
        Param.IOR: _source(context, shader, naming.ior),
        Param.NORMAL: _normal(context, shader, naming),
        Param.OCCLUSION: _source(context, shader, naming.occlusion),
    }
    labels = {Param.IOR: naming.ior[0], Param.ROUGHNESS: naming.roughness[0], Param.METALLIC: naming.metallic[0]}
    return {
        param: clamped(context, param, source, f"inputs:{labels.get(param, param.name.lower())}")
        for param, source in inputs.items()
    }


def _diffuse(context: Context, shader: UsdShade.Shader, naming: Naming) -> Source:
    """The base colour, and for the share that scatters below the surface the colour of that."""
    base = _product(context, shader, naming.base_color, naming.base_weight)
    share = _source(context, shader, naming.subsurface)
    if share == constant(0.0):
        return base
    found = mixed(context, _source(context, shader, naming.subsurface_color), base, share)
    what = f"{kind_of(shader)} {naming.subsurface[0]}"
    if found is None:
        note(context, f"{what} is ignored, for it and the colours it mixes are mapped")
        return base
    note(context, f"{what} is drawn as diffuse reflection of its colour, for nothing scatters below a surface here")
    return found


def _normal(context: Context, shader: UsdShade.Shader, naming: Naming) -> Source:
    """The normal where a map drives it; a constant there is a world direction, which is left alone."""
    source = _source(context, shader, naming.normal)
    return source if not is_constant(source) else constant((0.0, 0.0, 1.0))


def _see_through(inputs: dict[Param, Source], transmission: Source) -> bool:
    metal = inputs[Param.METALLIC]
    opaque = is_constant(transmission) and transmission.value[0] <= 0.0
    return not opaque and not (is_constant(metal) and metal.value[0] >= 1.0)


def _remaining(context: Context, naming: Naming, transmission: Source, metal: Source) -> Source:
    """Opacity: 1 - transmission * (1 - metal), where at least one of them is a constant."""
    if is_constant(metal):
        return scaled(transmission, metal.value[0] - 1.0, 1.0)
    if is_constant(transmission):
        return scaled(metal, transmission.value[0], 1.0 - transmission.value[0])
    note(context, f"{naming.transmission[0]} and {naming.metallic[0]} are both mapped; the metal transmits too")
    return scaled(transmission, -1.0, 1.0)


def _weakened_ior(ior: Source, weight: float) -> Source:
    """The ior whose normal reflectance is `weight` times that of `ior` (OpenPBR 1.1, specular weight)."""
    if not is_constant(ior) or weight == 1.0:
        return ior
    n = ior.value[0]
    root = min(math.sqrt(weight) * (n - 1.0) / (n + 1.0), 0.99)
    return constant((1.0 + root) / (1.0 - root))


def _volume(context: Context, shader: UsdShade.Shader, naming: Naming, unit: float) -> tuple[Source, float | None]:
    """TRANSMITTANCE and its distance [m]; no distance where the colour is a tint at any depth."""
    color = clamped(
        context, Param.TRANSMITTANCE, _source(context, shader, naming.transmission_color),
        f"inputs:{naming.transmission_color[0]}",
    )  # fmt: skip
    depth = _weight(context, shader, naming.transmission_depth) * unit
    if naming is GLTF_PBR:
        return _gltf_volume(context, shader, color, depth, unit)
    return color, depth if depth > 0.0 else None


def _gltf_volume(
    context: Context, shader: UsdShade.Shader, color: Source, depth: float, unit: float
) -> tuple[Source, float | None]:
    """The volume's colour and the base colour, which tints too: one colour, left after one thickness.

    Args:
        color: of the volume.
        depth: after which it is left [m]; 0 is infinite.
        unit: metres per scene unit.
    """
    white = constant(_WHITE)
    base = clamped(context, Param.TRANSMITTANCE, _source(context, shader, GLTF_PBR.base_color), "inputs:base_color")
    thickness = scalar(read_source(context, shader.GetInput("thickness"), 0.0))
    through = thickness.value[0] * unit if is_constant(thickness) else 0.0
    if depth <= 0.0 or color == white:  # only the base colour tints
        return base, through if through > 0.0 and base != white else None
    if base == white:
        return color, depth
    if through > 0.0 and is_constant(color):
        r, g, b = (left ** (through / depth) for left in color.value[:3])
        return scaled(base, (r, g, b, 1.0)), through
    note(context, "base_color tints the surface of a volume too, and is left out: that needs a thickness, and one "
         "colour for all of the volume")  # fmt: skip
    return color, depth


def _note_ignored(context: Context, shader: UsdShade.Shader, naming: Naming) -> None:
    """One notice about inputs that do something elsewhere: those not at their neutral value."""
    names = []
    for name, neutral in naming.ignored:
        attribute = producer(context, shader.GetInput(name))
        if attribute is None:
            continue
        off = read_source(context, shader.GetInput(name), neutral) == constant(neutral)
        if UsdShade.Output.IsOutput(attribute) or not off:
            names.append(name)
    if names:
        note(context, f"{kind_of(shader)} input {', '.join(names)} of {shader.GetShaderId()} is ignored; "
             "this renderer has no such effect")  # fmt: skip


def _coverage(context: Context, shader: UsdShade.Shader, naming: Naming) -> tuple[Source, bool, float]:
    """Presence: its source, whether it may be below 1, and a cut-out threshold (glTF alpha modes)."""
    source = scalar(_source(context, shader, naming.opacity))
    source = clamped(context, Param.OPACITY, source, f"inputs:{naming.opacity[0]}")
    mode = int(read_number(context, shader.GetInput("alpha_mode"), 0.0)) if naming is GLTF_PBR else 2
    if mode == 0 or lowest(source, context.textures) >= 1.0:
        return constant(1.0), False, 0.0
    threshold = read_number(context, shader.GetInput("alpha_cutoff"), 0.5) if mode == 1 else 0.0
    return source, mode != 1, threshold


def _read(context: Context, shader: UsdShade.Shader, naming: Naming, unit: float) -> Surface:
    """Glass where it transmits at all (then presence is ignored), else an opaque or cut-out surface."""
    inputs = _common(context, shader, naming)
    coverage, presence, threshold = _coverage(context, shader, naming)
    transmission = scalar(_source(context, shader, naming.transmission))
    transmission = clamped(context, Param.OPACITY, transmission, f"inputs:{naming.transmission[0]}")
    glass = _see_through(inputs, transmission)
    distance: float | None = None
    if glass:
        if presence or threshold > 0.0:
            note(context, f"inputs:{naming.opacity[0]} is ignored, because the material transmits light")
        presence, threshold = False, 0.0
        inputs[Param.OPACITY] = _remaining(context, naming, transmission, scalar(inputs[Param.METALLIC]))
        inputs[Param.TRANSMITTANCE], distance = _volume(context, shader, naming, unit)
    else:
        inputs[Param.OPACITY] = coverage
        inputs[Param.IOR] = _weakened_ior(inputs[Param.IOR], _weight(context, shader, naming.specular_weight))
    _note_ignored(context, shader, naming)
    return Surface(
        inputs=inputs,
        opacity_authored=producer(context, shader.GetInput(naming.transmission[0])) is not None,
        glass=glass,
        opacity_presence=presence,
        opacity_threshold=threshold,
        absorption_distance=distance,
    )


def read_open_pbr(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """OpenPBR 1.1: Abbe number divided by the dispersion scale; `unit` is metres per scene unit."""
    scale = read_number(context, shader.GetInput("transmission_dispersion_scale"), 0.0)
    abbe = read_number(context, shader.GetInput("transmission_dispersion_abbe_number"), 20.0)
    thin = bool(read_constant(context, shader.GetInput("geometry_thin_walled"), False))
    surface = _read(context, shader, OPEN_PBR, unit)
    return replace(surface, abbe=abbe / scale if scale > 0.0 else 0.0, thin=thin)


def read_standard_surface(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """Autodesk Standard Surface 1.0, and Arnold's; transmission_dispersion is the Abbe number, 0 for none."""
    abbe = read_number(context, shader.GetInput("transmission_dispersion"), 0.0)
    thin = bool(read_constant(context, shader.GetInput("thin_walled"), False))
    return replace(_read(context, shader, STANDARD_SURFACE, unit), abbe=max(abbe, 0.0), thin=thin)


def read_gltf_pbr(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """glTF PBR: dispersion = 20 / Abbe number (KHR_materials_dispersion); thickness 0 is a thin wall."""
    dispersion = read_number(context, shader.GetInput("dispersion"), 0.0)
    thickness = scalar(read_source(context, shader.GetInput("thickness"), 0.0))
    thin = is_constant(thickness) and thickness.value[0] <= 0.0
    surface = _read(context, shader, GLTF_PBR, unit)
    return replace(surface, abbe=20.0 / dispersion if dispersion > 0.0 else 0.0, thin=thin)


def read_unlit(context: Context, shader: UsdShade.Shader, unit: float) -> Surface:
    """MaterialX `surface_unlit`: it glows, and reflects nothing. What it transmits is left out."""
    color = _product(context, shader, ("emission_color", _WHITE), ("emission", 1.0))
    opacity = scalar(_source(context, shader, ("opacity", 1.0)))
    if read_source(context, shader.GetInput("transmission"), 0.0) != constant(0.0):
        note(context, "MaterialX input transmission of ND_surface_unlit is ignored")
    inputs = {
        Param.DIFFUSE: constant(_BLACK), Param.EMISSIVE: color, Param.OPACITY: opacity, Param.IOR: constant(1.0),
    }  # fmt: skip
    presence = lowest(opacity, context.textures) < 1.0
    return Surface(inputs=inputs, opacity_authored=True, opacity_presence=presence)


READERS: dict[str, Callable[[Context, UsdShade.Shader, float], Surface]] = {
    "ND_open_pbr_surface_surfaceshader": read_open_pbr,
    "ND_standard_surface_surfaceshader": read_standard_surface,
    "ND_gltf_pbr_surfaceshader": read_gltf_pbr,
    "ND_surface_unlit": read_unlit,
}
