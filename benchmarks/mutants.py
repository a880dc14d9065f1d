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
CORNERS = ("tests/test_corners.py",)
CAUSTICS = ("tests/test_caustics.py", "tests/test_shading.py", ORACLE)
BODIES = ("tests/test_usd_light_bodies.py",)
EDGES = ("tests/test_usd_edges.py",)
GLOWS = ("tests/test_emission.py",)
MANY = ("tests/test_instances.py", "tests/test_points.py")
TREE = "tests/test_tree.py"
SCREEN = (TREE, LAWS, "tests/test_screen.py", "tests/test_shading.py", "tests/test_nothing_invented.py")
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
    tests: tuple[str, ...] = (ORACLE, TREE, LAWS)


MUTANTS = (
    # --- light through glass: what a ray meets
    Mutant("no tie-break where glass touches a table", "world/offsets.py",
           "return 4.0 * _reach(point)", "return 0.0 * _reach(point)"),
    Mutant("no tie-break behind a model's exit", "transport/tree.py",
           "now.entered[lane] == 0 or dot(", "now.entered[lane] >= 0 or dot("),
    Mutant("max-layers hides glass in glass", "transport/tree.py",
           "blind = now.media.depth[lane] == 0 and (", "blind = ("),
    Mutant("glass counts twice for max-layers", "transport/crossing.py",
           "to.entered[i] = now.entered[lane] + 1", "to.entered[i] = now.entered[lane] + 2"),
    Mutant("what is passed is met again", "transport/crossing.py", "to.start[i] = past(t)", "to.start[i] = past(0.0)"),
    Mutant("the near plane cuts into nothing", "transport/crossing.py",
           "now.met[lane] == 0 and now.side[lane] == VIEW and room",
           "now.met[lane] < 0 and now.side[lane] == VIEW and room"),
    Mutant("a model reaches beyond its thickness", "transport/crossing.py",
           "to.end[i] = length\n", "to.end[i] = 2.0 * length\n"),
    Mutant("a wall crossed on an inner stretch is not left", "transport/crossing.py",
           "(now.inner[lane] == 0 or now.thing[lane] != thing)", "now.inner[lane] == 0"),
    Mutant("a ray comes out of a model into the wrong body", "transport/crossing.py",
           "drop_medium(to.media, i, slot_of(now.media, lane, now.thing[lane]))", "drop_medium(to.media, i, 0)"),
    Mutant("the eye enters the smallest body first", "transport/eye.py",
           "key=lambda body: -body[0]", "key=lambda body: body[0]"),
    Mutant("the eye is in no body", "transport/eye.py",
           "encloses(mesh.points, mesh.triangles, eye)", "encloses(mesh.points, mesh.triangles, -eye)"),
    Mutant("the eye is in what a body's first face is of", "transport/eye.py",
           "mesh.materials[of_glass.argmax()]", "mesh.materials[0]"),
    # --- media
    Mutant("of equal priority the body entered first fills", "transport/rays.py",
           "media.priority[i, k] >= media.priority[i, best]", "media.priority[i, k] > media.priority[i, best]"),
    Mutant("behind a body that is left it still fills", "transport/rays.py",
           "if k != slot and (best", "if k != slot + MOST_MEDIA and (best"),
    Mutant("a body of equal priority is not seen in another", "transport/crossing.py",
           "media.priority[lane, k] > meeting.priority[lane]", "media.priority[lane, k] >= meeting.priority[lane]"),
    Mutant("a model does not fill its stretch", "transport/crossing.py",
           "priority = max(priority, to.media", "priority = min(priority, to.media"),
    Mutant("a ray leaves the body it entered last", "transport/crossing.py",
           "drop_medium(to.media, i, meeting.slot[lane])", "to.media.depth[i] -= 1"),
    Mutant("a medium absorbs again what it has absorbed", "transport/rays.py",
           "length = max(0.0, until - rays.begun[i])", "length = until"),
    # --- interfaces
    Mutant("no normal map on glass", "transport/crossing.py",
           "n = flip_towards(normal_input(world, at), ng)", "n = flip_towards(at.ns, ng)"),
    Mutant("a steep normal bends light back into the glass", "transport/crossing.py",
           "if dot(out, ng) >= 0.0:  # a steep", "if dot(out, ng) >= 2.0:  # a steep"),
    Mutant("a steep normal mirrors into the surface", "transport/crossing.py",
           "if dot(r, ng) <= 0.0:", "if dot(r, ng) <= -2.0:"),
    Mutant("reflection without Fresnel", "transport/crossing.py",
           "meeting.mirrored_weight[lane, c] = w * share", "meeting.mirrored_weight[lane, c] = w * 0.04"),
    Mutant("opacity does not dim what comes through", "transport/crossing.py",
           "kept = (1.0 - share) * (1.0 - meeting.opacity[lane])", "kept = 1.0 - share"),
    Mutant("opacity dims what leaves", "transport/crossing.py",
           "        meeting.opacity[lane] = 0.0\n", "        meeting.opacity[lane] *= 1.0\n"),
    Mutant("a model in a medium keeps its ior in air", "transport/crossing.py",
           "max(1.0, n2 / n1)", "max(1.0, n2)"),
    Mutant("a pane absorbs without its cosine", "transport/crossing.py",
           "meeting.distance[lane], length)\n", "meeting.distance[lane], meeting.thickness[lane])\n"),
    Mutant("a dispersive medium around the eye does not disperse", "transport/crossing.py",
           "(abbe_before > 0.0 or abbe_behind > 0.0)", "abbe_behind > 0.0"),
    Mutant("dispersion: red and blue change places", "transport/rays.py",
           "return red if channel == 0 else (blue if channel == 2 else green)",
           "return blue if channel == 0 else (red if channel == 2 else green)"),
    Mutant("a colour's ray keeps the others' clear weight", "transport/crossing.py",
           "to.weight[i, other] = to.clear[i, other] = 0.0", "to.weight[i, other] = 0.0"),
    Mutant("the cut loses what it drops", "transport/crossing.py",
           "meeting.weight[lane, c] += meeting.mirrored_weight[lane, c]", "meeting.weight[lane, c] += 0.0"),
    Mutant("the cut loses what is hardly let through", "transport/crossing.py",
           "meeting.mirrored_weight[lane, c] += meeting.weight[lane, c]", "meeting.mirrored_weight[lane, c] += 0.0"),
    Mutant("the cut takes what is let through for what is lost", "transport/crossing.py",
           "(r < cut or late)", "(t < cut or late)"),
    Mutant("a second rough surface forgets the first", "transport/crossing.py",
           "to.blur[i] = math.hypot(now.blur[lane], _tan_of_lobe(wide))", "to.blur[i] = _tan_of_lobe(wide)"),
    Mutant("rough glass mirrors sharply", "transport/crossing.py",
           "math.hypot(now.blur[lane], _tan_of_lobe(meeting.roughness[lane]))", "now.blur[lane]"),
    # --- leaves and their sums
    Mutant("alpha ignores what no tier answered", "transport/tree.py",
           "cell.missing[i] += mean * unanswered", "cell.missing[i] += 0.0"),
    Mutant("alpha misses a background behind the camera", "transport/tree.py",
           "if dot(row(leaves.direction, k), row(view.axes, 2)) > 0.0:",
           "if dot(row(leaves.direction, k), row(view.axes, 2)) > -2.0:"),
    Mutant("what is in the glass is asked like the rest", "transport/tree.py",
           "query.embedded[lane] = 1 if inside or direct else 0", "query.embedded[lane] = 1 if direct else 0"),
    Mutant("a lost ray is sure", "transport/tree.py", "if not is_lost(leaves, k):", "if leaves.met[k] >= 0:"),
    Mutant("tiers share absorbed light", "transport/tree.py",
           "cell.tiers[i, tier] += share *", "cell.tiers[i, tier] += mean *"),
    Mutant("the path is that of the brightest coloured leaf", "transport/tree.py",
           "dot(row(leaves.clear, k), TEXEL_LUMINANCE)", "dot(row(leaves.weight, k), TEXEL_LUMINANCE)"),
    Mutant("only the first surface of glass shines", "transport/tree.py",
           "if meeting.kind[lane] != LEFT and (meeting", "if first and meeting.kind[lane] != LEFT and (meeting"),
    Mutant("the colour of the first surface is reflection", "transport/tree.py",
           "_glow(scratch, i, body, side,", "_glow(scratch, i, body, MIRRORED_SIDE if side == VIEW else side,"),
    Mutant("the depth of glass is a distance", "transport/tree.py",
           "            cell.z_depth[i] = hit.t * dot(direction, row(view.axes, 2))",
           "            cell.z_depth[i] = hit.t"),
    # --- the picture as a tier
    Mutant("the picture lights what lies in no plane of its own", "view/screen.py",
           "> _COPLANAR * z:", "> 1e9 * z:", SCREEN),
    Mutant("the picture lights what faces elsewhere", "view/screen.py", "facing) < _ALIKE:", "facing) < -2.0:", SCREEN),
    Mutant("a quarter of a pixel's weight is enough", "view/screen.py",
           "    if total < 0.5 or", "    if total <= 0.0 or", SCREEN),
    Mutant("half known light is half the light", "view/screen.py",
           "scale(irradiance, 1.0 / total)", "scale(irradiance, 1.0)", SCREEN),
    Mutant("the picture lights mirrors", "transport/tiers.py",
           "world.materials.gleams[hit.material] != 0", "world.materials.gleams[hit.material] > 1", SCREEN),
    Mutant("the picture's highlights get lost", "transport/tiers.py",
           "    gleam = seen.gloss\n", "    gleam = lit\n", SCREEN),
    # --- the surface
    Mutant("clear coat doubled", "world/shading.py", "fc = coat * (", "fc = 2.0 * coat * ("),
    Mutant("occlusion ignored", "world/shading.py",
           "scale(row(block.sky_seen, lane), block.occlusion[lane])", "scale(row(block.sky_seen, lane), 1.0)"),
    Mutant("specular workflow ignored", "world/shading.py",
           "if world.materials.specular_workflow[at.hit.material]:",
           "if world.materials.specular_workflow[at.hit.material] > 1:"),
    Mutant("a mirror shows things without their gloss", "world/shading.py",
           "_add_gloss_of_sky(second, lane, world, row(second.f0, lane), second.roughness[lane], 1.0)",
           "_add_gloss_of_sky(second, lane, world, row(second.f0, lane), second.roughness[lane], 0.0)"),
    Mutant("metal keeps its diffuse", "world/shading.py", "scale(base, 1.0 - metallic)", "scale(base, 1.0)"),
    Mutant("a normal map in mirrored uv is turned over", "world/surface.py",
           "1.0 if hand > 0.0 else -1.0", "1.0"),
    Mutant("texture bias forgotten for scalars", "world/surface.py",
           "x = c[0] * materials.scale[m, i, channel] + materials.bias[m, i, channel]",
           "x = c[0] * materials.scale[m, i, channel]"),
    Mutant("mirrored wrap is one texel off", "world/textures.py",
           "return i if i < size else 2 * size - 1 - i", "return i if i < size else 2 * size - 2 - i",
           (ORACLE, "tests/test_textures.py")),
    Mutant("cut-out threshold counts as hole", "world/tracing.py",
           "0.0 if opacity < threshold", "0.0 if opacity <= threshold", (ORACLE, "tests/test_shading.py")),
    Mutant("shadows reach beyond the light", "world/offsets.py",
           "return t * (1.0 - 10.0 * RELATIVE)", "return t * 2.0", (ORACLE, "tests/test_shading.py")),
    # --- lights and sky
    Mutant("a cone fades in a straight line", "world/shaping.py",
           "return 1.0 - x * x * (3.0 - 2.0 * x)", "return 1.0 - x", (ORACLE, "tests/test_lights.py")),
    Mutant("a measured profile is turned", "world/shaping.py",
           "math.atan2(dot(d, lamp.y), dot(d, lamp.x))", "math.atan2(dot(d, lamp.x), dot(d, lamp.y))",
           (ORACLE, "tests/test_lights.py")),
    Mutant("the picture on a light is mirrored", "world/shaping.py", "1.0 - u, 1.0 - v)", "u, 1.0 - v)",
           (ORACLE, "tests/test_lights.py")),
    Mutant("a cylinder is seen too far around", "world/lights.py",
           "phi = widest * (2.0 * i", "phi = 1.1 * widest * (2.0 * i", (ORACLE, "tests/test_lights.py")),
    Mutant("lights light everything", "world/shading.py",
           "return link < 0 or lights.linked[link, block.thing[lane]] != 0", "return link < 0 or lights.kind[l] >= 0",
           (ORACLE, "tests/test_lights.py")),
    Mutant("shadows fade in a straight line", "world/shading.py",
           "lights.reach[l, 1] * u ** lights.reach[l, 2]", "lights.reach[l, 1] * u", (ORACLE, "tests/test_lights.py")),
    Mutant("a light's diffuse multiplier forgotten", "world/shading.py", " * lights.diffuse[l]", "",
           (ORACLE, "tests/test_lights.py")),
    Mutant("a rect light shines backwards", "world/lights.py",
           "if dot(to, lamp.face) >= 0.0:  # behind it", "if dot(to, lamp.face) >= 1e30:",
           (ORACLE, "tests/test_lights.py")),
    Mutant("the dome turns the other way", "world/environment.py",
           "return 0.5 - math.atan2(x, z) / (2.0 * math.pi)", "return 0.5 + math.atan2(x, z) / (2.0 * math.pi)",
           (ORACLE, "tests/test_environment.py")),
    Mutant("a light's horizon is not clipped", "world/polygon.py",
           "        total += polygon_edge(leaving, entering, n)", "        total += 0.0",
           (ORACLE, "tests/test_lights.py", *GLOWS)),
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
    # --- pixels from corners, and quiet light
    Mutant("corners stand in the middles of pixels", "view/camera.py",
           "dx, dy = 0.5 * (right", "dx, dy = 0.0 * (right", CORNERS),
    Mutant("what one corner alone sees counts for two", "transport/corners.py",
           "row(own.light, answers.side[r]), scale(light, 0.25)", "row(own.light, answers.side[r]), scale(light, 0.5)",
           CORNERS),
    Mutant("a texture goes on askew beyond its triangle", "transport/corners.py",
           "px, py = dot(off, x), dot(off, y)", "px, py = dot(off, y), dot(off, x)", CORNERS),
    Mutant("few samples of an edge count like many", "transport/edges.py",
           "place, refining.samples / (end - first)", "place, 1.0", CORNERS),
    Mutant("an edge of alpha alone is none", "transport/corners.py",
           "return max(most, all_missing - least)", "return most", CORNERS),
    Mutant("a leaf too many is forgotten", "transport/answers.py",
           "min(k + 1, MOST_ANSWERS + 1)", "min(k + 1, MOST_ANSWERS)", CORNERS),
    Mutant("what a probe has said is taken for the surface's", "transport/answers.py",
           "query.color[lane, c] - share * known", "query.color[lane, c] - known", CORNERS),
    Mutant("nobody doubts a lamp", "view/quiet.py",
           "scratch.found[i, c]) > _STEP_OF_LAMP:", "scratch.found[i, c]) > 2.0:", CORNERS),
    Mutant("any cell of the sky is filled", "view/quiet.py",
           "high[2] - low[2]) > care.step:", "high[2] - low[2]) > 2.0:", CORNERS),
    Mutant("neighbours share a half shadow from one side", "view/quiet.py",
           "k - down * _SPAN - right", "k + down * _SPAN + right", CORNERS),
    Mutant("narrow half shadows are shared, too", "view/quiet.py", "_STEEP = 0.05, 0.25", "_STEEP = 9.0, 9.0", CORNERS),
    Mutant("nobody shares a half shadow", "view/quiet.py", "_GRAIN = 0.2, 0.5", "_GRAIN = 0.0, 0.0", CORNERS),
    Mutant("nobody looks for the last of a light", "view/quiet.py",
           "scratch.torn[k] = 1\n", "scratch.torn[k] = 0\n", CORNERS),
    Mutant("the rim of a light is its middle", "world/lights.py", "_INSET = 0.03", "_INSET = 0.45", CORNERS),
    Mutant("every light is faint", "view/quiet.py", "_FAINT = 1.0 / 32.0", "_FAINT = 2.0", CORNERS),
    Mutant("nobody looks at the middle of a light", "world/lights.py",
           "u1, u2 = (0.5, 0.25 + 0.5 * up) if right", "u1, u2 = (0.0, 0.25 + 0.5 * up) if right", CORNERS),
    Mutant("half shadows look at places that are not there", "view/quiet.py",
           "if scratch.part[j] == scratch.part[k] and _largest(sub", "if _largest(sub", ("tests/test_crop.py",)),
    Mutant("a hidden sun takes all colours along", "world/shading.py",
           "return direction, scale(tint, cosine", "return direction, scale((1.0, 1.0, 1.0), cosine", CORNERS),
    Mutant("one ray to the sky minds no cosine", "world/shading.py",
           "SKY_PICK.value)[0] < dot(direction, n)", "SKY_PICK.value)[0] < 2.0 * dot(direction, n)", CORNERS),
    Mutant("lamps in glass by Schlick", "transport/tree.py",
           "put(scratch.block.fresnel, lane, row(meeting.reflectance, lane))", "pass"),
    Mutant("light mirrored within glass sees no lamps", "transport/crossing.py",
           "to.lamps[i] = 1 if meeting.kind[lane] == LEFT else 0", "to.lamps[i] = 0"),
    Mutant("a lamp's mirror picture twice", "transport/crossing.py",
           "to.lamps[i] = 1 if meeting.kind[lane] == LEFT else 0", "to.lamps[i] = 1"),
    Mutant("corners that agree by chance are believed", "transport/corners.py",
           "> _FAR_APART * answers.wide[found[0]]", "> 1e9 * answers.wide[found[0]]", CORNERS),
    Mutant("nobody looks in the middle", "transport/corners.py",
           "!= THIN:", "!= 7:", CORNERS),
    Mutant("a wire is not followed", "transport/between.py",
           "while looked < found:", "while looked < 0:", CORNERS),
    Mutant("any side of a surface is the same", "transport/between.py",
           "_SAME_SIDE = 0.5", "_SAME_SIDE = -1.0", CORNERS),
    Mutant("nobody looks behind glass", "transport/behind.py",
           "_THIN if seen & ~known != 0 else", "_THIN if seen & 0 != 0 else", CORNERS),
    Mutant("edges of brushed metal have one lobe", "transport/tree.py",
           "query.rays[lane] if alone else max(", "1 if alone else max(", CORNERS),
    Mutant("an edge is as sure as any pixel", "transport/edges.py",
           "1.0 - min(1.0, expected_error(own.contrast[k], taken))", "1.0", CORNERS),
    # --- light through glass, on its way to what it lights
    Mutant("photons fall on the wrong side", "rendering/caustics.py",
           "((1.0, np.arange(len(parts))), (-1.0,", "((-1.0, np.arange(len(parts))), (-1.0,", CAUSTICS),
    Mutant("no light comes from within a body", "rendering/caustics.py",
           "np.isin(world.geometry.surface[parts] + instances, within)", "np.zeros(len(parts), bool)", CAUSTICS),
    Mutant("a photon counts its texel's height", "world/caustics.py",
           "scale = abs(n[axis]) / (texel * texel)", "scale = 1.0 / (texel * texel)", CAUSTICS),
    Mutant("no layer but one's own", "world/caustics.py", "for k in range(-1, 2):", "for k in range(1):", CAUSTICS),
    Mutant("texels keep all of each photon", "world/caustics.py",
           "share = (s if i else 1.0 - s) * (t if j else 1.0 - t)", "share = 0.5", CAUSTICS),
    Mutant("a seam where the axis changes", "world/caustics.py",
           "share = max(0.0, n[axis] * n[axis] - _AXIS_SHARE * _AXIS_SHARE)",
           "share = 1.0 if axis == _main_axis(n) else 0.0", CAUSTICS),
    Mutant("flat lights are even however near", "world/lights.py",
           "if not is_flat(lights, which):", "if True:", CAUSTICS),
    Mutant("photons fall through what stands before a light", "transport/photons.py",
           "flux = mul(row(own.brought, lane), row(own.arrives, lane))", "flux = row(own.brought, lane)", CAUSTICS),
    Mutant("glass that throws caustics lets light through, too", "world/tracing.py",
           "if world.glass.casts[hit.part] != 0:", "if world.glass.casts[hit.part] > 1:", CAUSTICS),
    Mutant("a body absorbs from the receiver on", "world/tracing.py",
           "length = hit.t - packet.begun[lane]", "length = hit.t", CAUSTICS),
    Mutant("walls on the way are clear", "world/tracing.py",
           "share = 1.0 - fresnel_dielectric(cosine, 1.0 / ior)", "share = 1.0", CAUSTICS),
    Mutant("a hole hides the glass before it", "world/tracing.py",
           "if packet.valid[lane] != 0:  # from where it began", "if False:  # from where it began", CAUSTICS),
    Mutant("all photons toss the same coin", "transport/photons.py",
           "scratch.cell.sample[slot] = first + lane, 0, 0", "scratch.cell.sample[slot] = 0, 0, 0", CAUSTICS),
    Mutant("every sample tosses the same coin", "world/tracing.py",
           "packet.sample[lane] * _GOLDEN)", "0.0)", CAUSTICS),
    Mutant("a single shadow ray goes to any point of a lamp", "world/lights.py",
           "chance = one[2] / total", "chance = 1.0 / (k + 1)", ("tests/test_lights.py",)),
    Mutant("a ball hides light through its middle", "world/lights.py",
           "return (radius * sine, math.sqrt(1.0 - sine * sine)) if sine < 1.0 else (0.0, 1.0)", "return (0.0, 1.0)",
           ("tests/test_lights.py", ORACLE)),
    Mutant("even light is looked at as closely as any", "world/caustics.py",
           "enough *= _EVEN", "enough *= 1.0", CAUSTICS),
    Mutant("layers do not add up", "world/tracing.py",
           "packet.through[lane] *= 1.0 - cover", "packet.through[lane] = 1.0 - cover", ("tests/test_shading.py",)),
    Mutant("a layer leaves what it covers of the light", "world/tracing.py",
           "scale(row(seen, lane), 1.0 - cover)", "scale(row(seen, lane), cover)", ("tests/test_shading.py",)),
    # --- what glows
    Mutant("every node is far enough to be a point", "world/glow.py", "_FAR = 8.0", "_FAR = 1.0", GLOWS),
    Mutant("every node is flat", "world/glow.py", "FLAT = 0.985", "FLAT = 0.0", GLOWS),
    Mutant("what glows has no depth from afar", "world/glow_views.py",
           "first = dot(seen.place, n) +", "first = 0.0 * dot(seen.place, n) +", GLOWS),
    Mutant("a table is looked at from the other side", "world/glow.py",
           "w = scale(to, -1.0 / d)", "w = scale(to, 1.0 / d)", GLOWS),
    Mutant("what glows shines backwards, too", "world/glow.py",
           "if toward > 0.0:\n                axes", "if True:\n                axes", GLOWS),
    Mutant("points on what glows count alike", "world/lights.py",
           "return direction, distance, worth * max(0.0, dot(direction, n))", "return direction, distance, 1.0", GLOWS),
    # --- many places
    Mutant("all places of a mesh are one thing", "world/surface.py",
           "return geometry.thing[hit.part] + hit.instance", "return geometry.thing[hit.part]", MANY),
    Mutant("all places of a mesh are one surface", "world/surface.py",
           "return geometry.surface[hit.part] + hit.instance", "return geometry.surface[hit.part]", MANY),
    Mutant("a place that mirrors turns inside out", "world/surface.py",
           "ng = scale(ng, sense_of(geometry, part, hit.instance))", "ng = scale(ng, 1.0)", MANY),
    Mutant("normals of places go as points do", "world/surface.py",
           "return (dot(cross(y, z), n), dot(cross(z, x), n), dot(cross(x, y), n))",
           "return (dot(x, n), dot(y, n), dot(z, n))", MANY),
    Mutant("all places have the first one's primvars", "world/tables.py",
           "return first, 0, size, size", "return first, 0, 0, size", MANY),
    Mutant("collections take instances all together", "world/instances.py",
           "if len(numbers) <= 1:", "if len(numbers) <= 9:", MANY),
    Mutant("droplets have the normals that their distance gives", "world/surface.py",
           "ng = _exact_normal(centre, radius, ray, hit.t)", "ng = normalize(ng)", MANY),
    # --- lights that the camera sees
    Mutant("a light and its body both shine", "world/lamps.py", "and not light.seen]", "]", BODIES),
    Mutant("plates glow at their backs", "usd/lights/bodies.py",
           "np.arange(len(triangles)) >= len(triangles) - (len(x) - 2)",
           "np.arange(len(triangles)) >= len(triangles) - 2 * (len(x) - 2)", BODIES),
    Mutant("one hidden dome hides them all", "usd/lights/domes.py", "hidden=all(", "hidden=any(", BODIES),
    # --- edges of glass
    Mutant("edges are right angles", "usd/geometry/edges.py", "_EDGE = 0.5 - 1e-3", "_EDGE = -1e-3", EDGES),
    Mutant("what is round is an edge", "usd/geometry/edges.py", "_EDGE = 0.5 - 1e-3", "_EDGE = 0.75", EDGES),
    Mutant("seams are edges", "usd/geometry/edges.py",
           "place = weld(shape.points)[shape.triangles]", "place = shape.triangles", EDGES),
    Mutant("only what leans much hides an edge", "usd/geometry/edges.py",
           "hidden = np.logical_or.reduceat(apart & alike, begins)",
           "hidden = np.logical_or.reduceat(apart & alike, begins) & ((faces * given).sum(axis=1) < _SUSPECT)", EDGES),
    Mutant("faces count alike, whatever their angle", "usd/geometry/edges.py",
           "np.where(apart, 0.0, angles[other])", "np.where(apart, 0.0, 1.0)", EDGES),
    # --- what glows, again
    Mutant("a sheet that glows has one side", "world/emitters.py", "if geometry.sheet[part] != 0:", "if False:", GLOWS),
    Mutant("nobody is within what glows", "world/emitters.py",
           "elif encloses(mesh.points, mesh.triangles, eye):", "elif False:", GLOWS),
    Mutant("a cut-out glows whole", "world/emitters.py", "0.25 * _there(world, at))", "0.25)", GLOWS),
    Mutant("a picture glows from its first triangle's middle", "world/emitters.py",
           "np.where(driven != 0, cuts, 0)", "np.zeros_like(cuts)", GLOWS),
    Mutant("things that share a light lose their weakest", "world/emitters.py",
           "_FAINT = 1e-4", "_FAINT = 0.02", GLOWS),
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
