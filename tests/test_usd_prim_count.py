"""Prims are counted before USD composes them: the count is USD's own where a stage is small enough to ask."""

from __future__ import annotations

from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdSkel
from service_server import ROOT
from service_stages import HEAD, laughs

from refract_core.errors import StageError
from refract_core.usd.geometry import traverse
from refract_core.usd.geometry.skel import posed
from refract_core.usd.prim_count import CEILING, CIRCLES, count_prims
from refract_core.usd.stage import load_stage, open_stage

SAMPLES = sorted((ROOT / "usd_samples").rglob("*.usda"))


def layer_of(text: str) -> Sdf.Layer:
    layer = Sdf.Layer.CreateAnonymous(".usda")
    assert layer.ImportFromString(text)
    return layer


def composed(layer: Sdf.Layer) -> int:
    """What USD makes of it, instances expanded."""
    stage = Usd.Stage.Open(layer)
    every = Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)
    return sum(1 for _ in Usd.PrimRange.Stage(stage, every))


def doubling(arc: str, levels: int) -> str:
    """Each level holds two prims with an arc to the level below."""
    parts = ['def "L0"\n{\n}\n']
    for level in range(1, levels):
        below = f"{arc} = </L{level - 1}>"
        twice = "".join(f'    def "{side}" (\n        {below}\n    )\n    {{\n    }}\n' for side in "ab")
        parts.append(f'def "L{level}"\n{{\n{twice}}}\n')
    return "#usda 1.0\n" + "".join(parts)


def in_variants(levels: int) -> str:
    """The same, each level inside of a selected variant; another one, never selected, is larger."""
    parts = ['def "L0"\n{\n}\n']
    for level in range(1, levels):
        refer = f"references = </L{level - 1}>"
        few, many = (
            "".join(f'            def "c{n}" (\n                {refer}\n            )\n            {{}}\n'
                    for n in range(count)) for count in (2, 9)
        )  # fmt: skip
        parts.append(
            f'def "L{level}" (\n    variants = {{\n        string size = "few"\n    }}\n'
            '    prepend variantSets = "size"\n)\n{\n    variantSet "size" = {\n'
            f'        "few" {{\n{few}        }}\n        "many" {{\n{many}        }}\n    }}\n}}\n'
        )
    return "#usda 1.0\n" + "".join(parts)


FAMILIES = {
    "references": lambda n: doubling("references", n), "payloads": lambda n: doubling("payload", n),
    "inherits": lambda n: doubling("inherits", n), "specializes": lambda n: doubling("specializes", n),
    "instances": lambda n: laughs(n, instanceable=True), "variants": in_variants,
}  # fmt: skip


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("levels", [2, 3, 6])
def test_the_count_is_what_usd_composes(family: str, levels: int) -> None:
    layer = layer_of(FAMILIES[family](levels))
    assert count_prims(layer).prims == composed(layer)


@pytest.mark.parametrize("family", FAMILIES)
def test_billions_are_counted_without_composing(family: str) -> None:
    """A level has one prim more than twice the one below, and all levels stand beside one another."""
    layer = layer_of(FAMILIES[family](40))
    found = count_prims(layer)
    assert found.prims == sum(2**level - 1 for level in range(1, 41))
    assert not found.more


def test_no_number_grows_beyond_its_ceiling() -> None:
    found = count_prims(layer_of(doubling("references", 3000)))
    assert found.prims == found.opinions == CEILING
    assert str(found).startswith("over ")


@pytest.mark.parametrize("path", [path for path in SAMPLES if path.stem != "not_usd"], ids=lambda path: path.stem)
def test_samples_are_counted_as_usd_does(path: Path) -> None:
    """And what its point instancers draw: of each place one prim, in the samples."""
    layer = Sdf.Layer.FindOrOpen(str(path))
    stage = Usd.Stage.Open(layer)
    instancers = [UsdGeom.PointInstancer(prim) for prim in stage.Traverse()]
    places = [one.GetProtoIndicesAttr().Get() for one in instancers if one]
    assert count_prims(str(path)).prims == composed(layer) + sum(map(len, places))


def test_what_is_no_stage_is_said(tmp_path: Path) -> None:
    with pytest.raises(StageError):
        count_prims(str(ROOT / "usd_samples" / "bad" / "not_usd.usda"))
    with pytest.raises(StageError):
        count_prims(str(tmp_path / "none.usda"))


