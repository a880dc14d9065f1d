"""Every stage below a folder: what we draw of it, how long that takes, and why it is not right where it is not.

    python -m benchmarks.corpus FOLDER OUT [--width 320] [--seconds 180] [--jobs 1] [--keep] [--write]

Stages are .usd, .usda, .usdc, .usdz, .mtlx (on preview balls) and, with the gltf extra, .glb and .gltf. Each is
drawn by a process of its own, so that a crash is a row like any other. OUT gets:

    index.md, corpus.json     a line a stage: seconds, triangles, notices, causes; the table of causes
    sheet-NN.jpg              what we draw, with somebody else's picture beside it where one lies beside the stage
    pictures/                 what we draw

A cause is a reason why a picture may differ from what usdview shows, by what the reader itself said (`CAUSES`), or by
what came of it: a crash, too long, nothing seen. What nobody said has no cause here; the sheets are there to be
looked at. `--write` puts the numbers into docs/corpus.md.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from PIL import Image, ImageDraw

from . import pages

USD = (".usd", ".usda", ".usdc", ".usdz")
OTHER = (".mtlx", ".glb", ".gltf")
PAGE = pages.ROOT / "docs" / "corpus.md"
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
BESIDE = ("baseline", "baselines", "ref", "reference", "screenshot", "screenshots", "media", "thumbnails", "preview")
"""Folders, and beginnings of file names, of pictures that show what a stage should look like."""


_CRASH, _LATE, _REFUSED, _UNSEEN = "crash", "too long", "refused", "nothing seen"


class Cause(NamedTuple):
    """Why a picture may not be right."""

    name: str
    words: str
    """Regular expression that a notice about it matches, whatever the case of its letters"""


CAUSES = (
    Cause("missing file", r"part of the stage is missing|cannot open|there is no such file|does not exist"),
    Cause("subdivision", r"subdivi|crease"),
    Cause("curves", r"\b(Basis|Nurbs|Hermite)Curves"),
    Cause("patches", r"\bNurbsPatch"),
    Cause("points", r"\bPoints\b.*\bis not"),
    Cause("volumes", r"\b(Volume|ParticleField\w*|TetMesh) is not"),
    Cause("instances", r"instance|prototype"),
    Cause("MaterialX", r"^MaterialX |mtlx"),
    Cause("MDL", r"^MDL "),
    Cause("shader of one renderer", r"surface shader .* is not one this renderer reads"),
    Cause("shader node", r"^shader node "),
    Cause("displacement", r"\bdisplacement\b"),
    Cause("texture", r"texture|UDIM|colou?rSpace|has no file"),
    Cause("UDIM", r"UDIM"),
    Cause("light", r"\b\w*Light\w* is not|light.*(ignored|skipped|not drawn)|lightFilter|portal"),
    Cause("no light", r"no light"),
    Cause("no camera", r"has no camera"),
    Cause("depth of field", r"depth of field|fStop|out of focus"),
    Cause("exposure", r"far above white|nearly black"),
    Cause("motion blur", r"shutter|motion"),
    Cause("draw mode", r"drawMode"),
    Cause("subset", r"of its indices are ignored|elementType"),
    Cause("value out of range", r"it is clamped|it must be"),
    Cause("tint without a depth", r"transmission colou?r without a depth"),
    Cause("binding without its schema", r"MaterialBindingAPI"),
    Cause("not converted", r"not converted"),
    Cause("skinning", r"skin|bind pose|skeleton"),
    Cause("primvar", r"primvars:|normals is ignored"),
    Cause("bad geometry", r"left out|skipped:|not everything in"),
    Cause("bad metadata", r"metersPerUnit|upAxis"),
    Cause("empty", r"nothing is visible"),
    Cause(_UNSEEN, r"^no pixel of the picture shows anything"),
    Cause("render settings", r"is authored but not used|renderSettingsPrimPath|RenderProduct|RenderVar"),
)
FAULTS = {
    "missing file", _REFUSED, "texture", "value out of range", "bad geometry", "bad metadata", "subset", "instances",
    _UNSEEN,
}  # fmt: skip
"""Said of what makes no sense as it stands, or is not there."""
NO_MISTAKE = {
    "no camera", "no light", "empty", "binding without its schema", "draw mode", "depth of field", "motion blur",
    "exposure",
}  # fmt: skip
"""Said of a stage that lacks something, or asks for something, and is drawn as well as it can be."""


def stages_in(folder: Path) -> list[Path]:
    """Every stage below a folder, by name; all .usd* files, also those that others are made of."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix.lower() in USD + OTHER)


