"""Moving scenes: the light against slow oracles, the statistics of the flow, and the truth in MARKs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import (
    BAR_LEVELS,
    CELLS,
    FLOW,
    LEVELS,
    PICTURES,
    TAPE,
    TICK_HZ,
    light_and_clicks,
    program,
    started,
    view_of,
)
from naive_moving import mean_light, shifted, tape_field

from pans.base.errors import ConfigError
from pans.instrument.click_law import ClickLaw
from pans.instrument.detector.dead_time import DeadTime
from pans.instrument.profile import ObjectModulator, load_profile
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Arm
from pans_sim.device.instrument import Instrument
from pans_sim.device.parallel import FrameRun
from pans_sim.device.sequential import Measurement
from pans_sim.device.view import View
from pans_sim.scene import cells as cells_module
from pans_sim.scene import shifts
from pans_sim.scene.cells import CellFlow
from pans_sim.scene.changes import Changes
from pans_sim.scene.detector_model import DetectorModel, detector_model, first_click_probability
from pans_sim.scene.marks import MARK_PHOTONS
from pans_sim.scene.moving import Cells, Change, SceneFile, Tape
from pans_sim.scene.optics import expected_photoelectrons, photons_per_level
from pans_sim.scene.program import Exposures, Program
from pans_sim.scene.scene_file import open_scene
from pans_sim.scene.shifts import ShiftTable, shift_table
from pans_sim.scene.still import scene_from_arrays
from pans_sim.scene.tape import BarTable, TapeFlow


def flow(what: Any = CELLS, plan: Program | None = None, seed: int = 7) -> Any:
    return light_and_clicks(view_of(what, seed=seed), plan or program())[0]


def light_of(run: Any, first: int, count: int) -> np.ndarray:
    rows, row_of = run.rows(first, count)
    return rows[row_of]


def marks_of(run: Any, n: int) -> list[wire.Mark]:
    marks: list[wire.Mark] = []
    before = 0
    while len(marks) < n:
        before += 100_000
        rows = run.take_marks(before)
        photons = rows[:, MARK_PHOTONS].copy().view(np.float64).tolist()
        for (number, truth, exposure, tick, half, _), light in zip(rows.tolist(), photons):
            marks.append(wire.Mark(0, number, truth, exposure, tick, light, half))
    return marks[:n]


def emitted(run: FrameRun | Measurement, n: int) -> list[Any]:
    return [run.emit() for _ in range(n) if run.next_tick is not None]


# -- light ---------------------------------------------------------------------------------------------------------------


def exposed(
    table: ShiftTable, centre: float, speed: float, images: list[int], offset: int = 0, begin: int = 0
) -> tuple[Any, int]:
    """Light of one exposure of 200 ticks from `begin` with these pictures at one place, and how many rows of light there are."""
    n = len(images)
    cells = (np.full(n, centre), np.full(n, speed), np.array(images), np.full(n, offset))
    row_of, rows = np.zeros(1, np.int64), np.empty((3, 3))
    begins, lit = np.array([begin], np.int64), np.ones(1, np.bool_)
    used = cells_module._fill(begins, lit, 200.0, np.inf, cells_module.Arrivals(*cells), table, row_of, rows)
    return rows[row_of[0]], used


@pytest.mark.parametrize("modulator", [None, ObjectModulator(20.0, 5), ObjectModulator(50.0, 256, 0.03)])
@pytest.mark.parametrize("background", [0.0, 0.3])
def test_tables_are_the_sums_of_the_drawn_field(modulator: ObjectModulator | None, background: float) -> None:
    profile = replace(FLOW, object_modulator=modulator)
    table = shift_table(profile, PICTURES, LEVELS, 2.0, 2, background)
    grey, white = shifts.grey_steps(profile)
    t_min, unit = profile.min_transmission, photons_per_level(profile, 2.0)
    for image, down, right in [(0, 0, 0), (1, -2, 3), (2, 1, -5), (3, 2, 7), (4, -1, -8), (4, 0, 8)]:
        field = shifted(grey[PICTURES.images[image]] / white, right, down, background)
        wanted = unit * (LEVELS @ (t_min + (1 - t_min) * field).ravel())
        at = (down + 2, right + 8)
        found = table.empty + table.scale_step * table.sums[image, *at] - table.scale_open * table.open_levels[at]
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", ["flow-snspd", "oled-qcmos"])
def test_a_cell_at_rest_in_the_middle_is_the_still_object(name: str) -> None:
    """Velocity 0+: the limit in which the simulator's moving light must be the light of its still scenes."""
    profile = load_profile(name)
    levels = np.minimum(LEVELS, profile.projector.levels - 1)
    table = shift_table(profile, PICTURES, levels, 2.0, 0, 0.0)
    still = expected_photoelectrons(profile, PICTURES, levels, 2.0)
    for image in range(5):
        found, used = exposed(table, 100.0, 1e-300, [image])
        assert used == 3
        np.testing.assert_allclose(found, still[image], rtol=1e-12)
        if profile.min_transmission == 0:
            np.testing.assert_allclose(found, still[image], rtol=4e-16)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 4), st.integers(-2, 2), st.floats(-9, 9), st.floats(1e-3, 7.0), st.sampled_from([0.0, 0.25]))
