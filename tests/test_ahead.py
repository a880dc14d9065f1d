"""Kernels compiled when the package is built: the same pictures without numba, and never called when they are stale."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from refract_core.kernels import ahead, build, store
from refract_core.kernels.arrays import F32_2D
from refract_core.kernels.declared import kind_of, signature_of
from refract_core.kernels.lanes import Column, Scalars
from refract_core.kernels.pointer import BOOL, FLOAT, INT, Array, Layout, Pointer, Row

ROOT = Path(__file__).parents[1]
STAGES = ROOT / "usd_samples" / "good"


def possible() -> str:
    """Why nothing can be built here; '' where it can."""
    try:
        build.compiler()
    except build.CannotBuild as error:
        return str(error)
    return ""


def on_what_is_built(test: Any) -> Any:
    """A test of the kernels in a wheel, whose making takes a minute or two."""
    return pytest.mark.slow(pytest.mark.skipif(bool(possible()), reason=possible() or "it can")(test))


def run(program: str, root: Path, **variables: str) -> str:
    """What a fresh process prints that finds the package in `root`."""
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1", **variables}
    command = [sys.executable, "-P", "-c", program]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=900)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.fixture
def copy(site: Path, tmp_path: Path) -> Path:
    """A copy of the wheel's contents, to be spoilt."""
    shutil.copytree(site, tmp_path / "copy")
    return tmp_path / "copy"


STATE = "from refract_core.kernels import ahead; found, why = ahead.state(); print(len(found), why)"
FORBID = """
import sys
class Forbidden:
    def find_spec(self, name, path=None, target=None):
        assert name.partition(".")[0] not in ("numba", "llvmlite"), name
sys.meta_path.insert(0, Forbidden())
"""
RENDER = """
import sys
import numpy as np
import refract_core as rc
found = {}
for name in sys.argv[1:] or NAMES:
    frame = rc.render(rc.load_stage(f"{STAGES}/{name}.usda"), rc.RenderSettings(image_width=48, samples=2, tiers=TIERS))
    found |= {f"{name} {aov}": plane for aov, plane in frame.planes.items()}
np.savez(OUT, **found)
"""


def rendering(out: Path, names: tuple[str, ...], tiers: tuple[str, ...]) -> str:
    """A program that renders samples and keeps all their planes."""
    words = {"STAGES": str(STAGES), "NAMES": repr(names), "TIERS": repr(tiers), "OUT": repr(str(out))}
    program = RENDER
    for word, text in words.items():
        program = program.replace("{STAGES}", text) if word == "STAGES" else program.replace(word, text)
    return program


@on_what_is_built
def test_a_wheel_has_kernels_and_its_name_says_for_whom(site: Path) -> None:
    assert run(STATE, site) == f"{len(build.kernels())} \n"
    (wheel,) = site.parent.glob("*.whl")
    assert re.search(r"-py3-none-(manylinux_2_\d+|linux)_x86_64\.whl$", wheel.name)


@on_what_is_built
@pytest.mark.parametrize("tiers", [("screen", "probe", "sky"), ("ray", "sky")])
def test_pictures_are_those_of_numba_bit_by_bit(tiers: tuple[str, ...], site: Path, tmp_path: Path) -> None:
    names = ("marble", "glass_behind_glass", "two_probes", "planar_table", "thickness_map", "traced")
    run(FORBID + rendering(tmp_path / "ahead.npz", names, tiers), site)
    # Numba's from the sources themselves, which the wheel holds, too: what it compiles is kept for other tests.
    run(rendering(tmp_path / "numba.npz", names, tiers) + "assert 'numba' in sys.modules", ROOT, REFRACT_KERNELS="jit")
    ours, theirs = np.load(tmp_path / "ahead.npz"), np.load(tmp_path / "numba.npz")
    assert set(ours.files) == set(theirs.files)
    assert [plane for plane in ours.files if ours[plane].tobytes() != theirs[plane].tobytes()] == []


