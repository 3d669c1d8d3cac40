"""`pans bench decide`: every back end's speed beside its error, and the limits beside both, in one run.

Owns the rows of decisions and of streams of packed words. Every back end decides the same varied inputs; scores are compared with float64,
decisions with the float64 decisions, and accuracy where the inputs have labels.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.runtime.bundle.layers import read_layers, reference_scores
from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.kernels import float_run
from pans.runtime.decide.mlp import ReferenceDecider, SparseDecider
from pans.runtime.decide.onnx import PictureDecider
from pans.runtime.decide.table import TableDecider
from pans.runtime.decide.verdict import Decider, checked_counts
from pans.runtime.errors import UsageError, as_usage_error

from .c import FLAGS, FREE_FLAGS, CLoops, c_loops
from .rows import (
    BenchOptions,
    Row,
    cpu_time,
    cpu_times,
    latencies_us,
    mark_pareto,
    per_item_ns,
    percentiles_us,
    repeated,
)
from .walks import decide_rows, made_automaton

BATCH = 20_000
PICTURES = 2_000
SINGLE_CALLS = 20_000
STREAM_REPEATS = 15
CACHED_WORDS, MEMORY_WORDS = 1 << 15, 1 << 24  # 64 kB of 16-bit words, as a block of a stream; 32 to 128 MB
CLOCK_MONOTONIC = 1  # on Linux: time.perf_counter_ns reads the same
BACKENDS = ("table", "count-table", "sparse", "int8", "onnx", "int8-onnx", "float64")


def bench_decide(options: BenchOptions) -> list[Row]:
    """Return the rows of every bundle (the shipped one and a made-up automaton unless others are given), then of streams."""
    paths = options.bundles or (options.first_bundle,)
    rows: list[Row] = [] if options.bundles else decide_rows(made_automaton(), options.quick)
    for number, path in enumerate(paths):
        bundle, _ = load_bundle(path)
        inputs = options.inputs[number] if number < len(options.inputs) else None
        if bundle.automaton is not None:
            rows += decide_rows(bundle, options.quick)
            continue
        if bundle.largest > 1:
            raise UsageError(
                f"{bundle.name} takes photon numbers, the benchmark draws clicks", remedy="name a bundle of clicks"
            )
        if bundle.picture_shape is not None:
            rows.append(_picture_row(bundle, PICTURES // 10 if options.quick else PICTURES))
            continue
        rows += _bundle_rows(bundle, inputs, BATCH // 10 if options.quick else BATCH)
        if bundle.table is not None:
            rows += _stream_rows(bundle)
    return rows


def _bundle_rows(bundle: Bundle, inputs: Path | None, n: int) -> list[Row]:
    counts, shots, labels = _inputs(bundle, inputs, n)
    reference = ReferenceDecider(bundle)
    wanted = reference.scores_wide(counts, shots)
    rows: list[Row] = []
    for name in BACKENDS:
        with suppress(UsageError):  # a back end that this bundle, or these shots, cannot have
            rows.append(
                _backend_row(
                    make_decider(bundle, shots=shots, backend=name), bundle.name, counts, shots, wanted, labels
                )
            )
    with suppress(UsageError):
        rows += _limits(bundle, counts, shots, wanted)
    mark_pareto(rows, "ns", "score_error")
    return rows


def _picture_row(bundle: Bundle, n: int) -> Row:
    """A head that returns pictures: time for one, alone and in a batch, and the largest error of a pixel against float64."""
    decider = PictureDecider(bundle)
    counts = np.random.default_rng(1).integers(0, 2, (n, bundle.n_features))
    pixels = decider.scores_batch(counts, 1)
    row: Row = {
        "name": f"{bundle.name} picture of {pixels.shape[1]} pixels, {decider.name}",
        **per_item_ns(cpu_time(lambda: decider.scores_batch(counts, 1)), n),
        **latencies_us(lambda one: decider.decide(one, 1), list(counts)),
        "checksum": round(float(pixels.sum(dtype=np.float64)), 3),
    }
    chain = read_layers(bundle.head_onnx or b"", bundle.n_features, bundle.n_outputs)
    if chain is None:
        return row | {"score_error": "no float64 reference: the head is no plain chain of layers"}
    return row | {"score_error": float(np.abs(pixels - reference_scores(chain, counts.astype(np.float64))).max())}


def _inputs(bundle: Bundle, path: Path | None, n: int) -> tuple[NDArray[np.int64], int, NDArray[np.int64] | None]:
    """Clicks to decide on: a file's (`counts` (n, d_f), `shots`, `labels` (n,)), else words whose clicks are as likely as not."""
    if path is None:
        return np.random.default_rng(1).integers(0, 2, (n, bundle.n_features)), 1, None
    with np.load(path, allow_pickle=False) as data:
        counts, shots = data["counts"].astype(np.int64), int(data["shots"])
        labels = data["labels"].astype(np.int64) if "labels" in data else None
    if counts.ndim != 2 or counts.shape[1] != bundle.n_features:
        raise UsageError(f"{path}: counts are {counts.shape}, allowed: (n, {bundle.n_features})")
    with as_usage_error():
        counts = checked_counts(counts, shots, bundle.n_features)
    return counts, shots, labels


