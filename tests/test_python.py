"""Python as a table of verbs: what each takes and gives, what a notebook shows, and notebooks that run."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pxr import Sdf, Usd, UsdGeom

import refract_core as rc
from refract_core.errors import UsageError
from refract_core.images.aovs import AOVS, shape_of
from refract_core.images.frame import Frame
from refract_core.images.shown import false_colour

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))
QUICK = rc.RenderSettings(image_width=32, image_height=20, samples=1, jobs=1, caustics=0)


def frame(seed: int = 3, names: tuple[str, ...] = tuple(AOVS)) -> Frame:
    rng = np.random.default_rng(seed)
    return Frame(24, 16, {name: rng.random(shape_of(name, 16, 24), np.float32) for name in names})


# --- what a stage may be


@pytest.mark.draws
def test_a_path_a_stage_and_its_layer_are_one_scene() -> None:
    path = rc.sample("marble")
    stage = Usd.Stage.Open(path)
    pictures = [rc.render(rc.load_stage(one), QUICK).planes["beauty"] for one in (path, stage, stage.GetRootLayer())]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])


def test_what_is_edited_and_not_saved_is_read_and_nothing_is_changed() -> None:
    stage = Usd.Stage.CreateInMemory()
    ball = UsdGeom.Sphere.Define(stage, "/Ball")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for radius in (0.5, 2.0):
        ball.CreateRadiusAttr().Set(radius)
        before = stage.ExportToString(), stage.GetSessionLayer().ExportToString()
        assert rc.load_stage(stage).spheres[0].radius == radius
        assert rc.load_stage(stage.GetRootLayer()).spheres[0].radius == radius
        assert (stage.ExportToString(), stage.GetSessionLayer().ExportToString()) == before


def test_what_is_no_stage_is_refused() -> None:
    wrongs: list[Any] = [3, None, Sdf.Path("/a")]
    for wrong in wrongs:
        with pytest.raises(UsageError, match=r"a path, a Usd\.Stage or an Sdf\.Layer, not"):
            rc.load_stage(wrong)
    with pytest.raises(UsageError, match="an opening is for files"):
        rc.load_stage(Usd.Stage.CreateInMemory(), opening=rc.Opening(mask=("/World",)))
    layer = Sdf.Layer.CreateAnonymous()
    gone = Usd.Stage.Open(layer)
    kept = gone.GetRootLayer()
    del layer, gone
    assert isinstance(rc.load_stage(kept), rc.Scene)


# --- verbs


def test_a_verb_refuses_arguments_that_it_does_not_have(tmp_path: Path) -> None:
    verbs: list[Callable[..., Any]] = [rc.convert, rc.bake_probes, rc.bake_thickness]
    for verb in verbs:
        with pytest.raises(UsageError, match=f"{verb.__name__}: there is no argument 'colour'; .*overwrite"):
            verb(rc.sample("marble"), tmp_path / "a.usda", colour="red")
    with pytest.raises(UsageError, match="validate: there is no argument"):
        rc.validate(rc.sample("marble"), colour="red")
    assert not list(tmp_path.iterdir())


def test_verbs_do_what_the_commands_do(tmp_path: Path) -> None:
    made = rc.convert(rc.sample("preview_surface"), tmp_path / "glass.usda")
    assert [row.action for row in made.rows] == ["applied"] * len(made.rows) != []
    assert rc.validate(tmp_path / "glass.usda").passed
    seen = rc.inspect(tmp_path / "glass.usda")
    assert {piece["material"] for piece in seen["glass"]} == {row.path for row in made.rows}
    rows = rc.bake_thickness(rc.sample("traced"), tmp_path / "thick.usda", progress=(told := Told()))
    assert all(0.0 < row.least <= row.mean <= row.most for row in rows)
    assert rows
    assert told.fractions == sorted(told.fractions) != []


class Told:
    def __init__(self) -> None:
        self.fractions: list[float] = []

    def __call__(self, fraction: float, stage: str) -> None:
        self.fractions.append(fraction)


@pytest.mark.draws
def test_baked_probes_are_told_with_their_files(tmp_path: Path) -> None:
    baked = rc.bake_probes(rc.sample("two_probes"), tmp_path / "out.usda", samples=1, resolution=8)
    *textures, out = baked.files
    assert out == str(tmp_path / "out.usda")
    assert textures
    assert all(baked.files.values())
    assert (tmp_path / "out.probes").is_dir()


def test_compare_takes_frames_and_files_alike(tmp_path: Path) -> None:
    one, other = frame(1), frame(2)
    for name, each in (("one", one), ("other", other)):
        each.save(tmp_path / f"{name}.exr")
    among = rc.compare(one, other).findings.whole.psnr
    mixed = rc.compare(one, tmp_path / "other.exr").findings.whole.psnr
    files = rc.compare(tmp_path / "one.exr", tmp_path / "other.exr").findings.whole.psnr
    assert mixed == pytest.approx(among, abs=0.05)  # half floats in the file
    assert files == pytest.approx(among, abs=0.05)
    assert rc.compare(one, one).findings.whole.psnr == np.inf
    with pytest.raises(UsageError, match="compare: 'out' is for files"):
        rc.compare(one, other, out=str(tmp_path / "report"))
    with pytest.raises(UsageError, match="not a known image extension"):
        rc.compare(one, rc.sample("marble"))


def test_optics_are_there_without_another_import() -> None:
    """Normal incidence on glass of 1.5: 4 %."""
    assert float(rc.optics.fresnel_dielectric(1.0, 1 / 1.5)) == pytest.approx(0.04)
    node = rc.refract_node([0.0, -1.0, 0.0], [0.0, 1.0, 0.0], 1.0, 1.5)
    np.testing.assert_allclose(node.refracted, [0.0, -1.0, 0.0])
    with pytest.raises(AttributeError):
        rc.optics.magic  # noqa: B018


@pytest.mark.draws
def test_a_session_serves_two_threads_as_it_serves_one_after_the_other() -> None:
    scene = rc.load_stage(rc.sample("marble"))
    scenes = [scene, rc.override(scene, {"/World/Looks/Clear": {"ior": 1.33}})]
    expected = [rc.render(one, QUICK).planes for one in scenes]
    session = rc.Session()
    with ThreadPoolExecutor(2) as threads:
        pictures = threads.map(lambda k: rc.render(scenes[k % 2], QUICK, session=session).planes, range(6))
        for k, planes in enumerate(pictures):
            for name, plane in planes.items():
                np.testing.assert_array_equal(plane, expected[k % 2][name])


# --- what is shown


def test_a_scene_and_its_materials_are_told_in_a_line() -> None:
    scene = rc.load_stage(rc.sample("marble"))
    assert repr(scene).startswith("<Scene marble.usda at 0: meshes 5, spheres 6,")
    for thing in (scene, *scene.materials):
        assert len(repr(thing)) < 300
        assert "\n" not in repr(thing)
    html = scene._repr_html_()
    assert "<th>of glass</th><td>5</td>" in html
    assert "/World/Looks/Clear" in html
    clear = next(one for one in scene.materials if one.name.endswith("Clear"))
    assert "ior=1.5" in repr(clear)
    assert "<td>1.5</td>" in clear._repr_html_()


def test_names_in_a_table_are_text() -> None:
    scene = rc.Scene((), (), name="<script>.usda")
    assert "<script>" not in scene._repr_html_()


def test_a_frame_shows_its_picture() -> None:
    made = frame()
    shown = np.asarray(Image.open(io.BytesIO(made._repr_png_())))
    np.testing.assert_array_equal(shown, made.to_srgb())
    assert repr(made).startswith("<Frame 24x16: beauty, refraction")
    assert made.show().size == (24, 16)


def test_the_ends_of_a_bar_are_the_ends_of_the_colours() -> None:
    """viridis begins with #440154 and ends with #fde725."""
    values = np.array([[0.0, 1.0, -5.0, 9.0, np.nan, np.inf]], np.float32)
    colours = [tuple(c) for c in false_colour(values, 0.0, 1.0)[0].tolist()]
    assert colours[0] == colours[2] == (0x44, 0x01, 0x54)
    assert colours[1] == colours[3] == (0xFD, 0xE7, 0x25)
    assert colours[4] == colours[5]
    light = false_colour(np.linspace(0, 1, 64, dtype=np.float32)[None], 0, 1)[0] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) > 0).all(), "more is lighter"