@on_what_is_built
@pytest.mark.parametrize(
    "words",
    [
        ("bake", "probes", "IN/two_probes.usda", "OUT/baked.usda", "--samples", "1"),
        ("bake", "thickness", "IN/traced.usda", "OUT/thick.usda"),
        ("node", "--incident", "0.5,-0.866,0", "--normal", "0,1,0"),
        ("render", "IN/glass_behind_glass.usda", "OUT/picture.exr", "--image-width", "32", "--screen", "proxy"),
    ],
)
def test_no_verb_needs_numba(words: tuple[str, ...], site: Path, tmp_path: Path) -> None:
    given = [w.replace("OUT", str(tmp_path)).replace("IN", str(STAGES)) for w in words]
    program = f"{FORBID}\nfrom refract_core.cli import app\napp({given!r}, standalone_mode=False)"
    run(program, site)


@on_what_is_built
def test_optics_of_arrays_need_no_numba(site: Path) -> None:
    program = """
from refract_core.optics import arrays
n, i = [0.0, 0.0, 1.0], [0.6, 0.0, -0.8]
print(arrays.reflect(i, n).round(12).tolist(), arrays.refract(i, n, 1.5).ok)
print(arrays.fresnel_dielectric(1.0, 1.5).round(9))
arrays.transmittance([0.5, 0.5, 0.5], 1.0, 2.0)
arrays.sphere_model([0, 0, 0], n, n, 1.5, 1.0), arrays.box_model([0, 0, 0], n, n, 1.5, 1.0), arrays.refract_node(i, n)
"""
    assert run(FORBID + program, site) == "[0.6, 0.0, 0.8] True\n0.04\n"


# --- never stale


@on_what_is_built
@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("kernels/vec.py", "return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]", "return a[0] * b[0] + a[1] * b[1]"),
        ("view/camera.py", "    orthographic: bool\n", "    orthographic: bool\n    more: float = 0.0\n"),
        ("kernels/pointer.py", "return 1 + kind.ndim", "return 2 + kind.ndim"),
        ("world/embree.py", "FIRST_CAPTURED_BIT = 5", "FIRST_CAPTURED_BIT = 6"),
    ],
)
def test_an_edited_source_means_numba(file: str, old: str, new: str, copy: Path) -> None:
    """A stale layout would read garbage."""
    assert run(STATE, copy) == f"{len(build.kernels())} \n"
    edited = copy / "refract_core" / file
    text = edited.read_text("utf-8")
    assert old in text
    edited.write_text(text.replace(old, new), "utf-8")
    assert run(STATE, copy) == f"0 {file} is not what the kernels were compiled from\n"


@on_what_is_built
def test_a_lost_source_means_numba(copy: Path) -> None:
    (copy / "refract_core" / "world" / "offsets.py").unlink()
    assert "world/offsets.py is not what" in run(STATE, copy)


@on_what_is_built
def test_object_and_manifest_are_of_one_build(copy: Path) -> None:
    file = copy / "refract_core" / "kernels" / "built" / ahead.MANIFEST
    manifest = json.loads(file.read_text("utf-8"))
    file.write_text(json.dumps({**manifest, "key": "0" * 64}), "utf-8")
    assert run(STATE, copy) == "0 kernels.so and kernels.json are not of one build\n"


@on_what_is_built
def test_a_damaged_object_means_numba(copy: Path) -> None:
    (copy / "refract_core" / "kernels" / "built" / ahead.OBJECT).write_bytes(b"not machine code")
    assert run(STATE, copy).startswith("0 kernels.so cannot be loaded: ")


@on_what_is_built
def test_an_older_processor_means_numba(copy: Path, tmp_path: Path) -> None:
    """The shared object says itself whether it runs here."""
    folder = copy / "refract_core" / "kernels" / "built"
    key = json.loads((folder / ahead.MANIFEST).read_text("utf-8"))["key"]
    source = tmp_path / "old.c"
    source.write_text(f'const char refract_key[] = "{key}"; int refract_runs_here(void) {{ return 0; }}')
    subprocess.run([build.compiler(), "-shared", "-fPIC", "-o", folder / ahead.OBJECT, source], check=True)
    assert run(STATE, copy) == "0 this processor is not a x86-64-v3\n"


