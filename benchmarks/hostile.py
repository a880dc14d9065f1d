"""What `benchmarks.attack` sends: damaged stages, bombs of prims, pictures and packages, and bytes that are no HTTP."""

from __future__ import annotations

import io
import json
import random
import struct
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdUtils

from .pages import ROOT

sys.path.append(str(ROOT / "tests"))  # what the tests send is sent here too
from service_server import BALL
from service_stages import HEAD, escapes, laughs, mutated, nested, package, referring

__all__ = ["BALL", "Protocol", "damaged", "escapes", "image_bombs", "package_bombs", "prim_bombs", "protocol_attacks"]
SEEDS = ("marble", "traced", "thickness_map", "two_probes")
"""Samples that are damaged, besides one in text."""
_HUGE = 1 << 22
"""A side of a picture that no texture has, and that any header can claim [pixels]"""


# --- damaged stages --------------------------------------------------------------------------------------------------


def damaged(count: int) -> Iterator[tuple[str, bytes]]:
    """`count` damaged stages and what each was: text, crate and package by turns, the same ones every time."""
    with tempfile.TemporaryDirectory() as folder:
        whole = dict(_whole(Path(folder)))
    names = sorted(whole)
    for seed in range(count):
        name = names[seed % len(names)]
        yield f"{name}, seed {seed}", mutated(whole[name], seed)


