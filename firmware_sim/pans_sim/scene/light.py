"""What reaches the detectors in one run: still objects, cells and a tape behind one interface.

`prepare` makes the tables of a pattern set, `begin` starts a scene. Cells and tape have modules of their own, with numba, loaded only
where something moves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from pans.instrument.profile import Profile
from pans.protocol.wire import DARK_PATTERN, NO_OBJECT, PARALLEL, Mark

from .changes import Changes
from .detector_model import detector_model, first_click_probability, stream_key
from .marks import mark_rows
from .moving import Cells, SceneFile, Tape
from .optics import expected_photoelectrons
from .program import Exposures, Program
from .still import Scene

if TYPE_CHECKING:
    from .shifts import ShiftTable
    from .tape import BarTable

_ROWS_AT_ONCE = 4096  # whose intermediate results stand in memory
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Table: TypeAlias = "LightTable | ShiftTable | BarTable"  # what a scene needs to know of a pattern set


class LightTable(NamedTuple):
    """Every still object under every pattern, one exposure each: photoelectrons and click probability.

    Both are float64 (objects, patterns + 1), the last column is the dark pattern.
    """

    photoelectrons: F64
    probability: F64


class RunLight(Protocol):
    """One run's light; `rows` is asked for exposures in their order."""

    probability: F64 | None  # of all rows, where they are known beforehand

    def take_marks(self, before_tick: int) -> I64:
        """Return the rows (marks.py) of marks whose tick after the start is below `before_tick`, and go on to those after."""

    def rows(self, first: int, count: int) -> tuple[F64, I64]:
        """Expected photoelectrons float64 (rows, channels), and int64 (count,) of the row of each of exposures first..first+count-1."""


