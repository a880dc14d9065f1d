"""A MaterialX file as plain records: its materials, the nodes behind them, and what drives each input.

The `materialx` wheel parses the file, brings older versions to 1.39 and says which definition a node has. The file may
be a stranger's: its size, depth and number of elements are bounded before it is parsed, it has no document type (so no
entities), and nothing it includes is read.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any, NamedTuple
from xml.parsers import expat

from ...errors import UsageError
from ...images.spaces import AUTO, canonical, linear, told
from ..values import finite, numbers

LARGEST = 1 << 24
"""Bytes of a file."""
ELEMENTS = 50_000
_DEEPEST = 32
EXTRA = "needs the extra `mtlx`: pip install 'usd-refract[mtlx]'"


class Unreadable(Exception):
    """It is no MaterialX, or too much of it; the text says why."""


class Port(NamedTuple):
    """An input, with what it has of: a value, a node's output, an input of the graph around it."""

    name: str
    kind: str
    """Type in MaterialX, such as color3."""
    value: Any
    """A number, a tuple of them, a text, a bool; None where it has none. File names have their prefix."""
    source: tuple[str, str]
    """Path of the node or graph that drives it, and the name of its output, '' for the only one."""
    interface: str
    color_space: str


class Node(NamedTuple):
    """A node, at the top or in a graph."""

    path: str
    identifier: str
    """Name of its definition, such as ND_image_color3."""
    ports: tuple[Port, ...]
    outputs: tuple[tuple[str, str], ...]
    """Name and type."""


class Graph(NamedTuple):
    """A node graph; in `outputs`, a port's source is the node inside."""

    path: str
    ports: tuple[Port, ...]
    outputs: tuple[Port, ...]


class Document(NamedTuple):
    """One file."""

    materials: dict[str, tuple[str, str]]
    """Name -> path of the surface shader's node, or of the graph it is in, and the name of its output."""
    nodes: dict[str, Node]
    graphs: dict[str, Graph]
    notices: tuple[str, ...]


@lru_cache(maxsize=2)  # a stage's files are looked through before they are composed
def read_document(content: bytes) -> Document:
    """Parse a file.

    Raises:
        UsageError: the wheel is not installed.
        Unreadable: it is too large or deep, or damaged.
    """
    check(content)
    mx = _wheel()
    document = mx.createDocument()
    document.setDataLibrary(load_library())
    options = mx.XmlReadOptions()
    options.readXIncludeFunction = None  # what a file includes is not read
    try:
        mx.readFromXmlString(document, content.decode("utf-8"), mx.FileSearchPath(), options)
        return _records(document)
    except Exception as error:  # the wheel has kinds of its own, straight below this one
        raise Unreadable(" ".join(str(error).split())[:300]) from error


def check(content: bytes) -> None:
    """Refuse what would cost too much to parse. Raises Unreadable."""
    if len(content) > LARGEST:
        raise Unreadable(f"it has {len(content)} bytes; at most {LARGEST} are read")
    depth = count = 0

    def begin(_name: str, _attributes: object) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > _DEEPEST:
            raise Unreadable(f"its elements are nested deeper than {_DEEPEST}")
        if count > ELEMENTS:
            raise Unreadable(f"it has more than {ELEMENTS} elements")

    def end(_name: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_anything: object) -> None:
        raise Unreadable("it has a document type, which MaterialX has not")

    parser = expat.ParserCreate("utf-8")  # as it is parsed afterwards, whatever it says of itself
    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = begin, end, refuse
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise Unreadable(f"it is not XML, from line {error.lineno} on") from error


def _wheel() -> Any:
    try:
        import MaterialX
    except ImportError as error:
        raise UsageError(f"MaterialX {EXTRA}") from error
    return MaterialX


@cache
def load_library() -> Any:
    """The standard definitions. Raises UsageError where the wheel is not installed."""
    mx = _wheel()
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    return library


# --- records ---


