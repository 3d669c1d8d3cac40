"""300 sessions of devices whose EXPOSED, STATUS or MARK contradict the stream, by chance in every way and mode: none may PASS."""

import functools
import random
from collections import Counter
from pathlib import Path

import pytest
from hostile_devices import LIES, MODES, Lie, lied
from mutated_sessions import Stage

pytestmark = pytest.mark.slow
SESSIONS = 15  # of each lie


def test_no_lie_passes_and_no_replay_differs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage = functools.cache(Stage)
    verdicts: dict[str, Counter[str]] = {what: Counter() for what in LIES}
    found: Counter[str] = Counter()
    wrong: list[str] = []
    for number, what in enumerate(LIES):
        for seed in range(SESSIONS):
            lie = Lie.drawn(what, random.Random(f"{what} {seed}"))
            session, told = lied(stage(MODES[(number + seed) % len(MODES)]), lie, seed, tmp_path)
            wrong += session.wrong
            summary = session.summary
            verdicts[what][
                "said nothing false" if not told else session.error[:20] if summary is None else summary.verdict
            ] += 1
            found.update(() if summary is None else summary.contradictions)
    with capsys.disabled():
        print("", *(f"{what}: {dict(counts)}" for what, counts in verdicts.items()), dict(found), sep="\n")
    assert wrong == []
    assert sum(counts["FAIL"] for counts in verdicts.values()) > 0.9 * SESSIONS * len(LIES)
