"""The attack and the soak: their tables from numbers made up here, their judgement, and each once, very small."""

from __future__ import annotations

import io
import time
import zipfile
from pathlib import Path

import pytest
from pxr import Sdf
from service_server import ROOT

from benchmarks import attack, hostile, pages, soak
from benchmarks.attack import Options, Row
from benchmarks.besieged import Held, Tally, leaks
from benchmarks.soak import Heard, Rate, Soaked

FEW = Options(mutants=4, damaged_requests=2, races=4, bombs=2)


def test_the_page_has_a_place_for_each_table() -> None:
    for name in ("attack", "soak"):
        pages.block_of(attack.PAGE.read_text("utf-8"), name)


def test_what_must_not_be_is_counted_and_what_is_told_is_not() -> None:
    tally = Tally()
    tally.answer("a", 422, '{"type": "/problems/stage-invalid"}')
    tally.answer("b", 507, '{"type": "/problems/disk-full"}')
    assert (tally.faults, tally.told) == ([], 1)
    tally.answer("c", 500, '{"type": "/problems/internal"}')
    tally.answer("d", 422, f'{{"detail": "{ROOT}/x.py"}}')
    tally.event("e", "no answer", fault=True)
    assert [fault.partition(":")[0] for fault in tally.faults] == ["c", "d", "e"]
    assert tally.sent == 5
    assert tally.outcomes["stage-invalid"] == 1


def test_a_row_holds_where_nothing_is_wrong_nothing_stays_and_it_is_well_again() -> None:
    fine = Row("fine", Tally(sent=3), recovery=0.25)
    assert fine.holds
    assert not fine._replace(leaks=("+1 files",)).holds
    assert not fine._replace(recovery=None).holds
    assert not fine._replace(tally=Tally(faults=["x: 500"])).holds
    rows = attack.table([fine, Row("ill", Tally(sent=1000, faults=["x"], told=2), ("+1 files",), 3 << 20)]).splitlines()
    assert rows[2] == "| fine | 3 | 0 | 0 | nothing | +0 MiB | 0.2 s | - |"
    assert rows[3] == "| ill | 1,000 | 1 | 2 | +1 files | +3 MiB | never | - |"


def test_what_is_left_behind_is_told_and_memory_is_not() -> None:
    before = Held(4, 40, 3, 0, 1 << 30)
    assert leaks(before, before._replace(memory=2 << 30, descriptors=39)) == []
    assert leaks(before, before._replace(processes=5, shared=2)) == ["+1 processes", "+2 shared"]


def test_the_same_damage_every_time() -> None:
    assert list(hostile.damaged(6)) == list(hostile.damaged(6))
    assert len({content for _, content in hostile.damaged(40)}) == 40


def test_bombs_of_prims_are_small_and_usd_reads_them() -> None:
    bombs = hostile.prim_bombs()
    for name in ("references, 2^30", "variants, 2^30", "a hundred arms, 100^6", "instancers in instancers"):
        assert len(bombs[name]) < 32_768
    for name, content in bombs.items():
        if content.startswith(b"#usda") and "deep" not in name and len(content) < 100_000:
            assert Sdf.Layer.CreateAnonymous(".usda").ImportFromString(content.decode()), name


def test_bombs_of_packages_unpack_to_more_than_they_are() -> None:
    bombs = hostile.package_bombs()
    with zipfile.ZipFile(io.BytesIO(bombs["1 GiB of zeros"])) as archive:
        assert sum(one.file_size for one in archive.infolist()) > 1 << 30
    assert len(bombs["1 GiB of zeros"]) < 1 << 22
    assert all(len(content) < 1 << 24 for content in bombs.values())


def test_protocol_attacks_have_names_of_their_own_and_differ() -> None:
    attacks = hostile.protocol_attacks(10)
    assert len({one.sent for one in attacks.values()}) > 0.95 * len(attacks) > 100


def test_the_soak_says_what_the_numbers_say() -> None:
    quiet, loud = Heard((0.1,) * 99 + (0.2,), 0, ()), Heard((0.1,) * 50 + (0.8,) * 50, 3, ("500",))
    held = tuple(Held(4, 40 + k, 0, 0, (100 + k) << 20) for k in range(8))
    found = Soaked(quiet, loud, quiet, quiet, Rate(90, 10.0, 45.0), Rate(100, 10.0, 20.0), held, 1234)
    text = soak.table(found)
    assert "| attacked | 100 | 450 ms | 800 ms | 4.0 | 3 | 1 |" in text
    assert "9.0 renders a second through HTTP, 10.0 by the engine alone on the same cores: 90%" in text
    assert "0.50 CPU s of the service, 0.20 of the engine" in text
    assert "Memory: 100 MiB in the first quarter of the time, 106 in the last, 107 at most" in text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mutants", "packages", "cancels", "kills"])
def test_a_small_attack_is_held(name: str, tmp_path: Path) -> None:
    for row in attack.PARTS[name](tmp_path, FEW):
        assert row.holds, attack.details(row)
        assert row.tally.sent


@pytest.mark.slow
def test_a_short_soak(tmp_path: Path) -> None:
    start = time.monotonic()
    found = soak.soak(0.1, tmp_path)
    assert time.monotonic() - start > 6.0 * 0.75
    for part in (found.quiet, found.full, found.after):
        assert part.seconds
        assert not part.failed
    assert found.flooded
    assert found.alone.renders
    assert found.served.cpu > 0.0