def _whole(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Stages as they were before: text, crate and package of each."""
    yield "ball.usda", BALL.encode()
    good = ROOT / "usd_samples" / "good"
    for name in SEEDS:
        source = good / f"{name}.usda"
        flat = Usd.Stage.Open(str(source)).Flatten()
        UsdUtils.ModifyAssetPaths(flat, lambda path: Path(path).name)
        flat.documentation = ""  # both would name folders of this machine
        for suffix in ("usda", "usdc"):
            flat.Export(str(folder / f"{name}.{suffix}"))
            yield f"{name}.{suffix}", (folder / f"{name}.{suffix}").read_bytes()
        UsdUtils.CreateNewUsdzPackage(str(source), str(folder / f"{name}.usdz"))
        yield f"{name}.usdz", _timeless((folder / f"{name}.usdz").read_bytes())


def _timeless(package: bytes) -> bytes:
    """A package that does not say when it was made."""
    data = bytearray(package)
    with zipfile.ZipFile(io.BytesIO(package)) as archive:
        at = archive.start_dir
        for entry in archive.infolist():
            data[entry.header_offset + 10 : entry.header_offset + 14] = bytes(4)
            data[at + 12 : at + 16] = bytes(4)
            lengths = (int.from_bytes(data[at + k : at + k + 2], "little") for k in (28, 30, 32))
            at += 46 + sum(lengths)  # its name, extra fields and comment stand behind it
    return bytes(data)


# --- bombs -----------------------------------------------------------------------------------------------------------


def _prim(kind: str, name: str, body: str = "", arc: str = "") -> str:
    """A prim as text. `arc`: what stands in its parentheses."""
    return f'def {kind} "{name}" {f"({arc}) " if arc else ""}{{\n{body}}}\n'


def _leading(name: str, *prims: str) -> str:
    """A stage whose default prim has this name."""
    return HEAD.replace("World", name) + "".join(prims)


def prim_bombs() -> dict[str, bytes]:
    """Small stages that are large when they are composed, or never done."""
    found = {f"references, 2^{levels}": laughs(levels) for levels in (16, 24, 30, 40)}
    found |= {f"instances, 2^{levels}": laughs(levels, instanceable=True) for levels in (16, 24, 30, 40)}
    found |= {f"{arc}, 2^30": laughs(30).replace("references", arc) for arc in ("payload", "inherits", "specializes")}
    found |= {
        "variants, 2^30": _variants(30),
        "a hundred arms, 100^6": _wide(100, 6),
        "instancers in instancers": _points(6, 100),
        "a circle of references": _leading(
            "World",
            _prim("Xform", "World", _prim("Xform", "A", arc="references = </World>"), "references = </World/A>"),
        ),
        "a circle of inherits": _leading(
            "World", _prim("Xform", "World", arc="inherits = </B>"), _prim("Xform", "B", arc="inherits = </World>")
        ),
        "a prim in itself": _leading(
            "World", _prim("Xform", "World", _prim("Xform", "A", arc="references = </World>"))
        ),
        "300,000 prims": _leading(
            "World", _prim("Xform", "World", "".join(_prim("Cube", f"c{k}") for k in range(300_000)))
        ),
        "100,000 deep": nested(100_000),
        "1,000 deep": nested(1_000),
        "a subdivided mesh": _subdivided(400),
        "faces of four billion corners": _mesh("[2147483647, 2147483647]", "[0, 1, 2]", "[(0, 0, 0), (1, 0, 0)]"),
        "200,000 targets": _leading("World", _prim("Sphere", "World", f"rel many = [{_targets(200_000)}]\n")),
        "connections in a circle": _connected(),
        "200,000 samples of time": _leading(
            "World", _prim("Sphere", "World", f"double radius.timeSamples = {{{_samples(200_000)}}}\n")
        ),
    }
    bombs = {name: text.encode() for name, text in found.items()}
    return bombs | {"an array of 10^8 in a crate": _huge_array()}


def _variants(levels: int) -> str:
    """2^levels prims, each level inside a variant."""
    prims = [_prim("Sphere", "L0")]
    for level in range(1, levels):
        both = "".join(_prim("Xform", side, arc=f"references = </L{level - 1}>") for side in "ab")
        arc = 'variants = {\nstring v = "x"\n}\nprepend variantSets = "v"'
        prims.append(_prim("Xform", f"L{level}", f'variantSet "v" = {{\n"x" {{\n{both}}}\n}}\n', arc))
    return _leading(f"L{levels - 1}", *prims)


def _wide(arms: int, levels: int) -> str:
    """arms^levels prims."""
    prims = [_prim("Sphere", "L0")]
    for level in range(1, levels + 1):
        many = "".join(_prim("Xform", f"a{k}", arc=f"references = </L{level - 1}>") for k in range(arms))
        prims.append(_prim("Xform", f"L{level}", many))
    return _leading(f"L{levels}", *prims)


def _points(levels: int, count: int) -> str:
    """Instancers whose prototype is an instancer: count^levels balls."""
    zeros, places = ", ".join(["0"] * count), ", ".join(f"({k}, 0, 0)" for k in range(count))
    prims = [_prim("Sphere", "P0")]
    for level in range(1, levels + 1):
        body = f"int[] protoIndices = [{zeros}]\npoint3f[] positions = [{places}]\nrel prototypes = </P{level}/A>\n"
        body += _prim("Xform", "A", arc=f"references = </P{level - 1}>")
        prims.append(_prim("PointInstancer", f"P{level}", body))
    return _leading(f"P{levels}", *prims)


def _mesh(counts: str, corners: str, points: str, scheme: str = "none") -> str:
    body = f"int[] faceVertexCounts = {counts}\nint[] faceVertexIndices = {corners}\npoint3f[] points = {points}\n"
    return _leading("World", _prim("Mesh", "World", f'{body}uniform token subdivisionScheme = "{scheme}"\n'))


def _subdivided(side: int) -> str:
    row = side + 1
    points = ", ".join(f"({x}, {y}, 0)" for y in range(row) for x in range(row))
    starts = [y * row + x for y in range(side) for x in range(side)]
    corners = ", ".join(f"{k}, {k + 1}, {k + row + 1}, {k + row}" for k in starts)
    return _mesh(f"[{', '.join(['4'] * len(starts))}]", f"[{corners}]", f"[{points}]", "catmullClark")


def _targets(count: int) -> str:
    return ", ".join(f"</World/p{k}>" for k in range(count))


def _samples(count: int) -> str:
    return ", ".join(f"{k}: 1" for k in range(count))


def _connected() -> str:
    """A glass whose index comes from a shader whose input is its own output."""
    shader = _prim(
        "Shader",
        "A",
        'uniform token info:id = "UsdUVTexture"\nfloat inputs:x.connect = </World/Glass/A.outputs:r>\n'
        "float outputs:r.connect = </World/Glass/A.inputs:x>\n",
    )
    asked = "float inputs:refraction:ior"
    return BALL.replace(f"{asked} = 1.5", f"{asked}.connect = </World/Glass/A.outputs:r>\n{shader}")


def _huge_array() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        layer = Sdf.Layer.CreateNew(f"{folder}/a.usdc")
        prim = Sdf.PrimSpec(layer, "World", Sdf.SpecifierDef, "PointInstancer")
        Sdf.AttributeSpec(prim, "protoIndices", Sdf.ValueTypeNames.IntArray).default = np.zeros(100_000_000, np.int32)
        layer.Save()
        return Path(folder, "a.usdc").read_bytes()


def image_bombs() -> dict[str, bytes]:
    """Packages whose sky or texture is a picture that claims more than it is, or unpacks to more."""
    sides = ((_HUGE, 1), (1, _HUGE), (65_535, 65_535), (20_000, 20_000), (0, 0), (2**31 - 1, 2**31 - 1))
    pictures: dict[str, tuple[str, bytes]] = {}
    for width, height in sides:
        size = f"{width} x {height}"
        pictures |= {
            f"png, {size}": ("png", _png(width, height)),
            f"jpeg, {size}": ("jpg", _jpeg(width, height)),
            f"exr, {size}": ("exr", _exr(width, height)),
            f"hdr, {size}": ("hdr", _hdr(width, height)),
            f"bmp, {size}": ("bmp", _bmp(width, height)),
            f"tiff, {size}": ("tif", _tiff(width, height)),
            f"gif, {size}": ("gif", b"GIF89a" + struct.pack("<HHBBB", width & 65_535, height & 65_535, 0, 0, 0) + b";"),
            f"webp, {size}": ("webp", _webp(width, height)),
            f"tga, {size}": ("tga", _tga(width, height)),
        }
    pictures |= {
        "png of 400 million zeros": ("png", _png(20_000, 20_000, whole=True)),
        "png of one line of zeros": ("png", _png(_HUGE, 1, whole=True)),
        "png of one column of zeros": ("png", _png(1, _HUGE, whole=True)),
        "png with 50,000 texts": ("png", _png(8, 8, whole=True, texts=50_000)),
        "png with a text that unpacks to 1 GiB": ("png", _png(8, 8, whole=True, packed=True)),
        "a picture that is a program": ("png", b"\x7fELF" + b"\0" * 1000),
        "an empty picture": ("png", b""),
    }
    found = {}
    for name, (suffix, content) in pictures.items():
        for slot, stage in _textured(f"bomb.{suffix}").items():
            found[f"{name}, {slot}"] = package({"a.usda": stage, f"bomb.{suffix}": content})
    return found


def _textured(name: str) -> dict[str, str]:
    sky = f'def DomeLight "Sky"\n    {{\n        asset inputs:texture:file = @{name}@\n    }}\n'
    wood = f"""def Material "Wood"
    {{
        token outputs:surface.connect = </World/Wood/S.outputs:surface>
        def Shader "S"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </World/Wood/T.outputs:rgb>
            token outputs:surface
        }}
        def Shader "T"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{name}@
            float3 outputs:rgb
        }}
    }}
