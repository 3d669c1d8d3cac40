"""Recordings in parts: whole runs in virtual time, each part replayed and verified by itself, the chain, the cap, the disk."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import json_of

from pans.firmware_sim.ports.serve import open_sim
from pans.firmware_sim.testing import small_setup
from pans.runtime.bundle.model import bundle_bytes
from pans.runtime.cli import main
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import DamagedFileError, RecordingError, UsageError
from pans.runtime.live import LiveRun, Observers, Recovery, RunOptions, RunResult, run_live
from pans.runtime.record import PartLimits, Recorder, read_recording
from pans.runtime.record.parts import chain_violations, first_decision, part_of, part_path, parts_in
from pans.runtime.record.replaying import replay
from pans.runtime.report.verify import verify_parts

KIB = 1024


def record(
    folder: Path, limits: PartLimits, *, faults: str = "", cycles: int = 3000, prepared: Any = None
) -> RunResult:
    """Run in virtual time into parts below `folder`; wait for each part's making, so that virtual time cannot outrun the disk."""
    profile, bundle, plan = small_setup("sequential")
    url = f"sim:ideal?scene=uniform&pace=fast&seed=4&faults={faults}"
    link = open_sim(url)
    header = {"config": {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table"}, "simulated": True}
    header["profile"] = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}
    core = Core(plan, make_decider(bundle, backend="table"), 1, cycles)
    config = RunOptions(n_cycles=cycles, deadline_us=1e9, realtime=False)
    folder.mkdir(exist_ok=True)
    with Recorder(folder / "run.pansrec", header, bundle=bundle_bytes(bundle), limits=limits) as recorder:

        def wait(run: LiveRun, output: Any) -> None:
            if recorder.open_file.size_bytes >= limits.rotate_bytes:
                recorder._next.result(timeout=20)

        observers, recovery = Observers(wait, prepared), Recovery.of(link, url, 10.0)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("pans.runtime.live.run.FLUSH_EVERY_NS", 20_000_000)  # small parts need small blocks
            result = run_live(link, profile, bundle, plan, core, config, recorder, recovery, observers)
        result.decisions_sha256 = recorder.close({"decisions": result.tally.decisions})
    return result


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parts")
    record(folder, PartLimits(48 * KIB))
    return folder


def test_every_part_replays_and_verifies_by_itself(parts: Path) -> None:
    paths = parts_in(parts)
    assert len(paths) > 2
    numbers = []
    for path in paths:
        recording = read_recording(path)
        assert recording.complete
        count, sha256 = replay(recording, recording.bundle())[:2]
        assert (count, sha256) == (recording.n_decisions, recording.decisions_sha256)
        assert count > (0 if path == paths[-1] else 50)
        assert recording.decisions()["index"][0] == first_decision(recording)
        numbers += recording.decisions()["index"].tolist()
        assert len(recording.clock_samples())
    assert numbers == list(range(len(numbers)))
    assert all(verdict.ok for verdict in verify_parts(parts)), verify_parts(parts)
    assert not list(parts.glob(".*"))


def test_parts_hold_what_one_recording_would(parts: Path, tmp_path: Path) -> None:
    record(tmp_path, PartLimits(1 << 30))
    (whole,) = parts_in(tmp_path)
    pieces = np.concatenate([read_recording(path).decisions() for path in parts_in(parts)])
    np.testing.assert_array_equal(read_recording(whole).decisions(), pieces)


def test_the_commands_take_a_folder(parts: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert json_of(capsys, "verify", parts)["ok"]
    payload = json_of(capsys, "replay", parts)
    assert payload["identical"]
    assert len(payload["parts"]) == len(parts_in(parts))
    assert main(["verify", str(parts.parent), "--json"]) in (0, 2)


@pytest.mark.parametrize("faults", ["loss:0.01,duplicate:0.01,flip:0.01", "stall:300ms/700ms,disconnect:100ms/900ms"])
def test_parts_replay_under_faults(tmp_path: Path, faults: str) -> None:
    result = record(tmp_path, PartLimits(48 * KIB), faults=faults)
    paths = parts_in(tmp_path)
    assert len(paths) > 2
    for path in paths:
        recording = read_recording(path)
        assert replay(recording, recording.bundle())[:2] == (recording.n_decisions, recording.decisions_sha256), path
    assert all(verdict.ok for verdict in verify_parts(tmp_path)), verify_parts(tmp_path)
    assert sum(read_recording(path).n_decisions for path in paths) == result.tally.decisions


def test_the_cap_deletes_the_oldest_and_never_the_open_one(tmp_path: Path) -> None:
    result = record(tmp_path, PartLimits(48 * KIB, 192 * KIB))
    paths = parts_in(tmp_path)
    first, last = part_of(read_recording(paths[0])), part_of(read_recording(paths[-1]))
    assert first is not None
    assert last is not None
    assert first["number"] > 1
    assert sum(path.stat().st_size for path in paths) <= 192 * KIB + 48 * KIB
    assert last["deleted"]["parts"] + len(paths) == last["number"]
    kept = sum(read_recording(path).n_decisions for path in paths)
    assert last["deleted"]["decisions"] == first["first_decision"] == result.tally.decisions - kept
    assert all(verdict.ok for verdict in verify_parts(tmp_path)), verify_parts(tmp_path)
    assert "part_deleted" in {event["kind"] for event in result.events}
    paths[0].unlink()
    assert f"{paths[0].name} is missing" in " ".join(verify_parts(tmp_path)[-1].violations)


def test_a_hole_and_a_strange_part_are_found(parts: Path, tmp_path: Path) -> None:
    paths = parts_in(parts)
    recordings = [read_recording(path) for path in paths]
    assert chain_violations(recordings) == []
    assert "one is missing between" in chain_violations([recordings[0], recordings[2]])[0]
    record(tmp_path, PartLimits(48 * KIB), cycles=1500)
    others = [read_recording(path) for path in parts_in(tmp_path)]
    text = " ".join(chain_violations([recordings[0], others[1]]))
    assert "parts of 2 runs" in text


def test_a_part_that_is_missing_is_found_wherever_it_was(parts: Path, tmp_path: Path) -> None:
    names = [path.name for path in parts_in(parts)]
    for name in names[:-1]:
        folder = tmp_path / name
        shutil.copytree(parts, folder)
        (folder / name).unlink()
        *others, found = verify_parts(folder)
        assert all(other.ok for other in others)
        assert "missing" in " ".join(found.violations), name
    (tmp_path / names[0] / names[-1]).unlink()
    assert f"{names[-1]} is missing" in " ".join(verify_parts(tmp_path / names[0])[-1].violations)


def test_a_surplus_part_is_found_wherever_it_is(parts: Path, tmp_path: Path) -> None:
    paths = parts_in(parts)
    record(tmp_path / "other", PartLimits(48 * KIB), cycles=1500)
    stranger = parts_in(tmp_path / "other")[0]
    for number in (2, len(paths) + 1, 99):
        folder = tmp_path / str(number)
        shutil.copytree(parts, folder)
        shutil.copy(stranger, folder / f"run-{number:04d}.pansrec")
        text = " ".join(verify_parts(folder)[-1].violations)
        assert "parts of 2 runs" in text, number
        assert "renamed" in text
        if number > len(paths):
            assert "is surplus: the run ended with" in text


def test_the_name_of_the_recording_stands_for_its_parts(
    parts: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = parts / "run.pansrec"
    assert json_of(capsys, "verify", name)["ok"]
    assert json_of(capsys, "replay", name)["identical"]
    assert main(["verify", str(tmp_path / "run.pansrec")]) == main(["verify", str(tmp_path)]) == 2


def test_a_part_without_its_place_is_refused(parts: Path) -> None:
    recording = read_recording(parts_in(parts)[1])

    class Silent:
        header, path, complete = recording.header, recording.path, True

        def events(self) -> Any:
            return iter(())

    with pytest.raises(DamagedFileError, match="does not say where it begins"):
        part_of(Silent())  # type: ignore[arg-type]


def test_parts_of_another_run_are_not_overwritten(parts: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="exists already"):
        Recorder(parts / "run.pansrec", {}, limits=PartLimits(KIB))
    path = tmp_path / "run.pansrec"
    for _ in range(2):
        with Recorder(path, {}, limits=PartLimits(KIB), overwrite=True) as recorder:
            recorder.close({})
    assert parts_in(tmp_path) == [part_path(path, 1)]


def test_limits_that_cannot_be_meant() -> None:
    for rotate, keep in ((0, 0), (100, 150)):
        with pytest.raises(UsageError):
            PartLimits(rotate, keep)


def test_a_full_disk_ends_the_run_with_the_light_off(tmp_path: Path) -> None:
    link_states = []

    def prepared(run: LiveRun) -> None:
        file = run.recorder.open_file._file  # type: ignore[union-attr]

        class Full:
            closed = False

            def write(self, data: bytes) -> int:
                raise OSError(errno.ENOSPC, "No space left on device")

            def truncate(self, size: int) -> None:
                file.truncate(size)

            def close(self) -> None:
                self.closed = True
                file.close()

        run.recorder.open_file._file = Full()  # type: ignore[union-attr]
        link_states.append(run)

    with pytest.raises(RecordingError, match="No space left on device"):
        record(tmp_path, PartLimits(1 << 30), prepared=prepared)
    status = link_states[0].connection.session.status
    assert status is not None
    assert status.state == 0  # IDLE: it was told to stop
    recording = read_recording(parts_in(tmp_path)[0])
    assert not recording.complete
