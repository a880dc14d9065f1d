"""`refract compare`: whose pixels are whose, what the report says, and that what is suggested is what was drawn."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import box, glass, material
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import Cancelled, ImageError
from refract_core.files import filling
from refract_core.images.frame import Frame
from refract_core.images.pictures import png_bytes, read_planes
from refract_core.progress import Report
from refract_core.scene import Mesh, Model, Param, Scene, Sphere
from refract_core.usd.stage import load_stage, scene_from_stage
from refract_core.usd.thickness.find import stage_of
from refract_core.verbs import compare_numbers, compare_renders, suggest
from refract_core.verbs.compare_numbers import Contrast, Trial, Trials, correlation
from refract_core.verbs.compare_report import FILES, FORMAT, heat
from refract_core.verbs.owners import NOBODY, Owner, find_owners

pytestmark = pytest.mark.draws

SAMPLES = Path(__file__).parents[1] / "usd_samples" / "good"
SMALL = ["--image-width", "48", "--samples", "1", "--reference-samples", "2", "--jobs", "1"]

# A glass ball before a wall that glows in stripes of many sizes. The model is wrong: a slab bends nothing like a ball.
STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 0.1
    upAxis = "Y"
)
def Xform "World"
{
    def Camera "Camera"
    {
        float focalLength = 50
        float horizontalAperture = 36
        float verticalAperture = 24
        double3 xformOp:translate = (0, 0, 6)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </World/Glass>
        double radius = 1
    }
    def Sphere "Hidden" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </World/Other>
        double radius = 0.2
        double3 xformOp:translate = (0, 0, -1.5)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Mesh "Wall" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </World/Glow>
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 3, 2, 1, 4, 5, 3]
        point3f[] points = [(-6, -6, -3), (0, -6, -3), (-6, 6, -3), (0, 6, -3), (6, -6, -3), (6, 6, -3)]
        uniform token subdivisionScheme = "none"
        def GeomSubset "Right" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            rel material:binding = </World/Ember>
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
        }
    }
    def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"])
    {
        uniform token refraction:model = "MODEL"
        float inputs:refraction:thickness = 2
    }
    def Material "Other" (prepend apiSchemas = ["RefractMaterialAPI"])
    {
        uniform token refraction:model = "traced"
    }
    def Material "Glow"
    {
        token outputs:surface.connect = </World/Glow/Surface.outputs:surface>
        def Shader "Surface"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0, 0, 0)
            color3f inputs:emissiveColor = (0.7, 0.4, 0.1)
            token outputs:surface
        }
    }
    def Material "Ember"
    {
        token outputs:surface.connect = </World/Ember/Surface.outputs:surface>
        def Shader "Surface"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0, 0, 0)
            color3f inputs:emissiveColor = (0.05, 0.1, 0.3)
            token outputs:surface
        }
    }
}
"""


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    path = tmp_path / "stage.usda"
    path.write_text(STAGE.replace("MODEL", "box"), "utf-8")
    return path


def run(*words: object) -> Any:
    return CliRunner().invoke(app, ["compare", *map(str, words)])


def report_in(folder: Path) -> Any:
    return json.loads((folder / "report.json").read_text("utf-8"))


# --- numbers --------------------------------------------------------------------------------------------------------


def test_any_falling_relation_has_rank_correlation_minus_one() -> None:
    error = np.linspace(0.0, 1.0, 50)
    found = correlation(np.exp(-5.0 * error).astype(np.float32), error)
    assert found.spearman == pytest.approx(-1.0)
    assert -1.0 < (found.pearson or 0.0) < -0.8
    assert correlation((1.0 - error).astype(np.float32), error).pearson == pytest.approx(-1.0)


def test_correlation_shares_the_ranks_of_equals() -> None:
    """Ranks 1.5 1.5 3 against 1 2 3: covariance 1.5, variances 1.5 and 2, so sqrt(3) / 2."""
    found = correlation(np.array([0.2, 0.2, 0.9], np.float32), np.array([0.0, 0.1, 0.7]))
    assert found.spearman == pytest.approx(np.sqrt(3.0) / 2.0)


