"""`refract serve`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from .app import app, outcome

Host = Annotated[str, typer.Option(help="Address to listen on. The default takes requests of this machine only.")]
Port = Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes a free one and prints it.")]
AllowHost = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        envvar="REFRACT_ALLOW_HOST",
        help="A name that requests may call the service by, beside localhost and --host; may be repeated. Others are "
        "refused with 421, or any page could have its own name lead here.",
    ),
]
AllowOrigin = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ORIGIN",
        envvar="REFRACT_ALLOW_ORIGIN",
        help="Another site whose pages may use the service, such as https://shop.example.org; may be repeated.",
    ),
]
Proxy = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ADDRESS",
        envvar="REFRACT_PROXY",
        help="A reverse proxy, or a network of them, whose X-Forwarded-For is believed; may be repeated. Without it, "
        "all its clients count as one, and share what one may have.",
    ),
]
StageRoot = Annotated[
    str,
    typer.Option(
        metavar="FOLDER", envvar="REFRACT_STAGE_ROOT", help="Stages that requests may name. Without it, uploads only."
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        envvar="REFRACT_WORKERS",
        help="Jobs at once. The default is the number of cores; with --executor it is 32, and the cluster decides how "
        "many of them really run.",
    ),
]
Queue = Annotated[int, typer.Option(envvar="REFRACT_QUEUE", help="Jobs that may wait; one more is refused with 429.")]
Data = Annotated[
    str,
    typer.Option(
        metavar="FOLDER",
        envvar="REFRACT_DATA",
        help="Where jobs and results are kept, also over a restart. Without it, a new temporary folder.",
    ),
]
Executor = Annotated[
    str,
    typer.Option(
        metavar="dask://HOST:PORT",
        envvar="REFRACT_EXECUTOR",
        help="Do the jobs on the Dask cluster with this scheduler, each in a locked process there. Without it, on this "
        "machine.",
    ),
]
TokenFile = Annotated[
    str,
    typer.Option(
        metavar="FILE",
        envvar="REFRACT_TOKEN_FILE",
        help="Bearer tokens, one a line, one of which each request must bring: a token alone, or NAME sha256:HEX "
        "SCOPES. Without it, everybody may come.",
    ),
]
RequireConfinement = Annotated[
    bool,
    typer.Option(
        "--require-confinement",
        envvar="REFRACT_REQUIRE_CONFINEMENT",
        help="Do not start where the kernel lacks Landlock or seccomp, without which a worker that a stage has taken "
        "over is not alone. Without it, the start and /readyz say what is missing.",
    ),
]
KeyFile = Annotated[
    str,
    typer.Option(
        metavar="FILE",
        envvar="REFRACT_KEY_FILE",
        help="One line: the secret that signs addresses of thumbnails, and webhooks. Without it, there are neither.",
    ),
]
Limit = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        metavar="NAME=NUMBER",
        help="Change one limit, such as job_seconds=60; may be repeated. /v1/limits and `--limits` list them. The "
        "environment does it too: REFRACT_LIMIT_JOB_SECONDS=60.",
    ),
]
Log = Annotated[
    str,
    typer.Option(
        metavar="KIND",
        envvar="REFRACT_LOG",
        help="Form of the log on stderr, which has a line for each request: text, json (an object a line), or auto, "
        "which is text for a terminal and else json.",
    ),
]
ShowLimits = Annotated[bool, typer.Option("--limits", help="Print every limit with its value, and exit.")]


_SENT = 32
"""Jobs that a cluster has at once."""


@app.command()
def serve(
    host: Host = "127.0.0.1",
    port: Port = 8000,
    allow_host: AllowHost = None,
    allow_origin: AllowOrigin = None,
    proxy: Proxy = None,
    stage_root: StageRoot = "",
    workers: Workers = None,
    queue: Queue = 16,
    data: Data = "",
    executor: Executor = "",
    token_file: TokenFile = "",
    require_confinement: RequireConfinement = False,
    key_file: KeyFile = "",
    limit: Limit = None,
    log: Log = "auto",
    limits: ShowLimits = False,
) -> None:
    """Serve renders, conversions and checks over HTTP, with a page at /.

    Every stage is opened by a process of its own, which may read nothing but that stage and dies with its job.
    """
    with outcome("none"):
        from ..service.limits import limits_from, table

        chosen = limits_from(_numbers(limit or []))
        if limits:
            for row in table(chosen):
                typer.echo(f"{row['name']:18} {row['value']:>12} {row['unit']:10} {row['meaning']}")
            return
        if require_confinement:
            from ..service import confine

            if executor:
                raise UsageError("--require-confinement looks at this machine, and --executor has others do the jobs")
            confine.required(confine.available())
        from ..service.app import Settings
        from ..service.journal import KINDS
        from ..service.serve import serve as run

        if log not in KINDS:
            raise UsageError(f"--log {log}: choose from {', '.join(KINDS)}")
        settings = Settings(
            stage_root=stage_root, data=data, executor=executor, queue=queue, tokens=_tokens(token_file), limits=chosen,
            allow_hosts=tuple(allow_host or ()), allow_origins=tuple(allow_origin or ()),
            proxies=tuple(proxy or ()), key=_key(key_file),
            workers=workers if workers is not None else _SENT if executor else os.cpu_count() or 1,
        )  # fmt: skip
        run(settings, host, port, log)


def _numbers(given: list[str]) -> dict[str, int | None]:
    """`NAME=NUMBER` pairs."""
    from dataclasses import fields

    from ..service.limits import Limits

    known = [one.name for one in fields(Limits)]
    found: dict[str, int | None] = {}
    for text in given:
        name, _, number = text.partition("=")
        if name not in known:
            raise UsageError(f"--limit {text}: there is no such limit; choose from {', '.join(known)}")
        try:
            found[name] = int(number)
        except ValueError as error:
            raise UsageError(f"--limit {text}: write NAME=NUMBER, with a whole number of 1 or more") from error
    return found


def _key(path: str) -> str:
    """The one line of a file. Raises UsageError."""
    if not path:
        return ""
    try:
        lines = Path(path).read_text("utf-8").split()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--key-file {path}: cannot be read") from error
    if len(lines) != 1:
        raise UsageError(f"--key-file {path}: holds {len(lines)} words; write one, long and random")
    return lines[0]


def _tokens(path: str) -> tuple[str, ...]:
    """Lines of a file of tokens; those that begin with # are for people. Raises UsageError."""
    if not path:
        return ()
    try:
        lines = Path(path).read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--token-file {path}: cannot be read") from error
    tokens = tuple(line.strip() for line in lines if line.strip() and not line.startswith("#"))
    if not tokens:
        raise UsageError(f"--token-file {path}: holds no token; write one a line, or leave the option out")
    return tokens
