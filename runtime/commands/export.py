"""`pans export`: a recording or a bundle for other tools: CSV, Photon-HDF5, Parquet; ONNX, NumPy arrays, PNG pictures.

A cut recording is exported as far as it goes, and the answer says so.
"""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.cli import EXIT_FINE, Command, add_force, emit
from pans.runtime.errors import UsageError
from pans.runtime.operate.parquet import need_pyarrow, write_decisions
from pans.runtime.operate.pattern_files import about, array_parts, head_with_facts, pattern_pngs
from pans.runtime.outputs import check_outputs, make_folder, write_file
from pans.runtime.record.exposures import click_list
from pans.runtime.record.parts import open_recording
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.report.csv_files import FILES, write_csv
from pans.runtime.report.verify import file_kind

OF_RECORDINGS = ("csv", "photon-hdf5", "parquet")
OF_BUNDLES = ("onnx", "npy", "png")
FORMATS = (*OF_RECORDINGS, *OF_BUNDLES)


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="FILE", help="a recording (file, folder or index of its parts), or a bundle"
    )
    parser.add_argument(
        "--format",
        required=True,
        choices=FORMATS,
        help="of a recording: csv (a folder), photon-hdf5, parquet (decisions); of a bundle: onnx, npy or png (a folder)",
    )
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT", help="the folder, or the file")
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    if args.format in OF_BUNDLES:
        return _export_bundle(args)
    is_folder = args.format == "csv"
    outputs = [args.out / name for name in FILES] if is_folder else [args.out]
    check_outputs(outputs, inputs=[args.recording], force=args.force, makes_folders=is_folder)
    if args.format == "parquet":
        need_pyarrow()
    recording = open_recording(args.recording)
    plan = recorded_plan(recording)
    clicks = click_list(recording, plan)
    written = [args.out]
    if is_folder:
        written = write_csv(args.out, recording, plan, clicks, force=args.force)
    elif args.format == "parquet":
        write_decisions(args.out, recording, force=args.force)
    else:
        from pans.runtime.report.photon_hdf5 import write_photon_hdf5

        write_photon_hdf5(args.out, recording, plan, clicks, force=args.force)
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


def _export_bundle(args: argparse.Namespace) -> int:
    is_folder, inputs = args.format != "onnx", [args.recording]
    if file_kind(args.recording) != "bundle":
        remedy = f"a recording goes to {', '.join(OF_RECORDINGS)}"
        raise UsageError(f"{args.recording}: --format {args.format} is for bundles", remedy=remedy)
    first = args.out / "about.json" if is_folder else args.out
    check_outputs([first], inputs=inputs, force=args.force, makes_folders=is_folder)
    bundle, digest = load_bundle(args.recording)
    files = dict(_bundle_files(bundle, args.format, args.out))
    check_outputs(files, inputs=inputs, force=args.force, makes_folders=True)
    if is_folder:
        make_folder(args.out)
    for path, data in files.items():
        write_file(path, data, force=args.force)
    payload = {"format": args.format, "files": [str(path) for path in files], "sha256": digest, **about(bundle)}
    emit(
        args, payload, f"{bundle.name}: {len(files)} files in {args.out}" if is_folder else f"{bundle.name}: {args.out}"
    )
    return EXIT_FINE


def _bundle_files(bundle: Bundle, form: str, out: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield paths and contents; of a folder about.json comes last."""
    if form == "onnx":
        yield out, head_with_facts(bundle)
        return
    if form == "png":
        yield from ((out / name, data) for name, data in pattern_pngs(bundle))
    else:
        for name, array in array_parts(bundle):
            stream = io.BytesIO()
            np.save(stream, array, allow_pickle=False)
            yield out / name, stream.getvalue()
        if bundle.head_onnx is not None:
            yield out / "head.onnx", head_with_facts(bundle)
    yield out / "about.json", (json.dumps(about(bundle), indent=1, sort_keys=True) + "\n").encode()


EXPORT = Command(
    "write a recording or a bundle in a format of other tools",
    _configure,
    _run,
    (
        "pans export run.pansrec --format csv -o tables",
        "pans export run.pansrec --format parquet -o decisions.parquet",
        "pans export fashion10.pans --format onnx -o head.onnx",
    ),
)
