"""The verbs around a render: `samples`, `schema`, `doctor`."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from test_cli import refract

import refract_core as rc
from refract_core.errors import EmbreeError
from refract_core.usd.layers.assets import files_of
from refract_core.verbs import doctor, samples, schema

ROOT = Path(__file__).parents[1]
GOOD = ROOT / "usd_samples" / "good"


# --- samples


def test_every_sample_is_listed_with_its_own_words() -> None:
    stages = sorted(path.stem for path in GOOD.glob("*.usda"))
    told = json.loads(refract("samples", "--json").out)
    assert [one["name"] for one in told] == stages
    assert all(Path(one["path"]) == GOOD / f"{one['name']}.usda" for one in told)
    assert all(f'doc = """{one["text"]}"""' in Path(one["path"]).read_text("utf-8") for one in told)
    listed = refract("samples").out
    assert [line.split()[0] for line in listed.splitlines() if line[:1].isalpha()][: len(stages)] == stages


def test_a_name_is_a_path() -> None:
    assert rc.sample("marble") == str(GOOD / "marble.usda")
    assert refract("samples", "marble", "traced").out.split() == [str(GOOD / "marble.usda"), str(GOOD / "traced.usda")]


def test_an_unknown_name_gets_the_nearest() -> None:
    with pytest.raises(rc.UsageError, match=r"^marbel: there is no such sample; did you mean marble\?$"):
        rc.sample("marbel")
    ended = refract("samples", "xyz")
    assert ended.code == 2
    assert ended.err.startswith("error: xyz: there is no such sample; choose from absorption, ")


@pytest.mark.parametrize("name", samples.names())
def test_a_copy_is_whole(name: str, tmp_path: Path) -> None:
    """It refers to nothing outside, and to all that the sample refers to, byte for byte."""
    ended = refract("samples", name, "--to", tmp_path / "new" / "folder")
    copied = tmp_path / "new" / "folder" / f"{name}.usda"
    assert (ended.code, ended.out.split()) == (0, [str(copied)])
    theirs = {os.path.relpath(file, GOOD): Path(file).read_bytes() for file in files_of(str(GOOD / f"{name}.usda"))}
    ours = {os.path.relpath(file, copied.parent): Path(file).read_bytes() for file in files_of(str(copied))}
    assert ours == theirs
    assert len(ours) > 0


def test_all_are_copied_where_none_is_named(tmp_path: Path) -> None:
    assert len(refract("samples", "--to", tmp_path).out.split()) == len(samples.names())
    assert sorted(path.stem for path in tmp_path.glob("*.usda")) == samples.names()


def test_what_is_there_and_differs_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "textures").mkdir()
    mine = tmp_path / "textures" / "wood.png"
    mine.write_text("mine")
    ended = refract("samples", "marble", "--to", tmp_path)
    assert ended.code == 2
    assert f"{mine}: exists already, and differs" in ended.err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["textures", "wood.png"]
    assert mine.read_text() == "mine"
    for words in (["--overwrite"], []):  # the second time everything is the same
        assert refract("samples", "marble", "--to", tmp_path, *words).code == 0
    assert mine.read_bytes() == (GOOD / "textures" / "wood.png").read_bytes()


@pytest.mark.parametrize(
    ("words", "message"), [(["--overwrite"], "--overwrite: is for --to"), (["--to", "file"], "--to file: is a file")]
)
def test_a_copy_that_cannot_be_is_refused(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    ended = refract("samples", "marble", *words)
    assert ended.code == 2
    assert message in ended.err


def test_without_samples_the_package_is_to_be_installed_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "FOLDER", tmp_path)
    with pytest.raises(rc.StageError, match="install the package anew"):
        rc.sample("marble")


# --- schema


def test_the_environment_line_makes_another_usd_know_the_schemas() -> None:
    """A program without our Python, started by a shell that has read the line; what was in the variable stays."""
    line = refract("schema", "--install").out
    find = "Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('RefractMaterialAPI')"
    known = f"from pxr import Usd; print({find} is not None)"
    script = f"{line}\n{shlex.quote(sys.executable)} -c {shlex.quote(known)}; echo $PXR_PLUGINPATH_NAME"
    for before in ("", "/other/plugins"):
        variables = {**os.environ, "PXR_PLUGINPATH_NAME": before}
        done = subprocess.run(["sh", "-c", script], env=variables, capture_output=True, text=True, check=True, cwd="/")
        found, path = done.stdout.splitlines()
        assert found == "True"
        assert path == ":".join(filter(None, [str(ROOT / "schemas"), before]))


def test_the_other_ways_name_the_same_folder() -> None:
    folder = refract("schema", "--path").out.strip()
    assert (Path(folder) / "plugInfo.json").is_file()
    (entry,) = json.loads(schema.houdini_package())["env"]
    assert entry == {"PXR_PLUGINPATH_NAME": {"method": "append", "value": folder}}
    said = refract("schema").out
    for text in (schema.export_line(), schema.houdini_package(), schema.registering_line(), "RefractMaterialAPI"):
        assert text in said
    compile(schema.registering_line(), "line", "exec")


def test_path_and_install_exclude_each_other() -> None:
    assert refract("schema", "--path", "--install").code == 2


# --- doctor

CPUINFO = """processor\t: 0
model name\t: A   Processor @ 3.00GHz
flags\t\t: fpu sse4_2 avx avx2 fma bmi1 bmi2

