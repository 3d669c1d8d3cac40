"""What two runs have in common, in what they differ, and which of the differences are larger than chance.

Results of the same objects are compared in pairs; otherwise as two samples in which each object counts once, however often it was shown.
P-values of one comparison are corrected for their number (Holm), and 0.05 is the limit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .side import Side
from .statistics import (
    LEAST_US,
    fisher_exact,
    holm,
    mcnemar_exact,
    newcombe_difference,
    paired_difference,
    poisson_rates,
    quantile_ratio,
    rate_ratio,
)

ALPHA = 0.05
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
LEAST_BEYOND = 10  # decisions slower than a quantile, or nothing is said about it
# Facts that differ between any two runs, or that follow from others.
_ALWAYS_DIFFERENT = ("created_utc", "command", "format_version", "toml", "decisions_sha256", "tick", "part")
_DERIVED = (
    "config.dark.guard.",
    "config.backend_choice.",
    "options.device",
    "options.out",
    "options.record",
    "options.force",
)
_FIRST = ("bundle_sha256", "profile.", "device_url")  # what a reader asks for first
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Change:
    """A fact that differs: its dotted name and what both sides say, "" where one says nothing."""

    name: str
    first: str
    second: str


@dataclass(frozen=True, slots=True)
class Finding:
    """A figure of both sides. `difference` is first less second, or their ratio where `is_ratio`; None where no interval is known.

    `p` is the p-value of the test named in `method`, `p_corrected` that after Holm; None where nothing was tested.
    """

    name: str
    unit: str
    first: float | None
    second: float | None
    difference: float | None
    low: float | None
    high: float | None
    is_ratio: bool
    p: float | None
    method: str
    p_corrected: float | None = None

    @property
    def significant(self) -> bool | None:
        """Whether it differs by more than chance; None where nothing was tested. An interval without a test tells by itself."""
        if self.p_corrected is not None:
            return self.p_corrected < ALPHA
        if self.low is None or self.high is None:
            return None
        return not self.low <= (1.0 if self.is_ratio else 0.0) <= self.high

    def as_json(self) -> dict[str, Any]:
        """Return it JSON-able; what is not finite becomes None."""
        facts = {key: _finite(value) for key, value in asdict(self).items()}
        return facts | {"difference_is": "a / b" if self.is_ratio else "a - b", "significant": self.significant}


@dataclass(frozen=True, slots=True)
class Comparison:
    """All that two runs differ in; `why` says why objects were paired or not."""

    first: Side
    second: Side
    paired: bool
    why: str
    changes: tuple[Change, ...]
    findings: tuple[Finding, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it JSON-able."""
        return {
            "a": str(self.first.path),
            "b": str(self.second.path),
            "paired": self.paired,
            "why": self.why,
            "changes": [asdict(change) for change in self.changes],
            "findings": [finding.as_json() for finding in self.findings],
            "significant": [finding.name for finding in self.findings if finding.significant],
            "simulated": self.first.simulated or self.second.simulated,
        }


def compare(first: Side, second: Side, pairing: str = "auto") -> Comparison:
    """Return in what two runs differ; `pairing` says whether their objects are the same, or `auto` to find out."""
    paired, why = _pairing(first, second, pairing)
    found = [
        *_accuracy(first, second, paired),
        *_abstained(first, second),
        *(_mean(first, second, name, unit) for name, unit in _MEANS.items()),
        *_late_and_lost(first, second),
        *_dark(first, second),
        *_latencies(first, second),
    ]
    tested = [finding for finding in found if finding.p is not None]
    corrected = dict(zip(map(id, tested), holm([finding.p for finding in tested if finding.p is not None])))
    findings = tuple(_corrected(finding, corrected.get(id(finding))) for finding in found)
    return Comparison(first, second, paired, why, tuple(changes_of(first, second)), findings)


def _corrected(finding: Finding, p: float | None) -> Finding:
    return finding if p is None else Finding(**{**asdict(finding), "p_corrected": p})


# ---- what was different about the runs ----


def changes_of(first: Side, second: Side) -> list[Change]:
    """Return the facts of headers and devices that differ: bundle, profile and device first, the others in the order of their names."""
    facts = [_facts(side) for side in (first, second)]
    names = sorted({*facts[0], *facts[1]}, key=lambda name: (not name.startswith(_FIRST), name))
    rows = ((name, facts[0].get(name, ""), facts[1].get(name, "")) for name in names)
    return [Change(*row) for row in rows if row[1] != row[2]]


def _facts(side: Side) -> dict[str, str]:
    kept = {key: value for key, value in side.header.items() if key not in _ALWAYS_DIFFERENT}
    told = {"device": side.summary.get("device", {}), "deadline_us": side.summary.get("deadline_us")}
    return {
        name: text
        for name, text in _flat({**kept, **told})
        if name.rpartition(".")[2] not in _ALWAYS_DIFFERENT and not name.startswith(_DERIVED)
    }