def _backend_row(decider: Decider, bundle: str, counts: NDArray[np.int64], shots: int, wanted: NDArray[np.float64],
                 labels: NDArray[np.int64] | None) -> Row:  # fmt: skip
    part = counts[:BATCH]
    spent = cpu_time(lambda: decider.decide_batch(part, shots))
    row: Row = {"name": f"{bundle} {decider.name}", **per_item_ns(spent, len(part))}
    singles = [counts[i % len(counts)] for i in range(SINGLE_CALLS)]
    row |= latencies_us(lambda one: decider.decide(one, shots), singles)
    return row | _errors(decider.scores_batch(counts, shots), decider.decide_batch(counts, shots), wanted, labels)


def _errors(
    scores: NDArray[Any], decided: NDArray[Any], wanted: NDArray[np.float64], labels: NDArray[np.int64] | None
) -> Row:
    best = wanted.argmax(axis=1)
    row: Row = {
        "score_error": float(np.abs(scores - wanted).max()),
        "changed_percent": round(100 * float((decided != best).mean()), 4),
        "checksum": int(decided.astype(np.int64).sum()),
    }
    if labels is not None:
        row["accuracy_change_points"] = round(100 * float((decided == labels).mean() - (best == labels).mean()), 4)
        row["accuracy_percent"] = round(100 * float((decided == labels).mean()), 3)
    return row


def _limits(bundle: Bundle, counts: NDArray[np.int64], shots: int, wanted: NDArray[np.float64]) -> list[Row]:
    """The same decisions by others: our kernel alone, the same loop in C, onnxruntime as one would call it, torch eager."""
    decider = SparseDecider(bundle)
    part = np.ascontiguousarray(counts[:BATCH])
    out = (
        np.empty((len(part), decider.n_classes), np.float32),
        np.empty(len(part), np.uint16),
        np.empty(len(part), np.float32),
    )
    run, layers, room = decider.kernel, decider.layers, decider.room
    spent = cpu_time(lambda: run(part, shots, *layers, room, *out))
    rows = [
        {
            "name": f"{bundle.name} sparse, called from compiled code, one at a time",
            **per_item_ns(spent, len(part)),
            **alone_row(decider, part, shots),
        }
    ]
    if shots == 1 and int(layers.meta[0]) == 2:
        rows += _c_rows(bundle, decider, part)
    others = _onnx_rows(bundle, counts, shots) + _torch_rows(bundle, counts, shots)
    for row in others:
        if "p50_us" in row and "p50_us" in rows[0]:
            row["p50_over_sparse"] = round(row["p50_us"] / rows[0]["p50_us"], 1)
    return rows + others


def _c_rows(bundle: Bundle, decider: SparseDecider, counts: NDArray[np.int64]) -> list[Row]:
    rows: list[Row] = []
    for flags, free in ((FLAGS, ""), (FREE_FLAGS, ", sums in any order")):
        loops = c_loops(flags)
        if not isinstance(loops, CLoops):
            return [{"name": f"{bundle.name} C", "skipped": loops}]
        for loop, word in (("sparse_groups", "the same loop"), ("sparse_plain", "a plain loop")):
            if loop == "sparse_groups" and not decider.layers.meta[-2]:
                continue
            spent = cpu_time(partial(loops.sparse, loop, counts, *decider.layers, decider.n_classes))
            decided = loops.sparse(loop, counts, *decider.layers, decider.n_classes)
            differs = float((decided != decider.decide_batch(counts, 1)).mean())
            name = f"{bundle.name} C, {word}, -O3 -march=native{free}"
            figures = per_item_ns(spent, len(counts))
            rows.append(
                {"name": name, **figures, "compiler": loops.compiler, "changed_percent": round(100 * differs, 4)}
            )
    return rows