"""
    bound = BALL.replace(
        'def Cube "Back"\n    {',
        'def Cube "Back" (prepend apiSchemas = ["MaterialBindingAPI"])\n    {\n'
        "        rel material:binding = </World/Wood>",
    )
    return {
        "sky": BALL.replace('def Material "Glass"', sky + '    def Material "Glass"'),
        "wood": bound.replace('def Material "Glass"', wood + '    def Material "Glass"'),
    }


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(width: int, height: int, *, whole: bool = False, texts: int = 0, packed: bool = False) -> bytes:
    """`whole`: with all its lines, zeros that pack to a thousandth; else with the first bytes alone."""
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    more = b"".join(_chunk(b"tEXt", b"k%d\0v" % k) for k in range(texts))
    if packed:
        more += _chunk(b"zTXt", b"k\0\0" + _zeros(1 << 30))
    data = _zeros((width + 1) * height) if whole else zlib.compress(b"\0" * 64)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + more + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _zeros(count: int) -> bytes:
    """That many zeros, packed, without ever holding them."""
    packer, part, made = zlib.compressobj(9), b"\0" * (1 << 20), []
    for _ in range(count >> 20):
        made.append(packer.compress(part))
    return b"".join([*made, packer.compress(part[: count & ((1 << 20) - 1)]), packer.flush()])


def _jpeg(width: int, height: int) -> bytes:
    frame = struct.pack(">BHHB", 8, height & 65_535, width & 65_535, 1) + b"\x01\x11\x00"
    table = b"\xff\xdb\x00\x43\x00" + b"\x01" * 64
    return (
        b"\xff\xd8"
        + table
        + b"\xff\xc0"
        + struct.pack(">H", len(frame) + 2)
        + frame
        + b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00"
        + b"\0" * 64
        + b"\xff\xd9"
    )


def _exr(width: int, height: int) -> bytes:
    def field(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    window = struct.pack("<4i", 0, 0, max(width - 1, -1), max(height - 1, -1))
    return (
        b"\x76\x2f\x31\x01\x02\0\0\0"
        + field("channels", "chlist", b"R\0" + struct.pack("<iiii", 1, 0, 1, 1) + b"\0")
        + field("compression", "compression", b"\x03")
        + field("dataWindow", "box2i", window)
        + field("displayWindow", "box2i", window)
        + field("lineOrder", "lineOrder", b"\0")
        + field("pixelAspectRatio", "float", struct.pack("<f", 1))
        + field("screenWindowCenter", "v2f", b"\0" * 8)
        + field("screenWindowWidth", "float", struct.pack("<f", 1))
        + b"\0"
        + b"\0" * 256
    )


def _hdr(width: int, height: int) -> bytes:
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width) + b"\x02\x02\x7f\xff" + b"\0" * 64


def _bmp(width: int, height: int) -> bytes:
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + head + b"\0" * 64


def _tiff(width: int, height: int) -> bytes:
    entries = [
        (256, 4, width),
        (257, 4, height),
        (258, 3, 8),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 8),
        (277, 3, 1),
        (278, 4, height),
        (279, 4, 64),
    ]
    body = b"".join(struct.pack("<HHII", tag, kind, 1, value & 0xFFFFFFFF) for tag, kind, value in entries)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + body + b"\0" * 64


def _webp(width: int, height: int) -> bytes:
    size = (
        struct.pack("<I", (max(width, 1) - 1) & 0xFFFFFF)[:3] + struct.pack("<I", (max(height, 1) - 1) & 0xFFFFFF)[:3]
    )
    part = b"VP8X" + struct.pack("<I", 10) + b"\0\0\0\0" + size
    return b"RIFF" + struct.pack("<I", 4 + len(part)) + b"WEBP" + part


def _tga(width: int, height: int) -> bytes:
    return (
        struct.pack("<BBBHHBHHHHBB", 0, 0, 10, 0, 0, 0, 0, 0, width & 65_535, height & 65_535, 24, 0)
        + b"\xff\0\0\0" * 16
    )


def package_bombs() -> dict[str, bytes]:
    """Zips that unpack to more than they are, or that no two programs read alike."""
    honest = package({"a.usda": BALL})
    large = io.BytesIO()
    with zipfile.ZipFile(large, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr(zipfile.ZipInfo("a.usda"), BALL)
        with archive.open("zeros.png", "w") as file:
            for _ in range(1024):
                file.write(b"\0" * (1 << 20))
    tail = honest.rindex(b"PK\x05\x06")
    middle = honest.index(b"PK\x01\x02")
    claimed = bytearray(honest)
    claimed[middle + 20 : middle + 28] = b"\xff\xff\xff\x7f" * 2
    many = bytearray(honest)
    many[tail + 8 : tail + 12] = b"\xff\xff\xff\xff"
    far = bytearray(honest)
    far[tail + 16 : tail + 20] = b"\xff\xff\xff\x7f"
    inner = package({"a.usda": BALL})
    for _ in range(20):
        inner = package({"a.usda": referring("./inner.usdz"), "inner.usdz": inner})
    doubled = honest[:middle] + honest[middle:tail] * 2000 + honest[tail:]
    return {
        "1 GiB of zeros": large.getvalue(),
        "packed": package({"a.usda": BALL}, compress=True),
        "65,000 files": package({"a.usda": BALL, **{f"{k}.png": b"" for k in range(65_000)}}),
        "a size of 2 GiB": bytes(claimed),
        "65,535 entries of one": bytes(many),
        "a directory far away": bytes(far),
        "packages in packages, 20 deep": inner,
        "a directory 2,000 times": doubled,
        "without an end": honest[:tail],
        "only an end": honest[tail:],
        "a zip in front": b"PK\x03\x04" + honest,
        "behind a program": b"PK\x03\x04" + b"\0" * 1000,
        "names that are one": package({"a.usda": BALL, "A.usda": BALL, "a.usda ": BALL}),
        "a name of 60,000": package({"a.usda": BALL, "n" * 60_000: b"x"}),
        "a name outside": package({"a.usda": BALL, "../b.usda": BALL}),
        "a name from the root": package({"a.usda": BALL, "/etc/b.usda": BALL}),
        "nothing": package({}),
        "no layer": package({"a.png": b"x"}),
        "a layer second": package({"b.png": b"x", "a.usda": BALL}),
        "a name that is no text": package({"a.usda": BALL}).replace(b"a.usda", b"\xff\xfe.usd"),
        "a link": _linked(),
        "encrypted": _flagged(honest, 1),
        "with sizes behind": _flagged(honest, 8),
    }


def _linked() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        info = zipfile.ZipInfo("a.usda")
        info.external_attr = 0o120777 << 16
        archive.writestr(info, "/etc/passwd")
    return stream.getvalue()


def _flagged(content: bytes, flag: int) -> bytes:
    data = bytearray(content)
    data[6] |= flag
    data[data.index(b"PK\x01\x02") + 8] |= flag
    return bytes(data)


# --- no HTTP ---------------------------------------------------------------------------------------------------------


class Protocol(NamedTuple):
    """Bytes for a socket, and what may come back."""

    sent: bytes
    allowed: frozenset[int] = frozenset()
    """Statuses of the first answer; empty: any below 500, 501 or 505, or a connection that closes."""
    alone: bool = False
    """Exactly one answer, and then the end: what follows in the connection is another's words."""


