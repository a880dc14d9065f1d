"""A glTF file as a USD stage: node hierarchy, meshes, UsdPreviewSurface materials with their pictures, lights,
cameras."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from ...errors import StageError
from ...scene import F64
from ..layers.write import RECORD
from ..materials.surfaces import Surface
from ..values import free_name
from .author import Work, origin
from .find import Glass
from .gltf_file import Gltf, GltfMaterial, Picture, Primitive, read_gltf
from .gltf_lamps import define_lamp, define_view

_TYPES = Sdf.ValueTypeNames
_DEEPEST = 256


def begin(path: str, pictures: str) -> tuple[Work, list[Glass], dict[str, bytes]]:
    """Build the stage, without RefractMaterialAPI, and say what glass is in it.

    Args:
        path: a .gltf or .glb file.
        pictures: folder where the stage expects its pictures.

    Returns:
        The stage, its glass, and the pictures to write: path and content.

    Raises:
        UsageError: pygltflib is not installed.
        StageError: the file cannot be read.
    """
    gltf = read_gltf(path)
    try:
        return _build(path, gltf, pictures)
    except (IndexError, ValueError, Tf.ErrorException) as error:
        raise StageError(f"{path}: refers to something that is not in it: {error}") from error


def _build(path: str, gltf: Gltf, pictures: str) -> tuple[Work, list[Glass], dict[str, bytes]]:
    """The stage in memory, its glass, and its pictures by path."""
    layer = Sdf.Layer.CreateAnonymous("gltf.usda")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    layer.customLayerData = {RECORD: origin(path)}
    stem = os.path.splitext(os.path.basename(path))[0]
    root = UsdGeom.Xform.Define(stage, f"/{Tf.MakeValidIdentifier(stem)}")
    stage.SetDefaultPrim(root.GetPrim())
    scope = UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("Looks"))
    files = [os.path.join(pictures, f"{n}{kind}") if kind else "" for n, (kind, _) in enumerate(gltf.images)]
    names = _names([material.name for material in gltf.materials])
    painted = _painted(gltf)
    materials = [
        _material(stage, scope.GetPath().AppendChild(name), material, files, painted=number in painted)
        for number, (name, material) in enumerate(zip(names, gltf.materials, strict=True))
    ]
    scales: dict[int, list[float]] = defaultdict(list)
    for name, number in zip(_names([gltf.nodes[n].name for n in gltf.roots], {"Looks"}), gltf.roots, strict=True):
        _node(stage, root.GetPath().AppendChild(name), number, gltf, materials, np.eye(4), scales, 0)
    glass = [
        _glass(material, made, files, scales[number])
        for number, (material, made) in enumerate(zip(gltf.materials, materials, strict=True))
        if material.transmission > 0.0 and (material.metallic < 1.0 or _usable(material, "metallic_roughness", files))
    ]
    content = {file: image for file, (_, image) in zip(files, gltf.images, strict=True) if file}
    return Work(stage, layer, Usd.TimeCode(0.0), 1.0, gltf.notices), glass, content


def _names(wanted: list[str], taken: set[str] | None = None) -> list[str]:
    """Valid prim names, each once."""
    used = set(taken or ())
    found = []
    for name in wanted:
        found.append(free_name(Tf.MakeValidIdentifier(re.sub(r"\W+", "_", name).strip("_") or "Prim"), used))
        used.add(found[-1])
    return found


# --- nodes and meshes -----------------------------------------------------------------------------------------------


def _node(
    stage: Usd.Stage,
    path: Sdf.Path,
    number: int,
    gltf: Gltf,
    materials: list[UsdShade.Material],
    world_from_parent: F64,
    scales: dict[int, list[float]],
    depth: int,
) -> None:
    """A node and what is below it; `scales` gathers the world scale of everything by material."""
    if depth > _DEEPEST:
        raise StageError(f"{path.name}: nodes are nested deeper than {_DEEPEST}; make the hierarchy flatter")
    node = gltf.nodes[number]
    xform = UsdGeom.Xform.Define(stage, path)
    world = world_from_parent @ node.matrix
    if not np.array_equal(node.matrix, np.eye(4)):
        xform.AddTransformOp().Set(Gf.Matrix4d(node.matrix.T.tolist()))
    used: set[str] = set()
    if node.mesh >= 0:
        name, primitives = gltf.meshes[node.mesh]
        for label, primitive in zip(_names([name] * len(primitives)), primitives, strict=True):
            used.add(label)
            _mesh(stage, path.AppendChild(label), primitive, gltf, materials)
            scales[primitive.material].append(abs(float(np.linalg.det(world[:3, :3]))) ** (1.0 / 3.0))
    if node.camera >= 0:
        used.add(label := free_name("Camera", used))
        define_view(stage, path.AppendChild(label), gltf.cameras[node.camera])
    if node.light >= 0:
        used.add(label := free_name("Light", used))
        define_lamp(stage, path.AppendChild(label), gltf.lights[node.light])
    for label, child in zip(_names([gltf.nodes[n].name for n in node.children], used), node.children, strict=True):
        _node(stage, path.AppendChild(label), child, gltf, materials, world, scales, depth + 1)


def _mesh(
    stage: Usd.Stage, path: Sdf.Path, primitive: Primitive, gltf: Gltf, materials: list[UsdShade.Material]
) -> None:
    """One primitive as a Mesh of triangles, v turned upwards, bound to its material."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(primitive.points))
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(primitive.triangles), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(primitive.triangles.ravel())))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    if len(primitive.points):
        mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    if primitive.normals is not None:
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(primitive.normals)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for uv_set, uv in primitive.uvs.items():
        flipped = np.ascontiguousarray(np.stack((uv[:, 0], 1.0 - uv[:, 1]), axis=1), np.float32)
        primvar = primvars.CreatePrimvar(_st(uv_set), _TYPES.TexCoord2fArray, UsdGeom.Tokens.vertex)
        primvar.Set(Vt.Vec2fArray.FromNumpy(flipped))
    if primitive.colors is not None:
        primvar = primvars.CreatePrimvar("displayColor", _TYPES.Color3fArray, UsdGeom.Tokens.vertex)
        # The primvar is read alone, and glTF multiplies both: the factor goes into it.
        factor = gltf.materials[primitive.material].base[:3] if primitive.material >= 0 else (1.0, 1.0, 1.0)
        primvar.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(primitive.colors * np.array(factor, np.float32))))
    if primitive.material >= 0:
        mesh.CreateDoubleSidedAttr(gltf.materials[primitive.material].double_sided)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(materials[primitive.material])


