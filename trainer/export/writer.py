"""From a trained model to a bundle, and the proof that the bundle decides as the model does.

Owns the folding of the normalisation, the ONNX graph and the comparison; never trains. `export` writes the file, reads it
back and raises when a score or a decision of the file differs from the torch model.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from pans.runtime import __version__
from pans.runtime.bundle.facts import GOLDEN_TOLERANCE
from pans.runtime.bundle.int8 import quantise_head
from pans.runtime.bundle.layers import read_layers
from pans.runtime.bundle.model import BackEnd, Bundle, Shown, load_bundle, make_bundle, word_means, write_bundle
from pans.runtime.bundle.optics import Analyser
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import PansError, UsageError
from pans.runtime.instrument.profile import Profile
from pans.trainer.model.encoders import ActiveIllumination
from pans.trainer.model.heads import EPSILON, ConvHead, Decoders, Heads, MlpHead, PictureHead
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.train.data import encoder_input, full_scale_photoelectrons
from pans.trainer.train.loop import Trained

from .conv_onnx import conv_nodes
from .int8_onnx import int8_onnx
from .picture_onnx import picture_nodes

OPSET = 17
IR_VERSION = 8  # onnxruntime 1.18 reads up to 10, and every later one reads this
DEAD_VARIANCE = 1e-7  # a pattern that clicks, or stays dark, less than once in ten million times says nothing
ALL_WORDS_MAX = 12
RANDOM_WORDS = 10_000
COMPARED_OBJECTS = 200

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Exported:
    """The written bundle and how far its back ends are from the torch model."""

    bundle: Bundle
    sha256: str
    words_compared: int
    score_difference: float  # the largest, over max(1, |score|)
    dead_patterns: tuple[int, ...]


def fold_normalisation(
    weight: F64, bias: F64, gain: F64, shift: F64, click_mean: F64
) -> tuple[F64, F64, tuple[int, ...]]:
    """Fold normalisation by `click_mean` (d_f,) into a linear layer: weight (hidden, d_f), bias (hidden,).

    The population variance of a click is p(1-p), exactly. A pattern that always or never clicks has none: its scale would
    explode, so its column is dropped (set to 0) and its constant part goes into the bias. Returns the folded weight and
    bias, float64, and the dropped patterns.
    """
    variance = click_mean * (1 - click_mean)
    dead = variance < DEAD_VARIANCE
    scale = np.where(dead, 0.0, gain / np.sqrt(variance + EPSILON))
    folded_bias = bias + weight @ (shift - click_mean * scale)
    return weight * scale, folded_bias, tuple(int(i) for i in np.flatnonzero(dead))


def head_onnx(head: Heads, click_mean: F64) -> tuple[bytes, tuple[int, ...]]:
    """Return the head as ONNX (float32 click means (n, d_f) -> scores or pixels (n, outputs)) and the dropped patterns."""

    gain, shift = (np.asarray(part.detach().double().numpy()) for part in (head.norm.gain, head.norm.bias))
    if isinstance(head, ConvHead):
        one = np.eye(len(click_mean))
        scale, offset, dead = fold_normalisation(one, np.zeros(len(click_mean)), gain, shift, click_mean)
        nodes, constants = conv_nodes(head, np.diag(scale), offset)
    elif isinstance(head, Decoders):
        first, first_bias = (np.asarray(part.detach().double().numpy()) for part in head.hidden.parameters())
        weight, bias, dead = fold_normalisation(first, first_bias, gain, shift, click_mean)
        nodes, constants = picture_nodes(head, weight, bias)
    else:
        nodes, constants, dead = _mlp_nodes(head, gain, shift, click_mean)
    n_outputs = math.prod(head.image_shape) if isinstance(head, PictureHead) else head.output.out_features
    initializers = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    source = helper.make_tensor_value_info("clicks", TensorProto.FLOAT, ["n", len(click_mean)])
    result = helper.make_tensor_value_info("scores", TensorProto.FLOAT, ["n", n_outputs])
    graph = helper.make_graph(nodes, "head", [source], [result], initializers)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="pans-runtime")
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString()), dead


def _mlp_nodes(
    head: MlpHead, gain: F64, shift: F64, click_mean: F64
) -> tuple[list[onnx.NodeProto], dict[str, NDArray[Any]], tuple[int, ...]]:
    """Nodes, constants by name, dropped patterns: the normalisation is folded into the first layer."""
    layers = (head.hidden.weight, head.hidden.bias, head.output.weight, head.output.bias)
    w1, b1, w2, b2 = (np.asarray(layer.detach().double().numpy()) for layer in layers)
    w1, b1, dead = fold_normalisation(w1, b1, gain, shift, click_mean)
    constants = {name: value.astype(np.float32) for name, value in (("w1", w1), ("b1", b1), ("w2", w2), ("b2", b2))}
    nodes = [
        helper.make_node("Gemm", ["clicks", "w1", "b1"], ["sums"], transB=1),
        helper.make_node("Relu", ["sums"], ["hidden"]),
        helper.make_node("Gemm", ["hidden", "w2", "b2"], ["scores"], transB=1),
    ]
    return nodes, constants, dead


def export(
    path: Path,
    head: Heads,
    click_mean: F64,
    optics: Shown | Analyser,
    *,
    name: str,
    task: str,
    classes: tuple[str, ...],
    image_shape: tuple[int, int],
    provenance: Mapping[str, Any],
    check: Callable[[Bundle], None] = lambda _: None,
) -> Exported:
    """Write the bundle to `path`, read it back and compare its back ends with `head`; PansError if they differ.

    A head that gives back pictures has no `classes`. `check` may refuse what was read, by PansError.
    """
    graph, dead = head_onnx(head, click_mean)
    picture_shape = head.image_shape if isinstance(head, Decoders) else None
    layers = None if picture_shape else read_layers(graph, len(click_mean), len(classes))
    int8 = None if layers is None else quantise_head(layers)
    bundle = make_bundle(
        name=name,
        task=task,
        classes=() if picture_shape else classes,
        picture_shape=picture_shape,
        image_shape=image_shape,
        optics=optics,
        back_end=BackEnd(graph, int8_head=int8, int8_onnx=None if int8 is None else int8_onnx(int8)),
        provenance={**provenance, "trained_with": f"pans-runtime {__version__}, torch {torch.__version__}"},
    )
    unchecked = path.with_name(path.name + ".unchecked")  # a wrong bundle must not stand where a right one may be
    try:
        write_bundle(bundle, unchecked)
        bundle, digest = load_bundle(unchecked)
        words, difference = compare(bundle, head, click_mean)
        check(bundle)
        os.replace(unchecked, path)
    finally:
        unchecked.unlink(missing_ok=True)
    return Exported(bundle, digest, words, difference, dead)


def export_trained(
    path: Path, trained: Trained, task: Task, profile: Profile, *, name: str, provenance: Mapping[str, Any]
) -> Exported:
    """Write what `train` returned to `path`; `provenance` is added to what the task, profile and training say of themselves."""
    quantised = trained.quantised
    optics: Shown | Analyser
    if quantised is None:
        optics = analyser_of(trained, task, profile)
    else:
        optics = Shown(profile.projector.levels, quantised.pattern_levels, quantised.photons_per_level)
    return export(
        path,
        trained.head,
        trained.click_mean.numpy(),
        optics,
        name=name,
        task=task.name,
        classes=task.classes,
        image_shape=task.image_shape,
        provenance={
            "data_sha256": task.sha256,
            "data_split": task.split,
            "task_light": task.light,
            "task_optics": task.optics,
            "task_source": task.source,
            "profile": profile.name,
            "profile_sha256": profile.sha256,
            "validation_losses": list(trained.validation_losses),
            **provenance,
        },
        check=lambda bundle: compare_optics(bundle, trained, task, profile),
    )


def analyser_of(trained: Trained, task: Task, profile: Profile) -> Analyser:
    """Return the passive optics that `train` returned, for the exposure that it assumed."""
    encoder, options = trained.encoder, trained.options
    if isinstance(encoder, ActiveIllumination):
        raise UsageError("an active encoder shows patterns, it has no optics of its own")
    matrix = encoder.matrix().detach().numpy()
    matrix.flags.writeable = False
    scale = full_scale_photoelectrons(task, options)
    return Analyser(options.encoder, matrix, task.light, task.optics, scale, profile.exposure.min_us)


def compare_optics(bundle: Bundle, trained: Trained, task: Task, profile: Profile) -> None:
    """Hold the light of a passive bundle against the torch encoder on held-out objects; PansError where it differs by 1e-5."""
    if bundle.analyser is None:
        return
    objects = Objects(task.test.images[:COMPARED_OBJECTS], task.test.labels[:COMPARED_OBJECTS])
    shown = encoder_input(task, objects, profile, trained.options)
    with torch.no_grad():
        encoder = copy.deepcopy(trained.encoder).double()
        wide = shown.to(torch.complex128 if shown.is_complex() else torch.float64)
        wanted = encoder(wide).numpy()
    difference = np.abs(bundle.analyser.photoelectrons(objects.images) - wanted) / np.maximum(1.0, wanted)
    if not difference.max() <= GOLDEN_TOLERANCE:
        raise PansError(
            f"the optics of {bundle.name} bring other light than the trained encoder: off by {difference.max():.3g} of "
            f"max(1, photoelectrons), allowed {GOLDEN_TOLERANCE:g}",
            remedy="report this with the bundle: the export is wrong",
        )


def compare(bundle: Bundle, head: Heads, click_mean: F64) -> tuple[int, float]:
    """Hold every back end of `bundle` against the torch head: all click words up to d_f = 12, else 10 000 random ones.

    Returns the number of words and the largest score difference over max(1, |score|). PansError where it exceeds 1e-5
    or a decision differs whose margin is clear of that (pictures have only scores, their pixels).
    """
    if bundle.n_features <= ALL_WORDS_MAX:
        means = word_means(np.arange(1 << bundle.n_features), bundle.n_features)
    else:
        means = np.random.default_rng(0).integers(0, 2, (RANDOM_WORDS, bundle.n_features)).astype(np.float32)
    wanted = reference_scores(head, click_mean, means)
    scale = np.maximum(1.0, np.abs(wanted))
    ranked = np.sort(wanted, axis=1)
    clear = ranked[:, -1] - ranked[:, -2] > 2 * GOLDEN_TOLERANCE * scale.max(axis=1)
    worst = 0.0
    for backend in ("onnx", "table") if bundle.table is not None else ("onnx",):
        decider = make_decider(bundle, backend=backend)
        found = decider.scores_batch(means.astype(np.int64), 1).astype(np.float64)
        difference = float((np.abs(found - wanted) / scale).max())
        clear &= bundle.picture_shape is None
        changed = int((clear & (found.argmax(axis=1) != wanted.argmax(axis=1))).sum())
        if not difference <= GOLDEN_TOLERANCE or changed:
            raise PansError(
                f"the {backend} back end of {bundle.name} differs from the trained model: scores by {difference:.3g} of "
                f"max(1, |score|), allowed {GOLDEN_TOLERANCE:g}; {changed} of {len(means)} decisions, allowed 0",
                remedy="report this with the bundle: the export is wrong",
            )
        worst = max(worst, difference)
    return len(means), worst


def reference_scores(head: Heads, click_mean: F64, means: NDArray[np.float32]) -> F64:
    """Scores of the trained head as it stands, not folded, in float64; dead patterns at their constant value."""
    variance = click_mean * (1 - click_mean)
    clicks = means.astype(np.float64)
    dead = variance < DEAD_VARIANCE
    clicks[:, dead] = click_mean[dead]
    with torch.no_grad():
        wide = copy.deepcopy(head).double()
        wide.norm.running_mean.copy_(torch.from_numpy(click_mean))
        return np.asarray(wide.eval()(torch.from_numpy(clicks)).numpy())
