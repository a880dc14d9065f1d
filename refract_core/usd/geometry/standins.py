"""What stands for a model whose draw mode asks for cards, its bounds or its origin: a prim of a stage in memory.

Sources: UsdGeomModelAPI (draw modes, cards geometry, card visibility); what that leaves open is as in OpenUSD's own
UsdImaging: s runs to the right and t upwards for who looks at a face from outside with Z up, and a picture is cut out
where its alpha is under 0.1.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from ...errors import ImageError
from ...scene import F64, Notice
from ..materials.textures import resolve_asset, screen_of

CARDS, BOUNDS, ORIGIN = "cards", "bounds", "origin"
MODES = (CARDS, BOUNDS, ORIGIN)
INHERITED = UsdGeom.Tokens.inherited
_PROJECTED = UsdGeom.Tokens.fromTexture
ROOT = "/refract_draw_modes"
"""Of their stage; below it they have the paths of the first models that asked for them."""
_FACES = ("XPos", "YPos", "ZPos", "XNeg", "YNeg", "ZNeg")
_PURPOSES = [UsdGeom.Tokens.default_, UsdGeom.Tokens.proxy, UsdGeom.Tokens.render]
_THRESHOLD = 0.1
"""Alpha under which a card is not there."""
_GAP = 1.0e-4
"""Between the two cards of a cross that look opposite ways, of the model's size: each hides the other from its side."""
_THIN = 0.006
"""Width of the lines of `bounds`, of the box's diagonal, and of those of `origin`, of their length."""
_RIGHT_UP = {
    "XPos": ((0, 1, 0), (0, 0, 1)), "XNeg": ((0, -1, 0), (0, 0, 1)), "YPos": ((-1, 0, 0), (0, 0, 1)),
    "YNeg": ((1, 0, 0), (0, 0, 1)), "ZPos": ((1, 0, 0), (0, 1, 0)), "ZNeg": ((1, 0, 0), (0, -1, 0)),
}  # fmt: skip
"""Which way s and t run on each face."""
_CORNERS = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
"""Their s and t, counter-clockwise seen from outside."""


def handed_down(prim: Usd.Prim, name: str, above: str) -> str:
    """A `model:` attribute, `drawMode` or `cardVisibility`, that holds at a prim and is handed to its children."""
    said = str(_said(prim, name, INHERITED))
    return above if said == INHERITED else said


def takes(prim: Usd.Prim) -> bool:
    """Whether a draw mode takes effect at a prim: where `model:applyDrawMode` says so, and at components that are
    silent about it."""
    if not prim.IsModel() or prim.IsPseudoRoot():
        return False
    said = prim.GetAttribute("model:applyDrawMode")
    return bool(said.Get()) if said and said.HasAuthoredValue() else prim.IsComponent()


def is_replaced(prim: Usd.Prim) -> bool:
    """Something stands for a prim and all that is below it."""
    return takes(prim) and UsdGeom.ModelAPI(prim).ComputeModelDrawMode() in MODES


class _Asked(NamedTuple):
    """All that a stand-in is made of: models that ask for the same share it."""

    mode: str
    color: Gf.Vec3f
    box: tuple[float, ...]
    """Lowest and highest corner in the model's own space"""
    geometry: str
    hidden: str
    """The axis whose cards are not seen; '' for none"""
    pictures: tuple[tuple[str, str], ...]
    """Faces and files"""


