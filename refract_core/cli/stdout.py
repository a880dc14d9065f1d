"""A picture on stdout, for a pipe: `refract render stage.usda - | ...`."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from ..errors import ImageError, UsageError
from ..progress import Report

STDOUT = "-"


@contextmanager
def written_to(out: str, form: str, frames: str, aovs: tuple[str, ...], report: Report) -> Iterator[tuple[str, Report]]:
    """The file to write where OUT is `-`, which goes to stdout when the block ends well; else OUT itself.

    Args:
        form: extension of the picture, with or without its dot; '' is png.

    Yields:
        The path to write to, and where to tell about it.

    Raises:
        UsageError: `form` without `-`, an unknown one, more than one picture, or a terminal, which shows no pictures.
        ImageError: nobody reads what is written.
    """
    if out != STDOUT:
        if form:
            raise UsageError(f"--format {form}: is for OUT -, a picture on stdout; the name of a file says its own")
        yield out, report
        return
    extension = f".{(form or 'png').lower().lstrip('.')}"
    _check(extension, frames, aovs)
    with tempfile.TemporaryDirectory(prefix="refract-") as folder:
        path = os.path.join(folder, f"stdout{extension}")
        yield path, report._replace(done=lambda file, text: report.done(STDOUT if file == path else file, text))
        if os.path.exists(path):
            _pour(path)


def _check(extension: str, frames: str, aovs: tuple[str, ...]) -> None:
    """Refuse, before any work, what cannot go down a pipe as one picture. Raises UsageError."""
    from ..images.pictures import check_output
    from ..usd.time_codes import parse_frames

    check_output(f"-{extension}", aovs, "disabled")
    if frames.strip() and len(parse_frames(frames)) > 1:
        raise UsageError(f"-: is one picture, and --frames {frames} are several; name one, or write to files")
    if sys.stdout.isatty():
        raise UsageError("-: is a terminal, which shows no pictures; send it to a program or a file, as in - > out.png")


def _pour(path: str) -> None:
    stream: BinaryIO = sys.stdout.buffer
    try:
        stream.write(Path(path).read_bytes())
        stream.flush()
    except BrokenPipeError as error:
        # What is left in the buffer cannot be written either, when the process ends and tries once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise ImageError("-: nobody reads the picture; the program after the pipe has ended") from error
    except OSError as error:
        raise ImageError(f"-: the picture cannot be written: {error.strerror}; choose another place") from error
