"""A glTF 2.0 file as plain arrays: nodes, triangles, materials with their KHR extensions, pictures as bytes.

pygltflib parses the file and keeps every extension; what its accessors and materials mean is done here after the
specification (Khronos glTF 2.0, sections 3.6, 3.7, 3.9 and 3.10, and KHR_lights_punctual). Morph targets, skins and
animations are left out, and said so.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ...errors import StageError, UsageError
from ...scene import F32, F64, I32, Notice
from .gltf_lamps import EXTENSION, Lamp, View, read_lamp, read_view

T = TypeVar("T")

NONE = -1
"""In place of a number that a file does not have."""
_KINDS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_UNREADABLE = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
_LARGEST = 1 << 28
"""Elements of one accessor"""


@dataclass(frozen=True)
class Picture:
    """A texture on a material."""

    image: int
    uv_set: int = 0
    wrap: tuple[str, str] = ("repeat", "repeat")
    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    """[rad]"""
    scale: tuple[float, float] = (1.0, 1.0)
    strength: float = 1.0
    """normalTexture.scale or occlusionTexture.strength"""


@dataclass(frozen=True)
class GltfMaterial:
    """A material; factors as in the file, lengths in metres."""

    name: str
    base: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    metallic: float = 1.0
    roughness: float = 1.0
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    ior: float = 1.5
    transmission: float = 0.0
    thickness: float = 0.0
    """In mesh space; 0 is a thin wall."""
    attenuation_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    attenuation_distance: float = 0.0
    """0: infinite"""
    dispersion: float = 0.0
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    pictures: dict[str, Picture] = field(default_factory=dict)
    """By what they drive: base, metallic_roughness, normal, occlusion, emissive, transmission, thickness."""


@dataclass(frozen=True)
class Primitive:
    """Triangles with one material."""

    points: F32
    """shape (V, 3)"""
    triangles: I32
    """shape (T, 3)"""
    material: int
    """or NONE"""
    normals: F32 | None = None
    uvs: dict[int, F32] = field(default_factory=dict)
    """Set -> shape (V, 2), v downwards as in the file"""
    colors: F32 | None = None
    """shape (V, 3), linear"""


@dataclass(frozen=True)
class Node:
    """A place in the hierarchy, with a mesh, a camera and a light, each or NONE, and what hangs below it."""

    name: str
    matrix: F64
    """shape (4, 4), column vectors: parent from node"""
    mesh: int
    children: tuple[int, ...]
    camera: int = NONE
    light: int = NONE


@dataclass(frozen=True)
class Gltf:
    """One file."""

    nodes: tuple[Node, ...]
    roots: tuple[int, ...]
    meshes: tuple[tuple[str, tuple[Primitive, ...]], ...]
    materials: tuple[GltfMaterial, ...]
    cameras: tuple[View, ...]
    lights: tuple[Lamp, ...]
    images: tuple[tuple[str, bytes], ...]
    """File extension and content; no content where it cannot be had"""
    notices: tuple[Notice, ...]


def read_gltf(path: str) -> Gltf:
    """Read a .gltf or .glb file.

    Raises:
        UsageError: pygltflib is not installed.
        StageError: the file is missing, damaged, or compressed in a way that cannot be read.
    """
    try:
        import pygltflib
    except ImportError as error:
        raise UsageError(f"{path}: glTF needs the extra `gltf`: pip install 'usd-refract[gltf]'") from error
    if not os.path.isfile(path):
        raise StageError(f"{path}: there is no such file; check the path")
    try:
        document = pygltflib.GLTF2.load(path)
        if document is None:
            raise ValueError("it is empty")
        version = str(document.asset.version)
        if not version.startswith("2."):
            raise StageError(f"{path}: is glTF {version}, and 2.0 is read; save it anew with what made it")
        needed = [name for name in document.extensionsRequired or [] if name in _UNREADABLE]
        if needed:
            raise StageError(f"{path}: its geometry is compressed with {', '.join(needed)}; save it without")
        return _read(_File(path, document))
    except StageError:
        raise
    except struct.error as error:
        raise StageError(f"{path}: cannot be read as glTF 2.0: it was cut off; copy or save it again") from error
    except (ValueError, LookupError, TypeError, AttributeError, OSError) as error:
        raise StageError(f"{path}: cannot be read as glTF 2.0: {error}") from error


@dataclass
class _File:
    """A parsed file and its buffers, each read once."""

    path: str
    document: Any
    buffers: dict[int, bytes] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)


def _read(file: _File) -> Gltf:
    """The parts of a parsed file. Raises ValueError or LookupError where it refers to what is not there."""
    document = file.document
    left = {"skins": document.skins, "animations": document.animations}
    if found := [name for name, values in left.items() if values]:
        _say(file, f"{', '.join(found)} are not converted: geometry is taken as it rests")
    children = [child for node in document.nodes for child in node.children or ()]
    scenes = document.scenes or []
    roots = scenes[document.scene or 0].nodes if scenes else sorted(set(range(len(document.nodes))) - set(children))
    if len(set(children)) < len(children) or set(children) & set(roots or ()):
        raise ValueError("a node has two parents, or nodes stand in a circle")
    all_of_it = Gltf(
        nodes=tuple(_node(node, number) for number, node in enumerate(document.nodes)),
        roots=tuple(roots or ()),
        meshes=tuple((mesh.name or "Mesh", _primitives(file, mesh)) for mesh in document.meshes),
        materials=tuple(_material(file, one, number) for number, one in enumerate(document.materials)),
        cameras=tuple(read_view(camera) for camera in document.cameras or ()),
        lights=tuple(read_lamp(one) for one in (document.extensions or {}).get(EXTENSION, {}).get("lights", ())),
        images=tuple(_image(file, number) for number in range(len(document.images))),
        notices=tuple(dict.fromkeys(file.notices)),
    )
    _check(all_of_it)
    return all_of_it


def _check(gltf: Gltf) -> None:
    """Raises ValueError where a node or a mesh asks for what the file does not have."""
    for number in (*gltf.roots, *(child for node in gltf.nodes for child in node.children)):
        _entry(gltf.nodes, number, "node")
    for node in gltf.nodes:
        for number, entries, kind in (
            (node.mesh, gltf.meshes, "mesh"), (node.camera, gltf.cameras, "camera"), (node.light, gltf.lights, "light"),
        ):  # fmt: skip
            if number != NONE:
                _entry(entries, number, kind)
    for number in {one.material for _, primitives in gltf.meshes for one in primitives} - {NONE}:
        _entry(gltf.materials, number, "material")


def _entry(entries: Sequence[T] | None, number: Any, kind: str) -> T:
    """What a number of the file stands for. Raises ValueError where it has no such thing."""
    if not 0 <= number < len(entries or ()):
        raise ValueError(f"it asks for {kind} {number}, and has {len(entries or ())}, counted from 0")
    return (entries or ())[number]


def _say(file: _File, text: str) -> None:
    file.notices.append(Notice(file.path, text))


# --- bytes ---


def _uri(file: _File, uri: str) -> bytes:
    """The bytes a URI stands for: its own, or a file beside the glTF file. Nothing is fetched. Raises StageError."""
    if uri.startswith("data:"):
        found: bytes = file.document.decode_data_uri(uri)
        return found
    if "://" in uri:
        raise StageError(
            f"{file.path}: refers to {uri}, and nothing is fetched; save the file with its parts beside it"
        )
    name = os.path.join(os.path.dirname(os.path.abspath(file.path)), unquote(uri))
    try:
        with open(name, "rb") as part:
            return part.read()
    except OSError as error:
        raise StageError(f"{file.path}: its part {uri} cannot be read: {error.strerror}") from error


def _view(file: _File, number: int) -> tuple[bytes, int]:
    """Content of a buffer view, and its stride (0: none given)."""
    view = _entry(file.document.bufferViews, number, "bufferView")
    if view.buffer not in file.buffers:
        uri = _entry(file.document.buffers, view.buffer, "buffer").uri
        file.buffers[view.buffer] = _uri(file, uri) if uri else bytes(file.document.binary_blob() or b"")
    start = view.byteOffset or 0
    content = file.buffers[view.buffer][start : start + view.byteLength]
    if len(content) < view.byteLength:
        raise ValueError(f"bufferView {number} goes beyond its buffer")
    return content, view.byteStride or 0


def _accessor(file: _File, number: int) -> NDArray[Any]:
    """Values as stored, shape (N, width); normalised integers as float32."""
    accessor = _entry(file.document.accessors, number, "accessor")
    kind, width = np.dtype(_KINDS[accessor.componentType]).newbyteorder("<"), _WIDTHS[accessor.type]
    if not 0 <= accessor.count <= _LARGEST:
        raise ValueError(f"accessor {number} has {accessor.count} elements")
    if accessor.bufferView is None:
        values = np.zeros((accessor.count, width), kind)
    else:
        values = _strided(file, accessor.bufferView, accessor.byteOffset or 0, accessor.count, width, kind)
    if accessor.sparse:
        sparse = accessor.sparse
        at, of = sparse.indices, sparse.values
        index_kind = np.dtype(_KINDS[at.componentType]).newbyteorder("<")
        places = _strided(file, at.bufferView, at.byteOffset or 0, sparse.count, 1, index_kind)[:, 0]
        values = values.copy()
        values[places] = _strided(file, of.bufferView, of.byteOffset or 0, sparse.count, width, kind)
    if accessor.normalized and kind.kind in "iu":
        return np.maximum(values.astype(np.float32) / float(np.iinfo(str(kind)).max), -1.0).astype(np.float32)
    return values


def _strided(file: _File, view: int, offset: int, count: int, width: int, kind: np.dtype[Any]) -> NDArray[Any]:
    content, stride = _view(file, view)
    size = width * kind.itemsize
    stride = stride or size
    if count and offset + (count - 1) * stride + size > len(content):
        raise ValueError(f"an accessor goes beyond bufferView {view}")
    shape, steps = (count, width), (stride, kind.itemsize)
    return np.ndarray(shape, kind, content, offset, steps) if count else np.zeros(shape, kind)


# --- geometry ---


def _primitives(file: _File, mesh: Any) -> tuple[Primitive, ...]:
    found = []
    for primitive in mesh.primitives:
        if (primitive.mode if primitive.mode is not None else 4) not in (4, 5, 6):
            _say(file, f"mesh {mesh.name or ''}: points and lines are left out")
        elif primitive.attributes.POSITION is not None:
            found.append(_primitive(file, primitive))
            if primitive.targets:
                _say(file, f"mesh {mesh.name or ''}: morph targets are left out")
    return tuple(found)


def _primitive(file: _File, primitive: Any) -> Primitive:
    """Triangles with their attributes; those that name a point that is not there are left out."""
    attributes = primitive.attributes
    points = _accessor(file, attributes.POSITION).astype(np.float32)
    corners = np.arange(len(points)) if primitive.indices is None else _accessor(file, primitive.indices)[:, 0]
    triangles = _triangles(corners.astype(np.int64), 4 if primitive.mode is None else primitive.mode)
    triangles = triangles[(triangles >= 0).all(axis=1) & (triangles < len(points)).all(axis=1)]
    uvs = {}
    for number in range(4):
        place = getattr(attributes, f"TEXCOORD_{number}", None)
        if place is not None:
            uvs[number] = _accessor(file, place).astype(np.float32)
    colors = None if attributes.COLOR_0 is None else _accessor(file, attributes.COLOR_0).astype(np.float32)[:, :3]
    normals = None if attributes.NORMAL is None else _accessor(file, attributes.NORMAL).astype(np.float32)
    material = NONE if primitive.material is None else int(primitive.material)
    return Primitive(points, triangles.astype(np.int32), material, normals, uvs, colors)


# --- materials ---


def _material(file: _File, material: Any, number: int) -> GltfMaterial:
    """Core factors, the KHR extensions that the renderer or its schema has a place for, and the pictures."""
    core, extensions = material.pbrMetallicRoughness, material.extensions or {}
    values: dict[str, Any] = {}
    pictures: dict[str, Picture] = {}

    def part(extension: str, **names: str) -> None:
        for ours, theirs in names.items():
            if theirs in extensions.get(extension, {}):
                value = extensions[extension][theirs]
                values[ours] = _color(value, 3) if ours == "attenuation_color" else float(value)

    def picture(name: str, info: Any) -> None:
        if info is not None:
            pictures[name] = _picture(file, info)

    if core is not None:
        values |= {"base": _color(core.baseColorFactor or (1, 1, 1, 1), 4)}
        values |= {"metallic": _or(core.metallicFactor, 1.0), "roughness": _or(core.roughnessFactor, 1.0)}
        picture("base", core.baseColorTexture)
        picture("metallic_roughness", core.metallicRoughnessTexture)
    picture("normal", material.normalTexture)
    picture("occlusion", material.occlusionTexture)
    picture("emissive", material.emissiveTexture)
    part("KHR_materials_ior", ior="ior")
    part("KHR_materials_transmission", transmission="transmissionFactor")
    part("KHR_materials_volume", thickness="thicknessFactor", attenuation_color="attenuationColor")
    part("KHR_materials_volume", attenuation_distance="attenuationDistance")
    part("KHR_materials_dispersion", dispersion="dispersion")
    part("KHR_materials_clearcoat", clearcoat="clearcoatFactor", clearcoat_roughness="clearcoatRoughnessFactor")
    picture("transmission", extensions.get("KHR_materials_transmission", {}).get("transmissionTexture"))
    picture("thickness", extensions.get("KHR_materials_volume", {}).get("thicknessTexture"))
    strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    r, g, b = (value * strength for value in _color(material.emissiveFactor or (0, 0, 0), 3))
    return GltfMaterial(
        name=material.name or f"Material_{number}",
        emissive=(r, g, b),
        alpha_mode=material.alphaMode or "OPAQUE",
        alpha_cutoff=_or(material.alphaCutoff, 0.5),
        double_sided=bool(material.doubleSided),
        pictures=pictures,
        **values,
    )


def _picture(file: _File, info: Any) -> Picture:
    """A textureInfo; those of extensions are dictionaries."""
    get = info.get if isinstance(info, dict) else lambda name, default=None: getattr(info, name, default)
    texture = _entry(file.document.textures, get("index"), "texture")
    moved = (get("extensions") or {}).get("KHR_texture_transform", {})
    wrap = ("repeat", "repeat")
    if texture.source is not None:
        _entry(file.document.images, texture.source, "image")
    if texture.sampler is not None:
        sampler = _entry(file.document.samplers, texture.sampler, "sampler")
        wrap = _WRAPS.get(sampler.wrapS or 10497, "repeat"), _WRAPS.get(sampler.wrapT or 10497, "repeat")
    u, v = moved.get("offset", (0.0, 0.0))
    x, y = moved.get("scale", (1.0, 1.0))
    return Picture(
        image=NONE if texture.source is None else texture.source,
        uv_set=int(moved.get("texCoord", get("texCoord") or 0)),
        wrap=wrap,
        offset=(float(u), float(v)),
        rotation=float(moved.get("rotation", 0.0)),
        scale=(float(x), float(y)),
        strength=_or(get("scale"), _or(get("strength"), 1.0)),
    )


def _image(file: _File, number: int) -> tuple[str, bytes]:
    """A picture's extension and bytes; two times nothing, and a notice, where it cannot be used."""
    image = file.document.images[number]
    try:
        content = _uri(file, image.uri) if image.uri else _view(file, image.bufferView)[0]
    except StageError as error:
        _say(file, f"{error}; the picture is left out")
        return "", b""
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        return ".png", content
    if content[:3] == b"\xff\xd8\xff":
        return ".jpg", content
    _say(file, f"picture {number} is neither PNG nor JPEG and is left out")
    return "", b""