def test_light_during_an_exposure_is_the_mean_of_the_drawn_field(
    image: int, down: int, start_px: float, moved_px: float, background: float
) -> None:
    table = shift_table(FLOW, PICTURES, LEVELS, 2.0, 2, background)
    speed = moved_px / 200
    found, _ = exposed(table, 50 - start_px / speed, speed, [image], down + 2, begin=50)

    def field_at(moment: float) -> np.ndarray:
        return shifted(PICTURES.images[image] / 255, min(max(moment, -8.0), 8.0), down, background)

    steps = 400
    wanted = photons_per_level(FLOW, 2.0) * mean_light(
        LEVELS.astype(float), field_at, start_px, start_px + moved_px, steps
    )
    # the midpoint sum errs where the piecewise linear light bends: by its change over one step, about twice a pixel
    bound = photons_per_level(FLOW, 2.0) * LEVELS.sum(1).max() * moved_px / steps
    np.testing.assert_allclose(found, wanted, atol=bound)


def test_cells_that_overlap_add_up_to_the_open_field_at_most() -> None:
    table = shift_table(FLOW, PICTURES, LEVELS, 2.0, 0, 0.0)

    def light(images: list[int]) -> np.ndarray:
        return exposed(table, 100.0, 0.01, images)[0]

    np.testing.assert_allclose(light([0, 1]), np.minimum(light([0]) + light([1]), table.full), rtol=1e-12)
    np.testing.assert_allclose(light([0, 1, 2, 3, 4]), table.full, rtol=1e-15)
    assert (light([0]) + light([1]) < table.full).any()


def test_a_table_too_large_is_refused_with_the_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shifts, "MAX_TABLE_BYTES", 4 * 2 * 5 * 17 * 3)
    size = r"5 pictures x 5 offsets x 17 shifts x 3 patterns need 0 MiB.*at most 2 pictures"
    with pytest.raises(ValueError, match=size):
        shift_table(FLOW, PICTURES, LEVELS, 2.0, 2, 0.0)


def test_tape_light_is_the_mean_of_the_drawn_bars() -> None:
    run: TapeFlow = flow(TAPE, program(exposure=240, period=250))
    found = light_of(run, 0, 64)
    bits = {run._first_bar + k: int(bit) for k, bit in enumerate(run._bits)}
    levels = BAR_LEVELS.reshape(3, 2, 40).sum(axis=1).astype(float)
    for exposure in (0, 1, 8, 17, 30, 63):
        start, stop = (float(edge[0]) for edge in run._path(np.array([250.0 * exposure])))
        first = int(np.floor(start)) - 1
        nearby = [bits.get(first + k, 0) for k in range(16)]
        wanted = mean_light(levels, lambda t: tape_field(nearby, t - first, 10, 4), start, stop, 40)  # noqa: B023
        np.testing.assert_allclose(found[exposure], photons_per_level(FLOW, 2.4) * wanted, rtol=0.02)


