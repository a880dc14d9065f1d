"""Jobs on disk: a folder each, with the record (written in one step), the uploaded stage, and results."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from . import quota
from .problems import Problem

ENDED = ("done", "failed", "cancelled")
RESULTS = re.compile(
    r"^((image|picture\.\d{1,4})\.(png|jpg|webp|avif|exr)|pictures\.zip|aov\.[A-Za-z_.]+\.png|report\.json|"
    r"(converted|baked)\.usdz)$"
)
STAGES_MADE = {"convert": "converted.usdz", "bake-probes": "baked.usdz", "bake-thickness": "baked.usdz"}
"""What verbs that make a stage call it, beside their report."""
_ID = re.compile(r"^[0-9a-f]{64}$")
_FORGOTTEN = 3600.0  # [s]
_FILES_OF_JOB, _BYTES_OF_JOB = 32, 1 << 20
"""The least that must be left for the service to call itself ready; a job may need far more."""
_WORK = re.compile(r"^[0-9a-f]{16}$")


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def count_of(settings: Mapping[str, Any]) -> int:
    """How many pictures a render makes."""
    return len(settings.get("widths") or (0,)) * len(settings.get("time_codes") or (0,))


@dataclass
class Record:
    """One job. The only record here that changes."""

    id: str
    kind: str
    settings: dict[str, Any]
    stage: str
    """Name of the uploaded file in the job's folder, or the path of a stage under the stage root."""
    uploaded: bool
    kept: bool = False
    """It is to be finished even if nobody waits for it."""
    status: str = "queued"
    fraction: float = 0.0
    stage_of_work: str = "waiting"
    created: str = field(default_factory=now)
    started: str | None = None
    finished: str | None = None
    warnings: list[dict[str, str]] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)
    problem: dict[str, Any] | None = None
    owner: str = ""
    """Of the token that asked for it; '' where none was asked for."""

    @property
    def ended(self) -> bool:
        return self.status in ENDED

    def outcome(self, *, report: bool = False) -> str:
        """The file that the job is done for, or its report where it makes one, too."""
        if self.kind == "render":
            return "pictures.zip" if count_of(self.settings) > 1 else f"image.{self.settings['format']}"
        return "report.json" if report else STAGES_MADE.get(self.kind, "report.json")

    def document(self) -> dict[str, Any]:
        """As `models.Job`."""
        here = f"/v1/jobs/{self.id}"
        links = {"self": here, "events": f"{here}/events"}
        if self.status == "done":
            links |= {"image": f"{here}/image"} if self.kind == "render" else {"report": f"{here}/report"}
            links |= {"file": f"{here}/file"} if self.kind in STAGES_MADE else {}
        aovs = [{**aov, "href": f"{here}/aovs/{aov['name']}.png"} for aov in self.result.get("aovs", [])]
        several = self.result.get("pictures", [])
        pictures = [{**one, "href": f"{here}/pictures/{number}"} for number, one in enumerate(several)]
        if pictures and self.status == "done":
            links["pictures"] = f"{here}/pictures"
        kept = ("id", "kind", "status", "fraction", "stage_of_work", "created", "started", "finished", "warnings",
                "problem")  # fmt: skip
        return {
            **{name: getattr(self, name) for name in kept}, "width": self.result.get("width"),
            "height": self.result.get("height"), "aovs": aovs, "pictures": pictures,
            "view": self.result.get("view"), "links": links,
        }  # fmt: skip


def make_work(parent: Path) -> Path:
    """A worker's folder: what comes in, what goes out, and scratch."""
    folder = parent / secrets.token_hex(8)
    try:
        for part in ("in", "out", "tmp"):
            (folder / part).mkdir(parents=True, mode=0o700)
    except OSError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


class Store:
    """The folder of all jobs."""

    def __init__(self, folder: Path) -> None:
        self.jobs, self.work = folder / "jobs", folder / "work"
        self.jobs.mkdir(parents=True, exist_ok=True, mode=0o700)
        shutil.rmtree(self.work, ignore_errors=True)  # of workers that are gone
        self.work.mkdir(mode=0o700)
        self._given: set[Path] = set()
        """Workers' folders in use."""

    def folder(self, identifier: str) -> Path:
        return self.jobs / identifier

    def save(self, record: Record) -> None:
        folder = self.folder(record.id)
        folder.mkdir(exist_ok=True, mode=0o700)
        temporary = folder / f".{secrets.token_hex(4)}"
        try:
            temporary.write_text(json.dumps(asdict(record), allow_nan=False), "utf-8")
            os.replace(temporary, folder / "record.json")
        except OSError:
            temporary.unlink(missing_ok=True)
            raise

    def load_all(self) -> dict[str, Record]:
        """Every job there is. Those that were under way when the service ended have failed; those that only waited,
        and are to be finished, still wait."""
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
            if not record.ended and not (record.kept and record.status == "queued"):
                problem = Problem("interrupted", "the service ended while the job was waiting or running")
                record.status, record.finished = "failed", now()
                record.problem = problem.document(f"/v1/jobs/{record.id}")
                self.drop_stage(record)
                self.drop_results(record)
                with contextlib.suppress(OSError):  # of a full disk; it is told all the same
                    self.save(record)
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

    def free(self) -> int:
        """Room for further files [bytes]; 0 where there are fewer files left to make than a job needs."""
        found = os.statvfs(self.work)
        enough = found.f_favail >= _FILES_OF_JOB or not found.f_files  # some file systems do not count them
        return found.f_bavail * found.f_frsize if enough else 0

    def writable(self) -> bool:
        """Whether there is room for the least that a job writes."""
        try:
            if self.free() < _BYTES_OF_JOB:
                return False
            with tempfile.TemporaryFile(dir=self.work) as file:
                file.write(b"x")
        except OSError:
            return False
        return True

    # --- a worker's folder ------------------------------------------------------------------------------------------

    def new_work(self) -> Path:
        work = make_work(self.work)
        self._given.add(work)
        return work

    def take_results(self, work: Path, record: Record) -> None:
        """Move what a worker wrote into the job's folder: plain files of known names, nothing else, and all or none."""
        try:
            for entry in os.scandir(work / "out"):
                if RESULTS.match(entry.name) and stat.S_ISREG(entry.stat(follow_symlinks=False).st_mode):
                    os.replace(entry.path, self.folder(record.id) / entry.name)
        except OSError:
            with contextlib.suppress(OSError):
                self.drop_results(record)
            raise

    def drop_results(self, record: Record) -> None:
        for path in self.folder(record.id).iterdir():
            if RESULTS.match(path.name):
                path.unlink(missing_ok=True)

    def drop_work(self, work: Path) -> None:
        quota.remove(str(work))
        self._given.discard(work)

    def drop_leavings(self) -> None:
        for path in self.work.iterdir():
            if _WORK.match(path.name) and path not in self._given:
                shutil.rmtree(path, ignore_errors=True)
            elif path.name.startswith("upload-") and time.time() - path.stat().st_mtime > _FORGOTTEN:
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