def test_data_have_a_bar_and_are_grey_where_no_glass_is() -> None:
    made = frame()
    made.planes["mask"][:, :12] = 0.0
    made.planes["thickness"][:, :12] = 1e6  # nobody's, so it must not stretch the bar
    picture = made.show("thickness")
    assert picture.height > made.height
    pixels = np.asarray(picture)
    left = (picture.width - made.width) // 2
    assert np.unique(pixels[:16, left : left + 12].reshape(-1, 3), axis=0).tolist() == [[96, 96, 96]]
    assert len(np.unique(pixels[:16, left + 12 : left + 24].reshape(-1, 3), axis=0)) > 20
    for name in AOVS:
        assert made.show(name).width >= 24


def test_what_cannot_be_shown_is_refused() -> None:
    made = frame(names=("beauty", "Z"))
    with pytest.raises(UsageError, match="AOV 'thickness' is not in this frame; it has beauty, Z"):
        made.show("thickness")
    with pytest.raises(UsageError, match="2 to 1 is no range"):
        made.show("Z", low=2.0, high=1.0)
    with pytest.raises(UsageError, match="leave them out"):
        made.show("beauty", high=1.0)


def test_a_difference_is_how_far_numbers_are_apart() -> None:
    one, other = frame(1), frame(2, ("beauty", "Z", "mask"))
    one.planes["Z"][0, 0] = other.planes["Z"][0, 0] = np.inf
    apart, back = one.diff(other), other.diff(one)
    assert apart.planes.keys() == {"beauty", "Z", "mask"}
    assert apart.planes["Z"][0, 0] == 0.0
    np.testing.assert_array_equal(apart.planes["mask"], np.abs(one.planes["mask"] - other.planes["mask"]))
    for name, plane in apart.planes.items():
        np.testing.assert_array_equal(plane, back.planes[name])
        assert (one.diff(one).planes[name][..., :3] == 0).all() or name == "beauty"
    with pytest.raises(UsageError, match="24 x 16 and 8 x 8"):
        one.diff(Frame(8, 8, {"Z": np.zeros((8, 8), np.float32)}))
    with pytest.raises(UsageError, match="no AOV in common"):
        frame(names=("Z",)).diff(frame(names=("mask",)))