def protocol_attacks(seeds: int = 100) -> Mapping[str, Protocol]:
    """Handwritten ones, and damaged honest requests."""
    found = {**_heads(), **_framing(), **_bodies(), **_paths(), **_pages_of_others()}
    whole = _request(
        "POST", "/v1/render", "multipart/form-data; boundary=x", _form(BALL, '{"image_width": 8, "samples": 1}')
    )
    for seed in range(seeds):
        found[f"damaged request {seed}"] = Protocol(_shaken(whole, seed))
    return found


def _request(method: str, path: str, media: str = "", body: bytes = b"", *lines: str, host: str = "localhost") -> bytes:
    head = [f"{method} {path} HTTP/1.1", f"Host: {host}", *lines]
    if media:
        head += [f"Content-Type: {media}", f"Content-Length: {len(body)}"]
    return "\r\n".join(head).encode("latin-1") + b"\r\n\r\n" + body


def _form(stage: str, settings: str) -> bytes:
    return (
        f'--x\r\nContent-Disposition: form-data; name="stage"; filename="a.usda"\r\n\r\n{stage}\r\n'
        "--x\r\nContent-Disposition: "
        f'form-data; name="settings"\r\n\r\n{settings}\r\n--x--\r\n'
    ).encode()


def _shaken(whole: bytes, seed: int) -> bytes:
    """`mutated` leaves the first bytes of a file alone; here any byte may be another one."""
    dice = random.Random(seed)
    data = bytearray(whole)
    for _ in range(dice.randint(1, 8)):
        at = dice.randrange(min(len(data), 400))
        if dice.random() < 0.5:
            data[at] = dice.randrange(256)
        else:
            data[at : at + dice.randint(0, 6)] = bytes(dice.randrange(256) for _ in range(dice.randint(0, 6)))
    return bytes(data)


