"""`pans export`: a recording for other tools, as CSV or as Photon-HDF5.

Owns the command; the files are csv_files.py's and photon_hdf5.py's. Never changes or judges a recording; a cut one
is exported as far as it goes, and the answer says so.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pans.runtime.cli import EXIT_FINE, Command, add_force, emit
from pans.runtime.outputs import check_outputs
from pans.runtime.record import read_recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.report.csv_files import FILES, write_csv

FORMATS = ("csv", "photon-hdf5")


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="FILE", help="a recording (.pansrec)")
    parser.add_argument(
        "--format", required=True, choices=FORMATS, help="csv: a folder of files; photon-hdf5: one file"
    )
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT", help="the folder, or the file")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    is_folder = args.format == "csv"
    outputs = [args.out / name for name in FILES] if is_folder else [args.out]
    check_outputs(outputs, inputs=[args.recording], force=args.force, makes_folders=is_folder)
    recording = read_recording(args.recording)
    plan = recorded_plan(recording)
    clicks = click_list(recording, plan)
    if is_folder:
        written = write_csv(args.out, recording, plan, clicks, force=args.force)
    else:
        from pans.runtime.report.photon_hdf5 import write_photon_hdf5

        write_photon_hdf5(args.out, recording, plan, clicks, force=args.force)
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