def _records(document: Any) -> Document:
    notices: dict[str, None] = {}
    graphs, nodes = {}, {}
    mx = _wheel()
    own = document.getChildren()  # getNodeGraphs would give the library's too
    for graph in (one for one in own if isinstance(one, mx.NodeGraph)):
        if graph.getNodeDefString():
            notices[f"MaterialX definition {graph.getNodeDefString()} of the file is not followed"] = None
            continue
        graphs[graph.getName()] = Graph(
            graph.getName(),
            tuple(_port(document, one, "", notices) for one in graph.getInputs()),
            tuple(_port(document, one, graph.getName(), notices) for one in graph.getOutputs()),
        )
        for node in graph.getNodes():
            made = _node(document, node, graph.getName(), notices)
            nodes[made.path] = made
    materials = {}
    for node in (one for one in own if isinstance(one, mx.Node)):
        if node.getCategory() != "surfacematerial":
            made = _node(document, node, "", notices)
            nodes[made.path] = made
            continue
        ports = {port.name: port for port in _node(document, node, "", notices).ports}
        if "surfaceshader" in ports and ports["surfaceshader"].source[0]:
            materials[node.getName()] = ports["surfaceshader"].source
        if "displacementshader" in ports:
            notices["MaterialX displacement is ignored; displace the mesh beforehand if its shape matters"] = None
    return Document(materials, nodes, graphs, tuple(notices))


def _node(document: Any, node: Any, graph: str, notices: dict[str, None]) -> Node:
    definition = node.getNodeDef()
    identifier = definition.getName() if definition else f"ND_{node.getCategory()}_{node.getType()}"
    outputs = [(one.getName(), one.getType()) for one in definition.getActiveOutputs()] if definition else []
    ports = tuple(_port(document, one, graph, notices) for one in node.getInputs())
    path = f"{graph}/{node.getName()}" if graph else node.getName()
    return Node(path, identifier, ports, tuple(outputs) or (("out", node.getType()),))


def _port(document: Any, port: Any, graph: str, notices: dict[str, None]) -> Port:
    """An input or a graph's output; names of nodes are those of the graph around it."""
    source = ""
    if port.getAttribute("nodegraph"):
        source = port.getAttribute("nodegraph")
    elif port.getNodeName():
        source = f"{graph}/{port.getNodeName()}" if graph else port.getNodeName()
    elif port.getAttribute("output") and graph == "":  # an output at the top of the file
        outer = document.getOutput(port.getAttribute("output"))
        if outer is not None and outer.getNodeName():
            return Port(port.getName(), port.getType(), None, (outer.getNodeName(), outer.getOutputString()), "", "")
    kind, text = port.getType(), port.getValueString()
    space = port.getActiveColorSpace()
    value = None if source or not text else _value(kind, text)
    if kind == "filename" and value:
        value = port.getActiveFilePrefix() + str(value)
    if kind in ("color3", "color4") and value is not None:
        value = _linear(value, space, notices)
    return Port(
        port.getName(), kind, value, (source, port.getAttribute("output")), port.getAttribute("interfacename"), space
    )  # fmt: skip


_SIZES = {"float": 1, "integer": 1, "color3": 3, "color4": 4, "vector2": 2, "vector3": 3, "vector4": 4}


def _value(kind: str, text: str) -> Any:
    """What a text stands for; None where it is no value of that type, or of a type no input here has."""
    if kind in ("string", "filename"):
        return text
    if kind == "boolean":
        return text.strip() == "true"
    if kind not in _SIZES:
        return None
    try:
        found = numbers([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        return None
    if found is None or len(found) != _SIZES[kind] or not finite(found):
        return None
    if kind == "integer":
        return int(found[0]) if abs(found[0]) < 1 << 31 else None
    return found[0] if kind == "float" else found


def _linear(color: tuple[float, ...], space: str, notices: dict[str, None]) -> tuple[float, ...]:
    """A colour of the file in linear Rec. 709."""
    if not (known := canonical(space)):
        notices[f"MaterialX {told(space)}; its colours are read as linear"] = None
    return linear(color, known or AUTO)
