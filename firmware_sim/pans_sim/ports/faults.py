"""Which faults a simulated link and device have: names, strengths and what cannot be done.

`parse_faults` reads the text form (`loss:0.01,stall:600ms/5s`, in a URL or a TOML file) and returns a `Faults`, or raises UsageError.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from pans.base.errors import ConfigError, UsageError
from pans.base.files import read_toml, toml_text

MAX_FILE_BYTES = 1 << 16
UNITS_NS = {"us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}


class Recurring(NamedTuple):
    """Something that happens about every `every_ns` and lasts (or jumps by) `length_ns`."""

    length_ns: int
    every_ns: int


@dataclass(frozen=True, slots=True)
class Faults:
    """Probabilities are per frame and hold in both directions; what recurs does so in the host's time.

    loss, flip (1 to 3 bits), duplicate, truncate (the end is missing, delimiter included), reorder (held back behind up to 8 frames), drip
    (one byte per tick); stall (nothing passes, then a flood), disconnect (the link breaks and comes back), pause (the host stands
    still), clock_step (the device's counter jumps ahead), reset (the device restarts with another epoch), late (the device keeps its
    stream messages to itself for a while, and answers everything else at once).
    """

    loss: float = 0.0
    flip: float = 0.0
    duplicate: float = 0.0
    truncate: float = 0.0
    reorder: float = 0.0
    drip: float = 0.0
    stall: Recurring | None = None
    disconnect: Recurring | None = None
    pause: Recurring | None = None
    clock_step: Recurring | None = None
    reset: Recurring | None = None
    late: Recurring | None = None

    @property
    def any_frame_fault(self) -> bool:
        """Whether single frames are damaged."""
        return any(getattr(self, name) > 0 for name in FRAME_FAULTS)


FRAME_FAULTS = ("loss", "flip", "duplicate", "truncate", "reorder", "drip")
NAMES = tuple(field.name for field in fields(Faults))
# What a name alone means: often enough to happen many times in a minute.
USUAL = {
    "loss": "0.01",
    "flip": "0.01",
    "duplicate": "0.01",
    "truncate": "0.01",
    "reorder": "0.01",
    "drip": "0.01",
    "stall": "600ms/5s",
    "disconnect": "400ms/15s",
    "pause": "300ms/4s",
    "clock_step": "2ms/5s",
    "reset": "0ms/20s",
    "late": "40ms/2s",
}
NO_FAULTS = Faults()


def parse_faults(text: str) -> Faults:
    """Read `name[:value],...`, `all` (each at its usual strength), or the name of a .toml file with a table [faults]."""
    if text.endswith(".toml"):
        return _of_pairs(_file_pairs(Path(text)), text)
    pairs: list[tuple[str, str]] = []
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = item.partition(":")
        pairs += list(USUAL.items()) if item == "all" else [(name, value)]
    return _of_pairs(pairs, f"faults={text}")


def check_possible(faults: Faults, *, pace: str, listen: str = "") -> None:
    """Raise UsageError for a fault that this way of running cannot produce."""
    if pace == "real" and faults.pause is not None:
        raise UsageError(
            "faults: pause cannot be done at real pace: the host is another program",
            remedy="use pace=fast, or stop the host with a signal",
        )
    if listen == "pty" and faults.disconnect is not None:
        raise UsageError(
            "faults: disconnect cannot be done on a pseudo-terminal: it would come back under another name",
            remedy="listen on tcp:127.0.0.1:0, or use pace=fast",
        )


def _of_pairs(pairs: list[tuple[str, str]], where: str) -> Faults:
    faults = NO_FAULTS
    for name, value in pairs:
        if name not in NAMES:
            raise UsageError(f"{where}: there is no fault {name!r}", remedy=f"known: all, {', '.join(NAMES)}")
        word = value or USUAL[name]
        read: Any = _probability(name, word, where) if name in FRAME_FAULTS else _recurring(name, word, where)
        faults = replace(faults, **{name: read})
    return faults


def _probability(name: str, word: str, where: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1.0:
        raise UsageError(
            f"{where}: {name} is a probability, allowed: 0 to 1, found {word!r}",
            remedy=f"write {name}:0.01, for example",
        )
    return value


def _recurring(name: str, word: str, where: str) -> Recurring:
    length, slash, every = word.partition("/")
    if not slash:
        raise UsageError(f"{where}: {name} needs a length and how often, like {USUAL[name]}, found {word!r}")
    lasting = Recurring(_nanoseconds(name, length, where), _nanoseconds(name, every, where))
    if name == "clock_step" and lasting.length_ns < 0:
        raise UsageError(
            f"{where}: a device's counter cannot run backwards: found {word!r}", remedy="a restart is the fault `reset`"
        )
    if (
        lasting.length_ns < 0
        or lasting.every_ns <= 0
        or (name != "clock_step" and lasting.length_ns >= lasting.every_ns)
    ):
        raise UsageError(f"{where}: {name} must last at least 0 and less than its period, found {word!r}")
    return lasting


def _nanoseconds(name: str, word: str, where: str) -> int:
    for unit, factor in UNITS_NS.items():
        number = word.removesuffix(unit)
        if word.endswith(unit) and number.removeprefix("-").replace(".", "", 1).isdecimal():
            return round(float(number) * factor)
    raise UsageError(f"{where}: {name} has no time in us, ms or s: {word!r}")


def _file_pairs(path: Path) -> list[tuple[str, str]]:
    table, _ = read_toml(toml_text(path, MAX_FILE_BYTES, "a list of faults"), str(path))
    if set(table) != {"faults"} or not isinstance(table["faults"], dict):
        raise ConfigError(f"{path}: expected one table [faults]")
    return [(name, value if isinstance(value, str) else str(value)) for name, value in table["faults"].items()]
