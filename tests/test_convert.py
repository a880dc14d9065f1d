"""`refract convert`: what it adds, what it leaves, and where it writes."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from pxr import Sdf, Usd, UsdShade
from typer.testing import CliRunner

from refract_core.cli import app
from refract_core.errors import Cancelled, RefractError, StageError, UsageError
from refract_core.scene import Material, Model, Param, Scene
from refract_core.usd.stage import load_stage
from refract_core.verbs.convert import ConvertOrder, Row, convert

HEAD = '#usda 1.0\n(\n    defaultPrim = "W"\n    metersPerUnit = {unit}\n    upAxis = "Z"\n)\n'
BOUND = '(prepend apiSchemas = ["MaterialBindingAPI"])'


def block(head: str, *lines: str) -> str:
    return "\n".join((head, "{", *lines, "}"))


def ball(name: str, material: str, radius: float, *more: str) -> str:
    bind = f"rel material:binding = </W/Looks/{material}>"
    return block(f'def Sphere "{name}" {BOUND}', f"double radius = {radius}", bind, *more)


def pane(name: str, material: str) -> str:
    return block(f'def Plane "{name}" {BOUND}', f"rel material:binding = </W/Looks/{material}>")


def cone(name: str, material: str) -> str:
    return block(f'def Cone "{name}" {BOUND}', f"rel material:binding = </W/Looks/{material}>")


def glass(name: str, *inputs: str, head: str = "", lines: tuple[str, ...] = ()) -> str:
    surface = f"token outputs:surface.connect = </W/Looks/{name}/S.outputs:surface>"
    identifier = 'uniform token info:id = "UsdPreviewSurface"'
    inputs = inputs or ("float inputs:opacity = 0", "float inputs:ior = 1.4", "float inputs:roughness = 0.1")
    shader = block('def Shader "S"', identifier, *inputs, "token outputs:surface")
    return block(f'def Material "{name}" {head}', surface, *lines, shader)


def stage(folder: Path, materials: list[str], prims: list[str], *, unit: float = 1.0, name: str = "in.usda") -> str:
    path = folder / name
    inside = block('def Xform "W"', block('def Scope "Looks"', *materials), *prims)
    path.write_text(f"{HEAD.format(unit=unit)}{inside}\n")
    return str(path)


def run(path: str, out: Path | str, **options: Any) -> dict[str, Row]:
    found = convert(ConvertOrder(stage=path, out=str(out), **options))
    return {row.path.rsplit("/", 1)[-1]: row for row in found.rows}


def material(scene: Scene, name: str) -> Material:
    (found,) = {m.name: m for m in scene.materials if m.name.endswith(f"/{name}")}.values()
    return found


def several(folder: Path) -> str:
    opaque = glass("Wall", "color3f inputs:diffuseColor = (0.2, 0.3, 0.4)")
    materials = [glass("Ball"), glass("Pane"), glass("Cone"), opaque]
    return stage(folder, materials, [ball("A", "Ball", 0.3), pane("B", "Pane"), cone("C", "Cone"), pane("D", "Wall")])


def test_the_model_follows_the_shape_and_nothing_else_changes(tmp_path: Path) -> None:
    path, out = several(tmp_path), tmp_path / "out.usda"
    rows = run(path, out)
    assert {name: row.model for name, row in rows.items()} == {"Ball": "sphere", "Pane": "thin", "Cone": "traced"}
    before, after = load_stage(path), load_stage(out)
    assert {m.name for m in before.materials} == {m.name for m in after.materials}
    for name, row in rows.items():
        old, new = material(before, name), material(after, name)
        assert new.model is Model[row.model.upper()]
        for param in Param:
            if param is not Param.THICKNESS:
                assert new.inputs[param] == old.inputs[param]
    assert material(after, "Ball").inputs[Param.THICKNESS].value[0] == pytest.approx(0.6, rel=1e-5)
    assert material(after, "Wall") == material(before, "Wall")


def test_what_was_guessed_right_comes_out_the_same(tmp_path: Path) -> None:
    path, out = several(tmp_path), tmp_path / "out.usda"
    run(path, out)
    before, after = load_stage(path), load_stage(out)
    for name in ("Pane", "Cone"):
        old, new = material(before, name), material(after, name)
        assert (new.model, new.abbe, new.inputs[Param.IOR]) == (old.model, old.abbe, old.inputs[Param.IOR])
        assert new.absorption_distance == pytest.approx(old.absorption_distance)


def opinions(path: str | Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    opened = Usd.Stage.Open(str(path))
    for prim in opened.Traverse():
        found[str(prim.GetPath())] = prim.GetTypeName()
        for attribute in prim.GetAuthoredAttributes():
            found[str(attribute.GetPath())] = (attribute.Get(), attribute.GetConnections())
        for relationship in prim.GetAuthoredRelationships():
            found[str(relationship.GetPath())] = relationship.GetTargets()
    return found


@pytest.mark.parametrize("options", [{}, {"flatten": True}, {"to": "preview"}, {"to": "gltf"}, {"model": "thin"}])
def test_every_authored_opinion_is_still_there(tmp_path: Path, options: dict[str, Any]) -> None:
    path, out = several(tmp_path), tmp_path / "out.usda"
    run(path, out, **options)
    before, after = opinions(path), opinions(out)
    assert {key: after.get(key) for key in before} == before


@pytest.mark.parametrize("source", ["usda", "usdc", "usdz"])
@pytest.mark.parametrize("target", ["usd", "usda", "usdc", "usdz"])
def test_every_format_to_every_format(tmp_path: Path, source: str, target: str) -> None:
    path = several(tmp_path)
    first = tmp_path / f"first.{source}"
    run(path, first, only=("/W/Looks/Ball",))
    rows = run(str(first), tmp_path / f"second.{target}")
    assert rows["Ball"].action == "kept"
    after = load_stage(tmp_path / f"second.{target}")
    assert material(after, "Ball").model is Model.SPHERE
    assert material(after, "Pane").model is Model.THIN
    assert material(after, "Cone").inputs[Param.IOR].value[0] == pytest.approx(1.4)


def test_a_material_that_has_the_schema_is_left_alone(tmp_path: Path) -> None:
    applied = glass("Own", head='(prepend apiSchemas = ["RefractMaterialAPI"])',
                    lines=('uniform token refraction:model = "box"', "float inputs:refraction:ior = 1.7"))  # fmt: skip
    path, out = stage(tmp_path, [applied], [ball("A", "Own", 1.0)]), tmp_path / "out.usda"
    row = run(path, out)["Own"]
    assert row.action == "kept"
    assert "already" in row.why
    layer = Sdf.Layer.FindOrOpen(str(out))
    assert not layer.rootPrims


def test_attributes_authored_without_the_schema_are_kept(tmp_path: Path) -> None:
    half = glass("Half", lines=("float inputs:refraction:ior = 1.7",))
    path, out = stage(tmp_path, [half], [ball("A", "Half", 1.0)]), tmp_path / "out.usda"
    assert "kept" in " ".join(run(path, out)["Half"].notes)
    assert material(load_stage(out), "Half").inputs[Param.IOR].value[0] == pytest.approx(1.7)


def test_flatten_needs_nothing_below_it(tmp_path: Path) -> None:
    path, out = several(tmp_path), tmp_path / "out.usdc"
    run(path, out, flatten=True)
    Path(path).unlink()
    assert not Sdf.Layer.FindOrOpen(str(out)).subLayerPaths
    assert material(load_stage(out), "Ball").model is Model.SPHERE


@pytest.mark.parametrize("flatten", [False, True])
def test_a_package_names_no_folder_of_the_machine_that_made_it(tmp_path: Path, flatten: bool) -> None:
    source, out = tmp_path / "here", tmp_path / "there" / "out.usdz"
    for folder in (source / "tiles", out.parent):
        folder.mkdir(parents=True)
    for number in (1001, 1002):
        (source / "tiles" / f"a.{number}.png").write_bytes(b"tile")
    files = ("./tiles/a.<UDIM>.png", "./lost/b.png", "lost/c.png", "./lost/d.<UDIM>.png", "./tiles")
    lines = tuple(f"asset inputs:file{number} = @{file}@" for number, file in enumerate(files))
    path = stage(source, [glass("Glass", lines=lines)], [ball("A", "Glass", 1.0)])
    run(path, out, flatten=flatten)
    opened = Usd.Stage.Open(str(out))
    text = "".join(layer.ExportToString() for layer in opened.GetUsedLayers())
    assert str(tmp_path) not in text.replace(str(out), "")
    assert "root layer" not in text
    assert opened.GetRootLayer().customLayerData["refract"] == {"made": "convert", "stage": "in.usda"}
    with zipfile.ZipFile(out) as package:
        assert sum(name.endswith((".1001.png", ".1002.png")) for name in package.namelist()) == 2


def test_the_input_is_never_written(tmp_path: Path) -> None:
    path = several(tmp_path)
    before = Path(path).read_bytes()
    run(path, tmp_path / "out.usda")
    assert Path(path).read_bytes() == before
    with pytest.raises(UsageError, match="never changed"):
        run(path, path, overwrite=True)


def test_an_existing_file_stays_unless_told(tmp_path: Path) -> None:
    path, out = several(tmp_path), tmp_path / "out.usda"
    out.write_text("mine")
    with pytest.raises(UsageError, match="--overwrite"):
        run(path, out)
    assert out.read_text() == "mine"
    run(path, out, overwrite=True)
    assert out.read_text().startswith("#usda")


def test_cancelled_leaves_nothing(tmp_path: Path) -> None:
    path, out = several(tmp_path), tmp_path / "out.usda"
    with pytest.raises(Cancelled):
        convert(ConvertOrder(stage=path, out=str(out)), cancel=lambda: True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["in.usda"]


@pytest.mark.parametrize(
    ("only", "kept"),
    [("/W/Looks/Ball", {"Ball"}), ("/W/Looks/*n*", {"Pane", "Cone"}), ("/W", {"Ball", "Pane", "Cone"})],
)
def test_only_what_is_named(tmp_path: Path, only: str, kept: set[str]) -> None:
    assert set(run(several(tmp_path), tmp_path / "out.usda", only=(only,))) == kept


def test_words_that_make_no_sense(tmp_path: Path) -> None:
    path, out = several(tmp_path), tmp_path / "out.usda"
    for options in ({"model": "ball"}, {"thickness": "guessed"}, {"to": "mdl"}, {"only": ("/W/Nothing",)}):
        with pytest.raises(UsageError):
            run(path, out, **options)
    with pytest.raises(StageError, match="no such file"):
        run(str(tmp_path / "none.usda"), out)
    assert not out.exists()


def test_model_overrides_the_shape(tmp_path: Path) -> None:
    rows = run(several(tmp_path), tmp_path / "out.usda", model="sphere")
    assert {row.model for row in rows.values()} == {"sphere"}
    assert {row.why for row in rows.values()} == {"--model"}
    assert rows["Ball"].thickness == pytest.approx(0.6, rel=1e-5)


def test_shapes_of_different_size_get_their_own_thickness(tmp_path: Path) -> None:
    order = 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]'
    small = ("double3 xformOp:translate = (4, 0, 0)", "double3 xformOp:scale = (1, 1, 1)", order)
    scaled = ("double3 xformOp:translate = (8, 0, 0)", "double3 xformOp:scale = (3, 3, 3)", order)
    prims = [ball("A", "Glass", 1.0), ball("B", "Glass", 0.5, *small), ball("C", "Glass", 0.5, *scaled)]
    path, out = stage(tmp_path, [glass("Glass")], prims, unit=0.01), tmp_path / "out.usda"
    row = run(path, out)["Glass"]
    assert row.model == "sphere"
    assert row.thickness == pytest.approx(2.0, rel=1e-5)
    found = {s.path: float(s.primvars["refraction:thickness"][0, 0, 0]) for s in load_stage(out).spheres}
    assert found == pytest.approx({"/W/A": 2.0, "/W/B": 1.0, "/W/C": 3.0}, rel=1e-5)


def test_shapes_that_want_different_models_are_traced(tmp_path: Path) -> None:
    path = stage(tmp_path, [glass("Glass")], [ball("A", "Glass", 1.0), pane("B", "Glass")])
    row = run(path, tmp_path / "out.usda")["Glass"]
    assert row.model == "traced"
    assert "1 sphere, 1 thin" in row.why
    assert any("/W/B" in note for note in row.notes)


def test_glass_on_nothing_is_traced(tmp_path: Path) -> None:
    row = run(stage(tmp_path, [glass("Glass")], []), tmp_path / "out.usda")["Glass"]
    assert (row.model, row.shapes) == ("traced", 0)


SUBSETS = block(
    f'def Mesh "M" {BOUND}',
    "point3f[] points = [(-1,-1,-1),(1,-1,-1),(-1,1,-1),(1,1,-1),(-1,-1,1),(1,-1,1),(-1,1,1),(1,1,1)]",
    "int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]",
    "int[] faceVertexIndices = [1,3,7,5, 2,0,4,6, 3,2,6,7, 0,1,5,4, 4,5,7,6, 2,3,1,0]",
    'uniform token subdivisionScheme = "none"',
    'uniform token subsetFamily:materialBind:familyType = "partition"',
    block(f'def GeomSubset "Label" {BOUND}', 'uniform token elementType = "face"', "int[] indices = [0]",
          'uniform token familyName = "materialBind"', "rel material:binding = </W/Looks/Label>"),
    block(f'def GeomSubset "Glass" {BOUND}', 'uniform token elementType = "face"', "int[] indices = [1, 2, 3, 4, 5]",
          'uniform token familyName = "materialBind"', "rel material:binding = </W/Looks/Glass>"),
)  # fmt: skip


def test_a_part_of_a_closed_mesh_is_traced_through_the_mesh(tmp_path: Path) -> None:
    path = stage(tmp_path, [glass("Glass"), glass("Label", "float inputs:roughness = 1")], [SUBSETS])
    row = run(path, tmp_path / "out.usda")["Glass"]
    assert (row.model, row.why) == ("traced", "an open part of a closed mesh")


def instanced(folder: Path, *, local: bool) -> str:
    """Two instances of a ball with its own material: of a class in the same file, or of another file."""
    inner = [glass("Glass").replace("/W/Looks", "/Proto"), ball("A", "Glass", 1.0).replace("/W/Looks", "/Proto")]
    proto = block('class Xform "Proto"' if local else 'def Xform "Proto"', *inner)
    (folder / "part.usda").write_text(f"{HEAD.format(unit=1.0)}{proto}\n")
    arc = "inherits = </Proto>" if local else "prepend references = @./part.usda@</Proto>"
    pair = [block(f'def Xform "I{n}" (\ninstanceable = true\n{arc}\n)') for n in (1, 2)]
    path = folder / "in.usda"
    path.write_text("\n".join((HEAD.format(unit=1.0), proto if local else "", block('def Xform "W"', *pair), "")))
    return str(path)


def test_instances_of_a_local_class_are_reached_at_their_source(tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    assert run(instanced(tmp_path, local=True), out)["Glass"].action == "applied"
    assert {m.model for m in load_stage(out).materials if m.name.endswith("Glass")} == {Model.SPHERE}


def test_instances_of_another_file_need_flatten(tmp_path: Path) -> None:
    path, out = instanced(tmp_path, local=False), tmp_path / "out.usda"
    row = run(path, out)["Glass"]
    assert row.action == "skipped"
    assert "--flatten" in row.why
    assert run(path, out, flatten=True, overwrite=True)["Glass"].action == "applied"
    assert {m.model for m in load_stage(out).materials if m.name.endswith("Glass")} == {Model.SPHERE}


def test_one_prim_drawn_in_several_sizes_is_traced(tmp_path: Path) -> None:
    inner = block('def Scope "P"', ball("A", "Glass", 1.0))
    instancer = block(
        'def PointInstancer "I"', "rel prototypes = </W/I/P/A>", "int[] protoIndices = [0, 0]",
        "point3f[] positions = [(0, 0, 0), (9, 0, 0)]", "float3[] scales = [(1, 1, 1), (2, 2, 2)]", inner,
    )  # fmt: skip
    row = run(stage(tmp_path, [glass("Glass")], [instancer]), tmp_path / "out.usda")["Glass"]
    assert row.model == "traced"
    assert "several sizes" in row.why


PLAIN = """
import sys
from pxr import Usd, UsdValidation
stage = Usd.Stage.Open(sys.argv[1])
prim = stage.GetPrimAtPath("/W/Looks/Ball")
print(prim.GetAttribute("refraction:model").Get(), round(prim.GetAttribute("inputs:refraction:thickness").Get(), 4))
registry = UsdValidation.ValidationRegistry()
context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
for error in context.Validate(stage):
    print(error.GetIdentifier(), error.GetMessage())
