"""A stage of one mesh in very many places: seconds to load it, what a place costs, and the first and second frame.

    python -m benchmarks.big_stage --instances 1000000 [--kind leaf|crystal] [--around 32]

`leaf` is an opaque globe in random places, turned and unevenly scaled; `crystal` is one of glass, on the rings of a
chandelier. Each size runs in a process of its own, with a tenth of the places beside it, so that what a place costs is
a difference of two.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from .room import globe

KINDS = ("leaf", "crystal")


def make(path: Path, count: int, kind: str, around: int) -> int:
    """Write the stage. Returns the triangles of its mesh."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rng = np.random.default_rng(0)
    instancer = UsdGeom.PointInstancer.Define(stage, "/Many")
    points, faces = globe(around // 2, around)
    if kind == "leaf":
        side = count ** (1 / 3) * 1.5
        positions, scales = rng.uniform(-side / 2, side / 2, (count, 3)), rng.uniform(0.5, 1.2, (count, 3))
    else:
        ring = rng.integers(0, 12, count)
        angle, radius = rng.uniform(0, 2 * math.pi, count), 0.25 + 0.06 * ring
        positions = np.stack([radius * np.cos(angle), 1.6 - 0.09 * ring + rng.uniform(-0.05, 0.05, count),
                              radius * np.sin(angle)], 1)  # fmt: skip
        scales = rng.uniform(0.02, 0.035, (count, 3)) * (0.6, 1.4, 0.6)
    turns = rng.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    instancer.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(positions.astype(np.float32)))
    instancer.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales.astype(np.float32)))
    instancer.CreateOrientationsAttr(Vt.QuathArray([Gf.Quath(*turn) for turn in turns.tolist()]))
    instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(count, np.int32)))
    mesh = UsdGeom.Mesh.Define(stage, "/Many/One")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy((0.5 * points).astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).reshape(-1)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    instancer.CreatePrototypesRel().AddTarget(mesh.GetPath())
    if kind == "crystal":
        _dress(stage, mesh.GetPrim())
    stage.GetRootLayer().Save()
    return len(faces)


def _dress(stage: Usd.Stage, mesh: Usd.Prim) -> None:
    """Glass, a floor and a wall behind it, a lamp within it and a sky."""
    material = UsdShade.Material.Define(stage, "/Glass")
    shader = UsdShade.Shader.Define(stage, "/Glass/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, value in (("opacity", 0.0), ("ior", 1.52), ("roughness", 0.0)):
        shader.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh).Bind(material)
    room = UsdGeom.Mesh.Define(stage, "/Room")
    room.CreatePointsAttr([(-3, 0, 3), (3, 0, 3), (3, 0, -2), (-3, 0, -2), (3, 3, -2), (-3, 3, -2)])
    room.CreateFaceVertexCountsAttr([4, 4])
    room.CreateFaceVertexIndicesAttr([0, 1, 2, 3, 3, 2, 4, 5])
    room.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    room.CreateDisplayColorAttr([(0.35, 0.2, 0.15)])
    lamp = UsdLux.SphereLight.Define(stage, "/Lamp")
    lamp.CreateRadiusAttr(0.06)
    lamp.CreateIntensityAttr(60.0)
    UsdGeom.XformCommonAPI(lamp).SetTranslate(Gf.Vec3d(0, 1.3, 0))
    UsdLux.DomeLight.Define(stage, "/Sky").CreateIntensityAttr(0.4)
    camera = UsdGeom.Camera.Define(stage, "/Camera")
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.05, 100.0))
    UsdGeom.XformCommonAPI(camera).SetTranslate(Gf.Vec3d(0, 1.15, 4.0))


def measure(path: str, picture: str) -> None:
    """One process: prints seconds and the growth of its memory, load, tables, first and second frame."""
    import refract_core as rc
    from refract_core.usd.stage import load_stage
    from refract_core.world.instances import settled
    from refract_core.world.tables import pack_geometry

    settings = rc.RenderSettings(image_width=480, image_height=360, samples=4, studio="none")

    since = now()
    scene = load_stage(path)
    told("load", since)
    since = now()
    tables = pack_geometry(settled(scene))
    told("tables", since)
    del tables
    for frame in ("first", "second"):
        since = now()
        drawn = rc.render(scene, settings)
        told(frame, since)
        if picture:
            drawn.save(picture)


class Mark(NamedTuple):
    """What a step of a process took, and its memory then."""

    seconds: float
    computed: float
    """of CPU"""
    held: float
    """[bytes], after the allocator has given back what is free"""
    peak: float
    """[bytes], of all steps so far"""


def now() -> tuple[float, float]:
    """Seconds that have passed, and those that this process has computed."""
    return time.perf_counter(), time.process_time()


def told(what: str, since: tuple[float, float]) -> tuple[float, float]:
    """Print the line of a step that began at `since`. Returns when the next one begins."""
    passed, computed = (after - before for after, before in zip(now(), since, strict=True))
    if sys.platform == "linux" and hasattr(lib := ctypes.CDLL(None), "malloc_trim"):
        lib.malloc_trim(0)
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    held, peak = (int(status[name].split()[0]) * 1024 for name in ("VmRSS", "VmHWM"))
    print(f"{what} {passed:.3f} {computed:.3f} {held} {peak}", flush=True)
    return now()


def marks_of(lines: str) -> dict[str, Mark]:
    """What a process has printed by `told`."""
    rows = (line.split() for line in lines.splitlines())
    return {name: Mark(*map(float, numbers)) for name, *numbers in rows}


class Many(NamedTuple):
    """A stage of one mesh in very many places, and how it was loaded and drawn."""

    places: int
    triangles: int
    """of the mesh"""
    steps: dict[str, Mark]
    """load, tables, first, second"""
    grown: dict[str, float]
    """load: at its peak; tables: held; second: at the peak of all [bytes for each place]"""


def measured(count: int, kind: str, around: int, picture: str = "") -> Many:
    """Make the stage, load it and draw it."""
    with tempfile.TemporaryDirectory() as folder:
        found: dict[int, dict[str, Mark]] = {}
        for places in (max(10, count // 10), count):
            stage = Path(folder) / f"{places}.usdc"
            triangles = make(stage, places, kind, around)
            command = [sys.executable, "-m", "benchmarks.instanced", str(stage), picture if places == count else ""]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            found[places] = marks_of(done.stdout)
    (few, less), (many, more) = found.items()
    grown = {
        "load": more["load"].peak - less["load"].peak,
        "tables": more["tables"].held - less["tables"].held,
        "second": more["second"].peak - less["second"].peak,
    }
    return Many(count, triangles, more, {name: size / (many - few) for name, size in grown.items()})


def run(count: int, kind: str, around: int, picture: str) -> None:
    """Print the table."""
    found = measured(count, kind, around, picture)
    print(f"{count} places of a {kind} of {found.triangles} triangles")
    print(f"{'':<8} {'seconds':>8} {'of CPU':>8} {'MiB held':>9} {'MiB peak':>9}")
    for name, mark in found.steps.items():
        print(f"{name:<8} {mark.seconds:8.2f} {mark.computed:8.2f} {mark.held / 2**20:9.0f} {mark.peak / 2**20:9.0f}")
    for step, what in (("load", "at its peak"), ("tables", "held"), ("second", "at the peak")):
        print(f"{step:<8} {found.grown[step]:8.0f} bytes {what} for each place")


def main() -> None:
    """A process of `run`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("stage")
    parser.add_argument("picture")
    arguments = parser.parse_args()
    measure(arguments.stage, arguments.picture)


if __name__ == "__main__":
    main()
