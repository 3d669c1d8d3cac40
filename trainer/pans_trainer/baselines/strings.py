"""Barcodes, exactly, without sampling or training: direct imaging, and what no scheme of patterns is above.

**Direct imaging** (`imaged`): one detector looks at each bar, and every string and every click word is gone through. A counting detector
would say no more without dark counts: a dark bar gives no photon.

**Any scheme** (`Bars`), patterns chosen by the clicks so far, is bounded by dynamic programming over its posteriors:

- A pattern clicks as the OR of its bars, lit one after the other with the same light. So a scheme that lights single bars, dimly, until
  they click or no more is wanted, knows as much for no more photons and no more illumination: single bars are no restriction.
- Bars are independent, and stay so: one is known to be bright (it clicked), or it was silent under light L, which leaves its bright case
  the weight s = exp(-L). The value W of a state, times its chance, is convex in each weight where a scheme stops, and
  `dW/ds = W(clicked) - price * light` along a bar that is lit.
- The program has nodes of s for each bar, the last of them 0. Linear in each s between them, its values meet both conditions of an upper
  bound if a scheme that stops there is given, for each dark bar, the most by which -ln s, its light, is below the straight line. After the
  last node above 0 a dark bar's light is charged as if that s were kept: the bound is not tight where certainty is paid for.
- With a price on photons alone neither matters: with s = 1 and 0 alone the bound is the optimum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pans.base.machine import njit
from pans_trainer.evaluate.information import entropy_bits, mutual_information_bits
from pans_trainer.evaluate.readings import outcome_probabilities
from pans_trainer.tasks.barcode import N_BARS, all_strings, weights

from .common import F32, F64, I64

LIT = N_BARS / 2  # bars of a string that are bright, on average
LIGHTS = (0.0, 1.0, 2.2, 4.0)  # of the nodes above 0 of a bar, where light has a price: 6^10 states
# lowest and highest price, and how many: of accuracy and of bits
PRICES = {
    ("photons", False): (0.02, 0.3, 60),
    ("photons", True): (0.05, 0.8, 60),
    ("illumination", False): (0.003, 0.035, 8),
    ("illumination", True): (0.006, 0.1, 8),
}
SURE = 1e-6  # part of a state's chance, below which its rarer label is none


def word_chances(bright: float, dark: float = 0.0) -> F64:
    """Return P(click word | string), (1024, 1024), where a bright bar gives `bright` photoelectrons and every detector `dark` counts.

    Bar 0 is the highest bit of the string's number, its detector that of the word's.
    """
    return outcome_probabilities(-np.expm1(-(bright * all_strings()[0][:, ::-1] + dark)), 1)


def imaged(bright: float, dark: float = 0.0) -> dict[str, float]:
    """Return `value` (accuracy in % of the best decision), `bits` known of the label, and mean `clicks`, `photons`, `illumination`.

    All strings are equally likely; the illumination is the light of all bars, as a camera needs it.
    """
    labels = all_strings()[1]
    share, chances = weights(), word_chances(bright, dark)
    joint = np.stack([share[labels == label] @ chances[labels == label] for label in (0, 1)])
    return {
        "value": 100 * float(joint.max(axis=0).sum()),
        "bits": mutual_information_bits(joint),
        "clicks": -LIT * math.expm1(-bright - dark) - (N_BARS - LIT) * math.expm1(-dark),
        "photons": LIT * bright,
        "illumination": N_BARS * bright,
    }


def at_photons(photons: float, dark: float = 0.0) -> dict[str, float]:
    """Return what `imaged` gives at that many detected photoelectrons per decision."""
    return imaged(photons / LIT, dark)


def at_clicks(clicks: float, dark: float = 0.0) -> dict[str, float] | None:
    """Return what `imaged` gives at that many clicks per decision; None where no light gives so many, or none so few."""
    clicking = (clicks + (N_BARS - LIT) * math.expm1(-dark)) / LIT  # share of the bright bars that click
    if not -math.expm1(-dark) <= clicking < 1.0:
        return None
    return imaged(-math.log1p(-clicking) - dark, dark)


# ---- any scheme ----


@dataclass(frozen=True, slots=True, eq=False)
class Bars:
    """Bars, each as likely bright as dark, and the label of every string, int64 (2**n,) of 0 and 1; bar 0 is the highest bit of the row."""

    labels: I64

    def most(
        self, photon_price: float, unit_price: float = 0.0, lights: Sequence[float] = LIGHTS, *, bits: bool = False
    ) -> float:
        """Return what no scheme's accuracy (0 to 1; or `bits` known of the label) less the prices of its mean light is above.

        `unit_price` is of the illumination, `lights` the light L of the nodes above 0, from 0 on: the more, the tighter.
        """
        lights = lights if unit_price else (0.0,)
        s = np.append(np.exp(-np.array(lights)), 0.0)
        chances = np.append(np.stack([np.full(len(s), 0.5), s / 2], axis=1), [[0.0, 0.5]], axis=0)  # dark, bright
        mass = chances.sum(axis=1)
        lit = -np.diff(s)  # of a bright bar, for both prices
        unlit = np.append(np.diff(lights), 1.0)
        cost = (photon_price * lit + unit_price * (lit + unlit)) / 2 / mass[: len(lit)]
        gains = [0.0, *(_gain(high, low) for high, low in pairwise(s[:-1])), 0.0]
        of_node = np.maximum(gains[1:], gains[:-1])
        if (np.diff(of_node) > np.diff(lights) + lit[:-1]).any():
            raise ValueError(f"lights are {lights}, allowed: steps of about the same size")
        gain = np.zeros(len(mass))
        gain[: len(lit)] = unit_price * of_node / 2 / mass[: len(lit)]
        values = self.labels.astype(np.float32)
        n = len(values).bit_length() - 1
        for _ in range(n):  # the chance of label 1 in every state
            values = (chances.astype(np.float32) @ values.reshape(2, -1)).T.reshape(-1)
        _solve(values, n, lit, mass, cost, gain, bits)
        prior = self.labels.mean()
        return float(values[0]) + (float(entropy_bits(np.array([prior, 1 - prior]))) if bits else 0.0)


def _gain(high: float, low: float) -> float:
    """The most by which -ln s is below the straight line between two nodes."""
    slope = math.log(high / low) / (high - low)
    return slope * high - 1 + math.log(1 / slope / high)


@njit(cache=True, nogil=True)
def _solve(values: F32, n: int, lit: F64, mass: F64, cost: F64, gain: F64, bits: bool) -> None:
    """Replace the chance of label 1 in every state of `n` bars by the state's value, from the last state to the first."""
    nodes = len(mass)
    at, chance = np.full(n, nodes - 1), np.ones(n + 1)
    strides = nodes ** np.arange(n - 1, -1, -1)
    changed = 0
    for state in range(len(values) - 1, -1, -1):
        for bar in range(changed, n):
            chance[bar + 1] = chance[bar] * mass[at[bar]]
        whole = chance[n]
        one, best = float(values[state]), 0.0
        other = whole - one
        sure = min(one, other) <= SURE * whole
        if not bits:
            best = max(one, other)
        elif not sure:
            best = one * math.log2(one / whole) + other * math.log2(other / whole)
        for bar in range(n):
            best += gain[at[bar]] * whole
        if not sure:
            for bar in range(n):
                node = at[bar]
                if node < len(lit):
                    clicked = values[state + (nodes - 1 - node) * strides[bar]]
                    best = max(best, values[state + strides[bar]] + lit[node] * clicked - cost[node] * whole)
        values[state] = best
        changed = n - 1
        while changed > 0 and at[changed] == 0:
            at[changed] = nodes - 1
            changed -= 1
        at[changed] -= 1


def bounds(levels: Sequence[float], light: str) -> list[dict[str, float]]:
    """Return for each level of `light` (photons or illumination per decision) what no scheme is above: `value` (accuracy in %) and `bits`.

    Uniform strings without dark counts, which are no help. The other light is free. With illumination a minute of a core or two.
    """
    bars, at = Bars(all_strings()[1]), np.array(levels)
    found = []
    for bits in (False, True):
        # a price of 0 gives what there is to know
        prices = [0.0, *np.geomspace(*PRICES[light, bits])]
        most = [bars.most(*((price, 0.0) if light == "photons" else (0.0, price)), bits=bits) for price in prices]
        found.append((np.array(most)[:, None] + np.outer(prices, at)).min(axis=0))
    return [{"value": 100 * float(value), "bits": float(known)} for value, known in zip(*found)]
