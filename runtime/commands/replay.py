"""`pans replay`: recompute a recording's decisions from its raw messages and compare the logs by hash.

Owns the command; the replay itself is record/replay.py's.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, emit
from pans.runtime.record import read_recording, replay
from pans.runtime.record.parts import parts_in
from pans.runtime.record.pictures import PictureLog
from pans.runtime.report.words import passage_words


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="a recording (.pansrec), or a folder with one in parts")
    parser.add_argument("--bundle", type=Path, help="decide with this bundle instead of the recorded one")
    parser.add_argument("--pictures", type=Path, metavar="OUT.npz", help="write the pictures that the head gives back")
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="SCENE.npz",
        help="compare these pictures with the scene's images (SSIM, squared error)",
    )


def _run(args: argparse.Namespace) -> int:
    if args.recording.is_dir():
        return _run_parts(args)
    recording = read_recording(args.recording)
    bundle = load_bundle(args.bundle)[0] if args.bundle else recording.bundle()
    pictures = PictureLog() if args.pictures or args.truth else None
    figures: dict[str, Any] = {}
    n_decisions, sha256 = replay(recording, bundle, pictures, figures)
    identical = sha256 == recording.decisions_sha256
    payload = {
        "decisions": n_decisions,
        "sha256": sha256,
        "recorded_sha256": recording.decisions_sha256,
        "identical": identical,
        "complete": recording.complete,
        **figures,
    }
    if pictures is not None and args.pictures:
        pictures.write(args.pictures)
    if pictures is not None and args.truth:
        payload |= pictures.compare(args.truth)
    words = "identical" if identical else f"DIFFERENT from the recorded log ({recording.n_decisions} decisions)"
    emit(args, payload, "\n".join([f"{n_decisions} decisions, SHA-256 {sha256}: {words}", *_passage_words(figures)]))
    return EXIT_FINE if identical else EXIT_ALERT


def _passage_words(figures: Mapping[str, Any]) -> list[str]:
    return passage_words(figures) if "passages" in figures else []


def _run_parts(args: argparse.Namespace) -> int:
    """Replay each part of a recording by itself."""
    rows: list[dict[str, Any]] = []
    for path in parts_in(args.recording):
        recording = read_recording(path)
        bundle = load_bundle(args.bundle)[0] if args.bundle else recording.bundle()
        figures: dict[str, Any] = {}
        n_decisions, sha256 = replay(recording, bundle, None, figures)
        same = sha256 == recording.decisions_sha256
        rows.append({"part": path.name, "decisions": n_decisions, "sha256": sha256, "identical": same, **figures})
    identical = all(row["identical"] for row in rows)
    payload = {"decisions": sum(row["decisions"] for row in rows), "identical": identical, "parts": rows}
    lines = []
    for row in rows:
        lines += [
            f"{row['part']}: {row['decisions']} decisions: {'identical' if row['identical'] else 'DIFFERENT'}",
            *_passage_words(row),
        ]
    emit(args, payload, "\n".join(lines))
    return EXIT_FINE if identical else EXIT_ALERT


REPLAY = Command("recompute a recording's decisions and compare", _configure, _run)
