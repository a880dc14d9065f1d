"""One probe to bake, as a piece of work that any machine can do."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from ..errors import StageError
from ..probes.digest import probe_digest
from .executors import Bench, file_bytes


class Errand(NamedTuple):
    """What to bake. The same errand over the same stage gives the same bytes, wherever it is done."""

    number: int
    path: str
    time_code: float
    digest: str
    """`probe_digest` in the process that gives the order"""
    resolution: int
    """[texels]"""
    samples: int
    jobs: int
    layout: str
    notes: Mapping[str, str | float]
    """attributes of the file"""


def bake_one(bench: Bench, errand: Errand) -> tuple[bytes, float]:
    """Bake a probe on a worker.

    Returns:
        The texture's file, and the seconds it took.
    """
    from ..images.cubemaps import write_cubemap
    from ..rendering.session import capture_probes

    started = time.perf_counter()
    scene = bench.read(time_code=errand.time_code)
    found = [probe for probe in scene.probes if probe.path == errand.path]
    probe = replace(found[0], resolution=errand.resolution) if found else None
    if probe is None or probe_digest(scene, probe) != errand.digest:
        raise StageError(f"{errand.path}: a worker reads the stage differently; is the same usd-core installed there?")
    (cubemap,) = capture_probes(scene, [probe], samples=errand.samples, jobs=errand.jobs, cancel=bench.cancel)
    data = file_bytes(lambda path: write_cubemap(path, cubemap, errand.layout, errand.notes), "probe.exr")
    return data, time.perf_counter() - started
