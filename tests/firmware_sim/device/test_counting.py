"""A detector that counts photons: what it reads against the physics summed by hand, walks in plain loops, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from automata import random_automaton
from bundles import automaton_bundle
from instrument_bench import Bench, of_type, run_hosted, stamps_and_readings
from instrument_bench import plan as fixed_plan

from pans.bundle.automaton import Automaton
from pans.decide.plan.plan import Plan, build_plan
from pans.instrument.profile import Profile, load_profile
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, AckStatus, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Arm, PatternChunk, ReadCounts, announced_counts, pack_command
from pans_sim.scene.moving import Change, SceneFile
from pans_sim.scene.still import scene_from_arrays

IMAGES = np.random.default_rng(3).integers(0, 256, (5, 2, 3)).astype(np.uint8)
SCENE = scene_from_arrays("five", IMAGES, np.arange(5) % 3, ("c0", "c1", "c2"))
LIGHT = 1.3  # photoelectrons of a lit pixel behind a transmission of 1


def instrument(**changes: Any) -> Profile:
    """The DMD with a counting pixel of much read noise and many dark counts, and no turn to wait for."""
    profile = load_profile("dmd-qcmos")
    detector = replace(profile.detector, read_noise_e=0.35, dark_rate_hz=150.0, **changes)
    timing = replace(profile.timing, device_turn_us=0.0, host_turn_us=100.0)
    projector = replace(profile.projector, peak_photoelectrons_hz=LIGHT / 1000e-6, dwell_steps=8)
    return replace(profile, detector=detector, timing=timing, projector=projector)


def reading(mean: float, largest: int, noise: float = 0.35, threshold: float = 0.7) -> list[float]:
    """P(0), P(1) ... P(largest or more) by hand: Poisson weights times the Gaussian between two edges."""
    edges = [-math.inf, threshold, *(number + 0.5 for number in range(1, largest)), math.inf]

    def below(edge: float, k: int) -> float:
        return 0.5 * (1 + math.erf((edge - k) / (noise * math.sqrt(2))))

    weight = [math.exp(-mean) * mean**k / math.factorial(k) for k in range(60)]
    return [sum(w * (below(high, k) - below(low, k)) for k, w in enumerate(weight)) for low, high in pairwise(edges)]


def set_up(automaton: Automaton, drive: str, profile: Profile | None = None, scene: Any = SCENE) -> tuple[Bench, Plan]:
    """A bench with `automaton` uploaded."""
    profile = profile or instrument()
    bundle = automaton_bundle(automaton, photons=LIGHT)
    made = build_plan(profile, bundle, shots_per_object=2, drive=drive)
    bench = Bench(profile, scene, seed=7)
    bench.hello()
    bench.load(bundle.pattern_levels, made)
    return bench, made


def run(bench: Bench, made: Plan, cycles: int) -> tuple[np.ndarray, np.ndarray]:
    start = bench.device.tick + 2000
    bench.done(Opcode.ARM, pack_command(Arm(start, cycles, 1_000_000)))
    return stamps_and_readings(bench.run_to(start + cycles * made.cycle_ticks))


def test_fixed_patterns_are_counted_as_the_physics_says() -> None:
    profile = instrument()
    bench = Bench(profile, SCENE, seed=3)
    bench.hello()
    levels = [np.ones(6, np.uint16), np.array([1, 0, 0, 0, 0, 0], np.uint16)]
    for number, pattern in enumerate(levels):
        bench.done(Opcode.LOAD_PATTERN, pack_command(PatternChunk(number, 0, 6, pattern)))
    ticks = round(1000e-6 * profile.clock.tick_hz)  # a lit pixel gives LIGHT
    plan = fixed_plan(2, [0, 1, DARK_PATTERN], exposure_ticks=ticks, slot_period_ticks=2 * ticks, cycle_ticks=6 * ticks)
    plan.slots["offset_ticks"] = np.arange(3) * 2 * ticks
    bench.done(Opcode.LOAD_PLAN, pack_command(plan))
    bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(4)))
    bench.grant(1 << 20)
    cycles, start = 2500, bench.device.tick + 2000
    bench.done(Opcode.ARM, pack_command(Arm(start, cycles, 3_600_000)))
    messages = bench.run_to(start + cycles * plan.cycle_ticks)
    shown, numbers = stamps_and_readings(messages)
    assert {block.largest for block in of_type(messages, wire.ClickBlock)} == {4}
    assert shown.tolist() == [0, 1, DARK_PATTERN] * cycles
    objects = np.arange(cycles) // plan.cycles_per_object % 5
    for place, pattern in enumerate([*levels, np.zeros(6)]):
        for number in range(5):
            mean = LIGHT * float(IMAGES[number].reshape(6) / 255.0 @ pattern) + 150.0 * 1e-3
            found = np.bincount(numbers[place::3][objects == number], minlength=5)
            wanted = np.array(reading(mean, 4)) * found.sum()
            assert abs(wanted.sum() - found.sum()) < 1e-6 * found.sum()
            chi2 = float(((found - wanted) ** 2 / wanted)[wanted > 5].sum())
            assert chi2 < 24, (place, number, found, wanted)  # of at most 4 degrees: once in 10 000
    marks = of_type(messages, wire.Mark)
    assert marks[1].photons == pytest.approx(LIGHT * IMAGES[1].sum() / 255 + LIGHT * IMAGES[1].flat[0] / 255, rel=1e-3)
    bench.done(Opcode.LOAD_PLAN, pack_command(plan))  # clicks again
    start = bench.device.tick + 2000
    bench.done(Opcode.ARM, pack_command(Arm(start, 30, 3_600_000)))
    again = of_type(bench.run_to(start + 30 * plan.cycle_ticks), wire.ClickBlock)
    assert {block.largest for block in again} == {1}
    assert max(int(block.bits.max()) for block in again) == 1


def test_an_object_that_stays_for_ever_is_counted_as_one_that_goes() -> None:
    """The host says for how many cycles: so many exposures are not drawn at once, and what is drawn is the same."""
    drawn = []
    for cycles_per_object in (3000, (1 << 32) - 1):
        bench = Bench(instrument(), SCENE, seed=3)
        bench.hello()
        bench.done(Opcode.LOAD_PATTERN, pack_command(PatternChunk(0, 0, 6, np.ones(6, np.uint16))))
        times = {"exposure_ticks": 10_000, "slot_period_ticks": 20_000, "cycle_ticks": 20_000}
        bench.done(Opcode.LOAD_PLAN, pack_command(fixed_plan(1, [0], cycles_per_object=cycles_per_object, **times)))
        bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(4)))
        bench.grant(1 << 20)
        start = bench.device.tick + 2000
        bench.done(Opcode.ARM, pack_command(Arm(start, 3000, 3_600_000)))
        drawn.append(stamps_and_readings(bench.run_to(start + 3000 * 20_000))[1].tolist())
    assert len(drawn[0]) == 3000
    assert drawn[0] == drawn[1]


def test_the_device_follows_the_numbers_and_the_host_gets_the_same_by_naming() -> None:
    automaton = random_automaton(5, slots=5, width=6, patterns=6, outcomes=4)
    bench, made = set_up(automaton, "device")
    stamps, numbers = run(bench, made, 60)
    node, seen = 0, set()
    for exposure, (stamp, number) in enumerate(zip(stamps.tolist(), numbers.tolist())):
        slot = exposure % made.slots_per_cycle
        node = node if slot else 0
        lit = made.slot_pattern[slot] == ADAPTIVE_PATTERN and node < automaton.n_states
        assert stamp == (node if lit else DARK_PATTERN)
        if lit:
            seen.add(number)
            node = int(automaton.successors[node, number])
    assert seen == {0, 1, 2, 3}
    hosted, named = set_up(automaton, "host")
    # another spacing of exposures changes no number: it belongs to the exposure
    assert [column.tolist() for column in run_hosted(hosted, named, automaton, 60)] == [
        stamps.tolist(),
        numbers.tolist(),
    ]


def test_what_a_walk_brings_is_told_in_its_mark() -> None:
    automaton = random_automaton(5, slots=4, width=3, patterns=6, outcomes=3)
    bench, made = set_up(automaton, "device", instrument())
    start = bench.device.tick + 2000
    bench.done(Opcode.ARM, pack_command(Arm(start, 2, 100_000)))
    (mark, *_) = of_type(bench.run_to(start + made.cycle_ticks), wire.Mark)
    lambdas = LIGHT * IMAGES[0].reshape(6) / 255.0 @ automaton_bundle(automaton).pattern_levels.astype(float).T
    seconds = made.exposure_us * 1e-6
    dark = 150.0 * seconds
    total, reached = 0.0, {0: 1.0}
    for state in range(automaton.n_states):
        light = float(lambdas[automaton.pattern[state]]) * float(automaton.dwell[state]) / automaton.dwell_steps
        here = reached.get(state, 0.0)
        total += here * light
        for after, chance in zip(automaton.successors[state].tolist(), reading(light + dark, 2)):
            reached[after] = reached.get(after, 0.0) + here * chance
    assert mark.photons == pytest.approx(total, rel=1e-3)


def test_what_changes_changes_the_numbers() -> None:
    automaton = random_automaton(5, slots=4, width=3, patterns=6, outcomes=3)
    plain = run(*set_up(automaton, "device"), 40)[1]
    dead = run(*set_up(automaton, "device", scene=SceneFile("dead", SCENE, (Change("dead", 0.0, 1e9, 0, 0.0),))), 40)[1]
    leak = Change("burst", 0.0, 1e9, 0, 2000.0)
    leaking = run(*set_up(automaton, "device", scene=SceneFile("leak", SCENE, (leak,))), 40)[1]
    assert plain.any()
    assert not dead.any()
    assert leaking.mean() > plain.mean() + 0.5


def test_clicks_alone_are_announced_by_who_does_not_count() -> None:
    def told(profile: Profile) -> int:
        (welcome,) = of_type(Bench(profile, SCENE).hello(), wire.Welcome)
        return announced_counts(welcome.facts)

    assert told(instrument()) == 15
    assert told(load_profile("dmd-spad")) == told(load_profile("oled-qcmos")) == 1
    assert told(instrument(afterpulse_probability=0.01)) == 1  # it clicks, whatever it says
    bench = Bench(load_profile("dmd-spad"), SCENE)
    bench.hello()
    for opcode in (Opcode.READ_COUNTS, Opcode.LOAD_COUNT_STATES):
        assert bench.refused(opcode, pack_command(ReadCounts(2)))[0] == AckStatus.UNKNOWN_OPCODE
