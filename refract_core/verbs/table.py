"""What commands do, as functions of Python: arguments instead of flags, records instead of printed words.

    rc.convert("shop.usda", "glass.usda")
    for row in rc.bake_thickness("glass.usda", "thick.usda"):
        print(row.path, row.mean)

Each function's further arguments are the fields of the order it gives: `ConvertOrder`, `BakeOrder` and so on.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from ..errors import UsageError
from ..images.frame import Frame
from ..progress import Report
from ..scene import Notice, Scene
from ..settings import AS_IT_IS, Opening

if TYPE_CHECKING:
    from pxr import Sdf, Usd

    from . import bake_thickness as thickness_room
    from .compare_report import Account
    from .convert import Converted
    from .validate import Verdict

Path = str | os.PathLike[str]
Progress = Callable[[float, str], None]
Cancel = Callable[[], bool]
Order = TypeVar("Order")


class Baked(NamedTuple):
    """What a bake wrote."""

    files: dict[str, str]
    """path -> what became of it, OUT last"""
    notices: tuple[Notice, ...]


def load_stage(
    path: Path | Usd.Stage | Sdf.Layer,
    *,
    time_code: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    camera: str = "",
    complexity: str = "low",
    pixels: int = 0,
    opening: Opening = AS_IT_IS,
) -> Scene:
    """Read a stage at one time; of a .mtlx file, balls of its materials; of glTF, what `convert` makes of it.

    Args:
        path: of a file; or a stage that is open, or a layer as the root of one, with what was edited and not saved.
            They are not changed, and how a stage is loaded, masked and muted is as its owner has it.
        time_code: None takes the stage's startTimeCode, or 0 where it has none.
        purposes: which of default, render, proxy and guide are drawn.
        camera: prim path or name of the camera that `Scene.cameras` begins with; '' chooses one.
        complexity: how fine subdivision surfaces are: low, medium, high or veryhigh.
        pixels: longer side of the pictures that will be drawn; above 1024 surfaces of few faces are finer, as `render`
            makes them.
        opening: session layer, variants and mask; of files, for an open stage is its owner's to change.

    Raises:
        StageError: the stage cannot be opened or read.
        UsageError: it has no such camera, there is no such complexity, the opening asks for what is not there, glTF
            needs an extra that is not installed, or `path` is none of the three.
    """
    from ..usd.stage import load_stage as of_usd
    from .gltf import as_usd

    lost: list[Notice] = []
    if isinstance(path, str | os.PathLike):
        path = as_usd(os.fspath(path), lambda where, text: lost.append(Notice(where, text)))
    how: dict[str, Any] = {"purposes": purposes, "camera": camera, "complexity": complexity, "pixels": pixels}
    scene = of_usd(path, time_code=time_code, opening=opening, **how)
    return replace(scene, notices=(*lost, *scene.notices)) if lost else scene


def convert(stage: Path, out: Path, *, progress: Progress | None = None, cancel: Cancel | None = None,
            **how: Any) -> Converted:  # fmt: skip
    """Write a layer over a stage that adds the schema to the glass it has; or a .glb, .gltf or .mtlx of it.

    Args:
        how: fields of `verbs.convert.ConvertOrder`: `model`, `thickness`, `only`, `to`, `overwrite`, ...

    Raises:
        UsageError: an argument is not known or makes no sense, or OUT cannot be used.
        StageError: the stage cannot be read, or OUT cannot be written.
        Cancelled: `cancel` said so; nothing was written.
    """
    from . import convert as room

    order = _order(room.ConvertOrder, "convert", how, stage=os.fspath(stage), out=os.fspath(out))
    return room.convert(order, progress or _unheard, cancel or _never)


def bake_probes(stage: Path, out: Path, *, progress: Progress | None = None, cancel: Cancel | None = None,
                **how: Any) -> Baked:  # fmt: skip
    """Take the pictures of a stage's probes, and write a layer over it that uses them.

    Args:
        how: fields of `verbs.bake_probes.BakeOrder`: `only`, `resolution`, `samples`, `force`, `overwrite`, ...

    Raises:
        RefractError: whatever goes wrong.
    """
    from . import bake_probes as room

    order = _order(room.BakeOrder, "bake_probes", how, stage=os.fspath(stage), out=os.fspath(out))
    listener = _Listener(progress)
    room.bake_probes(order, listener.report(), cancel or _never)
    return Baked(listener.files, tuple(listener.notices))


def bake_thickness(stage: Path, out: Path, *, progress: Progress | None = None, cancel: Cancel | None = None,
                   **how: Any) -> tuple[thickness_room.Row, ...]:  # fmt: skip
    """Measure how thick a stage's glass is, and write a layer over it that says so.

    Args:
        how: fields of `verbs.bake_thickness.ThicknessOrder`: `only`, `along`, `texture`, `overwrite`, ...

    Returns:
        What was measured on each prim, in scene units.

    Raises:
        RefractError: whatever goes wrong.
    """
    from . import bake_thickness as room

    order = _order(room.ThicknessOrder, "bake_thickness", how, stage=os.fspath(stage), out=os.fspath(out))
    return room.bake_thickness(order, _Listener(progress).report(), cancel or _never)


def inspect(stage: Path, *, opening: Opening = AS_IT_IS, cancel: Cancel | None = None) -> dict[str, Any]:
    """What is in a stage: units, cameras, glass, probes, and what is suspicious; as `refract inspect --json` has it.

    Raises:
        StageError: the stage cannot be opened.
    """
    from . import inspect as room

    return room.inspect(os.fspath(stage), cancel or _never, opening)


def validate(stage: Path, *, cancel: Cancel | None = None, **how: Any) -> Verdict:
    """Check a stage by our rules and USD's own; with `fix`, write the mended layer and check that.

    Args:
        how: fields of `verbs.validate.ValidateOrder`: `fix`, `overwrite`, `opening`.

    Raises:
        StageError: the stage cannot be opened, or the layer cannot be written.
        UsageError: an argument is not known, or the layer may not be written there.
    """
    from . import validate as room

    return room.validate(_order(room.ValidateOrder, "validate", how, stage=os.fspath(stage)), cancel or _never)


def compare(one: Path | Frame, other: Path | Frame, *, progress: Progress | None = None,
            cancel: Cancel | None = None, **how: Any) -> Account:  # fmt: skip
    """Measure how far one picture is from another, or a stage's picture from its reference.

    Args:
        one: a frame or a picture; or a stage.
        other: the reference, a frame or a picture; of a stage, the folder for the report.
        how: of pictures `out`, `fail_under`, `overwrite`; of a stage, fields of `verbs.compare_renders.CompareOrder`.

    Returns:
        `account.findings` has the numbers.

    Raises:
        UsageError: sizes differ, a frame meets a stage, or an argument is not known.
        RefractError: whatever goes wrong.
    """
    from . import compare_pictures as pictures
    from . import compare_renders as renders

    if isinstance(one, Frame) or isinstance(other, Frame):
        if how:
            raise UsageError(f"compare: '{min(how)}' is for files; save the frames and compare these")
        return pictures.compare_planes(*(_planes(each) for each in (one, other)))
    if _is_picture(one):
        order = _order(pictures.PicturesOrder, "compare", how, picture=os.fspath(one), reference=os.fspath(other))
        return pictures.compare_pictures(order)
    stage = _order(renders.CompareOrder, "compare", how, stage=os.fspath(one), out=os.fspath(other))
    return renders.compare_stage(stage, _Listener(progress).report(), cancel or _never)


def _planes(one: Path | Frame) -> tuple[str, dict[str, Any]]:
    """A frame or a picture by name, and its planes."""
    from ..images.pictures import read_planes

    return ("a frame", one.planes) if isinstance(one, Frame) else (os.fspath(one), read_planes(os.fspath(one)))


def _is_picture(path: Path) -> bool:
    from ..images.pictures import EIGHT_BIT, LAYERED

    return os.path.splitext(os.fspath(path))[1].lower() in LAYERED + EIGHT_BIT


def _order(kind: type[Order], verb: str, how: dict[str, Any], **given: str) -> Order:
    """The order of a verb. Raises UsageError where it has no such field."""
    known = [one.name for one in fields(kind) if one.name not in given]  # type: ignore[arg-type]
    for name in how:
        if name not in known:
            raise UsageError(f"{verb}: there is no argument '{name}'; choose from {', '.join(known)}")
    return kind(**given, **how)


class _Listener:
    """Keeps what a verb says; warnings are notices, and progress goes to whoever asked."""

    def __init__(self, progress: Progress | None) -> None:
        self.progress = progress or _unheard
        self.files: dict[str, str] = {}
        self.notices: list[Notice] = []

    def report(self) -> Report:
        """Where the verb's words go."""
        return Report(
            self.progress, lambda path, text: self.notices.append(Notice(path, text)), self.files.__setitem__,
            lambda _text: None,
        )  # fmt: skip


def _unheard(_fraction: float, _stage: str) -> None:
    pass


def _never() -> bool:
    return False
