"""Baking thickness: what rays find in the geometry, as primvars or pictures in a layer over the stage.

Values are in scene units of the stage's world, as the renderer takes them: a prim under a scale of 2 gets twice the
thickness. What is measured along a ray is said at the head of `thickness`.
"""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import Cancelled, StageError, UsageError
from ..files import folder_beside
from ..images.bake_files import file_names
from ..progress import Report
from ..scene import F32, Notice
from ..version import __version__
from .measure_thickness import How, Row, Work, measure_all

if TYPE_CHECKING:
    from ..usd.thickness_find import Candidate, Found

ALONG = ("normal", "refracted")
TEXTURE = (16, 8192)
_JOBS = (0, 4096)


@dataclass(frozen=True, kw_only=True)
class ThicknessOrder:
    """What to measure, and where to write it. Checked when made."""

    stage: str
    out: str
    """The layer over the stage; pictures go into the folder `<stem of out>.thickness` beside it, or into a .usdz."""
    only: tuple[str, ...] = ()
    """Prim paths, or paths of prims above, with * and ? for any characters; () means all glass."""
    along: str = "normal"
    texture: int = 0
    """[texels] on a side of a picture in each object's own uv; 0 writes primvars."""
    jobs: int = 0
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.along not in ALONG:
            raise UsageError(f"--along is '{self.along}', which is not known; choose from {', '.join(ALONG)}")
        if self.texture:
            _in_range("--texture", self.texture, TEXTURE)
        _in_range("--jobs", self.jobs, _JOBS)


def _in_range(name: str, value: int, limits: tuple[int, int]) -> None:
    if isinstance(value, bool) or not limits[0] <= value <= limits[1]:
        raise UsageError(f"{name} is {value}; it must be between {limits[0]} and {limits[1]}")


# --- the verb -------------------------------------------------------------------------------------------------------


def bake_thickness(order: ThicknessOrder, report: Report, cancel: Callable[[], bool]) -> tuple[Row, ...]:
    """Measure the glass of a stage and write a layer over it that says how thick it is.

    Args:
        order: checked completely before the first ray, as far as that is possible.
        report: told about progress, what is left alone and why, and what was measured on each prim.
        cancel: True stops the work; nothing is written.

    Raises:
        RefractError: whatever goes wrong.
    """
    from ..usd.layers.write import check_out, is_over, overlay, save
    from ..usd.stage import open_stage
    from ..usd.thickness import MADE, lost_bindings, write_maps, write_values
    from ..usd.thickness_find import find

    check_out(order.stage, order.out, overwrite=order.overwrite, ours=MADE)
    report.progress(0.0, "reading the stage")
    stage = open_stage(order.stage)
    found = find(stage)
    chosen = _chosen(found, order.only)
    for notice in found.notices:
        report.warning(notice.path, notice.text)
    if not chosen:
        report.warning(order.stage, "has no glass; OUT is a layer that changes nothing")
    with folder_beside(order.out, "thickness") as folder:
        files = _files(chosen, folder) if order.texture else {}
        if not (order.overwrite or is_over(order.out, order.stage, made=MADE)):
            _refuse_existing(files.values())
        how = How(order.along, order.texture, order.jobs, lambda: _stop_if(cancel))
        work = measure_all(found, chosen, how, files, report.progress)
        _stop_if(cancel)
        layer = overlay(order.stage, made=MADE)
        write_values(layer, stage, work.values, _unmapped(work))
        bound = write_maps(layer, stage, work.maps)
        _tell(report, found, work, lost_bindings(layer, bound))
        _write_pictures(work.pictures)
        save(layer, order.out)
    left = len(work.left) + len(work.fixed)
    report.done(order.out, f"{len(work.rows)} prims measured along {order.along}, {left} left alone")
    return tuple(work.rows)


def bake_over(
    layer: Any,
    prims: Sequence[str],
    *,
    along: str = "normal",
    jobs: int = 0,
    cancel: Callable[[], bool] = lambda: False,
) -> tuple[Notice, ...]:
    """Author the measured thickness of prims in a layer over their stage, as primvars, in place of typed ones.

    Args:
        layer: an Sdf.Layer that holds the stage or has it as a sublayer, with the materials as they are to be.
        prims: paths; what of them is no glass, or not below the layer, is passed over.

    Returns:
        What was left as it was, and why.
    """
    from ..usd.thickness import write_values
    from ..usd.thickness_find import find, stage_of

    stage = stage_of(layer)
    found = find(stage)
    wanted = set(prims)
    chosen = [candidate for candidate in found.candidates if wanted & set(candidate.paths)]
    how = How(along, 0, jobs, lambda: _stop_if(cancel))
    work = measure_all(found, chosen, how, {}, lambda _fraction, _text: None)
    write_values(layer, stage, work.values, _unmapped(work))
    return tuple(work.left)


def _chosen(found: Found, only: tuple[str, ...]) -> list[Candidate]:
    if not only:
        return list(found.candidates)
    for pattern in only:
        if not any(_matches(one, pattern) for one in found.candidates):
            known = ", ".join(one.path for one in found.candidates[:8]) or "none"
            raise UsageError(f"--only {pattern}: no glass is there; the stage has {known}")
    return [one for one in found.candidates if any(_matches(one, pattern) for pattern in only)]


def _matches(candidate: Candidate, pattern: str) -> bool:
    patterns = pattern, f"{pattern.rstrip('/')}/*"
    return any(fnmatch.fnmatchcase(path, form) for path in candidate.paths for form in patterns)


def _tell(report: Report, found: Found, work: Work, lost: Iterable[Notice]) -> None:
    for notice in (*work.left, *lost):
        report.warning(notice.path, notice.text)
    for path in work.fixed:
        report.done(path, "left alone: its model fixes the thickness")
    measured = {row.path for row in work.rows}
    for coat in work.coats.values():
        others = sorted(found.bound_to[coat.material] - measured)
        if others and coat.edit:
            text = f"its thickness is disconnected, also for {others[0]}, which was not measured and takes the constant"
            report.warning(coat.edit, text)
    for row in work.rows:
        report.done(row.path, "; ".join((f"{row.least:.4g} to {row.most:.4g}, mean {row.mean:.4g}", row.how)))
        for note in row.notes:
            report.warning(row.path, note)


def _stop_if(cancel: Callable[[], bool]) -> None:
    if cancel():
        raise Cancelled("cancelled; nothing was written")


def _unmapped(work: Work) -> list[str]:
    return [coat.edit for coat in work.coats.values() if coat.edit]


# --- pictures -------------------------------------------------------------------------------------------------------


def _files(chosen: list[Candidate], folder: str) -> dict[str, str]:
    """A picture's path for each prim."""
    return {path: os.path.join(folder, name) for path, name in file_names(one.path for one in chosen).items()}


def _refuse_existing(files: Iterable[str]) -> None:
    for file in files:
        if os.path.lexists(file):
            raise UsageError(f"{file}: exists already; choose another OUT, or replace it with --overwrite")


def _write_pictures(pictures: dict[str, F32]) -> None:
    from ..images.pictures import write_map

    for file, picture in pictures.items():
        try:
            Path(file).parent.mkdir(exist_ok=True)
        except OSError as error:
            raise StageError(f"{Path(file).parent}: cannot be made: {error.strerror}; choose another OUT") from error
        write_map(file, picture, {"software": f"refract {__version__}"})
