"""The map in numbers: rooms, arrows between them, floors, names a room, words of explanation.

    python -m benchmarks.structure [FOLDER]

A room is a module; an arrow says that one imports another, wherever in its text; the floor of a room is the longest way
down from it. A wing is a folder of rooms (the records at the top stand together as one). Names are what a room defines
at its top level; comment is the share of lines that are comments or docstrings.
"""

from __future__ import annotations

import ast
import io
import statistics
import sys
import tokenize
from functools import cache
from pathlib import Path


def modules_of(root: Path) -> dict[str, Path]:
    """Rooms by their full names; the fronts of packages are doors, not rooms."""
    paths = sorted(path for path in root.rglob("*.py") if path.name != "__init__.py")
    return {".".join(path.relative_to(root.parent).with_suffix("").parts): path for path in paths}


def imported(name: str, path: Path, modules: dict[str, Path]) -> set[str]:
    """Rooms that a room imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        above = name.split(".")[: -node.level] if node.level else []
        base = ".".join([*above, *([node.module] if node.module else [])])
        for alias in node.names:
            for target in (f"{base}.{alias.name}", base):
                if target in modules:
                    found.add(target)
                    break
    return found - {name}


def wing_of(name: str) -> str:
    """The folder of a room; `records` for what stands at the top."""
    parts = name.split(".")
    return parts[1] if len(parts) > 2 else "records"


def floors(below: dict[str, set[str]]) -> int:
    """Rooms on the longest way down."""

    @cache
    def depth(name: str) -> int:
        return 1 + max((depth(other) for other in below[name]), default=0)

    return max(depth(name) for name in below)


def names_in(path: Path) -> int:
    """Functions, classes and constants at the top of a room."""
    count = 0
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef | ast.AnnAssign):
            count += 1
        elif isinstance(node, ast.Assign):
            count += len(node.targets)
    return count


def explained(path: Path) -> tuple[int, int]:
    """(lines of comments and docstrings, lines that are not blank)"""
    text = path.read_text("utf-8")
    words: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            words.add(token.start[0])
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            words.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(words), sum(1 for line in text.splitlines() if line.strip())


def main() -> int:
    root = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "refract_core").resolve()
    modules = modules_of(root)
    below = {name: imported(name, path, modules) for name, path in modules.items()}
    wings = {wing_of(name): {wing_of(other) for other in below[name]} for name in modules}
    for name, others in below.items():
        wings[wing_of(name)] |= {wing_of(other) for other in others}
    between = sum(len(others - {wing, "records"}) for wing, others in wings.items())
    words, lines = (sum(column) for column in zip(*map(explained, modules.values()), strict=True))
    print(f"{len(modules)} rooms in {len(wings)} wings, {sum(map(len, below.values()))} arrows, {floors(below)} floors")
    print(f"{between} arrows between wings, those to the records left out")
    print(f"{statistics.mean(names_in(path) for path in modules.values()):.1f} names a room, ", end="")
    print(f"{lines / len(modules):.0f} lines a room, {words / lines:.0%} of them explain")
    for wing, others in wings.items():
        rooms = [name for name in modules if wing_of(name) == wing]
        inside = sum(len([o for o in below[name] if wing_of(o) == wing]) for name in rooms)
        uses = ", ".join(sorted(others - {wing})) or "nothing"
        print(f"  {wing:10s} {len(rooms):3d} rooms, {inside:3d} arrows inside; uses {uses}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
