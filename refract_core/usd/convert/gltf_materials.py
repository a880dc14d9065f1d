"""Materials as glTF has them: factors, the KHR extensions of glass, and pictures baked into the channels it wants."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...images.pictures import png_bytes
from ...images.srgb import linear_pixels, srgb_encode
from ...models import Behind
from ...scene import F32, Channel, Material, Param, Source, Texture, Wrap
from ..values import free_name, neat

_WRAPS = {Wrap.CLAMP: 33071, Wrap.MIRROR: 33648, Wrap.REPEAT: 10497, Wrap.BLACK: 33071}
_WHITE = (1.0, 1.0, 1.0)
_PICTURED = (
    Param.DIFFUSE, Param.TRANSMITTANCE, Param.METALLIC, Param.ROUGHNESS, Param.NORMAL, Param.OCCLUSION, Param.EMISSIVE,
    Param.OPACITY, Param.THICKNESS, Param.CLEARCOAT, Param.CLEARCOAT_ROUGHNESS,
)  # fmt: skip
"""What glTF has a picture for."""


class Uv(NamedTuple):
    """One set of texture coordinates."""

    primvar: str
    matrix: tuple[float, float, float, float, float, float]
    value: tuple[float, float]


def _uv(source: Source) -> Uv:
    return Uv(source.uv_primvar, source.uv_matrix, source.uv_value)


def uvs_of(material: Material) -> list[Uv]:
    """The coordinates that a material's pictures are looked up at, in the order of their sets."""
    sources = (material.inputs[param] for param in _PICTURED)
    return list(dict.fromkeys(_uv(source) for source in sources if source.texture >= 0))


class _One(NamedTuple):
    """A material that is being written."""

    material: Material
    thickness: float
    """[m]"""
    uvs: list[Uv]

    @property
    def power(self) -> float:
        """What takes a tint from its own distance to one thickness (Beer-Lambert)."""
        distance = self.material.absorption_distance
        return self.thickness / distance if self.thickness > 0.0 and distance > 0.0 else 1.0


