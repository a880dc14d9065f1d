"""Draw modes of models: what stands for them, by the words of UsdGeomModelAPI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Usd, UsdGeom
from scene_reading import read, texts, to_stage

import refract_core as rc
from refract_core.scene import Mesh, Scene
from refract_core.usd.stage import load_stage

F64 = NDArray[np.float64]
BOX = """def Cube "Geometry" { double size = 2
    double3 xformOp:scale = (1, 2, 3)
    uniform token[] xformOpOrder = ["xformOp:scale"] }"""
FACES = ("XPos", "XNeg", "YPos", "YNeg", "ZPos", "ZNeg")


def model(said: str, *, kind: str = "component", inside: str = BOX, name: str = "Model", how: str = "") -> str:
    return (
        f'def Xform "{name}" (kind = "{kind}"\nprepend apiSchemas = ["GeomModelAPI"]\n{how}) {{ {said}\n{inside} }}\n'
    )


CARDS = 'uniform token model:drawMode = "cards"\n'


def drawn(scene: Scene) -> list[str]:
    return [mesh.path for mesh in scene.meshes]


def corners(scene: Scene, mesh: Mesh) -> F64:
    return to_stage(scene, mesh.points)


@pytest.mark.parametrize(
    ("kind", "apply", "cards"),
    [("component", "", True), ("component", "uniform bool model:applyDrawMode = 0", False), ("assembly", "", False),
     ("assembly", "uniform bool model:applyDrawMode = 1", True), ("subcomponent", "", False)],
)  # fmt: skip
def test_a_mode_takes_effect_where_the_schema_says(kind: str, apply: str, cards: bool) -> None:
    """At components that do not decline it, and at models that ask for it."""
    scene = read(model(CARDS + apply, kind=kind))
    assert drawn(scene) == (["/Model"] if cards else ["/Model/Geometry"])


def test_it_is_inherited_and_default_ends_it() -> None:
    inner = model("", name="A") + model('uniform token model:drawMode = "default"', name="B")
    scene = read(model(CARDS, kind="group", name="Set", inside=inner))
    assert sorted(drawn(scene)) == ["/Set/A", "/Set/B/Geometry"]
    assert "drawn as cards" in texts(scene, "/Set/A")


def test_prototypes_have_the_mode_of_where_they_are() -> None:
    text = model(CARDS, kind="group", name="Set", inside=model("", name="P").replace("def Xform", "over")) + (
        'def PointInstancer "Many" { rel prototypes = </Set/P>\nint[] protoIndices = [0, 0]\n'
        "point3f[] positions = [(0, 0, 0), (9, 0, 0)] }"
    )
    scene = read(text.replace('over "P"', 'def Xform "P"'))
    assert [path for path in drawn(scene) if path.startswith("/Many")] == ["/Many/[0]/P", "/Many/[1]/P"]


@pytest.mark.parametrize(("geometry", "corner"), [("box", (1.0, 2.0, 3.0)), ("cross", (1.0, 2.0, 3.0))])
def test_cards_fill_the_extent_of_the_model(geometry: str, corner: tuple[float, float, float]) -> None:
    scene = read(model(CARDS + f'uniform token model:cardGeometry = "{geometry}"'))
    (mesh,) = scene.meshes
    points = corners(scene, mesh)
    assert len(mesh.triangles) == 12
    np.testing.assert_allclose(np.abs(points).max(axis=0), corner, atol=1e-3)
    on_a_face = np.isclose(np.abs(points), corner, atol=1e-3).all(axis=1)
    assert on_a_face.all() == (geometry == "box")


def test_every_card_faces_outwards() -> None:
    for geometry in ("box", "cross"):
        scene = read(model(CARDS + f'uniform token model:cardGeometry = "{geometry}"'))
        (mesh,) = scene.meshes
        points = corners(scene, mesh)[mesh.triangles]
        normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        assert (np.einsum("ij,ij->i", normals, points.mean(axis=1)) > 0.0).all()


def test_the_hint_is_the_extent_where_there_is_one() -> None:
    hint = "float3[] extentsHint = [(-4, -4, -4), (4, 4, 4)]"
    scene = read(model(CARDS + hint + '\nuniform token model:cardGeometry = "box"'))
    np.testing.assert_allclose(np.abs(corners(scene, scene.meshes[0])), 4.0, atol=1e-3)


def test_without_pictures_cards_have_the_draw_mode_colour() -> None:
    scene = read(model(CARDS + "uniform float3 model:drawModeColor = (0.9, 0.1, 0.2)"))
    (mesh,) = scene.meshes
    np.testing.assert_allclose(mesh.primvars["displayColor"][0, 0], (0.9, 0.1, 0.2), atol=1e-6)


def test_transforms_and_visibility_are_those_of_the_model() -> None:
    move = 'double3 xformOp:translate = (10, 0, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"]\n'
    scene = read(model(CARDS + move))
    np.testing.assert_allclose(corners(scene, scene.meshes[0]).mean(axis=0), (10, 0, 0), atol=1e-3)
    assert not read(model(CARDS + 'token visibility = "invisible"')).meshes
    assert not read(model(CARDS, inside="")).meshes
    assert "no extent" in texts(read(model(CARDS, inside="")), "/Model")


@pytest.mark.parametrize(("mode", "span"), [("bounds", (2.0, 4.0, 6.0)), ("origin", (1.0, 1.0, 1.0))])
def test_bounds_and_origins_are_thin_lines(mode: str, span: tuple[float, float, float]) -> None:
    scene = read(model(f'uniform token model:drawMode = "{mode}"'))
    points = corners(scene, scene.meshes[0])
    np.testing.assert_allclose(points.max(axis=0) - points.min(axis=0), span, atol=0.1)
    inside = (points > points.min(axis=0) + 0.2).all(axis=1) & (points < points.max(axis=0) - 0.2).all(axis=1)
    assert not inside.any()


# --- pictures -------------------------------------------------------------------------------------------------------


def picture(path: Path, *, hole: bool = False) -> None:
    """Red grows to the right, green upwards; the right half may be away."""
    oiio = pytest.importorskip("OpenImageIO")
    x, y = np.meshgrid((np.arange(8) + 0.5) / 8, 1.0 - (np.arange(8) + 0.5) / 8)
    alpha = np.where(x > 0.5, 0.0, 1.0) if hole else np.ones_like(x)
    pixels = (np.stack([x, y, np.zeros_like(x), alpha], axis=2) * 255).round().astype(np.uint8)
    file = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(8, 8, 4, "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    assert file.open(str(path), spec)
    assert file.write_image(pixels)
    file.close()


def textured(folder: Path, faces: str, said: str = "", up: str = "Z") -> Scene:
    picture(folder / "t.png")
    named = "\n".join(f"asset model:cardTexture{face} = @t.png@" for face in faces.split())
    text = model(CARDS + 'uniform token model:cardGeometry = "box"\n' + named + "\n" + said)
    path = folder / "s.usda"
    text = text.replace("{", "{\n").replace("}", "\n}\n")
    path.write_text(f'#usda 1.0\n(\nupAxis = "{up}"\nmetersPerUnit = 1\n)\n{text}')
    return load_stage(str(path))


def face_of(scene: Scene, axis: int, sign: int) -> tuple[F64, F64, int]:
    """Corners of the triangles of one face, in the stage's world, their st, and their material."""
    (mesh,) = scene.meshes
    points = corners(scene, mesh)[mesh.triangles]
    span = np.abs(corners(scene, mesh)[:, axis]).max()
    (rows,) = np.nonzero(np.isclose(points[:, :, axis], sign * span, atol=1e-3).all(axis=1))
    st = mesh.primvars["st"][rows].reshape(-1, 2).astype(np.float64)
    return points[rows].reshape(-1, 3), st, int(mesh.materials[rows[0]])


