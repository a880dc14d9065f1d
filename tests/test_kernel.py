"""Where compiled kernels come from."""

from __future__ import annotations

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
