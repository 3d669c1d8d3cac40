"""`main`: from the words of the command line to one command's exit code; no error leaves it as a traceback unless asked for."""

from __future__ import annotations

import argparse
import errno
import gc
import os
import shlex
import sys
import threading
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import EntryPoint
from typing import Any

from pans.base import __version__
from pans.base.console import LOGGER, begin, fail, logging_of, missing_extra, note, reading_bar, say, state
from pans.base.errors import EXIT_FINE, EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_USAGE, PansError, UsageError

from .command import Command, did_you_mean, parser_of
from .find_commands import EXTRAS, find_commands, load_command, overview

_REMEDIES = {
    errno.ENOSPC: "make room on that disk, or choose another one",
    errno.EACCES: "check the permissions of that path, or choose another one",
    errno.EPERM: "check the permissions of that path, or choose another one",
    errno.EROFS: "choose a place that can be written to",
    errno.ENOENT: "check the path",
    errno.EMFILE: "raise the limit of open files: ulimit -n 4096",
}
FIRST_AFTER_S = 0.2
LOOK_EVERY_S = 0.05
LOOK_FOR_S = 60.0  # a command that has not loaded numba by then does not wait for it
COMPILING = "compiling kernels: once per machine and version, about 10 s (pans doctor --warm compiles all)"
_listening: list[Any] = []  # numba keeps listeners for good: one per process


def main(argv: Sequence[str] | None = None) -> int:
    """Run `pans` with `argv` (default: the process's arguments) and return the exit code of the contract."""
    words = list(sys.argv[1:] if argv is None else argv)
    with suppress(AttributeError, ValueError):  # a terminal of ASCII alone gets the rest as escapes, as on stderr
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    begin(words)
    if argv is None:
        with _frozen():
            return _main(words)
    return _main(words)


@contextmanager
def _frozen() -> Iterator[None]:
    """Keep the garbage collector from what is loaded: to look through numba takes 50 ms, also when the process ends."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()


def _main(words: list[str]) -> int:
    try:
        code = _run(words)
    except KeyboardInterrupt as interrupt:
        # a signal's handler says which signal it was
        return fail(PansError(str(interrupt) or "interrupted"), EXIT_INTERRUPTED)
    except BrokenPipeError:
        _silence()  # the reader of our output went away: nothing more can be said to it
        return EXIT_FINE
    except Exception as error:
        if "--debug" in words:
            raise
        known = _known(error)
        if not state.answered and isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
            _silence()  # stdout itself is full: an error of a file names the file
        return fail(known, known.exit_code) if known is not None else fail(_internal(error), EXIT_INTERNAL)
    if code == EXIT_INTERRUPTED and "--json" in words and not state.answered:
        fail(PansError("interrupted"), code)
    return code


def _run(words: list[str]) -> int:
    commands = find_commands()
    wanted = next((word for word in words if not word.startswith("-")), None)
    if wanted == "help":
        return _help(words, commands)
    if wanted is None or wanted not in commands:
        return _top_level(words, wanted, commands)
    rest = list(words)
    rest.remove(wanted)
    with _first_sign(f"pans {wanted}: loading ..."):
        command = load_command(commands[wanted])
        if not gc.isenabled():
            gc.freeze()
            gc.enable()
        parser = parser_of(wanted, command)
        if command.prepare is not None:
            rest = command.prepare(parser, rest)
        args = parser.parse_args(rest)
        with logging_of(args):
            note(f"pans {__version__}: {wanted} is {commands[wanted].value}")
            return _logged(command, args, words)


def _logged(command: Command, args: argparse.Namespace, words: Sequence[str]) -> int:
    """Run the command; its log has the words at the begin, and at the end the exit code or the error."""
    LOGGER.info("begins: %s", shlex.join(["pans", *words]))
    try:
        with reading_bar():
            code = command.run(args)
    except KeyboardInterrupt as interrupt:
        LOGGER.warning("ends: %s", str(interrupt) or "interrupted")
        raise
    except BaseException as error:
        LOGGER.error("ends by an error: %s: %s", type(error).__name__, error)
        raise
    LOGGER.info("ends with exit code %d", code)
    return code


def _help(words: list[str], commands: Mapping[str, EntryPoint]) -> int:
    """`pans help [COMMAND [NAME]]`: what `pans COMMAND [NAME] --help` prints."""
    rest = [word for word in words if not word.startswith("-")][1:]
    return _run([*rest, "--help"]) if rest else _top_level([], None, commands)


def _top_level(words: Sequence[str], wanted: str | None, commands: Mapping[str, EntryPoint]) -> int:
    if wanted is not None:
        remedy = f"{did_you_mean(wanted, commands)}`pans` lists the commands"
        return fail(UsageError(f"unknown command {wanted!r}", remedy=remedy), EXIT_USAGE)
    if {"--version", "-V"} & {*words}:
        print(f"pans {__version__}")
        return EXIT_FINE
    unknown = next((word for word in words if word not in _WITHOUT_COMMAND), None)
    if unknown is not None:
        remedy = "name a command first: `pans` lists them"
        return fail(UsageError(f"unknown option {unknown!r}", remedy=remedy), EXIT_USAGE)
    print(overview(commands))
    return EXIT_FINE


_WITHOUT_COMMAND = {"-h", "--help", "--json", "--debug", "-q", "--quiet", "-v", "--verbose"}


def _known(error: Exception) -> PansError | None:
    """Return the error that a user can do something about, None for a fault of pans."""
    if isinstance(error, PansError):
        return error
    if isinstance(error, OSError) and error.errno is not None:
        where = f"{os.fsdecode(error.filename)}: " if isinstance(error.filename, str | bytes) else ""
        remedy = _REMEDIES.get(error.errno, "check the path and the disk")
        return UsageError(f"{where}{error.strerror or error}", remedy=remedy)
    if isinstance(error, MemoryError):
        return UsageError(f"there is not enough memory: {error}".removesuffix(": "), remedy="ask for less at once")
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("pans"):
        package = error.name.partition(".")[0]
        return missing_extra("this", package, EXTRAS[package]) if package in EXTRAS else None
    return None


def _internal(error: Exception) -> PansError:
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{os.path.basename(last.filename)}:{last.lineno}"
    return PansError(
        f"internal error: {type(error).__name__}: {error} ({place})",
        remedy="this is a fault of pans: report it with what the same command prints with --debug",
    )


def _silence() -> None:
    """Point stdout to nowhere, so that what it still holds makes no error when the process ends."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


@contextmanager
def _first_sign(text: str) -> Iterator[None]:
    """Print `text` unless something else is printed soon; say so when kernels are compiled within the block."""
    ended = threading.Event()
    threading.Thread(target=_look, args=(text, ended), name="pans-first-sign", daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _look(text: str, ended: threading.Event) -> None:
    said, looked_s = False, 0.0
    while not (said and _listening) and looked_s < LOOK_FOR_S and not ended.wait(LOOK_EVERY_S):
        looked_s += LOOK_EVERY_S
        if not said and (state.said or looked_s >= FIRST_AFTER_S):
            if not state.said:
                say(text)
            said = True
        if not _listening and "numba.core.dispatcher" in sys.modules:
            _listen()


def _listen() -> None:
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        """Reports the first compilation only; kernels in the cache make no event."""

        said = False

        def on_start(self, event: Any) -> None:
            if not self.said:
                self.said = True
                say(COMPILING)

        def on_end(self, event: Any) -> None:
            pass

    with suppress(AttributeError, ImportError):  # another numba: it compiles without being announced
        _listening.append(Listener())
        event.register("numba:compile", _listening[-1])
