"""What a person changes about a stage as it is opened: session layer, variants and mask, in every command alike."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdShade
from typer.testing import CliRunner, Result

from refract_core.cli import app
from refract_core.errors import UsageError
from refract_core.settings import AS_IT_IS, Opening
from refract_core.usd.stage import open_stage, scene_from_stage

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
)
def Xform "World" (
    prepend variantSets = "size"
    variants = { string size = "small" }
)
{
    def Xform "Left"
    {
        def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            rel material:binding = </Looks/Glass>
        }
    }
    def Sphere "Right"
    {
        double3 xformOp:translate = (5, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    variantSet "size" = {
        "small" {
            over "Right" { double radius = 1 }
        }
        "large" (prepend variantSets = "kind") {
            over "Right" { double radius = 2 }
            variantSet "kind" = {
                "round" { over "Left" { def Sphere "Extra" { double radius = 3 } } }
            }
        }
    }
}
def Scope "Looks"
{
    def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"])
    {
        float inputs:refraction:ior = 1.33
        token outputs:surface.connect = </Shaders/Surface.outputs:surface>
    }
    def Material "Other" {}
}
def Scope "Shaders"
{
    def Shader "Surface"
    {
        uniform token info:id = "UsdPreviewSurface"
        token outputs:surface
    }
}
"""
SESSION = """#usda 1.0
(
    metersPerUnit = 0.5
    startTimeCode = 7
)
over "World" { over "Right" { double radius = 4 } }
"""


@pytest.fixture
def stage(tmp_path: Path) -> str:
    path = tmp_path / "stage.usda"
    path.write_text(STAGE.replace("{ ", "{\n").replace(" }", "\n}"))
    return str(path)


@pytest.fixture
def session(tmp_path: Path) -> str:
    path = tmp_path / "session.usda"
    path.write_text(SESSION.replace("{ ", "{\n").replace(" }", "\n}"))
    return str(path)


def radius(opened: Usd.Stage, path: str = "/World/Right") -> float:
    return float(opened.GetAttributeAtPath(f"{path}.radius").Get())


def refract(*words: object) -> Result:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


# --- the three ------------------------------------------------------------------------------------------------------


def test_nothing_asked_changes_nothing(stage: str) -> None:
    assert open_stage(stage, AS_IT_IS).Flatten().ExportToString() == open_stage(stage).Flatten().ExportToString()


def test_a_variant_is_chosen_over_the_stage_s_own(stage: str) -> None:
    assert radius(open_stage(stage)) == 1.0
    assert radius(open_stage(stage, Opening(variants=("/World{size=large}",)))) == 2.0
    assert radius(open_stage(stage, Opening(variants=("{size=large}",)))) == 2.0  # of the default prim


def test_a_variant_may_be_inside_another(stage: str) -> None:
    opened = open_stage(stage, Opening(variants=("/World{size=large}", "/World{kind=round}")))
    assert radius(opened, "/World/Left/Extra") == 3.0


def test_a_session_layer_is_stronger_than_the_stage_also_in_its_metadata(stage: str, session: str) -> None:
    opened = open_stage(stage, Opening(session_layer=session))
    assert radius(opened) == 4.0
    scene = scene_from_stage(opened)
    assert (scene.metres_per_unit, scene.time_code) == (0.5, 7.0)


def test_a_session_layer_is_stronger_than_a_chosen_variant_s_opinions(stage: str, session: str) -> None:
    assert radius(open_stage(stage, Opening(session_layer=session, variants=("/World{size=large}",)))) == 4.0


def test_nothing_is_written_into_the_session_layer(stage: str, session: str) -> None:
    before = hashlib.sha256(Path(session).read_bytes()).digest()
    open_stage(stage, Opening(session_layer=session, variants=("/World{size=large}",)))
    layer = Sdf.Layer.FindOrOpen(session)
    assert not layer.dirty
    assert hashlib.sha256(Path(session).read_bytes()).digest() == before


def test_a_session_layer_that_has_changed_is_read_anew(stage: str, session: str) -> None:
    held = open_stage(stage, Opening(session_layer=session))
    path = Path(session)
    path.write_text(path.read_text().replace("radius = 4", "radius = 0.25"))
    assert radius(open_stage(stage, Opening(session_layer=session))) == 0.25
    assert held


