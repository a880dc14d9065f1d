"""Optics of many rays at once: arrays in, arrays out.

Each function here runs the function of the same name in `optics_scalar` over every row, so the formulas, their
sources and their limits are written there, once. Vectors are (..., 3), scalars (...); leading shapes broadcast, and
what comes back is float64 of the common leading shape. Directions are unit vectors, lengths metres. A ray that
cannot be refracted is a status in its own row and never touches another.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import UsageError
from ..kernels.compile import inlined, kernel
from ..kernels.vec import Vec
from ..models import Model
from . import interface as one
from . import models

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
    """Mirror directions, shape (..., 3)."""
    shape, rows = _rows({"incident": incident, "normal": normal}, {})
    out = np.empty((len(rows), 3))
    _reflect(rows, out)
    return out.reshape(*shape, 3)


def refract(incident: ArrayLike, normal: ArrayLike, eta_i_over_t: ArrayLike) -> Refracted:
    """Directions behind an interface; `normal` stands against `incident`."""
    shape, rows = _rows({"incident": incident, "normal": normal}, {"eta_i_over_t": eta_i_over_t})
    out = np.empty((len(rows), 4))
    _refract(rows, out)
    return Refracted((out[:, 0] != 0.0).reshape(shape), out[:, 1:].reshape(*shape, 3))


def fresnel_dielectric(cos_i: ArrayLike, eta_i_over_t: ArrayLike) -> F64:
    """Exact unpolarised reflectances, shape (...,); 1 at total internal reflection."""
    shape, rows = _rows({}, {"cos_i": cos_i, "eta_i_over_t": eta_i_over_t})
    out = np.empty(len(rows))
    _fresnel_dielectric(rows, out)
    return out.reshape(shape)


def fresnel_schlick(cos_i: ArrayLike, f0: ArrayLike) -> F64:
    """Schlick's reflectances, shape (...,)."""
    shape, rows = _rows({}, {"cos_i": cos_i, "f0": f0})
    out = np.empty(len(rows))
    _fresnel_schlick(rows, out)
    return out.reshape(shape)


def transmittance(color: ArrayLike, absorption_distance: ArrayLike, path_length: ArrayLike) -> F64:
    """Beer-Lambert: what is left of each channel, shape (..., 3); `color` is what `absorption_distance` leaves."""
    scalars = {"absorption_distance": absorption_distance, "path_length": path_length}
    shape, rows = _rows({"color": color}, scalars)
    out = np.empty((len(rows), 3))
    _transmittance(rows, out)
    return out.reshape(*shape, 3)


def sphere_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike, thickness: ArrayLike) -> Exit:
    """Through a ball of diameter `thickness` [m] touching the surface from inside."""
    shape, rows = _rows({"position": position, "normal": normal, "wo": wo}, {"ior": ior, "thickness": thickness})
    out = np.empty((len(rows), 7))
    _sphere_model(rows, out)
    return _exit(shape, out)


def box_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike, thickness: ArrayLike) -> Exit:
    """Through a slab of `thickness` [m] with parallel faces."""
    shape, rows = _rows({"position": position, "normal": normal, "wo": wo}, {"ior": ior, "thickness": thickness})
    out = np.empty((len(rows), 7))
    _box_model(rows, out)
    return _exit(shape, out)


def thin_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike) -> Exit:
    """Through a slab of 5 mm, whatever thickness is authored."""
    return box_model(position, normal, wo, ior, Model.THIN.fixed_thickness)


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
    shape, rows = _rows(vectors, {"ior_source": ior_source, "ior_medium": ior_medium})
    out = np.empty((len(rows), 6))
    _refract_node(rows, critical_angle, null_on_tir, out)
    intensity, reflectance, passed = (out[:, k].reshape(shape) for k in (3, 4, 5))
    return Node(out[:, :3].reshape(*shape, 3), intensity, reflectance, passed)


def _rows(vectors: dict[str, ArrayLike], scalars: dict[str, ArrayLike]) -> tuple[tuple[int, ...], F64]:
    """Common leading shape, and all arguments side by side: shape (N, 3 * vectors + scalars), float64."""
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
    return shape, np.ascontiguousarray(np.concatenate(wide, axis=1))


def _exit(shape: tuple[int, ...], out: F64) -> Exit:
    return Exit(out[:, 0].reshape(shape), out[:, 1:4].reshape(*shape, 3), out[:, 4:].reshape(*shape, 3))


@inlined
def _get(rows: F64, i: int, at: int) -> Vec:
    return (rows[i, at], rows[i, at + 1], rows[i, at + 2])


@inlined
def _put(out: F64, i: int, at: int, v: Vec) -> None:
    out[i, at], out[i, at + 1], out[i, at + 2] = v[0], v[1], v[2]


@kernel
def _reflect(rows: F64, out: F64) -> None:
    for i in range(rows.shape[0]):
        _put(out, i, 0, one.reflect(_get(rows, i, 0), _get(rows, i, 3)))


@kernel
def _refract(rows: F64, out: F64) -> None:
    for i in range(rows.shape[0]):
        ok, direction = one.refract(_get(rows, i, 0), _get(rows, i, 3), rows[i, 6])
        out[i, 0] = 1.0 if ok else 0.0
        _put(out, i, 1, direction)


@kernel
def _fresnel_dielectric(rows: F64, out: F64) -> None:
    for i in range(rows.shape[0]):
        out[i] = one.fresnel_dielectric(rows[i, 0], rows[i, 1])


@kernel
def _fresnel_schlick(rows: F64, out: F64) -> None:
    for i in range(rows.shape[0]):
        out[i] = one.fresnel_schlick(rows[i, 0], rows[i, 1])


@kernel
def _transmittance(rows: F64, out: F64) -> None:
    for i in range(rows.shape[0]):
        _put(out, i, 0, one.transmittance(_get(rows, i, 0), rows[i, 3], rows[i, 4]))


@kernel
def _sphere_model(rows: F64, out: F64) -> None:
    for i in range(rows.shape[0]):
        path_length, point, direction = models.sphere_model(
            _get(rows, i, 0), _get(rows, i, 3), _get(rows, i, 6), rows[i, 9], rows[i, 10]
        )
        out[i, 0] = path_length
        _put(out, i, 1, point)
        _put(out, i, 4, direction)


@kernel
def _box_model(rows: F64, out: F64) -> None:
    for i in range(rows.shape[0]):
        path_length, point, direction = models.box_model(
            _get(rows, i, 0), _get(rows, i, 3), _get(rows, i, 6), rows[i, 9], rows[i, 10]
        )
        out[i, 0] = path_length
        _put(out, i, 1, point)
        _put(out, i, 4, direction)


@kernel
def _refract_node(rows: F64, critical_angle: bool, null_on_tir: bool, out: F64) -> None:
    for i in range(rows.shape[0]):
        refracted, intensity, reflectance, passed = one.refract_node(
            _get(rows, i, 0), _get(rows, i, 3), rows[i, 6], rows[i, 7], critical_angle, null_on_tir
        )
        _put(out, i, 0, refracted)
        out[i, 3], out[i, 4], out[i, 5] = intensity, reflectance, passed
