"""The map of the house, checked against the imports: which room knows which library, and that arrows point down."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("refract_core", "schemas", "service")
MAX_LINES = 400

# Library -> the only places that may import it, as the start of a module's name.
ROOMS = {
    "pxr": ("refract_core.usd", "schemas", "service.precheck"),
    "embreex": ("refract_core.world.embree",),
    "ctypes": ("refract_core.world.embree", "service"),
    "llvmlite": ("refract_core.world.embree", "refract_core.kernels.compile", "refract_core.kernels.pointer"),
    "OpenImageIO": ("refract_core.images.pictures", "refract_core.images.files", "refract_core.images.cubemap_files"),
    "pygltflib": ("refract_core.usd.convert.gltf_file",),
    "flip_evaluator": ("refract_core.verbs.compare",),
    "distributed": ("refract_core.verbs.executors", "service.cluster", "service.cluster_worker"),
    "dask": ("refract_core.verbs.executors",),
    "fastapi": ("service",),
    "starlette": ("service",),
    "uvicorn": ("service",),
    "pydantic": ("service",),
    "prometheus_client": ("service.metrics",),
    "typer": ("refract_core.cli",),
    "click": ("refract_core.cli",),
}

# Importer -> what it may never import: the start of a module's name.
NEVER = {
    "refract_core": ("service", "tests", "benchmarks"),
    "schemas": ("refract_core", "service", "tests", "benchmarks"),
    "service": ("refract_core.cli", "tests", "benchmarks"),
}

HEAVY = ("pxr", "numba", "fastapi", "OpenImageIO", "typer")


class Import(NamedTuple):
    """One import statement: who imports what, and whether it runs when the importer is loaded."""

    importer: str
    imported: str
    on_load: bool


def under(name: str, room: str) -> bool:
    return name == room or name.startswith(f"{room}.")


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def modules() -> dict[str, Path]:
    return {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def statements(body: list[ast.stmt], on_load: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Every import in `body`, however deep, but those that only a type checker sees."""
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, on_load
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from statements(node.orelse, on_load)
        else:
            inside = on_load and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            for name in ("body", "orelse", "finalbody"):
                yield from statements(getattr(node, name, None) or [], inside)
            for handler in [*getattr(node, "handlers", []), *getattr(node, "cases", [])]:
                yield from statements(handler.body, inside)


def targets(node: ast.Import | ast.ImportFrom, importer: str, is_package: bool) -> Iterator[str]:
    """Full names of what a statement imports; a name taken out of a module counts as that module."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
        return
    base = node.module or ""
    if node.level:
        parts = importer.split(".")
        above = parts[: len(parts) - node.level + is_package]
        base = ".".join([*above, base] if base else above)
    for alias in node.names:
        inner = f"{base}.{alias.name}"
        yield inner if inner in modules() else base


@cache
def imports() -> tuple[Import, ...]:
    found = []
    for importer, path in modules().items():
        tree = ast.parse(path.read_text("utf-8"), str(path))
        for node, on_load in statements(tree.body, True):
            names = targets(node, importer, path.name == "__init__.py")
            found += [Import(importer, name, on_load) for name in names]
    return tuple(found)


def test_the_walk_sees_what_is_there() -> None:
    """Guards the tests below against passing because nothing was found."""
    assert Import("refract_core.settings", "refract_core.errors", True) in imports()
    assert Import("schemas", "pxr", False) in imports()
    assert any(row.importer.startswith("refract_core.usd.") and row.imported == "pxr" for row in imports())
    assert any(row.importer == "refract_core.kernels.vec" and row.imported == "refract_core.kernels.compile" for row in imports())


@pytest.mark.parametrize("library", ROOMS)
def test_a_library_is_imported_only_in_its_room(library: str) -> None:
    strays = [
        f"{row.importer} imports {row.imported}"
        for row in imports()
        if under(row.imported, library) and not any(under(row.importer, room) for room in ROOMS[library])
    ]
    assert strays == []


@pytest.mark.parametrize("package", NEVER)
def test_arrows_point_down(package: str) -> None:
    strays = [
        f"{row.importer} imports {row.imported}"
        for row in imports()
        if under(row.importer, package) and any(under(row.imported, room) for room in NEVER[package])
        # the command line may start the service
        and not under(row.importer, "refract_core.cli")
    ]
    assert strays == []


def test_nothing_in_the_engine_imports_the_command_line() -> None:
    importers = {row.importer for row in imports() if under(row.imported, "refract_core.cli")}
    assert [name for name in importers if not under(name, "refract_core.cli")] == []


def test_no_import_cycles() -> None:
    """Imports inside functions count too, but in the package's own front, which loads its rooms when asked."""
    below: dict[str, set[str]] = {name: set() for name in modules()}
    for row in imports():
        if row.imported in below and (row.on_load or row.importer != "refract_core"):
            below[row.importer].add(row.imported)
    while leaves := {name for name, rooms in below.items() if not rooms & below.keys() - {name}}:
        below = {name: rooms for name, rooms in below.items() if name not in leaves}
    assert sorted(below) == []


def test_modules_are_short() -> None:
    sources = [*modules().values(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    lengths = {str(path.relative_to(ROOT)): len(path.read_text("utf-8").splitlines()) for path in sources}
    assert {name: lines for name, lines in lengths.items() if lines > MAX_LINES} == {}


@pytest.mark.parametrize("name", ["refract_core", "schemas", "refract_core.errors", "refract_core.settings"])
def test_importing_the_front_loads_nothing_heavy(name: str) -> None:
    code = f"import sys, {name}; print(sorted(sys.modules.keys() & set({HEAVY!r})))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
