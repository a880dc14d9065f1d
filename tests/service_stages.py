"""Stages that mean no good, made by the tests that send them."""

from __future__ import annotations

import io
import random
import zipfile

HEAD = '#usda 1.0\n(\n    defaultPrim = "World"\n)\n'


def referring(path: str) -> str:
    return f'{HEAD}def Xform "World" (\n    references = @{path}@\n)\n{{\n}}\n'


def escapes(secret: str) -> dict[str, str]:
    """Ways out of a folder, by name. `secret`: absolute path of a layer elsewhere."""
    up = "../" * 12 + secret.lstrip("/")
    textured = f"""{HEAD}def Xform "World"
{{
    def Shader "Picture"
    {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{secret}@
    }}
}}
"""
    clips = f"""{HEAD}def Xform "World" (
    clips = {{
        dictionary default = {{
            asset[] assetPaths = [@{secret}@]
            asset manifestAssetPath = @./none.usda@
            string primPath = "/World"
            double2[] active = [(0, 0)]
            double2[] times = [(0, 0)]
        }}
    }}
)
{{
}}
"""
    template = clips.replace(f"asset[] assetPaths = [@{secret}@]", f'string templateAssetPath = "{up}"').replace(
        "double2[] active = [(0, 0)]", "double templateStartTime = 0").replace(
        "double2[] times = [(0, 0)]", "double templateEndTime = 1\n            double templateStride = 1")  # fmt: skip
    variants = f"""{HEAD}def Xform "World" (
    variants = {{
        string look = "plain"
    }}
    prepend variantSets = "look"
)
{{
    variantSet "look" = {{
        "plain" {{
        }}
        "open" (
            payload = @{secret}@
        ) {{
        }}
    }}
}}
"""
    expression = f"""#usda 1.0
(
    defaultPrim = "World"
    expressionVariables = {{
        string WHERE = "{secret}"
    }}
    subLayers = [@`"${{WHERE}}"`@]
)
def Xform "World"
{{
}}
"""
    return {
        "absolute": referring(secret), "parent": referring(up),
        "sublayer": f"#usda 1.0\n(\n    subLayers = [@{up}@]\n)\n",
        "texture": textured, "clips": clips, "clip template": template, "unchosen variant": variants,
        "expression": expression, "address": referring("https://example.com/a.usda"), "file address":
        referring(f"file://{secret}"), "arguments": referring(f"{secret}:SDF_FORMAT_ARGS:target=usd"),
        "package": referring(f"{secret}[a.usda]"), "share": referring("\\\\\\\\host\\\\a.usda"),
        "home": referring("~/a.usda"),
    }  # fmt: skip


def package(files: dict[str, str | bytes], *, compress: bool = False) -> bytes:
    """A zip as .usdz has it: stored, contents at multiples of 64 bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            info = zipfile.ZipInfo(name)
            info.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
            start = stream.tell() + 30 + len(name.encode())
            padding = -(start + 4) % 64
            info.extra = b"\x86\x19" + padding.to_bytes(2, "little") + b"\0" * padding
            archive.writestr(info, content)
    return stream.getvalue()


def laughs(levels: int = 30, *, instanceable: bool = False) -> str:
    """2^levels prims in a few kilobytes: each level refers twice to the one below."""
    word = "instanceable = true\n    " if instanceable else ""
    parts = ['def Sphere "L0"\n{\n}\n']
    for level in range(1, levels):
        twice = "".join(
            f'    def "{side}" (\n    {word}references = </L{level - 1}>\n    )\n    {{\n    }}\n' for side in "ab"
        )
        parts.append(f'def Xform "L{level}"\n{{\n{twice}}}\n')
    return HEAD.replace("World", f"L{levels - 1}") + "".join(parts)


def nested(depth: int) -> str:
    return HEAD + 'def "a" {\n' * depth + "}\n" * depth


def many_points(count: int) -> str:
    """A huge count of instances where the text is short only with arrays of one value; here, honest text."""
    return HEAD + f'def Points "World"\n{{\n    point3f[] points = [{", ".join(["(0, 0, 0)"] * count)}]\n}}\n'


def mutated(content: bytes, seed: int) -> bytes:
    """The same file with some bytes changed, some cut out or some doubled."""
    dice = random.Random(seed)
    data = bytearray(content)
    for _ in range(dice.randint(1, 12)):
        at = dice.randrange(8, len(data))
        way = dice.randrange(4)
        if way == 0:
            data[at] = dice.randrange(256)
        elif way == 1:
            data[at : at + 4] = dice.choice([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f"])
        elif way == 2:
            del data[at : at + dice.randint(1, 40)]
        else:
            data[at:at] = data[at : at + dice.randint(1, 40)]
    return bytes(data)
