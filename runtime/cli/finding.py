"""Finding and loading commands, which are entry points of ours and of other packages."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from pans.runtime.errors import UsageError
from pans.runtime.guests import load_guest

from .command import Command

EXTRAS = {"torch": "train", "onnx": "train", "optuna": "sweep", "matplotlib": "plot", "h5py": "export"}


def find_commands() -> dict[str, EntryPoint]:
    """Return the entry points of all commands by name."""
    return {point.name: point for point in entry_points(group="pans.commands")}


def load_command(point: EntryPoint) -> Command:
    """Return the command of an entry point; UsageError that names the missing extra, or the package that is broken."""
    try:
        command = load_guest(point)
    except UsageError as error:
        missing = (getattr(error.__cause__, "name", None) or "").split(".")[0]
        extra = EXTRAS.get(missing)
        if extra is None:
            raise
        raise missing_extra(f"`pans {point.name}`", missing, extra) from error
    if not isinstance(command, Command):
        raise UsageError(f"entry point {point.value} is a {type(command).__name__}, not a pans.runtime.cli.Command")
    return command


def missing_extra(what: str, package: str, extra: str) -> UsageError:
    """Return the error for a package that `what` needs and that is not installed."""
    return UsageError(
        f"{what} needs the package {package}, which is not installed", remedy=f"pip install 'pans-runtime[{extra}]'"
    )