RIGHT = {(0, 1): (0, 1, 0), (0, -1): (0, -1, 0), (1, 1): (-1, 0, 0), (1, -1): (1, 0, 0), (2, 1): (1, 0, 0),
         (2, -1): (1, 0, 0)}  # fmt: skip


@pytest.mark.parametrize("face", FACES)
def test_a_picture_is_upright_to_who_stands_before_it(tmp_path: Path, face: str) -> None:
    """s runs to the right of somebody who looks at the face from outside with Z up; seen along Z, X is to the right.
    t runs along the other direction that is neither mirrored nor turned: `up = right x towards the model`."""
    scene = textured(tmp_path, " ".join(FACES))
    axis, sign = "XYZ".index(face[0]), 1 if face.endswith("Pos") else -1
    points, st, _ = face_of(scene, axis, sign)
    right = np.array(RIGHT[axis, sign])
    inwards = -sign * np.eye(3)[axis]
    up = np.cross(right, inwards)
    half = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(st[:, 0], 0.5 + (points / half) @ right / 2.0, atol=1e-4)
    np.testing.assert_allclose(st[:, 1], 0.5 + (points / half) @ up / 2.0, atol=1e-4)


@pytest.mark.parametrize("face", FACES)
def test_one_picture_of_an_axis_is_seen_through_from_the_other_side(tmp_path: Path, face: str) -> None:
    """Turned over, so the same texel lies before and behind; faces of axes without pictures are not drawn."""
    scene = textured(tmp_path, face)
    assert len(scene.meshes[0].triangles) == 4
    axis = "XYZ".index(face[0])
    (front, st_front, m), (back, st_back, n) = (face_of(scene, axis, sign) for sign in (1, -1))
    assert m == n
    others = [a for a in range(3) if a != axis]
    for point, st in zip(front, st_front, strict=True):
        (same,) = np.nonzero(np.isclose(back[:, others], point[others], atol=1e-4).all(axis=1))
        np.testing.assert_allclose(st_back[same], np.broadcast_to(st, (len(same), 2)), atol=1e-4)


