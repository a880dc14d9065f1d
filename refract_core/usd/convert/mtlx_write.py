"""The materials of a stage as one MaterialX file: OpenPBR surfaces with what drives them.

The networks are those that `standard` writes into stages, so both say the same; here they become elements. Nothing but
the standard library of MaterialX 1.39 is used, and every connection is between ports of one type.
"""

from __future__ import annotations

import os
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from pxr import Ar, Sdf, Usd, UsdShade

from ...errors import ImageError
from ...scene import Notice, Texture
from ...version import __version__
from ..materials.read import read_material
from ..materials.textures import file_of
from ..stage import stage_unit, time_range
from ..values import free_name
from .author import Written
from .find import every_material
from .standard import write_open_pbr

_KINDS = {
    "float": "float", "int": "integer", "bool": "boolean", "string": "string", "token": "string", "asset": "filename",
    "color3f": "color3", "normal3f": "vector3", "float2": "vector2", "float3": "vector3", "float4": "color4",
}  # fmt: skip
"""Types of MaterialX by those of USD."""
_NODES = {
    "ND_open_pbr_surface_surfaceshader": ("open_pbr_surface", "surfaceshader", {}),
    "ND_UsdUVTexture_23": ("UsdUVTexture", "multioutput", dict.fromkeys("rgba", "float") | {"rgb": "color3"}),
    "ND_UsdPrimvarReader_float": ("UsdPrimvarReader", "float", {"out": "float"}),
    "ND_UsdPrimvarReader_vector2": ("UsdPrimvarReader", "vector2", {"out": "vector2"}),
    "ND_UsdPrimvarReader_vector3": ("UsdPrimvarReader", "vector3", {"out": "vector3"}),
    "ND_UsdTransform2d": ("UsdTransform2d", "vector2", {"out": "vector2"}),
    "ND_normalmap_float": ("normalmap", "vector3", {"out": "vector3"}),
}
"""Element, type, and types of the outputs by the definitions that are used."""


def write_mtlx(stage: Usd.Stage, out: str, folder: str) -> Written:
    """The bytes of a .mtlx file.

    Args:
        stage: with RefractMaterialAPI on its glass. Lengths stay in its unit, for MaterialX has none.
        out: where it will lie; pictures are named as seen from there.
        folder: for pictures that lie in a package.
    """
    time, unit = Usd.TimeCode(time_range(stage)[0]), stage_unit(stage, [])
    textures: dict[str, Texture] = {}
    notices: list[Notice] = []
    notes: dict[str, tuple[str, ...]] = {}
    elements: list[str] = []
    files = _Files(os.path.dirname(os.path.abspath(out)), folder, {}, {})
    taken: set[str] = set()
    for prim in every_material(stage):
        record = read_material(
            UsdShade.Material(prim), time, metres_per_unit=unit, closed=True, textures=textures, notices=notices
        )
        name = _free(prim.GetName(), taken)
        scratch = Usd.Stage.CreateInMemory()
        made = UsdShade.Material.Define(scratch, f"/{name}")
        notes[str(prim.GetPath())] = tuple(write_open_pbr(scratch.GetRootLayer(), made, record, textures, unit))
        try:
            elements += _elements(scratch, name, taken, files)
        except ImageError as error:
            notes[str(prim.GetPath())] = (*notes[str(prim.GetPath())], f"MaterialX: not written: {error}")
    if not notes:
        notices.append(Notice(out, "the stage has no material, so there is nothing in the MaterialX file"))
    head = [
        '<?xml version="1.0"?>', f"<!-- refract {__version__}; lengths are in units of {unit:g} m -->",
        '<materialx version="1.39" colorspace="lin_rec709">', *elements, "</materialx>", "",
    ]  # fmt: skip
    return Written("\n".join(head).encode(), tuple(dict.fromkeys(notices)), notes, files.taken)


