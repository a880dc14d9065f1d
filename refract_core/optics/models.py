"""How light goes through each refraction model: one function a row of the table `refract_core.models`.

A model answers from the entry alone (Snell's law at the first surface, and an assumed body behind it): how far the
light goes inside, where it leaves and where to. Fresnel and absorption are the same for all, and stand elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..kernels.choice import choice
from ..kernels.compile import inlined
from ..kernels.vec import Vec, along, dot, flip_towards, normalize, scale
from ..models import SHEET, Behind, Model

BOX_MIN_COS = 1e-5
"""Floor of the cosine in the box model (HDRP, Refraction.hlsl)."""

Exit = tuple[float, Vec, Vec]
"""Path length inside [m], exit point [m], unit exit direction."""
ExitFunction = Callable[[Vec, Vec, Vec, float, float], Exit]
"""(point [m], normal, unit direction to the viewer, ior, thickness [m]) -> exit"""


@inlined
def _enter(n: Vec, wo: Vec, ior: float) -> tuple[Vec, Vec, float, float, float]:
    """First interface of every model: normal towards the viewer, direction inside, cos_i, cos_t and the ior >= 1."""
    dense = max(ior, 1.0)
    facing = flip_towards(n, wo)
    cos_i = min(dot(facing, wo), 1.0)
    cos_t = cosine_inside(cos_i, dense)
    inside = along(scale(wo, -1.0 / dense), facing, cos_i / dense - cos_t)
    return facing, inside, cos_i, cos_t, dense


@inlined
def cosine_inside(cos_i: float, ior: float) -> float:
    """Cosine under which light goes on that came in under `cos_i`, 0 .. 1, from vacuum (Snell); ior >= 1."""
    return math.sqrt(max(1.0 - (1.0 - cos_i * cos_i) / (ior * ior), 0.0))


@inlined
def no_model(p: Vec, n: Vec, wo: Vec, ior: float, thickness: float) -> Exit:
    """Straight on, as if there were nothing."""
    return 0.0, p, scale(wo, -1.0)


@inlined
def sphere_model(p: Vec, n: Vec, wo: Vec, ior: float, thickness: float) -> Exit:
    """Through a ball of diameter `thickness` that touches the surface from inside (HDRP, Refraction.hlsl).

    The ball's far normal is n + 2 cos_t r, whatever its size, and the ray leaves it under the angle it came in
    with; written so, neither a thickness of 0 nor rounding at grazing angles can break the second refraction.
    """
    facing, inside, cos_i, cos_t, dense = _enter(n, wo, ior)
    path_length = thickness * cos_t
    outward = along(facing, inside, 2.0 * cos_t)
    leaving = along(scale(inside, dense), outward, cos_i - dense * cos_t)
    return path_length, along(p, inside, path_length), normalize(leaving)


@inlined
def box_model(p: Vec, n: Vec, wo: Vec, ior: float, thickness: float) -> Exit:
    """Through a slab of `thickness` with parallel faces: shifted, not turned (HDRP, Refraction.hlsl)."""
    _, inside, _, cos_t, _ = _enter(n, wo, ior)
    path_length = thickness / max(cos_t, BOX_MIN_COS)
    return path_length, along(p, inside, path_length), scale(wo, -1.0)


@inlined
def single_model(p: Vec, n: Vec, wo: Vec, ior: float, thickness: float) -> Exit:
    """By Snell's law at the surface, and no further: out of the surface's own point, with no way inside (Arm,
    Refraction based on local cubemaps: R = refract(D, N, n1 / n2))."""
    _, inside, _, _, _ = _enter(n, wo, ior)
    return 0.0, p, normalize(inside)


EXITS: dict[Model, ExitFunction] = {
    Model.SPHERE: sphere_model,
    Model.BOX: box_model,
    Model.THIN: box_model,  # at the one thickness that its row fixes
    Model.SINGLE: single_model,
}
"""The function of every model that answers from the entry alone; `traced` is a walk (`transport.exits`)."""

exit_of: Callable[[int, Vec, Vec, Vec, float, float], Exit] = choice(EXITS, no_model)
"""(model, point, normal, direction to the viewer, ior, thickness) -> exit, for kernels"""


# --- the table's columns, by a model's number -----------------------------------------------------------------------

WALL = SHEET.fixed_thickness
"""How thick a wall without an inside is, and over which way its colour is reached [m]."""

_IS_SHEET = np.array([model.behind is Behind.SHEET for model in Model], np.bool_)
_IS_WALKED = np.array([model.behind is Behind.MESH for model in Model], np.bool_)
_ON_OPEN_MESH = np.array([SHEET if model.behind is Behind.MESH else model for model in Model], np.int64)
_FIXED = np.array([model.fixed_thickness for model in Model], np.float64)
_LEAST = np.array([model.row.least_thickness for model in Model], np.float64)


@inlined
def is_sheet(model: int) -> bool:
    """Light enters it on either side, and there is no inside to be in."""
    return bool(_IS_SHEET[model])


@inlined
def is_walked(model: int) -> bool:
    """Its exit is found on the mesh itself, not by a function of the entry."""
    return bool(_IS_WALKED[model])


@inlined
def on_open_mesh(model: int) -> int:
    """What a model is drawn as on an open mesh: one that follows the mesh finds no far side there."""
    return int(_ON_OPEN_MESH[model])


@inlined
def thickness_of(model: int, authored: float) -> float:
    """[m]; the model's own where it has one."""
    return float(_FIXED[model]) if _FIXED[model] > 0.0 else max(float(_LEAST[model]), authored)


@inlined
def absorption_distance_of(model: int, authored: float) -> float:
    """[m]; over the way through a wall of fixed thickness its colour is reached once."""
    return float(_FIXED[model]) if _FIXED[model] > 0.0 else authored