def test_what_is_the_same_everywhere_goes_with_nothing() -> None:
    found = correlation(np.ones(9, np.float32), np.arange(9.0))
    assert (found.pearson, found.spearman) == (None, None)


def test_heat_goes_from_the_first_colour_to_the_last() -> None:
    shown = heat(np.array([[0.0, 0.5, 1.0]], np.float32))
    assert [tuple(color) for color in shown[0].tolist()] == [(0, 0, 4), (181, 54, 122), (252, 253, 191)]
    ramp = heat(np.linspace(0.0, 1.0, 256, dtype=np.float32)[None]).astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(ramp[0]) >= -1.0).all()  # brighter is worse, up to the rounding of one level


def test_pictures_with_nan_are_refused_by_name() -> None:
    good = {"beauty": np.zeros((4, 4, 4), np.float32)}
    bad = {"beauty": np.full((4, 4, 4), np.nan, np.float32)}
    with pytest.raises(rc.UsageError, match=r"b\.exr holds NaN in 16 pixels"):
        Contrast(good, bad, ("a.exr", "b.exr"))


# --- whose pixels ---------------------------------------------------------------------------------------------------


def two_balls() -> Scene:
    """A ball, half of another one behind it, a third behind an opaque box; seen along -Z."""
    eye = np.eye(4)
    eye[2, 3] = 6.0
    camera = rc.scene.Camera("/camera", eye, (-0.5, 0.5, -0.5, 0.5))
    ball, far = glass(Model.SPHERE), glass(Model.TRACED)
    materials = (material("/matt"), ball, rc.scene.Material("/far", far.inputs, far.model))
    spheres = (
        Sphere("/near", (0.0, 0.0, 0.0), 1.0, 1), Sphere("/behind", (1.0, 0.0, -3.0), 1.0, 2),
        Sphere("/covered", (-1.6, 0.0, -3.0), 0.4, 2),
    )  # fmt: skip
    wall = box("/wall", (0.6, 0.6, 0.1), 0, centre=(-1.4, 0.0, -1.5))
    return Scene((wall,), materials, spheres, cameras=(camera,))


def test_a_pixel_belongs_to_the_first_glass_along_its_ray() -> None:
    scene = two_balls()
    found = find_owners(scene, rc.RenderSettings(image_width=64, jobs=1), lambda: False)
    assert found.every == (Owner("/near", "/glass"), Owner("/behind", "/far"), Owner("/covered", "/far"))
    counts = [int(found.pixels(lambda owner, path=path: owner.path == path).sum())  # type: ignore[misc]
              for path in ("/near", "/behind", "/covered")]  # fmt: skip
    # A ball of radius 1 at distance 6 on the axis covers a disk of tangent 1 / sqrt(35), in a window of 1 x 1.
    y, x = (np.indices((64, 64)) + 0.5) / 64 - 0.5
    tangent, pixel = np.hypot(x, y), 1.0 / 64
    assert (found.number[tangent < 35**-0.5 - pixel] == 0).all()
    assert (found.number[tangent > 35**-0.5 + pixel] != 0).all()
    assert 0 < counts[1] < counts[0]
    assert counts[2] == 0
    assert found.number[32, 32] == 0
    assert found.number[0, 0] == NOBODY


def test_owners_and_the_mask_of_one_sample_agree() -> None:
    """The same rays, so the same pixels."""
    scene, settings = two_balls(), rc.RenderSettings(image_width=64, samples=1, jobs=1)
    mask = rc.render(scene, settings).planes["mask"]
    np.testing.assert_array_equal(find_owners(scene, settings, lambda: False).number != NOBODY, mask > 0.0)


# --- files ----------------------------------------------------------------------------------------------------------


def frame() -> Frame:
    random = np.random.default_rng(3)
    planes = {
        "beauty": random.uniform(0.0, 1.0, (6, 8, 4)).astype(np.float32),
        "mask": random.uniform(0.0, 1.0, (6, 8)).astype(np.float32),
        "weight.ray": random.uniform(0.0, 1.0, (6, 8)).astype(np.float32),
    }
    planes["beauty"][..., :3] *= planes["beauty"][..., 3:]
    return Frame(8, 6, planes)