def test_a_mask_keeps_what_it_names_and_what_that_is_made_of(stage: str) -> None:
    opened = open_stage(stage, Opening(mask=("/World/Left",)))
    assert opened.GetPrimAtPath("/World/Left/Ball")
    assert not opened.GetPrimAtPath("/World/Right")
    material, _ = UsdShade.MaterialBindingAPI(opened.GetPrimAtPath("/World/Left/Ball")).ComputeBoundMaterial()
    assert material.GetPath() == "/Looks/Glass"
    assert material.ComputeSurfaceSource("")[0]  # which is outside of the material
    assert not opened.GetPrimAtPath("/Looks/Other")


def test_what_a_masked_stage_draws_is_a_part_of_what_the_whole_one_does(stage: str) -> None:
    whole = scene_from_stage(open_stage(stage))
    part = scene_from_stage(open_stage(stage, Opening(mask=("/World/Left",))))
    assert {ball.path for ball in whole.spheres} == {"/World/Left/Ball", "/World/Right"}
    (ball,) = part.spheres
    name = {material.name: material for material in whole.materials}["/Looks/Glass"]
    assert part.materials[ball.material].inputs == name.inputs


def test_a_mask_may_name_what_only_a_chosen_variant_has(stage: str) -> None:
    variants = ("/World{size=large}", "/World{kind=round}")
    opened = open_stage(stage, Opening(variants=variants, mask=("/World/Left/Extra",)))
    assert [ball.path for ball in scene_from_stage(opened).spheres] == ["/World/Left/Extra"]


# --- what cannot be -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("opening", "words"),
    [
        (
            Opening(variants=("/World{size=huge}",)),
            ["--variant '/World{size=huge}'", "no 'huge'; choose from", "small", "large"],
        ),
        (Opening(variants=("/World{shape=x}",)), ["--variant '/World{shape=x}'", "no set 'shape'", "the sets size"]),
        (Opening(variants=("/World/Left{size=x}",)), ["--variant '/World/Left{size=x}'", "no set 'size'", "(none)"]),
        (Opening(variants=("/Nope{size=x}",)), ["--variant '/Nope{size=x}'", "no such prim", "/World{size=...}"]),
        (Opening(variants=("/World size=x",)), ["--variant '/World size=x'", "/Prim{set=name}"]),
        (Opening(variants=("/Wor ld{a=b}",)), ["--variant '/Wor ld{a=b}'", "/Prim{set=name}"]),
        (Opening(mask=("/World/Nope",)), ["--mask /World/Nope", "no such prim", "/World has", "Left", "Right"]),
        (Opening(mask=("/Nope/Nope",)), ["--mask /Nope/Nope", "no such prim", "World, Looks, Shaders"]),
        (Opening(mask=("World",)), ["--mask World", "no prim path"]),
        (Opening(mask=("/World.radius",)), ["--mask /World.radius", "no prim path"]),
        (Opening(session_layer="gone.usda"), ["--session-layer gone.usda", "no such file"]),
    ],
)
def test_what_is_not_there_is_one_sentence_with_flag_and_choice(opening: Opening, words: list[str], stage: str) -> None:
    with pytest.raises(UsageError) as error:
        open_stage(stage, opening)
    said = str(error.value)
    assert said.startswith(words[0])
    assert all(word in said for word in words), said
    assert "\n" not in said


def test_a_mask_of_commas_is_no_path(stage: str) -> None:
    result = refract("inspect", stage, "--mask", " , ")
    assert result.exit_code == 2
    assert "--mask  , : is no prim path" in result.stderr


def test_a_session_layer_that_is_no_layer_is_named(stage: str, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.usda"
    wrong.write_text("nothing of USD")
    with pytest.raises(UsageError, match=rf"^--session-layer {wrong}: cannot be read"):
        open_stage(stage, Opening(session_layer=str(wrong)))


# --- in the commands ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        ("render", "STAGE", "OUT.png"), ("inspect", "STAGE"), ("validate", "STAGE"), ("compare", "STAGE", "OUT"),
        ("convert", "STAGE", "OUT.usda"), ("bake", "probes", "STAGE", "OUT.usda"),
        ("bake", "thickness", "STAGE", "OUT.usda"),
    ],
    ids=lambda words: "-".join(word for word in words if word.islower()),
)  # fmt: skip
@pytest.mark.parametrize(
    ("flag", "value"), [("--variant", "/World{size=huge}"), ("--session-layer", "gone.usda"), ("--mask", "/Nope")]
)
def test_every_command_that_opens_a_stage_has_the_three(
    command: tuple[str, ...], flag: str, value: str, stage: str, tmp_path: Path
) -> None:
    words = [word.replace("STAGE", stage).replace("OUT", str(tmp_path / "out")) for word in command]
    result = refract(*words, flag, value)
    assert result.exit_code == 2
    assert f"{flag} " in result.stderr.strip().splitlines()[-1]
    assert not list(tmp_path.glob("out*"))


