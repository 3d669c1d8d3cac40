"""`pans batch`: items and their words, a journal that goes on where it was, and two Dask workers of which one is killed."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from commands import Pans

from pans.app.commands import batch
from pans.app.commands.batch import FORMAT, items_of, run_item
from pans.app.main import main
from pans.bundle.sensor.bundle import write_bundle
from pans_sim.testing import small_setup


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with three bundles to work on."""
    monkeypatch.chdir(tmp_path)
    bundle = small_setup("sequential")[1]
    for name in ("a", "b", "c"):
        Path(name).mkdir()
        write_bundle(bundle, Path(name) / "grid.pans")
    return tmp_path


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """Let items answer at once, without processes; return the words of those that ran."""
    ran: list[tuple[str, ...]] = []

    def answer(words: tuple[str, ...], folder: str) -> dict[str, Any]:
        ran.append(tuple(words))
        row = {"exit": int("b/" in words[1]), "seconds": 0.1, "host": "here", "error": None}
        return row | {"answer": {"accuracy": 0.5, "latency_us": {"p50": 2.0}, "rows": [1, 2], "exit": 9}}

    monkeypatch.setattr(batch, "run_item", answer)
    return ran


def test_items_are_inputs_times_values(lab: Path) -> None:
    items = items_of("evaluate", ["*/grid.pans", "a/grid.pans"], ["seed=0-2", "--eta=0.5,1"], "", files=True)
    assert len(items) == len({item.key for item in items}) == 3 * 3 * 2
    assert items[1].words == ("evaluate", "a/grid.pans", "--seed", "0", "--eta", "1")
    extra = "-o '{folder}/my {stem}-{seed}.html'"
    (item,) = items_of("report", ["b/grid.pans"], ["seed=7"], extra, files=True)
    assert item.words == ("report", "b/grid.pans", "-o", "b/my grid-7.html")
    assert items_of("reproduce", ["alpha", "eta"], [], "", files=False)[1].words == ("reproduce", "eta")
    Path("b/grid.pans").write_bytes(b"changed")
    assert items_of("report", ["b/grid.pans"], ["seed=7"], extra, files=True)[0].key != item.key


def test_a_batch_goes_on_where_it_was(lab: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans) -> None:
    ran = in_this_process(monkeypatch)
    words = ["batch info", "*/grid.pans", "-o", "r.jsonl"]
    found = pans(*words, code=1)
    assert (found["items"], found["run"]) == (3, 3)
    assert [row["item"] for row in found["failed"]] == ["b/grid.pans"]
    lines = Path("r.jsonl").read_text().splitlines()
    Path("r.jsonl").write_text("\n".join([*lines[:2], lines[2][:-5]]))  # cut within the last line
    ran.clear()
    assert main(["batch", "info", "*/grid.pans", "-o", "r.jsonl"]) == 2  # never replaced
    assert "--resume" in pans.said().err
    assert pans(*words, "--resume", code=1)["run"] == 1
    assert len(ran) == 1
    items = {json.loads(line)["item"] for line in Path("r.jsonl").read_text().splitlines()}
    assert items == {f"{name}/grid.pans" for name in "abc"}
    os.utime("a/grid.pans", (1, 1))  # a changed input is done again
    assert pans(*words, "--resume", code=1)["run"] == 1
    assert pans(*words, "--force", code=1)["run"] == 3


def test_every_result_survives_a_power_cut(
    lab: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans, synced: dict[int, Any]
) -> None:
    in_this_process(monkeypatch)
    pans("batch info", "*/grid.pans", "-o", "r.jsonl", code=1)
    facts = Path("r.jsonl").stat()
    assert synced[facts.st_ino] == facts.st_size > 0


def test_an_interrupted_batch_keeps_what_is_done(lab: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans) -> None:
    ran = in_this_process(monkeypatch)
    answer = batch.run_item

    def interrupted(words: tuple[str, ...], folder: str) -> dict[str, Any]:
        if ran:
            raise KeyboardInterrupt
        return answer(words, folder)

    monkeypatch.setattr(batch, "run_item", interrupted)
    assert "--resume" in pans.refuses("batch", "info", "*/grid.pans", "-o", "r.jsonl", code=130)
    assert len(Path("r.jsonl").read_text().splitlines()) == 1


