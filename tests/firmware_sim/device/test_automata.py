"""The instrument with an automaton: followed by the device or named by the host, bit for bit, and everything that it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import naive_walks
import numpy as np
import pytest
from bundles import automaton_bundle, six_states, two_states
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_bench import IDEAL, Bench, of_type, plan, run_hosted, stamps_and_readings

from pans.bundle.automaton import Automaton
from pans.decide.plan.plan import Plan, build_plan
from pans.instrument.profile import Profile, load_profile
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, AckStatus, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import (
    Arm,
    MaskChunk,
    PatternChunk,
    StateChunk,
    announced,
    mask_chunks,
    pack_command,
    state_dtype,
)
from pans_sim.device import readings
from pans_sim.scene.moving import Change, SceneFile
from pans_sim.scene.still import scene_from_arrays

IMAGES = np.random.default_rng(3).integers(0, 256, (5, 2, 3)).astype(np.uint8)
SCENE = scene_from_arrays("five", IMAGES, np.arange(5) % 3, ("c0", "c1", "c2"))
EXPOSURE_US = 80.0
SEED = 7


def instrument(**changes: Any) -> Profile:
    """The DMD with a SPAD, whose dark counts and afterpulses are strong enough to matter, on a clock of 1 MHz."""
    profile = load_profile("dmd-spad")
    projector = replace(profile.projector, automaton_states=100, dwell_steps=4)
    detector = replace(profile.detector, dark_rate_hz=2000.0, afterpulse_probability=0.3)
    timing = replace(profile.timing, device_turn_us=0.0, host_turn_us=200.0)
    clock = replace(profile.clock, tick_hz=1_000_000)
    return replace(profile, projector=projector, detector=replace(detector, **changes), timing=timing, clock=clock)


def set_up(automaton: Automaton, drive: str, profile: Profile | None = None, **options: Any) -> tuple[Bench, Plan]:
    """A bench with `automaton` uploaded; light is about one photoelectron per exposure."""
    profile = profile or instrument()
    top = EXPOSURE_US * 1e-6 * profile.projector.peak_photoelectrons_hz
    bundle = automaton_bundle(automaton, photons=top)
    made = build_plan(profile, bundle, shots_per_object=2, drive=drive)
    bench = Bench(profile, options.pop("scene", SCENE), **{"seed": SEED, **options})
    bench.hello()
    bench.load(bundle.pattern_levels, made)
    return bench, made


def bright(automaton: Automaton, drive: str = "device", **options: Any) -> tuple[Bench, Plan]:
    """As `set_up`, with a hundred times the light, so that about every second exposure clicks."""
    profile = options.pop("profile", None) or instrument()
    projector = replace(profile.projector, peak_photoelectrons_hz=profile.projector.peak_photoelectrons_hz * 5)
    return set_up(automaton, drive, replace(profile, projector=projector), **options)


def run(bench: Bench, made: Plan, cycles: int, start: int = 2000) -> tuple[np.ndarray, np.ndarray, list[Any]]:
    """Arm, run to the end, and return stamps, clicks and all messages."""
    start = bench.device.tick + start
    bench.done(Opcode.ARM, pack_command(Arm(start, cycles, 100_000)))
    messages = bench.run_to(start + cycles * made.cycle_ticks)
    return (*stamps_and_readings(messages), messages)


def naive(bench: Bench, made: Plan, automaton: Automaton, count: int) -> tuple[list[int], list[int]]:
    """The same run by the oracle, from profile, patterns and images alone."""
    profile = bench.device.profile
    states = [
        (int(p), int(d) / automaton.dwell_steps, int(a), int(b))
        for p, d, (a, b) in zip(automaton.pattern, automaton.dwell, automaton.successors)
    ]
    levels = automaton_bundle(automaton).pattern_levels.astype(float)
    seconds = made.exposure_us * 1e-6
    per_level = profile.projector.peak_photoelectrons_hz * seconds
    lambdas = per_level * IMAGES.reshape(5, 6) / 255.0 @ levels.T

    def light(cycle: int, pattern: int) -> float:
        return float(lambdas[cycle // made.cycles_per_object % 5, pattern])

    detector = profile.detector
    dark = detector.dark_rate_hz * seconds
    slots = made.slot_pattern.tolist()
    return naive_walks.exposures(states, slots, light, dark, detector.afterpulse_probability, SEED, count)


def walked_as_the_oracle(bench: Bench, made: Plan) -> int:
    """Hold all that came against the oracle; return how many exposures it is."""
    stamps, clicks = stamps_and_readings([message for _, message in bench.got])
    assert (stamps.tolist(), clicks.tolist()) == naive(bench, made, six_states(), len(stamps))
    return len(stamps)


@pytest.mark.parametrize("automaton", [two_states(), six_states()], ids=["two", "six"])
@pytest.mark.parametrize("afterpulses", [0.0, 0.3])
def test_the_device_follows_the_automaton_as_the_oracle_does(automaton: Automaton, afterpulses: float) -> None:
    bench, made = bright(automaton, profile=instrument(afterpulse_probability=afterpulses))
    stamps, clicks, _ = run(bench, made, 300)
    wanted = naive(bench, made, automaton, len(stamps))
    assert (stamps.tolist(), clicks.tolist()) == wanted
    assert set(stamps.tolist()) == {*range(automaton.n_states), DARK_PATTERN}  # every state was visited
    assert 0.2 < clicks.mean() < 0.9


@pytest.mark.parametrize("automaton", [two_states(), six_states()], ids=["two", "six"])
def test_both_ways_of_driving_give_the_same_walks(automaton: Automaton) -> None:
    stamps, clicks, _ = run(*bright(automaton), cycles=60)
    hosted = run_hosted(*bright(automaton, "host"), automaton, 60)
    assert np.array_equal(stamps, hosted[0])
    assert np.array_equal(clicks, hosted[1])


def test_what_the_next_walks_need_is_made_where_there_is_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """An object that comes for the first time would else hold up its own exposures, and the decision on it."""
    bench, made = bright(six_states())
    start, cycles = bench.device.tick + 2000, 2 * made.cycles_per_object
    bench.done(Opcode.ARM, pack_command(Arm(start, cycles, 100_000)))
    while bench.device.draw_ahead():
        pass

    def made_late(*_: Any) -> None:
        raise AssertionError("made when it was due")

    for name in ("expected_light", "_of_states"):
        monkeypatch.setattr(readings.Clicks, name, made_late)
    messages = bench.run_to(start + cycles * made.cycle_ticks)
    assert len(of_type(messages, wire.Mark)) == 2


def test_marks_tell_the_light_of_a_walk_in_expectation() -> None:
    automaton = six_states()
    bench, made = bright(automaton)
    _, _, messages = run(bench, made, 10)
    profile, seconds = bench.device.profile, made.exposure_us * 1e-6
    levels = automaton_bundle(automaton).pattern_levels.astype(float)
    lambdas = profile.projector.peak_photoelectrons_hz * seconds * IMAGES.reshape(5, 6) / 255.0 @ levels.T
    states = [
        (int(p), int(d) / 4, int(a), int(b))
        for p, d, (a, b) in zip(automaton.pattern, automaton.dwell, automaton.successors)
    ]
    dark = profile.detector.dark_rate_hz * seconds
    for mark in of_type(messages, wire.Mark):
        row = lambdas[mark.object_index % 5]
        wanted = naive_walks.expected_light(
            states, lambda pattern, row=row: row[pattern], dark, profile.detector.afterpulse_probability
        )
        assert mark.photons == pytest.approx(wanted, rel=1e-6)
    hosted, plan_of_host = bright(automaton, "host")
    run(hosted, plan_of_host, 1)
    assert math.isnan(of_type([message for _, message in hosted.got], wire.Mark)[0].photons)


def test_a_changing_detector_gives_both_ways_the_same_walks_and_other_ones_than_a_steady_one() -> None:
    changes = (
        Change("drift", 0.001, 1.0, -1, -5000.0),
        Change("burst", 0.004, 0.003, -1, 20_000.0),
        Change("dead", 0.01, 0.002, 0, 0.0),
    )
    scene, automaton = SceneFile("changing", SCENE, changes), six_states()
    prompt = instrument()
    prompt = replace(
        prompt, timing=replace(prompt.timing, host_turn_us=0.0)
    )  # slots come at the same times in both ways
    stamps, clicks, _ = run(*bright(automaton, scene=scene, profile=prompt), cycles=60)
    hosted = run_hosted(*bright(automaton, "host", scene=scene, profile=prompt), automaton, 60)
    assert np.array_equal(stamps, hosted[0])
    assert np.array_equal(clicks, hosted[1])
    steady = run(*bright(automaton, profile=prompt), cycles=60)
    assert not np.array_equal(steady[1], clicks)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 3000), min_size=1, max_size=20))
def test_the_size_of_time_steps_changes_nothing(cuts: list[int]) -> None:
    bench, made = bright(six_states())
    bench.done(Opcode.ARM, pack_command(Arm(bench.device.tick + 100, 40, 100_000)))
    for cut in cuts:
        bench.run_to(bench.device.tick + cut)
    bench.run_to(bench.device.tick + 41 * made.cycle_ticks)
    walked_as_the_oracle(bench, made)


def test_work_that_is_done_ahead_changes_nothing_and_ends() -> None:
    bench, made = bright(six_states())
    bench.done(Opcode.ARM, pack_command(Arm(bench.device.tick + 100, 40, 100_000)))
    # the thresholds of three objects, the light of two: that of the first is in its mark already
    assert [bench.device.draw_ahead() for _ in range(6)] == [*[True] * 5, False]
    for _ in range(100):
        bench.run_to(bench.device.tick + made.cycle_ticks // 2)
        bench.device.draw_ahead()
    assert walked_as_the_oracle(bench, made) == 40 * made.slots_per_cycle


def test_a_broken_off_walk_is_sent_as_far_as_it_went() -> None:
    bench, made = bright(six_states())
    start = bench.device.tick + 100
    bench.done(Opcode.ARM, pack_command(Arm(start, 10, 100_000)))
    bench.run_to(start + 3 * made.cycle_ticks + 2 * made.slot_period_ticks + made.exposure_ticks + 1)
    bench.done(Opcode.STOP)
    assert walked_as_the_oracle(bench, made) == 3 * made.slots_per_cycle + 3


def test_many_objects_and_patterns_need_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Objects are computed when they come; a walk is the same whether one, a few or all of them are kept."""
    whole = run(*bright(six_states()), cycles=40)[:2]
    monkeypatch.setattr("pans_sim.device.walking.BLOCK_ENTRIES", 6)  # two objects at a time
    monkeypatch.setattr("pans_sim.device.walking.MAX_BLOCKS", 1)
    monkeypatch.setattr("pans_sim.device.readings.MAX_THRESHOLDS", 1)
    bench, made = bright(six_states())
    assert np.array_equal(np.stack(whole), np.stack(run(bench, made, 40)[:2]))
    assert len(bench.device._light[1]._blocks) == 1


