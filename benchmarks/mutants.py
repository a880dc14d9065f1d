"""Do the tests notice? Small mistakes put into a copy of the engine, one at a time, and the tests that ought to fail.

    python -m benchmarks.mutants [--only NAME,...] [--list] [--jobs 1]

Each mutant is one edit that a person could make: a sign, a missing factor, a case left out. It is *killed* where some
test of its list fails, *alive* where all pass: then a law or an oracle is missing, and that is what to mend. Tests run
in the order given and stop at the first failure. The copy lives in a temporary folder; only the kernels that a mutant
reaches are compiled anew, so one takes about a minute. Exit code 1 where one is alive.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
ORACLE = "tests/test_oracle.py"
LAWS = "tests/test_render_laws.py"
COPIED = (
    "refract_core", "schemas", "service", "tests", "usd_samples", "benchmarks", "docs", "pyproject.toml", "README.md",
)  # fmt: skip


class Mutant(NamedTuple):
    """One edit: `before` stands exactly once in `file`."""

    name: str
    file: str
    """under refract_core"""
    before: str
    after: str
    tests: tuple[str, ...] = (ORACLE, LAWS)


MUTANTS = (
    # --- light through glass
    Mutant("alpha ignores what no tier answered", "transport/layers.py",
           "1.0 - exits.unanswered[lane] * clear_share", "1.0"),
    Mutant("dispersion without reloading the medium", "transport/layers.py",
           "                if disperses:\n                    _reload(",
           "                if channel < 0:\n                    _reload("),
    Mutant("dispersion: red and blue change places", "transport/layers.py",
           "red if channel == _RED else (green if channel == _GREEN else blue)",
           "blue if channel == _RED else (green if channel == _GREEN else red)"),
    Mutant("a pane absorbs without its cosine", "transport/exits.py",
           "WALL / cosine", "WALL"),
    Mutant("no tie-break where glass touches a table", "world/offsets.py",
           "return 4.0 * _reach(point)", "return 0.0 * _reach(point)"),
    Mutant("no normal map where a walk leaves", "transport/exits.py",
           "n = scale(flip_towards(normal_input(world, at), at.ng), -1.0)",
           "n = scale(flip_towards(at.ns, at.ng), -1.0)"),
    Mutant("no normal map where a walk enters another body", "transport/exits.py",
           "n = flip_towards(normal_input(world, at), at.ng)", "n = flip_towards(at.ns, at.ng)"),
    Mutant("a walk absorbs only in its last stretch", "transport/exits.py",
           "put(exits.transmittance, lane, mul(row(exits.transmittance, lane), through))\n\n\n@inlined\ndef _go_on",
           "put(exits.transmittance, lane, through)\n\n\n@inlined\ndef _go_on"),
    Mutant("a typed thickness reaches through the floor", "transport/exits.py",
           "    if measured:\n", "    if not measured:\n"),
    Mutant("reflection without Fresnel", "transport/layers.py",
           "reflection = query.color[lane, c] * f +", "reflection = query.color[lane, c] * 0.04 +"),
    Mutant("opacity does not dim what comes through", "transport/layers.py",
           "clear_share = (1.0 - opacity) * (1.0 - f)", "clear_share = 1.0 - f"),
    Mutant("a nested body keeps the outer ior", "transport/exits.py",
           "exits.ior_now[lane] = max(1.0, float_input(world, at, Param.IOR.value))",
           "exits.ior_now[lane] = max(1.0, exits.ior_now[lane])"),
    # --- the surface
    Mutant("clear coat doubled", "world/shading.py", "fc = coat * (", "fc = 2.0 * coat * ("),
    Mutant("occlusion ignored", "world/shading.py",
           "seen[lane] *= block.occlusion[lane]", "seen[lane] *= min(1.0, block.occlusion[lane] + 1.0)"),
    Mutant("specular workflow ignored", "world/shading.py",
           "if world.materials.specular_workflow[at.hit.material]:",
           "if world.materials.specular_workflow[at.hit.material] > 1:"),
    Mutant("a mirror shows things without their gloss", "world/shading.py",
           "_add_gloss_of_sky(second, lane, world, row(second.f0, lane), second.roughness[lane], 1.0)",
           "_add_gloss_of_sky(second, lane, world, row(second.f0, lane), second.roughness[lane], 0.0)"),
    Mutant("metal keeps its diffuse", "world/shading.py", "scale(base, 1.0 - metallic)", "scale(base, 1.0)"),
    Mutant("a normal map in mirrored uv is turned over", "world/surface.py",
           "1.0 if area > 0.0 else -1.0", "1.0"),
    Mutant("texture bias forgotten for scalars", "world/surface.py",
           "x = c[0] * materials.scale[m, i, channel] + materials.bias[m, i, channel]",
           "x = c[0] * materials.scale[m, i, channel]"),
    Mutant("mirrored wrap is one texel off", "world/textures.py",
           "return i if i < size else 2 * size - 1 - i", "return i if i < size else 2 * size - 2 - i",
           (ORACLE, "tests/test_textures.py")),
    Mutant("cut-out threshold counts as hole", "world/tracing.py",
           "return opacity < threshold", "return opacity <= threshold", (ORACLE, "tests/test_shading.py")),
    Mutant("shadows reach beyond the light", "world/offsets.py",
           "return t * (1.0 - 10.0 * RELATIVE)", "return t * 2.0", (ORACLE, "tests/test_shading.py")),
    # --- lights and sky
    Mutant("a light's diffuse multiplier forgotten", "world/shading.py", " * lights.diffuse[l]", "",
           (ORACLE, "tests/test_lights.py")),
    Mutant("a rect light shines backwards", "world/lights.py",
           "if dot(to, lamp.face) >= 0.0:  # behind it", "if dot(to, lamp.face) >= 1e30:",
           (ORACLE, "tests/test_lights.py")),
    Mutant("the dome turns the other way", "world/environment.py",
           "return 0.5 - math.atan2(x, z) / (2.0 * math.pi)", "return 0.5 + math.atan2(x, z) / (2.0 * math.pi)",
           (ORACLE, "tests/test_environment.py")),
    Mutant("a light's horizon is not clipped", "world/lights.py",
           "        total += _polygon_edge(leaving, entering, n)", "        total += 0.0",
           (ORACLE, "tests/test_lights.py")),
    # --- physics
    Mutant("Fresnel of one polarisation", "optics/interface.py",
           "return 0.5 * (rs * rs + rp * rp)", "return rs * rs", (ORACLE, "tests/test_optics.py")),
    Mutant("sphere model: path as long as the diameter", "optics/models.py",
           "path_length = thickness * cos_t\n", "path_length = thickness\n", (ORACLE, "tests/test_optics.py")),
    Mutant("Abbe number: half the dispersion", "optics/interface.py",
           "slope = (ior - 1.0) / (abbe *", "slope = 0.5 * (ior - 1.0) / (abbe *", (ORACLE, "tests/test_optics.py")),
    # --- tiers
    Mutant("the proxy tier reads foreground", "view/screen.py",
           "if there > shaded.z_depth else 0.0", "if there > 0.0 else 0.0", (ORACLE, "tests/test_screen.py")),
    Mutant("no fade at the edge of the screen", "probes/volumes.py",
           "return smooth01(steep * (1.0 - abs(2.0 * u - 1.0))) * ", "return ",
           (ORACLE, "tests/test_volumes.py", "tests/test_screen.py")),
    Mutant("a probe takes the weight of its uncovered share", "transport/tiers.py",
           "answered = weight * coverage", "answered = weight",
           ("tests/test_probes.py", "tests/test_nothing_invented.py")),
    Mutant("a probe's multiplier forgotten", "probes/lookup.py",
           "table.multiplier[k])", "1.0)", ("tests/test_probes.py", "tests/test_probe_laws.py")),
    Mutant("rough rays of the ray tier go straight", "transport/tiers.py",
           "if query.blur[lane] > 0.0:", "if query.blur[lane] > 100.0:"),
    # --- the picture
    Mutant("layers behind the first get lost", "rendering/layered.py",
           "used < self.max_layers", "used < min(2, self.max_layers)"),
    Mutant("one back face sends its whole tile on", "view/gbuffer.py",
           "if inside and previous.inside[y, x] == 0:", "if inside and previous.inside[y, x] > 1:",
           (ORACLE, "tests/test_exits.py", "tests/test_render_frame.py")),
    Mutant("dispersion by the last face of a block", "transport/layers.py",
           "                return True\n    return False", "                return lane == 0\n    return False"),
    Mutant("the depth of glass is that of what is behind", "transport/layers.py",
           "            planes.z_depth[y, x] = query.z_self[lane]", "            planes.z_depth[y, x] += 0.0"),
)  # fmt: skip


def mutated(folder: Path, mutant: Mutant) -> None:
    """A copy of the project with the mutant in it. Raises LookupError where its place is not there exactly once."""
    copied(folder)
    check(mutant, folder)
    path = folder / "refract_core" / mutant.file
    path.write_text(path.read_text("utf-8").replace(mutant.before, mutant.after), "utf-8")


def copied(folder: Path) -> None:
    """A copy of the project as it is."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            shutil.copy(source, folder / name)