class Maker:
    """Makes the materials of one file, with their textures."""

    def __init__(self, view: Callable[[bytes], int], textures: list[Texture], ways: dict[int, float]) -> None:
        """Args:
            view: puts bytes into the file.
            textures: of the stage.
            ways: mean way [m] through the bodies of a row of its material table.
        """
        self._view = view
        self._textures, self._ways = textures, ways
        self._materials: list[dict[str, Any]] = []
        self._numbers: dict[tuple[int, bool, float | None], int] = {}
        self._names: set[str] = set()
        self._images: dict[bytes, int] = {}
        self._samplers: list[dict[str, int]] = []
        self._of_textures: dict[tuple[int, int], int] = {}
        self._views: list[int] = []
        self._used: set[str] = set()
        self._notes: dict[str, dict[str, None]] = {}

    def number(self, row: int, material: Material, own: F32 | None, *, painted: bool, two_sided: bool) -> int:
        """Place of a material in the file; prims that have a thickness of their own get one for each.

        Args:
            row: its number in the stage's table.
            own: the thickness [m] that a prim has of its own.
            painted: the vertices have its base colour.
            two_sided: it is on something open.
        """
        thickness = neat(float(np.median(own))) if own is not None and material.model.sized else None
        key = row, painted, thickness
        if key not in self._numbers:
            one = _One(material, self._thickness(material, self._ways.get(row, 0.0), thickness), uvs_of(material))
            made = self._made(one, painted=painted)
            if two_sided:
                made["doubleSided"] = True
            self._numbers[key] = len(self._materials)
            self._materials.append(made)
            if own is not None and thickness is not None and np.ptp(own) > 0.01 * thickness:
                self._say(one, "a thickness that varies over a prim is left out; its median is written")
        return self._numbers[key]

    def parts(self) -> dict[str, list[Any]]:
        """What goes into the file."""
        return {
            "materials": self._materials,
            "textures": [{"source": image, "sampler": sampler} for image, sampler in self._of_textures],
            "images": [{"bufferView": view, "mimeType": "image/png"} for view in self._views],
            "samplers": self._samplers,
            "extensionsUsed": sorted(self._used),
        }

    def told(self) -> dict[str, tuple[str, ...]]:
        """What could not be written, by material."""
        return {path: tuple(notes) for path, notes in self._notes.items()}

    # --- one material ---

    def _made(self, one: _One, *, painted: bool) -> dict[str, Any]:
        material = one.material
        inputs = material.inputs
        made: dict[str, Any] = {"name": self._name(material.name)}
        core = self._base(one, painted=painted) | self._metal(one)
        made["pbrMetallicRoughness"] = core
        if inputs[Param.NORMAL].texture >= 0:
            made["normalTexture"] = self._picture(one, inputs[Param.NORMAL], lambda v: v * 0.5 + 0.5)
        if inputs[Param.OCCLUSION].texture >= 0:
            made["occlusionTexture"] = self._picture(one, inputs[Param.OCCLUSION], _grey)
        extensions = self._glass(one) if material.refractive else {}
        made |= self._emission(one, extensions)
        self._coat(one, extensions)
        if extensions:
            made["extensions"] = extensions
            self._used |= extensions.keys()
        if material.opacity_threshold > 0.0:
            made |= {"alphaMode": "MASK", "alphaCutoff": neat(material.opacity_threshold)}
        elif material.opacity_presence:
            made["alphaMode"] = "BLEND"
        if material.specular_workflow:
            self._say(one, "its specular colour is left out; metal and base colour are written")
        return made

    def _thickness(self, material: Material, way: float, own: float | None) -> float:
        """[m]; 0 is a wall without one. Where a model needs none it is the mean way through its bodies."""
        source = material.inputs[Param.THICKNESS]
        if not material.refractive or material.model.behind is Behind.SHEET:
            return 0.0
        if not material.model.sized:  # a picture of what is left stays as it is after its own distance
            mapped = material.inputs[Param.TRANSMITTANCE].driven
            return material.absorption_distance if mapped or way <= 0.0 else way
        if source.texture >= 0:
            return max(float(self._number(source).max()), 0.0)
        return source.value[0] if own is None else own

    def _name(self, path: str) -> str:
        name = free_name(path.rpartition("/")[2] or "Material", self._names)
        self._names.add(name)
        return name

    def _say(self, one: _One, text: str) -> None:
        self._notes.setdefault(one.material.name, {})[f"glTF: {text}"] = None

    def _one_number(self, one: _One, param: Param) -> float:
        """A number that glTF has no picture for, or none that is followed."""
        source = one.material.inputs[param]
        if source.driven:
            self._say(one, f"what drives its {param.name.lower()} is left out; one number is written")
        return neat(source.value[0])

    def _base(self, one: _One, *, painted: bool) -> dict[str, Any]:
        """The base colour with its alpha. It tints glass too: so there it is the tint of a wall, or one that a picture
        drives, as it is left after one thickness."""
        inputs = one.material.inputs
        white = Source(value=(*_WHITE, 1.0))
        if not one.material.refractive:
            opacity = inputs[Param.OPACITY]
            return self._with_alpha(one, white if painted else inputs[Param.DIFFUSE], opacity)
        tint = inputs[Param.TRANSMITTANCE]
        if one.material.model.behind is Behind.SHEET or tint.driven:
            return self._with_alpha(one, tint, white, lambda v: v**one.power)
        left = inputs[Param.OPACITY]
        if (left.driven or left.value[0] > 0.0) and inputs[Param.DIFFUSE].value[:3] != _WHITE:
            self._say(one, "the colour of what it does not let through is left out, for it would tint the glass")
        return self._with_alpha(one, white, white)

    def _with_alpha(
        self, one: _One, source: Source, alpha: Source, change: Callable[[F32], F32] = lambda v: v
    ) -> dict[str, Any]:
        """Base colour and alpha as factors or a picture."""
        seen = 1.0 if alpha.driven else neat(alpha.value[0])
        if source.primvar and source.texture < 0:
            self._say(one, f"the primvar {source.primvar} is left out; one colour is written")
        values = np.clip(self._color(source), 0.0, 1.0) if source.texture >= 0 else None
        through = self._number(alpha) if alpha.texture >= 0 else None
        if values is None and through is None:
            return {"baseColorFactor": [*map(neat, change(np.array(source.value[:3])).tolist()), seen]}
        if values is None:
            assert through is not None
            values, source = np.broadcast_to(np.array(source.value[:3], np.float32), (*through.shape, 3)), alpha
        elif through is not None and (_uv(alpha) != _uv(source) or through.shape != values.shape[:2]):
            self._say(one, "the picture of its opacity lies elsewhere than that of its colour, and is left out")
            through = None
        planes = srgb_encode(np.clip(change(values), 0.0, 1.0).astype(np.float32))
        planes = planes if through is None else np.dstack((planes, through))
        return {"baseColorTexture": self._texture(one, planes, source), "baseColorFactor": [1.0, 1.0, 1.0, seen]}

    def _metal(self, one: _One) -> dict[str, Any]:
        """Roughness in green and metal in blue of one picture, by the coordinates of the first that has one."""
        rough, metal = one.material.inputs[Param.ROUGHNESS], one.material.inputs[Param.METALLIC]
        pictured = [source for source in (rough, metal) if source.texture >= 0]
        if not pictured:
            metallic, roughness = self._one_number(one, Param.METALLIC), self._one_number(one, Param.ROUGHNESS)
            return {"metallicFactor": metallic, "roughnessFactor": roughness}
        shape = self._textures[pictured[0].texture].pixels.shape[:2]
        planes = np.zeros((*shape, 3), np.float32)
        for column, source in ((1, rough), (2, metal)):
            planes[..., column] = source.value[0]
            if source.texture >= 0 and _uv(source) == _uv(pictured[0]):
                plane = self._number(source)
                rows, columns = (np.arange(n) * m // n for n, m in zip(shape, plane.shape, strict=True))
                planes[..., column] = plane[rows[:, None], columns]
            elif source.driven:
                self._say(one, "what drives its metal is no picture beside that of its roughness, and is left out")
        return {"metallicFactor": 1.0, "roughnessFactor": 1.0,
                "metallicRoughnessTexture": self._texture(one, planes, pictured[0])}  # fmt: skip

    def _glass(self, one: _One) -> dict[str, Any]:
        """The extensions that light passes by."""
        material, inputs = one.material, one.material.inputs
        opacity, tint, depth = inputs[Param.OPACITY], inputs[Param.TRANSMITTANCE], inputs[Param.THICKNESS]
        metal = inputs[Param.METALLIC]  # of which glTF lets none through, and here that is in the opacity already
        rest = 1.0 - metal.value[0] if not metal.driven and metal.value[0] < 1.0 else 1.0
        if opacity.texture >= 0:
            picture = self._picture(one, opacity, lambda v: _grey((1.0 - v) / rest))
            through: dict[str, Any] = {"transmissionFactor": 1.0, "transmissionTexture": picture}
        else:
            through = {"transmissionFactor": neat(min((1.0 - self._one_number(one, Param.OPACITY)) / rest, 1.0))}
        found: dict[str, Any] = {
            "KHR_materials_transmission": through,
            "KHR_materials_ior": {"ior": self._one_number(one, Param.IOR)},
        }
        if material.model.behind is Behind.SHEET:
            return found
        if material.model.behind is Behind.SCENE:
            self._say(one, f"'{material.model.token}' is written as a volume, which glTF has instead")
        volume: dict[str, Any] = {"thicknessFactor": neat(one.thickness)}
        if material.model.sized and depth.texture >= 0 and one.thickness > 0.0:
            volume["thicknessTexture"] = self._picture(one, depth, lambda v: _grey(v / one.thickness))
        if not tint.driven and tint.value[:3] != _WHITE:
            volume["attenuationColor"] = [neat(min(max(value, 0.0), 1.0)) for value in tint.value[:3]]
            volume["attenuationDistance"] = neat(material.absorption_distance)
        found["KHR_materials_volume"] = volume
        if material.abbe > 0.0:
            found["KHR_materials_dispersion"] = {"dispersion": neat(20.0 / material.abbe)}
        return found

    def _emission(self, one: _One, extensions: dict[str, Any]) -> dict[str, Any]:
        """The emissive factor, which is 1 at most; what is more is an extension."""
        source = one.material.inputs[Param.EMISSIVE]
        if source.texture >= 0:
            most = max(float(self._color(source).max()), 1.0e-6)
            picture = self._texture(one, srgb_encode(np.clip(self._color(source) / most, 0.0, 1.0)), source)
            made: dict[str, Any] = {"emissiveTexture": picture, "emissiveFactor": [min(most, 1.0)] * 3}
        else:
            if source.primvar:
                self._say(one, "the primvar that drives its emission is left out; one colour is written")
            most = max(source.value[:3])
            if most <= 0.0:
                return {}
            made = {"emissiveFactor": [neat(max(value, 0.0) / max(most, 1.0)) for value in source.value[:3]]}
        if most > 1.0:
            extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": neat(most)}
        return made

    def _coat(self, one: _One, extensions: dict[str, Any]) -> None:
        if (coat := self._one_number(one, Param.CLEARCOAT)) > 0.0:
            rough = self._one_number(one, Param.CLEARCOAT_ROUGHNESS)
            extensions["KHR_materials_clearcoat"] = {"clearcoatFactor": coat, "clearcoatRoughnessFactor": rough}

    # --- pictures ---

    def _picture(self, one: _One, source: Source, change: Callable[[F32], F32]) -> dict[str, int]:
        """A picture of numbers, changed."""
        return self._texture(one, change(self._color(source)), source)

    def _number(self, source: Source) -> F32:
        """The one channel of a picture that is used, shape (H, W)."""
        return self._values(source)[..., _channel(source)]

    def _color(self, source: Source) -> F32:
        """Three channels; of a source that uses one, that one three times."""
        if source.channel is Channel.RGB:
            return self._values(source)[..., :3]
        return np.repeat(self._number(source)[..., None], 3, axis=2)

    def _values(self, source: Source) -> F32:
        """A picture with its factor and offset, linear, shape (H, W, 4)."""
        out = linear_pixels(self._textures[source.texture])
        return np.asarray(out * np.array(source.scale, np.float32) + np.array(source.bias, np.float32), np.float32)

    def _texture(self, one: _One, planes: NDArray[Any], source: Source) -> dict[str, int]:
        """A textureInfo of a picture of 0 .. 1; equal pictures are one."""
        content = png_bytes(np.asarray(np.clip(planes, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
        if content not in self._images:
            self._images[content] = len(self._views)
            self._views.append(self._view(content))
        wrap = {"wrapS": _WRAPS[source.wrap[0]], "wrapT": _WRAPS[source.wrap[1]]}
        if wrap not in self._samplers:
            self._samplers.append(wrap)
        key = self._images[content], self._samplers.index(wrap)
        number = self._of_textures.setdefault(key, len(self._of_textures))
        place = one.uvs.index(_uv(source))
        return {"index": number} | ({"texCoord": place} if place else {})


def _channel(source: Source) -> int:
    return 0 if source.channel is Channel.RGB else int(source.channel)


def _grey(values: F32) -> F32:
    """One number in every channel: glTF looks for it in another one each time."""
    return np.repeat(values[..., :1], 3, axis=2)
