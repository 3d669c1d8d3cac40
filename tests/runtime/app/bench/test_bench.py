"""Benchmarks measure the right things: their inputs, their checks and their report; never a speed."""

import json
from pathlib import Path

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from heads import head_bundle, random_layers

from pans.app.bench import against, decide, ingest, streams, turn
from pans.app.bench.rows import BenchOptions, Spent, machine_facts, percentiles_us, table_text
from pans.app.main import main
from pans.base.errors import EXIT_USAGE, UsageError
from pans.bundle.backends.choose import make_decider
from pans.bundle.heads.layers import quantise_head
from pans.bundle.sensor.bundle import load_bundle
from pans.decide.decision import DECISION_DTYPE
from pans.decide.kernel.stream_core import StreamCore
from pans.decide.kernel.system_calls import offered
from pans.protocol.wire.framing import FrameDecoder

compiled = pytest.mark.skipif(bool(offered()), reason="no compiled turn here")


def test_figures_are_of_the_calls_and_read_as_text() -> None:
    found = percentiles_us(np.arange(1, 100_001) * 1000)
    assert (found["p50_us"], found["p999_us"], found["max_us"], found["calls"]) == (50_000.5, 99_900.001, 1e5, 100_000)
    assert table_text([{"name": "a", "bench": "x", "ns": 1.23456, "n": 3_000_000}]) == "a  ns 1.235  n 3.000e+06"
    assert json.loads(json.dumps(machine_facts()))["cores"]


def test_every_back_end_has_its_error_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decide, "SINGLE_CALLS", 400)
    monkeypatch.setattr(decide, "cpu_time", lambda work, repeats=1: (work(), Spent(1e-3, 1e-3, 1))[1])
    layers = random_layers([6, 16, 4])
    bundle = head_bundle(layers, int8_head=quantise_head(layers))
    rows = {row["name"]: row for row in decide.bundle_rows(bundle, None, 300)}
    assert rows["chain table"]["changed_percent"] == rows["chain sparse"]["changed_percent"] == 0
    assert 0 < rows["chain int8"]["score_error"] < 0.2
    assert rows["chain float64"]["score_error"] < 1e-5


def test_rows_of_walks_have_their_checks() -> None:
    bundle = automaton_bundle(random_automaton(3))
    rows = [decide.walk_row(bundle, 2000), *ingest.stream_rows(bundle, quick=True)]
    assert [row["changed_percent"] for row in rows] == [0.0] * 3
    assert rows[0]["score_error"] == 0.0


def test_a_decision_that_differs_is_reported() -> None:
    wanted, found = np.zeros((2, 4), DECISION_DTYPE)
    found["label"][1] = 1
    parts = [found], [wanted[:2], wanted[2:]], [wanted[:3]]
    assert [streams.percent_changed(part, wanted) for part in parts] == [25.0, 0.0, 100.0]


