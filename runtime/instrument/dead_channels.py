"""Dead channels, found in exposures with light: a channel that says nothing where it should have clicked.

Owns counts of silence, in whole numbers, and says which channels are dead; never names other states (channel_health.py) and never
acts (core/dark_guard.py). In the dark a dead channel is hard to see: at 10^-4 clicks per exposure silence is no news for a long time.
With light there are two tests, each with a stated number of exposures or objects between false alarms, all channels together:

- *Proved.* Whatever the scene, a living channel clicks at least at its dark rate r in every exposure, lit or not. A silence of n
  exposures has probability (1 - r)^n after each click, so that false alarms come every 1 / (r (1 - r)^n) exposures. For r half the
  lower end of what is expected is taken: a channel that has become quiet is not dead.
- *Inferred*, much sooner. A channel that clicked in a share q of the objects is silent in m of them in a row with probability
  (1 - q)^m after each click; q is the run's own running mean up to its last click, at the lower end of its interval. A scene that
  has come to give a pattern no light looks the same to this channel, but not to the others: a dead channel changes nothing in them,
  other objects do. So the shares of the others since the last click are compared with those before; where they differ the test says
  nothing, and the proof must decide. What it takes on trust: that objects come in no order, and that objects without light on one
  pattern are not the same as the others in all else.

With one detector (sequential measurements) there are no others: nothing at all clicks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.runtime.intervals import wilson_interval
from pans.runtime.wire.frame import read_only
from pans.runtime.wire.inner import inner, outer

from .cusum import FLOOR_RATE

I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
F64 = npt.NDArray[np.float64]
QUIET = 0.5  # of the expected dark rate: less often clicks only a dead channel
MAX_COMPARED = 64  # other channels that are compared, evenly spread
LEAST_CLICKED = (
    30  # objects in which a channel has clicked before it is judged by them: its share is then known to about a fifth
)
LEAST_OBJECTS = 8  # in a row without a click
LOOK_AGAIN = 1.25  # times the objects, where the others have changed
# Of the others' changes, in squared standard errors, beyond which the scene is another. One change alone is chi-square with one degree
# of freedom: 12.0 is passed with probability 5e-4. Their mean over d channels has standard deviation sqrt(2 / d): 1.6 lies 1.3 of them
# above 1 for ten channels and 3.4 for MAX_COMPARED. The test errs to the side of saying nothing: then the proof decides, later.
MEAN_Z2_MAX, Z2_MAX = 1.6, 12.0
RETURN_BLOCKS = 3  # with a click: the channel lives
_NEVER = 1 << 62


class Silence(NamedTuple):
    """A channel found dead: `length` exposures (proved) or objects (inferred) without a click, `rate` per one of them expected."""

    channel: int
    proved: bool
    length: int
    rate: float


class DeadArrays(NamedTuple):
    """What compiled code continues of a DeadChannelTest: its arrays, int64, by their names there."""

    silent: I64
    clicking: I64
    limits: I64
    row: I64
    clicked: I64
    quiet: I64
    then: I64
    compared: I64
    first: I64
    due: I64


class DeadChannelTest:
    """Follows the silence of `n` channels; all memory is allocated here, before arming.

    `dark_low` float64 (n,) are the lower ends of their dark rates; `arl_exposures` lie between false proofs and `arl_objects`
    between false inferences, of any channel, in the mean.
    """

    def __init__(self, dark_low: F64, arl_exposures: float, arl_objects: float) -> None:
        n = len(dark_low)
        self.n_channels = n
        self.silent: I64 = np.zeros(n, np.int64)  # exposures since the last block with a click
        self.clicking: I64 = np.zeros(n, np.int64)  # blocks with a click
        self.objects = 0
        self.clicked: I64 = np.zeros(n, np.int64)  # objects with a click
        self._proofs = np.array(
            [silence_limit(max(FLOOR_RATE, QUIET * float(low)), n, arl_exposures) for low in dark_low], np.int64
        )
        self._dark, self._limits = dark_low, self._proofs.copy()
        self._arl_objects = arl_objects
        self._compared: I64 = np.unique(np.linspace(0, n - 1, min(n, MAX_COMPARED)).round().astype(np.int64))
        self._row: I64 = np.zeros(n, np.int64)  # of the object under way: 1 where a channel has clicked
        self._object, self._open = -1, False
        self._quiet: I64 = np.zeros(n, np.int64)  # objects since the one of the last click
        self._then: I64 = np.zeros((n, len(self._compared)), np.int64)  # `clicked` of the compared channels at that one
        self._first: I64 = np.full(n, LEAST_OBJECTS, np.int64)  # objects of silence at which a channel is looked at
        self._due: I64 = self._first.copy()
        self._told: I64 = np.full(n, -1, np.int64)  # of the dead: `clicking` when they were told of
        self._any_due, self._n_told = False, 0

    def warm_up(self) -> None:
        """Compile or load the kernels, without counting anything."""
        words = read_only(np.zeros((0, 1), np.uint8))
        note_silence(words, self.silent.copy(), self.clicking.copy(), self._proofs)
        spare = [np.zeros_like(self._row) for _ in range(5)]
        note_object(spare[0], spare[1], spare[2], self._then.copy(), self._compared, spare[3], spare[4])

    def take_exposures(self, words: U8) -> None:
        """Take the exposures of a block, lit or dark: words uint8 (n, bytes), bit c is channel c."""
        self._any_due |= bool(note_silence(read_only(words), self.silent, self.clicking, self._limits))

    def take_counts(self, exposures: int, clicks: I64) -> None:
        """Take exposures of which only the clicks of each channel are known, int64 (n,)."""
        silent = clicks == 0
        self.clicking += ~silent
        self.silent += exposures
        self.silent *= silent
        self._any_due |= bool((self.silent >= self._limits).any())

    @property
    def arrays(self) -> DeadArrays:
        """What compiled code continues."""
        silence = (self.silent, self.clicking, self._limits)
        return DeadArrays(
            *silence, self._row, self.clicked, self._quiet, self._then, self._compared, self._first, self._due
        )

    @property
    def place(self) -> tuple[int, bool, int]:
        """The object under way, whether it is, and the objects before it."""
        return self._object, self._open, self.objects

    def went_on(self, place: tuple[int, bool, int], *, due: bool) -> None:
        """Take over where compiled code has brought the arrays, and whether `look` is due."""
        self._object, self._open, self.objects = place
        self._any_due |= due

    @property
    def has_news(self) -> bool:
        """Whether `look` or `returned` may have something to tell; cheap."""
        return self._any_due or self._n_told > 0

    def take_object(self, counts: I64, number: int) -> None:
        """Take one window's clicks, int64 (n,); windows of the same object `number` are one object, -1 is always another."""
        if self._open and (number < 0 or number != self._object):
            self.end_object()
        self._object, self._open = number, True
        np.maximum(self._row, counts > 0, out=self._row)

    def end_object(self) -> None:
        """The object under way has gone: what comes next is another."""
        if self._open:
            due = note_object(self._row, self.clicked, self._quiet, self._then, self._compared, self._first, self._due)
            self.objects += 1
            self._any_due |= bool(due)
            self._row[:] = 0
            self._open = False

    def look(self) -> list[Silence]:
        """Return the channels that have been found dead since the last look; no work where none has been silent for long."""
        if not self._any_due:
            return []
        self._any_due = False
        found = [
            Silence(channel, True, int(self.silent[channel]), float(self._dark[channel]))
            for channel in np.flatnonzero(self.silent >= self._limits).tolist()
        ]
        for channel in np.flatnonzero((self._quiet >= self._due) & (self.silent < self._limits)).tolist():
            found += self._judge(channel)
        self._n_told += len(found)
        for silence in found:
            self._told[silence.channel] = self.clicking[silence.channel]
            self._limits[silence.channel] = self._due[silence.channel] = _NEVER  # until it has clicked again
        return found

    def returned(self) -> list[int]:
        """Return the dead channels that click again, once."""
        dead = np.flatnonzero(self._told >= 0)
        if not len(dead):
            return []
        back = dead[self.clicking[dead] >= self._told[dead] + RETURN_BLOCKS]
        self._told[back], self._limits[back] = -1, self._proofs[back]
        self._n_told -= len(back)
        return [int(channel) for channel in back]

    def _judge(self, channel: int) -> list[Silence]:
        """Is a channel that was silent in the last objects dead? Set when it is looked at again where that cannot be said."""
        quiet = int(self._quiet[channel])
        before, clicked = self.objects - quiet, int(self.clicked[channel])
        rate = wilson_interval(clicked, before)[0] if clicked >= LEAST_CLICKED else 0.0
        limit = silence_limit(rate, self.n_channels, self._arl_objects) if rate > 0 else 2 * quiet
        self._first[channel] = max(LEAST_OBJECTS, min(limit, _NEVER))
        if quiet < limit:
            self._due[channel] = self._first[channel]
            return []
        if not self._others_as_before(channel, before, quiet):
            self._due[channel] = math.ceil(LOOK_AGAIN * quiet)
            return []
        return [Silence(channel, False, quiet, clicked / before)]

    def _others_as_before(self, channel: int, before: int, quiet: int) -> bool:
        others = self._compared != channel
        if not others.any():
            return True  # one detector
        then = self._then[channel, others].astype(np.float64)
        since = self.clicked[self._compared[others]] - then
        share = (then + since) / (before + quiet)
        varies = (share > 0) & (share < 1)
        if not varies.any():
            return False  # nothing else clicks, or all do: they say nothing
        error2 = (share * (1 - share) * (1 / before + 1 / quiet))[varies]
        z2 = (since[varies] / quiet - then[varies] / before) ** 2 / error2
        return bool(z2.mean() <= MEAN_Z2_MAX and z2.max() <= Z2_MAX)


