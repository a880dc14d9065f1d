"""Stages with one probe, read: shared by the tests of probes."""

from __future__ import annotations

import numpy as np
from pxr import Usd

from refract_core.errors import ImageError
from refract_core.scene import F64, Cubemap, Notice, Probe
from refract_core.usd.probes.pictures import ReadCubemap
from refract_core.usd.probes.read import read_probes

# Z-up stage to Y-up engine: +X stays, +Z becomes +Y.
Y_UP = np.eye(4)
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def to_engine(metres: float = 1.0, turn: F64 = Y_UP, centre: tuple[float, float, float] = (0, 0, 0)) -> F64:
    move = np.eye(4)
    move[:3, 3] = np.negative(centre)
    return turn @ np.diag([metres, metres, metres, 1.0]) @ move


def cubemap(path: str, resolution: int) -> Cubemap:
    """A file that holds nothing but the length of its own path."""
    if "missing" in path:
        raise ImageError(f"{path} does not exist")
    return Cubemap((np.full((6, resolution, resolution, 5), len(path), np.float32),))


def open_text(text: str) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    # USD text wants a line's end before a closing brace.
    stage.GetRootLayer().ImportFromString("#usda 1.0\n" + text.replace("}", "\n}"))
    return stage


def read(
    text: str,
    engine_from_stage: F64 | None = None,
    metres: float = 1.0,
    time: float = 0.0,
    read_cubemap: ReadCubemap = cubemap,
) -> tuple[tuple[Probe, ...], list[Notice]]:
    notices: list[Notice] = []
    matrix = to_engine(metres) if engine_from_stage is None else engine_from_stage
    found = read_probes(
        open_text(text),
        Usd.TimeCode(time),
        engine_from_stage=matrix,
        metres_per_unit=metres,
        notices=notices,
        read_cubemap=read_cubemap,
    )
    return found, notices


def probe(body: str = "", *, name: str = "P", kind: str = "RefractProbe", data: str = "") -> str:
    """Text of one probe prim. `data`: what its customData holds."""
    above = f"(customData = {{\n{data}\n}}\n)" if data else ""
    return f'def {kind} "{name}" {above}\n{{\n{body}\n}}\n'


def planar(body: str = "") -> str:
    return probe(body, kind="RefractPlanarProbe")


def read_one(body: str = "", metres: float = 1.0, data: str = "") -> tuple[Probe, list[str]]:
    return read_only(probe(body, data=data), metres)


def read_only(text: str, metres: float = 1.0) -> tuple[Probe, list[str]]:
    """The one probe of a text, whose path is /P, and what was said about it."""
    (found,), notices = read(text, metres=metres)
    assert {notice.path for notice in notices} <= {"/P"}
    return found, [notice.text for notice in notices]
