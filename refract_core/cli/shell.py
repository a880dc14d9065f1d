"""What every command has from the shell: defaults in the environment, `@file` for words, completion of choices."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from ..errors import UsageError

PREFIX = "REFRACT"
"""`REFRACT_RENDER_SAMPLES` is the default of `refract render --samples`."""
_DEPTH = 8
"""Files of words within files of words."""


class Command(TyperCommand):
    """A command that offers the words its options may have, where a shell completes them."""

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        for param in self.params:
            choices = (param.metavar or "").split("|")
            if len(choices) > 1 and all(map(_CHOICE.fullmatch, choices)) and param._custom_shell_complete is None:
                param._custom_shell_complete = _offering(choices)


class Group(TyperGroup):
    """Commands below a word: the first of all takes words from files, and each gives options their variables."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        if ctx.parent is None:
            try:
                args = [*_expanded(args, ())]
            except UsageError as error:
                typer.echo(f"error: {error}", err=True)
                raise typer.Exit(error.exit_code) from error
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, command, rest = super().resolve_command(ctx, args)
        if command is not None:
            above = [] if ctx.parent is None else [ctx.info_name]  # nothing is deeper than `bake probes`
            _give_variables(command, "_".join([PREFIX, *above, str(name)]))
        return name, command, rest


class Commands(typer.Typer):
    """A Typer app of such commands."""

    def __init__(self, **options: Any) -> None:
        super().__init__(cls=Group, **options)

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        return super().command(name, **{"cls": Command, **options})


# --- variables and choices


_CHOICE = re.compile(r"[a-zA-Z0-9]+")


def _offering(choices: list[str]) -> Callable[[Any, Any, str], list[str]]:
    return lambda _ctx, _param, begun: [choice for choice in choices if choice.startswith(begun)]


def variable_of(prefix: str, option: Any) -> str:
    """What the default of an option is called: as its long flag, whatever its parameter is called in Python."""
    flag = next((flag for flag in option.opts if flag.startswith("--")), option.opts[0])
    return f"{prefix}_{flag.lstrip('-')}".replace("-", "_").upper()


def _give_variables(command: Any, prefix: str) -> None:
    """Have each option of a command read its variable, after those that it names itself; only these are in the help."""
    for option in command.params:
        if option.param_type_name != "option":
            continue
        if option.envvar is None:
            option.envvar, option.show_envvar = [], False
        named = [option.envvar] if isinstance(option.envvar, str) else list(option.envvar)
        option.envvar = list(dict.fromkeys([*named, variable_of(prefix, option)]))


# --- words from files


def _expanded(words: list[str], within: tuple[str, ...]) -> Iterator[str]:
    """Words, with those of FILE in the place of `@FILE`; `@@` begins a word with one @, and after `--` all are plain.

    Args:
        within: the files that are being read.

    Raises:
        UsageError: a file cannot be read, or leads to itself.
    """
    for at, word in enumerate(words):
        if word == "--":
            yield from words[at:]
            return
        if word.startswith("@@"):
            yield word[1:]
        elif word.startswith("@") and len(word) > 1:
            yield from _expanded(_words_of(word, within), (*within, os.path.abspath(word[1:])))
        else:
            yield word


def _words_of(word: str, within: tuple[str, ...]) -> list[str]:
    """The words of `@FILE` as a shell splits them; # begins a comment."""
    file = word[1:]
    if os.path.abspath(file) in within or len(within) >= _DEPTH:
        raise UsageError(f"{word}: this file of words leads to itself; take the word out of it")
    try:
        return shlex.split(Path(file).read_text("utf-8"), comments=True)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        text = f"cannot be read: {reason}; write words into it as in a shell, or begin a word that is no file with @@"
        raise UsageError(f"{word}: {text}") from error
    except ValueError as error:
        raise UsageError(f"{word}: {str(error).lower()}; close what is quoted in it") from error