def _heads() -> dict[str, Protocol]:
    get = "GET /livez HTTP/1.1\r\nHost: localhost\r\n"
    lines = {
        "a header of 1 MB": f"X: {'a' * 1_000_000}\r\n",
        "100,000 headers": "X: y\r\n" * 100_000,
        "a NUL in a value": "X: a\0b\r\n",
        "a NUL in a name": "X\0: a\r\n",
        "a name without a colon": "Xyz\r\n",
        "a space before the colon": "X : y\r\n",
        "a folded line": "X: y\r\n z\r\n",
        "an empty name": ": y\r\n",
        "a control in a value": "X: \x01\x02\r\n",
        "bytes above 127": "X: \xff\xfe\r\n",
        "a second Host": "Host: other\r\n",
        "an upgrade to a web socket": "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: x\r\n",
        "an upgrade to HTTP/2": "Upgrade: h2c\r\nConnection: Upgrade, HTTP2-Settings\r\nHTTP2-Settings: AAMAAABk\r\n",
        "an odd Expect": "Expect: 200-maybe\r\n",
        "cookies of 60 kB": f"Cookie: {'a=b; ' * 12_000}\r\n",
        "ten thousand ranges": f"Range: bytes={','.join(f'{k}-{k}' for k in range(9_000))}\r\n",
        "a range of no end": "Range: bytes=99999999999999999999-\r\n",
        "a negative range": "Range: bytes=-0\r\n",
        "q=nan": "Accept: image/png;q=nan\r\n",
        "q=1e999": "Accept: image/png;q=1e999\r\n",
        "a thousand tags": f"If-None-Match: {', '.join(['W/*'] * 9_000)}\r\n",
        "TE: trailers": "TE: trailers\r\nTrailer: X\r\n",
        "an odd request id": "X-Request-Id: \t\x7f'\";--\r\n",
        "a proxy's word": "X-Forwarded-For: 1.2.3.4\r\nForwarded: for=evil\r\n",
    }
    found = {name: Protocol((get + line + "\r\n").encode("latin-1")) for name, line in lines.items()}
    raw = {
        "HTTP/0.9": b"GET /livez\r\n",
        "HTTP/2's first words": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        "HTTP/3.0": b"GET / HTTP/3.0\r\nHost: x\r\n\r\n",
        "HTTP/1.0 without a host": b"GET /livez HTTP/1.0\r\n\r\n",
        "no host": b"GET /livez HTTP/1.1\r\n\r\n",
        "line feeds alone": b"GET /livez HTTP/1.1\nHost: localhost\n\n",
        "TLS": bytes.fromhex("160301020001000 1fc0303".replace(" ", "")) + b"\0" * 500,
        "SSH": b"SSH-2.0-x\r\n",
        "zeros": b"\0" * 10_000,
        "noise": random.Random(1).randbytes(10_000),
        "an empty line first": b"\r\n\r\nGET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "a method of 10 kB": b"A" * 10_000 + b" / HTTP/1.1\r\nHost: x\r\n\r\n",
        "an address of 1 MB": b"GET /" + b"a" * 1_000_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "CONNECT": b"CONNECT 127.0.0.1:22 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "TRACE": b"TRACE / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "OPTIONS *": b"OPTIONS * HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "a lower-case method": b"get /livez HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "PROXY protocol": b"PROXY TCP4 1.2.3.4 5.6.7.8 1 2\r\nGET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "a thousand requests at once": (get + "\r\n").encode() * 1000,
        "nothing": b"",
        "half a line": b"GET /li",
    }
    return found | {name: Protocol(sent) for name, sent in raw.items()}


