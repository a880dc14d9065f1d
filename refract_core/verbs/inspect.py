"""`refract inspect`: one screen about a stage.

The JSON of `--json` (its `format` changes when a field does; lengths are metres):

    {"format": "refract.inspect/1", "stage": STAGE, "engine": VERSION,
     "up_axis": "Y" | "Z", "metres_per_unit": x, "metres_per_unit_authored": bool,
     "time": {"start": x, "end": x, "authored": bool, "frames_per_second": x},
     "prims": {"all", "meshes", "materials", "lights", "instances", "instancers"},       counts
     "settings": {"tiers": [...], "max_layers": n, "samples": n},       of a render without flags
     "cameras": [{"path", "used": bool, "orthographic": bool}],         `used` first; none: everything is framed
     "environment": bool,                                               a dome light
     "glass": [{"path", "material", "by": "RefractMaterialAPI" | "surface shader",
                "model", "ior": {"value": x or null, "by": "constant" | "texture" | "primvar"},
                "roughness": as ior, "transmittance_color": {"value": [r, g, b] or null, "by"}, linear,
                "absorption_distance": x,      white light has that colour after so much of the glass
                "thickness": {"how": "typed" | "default" | "mapped" | "measured" | "fixed" | "unused",
                              "least": x, "most": x},
                "closed": bool, "convex": bool, "size": [x, y, z] ascending, along its own axes,
                "layers": n or null,           refractive surfaces along nine view rays through it, at most
                "tiers": [...],                those that have an answer for it, in order
                "probes": [{"path", "share": 0..1}]}],
     "probes": [{"path", "mode", "planar": bool, "texture": STATE, "resolution": n, "covers": [glass path, ...]}],
     "unsupported": [FINDING], "suspicious": [FINDING]}                 as in `refract validate --json`

    STATE: none (captured for every render), baked, stale, unknown (it does not say what it was made from), custom,
    missing, realtime, planar. "layers" is null where the glass is too much to try.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..models import Behind
from ..scene import F64, Camera, Param, Source
from ..settings import AS_IT_IS, Opening
from ..usd.materials.read import API
from ..usd.rules.findings import WARNING, Finding
from ..usd.rules.glass import Glass
from ..usd.rules.overview import Overview, overview_of
from ..usd.rules.probes import share
from ..usd.values import neat
from ..version import __version__
from ..world.solid import crossings
from .gltf import as_usd
from .orders import stop_if
from .validate import SEVERITIES, finding_record

FORMAT = "refract.inspect/1"
WIDTH = 100
_ROWS = {"glass": 10, "probes": 5, "unsupported": 5, "suspicious": 4}
"""Entries of each list that the plain text shows."""
_TESTS = 20_000_000
"""Ray-triangle tests spent on counting layers."""

Report = dict[str, Any]


def inspect(stage: str, cancel: Callable[[], bool] = lambda: False, opening: Opening = AS_IT_IS) -> Report:
    """Look through a stage; see the head of this module for what comes back.

    Raises:
        StageError: the stage cannot be opened.
    """
    seen = overview_of(as_usd(stage), opening)
    stop_if(cancel)
    scene = seen.scene
    shares = [[(probe.path, share(probe, piece)) for probe in scene.probes] for piece in seen.glass]
    layers = _layers(scene.cameras[0] if scene.cameras else None, seen.glass)
    return {
        "format": FORMAT,
        "stage": stage,
        "engine": __version__,
        "up_axis": seen.up_axis,
        "metres_per_unit": scene.metres_per_unit,
        "metres_per_unit_authored": seen.unit_authored,
        "time": {
            "start": seen.times[0],
            "end": seen.times[1],
            "authored": seen.times_authored,
            "frames_per_second": seen.frames_per_second,
        },
        "prims": seen.prims,
        "settings": {
            "tiers": list(seen.settings.tiers),
            "max_layers": seen.settings.max_layers,
            "samples": seen.settings.samples,
        },
        "cameras": _cameras(scene.cameras),
        "environment": scene.environment is not None,
        "glass": [
            _glass(piece, seen, inside, count)
            for piece, inside, count in zip(seen.glass, shares, layers, strict=True)
        ],
        "probes": _probes(seen, shares),
        "unsupported": [finding_record(finding, stage) for finding in seen.unsupported],
        "suspicious": [finding_record(finding, stage) for finding in [*seen.suspicious, *_too_deep(seen, layers)]],
    }  # fmt: skip


def _cameras(cameras: Sequence[Camera]) -> list[Report]:
    return [
        {"path": camera.path, "used": place == 0, "orthographic": camera.orthographic}
        for place, camera in enumerate(cameras)
        if camera.path
    ]


def _glass(piece: Glass, seen: Overview, inside: list[tuple[str, float]], layers: int | None) -> Report:
    """One piece of glass as JSON has it."""
    reached = [{"path": path, "share": round(part, 3)} for path, part in inside if part > 0.0]
    thickness = piece.thickness
    how = "default" if thickness.how == "typed" and piece.row.name not in seen.typed else thickness.how
    return {
        "path": piece.path,
        "material": piece.row.name,
        "by": API if piece.row.name in seen.with_api else "surface shader",
        "model": piece.model.name.lower(),
        "ior": _number(piece.row.inputs[Param.IOR]),
        "roughness": _number(piece.row.inputs[Param.ROUGHNESS]),
        "transmittance_color": _colour(piece.row.inputs[Param.TRANSMITTANCE]),
        "absorption_distance": neat(piece.row.absorption_distance),
        "thickness": {"how": how, "least": neat(thickness.low), "most": neat(thickness.high)},
        "closed": piece.closed,
        "convex": piece.convex,
        "size": [neat(side) for side in piece.sides],
        "layers": layers,
        "tiers": _tiers(seen, bool(reached)),
        "probes": reached,
    }


def _by(source: Source) -> str:
    return "texture" if source.texture >= 0 else "primvar" if source.primvar else "constant"


def _number(source: Source) -> Report:
    return {"value": None if source.driven else neat(source.value[0]), "by": _by(source)}


def _colour(source: Source) -> Report:
    return {"value": None if source.driven else [neat(part) for part in source.value[:3]], "by": _by(source)}


def _tiers(seen: Overview, reached: bool) -> list[str]:
    """Tiers that have something to say."""
    able = {
        "screen": True,
        "ray": True,
        "probe": reached,
        "sky": seen.scene.environment is not None,
    }
    return [tier for tier in seen.settings.tiers if able[tier]]


def _probes(seen: Overview, shares: list[list[tuple[str, float]]]) -> list[Report]:
    """The probes as JSON has them."""
    return [
        {
            "path": probe.path,
            "mode": probe.mode,
            "planar": probe.planar,
            "texture": seen.states[probe.path],
            "resolution": probe.resolution,
            "covers": [piece.path for piece, row in zip(seen.glass, shares, strict=True) if row[place][1] > 0.0],
        }
        for place, probe in enumerate(seen.scene.probes)
    ]


def _too_deep(seen: Overview, layers: list[int | None]) -> list[Finding]:
    """Glass behind more glass than a render draws."""
    most, limit = max((count or 0 for count in layers), default=0), seen.settings.max_layers
    if most <= limit:
        return []
    path = seen.glass[layers.index(most)].path
    text = f"{most} refractive surfaces lie behind one another, but a ray enters {limit} at most"
    return [Finding("refract.too-many-layers", WARNING, path, text, f"render with --max-layers {min(most, 32)}")]


# --- layers ---------------------------------------------------------------------------------------------------------


def _layers(camera: Camera | None, glass: list[Glass]) -> list[int | None]:
    """How many refractive surfaces nine view rays through each piece enter at most; None where that is too much.

    As in rendering, any side of an open or thin surface counts, and the outer side of a solid.
    """
    if camera is None or not glass:
        return [None] * len(glass)
    low = np.array([piece.points.min(axis=0) for piece in glass])
    high = np.array([piece.points.max(axis=0) for piece in glass])
    if 9 * len(glass) * max(len(piece.triangles) for piece in glass) * 3 > _TESTS or len(glass) > 1000:
        return [None] * len(glass)
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)] + [(0, 0, 0)]) * 0.5
    counts: list[int | None] = []
    for place in range(len(glass)):
        targets = (low[place] + high[place]) / 2 + corners * (high[place] - low[place]) / 2
        counts.append(max(_crossed(*ray, glass, low, high) for ray in map(lambda at: _ray(camera, at), targets)))
    return counts


def _ray(camera: Camera, target: F64) -> tuple[F64, F64]:
    """Where the view ray through a point starts, and its direction."""
    pose = camera.world_from_camera
    back = pose[:3, 2]
    origin = target + back * float((pose[:3, 3] - target) @ back) if camera.orthographic else pose[:3, 3]
    direction = target - origin
    return origin, direction / max(float(np.linalg.norm(direction)), 1e-300)


def _crossed(origin: F64, direction: F64, glass: list[Glass], low: F64, high: F64) -> int:
    """Surfaces that a ray enters."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / direction, (high - origin) / direction
    near, far = np.nanmax(np.minimum(a, b), axis=1), np.nanmin(np.maximum(a, b), axis=1)
    return sum(_entries(origin, direction, glass[i]) for i in np.flatnonzero((near <= far) & (far > 0.0)))