def _st(uv_set: int) -> str:
    return f"st{uv_set}" if uv_set else "st"


# --- materials ------------------------------------------------------------------------------------------------------


def _painted(gltf: Gltf) -> set[int]:
    """Materials whose base colour is that of the vertices: all they are on has one, and no picture is in the way."""
    found: dict[int, bool] = {}
    for _, primitives in gltf.meshes:
        for one in primitives:
            found[one.material] = found.get(one.material, True) and one.colors is not None
    return {number for number, all_of_it in found.items() if all_of_it and number >= 0
            and "base" not in gltf.materials[number].pictures}  # fmt: skip


def _material(
    stage: Usd.Stage, path: Sdf.Path, material: GltfMaterial, files: list[str], *, painted: bool
) -> UsdShade.Material:
    """UsdPreviewSurface; roughness, metallic and occlusion from the channels that glTF packs them in.

    Args:
        painted: the base colour is that of the vertices.
    """
    made = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    made.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", _TYPES.Token))

    def drive(name: str, kind: Sdf.ValueTypeName, slot: str, channel: str, factor: tuple[float, ...]) -> None:
        """A factor, times its picture if there is one."""
        port = shader.CreateInput(name, kind)
        picture = material.pictures.get(slot)
        if picture is None or picture.image < 0 or not files[picture.image]:
            port.Set(Gf.Vec3f(*factor[:3]) if kind == _TYPES.Color3f else factor[0])
            return
        scale = factor if len(factor) == 4 else (*factor, 1.0) if len(factor) == 3 else factor * 4
        texture = _texture(made, name, picture, files[picture.image], scale, color=kind == _TYPES.Color3f)
        port.ConnectToSource(texture.ConnectableAPI(), channel)

    if painted:
        reader = UsdShade.Shader.Define(stage, path.AppendChild("diffuseColor_primvar"))
        reader.CreateIdAttr("UsdPrimvarReader_float3")
        reader.CreateInput("varname", _TYPES.String).Set("displayColor")
        reader.CreateInput("fallback", _TYPES.Float3).Set(Gf.Vec3f(*material.base[:3]))
        colors = reader.CreateOutput("result", _TYPES.Float3)
        shader.CreateInput("diffuseColor", _TYPES.Color3f).ConnectToSource(colors)
    else:
        drive("diffuseColor", _TYPES.Color3f, "base", "rgb", material.base)
    drive("emissiveColor", _TYPES.Color3f, "emissive", "rgb", material.emissive)
    drive("metallic", _TYPES.Float, "metallic_roughness", "b", (material.metallic,))
    drive("roughness", _TYPES.Float, "metallic_roughness", "g", (material.roughness,))
    if "occlusion" in material.pictures:
        drive("occlusion", _TYPES.Float, "occlusion", "r", (1.0,))
    if material.clearcoat > 0.0:
        shader.CreateInput("clearcoat", _TYPES.Float).Set(material.clearcoat)
        shader.CreateInput("clearcoatRoughness", _TYPES.Float).Set(material.clearcoat_roughness)
    _normal(made, shader, material, files)
    _opacity(made, shader, material, files, drive)
    if material.transmission > 0.0:
        shader.CreateInput("ior", _TYPES.Float).Set(max(material.ior, 1.0))
    return made


