"""What a worker does with a stage, once it is confined: the command line's verbs, with results in a folder.

Texts that leave are made for strangers: no path of this machine, and no line of a file.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from refract_core.errors import EmbreeError, ImageError, RefractError, SceneError, StageError, UsageError
from refract_core.images.aovs import AOVS
from refract_core.images.frame import Frame
from refract_core.progress import Report
from refract_core.scene import Cubemap, Notice, Probe, Scene
from refract_core.settings import NO_ORBIT, RenderSettings
from refract_core.verbs.override import OverrideError, Overrides, override, override_notes

from . import formats, reading, uploads, views
from .discreet import own_folders, own_places, without_folders
from .problems import Problem

Verb = Callable[[str, str, Mapping[str, Any], Mapping[str, int], "Say"], Any]
"""Does a job: stage, folder of results, settings, limits, and how to tell of it."""
Say = Callable[..., None]
"""Tells the server something: `say(progress=0.5, stage="image")`, `say(path=..., warning=...)`."""

_QUOTES = (
    r"(?<= gave up): .*|\S*:\d+:\d+: .*|\(recompos[^)]*\)| -- .*|\b(?:syntax|parse) error.*|\(line .*|"
    r"\S*pxrInternal.*"
)
"""Where USD's messages begin to quote files, or its own source."""
_PARSED = re.compile(r":(?P<line>\d{1,9}):(?P<column>\d{1,9}): (?:Expected (?P<wanted>[!-~]{1,20}) at ')?")
"""Where USD's parser stopped, and what it waited for: words of its grammar, before those of the file."""
_CUT_OFF = "the package has no directory at its end, so it was cut off"
_UNITS = ("Z", "thickness", "path_length", "layers")
"""Planes that are not between 0 and 1: their PNG is scaled, and says by how much."""
_SETTINGS = ("camera", "image_width", "image_height", "quality", "preset", "samples", "tolerance", "light_samples",
             "caustics", "indirect", "cut", "tiers", "screen", "model", "max_layers", "denoise", "exposure",
             "motion_blur", "camera_light", "emission_light", "studio", "background", "purposes", "azimuth",
             "elevation", "distance", "fit", "fov", "focal_length", "look_at")  # fmt: skip


def laid_out(stage: str, root: str, settings: Mapping[str, Any], limits: Mapping[str, int]) -> tuple[str, str]:
    """An upload of several files as a folder, which becomes the current one. Anything else stays as it is.

    Returns:
        The stage, relative to the current folder, and that folder.

    Raises:
        Problem: a file is refused, or none of them is the stage.
    """
    if not stage.endswith(uploads.ARCHIVE):
        return stage, root
    folder = os.path.realpath(tempfile.mkdtemp(prefix="upload-"))
    chosen = uploads.stage_among(uploads.unpack(stage, folder, limits), settings.get("stage") or "")
    os.chdir(folder)
    return chosen, folder


