"""Noise taken out of a picture by Intel's Open Image Denoise, through its C API.

The library is the one inside the `pyoidn` wheel, an extra; pyoidn itself is never imported (it loads PyTorch where that
is installed). It runs on the processor alone, so that a picture does not depend on what else a machine has, and gives
the same bits whatever the number of its threads. Source: Open Image Denoise 2.5 documentation (openimagedenoise.org).
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, reduce
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ImageError, UsageError
from ..scene import F32

EXTRA = "needs the extra `denoise`: pip install 'usd-refract[denoise]'"
_RIM = 32
"""Pixels that are mirrored beyond the picture's edges. The network takes what is outside for black, which shows in a
rim of about so many."""
_REACH = 2
"""Pixels to each side that are looked at."""
_STEP = 0.1
"""Difference of albedo, and half that of normals, that a surface may have and be even."""
_DARK = 1e-6
_WHITE = 0.999
_CPU, _FLOAT3 = 1, 3  # OIDNDeviceType, OIDNFormat


def check_installed() -> None:
    """Raises UsageError where the extra is not installed."""
    _file()


def folder() -> str:
    """Where its libraries are; '' where the extra is not installed."""
    try:
        return str(_file().parent)
    except UsageError:
        return ""


@cache
def _file() -> Path:
    try:
        files = metadata.files("pyoidn") or []
    except metadata.PackageNotFoundError as missing:
        raise UsageError(f"--denoise {EXTRA}") from missing
    found = [f for f in files if f.name in ("libOpenImageDenoise.so.2", "OpenImageDenoise.dll")]
    found += [f for f in files if f.name.startswith("libOpenImageDenoise.2") and f.name.endswith(".dylib")]
    if not found:
        raise UsageError(f"--denoise {EXTRA}; the pyoidn that is installed holds no Open Image Denoise 2")
    return Path(str(found[0].locate())).resolve()


@cache
def library() -> ctypes.CDLL:
    """Open the bundled library once.

    Raises:
        UsageError: the extra is not installed.
        ImageError: the library cannot be loaded.
    """
    file = _file()
    try:
        lib = ctypes.CDLL(str(file))
    except OSError as error:
        raise ImageError(f"Open Image Denoise cannot be loaded: {error}") from error
    handle, size, text = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_char_p
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "oidnNewDevice": (handle, [ctypes.c_int]),
        "oidnSetDeviceInt": (None, [handle, text, ctypes.c_int]),
        "oidnSetDeviceBool": (None, [handle, text, ctypes.c_bool]),
        "oidnCommitDevice": (None, [handle]),
        "oidnGetDeviceError": (ctypes.c_int, [handle, ctypes.POINTER(text)]),
        "oidnReleaseDevice": (None, [handle]),
        "oidnNewFilter": (handle, [handle, text]),
        "oidnSetSharedFilterImage": (None, [handle, text, handle, ctypes.c_int, size, size, size, size, size]),
        "oidnSetFilterBool": (None, [handle, text, ctypes.c_bool]),
        "oidnCommitFilter": (None, [handle]),
        "oidnExecuteFilter": (None, [handle]),
        "oidnReleaseFilter": (None, [handle]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    return lib


def denoised(color: F32, albedo: F32, normal: F32, jobs: int = 0, *, shared: bool = False) -> F32:
    """A picture without its noise.

    The network knows noise that is different in every pixel, and takes for a texture what neighbours share. Where
    they do share it, every other pixel does not: the picture is taken apart into four, each of which is denoised for
    itself, and that is believed where it does no harm (docs/decisions/denoise.md).

    Where a white thing is brighter than white, as a lamp that is seen, the picture stays as it is: the network would
    let its edge glow.

    Args:
        color: shape (H, W, 3), scene-linear radiance >= 0; 1 is white.
        albedo: shape (H, W, 3), 0 .. 1, without noise of its own; edges of it stay edges of the picture.
        normal: shape (H, W, 3), any frame, likewise.
        jobs: threads; 0 means all cores.
        shared: pixels are made from their corners, so that neighbours share noise.

    Raises:
        UsageError: the extra is not installed.
        ImageError: Open Image Denoise failed, as for want of memory.
    """
    with _device(jobs) as (lib, device):
        quiet = _without_noise(lib, device, color, albedo, normal)
        if shared and min(color.shape[:2]) > 1:
            apart = np.empty_like(quiet)
            for y in range(2):
                for x in range(2):
                    part = slice(y, None, 2), slice(x, None, 2)
                    apart[part] = _without_noise(lib, device, color[part], albedo[part], normal[part])
            quiet += _trust(color, apart, albedo, normal) * (apart - quiet)
    lamp = (albedo.min(axis=2, keepdims=True) >= _WHITE) & (color.max(axis=2, keepdims=True) > 1.0)
    return np.where(_around(lamp, np.maximum), color, quiet)


def _trust(color: F32, apart: F32, albedo: F32, normal: F32) -> F32:
    """How far to believe a picture whose parts were denoised alone, 0 .. 1, shape (H, W, 1): where surfaces are even,
    so that nothing was too fine for a quarter of the pixels, and where only grain was taken away, whose mean over some
    pixels is nothing beside its spread."""
    rough = [_around(plane, np.maximum) - _around(plane, np.minimum) for plane in (albedo, normal)]
    steps = (rough[0].max(axis=2) / _STEP) ** 2 + (rough[1].max(axis=2) / (2.0 * _STEP)) ** 2
    taken = apart - color
    pixels = (2 * _REACH + 1) ** 2
    mean = _around(taken, np.add) / pixels
    spread = np.sqrt(np.maximum(0.0, _around(taken * taken, np.add) / pixels - mean * mean))
    even = np.clip(1.5 - 3.0 * np.abs(mean) / (spread + _DARK), 0.0, 1.0).min(axis=2)
    found: F32 = (np.exp(-steps) * even)[..., None].astype(np.float32)
    return found


def _around(plane: Any, join: np.ufunc) -> Any:
    """The largest, the smallest or the sum of a pixel and those around it, as `join` says."""
    height, width = plane.shape[:2]
    wide = np.pad(plane, ((_REACH, _REACH), (_REACH, _REACH), (0, 0)), "edge")
    rows = reduce(join, [wide[k : k + height] for k in range(2 * _REACH + 1)])
    return reduce(join, [rows[:, k : k + width] for k in range(2 * _REACH + 1)])


def _without_noise(lib: ctypes.CDLL, device: int, color: F32, albedo: F32, normal: F32) -> F32:
    """One picture, as `denoised`."""
    height, width = color.shape[:2]
    around = ((_RIM, _RIM), (_RIM, _RIM), (0, 0))
    planes = {name: np.ascontiguousarray(np.pad(plane, around, "symmetric"), np.float32)
              for name, plane in (("color", color), ("albedo", albedo), ("normal", normal))}  # fmt: skip
    planes["output"] = np.zeros_like(planes["color"])
    _run(lib, device, planes)
    inner: F32 = planes["output"][_RIM : _RIM + height, _RIM : _RIM + width]
    return inner


@contextmanager
def _device(jobs: int) -> Iterator[tuple[ctypes.CDLL, int]]:
    """The library, and a device of it that is released in the end."""
    lib = library()
    device = lib.oidnNewDevice(_CPU)
    if not device:
        raise ImageError(f"Open Image Denoise: {_error(lib, None) or 'no device'}")
    try:
        lib.oidnSetDeviceInt(device, b"numThreads", jobs)
        lib.oidnSetDeviceBool(device, b"setAffinity", False)  # other pictures may be drawn on the same cores
        lib.oidnCommitDevice(device)
        yield lib, device
    finally:
        lib.oidnReleaseDevice(device)


def _run(lib: ctypes.CDLL, device: int, planes: dict[str, F32]) -> None:
    """The filter for pictures of ray tracers, into `output`; all planes are of one size."""
    run = lib.oidnNewFilter(device, b"RT")
    try:
        height, width = planes["output"].shape[:2]
        for name, plane in planes.items():
            lib.oidnSetSharedFilterImage(run, name.encode(), plane.ctypes.data, _FLOAT3, width, height, 0, 0, 0)
        lib.oidnSetFilterBool(run, b"hdr", True)
        lib.oidnSetFilterBool(run, b"cleanAux", True)
        lib.oidnCommitFilter(run)
        lib.oidnExecuteFilter(run)
    finally:
        lib.oidnReleaseFilter(run)
    if text := _error(lib, device):
        raise ImageError(f"Open Image Denoise: {text}")


def _error(lib: ctypes.CDLL, device: int | None) -> str:
    """The first thing that went wrong on a device; '' where nothing did."""
    text = ctypes.c_char_p()
    code = lib.oidnGetDeviceError(device, ctypes.byref(text))
    return (text.value or b"unknown error").decode("utf-8", "replace") if code else ""
