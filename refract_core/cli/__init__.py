"""The `refract` command: words to calls, no logic. One module per command (a group of commands is one).

A module loads its verb when its command runs, so that `refract --help` waits for neither USD nor the kernels.
"""

from __future__ import annotations

import os
import sys

from . import (  # noqa: F401  a command is known once its module is loaded
    bake,
    compare,
    convert,
    doctor,
    inspect,
    join,
    node,
    render,
    samples,
    schema,
    serve,
    turntable,
    validate,
    warm,
)
from .app import CANCELLED, app

__all__ = ["app", "main"]


def main() -> None:
    """Entry point of the `refract` command."""
    try:
        app(prog_name="refract")
    except SystemExit as end:
        if end.code == CANCELLED:  # a thread that still compiles a kernel would hold the process up for a minute
            sys.stderr.flush()
            os._exit(CANCELLED)
        raise
