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

# Library -> the only places that may import it, as the start of a module's name.
ROOMS = {
    "pxr": ("refract_core.usd", "schemas", "service.precheck"),
    "embreex": ("refract_core.world.embree",),
    "ctypes": ("refract_core.images.denoise", "refract_core.kernels.ahead", "refract_core.world.embree", "service"),
    "llvmlite": ("refract_core.kernels",),
    "numba": ("refract_core.kernels.jit", "refract_core.kernels.linking", "refract_core.kernels.pointer_type"),
    "OpenImageIO": ("refract_core.images",),
    "PIL": ("refract_core.images",),
    "imageio_ffmpeg": ("refract_core.images.animation",),
    "MaterialX": ("refract_core.usd.layers.mtlx_file",),
    "pygltflib": ("refract_core.usd.convert.gltf_file",),
    "xatlas": ("refract_core.thickness.unwrap",),
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

# The wings of the engine from the ground up: each may use those before it, and the records every wing speaks of.
RECORDS = ("errors", "files", "models", "progress", "scene", "settings", "version")
WINGS = (
    "kernels", "optics", "images", "studio", "world", "probes", "view", "transport", "rendering", "thickness", "usd",
    "verbs", "cli",
)  # fmt: skip
# The same inside the wing that is a house of its own.
USD_ROOMS = (
    "diagnostics", "values", "registering", "ours", "layers", "materials", "geometry", "lights", "probes", "preview",
    "stage",
    "convert", "thickness", "rules",
)  # fmt: skip

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


def in_checkout(name: str) -> str:
    """`refract_core.schemas` and `refract_core.service` by the names that their folders have in a checkout."""
    inner = name.removeprefix("refract_core.")
    return inner if under(inner, "schemas") or under(inner, "service") else name


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
        yield from (in_checkout(alias.name) for alias in node.names)
        return
    base = node.module or ""
    if node.level:
        parts = importer.split(".")
        above = parts[: len(parts) - node.level + is_package]
        base = ".".join([*above, base] if base else above)
    for alias in node.names:
        inner = in_checkout(f"{base}.{alias.name}")
        yield inner if inner in modules() else in_checkout(base)


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
    assert Import("refract_core.kernels.vec", "refract_core.kernels.compile", True) in imports()


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


def wing_of(name: str) -> str:
    """`probes` for refract_core.probes.plan; '' for what is not in the engine, or its front."""
    parts = name.split(".")
    return parts[1] if parts[0] == "refract_core" and len(parts) > 1 else ""


def test_every_module_of_the_engine_is_in_a_wing() -> None:
    assert {wing_of(name) for name in modules()} - {"", *RECORDS, *WINGS} == set()


def test_arrows_between_wings_point_down() -> None:
    """Imports inside functions count too: a wing that loads another late still needs it."""
    floors = {name: 0 for name in RECORDS} | {name: 1 + floor for floor, name in enumerate(WINGS)}
    strays = [
        f"{row.importer} imports {row.imported}"
        for row in imports()
        if (upper := wing_of(row.importer)) and (lower := wing_of(row.imported))
        if upper != lower and floors[lower] >= floors[upper] > 0
    ]
    assert strays == []


def test_arrows_between_the_rooms_of_usd_point_down() -> None:
    floors = {name: floor for floor, name in enumerate(USD_ROOMS)}

    def room(name: str) -> str:
        parts = name.split(".")
        return parts[2] if under(name, "refract_core.usd") and len(parts) > 2 and parts[2] in floors else ""

    strays = [
        f"{row.importer} imports {row.imported}"
        for row in imports()
        if (upper := room(row.importer)) and (lower := room(row.imported)) and floors[lower] > floors[upper]
    ]
    assert strays == []


def door_of(package: str) -> set[str]:
    """The rooms a wing opens to others: `__all__` of its front."""
    for node in ast.parse(modules()[package].read_text("utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


@pytest.mark.parametrize("wing", [*WINGS, *(f"usd.{room}" for room in USD_ROOMS)])
def test_a_wing_says_what_it_is_and_is_entered_by_its_door(wing: str) -> None:
    package = f"refract_core.{wing}"
    if modules()[package].name != "__init__.py":  # a room of one module is its own door
        return
    text = ast.get_docstring(ast.parse(modules()[package].read_text("utf-8")))
    assert text is not None
    assert len(text) > 40
    if wing == "cli":  # nobody enters it but the user
        return
    door = door_of(package)
    depth = package.count(".") + 1
    rooms = {name.split(".")[depth] for name in modules() if name.startswith(f"{package}.")}
    assert door <= rooms
    strays = [
        f"{row.importer} imports {row.imported}"
        for row in imports()
        if under(row.imported, package) and not under(row.importer, package)
        if row.imported != package and row.imported.split(".")[depth] not in door
    ]
    assert strays == []


def test_wings_share_no_private_names() -> None:
    strays = []
    for importer, path in modules().items():
        for node, _ in statements(ast.parse(path.read_text("utf-8")).body, True):
            if isinstance(node, ast.ImportFrom):
                strays += [f"{importer} imports {alias.name}" for alias in node.names if alias.name.startswith("_")]
    assert [s for s in strays if "__" not in s] == []


def test_functions_and_modules_share_no_names() -> None:
    """`import refract_core.render as m` must not give a function."""
    front = door_of("refract_core")
    assert len(front) > 10
    assert {name for name in front if f"refract_core.{name}" in modules()} == set()


def test_what_is_taken_from_the_front_is_there() -> None:
    """The front loads its names when asked (`__getattr__`), so that a type checker believes in any name."""
    front = "refract_core"
    strays = []
    for importer, path in modules().items():
        for node, _ in statements(ast.parse(path.read_text("utf-8")).body, True):
            if isinstance(node, ast.ImportFrom) and node.module == front and not node.level:
                names = {alias.name for alias in node.names} - door_of(front)
                strays += [f"{importer} imports {name}" for name in names if f"{front}.{name}" not in modules()]
    assert strays == []


def test_no_import_cycles() -> None:
    """Imports inside functions count too, but in the package's own front, which loads its rooms when asked."""
    below: dict[str, set[str]] = {name: set() for name in modules()}
    for row in imports():
        if row.imported in below and (row.on_load or row.importer != "refract_core"):
            below[row.importer].add(row.imported)
    while leaves := {name for name, rooms in below.items() if not rooms & below.keys() - {name}}:
        below = {name: rooms for name, rooms in below.items() if name not in leaves}
    assert sorted(below) == []


@pytest.mark.parametrize("name", ["refract_core", "schemas", "refract_core.errors", "refract_core.settings"])
def test_importing_the_front_loads_nothing_heavy(name: str) -> None:
    code = f"import sys, {name}; print(sorted(sys.modules.keys() & set({HEAVY!r})))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