def perform(
    kind: str, stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say,
    verb: Verb | None = None,
) -> Any:  # fmt: skip
    """Do one job. `stage` is relative to the current folder. Returns what the job's record keeps of it.

    Args:
        verb: in place of the one that `kind` names.

    Raises:
        Problem: for the client.
    """
    from refract_core.images import codec

    codec.MAX_TEXTURE_PIXELS = min(codec.MAX_TEXTURE_PIXELS, limits["texture_pixels"])
    try:
        if kind != "convert" and stage.lower().endswith(uploads.GLTF):
            stage = _as_usd(stage, say, limits)
        return (verb or _VERBS[kind])(stage, out, settings, limits, say)
    except StageError as error:
        raise Problem("stage-invalid", _public(str(error))) from None
    except UsageError as error:
        if str(error).startswith("camera ") and settings.get("camera"):
            raise Problem("invalid-settings", _public(str(error)),
                          errors=[{"pointer": "/camera", "detail": "the stage has no such camera"}]) from None
        if (field := str(error).partition(" ")[0]) in NO_ORBIT:
            raise Problem("invalid-settings", _public(str(error)),
                          errors=[{"pointer": f"/{field}", "detail": _public(str(error))}]) from None
        if str(error).startswith("variant "):
            raise Problem("invalid-settings", _public(str(error)),
                          errors=[{"pointer": "/variants", "detail": "the stage has no such variant"}]) from None
        if "needs the extra `gltf`" in str(error):
            text = "glTF is not read here: the extra `gltf` is not installed"
            raise Problem("unsupported-media-type", text) from None
        raise Problem("invalid-settings", _public(str(error))) from None
    except (SceneError, ImageError) as error:
        if "cannot be encoded" in str(error):  # a picture of ours, not of the stage
            _check_room(limits["result_bytes"])
            text = "a picture of this size and form is larger than this service or its format allows"
            raise Problem("limit-exceeded", text) from error
        raise Problem("stage-invalid", _public(str(error))) from None
    except EmbreeError as error:
        slug = "memory-limit" if "memory" in str(error) else "stage-invalid"
        raise Problem(slug, "the scene could not be made ready for rays") from None
    except (MemoryError, np.exceptions.AxisError) as error:
        raise Problem("memory-limit", "the job ran out of memory") from error
    except RefractError as error:
        raise Problem("stage-invalid", _public(str(error))) from None


def _check_room(size: int) -> None:
    """Writers of pictures do not say why they fail. Raises OSError where there is no room for the largest result."""
    with tempfile.TemporaryFile() as file:
        os.posix_fallocate(file.fileno(), 0, size)


def _as_usd(stage: str, say: Say, limits: Mapping[str, int]) -> str:
    """A glTF file as USD with its glass described, as `refract convert` makes it, in a folder that becomes the current
    one."""
    from refract_core.verbs.convert import ConvertOrder, convert

    from . import precheck

    say(progress=0.0, stage="reading glTF")
    folder, name = tempfile.mkdtemp(prefix="gltf-"), f"{os.path.splitext(os.path.basename(stage))[0]}.usdz"
    done = convert(ConvertOrder(stage=stage, out=os.path.join(folder, name)))
    _tell(done.notices, say, limits)
    os.chdir(folder)
    try:
        precheck.check_size(name, limits["prims"])
    except precheck.TooMany as error:
        raise Problem("limit-exceeded", str(error)) from None
    return name


def _public(text: str) -> str:
    """A message without USD's own words, which quote files, and without paths of this machine; with the place that
    USD's words are about."""
    place = _place_of(text)
    name, unreadable, why = text.partition(" cannot be read as ")
    if unreadable:
        ours = f": {_CUT_OFF}" if _CUT_OFF in why else ""
        text = f"{name} cannot be read as USD{ours}"
    if text.startswith("USD says:"):
        return f"USD warned about this stage{place}; `refract render` on it shows what it said"
    text = re.sub(_QUOTES, "", text).strip() + place
    return without_folders(text, {*own_folders(), *own_places()})[:500]


def _place_of(text: str) -> str:
    """`: line 7, column 5: expected }` of a message in which USD quotes a layer it cannot parse; else ''."""
    found = _PARSED.search(text)
    if not found:
        return ""
    wanted = f": expected {found['wanted']}" if found["wanted"] else ""
    return f": line {found['line']}, column {found['column']}{wanted}"


def _tell(notices: tuple[Notice, ...] | list[Notice], say: Say, limits: Mapping[str, int]) -> None:
    once = dict.fromkeys((_public(notice.path), _public(notice.text)) for notice in notices)
    for path, text in list(once)[: limits["warnings"]]:
        say(path=path, warning=text)


# --- render ---------------------------------------------------------------------------------------------------------


def _render(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say) -> Any:
    from refract_core.rendering.picture import render
    from refract_core.rendering.ready import camera_of
    from refract_core.rendering.session import Session
    from refract_core.usd.opening import select_variants
    from refract_core.usd.settings import read_settings
    from refract_core.usd.stage import open_stage, scene_from_stage
    from refract_core.verbs.render_files import chosen_settings, with_features
    from refract_core.view.camera import image_size

    say(progress=0.0, stage="reading the stage")
    opened = open_stage(stage)
    select_variants(opened, settings.get("variants") or ())
    told: list[Notice] = []
    authored = read_settings(opened, "", told)
    wanted = chosen_settings(authored, {**asked_of(settings), "jobs": settings["threads"]})
    wanted = with_features(wanted, settings.get("aovs") or ())
    overrides = settings.get("overrides") or {}
    sizes = [(width, 0) for width in settings.get("widths") or ()] or [(wanted.image_width, wanted.image_height)]
    times = settings.get("time_codes") or [settings.get("time_code")]
    count = len(sizes) * len(times)
    session = Session() if count > 1 else None
    done: list[dict[str, Any]] = []
    for time_code in times:
        chosen: dict[str, Any] = {
            "purposes": wanted.purposes, "camera": wanted.camera, "orbits": wanted.orbits,
            "pixels": max(side for size in sizes for side in size),
        }  # fmt: skip
        scene = scene_from_stage(opened, time_code=time_code, **chosen)
        reading.has_ended()
        check_scene(scene, limits)
        measured = [image_size(camera_of(scene, _sized(wanted, size)), *size) for size in sizes]
        _check_sizes(measured, len(times), wanted.samples, settings["format"], limits)
        scene = overridden(scene, overrides)
        told += scene.notices

        def scene_at(time_code: float, chosen: dict[str, Any] = chosen) -> Scene:
            then = scene_from_stage(opened, time_code=time_code, **chosen)
            check_scene(then, limits)
            return override(then, overrides, strict=False)  # what it names may be hidden then

        for size in sizes:
            progress = _share_of(say, len(done), count)
            frame = render(scene, _sized(wanted, size), session=session, progress=progress, scene_at=scene_at)
            told += frame.notices
            frame = replace(frame, metadata={**frame.metadata, **override_notes(overrides)})
            _save_picture(frame, out, settings, f"picture.{len(done)}" if count > 1 else "image")
            done.append({"width": frame.width, "height": frame.height, "time_code": float(scene.time_code)})
    view = views.start_of(scene, wanted.camera)
    _tell(told, say, limits)
    whole = {"width": done[0]["width"], "height": done[0]["height"]}
    if count > 1:
        _pack_pictures(out, settings["format"], done)
        return {**whole, "pictures": done}
    return {**whole, "view": view, "aovs": _save_planes(frame, out, settings)}


def _sized(settings: RenderSettings, size: tuple[int, int]) -> RenderSettings:
    return replace(settings, image_width=size[0], image_height=size[1])


def asked_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """What settings ask of `RenderSettings`."""
    return _asked(settings, *_SETTINGS)


def _share_of(say: Say, before: int, count: int) -> Callable[[float, str], None]:
    """Progress of one picture of several as that of all."""
    return lambda share, work: say(progress=(before + share) / count, stage=work)


def _save_picture(frame: Frame, out: str, settings: Mapping[str, Any], name: str) -> None:
    """The picture; where the format holds them, with the planes that were asked for, or all where none was."""
    extension, aovs = settings["format"], settings.get("aovs") or []
    held = tuple(dict.fromkeys(("beauty", *aovs))) if aovs and extension == "exr" else ()
    correction = settings.get("color_correction") or "sRGB"
    frame.save(os.path.join(out, f"{name}.{extension}"), aovs=held, color_correction=correction)


