"""No head runs away: what is refused before a session is made, and what is let through costs what it says."""

import random
import secrets
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx")

from bundles import made_bundle
from heads import affine_head, onnx_chain, random_layers
from models import hostile_models, model, random_model
from onnx import helper
from onnx.parser import parse_model

from pans.base.errors import DamagedFileError
from pans.bundle.heads import onnx_check as onnx_model
from pans.bundle.heads.head import open_head
from pans.bundle.heads.onnx_check import ROWS, check_head, read_model, shapes_of

HOSTILE = hostile_models()


@pytest.mark.parametrize("name", HOSTILE)
def test_heads_that_would_run_away_are_refused_unrun(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import onnxruntime

    def no_session(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("a session was made")

    monkeypatch.setattr(onnxruntime, "InferenceSession", no_session)
    data, reason = HOSTILE[name]
    with pytest.raises(DamagedFileError, match=reason):
        open_head(data, {"foreign domain": 2, "convolution": 4096}.get(name, 4), 2, "here")


MIXING = [  # of 2 patterns and 2 classes, and the reason
    (
        "int64[1] s = {-1}, int64[1] e = {-9223372036854775807}, int64[1] a = {0}, int64[1] m = {-1}",
        "z = Slice(x, s, e, a, m)",
        "rows in steps of -1",
    ),
    ("", "n = Shape(x) m = Cast<to = 1>(n) z = Div(x, m)", "mixes rows: score"),
]


@pytest.mark.parametrize(("constants", "nodes", "reason"), MIXING, ids=["backwards", "by how many there are"])
def test_a_head_decides_each_row_by_itself(constants: str, nodes: str, reason: str) -> None:
    graph = f"(float[n, 2] x) => (float[n, 2] y) <{constants}> {{ {nodes} y = Identity(z) }}"
    data = parse_model(f'<ir_version: 8, opset_import: ["": 17]> head {graph}').SerializeToString()
    with pytest.raises(DamagedFileError, match=reason):
        open_head(data, 2, 2, "here")
    # and not: "the table does not answer the golden vectors"
    with pytest.raises(DamagedFileError, match=reason):
        made_bundle(2, 2, head_onnx=data)


def test_a_slice_of_all_rows_is_let_through() -> None:
    constants = "int64[2] s = {0, 0}, int64[2] e = {9223372036854775807, 2}, int64[2] a = {0, 1}, int64[2] m = {1, 1}"
    graph = f"(float[n, 3] x) => (float[n, 2] y) <{constants}> {{ y = Slice(x, s, e, a, m) }}"
    data = parse_model(f'<ir_version: 8, opset_import: ["": 17]> head {graph}').SerializeToString()
    assert open_head(data, 3, 2, "here").scores(np.eye(3, dtype=np.float32)).tolist() == [[1, 0], [0, 1], [0, 0]]


AFFINE = affine_head(np.eye(2), np.zeros(2))
NO_HEADS = [  # of 2 patterns and 2 classes: a graph, or the bytes of a file, and the reason
    ("(float[n, 3] x) => (float[n, 3] y) { y = Identity(x) }", r"allowed: \(n or 1, 2\)"),
    ("(float[n, 2] x) => (float[n, 4] y) { y = Concat<axis = 1>(x, x) }", "output"),
    ("(float[n, 2, 1] x) => (float[n, 2, 1] y) { y = Identity(x) }", "shape"),
    ("(float[2, 2] x) => (float[2, 2] y) { y = Identity(x) }", "shape"),
    ("(double[n, 2] x) => (double[n, 2] y) { y = Identity(x) }", "tensor"),
    ("(float[n, 2] x) => (int64[n, 1] y) { y = ArgMax<axis = 1>(x) }", "tensor"),
    ("(float[n, 2] x, float[n, 2] z) => (float[n, 2] y) { y = Add(x, z) }", "one input"),
    ("(float[n, 2] x) => (float[n, 2] y) { y = Teleport(x) }", "operator 'Teleport', allowed: Abs"),
    *((data, "ONNX") for data in (b"\xff" * 40, b"", np.random.default_rng(1).bytes(300))),
    *((AFFINE.replace(*change), "ONNX head") for change in ((b"means", b"\xf0eans"), (b"n", b"\xad"))),
    (AFFINE.replace(b"Gemm", b"\xf0emm"), "utf-8"),
]


@pytest.mark.parametrize(("graph", "reason"), NO_HEADS, ids=range(len(NO_HEADS)))
def test_what_is_no_head_is_refused_with_the_reason(
    graph: str | bytes, reason: str, capfd: pytest.CaptureFixture[str]
) -> None:
    if isinstance(graph, str):
        graph = parse_model(f'<ir_version: 8, opset_import: ["": 17]> head {graph}').SerializeToString()
    with pytest.raises(DamagedFileError, match=reason):
        open_head(graph, 2, 2, "here")
    assert capfd.readouterr() == ("", "")


def test_the_check_needs_neither_onnx_nor_onnxruntime() -> None:
    code = (
        "import sys; from pans.bundle.heads import check_head; print(check_head(sys.stdin.buffer.read(), 3, 2));"
        "assert not {'onnx', 'onnxruntime'} & set(sys.modules)"
    )
    data = onnx_chain(random_layers([3, 5, 2]))
    done = subprocess.run([sys.executable, "-c", code], input=data, capture_output=True, check=True)
    assert b"input_name='means', output_name='scores', row_by_row=False" in done.stdout


def convolutional(batch: Any, dynamic: bool) -> bytes:
    """What a trainer exports for a small convolutional network, its flattening by constants or by the shape at run time."""
    node = helper.make_node
    rng = np.random.default_rng(1)
    weights: dict[str, Any] = {
        "image": np.array([-1 if batch == "n" else 1, 1, 4, 4], np.int64),
        "k": rng.normal(size=(3, 1, 3, 3)).astype(np.float32),
        "w": rng.normal(size=(12, 2)).astype(np.float32),
        **{name: np.ones(3, np.float32) for name in ("scale", "offset", "mean", "variance")},
        **{"first": np.array(0, np.int64), "axis": np.array([0], np.int64), "rest": np.array([-1], np.int64)},
        **{"flat": np.array([0, 12], np.int64), "q": np.float32(0.1), "zero": np.uint8(0)},
    }
    nodes = [
        node("Reshape", ["means", "image"], ["x"]),
        node("Conv", ["x", "k"], ["c"], pads=[1, 1, 1, 1]),
        node("BatchNormalization", ["c", "scale", "offset", "mean", "variance"], ["b"]),
        node("Relu", ["b"], ["r"]),
        node("MaxPool", ["r"], ["p"], kernel_shape=[2, 2], strides=[2, 2]),
        node("QuantizeLinear", ["p", "q", "zero"], ["quantised"]),
        node("DequantizeLinear", ["quantised", "q", "zero"], ["d"]),
    ]
    if dynamic:
        nodes += [
            node("Shape", ["d"], ["s"]),
            node("Gather", ["s", "first"], ["rows"], axis=0),
            node("Unsqueeze", ["rows", "axis"], ["one"]),
            node("Concat", ["one", "rest"], ["flat2"], axis=0),
        ]
    nodes += [node("Reshape", ["d", "flat2" if dynamic else "flat"], ["f"]), node("MatMul", ["f", "w"], ["scores"])]
    return bytes(model(nodes, weights, d_f=16, batch=batch).SerializeToString())


@pytest.mark.parametrize(("batch", "dynamic"), [("n", False), ("n", True), (1, False), (1, True)])
def test_what_usual_trainers_export_runs(batch: Any, dynamic: bool) -> None:
    head = open_head(convolutional(batch, dynamic), 16, 2, "here")
    assert head.cost.row_by_row == (batch == 1)
    means = np.random.default_rng(2).random((5, 16)).astype(np.float32)
    together = head.scores(means)
    np.testing.assert_allclose(together, np.concatenate([head.scores(row[None]) for row in means]), rtol=1e-5)


def test_the_cost_of_a_chain_is_its_products() -> None:
    cost = check_head(onnx_chain(random_layers([10, 512, 10])), 10, 10)
    assert cost.operations == 10 * 512 + 512 * 10 + 8 * (512 + 512 + 10)
    assert cost.values == 10 + 512 + 512 + 10


def test_a_model_beyond_its_bytes_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_model, "MODEL_MAX_BYTES", len(AFFINE) - 1)
    with pytest.raises(ValueError, match=f"{len(AFFINE)} bytes, allowed: 1 to {len(AFFINE) - 1}"):
        check_head(AFFINE, 2, 2)


def check_random_models(seed: int, count: int) -> int:
    """Hold the shapes of random models against those of onnxruntime; return how many both let through."""
    import onnxruntime

    onnxruntime.set_default_logger_severity(4)
    dice, agreed = random.Random(seed), 0
    for number in range(count):
        data, d_f, n_out, names = random_model(dice)
        try:
            check_head(data, d_f, n_out)
        except ValueError:
            continue
        try:
            session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
            found = {rows: session.run(names, {"means": np.ones((rows, d_f), np.float32)}) for rows in (1, 3)}
        except Exception:
            continue  # it refuses what we let through: that is its right
        shapes, _, _ = shapes_of(read_model(data), d_f)
        for rows, arrays in found.items():
            for name, array in zip(names, arrays):
                wanted = tuple(rows if size == ROWS else size for size in shapes[name].shape)
                assert array.shape == wanted, f"seed {seed}, model {number}: {name} is {array.shape}, expected {wanted}"
        agreed += 1
    return agreed


def test_shapes_are_those_of_onnxruntime() -> None:
    seed = secrets.randbits(32)
    assert check_random_models(seed, 150) > 60, f"seed {seed}"
