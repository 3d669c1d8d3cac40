"""The detector as plain loops over single exposures and channels: the oracle of firmware_sim/detector.py."""

MASK = (1 << 64) - 1
GOLDEN = 0x9E3779B97F4A7C15


def finalise(word: int) -> int:
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & MASK
    return word ^ (word >> 31)


def number(seed: int, exposure: int, channel: int, stream: int) -> float:
    key = finalise(((finalise((seed + GOLDEN) & MASK) ^ finalise((stream + 1 + GOLDEN) & MASK)) + GOLDEN) & MASK)
    state = finalise((exposure * GOLDEN + key) & MASK)
    return (finalise((state + (channel + 1) * 0xD1342543DE82EF95) & MASK) >> 11) / (1 << 53)


def clicks(
    p_ap: float, p_ct: float, probability: list[list[float]], seed: int, first: int, previous: list[int]
) -> list[list[int]]:
    """Clicks of every exposure, one at a time: own click, afterpulse, then crosstalk of the first generation."""
    rows = []
    last = list(previous)
    for t, row in enumerate(probability):
        own = []
        for channel, p in enumerate(row):
            threshold = 1 - (1 - p) * (1 - p_ap) if last[channel] else p
            own.append(int(number(seed, first + t, channel, 0) < threshold))
        last = list(own)
        for channel in range(len(row)):
            if channel > 0 and own[channel - 1] and number(seed, first + t, channel, 1) < p_ct:
                last[channel] = 1
            if channel + 1 < len(row) and own[channel + 1] and number(seed, first + t, channel, 2) < p_ct:
                last[channel] = 1
        rows.append(list(last))
    return rows
