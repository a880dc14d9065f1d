"""Lights and cameras written as glTF and read back: the same light at a place, the same pixels of a view."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_convert import run
from test_convert_to_gltf import document

from refract_core.errors import StageError
from refract_core.scene import Camera, Light, LightKind, Scene
from refract_core.usd.stage import load_stage
from refract_core.verbs.convert import ConvertOrder, convert

pytest.importorskip("pygltflib")

HEAD = '#usda 1.0\n(\nmetersPerUnit = {unit}\nupAxis = "{up}"\n)\n'
BALL = 'def Sphere "Ball"\n{\ndouble radius = 1\n}\n'
PLACE = """double3 xformOp:translate = (3, 4, 5)
    float3 xformOp:rotateXYZ = (20, -30, 40)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
"""


def stage(folder: Path, body: str, *, unit: float = 1.0, up: str = "Y") -> str:
    path = folder / "in.usda"
    path.write_text(HEAD.format(unit=unit, up=up) + BALL + f'def Xform "Rig"\n{{\n{body}\n}}\n')
    return str(path)


def light(kind: str, said: str, api: str = "") -> str:
    return f'def {kind} "Lamp" {api}\n{{\n{said}\n{PLACE}\n}}'


def written(folder: Path, body: str, **how: Any) -> tuple[Scene, Scene, dict[str, Any], str]:
    """The scene, that of the file read back, the file, and what was told."""
    path, file, back = stage(folder, body, **how), folder / "f.glb", folder / "back.usda"
    made = convert(ConvertOrder(stage=path, out=str(file)))
    told = "\n".join(f"{notice.path}: {notice.text}" for notice in made.notices)
    run(str(file), back)
    return load_stage(path), load_stage(str(back)), document(file), told


def only(scene: Scene) -> Light:
    (found,) = scene.lights
    return found


def entry(file: dict[str, Any]) -> dict[str, Any]:
    assert "KHR_lights_punctual" in file["extensionsUsed"]
    (found,) = file["extensions"]["KHR_lights_punctual"]["lights"]
    assert max(found["color"]) <= 1.0
    return dict(found)


SHAPED = '(prepend apiSchemas = ["ShapingAPI"])'
CONE = "float inputs:shaping:cone:angle = 30\nfloat inputs:shaping:cone:softness = 0.5\n"


@pytest.mark.parametrize("unit", [1.0, 0.01])
@pytest.mark.parametrize(
    ("kind", "said", "candela"),
    [("SphereLight", "float inputs:radius = 0.5\nfloat inputs:intensity = 100", 100 * math.pi * 0.25),
     ("SphereLight", "float inputs:radius = 0.5\nfloat inputs:intensity = 100\nbool inputs:normalize = 1", None),
     ("DiskLight", "float inputs:radius = 2\nfloat inputs:intensity = 7", 7 * math.pi * 4),
     ("RectLight", "float inputs:width = 3\nfloat inputs:height = 2\nfloat inputs:intensity = 7", 42.0)],
)  # fmt: skip
def test_intensity_is_radiance_times_what_a_lamp_shows_of_itself(
    tmp_path: Path, kind: str, said: str, candela: float | None, unit: float
) -> None:
    """UsdLux: nits; a lamp of L nits that shows A square metres is L A candela. `normalize` divides by its area in
    units: of a sphere 100 / pi D^2 nits times pi D^2 / 4 square units are 25, times a square unit in square metres."""
    _, _, file, _ = written(tmp_path, light(kind, said), unit=unit)
    wanted = 25.0 if candela is None else candela
    assert entry(file)["intensity"] == pytest.approx(wanted * unit * unit, rel=1e-5)
    assert entry(file)["type"] == ("point" if kind == "SphereLight" else "spot")


@pytest.mark.parametrize("degrees", [0.0, 0.53, 20.0])
def test_a_sun_is_its_illuminance(tmp_path: Path, degrees: float) -> None:
    """L pi sin^2(angle / 2) lux, and with no angle what UsdLux's intensity is the limit of."""
    _, _, file, _ = written(tmp_path, light("DistantLight", f"float inputs:angle = {degrees}\ncolor3f inputs:color = "
                                                           "(1, 0.5, 0.25)\nfloat inputs:intensity = 10"))  # fmt: skip
    found = entry(file)
    factor = math.pi * math.sin(math.radians(degrees / 2)) ** 2 if degrees else 1.0
    assert found["intensity"] == pytest.approx(10 * factor, rel=1e-5)
    assert found["color"] == pytest.approx([1.0, 0.5, 0.25], rel=1e-5)


def test_a_cone_is_a_spot(tmp_path: Path) -> None:
    _, back, file, _ = written(tmp_path, light("SphereLight", CONE + "float inputs:intensity = 100", SHAPED))
    found = entry(file)
    assert found["spot"]["outerConeAngle"] == pytest.approx(math.radians(30.0))
    assert found["spot"]["innerConeAngle"] == pytest.approx(math.radians(15.0))
    assert only(back).shaping.cone == pytest.approx(math.radians(30.0))
    assert only(back).shaping.softness == pytest.approx(0.5)


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize(
    "body",
    [light("SphereLight", "bool treatAsPoint = 1\nfloat inputs:intensity = 90\ncolor3f inputs:color = (0.2, 1, 0.5)"),
     light("SphereLight", "bool treatAsPoint = 1\n" + CONE, SHAPED),
     light("DistantLight", "float inputs:angle = 0\nfloat inputs:intensity = 3")],
)  # fmt: skip
def test_points_spots_and_suns_come_back(tmp_path: Path, body: str, up: str) -> None:
    """As bright, from the same place, the same way."""
    before, after, _, _ = written(tmp_path, body, up=up, unit=0.1)
    old, new = only(before), only(after)
    assert (new.kind, new.size) == (old.kind, old.size)
    assert new.radiance == pytest.approx(old.radiance, rel=1e-4)
    moved = old.world_from_light.copy(), new.world_from_light.copy()
    for matrix, scene in zip(moved, (before, after), strict=True):
        matrix[:3, 3] -= np.linalg.inv(scene.stage_from_engine)[:3, 3]
    if old.kind is LightKind.DISTANT:
        assert moved[1][:3, :3] == pytest.approx(moved[0][:3, :3], abs=1e-6)
    else:
        assert moved[1] == pytest.approx(moved[0], abs=1e-5)
    assert new.shaping.cone == pytest.approx(old.shaping.cone)


def test_a_node_that_scales_scales_no_light(tmp_path: Path) -> None:
    """KHR_lights_punctual: scale has no say in it."""
    lights = '"extensions": {"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 12}]}}'
    node = '{"scale": [3, 3, 3], "translation": [1, 2, 3], "extensions": {"KHR_lights_punctual": {"light": 0}}}'
    file = tmp_path / "f.gltf"
    file.write_text(f'{{"asset": {{"version": "2.0"}}, "scenes": [{{"nodes": [0]}}], "nodes": [{node}], {lights}}}')
    run(str(file), tmp_path / "o.usda")
    assert only(load_stage(str(tmp_path / "o.usda"))).radiance == pytest.approx((12.0, 12.0, 12.0))


def test_a_tube_has_the_power_of_a_point(tmp_path: Path) -> None:
    """Power of a convex lamp: pi L A; of a point: 4 pi I. Its ends are dark."""
    _, _, file, _ = written(tmp_path, light("CylinderLight", "float inputs:radius = 0.2\nfloat inputs:length = 3\n"
                                                            "float inputs:intensity = 5"))  # fmt: skip
    power = math.pi * 5 * (2 * math.pi * 0.2 * 3)
    assert entry(file)["intensity"] == pytest.approx(power / (4 * math.pi), rel=1e-5)


def test_what_is_lost_is_told(tmp_path: Path) -> None:
    body = light("SphereLight", "float inputs:radius = 0.5\nfloat inputs:shaping:focus = 3", SHAPED)
    _, _, _, told = written(tmp_path, body + '\ndef DomeLight "Sky"\n{\n}\n')
    assert "size and soft shadows, focus, IES profile or picture" in told
    assert "/Rig/Sky: not written" in told


# --- cameras --------------------------------------------------------------------------------------------------------


