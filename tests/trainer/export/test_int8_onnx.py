"""The quantised model and the integer arrays are the same head; bundles from the trainer hold both."""

from __future__ import annotations

import numpy as np
import pytest
from heads import head_bundle, random_layers
from naive_decide import int8_reference

from pans.runtime.bundle.layers import quantise_head, reference_scores
from pans.runtime.decide.backends import make_decider

pytest.importorskip("onnx")
from pans.trainer.export.onnx_heads import int8_onnx


def test_the_model_gives_the_scores_of_the_integers() -> None:
    layers = random_layers([16, 48, 10], seed=2)
    head = quantise_head(layers)
    bundle = head_bundle(layers, int8_head=head, int8_onnx=int8_onnx(head))
    counts = np.random.default_rng(0).integers(0, 2, (500, 16))
    found = make_decider(bundle, backend="int8-onnx").scores_batch(counts, 1)
    own = make_decider(bundle, backend="int8").scores_batch(counts, 1)
    wanted = int8_reference(head, counts, 1)
    steps = np.abs(head.matrices()[1][1]).max() * 127  # a hidden value at a half may round either way
    assert np.abs(found - wanted).max() <= 2 * steps
    assert (np.abs(found - wanted).max(axis=1) < 1e-5).mean() > 0.98
    assert (found.argmax(axis=1) == own.argmax(axis=1)).mean() > 0.99
    assert (reference_scores(layers, counts).argmax(axis=1) == own.argmax(axis=1)).mean() > 0.97


def test_the_trainer_puts_both_into_the_bundle(tmp_path) -> None:  # type: ignore[no-untyped-def]
    torch = pytest.importorskip("torch")
    from pans.runtime.bundle.model import Shown, load_bundle
    from pans.trainer.export.writer import Description, export
    from pans.trainer.model.heads import MlpHead

    head = MlpHead(4, 8, 3, torch.Generator().manual_seed(1)).eval()
    about = Description("a", "t", ("x", "y", "z"), (2, 3), {})
    export(tmp_path / "a.pans", head, np.full(4, 0.4), Shown(2, np.ones((4, 6), np.uint16), 0.1), about)
    bundle, _ = load_bundle(tmp_path / "a.pans")
    counts = np.array([[r >> i & 1 for i in range(4)] for r in range(16)])
    for backend in ("int8", "int8-onnx"):
        found = make_decider(bundle, backend=backend).scores_batch(counts, 1)
        assert np.abs(found - make_decider(bundle, backend="float64").scores_batch(counts, 1)).max() < 0.05
