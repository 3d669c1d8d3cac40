"""Recordings in parts: each part replayed and verified by itself, the chain, the cap, the disk, and all parts as one recording."""

import errno
import json
import shutil
from collections import Counter
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import Pans
from small_runs import Disk, fails, record_small

import pans
from pans.app.main import main
from pans.base.errors import DamagedFileError, RecordingError, UsageError
from pans.base.files.container import open_regular
from pans.decide.plan.plan import Plan
from pans.live.loop import Status
from pans.protocol.wire.schema import RECEIVE_WINDOW
from pans.record.reading import Recording, read_recording, recording
from pans.record.reading.exposures import click_list, iter_exposures
from pans.record.reading.parts import (
    JoinedRecording,
    chain_violations,
    earlier_parts,
    first_decision,
    open_recording,
    part_of,
    part_path,
    parts_in,
    place_of,
)
from pans.record.reading.sent_plan import recorded_plan
from pans.record.recorder import PartLimits, Recorder
from pans.record.replay import replay
from pans.record.tables.tables import click_table
from pans.report.files.verify import verify_parts
from pans.report.pages.file_page import page_of

KIB = 1024
SMALL = PartLimits(48 * KIB)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run in parts, `parts`, and in one file, `one`."""
    folder = tmp_path_factory.mktemp("runs")
    record_small(folder / "parts/run.pansrec", 3000, limits=SMALL)
    record_small(folder / "one/run.pansrec", 3000)
    return folder


@pytest.fixture
def parts(runs: Path) -> Path:
    return runs / "parts"


def check_each(folder: Path) -> list[int]:
    """Replay and verify each part by itself; return the numbers of all decisions."""
    numbers: list[int] = []
    for path in parts_in(folder):
        found = read_recording(path)
        again = replay(found, found.bundle())
        assert (again.decisions, again.sha256) == (found.n_decisions, found.decisions_sha256), path
        assert first_decision(found) == (found.decisions()["index"][0] if found.n_decisions else len(numbers))
        numbers += found.decisions()["index"].tolist()
    assert all(verdict.ok for verdict in verify_parts(folder)), verify_parts(folder)
    return numbers


def marked_objects(recording: Recording, plan: Plan) -> set[int]:
    return {number for item in iter_exposures(recording, plan) for number in item.truths}


def check_clicks(whole: Path, scratch: Path) -> None:
    """Parts alone, and those left where earlier ones are gone, hold the exposures of the whole run and the clicks of their decisions."""
    paths, recording = parts_in(whole), open_recording(whole)
    plan = recorded_plan(recording)
    every, marked = click_list(recording, plan), marked_objects(recording, plan)
    alone = [read_recording(path) for path in paths]
    assert sum(click_list(one, plan).exposures for one in alone) == every.exposures
    for first in (1, len(paths) - 2):
        for path in paths[first:]:
            (folder := scratch / str(first)).mkdir(exist_ok=True)
            shutil.copy(path, folder)
        for one in (open_recording(folder), alone[first]):
            clicks, rows = click_list(one, plan), one.decisions()
            begin = int(np.searchsorted(every.start_tick, clicks.start_tick[0]))
            for found, expected in zip(clicks[:6], every[:6]):
                np.testing.assert_array_equal(found, expected[begin : begin + len(found)])
            of = click_table(one, plan, clicks)["decision"].compressed() - first_decision(one)
            np.testing.assert_array_equal(np.bincount(of, minlength=len(rows)), rows["clicks"])
            assert rows["clicks"].sum() > 100
            assert clicks.stream[0] >= 0
            assert marked.intersection(rows["object"].tolist()) <= marked_objects(one, plan)


def test_every_part_replays_and_verifies_by_itself(parts: Path) -> None:
    numbers, found = check_each(parts), [read_recording(path) for path in parts_in(parts)]
    assert len(found) > 2
    assert numbers == list(range(len(numbers)))
    assert all(part.complete and any(map(len, part.iter_clock_samples())) for part in found)
    assert all(part.n_decisions > 50 for part in found[:-1])
    assert not list(parts.glob(".*"))


@pytest.mark.parametrize("faults", ["loss:0.01,duplicate:0.01,flip:0.01", "stall:300ms/700ms,disconnect:100ms/900ms"])
def test_parts_replay_under_faults(tmp_path: Path, faults: str) -> None:
    result = record_small(tmp_path / "run.pansrec", 3000, limits=SMALL, faults=faults)
    assert len(parts_in(tmp_path)) > 2
    assert len(check_each(tmp_path)) == result.tally.decisions
    check_clicks(tmp_path, tmp_path)


def test_a_part_that_ends_within_the_last_object_leaves_the_rest_of_it_to_the_next(tmp_path: Path) -> None:
    result = record_small(tmp_path / "run.pansrec", 8, limits=PartLimits(1))
    assert result.tally.decisions == 8
    assert check_each(tmp_path) == list(range(8))
    assert {read_recording(path).n_decisions for path in parts_in(tmp_path)} <= {0, 1, 2}


def test_the_cap_deletes_the_oldest_and_never_the_open_one(tmp_path: Path) -> None:
    result = record_small(tmp_path / "run.pansrec", 3000, limits=PartLimits(48 * KIB, 192 * KIB))
    paths = parts_in(tmp_path)
    first, last = part_of(read_recording(paths[0])), part_of(read_recording(paths[-1]))
    assert first["number"] > 1
    assert sum(path.stat().st_size for path in paths) <= 192 * KIB + 48 * KIB
    assert last["deleted"]["parts"] + len(paths) == last["number"]
    kept = len(check_each(tmp_path))
    assert last["deleted"]["decisions"] == first["first_decision"] == result.tally.decisions - kept
    assert "part_deleted" in {event["kind"] for event in result.events}
    assert earlier_parts(open_recording(tmp_path)).endswith("deleted by the run")
    paths[0].unlink()
    assert f"{paths[0].name} is missing" in " ".join(verify_parts(tmp_path)[-1].violations)


def test_a_disk_that_is_nearly_full_keeps_the_last_closed_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=1 << 40, used=1 << 40, free=0))
    record_small(tmp_path / "run.pansrec", 3000, limits=SMALL)
    assert len(check_each(tmp_path)) > 0
    closed, last = parts_in(tmp_path)
    assert closed.stat().st_size >= SMALL.rotate_bytes
    found = part_of(read_recording(last))
    assert found["deleted"]["parts"] == found["number"] - 2 > 0


def test_a_part_that_is_missing_is_found_wherever_it_was(parts: Path, tmp_path: Path) -> None:
    names = [path.name for path in parts_in(parts)]
    for name in (names[0], names[1], names[-1]):
        folder = tmp_path / name
        shutil.copytree(parts, folder)
        (folder / name).unlink()
        *others, found = verify_parts(folder)
        assert all(other.ok for other in others)
        assert "missing" in " ".join(found.violations), name
    with pytest.raises(DamagedFileError, match="one is missing between"):
        open_recording(tmp_path / names[1])
    for name in names[2:-1]:
        (tmp_path / names[1] / name).unlink()
    left = open_recording(tmp_path / names[1], salvage=True)
    assert "one is missing" in left.damage
    exposures, *others = (
        click_list(one, recorded_plan(one)).exposures for one in (left, *map(read_recording, parts_in(left.path)))
    )
    assert exposures == sum(others)


def test_a_surplus_part_is_found_wherever_it_is(parts: Path, tmp_path: Path) -> None:
    paths = parts_in(parts)
    assert chain_violations([read_recording(path) for path in paths]) == []
    record_small(tmp_path / "other/run.pansrec", 1500, limits=SMALL)
    stranger = parts_in(tmp_path / "other")[0]
    for number in (2, len(paths) + 1, 99):
        folder = tmp_path / str(number)
        shutil.copytree(parts, folder)
        shutil.copy(stranger, folder / f"run-{number:04d}.pansrec")
        text = " ".join(verify_parts(folder)[-1].violations)
        assert "parts of 2 runs" in text, number
        assert "renamed" in text
        assert ("is surplus: the run ended with" in text) == (number > len(paths))


def test_a_part_without_its_place_is_refused(parts: Path) -> None:
    found = read_recording(parts_in(parts)[1])

    class Strange:
        header, path, complete = found.header, found.path, True

        def __init__(self, *events: Any) -> None:
            self.events = lambda: iter(events)

    with pytest.raises(DamagedFileError, match="does not say where it begins"):
        part_of(Strange())  # type: ignore[arg-type]
    event = next(found.events())
    assert place_of(Strange(event)) == place_of(found)  # type: ignore[arg-type]
    mark = event["place"]["marks"][0]
    for wrong in ({"tracker": ["x", 0, 0]}, {"tracker": [0, 0]}, {"marks": [[[], *mark[1:]]]}, {"marks": [mark[:4]]}):
        with pytest.raises(DamagedFileError, match="place where it begins cannot be read"):
            place_of(Strange(event | {"place": event["place"] | wrong}))  # type: ignore[arg-type]


def test_parts_of_another_run_are_not_overwritten(parts: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="exists already"):
        Recorder(parts / "run.pansrec", {}, limits=PartLimits(KIB))
    path = tmp_path / "run.pansrec"
    for _ in range(2):
        with Recorder(path, {}, limits=PartLimits(KIB), overwrite=True) as recorder:
            recorder.close({})
    assert parts_in(tmp_path) == [part_path(path, 1)]


@pytest.mark.parametrize("limits", [(0, 0), (100, 150)])
def test_limits_that_cannot_be_meant(limits: tuple[int, int]) -> None:
    with pytest.raises(UsageError):
        PartLimits(*limits)


def test_a_full_disk_ends_the_run_with_the_light_off(tmp_path: Path) -> None:
    runs = []

    def prepared(run: Status) -> None:
        file = run.accounts.recorder.open_file  # type: ignore[union-attr]
        file._file = Disk(file._file, write=fails(errno.ENOSPC))
        runs.append(run)

    with pytest.raises(RecordingError, match="No space left on device"):
        record_small(tmp_path / "run.pansrec", 3000, limits=PartLimits(1 << 30), prepared=prepared)
    status = runs[0].session.host.status
    assert status.state == 0  # IDLE: it was told to stop
    assert not read_recording(parts_in(tmp_path)[0]).complete


def test_parts_are_one_recording(runs: Path, parts: Path) -> None:
    one, joined = open_recording(runs / "one"), open_recording(parts)
    assert one == read_recording(runs / "one/run.pansrec")
    assert isinstance(joined, JoinedRecording)
    assert (joined.complete, joined.n_decisions, len(joined.timings())) == (True, one.n_decisions, one.n_decisions)
    np.testing.assert_array_equal(one.decisions(), joined.decisions())
    plan, wanted = recorded_plan(joined), recorded_plan(one)
    for field in fields(plan):
        assert np.array_equal(getattr(plan, field.name), getattr(wanted, field.name)), field.name
    for found, expected in zip(click_list(joined, plan), click_list(one, plan), strict=True):
        assert np.array_equal(found, expected)
    assert joined.bundle().classes == one.bundle().classes
    for found, wanted in ((pans.load_recording(place), one) for place in (parts, parts / "run.pansrec")):
        again = pans.replay(found, found.bundle())
        assert (again.as_recorded, again.sha256) == (True, wanted.decisions_sha256)
    assert (
        repr(open_recording(parts / "run.pansrec"))
        == f"<Recording run.pansrec: {one.n_decisions} decisions, SIMULATED>"
    )


def test_a_page_reads_each_part_as_often_however_many_there_are(
    parts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To check it, for the plan that was sent, and of the page each kind of block, and twice its beginning alone, where it says its place;
    the first part, which has the bundle, more often."""
    reads: Counter[str] = Counter()

    def opened(path: Path) -> Any:
        reads[Path(path).name] += 1
        return open_regular(path)

    monkeypatch.setattr(recording, "open_regular", opened)
    paths, found = parts_in(parts), []
    for n in (2, len(paths)):
        (tmp_path / str(n)).mkdir()
        for path in paths[:n]:
            shutil.copy(path, tmp_path / str(n))
        page_of(tmp_path / str(n))
        found.append(dict(reads))
        reads.clear()
    few, many = found
    assert len(many) > len(few) == 2
    assert all(many[name] == few[name] for name in few)
    assert {many[path.name] for path in paths[1:]} == {few[paths[1].name]}
    assert few[paths[1].name] < 10


