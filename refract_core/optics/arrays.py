"""Optics of many rays at once: arrays in, arrays out.

Each function here runs the function of the same name in `interface` over every row, so the formulas, their
sources and their limits are written there, once. Vectors are (..., 3), scalars (...); leading shapes broadcast, and
what comes back is float64 of the common leading shape. Directions are unit vectors, lengths metres. A ray that
cannot be refracted is a status in its own row and never touches another.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import UsageError
from ..kernels.compile import kernel
from ..kernels.lanes import by_address, put
from ..kernels.vec import row
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
    shape, (i, n), _ = _rows({"incident": incident, "normal": normal}, {})
    out = np.empty_like(i)
    _reflect(i, n, out)
    return out.reshape(*shape, 3)


def refract(incident: ArrayLike, normal: ArrayLike, eta_i_over_t: ArrayLike) -> Refracted:
    """Directions behind an interface; `normal` stands against `incident`."""
    shape, (i, n), (eta,) = _rows({"incident": incident, "normal": normal}, {"eta_i_over_t": eta_i_over_t})
    out = Refracted(np.empty(len(i), np.bool_), np.empty_like(i))
    _refract(i, n, eta, by_address(out))
    return Refracted(out.ok.reshape(shape), out.direction.reshape(*shape, 3))


def fresnel_dielectric(cos_i: ArrayLike, eta_i_over_t: ArrayLike) -> F64:
    """Exact unpolarised reflectances, shape (...,); 1 at total internal reflection."""
    shape, _, (cosine, eta) = _rows({}, {"cos_i": cos_i, "eta_i_over_t": eta_i_over_t})
    out = np.empty_like(cosine)
    _fresnel_dielectric(cosine, eta, out)
    return out.reshape(shape)


def fresnel_schlick(cos_i: ArrayLike, f0: ArrayLike) -> F64:
    """Schlick's reflectances, shape (...,)."""
    shape, _, (cosine, normal_incidence) = _rows({}, {"cos_i": cos_i, "f0": f0})
    out = np.empty_like(cosine)
    _fresnel_schlick(cosine, normal_incidence, out)
    return out.reshape(shape)


def transmittance(color: ArrayLike, absorption_distance: ArrayLike, path_length: ArrayLike) -> F64:
    """Beer-Lambert: what is left of each channel, shape (..., 3); `color` is what `absorption_distance` leaves."""
    scalars = {"absorption_distance": absorption_distance, "path_length": path_length}
    shape, (tint,), (distance, length) = _rows({"color": color}, scalars)
    out = np.empty_like(tint)
    _transmittance(tint, distance, length, out)
    return out.reshape(*shape, 3)


def sphere_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike, thickness: ArrayLike) -> Exit:
    """Through a ball of diameter `thickness` [m] touching the surface from inside."""
    vectors = {"position": position, "normal": normal, "wo": wo}
    shape, (p, n, towards), (eta, thick) = _rows(vectors, {"ior": ior, "thickness": thickness})
    out = Exit(np.empty(len(p)), np.empty_like(p), np.empty_like(p))
    _sphere_model(p, n, towards, eta, thick, by_address(out))
    return _shaped(shape, out)


def box_model(position: ArrayLike, normal: ArrayLike, wo: ArrayLike, ior: ArrayLike, thickness: ArrayLike) -> Exit:
    """Through a slab of `thickness` [m] with parallel faces."""
    vectors = {"position": position, "normal": normal, "wo": wo}
    shape, (p, n, towards), (eta, thick) = _rows(vectors, {"ior": ior, "thickness": thickness})
    out = Exit(np.empty(len(p)), np.empty_like(p), np.empty_like(p))
    _box_model(p, n, towards, eta, thick, by_address(out))
    return _shaped(shape, out)


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
    shape, (i, n), (source, medium) = _rows(vectors, {"ior_source": ior_source, "ior_medium": ior_medium})
    out = Node(np.empty_like(i), np.empty(len(i)), np.empty(len(i)), np.empty(len(i)))
    _refract_node(i, n, source, medium, critical_angle, null_on_tir, by_address(out))
    refracted, intensity, reflectance, passed = out
    return Node(
        refracted.reshape(*shape, 3), intensity.reshape(shape), reflectance.reshape(shape), passed.reshape(shape)
    )


