"""Stages with one probe, read: shared by the tests of probes."""

from __future__ import annotations

import numpy as np
from pxr import Usd

from refract_core.errors import ImageError
from refract_core.scene import F64, Notice, Probe, Texture
from refract_core.usd.probes import read_probes

# Z-up stage to Y-up engine: +X stays, +Z becomes +Y.
Y_UP = np.eye(4)
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def to_engine(metres: float = 1.0, turn: F64 = Y_UP, centre: tuple[float, float, float] = (0, 0, 0)) -> F64:
    move = np.eye(4)
    move[:3, 3] = np.negative(centre)
    return turn @ np.diag([metres, metres, metres, 1.0]) @ move


def texture(path: str, color_space: str) -> Texture:
    if "missing" in path:
        raise ImageError(f"{path} does not exist")
    return Texture(f"{path} {color_space}", np.zeros((1, 1, 4), np.uint8))


def open_text(text: str) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    # USD text wants a line's end before a closing brace.
    stage.GetRootLayer().ImportFromString("#usda 1.0\n" + text.replace("}", "\n}"))
    return stage


def read(
    text: str, engine_from_stage: F64 | None = None, metres: float = 1.0, time: float = 0.0
) -> tuple[tuple[Probe, ...], list[Notice]]:
    notices: list[Notice] = []
    matrix = to_engine(metres) if engine_from_stage is None else engine_from_stage
    found = read_probes(
        open_text(text),
        Usd.TimeCode(time),
        engine_from_stage=matrix,
        metres_per_unit=metres,
        notices=notices,
        read_texture=texture,
    )
    return found, notices


def probe(body: str = "") -> str:
    return f'def RefractProbe "P"\n{{\n{body}\n}}\n'


def read_one(body: str = "", metres: float = 1.0) -> tuple[Probe, list[str]]:
    (found,), notices = read(probe(body), metres=metres)
    assert {notice.path for notice in notices} <= {"/P"}
    return found, [notice.text for notice in notices]
