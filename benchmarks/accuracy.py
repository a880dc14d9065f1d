"""How near each quality comes to the reference: PSNR in glass and elsewhere, stage by stage.

    python -m benchmarks.accuracy [--stages NAMES] [--image-width 320] [--reference-samples 256] [--assets FOLDER]
                                  [--write]

Every stage of `usd_samples/good`, and every one with glass in a folder of other people's assets, is drawn as
`refract render` would draw it with `--quality draft`, `good` (the default) and `best`, and once with
`--quality reference`: every pixel takes all samples, branches are followed down to a two-thousandth, and whatever is
seen through glass or in it is found by rays, not by the screen or a probe. Materials keep their models, so the drawing
is measured, and not what an author chose; `refract compare` measures that.

One more column has `good` with rays alone (`--tiers ray,sky`): what it gains is the error of what the screen lends and
of what probes say.

PSNR is that of `refract compare`: sRGB pictures, clipped as they would be shown. Glass are the pixels in which the
reference met any, elsewhere are the others. Seconds are of processor time for one picture, over all threads. glTF files
among the assets go through `refract convert` first.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import refract_core as rc
from refract_core.errors import RefractError
from refract_core.images.frame import Frame
from refract_core.scene import Scene
from refract_core.settings import RenderSettings
from refract_core.usd.layers.write import GLTF
from refract_core.usd.settings import read_settings
from refract_core.usd.stage import open_stage, scene_from_stage
from refract_core.verbs.compare import Mask, displayed, psnr
from refract_core.verbs.gltf import as_usd
from refract_core.verbs.render_files import chosen_settings

from . import pages

PAGE = pages.ROOT / "docs" / "accuracy.md"
SAMPLES = pages.ROOT / "usd_samples" / "good"
ASSETS = pages.ROOT.parent / "shared" / "assets"
"""Other people's stages, where they stand beside the checkout."""
LEVELS = ("draft", "good", "best")
DEFAULT = "good"
ENOUGH = 35.0
"""[dB] in glass at the default quality; what is below has to say why."""
_PROBES = "what the screen does not show is answered by probes, which are pictures from one place"
_CORNERS = "what is thinner than a pixel falls between the corners that a pixel is made from"
_ROUGH = "rough glass has few rays for its lobes."
_DENSE = "balls of index 5 and 25 keep more ways of light than are sampled."
_GLTF = "gltf_glass"
REASONS: dict[str, str] = {
    "baked_and_realtime": f"{_PROBES}.",
    "two_probes": f"{_PROBES}.",
    "curves": "coil and rods are a few pixels wide, so most of their glass is edges, which take 16 samples.",
    "stained_glass": "its leads are about a pixel wide, so they are edges, which take 16 samples.",
    "traced": "the facets of the gem throw sparks of the lamps, in colours, which are smaller than a pixel.",
    f"{_GLTF}/GlassBrokenWindow/GlassBrokenWindow.glb": f"{_CORNERS}: the cracks, which a texture draws.",
    f"{_GLTF}/GlassVaseFlowers/GlassVaseFlowers.glb": f"{_CORNERS}: stems and leaves.",
    f"{_GLTF}/TransmissionRoughnessTest/TransmissionRoughnessTest.glb": _ROUGH,
    "chess_pawn/Pawn/Pawn.usd": _ROUGH,
    "chess_pawn/Pawn/Pawn_payload.usd": _ROUGH,
    "openusd_material_native/nativeOpacity.usda": _DENSE,
    "openusd_material_native/materialXopacity.usda": _DENSE,
}
"""stage -> why its glass, at the default quality, is further from the reference than ENOUGH"""
UNKNOWN = "nobody knows why yet."
_USD = (".usd", ".usda", ".usdc", ".usdz")
_LOOK = 64
"""Width of the picture that tells whether there is glass to see [pixels]"""


class Stage(NamedTuple):
    """What is drawn."""

    name: str
    path: Path


