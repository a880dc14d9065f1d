"""`python -m benchmarks.corpus`: a row for every stage whatever becomes of it, causes by name, pictures beside."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import corpus

SAMPLES = Path(__file__).parents[1] / "usd_samples"
CURVES = """#usda 1.0
def BasisCurves "Hair" {
    int[] curveVertexCounts = [4]
    point3f[] points = [(0, 0, 0), (0, 1, 0), (0, 2, 0), (0, 3, 0)]
}
def NurbsPatch "Sail" {
}
def Sphere "Ball" {
}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, object]]]:
    folder, out = tmp_path_factory.mktemp("stages"), tmp_path_factory.mktemp("out")
    (folder / "sub" / "baseline").mkdir(parents=True)
    (folder / "sub" / "curves.usda").write_text(CURVES)
    Image.new("RGB", (8, 8), (255, 0, 0)).save(folder / "sub" / "baseline" / "curves.png")
    shutil.copy(SAMPLES / "bad" / "not_usd.usda", folder / "damaged.usda")
    (folder / "empty.usda").write_text("#usda 1.0\n")
    (folder / "notes.txt").write_text("no stage")
    return out, corpus.run(folder, out, width=24, seconds=1800.0, jobs=1, keep=False)


def test_every_stage_is_a_row_whatever_becomes_of_it(made: tuple[Path, list[dict[str, object]]]) -> None:
    out, rows = made
    assert [row["stage"] for row in rows] == ["damaged.usda", "empty.usda", "sub/curves.usda"]
    damaged, empty, curves = rows
    assert (damaged["causes"], damaged["picture"]) == (["refused"], "")
    assert "nothing seen" in list(empty["causes"])  # type: ignore[call-overload]
    assert {"patches"} <= set(curves["causes"])  # type: ignore[call-overload]
    assert (out / str(curves["picture"])).exists()
    assert json.loads((out / "corpus.json").read_text())["stages"] == rows
    page = (out / "index.md").read_text()
    assert all(f"| {row['seconds']} |" in page for row in rows)


def test_the_sheet_has_our_picture_beside_the_other_one(made: tuple[Path, list[dict[str, object]]]) -> None:
    out, rows = made
    assert Path(str(rows[2]["beside"])).name == "curves.png"
    pixels = np.asarray(Image.open(out / "sheet-01.jpg"), np.int64)
    row = pixels[corpus._CELL + 28 : 2 * (corpus._CELL + 28)]  # the third stage is the first of the second line
    red = (row[..., 0] > 200) & (row[..., 1] < 60)
    assert red[:, corpus._CELL : 2 * corpus._CELL].any()
    assert not red[:, : corpus._CELL].any()


def test_a_stage_that_takes_too_long_or_crashes_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    late = corpus.row_of(tmp_path / "a.usda", "a.usda", tmp_path, 24, 0.01)
    assert late["causes"] == ["too long"]
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert corpus.row_of(tmp_path / "a.usda", "a.usda", tmp_path, 24, 60.0)["causes"] == ["crash"]


def test_causes_are_counted_by_stage_and_those_that_are_no_mistake_are_none() -> None:
    said = ["BasisCurves is not rendered; convert it to a Mesh (3 prims: /A)", "the stage has no camera; one is made"]
    assert corpus.causes_of([*said, *said]) == ["curves", "no camera"]
    assert corpus.causes_of(["a sentence that nobody wrote"]) == ["something else"]
    rows: list[dict[str, object]] = [{"causes": ["curves", "no camera"]}, {"causes": ["no camera"]}, {"causes": []}]
    assert dict(corpus.table_of_causes(rows)) == {"curves": 1, "no camera": 2, "none": 2}


@pytest.mark.parametrize(
    ("pictures", "stage", "found"),
    [
        (["baseline/a.png", "baseline/b.png"], "a.usda", "a.png"),
        (["baseline/ab.png"], "a.usda", None),  # which is of the stage ab
        (["a.png", "wood.png"], "a.usda", "a.png"),
        (["wood.png"], "a.usda", None),  # a texture
        (["screenshots/other.png"], "alone/x.usda", None),
        (["alone/screenshots/any.png"], "alone/x.usda", "any.png"),
    ],
)
def test_which_picture_is_of_which_stage(pictures: list[str], stage: str, found: str | None, tmp_path: Path) -> None:
    stages = [tmp_path / name for name in ("a.usda", "ab.usda", "b.usda", "alone/x.usda")]
    for path in [*stages, *(tmp_path / name for name in pictures)]:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    best = corpus.beside(tmp_path / stage, stages)
    assert (best.name if best else None) == found