def _entries(origin: F64, direction: F64, piece: Glass) -> int:
    """Surfaces of one piece of glass that a ray enters."""
    if piece.radius > 0.0:
        to = piece.points[0] - origin
        along = float(to @ direction)
        struck = along > 0.0 and float(to @ to) - along**2 < piece.radius**2 < float(to @ to)
        return int(struck) * (2 if piece.model.behind is Behind.SHEET else 1)
    distances, inwards = crossings(piece.points[piece.triangles], origin, direction)
    either = not piece.closed or piece.model.behind is Behind.SHEET
    met = distances if either else distances[inwards]
    # A ray through the edge of two triangles meets both of them.
    return int(len(met) > 0) + int((np.diff(met) > 1e-6 * met[1:]).sum())


# --- words ----------------------------------------------------------------------------------------------------------


def to_json(report: Report) -> str:
    """See the head of this module."""
    return json.dumps(report, indent=2)


def to_json_of_many(reports: Sequence[Report]) -> str:
    """An array of them."""
    return json.dumps(list(reports), indent=2)


def to_text(report: Report) -> str:
    """One screen for a person: at most 100 columns and about 50 lines."""
    glass, probes = report["glass"], report["probes"]
    lines = [*_head(report), f"glass       {len(glass) or 'none'}"]
    if glass:
        lines += _cut(_table([_HEADINGS, *map(_row, glass)]), _ROWS["glass"] + 1)
        if any(piece["by"] != API for piece in glass):
            lines.append("  * glass by its surface shader, without RefractMaterialAPI")
    lines.append(f"probes      {len(probes) or 'none'}")
    lines += _cut([_of_probe(probe, len(glass)) for probe in probes], _ROWS["probes"])
    lines.append(f"unsupported {len(report['unsupported']) or 'nothing'}")
    lines += _cut([f"  {entry['path']}: {entry['text']}" for entry in report["unsupported"]], _ROWS["unsupported"])
    lines.append(f"suspicious  {len(report['suspicious']) or 'nothing'}")
    lines += _suspicions(report["suspicious"])
    return "\n".join(_fitted(line) for line in lines)


