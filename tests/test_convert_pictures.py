"""Pictures of converted stages: what `refract convert` writes down is drawn as the stage itself was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import draw, globe, shell
from test_convert import HEAD, block, run
from test_convert_fit import TUMBLER, revolved

from refract_core.scene import Mesh, Model, Param
from refract_core.usd.stage import load_stage

AMBER = "color3f inputs:transmission_color = (0.9, 0.5, 0.1)"
CLEAR = "color3f inputs:transmission_color = (1, 1, 1)"
GLOW = "color3f inputs:emissiveColor = (0.9, 0.2, 0.1)"
VIEW = "matrix4d xformOp:transform = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, {up}, {far}, 1))"


def looks(*inputs: str) -> str:
    """OpenPBR glass with more inputs, whose tint has no depth, and what glows red."""
    glass = ("float inputs:transmission_weight = 1", "float inputs:specular_roughness = 0", *inputs)
    glow = (GLOW, "color3f inputs:diffuseColor = (0, 0, 0)")
    made = []
    for name, where, identifier, values in (
        ("Glass", "mtlx:", "ND_open_pbr_surface_surfaceshader", glass), ("Candle", "", "UsdPreviewSurface", glow)
    ):  # fmt: skip
        surface = f"token outputs:{where}surface.connect = </W/{name}/S.outputs:surface>"
        shader = block('def Shader "S"', f'uniform token info:id = "{identifier}"', *values, "token outputs:surface")
        made.append(block(f'def Material "{name}"', surface, shader))
    return "\n".join(made)


def mesh(name: str, points: NDArray[Any], triangles: NDArray[Any], *more: str) -> str:
    corners = ", ".join(f"({x:.7g}, {y:.7g}, {z:.7g})" for x, y, z in points)
    return block(
        f'def Mesh "{name}" (prepend apiSchemas = ["MaterialBindingAPI"])', "rel material:binding = </W/Glass>",
        f"point3f[] points = [{corners}]", f"int[] faceVertexIndices = {triangles.ravel().tolist()}",
        f"int[] faceVertexCounts = {[3] * len(triangles)}", 'uniform token subdivisionScheme = "none"', *more,
    )  # fmt: skip


def stage(folder: Path, *parts: str, unit: float = 1.0, far: float = 3.0, up: float = 0.0) -> str:
    """Things before a sky of one radiance, seen by a camera on +Z."""
    camera = block('def Camera "C"', "float focalLength = 35", "float verticalAperture = 20.955",
                   VIEW.format(up=up, far=far), 'uniform token[] xformOpOrder = ["xformOp:transform"]',
                   f"float2 clippingRange = ({0.01 * far}, {10 * far})")  # fmt: skip
    sky = block('def DomeLight "D"', "float inputs:intensity = 0.5")
    path = folder / "in.usda"
    text = HEAD.format(unit=unit).replace('"Z"', '"Y"') + block('def Xform "W"', *parts, camera, sky)
    path.write_text(text + "\n")
    return str(path)


def pictures(path: str, out: Path, **options: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Before and after."""
    run(path, out, **options)
    before, after = (draw(load_stage(one), 48, 48)["beauty"][..., :3] for one in (path, out))
    return before, after


def ball(name: str, radius: float, material: str) -> str:
    return block(f'def Sphere "{name}" (prepend apiSchemas = ["MaterialBindingAPI"])', f"double radius = {radius}",
                 f"rel material:binding = </W/{material}>")  # fmt: skip


def vessel(kind: str) -> Mesh | tuple[NDArray[Any], NDArray[Any]]:
    if kind == "shell":  # two closed surfaces, of which the inner one faces into the hollow
        return shell("/shell", 1.0, 0.9, 0, 24)
    points, triangles = revolved(TUMBLER)  # one closed surface with a wall outside and a wall inside
    return points[:, [0, 2, 1]] * (0.5, 0.5, -0.5) - (0.0, 0.6, 0.0), triangles


@pytest.mark.parametrize("kind", ["shell", "tumbler"])
@pytest.mark.parametrize("tint", [CLEAR, AMBER])
def test_what_stands_in_a_two_walled_vessel_is_seen_as_before(tmp_path: Path, kind: str, tint: str) -> None:
    made = vessel(kind)
    points, triangles = (made.points, made.triangles) if isinstance(made, Mesh) else made
    path = stage(tmp_path, looks(tint), mesh("Vessel", points, triangles), ball("Lit", 0.3, "Candle"))
    before, after = pictures(path, tmp_path / "out.usda")
    np.testing.assert_allclose(after, before, atol=2e-3)
    middle = after[22:26, 22:26]
    assert middle[..., 0].min() > 2.0 * middle[..., 1].max()  # the candle, through both walls