def test_clicks_of_the_parts_that_are_left_are_those_of_the_whole(parts: Path, tmp_path: Path) -> None:
    beyond_its_beginning = part_of(read_recording(parts_in(parts)[-2]))["place"]["tracker"][0]
    assert beyond_its_beginning > RECEIVE_WINDOW
    check_clicks(parts, tmp_path)


def test_what_came_before_is_said(parts: Path, tmp_path: Path, pans: Pans) -> None:
    paths = parts_in(parts)
    assert earlier_parts(open_recording(parts)) == earlier_parts(open_recording(paths[0])) == ""
    first = first_decision(read_recording(paths[2]))
    said = f"parts 1 to 2 of the run, with the decisions before number {first}"
    assert earlier_parts(read_recording(paths[2])) == f"{said}: not read"
    for path in paths[2:]:
        shutil.copy(path, tmp_path)
    assert earlier_parts(open_recording(tmp_path)) == f"{said}: missing"
    facts = pans("info", tmp_path)
    assert (facts["earlier_parts"], facts["first_decision"]) == (f"{said}: missing", first)
    assert main(["export", str(tmp_path), "--format", "csv", "-o", str(tmp_path / "csv")]) == 0
    assert f"without {said}: missing" in pans.said().out


def test_commands_take_a_folder_or_the_name_of_the_recording(parts: Path, tmp_path: Path, pans: Pans) -> None:
    for place in (parts, parts / "run.pansrec"):
        assert pans("verify", place)["ok"]
        payload = pans("replay", place)
        assert payload["identical"]
        assert len(payload["parts"]) == len(parts_in(parts))
    assert pans("export", place, "--format", "csv", "-o", tmp_path / "csv")["decisions"] > 1000
    told = json.loads((tmp_path / "csv/about.json").read_text())["events"]
    assert [event["number"] for event in told if event["kind"] == "part"] == list(range(1, len(parts_in(parts)) + 1))
    assert not any("place" in event for event in told)
    assert pans("info", place)["decisions"] == payload["decisions"]
    assert main(["verify", str(tmp_path / "run.pansrec")]) == main(["verify", str(tmp_path / "csv")]) == 2
    with pytest.raises(UsageError, match="0 recordings are here"):
        open_recording(tmp_path)
