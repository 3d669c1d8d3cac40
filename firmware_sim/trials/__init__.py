"""Long checks of the whole system against the simulator, each with a verdict: `pans trials NAME`.

Owns the table of trials, what a trial is and what it returns. A trial is a module with a frozen dataclass of settings, from whose fields
the options of the command line are made, and a function from settings to a `Report`; the module offers both as `TRIAL`. Trials drive
the ordinary host and the ordinary instrument and judge them from outside; never does any other code depend on a trial.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

__all__ = ["TRIALS", "Report", "Trial", "TrialEntry", "load_trial"]


@dataclass(frozen=True, slots=True)
class Report:
    """What a trial found: the JSON object, whether every bar was met, and the same in words for people."""

    figures: Mapping[str, Any]
    passed: bool
    words: str


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial: a frozen dataclass whose fields are options (pans.firmware_sim.options), and what to do with one."""

    settings: type[Any]
    run: Callable[[Any], Report]
    json_to_file: bool = False  # whether `--json` may name a file, beside which the words are printed


class TrialEntry(NamedTuple):
    """One row of the table: the module, relative to this package, what the trial checks, and how long it takes as it stands."""

    module: str
    summary: str
    takes: str


# Times are those of the default settings on two cores of a virtual machine.
TRIALS: Mapping[str, TrialEntry] = {
    "calibration": TrialEntry(".calibration", "many simulated calibrations against their truths", "15 min"),
    "causes": TrialEntry(".causes", "real causes of lateness against the names that the timing verdict gives", "5 min"),
    "clock": TrialEntry(".clock", "the clock model against known crystals and links", "10 s"),
    "dark-counts": TrialEntry(".dark_counts", "the dark-count watch against a simulated detector", "10 min"),
    "fault-grid": TrialEntry(
        ".fault_grid", "whole runs under every fault, compared with what the instrument logged", "10 min"
    ),
    "flow": TrialEntry(".flow", "cells in flow at real pace: which late decisions are the machine's", "10 min"),
    "fuzz": TrialEntry(".fuzz", "strange bytes and frames at decoder, instrument and host", "5 min"),
    "kills": TrialEntry(
        ".kills", "hosts that are killed: the light goes off, and what was acted upon is on record", "3 min"
    ),
    "light-level": TrialEntry(".light_level", "the light watch on simulated decisions", "1 min"),
    "pace": TrialEntry(
        ".pace", "real pace: objects at 1000/s, the demo beside a busy core, automata to 100 kHz", "15 min"
    ),
    "registration": TrialEntry(".registration", "many simulated optical tables against their truths", "5 min"),
    "soak": TrialEntry(".soak", "half an hour of real time with faults on, watched from outside", "30 min"),
}


def load_trial(name: str) -> Trial:
    """Return a trial of the table by name; only its own module is imported.

    >>> sorted(load_trial("clock").settings.__dataclass_fields__)
    ['seconds']
    """
    trial: Trial = importlib.import_module(TRIALS[name].module, __name__).TRIAL
    return trial


def rows_report(rows: Iterable[Mapping[str, Any]], passed: bool, **more: Any) -> Report:
    """Return the report of a trial whose figures are rows: `more` goes beside them into the JSON object."""
    rows = [{key: None if _endless(value) else value for key, value in row.items()} for row in rows]
    return Report({"rows": rows, **more}, passed, figures_text({**more, "rows": rows}))


def _endless(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)  # JSON has no word for it


def figures_text(figures: Mapping[str, Any]) -> str:
    """Return figures for people: a line for each, a line for each row of a list, a table for an object of objects."""
    lines: list[str] = []
    for key, value in figures.items():
        if key == "simulated":
            lines.insert(0, "SIMULATED")
        elif isinstance(value, Mapping) and value and all(isinstance(row, Mapping) for row in value.values()):
            columns = list(next(iter(value.values())))
            lines.append(f"{key:<18}" + "".join(f"{name:>11}" for name in columns))
            lines += [f"  {name:<16}" + "".join(f"{row[one]:>11}" for one in columns) for name, row in value.items()]
        elif isinstance(value, list):
            head = "" if key == "rows" else f"{key}: "
            lines += [head + (row_text(row) if isinstance(row, Mapping) else str(row)) for row in value]
        else:
            lines.append(row_text({key: row_text(value) if isinstance(value, Mapping) else value}))
    return "\n".join(lines)


def row_text(row: Mapping[str, Any]) -> str:
    """Return one row in one line, numbers with five digits."""
    return "  ".join(
        f"{key} {value:.5g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
    )