def _framing() -> dict[str, Protocol]:
    """Lengths that two programs may read differently: the second request must never be answered."""
    second = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n"
    post = "POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    alone = {
        "length and chunks": "Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        "chunks and length": "Transfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\n0\r\n\r\n",
        "two lengths": "Content-Length: 2\r\nContent-Length: 0\r\n\r\n{}",
        "two lengths in one": "Content-Length: 2, 0\r\n\r\n{}",
        "a negative length": "Content-Length: -1\r\n\r\n{}",
        "a length with a sign": "Content-Length: +2\r\n\r\n{}",
        "a length in hex": "Content-Length: 0x2\r\n\r\n{}",
        "a length of 10,000 digits": f"Content-Length: {'9' * 10_000}\r\n\r\n{{}}",
        "a length that is no number": "Content-Length: two\r\n\r\n{}",
        "a length of Arabic digits": "Content-Length: \xb2\r\n\r\n{}",
        "an unknown coding": "Transfer-Encoding: gzip\r\n\r\n{}",
        "a coding twice": "Transfer-Encoding: chunked, chunked\r\n\r\n0\r\n\r\n",
        "a coding behind a tab": "Transfer-Encoding:\tchunked, identity\r\n\r\n0\r\n\r\n",
        "an odd coding": "Transfer-Encoding: xchunked\r\n\r\n0\r\n\r\n",
        "a chunk of odd size": "Transfer-Encoding: chunked\r\n\r\nzz\r\n{}\r\n0\r\n\r\n",
        "a chunk of negative size": "Transfer-Encoding: chunked\r\n\r\n-2\r\n{}\r\n0\r\n\r\n",
        "a chunk of 10^30": "Transfer-Encoding: chunked\r\n\r\n" + "f" * 30 + "\r\n{}\r\n0\r\n\r\n",
        "a chunk without its end": "Transfer-Encoding: chunked\r\n\r\n2\r\n{}xx0\r\n\r\n",
        "an extension of 1 MB": f"Transfer-Encoding: chunked\r\n\r\n2;{'a' * 1_000_000}\r\n{{}}\r\n0\r\n\r\n",
    }
    found = {name: Protocol((post + rest).encode("latin-1") + second, alone=True) for name, rest in alone.items()}
    many = "Transfer-Encoding: chunked\r\n\r\n" + "1\r\n \r\n" * 100_000 + "2\r\n{}\r\n0\r\n\r\n"
    trailing = "Transfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n" + "X: y\r\n" * 20_000 + "\r\n"
    return found | {
        "a body of 100,000 chunks": Protocol((post + many).encode()),
        "20,000 trailers": Protocol((post + trailing).encode()),
        "a length of more than there is": Protocol((post + "Content-Length: 100\r\n\r\n{").encode()),
    }


