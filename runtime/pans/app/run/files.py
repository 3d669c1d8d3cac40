"""The files of one run: the checks before it begins, their folder while it runs, what the recording and the page say of it.

A run that is refused leaves nothing behind.
"""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from pans.app.commands.runs import make_room
from pans.base import __version__
from pans.base.console import changed_options, say
from pans.base.errors import EXIT_USAGE, PansError, RecordingError, UsageError
from pans.base.files import MIB, check_outputs, locked, make_folder, new_run_folder, refuse_existing
from pans.instrument.profile import Profile
from pans.live.options import RunOptions
from pans.live.watch import read_state
from pans.record.reading import files_of_parts, find_parts
from pans.record.recorder import PartLimits

if TYPE_CHECKING:
    from pans.bundle.backends import Decider
    from pans.decide.plan import Plan
    from pans.report.summary import Summary

# options that name a file to read
NAME_FILES = ("bundle", "profile", "flow", "act_profile", "calibration", "registration")


def check_run_files(options: RunOptions) -> None:
    """Check every output of `options` before anything is opened; UsageError if one exists, is an input, or cannot be written."""
    if options.record is not None and options.record.is_dir():  # `/` has no name that the page's could be made of
        raise UsageError(f"{options.record}: is a folder, expected the name of a file", remedy="choose another name")
    inputs = input_files(options)
    outputs = [path for path in (options.recording, options.page, options.trace) if path is not None]
    if options.recording is not None and options.rotate_bytes and not options.force:
        for part in files_of_parts(options.recording):
            raise refuse_existing(part)
    if options.out_root is not None:
        outputs.append(options.out_root / ".new" / "run")
    state, force = options.state, options.force

    def is_ours(path: Path) -> bool:
        return path == state and read_state(path) is not None

    if state is not None:
        check_outputs([state], inputs=inputs, force=force, ours=is_ours)  # its folder must be there
        outputs.append(state)
    check_outputs(outputs, inputs=inputs, force=force, ours=is_ours, makes_folders=True)
    _check_disk(options)


def input_files(options: RunOptions) -> list[str | Path | None]:
    """Return the files that a run reads."""
    named = [getattr(options, name) for name in NAME_FILES]
    return [*options.files_read, *named, *files_of_url(options.device)]


def _check_disk(options: RunOptions) -> None:
    """A run that would be stopped at once does not begin."""
    folder = options.out_root or (options.recording.parent if options.recording else None)
    if folder is None or not options.stop_below:
        return
    there = next((path for path in (folder, *folder.absolute().parents) if path.is_dir()), Path.cwd())
    free = shutil.disk_usage(there).free
    if free < options.stop_below:
        raise UsageError(
            f"{folder}: {free / MIB:.1f} MiB are free on its disk, and a run stops below {options.stop_below / MIB:.1f}",
            remedy="make room (pans runs prune), record elsewhere, or lower --disk-reserve-mb",
        )


@contextmanager
def claimed(options: RunOptions) -> Iterator[RunOptions]:
    """Make the folders of `options` and hold them while it runs; yield it with its own folder. Folders that stay empty go."""
    made: list[Path] = []
    if options.out_root is not None:
        if options.keep_runs_mb and options.out_root.is_dir():
            room = round(options.keep_runs_mb * MIB) - options.keep_bytes
            for line in make_room(options.out_root, options.command, room):
                say(f"pans: {line}")
        options = replace(options, out=new_run_folder(options.bundle.stem, options.out_root), out_root=None)
        made.append(options.out)  # type: ignore[arg-type]
    folders = {path.parent for path in (options.recording, options.page, options.trace) if path is not None}
    try:
        for folder in sorted(folders):
            made += [one for one in (*reversed(folder.parents), folder) if not os.path.lexists(one)]
            make_folder(folder)
        locks = [] if options.recording is None else [options.recording.with_name(f".{options.recording.name}.lock")]
        locks += [] if options.out is None else [options.out / ".pans-run.lock"]
        with ExitStack() as held:
            for lock in sorted(locks):
                held.enter_context(locked(lock))
            if (state := options.state) is not None:
                remedy = "give each run a file of its own with --state"
                held.enter_context(locked(state.with_name(f".{state.name}.lock"), str(state), remedy))
            yield options
    finally:
        for folder in reversed(made):
            with suppress(OSError):  # it holds something
                folder.rmdir()