def _head(report: Report) -> list[str]:
    """The lines about the stage as a whole."""
    unit, time, prims = report["metres_per_unit"], report["time"], report["prims"]
    guess = "" if report["metres_per_unit_authored"] else " (metersPerUnit is not authored)"
    start, end = time["start"], time["end"]
    when = f"time {start:g} to {end:g} at {time['frames_per_second']:g} fps" if end != start else f"time {start:g}"
    cameras = [camera["path"] + (" (used)" if camera["used"] else "") for camera in report["cameras"]]
    more = f", and {len(cameras) - 3} more" if len(cameras) > 3 else ""
    sky = "a dome" if report["environment"] else "no dome"
    settings = report["settings"]
    counted = [f"{number} {_many(name, number)}" for name, number in prims.items() if number and name != "lights"]
    return [
        report["stage"],
        f"stage       {report['up_axis']} up, 1 unit = {unit:g} m{guess}, {when}",
        f"prims       {', '.join(counted)}",
        f"cameras     {', '.join(cameras[:3]) + more if cameras else 'none; one that frames everything is used'}",
        f"lights      {prims['lights'] or 'none'}, {sky}",
        f"settings    tiers {','.join(settings['tiers'])}; {settings['max_layers']} surfaces entered at most",
    ]


def _many(name: str, number: int) -> str:
    if name == "all":
        return "in all"
    return name if number != 1 else name.removesuffix("s")


