"""Materials written as a few lines of usda, read; shared by the tests of materials."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from pxr import Usd, UsdShade

from refract_core.scene import Material, Notice, Param, Source, Texture
from refract_core.usd.materials.read import read_material

HEADER = "#usda 1.0\n"


def write_png(path: Path, pixels: list[list[tuple[int, ...]]]) -> None:
    array = np.array(pixels, np.uint8)
    height, width, channels = array.shape
    file = oiio.ImageOutput.create(str(path))
    assert file is not None
    assert file.open(str(path), oiio.ImageSpec(width, height, channels, oiio.UINT8))
    assert file.write_image(array)
    file.close()


class Reading:
    """One material, read; with the notices and textures that came with it."""

    def __init__(self, stage: Usd.Stage, *, metres_per_unit: float = 1.0, closed: bool = True, time: float = 0.0):
        self.notices: list[Notice] = []
        self.textures: dict[str, Texture] = {}
        self.material: Material = read_material(
            UsdShade.Material(stage.GetPrimAtPath("/M")),
            Usd.TimeCode(time),
            metres_per_unit=metres_per_unit,
            closed=closed,
            textures=self.textures,
            notices=self.notices,
        )

    def __getitem__(self, param: Param) -> Source:
        return self.material.inputs[param]

    @property
    def texts(self) -> str:
        return "\n".join(f"{n.path}: {n.text}" for n in self.notices)


def stage_of(inner: str, *, api: bool = False) -> Usd.Stage:
    applied = '(prepend apiSchemas = ["RefractMaterialAPI"])' if api else ""
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(f'{HEADER}def Material "M" {applied}\n{{\n{inner}\n}}\n')
    return stage


def shader(inputs: str, *, identifier: str = "UsdPreviewSurface", output: str = "surface") -> str:
    return f"""
    token outputs:{output}.connect = </M/S.outputs:out>
    def Shader "S"
    {{
        uniform token info:id = "{identifier}"
        {inputs}
        token outputs:out
    }}
    """


def preview(inputs: str = "", more: str = "", **how: object) -> Reading:
    return Reading(stage_of(shader(inputs) + more), **how)  # type: ignore[arg-type]


def api(attributes: str, inputs: str = "", **how: object) -> Reading:
    return Reading(stage_of(attributes + shader(inputs), api=True), **how)  # type: ignore[arg-type]
