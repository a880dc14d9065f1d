"""Optics of many rays at once, for Python: arrays in, arrays out.

    from refract_core.optics.arrays import fresnel_dielectric, refract

    angle = np.radians(np.linspace(0.0, 90.0, 91))
    incident = np.stack([np.sin(angle), np.zeros(91), -np.cos(angle)], axis=-1)
    behind = refract(incident, (0.0, 0.0, 1.0), 1.0 / 1.5).direction       # shape (91, 3)
    mirrored = fresnel_dielectric(np.cos(angle), 1.0 / 1.5)                # shape (91,)

Each function runs the function of the same name in `interface` or `models` over every row, so the formulas, their
sources and their limits are written there, once, and what is drawn is what is told here. Vectors are (..., 3), scalars
(...); leading shapes broadcast as in numpy, and what comes back is float64 of the common leading shape. Directions are
unit vectors, lengths metres. A ray that cannot be refracted is a status in its own row and never touches another.
Shapes that do not fit raise UsageError.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import UsageError
from ..kernels.arrays import F64_2D
from ..kernels.compile import inlined, kernel
from ..kernels.vec import Vec
from ..models import Model
from . import interface as one
from . import models

__all__ = [
    "Exit",
    "Node",
    "Refracted",
    "box_model",
    "fresnel_dielectric",
    "reflect",
    "refract",
    "refract_node",
    "sphere_model",
    "thin_model",
    "transmittance",
]

F64 = NDArray[np.float64]


class Refracted(NamedTuple):
    """What is behind an interface."""

    ok: NDArray[np.bool_]
    """shape (...,): False at total internal reflection"""
    direction: F64
    """shape (..., 3): unit vector, zero where not `ok`"""


class Exit(NamedTuple):
    """Where and how a ray leaves a refraction model."""

    path_length: F64
    """shape (...,) [m], inside the medium"""
    point: F64
    """shape (..., 3) [m]"""
    direction: F64
    """shape (..., 3), unit"""


class Node(NamedTuple):
    """Outputs of the Refract node and, beside them, the physical shares of the light."""

    refracted: F64
    """shape (..., 3)"""
    intensity: F64
    """shape (...,): the node's own second output"""
    reflectance: F64
    """shape (...,): exact, unpolarised"""
    transmittance: F64
    """shape (...,): 1 - reflectance"""


def reflect(incident: ArrayLike, normal: ArrayLike) -> F64:
    """Mirror directions, shape (..., 3); `normal` may stand on either side."""
    return _vector(_each(_Formula.REFLECT, {"incident": incident, "normal": normal}, {}), 0)


def refract(incident: ArrayLike, normal: ArrayLike, eta_i_over_t: ArrayLike) -> Refracted:
    """Directions behind an interface, by Snell's law.

    Args:
        normal: stands against `incident`.
        eta_i_over_t: ior of the medium the ray is in over that of the medium it enters.
    """
    out = _each(_Formula.REFRACT, {"incident": incident, "normal": normal}, {"eta_i_over_t": eta_i_over_t})
    return Refracted(out[..., 0] != 0.0, _vector(out, 1))


def fresnel_dielectric(cos_i: ArrayLike, eta_i_over_t: ArrayLike) -> F64:
    """Exact unpolarised reflectances, shape (...,); 1 at total internal reflection.

    Args:
        cos_i: cosine of the angle of incidence, 0 .. 1.
        eta_i_over_t: ior of the medium the ray is in over that of the medium it enters.
    """
    return _scalar(_each(_Formula.FRESNEL, {}, {"cos_i": cos_i, "eta_i_over_t": eta_i_over_t}), 0)


def transmittance(color: ArrayLike, absorption_distance: ArrayLike, path_length: ArrayLike) -> F64:
    """Beer-Lambert: what is left of each channel, shape (..., 3); `color` is what `absorption_distance` leaves."""
    lengths = {"absorption_distance": absorption_distance, "path_length": path_length}
    return _vector(_each(_Formula.TRANSMITTANCE, {"color": color}, lengths), 0)


def sphere_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike, thickness: ArrayLike) -> Exit:
    """Through a ball of diameter `thickness` [m] touching the surface from inside; `wo` points to the viewer."""
    return _exit(_Formula.SPHERE, position, normal, wo, ior, thickness)


def box_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike, thickness: ArrayLike) -> Exit:
    """Through a slab of `thickness` [m] with parallel faces; `wo` points to the viewer."""
    return _exit(_Formula.BOX, position, normal, wo, ior, thickness)


def thin_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike) -> Exit:
    """As `box_model`, of the thickness that the thin model has whatever is authored: 5 mm."""
    return _exit(_Formula.BOX, position, normal, wo, ior, Model.THIN.fixed_thickness)


