"""Commands are entry points of ours and of other packages: found, loaded, and listed by purpose without loading them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path

from pans.base import __version__
from pans.base.console import load_offered, missing_extra
from pans.base.errors import UsageError

from .command import Command

# The commands of this package: name -> module and the name of its `Command`. The entry points `pans.commands` add to them.
COMMANDS = {
    "demo": "pans.app.run.command:DEMO",
    "run": "pans.app.run.command:RUN",
    "replay": "pans.app.commands.recordings:REPLAY",
    "verify": "pans.app.commands.files:VERIFY",
    "info": "pans.app.commands.files:INFO",
    "report": "pans.app.commands.recordings:REPORT",
    "compare": "pans.app.commands.recordings:COMPARE",
    "export": "pans.app.commands.recordings:EXPORT",
    "bundle": "pans.app.commands.files:BUNDLE",
    "bench": "pans.app.commands.bench:BENCH",
    "service": "pans.app.commands.service:SERVICE",
    "batch": "pans.app.commands.batch:BATCH",
    "runs": "pans.app.commands.runs:RUNS_COMMAND",
    "devices": "pans.app.doctor.command:DEVICES",
    "doctor": "pans.app.doctor.command:DOCTOR",
    "profile": "pans.app.commands.profile:PROFILE",
    "calibrate": "pans.app.commands.calibrate:CALIBRATE",
    "refit": "pans.app.commands.refit:REFIT",
    "tune": "pans.app.commands.tune:TUNE",
    "completion": "pans.app.completion:COMPLETION",
}
EXTRAS = {"torch": "train", "onnx": "train", "optuna": "sweep", "matplotlib": "plot", "h5py": "export"}
EXTRAS |= {"ALP4": "alp", "Swabian": "tagger"}
GROUPS = {
    "Run and look": ("demo", "run", "replay", "verify", "info", "report", "compare", "export", "runs", "service"),
    "Instruments": ("profile", "calibrate", "refit", "tune", "simulate", "instrument", "devices", "doctor"),
    "Train and compare": ("train", "evaluate", "order", "baseline", "reproduce", "sweep", "batch", "data", "bundle"),
    "Measure and test": ("bench", "conform"),
    "Shell": ("completion",),
}
OTHERS = "Others"


def find_commands() -> dict[str, EntryPoint]:
    """Return all commands by name: those of COMMANDS, and the entry points of other packages."""
    ours = {name: EntryPoint(name, value, "pans.commands") for name, value in COMMANDS.items()}
    return {point.name: point for point in entry_points(group="pans.commands")} | ours


def load_command(point: EntryPoint) -> Command:
    """Return the command of an entry point; UsageError that names the missing extra, or the package that is broken."""
    try:
        command = load_offered(point)
    except UsageError as error:
        missing = (getattr(error.__cause__, "name", None) or "").split(".")[0]
        extra = EXTRAS.get(missing)
        if extra is None:
            raise
        raise missing_extra(f"`pans {point.name}`", missing, extra) from error
    if not isinstance(command, Command):
        raise UsageError(f"entry point {point.value} is a {type(command).__name__}, not a pans.app.command.Command")
    return command


def overview(commands: Mapping[str, EntryPoint]) -> str:
    """Return the text that `pans` prints without a command."""
    lines = [f"pans {__version__}: decide on a few photons, in time", "", "usage: pans COMMAND [options]"]
    width = max((len(name) for name in commands), default=0)
    for group, names in _grouped(commands):
        lines += ["", f"{group}:", *(f"  {name:<{width}}  {_summary(commands[name])}" for name in names)]
    lines += ["", "`pans help COMMAND` lists a command's options. Start with `pans demo`."]
    return "\n".join(lines)


def _grouped(commands: Mapping[str, EntryPoint]) -> Iterator[tuple[str, list[str]]]:
    known = {name for names in GROUPS.values() for name in names}
    for group, names in {**GROUPS, OTHERS: sorted({*commands} - known)}.items():
        if there := [name for name in names if name in commands]:
            yield group, there


def _summary(point: EntryPoint) -> str:
    try:
        return _written_help(point) or load_command(point).help
    except UsageError as error:
        return f"({error.message}; {error.remedy})"
    except Exception as error:  # one package's broken command must not hide all the others
        return f"(cannot be loaded: {error})"


def _written_help(point: EntryPoint) -> str:
    """Return the help as it is written in the command's source, "" if it is not a plain text there: importing all takes a second."""
    try:
        spec = find_spec(point.module)
        source = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
    except (ImportError, AttributeError, OSError):  # loading it says what is wrong
        return ""
    found = re.search(rf'^{point.attr} = Command\(\s*"([^"\\]*)",', source, re.MULTILINE)
    return found[1] if found else ""
