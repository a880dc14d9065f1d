"""A stage as one glTF 2.0 file: what is drawn, in metres and Y up, with the KHR extensions that make glass.

Only the core, KHR_lights_punctual and KHR_materials_transmission, _volume, _ior, _dispersion, _clearcoat and
_emissive_strength (Khronos glTF 2.0 and its registry). Every prim is a node that turns and moves; its scale and shear
go into its points, so that thickness and attenuation distance, which glTF has in mesh space, are metres on all of them.
Prims of one shape and scale share their mesh.
"""

from __future__ import annotations

import base64
import json
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from ...scene import F32, F64, Material, Notice, Param
from ...version import __version__
from ...world.solid import mean_way
from ..camera import read_cameras
from ..geometry.parts import Part, Tables, assemble, bind
from ..geometry.primvars import spread
from ..geometry.shapes import read_shape
from ..geometry.triangulate import turned_over
from ..lights.read import read_lights
from ..stage import stage_unit, time_range
from .author import Written
from .find import original
from .gltf_lamps import EXTENSION, camera_object, lamp_of, light_object, lost_of, lost_of_camera, shift_of, unwritten
from .gltf_materials import Maker, Uv, uvs_of
from .uses import drawn

_PURPOSES = ("default", "render")
_FLOAT, _SHORT, _INT = 5126, 5123, 5125
_POINTS, _CORNERS = 34962, 34963
"""Targets of a buffer view: attributes, and indices."""
_WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


@dataclass
class Document:
    """A file that grows."""

    blob: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)
    nodes: list[dict[str, Any]] = field(default_factory=list)
    cameras: list[dict[str, Any]] = field(default_factory=list)
    lights: list[dict[str, Any]] = field(default_factory=list)

    def view(self, content: bytes, target: int | None = None) -> int:
        """A new buffer view, on a boundary of four bytes."""
        self.blob.extend(bytes(-len(self.blob) % 4))
        made = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(content)}
        self.views.append(made if target is None else made | {"target": target})
        self.blob.extend(content)
        return len(self.views) - 1

    def accessor(self, values: NDArray[Any], target: int, **more: Any) -> int:
        """Values of shape (N, D), float32 or unsigned."""
        kind = {"f": _FLOAT, "H": _SHORT, "I": _INT}[values.dtype.char]
        made = {"bufferView": self.view(np.ascontiguousarray(values).tobytes(), target), "componentType": kind,
                "count": len(values), "type": _WIDTHS[values.shape[1]]}  # fmt: skip
        self.accessors.append(made | more)
        return len(self.accessors) - 1


class _Placed(NamedTuple):
    """A prim at one place, as a rigid motion of a mesh."""

    path: str
    part: Part
    stretch: F64
    """shape (3, 3): points of the mesh [m] from shape space, symmetric; of negative determinant where it mirrors"""
    turn: F64
    """shape (3, 3): a rotation"""
    origin: F64
    """shape (3,) [m]"""


def write_gltf(stage: Usd.Stage, out: str) -> Written:
    """The bytes of a .glb or .gltf file.

    Args:
        stage: with RefractMaterialAPI on its glass.
        out: its extension says which; a .gltf holds its buffer within itself.

    Raises:
        StageError: instances expand to more prims than can be drawn.
    """
    notices: list[Notice] = []
    time, unit = Usd.TimeCode(time_range(stage)[0]), stage_unit(stage, [])
    tables = Tables(time, unit, notices)
    metres_from_stage = _upright(stage) @ np.diag([unit] * 3 + [1.0])
    placed = list(_placed(stage, tables, metres_from_stage))
    document = Document()
    maker = Maker(document.view, list(tables.textures.values()), _ways(placed, tables.materials))
    open_ones = {int(n) for one in placed for n in np.unique(one.part.materials)
                 if not one.part.shape.closed or one.part.shape.double_sided}  # fmt: skip
    meshes: dict[tuple[int, bytes], int] = {}
    nodes: dict[str, int] = {}
    roots: list[int] = []
    for one in placed:
        key = id(one.part), np.round(one.stretch, 9).tobytes()
        if key not in meshes:
            meshes[key] = _mesh(document, maker, one, tables.materials, open_ones)
        motion = _motion(one.origin, one.turn)
        _node(document, nodes, roots, one.path, motion | {"mesh": meshes[key]})
    for path, seen_by in _seen_by(stage, time, unit, metres_from_stage, document, notices):
        _node(document, nodes, roots, path, seen_by)
    if not placed:
        notices.append(Notice(out, "nothing of the stage is drawn, so there is nothing in the glTF file"))
    content = _file(document, maker, roots, text=os.path.splitext(out)[1].lower() == ".gltf")
    return Written(content, tuple(dict.fromkeys(notices)), maker.told())