def causes_of(notices: Iterable[str]) -> list[str]:
    """Names of `CAUSES` that some notice speaks of, in their order; what nobody knows is `something else`."""
    found: set[str] = set()
    for text in notices:
        names = {cause.name for cause in CAUSES if re.search(cause.words, text, re.IGNORECASE)}
        found |= names or {"something else"}
    return [name for name in (*(cause.name for cause in CAUSES), "something else") if name in found]


def beside(stage: Path, stages: Sequence[Path]) -> Path | None:
    """A picture that somebody else made of a stage: of its name, or the only one beside the only stage."""
    above = stage.parent.parent
    around = [stage.parent] + [above] * (not any(other.parent == above for other in stages))
    homes = [stage.parent, *(folder / name for name in BESIDE for folder in around)]
    found: list[tuple[int, str, Path]] = []
    for home in homes:
        if not home.is_dir():
            continue
        shows = home.name.lower() in BESIDE
        pictures = [path for path in home.iterdir() if path.suffix.lower() in PICTURES]
        named = [path for path in pictures if shows or path.stem.lower().startswith((*BESIDE, "thumbnail"))]
        for path in [*named, *(path for path in pictures if path.stem == stage.stem)]:
            found.append((_unlike(stage.stem, path.stem), path.name, path))
    others = {other.stem for other in stages if other.stem != stage.stem}
    found = [one for one in found if one[0] == 0 or one[2].stem not in others]  # nobody else's own
    if not found:
        return None
    unlike, _, best = min(found)
    alone = sum(other.parent == stage.parent for other in stages) == 1
    return best if unlike < 100 or alone else None


def _unlike(stage: str, picture: str) -> int:
    """0 for the same name, more where only a part of it is the same, 100 where none is."""
    one, other = (re.sub(r"^(test(usdimaginggl|previewsurface)?|native|materialx)|[^a-z0-9]", "", name.lower())
                  for name in (stage, picture))  # fmt: skip
    if one == other:
        return 0
    if one and other and (other.startswith(one) or one.startswith(other)):
        return 1 + abs(len(one) - len(other))
    return 100


# --- one stage, in a process of its own


def draw(stage: str, out: str, width: int) -> dict[str, Any]:
    """Draw one stage with what it says itself, and tell what there was."""
    import numpy as np

    from refract_core.rendering.picture import render
    from refract_core.scene import Notice
    from refract_core.settings import QUALITIES, RenderSettings
    from refract_core.usd.settings import read_settings
    from refract_core.usd.stage import open_stage, scene_from_stage
    from refract_core.verbs.gltf import as_usd

    started = time.perf_counter()
    notices: list[Notice] = []
    opened = open_stage(as_usd(stage, lambda path, text: notices.append(Notice(path, text))))
    authored = read_settings(opened, "", notices)
    small = {"image_width": width, "image_height": 0, "jobs": 1}
    settings = RenderSettings(**{**authored, **QUALITIES["good"], **small})
    how: dict[str, Any] = {"purposes": settings.purposes, "camera": settings.camera}
    scene = scene_from_stage(opened, **how)
    read = time.perf_counter()
    frame = render(scene, settings, scene_at=lambda code: scene_from_stage(opened, time_code=code, **how))
    frame.save(out)
    notices += [*scene.notices, *frame.notices]
    return {
        "read_seconds": round(read - started, 2),
        "draw_seconds": round(time.perf_counter() - read, 2),
        "triangles": sum(len(mesh.triangles) for mesh in scene.meshes),
        "meshes": len(scene.meshes),
        "lights": len(scene.lights) + (scene.environment is not None),
        "glass": sum(material.refractive for material in scene.materials),
        "seen": round(float(np.isfinite(frame.planes["Z"]).mean()), 4),
        "notices": [f"{one.path}: {one.text}" for one in dict.fromkeys(notices)],
        "texts": [one.text for one in dict.fromkeys(notices)],
    }


