"""The shipped dashboard and alert rules: each metric that they name is served by a real run; promtool accepts the rules."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import threading
import urllib.request
from contextlib import suppress
from pathlib import Path

import pytest

from pans.firmware_sim.testing import small_setup
from pans.runtime import SHIPPED
from pans.runtime.bundle.model import write_bundle
from pans.runtime.watch.metrics import CAUSES, FIGURES, MetricsServer

RULES, DASHBOARD = SHIPPED / "prometheus-alerts.yml", SHIPPED / "grafana-dashboard.json"
METRIC = re.compile(r"\bpans_[a-z0-9_]+")
LABELS = re.compile(r"\{\{ ?(?:\$labels\.)?([a-z]+) ?\}\}")


def named(path: Path) -> set[str]:
    return set(METRIC.findall(path.read_text()))


@pytest.fixture(scope="module")
def scrapes(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What the endpoint of one real run answers, again and again until the run ends."""
    pytest.importorskip("prometheus_client", reason="needs the metrics extra")
    from pans.runtime.cli import main

    folder = tmp_path_factory.mktemp("run")
    write_bundle(small_setup("sequential")[1], folder / "grid.pans")
    servers: list[MetricsServer] = []
    begin = MetricsServer.__init__

    def noted(server: MetricsServer, *words: object) -> None:
        begin(server, *words)  # type: ignore[arg-type]
        servers.append(server)

    answers: list[str] = []
    ended = threading.Event()

    def scrape() -> None:
        while not ended.wait(0.1):
            if servers:
                address = f"http://{servers[0].host}:{servers[0].port}/metrics"
                with suppress(OSError):  # the run ends while it is asked
                    answers.append(urllib.request.urlopen(address, timeout=10).read().decode())

    reader = threading.Thread(target=scrape, daemon=True)
    reader.start()
    words = ["run", str(folder / "grid.pans"), "--device", "sim:ideal?scene=uniform&seed=3&pace=fast", "--metrics", "0"]
    patch = pytest.MonkeyPatch()
    patch.setattr(MetricsServer, "__init__", noted)
    patch.setattr("pans.runtime.watch.host.EVERY_S", 0.1)
    patch.setattr("pans.runtime.watch.host.SLOPE_LEAST_S", 0.2)
    try:
        assert main([*words, "--no-realtime", "--seconds", "20", "--rotate-mb", "1", "--out", str(folder / "out")]) in (
            0,
            1,
            4,
        )
    finally:
        ended.set()
        patch.undo()
    return answers


def test_every_metric_that_is_named_is_served(scrapes: list[str]) -> None:
    served = {line.split("{")[0].split(" ")[0] for text in scrapes for line in text.splitlines() if line[:1] != "#"}
    of_causes = {f"{name}_total" for name, _ in CAUSES.values()}  # a run without trouble has no causes to tell
    for path in (RULES, DASHBOARD):
        assert named(path) - served - of_causes == set(), path.name
        assert len(named(path)) >= 10
    assert {f"{name}_total" if counts else name for name, counts, _ in FIGURES.values()} - served == set()


def test_the_dashboard_is_one_that_grafana_reads() -> None:
    board = json.loads(DASHBOARD.read_text())
    assert board["uid"] == "pans-runs"
    assert {one["name"] for one in board["templating"]["list"]} == {"datasource", "instance"}
    for panel in board["panels"]:
        assert panel["targets"], panel["title"]
        for target in panel["targets"]:
            assert 'instance=~"$instance"' in target["expr"]
            assert target["expr"].count("(") == target["expr"].count(")")


def test_alerts_use_labels_that_exist() -> None:
    assert set(LABELS.findall(RULES.read_text())) <= {"instance"}
    assert set(LABELS.findall(DASHBOARD.read_text())) <= {"instance", "cause"}


def test_promtool_accepts_the_rules() -> None:
    program = shutil.which("promtool")
    if program is None:
        pytest.skip("needs promtool")
    done = subprocess.run([program, "check", "rules", str(RULES)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
