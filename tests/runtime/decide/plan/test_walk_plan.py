"""Plans of automata: one adaptive slot for each step of the longest walk, who drives, and refusals with numbers; to the device and back."""

import re
from dataclasses import replace

import numpy as np
import pytest
from bundles import automaton_bundle, made_bundle, six_states, two_states

from pans.base.errors import PlanError, UsageError
from pans.bundle.automaton import Automaton, stopped
from pans.bundle.sensor import Bundle
from pans.decide.plan.plan import NO_SHOT, build_plan, exposure_us
from pans.decide.plan.plan_codec import drive_words, plan_chunks, plan_from_chunks, state_chunks, upload_bytes
from pans.instrument.profile import Profile, load_profile
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, MalformedMessage
from pans.protocol.wire.commands import pack_command, unpack_states

DMD = load_profile("dmd-spad")


def instrument(states: int = 100, steps: int = 4, turn_us: float = 500.0) -> Profile:
    projector = replace(DMD.projector, automaton_states=states, dwell_steps=steps)
    return replace(DMD, projector=projector, timing=replace(DMD.timing, device_turn_us=0.0, host_turn_us=turn_us))


def bundle_for(automaton: Automaton, exposure: float = 50.0) -> Bundle:
    return automaton_bundle(automaton, photons=exposure * 1e-6 * DMD.projector.peak_photoelectrons_hz)


def long_walk(width: int, n_slots: int) -> Automaton:
    """Levels of 1, 2, 4 ... `width` states, `n_slots` of them; every state of a level is led to."""
    sizes = [min(1 << min(depth, 30), width) for depth in range(n_slots)]
    first = np.cumsum([0, *sizes])
    after = [first[t + 1] + np.arange(2 * sizes[t]).reshape(-1, 2) % sizes[t + 1] for t in range(n_slots - 1)]
    n_states = int(first[-1])
    successors = np.concatenate([*after, np.full((sizes[-1], 2), n_states)])
    return Automaton(np.zeros(n_states, int), np.ones(n_states, int), 1, successors, np.full((n_states + 1, 2), 0.5))


@pytest.mark.parametrize(("drive", "block"), [("device", None), ("host", 1)])
@pytest.mark.parametrize("dark", [0, 1, 3])
def test_a_cycle_is_one_walk(drive: str, block: int | None, dark: int) -> None:
    plan = build_plan(
        instrument(), bundle_for(six_states()), shots_per_object=5, dark_slots_per_cycle=dark, drive=drive
    )
    adaptive = plan.slot_pattern == ADAPTIVE_PATTERN
    assert (adaptive | (plan.slot_pattern == DARK_PATTERN)).all()
    assert (int(adaptive.sum()), plan.dark_slots_per_cycle) == (4, dark)
    assert adaptive[-1]
    assert (plan.slot_shot[adaptive] == 0).all()
    assert (plan.slot_shot[~adaptive] == NO_SHOT).all()
    assert (plan.shots_per_cycle, plan.cycles_per_object, plan.n_patterns, plan.drive) == (1, 5, 3, drive)
    assert block is None or plan.block_exposures == block
    assert plan.exposure_us == pytest.approx(exposure_us(instrument(), bundle_for(six_states())))


def test_the_hosts_turn_is_part_of_the_slot_where_the_host_drives() -> None:
    periods = {
        drive: build_plan(instrument(turn_us=750.0), bundle_for(six_states()), drive=drive).slot_period_ticks
        for drive in ("device", "host")
    }
    assert periods == {"device": 5300, "host": 5000 + 75000}  # 50 us, and 3 us of readout or 750 us, at 100 MHz
    prompt = instrument()
    prompt = replace(prompt, timing=replace(prompt.timing, device_turn_us=44.0))
    assert build_plan(prompt, bundle_for(six_states())).slot_period_ticks == 5000 + 4400
    slow = build_plan(instrument(turn_us=0.0), bundle_for(six_states(), 40.0), drive="host")
    assert slow.slot_period_ticks == 4330  # then the projector is what takes longest: 23.1 kHz


@pytest.mark.parametrize(("states", "drive"), [(6, "device"), (5, "host"), (0, "host")])
def test_the_device_drives_where_it_can(states: int, drive: str) -> None:
    assert build_plan(instrument(states), bundle_for(six_states())).drive == drive


