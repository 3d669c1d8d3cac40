"""Benchmarks measure the right things: their inputs, their checks and their report; never a speed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from bundles import made_bundle
from heads import head_bundle, onnx_chain, random_layers

from pans.runtime.bench import decide as bench_decide
from pans.runtime.bench import ingest as bench_ingest
from pans.runtime.bench.c import FREE_FLAGS, CLoops, c_loops
from pans.runtime.bench.decide import _bundle_rows, alone_row
from pans.runtime.bench.rows import (
    BenchOptions,
    Spent,
    machine_facts,
    mark_pareto,
    percentiles_us,
    repeated,
    table_text,
)
from pans.runtime.bundle.layers import quantise_head
from pans.runtime.cli import main
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.mlp import SparseDecider
from pans.runtime.turn.streaming import StreamCore
from pans.runtime.wire.framing import FrameDecoder


def test_the_best_trade_offs_are_marked() -> None:
    rows = [
        {"name": str(i), "ns": ns, "score_error": e}
        for i, (ns, e) in enumerate([(1, 3), (2, 1), (2, 2), (3, 1), (1, 3)])
    ]
    rows.append({"name": "limit", "ns": 0})
    mark_pareto(rows, "ns", "score_error")
    assert [row.get("pareto") for row in rows] == [True, True, False, False, True, None]


def test_percentiles_are_of_the_calls() -> None:
    found = percentiles_us(np.arange(1, 100_001) * 1000)
    assert found == {
        "p50_us": 50_000.5,
        "p99_us": 99_000.01,
        "p999_us": 99_900.001,
        "max_us": 100_000.0,
        "calls": 100_000,
    }


def test_repeated_repeats() -> None:
    calls: list[int] = []
    repeated(lambda: calls.append(1), 5)()
    assert len(calls) == 5


def test_rows_read_as_text_and_facts_are_json() -> None:
    assert table_text([{"name": "a", "bench": "x", "ns": 1.23456, "n": 3_000_000}]) == "a  ns 1.235  n 3.000e+06"
    assert json.loads(json.dumps(machine_facts()))["cores"]


def test_c_decides_as_our_kernel_does() -> None:
    loops = c_loops()
    if not isinstance(loops, CLoops):
        pytest.skip(loops)
    decider = SparseDecider(head_bundle(random_layers([10, 32, 7])))
    counts = np.random.default_rng(0).integers(0, 2, (200, 10))
    wanted = decider.decide_batch(counts, 1)
    for loop in ("sparse_groups", "sparse_plain"):
        assert (loops.sparse(loop, counts, *decider.layers, 7) == wanted).all()


def test_single_decisions_are_timed_and_right() -> None:
    decider = SparseDecider(head_bundle(random_layers([10, 32, 7])))
    counts = np.random.default_rng(0).integers(0, 2, (200, 10))
    row = alone_row(decider, counts, 1)
    if "skipped" not in row:
        assert row["checksum"] == decider.decide_batch(counts, 1).sum()
        assert 0 <= row["clock_us"] <= row["p50_us"] <= row["max_us"]
        assert row["calls"] == 200


def test_every_back_end_has_its_error_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_decide, "SINGLE_CALLS", 400)
    monkeypatch.setattr(bench_decide, "cpu_time", lambda work, repeats=1: (work(), Spent(1e-3, 1e-3, 1))[1])
    layers = random_layers([6, 16, 4])
    bundle = head_bundle(layers, int8_head=quantise_head(layers))
    rows = {row["name"]: row for row in _bundle_rows(bundle, None, 300)}
    assert rows["chain table"]["changed_percent"] == rows["chain sparse"]["changed_percent"] == 0
    assert 0 < rows["chain int8"]["score_error"] < 0.2
    assert rows["chain float64"]["score_error"] < 1e-5
    assert any(row.get("pareto") for row in rows.values())


def test_a_picture_has_its_error_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_decide, "cpu_time", lambda work, repeats=1: (work(), Spent(1e-3, 1e-3, 1))[1])
    layers = random_layers([6, 16, 12])
    bundle = made_bundle(
        name="chain",
        task="pictures",
        classes=(),
        image_shape=(1, 6),
        levels=2,
        pattern_levels=np.eye(6, dtype=np.uint16),
        photons_per_level=1.0,
        head_onnx=onnx_chain(layers),
        picture_shape=(3, 4),
    )
    row = bench_decide._picture_row(bundle, 50)
    assert row["name"] == "chain picture of 12 pixels, onnx"
    assert 0 < row["score_error"] < 1e-5


def test_streams_have_the_frames_and_zeros_they_promise() -> None:
    data, n_frames = bench_ingest._wire(0.9)
    frames = FrameDecoder().feed(data[: len(data) // 8])
    payload = np.frombuffer(b"".join(frame.payload[36:] for frame in frames), np.uint8)
    assert n_frames == bench_ingest.STREAM_BYTES // bench_ingest.PAYLOAD_BYTES
    assert abs((payload == 0).mean() - 0.9) < 5 * (0.09 / len(payload)) ** 0.5


@pytest.mark.parametrize("shots", [1, 3])
def test_a_renumbered_stretch_continues_the_stream(monkeypatch: pytest.MonkeyPatch, shots: int) -> None:
    monkeypatch.setattr(bench_ingest, "VISIT_FRAMES", 12)
    monkeypatch.setattr(bench_ingest, "BLOCK_FRAMES", 5)
    plan = bench_ingest.parallel_plan(4, shots)
    decider = make_decider(
        head_bundle(random_layers([4, 5, 3])), shots=shots, backend="table" if shots == 1 else "sparse"
    )
    stretch = bench_ingest._Renumbered(b"".join(bench_ingest.visits(plan, 0, 2, 0)), plan)
    core = StreamCore(plan, decider, shots, 0, bench_ingest.SESSION)
    messages = 1 + -(-plan.slots_per_cycle // 5)
    rows = 0
    for start in (0, 2, 4):
        rows += sum(len(batch.rows) for batch in core.feed(stretch.at(start, start * messages)))
    counters = core.core.tracker.counters
    assert (rows, counters.exposures, counters.lost_exposures, counters.lost_messages) == (72 // shots, 84, 0, 0)


def test_the_command_prints_one_object(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from pans.runtime.commands import bench as cmd_bench

    seen: list[BenchOptions] = []

    def bench(options: BenchOptions) -> list[dict[str, object]]:
        seen.append(options)
        return [{"name": "a", "ns": np.float32(2)}]

    monkeypatch.setattr(cmd_bench, "_find", lambda name: bench if name != "link" else None)
    assert main(["bench", "all", "--json", "--quick", "--frames", "7"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["bench"] for row in found["rows"]] == ["decide", "loop", "ingest", "turn", "sim"]
    assert (seen[0].quick, seen[0].frames) == (True, 7)
    assert "processor" in found["machine"]
    with pytest.raises(SystemExit, match="2"):
        main(["bench", "loop", "--seconds", "0"])


def test_the_simulators_benchmark_counts_wrong_bits() -> None:
    from pans.firmware_sim.commands import bench_clicks as bench_sim

    row = bench_sim._click_row("both", bench_sim.EFFECTS["+ afterpulsing and crosstalk"], quick=True)
    assert (row["bits_wrong"], row["name"]) == (0, "SIMULATED clicks, both")


def test_the_free_loops_leave_subnormal_numbers_alone():
    loops = c_loops(FREE_FLAGS)
    if not isinstance(loops, CLoops):
        pytest.skip(loops)
    assert np.float64(5e-324) * 1.0 > 0.0
    assert np.array([1e-310]) / 2 > 0.0