def _color(value: Any, size: int) -> tuple[float, ...]:
    found = tuple(map(float, value))
    if len(found) != size:
        raise ValueError(f"a colour has {len(found)} numbers instead of {size}")
    return found


def _or(value: Any, default: float) -> float:
    return default if value is None else float(value)


def _triangles(corners: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Triangles (4), a strip (5) or a fan (6) as shape (T, 3)."""
    if mode == 4:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    steps = np.arange(max(len(corners) - 2, 0))
    if mode == 6:
        return corners[np.stack((steps + 1, steps + 2, np.zeros_like(steps)), axis=1)]
    return corners[np.stack((steps, steps + 1 + steps % 2, steps + 2 - steps % 2), axis=1)]


def _node(node: Any, number: int) -> Node:
    """A node whose matrix is composed where the file gives translation, rotation and scale."""
    matrix = np.eye(4)
    if node.matrix:
        matrix = np.array(node.matrix, np.float64).reshape(4, 4).T
    else:
        x, y, z, w = node.rotation or (0.0, 0.0, 0.0, 1.0)
        turned = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        matrix[:3, :3] = turned * np.array(node.scale or (1.0, 1.0, 1.0))
        matrix[:3, 3] = node.translation or (0.0, 0.0, 0.0)
    mesh = NONE if node.mesh is None else int(node.mesh)
    camera = NONE if node.camera is None else int(node.camera)
    light = int((node.extensions or {}).get(EXTENSION, {}).get("light", NONE))
    return Node(node.name or f"Node_{number}", matrix, mesh, tuple(node.children or ()), camera, light)