processor\t: 1
flags\t\t: fpu
"""


def test_the_processor_is_read_as_linux_tells_it() -> None:
    name, flags = doctor.processor_of(CPUINFO)
    assert name == "A Processor @ 3.00GHz"
    assert flags == {"fpu", "sse4_2", "avx", "avx2", "fma", "bmi1", "bmi2"}
    assert doctor.processor_of("") == ("", frozenset())


def test_a_processor_without_avx2_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_text", lambda _path: CPUINFO.replace(" avx2", ""))
    check = doctor._processor()
    assert check.state == doctor.WARNING
    assert "without avx2" in check.text


@pytest.mark.draws
def test_the_doctor_looks_at_everything_and_draws() -> None:
    ended = refract("doctor", "--json")
    checks = {one["name"]: one for one in json.loads(ended.out)}
    assert ended.code == 0
    assert [*checks] == [
        "system", "processor", "memory", "packages", "extras", "embree",
        "schemas", "lock", "cache", "kernels", "picture",
    ]  # fmt: skip
    assert {one["state"] for one in checks.values()} <= {"ok", "warning"}
    assert rc.__version__ in checks["system"]["text"]
    assert "the sample marble, 160x90" in checks["picture"]["text"]


def test_what_fails_is_a_row_and_the_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> None:
        raise EmbreeError("embreex, which brings Embree, is not installed; pip install embreex")

    monkeypatch.setattr("refract_core.world.embree.library", nowhere)
    monkeypatch.setattr(doctor, "_picture", lambda *_: doctor.Check("picture", doctor.OK, "is drawn"))
    ended = refract("doctor")
    assert ended.code == 1
    assert "failed   embree     embreex, which brings Embree, is not installed" in ended.out
    assert ended.out.splitlines()[-1].endswith("1 failed")


def test_a_picture_without_glass_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    import numpy as np

    from refract_core.progress import reporting

    planes = {"beauty": np.ones((2, 3, 4), np.float32), "mask": np.zeros((2, 3), np.float32)}
    monkeypatch.setattr("refract_core.rendering.picture.render", lambda *_args, **_how: rc.Frame(3, 2, planes))
    with reporting("none") as report:
        check = doctor._picture(report, lambda: False)
    assert check.state == doctor.FAILED
    assert "it shows no glass" in check.text


def test_what_is_not_enforced_is_a_warning() -> None:
    pairs = doctor.locks({"landlock": 4, "seccomp": False}, {"seccomp": "no seccomp: it may use the network"})
    assert pairs == [("landlock 4", ""), ("seccomp", "no seccomp: it may use the network")]
    check = doctor._confined(pairs)
    assert check.state == doctor.WARNING
    assert check.text.endswith("with landlock 4; no seccomp: it may use the network")


def test_a_cache_that_cannot_be_written_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REFRACT_CACHE_DIR", "/proc/refract")
    check = doctor._cache()
    assert check.state == doctor.WARNING
    assert "REFRACT_CACHE_DIR" in check.text
