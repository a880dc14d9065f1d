"""What every command of `refract` shares: the app, common options, and how a command ends."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Annotated, Any

import typer

from ..errors import RefractError, UsageError
from ..progress import Report, reporting
from ..settings import Opening, RenderSettings
from ..version import __version__
from .shell import Commands

CANCELLED = 3

_HUMP = re.compile(r"(?<=[a-z0-9])[A-Z]")


def _in_kebab(name: str) -> str:
    """Options are known in the spelling of usdrecord, too: `--sessionLayer` is `--session-layer`."""
    return _HUMP.sub(lambda found: f"-{found[0].lower()}", name)


app = Commands(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"token_normalize_func": _in_kebab, "help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # the boxes cut long option names off
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"refract {__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
]
StagePath = Annotated[
    str, typer.Argument(metavar="STAGE", help="The .usd, .usda, .usdc or .usdz file. It is not changed.")
]
Jobs = Annotated[int | None, typer.Option(help="Threads to use; 0, the default, means all cores.")]
ProgressMode = Annotated[
    str,
    typer.Option(
        "--progress",
        metavar="auto|lines|json|none",
        help="What is told on stderr: auto is a bar on a terminal, and everywhere a line for each file; lines has a "
        "line for each percent, too, such as 42%; json is one object per line; none has warnings and errors alone.",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Say how many seconds each part of the work has taken, too.")
]


Variant = Annotated[
    list[str] | None,
    typer.Option(
        "--variant",
        metavar="/PRIM{SET=NAME}",
        help="Choose a variant, over what the stage says; may be repeated, outer ones first. Quote it for the shell.",
    ),
]
SessionLayer = Annotated[
    str,
    typer.Option(
        "--session-layer",
        metavar="FILE",
        help="A layer whose opinions are stronger than all of the stage, as usdrecord has it.",
    ),
]
Mask = Annotated[
    str,
    typer.Option(
        metavar="PATH,...",
        help="Open only these prims, with what is below them and the materials they are bound to. Name the camera and "
        "the lights too, if they are to be there.",
    ),
]


def opening_of(variant: list[str] | None, session_layer: str, mask: str) -> Opening:
    """What the three options say; a mask of commas alone is refused like any other word that is no path."""
    named = words(mask) or ((mask,) if mask else ())
    return Opening(variants=tuple(variant or ()), session_layer=session_layer, mask=named)


def only_option(what: str) -> Any:
    """`--only`, which verbs understand alike (`verbs.orders.select`)."""
    help_text = f"Only these {what}, or those below these paths; * and ? stand for any characters."
    return typer.Option(metavar="PATH,...", help=help_text)


def stages_argument(what: str) -> Any:
    """STAGE of the commands that take several (`verbs.validate_many.stages_named`)."""
    of_folder = "A folder means every USD file below it."
    return typer.Argument(metavar="STAGE", help=f"The .usd, .usda, .usdc, .usdz or .glb files to {what}. {of_folder}")


AsJson = Annotated[bool, typer.Option("--json", help="The same as --format json.")]


def format_of(form: str, json: bool, known: tuple[str, ...]) -> str:
    """What --format and --json ask for together. Raises UsageError."""
    if form not in known:
        raise UsageError(f"--format is '{form}', not known; choose from {', '.join(known)}")
    if json and form not in ("text", "json"):
        raise UsageError(f"--json is --format json, and --format {form} is given too; leave one of them out")
    return "json" if json else form


@app.callback()
def refract(version: Version = False) -> None:
    """Render USD stages with glass in them, without a GPU or a display.

    Every option has a default in the environment: REFRACT_RENDER_IMAGE_WIDTH=1920 is --image-width of render,
    REFRACT_BAKE_PROBES_JOBS=4 is --jobs of bake probes. The word @FILE stands for the words in a file.

    Exit codes: 0 done, 1 failed, 2 wrong usage, 3 cancelled.
    """


def words(text: str) -> tuple[str, ...]:
    """The parts of a comma-separated option, without empty ones."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


@contextmanager
def outcome(
    progress: str, quiet: bool = False, verbose: bool = False
) -> Iterator[tuple[Report, Callable[[], bool]]]:
    """Turn errors into a line on stderr and the exit code, and Ctrl-C into a wish to stop."""
    try:
        with reporting(progress, quiet=quiet, verbose=verbose) as report, _interrupts() as cancel:
            try:
                yield report, cancel
                if seconds := report.parts():
                    report.closing(seconds)
            except RefractError as error:
                report.error(_by_flag(error))
                raise typer.Exit(error.exit_code) from error
            except MemoryError as error:
                report.error("out of memory; make the picture smaller, or the stage simpler")
                raise typer.Exit(1) from error
            except KeyboardInterrupt as error:
                report.error("cancelled")
                raise typer.Exit(CANCELLED) from error
    except UsageError as error:
        typer.echo(f"error: {_by_flag(error)}", err=True)
        raise typer.Exit(error.exit_code) from error


def _by_flag(error: RefractError) -> str:
    """Its message; one about a field of `RenderSettings` with the flag that set it in the place of the name."""
    message = str(error)
    name, _, rest = message.partition(" ")
    if not isinstance(error, UsageError):  # those begin with a file or a prim, whatever it is called
        return message
    known = name in RenderSettings.__dataclass_fields__ or name in ("quality", "preset")
    return f"--{name.replace('_', '-')} {rest}" if known else message


@contextmanager
def _interrupts() -> Iterator[Callable[[], bool]]:
    """The first Ctrl-C asks the work to stop at its next chance; a second one stops it where it is."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread may listen to signals
        yield lambda: False
        return
    asked = threading.Event()

    def on_interrupt(_signal: int, _frame: FrameType | None) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)