def test_an_exr_is_read_as_it_was_written(tmp_path: Path) -> None:
    made = frame()
    made.save(tmp_path / "a.exr")
    found = read_planes(str(tmp_path / "a.exr"))
    assert set(found) == set(made.planes)
    for name in ("mask", "thickness"):  # half floats too
        if name in made.planes:
            np.testing.assert_allclose(found[name], made.planes[name], rtol=2**-11, atol=1e-7)
    np.testing.assert_allclose(found["beauty"], made.planes["beauty"], rtol=2**-10, atol=1e-6)  # half floats


def test_a_png_is_read_as_the_light_it_shows(tmp_path: Path) -> None:
    made = frame()
    made.save(tmp_path / "a.png")
    found = read_planes(str(tmp_path / "a.png"))["beauty"]
    # A step of 1/255 in sRGB is at most 1.055 * 2.4 / 255 of light.
    np.testing.assert_allclose(found, made.planes["beauty"], atol=0.01)


def test_an_exr_without_colours_is_refused(tmp_path: Path) -> None:
    frame().save(tmp_path / "mask.exr", aovs=("mask",))
    with pytest.raises(ImageError, match="has no channel R"):
        read_planes(str(tmp_path / "mask.exr"))


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def fail() -> None:
        with filling(str(out), (), ImageError) as folder:
            Path(folder, "half").write_text("")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []
    with filling(str(out), (), ImageError) as folder:
        Path(folder, "a").write_text("1")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "a"]


