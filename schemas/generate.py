"""Make generatedSchema.usda and plugInfo.json from schema.usda: `python -m schemas.generate`. Needs jinja2."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from . import FOLDER

GENERATED = ("generatedSchema.usda", "plugInfo.json")

# Everything lies in the folder that holds plugInfo.json, and there is no library.
_PLACEHOLDERS = {"@PLUG_INFO_ROOT@": ".", "@PLUG_INFO_LIBRARY_PATH@": "", "@PLUG_INFO_RESOURCE_PATH@": "."}


def generate(folder: Path) -> None:
    """Write the generated files into `folder`.

    Raises:
        RuntimeError: usdGenSchema failed; the message is its own.
    """
    with tempfile.TemporaryDirectory() as scratch:
        raw = Path(scratch)
        _run_generator(FOLDER / "schema.usda", raw)
        (folder / "plugInfo.json").write_text(_plug_info((raw / "plugInfo.json").read_text("utf-8")), "utf-8")
        _write_registry(raw / "generatedSchema.usda", folder / "generatedSchema.usda")


def _run_generator(source: Path, folder: Path) -> None:
    # The generator sets this variable itself, but as a module it does so too late: USD has been loaded by then.
    environment = os.environ | {"USD_DISABLE_PRIM_DEFINITIONS_FOR_USDGENSCHEMA": "1"}
    environment.pop("PXR_PLUGINPATH_NAME", None)  # else the schemas would meet an older copy of themselves
    command = [sys.executable, "-m", "pxr.Usd.usdGenSchema", str(source), str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode or not all((folder / name).exists() for name in GENERATED):
        raise RuntimeError(f"usdGenSchema could not read {source} (it needs jinja2): {done.stderr.strip()}")


def _plug_info(text: str) -> str:
    """plugInfo.json with its placeholders resolved and without its leading comment, which is not JSON."""
    for placeholder, value in _PLACEHOLDERS.items():
        text = text.replace(placeholder, value)
    return json.dumps(json.loads(text[text.index("{") :]), indent=4, sort_keys=True) + "\n"


def _write_registry(raw: Path, target: Path) -> None:
    """Copy the generated registry, with the whole documentation: usdGenSchema keeps only the first sentence."""
    from pxr import Sdf

    source = Sdf.Layer.OpenAsAnonymous(str(FOLDER / "schema.usda"))
    registry = Sdf.Layer.OpenAsAnonymous(str(raw))
    registry.comment = "Made from schema.usda by `python -m schemas.generate`. Do not edit."
    for prim in registry.rootPrims:
        _document(prim, source.GetObjectAtPath(prim.path))
        for spec in prim.properties:
            _document(spec, source.GetObjectAtPath(spec.path))
    target.write_text(registry.ExportToString(), "utf-8")


def _document(spec: Any, source: Any) -> None:
    if source is None:  # a property inherited from USD's own schemas
        return
    paragraphs = re.split(r"\n\s*\n", source.documentation.strip())
    spec.documentation = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    # USD answers with the first sentence where there is one, and only then with the whole.
    del spec.customData["userDocBrief"]


if __name__ == "__main__":
    generate(FOLDER)