def silence_limit(rate: float, n_channels: int, arl: float) -> int:
    """Return after how many silent trials in a row a channel that clicks with probability `rate` is taken for dead.

    False alarms of `n_channels` such channels lie `arl` trials apart in the mean: a silence of n begins with each click, so
    they come every 1 / (n_channels rate (1 - rate)^n) trials.
    """
    if rate >= 1.0:
        return 1
    needed = math.log(max(1.0, arl * n_channels * rate)) / -math.log1p(-rate)
    return max(1, math.ceil(min(needed, float(_NEVER))))


@outer
def note_silence(words, silent, clicking, limits):  # type: ignore[no-untyped-def]
    """Add a block's exposures to the silences: words uint8 (n, bytes), the rest int64 (channels,); return whether one passes its limit.

    A channel that clicked in the block is silent for 0 exposures at its end: no silence is ever counted too long.
    """
    passed = False
    for byte in range(min(words.shape[1], (silent.size + 7) >> 3)):
        seen = np.int64(0)
        for i in range(words.shape[0]):
            seen |= np.int64(words[i, byte])
        passed |= note_seen(seen, byte, words.shape[0], silent, clicking, limits)
    return passed


@inner
def note_seen(seen, byte, exposures, silent, clicking, limits):  # type: ignore[no-untyped-def]
    """As `note_silence` for the eight channels of one byte, of which `seen` has those that clicked in a block of `exposures`."""
    passed = False
    for channel in range(8 * byte, min(8 * byte + 8, silent.size)):
        if (seen >> (channel & 7)) & 1:
            silent[channel] = 0
            clicking[channel] += 1
        else:
            silent[channel] += exposures
            passed |= silent[channel] >= limits[channel]
    return passed


@outer
def note_object(row, clicked, quiet, then, compared, first, due):  # type: ignore[no-untyped-def]
    """Add one object, row int64 (channels,) of 0 or 1, to the shares; return whether a channel is due to be looked at.

    clicked and quiet int64 (channels,), then int64 (channels, compared), updated: at a click of channel c, then[c] are the
    totals of the channels `compared` with this object.
    """
    found = False
    for channel in range(row.size):
        clicked[channel] += row[channel]
    for channel in range(row.size):
        if row[channel]:
            quiet[channel] = 0
            due[channel] = first[channel]
            for w in range(compared.size):
                then[channel, w] = clicked[compared[w]]
        else:
            quiet[channel] += 1
            found |= quiet[channel] >= due[channel]
    return found
