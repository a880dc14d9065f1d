"""What every test stands on: the schemas are known to USD before the first stage is made."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import schemas

schemas.register()
# Equal pictures are to make equal files, so these do not say how long they took (`Frame.seconds`).
os.environ.setdefault("SOURCE_DATE_EPOCH", "1577836800")
# What Hypothesis thinks slow says more about the machine than about the code.
settings.register_profile("unhurried", parent=settings(), deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("unhurried")

_FOREIGN = {"test_docs", "test_attack", "test_executors", "test_ahead", "test_operate", "test_exits"}
"""Rooms beside those of the service whose slow tests watch other processes: side by side they would be in each other's
way."""


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks for groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is quick; keep what waits for processes to one worker, and what needs a wheel (`--dist loadgroup`)."""
    for item in items:
        room = item.path.stem
        if "site" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.draws)
            item.add_marker(pytest.mark.xdist_group("wheel"))
        elif item.get_closest_marker("slow") and (room in _FOREIGN or room.startswith(("test_service", "test_page"))):
            item.add_marker(pytest.mark.xdist_group("processes"))
        if not (item.get_closest_marker("slow") or item.get_closest_marker("draws")):
            item.add_marker(pytest.mark.quick)


_ROOT = Path(__file__).parents[1]
_ASSETS = Path(__file__).parents[2] / "shared" / "assets"


@pytest.fixture(scope="session")
def assets() -> Path:
    """Folder of real stages; tests that need it are skipped where it is absent."""
    if not _ASSETS.is_dir():
        pytest.skip("the folder of real stages is not here")
    return _ASSETS


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, unpacked as an installer does; its kernels are compiled where that can be done."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    build = "import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(folder)], cwd=_ROOT, check=True, capture_output=True, timeout=900)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"
