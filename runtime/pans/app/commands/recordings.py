"""The commands on recordings: `pans replay`, `pans export`, `pans report`, `pans compare`; export and report accept bundles too.

A cut recording is exported as far as it goes, and the answer says so.
"""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pans.app.command import Command, add_force
from pans.base.console import emit
from pans.base.errors import EXIT_ALERT, EXIT_FINE, UsageError
from pans.base.files import check_outputs, make_folder, write_file
from pans.bundle.making import about, array_parts, head_with_facts, pattern_pngs
from pans.bundle.sensor import Bundle, load_bundle
from pans.record.reading import (
    Recording,
    click_list,
    earlier_parts,
    is_of_parts,
    open_recording,
    parts_in,
    read_recording,
    recorded_plan,
)
from pans.record.replay import PictureLog, Replayed, replay
from pans.record.tables import FILES, need_pyarrow, write_csv, write_decisions, write_photon_hdf5
from pans.report.files import file_kind
from pans.report.summary import exposure_fault, lines_of, rows_of

from .runs import runs_in

OF_RECORDINGS = ("csv", "photon-hdf5", "parquet")
OF_BUNDLES = ("onnx", "npy", "png")
FORMATS = (*OF_RECORDINGS, *OF_BUNDLES)


def _configure_replay(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("recording", type=Path, help="a recording (.pansrec), or a folder with one in parts")
    add("--bundle", type=Path, help="decide with this bundle instead of the recorded one")
    add("--pictures", type=Path, metavar="OUT.npz", help="write the pictures that the head returns")
    truth = "compare these pictures with the scene's images (SSIM, squared error)"
    add("--truth", type=Path, metavar="SCENE.npz", help=truth)
    add_force(parser)


def _replay(args: argparse.Namespace) -> int:
    if args.pictures is not None:
        check_outputs([args.pictures], inputs=[args.recording, args.bundle, args.truth], force=args.force)
    of_parts, pictures = is_of_parts(args.recording), PictureLog() if args.pictures or args.truth else None
    if of_parts and pictures is not None:
        raise UsageError("--pictures and --truth take one recording", remedy="name one of its parts")
    rows: list[dict[str, Any]] = []
    lines: list[str] = []
    for path in parts_in(args.recording) if of_parts else [args.recording]:
        recording = read_recording(path)
        bundle = load_bundle(args.bundle)[0] if args.bundle else recording.bundle()
        found = replay(recording, bundle, pictures)
        rows.append({"decisions": found.decisions, "sha256": found.sha256, **_facts(recording, found)})
        of_one = f"{found.decisions} decisions, SHA-256 {found.sha256}"
        head = f"{path.name}: {found.decisions} decisions" if of_parts else of_one
        lines += [
            f"{head}: {_agreement_words(recording, found)}",
            *([] if found.passages is None else lines_of(rows_of(found.passages.as_json(), "flow"))),
            *([f"  fault         {fault}"] if (fault := exposure_fault(found.exposure_timing)) else []),
        ]
        if of_parts:
            rows[-1]["part"] = path.name
        else:
            rows[-1]["recorded_sha256"] = recording.decisions_sha256
    identical, payload = all(row["identical"] for row in rows), rows[0] if rows else {}
    if of_parts:
        payload = {"decisions": sum(row["decisions"] for row in rows), "identical": identical, "parts": rows}
    if pictures is not None and args.pictures:
        pictures.write(args.pictures, force=args.force)
    if pictures is not None and args.truth:
        payload |= pictures.compare(args.truth)
    emit(args, payload, "\n".join(lines))
    return EXIT_FINE if identical else EXIT_ALERT


def _facts(recording: Recording, found: Replayed) -> dict[str, Any]:
    return {
        "identical": found.as_recorded,
        "complete": recording.complete,
        "decisions_recorded": found.recorded,
        "decisions_more": found.more,
        "contradictions": found.contradictions,
        "exposure_timing": found.exposure_timing,
        **({} if found.passages is None else found.passages.as_json()),
    }


def _agreement_words(recording: Recording, found: Replayed) -> str:
    if not found.as_recorded:
        return f"DIFFERENT from the recorded log ({found.recorded} decisions)"
    if recording.complete:
        return "identical"
    more = f", {found.more} more can be decided" if found.more else ""
    return f"identical as far as recorded: {found.recorded} of {found.recorded}{more}"


REPLAY = Command(
    "recompute a recording's decisions and compare",
    _configure_replay,
    _replay,
    examples=("pans replay pans-runs/latest/run.pansrec", "pans replay run.pansrec --bundle other.pans"),
)


def _configure_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="FILE", help="a recording (file, or folder of its parts), or a bundle"
    )
    form = "of a recording: csv (a folder), photon-hdf5, parquet (decisions); of a bundle: onnx, npy or png (a folder)"
    parser.add_argument("--format", required=True, choices=FORMATS, help=form)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="OUT", help="the folder, or the file")
    add_force(parser)