def _bodies() -> dict[str, Protocol]:
    def said(text: str | bytes, *lines: str) -> Protocol:
        body = text if isinstance(text, bytes) else text.encode()
        return Protocol(_request("POST", "/v1/render", "application/json", body, *lines))

    def form(body: bytes, media: str = "multipart/form-data; boundary=x") -> Protocol:
        return Protocol(_request("POST", "/v1/render", media, body))

    part = b'--x\r\nContent-Disposition: form-data; name="stage"; filename="%s"\r\n\r\n#usda 1.0\r\n--x--\r\n'
    named = '{"stage": "marble.usda", "image_width": 8, '
    return {
        "JSON 100,000 deep": said("[" * 100_000),
        "JSON objects 50,000 deep": said('{"a":' * 50_000),
        "NaN": said(named + '"exposure": NaN}'),
        "1e999": said(named + '"exposure": 1e999}'),
        "an integer of 5,000 digits": said(named + f'"samples": {"9" * 5000}}}'),
        "half a surrogate": said('{"stage": "\\ud800.usda"}'),
        "half a surrogate as a name": said('{"\\udfff": 1}'),
        "half a surrogate as a camera": said(named + '"camera": "/\\ud800"}'),
        "a NUL in a name": said('{"stage": "marble.usda\\u0000"}'),
        "a NUL in a camera": said(named + '"camera": "/a\\u0000b"}'),
        "no UTF-8": said(b'{"stage": "\xff\xfe"}'),
        "UTF-16": said('{"stage": "marble.usda"}'.encode("utf-16")),
        "a byte order mark": said(b"\xef\xbb\xbf{}"),
        "a field twice": said('{"stage": "marble.usda", "stage": "x"}'),
        "a list": said("[]"),
        "a number": said("1"),
        "null": said("null"),
        "nothing": said(""),
        "a camera of 200 kB": said(named + f'"camera": "/{"a" * 200_000}"}}'),
        "10,000 overrides": said(
            named + '"overrides": {' + ", ".join(f'"/p{k}": {{"ior": 1}}' for k in range(6_000)) + "}}"
        ),
        "an override of nothing": said(named + '"overrides": {"": {"ior": 1.1}, "//": {"ior": 1.1}}}'),
        "a side of 2^62": said(named + '"image_height": 4611686018427387904}'),
        "a time of 1e308": said(named + '"time_code": 1e308}'),
        "a time of -0": said(named + '"time_code": -0.0}'),
        "300 kB of settings": said(" " * 300_000 + "{}"),
        "gzip": said(zlib.compress(b"{}"), "Content-Encoding: gzip"),
        "another charset": Protocol(_request("POST", "/v1/render", "application/json; charset=utf-7", b"{}")),
        "no boundary": form(b"--x--\r\n", "multipart/form-data"),
        "a boundary of 60 kB": form(b"--x--\r\n", f"multipart/form-data; boundary={'x' * 60_000}"),
        "an empty boundary": form(b"----\r\n", "multipart/form-data; boundary="),
        "a boundary that is no text": form(b"--x--\r\n", "multipart/form-data; boundary=\xff"),
        "10,000 parts": form(b'--x\r\nContent-Disposition: form-data; name="a"\r\n\r\nb\r\n' * 10_000 + b"--x--\r\n"),
        "a part without headers": form(b"--x\r\n\r\nb\r\n--x--\r\n"),
        "a part without a name": form(b"--x\r\nContent-Disposition: form-data\r\n\r\nb\r\n--x--\r\n"),
        "a part whose head is 1 MB": form(b"--x\r\nX: " + b"a" * 1_000_000 + b"\r\n\r\nb\r\n--x--\r\n"),
        "a part of 100,000 headers": form(b"--x\r\n" + b"X: y\r\n" * 100_000 + b"\r\nb\r\n--x--\r\n"),
        "no end": form(b"--x\r\nContent-Disposition: form-data; name=stage; filename=a\r\n\r\n#usda 1.0"),
        "a file's name with a NUL": form(part % b"a\0.usda"),
        "a file's name outside": form(part % b"../../../etc/passwd"),
        "a file's name of 60 kB": form(part % (b"a" * 60_000)),
        "a file's name that is no text": form(part % b"\xff\xfe"),
        "a file of nothing": form(
            b'--x\r\nContent-Disposition: form-data; name="stage"; filename="a"\r\n\r\n\r\n--x--\r\n'
        ),
        "settings twice": form(_form(BALL, "{}")[:-7] + _form(BALL, "{}")),
        "settings as a file": form(_form(BALL, "{}").replace(b'name="settings"', b'name="settings"; filename="s"')),
        "a form that is a link": form(b"stage=a", "application/x-www-form-urlencoded"),
        "XML with an entity": form(b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "text/xml"),
    }


