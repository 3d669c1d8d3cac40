"""ONNX models for tests: hostile ones, each with the reason for its refusal, and random ones from the allowed operators."""

import random
from typing import Any

import numpy as np


def model(nodes: list[Any], weights: dict[str, Any] | None = None, d_f: int = 4, n_out: int = 2, **more: Any) -> Any:
    """A model from `means` (n, d_f) to `scores` (n, n_out); further value names in `outputs` become outputs too."""
    from onnx import TensorProto, helper, numpy_helper

    tensors = [
        value if hasattr(value, "dims") else numpy_helper.from_array(np.asarray(value), name)
        for name, value in (weights or {}).items()
    ]
    source = helper.make_tensor_value_info("means", TensorProto.FLOAT, [more.get("batch", "n"), d_f])
    results = [helper.make_tensor_value_info("scores", TensorProto.FLOAT, [more.get("batch", "n"), n_out])]
    results += [helper.make_empty_tensor_value_info(name) for name in more.get("outputs", ())]
    graph = helper.make_graph(nodes, "head", [source], results, tensors)
    opsets = [helper.make_opsetid("", more.get("opset", 17))]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8)


def parsed(nodes: str, d_f: int = 4, n_out: int = 2, head: str = "", **weights: Any) -> Any:
    """A model from `means` (n, d_f) to `scores` (n, n_out) whose nodes are written in ONNX's text form."""
    from onnx import numpy_helper, parser

    ends = f"(float[n, {d_f}] means) => (float[n, {n_out}] scores)"
    made = parser.parse_model(f'<ir_version: 8, opset_import: ["": 17{head}]> head {ends} {{ {nodes} }}')
    tensors = ((name, value) for name, value in weights.items() if not hasattr(value, "dims"))
    made.graph.initializer.extend(numpy_helper.from_array(np.asarray(value), name) for name, value in tensors)
    made.graph.initializer.extend(value for value in weights.values() if hasattr(value, "dims"))
    return made


