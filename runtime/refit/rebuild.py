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

from pans.runtime.bundle import Automaton, BackEnd, Bundle, Shown, make_bundle
from pans.runtime.bundle.automaton import log_scores, walk_nodes
from pans.runtime.bundle.layers import Layer, quantise_head, read_layers, reference_scores
from pans.runtime.bundle.model import word_means
from pans.runtime.errors import UsageError

from .choosing import Kind, Refitted, choose
from .clicks import Labelled
from .evidence import F64, I64, Correction, Evidence, evidence_of, log_softmax

OPSET, IR_VERSION = 17, 8  # as the trainer's heads
_FLOAT = 1  # TensorProto.DataType
_LEAST = 1e-9  # of a posterior, so that no class is ever excluded for good


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The evidence, and what its rows are: leaves, table rows, or (of a head alone) nothing that has a number."""

    evidence: Evidence
    number: I64  # (rows,)
    own_posteriors: bool  # whether a row can be corrected by itself


@dataclass(frozen=True, slots=True, eq=False)
class Rebuilt:
    """The new bundle, and what had to change besides."""

    bundle: Bundle
    slots_corrected: int  # of an automaton: exposures after which the states' posteriors were corrected too
    notes: tuple[str, ...]


def rows_of(bundle: Bundle, clicks: Labelled) -> Rows:
    """Return the rows that the labelled clicks came to, with the old back end's scores; UsageError for a bundle that has none."""
    if bundle.picture_shape is not None:
        raise UsageError(f"{bundle.name} returns pictures", remedy="refit a bundle that decides among classes")
    if bundle.automaton is not None:
        leaves = walk_nodes(bundle.automaton, clicks.counts)[:, -1].astype(np.int64)
        return _rows(log_scores(bundle.automaton.posteriors), None, leaves, clicks, own_posteriors=True)
    if bundle.table is not None and clicks.shots == 1:
        words = clicks.counts @ bundle.outcomes ** np.arange(bundle.n_features, dtype=np.int64)
        return _rows(bundle.table, _table_means(bundle), words, clicks, own_posteriors=_layers(bundle) is None)
    layers = _layers(bundle)
    if layers is None:
        raise UsageError(
            f"the head of {bundle.name} is no plain chain of layers (Gemm, Relu), and there is no table for {clicks.shots} shots",
            remedy="refit a bundle with a table, on recordings of --shots 1",
        )
    vectors, row = np.unique(clicks.counts, axis=0, return_inverse=True)
    means = vectors / (clicks.shots * bundle.largest)
    scores = reference_scores(layers, means)
    shots = clicks.shots if bundle.largest == 1 else 1  # the noise of shots is known of clicks, not of photon numbers
    evidence = evidence_of(scores, means, row.reshape(-1), clicks.truth, clicks.object_id, shots)
    return Rows(evidence, np.arange(len(vectors)), own_posteriors=False)


def _rows(
    scores: NDArray[Any], means: NDArray[Any] | None, found: I64, clicks: Labelled, *, own_posteriors: bool
) -> Rows:
    """The rows that were seen, of `scores` (all rows, classes) and click `means` (all rows, d_f), None of nodes."""
    number, row = np.unique(found, return_inverse=True)
    seen = np.zeros((len(number), 0)) if means is None else means[number]
    return Rows(evidence_of(scores[number], seen, row, clicks.truth, clicks.object_id), number, own_posteriors)


def _layers(bundle: Bundle) -> tuple[Layer, ...] | None:
    if bundle.head_onnx is None:
        return None
    layers = read_layers(bundle.head_onnx, bundle.n_features, bundle.n_classes)
    return None if layers is None or layers[-1].relu else layers


def rebuilt(bundle: Bundle, rows: Rows, found: Refitted, clicks: Labelled, provenance: Mapping[str, Any]) -> Rebuilt:
    """Return `bundle` with what was `found` in place of its back end, and `provenance` beside its own; the old one where nothing was."""
    facts = {**bundle.provenance, "refit": dict(provenance)}
    if found.correction is None:
        return Rebuilt(replace(bundle, provenance=facts), 0, ())
    if bundle.automaton is not None:
        automaton, slots = _automaton(bundle.automaton, rows, found, clicks)
        notes = () if bundle.expected is None else ("the expected figures were the old instrument's, and are left out",)
        return Rebuilt(_made(bundle, facts, automaton=automaton), slots, notes)
    layers = _layers(bundle)
    if layers is None:
        left_out = "only the table is refitted: the head is no plain chain, and left out"
        table = BackEnd(table=_table(bundle, rows, found), outcomes=bundle.outcomes)
        return Rebuilt(_made(bundle, facts, table), 0, () if bundle.head_onnx is None else (left_out,))
    return _with_head(bundle, facts, layers, found)


