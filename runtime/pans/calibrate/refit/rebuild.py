"""Labelled clicks in, rows and scores of each kind of back end out; then a correction in, the new bundle out.

An automaton's posteriors and a table are corrected number by number, a head in its layers (its table is made from it again). `chain_onnx`
writes layers as an ONNX model without the onnx package; a bundle holds every head against its golden vectors when it is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base import __version__
from pans.base.errors import UsageError
from pans.bundle.automaton import Automaton, log_scores, walk_nodes
from pans.bundle.heads import FLOAT, Layer, protobuf, quantise_head, read_layers, reference_scores
from pans.bundle.sensor import BackEnd, Bundle, Shown, make_bundle, word_means

from .choosing import Kind, Refitted, choose
from .clicks import Labelled
from .evidence import F64, I64, Correction, Evidence, centred, evidence_of, log_softmax

OPSET, IR_VERSION = 17, 8  # as the trainer's heads
Field = tuple[int, int | bytes | str]
_LEAST = 1e-9  # of a posterior, so that no class is ever excluded for good


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The evidence, and what its rows are: leaves, table rows, or (of a head alone) nothing that has a number."""

    evidence: Evidence
    number: I64  # (rows,)
    own_posteriors: bool  # whether a row can be corrected by itself


@dataclass(frozen=True, slots=True, eq=False)
class Rebuilt:
    """The new bundle, and what else had to change."""

    bundle: Bundle
    slots_corrected: int  # of an automaton: exposures after which the states' posteriors were corrected too
    notes: tuple[str, ...]


def rows_of(bundle: Bundle, clicks: Labelled) -> Rows:
    """Return the rows that the labelled clicks came to, with the old back end's scores; UsageError for a bundle that has none."""
    if bundle.picture_shape is not None:
        raise UsageError(f"{bundle.name} returns pictures", remedy="refit a bundle that decides among classes")
    layers = _layers(bundle)
    if bundle.automaton is not None:
        scores, means = log_scores(bundle.automaton.posteriors), np.zeros((len(bundle.automaton.posteriors), 0))
        found = walk_nodes(bundle.automaton, clicks.counts)[:, -1].astype(np.int64)
    elif bundle.table is not None and clicks.shots == 1:
        scores, means = bundle.table, _table_means(bundle, bundle.table)
        found = clicks.counts @ bundle.outcomes ** np.arange(bundle.n_features, dtype=np.int64)
    elif layers is None:
        raise UsageError(
            f"the head of {bundle.name} is no plain chain of layers (Gemm, Relu), and there is no table for {clicks.shots} shots",
            remedy="refit a bundle with a table, on recordings of --shots 1",
        )
    else:
        vectors, row = np.unique(clicks.counts, axis=0, return_inverse=True)
        seen = vectors / (clicks.shots * bundle.largest)
        of_head = reference_scores(layers, seen)
        # the noise of shots is known of clicks, not of photon numbers
        shots = clicks.shots if bundle.largest == 1 else 1
        evidence = evidence_of(of_head, seen, row.reshape(-1), clicks.truth, clicks.object_id, shots)
        return Rows(evidence, np.arange(len(vectors)), own_posteriors=False)
    number, row = np.unique(found, return_inverse=True)
    evidence = evidence_of(scores[number], means[number], row, clicks.truth, clicks.object_id)
    return Rows(evidence, number, own_posteriors=layers is None)


def _layers(bundle: Bundle) -> tuple[Layer, ...] | None:
    if bundle.head_onnx is None:
        return None
    layers = read_layers(bundle.head_onnx, bundle.n_features, bundle.n_classes)
    return None if layers is None or layers[-1].relu else layers


def rebuilt(bundle: Bundle, rows: Rows, found: Refitted, clicks: Labelled, provenance: Mapping[str, Any]) -> Rebuilt:
    """Return `bundle` with what was `found` in place of its back end, and `provenance` added to its own; the old one where nothing was."""
    facts = {**bundle.provenance, "refit": dict(provenance)}
    if found.correction is None:
        return Rebuilt(replace(bundle, provenance=facts), 0, ())
    automaton, back_end, slots, notes = None, None, 0, list[str]()
    layers = _layers(bundle)
    if bundle.automaton is not None:
        automaton, slots = _automaton(bundle.automaton, rows, found.scores, found.correction, clicks)
        if bundle.expected is not None:
            notes.append("the expected figures were the old instrument's, and are left out")
    elif layers is None:
        back_end = BackEnd(table=_table(bundle, rows, found.scores, found.correction), outcomes=bundle.outcomes)
        if bundle.head_onnx is not None:
            notes.append("only the table is refitted: the head is no plain chain, and left out")
    else:
        new, int8 = corrected_layers(layers, found.correction), None
        if bundle.int8_head is not None:
            try:
                int8 = quantise_head(new)
            except ValueError as error:
                notes.append(f"the head in eight bits is left out: {error}")
        if bundle.int8_onnx is not None:
            notes.append("the quantised ONNX model is left out: only the trainer writes it")
        back_end = BackEnd(head_onnx=chain_onnx(new), int8_head=int8, outcomes=bundle.outcomes)
    made = make_bundle(
        name=bundle.name,
        task=bundle.task,
        classes=bundle.classes,
        image_shape=bundle.image_shape,
        optics=bundle.analyser or Shown(bundle.levels, bundle.pattern_levels, bundle.photons_per_level),
        provenance=facts,
        back_end=back_end,
        automaton=automaton,
    )
    return Rebuilt(made, slots, tuple(notes))