class Score(NamedTuple):
    """What came of one quality. PSNR [dB]; nan where there are no such pixels."""

    glass: float
    elsewhere: float
    seconds: float
    """of processor time"""


class Row(NamedTuple):
    """Everything about one stage."""

    name: str
    scores: dict[str, Score]
    """by quality"""
    rays: float
    """PSNR in glass of the default, if rays alone answer [dB]"""

    @property
    def low(self) -> bool:
        """Whether it has to say why."""
        return self.scores[DEFAULT].glass < ENOUGH


class Options(NamedTuple):
    """What the command line says."""

    width: int = 320
    """of every picture [pixels]; its height follows the camera"""
    reference_samples: int = 256
    jobs: int = 0


# ------------------------------------------------------------------------------------------------ which stages


def samples() -> list[Stage]:
    """The project's own stages."""
    return [Stage(path.stem, path) for path in sorted(SAMPLES.glob("*.usda"))]


def assets(folder: Path) -> Iterator[Stage]:
    """Stages in a folder that show glass, by their place in it.

    Args:
        folder: searched through and through.
    """
    for path in sorted(folder.rglob("*")):
        try:
            if path.suffix not in _USD + GLTF:
                continue
            stage = Path(as_usd(str(path)))
            if _shows_glass(stage):
                yield Stage(str(path.relative_to(folder)), stage)
        except RefractError as error:
            print(f"left out {path.relative_to(folder)}: {error}", file=sys.stderr)


def _shows_glass(path: Path) -> bool:
    scene, settings = _opened(path, {"image_width": _LOOK, "samples": 1})
    if not any(material.refractive for material in scene.materials):
        return False
    return bool((rc.render(scene, settings).planes["mask"] > 0.0).any())


def _opened(path: Path, asked: dict[str, Any]) -> tuple[Scene, RenderSettings]:
    """A stage, and what it is drawn with where a person asks for something."""
    stage = open_stage(str(path))
    settings = chosen_settings(read_settings(stage), asked)
    return scene_from_stage(stage, purposes=settings.purposes, camera=settings.camera), settings


# ------------------------------------------------------------------------------------------------ how far they are


def measure(stage: Stage, options: Options) -> Row:
    """Draw a stage with every quality, and compare.

    Raises:
        RefractError: it cannot be drawn, or shows no glass.
    """
    asked = {"image_width": options.width, "jobs": options.jobs}
    converged = {**asked, "quality": "reference", "samples": options.reference_samples}
    reference = rc.render(*_opened(stage.path, converged))
    scores = {level: _score(stage, {**asked, "quality": level}, reference) for level in LEVELS}
    rays = _score(stage, {**asked, "quality": DEFAULT, "tiers": ("ray", "sky")}, reference)
    return Row(stage.name, scores, rays.glass)


def _score(stage: Stage, asked: dict[str, Any], reference: Frame) -> Score:
    scene, settings = _opened(stage.path, asked)
    start = time.process_time()
    frame = rc.render(scene, settings)
    seconds = time.process_time() - start
    glass = reference.planes["mask"] > 0.0
    return Score(_psnr(frame, reference, glass), _psnr(frame, reference, ~glass), seconds)


def _psnr(frame: Frame, reference: Frame, mask: Mask) -> float:
    picture, truth = (displayed(one.planes["beauty"][..., :3]) for one in (frame, reference))
    return psnr(picture, truth, mask) if mask.any() else math.nan


def warm_up(options: Options) -> None:
    """Draw a little with every quality, so that no stage pays for compiling."""
    for level in LEVELS:
        scene, settings = _opened(SAMPLES / "marble.usda", {"image_width": 32, "jobs": options.jobs, "quality": level})
        rc.render(scene, settings)


# ------------------------------------------------------------------------------------------------ what is printed


