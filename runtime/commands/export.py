"""`pans export`: a recording for other tools, as CSV or as Photon-HDF5.

Owns the command and the CSV files (units in the headers); Photon-HDF5 is in export_hdf5.py. Never changes or judges a recording; a cut one
is exported as far as it goes, and the answer says so.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.cli import EXIT_FINE, Command, emit
from pans.runtime.container import replace_file
from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.core.plan import Plan
from pans.runtime.errors import UsageError
from pans.runtime.record import Recording, read_recording
from pans.runtime.record.exposures import ClickList, click_list, is_dark
from pans.runtime.record.sent_plan import recorded_plan

FORMATS = ("csv", "photon-hdf5")


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="FILE", help="a recording (.pansrec)")
    parser.add_argument(
        "--format", required=True, choices=FORMATS, help="csv: a folder of files; photon-hdf5: one file"
    )
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT", help="the folder, or the file")


def _run(args: argparse.Namespace) -> int:
    recording = read_recording(args.recording)
    plan = recorded_plan(recording)
    clicks = click_list(recording, plan)
    if args.format == "csv":
        written = _write_csv(args.out, recording, plan, clicks)
    else:
        from pans.runtime.report.photon_hdf5 import write_photon_hdf5

        write_photon_hdf5(args.out, recording, plan, clicks)
        written = [args.out]
    payload = {
        "format": args.format,
        "files": [str(path) for path in written],
        "decisions": recording.n_decisions,
        "clicks": len(clicks.start_tick),
        "exposures": clicks.exposures,
        "complete": recording.complete,
        "simulated": recording.header.get("simulated"),
    }
    banner = "SIMULATED: " if payload["simulated"] else ""
    names = ", ".join(payload["files"])
    emit(args, payload, f"{banner}{payload['decisions']} decisions, {payload['clicks']} clicks in {names}")
    return EXIT_FINE


def _write_csv(folder: Path, recording: Recording, plan: Plan, clicks: ClickList) -> list[Path]:
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", remedy="name a folder: csv is several files")
    folder.mkdir(parents=True, exist_ok=True)
    us = 1e6 / int(recording.header["config"]["tick_hz"])
    classes = _classes(recording)
    tables: dict[str, tuple[Sequence[str], Iterable[Sequence[Any]]]] = {
        "decisions.csv": (
            (
                *("decision", "tick", "time_us", "exposure", "object", "first_shot", "clicks", "label", "class"),
                *("truth", "probability", "flags", "flag_names"),
            ),
            (_decision_row(row, clicks.first_tick, us, classes) for row in recording.decisions()),
        ),
        "clicks.csv": (
            (
                "exposure_start_tick",
                "exposure_start_us",
                "exposure",
                "object",
                "channel",
                "pattern",
                "dark_slot",
                "stream",
            ),
            _click_rows(clicks, us),
        ),
        "timings.csv": (
            ("decision", "device_end_ns", "arrival_ns", "decided_ns", "recorded_ns", "end_to_decided_us"),
            (_timing_row(row) for row in recording.timings()),
        ),
    }
    written = []
    for name, (head, rows) in tables.items():
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)
        replace_file(folder / name, text.getvalue().encode())
        written.append(folder / name)
    about = {
        "recording": recording.path.name,
        "simulated": recording.header.get("simulated"),
        "complete": recording.complete,
        "exposure_us": plan.exposure_us,
        "tick_us": us,
        "exposures": clicks.exposures,
        "time_zero": "the begin of the first recorded exposure",
        "decisions_sha256": recording.decisions_sha256,
        "header": {key: value for key, value in recording.header.items() if key != "profile"},
        "events": list(recording.events()),
    }
    replace_file(folder / "about.json", (json.dumps(about, indent=1, sort_keys=True) + "\n").encode())
    return [*written, folder / "about.json"]


def _classes(recording: Recording) -> tuple[str, ...]:
    data: Bundle | None = recording.bundle() if recording.bundle_data() else None
    return () if data is None else data.classes


def _decision_row(row: Any, first_tick: int, us: float, classes: tuple[str, ...]) -> list[Any]:
    label, flags = int(row["label"]), DecisionFlag(int(row["flags"]))
    known = label != NO_LABEL
    return [
        *(
            int(row["index"]),
            int(row["tick"]),
            f"{(int(row['tick']) - first_tick) * us:.3f}",
            int(row["exposure_index"]),
        ),
        *(int(row["object"]), int(row["shot"]), int(row["clicks"]), label if known else ""),
        classes[label] if known and label < len(classes) else "",
        int(row["truth"]) if row["truth"] >= 0 else "",
        repr(float(row["probability"])) if known else "",
        *(int(flags), "|".join(str(flag.name) for flag in flags)),
    ]


def _click_rows(clicks: ClickList, us: float) -> Iterable[Sequence[Any]]:
    dark = is_dark(clicks.pattern)
    pattern = [("" if unlit else str(shown)) for shown, unlit in zip(clicks.pattern.tolist(), dark.tolist())]
    since = [f"{value * us:.3f}" for value in (clicks.start_tick - clicks.first_tick).tolist()]
    lists = (
        clicks.start_tick.tolist(),
        since,
        clicks.exposure.tolist(),
        clicks.object.tolist(),
        clicks.channel.tolist(),
    )
    return zip(*lists, pattern, dark.astype(int).tolist(), clicks.stream.tolist())


def _timing_row(row: Any) -> list[Any]:
    values = [int(row[name]) for name in ("index", "device_end_ns", "arrival_ns", "decided_ns", "recorded_ns")]
    return [*values, f"{(values[3] - values[1]) / 1000:.3f}"]


EXPORT = Command("write a recording as CSV or Photon-HDF5, for other tools", _configure, _run)