@contextmanager
def gone_if_refused(options: RunOptions) -> Iterator[None]:
    """Remove the recording that was begun within the block when the run is refused before it measures anything."""
    before = _recorded_files(options)
    try:
        yield
    except PansError as error:
        if error.exit_code == EXIT_USAGE and not isinstance(error, RecordingError):
            for path in _recorded_files(options) - before:
                with suppress(OSError):
                    path.unlink()
        raise


def _recorded_files(options: RunOptions) -> set[Path]:
    if options.recording is None:
        return set()
    return {path for path in (options.recording, *files_of_parts(options.recording)) if os.path.lexists(path)}


def files_of_url(device: str) -> list[str]:
    """Return the files that a device URL names: a scene, a fault plan, a profile."""
    base, _, query = device.partition("?")
    values = [base.partition(":")[2], *(value for _, value in parse_qsl(query))]
    return [value for value in values if value and os.path.isfile(value)]


def part_limits(options: RunOptions) -> PartLimits | None:
    """Return how a recording is divided into parts; None for one file."""
    return PartLimits(options.rotate_bytes, options.keep_bytes) if options.rotate_bytes else None


def what_was_run(
    options: RunOptions, profile: Profile, name: str, header: Mapping[str, Any], summary: Summary
) -> dict[str, str]:
    """The lines below the summary page's figures; `header` is the recording's."""
    parts = find_parts(options.recording) if options.recording and options.rotate_bytes else []
    written = f"{parts[0]} to {parts[-1].name}" if len(parts) > 1 else next(iter(parts), options.recording)
    log = f"decision log SHA-256 {summary.decisions_sha256[:16]}…; pans replay recomputes it"
    return {
        "bundle": f"{name} ({options.bundle.name}, SHA-256 {header['bundle_sha256'][:16]}…)",
        "device": f"{options.device} (firmware {summary.device.get('firmware', 'unknown')})",
        "profile": f"{profile.name}: {profile.description}",
        "decision back end": header["config"]["backend"],
        "recording": f"{written} ({log})",
        "command": options.command,
        "machine": f"{platform.machine()}, Python {platform.python_version()}, pans {__version__}",
    }


def recording_header(
    options: RunOptions, profile: Profile, bundle_sha256: str, decider: Decider, n_objects: int, plan: Plan
) -> dict[str, Any]:
    """What a recording must say to be understood alone; units are in the keys."""
    dose = decider.dose
    return {
        "bundle_sha256": bundle_sha256,
        "command": options.command,
        "device_url": options.device,
        "profile": {"name": profile.name, "sha256": profile.sha256, "toml": profile.text},
        "options": changed_options(options),
        "config": {
            **{name: getattr(options, name) for name in ("shots", "trials", "seconds", "deadline_us", "order")},
            **{"objects": n_objects, "dark_slots_per_cycle": options.dark_slots, "tick_hz": profile.clock.tick_hz},
            **{"backend": decider.name, "backend_choice": dict(decider.choice)},
            "realtime_requested": options.realtime,
            **({"mode": "parallel"} if profile.mode == "parallel" else {}),
            **({"drive": plan.drive, "confidence": options.confidence} if plan.drive else {}),
            **({"photon_number_max": plan.largest} if plan.largest > 1 and plan.channels_at_once == 1 else {}),
            **({"channels_at_once": plan.channels_at_once} if plan.channels_at_once > 1 else {}),
            **({"dose_cap": options.dose_cap} if options.dose_cap else {}),
            **({"walk_dose": {"most": dose.most, "states": dose.states}} if dose is not None else {}),
        },
        "versions": {
            **{"pans": __version__, "python": platform.python_version(), "platform": platform.platform()},
            **{name: version(name) for name in ("numpy", "numba", "onnxruntime")},
        },
    }