def _table_means(bundle: Bundle, table: NDArray[np.float32]) -> F64:
    """What each pattern says in each row of the table, over the largest that it can say, (rows, d_f)."""
    return word_means(np.arange(len(table)), bundle.n_features, bundle.outcomes).astype(np.float64)


def _table(bundle: Bundle, rows: Rows, found: F64, correction: Correction) -> F64:
    """All rows by the correction; those that were seen as they were found."""
    assert bundle.table is not None
    scores = correction.apply(centred(bundle.table), _table_means(bundle, bundle.table))
    scores[rows.number] = found
    return scores


def _automaton(
    old: Automaton, rows: Rows, found: F64, correction: Correction, clicks: Labelled
) -> tuple[Automaton, int]:
    """Leaves as they were found; the states of each slot by a correction of their own where that is better."""
    scores, new = centred(log_scores(old.posteriors)), np.log(np.maximum(old.posteriors.astype(np.float64), _LEAST))
    none = np.zeros((len(scores), 0))
    new[old.n_states :] = correction.apply(scores, none)[old.n_states :]
    new[rows.number] = found
    nodes, corrected = walk_nodes(old, clicks.counts).astype(np.int64), 0
    for slot in range(old.n_slots):
        passed = nodes[:, slot] < old.n_states
        if not passed.any():
            continue
        number, row = np.unique(nodes[passed, slot], return_inverse=True)
        truth, object_id = clicks.truth[passed], clicks.object_id[passed]
        evidence = evidence_of(scores[number], none[number], row, truth, object_id)
        better = choose(evidence, (Kind(correction.blocks), Kind(correction.blocks, rows=True)))
        if better.correction is not None:
            states = old.depth == slot
            new[: old.n_states][states] = better.correction.apply(scores, none)[: old.n_states][states]
            new[number] = better.scores
            corrected += 1
    posteriors = np.maximum(np.exp(log_softmax(new)), _LEAST)
    posteriors /= posteriors.sum(axis=1, keepdims=True)
    return replace(old, posteriors=posteriors.astype(np.float32)), corrected


# ---- a chain of layers as ONNX ----


def corrected_layers(layers: tuple[Layer, ...], correction: Correction) -> tuple[Layer, ...]:
    """Return the layers whose scores are the corrected ones; the last one must not be rectified.

    Where the correction reads the clicks, each hidden layer passes them on next to its own values: they are 0 or more, which a rectifier
    leaves as it is.
    """
    *hidden, last = layers
    n_clicks, n_classes = layers[0].weights.shape[0], last.weights.shape[1]
    mixed = np.eye(n_classes) - 1.0 / n_classes  # centres the scores
    if "scores" in correction.blocks:
        mixed += mixed @ correction.gain[:n_classes]
    weights, bias = last.weights.astype(np.float64) @ mixed, last.bias.astype(np.float64) @ mixed + correction.offset
    if "clicks" in correction.blocks:
        of_clicks = correction.gain[-n_clicks:]
        weights = np.concatenate([weights, of_clicks]) if hidden else weights + of_clicks
        for number, layer in enumerate(hidden):
            n_in, n_out = layer.weights.shape
            wide = np.zeros((n_in + (n_clicks if number else 0), n_out + n_clicks), np.float32)
            wide[:n_in, :n_out] = layer.weights
            wide[-n_clicks:, n_out:] = np.eye(n_clicks)
            hidden[number] = Layer(wide, np.append(layer.bias, np.zeros(n_clicks, np.float32)), layer.relu)
    return (*hidden, Layer(weights.astype(np.float32), bias.astype(np.float32), relu=False))


def chain_onnx(layers: tuple[Layer, ...]) -> bytes:
    """Return the layers as an ONNX model: `clicks` float32 (decisions, d_f) -> `scores` float32 (decisions, classes)."""
    nodes, tensors, current = list[Field](), list[Field](), "clicks"
    for number, layer in enumerate(layers):
        is_last = number == len(layers) - 1
        steps = [("Gemm", (f"w{number}", f"b{number}"), f"x{number}"), ("Relu", (), f"h{number}")][: 1 + layer.relu]
        for op, more, result in steps:
            output = "scores" if is_last and op == steps[-1][0] else result
            nodes.append((1, protobuf(*((1, name) for name in (current, *more)), (2, output), (4, op))))
            current = output
        for name, values in zip(steps[0][1], (layer.weights, layer.bias)):
            dims = [(1, size) for size in values.shape]
            tensors.append((5, protobuf(*dims, (2, FLOAT), (8, name), (9, values.astype("<f4").tobytes()))))
    ends: list[Field] = []
    for field, name, width in ((11, "clicks", layers[0].weights.shape[0]), (12, "scores", layers[-1].weights.shape[1])):
        shape = protobuf((1, protobuf((2, "decisions"))), (1, protobuf((1, width))))
        ends.append((field, protobuf((1, name), (2, protobuf((1, protobuf((1, FLOAT), (2, shape))))))))
    graph = protobuf(*nodes, (2, "head"), *tensors, *ends)
    return protobuf(
        (1, IR_VERSION), (2, "pans-runtime"), (3, __version__), (7, graph), (8, protobuf((1, ""), (2, OPSET)))
    )