@pytest.mark.uncompiled
def test_the_kernels_walk_as_the_oracle_does() -> None:
    automaton, slots = six_states(), [0xFFFF, *[0xFFFE] * 4]
    light = np.linspace(0.2, 2.0, 6)
    states = [(p, 1.0, int(a), int(b)) for p, (a, b) in enumerate(automaton.successors)]
    wanted = naive_walks.exposures(states, slots, lambda _, pattern: light[pattern], 0.0, 0.0, 3, 5 * 40)
    limits = np.ceil(-np.expm1(-np.append(light, 0.0)) * 2.0**53).astype(np.uint64)
    successors = automaton.successors.astype(np.int64)
    stamps, clicks, before = np.zeros((40, 5), np.uint16), np.zeros((40, 5), np.uint8), 0
    for walk in range(40):
        readings.follow(
            np.stack([limits, limits])[:, :, None], successors, np.array(slots) == ADAPTIVE_PATTERN, readings.click_key(3),
            5 * walk, (0, before), stamps[walk], clicks[walk],
        )  # fmt: skip
        before = int(clicks[walk, -1])
    assert (stamps.ravel().tolist(), clicks.ravel().tolist()) == wanted
    for p_ap in (0.0, 0.3):
        p = -np.expm1(-light)
        click = np.stack([p, p + p_ap * (1 - p)])
        expected = readings.expected_light(np.stack([1 - click, click], axis=1), light, successors)
        assert expected == pytest.approx(naive_walks.expected_light(states, lambda pattern: light[pattern], 0.0, p_ap))