def test_files_multiply_as_prims_do_and_missing_ones_do_not(tmp_path: Path) -> None:
    for level in range(30):
        below = f"@./l{level - 1}.usda@" if level else "@./none.usda@"
        twice = "".join(f'    def "{side}" (\n        references = {below}\n    )\n    {{\n    }}\n' for side in "ab")
        (tmp_path / f"l{level}.usda").write_text(f'{HEAD}def "World"\n{{\n{twice}}}\n')
    assert count_prims(str(tmp_path / "l4.usda")).prims == composed(Sdf.Layer.FindOrOpen(str(tmp_path / "l4.usda")))
    assert count_prims(str(tmp_path / "l29.usda")).prims == 2**31 - 1


def test_sublayers_that_speak_of_one_prim_count_it_once(tmp_path: Path) -> None:
    body = 'def "World"\n{\n    def "a"\n    {\n    }\n}\n'
    (tmp_path / "weak.usda").write_text(f"#usda 1.0\n{body}")
    (tmp_path / "weaker.usda").write_text(f'#usda 1.0\n(\n    subLayers = [@./root.usda@]\n)\n{body}def "b"\n{{\n}}\n')
    root = tmp_path / "root.usda"
    root.write_text(f"#usda 1.0\n(\n    subLayers = [@./weak.usda@, @./weaker.usda@, @./none.usda@]\n)\n{body}")
    assert count_prims(str(root)) .prims == 3
    assert composed(Sdf.Layer.FindOrOpen(str(root))) == 3


def test_a_reference_to_a_prim_inside_brings_what_is_above_it() -> None:
    text = """#usda 1.0
def "A"
{
    def "x"
    {
        def "y"
        {
        }
    }
}
def "B" (
    references = </A>
)
{
}
def "C" (
    references = </B/x>
)
{
}
"""
    layer = layer_of(text)
    assert count_prims(layer).prims == composed(layer) == 8


def test_a_class_that_the_referencing_layer_adds_to_counts_there(tmp_path: Path) -> None:
    (tmp_path / "asset.usda").write_text(
        f'{HEAD}class "_c"\n{{\n    def "a"\n    {{\n    }}\n}}\ndef "World" (\n    inherits = </_c>\n)\n{{\n}}\n'
    )
    root = tmp_path / "root.usda"
    root.write_text(
        '#usda 1.0\ndef "W" (\n    references = @./asset.usda@\n)\n{\n}\nclass "_c"\n{\n    def "b"\n    {\n    }\n}\n'
    )
    layer = Sdf.Layer.FindOrOpen(str(root))
    assert count_prims(str(root)).prims == composed(layer) == 5


def test_what_leads_back_to_itself_is_left_out_as_usd_does() -> None:
    own = layer_of('#usda 1.0\ndef "A"\n{\n    def "b" (\n        references = </A>\n    )\n    {\n    }\n}\n')
    assert count_prims(own).prims == composed(own) == 2
    assert count_prims(layer_of(circles(4))).prims >= composed(layer_of(circles(4)))


def between(*arcs: tuple[str, str, str]) -> str:
    """Prims that refer to one place and hold an `A` that refers to another: name, target, target of its `A`."""
    return "#usda 1.0\n" + "".join(
        f'def "{name}" (\n    references = <{target}>\n)\n{{\n    def "A" (\n        references = <{inner}>\n    )\n'
        "    {\n    }\n}\n" for name, target, inner in arcs
    )  # fmt: skip


def test_arcs_between_a_prim_and_its_own_parts_are_left_out_as_usd_does() -> None:
    """Each way around makes the path longer, so it comes by no place twice."""
    own = layer_of(between(("World", "/World/A", "/World")))
    assert (count_prims(own).prims, count_prims(own).more) == (2, False)
    assert composed(own) == 2


def test_paths_that_only_grow_are_given_up_on() -> None:
    """Of two prims, each is a part of the other: neither arc leads back by itself."""
    found = count_prims(layer_of(between(("P", "/Q/A", "/Q"), ("Q", "/P/A", "/P"))), stop=200_000)
    assert found.more
    assert found.opinions < 10_000


