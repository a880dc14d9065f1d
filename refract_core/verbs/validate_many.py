"""Many stages against the rules, one after the other; what one of them does to USD, another does not notice.

USD can end its process over a damaged file. Files that a person names together are thus checked in a process beside
this one, which is started again where that happens; the file is then an error like any other.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from concurrent.futures.process import BrokenProcessPool

from ..errors import RefractError, UsageError
from ..settings import AS_IT_IS, Opening
from ..usd.layers.write import EXTENSIONS
from ..usd.rules.findings import ERROR, Finding, Repair
from .orders import stop_if
from .validate import ValidateOrder, Verdict, validate

UNREADABLE = "refract.unreadable"
_DIED = "USD ended its process over this file, which is damaged"


def names_one(names: Sequence[str]) -> bool:
    """A person named one stage, and no folder of them."""
    return len(names) == 1 and not os.path.isdir(names[0])


def stages_named(names: Sequence[str]) -> list[str]:
    """The stages that a person names: files as they are, and of a folder every .usd* file below it, by name.

    Raises:
        UsageError: a folder has none.
    """
    found: dict[str, None] = {}
    for name in names:
        if not os.path.isdir(name):
            found[name] = None
            continue
        below = [
            os.path.join(folder, file)
            for folder, _, files in os.walk(name)
            for file in files
            if os.path.splitext(file)[1].lower() in EXTENSIONS
        ]
        if not below:
            raise UsageError(f"{name}: the folder has no {', '.join(EXTENSIONS[:-1])} or {EXTENSIONS[-1]} file in it")
        found |= dict.fromkeys(sorted(below))
    return list(found)


def validate_each(
    stages: Sequence[str], opening: Opening = AS_IT_IS, cancel: Callable[[], bool] = lambda: False
) -> Iterator[Verdict]:
    """A verdict on every stage, in their order. One that cannot be read has that as its only finding.

    Raises:
        UsageError: the opening asks for what a stage does not have.
    """
    waiting = list(stages)
    while waiting:
        # Not forked: USD has threads, and whatever is locked in one of them now would stay so.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _leave_interrupts) as pool:
            try:
                while waiting:
                    work = pool.submit(_verdict, waiting[0], opening)
                    while True:
                        stop_if(cancel)
                        try:
                            yield work.result(timeout=0.2)
                            break
                        except NotYet:
                            continue
                    del waiting[0]
            except BrokenProcessPool:
                stop_if(cancel)
                yield unreadable(waiting.pop(0), _DIED)


def _leave_interrupts() -> None:
    """To the process that waits: a terminal's Ctrl-C reaches both."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _verdict(stage: str, opening: Opening) -> Verdict:
    """In the other process."""
    try:
        verdict = validate(ValidateOrder(stage=stage, opening=opening))
    except UsageError:
        raise
    except (RefractError, MemoryError) as error:
        return unreadable(stage, str(error) or "out of memory")
    return Verdict(stage, tuple(map(_light, verdict.findings)))


def _light(finding: Finding) -> Finding:
    """Without the values of its repairs, which cannot leave their process. Nobody repairs many stages at once."""
    return finding._replace(repairs=tuple(Repair(repair.path, repair.name) for repair in finding.repairs))


def unreadable(stage: str, reason: str) -> Verdict:
    """Of a stage that cannot be opened."""
    return Verdict(stage, (Finding(UNREADABLE, ERROR, stage, reason, ""),))