# --- what is drawn ------------------------------------------------------------------------------------------------


def _placed(stage: Usd.Stage, tables: Tables, metres_from_stage: F64) -> Iterator[_Placed]:
    """Everything with a surface, as the renderer reads it."""
    every, placements = drawn(stage, tables.time, tables.notices)
    prims = [prim for prim in every if UsdGeom.Imageable(prim).ComputePurpose() in _PURPOSES]
    known: dict[tuple[Any, ...], Part] = {}
    for prim, bound in zip(prims, bind(prims, tables.notices), strict=True):
        places = placements(prim)
        shape = read_shape(prim, tables.time, tables.notices) if places else None
        if shape is None:
            continue
        part = assemble(prim, shape, bound, tables)
        # Proxies of one prototype are one mesh, as far as they have the same materials and primvars.
        values = (primvar.tobytes() for _, primvar in sorted(part.primvars.items()))
        part = known.setdefault((original(prim), part.materials.tobytes(), *values), part)
        for count, place in enumerate(places):
            path = str(prim.GetPath()) + (f"[{count}]" if len(places) > 1 else "")
            world = np.vstack((place[:3], (0.0, 0.0, 0.0, 1.0)))
            matrix = metres_from_stage @ world @ part.shape.prim_from_shape
            if np.isfinite(matrix).all():
                turn, stretch = _rigid(matrix[:3, :3])
                yield _Placed(path, part, stretch, turn, matrix[:3, 3])
            else:
                tables.notices.append(Notice(path, "skipped: its transform is not finite"))


def _upright(stage: Usd.Stage) -> F64:
    """Y up from the stage's own axis, shape (4, 4)."""
    turned = np.eye(4)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        turned[1:3, 1:3] = [[0.0, 1.0], [-1.0, 0.0]]
    return turned


def _rigid(linear: F64) -> tuple[F64, F64]:
    """A rotation after a symmetric matrix: the polar decomposition. What mirrors is in the second."""
    u, scales, vt = np.linalg.svd(linear)
    turn, stretch = u @ vt, vt.T @ np.diag(scales) @ vt
    return (turn, stretch) if np.linalg.det(turn) > 0.0 else (-turn, -stretch)


def _ways(placed: list[_Placed], materials: list[Material]) -> dict[int, float]:
    """Mean way [m] through the bodies of each glass, of several the median."""
    found: dict[int, list[float]] = {}
    measured: dict[tuple[int, bytes], float] = {}
    for one in placed:
        used = np.unique(one.part.materials).tolist()
        if len(used) != 1 or not (materials[used[0]].refractive and one.part.shape.closed):
            continue
        key = id(one.part), np.round(one.stretch, 9).tobytes()
        if key not in measured:
            points = one.part.shape.points.astype(np.float64) @ one.stretch.T
            measured[key] = mean_way(points, one.part.shape.triangles.astype(np.int64))
        found.setdefault(used[0], []).append(measured[key])
    return {number: float(np.median(ways)) for number, ways in found.items()}


# --- meshes -------------------------------------------------------------------------------------------------------


