"""`refract compare STAGE OUTDIR`: a picture of a stage against its reference, in numbers and side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import UsageError
from ..models import Model
from ..progress import Report
from ..scene import Notice, Scene
from ..settings import AS_IT_IS, QUALITIES, Opening, RenderSettings
from ..world.instances import apart
from .compare_numbers import Contrast, Findings, Mask, find, glass_of
from .compare_report import Account, Pictures, check_folder, write_account
from .orders import check_range, stop_if
from .owners import Owners, find_owners
from .render_files import chosen_settings

if TYPE_CHECKING:
    from ..images.frame import Frame
    from .suggest import Suggestion

SAMPLES = (1, 4096)
_MOST_APART = 1 << 21
"""Triangles that instances may have together for each of them to be judged by itself."""
STATE = "nothing was written"


@dataclass(frozen=True, kw_only=True)
class CompareOrder:
    """What to compare, and where to put what is found. Checked when made."""

    stage: str
    out: str
    """The folder; `compare_report.FILES` says what comes into it."""
    overrides: Mapping[str, object] = field(default_factory=dict)
    """Fields of `RenderSettings` that win over what the stage authors."""
    settings_prim: str = ""
    """RenderSettings prim whose authored values win over the defaults; '' is the one the stage names, if any."""
    time_code: float | None = None
    """None is the stage's start."""
    reference_samples: int = 64
    suggest: bool = False
    """Try other models and thicknesses on each glass material."""
    write: str = ""
    """Path of the layer over the stage that gets what is suggested; '' writes none."""
    fail_under: float | None = None
    """[dB] of the glass, or of everything where there is none."""
    overwrite: bool = False
    opening: Opening = AS_IT_IS
    """Session layer, variants and mask."""

    def __post_init__(self) -> None:
        check_range("--reference-samples", self.reference_samples, SAMPLES)
        if self.write and not self.suggest:
            raise UsageError("--write authors what --suggest finds; add --suggest")
        if self.suggest and self.overrides.get("model"):
            raise UsageError("--suggest tries the models itself, and --model would replace each; leave out --model")


def reference_settings(settings: RenderSettings, samples: int) -> RenderSettings:
    """What the reference of a picture is drawn with: the real way through every mesh, and a ray for whatever is behind.

    Args:
        settings: of the picture.
        samples: per pixel.
    """
    return replace(settings, **{**QUALITIES["reference"], "model": Model.TRACED.token, "samples": samples})


class Drawn(NamedTuple):
    """A picture, what it is measured by, and what draws another one under the same conditions."""

    scene: Scene
    settings: RenderSettings
    frame: Frame
    reference: Frame
    owners: Owners
    contrast: Contrast
    draw: Callable[[Scene, str], Frame]
    """A frame of another scene with the picture's settings; the text says what it is, for progress."""

    def against(self, frame: Frame) -> Contrast:
        """Another picture against the same reference."""
        return Contrast(frame.planes, self.reference.planes)