class StandIns:
    """The stage that they are made in, and which there are."""

    def __init__(self, stage: Usd.Stage, notices: list[Notice]) -> None:
        self.stage = Usd.Stage.CreateInMemory()
        self._up = str(UsdGeom.GetStageUpAxis(stage))
        self._notices = notices
        self._boxes = UsdGeom.BBoxCache(Usd.TimeCode.EarliestTime(), _PURPOSES, useExtentsHint=True)
        self._made: dict[_Asked, Usd.Prim | None] = {}

    def of(self, model: Usd.Prim, mode: str, cards: str) -> Usd.Prim | None:
        """What is drawn for a model, in its space; None, with a notice, where that is nothing.

        Args:
            mode: one of `MODES`
            cards: its `model:cardVisibility`
        """
        color = Gf.Vec3f(_said(model, "drawModeColor", (0.18, 0.18, 0.18)))
        geometry = str(_said(model, "cardGeometry", UsdGeom.Tokens.cross)) if mode == CARDS else ""
        box = self._box(model) if mode == BOUNDS or geometry not in ("", _PROJECTED) else ()
        hidden = self._up if mode == CARDS and cards == "simple" else ""
        asked = _Asked(mode, color, box, geometry, hidden, tuple(_pictures(model)) if mode == CARDS else ())
        if asked not in self._made:
            self._made[asked] = self._make(asked, str(model.GetPath()))
        return self._made[asked]

    def _make(self, asked: _Asked, model: str) -> Usd.Prim | None:
        path = f"{ROOT}{model}"
        if asked.mode == ORIGIN:
            return self._lines(path, [(np.zeros(3), axis) for axis in np.eye(3)], _THIN, asked.color)
        low, high = np.array(asked.box[:3]), np.array(asked.box[3:])
        if not (low <= high).all():
            self._notices.append(Notice(model, f"model:drawMode is {asked.mode}, but it has no extent: skipped"))
            return None
        if asked.mode == BOUNDS:
            return self._lines(path, _edges(low, high), _THIN * float(np.linalg.norm(high - low)), asked.color)
        pictures = dict(asked.pictures)
        if asked.geometry == _PROJECTED:
            quads = self._projected(model, pictures)
        else:
            quads = _quads(low, high, pictures, cross=asked.geometry == UsdGeom.Tokens.cross)
        quads = {face: quad for face, quad in quads.items() if face[0] != asked.hidden}
        return self._cards(path, quads, pictures, asked.color) if quads else None

    def _box(self, model: Usd.Prim) -> tuple[float, ...]:
        """Lowest and highest corner in the model's own space; the one above the other where there is nothing."""
        box = self._boxes.ComputeUntransformedBound(model).ComputeAlignedRange()
        return (*box.GetMin(), *box.GetMax())

    def _lines(self, path: str, lines: list[tuple[F64, F64]], width: float, color: Gf.Vec3f) -> Usd.Prim:
        curves = UsdGeom.BasisCurves.Define(self.stage, path)
        curves.CreateTypeAttr(UsdGeom.Tokens.linear)
        curves.CreatePointsAttr([Gf.Vec3f(*map(float, point)) for line in lines for point in line])
        curves.CreateCurveVertexCountsAttr([2] * len(lines))
        curves.CreateWidthsAttr([width])
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        curves.CreateDisplayColorAttr([color])
        return curves.GetPrim()

    def _projected(self, model: str, pictures: dict[str, str]) -> dict[str, F64]:
        """Cards that lie where their pictures say: the square of the picture's screen, taken back to the model."""
        quads = {}
        for face, picture in pictures.items():
            try:
                back = np.linalg.inv(screen_of(picture))
            except (ImageError, np.linalg.LinAlgError) as error:
                self._notices.append(Notice(model, f"its card {face} is left out: {error}"))
                continue
            corners = np.array([(2.0 * s - 1.0, 2.0 * t - 1.0, 0.0, 1.0) for s, t in _CORNERS]) @ back
            quads[face] = corners[:, :3] / corners[:, 3:]
        return quads

    def _cards(self, path: str, quads: dict[str, F64], pictures: dict[str, str], color: Gf.Vec3f) -> Usd.Prim:
        mesh = UsdGeom.Mesh.Define(self.stage, path)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        points = np.concatenate(list(quads.values())).astype(np.float32)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points)))
        mesh.CreateFaceVertexCountsAttr([4] * len(quads))
        mesh.CreateFaceVertexIndicesAttr(list(range(4 * len(quads))))
        mesh.CreateDisplayColorAttr([color])
        st = [pair for face in quads for pair in _coordinates(face, pictures)]
        primvars = UsdGeom.PrimvarsAPI(mesh)
        primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex).Set(st)
        for number, face in enumerate(quads):
            if (shown := _shown(face, pictures)) in pictures:
                subset = UsdGeom.Subset.CreateGeomSubset(mesh, face, UsdGeom.Tokens.face, [number], "materialBind")
                material = self._material(f"{path}/cardTexture{shown}", pictures[shown], color)
                UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
        return mesh.GetPrim()

    def _material(self, path: str, picture: str, color: Gf.Vec3f) -> UsdShade.Material:
        material = UsdShade.Material.Define(self.stage, path)
        surface = UsdShade.Shader.Define(self.stage, f"{path}/Surface")
        texture = UsdShade.Shader.Define(self.stage, f"{path}/Texture")
        reader = UsdShade.Shader.Define(self.stage, f"{path}/Coordinates")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(picture))
        texture.CreateInput("fallback", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*color, 1.0))
        for wrap in ("wrapS", "wrapT"):
            texture.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("clamp")
        coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
        surface.CreateIdAttr("UsdPreviewSurface")
        surface.CreateInput("opacityThreshold", Sdf.ValueTypeNames.Float).Set(_THRESHOLD)
        for name, kind, output, given in (
            ("diffuseColor", Sdf.ValueTypeNames.Color3f, "rgb", Sdf.ValueTypeNames.Float3),
            ("opacity", Sdf.ValueTypeNames.Float, "a", Sdf.ValueTypeNames.Float),
        ):
            surface.CreateInput(name, kind).ConnectToSource(texture.CreateOutput(output, given))
        surface_output = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(surface_output)
        return material


