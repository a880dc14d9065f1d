"""Uploads of several files: which names they may have, how they travel as one, and how a worker lays them out.

Files of a form are packed into one archive by the server, and a client's zip is such an archive already. Neither is
opened but by the locked worker, which refuses by name whatever could lie anywhere but under its folder, or be taken
for another file there.
"""

from __future__ import annotations

import os
import posixpath
import shutil
import stat
import unicodedata
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from typing import IO

from .problems import Problem

USD = (".usd", ".usda", ".usdc", ".usdz")
GLTF = (".glb", ".gltf")
ARCHIVE = ".zip"
_LONGEST_PART, _LONGEST, _DEEPEST = 255, 1024, 32
"""Bytes of one name, bytes of a path, folders within each other."""
_STEERING = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Characters that change the direction of writing, so that a name reads as another."""
_BY_SYSTEMS = ("__MACOSX",)
"""Folders that file managers add to archives; nobody meant to send them."""
_EVEN = 1 << 20
"""Bytes below which no ratio is too high."""
_STEP = 1 << 20


def checked_name(name: str) -> str:
    """A relative path with / between its parts, as it is.

    Raises:
        Problem: it leads elsewhere, or is written so that it could be taken for another one.
    """
    plain = unicodedata.normalize("NFKC", name)  # full-width dots and slashes among others
    parts = plain.split("/")
    if not name or plain.startswith(("/", "~")):
        raise _refused(name, "is an absolute path, or none; name each file relative to the upload")
    if "\\" in plain or ":" in plain:
        raise _refused(name, "holds a \\ or a :; write / between folders")
    if any(unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in plain):
        raise _refused(name, "holds a character that cannot be shown")
    if _STEERING.intersection(name):
        raise _refused(name, "holds a character that turns the direction of writing")
    if any(part in ("", ".", "..") for part in parts) or len(parts) != name.count("/") + 1:
        raise _refused(name, "leads out of the upload, or has a part without a name")
    if len(name.encode()) > _LONGEST or max(len(part.encode()) for part in name.split("/")) > _LONGEST_PART:
        raise _refused(name, f"is longer than {_LONGEST} bytes, or a part of it than {_LONGEST_PART}")
    if len(parts) > _DEEPEST:
        raise _refused(name, f"lies more than {_DEEPEST} folders deep")
    return name


def check_together(names: Iterable[str]) -> None:
    """Refuse names of which two are the same to some file system, or one is a file and a folder.

    Raises:
        Problem: with the name that comes second.
    """
    files: dict[str, str] = {}
    folders: dict[str, str] = {}
    for name in names:
        way = name.split("/")
        key = _alike(name)
        if key in files or key in folders:
            other = files.get(key) or folders[key]
            raise _refused(name, f"is as good as '{_shown(other)}'; files need different names")
        files[key] = name
        for count in range(1, len(way)):
            above = "/".join(way[:count])
            if _alike(above) in files or folders.setdefault(_alike(above), above) != above:
                other = files.get(_alike(above)) or folders[_alike(above)]
                raise _refused(name, f"lies in a folder that is as good as '{_shown(other)}'; give it another name")


def _alike(name: str) -> str:
    """The same for names that differ in case, in how letters are composed, or in characters that nobody sees."""
    folded = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    return "".join(letter for letter in folded if unicodedata.category(letter) != "Cf")


def _refused(name: str, why: str) -> Problem:
    return Problem("stage-refused", f"the file named '{_shown(name)}' {why}")


def _shown(name: str) -> str:
    """A name for a message: short, and with nothing in it that does not stand for itself."""
    short = name if len(name) <= 200 else f"{name[:200]}..."
    return "".join(one if one.isprintable() else f"\\u{ord(one):04x}" for one in short)


# --- the server's side ------------------------------------------------------------------------------------------------


def pack(files: Mapping[str, IO[bytes]], path: str | os.PathLike[str]) -> None:
    """Put files into one archive: equal files under equal names are an equal archive.

    Args:
        files: by their names, which have been checked.
    """
    with zipfile.ZipFile(path, "x", zipfile.ZIP_STORED) as archive:
        for name in sorted(files):
            files[name].seek(0)
            with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as part:
                shutil.copyfileobj(files[name], part, _STEP)


# --- the worker's side ------------------------------------------------------------------------------------------------


def unpack(path: str, folder: str, limits: Mapping[str, int]) -> list[str]:
    """Lay an archive out. Its names, kinds and sizes are checked before anything is written.

    Args:
        path: the archive.
        folder: empty.
        limits: `upload_files`, `stage_bytes`, `upload_ratio`.

    Returns:
        Names of the files, relative to `folder`.

    Raises:
        Problem: a file is refused by its name, they are too many or too large, or the archive is damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = _checked_entries(archive.infolist(), os.path.getsize(path), limits)
            left = limits["stage_bytes"]
            for entry in entries:
                left -= _extract(archive, entry, os.path.join(folder, entry.filename), left)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, UnicodeError, ValueError) as error:
        raise Problem("stage-invalid", "the archive cannot be read as a zip file: it is damaged") from error
    return [entry.filename for entry in entries]