def _onnx_rows(bundle: Bundle, counts: NDArray[np.int64], shots: int) -> list[Row]:
    """onnxruntime with its defaults and `session.run`, as its own examples have it."""
    import onnxruntime

    if bundle.head_onnx is None:
        return []
    session = onnxruntime.InferenceSession(bundle.head_onnx, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    means = (counts[:BATCH] / shots).astype(np.float32)
    singles = [means[i % len(means)][None] for i in range(SINGLE_CALLS // 4)]
    row = {"name": f"{bundle.name} onnxruntime as a user calls it"}
    return [row | latencies_us(lambda one: session.run(None, {name: one})[0].argmax(), singles)]


def _torch_rows(bundle: Bundle, counts: NDArray[np.int64], shots: int) -> list[Row]:
    try:
        torch = import_module("torch")  # to measure against, where somebody has installed it
    except ModuleNotFoundError:
        return [{"name": f"{bundle.name} torch eager", "skipped": "torch is not installed"}]
    from pans.runtime.decide.mlp import bundle_layers

    torch.set_num_threads(1)
    modules: list[Any] = []
    for layer in bundle_layers(bundle):
        linear = torch.nn.Linear(*layer.weights.shape)
        with torch.no_grad():
            linear.weight.copy_(torch.from_numpy(layer.weights.T.copy()))
            linear.bias.copy_(torch.from_numpy(layer.bias.copy()))
        modules += [linear, torch.nn.ReLU()] if layer.relu else [linear]
    head = torch.nn.Sequential(*modules).eval()
    means = torch.from_numpy((counts[:BATCH] / shots).astype(np.float32))
    singles = [means[i % len(means)][None] for i in range(SINGLE_CALLS // 4)]
    with torch.inference_mode():
        batch = per_item_ns(cpu_time(lambda: head(means).argmax(dim=1)), len(means))
        alone = latencies_us(lambda one: int(head(one).argmax()), singles)
    return [{"name": f"{bundle.name} torch eager, one thread", **batch, **alone}]


def _stream_rows(bundle: Bundle) -> list[Row]:
    """The table on streams of packed words against a copy of the same bytes, in the cache and out of memory."""
    decider = TableDecider(bundle)
    rows: list[Row] = []
    dtypes: tuple[Any, ...] = (np.uint16, np.uint32, np.uint64)
    for dtype in dtypes:
        for n, place in ((CACHED_WORDS, "in the cache"), (MEMORY_WORDS, "from memory")):
            words: NDArray[Any] = np.random.default_rng(2).integers(0, 1 << bundle.n_features, n).astype(dtype)
            out = np.empty(n, decider.labels.dtype)
            inner = max(1, MEMORY_WORDS // n)
            source, target = words.copy(), np.empty_like(words)
            works: list[Callable[[], Any]] = [
                partial(decider.decide_words, words, out),
                partial(np.copyto, target, source),
            ]
            spent, copied = cpu_times([repeated(work, inner) for work in works], STREAM_REPEATS)
            figures, copy_ns = per_item_ns(spent, n * inner), per_item_ns(copied, n * inner)
            exact = bool((out == decider.labels[words]).all())
            rows.append(
                {"name": f"{bundle.name} table, {8 * words.itemsize}-bit words {place}", **figures, "rate": round(1e9 / figures["ns"]),
                 "copy_ns": copy_ns["ns"], "of_copy_rate": round(copied.least_s / spent.least_s, 3),
                 "of_copy_rate_median": round(copied.median_s / spent.median_s, 3), "changed_percent": 0.0 if exact else 100.0,
                 "checksum": int(out.sum(dtype=np.int64))}
            )  # fmt: skip
    return rows


def alone_row(decider: SparseDecider, counts: NDArray[np.int64], shots: int) -> Row:
    """Percentiles of single decisions on counts (n, d_f) in wall time, us, and `clock_us`, what reading the clock costs in each."""
    run = _timed_calls()
    if run is None:
        return {"skipped": "this system has no clock_gettime"}
    times, clock = np.zeros(len(counts), np.int64), np.zeros(len(counts), np.int64)
    out = np.empty((1, decider.n_classes), np.float32), np.empty(1, np.uint16), np.empty(1, np.float32)
    labels = np.zeros(len(counts), np.uint16)
    spec = np.zeros(2, np.int64)
    for _ in range(2):  # the first time compiles
        run(counts, shots, *decider.layers, decider.room, *out, (spec, times, clock, labels))
    return {
        **percentiles_us(times),
        "clock_us": percentiles_us(clock)["p50_us"],
        "checksum": int(labels.sum(dtype=np.int64)),
    }


@cache
def _timed_calls() -> Any:
    """Compile a loop that times each call by itself; both clock readings are within its time, as where Python times a call."""
    try:
        gettime = ctypes.CDLL(None).clock_gettime
    except (AttributeError, TypeError, OSError):
        return None
    gettime.argtypes, gettime.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_int

    @njit
    def now_ns(spec):  # type: ignore[no-untyped-def]
        gettime(CLOCK_MONOTONIC, spec.ctypes)
        return spec[0] * 1_000_000_000 + spec[1]

    @njit
    def timed_calls(counts, shots, meta, numbers, room, scores, labels, probabilities, book):  # type: ignore[no-untyped-def]
        spec, times, clock, decided = book
        for i in range(counts.shape[0]):
            start = now_ns(spec)
            float_run(counts[i : i + 1], shots, meta, numbers, room, scores, labels, probabilities)
            times[i] = now_ns(spec) - start
            decided[i] = labels[0]
            start = now_ns(spec)
            clock[i] = now_ns(spec) - start

    return timed_calls