def _with_head(bundle: Bundle, facts: dict[str, Any], layers: tuple[Layer, ...], found: Refitted) -> Rebuilt:
    assert found.correction is not None
    new, notes, int8 = corrected_layers(layers, found.correction), [], None
    if bundle.int8_head is not None:
        try:
            int8 = quantise_head(new)
        except ValueError as error:
            notes.append(f"the head in eight bits is left out: {error}")
    if bundle.int8_onnx is not None:
        notes.append("the quantised ONNX model is left out: only the trainer writes it")
    made = _made(bundle, facts, BackEnd(head_onnx=chain_onnx(new), int8_head=int8, outcomes=bundle.outcomes))
    return Rebuilt(made, 0, tuple(notes))


def _made(
    bundle: Bundle, provenance: dict[str, Any], back_end: BackEnd | None = None, automaton: Automaton | None = None
) -> Bundle:
    shown = Shown(bundle.levels, bundle.pattern_levels, bundle.photons_per_level)
    return make_bundle(
        name=bundle.name,
        task=bundle.task,
        classes=bundle.classes,
        image_shape=bundle.image_shape,
        optics=shown if bundle.analyser is None else bundle.analyser,
        provenance=provenance,
        back_end=back_end,
        automaton=automaton,
    )


def _table_means(bundle: Bundle) -> F64:
    """What each pattern says in each row of the table, over the largest that it can say, (rows, d_f)."""
    assert bundle.table is not None
    return word_means(np.arange(len(bundle.table)), bundle.n_features, bundle.outcomes).astype(np.float64)


def _table(bundle: Bundle, rows: Rows, found: Refitted) -> F64:
    """All rows by the correction; those that were seen as they were found."""
    assert found.correction is not None
    assert bundle.table is not None
    wide = bundle.table.astype(np.float64)
    centred = wide - wide.mean(axis=1, keepdims=True)
    scores = found.correction.apply(centred, _table_means(bundle))
    scores[rows.number] = found.scores
    return scores


def _automaton(old: Automaton, rows: Rows, found: Refitted, clicks: Labelled) -> tuple[Automaton, int]:
    """Leaves as they were found; the states of each slot by a correction of their own where that is better."""
    assert found.correction is not None
    scores = log_scores(old.posteriors).astype(np.float64)
    scores -= scores.mean(axis=1, keepdims=True)
    posteriors = old.posteriors.astype(np.float64)
    leaves = scores[old.n_states :]
    posteriors[old.n_states :] = np.exp(log_softmax(found.correction.apply(leaves, np.zeros((len(leaves), 0)))))
    posteriors[rows.number] = np.exp(log_softmax(found.scores))
    nodes, corrected = walk_nodes(old, clicks.counts).astype(np.int64), 0
    for slot in range(old.n_slots):
        here = np.flatnonzero(old.depth == slot)
        passed = nodes[:, slot] < old.n_states
        new = _of_slot(scores, nodes[passed, slot], clicks, passed, here, found.correction.blocks)
        if new is not None:
            posteriors[here] = new
            corrected += 1
    posteriors = np.maximum(posteriors, _LEAST)
    posteriors /= posteriors.sum(axis=1, keepdims=True)
    return replace(old, posteriors=posteriors.astype(np.float32)), corrected


def _of_slot(
    scores: F64, nodes: I64, clicks: Labelled, passed: NDArray[np.bool_], states: I64, blocks: tuple[str, ...]
) -> F64 | None:
    if not len(nodes):
        return None
    number, row = np.unique(nodes, return_inverse=True)
    seen = np.zeros((len(number), 0))
    evidence = evidence_of(scores[number], seen, row, clicks.truth[passed], clicks.object_id[passed])
    found = choose(evidence, (Kind(blocks), Kind(blocks, rows=True)))
    if found.correction is None:
        return None
    new = found.correction.apply(scores[states], np.zeros((len(states), 0)))
    new[np.searchsorted(states, number)] = found.scores
    return np.exp(log_softmax(new))