def test_xarray_has_the_same_numbers() -> None:
    pytest.importorskip("xarray")
    made = frame()
    data = made.to_xarray()
    assert data.sizes["y"] == 16
    assert data.sizes["x"] == 24
    for name, plane in made.planes.items():
        np.testing.assert_array_equal(data[name].values, plane)
    np.testing.assert_array_equal(data["N"].sel(N_channel="Y").values, made.planes["N"][..., 1])


def test_without_xarray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(UsageError, match=r"pip install usd-refract\[xarray\]"):
        frame().to_xarray()


# --- notebooks


def cells(notebook: Path) -> list[str]:
    """What its cells of code say."""
    document = json.loads(notebook.read_text("utf-8"))
    assert document["nbformat"] == 4
    assert len({cell["id"] for cell in document["cells"]}) == len(document["cells"])
    return ["".join(cell["source"]) for cell in document["cells"] if cell["cell_type"] == "code"]


@pytest.mark.draws
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cell by cell in one room of names, as a notebook's kernel does."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__main__"}
    for k, text in enumerate(cells(notebook)):
        exec(compile(text, f"{notebook.name}[{k}]", "exec"), names)
    assert not list(tmp_path.iterdir()), "a notebook of the docs leaves nothing behind"


def test_notebooks_are_kept_without_what_they_showed() -> None:
    assert len(NOTEBOOKS) >= 3
    for notebook in NOTEBOOKS:
        for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
            assert not cell.get("outputs")
            assert cell.get("execution_count") is None