def _normal(made: UsdShade.Material, shader: UsdShade.Shader, material: GltfMaterial, files: list[str]) -> None:
    picture = material.pictures.get("normal")
    if picture is None or picture.image < 0 or not files[picture.image]:
        return
    s = 2.0 * picture.strength
    scale, bias = (s, s, 2.0, 1.0), (-s / 2.0, -s / 2.0, -1.0, 0.0)
    texture = _texture(made, "normal", picture, files[picture.image], scale, bias)
    shader.CreateInput("normal", _TYPES.Normal3f).ConnectToSource(texture.ConnectableAPI(), "rgb")


def _opacity(
    made: UsdShade.Material, shader: UsdShade.Shader, material: GltfMaterial, files: list[str], drive: object
) -> None:
    """1 - transmission for glass, for metal lets no light through; else what glTF's alpha mode says."""
    if material.transmission > 0.0:
        port, t, m = shader.CreateInput("opacity", _TYPES.Float), material.transmission, material.metallic
        picture, metal = (_usable(material, name, files) for name in ("transmission", "metallic_roughness"))
        if picture is not None:
            t *= 1.0 - m if metal is None else 1.0  # two pictures cannot be multiplied; the metal's is left
            texture = _texture(made, "opacity", picture, files[picture.image], (-t,) * 4, (1.0,) * 4)
            port.ConnectToSource(texture.ConnectableAPI(), "r")
        elif metal is not None and m > 0.0:
            texture = _texture(made, "opacity", metal, files[metal.image], (t * m,) * 4, (1.0 - t,) * 4)
            port.ConnectToSource(texture.ConnectableAPI(), "b")
        else:
            port.Set(1.0 - t * (1.0 - m))
    elif material.alpha_mode != "OPAQUE":
        assert callable(drive)
        drive("opacity", _TYPES.Float, "base", "a", (material.base[3],))
        if material.alpha_mode == "MASK":
            shader.CreateInput("opacityThreshold", _TYPES.Float).Set(max(material.alpha_cutoff, 1.0e-6))
        else:
            shader.CreateInput("opacityMode", _TYPES.Token).Set("presence")


def _usable(material: GltfMaterial, name: str, files: list[str]) -> Picture | None:
    picture = material.pictures.get(name)
    return picture if picture is not None and picture.image >= 0 and files[picture.image] else None


