"""Where a probe stands: its frame, its influence volume and its proxy, in metres of engine world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pxr import UsdGeom

from ...scene import F64, Volume
from ..values import triple
from .attributes import ProbePrim, positive, token

MIN_EXTENT = 1e-4
"""[m]; the thinnest proxy box, as HDRP's."""

_SCALE_TOLERANCE = 1e-4


class Place(NamedTuple):
    """Where a stage's units and axes lie in engine world."""

    engine_from_stage: F64
    metres_per_unit: float


class Frame(NamedTuple):
    """A probe's own axes and origin in engine world; its axes are mirrored where the prim's transform mirrors."""

    axes: F64
    """shape (3, 3), columns, orthonormal"""
    origin: F64
    """shape (3,) [m]"""

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(self.axes) < 0.0)

    @property
    def world_from_volume(self) -> F64:
        """The frame with x turned round where it is mirrored: a box looks the same from both sides."""
        flip = np.diag([-1.0 if self.mirrored else 1.0, 1.0, 1.0])
        return _matrix(self.axes @ flip, self.origin)

    def per_face(self, faces: tuple[float, ...]) -> tuple[float, ...]:
        """Values for +x -x +y -y +z -z of the prim, as the volume's own faces."""
        return (faces[1], faces[0], *faces[2:]) if self.mirrored else faces


def frame_of(probe: ProbePrim, place: Place, transforms: UsdGeom.XformCache) -> Frame | None:
    """The prim's frame without its scale; None, and a notice, where its transform gives none."""
    stage_from_prim = np.array(transforms.GetLocalToWorldTransform(probe.prim), np.float64).T
    engine_from_prim = place.engine_from_stage @ stage_from_prim
    linear = engine_from_prim[:3, :3] / place.metres_per_unit
    if not np.isfinite(engine_from_prim).all():
        probe.say("its transform is not finite; the probe is ignored. Correct its xformOps")
        return None
    # The nearest orthonormal matrix: what is left of the transform without scale and shear (polar decomposition).
    left, scales, right = np.linalg.svd(linear)
    if scales[2] < 1e-9 * max(scales[0], 1e-30):
        probe.say("its transform is flat (a scale of 0); the probe is ignored. Correct its xformOps")
        return None
    if np.abs(scales - 1.0).max() > _SCALE_TOLERANCE:
        listed = ", ".join(f"{scale:.4g}" for scale in scales)
        probe.say(f"its scale in the world ({listed}) is ignored; give the volumes their size in scene units instead")
    return Frame(left @ right, engine_from_prim[:3, 3])


def own_volume(probe: ProbePrim, place: Place, frame: Frame, which: str, sphere: bool) -> Volume:
    """The volume whose size the prim itself gives; `which` is influence or proxy."""
    if sphere:
        extents = positive(probe, f"probe:{which}:radius", 1) * 3
    else:
        extents = tuple(0.5 * size for size in positive(probe, f"probe:{which}:size", 3))
    x, y, z = (place.metres_per_unit * extent for extent in extents)
    return Volume(frame.world_from_volume, sphere, (x, y, z))


def proxy_of(
    probe: ProbePrim, place: Place, frame: Frame, influence: Volume, planar: bool
) -> tuple[Volume | None, bool]:
    """What the surroundings are taken to lie on; None is infinitely far. And whether the picture's distances say it
    better."""
    kind = token(probe, "probe:proxy", ("influence", "volume", "infinite", "depth"))
    if kind == "depth" and planar:
        probe.say("probe:proxy is 'depth', which is for cubemaps, not for planar probes; the influence volume is used")
    return _volume_of(probe, place, frame, influence, kind), kind == "depth" and not planar


def _volume_of(probe: ProbePrim, place: Place, frame: Frame, influence: Volume, kind: str) -> Volume | None:
    targets = probe.prim.GetRelationship("probe:proxy:prim").GetForwardedTargets()
    if targets and kind != "volume":
        probe.say(f"probe:proxy:prim is ignored, for probe:proxy is '{kind}'; set that to 'volume' to use it")
    if kind in ("influence", "depth"):
        return influence
    if kind == "infinite":
        return None
    if not targets:
        return own_volume(probe, place, frame, "proxy", influence.sphere)
    box = _bounds(probe, place, targets)
    return influence if box is None else box


def _bounds(probe: ProbePrim, place: Place, targets: Sequence[Any]) -> Volume | None:
    """The world-aligned box of the first target; None, and a notice, where it has none."""
    if len(targets) > 1:
        probe.say(f"probe:proxy:prim has {len(targets)} targets; only the first, {targets[0]}, is used. Name one prim")
    prim = probe.prim.GetStage().GetPrimAtPath(targets[0].GetPrimPath())
    if not prim:
        probe.say(f"probe:proxy:prim names {targets[0]}, which does not exist; the influence volume is the proxy")
        return None
    cache = UsdGeom.BBoxCache(probe.time, [UsdGeom.Tokens.default_, UsdGeom.Tokens.render])
    box = cache.ComputeWorldBound(prim).ComputeAlignedRange()
    corners = np.array([box.GetMin(), box.GetMax()], np.float64)
    if box.IsEmpty() or not np.isfinite(corners).all():
        probe.say(f"probe:proxy:prim names {targets[0]}, which has no bounds; the influence volume is the proxy")
        return None
    half = 0.5 * (corners[1] - corners[0]) * place.metres_per_unit
    if half.min() < MIN_EXTENT:
        probe.say(f"probe:proxy:prim names {targets[0]}, which is flat; the proxy is made {2 * MIN_EXTENT} m thick")
    # Stage axes stay the box's own axes: engine world may be turned against them (Z up).
    axes = place.engine_from_stage[:3, :3] / place.metres_per_unit
    centre = place.engine_from_stage @ np.array([*corners.mean(axis=0), 1.0])
    return Volume(_matrix(axes, centre[:3]), False, triple(np.maximum(half, MIN_EXTENT)))


def _matrix(axes: F64, origin: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    matrix[:3, 3] = origin
    return matrix