def _rows(
    vectors: dict[str, ArrayLike], scalars: dict[str, ArrayLike]
) -> tuple[tuple[int, ...], list[F64], list[F64]]:
    """Common leading shape, and every argument with a row for each ray: (N, 3) and (N,) float64, contiguous."""
    wide = {name: np.asarray(value, dtype=np.float64) for name, value in vectors.items()}
    for name, vector in wide.items():
        if vector.ndim == 0 or vector.shape[-1] != 3:
            raise UsageError(f"{name} has shape {vector.shape}; its last axis must hold x, y, z: pass (N, 3) or (3,)")
    narrow = {name: np.asarray(value, dtype=np.float64) for name, value in scalars.items()}
    shapes = {name: vector.shape[:-1] for name, vector in wide.items()}
    shapes |= {name: scalar.shape for name, scalar in narrow.items()}
    try:
        shape = np.broadcast_shapes(*shapes.values())
    except ValueError:
        found = ", ".join(f"{name} {own}" for name, own in shapes.items())
        raise UsageError(f"numbers of rays disagree: {found}; pass equal or broadcastable leading shapes") from None
    return (
        shape,
        [np.ascontiguousarray(np.broadcast_to(v, (*shape, 3)).reshape(-1, 3)) for v in wide.values()],
        [np.ascontiguousarray(np.broadcast_to(s, shape).reshape(-1)) for s in narrow.values()],
    )


def _shaped(shape: tuple[int, ...], out: Exit) -> Exit:
    return Exit(out.path_length.reshape(shape), out.point.reshape(*shape, 3), out.direction.reshape(*shape, 3))


@kernel
def _reflect(incident: F64, normal: F64, out: F64) -> None:
    for i in range(len(incident)):
        put(out, i, one.reflect(row(incident, i), row(normal, i)))


@kernel
def _refract(incident: F64, normal: F64, eta_i_over_t: F64, out: Refracted) -> None:
    for i in range(len(incident)):
        ok, direction = one.refract(row(incident, i), row(normal, i), eta_i_over_t[i])
        out.ok[i] = ok
        put(out.direction, i, direction)


@kernel
def _fresnel_dielectric(cos_i: F64, eta_i_over_t: F64, out: F64) -> None:
    for i in range(len(cos_i)):
        out[i] = one.fresnel_dielectric(cos_i[i], eta_i_over_t[i])


@kernel
def _fresnel_schlick(cos_i: F64, f0: F64, out: F64) -> None:
    for i in range(len(cos_i)):
        out[i] = one.fresnel_schlick(cos_i[i], f0[i])


@kernel
def _transmittance(color: F64, absorption_distance: F64, path_length: F64, out: F64) -> None:
    for i in range(len(color)):
        put(out, i, one.transmittance(row(color, i), absorption_distance[i], path_length[i]))


@kernel
def _sphere_model(position: F64, normal: F64, wo: F64, ior: F64, thickness: F64, out: Exit) -> None:
    for i in range(len(position)):
        length, point, direction = models.sphere_model(
            row(position, i), row(normal, i), row(wo, i), ior[i], thickness[i]
        )
        out.path_length[i] = length
        put(out.point, i, point)
        put(out.direction, i, direction)


@kernel
def _box_model(position: F64, normal: F64, wo: F64, ior: F64, thickness: F64, out: Exit) -> None:
    for i in range(len(position)):
        length, point, direction = models.box_model(row(position, i), row(normal, i), row(wo, i), ior[i], thickness[i])
        out.path_length[i] = length
        put(out.point, i, point)
        put(out.direction, i, direction)


@kernel
def _refract_node(
    incident: F64, normal: F64, source: F64, medium: F64, critical_angle: bool, null_on_tir: bool, out: Node
) -> None:
    for i in range(len(incident)):
        refracted, intensity, reflectance, passed = one.refract_node(
            row(incident, i), row(normal, i), source[i], medium[i], critical_angle, null_on_tir
        )
        put(out.refracted, i, refracted)
        out.intensity[i], out.reflectance[i], out.transmittance[i] = intensity, reflectance, passed