_HEADINGS = ("  prim", "model", "ior", "thickness [m]", "shape", "layers", "tiers")


def _row(piece: Report) -> tuple[str, ...]:
    """The cells of one piece of glass, under `_HEADINGS`."""
    ior, thickness = piece["ior"], piece["thickness"]
    least, most = thickness["least"], thickness["most"]
    amount = f"{most:.4g}" if least == most else f"{least:.3g}..{most:.3g}"
    shape = f"{'closed' if piece['closed'] else 'open'}{' convex' if piece['convex'] else ''}"
    return (
        f"  {piece['path']}",
        piece["model"] + ("" if piece["by"] == API else "*"),
        f"{ior['value']:.4g}" if ior["by"] == "constant" else ior["by"],
        "by the mesh" if thickness["how"] == "unused" else f"{amount} {thickness['how']}",
        shape,
        "?" if piece["layers"] is None else str(piece["layers"]),
        ",".join(piece["tiers"]) or "none",
    )


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    """Columns as wide as their widest cell; the first gives way where a line would be too long."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    widths[0] = max(20, min(widths[0], WIDTH - sum(widths[1:]) - 2 * (len(widths) - 1)))
    lines = ["  ".join(_fitted(cell, wide).ljust(wide) for cell, wide in zip(row, widths, strict=True)) for row in rows]
    return [line.rstrip() for line in lines]


def _of_probe(probe: Report, glass: int) -> str:
    kind = "planar" if probe["planar"] else probe["mode"]
    picture = {"none": "not baked", "planar": "", "realtime": ""}.get(probe["texture"], f"texture {probe['texture']}")
    covers = f"covers {len(probe['covers'])} of {glass}" if glass else "no glass to cover"
    words = (probe["path"], kind, picture, f"{probe['resolution']} px", covers)
    return "  " + "  ".join(word for word in words if word)


def _suspicions(entries: list[Report]) -> list[str]:
    """The first of each rule, with how many there are."""
    rules: dict[str, list[Report]] = {}
    for entry in sorted(entries, key=lambda entry: SEVERITIES.index(entry["severity"])):
        rules.setdefault(entry["rule"], []).append(entry)
    lines: list[str] = []
    for same in list(rules.values())[: _ROWS["suspicious"]]:
        first, more = same[0], f" and {len(same) - 1} more" if len(same) > 1 else ""
        lines.append(f"  {first['severity']} {first['rule']}  {first['path']}{more}")
        lines += textwrap.wrap(first["text"], WIDTH, initial_indent="    ", subsequent_indent="    ")[:2]
        lines += textwrap.wrap(f"fix: {first['fix']}", WIDTH, initial_indent="    ", subsequent_indent="      ")[:2]
    if len(rules) > _ROWS["suspicious"]:
        lines.append(f"  ... and {len(rules) - _ROWS['suspicious']} more rules; --json and refract validate list all")
    return lines


def _cut(lines: list[str], most: int) -> list[str]:
    if len(lines) <= most:
        return lines
    return [*lines[:most], f"  ... and {len(lines) - most} more; --json lists all"]


def _fitted(text: str, width: int = WIDTH) -> str:
    """Cut in the middle where it is too long: the ends of a path tell most."""
    if len(text) <= width:
        return text
    head = (width - 3) // 2
    return f"{text[:head]}...{text[len(text) - (width - 3 - head) :]}"
