"""`refract serve` whose workers are `escape_worker.py`: the arguments are those of `refract`, and
`--without-namespaces` before them for a machine that has none."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from refract_core.cli import main  # noqa: E402
from refract_core.service import pool  # noqa: E402

MACHINE = [word for word in sys.argv[1:] if word == "--without-namespaces"]


class Popen(subprocess.Popen[bytes]):
    def __init__(self, command: list[str], **options: Any) -> None:
        assert command[1:3] == ["-m", "refract_core.service.worker"]
        program = str(Path(__file__).with_name("escape_worker.py"))
        super().__init__([command[0], program, *command[3:], *MACHINE], **options)


if __name__ == "__main__":
    pool.subprocess.Popen = Popen
    sys.argv = [word for word in sys.argv if word not in MACHINE]
    main()