"""


def plain(path: Path | str) -> list[str]:
    """What usd-core alone makes of a stage, in a process where our schemas are not registered."""
    words = [sys.executable, "-c", PLAIN, str(path)]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()


@pytest.mark.parametrize("name", ["out.usda", "flat.usdc", "out.usdz"])
def test_plain_usd_core_opens_it_and_finds_nothing_wrong(tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    run(several(tmp_path), out, flatten=name.startswith("flat"), to="preview")
    assert plain(out) == ["sphere 0.6"]


def test_measured_thickness_is_what_the_geometry_says(tmp_path: Path) -> None:
    """A ball of radius 0.3 is 0.6 thick along every normal."""
    out = tmp_path / "out.usda"
    run(several(tmp_path), out, thickness="measured")
    scene = load_stage(str(out))
    (ball_read,) = scene.spheres
    assert ball_read.primvars["refraction:thickness"].ravel() == pytest.approx(0.6, rel=0.02)


def test_the_command_prints_a_table_or_json(tmp_path: Path) -> None:
    path, runner = several(tmp_path), CliRunner()
    table = runner.invoke(app, ["convert", path, str(tmp_path / "a.usda")])
    assert table.exit_code == 0
    line = next(line for line in table.stdout.splitlines() if line.startswith("/W/Looks/Ball"))
    assert line.split()[:5] == ["/W/Looks/Ball", "UsdPreviewSurface", "sphere", "1.4", "0.6"]
    found = runner.invoke(app, ["convert", path, str(tmp_path / "b.usda"), "--json", "--only", "/W/Looks/Cone"])
    (row,) = json.loads(found.stdout)["materials"]
    assert (row["path"], row["model"], row["ior"]) == ("/W/Looks/Cone", "traced", 1.4)
    again = runner.invoke(app, ["convert", path, str(tmp_path / "a.usda")])
    assert again.exit_code == 2


def test_every_real_stage_goes_through(assets: Path, tmp_path: Path) -> None:
    files = [file for kind in ("usd", "usda", "usdc", "usdz") for file in sorted(assets.rglob(f"*.{kind}"))]
    done = 0
    for number, file in enumerate(files):
        out = tmp_path / f"{number}.usda"
        try:
            found = convert(ConvertOrder(stage=str(file), out=str(out)))
        except RefractError:
            assert not out.exists()
            continue
        done += 1
        after = Usd.Stage.Open(str(out))
        for row in found.rows:
            if row.action == "applied":
                assert UsdShade.Material(after.GetPrimAtPath(row.path)).GetPrim().HasAttribute("refraction:model")
    assert done > 0.9 * len(files)
