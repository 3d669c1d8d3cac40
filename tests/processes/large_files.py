"""The largest files that are accepted, of every kind of content that can make one large."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from bundles import made_bundle
from models import model

from pans.base.files.container import FILE_MAX_BYTES, JSON_VALUES_MAX, MIB
from pans.bundle.automaton import reachable_automaton
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.analyser import Analyser
from pans.bundle.sensor.bundle import BackEnd, make_bundle
from pans.decide.decision import DECISION_DTYPE
from pans.record.reading.format import TIMING_RUN_DTYPE
from pans.record.recorder import Recorder

ROOM = FILE_MAX_BYTES - MIB  # for the arrays, beside header and golden vectors
LIGHT: dict[str, Any] = {"levels": 65536, "photons_per_level": 1e-5}


def many_patterns() -> Bundle:
    """As many patterns as there may be, as large as fits."""
    d_f = 4096
    pixels = 100 * 74
    levels = np.random.default_rng(1).integers(0, 65536, (d_f, pixels)).astype(np.uint16)
    head = chain_head([d_f, 64, 2])
    return made_bundle(d_f, pattern_levels=levels, image_shape=(100, 74), **LIGHT, head_onnx=head)


def large_patterns() -> Bundle:
    """Few patterns of as many pixels as there may be."""
    pixels = 1 << 22
    levels = np.random.default_rng(2).integers(0, 65536, (7, pixels)).astype(np.uint16)
    return made_bundle(7, pattern_levels=levels, image_shape=(2048, 2048), **LIGHT, table=np.eye(128, 2))


def large_table() -> Bundle:
    """A table for as many patterns as it may have."""
    n_classes = ROOM // 4 >> 20
    table = np.random.default_rng(3).standard_normal((1 << 20, n_classes), dtype=np.float32)
    return made_bundle(20, n_classes, **LIGHT, table=table)


def large_head() -> Bundle:
    """A head as large as it may be, and the rest of the file filled with a table."""
    table = np.zeros((1 << 18, 28), np.float32)
    head = chain_head([18, 2866, 2866, 28], last=0.0)
    return made_bundle(18, 28, **LIGHT, head_onnx=head, table=table)


def wide_results() -> Bundle:
    """A head with as many intermediate values as there may be, and large golden pictures."""
    side = 512
    return made_bundle(
        16, 0, **LIGHT, head_onnx=chain_head([16, 16, side * side]), picture_shape=(side, side), classes=()
    )


def large_matrix() -> Bundle:
    """The optics of a passive sensor, complex."""
    d_f, pixels = 64, ROOM // 8 // 64
    rng = np.random.default_rng(4)
    matrix = (rng.normal(size=(d_f, pixels)) + 1j * rng.normal(size=(d_f, pixels))).astype(np.complex64) / 1000
    optics, head = Analyser("coherent", matrix, "field", "none", 10.0, 100.0), chain_head([d_f, 8, 2])
    facts: dict[str, Any] = {"name": "passive", "task": "test", "classes": ("a", "b"), "provenance": {}}
    return make_bundle(image_shape=(1, pixels), optics=optics, back_end=BackEnd(head_onnx=head), **facts)


def large_automaton() -> Bundle:
    """As many pixels of 1-bit patterns as there may be: the file has one byte for sixteen of memory."""
    return _layered(slots=2, width=49, shape=(768, 1024), levels=2)


def many_states() -> Bundle:
    """As many patterns of 28 x 28 pixels as `dmd-spad` holds, each shown by one state."""
    return _layered(slots=683, width=64, shape=(28, 28), levels=2)


def _layered(slots: int, width: int, shape: tuple[int, int], levels: int) -> Bundle:
    """An automaton of up to `width` states in each slot, in a bundle of random patterns, one for each of them."""
    n = 1 + (slots - 1) * width
    state = np.arange(n)
    slot, place = (state + width - 1) // width, (state + width - 1) % width * (state > 0)
    ahead = np.stack([2 * place, 2 * place + 1], axis=1) % width
    successors = 1 + (slot * width)[:, None] + ahead
    posteriors = np.random.default_rng(7).dirichlet(np.ones(10), n + width)
    automaton = reachable_automaton(state, np.ones(n, int), 1, successors, posteriors)
    patterns = np.random.default_rng(6).integers(0, levels, (n, shape[0] * shape[1])).astype(np.uint16)
    light = {"levels": levels, "photons_per_level": 0.1 / (levels - 1)}
    return made_bundle(n_classes=10, automaton=automaton, image_shape=shape, pattern_levels=patterns, **light)


def chain_head(sizes: list[int], last: float = 1.0) -> bytes:
    """A chain of dense layers with random weights, those of the last one times `last`."""
    from onnx import helper

    rng, nodes, weights, current = np.random.default_rng(5), [], {}, "means"
    for number, (n_in, n_out) in enumerate(pairwise(sizes)):
        ends = number == len(sizes) - 2
        matrix = rng.standard_normal((n_in, n_out), dtype=np.float32) / np.float32(n_in)
        weights[f"w{number}"] = matrix * np.float32(last if ends else 1.0)
        nodes.append(helper.make_node("MatMul", [current, f"w{number}"], ["scores" if ends else f"s{number}"]))
        if not ends:
            nodes.append(helper.make_node("Relu", [f"s{number}"], [f"x{number}"]))
        current = f"x{number}"
    return bytes(model(nodes, weights, d_f=sizes[0], n_out=sizes[-1]).SerializeToString())


def large_pictures() -> Bundle:
    """Patterns for the largest pictures that a scene may have, in s.npz."""
    return _scene_bundle((16, 2048, 2040))


def many_pictures() -> Bundle:
    """Patterns for as many pictures as a scene may have, in s.npz."""
    return _scene_bundle((85_000, 28, 28))


def _scene_bundle(shape: tuple[int, int, int]) -> Bundle:
    """Write a scene of pictures, which a few bytes stand for, and return patterns of as many pixels, as many as there is room for."""
    labels = (np.arange(shape[0]) % 2).astype(np.int16)
    np.savez_compressed("s.npz", images=np.full(shape, 200, np.uint8), labels=labels)
    pixels = shape[1] * shape[2]
    d_f = min(48, ROOM // 2 // pixels)
    levels = np.random.default_rng(6).integers(0, 65536, (d_f, pixels)).astype(np.uint16)
    head = chain_head([d_f, 8, 2])
    return made_bundle(d_f, **LIGHT, pattern_levels=levels, image_shape=shape[1:], head_onnx=head)


def long_recording(path: Path, decisions: int) -> Path:
    """A recording of many decisions with their timings."""
    with Recorder(path, {"config": {"shots": 1, "tick_hz": 1000}}) as recorder:
        for number in range(decisions):
            row = (number, number, number, 0, 0, 1, 0, -1, 0, 0.5, 0, 0)
            recorder.add_decisions(np.array([row], DECISION_DTYPE))
            recorder.add_timing_runs(np.array([(number,) * 5 + (1,)], TIMING_RUN_DTYPE))
        recorder.close({})
    return path


def large_json(path: Path) -> Path:
    """A calibration with as many values as it may have, each as large in memory as it can be."""
    path.write_text(json.dumps({"name": [f"run-{number:04d}.pansrec" for number in range(1, JSON_VALUES_MAX - 8)]}))
    return path
