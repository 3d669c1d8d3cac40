"""A recording as CSV files, units in the headers, and a JSON file about them."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.core.plan import Plan
from pans.runtime.errors import UsageError
from pans.runtime.outputs import make_folder, write_file
from pans.runtime.record import Recording
from pans.runtime.record.exposures import ClickList, is_dark
from pans.runtime.safe_text import csv_cell

DECISIONS = (
    *("decision", "tick", "time_us", "exposure", "object", "first_shot", "clicks", "label", "class"),
    *("truth", "probability", "flags", "flag_names", "exposures"),
)
CLICKS = (
    *("exposure_start_tick", "exposure_start_us", "exposure", "object", "channel", "pattern", "dark_slot", "stream"),
    "state",
)
FILES = ("decisions.csv", "clicks.csv", "timings.csv", "about.json")
TIMINGS = ("decision", "device_end_ns", "arrival_ns", "decided_ns", "recorded_ns", "end_to_decided_us")


def write_csv(folder: Path, recording: Recording, plan: Plan, clicks: ClickList, *, force: bool = False) -> list[Path]:
    """Write decisions, clicks, timings and about.json into `folder`; return their paths. UsageError where `folder` is a file."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", remedy="name a folder: csv is several files")
    make_folder(folder)
    us = 1e6 / int(recording.header["config"]["tick_hz"])
    classes = recording.bundle().classes if recording.bundle_place else ()
    tables: dict[str, tuple[Sequence[str], Iterable[Sequence[Any]]]] = {
        "decisions.csv": (
            DECISIONS,
            (_decision_row(row, clicks.first_tick, us, classes) for row in recording.decisions()),
        ),
        "clicks.csv": _click_table(clicks, us, plan),
        "timings.csv": (TIMINGS, (_timing_row(row) for row in recording.timings())),
    }
    written = []
    for name, (head, rows) in tables.items():
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)
        write_file(folder / name, text.getvalue().encode(), force=force)
        written.append(folder / name)
    about = {
        "recording": recording.path.name,
        "simulated": recording.simulated,
        "complete": recording.complete,
        "exposure_us": plan.exposure_us,
        "tick_us": us,
        "exposures": clicks.exposures,
        "time_zero": "the begin of the first recorded exposure",
        "decisions_sha256": recording.decisions_sha256,
        "header": {key: value for key, value in recording.header.items() if key != "profile"},
        "events": list(recording.events()),
    }
    write_file(folder / "about.json", (json.dumps(about, indent=1, sort_keys=True) + "\n").encode(), force=force)
    return [*written, folder / "about.json"]


def _decision_row(row: Any, first_tick: int, us: float, classes: tuple[str, ...]) -> list[Any]:
    label, flags = int(row["label"]), DecisionFlag(int(row["flags"]))
    known = label != NO_LABEL
    return [
        *(int(row["index"]), int(row["tick"]), f"{(int(row['tick']) - first_tick) * us:.3f}"),
        *(int(row[name]) for name in ("exposure_index", "object", "shot", "clicks")),
        label if known else "",
        csv_cell(classes[label]) if known and label < len(classes) else "",
        int(row["truth"]) if row["truth"] >= 0 else "",
        repr(float(row["probability"])) if known else "",
        *(int(flags), "|".join(str(flag.name) for flag in flags)),
        int(row["exposures"]) or "",
    ]


def _click_table(clicks: ClickList, us: float, plan: Plan) -> tuple[Sequence[str], Iterable[Sequence[Any]]]:
    """Heads and rows of clicks.csv; those of a detector that counts have their photons too."""
    rows = _click_rows(clicks, us, walks=plan.automaton is not None)
    if plan.largest == 1 or plan.channels_at_once > 1:
        return CLICKS, rows
    return (*CLICKS, "photons"), ((*row, number) for row, number in zip(rows, clicks.photons.tolist()))


def _click_rows(clicks: ClickList, us: float, *, walks: bool) -> Iterable[Sequence[Any]]:
    dark = is_dark(clicks.pattern)
    pattern = [("" if unlit else str(shown)) for shown, unlit in zip(clicks.pattern.tolist(), dark.tolist())]
    since = [f"{value * us:.3f}" for value in (clicks.start_tick - clicks.first_tick).tolist()]
    numbers = (column.tolist() for column in (clicks.exposure, clicks.object, clicks.channel))
    unlit = dark.tolist()
    state = [str(state) if walks and not off else "" for state, off in zip(clicks.state.tolist(), unlit)]
    streams = clicks.stream.tolist()
    return zip(clicks.start_tick.tolist(), since, *numbers, pattern, dark.astype(int).tolist(), streams, state)


def _timing_row(row: Any) -> list[Any]:
    values = [int(row[name]) for name in ("index", "device_end_ns", "arrival_ns", "decided_ns", "recorded_ns")]
    return [*values, f"{(values[3] - values[1]) / 1000:.3f}"]
