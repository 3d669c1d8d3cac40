"""A run in parts, read as one: the same decisions and clicks as those of the run in one file."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.runtime.cli import main
from pans.runtime.container import open_regular
from pans.runtime.core.plan import Plan
from pans.runtime.errors import DamagedFileError, UsageError
from pans.runtime.pages import page_of
from pans.runtime.record import read_recording, recording
from pans.runtime.record.exposures import click_list
from pans.runtime.record.parts import JoinedRecording, open_recording
from pans.runtime.record.sent_plan import recorded_plan

RUN = ["run", "fashion10", "--device", "sim:oled-qcmos?pace=fast", "--decisions", "150", "-q"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    assert main([*RUN, "--record", str(folder / "parts/r.pansrec"), "--rotate-mb", "0.18"]) == 0
    assert main([*RUN, "--out", str(folder / "one")]) == 0
    return folder


def plan_values(plan: Plan) -> list[object]:
    return [getattr(plan, field.name) for field in dataclasses.fields(plan)]


def test_parts_are_one_recording(folder: Path) -> None:
    one, joined = open_recording(folder / "one"), open_recording(folder / "parts")
    assert isinstance(joined, JoinedRecording)
    assert len(joined.parts) > 2
    assert joined.complete
    assert joined.n_decisions == one.n_decisions == 150
    same = [name for name in one.decisions().dtype.names or () if not name.endswith("_ns")]
    assert all(np.array_equal(one.decisions()[name], joined.decisions()[name]) for name in same)
    assert len(joined.timings()) == 150
    plan = recorded_plan(joined)
    assert [np.asarray(value).tolist() for value in plan_values(plan)] == [
        np.asarray(value).tolist() for value in plan_values(recorded_plan(one))
    ]
    clicks, wanted = click_list(joined, plan), click_list(one, plan)
    assert np.array_equal(clicks.start_tick, wanted.start_tick)
    assert clicks.exposures == wanted.exposures
    assert joined.bundle().classes == one.bundle().classes
    assert open_recording(folder / "parts/r.pansrec").n_decisions == 150


def test_a_page_reads_each_part_as_often_however_many_there_are(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first part, which has the bundle, a few times more."""
    reads: Counter[str] = Counter()

    def opened(path: Path) -> Any:
        reads[Path(path).name] += 1
        return open_regular(path)

    monkeypatch.setattr(recording, "open_regular", opened)
    parts = sorted((folder / "parts").glob("*.pansrec"))
    found = []
    for n in (2, len(parts)):
        (tmp_path / str(n)).mkdir()
        for path in parts[:n]:
            (tmp_path / str(n) / path.name).write_bytes(path.read_bytes())
        page_of(tmp_path / str(n))
        found.append(dict(reads))
        reads.clear()
    few, many = found
    assert len(many) > len(few) == 2
    assert all(many[name] == few[name] for name in few)
    assert {many[path.name] for path in parts[1:]} == {few[parts[1].name]}
    assert few[parts[1].name] < 25


def test_a_part_that_is_missing_is_told(folder: Path, tmp_path: Path) -> None:
    for path in (folder / "parts").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "r-0002.pansrec").unlink()
    with pytest.raises(DamagedFileError, match="one is missing between"):
        open_recording(tmp_path)
    assert "one is missing" in open_recording(tmp_path, salvage=True).damage


def test_a_folder_stands_for_its_only_recording(folder: Path, tmp_path: Path) -> None:
    assert open_recording(folder / "one").path == folder / "one/run.pansrec"
    assert open_recording(folder / "one/run.pansrec") == read_recording(folder / "one/run.pansrec")
    with pytest.raises(UsageError, match="0 recordings are here"):
        open_recording(tmp_path)


def test_commands_take_parts_as_one(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = str(folder / "parts/r.pansrec")
    assert main(["export", name, "--format", "csv", "-o", str(tmp_path / "csv")]) == 0
    assert "150 decisions" in capsys.readouterr().out
    assert main(["info", name]) == 0
    assert "decisions " in capsys.readouterr().out