def hostile_models() -> dict[str, tuple[bytes, str]]:
    """Models that would run away, or that readers take differently: name -> (bytes, pattern of the refusal)."""
    from onnx import TensorProto, helper, numpy_helper

    ones, last = np.ones((4, 2), np.float32), "scores = MatMul(means, w)"
    outside = numpy_helper.from_array(ones, "w")
    outside.ClearField("raw_data")
    outside.data_location = 1
    outside.external_data.add(key="location", value="secret.bin")
    opsets = [helper.make_opsetid("", 17)]
    again = helper.make_function("own", "Again", ["a"], ["c"], [helper.make_node("Identity", ["a"], ["c"])], opsets)
    plain, called, late = (parsed(last, w=ones) for _ in range(3))
    called.functions.append(again)
    late.opset_import[0].version = 99
    whole, graph = plain.SerializeToString(), plain.graph.SerializeToString()
    deep = " ".join(f"x{i + 1} = MatMul({f'x{i}' if i else 'means'}, m)" for i in range(999))
    doubled = parsed(f"{deep} scores = MatMul(x999, w)", w=ones, m=np.ones((4, 4), np.float32))
    doubled.graph.node.extend([*doubled.graph.node])
    resized = "x = Reshape(means, s) y = Conv<pads = [31, 31, 31, 31]>(x, k) z = GlobalMaxPool(y)"
    body = "body (int64 i, bool go) => (bool on) { on = Identity(go) }"

    def int64(*values: int) -> np.ndarray:
        return np.array(values, np.int64)

    def full(*shape: int) -> np.ndarray:
        return np.ones(shape, np.float32)

    added: dict[str, tuple[str, dict[str, Any], str]] = {  # nodes that make `b`, which is added to a plain head's scores
        "loop": (f"b = Loop<body = {body}>(m)", {"m": int64(1 << 40)}, "subgraph"),
        "if": (f"b = If<then_branch = {body}, else_branch = {body}>(means)", {}, "subgraph"),
        "scan": (f"b = Scan<body = {body}, num_scan_inputs = 1>(means)", {}, "subgraph"),
        "constant of shape": ("b = ConstantOfShape(s)", {"s": int64(1 << 30)}, "ConstantOfShape"),
        "expand": ("b = Expand(v, s)", {"v": ones[:1], "s": int64(1 << 30, 2)}, "Expand"),
        "tile": ("b = Tile(v, s)", {"v": ones, "s": int64(1 << 20, 1)}, "Tile"),
        "range": ("b = Range(r, s, t)", {"r": int64(0), "s": int64(1 << 40), "t": int64(1)}, "Range"),
        "resize": ('b = Resize(v, "", s)', {"v": ones, "s": np.float32([1e5, 1e5])}, "Resize"),
        "dice": ("b = RandomNormal<shape = [1, 2]>()", {}, "RandomNormal"),
        "rows by rows": ("t = Transpose(means) b = MatMul(means, t)", {}, "rows stay first"),
        "rows summed": ("b = ReduceSum<keepdims = 1>(means)", {}, "rows stay first"),
        "broadcast": ("b = Add(u, v)", {"u": full(1, 1 << 14), "v": full(1 << 14, 1)}, "multiply-adds|intermediate"),
        "product": ("b = MatMul(u, v)", {"u": full(1 << 11, 1 << 8), "v": full(1 << 8, 1 << 11)}, "multiply-adds"),
        "wide pads": (f"b = Conv<pads = [{1 << 40}, {1 << 40}]>(x, k)", {"x": full(1, 1, 3), "k": full(1, 1, 3)}, "pads wider"),
        "too many values": ("", {"b": TensorProto(name="b", data_type=1, dims=[1 << 40], raw_data=b"")}, "allowed: at most"),
        "training mode": ("b = Dropout(u, r, t)", {"u": ones[:1], "r": np.float32(0.5), "t": np.uint8([1])}, "training_mode"),
    }  # fmt: skip
    models: dict[str, tuple[Any, str]] = {
        **{
            name: (parsed(f"{nodes} sums = MatMul(means, w) scores = Add(sums, b)", w=ones, **weights), reason)
            for name, (nodes, weights, reason) in added.items()
        },
        "convolution": (parsed(resized, 4096, s=int64(-1, 1, 64, 64), k=full(64, 1, 63, 63)), "multiply-adds"),
        "endless chain": (doubled, "1000 nodes"),
        "external data": (parsed(last, w=outside), "another file"),
        "function": (called, "functions"),
        "foreign domain": (parsed("scores = com.example.Relu(means)", 2, head=', "com.example": 1'), "of the domain 'com.example'"),
        "not finite": (parsed(last, w=ones * np.inf), "not finite"),
        "doubles": (parsed(last, w=np.ones((4, 2))), "data type 11"),
        "operator set 99": (late, "operator set 99"),
    }  # fmt: skip
    return {
        **{name: (bytes(made.SerializeToString()), reason) for name, (made, reason) in models.items()},
        "two graphs": (whole + b"\x3a" + varint(len(graph)) + graph, "graph twice"),
        "unknown field": (whole + b"\xf8\x3f\x01", "field 1023"),
        "training": (whole + b"\xa2\x01\x00", "training graph"),
        "million fields": (b"\x3a" + varint(6_000_000) + b"\x0a\x00" * 3_000_000, "1000 nodes"),
    }


def varint(number: int) -> bytes:
    found = b""
    while number > 127:
        found += bytes([number & 127 | 128])
        number >>= 7
    return found + bytes([number])