@on_what_is_built
def test_the_environment_may_ask_for_numba(site: Path) -> None:
    assert run(STATE, site, REFRACT_KERNELS="jit") == "0 REFRACT_KERNELS is jit\n"
    program = "from refract_core.errors import UsageError\ntry:\n    exec(STATE)\nexcept UsageError as e:\n    print(e)"
    said = run(program.replace("STATE", repr(STATE)), site, REFRACT_KERNELS="no")
    assert said == "REFRACT_KERNELS is 'no'; write jit, or leave it out\n"


@on_what_is_built
def test_other_arguments_are_numbas_business(site: Path) -> None:
    """A layout, a type or a number of axes that the kernel was not compiled for; and what may be read both ways is."""
    program = """
import sys
import numpy as np
from refract_core.kernels.pointer import Pointer
from refract_core.scene import Camera
from refract_core.view.camera import view_of
from refract_core.view.planes import Finish, Planes, finish_tile, new_planes

view = view_of(Camera("/camera", np.eye(4), (-1.0, 1.0, -0.5, 0.5)), 4, 2)
doubled = Finish(2.0, 2.0, 1.0, np.eye(4), np.eye(3))

def finished(dtype, tile):
    planes = Planes(*(plane.astype(dtype) for plane in new_planes(4, 2)))
    planes.beauty[:] = 1.0
    finish_tile(Pointer(planes), Pointer(view), Pointer(doubled), tile)
    return planes.beauty.sum()

assert finished(np.float32, (1, 0, 4, 2)) == 6 * 4 * 2.0 + 2 * 4
assert finished(np.float32, (np.int64(1), np.int32(0), 4, 2)) == 56.0
assert "numba" not in sys.modules
assert finished(np.float64, (1, 0, 4, 2)) == 56.0
assert "numba" in sys.modules
"""
    run(program, site)


# --- signatures


def test_every_kernel_says_what_it_takes() -> None:
    kernels = build.kernels()
    assert len(kernels) > 20
    for one in kernels.values():
        signature_of(one.py_func)


class Inner(NamedTuple):
    """A record in a record."""

    flags: Scalars
    number: float


class Outer(NamedTuple):
    """A record."""

    inner: Inner
    plane: F32_2D
    pairs: Annotated[NDArray[np.int64], Column(np.int64, (2,))]
    on: bool


def test_annotations_are_the_layout_of_what_is_handed_over() -> None:
    """What a class declares is what a `Pointer` to one holds."""
    record = Outer(Inner(np.zeros(8), 1.0), np.zeros((2, 3), np.float32), np.zeros((8, 2), np.int64), True)
    inner = Layout("Inner", (("flags", Array("<f8", 1)), ("number", FLOAT)))
    expected = Layout(
        "Outer", (("inner", inner), ("plane", Array("<f4", 2)), ("pairs", Array("<i8", 2)), ("on", BOOL))
    )
    assert kind_of(Outer, "here") == expected
    assert Pointer(record).layout == expected
    assert ahead.from_json(json.loads(json.dumps(ahead.to_json(expected)))) == expected
    row = Row((INT, FLOAT, BOOL))
    assert kind_of(tuple[int, float, bool], "here") == row
    assert ahead.from_json(json.loads(json.dumps(ahead.to_json(row)))) == row


class Vague(NamedTuple):
    """A record with an array of who knows how many axes."""

    plane: NDArray[np.float32]


@pytest.mark.parametrize("hint", [NDArray[np.float32], Any, str, tuple[int, ...], list[int], None, Vague])
def test_a_vague_annotation_is_refused(hint: Any) -> None:
    with pytest.raises(TypeError, match=r"^(here|Vague\.plane) is annotated with .*; a kernel's arrays say their axes"):
        kind_of(hint, "here")


