"""What a comparison leaves behind: a table for the terminal, `report.json` for programs, `report.html` for people.

The JSON (its `format` changes when a field does):

    {"format": "refract.compare/1", "engine": VERSION, "picture": PATH, "reference": PATH or "" where it was drawn,
     "width": N, "height": N, "made": {"picture": {...}, "reference": {...}} or {},
     "whole": SCORE, "glass": SCORE or null,
     "objects": [{"path": PRIM, "materials": [PATH, ...], "score": SCORE or null}, ...],
     "tiers": [{"tier": "screen" | ... | "none", "score": SCORE}, ...],
     "confidence": {"pixels": N, "pearson": R or null, "spearman": R or null} or null,
     "suggestions": [{"material": PATH, "best": LABEL, "now": LABEL, "notes": [TEXT, ...],
                      "trials": [{"label": LABEL, "model": TOKEN, "thickness": "authored" | "fitted" | "measured" | "",
                                  "value": LENGTH or null, "psnr": DB or null,
                                  "objects": {PRIM: DB or null}}, ...]}, ...] or null,
     "written": {"file": PATH, "changed": [PATH, ...], "score": SCORE} or null,
     "fail_under": DB or null, "passed": BOOL, "lacks": [TEXT, ...],
     "notices": [{"path": PATH, "text": TEXT}, ...]}

    SCORE = {"pixels": N, "psnr": DB or null where nothing differs, "ssim": S, "flip": F or null where it is lacking}
"""

from __future__ import annotations

import base64
import html
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ImageError, UsageError
from ..files import check_place, filling
from ..scene import F32, Notice
from ..version import __version__
from .compare_numbers import COVERED, Contrast, Findings, Score, Trial, Trials, Written

if TYPE_CHECKING:
    from ..images.frame import Frame

FORMAT = "refract.compare/1"
FILES = ("picture.exr", "reference.exr", "picture.png", "reference.png", "flip.png", "report.json", "report.html")
"""What comes into the folder. The .exr files hold all AOVs, and are not there for pictures that were files before."""


@dataclass(frozen=True, kw_only=True)
class Account:
    """All that a comparison has to say."""

    picture: str
    """Path of the stage, or of the picture."""
    reference: str
    """Path of the reference; '' where it was drawn."""
    size: tuple[int, int]
    """Width, height [pixels]."""
    findings: Findings
    made: Mapping[str, Any] = field(default_factory=dict)
    """What made the two; empty for files."""
    trials: tuple[Trials, ...] | None = None
    """None where nothing was to be suggested."""
    written: Written | None = None
    fail_under: float | None = None
    """[dB]"""
    notices: tuple[Notice, ...] = ()

    @property
    def passed(self) -> bool:
        return self.fail_under is None or self.findings.counted.psnr >= self.fail_under

    @property
    def verdict(self) -> str:
        """Why `--fail-under` fails; '' where it does not."""
        if self.passed:
            return ""
        where = "the glass" if self.findings.glass else "the picture"
        return f"{where} has {_db(self.findings.counted.psnr)} dB, which is under the {self.fail_under:g} dB asked for"


class Pictures(NamedTuple):
    """What is shown, and written beside the numbers."""

    frame: Frame | None
    """None where the picture is a file already."""
    reference: Frame | None
    contrast: Contrast


# --- the folder -----------------------------------------------------------------------------------------------------


def check_folder(out: str, *, overwrite: bool) -> None:
    """Refuse, before any work, a folder that no report can be written to. An earlier report may be replaced.

    Raises:
        UsageError: it is a file, or has something else in it.
        ImageError: it cannot be made, or nothing can be written to it.
    """
    path = out.rstrip("/") or out
    if not os.path.isdir(path):
        if os.path.lexists(path):
            raise UsageError(f"{out}: is a file; name a folder for the report")
        check_place(path, ImageError)
        return
    check_place(os.path.join(path, FILES[0]), ImageError)
    if os.listdir(path) and not (overwrite or _is_report(path)):
        raise UsageError(f"{out}: has files in it that are no report; name another folder, or add --overwrite")