@pytest.mark.parametrize("geometry", ["cross", "box"])
@pytest.mark.parametrize("side", [1, -1])
def test_who_stands_on_a_side_sees_its_picture(tmp_path: Path, geometry: str, side: int) -> None:
    """And not that of the side behind, although both cards of a cross lie in one plane."""
    oiio = pytest.importorskip("OpenImageIO")
    for name, pixel in (("pos", (1.0, 0.0, 0.0)), ("neg", (0.0, 1.0, 0.0))):
        file = oiio.ImageOutput.create("t.png")
        assert file.open(str(tmp_path / f"{name}.png"), oiio.ImageSpec(2, 2, 3, "uint8"))
        assert file.write_image(np.full((2, 2, 3), pixel, np.float32))
        file.close()
    said = CARDS + f'uniform token model:cardGeometry = "{geometry}"\n'
    said += "asset model:cardTextureXPos = @pos.png@\nasset model:cardTextureXNeg = @neg.png@\n"
    eye = f"""def Camera "Eye" {{ float2 clippingRange = (0.1, 100)
        double3 xformOp:translate = ({9 * side}, 0, 0)
        double3 xformOp:rotateXYZ = (0, {90 * side}, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"] }}\n"""
    text = (model(said) + eye + 'def DomeLight "Sky" { }').replace("{", "{\n").replace("}", "\n}\n")
    path = tmp_path / "s.usda"
    path.write_text(f'#usda 1.0\n(\nupAxis = "Y"\nmetersPerUnit = 1\n)\n{text}')
    drawn = rc.render(load_stage(str(path)), rc.RenderSettings(image_width=9, image_height=9, samples=1, jobs=1))
    red, green = drawn.planes["beauty"][4, 4, :2]
    assert (red > 4.0 * green) == (side > 0)
    assert (green > 4.0 * red) == (side < 0)


@pytest.mark.parametrize(("up", "left"), [("Z", 8), ("Y", 8)])
def test_simple_cards_leave_out_those_along_the_up_axis(tmp_path: Path, up: str, left: int) -> None:
    scene = textured(tmp_path, " ".join(FACES), 'uniform token model:cardVisibility = "simple"', up)
    (mesh,) = scene.meshes
    points = corners(scene, mesh)[mesh.triangles]
    flat = np.ptp(points, axis=1) < 1e-3
    assert len(points) == left
    assert not flat[:, "XYZ".index(up)].any()


