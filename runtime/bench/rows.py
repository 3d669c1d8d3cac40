"""What every benchmark shares: its options, timing, the facts of the machine, the mark of the best trade-offs, table and plot.

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

from pans.runtime import SHIPPED
from pans.runtime.outputs import whole_file
from pans.runtime.report.figures import pyplot

Row = dict[str, Any]
REPEATS = 7
PACKAGES = ("numpy", "numba", "onnxruntime", "torch")


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """The command's options; each benchmark uses those that concern it."""

    bundles: tuple[Path, ...] = ()
    inputs: tuple[Path, ...] = ()
    seconds: float = 5.0
    frames: int = 0
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


def cpu_times(works: Sequence[Callable[[], Any]], repeats: int = REPEATS) -> list[Spent]:
    """As `cpu_time` for several works in turn, so that what else the machine does meets them alike: for ratios."""
    times: list[list[float]] = [[] for _ in works]
    for round_ in range(repeats + 1):
        for work, taken in zip(works, times):
            start = time.thread_time_ns()
            work()
            if round_:
                taken.append((time.thread_time_ns() - start) / 1e9)
    return [Spent(min(taken), median(taken), repeats) for taken in times]


def repeated(work: Callable[[], Any], times: int) -> Callable[[], None]:
    """Return a call that does `work` `times` times."""

    def loop() -> None:
        for _ in range(times):
            work()

    return loop


def per_item_ns(spent: Spent, n: int) -> Row:
    """The figures of `n` items in ns each, with the number of runs."""
    return {
        "ns": round(spent.least_s / n * 1e9, 3),
        "ns_median": round(spent.median_s / n * 1e9, 3),
        "runs": spent.runs,
        "n": n,
    }


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
    """p50, p99, p99.9 and the largest of durations in ns, in us."""
    p50, p99, p999 = np.quantile(times_ns, [0.5, 0.99, 0.999]) / 1000
    figures = {"p50_us": p50, "p99_us": p99, "p999_us": p999, "max_us": times_ns.max() / 1000}
    return {name: round(float(value), 3) for name, value in figures.items()} | {"calls": len(times_ns)}


def copy_ns(n_bytes: int) -> float:
    """CPU time of a memory copy of `n_bytes` in the same place again and again, in ns: the limit beside our own."""
    source = np.random.default_rng(0).integers(0, 256, n_bytes, dtype=np.uint8)
    target = np.empty_like(source)
    inner = max(1, (1 << 26) // n_bytes)
    return cpu_time(repeated(lambda: np.copyto(target, source), inner)).least_s / inner * 1e9


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


def mark_pareto(rows: list[Row], speed: str, error: str) -> None:
    """Set `pareto` on rows that no other row beats in both figures (smaller is better); rows without either are left out."""
    known = [row for row in rows if isinstance(row.get(speed), int | float) and isinstance(row.get(error), int | float)]
    for row in known:
        beaten = any(
            other[speed] <= row[speed]
            and other[error] <= row[error]
            and (other[speed], other[error]) != (row[speed], row[error])
            for other in known
        )
        row["pareto"] = not beaten


def write_plot(rows: list[Row], path: Path, *, force: bool = False) -> None:
    """Draw speed against error of the rows that have both (`ns`, `score_error`), and plain speed of the others."""
    plt = pyplot("--plot")
    points = [row for row in rows if "ns" in row and "score_error" in row]
    others = [row for row in rows if "rate" in row]
    figure, axes = plt.subplots(1, 2, figsize=(14, 6), layout="constrained")
    for row in points:
        kind = "o" if row.get("pareto") else "x"
        axes[0].loglog(row["ns"], max(row["score_error"], 1e-9), kind)
        axes[0].annotate(row["name"], (row["ns"], max(row["score_error"], 1e-9)), fontsize=7)
    axes[0].set(xlabel="ns per decision", ylabel="largest score error against float64 (below 1e-9 drawn there)")
    axes[1].barh([row["name"] for row in others], [row["rate"] for row in others])
    axes[1].set(xscale="log", xlabel="items per second")
    axes[1].tick_params(labelsize=7)
    with whole_file(path, force=force) as beside:
        figure.savefig(beside, dpi=120, format=path.suffix[1:] or "png")
    plt.close(figure)


def table_text(rows: list[Row]) -> str:
    """Rows for people: one line each, figures as they are."""
    width = max((len(str(row["name"])) for row in rows), default=0)
    lines = []
    for row in rows:
        figures = "  ".join(f"{key} {_short(value)}" for key, value in row.items() if key not in ("name", "bench"))
        lines.append(f"{row['name']:<{width}}  {figures}")
    return "\n".join(lines)


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int) and not isinstance(value, bool) and value >= 100_000:
        return f"{value:.3e}"
    return str(value)
