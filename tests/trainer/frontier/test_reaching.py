"""Passive rows beside direct imaging at the light that they need: which way counts, how much light it gets, what the verdict is."""

# ruff: noqa: E402  (what follows needs torch)
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")

from pans.trainer.frontier import reaching
from pans.trainer.paper.page import Asked


def ours(value, light, encoder="unconstrained"):
    row = dict.fromkeys(("spread_trials", "clicks", "photons", "illumination", "features", "dark"), 1.0)
    return row | {"task": "fiber", "value": value, "error_objects": 0.3, "reaching": light, "encoder": encoder}


def test_the_better_way_counts_and_gets_no_more_than_its_limit(monkeypatch, tmp_path):
    asked_for = []

    def direct(_asked, name, way, photons):
        asked_for.append((way, photons))
        return {
            "way": way,
            "value": {"posterior": 70.0, "photon pairs": 90.0}[way],
            "photons": photons,
            "error_objects": 0.4,
            "spread_trials": 0.1,
        }

    monkeypatch.setattr(reaching, "WAYS", {"fiber": ("photon pairs", "posterior")})
    monkeypatch.setattr(reaching, "_unconstrained", lambda *_: [ours(88.0, 4e6)])
    monkeypatch.setattr(reaching, "_conserving", lambda *_: [ours(90.9, 25.0, "conserving")])
    monkeypatch.setattr(reaching, "_direct", direct)
    made = reaching.reaching_page(Asked("reaching", tmp_path))
    assert asked_for == [("photon pairs", 1e6), ("posterior", 1e4), ("photon pairs", 25.0), ("posterior", 25.0)]
    conserving, unconstrained = reaching.reaching_tables(made.rows)
    assert conserving.heading == "## W conserving"
    assert conserving.lines()[-3].endswith("| +0.90 | 0.50 | level |")  # errors of 0.3 and 0.4 points: 0.5 together
    assert unconstrained.lines()[-3].endswith("| -2.00 | 0.50 | below |")
    pytest.importorskip("matplotlib", reason="needs the plot extra")
    made.pictures[""](tmp_path / "r.png")
    assert (tmp_path / "r.png").stat().st_size > 5000


def test_a_row_whose_light_is_not_known_or_not_measured_is_left_out(monkeypatch, tmp_path):
    monkeypatch.setattr(reaching, "_unconstrained", lambda *_: [ours(88.0, 4e6)])
    monkeypatch.setattr(reaching, "_conserving", lambda *_: [])
    assert reaching.reaching_page(Asked("reaching", tmp_path, collect=True)).rows == []
