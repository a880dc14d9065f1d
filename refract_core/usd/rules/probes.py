"""Rules about reflection probes: their pictures, where they stand, and what they reach."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from pxr import Usd

from ...probes.digest import stale_bakes
from ...scene import F64, Probe, Scene, Volume
from ...version import __version__
from ...world.instances import around, placed, sphere
from ...world.solid import encloses
from .findings import ERROR, INFO, WARNING, Finding, Rule
from .glass import Glass

_POINTS = 2000
"""Points of a piece of glass that are asked whether a probe reaches them."""

MISSING = Rule("refract.probe-texture-missing", ERROR, "The texture a probe names is there, and can be read.")
UNBAKED = Rule("refract.probe-not-baked", INFO, "A baked probe has a texture; without one it is drawn anew each time.")
STALE = Rule("refract.probe-texture-stale", WARNING, "A baked texture was made from the stage as it is now.")
OUTSIDE = Rule("refract.glass-outside-probes", WARNING, "Every piece of glass is within the influence of a probe.")
INSIDE = Rule("refract.capture-inside-object", WARNING, "A probe's capture point is not inside a solid object.")

SceneAt = Callable[[float], Scene]
"""The stage's scene at a time code."""


def texture_state(stage: Usd.Stage, probe: Probe, scene_at: SceneAt | None) -> str:
    """What a probe's picture is: realtime, planar, custom, missing, none, stale, baked, or unknown (no digest).

    Args:
        scene_at: None leaves the digest alone, so that only another engine is told.
    """
    if probe.planar or probe.mode == "realtime":
        return "planar" if probe.planar else "realtime"
    asset = stage.GetPrimAtPath(probe.path).GetAttribute("probe:texture").Get()
    if not asset or not asset.path:
        return "missing" if probe.mode == "custom" else "none"
    if probe.cubemap is None:
        return "missing"
    if probe.mode == "custom":
        return "custom"
    if probe.bake is None:
        return "unknown"
    if probe.bake.engine != __version__:
        return "stale"
    if scene_at is None:
        return "baked"
    return "stale" if stale_bakes([probe], scene_at) else "baked"


def probe_findings(stage: Usd.Stage, scene: Scene, glass: list[Glass], scene_at: SceneAt | None) -> list[Finding]:
    """What is wrong with the probes of a scene."""
    found: list[Finding] = []
    for probe in scene.probes:
        found += _picture(probe, texture_state(stage, probe, scene_at))
        if not probe.planar:  # that one looks from where the eye is
            found += _standing(probe, scene, glass)
    if scene.probes:
        found += [_outside(piece) for piece in glass if not any(share(probe, piece) for probe in scene.probes)]
    return found


def _picture(probe: Probe, state: str) -> Iterator[Finding]:
    """What is wrong with a probe's picture, by its state."""
    about, bake = "probe:texture", "run refract bake probes STAGE OUT"
    if state == "missing":
        custom = probe.mode == "custom"
        text = "probe:texture is not set, or is no picture that can be read; the surroundings are captured instead"
        fix = "name an existing picture in probe:texture" + ("" if custom else f", or {bake}")
        yield MISSING.broken(probe.path, text, fix, about)
    elif state == "none":
        text = "probe:mode is 'baked' but nothing has been baked; the probe is captured again for every render"
        yield UNBAKED.broken(probe.path, text, bake, about)
    elif state == "stale" and probe.bake is not None:
        old = probe.bake.engine
        why = f"by version {old} of the engine" if old != __version__ else "of a scene that has changed since"
        yield STALE.broken(probe.path, f"probe:texture was baked {why}", bake, about)


def _standing(probe: Probe, scene: Scene, glass: list[Glass]) -> Iterator[Finding]:
    """A solid has its outside facing outwards, and neither a camera nor glass in it: else it is a room."""
    point = np.array(probe.capture_point, np.float64)
    others = [camera.world_from_camera[:3, 3] for camera in scene.cameras]
    others += [piece.points.mean(axis=0) for piece in glass]
    refractive = {piece.path for piece in glass}
    for path, holds in _solids_at(scene, point):
        seen = probe.captured is None or path in probe.captured
        if path not in refractive and seen and not any(holds(other) for other in others):
            text = f"the capture point is inside {path}, so the picture shows that from within"
            fix = "move the probe, or author probe:captureOffset"
            yield INSIDE.broken(probe.path, text, fix, "probe:captureOffset")
            return


def _solids_at(scene: Scene, point: F64) -> Iterator[tuple[str, Callable[[F64], bool]]]:
    """Closed objects round a point, each with a test of whether it holds another."""
    around_it = [placed(many, k) for many in scene.instances if many.mesh.closed for k in around(many, point)]
    for mesh in (*scene.meshes, *around_it):
        if mesh.closed and encloses(mesh.points, mesh.triangles, point):
            yield mesh.path, lambda at, m=mesh: encloses(m.points, m.triangles, at)  # type: ignore[misc]
    around_too = [
        sphere(balls, k) for balls in scene.balls
        for k in np.flatnonzero(np.linalg.norm(balls.centres - point, axis=1) < balls.radii).tolist()
    ]  # fmt: skip
    for ball in (*scene.spheres, *around_too):
        if np.linalg.norm(point - ball.centre) < ball.radius:
            yield ball.path, lambda at, b=ball: bool(np.linalg.norm(at - b.centre) < b.radius)  # type: ignore[misc]


def _outside(piece: Glass) -> Finding:
    """Glass that no probe reaches."""
    text = "no probe's influence reaches this glass, so what the screen does not show comes from a ray, or the sky"
    fix = "make a probe's influence larger, or add a RefractProbe here, if a probe is to answer"
    return OUTSIDE.broken(piece.path, text, fix)


def share(probe: Probe, piece: Glass) -> float:
    """Part of a piece of glass, 0 .. 1, that lies in a probe's influence."""
    points = piece.points
    if len(piece.triangles):
        points = np.concatenate((points, points[piece.triangles].mean(axis=1)))
    points = points[:: max(1, len(points) // _POINTS)]
    return float(_inside(probe.influence, points).mean())


def _inside(volume: Volume, points: F64) -> NDArray[np.bool_]:
    local = np.abs((points - volume.world_from_volume[:3, 3]) @ volume.world_from_volume[:3, :3])
    if volume.sphere:
        return np.asarray((local**2).sum(axis=1) <= volume.extents[0] ** 2)
    return np.asarray((local <= np.array(volume.extents)).all(axis=1))
