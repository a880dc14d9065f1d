"""What a program that uses refract may expect of it: none of its own names taken, nothing changed that it did not ask
for, and the same answers whatever it did with USD before."""

from __future__ import annotations

import dataclasses
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import refract_core as rc
from refract_core.usd.rules.stage import stage_findings
from refract_core.usd.stage import open_stage
from refract_core.verbs.validate import ValidateOrder, validate
from schemas.generate import GENERATED

ROOT = Path(__file__).parents[1]
GOOD, BAD = ROOT / "usd_samples" / "good", ROOT / "usd_samples" / "bad"


def run(code: str, folder: Path, path: Path = ROOT) -> str:
    """What `code` prints in a fresh process in `folder`, to which `path` gives our packages."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PXR_"))}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=folder, env=kept | {"PYTHONPATH": str(path)},
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


# ---- names

LOAD = f"""
import refract_core as rc
scene = rc.load_stage({str(GOOD / "marble.usda")!r})
print(rc.__file__, *sorted({{material.model.name for material in scene.materials}}))
"""
SERVE = """
import sys
from refract_core.cli import main
import refract_core.service.app, refract_core.service.worker
sys.argv = ["refract", "serve", "--limits"]
main()
"""
OWN = "raise AssertionError('the user has imported nothing')"


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A user's folder, first on sys.path, with modules and packages that are called as ours are."""
    (tmp_path / "schemas.py").write_text(OWN)
    (tmp_path / "service.py").write_text(OWN)
    for name in ("tests", "benchmarks", "usd"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(OWN)
    return tmp_path


def test_a_checkout_works_beside_a_users_own_schemas_and_service(own: Path) -> None:
    file, *models = run(LOAD, own).split()
    assert Path(file).parents[1] == ROOT
    assert models == ["NONE", "SPHERE"]
    assert "job_seconds" in run(SERVE, own)


def test_a_wheel_works_beside_a_users_own_schemas_and_service(own: Path, site: Path) -> None:
    file, *models = run(LOAD, own, site).split()
    assert Path(file).parents[1] == site
    assert models == ["NONE", "SPHERE"]
    assert "job_seconds" in run(SERVE, own, site)


def test_a_wheel_has_one_import_name_and_says_that_it_is_typed(site: Path) -> None:
    assert [folder.name for folder in site.iterdir() if folder.suffix != ".dist-info"] == ["refract_core"]
    assert {path.name for path in (site / "refract_core" / "schemas").iterdir()} >= {"schema.usda", *GENERATED}
    assert (site / "refract_core" / "service" / "static" / "index.html").is_file()
    assert (site / "refract_core" / "py.typed").is_file()


def test_a_wheel_and_the_package_in_it_tell_one_version(site: Path) -> None:
    (metadata,) = site.glob("*.dist-info/METADATA")
    assert f"\nVersion: {rc.__version__}\n" in metadata.read_text("utf-8")


def test_the_digest_of_the_engine_is_that_of_its_sources_wherever_they_lie(tmp_path: Path, site: Path) -> None:
    code = "from refract_core.service.digests import engine; print(engine())"
    assert run(code, tmp_path) == run(code, tmp_path, site)


# ---- import refract_core, and USD knows

APPLY = """
from pxr import Usd
stage = Usd.Stage.CreateInMemory()
prim = stage.DefinePrim("/Glass", "Material")
prim.ApplyAPI("RefractMaterialAPI")
print(prim.GetAttribute("inputs:refraction:ior").Get())
"""


@pytest.mark.parametrize("before", ["", "from pxr import Tf", "from pxr import Usd, UsdGeom", "import pxr.Plug"])
def test_importing_the_package_before_the_first_stage_is_enough(tmp_path: Path, before: str) -> None:
    assert run(f"{before}\nimport refract_core\n{APPLY}", tmp_path) == "1.5\n"


def test_importing_the_package_changes_neither_the_environment_nor_what_is_loaded(tmp_path: Path) -> None:
    code = """
import os, sys
environment = dict(os.environ)
import refract_core
assert not any(name.partition(".")[0] in ("pxr", "numpy", "numba", "schemas", "service") for name in sys.modules)
assert dict(os.environ) == environment
import importlib
importlib.reload(refract_core)
print(sum(type(finder).__module__.startswith("refract_core") for finder in sys.meta_path))
from pxr import Usd
print(sum(type(finder).__module__.startswith("refract_core") for finder in sys.meta_path))
"""
    assert run(code, tmp_path).splitlines() == ["1", "0"]


# ---- after another stage

ROOM = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "Room" (prepend apiSchemas = ["CollectionAPI:lamps"])
{
    rel collection:lamps:includes = </Room/Lamp>
    def Sphere "Lamp" {}
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </Looks/Plain>
        double3 xformOp:translate = (3, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
def Scope "Looks"
{
    def Material "Plain" (prepend apiSchemas = ["RefractMaterialAPI"]) {}
    def Material "Said" (prepend apiSchemas = ["RefractMaterialAPI"])
    {
        uniform token refraction:model = "box"
        float inputs:refraction:thickness = 0.25
        uniform int refraction:priority = 3
    }
}
def RefractProbe "Plain"
{
    double3 xformOp:translate = (1, 2, 3)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    float probe:weight = None
    def Sphere "Within" (prepend apiSchemas = ["MaterialBindingAPI"]) { rel material:binding = </Looks/Said> }
}
def RefractPlanarProbe "Window"
{
    float probe:weight.timeSamples = { 0: 0.25, 1: 0.75 }
    rel collection:captured:excludes = </Room/Lamp>
}
def Xform "Applied" (prepend apiSchemas = ["RefractProbeAPI"])
{
    uniform bool collection:captured:includeRoot = 0
    rel collection:captured:includes = [</Room.collection:lamps>, </Nothing>]
    uniform token probe:proxy = "volume"
    float2 probe:clippingRange = (3, 1)
}
def Scope "Nowhere" (prepend apiSchemas = ["RefractProbeAPI"]) {}
def Xform "Model" { def RefractProbe "Inner" { rel collection:captured:excludes = </Room> } }
def Xform "Copy" (
    instanceable = true
    references = </Model>
) {}
def Xform "Nested" {
    def Xform "Within" (
        instanceable = true
        references = </Model>
    ) {}
}
def Xform "Deep" (
    instanceable = true
    references = </Nested>
) {}
"""


def plain(value: Any) -> Any:
    """Records and arrays as tuples that can be compared."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if dataclasses.is_dataclass(value):
        return type(value).__name__, [(f.name, plain(getattr(value, f.name))) for f in dataclasses.fields(value)]
    return [plain(item) for item in value] if isinstance(value, list | tuple) else repr(value)


LATE = """
import pickle, sys
from pxr import Usd
Usd.Stage.CreateInMemory().DefinePrim("/A", "Xform")  # USD reads its table of schemas
import refract_core as rc
from refract_core.usd.ours import known
from refract_core.usd.rules.stage import stage_findings
from refract_core.usd.stage import open_stage
assert not known()
told = {{}}
for path in {paths!r}:
    try:
        told[path] = rc.load_stage(path), stage_findings(open_stage(path))
    except rc.StageError as error:
        told[path] = str(error)
with open({out!r}, "wb") as file:
    pickle.dump(told, file)
"""


def test_a_stage_reads_the_same_after_other_stages_were_made(tmp_path: Path) -> None:
    """Here USD knows the schemas; in the other process it had read its table before it could be told of them."""
    room = tmp_path / "room.usda"
    room.write_text(ROOM.replace("{ ", "{\n").replace(" }", "\n}"))
    paths = [str(path) for path in (room, *sorted(GOOD.glob("*.usda")), *sorted(BAD.glob("*.usda")))]
    run(LATE.format(paths=paths, out=str(tmp_path / "told")), tmp_path)
    late = pickle.loads((tmp_path / "told").read_bytes())
    for path in paths:
        try:
            expected: Any = rc.load_stage(path), stage_findings(open_stage(path))
        except rc.StageError as error:
            expected = str(error)
        assert plain(late[path]) == plain(expected), path
    scene = rc.load_stage(room)
    assert [probe.path for probe in scene.probes] == [
        "/Plain", "/Window", "/Applied", "/Model/Inner", "/Copy/Inner", "/Nested/Within/Inner", "/Deep/Within/Inner",
    ]  # fmt: skip


def test_repairs_are_the_same_after_other_stages_were_made(tmp_path: Path) -> None:
    """A stage with our types is told what other programs take them for, whether USD knows them or not."""
    (tmp_path / "a.usda").write_text('#usda 1.0\ndef RefractProbe "P" { float probe:weight = 5\n}\n')
    code = """
from pxr import Usd
Usd.Stage.CreateInMemory().DefinePrim("/A", "Xform")
from refract_core.verbs.validate import ValidateOrder, validate
print([finding.rule for finding in validate(ValidateOrder(stage="a.usda", fix="late.usda")).fixed])
"""
    said = run(code, tmp_path)
    made = validate(ValidateOrder(stage=str(tmp_path / "a.usda"), fix=str(tmp_path / "known.usda")))
    assert said.strip() == repr([finding.rule for finding in made.fixed])
    assert len(made.fixed) == 2
    assert (tmp_path / "late.usda").read_text() == (tmp_path / "known.usda").read_text()