def check(mutant: Mutant, root: Path = ROOT) -> None:
    """Raises LookupError where the mutant's place is not there exactly once."""
    count = (root / "refract_core" / mutant.file).read_text("utf-8").count(mutant.before)
    if count != 1:
        where = f"refract_core/{mutant.file}"
        raise LookupError(f"mutant '{mutant.name}': its text stands {count} times in {where}; mend the mutant")


def killer(mutant: Mutant) -> tuple[str, float]:
    """The test that notices ('' for none), and seconds."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="refract-mutant-") as name:
        folder = Path(name)
        mutated(folder, mutant)
        failed = first_failure(folder, mutant.tests)
    return failed, time.perf_counter() - start


def first_failure(folder: Path, tests: Iterable[str]) -> str:
    """The first test that fails in a copy; '' for none. Raises RuntimeError where the tests cannot run."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout[-2000:]}")
    found = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return found[0].split(" - ")[0].split("::")[-1] if found else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--only", default="", help="names, or parts of them, separated by commas")
    parser.add_argument("--list", action="store_true", help="name them and check that their places are there")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time")
    options = parser.parse_args()
    chosen = [m for m in MUTANTS if not options.only or any(part in m.name for part in options.only.split(","))]
    for mutant in chosen:
        check(mutant)
        if options.list:
            print(f"{mutant.file:24s} {mutant.name}")
    if options.list:
        return 0
    with tempfile.TemporaryDirectory(prefix="refract-mutant-") as name:
        copied(Path(name))
        if failed := first_failure(Path(name), dict.fromkeys(test for mutant in chosen for test in mutant.tests)):
            print(f"{failed} fails without any mutant; mend that first")
            return 1
    alive = 0
    with ThreadPoolExecutor(options.jobs) as threads:
        for mutant, (test, seconds) in zip(chosen, threads.map(killer, chosen), strict=True):
            alive += not test
            print(f"{'killed' if test else 'ALIVE ':6s} {seconds:5.0f} s  {mutant.name:52s} {test}", flush=True)
    print(f"{len(chosen)} mutants, {len(chosen) - alive} killed, {alive} alive")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
