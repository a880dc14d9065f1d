"""Where compiled kernels come from: what makes one another, where it is kept, and that nothing of a host is touched."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
SPY = """
import sys
from numba.core.dispatcher import _FunctionCompiler
compile = _FunctionCompiler._compile_cached
def spy(self, *arguments):
    print("compiles", self.py_func.__module__, self.py_func.__name__)
    return compile(self, *arguments)
_FunctionCompiler._compile_cached = spy
from refract_core.cli import app
for stage in sys.argv[1:]:
    words = ["render", stage, OUT, "--image-width", "24", "--samples", "1"]
    app(words, standalone_mode=False)
"""


@pytest.mark.parametrize("stages", [("marble", "glass_behind_glass"), ("two_probes", "planar_table", "thickness_map")])
def test_a_second_process_compiles_nothing(stages: tuple[str, ...], tmp_path: Path) -> None:
    """It loads what the first one left: 100 ms each would be lost in every process."""
    paths = [str(ROOT / "usd_samples" / "good" / f"{stage}.usda") for stage in stages]
    program = SPY.replace("OUT", repr(str(tmp_path / "out.png")))
    command = [sys.executable, "-c", program, *paths]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True, timeout=600)
    second = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=600)
    assert second.stdout == ""


# --- the key

CALLED = """
from enum import IntEnum
from refract_core.kernels.compile import inlined

FACTOR = 3.0
UNUSED = 1.0
class Way(IntEnum):
    UP = 1
    DOWN = 2

@inlined
def deepest(x):
    return x * FACTOR if x > 0.0 else x * Way.DOWN.value
"""
BETWEEN = """
import called

from refract_core.kernels.compile import inlined

@inlined
def between(x):
    return called.deepest(x) + 1.0
"""
CALLER = """
from between import between
from refract_core.kernels.compile import kernel

@kernel
def outer(x):
    '''A kernel.'''
    return between(x)
"""
SHOW = "import caller, refract_core.kernels.store as s; print(s.stem(caller.outer.py_func))"


def outputs(program: str, *folders: Path) -> str:
    """What a fresh process prints that finds modules in `folders`."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders)), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-P", "-c", program]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def key_after(folder: Path, edits: dict[str, tuple[str, str]], engine: Path = ROOT) -> str:
    """Name under which `outer` would be kept after edits of the three modules above."""
    for name, text in {"called": CALLED, "between": BETWEEN, "caller": CALLER}.items():
        old, new = edits.get(name, ("", ""))
        assert old in text
        (folder / f"{name}.py").write_text(text.replace(old, new) if old else text)
    return outputs(SHOW, folder, engine)


@pytest.mark.parametrize(
    "edits",
    [
        {"called": ("FACTOR = 3.0", "FACTOR = 3.5")},
        {"called": ("x * FACTOR", "FACTOR / x")},
        {"called": ("> 0.0", "> 0.5")},
        {"called": ("DOWN = 2", "DOWN = 4")},
        {"called": ("import inlined\n", "import leaf as inlined\n")},
        {"between": ("+ 1.0", "- 1.0")},
        {"caller": ("between(x)", "between(2.0 * x)")},
    ],
)
def test_an_edit_of_what_is_compiled_changes_the_key(edits: dict[str, tuple[str, str]], tmp_path: Path) -> None:
    """However deep it is called from."""
    assert key_after(tmp_path, edits) != key_after(tmp_path, {})


@pytest.mark.parametrize(
    "edits",
    [
        {"called": ("FACTOR = 3.0", "# how much\n\n\nFACTOR = 3.0")},
        {"between": ("    return", "    '''In between.'''\n    return")},
        {"caller": ("'''A kernel.'''", "'''The kernel, or what it is called.'''")},
        {"caller": ("'''A kernel.'''", "# no words at all")},
        {"called": ("UNUSED = 1.0", "UNUSED = 2.0")},
        {"between": ("def between", "def other(x):\n    return x\n\n@inlined\ndef between")},
    ],
)
def test_an_edit_of_anything_else_keeps_the_key(edits: dict[str, tuple[str, str]], tmp_path: Path) -> None:
    assert key_after(tmp_path, edits) == key_after(tmp_path, {})