def row_of(stage: Path, name: str, out: Path, width: int, seconds: float) -> dict[str, Any]:
    """The line of one stage: what `draw` tells, or how it ended."""
    picture = out / "pictures" / (re.sub(r"[^\w.]+", "_", name) + ".png")
    command = [sys.executable, "-m", "benchmarks.corpus", "--stage", str(stage), str(picture), "--width", str(width)]
    started = time.perf_counter()
    row: dict[str, Any] = {"stage": name, "picture": "", "notices": [], "triangles": 0, "error": ""}
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return row | {"seconds": seconds, "causes": [_LATE], "error": f"not done after {seconds:g} s"}
    row["seconds"] = round(time.perf_counter() - started, 1)
    if ended.returncode:
        said = (ended.stderr.strip().splitlines() or [f"ended with {ended.returncode}"])[-1]
        refused = said.startswith("refused: ")
        return row | {"causes": [_REFUSED if refused else _CRASH], "error": said.removeprefix("refused: ")}
    told = json.loads(ended.stdout.splitlines()[-1])
    causes = causes_of(told.pop("texts"))
    return {**row, **told, "picture": str(picture.relative_to(out)), "causes": causes}


# --- pages


_CELL, _COLUMNS, _ROWS = 320, 4, 5


def _fitted(path: Path | None) -> Image.Image:
    """A picture in a square cell, over grey; an empty cell where there is none."""
    cell = Image.new("RGB", (_CELL, _CELL), (70, 70, 70))
    if path is None:
        return cell
    try:
        with Image.open(path) as file:
            picture = file.convert("RGBA")
            picture.thumbnail((_CELL, _CELL))
            cell.paste(picture, ((_CELL - picture.width) // 2, (_CELL - picture.height) // 2), picture)
    except OSError:  # a format that Pillow does not know, or a file that is no picture
        ImageDraw.Draw(cell).text((8, 8), f"{path.name} cannot be shown", (255, 200, 200))
    return cell


def sheets(rows: Sequence[dict[str, Any]], out: Path) -> list[str]:
    """Write contact sheets: two stages a line, ours on the left and the other picture on the right. Returns names."""
    names: list[str] = []
    each = _COLUMNS // 2 * _ROWS
    for first in range(0, len(rows), each):
        sheet = Image.new("RGB", (_COLUMNS * _CELL, _ROWS * (_CELL + 28)), (30, 30, 30))
        drawing = ImageDraw.Draw(sheet)
        for place, row in enumerate(rows[first : first + each]):
            x, y = place % 2 * 2 * _CELL, place // 2 * (_CELL + 28)
            sheet.paste(_fitted(out / row["picture"] if row["picture"] else None), (x, y + 28))
            sheet.paste(_fitted(Path(row["beside"]) if row["beside"] else None), (x + _CELL, y + 28))
            drawing.text((x + 4, y + 2), row["stage"][-100:], (255, 255, 255))
            drawing.text((x + 4, y + 14), (row["error"] or ", ".join(row["causes"]))[:100], (255, 180, 80))
        names.append(f"sheet-{len(names) + 1:02d}.jpg")
        sheet.save(out / names[-1], quality=85)
    return names


def table_of_causes(rows: Sequence[dict[str, Any]]) -> list[tuple[str, int]]:
    """How many stages each cause touches, most first; `none` counts those without any but `NO_MISTAKE`."""
    counts = Counter(cause for row in rows for cause in row["causes"])
    counts["none"] = sum(not set(row["causes"]) - NO_MISTAKE for row in rows)
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def page(folder: str, rows: Sequence[dict[str, Any]], names: Sequence[str]) -> str:
    """index.md."""
    lines = [f"# {len(rows)} stages of {folder}", "", *(f"[{name}]({name})" for name in names), ""]
    causes = (f"| {name} | {count} |" for name, count in table_of_causes(rows))
    lines += ["| cause | stages |", "|---|---|", *causes, ""]
    lines += ["| stage | s | triangles | notices | cause |", "|---|---|---|---|---|"]
    for row in rows:
        cause = ", ".join(row["causes"]) + (f": {row['error']}" if row["error"] else "")
        link = f"[{row['stage']}]({row['picture']})" if row["picture"] else row["stage"]
        lines.append(f"| {link} | {row['seconds']} | {row['triangles']} | {len(row['notices'])} | {cause} |")
    return "\n".join(lines) + "\n"


def summary(rows: Sequence[dict[str, Any]], width: int) -> str:
    """What docs/corpus.md says of a run."""
    ends = Counter(cause for row in rows for cause in row["causes"] if cause in (_CRASH, _LATE, _REFUSED))
    told = ", ".join(f"{ends[name]} {name}" for name in (_CRASH, _LATE, _REFUSED))
    seconds = sorted(row["seconds"] for row in rows)
    first = (
        f"{len(rows)} stages, {width} pixels wide, a process each on one of {pages.machine()}: {median(seconds)} s in "
        f"the middle and {seconds[-1]} s at most. {told}."
    )
    of: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        of.setdefault(row["stage"].partition("/")[0], []).append(row)
    folders = [
        [f"`{name}`", str(len(some)), str(sum(bool(row["beside"]) for row in some)),
         str(sum(not set(row["causes"]) - NO_MISTAKE for row in some))]
        for name, some in of.items()
    ]  # fmt: skip
    kinds = ((NO_MISTAKE, "lacking, or asked for: drawn, and said"), (FAULTS, "a fault of the stage: said"))
    causes = [
        [name, next((kind for names, kind in kinds if name in names), "not drawn as it is meant: said"), str(count)]
        for name, count in table_of_causes(rows) if name != "none"
    ]  # fmt: skip
    by_folder = pages.table(["folder", "stages", "with a picture beside", "nothing but what is lacking"], folders)
    return f"{first}\n\n{by_folder}\n\n{pages.table(['cause', 'what it is', 'stages'], causes)}"


def run(folder: Path, out: Path, *, width: int, seconds: float, jobs: int, keep: bool) -> list[dict[str, Any]]:
    """Draw everything, and write the pages. `keep`: rows of an earlier run that have a picture are not drawn again."""
    (out / "pictures").mkdir(parents=True, exist_ok=True)
    stages = stages_in(folder)
    record = out / "corpus.json"
    known = {}
    if keep and record.exists():
        known = {row["stage"]: row for row in json.loads(record.read_text("utf-8"))["stages"] if row["picture"]}

    def one(stage: Path) -> dict[str, Any]:
        name = str(stage.relative_to(folder))
        row = known.get(name) or row_of(stage, name, out, width, seconds)
        if name in known:
            row["causes"] = causes_of(text.partition(": ")[2] for text in row["notices"])
        other = beside(stage, stages)
        print(f"{row['seconds']:8.1f} s  {name}  {row['error'] or ', '.join(row['causes'])}", flush=True)
        return row | {"beside": str(other) if other else ""}

    with ThreadPoolExecutor(max(1, min(jobs, 2))) as pool:
        rows = list(pool.map(one, stages))
    record.write_text(json.dumps({"folder": str(folder), "causes": table_of_causes(rows), "stages": rows}, indent=1))
    (out / "index.md").write_text(page(str(folder), rows, sheets(rows, out)), "utf-8")
    return rows


def main(words: Sequence[str] | None = None) -> None:
    """Words to calls."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.corpus")
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--seconds", type=float, default=180.0, help="after which a stage is given up")
    parser.add_argument("--jobs", type=int, default=1, choices=(1, 2), help="stages at once")
    parser.add_argument("--keep", action="store_true", help="do not draw again what an earlier run has drawn")
    parser.add_argument("--write", action="store_true", help=f"the numbers into {PAGE.relative_to(pages.ROOT)}")
    parser.add_argument("--stage", action="store_true", help="FOLDER is one stage and OUT its picture")
    asked = parser.parse_args(words)
    if asked.stage:
        from refract_core.errors import RefractError

        try:
            print(json.dumps(draw(str(asked.folder), str(asked.out), asked.width)))
        except RefractError as error:
            sys.exit(f"refused: {error}")
        return
    rows = run(asked.folder, asked.out, width=asked.width, seconds=asked.seconds, jobs=asked.jobs, keep=asked.keep)
    for name, count in table_of_causes(rows):
        print(f"{count:5d}  {name}")
    if asked.write:
        pages.write(PAGE, {"corpus": summary(rows, asked.width)})


if __name__ == "__main__":
    main()