@pytest.mark.parametrize(
    ("profile", "options", "words"),
    [
        (instrument(5), {"drive": "device"}, "6 states, the device of dmd-spad follows 5"),
        (instrument(steps=6), {}, "1 to 4 parts of an exposure, dmd-spad divides one into 6"),
        (instrument(steps=1), {}, "1 to 4 parts of an exposure, dmd-spad divides one into 1"),
        (
            replace(instrument(), projector=replace(instrument().projector, pattern_memory=2)),
            {},
            "3 patterns, the pattern memory of dmd-spad holds 2",
        ),
        (instrument(turn_us=5e7), {"drive": "host"}, "5000005000 ticks, the protocol counts up to 4294967295"),
        (instrument(), {"order": "pattern-major"}, "no order pattern-major"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_numbers(profile, options, words) -> None:
    with pytest.raises(PlanError, match=re.escape(words)):
        build_plan(profile, bundle_for(six_states()), **options)


def test_a_drive_is_for_automata_and_one_of_three() -> None:
    with pytest.raises(UsageError, match="drive must be one of"):
        build_plan(instrument(), bundle_for(six_states()), drive="both")
    fixed = made_bundle(photons_per_level=0.1, table=np.zeros((4, 2)))
    with pytest.raises(PlanError, match="fixed patterns"):
        build_plan(instrument(), fixed, drive="device")


def test_a_parallel_instrument_and_several_detectors_at_once_are_refused() -> None:
    with pytest.raises(PlanError, match="parallel mode"):
        parallel = replace(load_profile("wdm-snspd"), projector=instrument().projector)
        build_plan(parallel, bundle_for(six_states(), 4.0))
    pair = Automaton([0], [1], 1, [[1, 2, 3, 1]], np.full((4, 2), 0.5))
    with pytest.raises(PlanError, match=r"2 detectors at once, .* has 1;"):
        build_plan(instrument(), two := bundle_for(pair))
    assert two.n_patterns == 2


def test_a_stopped_automaton_takes_fewer_slots() -> None:
    sure = stopped(six_states(), 0.5)  # state 2 decides by then: 0 -> 1 -> 3 -> 5
    plan = build_plan(instrument(), bundle_for(six_states()), automaton=sure)
    assert plan.automaton is sure
    assert plan.slots_per_cycle == sure.n_slots + 1


@pytest.mark.parametrize("automaton", [two_states(), six_states(), long_walk(256, 40)], ids=["two", "six", "thousands"])
def test_a_plan_goes_to_the_device_and_back(automaton: Automaton) -> None:
    profile = instrument(60_000)
    plan = build_plan(profile, bundle_for(automaton))
    states = [unpack_states(chunk.opcode, pack_command(chunk)) for chunk in state_chunks(plan)]
    assert len(states) == -(-automaton.n_states // 680)
    rows = np.concatenate([chunk.states for chunk in states])
    assert np.array_equal(rows["pattern"], automaton.pattern)
    assert np.array_equal(rows["dwell"], automaton.dwell)
    assert np.array_equal(rows["next"], automaton.successors)
    again = plan_from_chunks(plan_chunks(plan), profile.clock.tick_hz, automaton, states)
    for name in plan.__slots__:
        np.testing.assert_array_equal(getattr(again, name), getattr(plan, name), err_msg=name)


def test_a_plan_of_the_host_has_no_states_and_comes_back_as_one() -> None:
    plan = build_plan(instrument(), bundle_for(six_states()), drive="host")
    assert state_chunks(plan) == []
    assert plan_from_chunks(plan_chunks(plan), DMD.clock.tick_hz, six_states()).drive == "host"


def test_states_of_another_automaton_are_not_believed() -> None:
    plan = build_plan(instrument(), bundle_for(six_states()))
    chunks, states, tick_hz = plan_chunks(plan), state_chunks(plan), DMD.clock.tick_hz
    other = six_states()
    turned = Automaton(other.pattern, other.dwell, 4, other.successors[:, ::-1], other.posteriors)
    with pytest.raises(MalformedMessage, match="were not sent as the automaton has them"):
        plan_from_chunks(chunks, tick_hz, turned, states)
    with pytest.raises(MalformedMessage, match="4 adaptive slots for walks of 2 exposures"):
        plan_from_chunks(chunks, tick_hz, two_states(), states)
    with pytest.raises(MalformedMessage, match="4 adaptive slots for walks of 0 exposures"):
        plan_from_chunks(chunks, tick_hz)


def test_who_drives_is_said_with_the_numbers() -> None:
    bundle = bundle_for(six_states())
    plan = build_plan(instrument(), bundle)
    said = drive_words(instrument(), bundle, plan)
    assert "the device drives an automaton of 6 states (the device follows 100) and 3 patterns (it holds 43690)" in said
    assert "5 slots of 53 us, 3774 walks per second" in said
    assert upload_bytes(plan, bundle) == 3 * 1 + 5 * 12 + 6 * 12  # 6 pixels of one bit, slots and states of 12 bytes
    hosted = build_plan(instrument(3), bundle)
    said = drive_words(instrument(3), bundle, hosted)
    assert said.startswith("the host names each next pattern, within 500 us, of 6 states (the device follows 3)")
    assert upload_bytes(hosted, bundle) == 3 * 1 + 5 * 12