# -- uploads -----------------------------------------------------------------------------------------------------------


def states(*rows: tuple[int, int, int, int], **changes: Any) -> StateChunk:
    chunk = StateChunk(len(rows), 0, 1, 2, 2, np.array([(*row[:2], row[2:]) for row in rows], state_dtype(2)))
    return chunk._replace(**changes)


def with_plan(slots: int = 2, profile: Profile | None = None) -> Bench:
    bench = Bench(profile or instrument(), SCENE)
    bench.hello()
    bench.done(Opcode.LOAD_MASKS, pack_command(MaskChunk(0, 0, 6, 6, np.ones((2, 1), np.uint8))))
    bench.done(Opcode.LOAD_PLAN, pack_command(plan(2, [ADAPTIVE_PATTERN] * slots)))
    return bench


def test_states_in_pieces_and_a_plan_that_forgets_them() -> None:
    bench = with_plan()
    whole = states((0, 1, 1, 2), (1, 1, 2, 3))
    first, second = (whole._replace(first_state=n, states=whole.states[n : n + 1]) for n in (0, 1))
    arm = pack_command(Arm(bench.device.tick + 10_000, 1, 1000))
    bench.done(Opcode.LOAD_STATES, pack_command(first))
    assert bench.refused(Opcode.ARM, arm)[0] == AckStatus.WRONG_STATE
    assert bench.refused(Opcode.LOAD_STATES, pack_command(second._replace(n_leaves=3)))[0] == AckStatus.OUT_OF_RANGE
    bench.done(Opcode.LOAD_STATES, pack_command(second))
    assert bench.device._states.states is not None
    assert bench.refused(Opcode.LOAD_STATES, pack_command(second))[0] == AckStatus.OUT_OF_RANGE
    bench.done(Opcode.LOAD_PLAN, pack_command(plan(2, [ADAPTIVE_PATTERN] * 2)))
    assert bench.device._states.states is None
    assert bench.refused(Opcode.LOAD_STATES, pack_command(second))[0] == AckStatus.OUT_OF_RANGE
    bench.done(Opcode.ARM, arm)  # without states: the host drives


