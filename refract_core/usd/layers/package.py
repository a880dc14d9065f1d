"""Packages (.usdz): everything a layer refers to, in one file, and out of one file again.

USD's own packer (usd-core 26.11) loses the offsets of sublayers and mixes up files of the same name, so files are
packed here in the tree in which they lie on disk: relative paths, and expressions that become such, stay as they are.
"""

from __future__ import annotations

import errno
import glob
import os
import shutil
import struct
import tempfile
import zipfile
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from pxr import Ar, Sdf, Tf

from ...errors import StageError
from .assets import anchored, asset_paths, copy_of, dependencies, edit_asset_paths, export, is_expression, outer_of

_LAYERS = (".usd", ".usda", ".usdc")
_ALIGNMENT = 64
_ZIP_HEADER = 30  # bytes before the name of a file
_ZIP_FIELD = struct.Struct("<HH")  # identifier and size of an extra field
_PADDING_ID = 0x1986


def pack(layer: Sdf.Layer, target: str, out: str) -> None:
    """Write a package whose root layer is `layer`.

    What the layer takes from other packages lies as plain files in the new one; a package that something else in the
    stage refers to goes in as it is. Files that the stage names but that are not there are left out.

    Args:
        layer: all its asset paths are absolute. Changed.
        target: the .usdz file to write.
        out: what the file will be called in the end; the root layer has its name.

    Raises:
        StageError: a file cannot be packed, or the package cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="refract-") as scratch:
        unpacked: dict[str, Path] = {}
        edit_asset_paths(layer, lambda asset: _unpacked(asset, scratch, unpacked))
        trees = _trees(asset_paths(layer), scratch)
        edit_asset_paths(layer, lambda asset: _named(asset, trees, ""))
        root_name = f"{Path(out).stem}.usdc"
        root = os.path.join(scratch, root_name)
        export(layer, root, out)
        entries = {root_name: root}
        for index, tree in enumerate(trees):
            for file in sorted(tree.files):
                name = f"{index}/{_relative(file, tree.folder)}"
                entries[name] = _ready(file, name, trees, scratch) if file.lower().endswith(_LAYERS) else file
        _write(entries, target, out)


# --- which files, under which names


class _Tree(NamedTuple):
    """Files that keep their places relative to each other."""

    folder: str
    files: set[str]


def _trees(assets: list[str], scratch: str) -> list[_Tree]:
    """The files that asset paths lead to, directly or not, in as few trees as they lie in; `scratch` is apart."""
    trees: list[_Tree] = []
    for asset in assets:
        files = _files_of(asset)
        if not files:
            continue
        tree = _Tree(os.path.commonpath([os.path.dirname(file) for file in files]), files)
        for other in list(trees):
            shared = os.path.commonpath([tree.folder, other.folder])
            together = _within(tree.folder, scratch) == _within(other.folder, scratch)
            if together and shared in (tree.folder, other.folder):
                trees.remove(other)
                tree = _Tree(shared, tree.files | other.files)
        trees.append(tree)
    return trees


def _within(path: str, folder: str) -> bool:
    return os.path.commonpath([path, folder]) == folder


def _files_of(asset: str) -> set[str]:
    """Absolute paths of a file and of everything it refers to, as far as they exist."""
    if is_expression(asset) or not os.path.isabs(outer_of(asset)):
        return set()
    if "<UDIM>" in asset:
        return {os.path.abspath(tile) for tile in tiles(asset)}
    outer = os.path.abspath(outer_of(asset))
    if not os.path.isfile(outer):
        return set()
    if not outer.lower().endswith((*_LAYERS, ".usdz")):
        return {outer}
    try:
        files, missing = dependencies(asset)
    except Tf.ErrorException as error:
        raise StageError(f"{asset}: cannot be packed, for a part of it cannot be read") from error
    for path in missing:
        if "${" in path:
            text = f"{os.path.basename(path)}: this asset path has a variable that cannot be resolved before packing"
            raise StageError(f"{text}; write a .usda or .usdc file instead of a .usdz")
    return set(files)


def tiles(asset: str) -> list[str]:
    """The files of a texture in tiles, whose name says <UDIM> for a number of four digits."""
    return glob.glob(glob.escape(asset).replace("<UDIM>", "[0-9]" * 4)) if "<UDIM>" in asset else []


def _relative(path: str, folder: str) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def _named(asset: str, trees: list[_Tree], folder: str) -> str:
    """An absolute asset path as seen from a folder of the package; what is in no tree stays as it is."""
    outer = outer_of(asset)
    holding = [one for one in trees if os.path.isabs(outer) and _within(os.path.abspath(outer), one.folder)]
    if not holding:
        return asset
    tree = max(holding, key=lambda one: len(one.folder))
    steps = _relative(f"{trees.index(tree)}/{_relative(outer, tree.folder)}", folder or ".")
    # Without the dot USD would look through its search path too.
    return (steps if steps.startswith("../") else f"./{steps}") + asset[len(outer) :]


def _ready(file: str, name: str, trees: list[_Tree], scratch: str) -> str:
    """A layer that can go into the package: the file itself, or a copy whose paths lead to their new places."""
    layer = Sdf.Layer.FindOrOpen(file)
    folder = os.path.dirname(name)

    def kept(asset: str) -> str:
        if is_expression(asset) or asset.startswith(("./", "../")):  # the tree keeps its shape
            return asset
        return _named(anchored(asset, layer), trees, folder)

    if layer is None or all(kept(asset) == asset for asset in asset_paths(layer)):
        return file
    copy = copy_of(layer)
    edit_asset_paths(copy, kept)
    path = os.path.join(scratch, "edited", name)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    export(copy, path, file)
    return path


def _write(entries: dict[str, str], target: str, out: str) -> None:
    """A zip file without compression, the content of each file on a 64-byte boundary (usdz specification)."""
    try:
        with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED, allowZip64=False) as archive:
            for name, file in entries.items():
                entry = zipfile.ZipInfo(name)  # with no date of its own, so that equal stages make equal files
                entry.external_attr = 0o644 << 16
                start = archive.start_dir + _ZIP_HEADER + len(name.encode()) + _ZIP_FIELD.size
                padding = -start % _ALIGNMENT
                entry.extra = _ZIP_FIELD.pack(_PADDING_ID, padding) + bytes(padding)
                with open(file, "rb") as source, archive.open(entry, "w") as content:
                    shutil.copyfileobj(source, content, 1 << 20)
    except (zipfile.LargeZipFile, RuntimeError) as error:
        text = "its files are too large for a package, which may have 4 GB, and each of its files 2 GB"
        raise StageError(f"{out}: {text}; write a .usda or .usdc file") from error


# --- files out of packages


def _unpacked(asset: str, scratch: str, done: dict[str, Path]) -> str:
    """Path of a plain file with the content of `asset`: unpacked into a folder in `scratch` where it is in a .usdz.

    Args:
        done: package -> its root layer, unpacked; grows.
    """
    outer, inner = Ar.SplitPackageRelativePathOuter(asset) if Ar.IsPackageRelativePath(asset) else (asset, "")
    if is_expression(asset) or not outer.lower().endswith(".usdz") or not os.path.isfile(outer):
        return asset
    folder = Path(scratch, f"package{list(done).index(outer) if outer in done else len(done)}")
    if outer not in done:
        done[outer] = folder / _extract(outer, folder)
        _check_inside(str(done[outer]), folder, outer)
    # The inner path may lie in a package again.
    return _unpacked(str(folder / inner), scratch, done) if inner else str(done[outer])


def _extract(package: str, folder: Path) -> str:
    """Unpack a .usdz.

    Returns:
        Name of its root layer, which is its first file.
    """
    try:
        with zipfile.ZipFile(package) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            for entry in entries:
                _check_entry(entry, package)
            if not entries:
                raise StageError(f"{package}: is an empty package; make it again")
            archive.extractall(folder, entries)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # a full disk, not an offset before the file
            raise
        raise StageError(f"{package}: is a damaged package; make it again") from error
    return entries[0].filename


def _check_entry(entry: zipfile.ZipInfo, package: str) -> None:
    """A name that would land outside the folder, or a compressed file, which may be a bomb and is not allowed."""
    name = entry.filename
    parts = PurePosixPath(name).parts
    if name.startswith("/") or ".." in parts or "\\" in name or ":" in name or "\0" in entry.orig_filename:
        raise StageError(f"{package}: holds a file named '{name}', which leads out of the package; it is not unpacked")
    if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
        raise StageError(f"{package}: holds compressed or encrypted files, which a .usdz may not; pack it again")


def _check_inside(layer: str, folder: Path, package: str) -> None:
    """Refuse a package that refers to files outside itself: they would be packed as if they belonged to it."""
    for file in _files_of(layer):
        if not Path(file).resolve().is_relative_to(folder.resolve()):
            name = os.path.basename(file)
            raise StageError(f"{package}: refers to the file {name} outside the package; it cannot be packed again")