def _checked_entries(found: list[zipfile.ZipInfo], packed: int, limits: Mapping[str, int]) -> list[zipfile.ZipInfo]:
    """The files of an archive, without folders and what file managers add."""
    meant = [entry for entry in found if entry.filename.split("/")[0] not in _BY_SYSTEMS
             and posixpath.basename(entry.filename) != ".DS_Store"]  # fmt: skip
    if len(meant) > limits["upload_files"]:
        raise Problem("limit-exceeded", f"the archive has {len(meant)} files; the limit is {limits['upload_files']}")
    for entry in meant:
        _check_entry(entry)
    files = [entry for entry in meant if not entry.is_dir()]
    check_together(entry.filename for entry in files)
    folders = {part for entry in files for part in _folders_of(entry.filename)}
    if len(folders) > limits["upload_files"]:
        text = f"the archive has {len(folders)} folders; the limit is {limits['upload_files']}, as of files"
        raise Problem("limit-exceeded", text)
    total = sum(entry.file_size for entry in files)
    if total > limits["stage_bytes"]:
        text = f"the archive holds {total} bytes when unpacked; the limit is {limits['stage_bytes']}"
        raise Problem("limit-exceeded", text)
    if total > _EVEN and total > packed * limits["upload_ratio"]:
        text = f"the archive holds {total // packed} times its own size; the limit is {limits['upload_ratio']}"
        raise Problem("limit-exceeded", text)
    return files


def _folders_of(name: str) -> list[str]:
    parts = name.split("/")
    return ["/".join(parts[:count]) for count in range(1, len(parts))]


def _check_entry(entry: zipfile.ZipInfo) -> None:
    name = checked_name(entry.filename.removesuffix("/"))
    if "\0" in entry.orig_filename:
        raise _refused(entry.orig_filename, "holds a character that cannot be shown")
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFDIR if entry.is_dir() else stat.S_IFREG):
        raise _refused(name, "is a link or a device; pack the file itself")
    if entry.flag_bits & 0x1:
        raise _refused(name, "is encrypted; pack it without a password")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _refused(name, "is compressed in a way that is not read; use deflate, or none")


def _extract(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: str, most: int) -> int:
    """Write one file. Returns its bytes, which are counted as they come: what a head says is not believed."""
    os.makedirs(os.path.dirname(target), mode=0o700, exist_ok=True)
    count = 0
    with archive.open(entry) as source, open(target, "xb") as file:
        while part := source.read(_STEP):
            count += len(part)
            if count > most:
                raise Problem("limit-exceeded", "the archive holds more than it says")
            file.write(part)
    return count


def stage_among(names: Iterable[str], wanted: str) -> str:
    """Which file is the stage: the one that is named, else the only one that is not below another.

    Raises:
        Problem: there is none, or more than one.
    """
    known = sorted(name for name in names if name.lower().endswith((*USD, *GLTF)))
    if wanted:
        if wanted in known:
            return wanted
        raise _no_stage(f"the upload has no stage '{_shown(wanted)}'; it has {_list(known)}")
    least = min((name.count("/") for name in known), default=0)
    top = [name for name in known if name.count("/") == least and not posixpath.basename(name).startswith(".")]
    if len(top) == 1:
        return top[0]
    if top:
        raise _no_stage(f"the upload has several stages: {_list(top)}; name one of them in the settings")
    raise _no_stage(f"the upload has no stage; send one of {', '.join((*USD, *GLTF))}")


def _no_stage(text: str) -> Problem:
    return Problem("invalid-settings", f"/stage: {text}", errors=[{"pointer": "/stage", "detail": text}])


def _list(names: list[str]) -> str:
    return ", ".join(_shown(name) for name in names[:10]) + (", ..." if len(names) > 10 else "") if names else "none"
