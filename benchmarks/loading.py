"""A stage of many meshes: seconds to read it in USD, to make a scene of it, to lay out its tables and to build Embree's
hierarchy, and what a triangle costs in memory.

    python -m benchmarks.loading [--meshes 1000] [--triangles 1000] [--bare]

Every mesh is a globe with points, normals and texture coordinates, as exporters write them; `--bare` leaves the last
two out. Each size runs in a process of its own, with a tenth of the meshes beside it, so that what a triangle costs is
a difference of two.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from .instanced import Mark, marks_of, told
from .room import globe

STEPS = ("usd", "scene", "tables", "embree")


class Loaded(NamedTuple):
    """A stage, and how it was loaded."""

    meshes: int
    triangles: int
    """of all"""
    steps: dict[str, Mark]
    """usd: what USD alone takes; scene: all of `load_stage`, USD among it; tables; embree"""
    grown: dict[str, float]
    """step -> memory held after it [bytes for each triangle]; peak -> at the peak of all"""


def make(path: Path, meshes: int, triangles: int, *, bare: bool) -> int:
    """Write the stage. Returns the triangles of a mesh."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rings = max(2, round((triangles / 4.0) ** 0.5))
    points, faces = globe(rings, 2 * rings)
    side = max(1, round(meshes ** (1 / 3)))
    rng = np.random.default_rng(0)
    for number in range(meshes):
        mesh = UsdGeom.Mesh.Define(stage, f"/World/Globe{number}")
        at = Gf.Vec3d(number % side, number // side % side, number // side**2)
        UsdGeom.XformCommonAPI(mesh).SetTranslate(at)
        shape = 0.45 * points * rng.uniform(0.8, 1.0, (len(points), 1))  # each its own, or USD keeps one for all
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(shape.astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).reshape(-1)))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        if not bare:
            _dress(mesh, points)
    stage.GetRootLayer().Save()
    return len(faces)


def _dress(mesh: UsdGeom.Mesh, points: np.ndarray) -> None:
    """Normals and texture coordinates, both of points."""
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    st = np.stack([np.arctan2(points[:, 2], points[:, 0]) / (2.0 * np.pi) % 1.0, 0.5 + 0.5 * points[:, 1]], 1)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    primvar.Set(Vt.Vec2fArray.FromNumpy(st.astype(np.float32)))


def usd_alone(path: str) -> int:
    """Open a stage and ask for what a scene is made of. Returns points."""
    stage = Usd.Stage.Open(path)
    cache, found = UsdGeom.XformCache(), 0
    for prim in stage.Traverse():
        cache.GetLocalToWorldTransform(prim)
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            attributes = mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetNormalsAttr()
            for attribute in (*attributes, prim.GetAttribute("primvars:st")):
                attribute.Get() if attribute else None
            found += len(mesh.GetPointsAttr().Get())
    return found


def measure(path: str) -> None:
    """One process: prints seconds and memory of each step."""
    import refract_core as rc
    from refract_core.world import embree, tables

    since = told("start", (time.perf_counter(), time.process_time()))
    usd_alone(path)
    since = told("usd", since)
    scene = rc.load_stage(path)
    since = told("scene", since)
    made = embree.Bvh
    waited: list[tuple[float, float]] = []

    def built(*parts: object) -> embree.Bvh:
        waited.append(told("tables", since))
        return made(*parts)  # type: ignore[arg-type]

    tables.Bvh = built  # type: ignore[assignment,attr-defined]
    kept = tables.pack_geometry(scene)
    told("embree", waited[0])
    del kept


def loaded(meshes: int, triangles: int, *, bare: bool = False, repeat: int = 1) -> Loaded:
    """Make the stage and load it; medians of `repeat` processes."""
    found: list[tuple[int, dict[str, Mark]]] = []
    with tempfile.TemporaryDirectory() as folder:
        for count in (max(1, meshes // 10), meshes):
            stage = Path(folder) / f"{count}.usdc"
            each = make(stage, count, triangles, bare=bare)
            command = [sys.executable, "-m", "benchmarks.loading", "--stage", str(stage)]
            runs = [
                marks_of(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
                for _ in range(repeat)
            ]
            middle = {name: Mark(*map(median, zip(*(run[name] for run in runs), strict=True))) for name in runs[0]}
            found.append((each * count, middle))
    (few, less), (many, more) = found
    grown = {name: (more[name].held - less[name].held) / (many - few) for name in ("scene", "embree")}
    grown["peak"] = (more["embree"].peak - less["embree"].peak) / (many - few)
    return Loaded(meshes, many, {name: more[name] for name in STEPS}, grown)


def main() -> None:
    """Print the numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=int, default=1000)
    parser.add_argument("--triangles", type=int, default=1000, help="of each")
    parser.add_argument("--bare", action="store_true", help="points alone")
    parser.add_argument("--stage", default="", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.stage:
        measure(asked.stage)
        return
    one = loaded(asked.meshes, asked.triangles, bare=asked.bare)
    print(f"{one.meshes} meshes, {one.triangles} triangles")
    for name, mark in one.steps.items():
        print(f"{name:<8} {mark.seconds:7.2f} s {mark.computed:7.2f} s of CPU")
    for name, each in one.grown.items():
        print(f"{name:<8} {each:7.0f} bytes for each triangle")


if __name__ == "__main__":
    main()
