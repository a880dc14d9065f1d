"""The files for those who run the service say what the service understands, and keep what they promise."""

from __future__ import annotations

import configparser
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from service_server import ROOT
from typer.main import get_command

from refract_core.cli import app
from service.app import Settings
from service.limits import Limits

PLACE = ROOT / "docs" / "operate"
UNIT, COMPOSE, IMAGE = (PLACE / name for name in ("refract.service", "compose.yaml", "Dockerfile"))


def compose() -> Any:
    yaml = pytest.importorskip("yaml")  # Dask brings it
    return yaml.safe_load(COMPOSE.read_text("utf-8"))


def unit() -> configparser.SectionProxy:
    """[Service]; of options that come more than once, the last."""
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(UNIT.read_text("utf-8"))
    return parser["Service"]


def steps() -> list[tuple[str, str]]:
    """Instructions of the Dockerfile, in order."""
    text = re.sub(r"\\\n", " ", re.sub(r"^\s*#.*\n", "", IMAGE.read_text("utf-8"), flags=re.MULTILINE))
    return [(line.partition(" ")[0], line.partition(" ")[2].strip()) for line in text.splitlines() if line.strip()]


def last(name: str) -> str:
    return [rest for one, rest in steps() if one == name][-1]


def command_words() -> dict[str, list[str]]:
    """What each of the two starts."""
    return {"unit": shlex.split(unit()["ExecStart"])[1:], "image": re.findall(r'"([^"]+)"', last("CMD"))[1:]}


@pytest.mark.parametrize("who", ["unit", "image"])
def test_what_is_started_is_a_command_of_ours(who: str) -> None:
    words = command_words()[who]
    serve = get_command(app).commands["serve"]  # type: ignore[attr-defined]
    known = {option for parameter in serve.params for option in parameter.opts}
    assert words[0] == "serve"
    assert {word for word in words if word.startswith("-")} <= known


def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    if not shutil.which("systemd-analyze"):
        pytest.skip("there is no systemd-analyze here")
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text("utf-8").replace("/opt/refract/bin/refract", "/bin/true"))
    done = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, check=False)
    said = [line for line in done.stderr.splitlines() if UNIT.name in line]
    assert (done.returncode, said) == (0, [])


def test_the_unit_leaves_what_workers_need_and_takes_the_rest() -> None:
    service = unit()
    assert int(service["LimitNOFILE"]) > 1024
    for name in ("NoNewPrivileges", "DynamicUser", "PrivateTmp", "PrivateDevices", "ProtectHome", "RestrictSUIDSGID"):
        assert service[name] == "yes", name
    assert service["ProtectSystem"] == "strict"
    assert service["CapabilityBoundingSet"] == ""
    assert "MemoryDenyWriteExecute" not in service  # kernels
    assert service.get("ProcSubset", "all") == "all"  # /proc/meminfo
    calls = service["SystemCallFilter"].split()
    assert {"user", "mnt"} <= set(service["RestrictNamespaces"].split())
    needed = {"landlock_create_ruleset", "landlock_add_rule", "landlock_restrict_self", "seccomp", "@mount", "unshare"}
    assert needed <= set(calls)


def test_stopping_waits_for_what_drains() -> None:
    drain = Limits().drain_seconds
    assert int(unit()["TimeoutStopSec"]) > drain
    assert int(compose()["services"]["refract"]["stop_grace_period"].removesuffix("s")) > drain


def test_there_is_memory_for_every_worker() -> None:
    service = compose()["services"]["refract"]
    gibibytes = Limits().memory_bytes / 2**30
    assert int(service["mem_limit"].removesuffix("g")) > int(service["environment"]["REFRACT_WORKERS"]) * gibibytes + 1
    assert int(unit()["MemoryMax"].removesuffix("G")) > Settings().workers * gibibytes + 1


def test_the_container_is_nobody_and_writes_nothing_but_its_data() -> None:
    service = compose()["services"]["refract"]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert service["user"] == last("USER")
    assert not service["user"].startswith("0")
    data = command_words()["image"]
    (volume,) = service["volumes"]
    assert volume.partition(":")[2] == data[data.index("--data") + 1] == last("VOLUME")
    (port,) = service["ports"]
    assert port.startswith("127.0.0.1:")
    assert port.rpartition(":")[2] == data[data.index("--port") + 1] == last("EXPOSE")


def test_the_image_has_what_it_copies_and_names_nobody() -> None:
    made = [rest for one, rest in steps() if one == "COPY" and not rest.startswith("--from")]
    kept = (PLACE / "Dockerfile.dockerignore").read_text("utf-8").splitlines()
    for source in [word for rest in made for word in rest.split()[:-1]]:
        assert (ROOT / source).exists()
        assert f"!{source}" in kept
    for base in (rest.split()[0] for one, rest in steps() if one == "FROM"):
        assert "/" not in base  # a host, or somebody's collection
    service = compose()["services"]["refract"]
    assert (COMPOSE.parent / service["build"]["context"]).resolve() == ROOT
    assert (ROOT / service["build"]["dockerfile"]).resolve() == IMAGE


def test_kernels_are_made_by_root_and_read_by_nobody_who_may_change_them() -> None:
    names = [one for one, _ in steps()]
    assert "refract warm" in last("RUN")
    assert names.index("USER") > max(k for k, one in enumerate(names) if one == "RUN")
