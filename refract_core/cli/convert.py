"""`refract convert`."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from ..models import MODELS
from .app import Mask, ProgressMode, Quiet, SessionLayer, Variant, Verbose, app, only_option, opening_of, outcome, words

if TYPE_CHECKING:
    from ..verbs.convert import Converted, ConvertOrder, Row

In = Annotated[
    str,
    typer.Argument(
        metavar="IN", help="The stage to read: .usd, .usda, .usdc, .usdz, or with the gltf extra .glb, .gltf."
    ),
]
Out = Annotated[
    str,
    typer.Argument(
        metavar="OUT", help="The .usd, .usda, .usdc or .usdz file to write: a thin layer over IN, or all of it. A .glb "
        "or .gltf file has all that is drawn, with the KHR extensions of glass, a .mtlx file its materials as OpenPBR."
    ),
]
Flatten = Annotated[
    bool, typer.Option("--flatten", help="Write everything into OUT. Without it OUT is a layer that needs IN below it.")
]
ModelName = Annotated[
    str,
    typer.Option(
        "--model", metavar="|".join(MODELS), help="Use this model for all glass, whatever its shape."
    ),
]
Only = Annotated[str, only_option("materials")]
Thickness = Annotated[
    str,
    typer.Option(
        metavar="typed|measured",
        help="Where a thickness comes from: typed is one number per shape, a ball's diameter or a box's smallest side "
        "(the default); measured is what `refract bake thickness` finds.",
    ),
]
To = Annotated[
    str,
    typer.Option(
        metavar="preview|openpbr|gltf|mtlx",
        help="Write the nearest standard surface back on each material too, for other renderers. What a .glb, .gltf or "
        ".mtlx file is its name says: there gltf and mtlx may be left out.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it exists. IN is never changed.")]
Json = Annotated[bool, typer.Option("--json", help="Print what was done as JSON instead of a table.")]


@app.command("convert")
def convert_command(
    stage: In,
    out: Out,
    flatten: Flatten = False,
    model: ModelName = "",
    only: Only = "",
    thickness: Thickness = "typed",
    to: To = "",
    overwrite: Overwrite = False,
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
    as_json: Json = False,
    progress: ProgressMode = "auto",
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find the glass of a stage and describe it with RefractMaterialAPI.

    The model follows the shape a material is on: a closed convex ball is a sphere, a closed convex box a box, what is
    open is thin, and everything else is traced, hollow bodies too. Materials that have RefractMaterialAPI are left
    alone.
    """
    from ..verbs.convert import ConvertOrder, convert

    with outcome(progress, quiet, verbose) as (report, cancel):
        order = ConvertOrder(
            stage=stage, out=out, flatten=flatten, model=model, only=words(only), thickness=thickness, to=to,
            overwrite=overwrite, opening=opening_of(variant, session_layer, mask),
        )  # fmt: skip
        found = convert(order, report.progress, cancel)
        for notice in found.notices:
            report.warning(notice.path, notice.text)
    if as_json or not quiet:
        typer.echo(_as_json(order, found) if as_json else _as_table(order, found.rows))


def _as_json(order: ConvertOrder, found: Converted) -> str:
    """Keys: stage, out, materials (the fields of `Row`), notices (path, text)."""
    lists = {"materials": [asdict(row) for row in found.rows], "notices": [asdict(one) for one in found.notices]}
    return json.dumps({"stage": order.stage, "out": order.out, **lists}, indent=2)


_HEAD = ("material", "from", "model", "ior", "thickness", "colour", "distance", "abbe", "why")


def _as_table(order: ConvertOrder, rows: tuple[Row, ...]) -> str:
    """One line for each material, its notes below it, and what became of all."""
    if not rows:
        return f"{order.out}: written; no glass was found in {order.stage}"
    cells = [_HEAD, *(_cells(row) for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(_HEAD))]
    lines = []
    for number, line in enumerate(cells):
        lines.append("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
        if number:
            lines.extend(f"    {note}" for note in rows[number - 1].notes)
    counts = {action: sum(row.action == action for row in rows) for action in ("applied", "kept", "skipped")}
    told = ", ".join(f"{count} {action}" for action, count in counts.items() if count)
    return "\n".join([*lines, f"{order.out}: written; {len(rows)} refractive materials: {told}"])


def _cells(row: Row) -> tuple[str, ...]:
    if row.action != "applied":
        return (row.path, row.shader or "-", row.action, "", "", "", "", "", row.why)
    color = (
        "mapped" if row.color_from else "" if row.color == (1.0, 1.0, 1.0) else ",".join(f"{v:.3g}" for v in row.color)
    )
    numbers = ("" if value is None else f"{value:.4g}" for value in (row.thickness, row.distance))
    thickness, distance = numbers
    abbe = f"{row.abbe:.4g}" if row.abbe else ""
    return (row.path, row.shader or "-", row.model, f"{row.ior:.4g}", thickness, color, distance, abbe, row.why)
