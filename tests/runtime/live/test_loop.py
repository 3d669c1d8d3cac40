"""The whole way, in virtual time, against the simulated instrument: decisions, losses, recordings, replays, refusals, dark counts."""

import logging
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from bundles import made_bundle
from commands import json_of
from heads import onnx_chain, random_layers
from links import Wrapped
from small_files import small_calibration

from pans.base.errors import DeviceError, LinkError
from pans.bundle.backends.choose import make_decider
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import write_bundle
from pans.decide.dark.health import DarkReport
from pans.decide.dark.state_watch import StateWatch
from pans.decide.decision import Decision
from pans.decide.plan.plan import build_plan
from pans.decide.plan.plan_codec import plan_chunks, plan_from_chunks
from pans.decide.still.core import Core
from pans.instrument.calibration_file import load_calibration
from pans.instrument.profile import load_profile
from pans.live.dark_run import DarkRun
from pans.live.journal import Journal
from pans.live.loop import Job, RunResult, run_live
from pans.live.options import RunOptions
from pans.protocol.links.base import Link
from pans.protocol.wire import messages as wire
from pans.record.reading import read_recording
from pans_sim.ports.serve import open_sim
from pans_sim.testing import small_setup

PROFILE = load_profile("oled-qcmos")


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    rng = np.random.default_rng(1)
    levels = rng.integers(0, 124, (4, 64))
    levels[rng.random(levels.shape) < 0.9] = 0
    levels[0, 0] = 123
    return made_bundle(
        classes=("a", "b", "c"),
        image_shape=(8, 8),
        levels=124,
        pattern_levels=levels.astype(np.uint16),
        photons_per_level=8.0 / 123,
        table=rng.normal(size=(16, 3)).astype(np.float32),
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(2)
    path = tmp_path_factory.mktemp("scene") / "tiny.npz"
    images = rng.integers(0, 256, (6, 8, 8)).astype(np.uint8)
    np.savez(path, images=images, labels=np.arange(6, dtype=np.int16) % 3, classes=np.array(["a", "b", "c"]))
    return path


def shown(bundle: Bundle) -> dict[str, Any]:
    """What another bundle needs to show the same."""
    names = ("classes", "image_shape", "levels", "pattern_levels", "photons_per_level")
    return {name: getattr(bundle, name) for name in names}


class Disturbed(Wrapped):
    """A link that passes every chunk from the device through `disturb`."""

    def __init__(self, link: Link, disturb: Any) -> None:
        super().__init__(link)
        self._disturb = disturb

    def read(self, timeout_s: float) -> bytes:
        return bytes(self._disturb(self.link.read(timeout_s)))


def run(
    bundle: Bundle, scene: Path, n_objects: int = 6, trials: int = 3, shots: int = 1, wrap: Any = None, **options: Any
) -> RunResult:
    plan = build_plan(PROFILE, bundle, shots_per_object=trials * shots, **options)
    link: Link = open_sim(f"sim:oled-qcmos?scene={scene}&seed=5&pace=fast")
    link = link if wrap is None else wrap(link)
    config = RunOptions(shots=shots, n_cycles=n_objects * plan.cycles_per_object, deadline_us=16667.0)
    return run_live(
        link, Job(PROFILE, bundle, plan, config), Core(plan, make_decider(bundle, shots=shots), shots, config.n_cycles)
    )


@pytest.mark.parametrize("order", ["pattern-major", "shot-major"])
def test_every_object_is_decided_on_time_and_truth_is_known(bundle: Bundle, scene: Path, order: str) -> None:
    result = run(bundle, scene, order=order)
    summary = result.tally.figures()
    assert result.ended == "completed"
    assert (summary.decisions, summary.objects, summary.trials, summary.abstained) == (18, 6, 3, 0)
    assert (result.timing.late, result.stream["lost_exposures"], result.wrong_patterns) == (0, 0, 0)
    assert 0 < summary.clicks_mean <= 4
    assert summary.photons_mean > summary.clicks_mean * 0.5
    assert result.slot_jitter_us == 0.0
    assert result.dark.exposures > 0
    assert result.clock["drift_ppm"] == pytest.approx(-20, abs=1)


def test_virtual_runs_are_the_same_bit_for_bit(bundle: Bundle, scene: Path) -> None:
    first, second = run(bundle, scene), run(bundle, scene)
    assert first.tally.figures() == second.tally.figures()
    np.testing.assert_array_equal(first.tally.confusion, second.tally.confusion)


def test_a_silent_device_is_a_link_error(bundle: Bundle, scene: Path) -> None:
    with pytest.raises(LinkError, match="no WELCOME"):
        run(bundle, scene, wrap=lambda link: Disturbed(link, lambda data: b""))


class OldNews(Wrapped):
    """A link on which a STATUS of an earlier run comes after ARM: the device was SAFE, then."""

    old = b""

    def write(self, data: bytes) -> None:
        super().write(data)
        for frame in wire.FrameDecoder().feed(data):
            if frame.type == wire.MessageType.COMMAND and wire.decode_command(frame.payload).opcode == wire.Opcode.ARM:
                safe = wire.Status(wire.DeviceState.SAFE, wire.StateReason.LEASE_EXPIRED, 0, 0, 1, 99)
                self.old = wire.encode_status(safe, frame.session)

    def read(self, timeout_s: float) -> bytes:
        data, self.old = super().read(timeout_s) + self.old, b""
        return data


def test_a_status_from_before_the_run_is_no_news_of_it(bundle: Bundle, scene: Path) -> None:
    links: list[Any] = []
    result = run(bundle, scene, wrap=lambda link: links.append(OldNews(link)) or links[0])  # type: ignore[func-returns-value]
    assert (result.ended, result.tally.decisions) == ("completed", 18)
    assert links[0].old == b""


@pytest.mark.parametrize("why", ["the device fell silent", "the cable was pulled"])
def test_a_link_that_ends_still_gives_the_figures_so_far(bundle: Bundle, scene: Path, why: str) -> None:
    seen = [0]

    def end(data: bytes) -> bytes:
        seen[0] += len(data)
        if seen[0] > 6000 and "cable" in why:
            raise LinkError(why)
        return data if seen[0] < 6000 else b""

    result = run(bundle, scene, n_objects=200, wrap=lambda link: Disturbed(link, end))
    assert (result.ended, result.link_lost) == (f"the link was lost: {why}", True)
    assert 0 < result.tally.decisions < 600


def test_a_device_of_another_kind_is_refused(bundle: Bundle, scene: Path) -> None:
    plan = build_plan(PROFILE, bundle, shots_per_object=1)
    link = open_sim(f"sim:dmd-spad?scene={scene}&pace=fast")
    with pytest.raises(DeviceError, match=r"projector levels: 2, needed 124"):
        run_live(link, Job(PROFILE, bundle, plan, RunOptions(n_cycles=1)), Core(plan, make_decider(bundle), 1, 1))


def test_several_shots_per_decision(bundle: Bundle, scene: Path) -> None:
    headed = made_bundle(**shown(bundle), head_onnx=onnx_chain(random_layers([4, 3])))
    result = run(headed, scene, shots=4, trials=2)
    assert result.tally.decisions == 12
    assert result.tally.of["decisions"].clicks / 12 > 4 * 0.2
    assert result.tally.figures().photons_mean == pytest.approx(4 * run(headed, scene).tally.figures().photons_mean)


def test_the_plan_survives_the_wire(bundle: Bundle) -> None:
    plan = build_plan(PROFILE, bundle, shots_per_object=3)
    back = plan_from_chunks(plan_chunks(plan), PROFILE.clock.tick_hz)
    for name in plan.__slots__:
        np.testing.assert_array_equal(getattr(back, name), getattr(plan, name), err_msg=name)


def test_a_recording_replays_to_the_same_hash_and_another_bundle_does_not(
    bundle: Bundle, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "test.pans"
    write_bundle(bundle, path)
    device = f"sim:oled-qcmos?scene={scene}&seed=5&pace=fast"
    words = ("--device", device, "--out", tmp_path)
    summary = json_of(capsys, "run --trials 2 --decisions 12", path, *words)
    keys = "accuracy clicks_mean photons_mean decisions late lost latency_us verdict recording report"
    assert {*keys.split()} <= summary.keys()
    assert summary["simulated"] is True
    assert "SIMULATED" in Path(summary["report"]).read_text()
    assert json_of(capsys, "replay", summary["recording"])["identical"] is True
    assert len(read_recording(summary["recording"]).decisions()) == 12

    other = made_bundle(name="other", **shown(bundle), table=-np.asarray(bundle.table))
    write_bundle(other, tmp_path / "other.pans")
    again = json_of(capsys, "replay", summary["recording"], "--bundle", tmp_path / "other.pans", code=1)
    assert again["identical"] is False


@pytest.mark.parametrize(
    ("clicks", "contradicts"), [(0, False), (10, False), (40, False), (70, False), (120, True), (10_000, True)]
)
def test_dark_counts_beyond_the_calibration_are_a_fault(clicks: int, contradicts: bool, tmp_path: Path) -> None:
    small_calibration(tmp_path)  # 0 to 0.004 clicks per exposure of 100 us
    profile, bundle, plan = small_setup()
    dark = DarkRun(profile, load_calibration(tmp_path / "calibration.json"), "warn", [])
    assert dark.guard(plan, bundle, 1) is not None
    report = DarkReport(10_000, clicks, clicks / 10_000, 0.0, 1.0, 0.001, "")
    faults = dark.figures(report).faults
    assert bool(faults) == contradicts
    assert all("the calibration contradicts the dark counts" in fault for fault in faults)
    assert DarkRun(profile, None, "warn", []).figures(report).faults == []


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize(("objects", "stated"), [(200, True), (199, True), (None, True), (200, False)])
def test_what_a_bundle_states_is_contradicted_by_many_objects_only(
    objects: int | None, stated: bool, calibrated: bool, tmp_path: Path
) -> None:
    """Clicks unlike the statement are a fault without a calibration too; fewer objects may be others, and then it is a warning."""
    small_calibration(tmp_path)
    profile = small_setup()[0]
    calibration = load_calibration(tmp_path / "calibration.json") if calibrated else None
    dark, run = DarkRun(profile, calibration, "warn", []), MagicMock()
    run.session.facts = {} if objects is None else {"objects": objects}
    dark.check_device(run)
    dark.light.stated = 2.0 if stated else None
    clicks = np.random.default_rng(1).integers(2, 5, 1600 if stated else 20_000)
    dark.light.take(clicks)
    if not stated:  # a change within the run
        dark.light.take(clicks + 2)
    (found,) = dark.light.found
    figures = dark.figures()
    is_fault = calibrated or (stated and objects != 199)
    assert (figures.faults, figures.changes) == (([found["words"]], []) if is_fault else ([], [found["words"]]))


def test_walks_of_few_objects_are_a_warning() -> None:
    dark = DarkRun(small_setup()[0], None, "warn", [])
    dark.states = StateWatch(1, 100, 1e8)
    dark.states.stated, dark.states.walks_per_object = (0.9, 0.9), 100
    shown = np.arange(100, 20_100, 100)
    for n in shown:
        dark.states.take(np.array([n]), np.array([n // 10]))
    assert dark.states.found[0]["objects"] < 200
    figures = dark.figures()
    assert (figures.faults, figures.changes) == ([], [dark.states.found[0]["words"]])


@pytest.mark.parametrize(
    ("clicks", "lit", "saturates", "word"),
    [
        (0, 500, True, "none"),
        (500, 500, True, "every one"),
        (1, 500, True, ""),
        (499, 500, True, ""),
        (0, 499, True, ""),
        (499, 499, True, ""),
        (500, 500, False, ""),
        (0, 500, False, "none"),
    ],
)
def test_none_or_all_of_many_lit_exposures_are_a_warning(clicks: int, lit: int, saturates: bool, word: str) -> None:
    figures = DarkRun(small_setup()[0], None, "warn", []).figures(None, clicks, lit, saturates=saturates)
    assert figures.faults == []
    assert [f"clicked in {word} of {lit} exposures" in one for one in figures.changes] == [True] * bool(word)


@pytest.mark.parametrize(("low", "high"), [(0.9, 1.2), (0.9, None), (1.1, 1.2)])
def test_a_calibration_widens_what_a_bundle_states_of_state_0(low: float, high: float | None) -> None:
    """Whatever the objects: of so much more or less light none of their mixtures clicks more or less often."""
    profile = small_setup()[0]
    light = profile.projector.peak_photoelectrons_hz
    calibration: Any = MagicMock(
        values={"peak_photoelectrons_hz_ci": [low * light, None if high is None else high * light]}
    )
    calibration.applied_to.return_value = profile
    ends = DarkRun(profile, calibration, "warn", [])._within_calibration(0.4)
    assert DarkRun(profile, None, "warn", [])._within_calibration(0.4) == (0.4, 0.4)
    for shares in (np.array([0.4, 0.4]), np.array([0.8, 0.0]), np.array([0.1, 0.7])):
        for left in np.linspace(min(low, 1.0), 50.0 if high is None else high, 20):
            assert ends[0] - 1e-12 <= np.mean(1 - (1 - shares) ** left) <= ends[1] + 1e-12
    assert ends == pytest.approx((1 - 0.6 ** min(low, 1.0), 1.0 if high is None else 1 - 0.6**high))


@pytest.mark.parametrize("present", [[], ["a burst"]])
def test_a_state_of_the_detector_is_no_change_of_light(present: list[str]) -> None:
    dark: Any = DarkRun(small_setup()[0], None, "warn", [])
    dark.light = MagicMock()
    dark.light.take.return_value = []
    run, output = MagicMock(), MagicMock(decisions=[Decision(0, 0, 0, 0, 0, 4, 1, 1, 0, 0.9, 0)])
    run.core.guard.present = present
    dark.look(run, output)
    assert dark.light.take.called == (not present)


@pytest.mark.parametrize(("level", "word"), [("notice", "INFO"), ("warning", "WARNING"), ("alarm", "WARNING")])
def test_dark_counts_that_change_are_a_warning(level: str, word: str, caplog: pytest.LogCaptureFixture) -> None:
    journal = Journal(None)
    with caplog.at_level(logging.INFO):
        journal.note("dark_state", level=level)
    assert [record.levelname for record in caplog.records] == [word]
    assert (journal.trouble is not None) == (word == "WARNING")