def circles(count: int) -> str:
    """Prims that each hold a reference to every other: as many ways through as orders."""
    def body(one: int) -> str:
        return "".join(f'    def "c{n}" (\n        references = </P{n}>\n    )\n    {{\n    }}\n'
                       for n in range(count) if n != one)  # fmt: skip

    return "#usda 1.0\n" + "".join(f'def "P{one}"\n{{\n{body(one)}}}\n' for one in range(count))


def test_circles_are_given_up_in_time() -> None:
    found = count_prims(layer_of(circles(14)))  # 14! is 87 thousand million
    assert found.more or found.prims > 10**9
    assert found.prims >= CIRCLES


def test_opinions_multiply_where_prims_do_not() -> None:
    """Two prims a level, each put together from both of the level below: a line of 60 prims, and 2^30 specs each."""
    parts = ['def "N0"\n{\n}\ndef "M0"\n{\n}\n']
    for level in range(1, 30):
        both = f"references = [</N{level - 1}>, </M{level - 1}>]"
        parts += [f'def "{name}{level}" (\n    {both}\n)\n{{\n}}\n' for name in "NM"]
    found = count_prims(layer_of("#usda 1.0\n" + "".join(parts)))
    assert found.prims == 60
    assert found.opinions > 2**30


def test_point_instancers_multiply_their_prototypes() -> None:
    def instancer(name: str, target: str, count: int) -> str:
        return (f'def PointInstancer "{name}"\n{{\n    rel prototypes = [{target}]\n'
                f"    int[] protoIndices = [{', '.join(['0'] * count)}]\n"
                '    def Xform "Ball"\n    {\n        def Sphere "s"\n        {\n        }\n    }\n}\n')  # fmt: skip

    text = "#usda 1.0\n" + instancer("Inner", "</Inner/Ball>", 1000) + instancer("Outer", "</Inner>", 1000)
    # Inner: itself, the ball (2 prims), and 1000 balls; Outer: itself, its ball, and 1000 times what Inner is.
    inner = 3 + 1000 * 2
    assert count_prims(layer_of(text)).prims == inner + 3 + 1000 * inner


def test_looking_stops_where_it_is_told_to() -> None:
    boxes = "".join(f'def "a{n}"\n{{\n    def "b"\n    {{\n    }}\n}}\n' for n in range(100))
    assert count_prims(layer_of(f"#usda 1.0\n{boxes}"), stop=50).more
    assert not count_prims(layer_of(f"#usda 1.0\n{boxes}"), stop=500).more


# --- what the engine itself does with a stage of instances


def skinned(levels: int) -> str:
    """2^levels places for one skeleton."""
    return laughs(levels, instanceable=True).replace('def Sphere "L0"', 'def SkelRoot "L0"')


@pytest.mark.parametrize("stage", [laughs(40, instanceable=True), skinned(40)])
def test_instances_of_instances_are_refused_not_walked(tmp_path: Path, stage: str) -> None:
    (tmp_path / "a.usda").write_text(stage)
    with pytest.raises(StageError, match=str(sum(2**level - 1 for level in range(1, 41)))):
        open_stage(str(tmp_path / "a.usda"))


def test_the_refusal_counts_as_the_walk_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.usda").write_text(laughs(5, instanceable=True))
    prims = composed(Sdf.Layer.FindOrOpen(str(tmp_path / "a.usda")))
    monkeypatch.setattr(traverse, "MAX_PRIMS", prims + 1)  # the walk begins at the root of all
    assert load_stage(tmp_path / "a.usda").spheres
    monkeypatch.setattr(traverse, "MAX_PRIMS", prims - 1)
    with pytest.raises(StageError, match=str(prims)):
        open_stage(tmp_path / "a.usda")


def test_skeletons_in_nested_instances_are_found(tmp_path: Path) -> None:
    """Eight places of one skeleton, three instances deep: each becomes a prim that can have its own pose."""
    (tmp_path / "a.usda").write_text(skinned(4))
    in_pose = posed(open_stage(tmp_path / "a.usda"), Usd.TimeCode(0), [])
    roots = [prim for prim in in_pose.Traverse() if prim.IsA(UsdSkel.Root) and str(prim.GetPath()).startswith("/L3")]
    assert len(roots) == 8