class _Files(NamedTuple):
    """Where pictures lie, and which are to be written."""

    home: str
    """Folder of the file"""
    folder: str
    taken: dict[str, bytes]
    """Pictures to write, by path"""
    moved: dict[str, str]
    """Where those of packages go"""

    def name(self, path: str) -> str:
        """A picture as the file names it. Raises ImageError where it lies in a package, and cannot be read there."""
        if Ar.IsPackageRelativePath(path):
            if path not in self.moved:
                inner = os.path.basename(Ar.SplitPackageRelativePathInner(path)[1])
                content = file_of(path)
                assert isinstance(content, bytes)
                self.moved[path] = os.path.join(self.folder, f"{len(self.taken)}_{inner}")
                self.taken[self.moved[path]] = content
            path = self.moved[path]
        return os.path.relpath(path, self.home).replace(os.sep, "/") if os.path.isabs(path) else path


def _free(name: str, taken: set[str]) -> str:
    """A name that no element has; it is taken then."""
    unique = free_name(name, taken)
    taken.add(unique)
    return unique


def _elements(stage: Usd.Stage, name: str, taken: set[str], files: _Files) -> list[str]:
    """The nodes of one material, and itself."""
    material = UsdShade.Material(stage.GetPrimAtPath(f"/{name}"))
    surface = material.ComputeSurfaceSource("mtlx")[0]
    shaders = [UsdShade.Shader(prim) for prim in material.GetPrim().GetChildren()]
    names = {str(shader.GetPath()): _free(f"{name}_{shader.GetPrim().GetName()}", taken) for shader in shaders}
    found: list[str] = []
    if not surface:
        return found
    for shader in shaders:
        element, kind, _ = _NODES[str(shader.GetShaderId())]
        own = names[str(shader.GetPath())]
        inside = []
        for port in shader.GetInputs():
            inside.append(_input(port, own, names, taken, found, files))
        found += [f"  <{element} name={quoteattr(own)} type={quoteattr(kind)}>", *inside, f"  </{element}>"]
    found.append(f'  <surfacematerial name={quoteattr(name)} type="material">')
    source = quoteattr(names[str(surface.GetPath())])
    found.append(f'    <input name="surfaceshader" type="surfaceshader" nodename={source} />')
    return [*found, "  </surfacematerial>"]


def _input(
    port: UsdShade.Input, owner: str, names: dict[str, str], taken: set[str], elements: list[str], files: _Files
) -> str:
    """An input with its value or what drives it; where types differ, a `convert` goes before."""
    kind = _KINDS[str(port.GetTypeName())]
    head = f"    <input name={quoteattr(port.GetBaseName())} type={quoteattr(kind)}"
    sources = port.GetConnectedSources()[0]
    if not sources:
        value = port.Get()
        text = files.name(value.path) if isinstance(value, Sdf.AssetPath) else _text(value)
        space = f" colorspace={quoteattr(port.GetAttr().GetColorSpace())}" if port.GetAttr().HasColorSpace() else ""
        return f"{head} value={quoteattr(text)}{space} />"
    shader = UsdShade.Shader(sources[0].source.GetPrim())
    _, whole, outputs = _NODES[str(shader.GetShaderId())]
    source, output = names[str(shader.GetPath())], str(sources[0].sourceName)
    which = f" output={quoteattr(output)}" if whole == "multioutput" else ""
    if outputs[output] != kind:
        convert = _free(f"{owner}_{port.GetBaseName()}", taken)
        inner = f'<input name="in" type={quoteattr(outputs[output])} nodename={quoteattr(source)}{which} />'
        elements += [f"  <convert name={quoteattr(convert)} type={quoteattr(kind)}>", f"    {inner}", "  </convert>"]
        source, which = convert, ""
    return f"{head} nodename={quoteattr(source)}{which} />"


def _text(value: Any) -> str:
    """A value as MaterialX writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return value
    if hasattr(value, "__len__"):
        return ", ".join(_number(float(part)) for part in value)
    return str(value) if isinstance(value, int) else _number(float(value))


def _number(value: float) -> str:
    """As few digits as give the same float32."""
    few = f"{value:.7g}"
    return few if np.float32(few) == np.float32(value) else f"{value:.9g}"


