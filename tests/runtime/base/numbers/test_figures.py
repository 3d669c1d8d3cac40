"""The table of figures: a row of it, with a property of what decisions add up to, is all that a new figure needs."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from pans.app.main import main
from pans.base.numbers import FIGURES, DecisionFigures, Figure, Part, Shown, decision_figures, keys_of, live_figures
from pans.live.watch.metrics import Collector

STORED = Path(__file__).parents[2] / "report/summary"
NEW = Figure(
    key="abstained_share",
    meaning="Share of decisions without a label",
    part=Part.DECISIONS,
    unit="share",
    name="abstentions",
    word="abstentions",
    form="{:.1%}",
    shown=Shown.RESULTS | Shown.INDEX | Shown.TREND | Shown.COMPARE | Shown.CARD | Shown.EXPORT,
    live="abstained_share",
    metric="pans_abstained_share",
)


@pytest.mark.parametrize("kind", ["still", "walks", "flow"])
def test_every_key_of_a_summary_is_in_the_table(kind: str) -> None:
    facts: dict[str, Any] = json.loads((STORED / f"summary_{kind}.json").read_text())
    shares = {f"{one.key}_ci" for one in FIGURES.values() if one.interval}
    assert facts.keys() - FIGURES.keys() - shares == set()
    parts = [Part.DECISIONS, Part.RUN, *([] if kind == "still" else [Part[kind.upper()]])]
    assert [key for part in parts for key in keys_of(part) if key not in facts] == []


@pytest.mark.parametrize("name", ["live", "metric", "compared"])
def test_names_are_given_once(name: str) -> None:
    assert max(Counter(filter(None, (getattr(one, name) for one in FIGURES.values()))).values()) == 1


def test_metrics_have_the_base_unit_in_their_names() -> None:
    ends = {"us": "_seconds", "s": "_seconds", "bytes": "_bytes"}
    assert [
        one.metric for one in live_figures() if one.metric and not one.metric.endswith(ends.get(one.unit, ""))
    ] == []


def test_what_is_not_known_is_said() -> None:
    figure = FIGURES["clicks_mean"]
    assert [figure.text(8.8304), figure.brief(8.8304), figure.text(None)] == ["8.830", "8.83", "unknown"]
    assert FIGURES["stream.gaps"].value({"stream": {"gaps": 3}}) == 3
    assert FIGURES["stream.gaps"].value({"stream": None}) is None


def test_figures_are_of_the_narrowest_group_that_has_decisions() -> None:
    sums = Counter({"decisions": 5, "decided": 4, "right": 0, "decided_clicks": 12, "decisions_clicks": 40})
    found = decision_figures(sums | Counter({"decided_photons": 30, "decided_photons_known": 3}))
    assert (found.accuracy, found.clicks_mean, found.photons_mean, found.photons_known) == (None, 3.0, 10.0, 3)
    assert (found.abstained, found.figures_of["clicks_mean"]) == (1, "decided")


def test_a_new_figure_needs_this_table_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("prometheus_client", reason="needs the metrics extra")
    monkeypatch.setitem(FIGURES, NEW.key, NEW)
    share = property(lambda found: found.abstained / found.decisions if found.decisions else None)
    monkeypatch.setattr(DecisionFigures, NEW.key, share, raising=False)
    runs, state = tmp_path / "runs", tmp_path / "state.json"
    for seed in ("1", "2"):
        device = ("--device", f"sim:dmd-spad?scene=fashion200&seed={seed}&pace=fast", "--decisions", "50")
        files = ("--state", str(state), "--out", str(runs / seed), "--json")
        assert main(["run", "fashion-adaptive", *device, "--confidence", "0.6", *files]) in (0, 1)
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    wanted = summary["abstained"] / summary["decisions"]
    assert 0 < summary["abstained_share"] == wanted < 1
    assert f"| abstentions | {wanted:.1%} |" in Path(summary["report"]).read_text()
    seen = json.loads(state.read_text())
    (metric,) = (one for one in Collector(lambda: seen).collect() if one.name == NEW.metric)
    assert [sample.value for sample in metric.samples] == [wanted]
    run = summary["recording"]
    assert main(["report", run, "-o", str(tmp_path / "run.html")]) == 0
    assert "abstentions" in (tmp_path / "run.html").read_text()
    assert main(["report", str(runs), "-o", str(tmp_path / "runs.html")]) == 0
    assert f"<td>{wanted:.1%}</td>" in (tmp_path / "runs.html").read_text()
    assert "abstentions of 2 runs" in (tmp_path / "runs.html").read_text()
    assert main(["export", run, "--format", "csv", "-o", str(tmp_path / "csv")]) == 0
    assert json.loads((tmp_path / "csv/about.json").read_text())["figures"]["abstained_share"] == wanted
    capsys.readouterr()
    assert main(["compare", str(runs / "1"), str(runs / "2"), "--json"]) == 0
    findings = {one["name"]: one for one in json.loads(capsys.readouterr().out)["findings"]}
    assert findings["abstained_share"]["second"] == wanted