def test_a_bar_tape_at_rest_is_the_still_picture_of_its_window() -> None:
    """Slow, without jitter: exposure m * pitch sees bars m - 1 to m + 8 and nothing else."""
    slow = Tape(10, 4, 0.5, 0.0, 0.0, "1010")
    run: TapeFlow = flow(slow, program(1, exposure=200, period=2 * TICK_HZ))
    found = light_of(run, 0, 30)
    bits = run._bits[np.arange(30)[:, None] + np.arange(10) - 1 - run._first_bar]
    pictures = np.repeat(np.repeat(bits * np.uint8(255), 4, axis=1)[:, None, :], 2, axis=1)
    still = expected_photoelectrons(FLOW, scene_from_arrays("bars", pictures, None, ()), BAR_LEVELS, 2.0)
    np.testing.assert_allclose(found, still, rtol=1e-6)  # in 2 us it moves by 1e-6 bars
    truths = [mark.truth for mark in marks_of(run, 29)]
    assert truths == ["1010" in "".join(map(str, row)) for row in bits[1:]]


# -- the flow ------------------------------------------------------------------------------------------------------------


def arrivals(cells: Cells, n: int, seed: int = 7) -> cells_module.Arrivals:
    run: CellFlow = flow(cells, seed=seed)
    while len(run._known.centre_ticks) < n:
        run._draw_chunk()
    return cells_module.Arrivals(*(column[:n] for column in run._known))


def test_arrivals_are_poisson_and_independent_of_everything_else() -> None:
    n = 40_000
    found = arrivals(CELLS, n)
    waits = np.diff(found.centre_ticks) * CELLS.rate_hz / TICK_HZ
    five_sigma = 5 / np.sqrt(n)
    assert waits.min() > 0
    assert abs(waits.mean() - 1) < five_sigma
    assert abs(waits.var() - 1) < five_sigma * np.sqrt(8)  # the variance of a variance: fourth moment 9, less 1
    counts = np.bincount((found.centre_ticks * CELLS.rate_hz / TICK_HZ / 5).astype(int))[:-1]
    assert abs(counts.var() / counts.mean() - 1) < 5 * np.sqrt(2 / len(counts))  # Fano factor of a Poisson process
    columns = {"waits": waits[1:], "before": waits[:-1], "speed": found.speed_px[2:], "image": found.images[2:]}
    columns["offset"] = found.offsets[2:]
    correlation = np.corrcoef(list(columns.values()))
    assert np.abs(correlation - np.eye(len(columns))).max() < five_sigma
    for numbers, kinds in ((found.images, 5), (found.offsets, 5)):
        expected = n / kinds
        assert np.abs(np.bincount(numbers, minlength=kinds) - expected).max() < 5 * np.sqrt(expected)
    fields_per_s = found.speed_px / 8 * TICK_HZ
    assert abs(fields_per_s.mean() / 40_000 - 1) < 0.2 * five_sigma
    assert abs(fields_per_s.std() / 40_000 - 0.2) < 0.2 * five_sigma
    assert abs(np.log(fields_per_s).mean() - np.median(np.log(fields_per_s))) < 0.2 * 2 * five_sigma


def test_empty_stretches_are_empty_and_cost_no_cell() -> None:
    gaps = replace(CELLS, gap_every_s=1e-3, gap_s=4e-4)
    found, plain = arrivals(gaps, 3000), arrivals(CELLS, 3000)
    within = found.centre_ticks / TICK_HZ % 1e-3
    assert within.max() < 6e-4 + 1e-9
    stretches = np.floor(plain.centre_ticks / (6e-4 * TICK_HZ))
    np.testing.assert_allclose(found.centre_ticks - plain.centre_ticks, stretches * 4e-4 * TICK_HZ, rtol=1e-9)


