"""`pans compare`: what it pairs, what it finds, what it says of damaged and foreign files, and its page."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_files
from browser import browser, clipped, console, look, serious, unreachable
from commands import Pans, fixed_run, words_of

from pans.app.main import main
from pans.base.errors import DamagedFileError
from pans.record.reading import read_recording
from pans.record.reading.format import Kind
from pans.report.compare import compare, mcnemar_exact, read_side


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name, shots in (("a", "1"), ("b", "1"), ("c", "4")):
        words = [word.replace("seed=1", f"seed={ord(name)}") for word in fixed_run(80)]
        assert main([*words, "--shots", shots, "--out", str(folder / name)]) == 0
    return folder


def test_the_same_objects_are_paired_and_counted(runs: Path, pans: Pans) -> None:
    found = pans("compare", runs / "a", runs / "c")
    first, second = (read_recording(runs / name / "run.pansrec").decisions() for name in ("a", "c"))
    right = [dict(zip(rows["object"].tolist(), (rows["label"] == rows["truth"]).tolist())) for rows in (first, second)]
    better = sum(right[0][one] and not right[1][one] for one in right[0])
    worse = sum(right[1][one] and not right[0][one] for one in right[0])
    rows = {row["name"]: row for row in found["findings"]}
    assert (found["paired"], rows["clicks_mean"]["significant"]) == (True, True)
    assert rows["accuracy"]["p"] == mcnemar_exact(better, worse)
    assert rows["accuracy"]["difference"] == pytest.approx((better - worse) / 80)
    assert rows["clicks_mean"]["first"] == pytest.approx(first["clicks"].mean())
    apart = first["clicks"].astype(float) - second["clicks"]  # each object once, in the same order
    error = 1.959964 * apart.std(ddof=1) / 80**0.5
    ends = [rows["clicks_mean"][end] for end in ("low", "high")]
    assert ends == pytest.approx([apart.mean() - error, apart.mean() + error])
    least = min((row for row in found["findings"] if row["p"] is not None), key=lambda row: row["p"])
    tested = sum(row["p"] is not None for row in found["findings"])
    assert tested > 1
    assert least["p_corrected"] == pytest.approx(min(1.0, tested * least["p"]))  # Holm's first step is Bonferroni's
    changed = {row["name"]: (row["first"], row["second"]) for row in found["changes"]}
    assert changed["config.shots"] == ("1", "4")
    assert not any(name.startswith(("bundle", "profile")) for name in changed)


def test_a_run_beside_itself_differs_in_nothing(runs: Path, pans: Pans) -> None:
    found = pans("compare", runs / "a", runs / "a" / "run.pansrec")
    assert (found["changes"], found["significant"]) == ([], [])
    assert main(["compare", str(runs / "a"), str(runs / "a")]) == 0
    words = pans.said().out
    assert "Bundle, profile, options and device are the same." in words
    assert "No figure differs by more than chance" in words
    assert words.startswith("SIMULATED")


def test_samples_where_nothing_says_that_the_objects_are_the_same(runs: Path) -> None:
    first, second = read_side(runs / "a"), read_side(runs / "b")
    assert compare(first, second).paired
    told = {"created_utc": "2036-01-01T00:00:00", "part": {"number": 2}}
    told["profile"] = {**second.header["profile"], "toml": "# other words"}
    later = replace(second, header={**second.header, **told})
    names = {change.name for change in compare(first, later).changes}
    assert names == {"device_url", "device.seed", "device.serial"}  # no date, no hash of its own
    assert "80 and 80 distinct objects" in compare(first, second, "different").findings[0].method
    unnamed = replace(first, header={**first.header, "device_url": "sim:oled-qcmos"})  # the device tells its default
    assert "both runs show the scene" in compare(unnamed, second).why
    real = replace(unnamed, summary={**first.summary, "device": {"serial": "A1"}})
    assert "--objects same" in compare(real, second).why
    assert compare(real, second, "same").paired
    moved = first.decisions.copy()
    moved["truth"] = np.roll(moved["truth"], 1)
    why = compare(replace(first, decisions=moved), second, "same").why
    assert re.match(r"\d+ of 80 objects of the same number have another true class", why)


def test_an_object_that_is_shown_again_is_the_same(tmp_path: Path) -> None:
    assert main([*fixed_run(230), "--out", str(tmp_path / "run")]) == 0
    side = read_side(tmp_path / "run")
    assert side.decisions["object"].tolist() == [*range(200), *range(30)]
    # the figures are those that the run says, though 30 objects have two decisions
    right = side.decisions["label"] == side.decisions["truth"]
    once = np.mean([right[side.decisions["object"] == number].mean() for number in range(200)])
    for pairing in ("same", "different"):
        found = {one.name: one for one in compare(side, side, pairing).findings}
        assert found["accuracy"].first == side.summary["accuracy"] == right.mean() != once
        assert found["clicks_mean"].first == pytest.approx(side.summary["clicks_mean"], rel=1e-12)
    assert f"A {once:.2%}, B {once:.2%}" in compare(side, side, "same").findings[0].method


def test_summaries_are_compared_without_pairs(runs: Path, tmp_path: Path, pans: Pans) -> None:
    for name in ("a", "c"):
        summary = read_recording(runs / name / "run.pansrec").summary
        (tmp_path / f"{name}.json").write_text(json.dumps(dict(summary)))
    found = pans("compare", tmp_path / "a.json", tmp_path / "c.json")
    whole = pans("compare", runs / "a", runs / "c", "--objects", "different")
    assert not found["paired"]
    for key in ("name", "p", "low", "high", "first", "second"):
        assert found["findings"][0][key] == whole["findings"][0][key]


def test_a_difference_is_that_of_the_figures_beside_it(runs: Path, tmp_path: Path, pans: Pans) -> None:
    """Shares of objects that were decided several times are no whole numbers of objects: 78.8 and 75.75 % of 200."""
    summary = dict(read_recording(runs / "a" / "run.pansrec").summary)
    for name, accuracy, abstained in (("a", 0.788, 3), ("b", 0.7575, 0)):
        told = {"accuracy": accuracy, "objects": 200, "decisions": 1000, "trials": 5, "abstained": abstained}
        told |= {"verdict": "FAIL", "faults": ["it was <dark>"]} if name == "b" else {}
        (tmp_path / f"{name}.json").write_text(json.dumps(summary | told))
    words = ["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]
    for row in pans(*words)["findings"]:
        assert row["difference_is"] in ("a - b", "a / b")
        if row["difference_is"] == "a - b" and row["difference"] is not None:
            assert row["difference"] == pytest.approx(row["first"] - row["second"])
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    assert main([*words, "-o", str(tmp_path / "page.html")]) == 0
    for said in (pans.said().out, words_of((tmp_path / "page.html").read_text())):
        assert "The verdicts differ: A PASS, B FAIL." in said
        assert "it was <dark>" in said


def test_a_cut_recording_is_compared_as_far_as_it_goes(runs: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    data = (runs / "a" / "run.pansrec").read_bytes()
    (tmp_path / "cut.pansrec").write_bytes(data[: int(0.8 * len(data))])
    assert main(["compare", str(tmp_path / "cut.pansrec"), str(runs / "b"), "-o", str(tmp_path / "page.html")]) == 0
    assert "Side A was cut" in words_of((tmp_path / "page.html").read_text())


@pytest.mark.parametrize("what", ["empty folder", "other json", "broken json", "two recordings"])
def test_what_is_no_run_is_refused(what: str, runs: Path, tmp_path: Path) -> None:
    place = tmp_path / "x.json"
    if what in ("empty folder", "two recordings"):
        place.mkdir()
        for name in ("p", "q") if what == "two recordings" else ():
            (place / f"{name}.pansrec").write_bytes(b"")
    else:
        place.write_text('{"a": 1}' if what == "other json" else "{")
    assert main(["compare", str(place), str(runs / "a")]) == 2


@pytest.mark.parametrize("config", [None, {}, {"tick_hz": "a"}])
def test_a_header_without_the_devices_clock_is_damage(config: Any, runs: Path, tmp_path: Path) -> None:
    blocks = small_files.blocks_of((runs / "a" / "run.pansrec").read_bytes())
    header = {key: value for key, value in json.loads(blocks[0][1]).items() if key != "config"}
    blocks[0] = Kind.HEADER, json.dumps(header if config is None else header | {"config": config}).encode()
    (tmp_path / "x.pansrec").write_bytes(small_files.sealed(blocks))
    with pytest.raises(DamagedFileError, match=r"its header has no config\.tick_hz that can be"):
        read_side(tmp_path / "x.pansrec")


def test_the_page_in_a_browser(runs: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    place = tmp_path / "page.html"
    assert main(["compare", str(runs / "a"), str(runs / "c"), "-o", str(place)]) == 0
    page = place.read_text()
    assert len(page) < 1_000_000
    assert "<script" not in page
    assert "A − B" in page
    with browser(tmp_path) as driver:
        driver.get(place.as_uri())
        for width, dark in ((1280, False), (390, True)):
            look(driver, width, dark=dark)
            assert clipped(driver) == []
            assert serious(driver) == []
            assert unreachable(driver) == []
        assert console(driver) == []