def _mesh(document: Document, maker: Maker, one: _Placed, materials: list[Material], open_ones: set[int]) -> int:
    """A mesh with one primitive for each of its materials."""
    shape, part = one.part.shape, one.part
    mirrored = np.linalg.det(one.stretch) < 0.0
    points = (shape.points.astype(np.float64) @ one.stretch.T).astype(np.float32)
    triangles = turned_over(shape.triangles) if mirrored else shape.triangles
    normals = None
    if shape.normals is not None and np.linalg.det(one.stretch) != 0.0:
        turned = spread(shape.normals, mirrored=mirrored).astype(np.float64) @ np.linalg.inv(one.stretch)
        turned /= np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-30)
        normals = np.broadcast_to(turned, (len(triangles), 3, 3)).astype(np.float32)
    primvars = {name: values if values.shape[:2] == (1, 1) or not mirrored else turned_over(values)
                for name, values in part.primvars.items()}  # fmt: skip
    primitives = []
    for number in np.unique(part.materials).tolist():
        chosen = part.materials == number
        corners = {"POSITION": points[triangles[chosen].astype(np.int64)]}
        if normals is not None:
            corners["NORMAL"] = normals[chosen]
        material = materials[number]
        for count, uv in enumerate(uvs_of(material)):
            corners[f"TEXCOORD_{count}"] = _coordinates(uv, primvars, chosen)
        if (colors := primvars.get(material.inputs[Param.DIFFUSE].primvar)) is not None and colors.shape[2] == 3:
            corners["COLOR_0"] = _each(colors, chosen)
        depth = material.inputs[Param.THICKNESS]
        own = primvars.get(depth.primvar)
        own = None if own is None else _each(own, chosen)[..., 0] * np.float32(depth.scale[0])
        painted, two_sided = "COLOR_0" in corners, number in open_ones
        place = maker.number(number, material, own, painted=painted, two_sided=two_sided)
        primitives.append(_primitive(document, corners) | {"material": place})
    name = one.path.rpartition("/")[2] or "Mesh"
    document.meshes.append({"name": name, "primitives": primitives})
    return len(document.meshes) - 1


def _each(values: F32, chosen: NDArray[np.bool_]) -> F32:
    """Values per corner of some triangles, shape (T, 3, D)."""
    if values.shape[:2] == (1, 1):
        return np.broadcast_to(values, (int(chosen.sum()), 3, values.shape[2])).astype(np.float32)
    return values[chosen]


def _coordinates(uv: Uv, primvars: dict[str, F32], chosen: NDArray[np.bool_]) -> F32:
    """Texture coordinates, moved as their source says, v downwards."""
    values = primvars.get(uv.primvar)
    if values is None or values.shape[2] < 2:
        values = np.array(uv.value, np.float32).reshape(1, 1, 2)
    st = _each(values, chosen)[..., :2].astype(np.float64)
    a, b, c, d, e, f = uv.matrix
    s, t = st[..., 0], st[..., 1]
    return np.stack((a * s + b * t + c, 1.0 - (d * s + e * t + f)), axis=-1).astype(np.float32)


