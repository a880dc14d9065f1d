"""What a person changes about a stage as it is opened, without a word in its files: session layer, variants, a mask."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd

from ..errors import UsageError
from ..settings import Opening
from .diagnostics import captured, opened
from .layers import mtlx
from .layers.write import STAYS_BELOW

_SHOWN = 8


def mask_of(opening: Opening) -> Usd.StagePopulationMask | None:
    """The mask that an opening asks for; None where it asks for none.

    Raises:
        UsageError: a word of it is no prim path.
    """
    if not opening.mask:
        return None
    for path in opening.mask:
        absolute = path.startswith("/") and Sdf.Path.IsValidPathString(path)
        if not (absolute and Sdf.Path(path).IsAbsoluteRootOrPrimPath()):
            raise UsageError(f"--mask {path[:200]}: is no prim path; write /A or /A/B, with commas between several")
    return Usd.StagePopulationMask([Sdf.Path(path) for path in opening.mask])


def open_as(stage: Usd.Stage, opening: Opening) -> None:
    """Apply an opening to a stage, in its session layer, which no file is behind.

    A mask takes with it the materials that what it shows is bound to, and what those are connected to.

    Raises:
        UsageError: the layer cannot be read; there is no such prim, set or variant. It names the flag.
    """
    if opening.session_layer:
        _lay_over(stage, opening.session_layer)
    mask = mask_of(opening)
    if mask and stage.GetPopulationMask() != mask:
        stage.SetPopulationMask(mask)
    try:
        select_variants(stage, opening.variants)
    except UsageError as error:
        raise UsageError(f"--{error}") from error
    if mask:
        for path in opening.mask:
            if not stage.GetPrimAtPath(path):
                above = _nearest(stage, Sdf.Path(path))
                raise UsageError(f"--mask {path}: the stage has no such prim; {_children(above)}")
        with captured():
            stage.ExpandPopulationMask(
                relationshipPredicate=lambda relationship: relationship.GetName().startswith("material:binding"),
                attributePredicate=lambda _attribute: True,
            )


def _lay_over(stage: Usd.Stage, name: str) -> None:
    """A layer file as the strongest of a stage. It becomes a sublayer, so that nothing is ever written into it."""
    path = os.path.abspath(name)
    if not Path(path).is_file():
        raise UsageError(f"--session-layer {name}: there is no such file; name a .usd, .usda or .usdc layer")
    layer, reason = opened(lambda: Sdf.Layer.FindOrOpen(path))
    if layer is None:
        raise UsageError(f"--session-layer {name}: cannot be read as .usd, .usda or .usdc: {reason}")
    with captured():
        if not layer.dirty:
            layer.Reload()  # USD keeps layers in memory; a changed file would show its old content
        session = stage.GetSessionLayer()
        session.subLayerPaths.insert(0, path)
        for key in layer.pseudoRoot.ListInfoKeys():  # a stage takes its metadata from two layers alone, none below them
            if key not in STAYS_BELOW:
                session.pseudoRoot.SetInfo(key, layer.pseudoRoot.GetInfo(key))
        mtlx.stand_in(stage)


def _nearest(stage: Usd.Stage, path: Sdf.Path) -> Usd.Prim:
    """The deepest prim above a path that there is."""
    while not stage.GetPrimAtPath(path):
        path = path.GetParentPath()
    return stage.GetPrimAtPath(path)


def _children(prim: Usd.Prim) -> str:
    # The mask hides the siblings of what it asks for, so they are read where they are authored.
    names: dict[str, None] = {}
    if prim.IsPseudoRoot():
        for layer in prim.GetStage().GetLayerStack():
            names |= {child.name: None for child in layer.rootPrims if child.specifier == Sdf.SpecifierDef}
    else:
        names = dict.fromkeys(prim.GetPrimIndex().ComputePrimChildNames()[0])
    return f"{prim.GetPath()} has {_listed(names)}"


def _listed(names: Iterable[Any]) -> str:
    every = [str(name) for name in names]
    return ", ".join(every[:_SHOWN]) + (", ..." if len(every) > _SHOWN else "") if every else "nothing below it"


def select_variants(stage: Usd.Stage, chosen: Iterable[str]) -> None:
    """Choose variants over what the stage itself chooses, in its session layer.

    Args:
        chosen: as USD writes them, `/World/Car{paint=red}`; without a path, `{paint=red}` is of the default prim.

    Raises:
        UsageError: there is no such prim, set or variant.
    """
    for text in chosen:
        said = f"variant '{text[:200]}'"
        place, brace, rest = text.partition("{")
        group, sign, name = rest.removesuffix("}").partition("=")
        written = brace and sign and rest.endswith("}") and group and name and len(text) < 2000
        if not written or (place and not Sdf.Path.IsValidPathString(place)):
            raise UsageError(f"{said} is not written as /Prim{{set=name}}")
        prim = stage.GetPrimAtPath(place) if place else stage.GetDefaultPrim()
        if not prim:
            what = "such prim" if place else "default prim"
            raise UsageError(f"{said}: the stage has no {what}; {_with_sets(stage)}")
        known = prim.GetVariantSets().GetNames()
        if group not in known:
            raise UsageError(f"{said}: the prim has no set '{group}'; it has the sets {', '.join(known) or '(none)'}")
        one = prim.GetVariantSet(group)
        if name not in one.GetVariantNames():
            raise UsageError(f"{said}: '{group}' has no '{name}'; choose from {', '.join(one.GetVariantNames())}")
        with Usd.EditContext(stage, stage.GetSessionLayer()), captured():
            one.SetVariantSelection(name)
            mtlx.stand_in(stage)


def _with_sets(stage: Usd.Stage) -> str:
    """Which prims can be asked for a variant."""
    found = []
    for prim in stage.Traverse():
        found += [f"{prim.GetPath()}{{{name}=...}}" for name in prim.GetVariantSets().GetNames()]
        if len(found) > _SHOWN:
            break
    return f"it has {_listed(found)}" if found else "no prim of it has variants"
