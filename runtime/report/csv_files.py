"""A recording as CSV files, units in the headers, a data dictionary and a JSON file about them."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from pans.runtime.core.plan import Plan
from pans.runtime.errors import UsageError
from pans.runtime.outputs import make_folder, write_file
from pans.runtime.record import Recording
from pans.runtime.record.exposures import ClickList
from pans.runtime.record.tables import (
    CLICKS,
    DECISIONS,
    TIMINGS,
    Table,
    click_table,
    iter_decisions,
    tick_us,
    timing_table,
)
from pans.runtime.safe_text import csv_cell

TABLES = {"decisions.csv": DECISIONS, "clicks.csv": CLICKS, "timings.csv": TIMINGS}
FILES = (*TABLES, "columns.csv", "about.json")


def write_csv(folder: Path, recording: Recording, plan: Plan, clicks: ClickList, *, force: bool = False) -> list[Path]:
    """Write the tables, their dictionary columns.csv and about.json into `folder`; return their paths. UsageError where it is a file."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", remedy="name a folder: csv is several files")
    make_folder(folder)
    tables = {
        "decisions.csv": _csv(DECISIONS, iter_decisions(recording, plan)),
        "clicks.csv": _csv(CLICKS, [click_table(recording, plan, clicks)]),
        "timings.csv": _csv(TIMINGS, map(timing_table, recording.iter_timings())),
        "columns.csv": dictionary(),
    }
    about = {
        "recording": recording.path.name,
        "simulated": recording.simulated,
        "complete": recording.complete,
        "exposure_us": plan.exposure_us,
        "tick_us": tick_us(recording),
        "exposures": clicks.exposures,
        "time_zero": "the begin of the first recorded exposure",
        "decisions_sha256": recording.decisions_sha256,
        "header": {key: value for key, value in recording.header.items() if key != "profile"},
        "events": list(recording.events()),
    }
    files = tables | {"about.json": json.dumps(about, indent=1, sort_keys=True) + "\n"}
    for name, text in files.items():
        write_file(folder / name, text.encode(), force=force)
    return [folder / name for name in files]


def dictionary() -> str:
    """Return columns.csv: every column of every table with its unit, its type, what it means, and what an empty cell means."""
    rows = (
        (file, name, column.unit, column.dtype, column.meaning, column.missing)
        for file, columns in TABLES.items()
        for name, column in columns.items()
    )
    return _text(("file", "column", "unit", "dtype", "meaning", "empty_means"), rows)


def _csv(columns: Mapping[str, object], blocks: Iterable[Table]) -> str:
    return _text(tuple(columns), chain.from_iterable(map(_rows, blocks)))


def _rows(table: Table) -> Iterator[tuple[Any, ...]]:
    """The rows of a table; masked values are None, which the writer leaves empty."""
    return zip(*([csv_cell(value) for value in column.tolist()] for column in table.values()))


def _text(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([head])
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