def _export(args: argparse.Namespace) -> int:
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
        write_decisions(args.out, recording, plan, force=args.force)
    else:
        write_photon_hdf5(args.out, recording, plan, clicks, force=args.force)
    payload = {
        "format": args.format,
        "files": [str(path) for path in written],
        "decisions": recording.n_decisions,
        "clicks": len(clicks.start_tick),
        "exposures": clicks.exposures,
        "complete": recording.complete,
        "earlier_parts": earlier_parts(recording),
        "simulated": recording.simulated,
    }
    banner = "SIMULATED: " if payload["simulated"] else ""
    found = f"{banner}{payload['decisions']} decisions, {payload['clicks']} clicks in {', '.join(payload['files'])}"
    emit(args, payload, f"{found}\nwithout {payload['earlier_parts']}" if payload["earlier_parts"] else found)
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
    emit(args, payload, f"{bundle.name}: {f'{len(files)} files in ' * is_folder}{args.out}")
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
    _configure_export,
    _export,
    (
        "pans export run.pansrec --format csv -o tables",
        "pans export run.pansrec --format parquet -o decisions.parquet",
        "pans export fashion10.pans --format onnx -o head.onnx",
    ),
)


def _configure_report(parser: argparse.ArgumentParser) -> None:
    what = "a recording, a bundle, a calibration, a registration, or a folder of runs"
    parser.add_argument("path", type=Path, metavar="FILE", help=what)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.html", help="the page to write")
    add_force(parser)


def _report(args: argparse.Namespace) -> int:
    check_outputs([args.out], inputs=[args.path], force=args.force)
    from pans.report.pages import need_extra, page_of

    need_extra()
    if args.path.is_dir() and not any(args.path.glob("*.pansrec")):
        from pans.report.pages import index_page

        if not (runs := runs_in(args.path)):
            raise UsageError(f"{args.path}: no runs are in this folder", remedy="name a folder of runs, as pans-runs")
        kind, page = "runs", index_page(args.path, runs, args.out.resolve().parent)
    else:
        kind, page = file_kind(args.path), page_of(args.path)
    write_file(args.out, page, force=args.force)
    emit(args, {"report": str(args.out), "kind": kind, "bytes": len(page)}, str(args.out))
    return EXIT_FINE


REPORT = Command(
    "one self-contained page of a run, a bundle, or a folder of runs",
    _configure_report,
    _report,
    examples=("pans report pans-runs/latest/run.pansrec -o run.html", "pans report pans-runs -o runs.html"),
)


def _configure_compare(parser: argparse.ArgumentParser) -> None:
    side = "a run's folder, a recording (.pansrec), or a summary as `pans run --json` prints it (.json)"
    for name, metavar in (("first", "A"), ("second", "B")):
        parser.add_argument(name, type=Path, metavar=metavar, help=side)
    same = "whether objects of the same number are the same (default auto: of the same simulated scene)"
    parser.add_argument("--objects", default="auto", choices=("auto", "same", "different"), help=same)
    parser.add_argument("-o", "--out", type=Path, metavar="OUT.html", help="also write a page")
    add_force(parser)


def _compare(args: argparse.Namespace) -> int:
    from pans.report.pages import need_extra

    if args.out is not None:
        check_outputs([args.out], inputs=[args.first, args.second], force=args.force)
        need_extra()
    from pans.report.compare import compare, comparison_page, comparison_words, read_side

    found = compare(read_side(args.first), read_side(args.second), args.objects)
    if args.out is not None:
        write_file(args.out, comparison_page(found), force=args.force)
    report = {"report": None if args.out is None else str(args.out)}
    emit(args, found.as_json() | report, comparison_words(found))
    return EXIT_FINE


COMPARE = Command(
    "compare two runs: what changed, and is it significant",
    _configure_compare,
    _compare,
    examples=("pans compare pans-runs/2026-11-22T1412-fashion10 pans-runs/latest -o compared.html",),
)
