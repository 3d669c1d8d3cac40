"""The shipped files for Prometheus and Grafana: a real run serves each metric that they name, and the rules fire when they should."""

import json
import re
import shutil
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.app.main import main
from pans.base import SHIPPED
from pans.base.numbers import live_figures
from pans.bundle.sensor.bundle import write_bundle
from pans.live.watch.metrics import MetricsServer
from pans_sim.testing import small_setup

RULES, DASHBOARD = SHIPPED / "prometheus-alerts.yml", SHIPPED / "grafana-dashboard.json"
METRIC = re.compile(r"\bpans_[a-z0-9_]+")
LABELS = re.compile(r"\$labels\.([a-z]+)|\{\{([a-z]+)\}\}")


def named(path: Path) -> set[str]:
    return set(METRIC.findall(path.read_text()))


def test_every_metric_that_is_named_is_served_by_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("prometheus_client", reason="needs the metrics extra")
    write_bundle(small_setup("sequential")[1], tmp_path / "grid.pans")
    close, answers = MetricsServer.close, list[str]()

    def asked_once_more(server: MetricsServer) -> None:
        answers.append(urllib.request.urlopen(f"http://{server.host}:{server.port}/metrics").read().decode())
        close(server)

    monkeypatch.setattr(MetricsServer, "close", asked_once_more)
    device = ("--device", "sim:ideal?scene=uniform&seed=3&pace=fast", "--seconds", "20", "--rotate-mb", "1")
    assert main(["run", str(tmp_path / "grid.pans"), *device, "--metrics", "0", "--out", str(tmp_path / "out")]) in (
        0,
        1,
        4,
    )
    (text,) = answers
    served = {re.split("[{ ]", line)[0] for line in text.splitlines() if line[:1] != "#"}
    # a run without trouble has no causes to tell, and no alarm
    metrics = [one for one in live_figures() if one.metric]
    of_causes = {f"{one.metric}_total" for one in metrics if one.label == "cause"}
    of_causes.add("pans_alarm_times_expected")
    for path in (RULES, DASHBOARD):
        named = set(METRIC.findall(path.read_text()))
        assert named - served - of_causes == set(), path.name
        assert len(named) >= 10
    of_all = {f"{one.metric}_total" if one.counts else one.metric for one in metrics if not one.label}
    assert of_all - served == set()
    assert "pans_disk_left_seconds +Inf" in text.splitlines()  # there at all times; no rate is known after a second
    assert promtool("check", "metrics", text=text) == ""


def test_the_dashboard_is_one_that_grafana_reads_and_labels_exist() -> None:
    board = json.loads(DASHBOARD.read_text())
    assert board["uid"] == "pans-runs"
    assert {one["name"] for one in board["templating"]["list"]} == {"datasource", "instance"}
    for panel in board["panels"]:
        assert panel["targets"], panel["title"]
        for target in panel["targets"]:
            assert 'instance=~"$instance"' in target["expr"]
    used = [{"".join(found) for found in LABELS.findall(path.read_text())} for path in (RULES, DASHBOARD)]
    assert used == [{"instance", "kind", "folder"}, {"instance", "cause", "kind"}]


def test_prometheus_reads_every_expression_of_the_dashboard(tmp_path: Path) -> None:
    targets = [one["expr"] for panel in json.loads(DASHBOARD.read_text())["panels"] for one in panel["targets"]]
    plain = [one.replace("$instance", ".+").replace("$__rate_interval", "1m") for one in targets]
    rules = [{"record": f"panel:{place}", "expr": expression} for place, expression in enumerate(plain)]
    (tmp_path / "rules.yml").write_text(json.dumps({"groups": [{"name": "dashboard", "rules": rules}]}))
    assert f"SUCCESS: {len(rules)} rules found" in promtool("check", "rules", str(tmp_path / "rules.yml"))


def test_promtool_accepts_configuration_and_rules() -> None:
    said = promtool("check", "config", str(SHIPPED / "prometheus.yml"))
    assert "SUCCESS: 14 rules found" in said
    assert "prometheus.yml is valid" in said