def camera(said: str) -> str:
    return f'def Camera "Eye"\n{{\nfloat2 clippingRange = (0.5, 200)\n{said}\n{PLACE}\n}}'


def eye(scene: Scene) -> Camera:
    (found,) = scene.cameras
    assert found.path
    return found


@pytest.mark.parametrize("unit", [1.0, 0.01])
@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize(
    "said",
    ["float focalLength = 35\nfloat horizontalAperture = 24\nfloat verticalAperture = 36",
     'token projection = "orthographic"\nfloat horizontalAperture = 60\nfloat verticalAperture = 40'],
)  # fmt: skip
def test_a_camera_comes_back(tmp_path: Path, said: str, up: str, unit: float) -> None:
    before, after, _, told = written(tmp_path, camera(said), up=up, unit=unit)
    old, new = eye(before), eye(after)
    assert new.window == pytest.approx(old.window, rel=1e-5)
    assert new.clipping == pytest.approx(old.clipping, rel=1e-5)
    assert new.orthographic == old.orthographic
    shift = [np.linalg.inv(scene.stage_from_engine)[:3, 3] for scene in (before, after)]
    assert new.world_from_camera[:3, :3] == pytest.approx(old.world_from_camera[:3, :3], abs=1e-6)
    ends = [one.world_from_camera[:3, 3] - by for one, by in zip((old, new), shift, strict=True)]
    assert ends[1] == pytest.approx(ends[0], abs=1e-5)
    assert "/Rig/Eye" not in told


def test_a_camera_in_the_words_of_glTF(tmp_path: Path) -> None:
    """yfov of a 24 mm film behind 50 mm is 26.99 degrees, as of every full frame; lengths are metres."""
    said = "float focalLength = 50\nfloat horizontalAperture = 36\nfloat verticalAperture = 24"
    _, _, file, _ = written(tmp_path, camera(said), unit=0.1)
    (found,) = file["cameras"]
    lens = found["perspective"]
    assert math.degrees(lens["yfov"]) == pytest.approx(26.99, abs=0.005)
    assert lens["aspectRatio"] == pytest.approx(1.5)
    assert (lens["znear"], lens["zfar"]) == pytest.approx((0.05, 20.0))


def test_an_orthographic_offset_is_a_move(tmp_path: Path) -> None:
    """Parallel rays: what the aperture is moved by, the camera can be."""
    said = 'token projection = "orthographic"\nfloat horizontalAperture = 60\nfloat horizontalApertureOffset = 20'
    before, after, _, told = written(tmp_path, camera(said))
    old, new = eye(before), eye(after)
    assert np.mean(new.window[:2]) == pytest.approx(0.0, abs=1e-6)

    def middle(one: Camera, scene: Scene) -> Any:
        left, right, bottom, top = one.window
        at = one.world_from_camera @ ((left + right) / 2, (bottom + top) / 2, 0.0, 1.0)
        return at[:3] - np.linalg.inv(scene.stage_from_engine)[:3, 3]

    assert middle(new, after) == pytest.approx(middle(old, before), abs=1e-5)
    assert "offset" not in told


def test_what_a_camera_loses_is_told(tmp_path: Path) -> None:
    said = "float horizontalApertureOffset = 3\nfloat fStop = 2\nfloat focusDistance = 4\nfloat exposure = 1"
    _, _, _, told = written(tmp_path, camera(said))
    assert "/Rig/Eye: glTF's cameras have no aperture offset, depth of field, exposure" in told


@pytest.mark.parametrize("wrong", ['"type": "laser"', '"type": "point", "intensity": -1', '"type": "spot", "spot": '
                                   '{"innerConeAngle": 1, "outerConeAngle": 0.5}'])  # fmt: skip
def test_a_light_that_is_none_is_an_error(tmp_path: Path, wrong: str) -> None:
    file = tmp_path / "f.gltf"
    lights = f'"extensions": {{"KHR_lights_punctual": {{"lights": [{{{wrong}}}]}}}}'
    file.write_text(f'{{"asset": {{"version": "2.0"}}, "scenes": [{{"nodes": []}}], "scene": 0, {lights}}}')
    with pytest.raises(StageError, match="light"):
        run(str(file), tmp_path / "o.usda")
