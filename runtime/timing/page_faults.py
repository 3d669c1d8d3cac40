"""What the kernel did to one thread: page faults, and how often another thread was put in its place.

Owns the counting, by getrusage of the calling thread (Linux; elsewhere nothing is known). A minor fault is the first touch of a page, or of
one that had been given back: one to a few microseconds each. A major fault waits for the disk. An involuntary switch means that the
scheduler took the core away for somebody else.
"""

from __future__ import annotations

from collections.abc import Mapping

FIELDS = {"minor": "ru_minflt", "major": "ru_majflt", "involuntary_switches": "ru_nivcsw"}


class ThreadCounts:
    """Counts of the calling thread since construction, or since the last `restart`."""

    def __init__(self) -> None:
        self._before = _counts()

    def restart(self) -> None:
        """Count from here on."""
        self._before = _counts()

    def since(self) -> dict[str, int]:
        """Return {minor, major, involuntary_switches} so far; {} where the system does not tell."""
        return {name: count - self._before[name] for name, count in _counts().items() if name in self._before}


def fault_words(counts: Mapping[str, int]) -> str:
    """Return the counts in words.

    >>> fault_words({"minor": 12, "major": 0, "involuntary_switches": 3})
    '12 minor, 0 major; the core was taken away 3 times'
    """
    if not counts:
        return "not told by this system"
    switches = counts.get("involuntary_switches", 0)
    return f"{counts.get('minor', 0)} minor, {counts.get('major', 0)} major; the core was taken away {switches} times"


def _counts() -> dict[str, int]:
    try:
        import resource

        usage = resource.getrusage(resource.RUSAGE_THREAD)
    except (ImportError, AttributeError, ValueError):  # Windows; macOS knows whole processes only
        return {}
    return {name: int(getattr(usage, field)) for name, field in FIELDS.items()}
