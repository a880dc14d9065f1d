"""What every test stands on: the schemas are known to USD before the first stage is made."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import schemas

schemas.register()
# What Hypothesis thinks slow says more about the machine than about the code.
settings.register_profile("unhurried", parent=settings(), deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("unhurried")

_ASSETS = Path(__file__).parents[2] / "shared" / "assets"


@pytest.fixture(scope="session")
def assets() -> Path:
    """Folder of real stages; tests that need it are skipped where it is absent."""
    if not _ASSETS.is_dir():
        pytest.skip("the folder of real stages is not here")
    return _ASSETS
