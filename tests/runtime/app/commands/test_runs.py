"""`pans runs`: what lies in a folder, and what prune may delete: nothing foreign, nothing that is going on, nothing without --yes."""

import re
import shlex
import shutil
import sys
from argparse import ArgumentTypeError
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Pans, fixed_run, json_of

from pans.app.commands.runs import RUN_LOCK, Run, duration_s, prunable, run_of, size_bytes
from pans.app.main import main
from pans.base.files.container import block_ends, canonical_json
from pans.base.files.output_files import locked
from pans.record.reading import read_recording
from pans.record.reading.format import Kind
from pans.record.reading.recording_file import RecordingFile

NOW = datetime(2026, 11, 22, 12, tzinfo=UTC)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two runs: one whole, one in parts."""
    root = tmp_path_factory.mktemp("pans-runs")
    assert main([*fixed_run(20), "--out", str(root / "whole")]) in (0, 1)
    assert main([*fixed_run(60), "--out", str(root / "parts"), "--rotate-mb", "0.1"]) in (0, 1)
    return root


@pytest.fixture
def root(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "pans-runs", symlinks=True))


def listed(capsys: pytest.CaptureFixture[str], *words: Any, code: int = 0) -> dict[str, Any]:
    return json_of(capsys, "runs", *words, code=code)


def test_the_list_says_what_the_summary_says(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "notes").mkdir()
    (root / "notes" / "a.txt").write_text("no run")
    found = {Path(run["folder"]).name: run for run in listed(capsys, root)["runs"]}
    assert found.keys() == {"whole", "parts"}
    for name, decisions in (("whole", 20), ("parts", 60)):
        run, summary = found[name], (root / name / "summary.md").read_text()
        told = tuple(run[key] for key in ("decisions", "bundle", "simulated", "locked"))
        assert told == (decisions, "fashion10", True, False)
        assert run["verdict"] in ("PASS", "FAIL")
        assert run["verdict"] in summary
        files = sorted(path.name for path in (root / name).glob("*.pansrec"))
        assert set(re.findall(r"[\w-]+\.pansrec", summary)) == {files[0], files[-1]}
        assert all(f"- {fault}" in summary for fault in run["faults"])
        clicks, exposures = re.findall(r"(\d+) clicks in (\d+) dark exposures", summary)[0]
        assert run["dark_per_exposure"] == pytest.approx(int(clicks) / int(exposures))
        assert run["bytes"] == sum(path.stat().st_size for path in (root / name).iterdir())
        assert datetime.now(UTC) - datetime.fromisoformat(run["started"]) < timedelta(hours=1)
    assert main(["runs", str(root)]) == 0
    out = capsys.readouterr().out
    assert "2 runs" in out
    assert "dark clicks/exposure" in out


def test_a_cut_run_and_one_that_goes_on(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = root / "whole" / "run.pansrec"
    path.write_bytes(path.read_bytes()[:-3000])
    (root / "parts" / "run-0001.pansrec").write_bytes(b"damaged")
    with locked(root / "parts" / ".pans-run.lock"):
        found = {Path(run["folder"]).name: run for run in listed(capsys, root)["runs"]}
    rows = read_recording(path).decisions()
    whole = found["whole"]
    assert (whole["verdict"], whole["decisions"]) == ("cut", len(rows))
    assert whole["accuracy"] == np.mean(rows["label"] == rows["truth"])
    assert (found["parts"]["verdict"], found["parts"]["locked"]) == ("running", True)


def test_no_bytes_of_the_device_are_taken_for_the_end_of_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run was killed: WELCOME's text reads as an END, and a message holds a whole block of one, where the file was cut."""
    summary = {"verdict": "PASS", "decisions": 99, "accuracy": 1.0}
    text = canonical_json({"blocks": 1, "summary": summary})
    with monkeypatch.context() as patch:
        patch.setattr("pans_sim.device.facts.FIRMWARE", text.decode())
        assert main([*fixed_run(20), "--out", str(tmp_path / "killed")]) in (0, 1)
    path = tmp_path / "killed" / "run.pansrec"
    recording = read_recording(path)
    assert run_of(path.parent).summary == recording.summary  # type: ignore[union-attr]
    cut = path.read_bytes()[: -len(canonical_json(dict(recording.summary)))]
    assert text in cut
    path.write_bytes(cut)
    forged = RecordingFile(tmp_path / "forged.pansrec", {})
    seed = bytes(4)  # what stands before a block's header is the checksum that it begins from
    head, tail, _ = block_ends(Kind.END, 1, 0, text)
    forged.write(*forged.framed(Kind.MESSAGES, seed + head + text + tail)[:2])
    forged.take_name()
    forged.close()
    (tmp_path / "forging").mkdir()
    forged.path.rename(tmp_path / "forging" / "run.pansrec")
    runs = {Path(run["folder"]).name: run for run in listed(capsys, tmp_path)["runs"]}
    assert {name: run["verdict"] for name, run in runs.items()} == {"killed": "cut", "forging": "cut"}
    assert runs["killed"]["decisions"] == 20
    assert runs["forging"]["decisions"] is None


