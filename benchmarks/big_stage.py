"""Seconds for the verbs that do not render, on a stage of 10,000 materials and 100,000 prims.

    python -m benchmarks.big_stage [--materials 10000] [--prims 100000] [--glass 10] [--verbs inspect,validate]
    python -m benchmarks.big_stage --instances 1000000 [--kind leaf|crystal] [--around 32] [--picture OUT.png]

Every mesh is a closed box of 12 triangles; one material in `--glass` is glass. Each verb runs in a process of its
own, from its start to its last word. Beside it stands what usd-core alone takes for the same stage: open it, ask
every prim for its place and every mesh for its material, read the glass, and do nothing with it. `--instances` is
another stage, of one mesh in many places, and is drawn (`benchmarks.instanced`).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

import schemas

from . import instanced

VERBS = {
    "inspect": ["inspect", "STAGE", "--json"],
    "validate": ["validate", "STAGE", "--json"],
    "convert": ["convert", "STAGE", "OUT"],
}
_POINTS = [(x, y, z) for z in (-0.4, 0.4) for y in (-0.4, 0.4) for x in (-0.4, 0.4)]
_FACES = [1, 3, 7, 5, 2, 0, 4, 6, 3, 2, 6, 7, 0, 1, 5, 4, 4, 5, 7, 6, 2, 3, 1, 0]


def make(path: Path, materials: int, prims: int, glass: int) -> None:
    """Write the stage: a folder of materials with a shader each, and meshes with a transform each."""
    schemas.register()
    layer = Sdf.Layer.CreateNew(str(path))
    with Sdf.ChangeBlock():
        for place in ("/World", "/World/Looks"):
            Sdf.CreatePrimInLayer(layer, place).specifier = Sdf.SpecifierDef
        layer.defaultPrim = "World"
        for number in range(materials):
            _material(layer, f"/World/Looks/M{number}", is_glass=number % glass == 0)
        for number in range((prims - 2 * materials - 2) // 2):
            _mesh(layer, f"/World/X{number}", number, f"/World/Looks/M{number % materials}")
    layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    layer.pseudoRoot.SetInfo("upAxis", "Y")
    layer.Save()


def _prim(layer: Sdf.Layer, path: str, kind: str) -> Sdf.PrimSpec:
    spec = Sdf.CreatePrimInLayer(layer, path)
    spec.specifier, spec.typeName = Sdf.SpecifierDef, kind
    return spec


def _attribute(
    spec: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName, value: object, *, uniform: bool = False
) -> Sdf.AttributeSpec:
    variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
    attribute = Sdf.AttributeSpec(spec, name, kind, variability)
    if value is not None:
        attribute.default = value
    return attribute


def _material(layer: Sdf.Layer, path: str, *, is_glass: bool) -> None:
    types = Sdf.ValueTypeNames
    material, shader = _prim(layer, path, "Material"), _prim(layer, f"{path}/Surface", "Shader")
    _attribute(shader, "info:id", types.Token, "UsdPreviewSurface", uniform=True)
    _attribute(shader, "outputs:surface", types.Token, None)
    surface = _attribute(material, "outputs:surface", types.Token, None)
    surface.connectionPathList.prependedItems = [Sdf.Path(f"{path}/Surface.outputs:surface")]
    if is_glass:
        _attribute(shader, "inputs:opacity", types.Float, 0.0)
        _attribute(shader, "inputs:ior", types.Float, 1.45)


def _mesh(layer: Sdf.Layer, path: str, number: int, material: str) -> None:
    types = Sdf.ValueTypeNames
    place, mesh = _prim(layer, path, "Xform"), _prim(layer, f"{path}/Box", "Mesh")
    at = Gf.Vec3d(number % 200, number // 200 % 200, number // 40000)
    _attribute(place, "xformOp:translate", types.Double3, at)
    _attribute(place, "xformOpOrder", types.TokenArray, ["xformOp:translate"], uniform=True)
    _attribute(mesh, "points", types.Point3fArray, _POINTS)
    _attribute(mesh, "extent", types.Float3Array, [(-0.4, -0.4, -0.4), (0.4, 0.4, 0.4)])
    _attribute(mesh, "faceVertexCounts", types.IntArray, [4] * 6)
    _attribute(mesh, "faceVertexIndices", types.IntArray, _FACES)
    _attribute(mesh, "subdivisionScheme", types.Token, "none", uniform=True)
    mesh.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"]))
    binding = Sdf.RelationshipSpec(mesh, "material:binding", custom=False)
    binding.targetPathList.explicitItems = [Sdf.Path(material)]


def usd_alone(path: Path) -> dict[str, float]:
    """Seconds of usd-core for what `inspect` cannot do without, asked in plain loops that use no answer.

    Every prim for its visibility, purpose and transform; every mesh for its material; every material for its shader
    and what is authored on that; the meshes with glass for their triangles.
    """
    schemas.register()
    time_code = Usd.TimeCode(0.0)
    marks = [time.perf_counter()]
    stage = Usd.Stage.Open(str(path))
    marks.append(time.perf_counter())
    prims = list(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    cache, purpose = UsdGeom.XformCache(time_code), UsdGeom.Imageable.PurposeInfo()
    for prim in prims:
        prim.GetAttribute("visibility").Get(time_code)
        if imageable := UsdGeom.Imageable(prim):
            imageable.ComputePurposeInfo(purpose)
        if xformable := UsdGeom.Xformable(prim):
            cache.GetLocalTransformation(prim)
            xformable.TransformMightBeTimeVarying()
    meshes = [prim for prim in prims if prim.IsA(UsdGeom.Gprim)]
    marks.append(time.perf_counter())
    bound, _ = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(meshes, UsdShade.Tokens.full)
    marks.append(time.perf_counter())
    glass = {str(material.GetPath()) for material in bound if _asked_for_opacity(material)}
    marks.append(time.perf_counter())
    for prim, material in zip(meshes, bound, strict=True):
        if str(material.GetPath()) in glass:
            mesh = UsdGeom.Mesh(prim)
            for attribute in (mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()):
                attribute.Get(time_code)
    marks.append(time.perf_counter())
    names = ("open", "prims", "bindings", "materials", "geometry")
    return {name: after - before for name, before, after in zip(names, marks, marks[1:], strict=False)}


def _asked_for_opacity(material: UsdShade.Material) -> bool:
    shader = material.ComputeSurfaceSource("")[0]
    shader.GetShaderId()
    shader.GetPrim().GetAuthoredPropertyNames()
    return bool(shader.GetInput("opacity"))


def seconds_of(verb: str, stage: Path, out: Path) -> tuple[float, float]:
    """One run of a verb in a new process: seconds that passed, and those that it computed."""
    words = [str({"STAGE": stage, "OUT": out}.get(word, word)) for word in VERBS[verb]]
    start, before = time.perf_counter(), os.times()
    command = [sys.executable, "-m", "refract_core.cli", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(f"refract {' '.join(words)} ended with {done.returncode}: {done.stderr.strip()}")
    after = os.times()
    computed = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - start, computed


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--materials", type=int, default=10_000)
    parser.add_argument("--prims", type=int, default=100_000)
    parser.add_argument("--glass", type=int, default=10, help="one material in so many is glass")
    parser.add_argument("--verbs", default="inspect,validate")
    parser.add_argument("--instances", type=int, default=0, help="places of one mesh; the rest is then left out")
    parser.add_argument("--kind", choices=instanced.KINDS, default=instanced.KINDS[0])
    parser.add_argument("--around", type=int, default=32, help="meridians of that mesh; 32 are 960 triangles")
    parser.add_argument("--picture", default="", help="where to save it")
    arguments = parser.parse_args()
    if arguments.instances:
        instanced.run(arguments.instances, arguments.kind, arguments.around, arguments.picture)
        return
    with tempfile.TemporaryDirectory() as folder:
        stage = Path(folder) / "big.usdc"
        make(stage, arguments.materials, arguments.prims, arguments.glass)
        times = {verb: seconds_of(verb, stage, Path(folder) / "out.usdc") for verb in arguments.verbs.split(",")}
        before = time.process_time()
        alone = usd_alone(stage)
        bare = time.process_time() - before
    print(f"{arguments.prims} prims, {arguments.materials} materials, one in {arguments.glass} of them glass")
    parts = ", ".join(f"{name} {seconds:.2f}" for name, seconds in alone.items())
    print(f"usd-core alone {sum(alone.values()):7.2f} s, {bare:6.2f} s of CPU: {parts}")
    for verb, (seconds, computed) in times.items():
        print(f"{verb:<14} {seconds:7.2f} s, {computed:6.2f} s of CPU: {computed / bare:.1f} times usd-core alone")


if __name__ == "__main__":
    main()