def test_a_kernel_without_annotations_is_refused() -> None:
    def one(x):  # type: ignore[no-untyped-def]
        return x

    def two(x: int):  # type: ignore[no-untyped-def]
        return x

    with pytest.raises(TypeError, match=r"one\(x\) is annotated with None"):
        signature_of(one)
    with pytest.raises(TypeError, match="two does not say what it returns"):
        signature_of(two)


# --- outside a checkout


def test_a_wheel_brings_its_samples_and_can_draw_them(site: Path, tmp_path: Path) -> None:
    """The first two commands of the README, in an empty folder, without a checkout."""
    program = f"""
import os, sys
import refract_core as rc
os.chdir({str(tmp_path)!r})
assert rc.sample("marble").startswith({str(site)!r})
from refract_core.cli import app
app(["samples", "marble", "--to", "."], standalone_mode=False)
app(["render", "marble.usda", "marble.png", "-w", "32", "--samples", "1"], standalone_mode=False)
app(["schema", "--path"], standalone_mode=False)
"""
    said = run(program, site).split()
    assert said == ["marble.usda", str(site / "refract_core" / "schemas")]
    assert (tmp_path / "marble.png").read_bytes().startswith(b"\x89PNG")


# --- where nothing can be built


def test_without_a_compiler_the_reason_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda _name: None)
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(build.CannotBuild, match="no C compiler"):
        build.compiler()
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(build.CannotBuild, match="linux on aarch64"):
        build.compiler()


@pytest.mark.parametrize(("version", "path"), [("editable", None), ("standard", "/nowhere")])
def test_the_wheel_is_plain_where_nothing_can_be_built(
    version: str, path: str | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An editable install has sources that will change; a machine without a compiler says that it has none."""
    monkeypatch.syspath_prepend(str(ROOT))
    from hatchling.bridge.app import Application

    import hatch_build

    if path:
        monkeypatch.setenv("PATH", path)
        monkeypatch.delenv("CC", raising=False)
    data: dict[str, Any] = {"force_include": {}}
    hook = hatch_build.CustomBuildHook(str(ROOT), {}, None, None, "", "wheel", Application())  # type: ignore[arg-type]
    hook.initialize(version, data)
    hook.finalize(version, data, "")
    assert data == {"force_include": {}}
    said = "".join(capsys.readouterr())
    assert ("no C compiler" in said and "compiling kernels" in said) is bool(path)


def test_the_wheels_name_tells_the_oldest_libc() -> None:
    sys.path.insert(0, str(ROOT))
    try:
        from hatch_build import platform_tag
    finally:
        sys.path.remove(str(ROOT))
    assert platform_tag(b"..\0GLIBC_2.2.5\0..GLIBC_2.29\0GLIBC_2.4") == "manylinux_2_29_x86_64"
    assert platform_tag(b"nothing") == "linux_x86_64"


# --- compiling beforehand


@pytest.mark.slow
def test_warm_compiles_what_a_render_needs(tmp_path: Path) -> None:
    """All of it: what the annotations say is what the kernels are called with."""
    where = {"REFRACT_KERNELS": "jit"}
    warm = "from refract_core.cli import app\napp(['warm'], standalone_mode=False)"
    count = len(build.kernels())
    said = re.search(r"(\d+) kernels compiled, (\d+) had been before; they are in (.+) \(", run(warm, ROOT, **where))
    assert said is not None
    assert int(said[1]) + int(said[2]) == count
    assert said[3] == str(store.folder())
    assert f"0 kernels compiled, {count} had been before" in run(warm, ROOT, **where)
    forbid = """
from numba.core.dispatcher import _FunctionCompiler
def compile(self, *arguments):
    raise AssertionError(self.py_func.__name__)
_FunctionCompiler._compile_cached = compile
"""
    names = ("marble", "two_probes", "planar_table", "thickness_map")
    run(forbid + rendering(tmp_path / "planes.npz", names, ("screen", "probe", "sky")), ROOT, **where)