def test_the_tape_is_fair_and_its_error_is_the_process_it_says() -> None:
    run: TapeFlow = flow(Tape(10, 4, 50_000.0, 0.05, 2e-4))  # correlation time of ten bars
    run._reach(60_000)
    errors, bits = run._errors[:60_000], run._bits[:60_000].astype(float)
    kept = np.exp(-0.1)
    effective = len(errors) * (1 - kept**2) / (1 + kept**2)  # independent squares
    assert abs(errors.var() / 0.05**2 - 1) < 5 * np.sqrt(2 / effective)
    assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1] - kept) < 5 * np.sqrt((1 - kept**2) / len(errors))
    assert abs(bits.mean() - 0.5) < 5 * 0.5 / np.sqrt(len(bits))
    for lag in (1, 2, 9):
        assert abs(np.corrcoef(bits[lag:], bits[:-lag])[0, 1]) < 5 / np.sqrt(len(bits))


def test_a_tape_file_repeats_without_end() -> None:
    run: TapeFlow = flow(replace(TAPE, file_bits=np.array([1, 0, 1, 1, 0], np.uint8)))
    run._reach(9000)
    first = run._first_bar
    assert run._bits.tolist() == [[1, 0, 1, 1, 0][(first + k) % 5] for k in range(len(run._bits))]


# -- marks and messages ----------------------------------------------------------------------------------------------------


def test_marks_tell_when_a_cell_is_centred_and_gone() -> None:
    plan = program(dark=(15,), gap=500)
    run: CellFlow = flow(CELLS, plan)
    found = arrivals(CELLS, 200)
    exposures = Exposures(plan, None, TICK_HZ)
    begins = exposures.begins(0, 20_000)
    for number, mark in enumerate(marks_of(run, 200)):
        centre = float(found.centre_ticks[number])
        assert mark.object_index == number
        assert mark.truth == PICTURES.labels[found.images[number]]
        assert mark.tick == begins[mark.exposure_index] <= centre
        assert begins[mark.exposure_index + 1] > centre
        gone = np.ceil(centre + 8 / found.speed_px[number])
        assert (
            begins[mark.exposure_index + mark.half_exposures]
            > gone
            >= begins[mark.exposure_index + mark.half_exposures - 1]
        )


def test_a_mark_promises_the_light_of_its_cell_alone() -> None:
    rare = replace(CELLS, rate_hz=20.0)
    run: CellFlow = flow(rare)
    for mark in marks_of(run, 5):
        assert light_of(run, mark.exposure_index, 1).sum() == pytest.approx(mark.photons, rel=1e-12)
        around = light_of(run, mark.exposure_index + mark.half_exposures, 3)
        assert not around.any()  # it has left


def test_tape_marks_stand_where_the_window_is_aligned() -> None:
    run: TapeFlow = flow(TAPE)
    marks = marks_of(run, 600)
    bits = {run._first_bar + k: int(bit) for k, bit in enumerate(run._bits)}
    for number, mark in enumerate(marks):
        assert mark.object_index == number
        window = "".join(str(bits[number + k]) for k in range(10))
        assert mark.truth == int("1010" in window)
        start, _ = run._path(np.array([float(mark.tick), float(mark.tick + 250)]))
        assert start[0] <= number + 1e-9
        assert start[1] >= number - 1e-9
        assert mark.half_exposures == pytest.approx(4, abs=1)  # half of 20 us in periods of 2.5 us
    assert light_of(run, marks[3].exposure_index, 1).sum() == pytest.approx(marks[3].photons, rel=1e-12)


def test_another_run_meets_other_cells() -> None:
    first, again, later = (started(view_of(), program(), first_draw=draw) for draw in (0, 0, 5000))
    marks = [marks_of(run._light, 3) for run in (first, again, later)]
    assert marks[0] == marks[1] != marks[2]


# -- what changes ----------------------------------------------------------------------------------------------------------