def test_results_as_parquet(lab: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the parquet extra")
    in_this_process(monkeypatch)
    words = ["batch evaluate", "a/grid.pans", "--vary", "seed=3,4", "-o", "r.parquet"]
    monkeypatch.setattr(batch, "_check_words", lambda command, item: None)
    pans(*words)
    table = parquet.read_table("r.parquet").to_pydict()
    assert table["seed"] == ["3", "4"]
    assert (table["accuracy"], table["latency_us.p50"], table["exit"]) == ([0.5, 0.5], [2.0, 2.0], [0, 0])
    assert table["rows"] == ["[1, 2]", "[1, 2]"]
    assert table["answer.exit"] == [9, 9]
    assert pans(*words, "--resume")["run"] == 0


def test_foreign_files_are_no_journals(lab: Path, pans: Pans) -> None:
    for text in (
        "precious\n",
        '{"a": 1}\n',
        f'{{"format": "{FORMAT}", "key": "k", "item": "i", "exit": 0}}\nprecious\nmore\n',
    ):
        Path("r.jsonl").write_text(text)
        assert "not the journal" in pans.refuses("batch", "info", "a/grid.pans", "-o", "r.jsonl", "--resume")
        assert Path("r.jsonl").read_text() == text


def test_an_item_is_a_process_with_an_answer_or_an_error(lab: Path) -> None:
    good, bad = run_item(("info", "a/grid.pans"), str(lab)), run_item(("info", "none"), str(lab))
    assert (good["exit"], good["error"]) == (0, None)
    assert good["answer"]["classes"]
    assert (bad["exit"], bad["answer"], "none" in bad["error"]) == (2, None, True)


@pytest.mark.skipif(sys.platform == "win32", reason="kills a process")
def test_two_workers_share_a_batch_and_a_killed_one_costs_no_result(lab: Path) -> None:
    pytest.importorskip("distributed", reason="needs the dask extra")
    for number in range(4):
        (lab / f"more{number}").mkdir()
        (lab / f"more{number}" / "grid.pans").write_bytes((lab / "a" / "grid.pans").read_bytes())
    started: list[subprocess.Popen[str]] = []

    def start(*words: str, stdout: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", *words]
        started.append(subprocess.Popen(command, stdout=stdout, stderr=subprocess.DEVNULL, text=True))
        return started[-1]

    place = ("--scheduler-file", "place.json", "--no-dashboard")
    try:
        start("distributed.cli.dask_scheduler", "--port", "0", *place)
        address = _wait_for(lambda: json.loads(Path("place.json").read_text())["address"])
        worker, _ = (start("distributed.cli.dask_worker", *place, "--nthreads", "1", "--no-nanny") for _ in range(2))
        words = ("pans", "batch", "info", "*/grid.pans", "--dask", address, "-o", "r.jsonl", "--json")
        process = start(*words, stdout=subprocess.PIPE)
        _wait_for(lambda: process.poll() is not None or Path("r.jsonl").read_text().splitlines()[0])
        assert process.poll() is None
        worker.kill()  # in the middle of its next item
        found = json.loads(process.communicate(timeout=300)[0])
    finally:
        for one in started:
            one.kill()
            one.wait()
    assert (process.returncode, found["items"], found["failed"]) == (0, 7, [])
    rows = [json.loads(line) for line in Path("r.jsonl").read_text().splitlines()]
    assert len(rows) == len({row["item"] for row in rows}) == 7
    assert all(row["answer"]["classes"] for row in rows)


def _wait_for(look: Callable[[], Any]) -> Any:
    for _ in range(1500):
        with suppress(OSError, ValueError, IndexError, KeyError):
            if found := look():
                return found
        time.sleep(0.1)
    raise AssertionError("it never came")
