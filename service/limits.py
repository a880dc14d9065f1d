"""Every limit of the service in one table: name, default, unit and meaning.

Each can be set by a flag of `refract serve` (`--limit NAME=NUMBER`), or by the environment
(`REFRACT_LIMIT_NAME`). A request may ask for less, never for more. `GET /v1/limits` shows what holds.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from refract_core.errors import UsageError

PREFIX = "REFRACT_LIMIT_"


def _limit(default: int, unit: str, meaning: str) -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True, kw_only=True)
class Limits:
    """All of them are whole numbers above 0."""

    body_bytes: int = _limit(64 << 20, "bytes", "body of one request")
    body_seconds: int = _limit(30, "s", "time for a request's body to arrive")
    bodies: int = _limit(32, "bodies", "bodies of requests that arrive at once")
    header_seconds: int = _limit(10, "s", "time for a request's head to arrive")
    connections: int = _limit(1000, "connections", "open at once; fewer where the process may open too few files")
    settings_bytes: int = _limit(256 << 10, "bytes", "settings of one request, as JSON")
    stage_bytes: int = _limit(64 << 20, "bytes", "one uploaded stage, and what its package holds when unpacked")
    upload_files: int = _limit(1000, "files", "files of one upload")
    upload_ratio: int = _limit(200, "times", "bytes of an unpacked archive to its own")
    layers: int = _limit(256, "files", "layers that one stage is composed of")
    prims: int = _limit(200_000, "prims", "prims of a stage, instances counted, told before it is composed")
    pixels: int = _limit(1 << 22, "pixels", "width times height of a picture")
    samples: int = _limit(64, "per pixel", "samples of a pixel")
    side: int = _limit(16384, "pixels", "width, and height, of a picture")
    pixel_samples: int = _limit(1 << 27, "samples", "width times height times samples")
    pictures: int = _limit(64, "pictures", "pictures of one job, sizes times time codes")
    aovs: int = _limit(16, "planes", "AOVs of one request")
    triangles: int = _limit(20_000_000, "triangles", "triangles of a stage, instances counted")
    texture_pixels: int = _limit(1 << 26, "pixels", "one texture")
    queue_seconds: int = _limit(600, "s", "time a job may wait for a worker")
    job_seconds: int = _limit(120, "s", "wall clock of one job, without its time in the queue")
    cpu_seconds: int = _limit(300, "s", "processor time of one job, all threads together")
    stage_seconds: int = _limit(30, "s", "processor time to check, open and read a stage, before the work begins")
    memory_bytes: int = _limit(4 << 30, "bytes", "address space of one job beyond that of an idle worker")
    result_bytes: int = _limit(256 << 20, "bytes", "one file written by a job")
    folder_bytes: int = _limit(1 << 30, "bytes", "all files of a job at once, results and scratch")
    folder_files: int = _limit(1000, "files", "files and folders of a job at once")
    open_files: int = _limit(256, "files", "files open at once in a job")
    warnings: int = _limit(200, "entries", "warnings kept of one job")
    live_workers: int = _limit(2, "viewers", "live viewers at once, beside the workers; each client has one")
    live_pixels: int = _limit(1 << 17, "pixels", "width times height of a live picture")
    live_frame_seconds: int = _limit(20, "s", "wall clock of one live picture; reading the stage is in the first")
    live_idle_seconds: int = _limit(30, "s", "after which a live viewer that nobody asks ends")
    live_seconds: int = _limit(1800, "s", "wall clock of a live viewer from its start to its end")
    live_cpu_seconds: int = _limit(600, "s", "processor time of a live viewer, all pictures and threads together")
    event_streams: int = _limit(100, "streams", "clients that listen to events at once")
    share: int = _limit(50, "per cent", "bodies, waiting jobs and event streams that one client may have; 100 is all")
    webhooks: int = _limit(256, "webhooks", "webhooks still to be sent")
    retention_seconds: int = _limit(24 * 3600, "s", "time a finished job and its results are kept")
    retention_bytes: int = _limit(2 << 30, "bytes", "results kept in all; the oldest go first")
    kept_bytes: int = _limit(1 << 30, "bytes", "stages kept by their digests; those not asked for the longest go first")
    drain_seconds: int = _limit(20, "s", "time running jobs get to finish when the service is asked to stop")

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise UsageError(f"limit {one.name} is {value}; it must be a whole number of 1 or more")


def limits_from(given: Mapping[str, int | None], environment: Mapping[str, str] | None = None) -> Limits:
    """Defaults, then the environment, then what is given.

    Raises:
        UsageError: a value is no number above 0, or a variable names no limit.
    """
    environment = os.environ if environment is None else environment
    names = [one.name for one in fields(Limits)]
    chosen: dict[str, int] = {}
    for variable, text in environment.items():
        if not variable.startswith(PREFIX):
            continue
        name = variable.removeprefix(PREFIX).lower()
        if name not in names:
            raise UsageError(f"{variable}: there is no such limit; choose from {', '.join(names)}")
        try:
            chosen[name] = int(text)
        except ValueError as error:
            raise UsageError(f"{variable} is '{text}'; it must be a whole number of 1 or more") from error
    chosen.update({name: value for name, value in given.items() if value is not None})
    return Limits(**chosen)


def table(limits: Limits) -> list[dict[str, str | int]]:
    """What `/v1/limits` and the documentation show."""
    return [
        {
            "name": one.name, "value": getattr(limits, one.name), "default": int(str(one.default)),
            "unit": one.metadata["unit"], "meaning": one.metadata["meaning"],
            "variable": f"{PREFIX}{one.name.upper()}", "flag": f"--limit {one.name}=",
        }
        for one in fields(limits)
    ]  # fmt: skip