def test_camel_case_is_another_spelling_of_the_same_options(stage: str, session: str, tmp_path: Path) -> None:
    """usdrecord has --sessionLayer, --imageWidth and --disableCameraLight."""
    result = refract("inspect", stage, "--sessionLayer", session, "--json")
    assert json.loads(result.stdout)["metres_per_unit"] == 0.5
    words = ("render", stage, tmp_path / "a.png", "--imageWidth", "0", "--disableCameraLight")
    assert "image-width" in refract(*words).stderr


def test_an_option_that_nobody_has_is_still_refused(stage: str) -> None:
    assert refract("inspect", stage, "--sessionlayer", "x").exit_code == 2


def test_a_flat_conversion_holds_what_was_chosen(stage: str, session: str, tmp_path: Path) -> None:
    out = tmp_path / "flat.usda"
    words = ("convert", stage, out, "--flatten", "--variant", "/World{size=large}", "--session-layer", session)
    assert refract(*words).exit_code == 0
    assert radius(open_stage(out)) == 4.0
    assert "size" not in open_stage(out).GetPrimAtPath("/World").GetVariantSets().GetNames()


IN_A_VARIANT = """#usda 1.0
( defaultPrim = "W" )
def Xform "W" (
    prepend variantSets = "show"
    variants = { string show = "nothing" }
)
{
    variantSet "show" = {
        "nothing" {
        }
        "ball" {
            def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
            {
                rel material:binding = </W/Glass>
            }
            def Material "Glass"
            {
                token outputs:surface.connect = </W/Glass/S.outputs:surface>
                def Shader "S"
                {
                    uniform token info:id = "UsdPreviewSurface"
                    float inputs:opacity = 0.1
                    token outputs:surface
                }
            }
        }
    }
}
"""


@pytest.mark.parametrize("flat", [(), ("--flatten",)], ids=["layer", "flat"])
@pytest.mark.parametrize("more", [("--to", "openpbr"), ("--thickness", "measured")], ids="=".join)
def test_a_conversion_writes_what_only_a_chosen_variant_has(
    flat: tuple[str, ...], more: tuple[str, ...], tmp_path: Path
) -> None:
    """Whatever is written after the glass is found opens the stage once more, as it was opened before."""
    (tmp_path / "in.usda").write_text(IN_A_VARIANT)
    chosen = Opening(variants=("/W{show=ball}",))
    result = refract(
        "convert", tmp_path / "in.usda", tmp_path / "out.usda", "--variant", *chosen.variants, *flat, *more
    )
    assert result.exit_code == 0, result.stderr
    made = open_stage(str(tmp_path / "out.usda"), AS_IT_IS if flat else chosen)
    if "--to" in more:
        glass = UsdShade.Material(made.GetPrimAtPath("/W/Glass"))
        assert glass.ComputeSurfaceSource("mtlx")[0].GetShaderId() == "ND_open_pbr_surface_surfaceshader"
    else:
        assert made.GetPrimAtPath("/W/Ball").GetAttribute("primvars:refraction:thickness").HasAuthoredValue()


@pytest.mark.parametrize("opening", [("--variant", "/W{a=b}"), ("--session-layer", "gone.usda"), ("--mask", "/W")])
def test_a_gltf_file_is_no_stage_to_open_in_another_way(opening: tuple[str, str], tmp_path: Path) -> None:
    (tmp_path / "in.gltf").write_text('{"asset": {"version": "2.0"}}')
    result = refract("convert", tmp_path / "in.gltf", tmp_path / "out.usda", *opening)
    assert result.exit_code == 2
    assert opening[0] in result.stderr
    assert "leave them out" in result.stderr
    assert not (tmp_path / "out.usda").exists()
