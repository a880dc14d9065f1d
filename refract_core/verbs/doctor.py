"""Whether this machine and this installation can draw: what a person looks at first, or sends with a report."""

from __future__ import annotations

import json
import os
import platform
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from ..errors import Cancelled, RefractError
from ..progress import Report
from ..version import __version__
from .orders import peak_memory, size_text, stop_if

OK, WARNING, FAILED = "ok", "warning", "failed"

NEEDED = ("usd-core", "embreex", "numba", "numpy", "openimageio", "mapbox_earcut", "typer", "fastapi", "uvicorn")
EXTRAS = {
    "gltf": "pygltflib", "mtlx": "materialx", "unwrap": "xatlas", "denoise": "pyoidn", "dask": "distributed",
    "bench": "flip-evaluator",
}  # fmt: skip
_FLAGS = ("sse4_2", "avx", "avx2", "fma", "bmi1", "bmi2", "avx512f")
_BUILT_FOR = ("avx2", "fma", "bmi1", "bmi2")
"""What kernels that come with the package are compiled for (`kernels.build`)."""
_WIDTH = 160  # [pixels] of the picture that is drawn


class Check(NamedTuple):
    """One thing that was looked at."""

    name: str
    state: str
    """`ok`, `warning` for what works less well than it could, `failed` for what keeps refract from drawing."""
    text: str


def examine(confinement: Sequence[tuple[str, str]], report: Report, cancel: Callable[[], bool]) -> list[Check]:
    """Look at everything, and draw a small picture.

    Args:
        confinement: what the service locks its workers in with, as pairs of a name and what it means that it is not
            there, '' where it is.

    Raises:
        Cancelled: `cancel` said so.
    """
    looks: list[Callable[[], Check]] = [
        _system, _processor, _memory, _packages, _extras, _embree, _schemas, lambda: _confined(confinement), _cache,
        _kernels, lambda: _picture(report, cancel),
    ]  # fmt: skip
    found = []
    for done, look in enumerate(looks):
        stop_if(cancel)
        report.progress(done / len(looks), "looking")
        try:
            found.append(look())
        except Cancelled:
            raise
        except RefractError as error:
            found.append(Check(look.__name__.strip("_<>"), FAILED, str(error)))
    return found


def to_text(checks: Sequence[Check]) -> str:
    """A line for each, and one about all."""
    column = max(len(check.name) for check in checks) + 2
    lines = [f"{check.state:9}{check.name:{column}}{check.text}" for check in checks]
    counts = {state: sum(check.state == state for check in checks) for state in (WARNING, FAILED)}
    told = [f"{count} {state}{'s' * (state == WARNING and count > 1)}" for state, count in counts.items() if count]
    return "\n".join([*lines, ", ".join(told) or "all is well"])


def to_json(checks: Sequence[Check]) -> str:
    """An array of name, state and text."""
    return json.dumps([check._asdict() for check in checks], indent=2)


# --- the machine


def _system() -> Check:
    fits = sys.platform == "linux" and platform.machine() == "x86_64"
    python, system = platform.python_version(), platform.platform(terse=True)
    text = f"refract {__version__}, Python {python}, {system} {platform.machine()}"
    return Check("system", OK if fits else WARNING, text if fits else f"{text}; it is tested on Linux x86-64 alone")


def _processor() -> Check:
    model, flags = processor_of(_text("/proc/cpuinfo"))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    known = [flag for flag in _FLAGS if flag in flags]
    told = " ".join(known) or "its flags are not known"
    text = f"{model or platform.machine()}, {cores} cores, {told}; no GPU is needed"
    lacking = [flag for flag in _BUILT_FOR if flags and flag not in flags]
    if lacking:
        text += f"; without {' and '.join(lacking)} the kernels of the package do not run, and numba compiles them here"
    return Check("processor", WARNING if lacking else OK, text)


def processor_of(cpuinfo: str) -> tuple[str, frozenset[str]]:
    """Name and flags of the first processor in a text as /proc/cpuinfo has it; '' and none where they are not told."""
    name = re.search(r"^model name\s*:\s*(.*)$", cpuinfo, re.MULTILINE)
    flags = re.search(r"^flags\s*:\s*(.*)$", cpuinfo, re.MULTILINE)
    return " ".join(name[1].split()) if name else "", frozenset(flags[1].split() if flags else ())


_SCARCE = 1 << 30  # [bytes]


def _memory() -> Check:
    rows = re.findall(r"^(\w+):\s*(\d+) kB", _text("/proc/meminfo"), re.MULTILINE)
    sizes = {name: int(kilo) * 1024 for name, kilo in rows}
    if "MemTotal" not in sizes:
        return Check("memory", OK, "its size is not known here")
    free = sizes.get("MemAvailable", sizes["MemTotal"])
    text = f"{sizes['MemTotal'] / 1e9:.1f} GB, {free / 1e9:.1f} GB of them free"
    if free < _SCARCE:
        return Check("memory", WARNING, f"{text}; a picture takes about half a GB and more: end something else first")
    return Check("memory", OK, text)