# ---- a chain of layers as ONNX ----


def corrected_layers(layers: tuple[Layer, ...], correction: Correction) -> tuple[Layer, ...]:
    """Return the layers whose scores are the corrected ones; the last one must not be rectified.

    Where the correction reads the clicks, each hidden layer passes them on beside its own values: they are 0 or more, which a rectifier
    leaves as it is.
    """
    last = layers[-1]
    n_classes, n_clicks = last.weights.shape[1], layers[0].weights.shape[0]
    of_scores, of_clicks = _parts(correction, n_classes, n_clicks)
    centred = np.eye(n_classes) - 1.0 / n_classes
    mixed = centred + centred @ of_scores
    weights, bias = last.weights.astype(np.float64) @ mixed, last.bias.astype(np.float64) @ mixed + correction.offset
    if len(layers) == 1:
        return (_layer(weights + of_clicks, bias, relu=False),)
    if not of_clicks.any():
        return (*layers[:-1], _layer(weights, bias, relu=False))
    beside = [_layer_beside(layer, n_clicks, first=number == 0) for number, layer in enumerate(layers[:-1])]
    return (*beside, _layer(np.concatenate([weights, of_clicks]), bias, relu=False))


def chain_onnx(layers: tuple[Layer, ...]) -> bytes:
    """Return the layers as an ONNX model: `clicks` float32 (n, d_f) -> `scores` float32 (n, classes)."""
    nodes, tensors, current = b"", b"", "clicks"
    for number, layer in enumerate(layers):
        result = "scores" if number == len(layers) - 1 and not layer.relu else f"x{number}"
        nodes += _field(1, _node("Gemm", [current, f"w{number}", f"b{number}"], result))
        tensors += _field(5, _tensor(f"w{number}", layer.weights)) + _field(5, _tensor(f"b{number}", layer.bias))
        current = result
        if layer.relu:
            result = "scores" if number == len(layers) - 1 else f"h{number}"
            nodes += _field(1, _node("Relu", [current], result))
            current = result
    n_in, n_out = layers[0].weights.shape[0], layers[-1].weights.shape[1]
    ends = _field(11, _value("clicks", n_in)) + _field(12, _value("scores", n_out))
    graph = nodes + _field(2, b"head") + tensors + ends
    opset = _field(8, _field(1, b"") + _number(2, OPSET))
    return _number(1, IR_VERSION) + _field(2, b"pans-runtime") + _field(7, graph) + opset


def _parts(correction: Correction, n_classes: int, n_clicks: int) -> tuple[F64, F64]:
    """The gains of scores (classes, classes) and clicks (d_f, classes), zeros where there is no such block."""
    blocks, gain = correction.blocks, correction.gain
    of_scores = gain[:n_classes] if "scores" in blocks else np.zeros((n_classes, n_classes))
    return of_scores, gain[-n_clicks:] if "clicks" in blocks else np.zeros((n_clicks, n_classes))


def _layer(weights: F64, bias: F64, *, relu: bool) -> Layer:
    return Layer(weights.astype(np.float32), bias.astype(np.float32), relu)


def _layer_beside(layer: Layer, n_clicks: int, *, first: bool) -> Layer:
    """The layer with the clicks passed on behind its own values."""
    n_in, n_out = layer.weights.shape
    wide = np.zeros((n_in if first else n_in + n_clicks, n_out + n_clicks))
    wide[:n_in, :n_out] = layer.weights
    wide[-n_clicks:, n_out:] = np.eye(n_clicks)
    return _layer(wide, np.concatenate([layer.bias, np.zeros(n_clicks)]), relu=layer.relu)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _field(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _node(op: str, inputs: list[str], output: str) -> bytes:
    ends = b"".join(_field(1, name.encode()) for name in inputs)
    return ends + _field(2, output.encode()) + _field(4, op.encode())


def _tensor(name: str, values: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> bytes:
    dims = b"".join(_number(1, size) for size in values.shape)
    return dims + _number(2, _FLOAT) + _field(8, name.encode()) + _field(9, values.astype("<f4").tobytes())


def _value(name: str, width: int) -> bytes:
    shape = _field(1, _field(2, b"n")) + _field(1, _number(1, width))
    return _field(1, name.encode()) + _field(2, _field(1, _number(1, _FLOAT) + _field(2, shape)))
