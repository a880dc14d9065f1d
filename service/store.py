"""Jobs on disk: a folder each, with the record (written in one step), the uploaded stage, and results."""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import stat
import tempfile
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from .problems import Problem

ENDED = ("done", "failed", "cancelled")
RESULTS = re.compile(
    r"^((image|picture\.\d{1,4})\.(png|jpg|webp|avif|exr)|pictures\.zip|aov\.[A-Za-z_.]+\.png|report\.json|"
    r"converted\.usdz)$"
)
_ID = re.compile(r"^[0-9a-f]{64}$")


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@dataclass
class Record:
    """One job. The only record here that changes."""

    id: str
    kind: str
    settings: dict[str, Any]
    stage: str
    """Name of the uploaded file in the job's folder, or the path of a stage under the stage root."""
    uploaded: bool
    status: str = "queued"
    fraction: float = 0.0
    stage_of_work: str = "waiting"
    created: str = field(default_factory=now)
    started: str | None = None
    finished: str | None = None
    warnings: list[dict[str, str]] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)
    problem: dict[str, Any] | None = None

    @property
    def ended(self) -> bool:
        return self.status in ENDED

    def document(self) -> dict[str, Any]:
        """As `models.Job`."""
        here = f"/v1/jobs/{self.id}"
        links = {"self": here, "events": f"{here}/events"}
        if self.status == "done":
            links |= {"render": {"image": f"{here}/image"}, "convert": {"file": f"{here}/file",
                      "report": f"{here}/report"}}.get(self.kind, {"report": f"{here}/report"})  # fmt: skip
        aovs = [{**aov, "href": f"{here}/aovs/{aov['name']}.png"} for aov in self.result.get("aovs", [])]
        several = self.result.get("pictures", [])
        pictures = [{**one, "href": f"{here}/pictures/{number}"} for number, one in enumerate(several)]
        if pictures and self.status == "done":
            links["pictures"] = f"{here}/pictures"
        kept = ("id", "kind", "status", "fraction", "stage_of_work", "created", "started", "finished", "warnings",
                "problem")  # fmt: skip
        return {
            **{name: getattr(self, name) for name in kept}, "width": self.result.get("width"),
            "height": self.result.get("height"), "aovs": aovs, "pictures": pictures, "links": links,
        }  # fmt: skip


def make_work(parent: Path) -> Path:
    """A worker's folder: what comes in, what goes out, and scratch."""
    folder = parent / secrets.token_hex(8)
    for part in ("in", "out", "tmp"):
        (folder / part).mkdir(parents=True, mode=0o700)
    return folder


class Store:
    """The folder of all jobs."""

    def __init__(self, folder: Path) -> None:
        self.jobs, self.work = folder / "jobs", folder / "work"
        self.jobs.mkdir(parents=True, exist_ok=True, mode=0o700)
        shutil.rmtree(self.work, ignore_errors=True)  # of workers that are gone
        self.work.mkdir(mode=0o700)

    def folder(self, identifier: str) -> Path:
        return self.jobs / identifier

    def save(self, record: Record) -> None:
        folder = self.folder(record.id)
        folder.mkdir(exist_ok=True, mode=0o700)
        temporary = folder / f".{secrets.token_hex(4)}"
        temporary.write_text(json.dumps(asdict(record), allow_nan=False), "utf-8")
        os.replace(temporary, folder / "record.json")

    def load_all(self) -> dict[str, Record]:
        """Every job there is; those that were under way when the service ended have failed."""
        found: dict[str, Record] = {}
        known = {one.name for one in fields(Record)}
        for folder in sorted(self.jobs.iterdir()):
            try:
                values = json.loads((folder / "record.json").read_text("utf-8"))
                record = Record(**{name: value for name, value in values.items() if name in known})
            except (OSError, ValueError, TypeError):
                shutil.rmtree(folder, ignore_errors=True)
                continue
            if not _ID.match(record.id) or record.id != folder.name:
                shutil.rmtree(folder, ignore_errors=True)
                continue
            if not record.ended:
                problem = Problem("interrupted", "the service ended while the job was waiting or running")
                record.status, record.finished = "failed", now()
                record.problem = problem.document(f"/v1/jobs/{record.id}")
                self.save(record)
                self.drop_stage(record)
            found[record.id] = record
        return found

    def remove(self, identifier: str) -> None:
        shutil.rmtree(self.folder(identifier), ignore_errors=True)

    def drop_stage(self, record: Record) -> None:
        """A client's file is kept no longer than it is needed."""
        if record.uploaded:
            (self.folder(record.id) / record.stage).unlink(missing_ok=True)

    def size(self, identifier: str) -> int:
        return sum(entry.stat().st_size for entry in os.scandir(self.folder(identifier)) if entry.is_file())

    def writable(self) -> bool:
        try:
            with tempfile.TemporaryFile(dir=self.work) as file:
                file.write(b"x")
        except OSError:
            return False
        return True

    # --- a worker's folder ------------------------------------------------------------------------------------------

    def new_work(self) -> Path:
        return make_work(self.work)

    def take_results(self, work: Path, record: Record) -> None:
        """Move what a worker wrote into the job's folder: plain files of known names, nothing else."""
        for entry in os.scandir(work / "out"):
            if RESULTS.match(entry.name) and stat.S_ISREG(entry.stat(follow_symlinks=False).st_mode):
                os.replace(entry.path, self.folder(record.id) / entry.name)

    def drop_work(self, work: Path) -> None:
        shutil.rmtree(work, ignore_errors=True)
