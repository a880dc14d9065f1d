"""MaterialX files in the place of references that USD cannot open, for usd-core has no reader of them.

A layer that refers to one is changed in memory, never on disk: its reference leads to an anonymous layer with the same
materials as UsdShade. So instances, variants and stronger opinions compose as they would with the reader.
"""

from __future__ import annotations

import os
import posixpath
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

from pxr import Ar, Gf, Sdf, Tf, Usd

from ...errors import StageError, UsageError
from ..values import free_name
from .mtlx_file import LARGEST, Document, Graph, Node, Port, Unreadable, load_library, read_document

EXTENSION = ".mtlx"
_MOST = 50_000
"""Prims made of one file."""
_TYPES = Sdf.ValueTypeNames
_INTERFACE = "outputs:mtlx:surface"
_KINDS: dict[str, tuple[Sdf.ValueTypeName, Any]] = {
    "float": (_TYPES.Float, float),
    "integer": (_TYPES.Int, int),
    "boolean": (_TYPES.Bool, bool),
    "string": (_TYPES.String, str),
    "color3": (_TYPES.Color3f, lambda value: Gf.Vec3f(*value)),
    "color4": (_TYPES.Color4f, lambda value: Gf.Vec4f(*value)),
    "vector2": (_TYPES.Float2, lambda value: Gf.Vec2f(*value)),
    "vector3": (_TYPES.Float3, lambda value: Gf.Vec3f(*value)),
    "vector4": (_TYPES.Float4, lambda value: Gf.Vec4f(*value)),
    "filename": (_TYPES.Asset, Sdf.AssetPath),
}


class _Made(NamedTuple):
    """An anonymous layer and what it was made from."""

    stamp: tuple[int, int]
    """Size and time of the file; zeros inside a package."""
    layer: Sdf.Layer | None
    notices: tuple[str, ...]
    """What was left out; of a file that cannot be read, why."""


class _Host(NamedTuple):
    """A layer that was changed in memory."""

    stamp: tuple[int, int]
    authored: dict[str, str]
    """Identifier of an anonymous layer -> what stands in the file."""


_made: dict[str, _Made] = {}
_hosts: dict[str, _Host] = {}


def make_ready() -> None:
    """Load what is needed to read MaterialX, where it is installed: in a confined process it may be out of reach."""
    with suppress(UsageError):
        load_library()


def forget_old(layer: Sdf.Layer) -> None:
    """Read a layer anew that was changed in memory, where its file has another content since."""
    host = _hosts.get(layer.identifier)
    if host is not None and host.stamp != _stamp(layer.identifier):
        del _hosts[layer.identifier]
        layer.Reload(force=True)


def stand_in(stage: Usd.Stage) -> None:
    """Let every reference to a MaterialX file, of any layer the stage uses, lead to its materials."""
    for layer in stage.GetUsedLayers():
        for file in replaced_in(layer):
            _layer_of(file)  # which may have another content since
        for asset in _named(layer):
            made = _layer_of(_absolute(asset, layer))
            if made.layer is None or not layer.permissionToEdit:
                continue
            host = _hosts.setdefault(layer.identifier, _Host(_stamp(layer.identifier), {}))
            host.authored[made.layer.identifier] = asset
            layer.UpdateCompositionAssetDependency(asset, made.layer.identifier)


def is_file(name: str) -> bool:
    """An asset path of a MaterialX file, which may lie in a package."""
    return name.lower().rstrip("]").endswith(EXTENSION)


def layer_of(anchor: Sdf.Layer, name: str) -> Sdf.Layer | None:
    """The layer that stands for a file as another layer names it; None where it cannot be read."""
    return _layer_of(_absolute(name, anchor)).layer


def _named(layer: Sdf.Layer) -> list[str]:
    """Asset paths of the MaterialX files that a layer refers to."""
    return [str(name) for name in layer.GetCompositionAssetDependencies() if is_file(str(name))]


def as_authored(layer: Sdf.Layer, copy: Sdf.Layer) -> None:
    """Put back into the copy of a layer what stands in its file."""
    host = _hosts.get(layer.identifier)
    for identifier, asset in host.authored.items() if host is not None else ():
        copy.UpdateCompositionAssetDependency(identifier, asset)


def replaced_in(layer: Sdf.Layer) -> list[str]:
    """Absolute paths of the MaterialX files that a layer's own file refers to, and the layer no more."""
    host = _hosts.get(layer.identifier)
    return [_absolute(asset, layer) for asset in host.authored.values()] if host is not None else []


def file_behind(identifier: str) -> str:
    """The MaterialX file that an anonymous layer stands for; '' where it stands for none."""
    for path, made in _made.items():
        if made.layer is not None and made.layer.identifier == identifier:
            return path
    return ""


def stands_in(text: str) -> bool:
    """A text quotes the name of a layer that stands for a MaterialX file."""
    return "anon:" in text and any(made.layer is not None and made.layer.identifier in text for made in _made.values())