def _said(model: Usd.Prim, name: str, otherwise: Any) -> Any:
    """One of its `model:` attributes; what the schema says where it is silent, applied or not."""
    attribute = model.GetAttribute(f"model:{name}")
    value = attribute.Get() if attribute else None
    return otherwise if value is None else value


def _pictures(model: Usd.Prim) -> Iterator[tuple[str, str]]:
    """Faces that a picture is named for, and its file."""
    for face in _FACES:
        attribute = model.GetAttribute(f"model:cardTexture{face}")
        if attribute and (file := resolve_asset(attribute, Usd.TimeCode.EarliestTime())):
            yield face, file


def _edges(low: F64, high: F64) -> list[tuple[F64, F64]]:
    """The twelve edges of a box."""
    corners = [np.where([i & 1, i & 2, i & 4], high, low) for i in range(8)]
    return [(corners[i], corners[i | bit]) for i in range(8) for bit in (1, 2, 4) if not i & bit]


def _quads(low: F64, high: F64, pictures: dict[str, str], *, cross: bool) -> dict[str, F64]:
    """Corners of the cards, shape (4, 3) each, in the order of `_CORNERS`: all where there is no picture, else those
    of the axes that have one."""
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    apart = _GAP * float(half.max()) if cross else 0.0
    found = {}
    for face in _FACES:
        if pictures and face not in pictures and _opposite(face) not in pictures:
            continue
        right, up = (np.array(direction, np.float64) for direction in _RIGHT_UP[face])
        outwards = np.cross(right, up)
        centre = middle + outwards * (apart if cross else half)
        found[face] = np.array([centre + half * ((2 * s - 1) * right + (2 * t - 1) * up) for s, t in _CORNERS])
    return found


def _opposite(face: str) -> str:
    return face[0] + ("Neg" if face.endswith("Pos") else "Pos")


def _shown(face: str, pictures: dict[str, str]) -> str:
    """The face whose picture a card shows."""
    return face if face in pictures else _opposite(face)


def _coordinates(face: str, pictures: dict[str, str]) -> list[Gf.Vec2f]:
    """Its st; of the picture of the face opposite turned over, so that both sides look like one picture on glass."""
    if _shown(face, pictures) == face or face[0] != "Z":
        turned = _shown(face, pictures) != face
        return [Gf.Vec2f(1.0 - s if turned else s, t) for s, t in _CORNERS]
    return [Gf.Vec2f(s, 1.0 - t) for s, t in _CORNERS]  # which face looks upwards turns about X, not about Z
