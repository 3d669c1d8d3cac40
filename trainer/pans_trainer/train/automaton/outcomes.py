"""The chances of an exposure's outcomes and their slopes, from the light on the detectors: clicks of one or several, or photon numbers.

The laws are those of `runtime.instrument`, in torch and as fast as training needs; float32 in training, float64 where figures are compared.
The last outcome is what remains: its probability is 1 less the others', its slope minus theirs.

Of c channels that are read at once a state has c rows of light, one after the other, and 2**c outcomes: bit k is the click of channel k.
Given the light, channels click independently: an outcome's chance is the product of theirs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pans.instrument.click_law import ClickLaw, CountLaw, count_law, outcome_weights, outcomes_of
from pans.instrument.profile import Profile
from pans_trainer.model.detection import counted_mean, kept_coefficients

MEAN_MAX = 100.0  # beyond it no detector of a profile stays dark, and high powers of the mean leave float32
NEGLIGIBLE = 1e-8  # c_k k!: the chance to miss that many photoelectrons, below which the term is left out


@dataclass(frozen=True, slots=True)
class WordLaw:
    """The law of several channels that are read at once, each of which clicks by `click`."""

    click: ClickLaw
    channels: int


Law = ClickLaw | CountLaw | WordLaw
# Chances of all outcomes but the last, and how fast each falls; of several channels the falls are the chance of no click in each channel
# and how fast that falls.
Readings = tuple[tuple[Tensor, ...], tuple[Tensor, ...]]


def channels_of(law: Law) -> int:
    """Return how many rows of light a state has."""
    return law.channels if isinstance(law, WordLaw) else 1


def clicks_of(law: Law) -> tuple[int, ...]:
    """Return the clicks of each outcome, or the photons that are counted."""
    if isinstance(law, WordLaw):
        return tuple(word.bit_count() for word in range(1 << law.channels))
    return tuple(range(outcomes_of(law)))


def law_of(profile: Profile, exposure_us: float, outcomes: int, channels: int, dark: float | None) -> Law:
    """Return the law of an exposure on `profile`, with `dark` photoelectrons instead of its own, if given; ValueError as `count_law`."""
    law = count_law(profile, exposure_us, outcomes, dark)
    return WordLaw(law, channels) if channels > 1 and isinstance(law, ClickLaw) else law


def by_state(light: Tensor, channels: int) -> Tensor:
    """Return the sum over the channels of what stands as (states * channels, objects): (states, objects)."""
    return light if channels == 1 else light.unflatten(0, (-1, channels)).sum(dim=1)


def by_row(values: Tensor, channels: int) -> Tensor:
    """Return what stands by state, (states, anything), once for each of its channels."""
    return values if channels == 1 else values.repeat_interleave(channels, dim=0)


def readings(light: Tensor, law: Law) -> Readings:
    """Return the chances of all outcomes but the last, and how fast each of them falls with `light` (photoelectrons).

    The fall is -d/d(light): negative where an outcome becomes more probable. Under a click law both are those of `no_click`. Of several
    channels `light` is (states * channels, objects), chances are (states, objects), and the falls are for `slope_of` alone.
    """
    if isinstance(law, WordLaw):
        return _words(light, law)
    if isinstance(law, ClickLaw):
        dark, fall = no_click(light, law)
        return (dark,), (fall,)
    mean = light + law.dark_per_exposure if law.dark_per_exposure else light
    return _plain(mean, law) if law.is_plain else _noisy(mean, law)


def mean_reading(chances: tuple[Tensor, ...], clicks: tuple[int, ...]) -> Tensor:
    """Return the mean number of clicks or photons, from the chances of all outcomes but the last and the `clicks_of` all."""
    most = clicks[-1]
    mean = 1 - chances[0] if most == 1 else most * (1 - chances[0])
    for chance, number in zip(chances[1:], clicks[1:]):
        if number < most:
            mean -= (most - number) * chance
    return mean


def slope_of(falls: tuple[Tensor, ...], gains: list[Tensor], law: Law) -> Tensor:
    """Return how fast light lowers the sum of chance times gain over the outcomes: by rows of light, (rows, objects).

    `falls` are those of `readings`; `gains` what each outcome but the last, whose gain is 0, counts for, (states, objects).
    """
    if isinstance(law, WordLaw):
        return _word_slope(falls, gains, law.channels)
    slope = torch.mul(falls[0], gains[0])
    for fall, gain in zip(falls[1:], gains[1:]):
        slope.addcmul_(fall, gain)
    return slope


def no_click(light: Tensor, law: ClickLaw) -> tuple[Tensor, Tensor]:
    """Return the probability of no click, and how fast it falls with `light` (photoelectrons): both of the shape of `light`.

    The fall is -d/d(light), which is the slope of the click probability. With the plain law and no dead time both are the same tensor.
    """
    coefficients = kept_coefficients(law, NEGLIGIBLE)
    blinded = law.dead_time.reach > 0
    if coefficients == [1.0] and not blinded:
        dark = torch.exp(-(light + law.dark_per_exposure)) if law.dark_per_exposure else torch.exp(-light)
        return dark, dark
    mean, slope = counted_mean((light + law.dark_per_exposure).clamp(max=MEAN_MAX), law.dead_time)
    missed = torch.zeros_like(mean)
    change = torch.zeros_like(mean)
    for coefficient in reversed(coefficients):  # Horner, of the polynomial and of its derivative
        change = change * mean + missed
        missed = missed * mean + coefficient
    empty = torch.exp(-mean)
    fall = empty * (missed - change)
    return empty * missed, fall * slope if blinded else fall


def _words(light: Tensor, law: WordLaw) -> Readings:
    """Of each channel the chance of no click; products of them for the outcomes."""
    rows = light.unflatten(0, (-1, law.channels))
    of_each = [no_click(rows[:, channel], law.click) for channel in range(law.channels)]
    dark, fall = zip(*of_each)
    chances = [dark[0], 1 - dark[0]]
    for empty in dark[1:]:
        silent = [chance * empty for chance in chances]
        chances = silent + [chance - part for chance, part in zip(chances, silent)]
    return tuple(chances[:-1]), (*dark, *fall)


def _word_slope(falls: tuple[Tensor, ...], gains: list[Tensor], channels: int) -> Tensor:
    """The slope by rows: of each channel what its click changes, in the mean over what the others do."""
    dark, fall = falls[:channels], falls[channels:]
    slopes = []
    for channel in range(channels):
        bit = 1 << channel
        # last outcome: gain 0. What a click of this channel takes away, with the others' words in order
        differences = [
            gains[word] - gains[word | bit] if word | bit < len(gains) else gains[word]
            for word in range(len(gains))
            if not word & bit
        ]
        for other in range(channels):
            if other != channel:  # the lowest bit that is left
                silent, clicked = differences[::2], differences[1::2]
                differences = [torch.lerp(b, a, dark[other]) for a, b in zip(silent, clicked)]
        slopes.append(differences[0] * fall[channel])
    return torch.stack(slopes, dim=1).flatten(0, 1)


def _plain(mean: Tensor, law: CountLaw) -> Readings:
    """Without read noise: p_k = exp(-mean) mean^k / k!, which falls by p_k - p_(k-1)."""
    chances = [torch.exp(-mean)]
    falls = [chances[0]]
    for k in range(1, law.outcomes - 1):
        chances.append(chances[-1] * mean if k == 1 else (chances[-1] * mean).mul_(1.0 / k))
        falls.append(chances[-1] - chances[-2])
    return tuple(chances), tuple(falls)


def _noisy(mean: Tensor, law: CountLaw) -> Readings:
    """With read noise: polynomials in the mean, each coefficient of a chance 0 or above, so that no chance loses digits."""
    mean = mean.clamp(max=MEAN_MAX)
    weights = outcome_weights(law)
    empty = torch.exp(-mean)
    chances, falls = [], []
    for row in weights[:-1].tolist():
        kept = [weight if weight > NEGLIGIBLE else 0.0 for weight in row]
        while len(kept) > 1 and not kept[-1]:
            kept.pop()
        drops = [here - after for here, after in zip(kept, [*kept[1:], 0.0])]
        chances.append(_polynomial(mean, kept).mul_(empty))
        falls.append(_polynomial(mean, drops).mul_(empty))
    return tuple(chances), tuple(falls)


def _polynomial(mean: Tensor, weights: list[float]) -> Tensor:
    """Return sum_k weights_k mean^k / k!."""
    total = torch.full_like(mean, weights[-1] / math.factorial(len(weights) - 1))
    for k in range(len(weights) - 2, -1, -1):
        total.mul_(mean).add_(weights[k] / math.factorial(k))
    return total