def told(stage: Usd.Stage) -> Iterator[tuple[str, str]]:
    """What is said of the MaterialX files of a stage: their paths, and what was left out or why they are not read."""
    for layer in stage.GetUsedLayers():
        if path := file_behind(layer.identifier):
            yield from ((path, text) for text in _made[path].notices)
        for asset in _named(layer):  # those left are not read
            path = _absolute(asset, layer)
            if path in _made:
                yield from ((path, text) for text in _made[path].notices)


def pictures_of(path: str) -> list[str]:
    """Absolute paths of what a MaterialX file refers to. Nothing of one that is not read."""
    return [_file(name, path) for name in written_in(path)]


def written_in(path: str) -> list[str]:
    """What a MaterialX file refers to, as it stands there. Nothing of one that is not read."""
    try:
        document = read_document(_content(path))
    except (UsageError, Unreadable):
        return []
    owners: list[Node | Graph] = [*document.nodes.values(), *document.graphs.values()]
    return sorted({port.value for one in owners for port in one.ports if port.kind == "filename" and port.value})


def materials_of(path: str) -> Sdf.Layer:
    """A layer with the materials of a file, in /MaterialX/Materials.

    Raises:
        StageError: it cannot be read.
    """
    made = _layer_of(os.path.abspath(path))
    if made.layer is None:
        raise StageError(f"{path}: {'; '.join(made.notices)}")
    return made.layer


# --- files ---


def _absolute(asset: str, layer: Sdf.Layer) -> str:
    return str(Sdf.ComputeAssetPathRelativeToLayer(layer, asset.replace("\\", "/")))


def _stamp(path: str) -> tuple[int, int]:
    try:
        found = os.stat(path)
    except OSError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def _layer_of(path: str) -> _Made:
    """The layer that stands for a file; made once, and again where the file changes."""
    stamp = _stamp(path)
    known = _made.get(path)
    if known is not None and known.stamp == stamp and known.layer is not None:
        return known
    layer = known.layer if known is not None else None
    try:
        content, notices = _authored(read_document(_content(path)), path)
        if layer is None:
            layer = Sdf.Layer.CreateAnonymous(f"{os.path.basename(path)}.usda")  # USD looks at the last extension
        layer.TransferContent(content)
    except (UsageError, Unreadable) as error:
        notices = (f"MaterialX file is not read: {error}",)
        if layer is not None:  # some stage refers to it
            layer.Clear()
    _made[path] = _Made(stamp, layer, notices)
    return _made[path]


def _content(path: str) -> bytes:
    """Bytes of a file, or of one inside a package. Raises Unreadable."""
    if "://" in path or path.startswith("\\\\"):
        raise Unreadable("nothing is fetched from a network")
    if Ar.IsPackageRelativePath(path):
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path))
        if not asset or asset.GetSize() > LARGEST:
            raise Unreadable(f"the package has no such file, or one of more than {LARGEST} bytes")
        return bytes(asset.GetBuffer())
    if not os.path.isfile(path):
        raise Unreadable("there is no such file")
    if os.path.getsize(path) > LARGEST:
        raise Unreadable(f"it has more than {LARGEST} bytes")
    try:
        with open(path, "rb") as file:
            return file.read(LARGEST + 1)
    except OSError as error:
        raise Unreadable(str(error.strerror)) from error


# --- layers ---


def _authored(document: Document, path: str) -> tuple[Sdf.Layer, tuple[str, ...]]:
    """The materials of a document in /MaterialX/Materials, each with its own copy of what is behind it, so that it is
    whole wherever it is referred to."""
    layer = Sdf.Layer.CreateAnonymous("materials.usda")
    layer.defaultPrim = "MaterialX"
    home = Sdf.PrimSpec(layer, "MaterialX", Sdf.SpecifierDef)
    scope = Sdf.PrimSpec(home, "Materials", Sdf.SpecifierDef, "Scope")
    notices = dict.fromkeys(document.notices)
    left = _MOST
    with Sdf.ChangeBlock():
        for name, surface in document.materials.items():
            needed = _behind(document, surface[0])
            left -= len(needed) + 1
            if left < 0:
                notices[f"MaterialX file comes to more than {_MOST} nodes; some of its materials are left out"] = None
                break
            _material(scope, name, surface, needed, document, path)
    return layer, tuple(notices)


def _behind(document: Document, start: str) -> list[str]:
    """Paths of a node or graph and of all that drives it; a graph's nodes are in it."""
    found: dict[str, None] = {}
    waiting = [start]
    while waiting:
        path = waiting.pop()
        one = document.nodes.get(path) or document.graphs.get(path)
        if path in found or one is None:
            continue
        found[path] = None
        waiting += [port.source[0] for port in _ports(one) if port.source[0]]
        if "/" in path:
            waiting.append(path.partition("/")[0])
    return list(found)