def _flat(facts: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    found = []
    for name, value in facts.items():
        if isinstance(value, Mapping):
            found += _flat(value, f"{prefix}{name}.")
        elif value is not None:
            found.append((f"{prefix}{name}", f"{value:.6g}" if isinstance(value, float) else str(value)))
    return found


# ---- whether objects are the same ----


def _pairing(first: Side, second: Side, pairing: str) -> tuple[bool, str]:
    if pairing == "different":
        return False, "the objects are different ones, as was said"
    if first.decisions is None or second.decisions is None:
        return False, "a summary has no decisions: objects cannot be compared one by one"
    truths = [_truth_of_objects(side.decisions) for side in (first, second)]
    common = truths[0].keys() & truths[1].keys()
    if not common:
        return False, "no object with a known truth is in both runs"
    differ = sum(truths[0][number] != truths[1][number] for number in common)
    if differ:
        return False, f"{differ} of {len(common)} objects of the same number have another true class"
    if pairing == "same":
        return True, f"{len(common)} objects are the same, as was said"
    if first.scene and first.scene == second.scene:
        return True, f"both runs show the scene {first.scene}; {len(common)} objects are in both"
    return False, "nothing says that the objects are the same; `--objects same` does"


def _truth_of_objects(decisions: NDArray[np.void] | None) -> dict[int, int]:
    if decisions is None:
        return {}
    known = decisions[decisions["truth"] >= 0]
    return dict(zip(known["object"].tolist(), known["truth"].tolist()))


def _share_right(decisions: NDArray[np.void]) -> dict[int, float]:
    """The share of right decisions of each object with a known truth."""
    known = decisions[decisions["truth"] >= 0]
    objects, at = np.unique(known["object"], return_inverse=True)
    right = np.bincount(at, weights=known["label"] == known["truth"])
    return dict(zip(objects.tolist(), (right / np.maximum(np.bincount(at), 1)).tolist()))


# ---- figures ----

_MEANS = {
    "clicks_mean": "clicks per decision",
    "photons_mean": "photons per decision",
    "illumination": "illumination per decision",
}


def _accuracy(first: Side, second: Side, paired: bool) -> list[Finding]:
    values = [side.summary.get("accuracy") for side in (first, second)]
    sizes = [int(side.summary.get("objects") or 0) for side in (first, second)]
    if first.decisions is not None and second.decisions is not None:
        shares = [_share_right(decisions) for decisions in (first.decisions, second.decisions)]
        if paired:
            return [_paired_accuracy(shares[0], shares[1])]
        sizes = [len(one) for one in shares]
        values = [sum(one.values()) / len(one) if one else None for one in shares]
    if None in values or not all(sizes):
        return []
    one, two = (float(value or 0.0) for value in values)
    counts = round(one * sizes[0]), sizes[0], round(two * sizes[1]), sizes[1]
    between = newcombe_difference(one * sizes[0], sizes[0], two * sizes[1], sizes[1])  # of the shares that are shown
    method = f"two shares of {sizes[0]} and {sizes[1]} distinct objects, Fisher exact; interval by Newcombe"
    return [Finding("accuracy", "share", one, two, *between, False, fisher_exact(*counts), method)]


def _paired_accuracy(first: dict[int, float], second: dict[int, float]) -> Finding:
    common = sorted(first.keys() & second.keys())
    one, two = (np.array([shares[number] for number in common]) for shares in (first, second))
    better, worse = int((one > two).sum()), int((one < two).sum())
    between = paired_difference(one, two)
    method = f"pairs of {len(common)} objects: {better} better in A, {worse} better in B, McNemar exact"
    p = mcnemar_exact(better, worse)
    return Finding("accuracy", "share", float(one.mean()), float(two.mean()), *between, False, p, method)


def _abstained(first: Side, second: Side) -> list[Finding]:
    counts, shares, sizes = [], [], []
    for side in (first, second):
        abstained, decisions = (int(side.summary.get(name) or 0) for name in ("abstained", "decisions"))
        trials = max(1, int(side.summary.get("trials") or 1))
        if not decisions:
            return []
        n = max(1, decisions // trials)
        counts += [min(n, round(abstained / trials)), n]
        shares.append(abstained / decisions)
        sizes.append(n)
    if not any(shares):
        return []
    between = newcombe_difference(shares[0] * sizes[0], sizes[0], shares[1] * sizes[1], sizes[1])
    method = "two shares, the trials of an object count once; Fisher exact; interval by Newcombe"
    return [Finding("abstained", "share", shares[0], shares[1], *between, False, fisher_exact(*counts), method)]


def _mean(first: Side, second: Side, name: str, unit: str) -> Finding:
    values = [side.summary.get(name) for side in (first, second)]
    if name == "illumination":
        values = [side.summary.get("illumination_mean", side.summary.get(name)) for side in (first, second)]
    one, two = (None if value is None else float(value) for value in values)
    if name == "clicks_mean" and first.decisions is not None and second.decisions is not None:
        means = [_clicks_of_objects(side.decisions) for side in (first, second)]
        if min(map(len, means)) > 1:
            return _clicks(means[0], means[1], unit)
    difference = None if one is None or two is None else one - two
    return Finding(name, unit, one, two, difference, None, None, False, None, "not tested")


def _clicks_of_objects(decisions: NDArray[np.void] | None) -> F64:
    assert decisions is not None
    _, at = np.unique(decisions["object"], return_inverse=True)
    return np.asarray(np.bincount(at, weights=decisions["clicks"]) / np.bincount(at), np.float64)


def _clicks(first: F64, second: F64, unit: str) -> Finding:
    difference = float(first.mean() - second.mean())
    half = 1.959963984540054 * float(np.sqrt(first.var(ddof=1) / len(first) + second.var(ddof=1) / len(second)))
    method = f"means of {len(first)} and {len(second)} objects; interval by their spread"
    ends = difference - half, difference + half
    return Finding(
        "clicks_mean", unit, float(first.mean()), float(second.mean()), difference, *ends, False, None, method
    )


def _late_and_lost(first: Side, second: Side) -> list[Finding]:
    found = []
    for name, unit, of in (("late", "decisions", "decisions"), ("lost", "exposures", "exposures")):
        counts = [int(side.summary.get(name) or 0) for side in (first, second)]
        totals = [_total(side.summary, of) for side in (first, second)]
        if not any(counts) or not all(totals):
            continue
        p = poisson_rates(counts[0], totals[0], counts[1], totals[1])
        ratio = rate_ratio(counts[0], totals[0], counts[1], totals[1])
        shares = [count / total for count, total in zip(counts, totals)]
        method = f"{counts[0]} of {totals[0]} and {counts[1]} of {totals[1]} {unit} as two Poisson counts; bursts look surer than they are"
        found.append(Finding(name, f"per {of[:-1]}", shares[0], shares[1], *ratio, True, p, method))
    return found


def _total(summary: Mapping[str, Any], name: str) -> int:
    if name == "decisions":
        return int(summary.get("decisions") or 0)
    stream = summary.get("stream")
    return int(stream.get("exposures") or 0) if isinstance(stream, Mapping) else 0


def _dark(first: Side, second: Side) -> list[Finding]:
    darks = [side.summary.get("dark") for side in (first, second)]
    counts = [
        (int(dark["clicks"]), int(dark["exposures"]))
        for dark in darks
        if isinstance(dark, Mapping) and dark.get("exposures")
    ]
    if len(counts) < 2:
        return []
    (clicks_1, n_1), (clicks_2, n_2) = counts
    p, ratio = poisson_rates(clicks_1, n_1, clicks_2, n_2), rate_ratio(clicks_1, n_1, clicks_2, n_2)
    method = f"{clicks_1} clicks in {n_1} and {clicks_2} in {n_2} dark exposures as two Poisson counts, exact"
    return [Finding("dark_rate", "clicks per dark exposure", clicks_1 / n_1, clicks_2 / n_2, *ratio, True, p, method)]


def _latencies(first: Side, second: Side) -> list[Finding]:
    if first.latency_us is None or second.latency_us is None:
        return _summed_latencies(first, second)
    found = []
    for name, q in QUANTILES.items():
        if min(len(first.latency_us), len(second.latency_us)) * (1 - q) < LEAST_BEYOND:
            continue
        if min(np.quantile(first.latency_us, q), np.quantile(second.latency_us, q)) < LEAST_US:
            continue  # virtual time
        one = quantile_ratio(first.latency_us, second.latency_us, q)
        method = "interval by a bootstrap of stretches of consecutive decisions"
        found.append(Finding(f"latency_{name}", "us", one.first, one.second, *one.ratio, True, None, method))
    return found


def _summed_latencies(first: Side, second: Side) -> list[Finding]:
    found = []
    for name, key in (("p50", "p50"), ("p99", "p99"), ("p99.9", "p999")):
        values = [(side.summary.get("latency_us") or {}).get(key) for side in (first, second)]
        if None not in values and min(float(value or 0) for value in values) >= LEAST_US:
            one, two = (float(value or 0) for value in values)
            ratio = one / two if two else None
            found.append(
                Finding(
                    f"latency_{name}",
                    "us",
                    one,
                    two,
                    ratio,
                    None,
                    None,
                    True,
                    None,
                    "not tested: no single latencies",
                )
            )
    return found


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
