"""Before USD composes a stage: every file it names must lie inside its own folder.

Layers are opened one by one at the Sdf level, which follows no reference, and their names are compared as text and by
`realpath`, never through USD's resolver: that would take a name from the process's folder, or follow a link out.
The only module of the service that knows USD; it runs in the confined worker alone.
"""

from __future__ import annotations

import os
import posixpath
import zipfile
from collections import deque
from typing import NamedTuple

from pxr import Ar, Sdf, Tf, UsdUtils

from refract_core.errors import StageError
from refract_core.usd.diagnostics import captured
from refract_core.usd.layers import mtlx
from refract_core.usd.prim_count import count_prims

from .gltf_parts import parts_of
from .uploads import GLTF

_LAYERS = (".usd", ".usda", ".usdc", ".usdz")
_OPINIONS = 8
"""Specs a prim may be put together from, on average: what composing costs where few prims refer to much."""


class Refused(Exception):
    """The stage may not be opened; the text names what it refers to, in its own words."""


class TooMany(Refused):
    """It is made of more than is allowed."""


class Place(NamedTuple):
    """A layer: a file, or a file inside a package."""

    file: str
    """Absolute path."""
    inner: str = ""

    def name(self) -> str:
        return f"{self.file}[{self.inner}]" if self.inner else self.file


def check_size(path: str, prims: int) -> None:
    """Refuse a stage of too many prims, before USD composes one of them. The layers must be checked already.

    Raises:
        TooMany: with the number that was found.
    """
    try:
        found = count_prims(path, stop=prims)
    except StageError:
        return  # who opens it says why it cannot be read
    if found.more:
        text = f"the stage would be composed of more prims than can be counted, {found.prims} by then"
        raise TooMany(f"{text}; the limit is {prims} (prims)")
    if found.prims > prims:
        raise TooMany(f"the stage would be composed of {found}; the limit is {prims} (prims)")
    if found.opinions > _OPINIONS * prims:
        text = f"the stage's {found} would be put together from {found.opinions} opinions"
        raise TooMany(f"{text}; the limit is {prims} prims of {_OPINIONS} opinions each (prims)")


def check_stage(path: str, root: str, *, layers: int, unpacked_bytes: int) -> list[Sdf.Layer]:
    """Refuse a stage that reaches outside `root`, in any variant, payload, clip or texture.

    Returns its layers: while they are held, whoever opens the stage does not read their files again.

    Args:
        path: the root layer.
        root: folder that holds all it may use.
        layers: most layers.
        unpacked_bytes: most bytes in one package.

    Raises:
        Refused: with the offending name.
        TooMany: too many layers, or too much in a package.
    """
    root = os.path.realpath(root)
    first = Place(os.path.abspath(path))
    _inside(first.file, root, os.path.basename(path))
    waiting, seen = deque([first]), {first}
    packages: dict[str, frozenset[str]] = {}
    held: list[Sdf.Layer] = []
    while waiting:
        here = waiting.popleft()
        if not here.inner and here.file.lower().endswith(".usdz") and os.path.isfile(here.file):
            packages[here.file] = _package(here.file, unpacked_bytes)
        for name, composed in _names(here, held):
            found = _resolved(name, here, root)
            if found is None or found in seen or not composed:
                continue
            seen.add(found)
            if len(seen) > layers:
                raise TooMany(f"the stage is made of more than {layers} layers")
            waiting.append(found)
    return held


def _names(place: Place, held: list[Sdf.Layer]) -> list[tuple[str, bool]]:
    """What a layer refers to, and whether as another layer. A layer that cannot be read refers to nothing; one that can
    is added to `held`."""
    if not place.inner and not os.path.isfile(place.file):
        return []
    if not place.inner and place.file.lower().endswith(GLTF):
        return [(name, False) for name in parts_of(place.file)]
    if mtlx.is_file(place.name()):
        return [(name, False) for name in mtlx.written_in(place.name())]
    if not (place.inner or place.file).lower().endswith(_LAYERS):
        return []
    with captured():
        try:
            layer = Sdf.Layer.FindOrOpen(place.name())
            if not layer:
                return []
            held.append(layer)
            composed = {str(name) for name in layer.GetCompositionAssetDependencies()}
            every = [str(name) for part in UsdUtils.ExtractExternalReferences(place.name()) for name in part]
        except Tf.ErrorException:
            return []
    return [(name, True) for name in sorted(composed)] + [(name, False) for name in sorted({*every} - composed)]


def _resolved(name: str, here: Place, root: str) -> Place | None:
    """Where a name leads, as seen from the layer it stands in; None where it names nothing."""
    shown = name if len(name) <= 200 else f"{name[:200]}..."
    if not name:
        return None
    if "`" in name or "${" in name:
        raise Refused(f"'{shown}' is an expression; write the path itself")
    if "://" in name or name.startswith("\\\\") or "\0" in name or "SDF_FORMAT_ARGS" in name:
        raise Refused(f"'{shown}' is not the path of a file in the stage's own folder")
    outer, inner = (str(part) for part in Ar.SplitPackageRelativePathOuter(name)) if "[" in name else (name, "")
    outer = outer.replace("\\", "/")
    if posixpath.isabs(outer) or outer[1:2] == ":" or outer.startswith("~"):
        raise Refused(f"'{shown}' is an absolute path; name it relative to the stage")
    if here.inner:
        within = posixpath.normpath(posixpath.join(posixpath.dirname(here.inner), outer))
        if within.startswith(".."):
            raise Refused(f"'{shown}' leads out of its package")
        return Place(here.file, within if not inner else f"{within}[{inner}]")
    if here.file.lower().endswith(".usdz"):  # its root layer is its first file
        within = posixpath.normpath(posixpath.join(posixpath.dirname(_first_of(here.file)), outer))
        if within.startswith(".."):
            raise Refused(f"'{shown}' leads out of its package")
        return Place(here.file, within if not inner else f"{within}[{inner}]")
    target = os.path.join(os.path.dirname(here.file), outer)
    _inside(target, root, shown)
    return Place(os.path.normpath(target), inner)


def _inside(path: str, root: str, shown: str) -> None:
    """Both as written and with every link followed."""
    for way in (os.path.normpath(path), os.path.realpath(path)):
        if os.path.commonpath([os.path.realpath(root), way]) != root and not way.startswith(root + os.sep):
            raise Refused(f"'{shown}' leads out of the stage's own folder")


def _package(path: str, unpacked_bytes: int) -> frozenset[str]:
    try:
        with zipfile.ZipFile(path) as package:
            entries = package.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return frozenset()  # USD has its own reader, and says what is wrong
    if sum(entry.file_size for entry in entries) > unpacked_bytes:
        raise TooMany(f"the package holds more than {unpacked_bytes} bytes when unpacked")
    for entry in entries:
        name = entry.filename.replace("\\", "/")
        if posixpath.isabs(name) or posixpath.normpath(name).startswith("..") or name[1:2] == ":":
            raise Refused(f"the package has a file named '{entry.filename[:200]}', outside itself")
        if entry.compress_type != zipfile.ZIP_STORED:
            raise Refused("the package is compressed; a .usdz only stores its files")
    return frozenset(entry.filename for entry in entries)


def _first_of(path: str) -> str:
    try:
        with zipfile.ZipFile(path) as package:
            return package.namelist()[0]
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, IndexError):
        return ""