def compare_stage(order: CompareOrder, report: Report, cancel: Callable[[], bool]) -> Account:
    """Draw a stage, draw its reference, measure what differs, and write it down.

    Args:
        order: checked completely before the first ray, as far as that is possible.
        report: told about progress and notices.
        cancel: True stops the work; nothing is written then.

    Raises:
        RefractError: whatever goes wrong.
    """
    from ..usd.layers.write import check_out
    from ..usd.settings import read_settings
    from ..usd.stage import open_stage, scene_from_stage
    from .gltf import as_usd
    from .suggest import MADE, suggest

    chosen_settings({}, order.overrides)
    check_folder(order.out, overwrite=order.overwrite)
    if order.write:
        check_out(order.stage, order.write, overwrite=order.overwrite, ours=MADE)
    report.progress(0.0, "reading the stage")
    stage = open_stage(order.stage if order.suggest else as_usd(order.stage, report.warning), order.opening)
    notices: list[Notice] = []
    # A studio is not invented here: it would stand in the picture as in the reference, and hide what a stage lacks.
    bare = {"studio": "none"}
    settings = chosen_settings({**bare, **read_settings(stage, order.settings_prim, notices)}, order.overrides)
    if order.suggest and settings.model:
        raise UsageError(f"the stage's RenderSettings choose the model '{settings.model}'; --suggest needs none")
    if order.suggest:  # its trials have numbers that the stage does not have at other times
        settings = replace(settings, motion_blur=False)
    reader = partial(
        scene_from_stage, purposes=settings.purposes, camera=settings.camera, pixels=settings.longer_side
    )

    def read(stage: Any, time_code: float | None = order.time_code) -> Scene:
        return apart(reader(stage, time_code=time_code), _MOST_APART)

    scene = read(stage)
    drawn = _draw(order, scene, settings, report, cancel, partial(read, stage))
    notices += [*drawn.frame.notices, *_only_of_reference(drawn)]
    findings = find(drawn.contrast, drawn.frame.planes, _objects(drawn))
    suggestion: Suggestion | None = None
    if order.suggest:
        suggestion = suggest(order.stage, order.write, drawn, read, cancel, order.opening)
        notices += suggestion.notices
    for notice in dict.fromkeys(notices):
        report.warning(notice.path, notice.text)
    stop_if(cancel, STATE)
    account = _account(order, drawn, findings, suggestion, tuple(dict.fromkeys(notices)))
    write_account(account, Pictures(drawn.frame, drawn.reference, drawn.contrast), order.out)
    if suggestion is not None:
        suggestion.save()
    report.progress(1.0, "done")
    return account


def _draw(
    order: CompareOrder, scene: Scene, settings: RenderSettings, report: Report, cancel: Callable[[], bool],
    scene_at: Callable[[float], Scene],
) -> Drawn:  # fmt: skip
    """The picture, its reference, and whose pixel is whose."""
    from ..rendering.picture import render
    from ..rendering.session import Session

    session = Session()  # not for `find_owners`: its scene is another one, and would take the place of what is kept

    def draw(other: Scene, how: RenderSettings, what: str) -> Frame:
        stop_if(cancel, STATE)
        told = lambda share, stage: report.progress(share, f"{what}: {stage}")  # noqa: E731
        return render(other, how, progress=told, cancel=cancel, session=session, scene_at=scene_at)

    frame = draw(scene, settings, "picture")
    reference = draw(scene, reference_settings(settings, order.reference_samples), "reference")
    owners = find_owners(scene, settings, cancel)
    contrast = Contrast(frame.planes, reference.planes)
    return Drawn(
        scene, settings, frame, reference, owners, contrast, lambda other, what: draw(other, settings, what)
    )


def _only_of_reference(drawn: Drawn) -> list[Notice]:
    known = set(drawn.frame.notices)
    return [Notice(one.path, f"in the reference: {one.text}") for one in drawn.reference.notices if one not in known]


def _objects(drawn: Drawn) -> dict[str, tuple[Mask, tuple[str, ...]]]:
    """Every prim with glass on it: where it is seen first, and what glass it has."""
    glass = glass_of(drawn.frame.planes)
    found: dict[str, tuple[Mask, tuple[str, ...]]] = {}
    for path in dict.fromkeys(owner.path for owner in drawn.owners.every):
        seen = drawn.owners.pixels(lambda owner, path=path: owner.path == path)  # type: ignore[misc]
        names = tuple(owner.material for owner in drawn.owners.every if owner.path == path)
        found[path] = (seen if glass is None else seen & glass, names)
    return found


def _account(
    order: CompareOrder,
    drawn: Drawn,
    findings: Findings,
    suggestion: Suggestion | None,
    notices: tuple[Notice, ...],
) -> Account:
    return Account(
        picture=order.stage,
        reference="",
        size=(drawn.frame.width, drawn.frame.height),
        made=_made(drawn),
        findings=findings,
        trials=suggestion.trials if suggestion else None,
        written=suggestion.written if suggestion else None,
        fail_under=order.fail_under,
        notices=notices,
    )


def _made(drawn: Drawn) -> dict[str, Any]:
    """What made the two pictures, for whoever wants to make them again."""

    def how(frame: Frame) -> dict[str, Any]:
        return {name.removeprefix("refract:"): value for name, value in frame.metadata.items() if name != "software"}

    return {"picture": how(drawn.frame), "reference": how(drawn.reference)}