def test_prune_lists_first_and_deletes_only_what_is_ours(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "whole" / "notes.txt").write_text("precious")
    (root / "latest").symlink_to("parts")
    before = sorted(root.rglob("*"))
    found = listed(capsys, "prune", root, "--larger-than", "1B")
    assert (len(found["runs"]), found["deleted"]) == (2, False)
    assert sorted(root.rglob("*")) == before
    found = listed(capsys, "prune", root, "--larger-than", "1B", "--yes", code=1)
    assert "notes.txt" in found["left"][0]
    assert sorted(path.name for path in root.rglob("*")) == ["notes.txt", "whole"]


def test_a_run_that_begins_makes_room_among_its_own_earlier_ones(
    root: Path, pans: Pans, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest ended runs in parts of the same command line go, until what stays and the new run fit; nothing else goes."""
    for name in ("parts-1", "parts-2", "parts-3", "parts-4", "going on", "other"):
        shutil.copytree(root / "parts", root / name)
    (root / "parts-1" / "notes.txt").write_text("precious")
    own = run_of(root / "parts")
    assert own is not None
    for path in (root / "other").glob("*.pansrec"):
        assert own.command.encode() in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(own.command.encode(), own.command.encode()[:-1] + b"!"))
    monkeypatch.chdir(root.parent)
    monkeypatch.setattr(sys, "argv", shlex.split(own.command))
    keep = 1.1 * own.bytes / 2**20
    bound = ["--rotate-mb", str(keep / 3), "--keep-mb", str(keep), "--keep-runs-mb", str(3 * keep)]
    with locked(root / "going on" / RUN_LOCK):
        found = pans(*fixed_run(20), *bound, code=None)
    left = {path.name for path in root.iterdir() if not path.is_symlink()} - {Path(found["recording"]).parent.name}
    assert left == {"parts-1", "parts-3", "parts-4", "going on", "other", "whole"}
    assert [path.name for path in (root / "parts-1").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--keep-runs-mb", "9"], "--keep-mb"),
        (["--keep-runs-mb", "9", "--rotate-mb", "1", "--keep-mb", "5"], "below twice"),
        (["--keep-runs-mb", "9", "--rotate-mb", "1", "--keep-mb", "2", "--out", "x"], "leave --out"),
    ],
)
def test_a_bound_that_cannot_be_kept_is_refused(words: list[str], said: str, pans: Pans) -> None:
    assert said in pans.refuses(*fixed_run(4), *words)


def made(name: str, days: float, size: int, *, is_locked: bool = False) -> Run:
    started = NOW - timedelta(days=days)
    return Run(Path(name), started, "b", "PASS", 1, None, None, None, size, True, is_locked, "", (), ())


def test_all_conditions_hold_and_the_newest_are_kept() -> None:
    runs = [made("a", 1, 9), made("b", 40, 9), made("c", 50, 1), made("d", 60, 9), made("e", 70, 9, is_locked=True)]

    def names(**rule: Any) -> str:
        facts = {"older_s": None, "larger": None, "keep": 0} | rule
        return "".join(str(run.folder) for run in prunable(runs, now=NOW.timestamp(), **facts))

    assert names() == "abcd"
    assert names(older_s=30 * 86400.0) == "bcd"
    assert names(older_s=30 * 86400.0, larger=5) == "bd"
    assert names(older_s=30 * 86400.0, larger=5, keep=2) == "d"
    assert names(keep=5) == ""
    assert names(larger=9) == ""


def test_links_are_not_followed(root: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside.pansrec"
    (root / "whole" / "run.pansrec").rename(outside)
    (root / "whole" / "run.pansrec").symlink_to(outside)
    assert run_of(root / "whole") is None


def test_times_and_sizes() -> None:
    assert (duration_s("30d"), duration_s("1.5 h"), duration_s("2w")) == (2_592_000, 5400, 1_209_600)
    assert (size_bytes("5GB"), size_bytes("200 MiB")) == (5 * 10**9, 200 << 20)
    for text in ("30", "d", "5 parsecs", "-1d"):
        with pytest.raises(ArgumentTypeError):
            duration_s(text)
