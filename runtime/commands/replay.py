"""`pans replay`: recompute a recording's decisions from its raw messages and compare the logs by hash (record/replaying.py)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, add_force, emit
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs

if TYPE_CHECKING:  # `pans replay --help` loads no kernels
    from pans.runtime.record import Recording
    from pans.runtime.record.pictures import PictureLog
    from pans.runtime.record.replaying import Replayed


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, help="a recording (.pansrec), a folder with one in parts, or the index of its parts"
    )
    parser.add_argument("--bundle", type=Path, help="decide with this bundle instead of the recorded one")
    parser.add_argument("--pictures", type=Path, metavar="OUT.npz", help="write the pictures that the head returns")
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="SCENE.npz",
        help="compare these pictures with the scene's images (SSIM, squared error)",
    )
    add_force(parser)


def _run(args: argparse.Namespace) -> int:
    from pans.runtime.record.part_names import is_of_parts, parts_in
    from pans.runtime.record.pictures import PictureLog

    if args.pictures is not None:
        check_outputs([args.pictures], inputs=[args.recording, args.bundle, args.truth], force=args.force)
    of_parts, pictures = is_of_parts(args.recording), PictureLog() if args.pictures or args.truth else None
    if of_parts and pictures is not None:
        raise UsageError("--pictures and --truth take one recording", remedy="name one of its parts")
    rows: list[dict[str, Any]] = []
    lines: list[str] = []
    for path in parts_in(args.recording) if of_parts else [args.recording]:
        recording, found = _replayed(args, path, pictures)
        rows.append({"decisions": found.decisions, "sha256": found.sha256, **_facts(recording, found)})
        of_one = f"{found.decisions} decisions, SHA-256 {found.sha256}"
        head = f"{path.name}: {found.decisions} decisions" if of_parts else of_one
        lines += [f"{head}: {_agreement_words(recording, found)}", *_passage_words(found)]
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


def _replayed(args: argparse.Namespace, path: Path, pictures: PictureLog | None = None) -> tuple[Recording, Replayed]:
    from pans.runtime.bundle.model import load_bundle
    from pans.runtime.record import read_recording, replay

    recording = read_recording(path)
    bundle = load_bundle(args.bundle)[0] if args.bundle else recording.bundle()
    return recording, replay(recording, bundle, pictures)


def _facts(recording: Recording, found: Replayed) -> dict[str, Any]:
    return {
        "identical": found.as_recorded,
        "complete": recording.complete,
        "decisions_recorded": found.recorded,
        "decisions_more": found.more,
        "contradictions": found.contradictions,
        **({} if found.passages is None else found.passages.as_json()),
    }


def _agreement_words(recording: Recording, found: Replayed) -> str:
    if not found.as_recorded:
        return f"DIFFERENT from the recorded log ({found.recorded} decisions)"
    if recording.complete:
        return "identical"
    more = f", {found.more} more can be decided" if found.more else ""
    return f"identical as far as recorded: {found.recorded} of {found.recorded}{more}"


def _passage_words(found: Replayed) -> list[str]:
    from pans.runtime.report.words import passage_words

    return [] if found.passages is None else passage_words(found.passages)


REPLAY = Command(
    "recompute a recording's decisions and compare",
    _configure,
    _run,
    examples=(
        "pans replay pans-runs/latest/run.pansrec",
        "pans replay run.pansrec --bundle other.pans",
    ),
)
