"""The Refract node for a person: one ray, or a sweep over the angle, as numbers and words.

The formulas are `optics.refract_node`'s. Angles are in degrees, between the ray and the interface's normal.
"""

from __future__ import annotations

import json
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..optics.arrays import refract_node

MODES = ("safe", "critical")
SWEEP_STEPS = 18

F64 = NDArray[np.float64]


class Interface(NamedTuple):
    """What the node is asked."""

    source: float
    """ior on the side that the ray comes from"""
    medium: float
    """ior behind the interface"""
    mode: str
    """`safe`, or `critical`: at total internal reflection the refracted vector is the reflected one"""


class Answer(NamedTuple):
    """What the node says to one ray."""

    incident: F64
    """shape (3,), unit: as asked, normalised"""
    normal: F64
    """shape (3,), unit"""
    refracted: F64
    """shape (3,); in safe mode not a unit vector at total internal reflection, as in Unity"""
    intensity: float
    """the node's second output: a transmittance into denser media, a reflectance out of them"""
    reflectance: float
    transmittance: float
    angle: float
    """of incidence"""
    refracted_angle: float | None
    """None at total internal reflection"""
    deviation: float
    """between incident and refracted vector"""
    total_reflection: bool


def check(name: str, interface: Interface) -> None:
    """Raises UsageError where an ior is not a number above 0, or the mode is unknown. `name`: of the command."""
    for flag, value in (("--source", interface.source), ("--medium", interface.medium)):
        if not math.isfinite(value) or value <= 0.0:
            raise UsageError(f"{name} {flag} is {value}; an index of refraction is a number of 1 or more")
    if interface.mode not in MODES:
        raise UsageError(f"{name} --mode is '{interface.mode}', which is not known; choose from {', '.join(MODES)}")


def parse_vector(flag: str, text: str) -> F64:
    """Unit vector of `x,y,z`. Raises UsageError."""
    try:
        vector = np.array([float(part) for part in text.split(",")])
    except ValueError:
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise UsageError(f"{flag} is '{text}'; give three numbers x,y,z that are not all 0, such as 0.5,-0.866,0")
    vector = vector / np.abs(vector).max()  # so that the square of the largest double is finite
    return np.asarray(vector / np.linalg.norm(vector))


def answer(incident: F64, normal: F64, interface: Interface) -> Answer:
    """Ask the node about one ray. Vectors have shape (3,) and unit length."""
    node = refract_node(
        incident, normal, interface.source, interface.medium, critical_angle=interface.mode == "critical"
    )
    source, medium = max(interface.source, 1.0), max(interface.medium, 1.0)
    cosine = float(-incident @ normal)
    sine = source / medium * math.sqrt(max(0.0, 1.0 - cosine * cosine))
    total = sine > 1.0
    refracted = node.refracted
    along = float(refracted @ incident) / max(float(np.linalg.norm(refracted)), 1e-300)
    return Answer(
        incident,
        normal,
        refracted,
        float(node.intensity),
        float(node.reflectance),
        float(node.transmittance),
        math.degrees(math.acos(max(-1.0, min(1.0, cosine)))),
        None if total else math.degrees(math.asin(min(sine, 1.0))),
        math.degrees(math.acos(max(-1.0, min(1.0, along)))),
        total,
    )


def sweep(interface: Interface, steps: int = SWEEP_STEPS) -> list[Answer]:
    """Ask for `steps` + 1 angles from 0 to 90 degrees; the last ray only just grazes."""
    normal = np.array([0.0, 1.0, 0.0])
    angles = np.radians(np.linspace(0.0, 90.0, steps + 1))
    angles[-1] = np.radians(89.999)
    return [answer(np.array([math.sin(a), -math.cos(a), 0.0]), normal, interface) for a in angles]


def critical_angle(interface: Interface) -> float | None:
    """Angle from which everything is reflected; None into denser media."""
    source, medium = max(interface.source, 1.0), max(interface.medium, 1.0)
    return math.degrees(math.asin(medium / source)) if source > medium else None


# ---- words


def to_text(found: Answer, interface: Interface) -> str:
    """One line per output."""
    bent = "none: total internal reflection" if found.refracted_angle is None else f"{found.refracted_angle:.4f} deg"
    lines = [
        ("incident", _vector(found.incident)),
        ("normal", _vector(found.normal)),
        ("refracted", _vector(found.refracted)),
        ("intensity", f"{found.intensity:.6f}"),
        ("reflectance", f"{found.reflectance:.6f}"),
        ("transmittance", f"{found.transmittance:.6f}"),
        ("angle", f"{found.angle:.4f} deg"),
        ("refracted angle", bent),
        ("deviation", f"{found.deviation:.4f} deg"),
    ]
    critical = critical_angle(interface)
    if critical is not None:
        lines.append(("critical angle", f"{critical:.4f} deg"))
    return "\n".join(f"{name:<16}{value}" for name, value in lines)


def sweep_text(found: list[Answer]) -> str:
    """A table with the reflectance drawn beside it."""
    rows = ["  angle  refracted  deviation  intensity  reflectance"]
    for one in found:
        bent = "    total" if one.refracted_angle is None else f"{one.refracted_angle:9.3f}"
        bar = "#" * round(40 * one.reflectance)
        row = f"{one.angle:7.2f}  {bent}  {one.deviation:9.3f}  {one.intensity:9.5f}  {one.reflectance:11.5f}  {bar}"
        rows.append(row.rstrip())
    return "\n".join(rows)


def to_json(found: Answer | list[Answer], interface: Interface) -> str:
    """The same as JSON: one object, or a list of them for a sweep, beside the interface."""
    body = [_plain(one) for one in found] if isinstance(found, list) else _plain(found)
    key = "sweep" if isinstance(found, list) else "ray"
    return json.dumps({**interface._asdict(), "critical_angle": critical_angle(interface), key: body}, indent=2)


def _plain(found: Answer) -> dict[str, object]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in found._asdict().items()}


def _vector(v: F64) -> str:
    return ", ".join(f"{x + 0.0:.6f}" for x in np.where(np.abs(v) < 5e-7, 0.0, v))