def _save_planes(frame: Frame, out: str, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every plane that was asked for as a PNG of its own. Returns what white means in each."""
    kept = []
    for name in settings.get("aovs") or []:
        if name == "P":  # no picture holds positions
            continue
        white, shown = 1.0, frame
        if name in _UNITS:
            plane = frame.planes[name]
            finite = plane[np.isfinite(plane)]
            white = max(float(finite.max()) if finite.size else 1.0, 1e-9)
            shown = replace(frame, planes={name: (plane / np.float32(white)).astype(np.float32)})
        correction = settings.get("color_correction") or "sRGB"
        shown.save(os.path.join(out, f"aov.{name}.png"), aovs=[name], color_correction=correction)
        kept.append({"name": name, "white": white})
    return kept


def _pack_pictures(out: str, extension: str, done: list[dict[str, Any]]) -> None:
    """All pictures in one archive, beside themselves."""
    with contextlib.ExitStack() as files:
        named = {
            f"{number:04}_{one['width']}x{one['height']}.{extension}": files.enter_context(
                open(os.path.join(out, f"picture.{number}.{extension}"), "rb")
            )
            for number, one in enumerate(done)
        }
        uploads.pack(named, os.path.join(out, "pictures.zip"))


def check_scene(scene: Scene, limits: Mapping[str, int]) -> None:
    triangles = sum(len(mesh.triangles) for mesh in scene.meshes)
    triangles += sum(len(many) * len(many.mesh.triangles) for many in scene.instances)
    triangles += sum(len(balls) for balls in scene.balls)
    if triangles > limits["triangles"]:
        raise Problem("limit-exceeded", f"the stage has {triangles} triangles; the limit is {limits['triangles']}")


def _check_size(width: int, height: int, samples: int, limits: Mapping[str, int]) -> None:
    asked = {"side": max(width, height), "pixels": width * height, "samples": samples,
             "pixel_samples": width * height * samples}  # fmt: skip
    for name, value in asked.items():
        if value > limits[name]:
            what = f"{width} x {height} pixels with {samples} samples"
            raise Problem("limit-exceeded", f"{what}: {name} would be {value}; the limit is {limits[name]}")


def _check_sizes(
    sizes: list[tuple[int, int]], times: int, samples: int, extension: str, limits: Mapping[str, int]
) -> None:  # fmt: skip
    longest = formats.BY_EXTENSION[extension].longest_side
    for width, height in sizes:
        _check_size(width, height, samples, limits)
        if max(width, height) > longest:
            text = f"{width} x {height} pixels are more than a .{extension} can hold; its sides have at most {longest}"
            raise Problem("invalid-settings", text, errors=[{"pointer": "/format", "detail": text}])
    every = times * samples * sum(width * height for width, height in sizes)
    if every > limits["pixel_samples"]:
        what = f"{times * len(sizes)} pictures from {sizes[0][0]} x {sizes[0][1]} pixels on, with {samples} samples"
        text = f"{what}: pixel_samples would be {every}; the limit is {limits['pixel_samples']}"
        raise Problem("limit-exceeded", text)


def overridden(scene: Scene, overrides: Overrides) -> Scene:
    try:
        return override(scene, overrides)
    except OverrideError as error:
        at = "".join(f"/{pointer(step)}" for step in ("overrides", error.path, error.field) if step)
        about = "asks for a value that cannot be" if error.field else "names nothing that is drawn; see /v1/inspect"
        raise Problem("invalid-settings", f"an override {about}", prim=error.path,
                      errors=[{"pointer": at, "detail": _public(str(error))}]) from None  # fmt: skip


def pointer(text: str) -> str:
    """One step of a JSON pointer (RFC 6901)."""
    return text.replace("~", "~0").replace("/", "~1")


# --- the other verbs ------------------------------------------------------------------------------------------------


def _inspect(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say) -> Any:
    from refract_core.verbs import inspect as room

    report = room.inspect(stage)
    _write(out, _clean(report))
    return {}


def _validate(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say) -> Any:
    from refract_core.verbs import validate as room

    verdict = room.validate(room.ValidateOrder(stage=stage))
    _write(out, _clean(json.loads(room.to_json(verdict))))
    return {}


def _convert(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say) -> Any:
    from refract_core.verbs.convert import ConvertOrder, convert

    order = ConvertOrder(
        stage=stage, out=os.path.join(out, "converted.usdz"), flatten=bool(settings.get("flatten")),
        model=settings.get("model") or "", only=tuple(settings.get("only") or ()),
        thickness=settings.get("thickness") or "typed", to=settings.get("to") or "",
    )  # fmt: skip

    def progress(share: float, work: str) -> None:
        if share > 0.0:  # what is told of after the stage has been read
            reading.has_ended()
        say(progress=share, stage=work)

    done = convert(order, progress)
    _tell(done.notices, say, limits)
    _write(out, _clean({
        "stage": stage, "out": "converted.usdz", "materials": [asdict(row) for row in done.rows],
        "notices": [asdict(notice) for notice in done.notices],
    }))  # fmt: skip
    return {}


def _bake_probes(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say) -> Any:
    from refract_core.rendering.ready import capture_probes
    from refract_core.verbs.bake_probes import BakeOrder, bake_probes

    made = os.path.join(out, "baked.usdz")
    order = BakeOrder(stage=stage, out=made, jobs=settings["threads"], **_asked(settings, "only", "resolution",
                      "layout", "samples"))  # fmt: skip
    rays = 0

    def capture(scene: Scene, probes: Sequence[Probe], **how: Any) -> list[Cubemap]:
        """As many probes as are captured together, where the limits allow them and all before them."""
        nonlocal rays
        check_scene(scene, limits)
        for probe in probes:
            _check_size(6 * probe.resolution, probe.resolution, order.samples, limits)
            rays += 6 * probe.resolution**2 * order.samples
        if rays > limits["pixel_samples"]:
            text = f"probes up to {probes[-1].path}, with {order.samples} samples: pixel_samples would be {rays}"
            raise Problem("limit-exceeded", f"{text}; the limit is {limits['pixel_samples']}")
        return capture_probes(scene, list(probes), **how)

    return _baked(stage, made, lambda report: bake_probes(order, report, lambda: False, capture=capture), limits, say)


def _bake_thickness(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say) -> Any:
    from refract_core.verbs.bake_thickness import ThicknessOrder, bake_thickness

    made = os.path.join(out, "baked.usdz")
    order = ThicknessOrder(stage=stage, out=made, jobs=settings["threads"], **_asked(settings, "only", "along",
                           "texture"))  # fmt: skip
    return _baked(stage, made, lambda report: bake_thickness(order, report, lambda: False), limits, say)


def _asked(settings: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """The settings that were given; what is left out is as on the command line."""
    asked = {name: settings[name] for name in names if settings.get(name) is not None}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in asked.items()}


def _baked(
    stage: str, made: str, bake: Callable[[Report], Any], limits: Mapping[str, int], say: Say
) -> dict[str, Any]:  # fmt: skip
    """Bake, and write what was told of it as the report."""
    notices: list[Notice] = []
    done: list[dict[str, str]] = []

    def progress(share: float, work: str) -> None:
        if share > 0.0:
            reading.has_ended()
        say(progress=share, stage=work)

    bake(Report(progress, lambda path, text: notices.append(Notice(path, text)),
                lambda path, text: done.append({"path": path, "text": text}), lambda _text: None))  # fmt: skip
    _tell(notices, say, limits)
    _write(os.path.dirname(made), _clean({
        "stage": stage, "out": os.path.basename(made), "summary": done[-1]["text"], "prims": done[:-1],
        "notices": [asdict(notice) for notice in notices],
    }))  # fmt: skip
    return {}


def _clean(value: Any) -> Any:
    """Every text in a report, for strangers; numbers that JSON does not have are null."""
    if isinstance(value, str):
        return _public(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _clean(inner) for key, inner in value.items()}
    return [_clean(inner) for inner in value] if isinstance(value, list | tuple) else value


def _write(out: str, report: Any) -> None:
    with open(os.path.join(out, "report.json"), "w", encoding="utf-8") as file:
        json.dump(report, file, allow_nan=False, indent=2)


_VERBS = {
    "render": _render, "inspect": _inspect, "validate": _validate, "convert": _convert, "bake-probes": _bake_probes,
    "bake-thickness": _bake_thickness,
}  # fmt: skip
assert set(_UNITS) <= AOVS.keys()
