"""What a verified recording claims, it holds: a replay gives its decisions, and its events can be read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from small_files import blocks_of, record_flow, record_passive, record_run, sealed, use_file

from pans.runtime.record import read_recording
from pans.runtime.record.format import Kind
from pans.runtime.report.verify import verify_file

Change = Callable[[list[tuple[int, bytes]]], list[tuple[int, bytes]]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return record_run(tmp_path_factory.mktemp("run")).read_bytes()


def without(*kinds: Kind) -> Change:
    return lambda blocks: [block for block in blocks if block[0] not in kinds]


def event(text: bytes) -> Change:
    return lambda blocks: [(kind, text if kind == Kind.EVENTS else payload) for kind, payload in blocks]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without(Kind.COMMANDS), "the device was never armed"),
        (without(Kind.COMMANDS, Kind.MESSAGES), "the device was never armed"),
        (event(b'{"why":"no kind"}'), "does not say of what kind"),
        (event(b'{"kind":"gate_refused","decision":"7"}'), "names the decision '7'"),
        (event(b'{"kind":"gate_refused","decision":-1}'), "names the decision -1"),
    ],
)
def test_what_cannot_be_replayed_or_read_is_a_violation(
    change: Change, words: str, whole: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "run.pansrec"
    path.write_bytes(sealed(change(blocks_of(whole))))
    assert words in " ".join(verify_file(path).violations)


def test_a_run_that_decided_nothing_and_armed_nothing_is_fine(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "run.pansrec"
    kinds = (Kind.COMMANDS, Kind.MESSAGES, Kind.DECISIONS, Kind.TIMINGS)
    path.write_bytes(sealed(without(*kinds)(blocks_of(whole))))
    assert verify_file(path).violations == []
    use_file("recording", path)


@pytest.mark.parametrize("make", [record_run, record_passive, record_flow])
def test_the_files_that_are_changed_are_whole_and_decide(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path)
    assert verify_file(path).violations == []
    assert read_recording(path).n_decisions > 0
    use_file("recording", path)