def test_a_folder_that_is_there_keeps_what_is_not_ours(tmp_path: Path) -> None:
    for name in ("a", "b", "notes"):
        (tmp_path / name).write_text("old")
    with filling(str(tmp_path), ("a", "b"), ImageError) as folder:
        Path(folder, "a").write_text("new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "new", "notes": "old"}


# --- the command ----------------------------------------------------------------------------------------------------


def test_a_stage_is_measured_against_its_reference(stage: Path, tmp_path: Path) -> None:
    before = stage.read_bytes()
    done = run(stage, tmp_path / "out", *SMALL)
    assert done.exit_code == 0, done.output
    out = tmp_path / "out"
    found = report_in(out)
    assert found["format"] == FORMAT
    assert {path.name for path in out.iterdir()} == {*FILES} - (set() if found["glass"]["flip"] else {"flip.png"})
    objects = {one["path"]: one["score"] for one in found["objects"]}
    assert objects["/World/Hidden"] is None
    assert objects["/World/Ball"]["pixels"] == found["glass"]["pixels"]  # one sample, one ball that is seen
    assert sum(one["score"]["pixels"] for one in found["tiers"]) <= found["glass"]["pixels"]
    assert found["glass"]["psnr"] < found["whole"]["psnr"]  # outside of the glass nothing differs but samples
    assert found["made"]["reference"]["samples"] == 2
    assert "/World/Ball" in done.output
    assert "/World/Hidden" in done.output
    assert stage.read_bytes() == before


def test_two_files_give_the_numbers_of_the_stage_they_came_from(stage: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(stage, out, *SMALL).exit_code == 0
    done = run(out / "picture.exr", out / "reference.exr", "--json")
    first, second = report_in(out), json.loads(done.stdout)
    for part in ("whole", "glass"):
        assert second[part]["pixels"] == first[part]["pixels"]
        assert second[part]["psnr"] == pytest.approx(first[part]["psnr"], abs=0.02)  # the files hold half floats
        assert second[part]["ssim"] == pytest.approx(first[part]["ssim"], abs=1e-3)
    assert [one["tier"] for one in second["tiers"]] == [one["tier"] for one in first["tiers"]]
    assert second["objects"] == []


def test_a_file_against_itself_is_the_same(tmp_path: Path) -> None:
    frame().save(tmp_path / "a.exr")
    done = run(tmp_path / "a.exr", tmp_path / "a.exr", tmp_path / "out", "--fail-under", 1000)
    assert done.exit_code == 0, done.output
    whole = report_in(tmp_path / "out")["whole"]
    assert (whole["psnr"], whole["ssim"]) == (None, pytest.approx(1.0))
    assert whole["flip"] in (None, 0.0)
    assert "same" in done.output


def test_fail_under_is_the_glass_or_everything(tmp_path: Path) -> None:
    made = frame()
    made.save(tmp_path / "a.exr")
    other = {**made.planes, "beauty": made.planes["beauty"].copy()}
    other["beauty"][made.planes["mask"] >= 0.5] = 1.0
    Frame(8, 6, other).save(tmp_path / "b.exr")
    failed = run(tmp_path / "b.exr", tmp_path / "a.exr", "--fail-under", 30)
    assert failed.exit_code == 1
    assert re.search(r"error: the glass has [\d.]+ dB, which is under the 30 dB asked for", failed.output)
    bare = [Frame(8, 6, {"beauty": planes["beauty"]}) for planes in (other, made.planes)]
    for one, name in zip(bare, "cd", strict=True):
        one.save(tmp_path / f"{name}.exr")
    failed = run(tmp_path / "c.exr", tmp_path / "d.exr", "--fail-under", 30)
    assert failed.exit_code == 1
    assert "error: the picture has" in failed.output
    assert run(tmp_path / "c.exr", tmp_path / "d.exr", "--fail-under", 0).exit_code == 0


def test_the_page_needs_nothing_else(stage: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(stage, out, *SMALL).exit_code == 0
    page = (out / "report.html").read_text("utf-8")
    assert not re.search(r"https?://|<link|<script|@import|url\(", page)
    sources = re.findall(r'src="([^"]*)"', page)
    pictures = [base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True) for source in sources]
    assert pictures[:2] == [(out / f"{name}.png").read_bytes() for name in ("picture", "reference")]
    assert 'type="range"' in page


def test_names_from_a_stage_stay_words_on_the_page(tmp_path: Path) -> None:
    frame().save(tmp_path / "<b>&.exr")
    assert run(tmp_path / "<b>&.exr", tmp_path / "<b>&.exr", tmp_path / "out").exit_code == 0
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "<b>" not in page
    assert "&lt;b&gt;&amp;.exr" in page


def test_without_flip_the_report_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare_numbers, "flip_lacks", lambda: "FLIP needs the package 'flip-evaluator'")
    frame().save(tmp_path / "a.exr")
    done = run(tmp_path / "a.exr", tmp_path / "a.exr", tmp_path / "out")
    assert done.exit_code == 0
    assert "FLIP is left out: FLIP needs the package 'flip-evaluator'." in done.output
    found = report_in(tmp_path / "out")
    assert found["whole"]["flip"] is None
    assert found["lacks"] == ["FLIP needs the package 'flip-evaluator'"]
    assert not (tmp_path / "out" / "flip.png").exists()


def test_an_earlier_report_is_replaced_and_other_folders_are_not(tmp_path: Path) -> None:
    frame().save(tmp_path / "a.exr")
    out = tmp_path / "out"
    for _ in range(2):
        assert run(tmp_path / "a.exr", tmp_path / "a.exr", out).exit_code == 0
    (out / "report.json").unlink()
    refused = run(tmp_path / "a.exr", tmp_path / "a.exr", out)
    assert refused.exit_code == 2
    assert "--overwrite" in refused.output
    assert run(tmp_path / "a.exr", tmp_path / "a.exr", out, "--overwrite").exit_code == 0


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["a.exr", "wide.exr"], 2, "8 x 6 pixels and wide.exr 4 x 4 pixels"),
        (["a.exr", "none.exr"], 1, "none.exr: the file does not exist"),
        (["a.txt", "a.exr"], 2, "not a known image extension"),
        (["a.exr", "a.exr", "--suggest"], 2, "--suggest: says how to draw"),
        (["a.exr", "a.exr", "--samples", "4"], 2, "--samples: says how to draw"),
        (["a.exr", "a.exr", "--disable-camera-light"], 2, "--disable-camera-light: says how to draw"),
        (["a.exr", "a.exr", "no/folder"], 2, "no/folder: the folder no does not exist"),
        (["a.exr", "a.exr", "a.exr"], 2, "a.exr: is a file"),
        (["stage.usda", "out", "more"], 2, "more: is one word too many"),
        (["stage.usda", "out", "--camera", "none"], 2, "camera 'none' does not exist"),
        (["stage.usda", "out", "--camera", "a", "--camera", "b"], 2, "--camera may be given once"),
        (["stage.usda", "out", "--write", "b.usda"], 2, "add --suggest"),
        (["stage.usda", "out", "--suggest", "--model", "thin"], 2, "leave out --model"),
        (["stage.usda", "out", "--suggest", "--write", "stage.usda"], 2, "input is never changed"),
        (["stage.usda", "out", "--reference-samples", "0"], 2, "it must be between 1 and 4096"),
        (["stage.usda", "out", "--tiers", "moon"], 2, "tiers has 'moon'"),
        (["lost.usda", "out"], 1, "lost.usda: there is no such file"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    words: list[str], code: int, text: str, stage: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(stage.parent)
    frame().save("a.exr")
    Frame(4, 4, {"beauty": np.zeros((4, 4, 4), np.float32)}).save("wide.exr")
    before = {path.name for path in stage.parent.iterdir()}
    done = run(*words)
    assert done.exit_code == code
    assert text in done.output
    assert {path.name for path in stage.parent.iterdir()} == before


def test_cancel_leaves_nothing_behind(stage: Path, tmp_path: Path) -> None:
    asked = []

    def cancel() -> bool:
        asked.append(True)
        return len(asked) > 3

    nothing: Callable[..., None] = lambda *_: None  # noqa: E731
    order = compare_renders.CompareOrder(
        stage=str(stage), out=str(tmp_path / "out"), suggest=True, write=str(tmp_path / "best.usda"),
        overrides={"image_width": 32, "samples": 1}, reference_samples=1,
    )  # fmt: skip
    with pytest.raises(Cancelled):
        compare_renders.compare_stage(order, Report(nothing, nothing, nothing, nothing), cancel)
    assert [path.name for path in tmp_path.iterdir()] == ["stage.usda"]


def things(scene: Scene) -> tuple[Mesh | Sphere, ...]:
    return (*scene.meshes, *scene.spheres)


# --- suggestions ----------------------------------------------------------------------------------------------------


def test_a_ball_that_is_a_slab_is_found_out_and_mended(stage: Path, tmp_path: Path) -> None:
    best = tmp_path / "best.usda"
    before = stage.read_bytes()
    done = run(stage, tmp_path / "out", *SMALL, "--suggest", "--write", best)
    assert done.exit_code == 0, done.output
    found = report_in(tmp_path / "out")
    (only,) = found["suggestions"]  # the other one is not seen
    assert only["material"] == "/World/Glass"
    assert only["now"] == "box authored"
    assert only["best"].split()[0] in ("sphere", "traced")
    labels = {"sphere authored", "sphere measured", "box authored", "box measured", "thin", "traced"}
    assert {trial["label"] for trial in only["trials"]} == labels
    assert found["written"]["changed"] == ["/World/Glass"]
    assert found["written"]["score"]["psnr"] > found["glass"]["psnr"] + 3.0
    assert "/World/Other: no pixel shows it first" in done.output
    scene = load_stage(best)
    (row,) = [one for one in scene.materials if one.name == "/World/Glass"]
    assert row.model.token == only["best"].split()[0]
    assert stage.read_bytes() == before


def test_what_cannot_be_better_is_left_alone(tmp_path: Path) -> None:
    stage = tmp_path / "stage.usda"
    stage.write_text(STAGE.replace("MODEL", "traced"), "utf-8")
    done = run(stage, tmp_path / "out", *SMALL, "--suggest", "--write", tmp_path / "best.usda", "--tiers", "ray,sky",
               "--samples", "2")  # fmt: skip
    assert done.exit_code == 0, done.output
    found = report_in(tmp_path / "out")
    assert found["suggestions"][0]["best"] == found["suggestions"][0]["now"] == "traced"
    assert found["written"]["changed"] == []


@pytest.mark.parametrize(
    ("name", "labels", "note"),
    [
        ("bubble", {"sphere fitted", "sphere measured", "box fitted", "box measured", "thin", "traced"}, "solid glass"),
        ("thickness_map", {"sphere authored", "box authored", "thin", "traced"}, "knows no thickness of it"),
        ("window", {"thin", "traced"}, "thickness not measured"),  # flat sheets: there is no thickness to fit
    ],
)
def test_what_the_reference_cannot_know_is_said(name: str, labels: set[str], note: str, tmp_path: Path) -> None:
    done = run(SAMPLES / f"{name}.usda", tmp_path / "out", *SMALL, "--suggest")
    assert done.exit_code == 0, done.output
    first = report_in(tmp_path / "out")["suggestions"][0]
    assert {trial["label"] for trial in first["trials"]} == labels
    assert any(note in one for one in first["notes"])


@pytest.mark.parametrize("name", ["preview_surface", "thickness_map", "window", "absorption", "ice_cube"])
def test_what_is_written_is_what_was_drawn(name: str) -> None:
    """Every candidate of every glass of a sample: its layer, read again, has the values that were drawn."""
    path = str(SAMPLES / f"{name}.usda")
    read = partial(scene_from_stage)
    scene = load_stage(path)
    names = [one.name for one in scene.materials if one.refractive]
    glasses = suggest.glass_by_name(path, list(dict.fromkeys(names)))
    prims = [thing.path for thing in things(scene)]
    measured, _ = suggest.measured_scene(path, glasses, prims, read)
    for material_name in glasses:
        for candidate in suggest.candidates(scene, material_name, measured):
            drawn = suggest.applied(scene, material_name, candidate, measured)
            if candidate.now:
                continue
            layer, changed, _ = suggest.authored(path, scene, glasses, {material_name: (candidate, drawn)})
            assert changed == (material_name,)
            written = scene_from_stage(stage_of(layer))
            _same_glass(written, drawn, material_name, candidate.thickness)


def _same_glass(written: Scene, drawn: Scene, name: str, thickness: str) -> None:
    (a,) = {one.model: one for one in written.materials if one.name == name}.values()
    b = next(one for one in drawn.materials if one.name == name)
    assert a.model is b.model
    assert a.abbe == b.abbe
    for param in (Param.IOR, Param.TRANSMITTANCE, Param.ROUGHNESS):
        assert (a.inputs[param].texture >= 0) == (b.inputs[param].texture >= 0), param
        np.testing.assert_allclose(a.inputs[param].value, b.inputs[param].value, rtol=1e-5, err_msg=param.name)
    if b.inputs[Param.TRANSMITTANCE].value[:3] != (1.0, 1.0, 1.0):
        assert a.absorption_distance == pytest.approx(b.absorption_distance, rel=1e-5)
    if b.model.sized and thickness != "measured":
        x, y = a.inputs[Param.THICKNESS], b.inputs[Param.THICKNESS]
        np.testing.assert_allclose((*x.value, *x.scale), (*y.value, *y.scale), rtol=1e-5)
        assert (x.texture >= 0) == (y.texture >= 0)
    if thickness == "measured":
        key, found = "refraction:thickness", 0
        for one, other in zip(things(written), things(drawn), strict=True):
            assert (key in one.primvars) == (key in other.primvars), one.path
            if key in one.primvars:
                np.testing.assert_allclose(one.primvars[key], other.primvars[key], rtol=1e-5)
                found += 1
        assert found > 0


def test_png_bytes_are_a_png() -> None:
    assert png_bytes(np.zeros((2, 3, 3), np.uint8)).startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("psnrs", "best"), [((30.0, 30.05), 0), ((30.0, 30.2, 31.0), 2), ((30.0, 29.0), 0), ((np.inf, np.inf), 0)]
)
def test_what_the_stage_has_stays_where_nothing_is_clearly_better(psnrs: tuple[float, ...], best: int) -> None:
    trials = tuple(Trial("traced", "", None, psnr, {}, number == 0) for number, psnr in enumerate(psnrs))
    assert Trials("/glass", trials, ()).best is trials[best]
