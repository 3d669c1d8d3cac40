"""`pans trials` and `pans fuzz`: long checks with a verdict, found in the table of pans.firmware_sim.trials.

Owns the options, made from a trial's settings, and the exit code: 0 when every bar was met, 1 when one was missed. Only the module of
the trial that is run is imported.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pans.firmware_sim.options import add_options, settings_from
from pans.firmware_sim.trials import TRIALS, load_trial
from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, add_force, emit
from pans.runtime.cli.command import CommandParser
from pans.runtime.errors import PansError
from pans.runtime.outputs import check_outputs, write_file


def run_trial(name: str, args: argparse.Namespace) -> int:
    """Run the trial `name` with the options in `args`, print its report and return the exit code."""
    trial = load_trial(name)
    if isinstance(args.json, Path):
        check_outputs([args.json], force=args.force)
    try:
        report = trial.run(settings_from(args, trial.settings))
    except RuntimeError as error:  # a process of the trial did not do its part: nothing was measured
        raise PansError(f"{name}: {error}") from error
    if isinstance(args.json, Path):
        write_file(args.json, (json.dumps(report.figures) + "\n").encode(), force=args.force)
        args.json = False
    emit(args, report.figures, report.words)
    return EXIT_FINE if report.passed else EXIT_ALERT


class _TrialParser(CommandParser):
    """The parser of one trial; its module is imported when its options are asked for."""

    name = ""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        trial = load_trial(self.name)
        add_options(self, trial.settings)
        to_file = {"nargs": "?", "type": Path, "const": True, "metavar": "FILE"}
        json_words: dict[str, Any] = to_file if trial.json_to_file else {"action": "store_true"}
        where = "to FILE, or on stdout" if trial.json_to_file else "on stdout"
        self.add_argument("--json", default=argparse.SUPPRESS, help=f"write one JSON object {where}", **json_words)
        if trial.json_to_file:
            add_force(self)
        self.add_argument(
            "--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error"
        )
        return super().parse_known_args(args, namespace)


def _configure(parser: argparse.ArgumentParser) -> None:
    chosen = parser.add_subparsers(dest="name", metavar="NAME", parser_class=_TrialParser)
    for name, entry in TRIALS.items():
        chosen.add_parser(name, help=f"{entry.summary} ({entry.takes})", description=entry.summary).name = name


def _run(args: argparse.Namespace) -> int:
    if args.name is not None:
        return run_trial(args.name, args)
    rows = [{"name": name, "summary": entry.summary, "takes": entry.takes} for name, entry in TRIALS.items()]
    text = "\n".join(f"  {row['name']:<12} {row['takes']:<8} {row['summary']}" for row in rows)
    emit(
        args,
        {"rows": rows},
        f"{text}\n\n`pans trials NAME --help` lists a trial's options; each ends with 1 when a bar is missed.",
    )
    return EXIT_FINE


def _configure_fuzz(parser: argparse.ArgumentParser) -> None:
    add_options(parser, load_trial("fuzz").settings)


TRIALS_COMMAND = Command(
    "run a long check of the whole system; without a name, list them",
    _configure,
    _run,
    examples=(
        "pans trials",
        "pans trials clock --seconds 2",
    ),
)
FUZZ = Command(
    TRIALS["fuzz"].summary,
    _configure_fuzz,
    lambda args: run_trial("fuzz", args),
    examples=("pans fuzz --frames 200 --bytes 20000",),
)