def test_masks_are_patterns_of_two_levels() -> None:
    bench = Bench(IDEAL, SCENE)
    bench.hello()
    rows = np.random.default_rng(0).integers(0, 2, (5, 13)).astype(np.uint8)
    packed = np.packbits(rows, axis=1, bitorder="little")
    bench.done(Opcode.LOAD_MASKS, pack_command(MaskChunk(3, 0, 13, 13, packed)))
    bench.done(Opcode.LOAD_PATTERN, pack_command(PatternChunk(0, 0, 13, rows[0].astype(np.uint16))))
    bench.done(Opcode.LOAD_MASKS, pack_command(MaskChunk(1, 0, 13, 8, packed[1:2, :1])))
    bench.done(Opcode.LOAD_PATTERN, pack_command(PatternChunk(1, 8, 13, rows[1, 8:].astype(np.uint16))))
    bench.done(Opcode.LOAD_PATTERN, pack_command(PatternChunk(2, 0, 13, rows[2].astype(np.uint16))))
    held = bench.device._patterns.stack(8)
    assert np.array_equal(held, rows[[0, 1, 2, 0, 1, 2, 3, 4]])
    assert bench.device._patterns.held_bytes == held.nbytes


def test_large_masks_go_in_pieces_and_small_ones_together() -> None:
    levels = np.random.default_rng(0).integers(0, 2, (3, 200_003)).astype(np.uint16)
    bench = Bench(instrument(), SCENE)
    bench.hello()
    bodies = [pack_command(chunk) for chunk in mask_chunks(levels)]
    assert max(map(len, bodies)) < 9000
    for body in bodies:
        bench.done(Opcode.LOAD_MASKS, body)
    assert np.array_equal(bench.device._patterns.stack(3), levels)
    small = list(mask_chunks(np.zeros((12_000, 784), np.uint16)))
    assert sum(len(chunk.rows) for chunk in small) == 12_000
    assert len(small) == 145  # of 83 masks each


def test_what_the_device_announces() -> None:
    (welcome, _) = Bench(instrument(), SCENE).hello()
    extension = announced(welcome.facts)
    assert extension is not None
    assert (extension.states, extension.dwell_steps) == (100, 4)
    assert announced({**welcome.facts, "automaton_schema": 1}) is None
    parallel = Bench(load_profile("wdm-snspd"))
    (welcome, _) = parallel.hello()
    assert announced(welcome.facts) is None
    status, _ = parallel.refused(Opcode.LOAD_STATES, pack_command(states((0, 1, 1, 2))))
    assert status == AckStatus.UNKNOWN_OPCODE