def _ports(one: Node | Graph) -> Iterable[Port]:
    return one.ports if isinstance(one, Node) else (*one.ports, *one.outputs)


class _Place(NamedTuple):
    """Where the parts of one material are."""

    home: Sdf.PrimSpec
    document: Document
    file: str
    names: dict[str, str]
    """Path in the document -> name of the prim, which is unique beside its siblings."""

    def path(self, inside: str) -> Sdf.Path:
        graph, _, node = inside.rpartition("/")
        parent = self.home.path.AppendChild(self.names[graph]) if graph else self.home.path
        return parent.AppendChild(self.names[inside]) if node else parent


def _material(
    scope: Sdf.PrimSpec, name: str, surface: tuple[str, str], needed: list[str], document: Document, file: str
) -> None:
    """One material with everything behind it."""
    material = Sdf.PrimSpec(scope, _free(name, scope), Sdf.SpecifierDef, "Material")
    place = _Place(material, document, file, {})
    for path in sorted(needed, key=lambda path: path.count("/")):  # graphs before what is in them
        one = document.nodes.get(path) or document.graphs[path]
        graph, _, own = path.rpartition("/")
        parent = scope.layer.GetPrimAtPath(place.path(graph)) if graph else material
        kind = "Shader" if isinstance(one, Node) else "NodeGraph"
        place.names[path] = _free(own, parent)
        spec = Sdf.PrimSpec(parent, place.names[path], Sdf.SpecifierDef, kind)
        if isinstance(one, Node):
            Sdf.AttributeSpec(spec, "info:id", _TYPES.Token, Sdf.VariabilityUniform).default = one.identifier
            for output, type_name in one.outputs:
                _attribute(spec, _named_port("outputs", output), _KINDS.get(type_name, (_TYPES.Token, None))[0])
    for path in needed:
        one = document.nodes.get(path) or document.graphs[path]
        spec = scope.layer.GetPrimAtPath(place.path(path))
        for port in one.ports:
            _drive(_attribute(spec, _named_port("inputs", port.name), _kind(port)), port, path, place)
        for port in one.outputs if isinstance(one, Graph) else ():
            _drive(_attribute(spec, _named_port("outputs", port.name), _kind(port)), port, f"{path}/", place)
    if surface[0] in place.names:
        output = _attribute(material, _INTERFACE, _TYPES.Token)
        output.connectionPathList.explicitItems = [_output(surface, place)]


def _free(name: str, parent: Sdf.PrimSpec) -> str:
    """A valid name that no child has."""
    return free_name(Tf.MakeValidIdentifier(name), parent.nameChildren)


def _kind(port: Port) -> Sdf.ValueTypeName:
    return _KINDS.get(port.kind, (_TYPES.Token, None))[0]


def _attribute(spec: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName) -> Sdf.AttributeSpec:
    return spec.attributes.get(name) or Sdf.AttributeSpec(spec, name, kind)


def _named_port(kind: str, name: str) -> str:
    """A valid attribute name of an input or output."""
    return f"{kind}:{Tf.MakeValidIdentifier(name)}"


def _drive(attribute: Sdf.AttributeSpec, port: Port, path: str, place: _Place) -> None:
    """Give an input its value or connection."""
    graph = path.rpartition("/")[0]
    if port.source[0] in place.names:
        attribute.connectionPathList.explicitItems = [_output(port.source, place)]
    elif port.interface and graph in place.names:
        owner = place.path(graph)
        attribute.connectionPathList.explicitItems = [owner.AppendProperty(_named_port("inputs", port.interface))]
    elif port.value is not None and port.kind in _KINDS:
        if port.kind == "filename":
            attribute.default = Sdf.AssetPath(_file(str(port.value), place.file))
            attribute.SetInfo("colorSpace", port.color_space or "lin_rec709")
        else:
            attribute.default = _KINDS[port.kind][1](port.value)


def _output(source: tuple[str, str], place: _Place) -> Sdf.Path:
    """Where an output is; of the only one the name may be left out."""
    one = place.document.nodes.get(source[0]) or place.document.graphs[source[0]]
    names = [output[0] for output in one.outputs]
    name = source[1] if source[1] in names or not names else names[0]
    return place.path(source[0]).AppendProperty(_named_port("outputs", name))


def _file(name: str, file: str) -> str:
    """A picture's path, as the file that names it has it beside itself. Nothing is fetched."""
    name = name.replace("\\", "/")
    if "://" in name or name.startswith("//"):
        return name  # the texture's reader finds no such file, and says so
    if os.path.isabs(name):
        return name
    if Ar.IsPackageRelativePath(file):  # USD's resolver would leave the package
        package, inner = (str(part) for part in Ar.SplitPackageRelativePathInner(file))
        within = posixpath.normpath(posixpath.join(posixpath.dirname(inner), name))
        return str(Ar.JoinPackageRelativePath([package, within]))
    return os.path.normpath(os.path.join(os.path.dirname(file), name))