def refract_node(
    incident: ArrayLike,
    normal: ArrayLike,
    ior_source: ArrayLike = 1.0,
    ior_medium: ArrayLike = 1.5,
    *,
    critical_angle: bool = False,
    null_on_tir: bool = False,
) -> Node:
    """Unity's Refract node; mode Safe, or CriticalAngle where asked for."""
    vectors = {"incident": incident, "normal": normal}
    scalars = {"ior_source": ior_source, "ior_medium": ior_medium, "critical": critical_angle, "null": null_on_tir}
    out = _each(_Formula.NODE, vectors, scalars)
    return Node(_vector(out, 0), _scalar(out, 3), _scalar(out, 4), _scalar(out, 5))


class _Formula(IntEnum):
    """Which function the kernel runs."""

    REFLECT = 0
    REFRACT = 1
    FRESNEL = 2
    TRANSMITTANCE = 3
    SPHERE = 4
    BOX = 5
    NODE = 6


def _each(formula: _Formula, vectors: dict[str, ArrayLike], scalars: dict[str, ArrayLike]) -> F64:
    """What the formula gives for every row of the arguments, shape (..., 7): its outputs in their order, then zeros."""
    parts: list[F64] = []
    for name, value in vectors.items():
        vector = np.asarray(value, dtype=np.float64)
        if vector.ndim == 0 or vector.shape[-1] != 3:
            raise UsageError(f"{name} has shape {vector.shape}; its last axis must hold x, y, z: pass (N, 3) or (3,)")
        parts.append(vector)
    parts += [np.asarray(value, dtype=np.float64)[..., None] for value in scalars.values()]
    try:
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    except ValueError:
        found = ", ".join(f"{n} {p.shape[:-1]}" for n, p in zip([*vectors, *scalars], parts, strict=True))
        raise UsageError(f"numbers of rays disagree: {found}; pass equal or broadcastable leading shapes") from None
    wide = [np.broadcast_to(part, (*shape, part.shape[-1])).reshape(-1, part.shape[-1]) for part in parts]
    rows = np.ascontiguousarray(np.concatenate(wide, axis=1))
    out = np.zeros((len(rows), 7))
    _run(int(formula), rows, out)
    return out.reshape(*shape, 7)


def _vector(out: F64, at: int) -> F64:
    return out[..., at : at + 3].copy()


def _scalar(out: F64, at: int) -> F64:
    return out[..., at].copy()


def _exit(
    model: _Formula, position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike, thickness: ArrayLike
) -> Exit:
    vectors = {"position": position, "normal": normal, "wo": wo}
    out = _each(model, vectors, {"ior": ior, "thickness": thickness})
    return Exit(_scalar(out, 0), _vector(out, 1), _vector(out, 4))


@inlined
def _get(rows: F64, i: int, at: int) -> Vec:
    return (rows[i, at], rows[i, at + 1], rows[i, at + 2])


@inlined
def _put(out: F64, i: int, at: int, v: Vec) -> None:
    out[i, at], out[i, at + 1], out[i, at + 2] = v[0], v[1], v[2]


@kernel
def _run(formula: int, rows: F64_2D, out: F64_2D) -> None:
    """One formula over rows that hold its arguments side by side: no column beyond them may be read."""
    for i in range(rows.shape[0]):
        if formula == _Formula.REFLECT:
            _put(out, i, 0, one.reflect(_get(rows, i, 0), _get(rows, i, 3)))
        elif formula == _Formula.REFRACT:
            ok, direction = one.refract(_get(rows, i, 0), _get(rows, i, 3), rows[i, 6])
            out[i, 0] = 1.0 if ok else 0.0
            _put(out, i, 1, direction)
        elif formula == _Formula.FRESNEL:
            out[i, 0] = one.fresnel_dielectric(rows[i, 0], rows[i, 1])
        elif formula == _Formula.TRANSMITTANCE:
            _put(out, i, 0, one.transmittance(_get(rows, i, 0), rows[i, 3], rows[i, 4]))
        elif formula == _Formula.NODE:
            refracted, intensity, reflectance, passed = one.refract_node(
                _get(rows, i, 0), _get(rows, i, 3), rows[i, 6], rows[i, 7], rows[i, 8] != 0.0, rows[i, 9] != 0.0
            )
            _put(out, i, 0, refracted)
            out[i, 3], out[i, 4], out[i, 5] = intensity, reflectance, passed
        else:
            p, n, wo, ior, thickness = _get(rows, i, 0), _get(rows, i, 3), _get(rows, i, 6), rows[i, 9], rows[i, 10]
            if formula == _Formula.SPHERE:
                path_length, point, leaving = models.sphere_model(p, n, wo, ior, thickness)
            else:
                path_length, point, leaving = models.box_model(p, n, wo, ior, thickness)
            out[i, 0] = path_length
            _put(out, i, 1, point)
            _put(out, i, 4, leaving)