def test_changes_add_up_as_declared() -> None:
    model = detector_model(replace(FLOW, detector=replace(FLOW.detector, dead_time_ns=0.0)), 2.0)
    changes = Changes(
        (
            Change("dark", 1.0, 2.0, -1, 100.0),
            Change("hot", 0.0, 9.0, 1, 1e4),
            Change("burst", 2.0, 0.5, -1, 2e5),
            Change("dead", 3.0, np.inf, 2, 0.0),
            Change("drift", 1.0, 4.0, -1, -10.0),
            Change("hot", 0.0, 9.0, 7, 1e9),  # a channel that this instrument does not have
        ),
        3,
    )
    times = np.array([0.5, 1.0, 2.2, 3.5, 20.0])
    light = np.full((5, 3), 0.3)
    dark = 130 * 2e-6
    mean = np.array(
        [
            [0.3 + dark, 0.3 + dark + 0.02, 0.3 + dark],
            [0.3 + 100 * dark, 0.3 + 100 * dark + 0.02, 0.3 + 100 * dark],
            [0.88 * 0.3 + 100 * dark + 0.4, 0.88 * 0.3 + 100 * dark + 0.42, 0.88 * 0.3 + 100 * dark + 0.4],
            [0.75 * 0.3 + dark, 0.75 * 0.3 + dark + 0.02, np.nan],
            [0.6 * 0.3 + dark, 0.6 * 0.3 + dark, np.nan],
        ]
    )
    wanted = np.nan_to_num(-np.expm1(-mean))
    np.testing.assert_allclose(changes.probability(model, light, times, 2e-6), wanted, rtol=1e-12)
    assert not Changes((), 3)


def test_dead_time_counts_after_all_that_changed() -> None:
    blinded = DetectorModel(ClickLaw(0.01, dead_time=DeadTime(0.5)))
    brighter = Changes((Change("burst", 0.0, 1.0, -1, 1e6), Change("dark", 0.0, 1.0, -1, 20.0)), 1)
    found = brighter.probability(blinded, np.array([[1.0]]), np.array([0.5]), 2e-6)
    wanted = first_click_probability(blinded, np.array([[1.0 + 2.0 + 0.19]]))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert found[0, 0] < -np.expm1(-3.2) - 0.03


def test_a_dead_channel_is_silent_in_spite_of_crosstalk() -> None:
    profile = replace(FLOW, detector=replace(FLOW.detector, crosstalk_probability=0.5))
    changes = (Change("dead", 0.0, np.inf, 1, 0.0), Change("burst", 0.0, 1.0, -1, 1e6))
    run = started(view_of(PICTURES, changes, profile=profile, seed=1), program())
    words = np.concatenate([block.words for block in emitted(run, 80) if isinstance(block, wire.FrameBlock)])
    clicks = np.unpackbits(words, axis=1, bitorder="little")[:, :3].mean(axis=0)
    assert clicks[1] == 0
    assert min(clicks[0], clicks[2]) > 0.5


def test_a_moving_scene_needs_all_channels_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="shows pattern after pattern"):
        Instrument(load_profile("ideal"), SceneFile("x", CELLS))


def test_bars_that_do_not_fit_the_patterns_are_refused() -> None:
    with pytest.raises(ValueError, match=r"patterns have 48 pixels, the tape needs a multiple of 40"):
        BarTable(FLOW, TAPE, LEVELS, 2.0)


# -- the whole device --------------------------------------------------------------------------------------------------------


def test_a_still_scene_changes_too_pattern_after_pattern() -> None:
    """The paper's way of measuring: 40 000 exposures in the dark, the dark rate ten times as high in the second half."""
    profile = load_profile("ideal")
    profile = replace(profile, detector=replace(profile.detector, dark_rate_hz=1e4))
    slots = 2 * np.arange(100, dtype=np.int64)
    plan = Program(
        0, 1, 2, 2, 200, 1, slots, np.zeros(100, np.uint16), ((0, 100),)
    )  # 2 us at 1 MHz, one after the other
    view = View(profile, open_scene("dark", "dark:at_s=0.05:factor=10"), seed=1)
    run = view.run(plan, Arm(10, 0, 1), view.tabulate(plan, np.ones((1, 4), np.uint16)))
    assert isinstance(run, Measurement)
    bits = np.concatenate([block.bits for block in emitted(run, 1100) if isinstance(block, wire.ClickBlock)])[:50_000]
    for part, mean in ((bits[:25_000], 0.02), (bits[25_000:], 0.2)):
        wanted = -np.expm1(-mean)
        assert abs(part.mean() - wanted) < 5 * np.sqrt(wanted / len(part))