def _paths() -> dict[str, Protocol]:
    paths = (
        "/../../etc/passwd",
        "/static/../../../../etc/passwd",
        "/static/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
        "/static/..%2f..%2f..%2fetc/passwd",
        "/static/%252e%252e/x",
        "/static//etc/passwd",
        "/static/%00",
        "/static/..\\..\\x",
        "/v1/jobs/../../etc/passwd",
        "/v1/jobs/%2e%2e/image",
        f"/v1/jobs/{'a' * 64}/aovs/..%2f..%2fx.png",
        f"/v1/jobs/{'a' * 60_000}",
        "/v1/jobs/%ff%fe",
        "/v1/jobs/%00",
        f"/v1/jobs/{'f' * 64}/events",
        "/problems/../x",
        "/problems/%ff",
        "//evil.test/",
        "/%",
        "/%zz",
        "/?%",
        "/v1/stages?" + "a=b&" * 10_000,
        "http://evil.test/livez",
        "/v1/render/",
        "/V1/limits",
        "/v1//limits",
        "/;/v1/limits",
        "/.git/config",
        "/.env",
    )
    return {f"GET {path[:50]}": Protocol(_request("GET", path)) for path in paths}


def _pages_of_others() -> dict[str, Protocol]:
    """What a browser sends for a page of somebody else."""
    ours, told = "http://localhost", json.dumps({"stage": "marble.usda", "image_width": 8, "samples": 1}).encode()
    refused = frozenset({403, 421})
    return {
        "a name that is not ours": Protocol(_request("GET", "/v1/stages", host="evil.test"), frozenset({421})),
        "a name that is not ours, its page": Protocol(
            _request("POST", "/v1/render", "application/json", told, "Origin: http://evil.test", host="evil.test"),
            refused,
        ),
        "another page's post": Protocol(
            _request("POST", "/v1/render", "application/json", told, "Origin: http://evil.test"), refused
        ),
        "a page from nowhere": Protocol(
            _request("POST", "/v1/render", "application/json", told, "Origin: null"), refused
        ),
        "another port's page": Protocol(
            _request("POST", "/v1/render", "application/json", told, f"Origin: {ours}:1"), refused
        ),
        "another page's delete": Protocol(
            _request("DELETE", f"/v1/jobs/{'a' * 64}", "", b"", "Origin: http://evil.test"), refused
        ),
    }