def _primitive(document: Document, corners: dict[str, F32]) -> dict[str, Any]:
    """Indexed triangles: corners that are alike in everything are one."""
    flat = {name: np.ascontiguousarray(values.reshape(-1, values.shape[-1]) + 0.0) for name, values in corners.items()}
    rows = np.ascontiguousarray(np.concatenate(list(flat.values()), axis=1, dtype=np.float32))
    as_bytes = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    _, first, number = np.unique(as_bytes, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # in the order in which triangles use them
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    kept = first[order]
    attributes = {}
    for name, values in flat.items():
        more = {}
        if name == "POSITION":
            more = {"min": values[kept].min(axis=0).tolist(), "max": values[kept].max(axis=0).tolist()}
        attributes[name] = document.accessor(values[kept].astype(np.float32), _POINTS, **more)
    kind = np.uint16 if len(kept) < 0xFFFF else np.uint32
    indices = place[number.reshape(-1)].astype(kind).reshape(-1, 1)
    return {"attributes": attributes, "indices": document.accessor(indices, _CORNERS)}


# --- nodes --------------------------------------------------------------------------------------------------------


def _seen_by(
    stage: Usd.Stage, time: Usd.TimeCode, unit: float, metres_from_stage: F64, document: Document,
    notices: list[Notice],
) -> Iterator[tuple[str, dict[str, Any]]]:  # fmt: skip
    """Paths and nodes of lights and cameras, whose entries go into the document; what is lost of them is told."""
    frame: dict[str, Any] = {"engine_from_stage": metres_from_stage, "metres_per_unit": unit, "notices": notices}
    lights, _ = read_lights(stage, time, purposes=_PURPOSES, **frame)
    for light in lights:
        document.lights.append(light_object(lamp_of(light), light.path.rpartition("/")[2]))
        motion = _motion(light.world_from_light[:3, 3], light.world_from_light[:3, :3])
        yield light.path, motion | {"extensions": {EXTENSION: {"light": len(document.lights) - 1}}}
        if lost := list(lost_of(light)):
            notices.append(Notice(light.path, f"glTF's lights have no {', '.join(lost)}: left out"))
    notices.extend(unwritten(stage, {light.path for light in lights}))
    for camera in read_cameras(stage, time, **frame):
        document.cameras.append(camera_object(camera, camera.path.rpartition("/")[2]))
        turn, origin = camera.world_from_camera[:3, :3], camera.world_from_camera[:3, 3]
        if camera.orthographic:
            origin = origin + turn @ shift_of(camera)
        yield camera.path, _motion(origin, turn) | {"camera": len(document.cameras) - 1}
        if lost := list(lost_of_camera(camera)):
            notices.append(Notice(camera.path, f"glTF's cameras have no {', '.join(lost)}: left out"))


def _node(document: Document, nodes: dict[str, int], roots: list[int], path: str, content: dict[str, Any]) -> None:
    """A prim's node, and one without a transform for each prim above it that there is none for yet."""
    parent = -1
    parts = path.strip("/").split("/")
    for depth, name in enumerate(parts):
        last = depth == len(parts) - 1
        here = "/".join(parts[: depth + 1])
        if here not in nodes or last:
            document.nodes.append({"name": name} | (content if last else {}))
            number = len(document.nodes) - 1
            if parent < 0:
                roots.append(number)
            else:
                document.nodes[parent].setdefault("children", []).append(number)
            if not last:
                nodes[here] = number
        parent = nodes.get(here, parent)


def _motion(origin: F64, turn: F64) -> dict[str, Any]:
    """Translation and rotation, where there are any."""
    found: dict[str, Any] = {}
    if origin.any():
        found["translation"] = origin.tolist()
    if not np.allclose(turn, np.eye(3), atol=1e-12):
        found["rotation"] = quaternion(turn).tolist()
    return found


def quaternion(turn: F64) -> F64:
    """A rotation matrix as (x, y, z, w): the eigenvector of the largest eigenvalue (Bar-Itzhack 2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = turn.tolist()
    form = np.array([
        [xx - yy - zz, yx + xy, zx + xz, zy - yz],
        [yx + xy, yy - xx - zz, zy + yz, xz - zx],
        [zx + xz, zy + yz, zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ])  # fmt: skip
    values, vectors = np.linalg.eigh(form / 3.0)
    found: F64 = vectors[:, int(np.argmax(values))]
    return found if found[3] >= 0.0 else -found


# --- bytes --------------------------------------------------------------------------------------------------------


def _file(document: Document, maker: Maker, roots: list[int], *, text: bool) -> bytes:
    """The file, without what it has none of: glTF knows no empty lists."""
    blob = bytes(document.blob)
    uri = {"uri": "data:application/octet-stream;base64," + base64.b64encode(blob).decode()} if text else {}
    parts = {
        "nodes": document.nodes, "cameras": document.cameras, "meshes": document.meshes,
        "accessors": document.accessors,
        "bufferViews": document.views, "buffers": [{"byteLength": len(blob)} | uri] if blob else [],
        **maker.parts(),
    }  # fmt: skip
    scene = {"nodes": roots} if roots else {}
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"refract {__version__}"}, "scene": 0, "scenes": [scene],
        **{name: values for name, values in parts.items() if values},
    }  # fmt: skip
    if document.lights:
        content["extensions"] = {EXTENSION: {"lights": document.lights}}
        content["extensionsUsed"] = sorted({EXTENSION, *content.get("extensionsUsed", ())})
    document_text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    if text:
        return document_text
    document_text += b" " * (-len(document_text) % 4)
    blob += bytes(-len(blob) % 4)
    chunks = struct.pack("<I4s", len(document_text), b"JSON") + document_text
    if blob:
        chunks += struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