def tabulate(profile: Profile, photons: F64, exposure_us: float) -> LightTable:
    """Return the table of expected photoelectrons (objects, patterns) of one exposure each."""
    with_dark = np.column_stack([photons, np.zeros(len(photons))])
    model, probability = detector_model(profile, exposure_us), np.empty_like(with_dark)
    for first in range(0, len(with_dark), _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        probability[rows] = first_click_probability(model, with_dark[rows])
    return LightTable(with_dark, probability)


def prepare(profile: Profile, scene: SceneFile, levels: NDArray[np.uint16], exposure_us: float) -> Table:
    """Make what `scene` needs to know of the patterns, uint16 (patterns, pixels); ValueError when they do not fit it."""
    what = scene.what
    if isinstance(what, Cells):
        from .shifts import shift_table

        return shift_table(profile, what.objects, levels, exposure_us, what.offset_px, what.background_transmission)
    if isinstance(what, Tape):
        from .tape import BarTable

        return BarTable(profile, what, levels, exposure_us)
    return tabulate(profile, expected_photoelectrons(profile, what, levels, exposure_us), exposure_us)


def warm_up(scene: SceneFile) -> None:
    """Compile or load the kernels of a scene that moves, so that ARM need not."""
    if isinstance(scene.what, Cells):
        from .cells import warm_up as warm_up_cells

        warm_up_cells()
    elif isinstance(scene.what, Tape):
        from .tape import warm_up as warm_up_tape

        warm_up_tape()


def begin(
    scene: SceneFile,
    table: Table,
    program: Program,
    exposures: Exposures,
    changes: Changes,
    seed: int,
    first_draw: int,
) -> RunLight:
    """Start the scene for one run; `first_draw` counts the exposures of earlier runs, so that no run repeats another one's objects."""
    flow_seed = stream_key(seed, first_draw) if first_draw else seed
    what = scene.what
    if isinstance(table, LightTable):
        assert isinstance(what, Scene)
        kind = StillObjects if what.bleaching.is_none else BleachedObjects
        return kind(what, table, program, exposures, changes)
    if isinstance(what, Cells):
        from .cells import CellFlow

        return CellFlow(what, cast("ShiftTable", table), exposures, changes, flow_seed)
    from .tape import TapeFlow

    return TapeFlow(cast(Tape, what), cast("BarTable", table), exposures, changes, flow_seed)


class StillMarks:
    """The marks of objects that stand still for `cycles_per_object` cycles each, in the order of the scene, which starts over at its end.

    `photons` gives what one shot on an object of the scene brings in expectation; NaN where that is not known.
    """

    def __init__(
        self,
        scene: Scene,
        program: Program,
        exposures: Exposures,
        changes: Changes,
        photons: Callable[[int], float],
    ) -> None:
        self._scene, self._program, self._exposures, self._changes = scene, program, exposures, changes
        self._photons_of = photons
        self._object = 0

    @property
    def mark(self) -> Mark:
        """The next mark; its tick counts from the start of the run."""
        exposure = self._object * self._program.cycles_per_object * self._program.n_slots
        tick = self._exposures.begin(exposure)
        number = self._object % NO_OBJECT
        photons = self._photons_of(number % self._scene.n_objects)
        if self._changes:
            photons *= float(self._changes.efficiency(np.array([tick / self._exposures.tick_hz]))[0])
        return Mark(0, number, self._scene.truth(number % self._scene.n_objects), exposure, tick, photons)

    def take_mark(self) -> None:
        """Go on to the mark after."""
        self._object += 1


class StillObjects(StillMarks):
    """Still objects under the fixed patterns of a plan."""

    def __init__(
        self, scene: Scene, table: LightTable, program: Program, exposures: Exposures, changes: Changes
    ) -> None:
        super().__init__(scene, program, exposures, changes, lambda number: float(self._photons[number]))
        self._photons = table.photoelectrons.sum(axis=1)
        self._light = _by_row(table.photoelectrons, program.mode)
        self.probability: F64 | None = _by_row(table.probability, program.mode)
        self._column = np.where(program.patterns == DARK_PATTERN, program.n_patterns, program.patterns).astype(np.int64)

    def take_marks(self, before_tick: int) -> I64:
        """See `RunLight`."""
        exposures_per_object = self._program.cycles_per_object * self._program.n_slots
        begun = int(self._exposures.begun_by(np.array([before_tick - 1]))[0])
        passing = np.arange(self._object, max(self._object, -(-begun // exposures_per_object)))
        self._object += len(passing)
        ticks = self._exposures.begins_of(passing * exposures_per_object)
        numbers = passing % NO_OBJECT
        photons = self._photons[numbers % self._scene.n_objects]
        if self._changes:
            photons = photons * self._changes.efficiency(ticks / self._exposures.tick_hz)
        truths = self._scene.labels[numbers % self._scene.n_objects].astype(np.int64)
        return mark_rows(numbers, truths, passing * exposures_per_object, ticks, np.zeros_like(ticks), photons)

    def rows(self, first: int, count: int) -> tuple[F64, I64]:
        """See `RunLight`: parallel, an object is a row and the last one is dark; sequential, a row is an object under a pattern."""
        program = self._program
        cycle, slot = np.divmod(np.arange(first, first + count), program.n_slots)
        row = cycle // program.cycles_per_object % NO_OBJECT % self._scene.n_objects
        column = self._column[slot]
        if program.mode != PARALLEL:
            return self._light, row * (program.n_patterns + 1) + column
        return self._light, np.where(column == program.n_patterns, len(self._light) - 1, row)


class BleachedObjects(StillObjects):
    """Still objects that the plan bleaches: the table has a column for each exposure of an object's stay (bleached.py)."""

    def __init__(
        self, scene: Scene, table: LightTable, program: Program, exposures: Exposures, changes: Changes
    ) -> None:
        super().__init__(scene, table, program, exposures, changes)
        self._photons = self._photons / program.cycles_per_object  # a mark tells of one shot: the mean of all
        self._columns = table.photoelectrons.shape[1]

    def rows(self, first: int, count: int) -> tuple[F64, I64]:
        """See `RunLight`: a row is an exposure of an object's stay."""
        stay = self._program.cycles_per_object * self._program.n_slots
        visit, place = np.divmod(np.arange(first, first + count), stay)
        return self._light, visit % NO_OBJECT % self._scene.n_objects * self._columns + place


def _by_row(table: F64, mode: int) -> F64:
    """A table (objects, patterns + 1) as rows of what the channels see at once: see `StillObjects.rows`."""
    if mode != PARALLEL:
        return table.reshape(-1, 1)
    return np.vstack([table[:, :-1], np.full((1, table.shape[1] - 1), table[0, -1])])