def test_a_card_is_cut_out_by_its_alpha(tmp_path: Path) -> None:
    scene = textured(tmp_path, "XPos")
    _, _, material = face_of(scene, 0, 1)
    assert scene.materials[material].opacity_threshold == pytest.approx(0.1)
    assert not scene.materials[material].refractive


def test_a_picture_that_is_not_there_leaves_the_draw_mode_colour(tmp_path: Path) -> None:
    text = CARDS + "uniform float3 model:drawModeColor = (0.9, 0.1, 0.2)\nasset model:cardTextureXPos = @none.png@"
    scene = read(model(text))
    material = scene.materials[int(scene.meshes[0].materials[0])]
    assert tuple(material.inputs[0].value[:3]) == pytest.approx((0.9, 0.1, 0.2))
    assert "none.png" in texts(scene, "/Model/cardTextureXPos/Texture")


def test_cards_from_textures_lie_where_the_screen_was(tmp_path: Path) -> None:
    """A picture taken along -Z, 4 wide and 2 high about (1, 2, 3): its square of -1 .. 1 goes back there."""
    oiio = pytest.importorskip("OpenImageIO")
    world_to_screen = np.diag([0.5, 1.0, 1.0, 1.0])
    world_to_screen[3, :3] = (-0.5, -2.0, -3.0)
    spec = oiio.ImageSpec(4, 2, 4, "half")
    spec.attribute("worldtoscreen", oiio.TypeDesc("matrix"), tuple(world_to_screen.ravel().tolist()))
    file = oiio.ImageOutput.create("t.exr")
    assert file.open(str(tmp_path / "t.exr"), spec)
    assert file.write_image(np.ones((2, 4, 4), np.float32))
    file.close()
    said = CARDS + 'uniform token model:cardGeometry = "fromTexture"\nasset model:cardTextureZPos = @t.exr@'
    path = tmp_path / "s.usda"
    text = model(said, inside="").replace("{", "{\n").replace("}", "\n}\n")
    path.write_text(f"#usda 1.0\n(\nmetersPerUnit = 1\n)\n{text}")
    scene = load_stage(str(path))
    (mesh,) = scene.meshes
    points, st = corners(scene, mesh)[mesh.triangles].reshape(-1, 3), mesh.primvars["st"].reshape(-1, 2)
    np.testing.assert_allclose(points[:, 0], 1.0 + 2.0 * (2.0 * st[:, 0] - 1.0), atol=1e-4)
    np.testing.assert_allclose(points[:, 1], 2.0 + 1.0 * (2.0 * st[:, 1] - 1.0), atol=1e-4)
    np.testing.assert_allclose(points[:, 2], 3.0, atol=1e-4)


def test_many_instances_of_a_model_are_one_card(tmp_path: Path) -> None:
    """Of native instances, too: as many places of one mesh, each under the path of its model."""
    text = f"#usda 1.0\n{model(CARDS, name='Asset')}".replace("{", "{\n").replace("}", "\n}\n")
    (tmp_path / "asset.usda").write_text(text)
    stage = Usd.Stage.CreateNew(str(tmp_path / "s.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for i in range(400):
        prim = UsdGeom.Xform.Define(stage, f"/Set/M{i}")
        UsdGeom.XformCommonAPI(prim).SetTranslate((10.0 * i, 0.0, 0.0))
        prim.GetPrim().GetReferences().AddReference("asset.usda", "/Asset")
        prim.GetPrim().SetInstanceable(True)
    Usd.ModelAPI(stage.GetPrimAtPath("/Set")).SetKind("group")
    scene = load_stage(stage)
    (many,) = scene.instances
    assert len(many.paths) == 400
    assert not scene.meshes


def test_lights_in_a_model_that_is_replaced_do_not_shine() -> None:
    lamp = 'def SphereLight "Lamp" { }'
    assert not read(model(CARDS, inside=BOX + lamp)).lights
    assert read(model("", inside=BOX + lamp)).lights


def test_the_callers_stage_is_not_changed() -> None:
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString("#usda 1.0\n" + model(CARDS).replace("{", "{\n").replace("}", "\n}\n"))
    before = stage.Flatten().ExportToString()
    load_stage(stage)
    assert stage.Flatten().ExportToString() == before
