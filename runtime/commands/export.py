"""`pans export`: a recording for other tools, as CSV or as Photon-HDF5.

Owns the command; the files are csv_files.py's and photon_hdf5.py's. Never changes or judges a recording; a cut one
is exported as far as it goes, and the answer says so.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pans.runtime.cli import EXIT_FINE, Command, emit
from pans.runtime.record import read_recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.report.csv_files import write_csv

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
        written = write_csv(args.out, recording, plan, clicks)
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
        "simulated": recording.simulated,
    }
    banner = "SIMULATED: " if payload["simulated"] else ""
    names = ", ".join(payload["files"])
    emit(args, payload, f"{banner}{payload['decisions']} decisions, {payload['clicks']} clicks in {names}")
    return EXIT_FINE


EXPORT = Command("write a recording as CSV or Photon-HDF5, for other tools", _configure, _run)
