"""What hatchling does beyond copying files: it compiles the kernels into the wheel, so that no user has to wait for it,
and writes a description that can be read without the repository.

Where that cannot be done (another platform, no C compiler, no numba in the build) the wheel has no kernels in it, and
numba compiles them when they are first called. An editable install is such a case: its sources are going to change.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(?P<picture>!?)\[(?P<words>[^\]]*)\]\((?!https?://|#)[^)]*\)")
"""A link of Markdown to a file beside it."""
_IN_WHEEL = "refract_core/kernels/built"


class CustomBuildHook(BuildHookInterface[Any]):
    """Puts `kernels.so` and its manifest into a wheel, and says in the wheel's name which machines it is for."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before the wheel is packed. `version`: "standard" or "editable"."""
        if version == "editable":
            return
        if importlib.util.find_spec("numba") is None:
            self.app.display_info("kernels are not compiled ahead of time: there is no numba in this build")
            return
        self.app.display_info("compiling kernels, a minute or two")
        self._place = tempfile.TemporaryDirectory()
        ended = _build(Path(self.root), Path(self._place.name))
        self.app.display_info(ended.stdout.strip() or ended.stderr.strip())
        if ended.returncode == CANNOT:
            return
        if ended.returncode:
            raise RuntimeError(f"compiling the kernels failed:\n{ended.stderr}")
        for file in sorted(Path(self._place.name).iterdir()):
            build_data["force_include"][str(file)] = f"{_IN_WHEEL}/{file.name}"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform_tag(Path(self._place.name, 'kernels.so').read_bytes())}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Called when the wheel is there."""
        if hasattr(self, "_place"):
            self._place.cleanup()


CANNOT = 3
"""Exit code of the builder where this machine has not got what it needs."""


def _build(root: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Compile in a process of its own, which finds what the build has installed, and the package as it is here."""
    path = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "refract_core.kernels.build", str(folder)]
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


def platform_tag(library: bytes) -> str:
    """The oldest platform that has every versioned symbol of a shared object which needs libc and libm alone."""
    versions = [(int(a), int(b)) for a, b in re.findall(rb"GLIBC_(\d+)\.(\d+)", library)]
    if not versions:
        return "linux_x86_64"
    return "manylinux_{}_{}_x86_64".format(*max(versions))


class CustomMetadataHook(MetadataHookInterface):
    """Makes the README the description that a package index shows, far from the files that it links to."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Called for every wheel and every archive of sources."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": alone(text)}


def alone(markdown: str) -> str:
    """The same without links to files beside it, of which the words stay, and without its pictures. The project has no
    address that they could be made absolute by."""
    return _LINK.sub(lambda found: "" if found["picture"] else found["words"], markdown)
