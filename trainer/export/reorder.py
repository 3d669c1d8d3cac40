"""A bundle whose patterns are shown in another order: tables, heads and golden vectors go with them.

Owns the permutation of every back end; which order is ordering.py's. The bundle is made anew, so that all its golden vectors are
computed and its table is held against its head. It decides on the same readings of the same patterns as before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.layers import Int8Head, Layer, read_layers
from pans.runtime.bundle.model import BackEnd, Bundle, Shown, make_bundle
from pans.runtime.refit.onnx_chain import chain_onnx
from pans.trainer.evaluate.shown import demand_fixed_patterns

from .ordering import Order


def reordered(bundle: Bundle, order: Sequence[int], facts: Mapping[str, Any]) -> Bundle:
    """Return `bundle` with pattern `order[i]` as its pattern i, and `facts` beside its provenance.

    ValueError for what is no order of its patterns, for a bundle without fixed patterns, and for a head that is no plain chain of layers.
    """
    places = [int(place) for place in order]
    demand_fixed_patterns(bundle)
    if sorted(places) != list(range(bundle.n_features)):
        raise ValueError(f"{places[:20]} is no order of {bundle.n_features} patterns")
    return make_bundle(
        name=bundle.name,
        task=bundle.task,
        classes=bundle.classes,
        image_shape=bundle.image_shape,
        optics=Shown(bundle.levels, bundle.pattern_levels[places], bundle.photons_per_level),
        provenance={**bundle.provenance, **facts},
        back_end=_back_end(bundle, places),
    )


def order_facts(order: Order, bundle: Bundle) -> dict[str, Any]:
    """Return what a bundle says of its order; pattern numbers are those of `bundle`, as it was before."""
    told = bundle.provenance.get("order")
    first = list(order.patterns)
    if isinstance(told, Mapping) and isinstance(told.get("patterns"), Sequence):
        first = [int(told["patterns"][place]) for place in order.patterns]  # of the bundle as it was trained
    bits = [round(value, 5) for value in order.bits]
    return {"order": {"by": order.by, "patterns": first, "bits": bits, "objects": order.objects, "exact": order.exact}}


def _back_end(bundle: Bundle, places: list[int]) -> BackEnd:
    outcomes = bundle.largest + 1
    table = None if bundle.table is None else bundle.table[_old_rows(places, outcomes)]
    if bundle.head_onnx is None:
        return BackEnd(table=table, outcomes=outcomes)
    layers = read_layers(bundle.head_onnx, bundle.n_features, bundle.n_classes)
    if layers is None:
        raise ValueError(
            f"the head of {bundle.name} is no plain chain of layers (Gemm, Relu), which alone can be reordered"
        )
    first = Layer(np.ascontiguousarray(layers[0].weights[places]), layers[0].bias, layers[0].relu)
    int8 = None if bundle.int8_head is None else _int8(bundle.int8_head, places)
    quantised = None
    if int8 is not None and bundle.int8_onnx is not None:
        from .int8_onnx import int8_onnx  # and the package onnx, which nothing else here needs

        quantised = int8_onnx(int8)
    return BackEnd(chain_onnx((first, *layers[1:])), table, int8, quantised, outcomes)


def _old_rows(places: list[int], outcomes: int) -> NDArray[np.int64]:
    """The row of the old table for each of the new one: digit i was that of pattern places[i]."""
    word = np.arange(outcomes ** len(places), dtype=np.int64)
    return np.asarray(sum(word // outcomes**new % outcomes * outcomes**old for new, old in enumerate(places)), np.int64)


def _int8(head: Int8Head, places: list[int]) -> Int8Head:
    n_in, n_out = (int(size) for size in head.sizes[:2])
    first = head.weights[: n_in * n_out].reshape(n_in, n_out)[places].ravel()
    return Int8Head(head.sizes, np.concatenate([first, head.weights[n_in * n_out :]]), head.affine)