def table(rows: Sequence[Row]) -> str:
    """Markdown: a row for each stage, then why those are low that are."""
    head = ["stage", *(f"`{level}`" for level in LEVELS), f"`{DEFAULT}` by rays", "CPU seconds"]
    lines = [pages.table(head, [_cells(row) for row in rows])]
    if low := [row for row in rows if row.low]:
        lines += ["", f"\\* Below {ENOUGH:g} dB at the default quality:", ""]
        lines += [f"- `{row.name}`: {REASONS.get(row.name, UNKNOWN)}" for row in low]
    return "\n".join(lines)


def _cells(row: Row) -> list[str]:
    pairs = [" / ".join(_decibels(one) for one in row.scores[level][:2]) for level in LEVELS]
    seconds = " / ".join(f"{row.scores[level].seconds:.2f}" for level in LEVELS)
    return [f"`{row.name}`{' *' if row.low else ''}", *pairs, _decibels(row.rays), seconds]


def _decibels(value: float) -> str:
    return "-" if math.isnan(value) else "same" if math.isinf(value) else f"{value:.1f}"


def unexplained(rows: Iterable[Row]) -> list[str]:
    """Stages that are low for no named reason."""
    return [row.name for row in rows if row.low and row.name not in REASONS]


def block(rows: Sequence[Row], options: Options) -> str:
    """What the page gets: the table, and how it was made."""
    made = f"{options.width} pixels wide, against {options.reference_samples} samples a pixel"
    return f"Pictures are {made}; dB in glass / elsewhere.\n\n{table(rows)}"


def summary(rows: Sequence[Row]) -> str:
    """What README says of the samples."""
    values = sorted(row.scores[DEFAULT].glass for row in rows)
    enough = sum(value >= ENOUGH for value in values)
    return (
        f"Of {len(values)} samples, {enough} have {ENOUGH:g} dB or more in their glass at the default quality, against "
        "their own reference,\nand the others a reason that is named "
        f"(lowest {_decibels(values[0])} dB, median {_decibels(statistics.median(values))} dB)."
    )


def _measured(stages: Iterable[Stage], options: Options) -> list[Row]:
    rows = []
    for stage in stages:
        try:
            rows.append(measure(stage, options))
        except RefractError as error:
            print(f"left out {stage.name}: {error}", file=sys.stderr)
            continue
        print(" | ".join(_cells(rows[-1])), file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Print the tables, and write them into the page where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stages", default="", help="names, with commas; default: all")
    parser.add_argument("--image-width", type=int, default=320)
    parser.add_argument("--reference-samples", type=int, default=256)
    parser.add_argument("--assets", type=Path, default=ASSETS, help="folder of other people's stages")
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--write", action="store_true", help=f"into {PAGE.relative_to(pages.ROOT)} and README.md")
    chosen = parser.parse_args()
    if chosen.write and chosen.stages:
        parser.error("--write makes whole tables; leave out --stages")
    names = set(chosen.stages.split(",")) if chosen.stages else None
    options = Options(chosen.image_width, chosen.reference_samples, chosen.jobs)
    groups: dict[str, list[Stage]] = {"samples": samples(), "assets": []}
    if not names or names - {stage.name for stage in groups["samples"]}:
        groups["assets"] = [*assets(chosen.assets)]
    if names and (unknown := names - {stage.name for group in groups.values() for stage in group}):
        parser.error(f"--stages has {', '.join(sorted(unknown))}, which are not there")
    warm_up(options)
    found = {
        group: _measured([one for one in stages if not names or one.name in names], options)
        for group, stages in groups.items()
    }
    blocks = {group: block(rows, options) for group, rows in found.items() if rows}
    print("\n\n".join(blocks.values()))
    if chosen.write:
        pages.write(PAGE, blocks)
        pages.write(pages.README, {"accuracy": summary(found["samples"])})
    if lacking := unexplained([row for rows in found.values() for row in rows]):
        raise SystemExit(f"below {ENOUGH:g} dB, and `REASONS` does not say why: {', '.join(lacking)}")


if __name__ == "__main__":
    main()
