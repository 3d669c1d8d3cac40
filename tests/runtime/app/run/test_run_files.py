"""`pans run` and what was there before it: nothing is replaced, nothing stays of a run that was refused."""

import os
import shutil
from pathlib import Path

import pytest
from commands import Pans

from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import EXIT_DEVICE
from pans.base.files.output_files import locked
from pans.record.reading import read_recording

DEVICE = "sim:oled-qcmos?pace=fast&scene=fashion200"
RUN = ["run", "self.pans", "--device", DEVICE, "--decisions", "5"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with a bundle, to run in."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(SHIPPED / "fashion10.pans", "self.pans")
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, and every folder in it."""
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in sorted(folder.rglob("*"))}


REFUSED = [  # what is asked for, what is there already, and why it is refused
    ("--out taken", ["taken/run.pansrec"], "exists already"),
    ("--out taken", ["taken/summary.md"], "exists already"),
    ("--out taken --rotate-mb 1", ["taken/run.pansrec", "taken/run-0007.pansrec"], "exists already"),
    ("--trace trace.txt", ["trace.txt"], "exists already"),
    ("--state notes.json", ["notes.json"], "exists already"),
    ("--state x --trace x", [], "is also the output"),
    ("--out a/b --device serial:/dev/none --profile ideal", [], "cannot open"),
    ("--out a --device sim:dmd-spad?pace=fast", [], "levels"),
]


@pytest.mark.parametrize(("words", "there", "why"), REFUSED)
def test_a_refused_run_touches_nothing(words: str, there: list[str], why: str, folder: Path, pans: Pans) -> None:
    for name in there:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"another run's")
    before = contents(folder)
    assert main([*RUN, *words.split()]) in (2, 3)
    assert why in pans.said().err
    assert contents(folder) == before


def test_force_replaces_and_only_what_is_written(folder: Path, pans: Pans) -> None:
    pans(*RUN, "--out", "a")
    (folder / "a" / "run-2notes.pansrec").write_bytes(b"mine")
    first = read_recording("a/run.pansrec").decisions_sha256
    assert main([*RUN, "--out", "a"]) == 2
    pans(*RUN, "--out", "a", "--force", "--shots", "2")
    assert read_recording("a/run.pansrec").decisions_sha256 != first
    parted = pans(*RUN, "--out", "a", "--force", "--rotate-mb", "0.3")
    assert parted["recording"] == "a/run.pansrec"
    assert sorted(os.listdir("a")) == ["run-0001.pansrec", "run-2notes.pansrec", "summary.md"]


def test_a_run_of_its_own_gets_a_folder_with_its_date(folder: Path, pans: Pans) -> None:
    found = [pans(*RUN) for _ in range(2)]
    assert found[0]["recording"] != found[1]["recording"]
    assert found[0]["recording"].startswith("pans-runs/20")
    assert Path("pans-runs/latest/run.pansrec").samefile(found[1]["recording"])
    assert all(Path(one[key]).is_file() for one in found for key in ("recording", "report"))
    recorded = pans(*RUN, "--record", "a.pansrec")
    assert (recorded["recording"], recorded["report"]) == ("a.pansrec", "a.summary.md")
    assert not [name for name in contents(folder) if "lock" in name or "partial" in name]


def test_a_folder_belongs_to_one_run_at_a_time(folder: Path, pans: Pans) -> None:
    Path("a").mkdir()
    with locked(Path("a/.pans-run.lock")):
        assert main([*RUN, "--out", "a"]) == 2
    assert f"process {os.getpid()}" in pans.said().err
    assert main([*RUN, "--out", "a"]) == 0


@pytest.mark.parametrize("parts", [(), ("--rotate-mb", "0.3")], ids=["one file", "parts"])
def test_a_device_that_refuses_costs_no_recording(parts: tuple[str, ...], folder: Path, pans: Pans) -> None:
    pans(*RUN, "--out", "a", *parts)
    before = contents(Path("a"))
    other = "sim:ideal?pace=fast&scene=fashion200"  # counts other ticks than the profile says
    refused = ["run", "self.pans", "--device", other, "--profile", "oled-qcmos", "--decisions", "5"]
    assert "the device" in pans.refuses(*refused, "--out", "a", "--force", *parts, code=EXIT_DEVICE)
    assert contents(Path("a")) == before
    pans(*RUN, "--out", "a", "--force", "--shots", "2", *parts)
    after = contents(Path("a"))
    assert before.keys() == after.keys()
    assert all(before[name] != after[name] for name in before)