def random_model(dice: random.Random) -> tuple[bytes, int, int, list[str]]:
    """A model of random allowed operators, sizes and attributes: (bytes, d_f, outputs, names of its values); it need not be valid."""
    from onnx import helper

    d_f, n_out = dice.randint(1, 24), dice.randint(1, 6)
    weights: dict[str, Any] = {}
    nodes: list[Any] = []
    dims = [d_f]  # without the rows; only what the maker believes

    def constant(*shape: int, kind: type = np.float32) -> str:
        weights[f"c{len(weights)}"] = np.asarray(np.random.default_rng(len(weights)).normal(size=shape), kind)
        return f"c{len(weights) - 1}"

    def ints(*values: int) -> str:
        weights[f"c{len(weights)}"] = np.array(values, np.int64)
        return f"c{len(weights) - 1}"

    current = "means"

    def add(op: str, *inputs: str, **attributes: Any) -> None:
        nonlocal current
        nodes.append(helper.make_node(op, [current, *inputs], [f"v{len(nodes)}"], **attributes))
        current = f"v{len(nodes) - 1}"

    def some(low: int, high: int) -> int:
        return dice.randint(low, high)

    for _ in range(some(0, 6)):
        spatial = len(dims) - 1
        kind = dice.choice(
            ("unary", "binary", "dense", "shape", "window", "window", "reduce", "order", "slice", "softmax")
        )
        if kind == "unary":
            add(dice.choice(("Relu", "Sigmoid", "Tanh", "Elu", "Softplus", "Abs", "Erf", "Identity", "Clip", "Neg")))
        elif kind == "binary":
            other = [size if dice.random() < 0.7 else dice.choice((1, size + 1)) for size in dims[some(0, len(dims)) :]]
            add(dice.choice(("Add", "Mul", "Sub", "Max", "PRelu")), constant(*other))
        elif kind == "dense":
            wide = some(1, 8)
            if len(dims) == 1 and dice.random() < 0.5:
                turned = some(0, 1)
                add("Gemm", constant(*((wide, dims[0]) if turned else (dims[0], wide))), constant(wide), transB=turned)
            else:
                add("MatMul", constant(dims[-1], wide))
            dims = [*dims[:-1], wide]
        elif kind == "shape":
            if dice.random() < 0.4:
                add("Flatten", axis=1)
                dims = [int(np.prod(dims))]
            elif dice.random() < 0.5 and len(dims) < 4:
                place = some(1, len(dims) + 1)
                add("Unsqueeze", ints(place))
                dims.insert(place - 1, 1)
            else:
                total = int(np.prod(dims))
                part = dice.choice([n for n in range(1, total + 1) if total % n == 0])
                dims = [part, total // part] if dice.random() < 0.7 else [1, part, -1]
                add("Reshape", ints(dice.choice((-1, 0)), *dims))
                dims = [size if size > 0 else total // part for size in dims]
        elif kind == "window" and 1 <= spatial <= 3:
            kernel, out = [some(1, 3) for _ in range(spatial)], some(1, 4)
            about: dict[str, Any] = {"strides": [some(1, 3) for _ in kernel], "pads": [some(0, 1) for _ in kernel * 2]}
            if dice.random() < 0.2:
                about = {"auto_pad": dice.choice(("SAME_UPPER", "SAME_LOWER", "VALID"))}
            pick = dice.random()
            if pick < 0.4:
                add("Conv", constant(out, dims[0], *kernel), dilations=[some(1, 2) for _ in kernel], **about)
            elif pick < 0.6:
                add("ConvTranspose", constant(dims[0], out, *kernel), **about)
            elif pick < 0.9:
                add(dice.choice(("MaxPool", "AveragePool")), kernel_shape=kernel, ceil_mode=some(0, 1), **about)
            else:
                add("GlobalAveragePool")
            break  # what it gives is for the reader to say
        elif kind == "reduce":
            axis = some(1, len(dims))
            add("ReduceMean", axes=[axis], keepdims=1)
            dims[axis - 1] = 1
        elif kind == "order" and len(dims) > 1:
            order = dice.sample(range(len(dims)), len(dims))
            add("Transpose", perm=[0, *(place + 1 for place in order)])
            dims = [dims[place] for place in order]
        elif kind == "slice":
            axis, start, step = some(1, len(dims)), some(-5, 5), dice.choice((1, 1, 2, -1))
            add("Slice", ints(start), ints(dice.choice((-1, 3, 1 << 40, -(1 << 40)))), ints(axis), ints(step))
            break
        elif kind == "softmax":
            add("Softmax", axis=dice.choice((-1, 1)))
    names = [node.output[0] for node in nodes]
    add("Flatten", axis=1)
    nodes.append(helper.make_node("ReduceMax", [current], ["one"], axes=[1], keepdims=1))
    nodes.append(helper.make_node("MatMul", ["one", constant(1, n_out)], ["scores"]))
    return bytes(model(nodes, weights, d_f, n_out, outputs=names).SerializeToString()), d_f, n_out, names
