"""`pans bench decide`: every back end's speed beside its error, and the limits beside both, in one run.

Every back end decides the same varied inputs. Scores are compared with float64, decisions with the float64 decisions, and accuracy where
the inputs have labels.
"""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import UsageError, as_usage_error
from pans.bundle.automaton import log_scores, walk_nodes
from pans.bundle.backends import (
    BACKENDS,
    AutomatonDecider,
    Decider,
    PictureDecider,
    SparseDecider,
    bundle_layers,
    checked_counts,
    make_decider,
)
from pans.bundle.heads import read_layers, reference_scores
from pans.bundle.sensor import Bundle, load_bundle

from .rows import BenchOptions, Row, cpu_time, latencies_us, per_item_ns
from .streams import CLICK, made_automaton

I64 = NDArray[np.int64]
BATCH, PICTURES, WORDS = 20_000, 2_000, 20_000
SINGLE_CALLS, WALK_CALLS = 20_000, 5_000


def bench_decide(options: BenchOptions) -> list[Row]:
    """Return the rows of every bundle (the shipped one and a made-up automaton unless others are given)."""
    scale = 10 if options.quick else 1
    rows = [] if options.bundles else [walk_row(made_automaton(), WORDS // scale)]
    for number, path in enumerate(options.bundles or (options.first_bundle,)):
        bundle, _ = load_bundle(path)
        inputs = options.inputs[number] if number < len(options.inputs) else None
        if bundle.automaton is not None:
            rows.append(walk_row(bundle, WORDS // scale))
        elif bundle.largest > 1:
            what = f"{bundle.name} takes photon numbers, the benchmark draws clicks"
            raise UsageError(what, remedy="name a bundle of clicks")
        elif bundle.picture_shape is not None:
            rows.append(picture_row(bundle, PICTURES // scale))
        else:
            rows += bundle_rows(bundle, inputs, BATCH // scale)
    return rows


def walk_row(bundle: Bundle, n: int) -> Row:
    """Return the row of decisions on whole click words of an automaton, compared with the plain walk."""
    decider = AutomatonDecider(bundle)
    automaton = decider.automaton
    words = (np.random.default_rng(1).random((n, automaton.n_bits)) < CLICK).astype(np.int64)
    spent = cpu_time(lambda: decider.decide_batch(words, 1))
    leaves, exposures = decider.leaves(words)
    nodes = walk_nodes(automaton, words)[:, -1]
    wanted = log_scores(automaton.posteriors[nodes])
    return {
        "name": f"{bundle.name} {decider.name}",
        **per_item_ns(spent, n),
        "ns_per_exposure": round(spent.least_s / int(exposures.sum()) * 1e9, 3),
        **latencies_us(lambda one: decider.decide(one, 1), list(words[:WALK_CALLS])),
        "score_error": float(np.abs(decider.scores_batch(words, 1) - wanted).max()),
        "changed_percent": round(100 * float((leaves + automaton.n_states != nodes).mean()), 4),
        "exposures_mean": round(float(exposures.mean()), 2),
        "checksum": int(leaves.sum(dtype=np.int64)),
    }


def picture_row(bundle: Bundle, n: int) -> Row:
    """Return the row of a head that returns pictures: time for one, alone and in a batch, and the largest error of a pixel."""
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


def bundle_rows(bundle: Bundle, inputs: Path | None, n: int) -> list[Row]:
    """Return the rows of every back end that the bundle can have, then the limits beside them."""
    counts, shots, labels = _inputs(bundle, inputs, n)
    wanted = reference_scores(bundle_layers(bundle), counts / shots)
    rows: list[Row] = []
    for name in BACKENDS[1:]:  # but auto
        with suppress(UsageError):  # a back end that this bundle, or these shots, cannot have
            decider = make_decider(bundle, shots=shots, backend=name)
            rows.append(_backend_row(decider, bundle.name, (counts, shots), wanted, labels))
    with suppress(UsageError):
        rows += _limits(bundle, counts, shots)
    return rows


def _inputs(bundle: Bundle, path: Path | None, n: int) -> tuple[I64, int, I64 | None]:
    """Clicks to decide on: a file's (`counts` (n, d_f), `shots`, `labels` (n,)), else words whose clicks are as likely as not."""
    if path is None:
        return np.random.default_rng(1).integers(0, 2, (n, bundle.n_features)), 1, None
    with np.load(path, allow_pickle=False) as data:
        counts, shots = data["counts"].astype(np.int64), int(data["shots"])
        labels = data["labels"].astype(np.int64) if "labels" in data else None
    if counts.ndim != 2 or counts.shape[1] != bundle.n_features:
        raise UsageError(f"{path}: counts are {counts.shape}, allowed: (n, {bundle.n_features})")
    with as_usage_error():
        return checked_counts(counts, shots, bundle.n_features), shots, labels


def _backend_row(
    decider: Decider, bundle: str, inputs: tuple[I64, int], wanted: NDArray[np.float64], labels: I64 | None
) -> Row:
    counts, shots = inputs
    part = counts[:BATCH]
    singles = [counts[i % len(counts)] for i in range(SINGLE_CALLS)]
    row: Row = {
        "name": f"{bundle} {decider.name}",
        **per_item_ns(cpu_time(lambda: decider.decide_batch(part, shots)), len(part)),
        **latencies_us(lambda one: decider.decide(one, shots), singles),
    }
    scores, decided = decider.scores_batch(counts, shots), decider.decide_batch(counts, shots)
    best = wanted.argmax(axis=1)
    row["score_error"] = float(np.abs(scores - wanted).max())
    row["changed_percent"] = round(100 * float((decided != best).mean()), 4)
    row["checksum"] = int(decided.astype(np.int64).sum())
    if labels is not None:
        row["accuracy_change_points"] = round(100 * float((decided == labels).mean() - (best == labels).mean()), 4)
        row["accuracy_percent"] = round(100 * float((decided == labels).mean()), 3)
    return row


def _limits(bundle: Bundle, counts: I64, shots: int) -> list[Row]:
    """The same decisions by others: our kernel alone, onnxruntime as one would call it, torch eager."""
    import onnxruntime

    decider = SparseDecider(bundle)
    part = np.ascontiguousarray(counts[:BATCH])
    out = np.empty((len(part), decider.n_classes), np.float32), np.empty(len(part), np.uint16)
    probabilities = np.empty(len(part), np.float32)
    spent = cpu_time(lambda: decider.kernel(part, shots, *decider.layers, decider.room, *out, probabilities))
    name = f"{bundle.name} sparse, called from compiled code, one at a time"
    ours: Row = {"name": name, **per_item_ns(spent, len(part))}
    means = (part / shots).astype(np.float32)
    singles = [means[i % len(means)][None] for i in range(SINGLE_CALLS // 4)]
    others = [_torch_row(bundle, means, singles)]
    if bundle.head_onnx is not None:  # with the defaults and `session.run`, as the examples of onnxruntime have it
        session = onnxruntime.InferenceSession(bundle.head_onnx, providers=["CPUExecutionProvider"])
        name = session.get_inputs()[0].name
        times = latencies_us(lambda one: session.run(None, {name: one})[0].argmax(), singles)
        others.insert(0, {"name": f"{bundle.name} onnxruntime as a user calls it", **times})
    for row in others:
        if "p50_us" in row:
            row["p50_over_sparse"] = round(1000 * row["p50_us"] / ours["ns"], 1)
    return [ours, *others]


def _torch_row(bundle: Bundle, means: NDArray[np.float32], singles: list[NDArray[np.float32]]) -> Row:
    try:
        torch = import_module("torch")  # to measure against, where somebody has installed it
    except ModuleNotFoundError:
        return {"name": f"{bundle.name} torch eager", "skipped": "torch is not installed"}
    torch.set_num_threads(1)
    modules: list[Any] = []
    for layer in bundle_layers(bundle):
        linear = torch.nn.Linear(*layer.weights.shape)
        with torch.no_grad():
            linear.weight.copy_(torch.from_numpy(layer.weights.T.copy()))
            linear.bias.copy_(torch.from_numpy(layer.bias.copy()))
        modules += [linear, torch.nn.ReLU()] if layer.relu else [linear]
    head, batch = torch.nn.Sequential(*modules).eval(), torch.from_numpy(means)
    with torch.inference_mode():
        together = per_item_ns(cpu_time(lambda: head(batch).argmax(dim=1)), len(means))
        alone = latencies_us(lambda one: int(head(one).argmax()), [torch.from_numpy(one) for one in singles])
    return {"name": f"{bundle.name} torch eager, one thread", **together, **alone}