def _texture(
    made: UsdShade.Material,
    name: str,
    picture: Picture,
    file: str,
    scale: tuple[float, ...],
    bias: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    *,
    color: bool = False,
) -> UsdShade.Shader:
    """A UsdUVTexture with its coordinates: glTF's (0, 0) is the picture's upper left corner, USD's the lower left."""
    stage, path = made.GetPrim().GetStage(), made.GetPath()
    reader = UsdShade.Shader.Define(stage, path.AppendChild(f"{name}_st"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", _TYPES.String).Set(_st(picture.uv_set))
    st = reader.CreateOutput("result", _TYPES.Float2)
    if (picture.offset, picture.rotation, picture.scale) != ((0.0, 0.0), 0.0, (1.0, 1.0)):
        st = _moved(stage, path.AppendChild(f"{name}_transform"), picture, st)
    texture = UsdShade.Shader.Define(stage, path.AppendChild(f"{name}_texture"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", _TYPES.Asset).Set(Sdf.AssetPath(file))
    texture.CreateInput("sourceColorSpace", _TYPES.Token).Set("sRGB" if color else "raw")
    texture.CreateInput("st", _TYPES.Float2).ConnectToSource(st)
    for axis, wrap in zip("ST", picture.wrap, strict=True):
        texture.CreateInput(f"wrap{axis}", _TYPES.Token).Set(wrap)
    texture.CreateInput("scale", _TYPES.Float4).Set(Gf.Vec4f(*scale))
    if any(bias):
        texture.CreateInput("bias", _TYPES.Float4).Set(Gf.Vec4f(*bias))
    for output, kind in (("rgb", _TYPES.Float3), *((channel, _TYPES.Float) for channel in "rgba")):
        texture.CreateOutput(output, kind)
    return texture


def _moved(stage: Usd.Stage, path: Sdf.Path, picture: Picture, st: UsdShade.Output) -> UsdShade.Output:
    """KHR_texture_transform in USD's upward t: uv' = T R S uv with v = 1 - t on both sides.

    With p = (s, t) and the flip F(p) = (s, 1 - t): F T R S F, where R is counter-clockwise as seen on the picture, so
    [[cos, sin], [-sin, cos]] (KhronosGroup/glTF issue 1563).
    """
    (u, v), (x, y), angle = picture.offset, picture.scale, picture.rotation
    c, s = math.cos(angle), math.sin(angle)
    translation = (s * y + u, 1.0 - c * y - v)
    node = UsdShade.Shader.Define(stage, path)
    node.CreateIdAttr("UsdTransform2d")
    node.CreateInput("in", _TYPES.Float2).ConnectToSource(st)
    node.CreateInput("scale", _TYPES.Float2).Set(Gf.Vec2f(x, y))
    node.CreateInput("rotation", _TYPES.Float).Set(math.degrees(angle))
    node.CreateInput("translation", _TYPES.Float2).Set(Gf.Vec2f(*translation))
    return node.CreateOutput("result", _TYPES.Float2)


# --- glass ----------------------------------------------------------------------------------------------------------


def _glass(material: GltfMaterial, made: UsdShade.Material, files: list[str], scales: list[float]) -> Glass:
    """What the KHR extensions say, as the schema has it: no volume is a thin wall that the base colour tints.

    Where a volume absorbs, and its base colour tints too, both are one colour that is left after one thickness.
    """
    notes = []
    path = made.GetPath()
    thin = material.thickness <= 0.0
    # thicknessFactor is in mesh space: one number only where all meshes are scaled alike.
    alike = bool(scales) and max(scales) - min(scales) <= 0.05 * max(scales)
    thickness = material.thickness * scales[0] if alike else 0.0
    base, distance = material.base[:3], None
    node = UsdShade.Shader(made.GetPrim().GetChild("Surface")).GetInput("diffuseColor").GetConnectedSources()[0]
    driver = node[0].source.GetOutput(node[0].sourceName).GetAttr() if node else None
    color, color_from = base, str(driver.GetPath()) if driver else ""
    if not thin and material.attenuation_distance > 0.0 and material.attenuation_color != (1.0, 1.0, 1.0):
        color, distance = material.attenuation_color, material.attenuation_distance
        tinted = driver or base != (1.0, 1.0, 1.0)
        picture = _usable(material, "base", files)
        if tinted and thickness > 0.0 and (picture is not None or not driver):
            r, g, b = (factor * left ** (thickness / distance) for factor, left in zip(base, color, strict=True))
            color, distance = (r, g, b), thickness
            if picture is not None:
                one = _texture(made, "transmittance", picture, files[picture.image], (r, g, b, 1.0), color=True)
                color_from = f"{one.GetPath()}.outputs:rgb"
        else:
            color_from = ""
            if tinted:
                notes.append("the base colour tints the surface too, which the schema has no place for")
    ior = material.ior
    if ior < 1.0:
        notes.append(f"ior is {ior:g}, glTF's special mode; 1.5 is used")
        ior = 1.5
    if "transmission" in material.pictures and "metallic_roughness" in material.pictures and material.metallic > 0.0:
        notes.append("transmission and metal are both mapped; the metal's picture is left out of the opacity")
    thickness_from = ""
    if (depth := _usable(material, "thickness", files)) is not None:
        if thickness > 0.0:
            one = _texture(made, "thickness", depth, files[depth.image], (thickness,) * 4)
            thickness_from = f"{one.GetPath()}.outputs:g"
        else:
            notes.append("its meshes are scaled differently, so the thickness picture is left out")
    return Glass(
        path=str(path), edit=str(path), shader="KHR_materials_transmission", applied=False, thin=thin,
        surface=Surface(), ior=ior, color=color, color_from=color_from, color_map=None, distance=distance,
        abbe=20.0 / material.dispersion if material.dispersion > 0.0 else 0.0,
        thickness=thickness, thickness_from=thickness_from, thickness_map=None, authored=frozenset(),
        notes=tuple(notes),
    )  # fmt: skip
