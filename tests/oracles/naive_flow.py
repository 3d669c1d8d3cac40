"""Onsets and releases in plain loops over the whole history: what flow_kernels.scan must find, however the frames are cut into blocks."""

from fractions import Fraction


def passages(
    counts: list[int | None], width: int, on: int, off: int, longest: int, hold: int, background: Fraction
) -> list[tuple[object, ...]]:
    """Return (first, last, centre, clicks, broken, too long) of every passage in `counts` (None: a frame that never came)."""
    found: list[tuple[object, ...]] = []
    whole_since, start, broken, blind, not_before = 0, -1, False, False, 0
    for now, clicks in enumerate(counts):
        if clicks is None:
            whole_since = now + 1
            broken = broken or start >= 0
            continue
        if now - whole_since + 1 < width:
            total = None
        else:
            total = sum(c for c in counts[now - width + 1 : now + 1] if c)
        if start >= 0:
            too_long = now - start >= 2 * longest
            quiet = total is not None and total <= off
            if quiet or too_long:
                last = now - width if quiet else now
                found.append(
                    (
                        start,
                        last,
                        centre(counts[start : now + 1], last - start, background),
                        light(counts, start, now),
                        broken,
                        not quiet,
                    )
                )
                start, broken, blind, not_before = -1, False, not quiet, now + 1 + hold
        elif blind:
            blind = not (total is not None and total <= off)
        elif total is not None and total >= on and now >= not_before:
            start = now - width + 1
            broken = start - whole_since < width
    return found


def light(counts: list[int | None], first: int, last: int) -> int:
    """Clicks from frame `first` to `last`."""
    return sum(c for c in counts[first : last + 1] if c)


def centre(counts: list[int | None], width: int, background: Fraction) -> float:
    """The centroid of the clicks beyond the background's, in frames after the first; the middle where there is no such click."""
    weights = [Fraction(c or 0) - background for c in counts]
    if sum(weights) <= 0:
        return width / 2
    return float(min(max(sum(i * w for i, w in enumerate(weights)) / sum(weights), Fraction(0)), Fraction(len(counts))))