def test_rules_fire_at_once_or_after_enough_history(tmp_path: Path) -> None:
    """Of a run that begins at minute 0, is scraped from minute 1 to 941, has an alarm from minute 60 to 90, and grows by 1 MB a minute."""
    states = {  # minute -> the states of four rules
        0: {"PansRunFailed": "firing", "PansGone": "pending"},
        1: {"PansRunFailed": "firing"},
        59: {"PansRunFailed": "firing"},
        60: {"PansAlarm": "firing"},
        90: {},
        419: {},
        421: {"PansMemoryGrows": "pending"},
        782: {"PansMemoryGrows": "firing"},
        960: {"PansMemoryGrows": "firing", "PansGone": "firing"},
    }
    series = {
        "pans_alarm{instance='lab',kind='hot'}": "0x59 1x29 0x900",
        "pans_alarm_times_expected{instance='lab',kind='hot'}": "_x59 12.34x29 _x900",
        "pans_alarm{instance='lab',kind='light'}": "0x990",
        "pans_running": "_ 1x940 _x50",
        "pans_last_run_failed{folder='run-1'}": "1x990",
        "pans_uptime_seconds": "0+60x990",
        "pans_resident_memory_bytes": "0+1000000x990",
    }
    found = 'count by (alertname, alertstate) (ALERTS{alertname=~"PansAlarm|PansGone|PansRunFailed|PansMemoryGrows"})'
    asked = [
        (minute, found, [f'{{alertname="{name}", alertstate="{state}"}}' for name, state in wanted.items()])
        for minute, wanted in states.items()
    ]
    labels = {"instance": "lab", "kind": "hot", "severity": "critical"}
    summary = "lab: the dark counts have changed (hot): 12.3 times the expected rate "
    summary += "(docs/how-to/dark-counts.md tells what that means and what to do)"
    check_rules(tmp_path, series, asked, (60, "PansAlarm", labels, summary))


def test_dark_counts_alarm_on_another_rate_and_not_on_few_clicks(tmp_path: Path) -> None:
    """Six days at six constant Poisson rates, five of which have a day before; and rises and a fall after two days."""
    hours, random, after = 144, np.random.default_rng(1), 48
    constant = {"0.05": 0.05, "0.5": 0.5, "5": 5.0, "20": 20.0, "50": 50.0, "500": 500.0}
    per_hour = {name: np.full(hours, rate) for name, rate in constant.items()}
    per_hour |= {"0.5 to 100": np.repeat([0.5, 100.0], [after, hours - after])}
    per_hour |= {"5 to 50": np.repeat([5.0, 50.0], [after, hours - after])}
    per_hour |= {"100 to 10": np.repeat([100.0, 10.0], [after, hours - after])}
    series = {}
    for name, rates in per_hour.items():
        clicks = np.cumsum(random.poisson(np.repeat(rates / 12, 12)))
        series[f"pans_dark_clicks_total{{instance='{name}'}}"] = " ".join(map(str, clicks))
        series[f"pans_dark_exposures_total{{instance='{name}'}}"] = f"0+1550x{12 * hours}"
    firing = 'ALERTS{alertname="PansDarkCountsChanged", alertstate="firing"}'
    changed = [f'{{instance="{name}"}}' for name in per_hour if name not in constant]
    asked = [
        (60 * hour, f"count by (instance) (count_over_time({firing}[{past}h]))", wanted)
        for hour, past, wanted in ((after, after, []), (after + 2, 1, changed), (hours, hours, changed))
    ]
    check_rules(tmp_path, series, asked, minutes=5)


def check_rules(
    folder: Path,
    series: dict[str, str],
    asked: list[tuple[int, str, list[str]]],
    *alerts: tuple[int, str, Any, str],
    minutes: int = 1,
) -> None:
    """`promtool test rules`, of `series` with a value every so many minutes: at a minute an expression is 1 for these labels, no others."""
    test = {
        "interval": f"{minutes}m",
        "input_series": [{"series": name, "values": values} for name, values in series.items()],
        "promql_expr_test": [
            {
                "eval_time": f"{minute}m",
                "expr": expression,
                "exp_samples": [{"labels": labels, "value": 1} for labels in wanted],
            }
            for minute, expression, wanted in asked
        ],
        "alert_rule_test": [
            {
                "eval_time": f"{minute}m",
                "alertname": name,
                "exp_alerts": [{"exp_labels": labels, "exp_annotations": {"summary": summary}}],
            }
            for minute, name, labels, summary in alerts
        ],
    }
    told = {"rule_files": [str(RULES)], "evaluation_interval": f"{minutes}m", "tests": [test]}
    (folder / "test.json").write_text(json.dumps(told))
    promtool("test", "rules", str(folder / "test.json"))


def promtool(*words: str, text: str = "") -> str:
    """What promtool says, which must be content; skips where it is not installed."""
    program = shutil.which("promtool")
    if program is None:
        pytest.skip("needs promtool")
    done = subprocess.run([program, *words], input=text, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr
