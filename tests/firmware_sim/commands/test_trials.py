"""`pans trials`: the table, options made from settings, exit codes and the JSON object."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from pans.firmware_sim import trials
from pans.firmware_sim.options import option
from pans.firmware_sim.trials import TRIALS, Report, Trial, load_trial, rows_report
from pans.runtime.cli import main


def test_without_a_name_all_trials_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trials"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[: len(TRIALS)]] == list(TRIALS)
    assert main(["trials", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {row["name"]: row["takes"] for row in rows} == {name: entry.takes for name, entry in TRIALS.items()}


@pytest.mark.parametrize("name", TRIALS)
def test_every_trial_shows_its_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["trials", name, "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert f"usage: pans trials {name}" in shown
    assert "--json" in shown
    for one in load_trial(name).settings.__dataclass_fields__.values():
        assert one.metadata.get("flag", "--" + one.name.replace("_", "-")) in shown


def test_an_unknown_trial_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["trials", "nothing"])
    assert ended.value.code == 2
    assert "fault-grid" in capsys.readouterr().err


def test_a_trial_runs_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trials", "clock", "--seconds", "2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert len(rows) == 15
    assert all(row["within"] == 1 for row in rows)
    assert main(["trials", "--json", "fault-grid", "--frames", "2000", "--seed", "1", "--faults", "none"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in figures["rows"]] == ["none"]
    assert figures["failures"] == []


@dataclass(frozen=True)
class Settings:
    """One of each kind of option."""

    what: str = option("", "by place", flag="what", choices=("a", "b"))
    often: int = option(3, "a number")
    some_names: tuple[str, ...] = option((), "repeatable", flag="--name", action="append")
    really: bool = option(False, "a switch", action="store_true")
    more: tuple[str, ...] = option((), "after --", flag="more", nargs="*")


def made_up(settings: Settings) -> Report:
    if settings.what == "b":
        raise RuntimeError("the host ended with 7")
    return rows_report([vars(settings), {"size": float("inf")}], settings.really, simulated=True)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock trial's place in the table, taken by a trial that gives back its settings."""
    monkeypatch.setattr(trials.importlib, "import_module", lambda *name: Stand)


class Stand:
    TRIAL = Trial(Settings, made_up, json_to_file=True)


@pytest.mark.usefixtures("stand_in")
def test_options_reach_the_trial_and_the_verdict_the_exit_code(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    options = ["--often", "5", "--name", "x", "--name", "y"]
    words = ["trials", "--json", "clock", *options, "a", "--", "--further", "-w"]
    assert main(words) == 1
    given, endless = json.loads(capsys.readouterr().out)["rows"]
    assert given == {
        "what": "a",
        "often": 5,
        "some_names": ["x", "y"],
        "really": False,
        "more": ["--further", "-w"],
    }
    assert endless == {"size": None}
    path = tmp_path / "figures.json"
    assert main(["trials", "clock", "a", "--really", "--json", str(path)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "SIMULATED",
        "what a  often 3  some_names []  really True  more []",
        "size None",
    ]
    assert json.loads(path.read_text())["simulated"] is True


@pytest.mark.usefixtures("stand_in")
def test_a_process_that_fails_is_an_error_not_a_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trials", "clock", "b"]) == 2
    assert "clock: the host ended with 7" in capsys.readouterr().err
