"""A stage of several files, and everything that is authored in a stage, for the tests of writing layers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pxr import Ar, Sdf, Usd

from refract_core.usd.layers.write import check_out, overlay, save

EXTENSIONS = (".usda", ".usdc", ".usd", ".usdz")

PART = """#usda 1.0
(
    defaultPrim = "Part"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "Part" {
    asset picture = @./tex/a.png@
    double size = 3
    def Scope "Inner" {
        int count = 4
    }
}
"""

STAGE = """#usda 1.0
(
    "What this is for."
    colorConfiguration = @./looks/studio.ocio@
    customLayerData = {
        asset[] pictures = [@./tex/a.png@]
        string owner = "somebody"
    }
    defaultPrim = "World"
    endTimeCode = 20
    expressionVariables = {
        string WHICH = "part"
    }
    fallbackPrimTypes = {
        token[] RefractProbe = ["Xform"]
    }
    framePrecision = 4
    framesPerSecond = 25
    kilogramsPerUnit = 2
    metersPerUnit = 0.1
    renderSettingsPrimPath = "/Render"
    startTimeCode = 3
    subLayers = [
        @./parts/below.usda@ (offset = 5; scale = 2)
    ]
    timeCodesPerSecond = 50
    upAxis = "Z"
)
def Xform "World" (
    customData = {
        int kept = 1
    }
    references = @`"./parts/${WHICH}.usda"`@
    variants = {
        string look = "red"
    }
    prepend variantSets = "look"
) {
    double size = 5
    double moved.timeSamples = {
        1: 2,
        10: 3,
    }
    asset also = @./parts/tex/a.png@
    variantSet "look" = {
        "red" {
            string paint = "red"
        }
        "blue" {
            string paint = "blue"
        }
    }
}
"""

BELOW = """#usda 1.0
(
    timeCodesPerSecond = 50
)
def Xform "World" {
    double below.timeSamples = {
        0: 0,
        10: 10,
    }
}
def RefractProbe "Probe" {
}
"""


def usda(text: str) -> str:
    """Braces may stand on the line of a statement, which USD's text format does not allow."""
    head, rest = text.split("def Xform", 1)
    return head + "def Xform" + rest.replace(") {", ")\n{").replace('" {', '"\n{')


def stage_in(tmp_path: Path) -> Path:
    """A stage of three layers in three folders, and an empty folder `out` beside it."""
    parts = tmp_path / "in" / "parts"
    (parts / "tex").mkdir(parents=True)
    for folder in (tmp_path / "in" / "tex", tmp_path / "in" / "looks", tmp_path / "out"):
        folder.mkdir()
    (parts / "part.usda").write_text(usda(PART))
    (parts / "below.usda").write_text(usda(BELOW).replace('Probe" {', 'Probe"\n{'))
    (tmp_path / "in" / "stage.usda").write_text(usda(STAGE))
    for name in ("parts/tex/a.png", "tex/a.png", "looks/studio.ocio"):
        (tmp_path / "in" / name).write_bytes(name.encode())
    return tmp_path / "in" / "stage.usda"


def package_of(stage: Path) -> Path:
    """The same stage as a package beside it."""
    path = stage.parent / "stage.usdz"
    files = [stage, *sorted(one for one in stage.parent.rglob("*") if one.is_file() and one != stage)]
    writer = Sdf.ZipFileWriter.CreateNew(str(path))
    for file in files:
        writer.AddFile(str(file), file.relative_to(stage.parent).as_posix())
    assert writer.Save()
    return path


def write(stage: Path | str, out: Path) -> Usd.Stage:
    check_out(str(stage), str(out), overwrite=False)
    save(overlay(str(stage), made="test"), str(out))
    return Usd.Stage.Open(str(out))


def content(value: Any) -> Any:
    """A value with the bytes of a file in place of the file's name."""
    if isinstance(value, Sdf.AssetPath):
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(value.resolvedPath)) if value.resolvedPath else None
        return bytes(asset.GetBuffer()) if asset else value.path
    return value


def opinions(stage: Usd.Stage) -> dict[str, Any]:
    """Every value and metadatum of a composed stage, at two times."""
    found: dict[str, Any] = {}
    for prim in stage.TraverseAll():
        found[str(prim.GetPath())] = (prim.GetTypeName(), prim.GetAllAuthoredMetadata().get("customData"))
        for attribute in prim.GetAttributes():
            values = [content(attribute.Get(time)) for time in (Usd.TimeCode.Default(), 4.0, 15.0)]
            found[str(attribute.GetPath())] = (attribute.GetTypeName(), attribute.GetTimeSamples(), values)
        for name in prim.GetVariantSets().GetNames():
            variants = prim.GetVariantSet(name)
            found[f"{prim.GetPath()}{{{name}}}"] = (variants.GetVariantNames(), variants.GetVariantSelection())
    return found