def test_streams_have_the_frames_and_zeros_they_promise() -> None:
    data, n_frames = ingest.wire_stream(0.9)
    frames = FrameDecoder().feed(data[: len(data) // 8])
    payload = np.frombuffer(b"".join(frame.payload[36:] for frame in frames), np.uint8)
    assert n_frames == ingest.STREAM_BYTES // ingest.PAYLOAD_BYTES
    assert abs((payload == 0).mean() - 0.9) < 5 * (0.09 / len(payload)) ** 0.5


@pytest.mark.parametrize("shots", [1, 3])
def test_parallel_visits_continue_the_stream(monkeypatch: pytest.MonkeyPatch, shots: int) -> None:
    monkeypatch.setattr(streams, "VISIT_FRAMES", 12)
    monkeypatch.setattr(streams, "BLOCK_FRAMES", 5)
    plan = streams.parallel_plan(4, shots)
    bundle = head_bundle(random_layers([4, 5, 3]))
    decider = make_decider(bundle, shots=shots, backend="table" if shots == 1 else "sparse")
    core = StreamCore(plan, decider, shots, 0, streams.SESSION)
    rows = sum(len(batch.rows) for batch in core.feed(b"".join(streams.parallel_visits(plan, 6))))
    counters = core.core.tracker.counters
    assert (rows, counters.exposures, counters.lost_exposures, counters.lost_messages) == (72 // shots, 84, 0, 0)


@compiled
def test_work_that_is_timed_decides_as_the_plain_core() -> None:
    bundle, _ = load_bundle(BenchOptions().first_bundle)
    flow = turn.flow_row(bundle, True)
    assert flow["decisions"] == 100  # one every 500 of 400 blocks' frames
    for row in (turn.block_row(streams.made_automaton(), True), turn.frame_row(bundle, True), flow):
        assert row["changed_percent"] == 0.0, row["name"]


@compiled
@pytest.mark.parametrize("kind", turn.KINDS)
def test_round_trips_are_decided_as_by_the_plain_core(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = turn.built_device(tmp_path)
    if isinstance(device, str):
        pytest.skip(device)
    monkeypatch.setattr(turn, "ROUNDS", 1)
    bundle = streams.made_automaton()
    decider = make_decider(bundle)
    plan = streams.sequential_plan(bundle, decider, host=True)
    row = turn.trip_row(turn.Trips(kind, plan, decider, device, 300))
    assert (row["changed_percent"], row["command_bytes"]) == (0.0, 38)
    assert row["calls"] >= 270


def test_the_command_prints_one_object(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def bench(options: BenchOptions) -> list[dict[str, object]]:
        return [{"name": "a", "ns": np.float32(2), "quick": options.quick}]

    monkeypatch.setattr("pans.app.commands.bench.load_offered", lambda point: bench)
    assert main(["bench", "all", "--json", "--quick"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(row["bench"], row["quick"]) for row in found["rows"]] == [
        (name, True) for name in ("decide", "link", "loop", "ingest", "turn")
    ]
    assert "processor" in found["machine"]
    assert main(["bench", "turn", "--load"]) == 2
    with pytest.raises(SystemExit, match="2"):
        main(["bench", "loop", "--seconds", "0"])


def test_a_loss_of_pace_is_named_and_noise_is_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def row(name: str, p50: float, p99: float | None, late: int) -> dict[str, object]:
        return {
            "bench": "loop",
            "name": name,
            "p50_us": p50,
            "p99_us": p99,
            "p999_us": None,
            "late": late,
            "decisions": 1000,
        }

    file = tmp_path / "before.json"
    before = [row("a", 100.0, 500.0, 1), row("b", 100.0, None, 0), {"bench": "ingest", "name": "c", "ns": 1.0}]
    file.write_text(json.dumps({"machine": {}, "rows": before}))
    earlier = against.read_rows(file)
    assert sorted(earlier) == ["a", "b"]
    found, losses = against.compared([row("a", 114.0, 570.0, 3), row("new", 1.0, 1.0, 0)], earlier)
    assert (losses, len(found)) == ([], 1)
    assert (found[0]["p50_us_ratio"], found[0]["p99_us_ratio"], found[0]["p999_us_ratio"]) == (1.14, 1.14, None)
    _, losses = against.compared([row("a", 116.0, 600.0, 4), row("b", 90.0, 9e9, 1)], earlier)
    assert [loss.split(":")[1].split(" times")[0].split(" of 1000")[0] for loss in losses] == [
        *(" p50_us 1.16", " p99_us 1.2", " 4"),
    ]
    with pytest.raises(UsageError, match="there: a, b"):
        against.compared([row("new", 1.0, 1.0, 0)], earlier)
    for text in (
        "[]",
        "{}",
        '{"rows": 3}',
        '{"rows": [{"bench": "ingest", "name": "c"}]}',
        '{"rows": [1, {"name": 2}]}',
    ):
        file.write_text(text)
        assert main(["bench", "loop", "--against", str(file)]) == EXIT_USAGE
        assert str(file) in capsys.readouterr().err
    assert main(["bench", "decide", "--against", str(file)]) == EXIT_USAGE