@pytest.fixture
def copied_engine(tmp_path: Path) -> Path:
    """A folder with a copy of the package, to be edited."""
    copy = tmp_path / "copy"
    for name in ("refract_core", "schemas"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


@pytest.mark.parametrize(
    ("room", "old", "new", "same"),
    [
        ("pointer", "return 1 + kind.ndim", "return 2 + kind.ndim", False),  # another layout
        ("pointer_type", "load(1 + axis)", "load(2 + axis)", False),  # read differently
        ("jit", '"contract", ', "", False),  # compiled differently
        ("pointer", "class Pointer:", "# A comment.\nclass Pointer:", True),
        ("compile", "class Kernel:", "class Other: ...\n\n\nclass Kernel:", True),
    ],
)
def test_the_layout_of_records_and_the_compiler_are_in_the_key(
    room: str, old: str, new: str, same: bool, copied_engine: Path, tmp_path: Path
) -> None:
    """An edit of `pointer` with a warm cache was a segmentation fault."""
    before = key_after(tmp_path, {}, copied_engine)
    file = copied_engine / "refract_core" / "kernels" / f"{room}.py"
    text = file.read_text("utf-8")
    assert old in text
    file.write_text(text.replace(old, new), "utf-8")
    assert (key_after(tmp_path, {}, copied_engine) == before) is same


# --- a good guest


def test_a_hosts_numba_is_left_alone(tmp_path: Path) -> None:
    """The host's own kernels are kept where they would be without us, and what is set stays set."""
    program = f"""
import numba
from numba import njit

def settings():
    return {{name: value for name, value in vars(numba.config).items() if name.isupper()}}

before = settings()
import refract_core as rc
from refract_core.kernels.store import folder
scene = rc.load_stage({str(ROOT / "usd_samples" / "good" / "marble.usda")!r})
rc.render(scene, rc.RenderSettings(image_width=16, samples=1))
import host
host.twice(2.0)
assert settings() == before
print(host.twice._cache.cache_path, folder() in __import__("pathlib").Path(host.twice._cache.cache_path).parents)
"""
    (tmp_path / "host.py").write_text("from numba import njit\n@njit(cache=True)\ndef twice(x):\n    return 2.0 * x\n")
    assert outputs(program, tmp_path, ROOT).split() == [str(tmp_path / "__pycache__"), "False"]


def test_a_process_can_be_told_to_keep_nothing(tmp_path: Path) -> None:
    """Who runs others' jobs reads kernels and writes none."""
    (tmp_path / "own.py").write_text(
        "from refract_core.kernels.compile import kernel\n@kernel\ndef twice(x):\n    return 2.0 * x\n"
    )
    program = f"""
import os
os.environ["REFRACT_CACHE_DIR"] = {str(tmp_path / "cache")!r}
from refract_core.kernels.compile import is_compiled, keep_nothing
from own import twice
from refract_core.kernels.store import is_kept
if WISH:
    keep_nothing()
assert not is_compiled(twice)
assert twice(2.0) == 4.0
assert is_compiled(twice)
print(is_kept(twice.py_func))
"""
    assert outputs(program.replace("WISH", "True"), tmp_path, ROOT) == "False\n"
    assert outputs(program.replace("WISH", "False"), tmp_path, ROOT) == "True\n"


# --- one kernel, one optimisation


def test_a_function_of_kernels_has_no_entry_for_python(tmp_path: Path) -> None:
    """Calling what has no machine code is a TypeError, not the end of the process; what is called by name works."""
    (tmp_path / "own.py").write_text(
        "from refract_core.kernels.compile import inlined\n@inlined\ndef twice(x):\n    return 2.0 * x\n"
        "@inlined\ndef more(x):\n    return twice(x) + 1.0\n"
    )
    program = """
import own
from refract_core.kernels import jit, linking
assert linking.is_known()
bare = jit.inlined(own.twice.py_func, False)
try:
    bare(2.0)
except TypeError:
    print(own.twice(2.0), own.more(2.0))
"""
    assert outputs(program, tmp_path, ROOT) == "4.0 5.0\n"


def test_a_numba_that_was_not_tried_compiles_as_it_does_by_itself(tmp_path: Path) -> None:
    """The same values from a version whose inner classes may be others."""
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "between.py").write_text(BETWEEN)
    (tmp_path / "called.py").write_text(CALLED)
    program = """
import os, numba
numba.__version__ = "0.99.0"
os.environ["REFRACT_CACHE_DIR"] = CACHE
from refract_core.kernels import linking
assert not linking.is_known() and not linking.KERNEL and not linking.TEXT
import caller
print(caller.outer(2.0), caller.outer(-2.0))
"""
    assert outputs(program.replace("CACHE", repr(str(tmp_path / "cache"))), tmp_path, ROOT) == "7.0 -3.0\n"