@pytest.mark.parametrize("walls", ["one prim for each", "none: a solid ball"])
def test_what_a_ball_holds_is_seen_as_before(tmp_path: Path, walls: str) -> None:
    """Each prim is a ball by itself, and a ball's closed form looks straight out of its far side."""
    outer, inner = (globe(f"/{radius}", radius, 0, 24) for radius in (1.0, 0.8))
    parts = [mesh("Outer", outer.points, outer.triangles)]
    if walls != "none: a solid ball":
        parts.append(mesh("Inner", inner.points, inner.triangles, 'uniform token orientation = "leftHanded"'))
    path = stage(tmp_path, looks(AMBER), *parts, ball("Lit", 0.3, "Candle"))
    out = tmp_path / "out.usda"
    assert "holds" in run(path, out)["Glass"].why
    before, after = pictures(path, tmp_path / "again.usda")
    np.testing.assert_allclose(after, before, atol=2e-3)
    middle = after[22:26, 22:26]
    assert middle[..., 0].min() > 1.5 * middle[..., 1].max()


def test_what_stands_beside_a_ball_is_not_in_it(tmp_path: Path) -> None:
    """Within its bounds, at a corner of them."""
    one = globe("/one", 1.0, 0, 24)
    speck = block('def Sphere "Speck"', "double radius = 0.05", "double3 xformOp:translate = (0.9, 0.9, 0.9)",
                  'uniform token[] xformOpOrder = ["xformOp:translate"]')  # fmt: skip
    path = stage(tmp_path, looks(CLEAR), mesh("Ball", one.points, one.triangles), speck)
    assert run(path, tmp_path / "out.usda")["Glass"].model == "sphere"


def test_thin_is_still_there_for_who_asks(tmp_path: Path) -> None:
    made = shell("/shell", 1.0, 0.9, 0)
    path = stage(tmp_path, looks(CLEAR), mesh("Vessel", made.points, made.triangles))
    out = tmp_path / "out.usda"
    assert run(path, out, model="thin")["Glass"].model == "thin"
    assert {m.model for m in load_stage(out).materials if m.refractive} == {Model.THIN}


@pytest.mark.parametrize("shape", ["Sphere", "Cone"])
def test_amber_beads_of_one_centimetre_keep_their_colour(tmp_path: Path, shape: str) -> None:
    """A bead of 1 cm in a stage of metres: its colour is reached within its own body, not after one stage unit."""
    size = "double radius = 0.005" if shape == "Sphere" else "double radius = 0.005\ndouble height = 0.01"
    bead = block(f'def {shape} "Bead" (prepend apiSchemas = ["MaterialBindingAPI"])', size,
                 "rel material:binding = </W/Glass>")  # fmt: skip
    path = stage(tmp_path, looks(AMBER), bead, far=0.02)
    out = tmp_path / "out.usda"
    before, after = pictures(path, out)
    for picture in (before, after):
        red, _, blue = picture[24, 24]
        assert blue < 0.5 * red
    assert np.abs(after - before).mean() < 5e-3  # the closed form of a ball is another one at its rim
    distances = [m.absorption_distance for one in (path, out) for m in load_stage(one).materials if m.refractive]
    assert distances[1] == pytest.approx(distances[0], rel=0.02)


@pytest.mark.parametrize("to", ["", "openpbr", "preview", "gltf"])
def test_a_colour_of_another_space_is_converted_once(tmp_path: Path, to: str) -> None:
    """A stage whose colours are ACEScg by ColorSpaceAPI: what is written is read as what it was."""
    path = Path(stage(tmp_path, looks(AMBER), ball("Bead", 1.0, "Glass")))
    api = 'def Xform "W" (prepend apiSchemas = ["ColorSpaceAPI"])\n{\nuniform token colorSpace:name = "lin_ap1_scene"'
    path.write_text(path.read_text().replace('def Xform "W"\n{', api))
    out = tmp_path / "out.usda"
    run(str(path), out, to=to)
    before, after = (next(m for m in load_stage(one).materials if m.refractive) for one in (path, out))
    plain = after.inputs[Param.TRANSMITTANCE].value
    assert plain == pytest.approx(before.inputs[Param.TRANSMITTANCE].value, abs=1e-5)
    assert plain[:3] != pytest.approx((0.9, 0.5, 0.1), abs=0.01)
