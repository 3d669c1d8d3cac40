"""What every benchmark shares: its options, timing, the facts of the machine and the table.

Throughput is in CPU time of the measuring thread, which a busy machine changes little; latencies are in wall time, with the load beside
them. A row is a dict with a `name`; speed and error stand in the same row.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base import SHIPPED
from pans.base.console import needed
from pans.base.files import whole_file
from pans.live.timing import quantiles_us

Row = dict[str, Any]
REPEATS = 7
PACKAGES = ("numpy", "numba", "onnxruntime", "torch")


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """The command's options; each benchmark uses those that concern it."""

    bundles: tuple[Path, ...] = ()
    inputs: tuple[Path, ...] = ()
    seconds: float = 5.0
    load: bool = False
    quick: bool = False

    @property
    def first_bundle(self) -> Path:
        """The first of `bundles`, by default the shipped one."""
        return self.bundles[0] if self.bundles else SHIPPED / "fashion10.pans"


@dataclass(frozen=True, slots=True)
class Spent:
    """CPU seconds of the fastest and of the middle run, and how many runs there were."""

    least_s: float
    median_s: float
    runs: int


def cpu_time(work: Callable[[], Any], repeats: int = REPEATS) -> Spent:
    """Run `work` once unmeasured and `repeats` times measured, in CPU time of this thread."""
    work()
    times = []
    for _ in range(repeats):
        start = time.thread_time_ns()
        work()
        times.append((time.thread_time_ns() - start) / 1e9)
    return Spent(min(times), median(times), repeats)


def per_item_ns(spent: Spent, n: int) -> Row:
    """The figures of `n` items in ns each, with the number of runs."""
    least, middle = (round(seconds / n * 1e9, 3) for seconds in (spent.least_s, spent.median_s))
    return {"ns": least, "ns_median": middle, "runs": spent.runs, "n": n}


def latencies_us(call: Callable[[Any], Any], inputs: Sequence[Any]) -> Row:
    """Percentiles of single calls in wall time, in us; inputs differ from call to call, the clock's own cost is in them."""
    times = np.empty(len(inputs), np.int64)
    clock = time.perf_counter_ns
    for position, item in enumerate(inputs):
        start = clock()
        call(item)
        times[position] = clock() - start
    return percentiles_us(times)


def percentiles_us(times_ns: NDArray[np.int64]) -> Row:
    """p50, p99, p99.9 and the largest of durations in ns, in us; None of too few (intervals.has_quantile)."""
    figures = quantiles_us(times_ns) | {"max_us": float(times_ns.max()) / 1000}
    return {name: value and round(value, 3) for name, value in figures.items()} | {"calls": len(times_ns)}


def copy_ns(n_bytes: int) -> float:
    """CPU time of a memory copy of `n_bytes` in the same place again and again, in ns: the limit beside our own."""
    source = np.random.default_rng(0).integers(0, 256, n_bytes, dtype=np.uint8)
    target = np.empty_like(source)
    inner = max(1, (1 << 26) // n_bytes)

    def copies() -> None:
        for _ in range(inner):
            np.copyto(target, source)

    return cpu_time(copies).least_s / inner * 1e9


def machine_facts() -> Row:
    """Processor, cores, load and versions: without them a figure means nothing."""
    facts: Row = {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "load_1min": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "time": "throughput in CPU time of the measuring thread, latency in wall time",
    }
    for name in PACKAGES:
        try:
            facts[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            facts[name] = "not installed"
    return facts


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def write_plot(rows: list[Row], path: Path, *, force: bool = False) -> None:
    """Draw speed against error of the rows that have both (`ns`, `score_error`), and the rates of the others."""
    points = [row for row in rows if "ns" in row and isinstance(row.get("score_error"), float)]
    others = [row for row in rows if "rate" in row]
    figure, axes = needed("matplotlib.pyplot", "--plot").subplots(1, 2, figsize=(14, 6), layout="constrained")
    for row in points:
        axes[0].loglog(row["ns"], max(row["score_error"], 1e-9), "o", label=row["name"])
    if points:
        axes[0].legend(fontsize=8)
    axes[0].set(xlabel="ns per decision", ylabel="largest score error against float64 (below 1e-9 drawn there)")
    axes[1].barh([row["name"] for row in others], [row["rate"] for row in others], log=True)
    axes[1].set(xlabel="items per second")
    for panel, shown in zip(axes, (points, others)):
        panel.set_visible(bool(shown))
    with whole_file(path, force=force) as beside:
        figure.savefig(beside, dpi=120, format=path.suffix[1:] or "png")
    needed("matplotlib.pyplot").close(figure)


def table_text(rows: list[Row]) -> str:
    """Rows for people: one line each, figures as they are."""
    width = max((len(str(row["name"])) for row in rows), default=0)
    figures = (
        "  ".join(
            f"{key} {_short(value)}" for key, value in row.items() if key not in ("name", "bench") and value is not None
        )
        for row in rows
    )
    return "\n".join(f"{row['name']:<{width}}  {text}" for row, text in zip(rows, figures))


def _short(value: Any) -> str:
    is_large = type(value) is int and value >= 100_000
    return f"{value:.3e}" if is_large else f"{value:.4g}" if isinstance(value, float) else str(value)
