"""The files of one run: which they are, that none is in the way before it begins, and their folder while it runs.

Owns what a run may write and replace; each file's content is its writer's. A run that is refused leaves nothing behind.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qsl

from pans.runtime.cli import EXIT_USAGE
from pans.runtime.errors import PansError, RecordingError, UsageError
from pans.runtime.outputs import check_outputs, make_folder, refuse_existing
from pans.runtime.record.part_keeper import files_of_parts, index_path
from pans.runtime.run_folder import locked, new_run_folder

from .job import Job
from .options import MIB

STATE_FORMAT = "pans-state 1"
STATE_MAX_BYTES = 1 << 16


def check_run_files(job: Job) -> None:
    """Check every output of `job` before anything is opened; UsageError if one exists, is an input, or cannot be written."""
    if job.record is not None and job.record.is_dir():  # `/` has no name that the page's could be made of
        raise UsageError(f"{job.record}: is a folder, expected the name of a file", remedy="choose another name")
    inputs = input_files(job)
    outputs = [path for path in (job.recording, job.page, job.trace) if path is not None]
    if job.recording is not None and job.continuous.limits is not None:
        outputs = [index_path(path) if path == job.recording else path for path in outputs]
        parts = files_of_parts(job.recording)
        if parts and not job.force:
            raise refuse_existing(parts[0])
    if job.out_root is not None:
        outputs.append(job.out_root / ".new" / "run")
    state = job.continuous.state
    if state is not None:
        check_outputs([state], inputs=inputs, force=job.force, ours=is_state_file)  # its folder must be there
        outputs.append(state)
    check_outputs(
        outputs,
        inputs=inputs,
        force=job.force,
        ours=lambda path: path == state and is_state_file(path),
        makes_folders=True,
    )
    _check_disk(job)


def input_files(job: Job) -> list[str | Path | None]:
    """Return the files that a run reads."""
    return [*job.inputs, job.bundle_path, job.dark.calibration, job.dark.registration, *files_of_url(job.device)]


def _check_disk(job: Job) -> None:
    """A run that would be stopped at once does not begin."""
    folder = job.out_root if job.out_root is not None else None if job.recording is None else job.recording.parent
    if folder is None or not job.continuous.stop_below:
        return
    there = next((path for path in (folder, *folder.absolute().parents) if path.is_dir()), Path.cwd())
    free = shutil.disk_usage(there).free
    if free < job.continuous.stop_below:
        raise UsageError(
            f"{folder}: {free / MIB:.1f} MiB are free on its disk, and a run stops below {job.continuous.stop_below / MIB:.1f}",
            remedy="make room (pans runs prune), record elsewhere, or lower --disk-reserve-mb",
        )


@contextmanager
def claimed(job: Job) -> Iterator[Job]:
    """Make the folders of `job` and hold them while it runs; yield it with its own folder. Folders that stay empty go."""
    made: list[Path] = []
    if job.out_root is not None:
        job = replace(job, out=new_run_folder(job.run_name, job.out_root), out_root=None)
        made.append(job.out)  # type: ignore[arg-type]
    folders = {path.parent for path in (job.recording, job.page, job.trace) if path is not None}
    try:
        for folder in sorted(folders):
            made += missing_folders(folder)
            make_folder(folder)
        with ExitStack() as held:
            for lock in sorted(_locks(job)):
                held.enter_context(locked(lock))
            yield job
    finally:
        for folder in reversed(made):
            with suppress(OSError):  # it holds something
                folder.rmdir()


@contextmanager
def gone_if_refused(job: Job) -> Iterator[None]:
    """Remove the recording that was begun within the block when the run is refused before it measures anything."""
    before = _recorded_files(job)
    try:
        yield
    except PansError as error:
        if error.exit_code == EXIT_USAGE and not isinstance(error, RecordingError):
            for path in _recorded_files(job) - before:
                with suppress(OSError):
                    path.unlink()
        raise


def _recorded_files(job: Job) -> set[Path]:
    if job.recording is None:
        return set()
    return {path for path in (job.recording, *files_of_parts(job.recording)) if os.path.lexists(path)}


def missing_folders(folder: Path) -> list[Path]:
    """Return `folder` and those above it that do not exist, the outermost first."""
    missing: list[Path] = []
    while not os.path.lexists(folder):
        missing.insert(0, folder)
        folder = folder.parent
    return missing


def is_state_file(path: Path) -> bool:
    """Return whether `path` is a state file of a run, which the next one may replace."""
    try:
        if path.stat().st_size > STATE_MAX_BYTES:
            return False
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and found.get("format") == STATE_FORMAT


def _locks(job: Job) -> set[Path]:
    recording = set() if job.recording is None else {job.recording.with_name(f".{job.recording.name}.lock")}
    return recording if job.out is None else {*recording, job.out / ".pans-run.lock"}


def files_of_url(device: str) -> list[str]:
    """Return the files that a device URL names: a scene, a fault plan, a profile."""
    base, _, query = device.partition("?")
    values = [base.partition(":")[2], *(value for _, value in parse_qsl(query))]
    return [value for value in values if value and os.path.isfile(value)]