def _is_report(folder: str) -> bool:
    try:
        found = json.loads(Path(folder, "report.json").read_text("utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and found.get("format") == FORMAT


def write_account(account: Account, pictures: Pictures, out: str) -> None:
    """Write the folder: whole, or not at all where it was not there before.

    Raises:
        ImageError: a file cannot be written.
    """
    from ..images.pictures import png_bytes

    shown = {
        "picture": png_bytes(_bytes(pictures.contrast.test)),
        "reference": png_bytes(_bytes(pictures.contrast.truth)),
    }
    if pictures.contrast.flip is not None:
        shown["flip"] = png_bytes(heat(pictures.contrast.flip))
    with filling(out, FILES, ImageError) as folder:
        for name, frame in (("picture", pictures.frame), ("reference", pictures.reference)):
            if frame is not None:
                frame.save(os.path.join(folder, f"{name}.exr"))
        for name, data in shown.items():
            Path(folder, f"{name}.png").write_bytes(data)
        Path(folder, "report.html").write_text(to_html(account, shown), "utf-8")
        Path(folder, "report.json").write_text(to_json(account) + "\n", "utf-8")


def _bytes(shown: F32) -> NDArray[np.uint8]:
    return (shown * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)


_HEAT = ("000004", "1c1044", "4f127b", "812581", "b5367a", "e55064", "fb8761", "fec287", "fcfdbf")
"""Magma at nine places (van der Walt and Smith, matplotlib 1.5, CC0), in which FLIP is shown by its authors."""


def heat(values: F32) -> NDArray[np.uint8]:
    """Numbers 0 .. 1 as colours, dark to bright.

    Args:
        values: shape (H, W).

    Returns:
        shape (H, W, 3).
    """
    table = np.array([[int(one[k : k + 2], 16) for k in (0, 2, 4)] for one in _HEAT], np.float64)
    at = np.linspace(0.0, 1.0, len(table))
    return np.stack([np.rint(np.interp(values, at, table[:, c])) for c in range(3)], axis=2).astype(np.uint8)


# --- for programs ---------------------------------------------------------------------------------------------------


def to_json(account: Account) -> str:
    """See the head of this module."""
    found = account.findings
    record = {
        "format": FORMAT,
        "engine": __version__,
        "picture": account.picture,
        "reference": account.reference,
        "width": account.size[0],
        "height": account.size[1],
        "made": account.made,
        "whole": _score(found.whole),
        "glass": _score(found.glass),
        "objects": [
            {"path": part.name, "materials": list(part.materials), "score": _score(part.score)}
            for part in found.objects
        ],
        "tiers": [{"tier": part.name, "score": _score(part.score)} for part in found.tiers],
        "confidence": None
        if found.confidence is None
        else {
            "pixels": found.confidence.pixels,
            "pearson": found.confidence.pearson,
            "spearman": found.confidence.spearman,
        },
        "suggestions": None if account.trials is None else [_trials(one) for one in account.trials],
        "written": None
        if account.written is None
        else {
            "file": account.written.file,
            "changed": list(account.written.changed),
            "score": _score(account.written.score),
        },
        "fail_under": account.fail_under,
        "passed": account.passed,
        "lacks": list(found.lacks),
        "notices": [{"path": notice.path, "text": notice.text} for notice in account.notices],
    }
    return json.dumps(record, indent=2, allow_nan=False)


def _score(score: Score | None) -> dict[str, Any] | None:
    if score is None:
        return None
    return {"pixels": score.pixels, "psnr": _finite(score.psnr), "ssim": score.ssim, "flip": score.flip}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _trials(one: Trials) -> dict[str, Any]:
    def record(trial: Trial) -> dict[str, Any]:
        return {
            "label": trial.label,
            "model": trial.model,
            "thickness": trial.thickness,
            "value": trial.value,
            "psnr": _finite(trial.psnr),
            "objects": {path: _finite(value) for path, value in trial.objects.items()},
        }

    return {
        "material": one.material,
        "best": one.best.label,
        "now": one.now.label,
        "notes": list(one.notes),
        "trials": [record(trial) for trial in one.trials],
    }


# --- tables, for both kinds of page ---------------------------------------------------------------------------------


class Table(NamedTuple):
    """Words in rows and columns."""

    title: str
    head: tuple[str, ...]
    """The first column is words, the others are numbers."""
    rows: list[tuple[str, ...]]
    below: tuple[str, ...] = ()
    """Sentences."""


def tables(account: Account) -> Iterator[Table]:
    """Everything that is found, in the order in which it is told."""
    yield _scores(account.findings)
    if account.trials is not None:
        yield _suggestions(account)


def _scores(found: Findings) -> Table:
    rows = [("whole picture", *_cells(found.whole))]
    if found.glass is not None:
        rows.append(("glass", *_cells(found.glass)))
    rows += [(part.name, *_cells(part.score)) for part in found.objects]
    rows += [(f"tier {part.name}", *_cells(part.score)) for part in found.tiers]
    return Table("Difference", ("", "pixels", "PSNR dB", "SSIM", "FLIP"), rows, tuple(_below(found)))


def _below(found: Findings) -> Iterator[str]:
    if any(part.score is None for part in found.objects):
        yield "-: no pixel shows it first, because other things or other glass are in front."
    if found.confidence is not None:
        numbers = found.confidence
        if numbers.spearman is None or numbers.pearson is None:
            yield "The confidence AOV goes with nothing: it, or the error, is the same everywhere in the glass."
        else:
            yield (
                f"Confidence against true error in the glass: rank correlation {numbers.spearman:+.2f} (Spearman), "
                f"linear {numbers.pearson:+.2f} (Pearson), {numbers.pixels} pixels; -1 would be a perfect warning."
            )
    for text in found.lacks:
        yield f"FLIP is left out: {text}."


def _cells(score: Score | None) -> tuple[str, ...]:
    if score is None:
        return "0", "-", "-", "-"
    flip = "-" if score.flip is None else f"{score.flip:.4f}"
    return str(score.pixels), _db(score.psnr), f"{score.ssim:.4f}", flip


def _db(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "same"


def _suggestions(account: Account) -> Table:
    """A row for each prim of each material, a column for each way to draw it."""
    trials = account.trials or ()
    labels = list(dict.fromkeys(trial.label for one in trials for trial in _by_label(one)))
    rows, below = [], []
    for one in trials:
        by_label = {trial.label: trial for trial in one.trials}
        for path in one.trials[0].objects:
            cells = [_tried(by_label.get(label), path, one.now) for label in labels]
            rows.append((path, *cells, one.best.label))
        below += [f"{one.material}: {note}." for note in one.notes]
    fitted = {f"{one.material} {trial.value:g}" for one in trials for trial in one.trials if trial.value is not None}
    if fitted:
        below.append(f"Fitted thickness, in stage units: {', '.join(sorted(fitted))}.")
    if rows:
        below.insert(0, "PSNR in dB in each prim's own pixels; * is what the stage has.")
    else:
        below.insert(0, "There is no glass to try anything on.")
    if account.written is not None:
        changed = ", ".join(account.written.changed)
        text = f"it changes {changed}" if changed else "it changes nothing, as there is nothing better"
        scores = account.written.score, account.findings.counted
        now, before = (f"{score.psnr:.2f} dB" if math.isfinite(score.psnr) else "no error" for score in scores)
        where = "the glass" if account.findings.glass else "the picture"
        below.append(f"{account.written.file}: written, {text}. With it {where} has {now}, before {before}.")
    return Table("Suggestions", ("prim", *labels, "best"), rows, tuple(below))


_ORDER = ("authored", "fitted", "measured", "")


def _by_label(one: Trials) -> list[Trial]:
    """Trials in an order that does not depend on what the stage has."""
    models = list(dict.fromkeys(sorted(trial.model for trial in one.trials)))
    return sorted(one.trials, key=lambda trial: (models.index(trial.model), _ORDER.index(trial.thickness)))


def _tried(trial: Trial | None, path: str, now: Trial) -> str:
    if trial is None:
        return ""
    return _db(trial.objects[path]) + ("*" if trial is now else "")


# --- for the terminal -----------------------------------------------------------------------------------------------


def to_text(account: Account, out: str = "") -> str:
    """For a person. `out`: the folder that was written, or ''."""
    lines = [_headline(account)]
    for table in tables(account):
        lines += ["", *_lined(table)]
    if out:
        lines += ["", f"{out}: written; open {os.path.join(out, 'report.html')}"]
    return "\n".join(lines)


def _headline(account: Account) -> str:
    size = f"{account.size[0]} x {account.size[1]}"
    against = f"against {account.reference}" if account.reference else "against its reference"
    return f"{account.picture} {against}, {size}{_samples(account)}"


def _samples(account: Account) -> str:
    made = account.made
    if not made:
        return ""
    return f", {made['picture']['samples']:g} and {made['reference']['samples']:g} samples per pixel"


def _lined(table: Table) -> Iterable[str]:
    lines = [table.head, *table.rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(table.head))]
    if table.rows:
        for line in lines:
            first, rest = line[0].ljust(widths[0]), zip(line[1:], widths[1:], strict=True)
            yield "  ".join((first, *(cell.rjust(width) for cell, width in rest))).rstrip()
    yield from table.below


# --- for people -----------------------------------------------------------------------------------------------------

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.3rem; overflow-wrap: anywhere; }}
h2 {{ font-size: 1.1rem; margin-top: 2rem; }}
figure {{ margin: 1rem 0; }}
img {{ display: block; width: 100%; {pixels} }}
.pair {{ position: relative; --at: 50%; }}
.pair img + img {{ position: absolute; inset: 0; clip-path: inset(0 0 0 var(--at)); }}
.pair::after {{ content: ""; position: absolute; top: 0; bottom: 0; left: var(--at); width: 2px; margin-left: -1px;
 background: #fff; box-shadow: 0 0 3px #000; pointer-events: none; }}
.pair input {{ position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; }}
.pair:focus-within {{ outline: 2px solid Highlight; }}
figcaption {{ display: flex; justify-content: space-between; gap: 1rem; }}
.scale {{ height: .8rem; background: linear-gradient(to right, {scale}); }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; }}
th, td {{ padding: .15rem .7rem; text-align: right; border-bottom: 1px solid #8886; white-space: nowrap;
 font-variant-numeric: tabular-nums; }}
th:first-child, td:first-child {{ text-align: left; }}
.failed {{ color: #c00; font-weight: bold; }}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def to_html(account: Account, shown: Mapping[str, bytes]) -> str:
    """One page with everything in it; it needs nothing else, from here or from the network.

    Args:
        shown: PNG files: `picture`, `reference`, and `flip` where there is one.
    """
    small = account.size[0] < 960
    return _PAGE.format(
        title=html.escape(_headline(account)),
        pixels="image-rendering: pixelated;" if small else "",
        scale=", ".join(f"#{color}" for color in _HEAT),
        body="\n".join(_body(account, shown)),
    )


def _body(account: Account, shown: Mapping[str, bytes]) -> Iterator[str]:
    if account.verdict:
        yield f'<p class="failed">Failed: {html.escape(account.verdict)}.</p>'
    yield (
        f'<figure><div class="pair">{_img(shown["picture"], "the picture")}{_img(shown["reference"], "the reference")}'
        '<input type="range" min="0" max="100" value="50" step="0.1" '
        'aria-label="How much of the picture is shown, from the left"'
        " oninput=\"this.parentNode.style.setProperty('--at', this.value + '%')\"></div>"
        "<figcaption><span>picture</span><span>drag to compare</span><span>reference</span></figcaption></figure>"
    )
    if "flip" in shown:
        yield (
            f'<h2>FLIP</h2><figure>{_img(shown["flip"], "FLIP heat map")}<div class="scale"></div>'
            "<figcaption><span>0: looks the same</span><span>1: could not look more different</span></figcaption>"
            "</figure>"
        )
    for table in tables(account):
        yield _tabled(table)
    yield (
        "<p>PSNR, SSIM (Wang et al. 2004) and FLIP (Andersson et al. 2020) of the pictures as they are shown: sRGB, "
        f"over black. A pixel is glass where the mask is {COVERED:g} or more, and a tier's where that tier's weight is "
        f"above {COVERED:g}; a prim has the pixels that show it first.</p>"
    )
    if account.notices:
        told = "".join(
            f"<li>{html.escape(notice.path)}: {html.escape(notice.text)}</li>" for notice in account.notices
        )
        yield f"<h2>What was said while drawing</h2><ul>{told}</ul>"
    if account.made:
        yield _tabled(_making(account.made))
    yield f"<p>refract {html.escape(__version__)}; the same numbers are in report.json.</p>"


def _making(made: Mapping[str, Mapping[str, Any]]) -> Table:
    names = list(dict.fromkeys(name for how in made.values() for name in how))
    rows = [(name, *(_word(how.get(name, "")) for how in made.values())) for name in names]
    return Table("How they were drawn", ("", *made), rows)


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _img(png: bytes, words: str) -> str:
    return f'<img alt="{words}" src="data:image/png;base64,{base64.b64encode(png).decode("ascii")}">'


def _tabled(table: Table) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    rows = "".join(row(cells, "td") for cells in table.rows)
    body = f'<div class="wide"><table>{row(table.head, "th")}{rows}</table></div>' if table.rows else ""
    return f"<h2>{html.escape(table.title)}</h2>{body}" + "".join(f"<p>{html.escape(one)}</p>" for one in table.below)