def _text(path: str) -> str:
    try:
        return Path(path).read_text("utf-8", "replace")
    except OSError:
        return ""


# --- the installation


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _packages() -> Check:
    versions = {name: _version(name) for name in NEEDED}
    missing = [name for name, version in versions.items() if not version]
    if missing:
        return Check("packages", FAILED, f"{', '.join(missing)} not installed; pip install {' '.join(missing)}")
    return Check("packages", OK, ", ".join(f"{name} {version}" for name, version in versions.items()))


def _extras() -> Check:
    there = [f"{extra} ({name} {version})" for extra, name in EXTRAS.items() if (version := _version(name))]
    others = [extra for extra, name in EXTRAS.items() if not _version(name)]
    text = ", ".join(there) or "none"
    return Check("extras", OK, text + (f"; not installed: {', '.join(others)}" if others else ""))


def _embree() -> Check:
    from ..world import embree

    try:
        embree.library()
    except (RefractError, OSError) as error:
        return Check("embree", FAILED, str(error))
    return Check("embree", OK, f"its library is that of embreex {_version('embreex')}")


def _schemas() -> Check:
    from ..schemas import APPLIED, FOLDER, TYPED, register

    try:
        register()
    except RuntimeError as error:
        return Check("schemas", FAILED, str(error))
    return Check("schemas", OK, f"USD knows {', '.join((*APPLIED, *TYPED))}, from {FOLDER}")


def _confined(confinement: Sequence[tuple[str, str]]) -> Check:
    lacking = [text for _, text in confinement if text]
    there = ", ".join(name for name, text in confinement if not text) or "nothing"
    text = f"the service locks its workers in with {there}"
    return Check("lock", WARNING if lacking else OK, "; ".join([text, *lacking]))


# --- kernels


_LARGE = 1 << 30  # [bytes]


def _cache() -> Check:
    from ..kernels import store

    root = store.cache_root()
    sizes = [path.stat().st_size for path in root.rglob("*") if path.is_file()]
    text = f"{root}: {len(sizes)} files, {size_text(sum(sizes))}" if sizes else f"{root}: empty"
    text += "; what is old in it may be removed" if sum(sizes) > _LARGE else ""
    above = next((place for place in (root, *root.parents) if place.exists()), root)
    try:
        with tempfile.TemporaryFile(dir=above):
            pass
    except OSError as error:
        why = f"{text}; it cannot be written ({error.strerror}), so every process compiles what the package has not got"
        return Check("cache", WARNING, f"{why}: name another folder with REFRACT_CACHE_DIR")
    return Check("cache", OK, text)


def _kernels() -> Check:
    from ..kernels import ahead, build, store

    kernels = build.kernels()
    left = [one for one in kernels.values() if one.native is None]
    built = len(kernels) - len(left)
    why = ahead.state()[1]
    if not left:
        return Check("kernels", OK, f"all {built} came compiled with the package; numba is not loaded")
    kept = sum(store.is_kept(one.py_func) for one in left)
    text = f"{built} came compiled with the package ({why}), " if why else ""
    text += f"{kept} of {len(left)} were compiled by numba before and are kept"
    if kept < len(left):
        return Check("kernels", WARNING, f"{text}; the others are compiled when first called: run refract warm")
    return Check("kernels", OK, text)


# --- a picture


def _picture(report: Report, cancel: Callable[[], bool]) -> Check:
    import numpy as np

    from ..rendering.picture import render
    from ..settings import RenderSettings
    from ..usd.stage import load_stage
    from .samples import sample

    settings = RenderSettings(image_width=_WIDTH, samples=1)
    started = time.perf_counter()
    frame = render(load_stage(sample("marble")), settings, progress=report.progress, cancel=cancel)
    seconds = time.perf_counter() - started
    what = f"the sample marble, {frame.width}x{frame.height}, 1 sample"
    beauty = frame.planes["beauty"]
    faults = {
        "it has numbers that are none": not np.isfinite(beauty).all(),
        "it is black": not beauty[..., :3].max() > 0.0,
        "it shows no glass": not (frame.planes["mask"] > 0.0).any(),
    }
    for fault, found in faults.items():
        if found:
            return Check("picture", FAILED, f"{what}: {fault}; send this output with a report")
    return Check("picture", OK, f"{what}: {seconds:.1f} s, {peak_memory() / 1e6:.0f} MB")


# --- what the service says


def locks(available: Mapping[str, object], missing: Mapping[str, str]) -> list[tuple[str, str]]:
    """What `examine` wants to know of confinement, with the version of what has one."""
    return [
        (f"{name} {value}" if isinstance(value, int) and not isinstance(value, bool) else name, missing.get(name, ""))
        for name, value in available.items()
    ]
