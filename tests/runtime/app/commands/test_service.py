"""`pans service`: units that systemd accepts, the protocol run on a real socket, and nobody else's unit touched."""

import json
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import Pans, fixed_run

from pans.app.commands.service import (
    ServiceRun,
    _start_findings,
    check_name,
    command_line,
    command_of,
    run_as_systemd,
    unit_text,
)
from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import UsageError
from pans.bundle.sensor.bundle import write_bundle
from pans_sim.testing import small_setup

NASTY = ["/a b/pans", "50%.pans", "$HOME", 'say "hi"', "a\\b", "tab\tend", "Größe", "%n%%", "$$", "line\nend", ""]


def test_every_word_comes_back_from_a_unit() -> None:
    folder = Path('/data/50% of "it" \\ there')
    assert command_of(unit_text("lab", NASTY, folder, [], 20.0, "lab")) == (NASTY, folder)
    assert "\n" not in command_line(NASTY)


@pytest.mark.parametrize("name", ["", "a b", "../x", "a/b", ".hidden", "x" * 101, "größe"])
def test_names_that_no_unit_can_have(name: str) -> None:
    with pytest.raises(UsageError, match="--name"):
        check_name(name)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a bundle and options of a run without an end; its name is not easy to quote."""
    folder = tmp_path / "my lab, 50%"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr("pans.app.commands.service.PRIVATE", ())  # where a test works is no matter
    write_bundle(small_setup("sequential")[1], Path("grid.pans"))
    words = ["run", "grid.pans", "--device", "sim:ideal?scene=uniform&seed=3", "--no-realtime"]
    assert main([*words, "--state", "state.json", "--write-config", "lab.toml"]) == 0
    return folder


def service(pans: Pans, *words: Any, code: int | None = 0) -> dict[str, Any]:
    return pans("service", *words, "--unit-dir", "units", code=code)


def test_a_unit_is_installed_verified_and_removed(lab: Path, pans: Pans) -> None:
    found = service(pans, "install", "--config", "lab.toml", "--run-as", "root")
    unit = Path("units/pans-lab.service")
    text = unit.read_text()
    wanted = {"Type=notify", "WatchdogSec=20", "Restart=on-failure", "RestartPreventExitStatus=2", "User=root"}
    assert wanted | {"LimitRTPRIO=10", "LimitMEMLOCK=infinity"} <= set(text.splitlines())
    command = [sys.executable, "-m", "pans", "run", "--config", str(lab / "lab.toml")]
    assert (found["unit"], found["command"], found["folder"]) == (str(unit), command, str(lab))
    if shutil.which("systemd-analyze"):
        assert [one["found"] for one in found["findings"]] == ["no complaints"]
        unit.write_text(text.replace("Restart=on-failure", "Restart=sometimes").replace("UMask=0027", "Umask=9"))
        findings = service(pans, "verify", "--name", "lab", code=1)["findings"]
        assert "sometimes" in findings[0]["found"]
        service(pans, "install", "--config", "lab.toml")  # a unit of ours is written again
    assert service(pans, "verify", "--name", "lab")["findings"][-1]["ok"]
    assert service(pans, "remove", "--name", "lab")["removed"] == str(unit)
    assert not unit.exists()


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="needs systemd-analyze")
@pytest.mark.parametrize("whose", [("--run-as", "root"), ("--user",)])
def test_systemd_has_no_word_to_say_on_a_unit(
    whose: tuple[str, ...], lab: Path, pans: Pans, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    unit = service(pans, "install", "--config", "lab.toml", *whose)["unit"]
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    words = ["systemd-analyze", *({"--user"} & {*whose}), "--man=no", "verify", unit]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_folders_that_the_run_writes_to_are_writable(lab: Path, pans: Pans) -> None:
    text = Path("lab.toml").read_text()
    Path("lab.toml").write_text(text + 'log-file = "/var/tmp/pans-test-logs/l"\nout = "out"\n')
    shown = service(pans, "show", "--config", "lab.toml", "--name", "other")["text"]
    paths = re.findall(r'^ReadWritePaths="(.*)"$', shown, re.MULTILINE)
    inside = str(lab).replace("%", "%%")
    assert set(paths) == {inside, f"{inside}/out", "/var/tmp/pans-test-logs"}
    assert not Path("units").exists()
    assert main(["service", "show", "--config", "lab.toml"]) == 0
    assert "keep-runs-mb" in pans.said().err  # each restart would leave another folder


def test_a_service_is_not_installed_where_it_cannot_see_its_files(
    lab: Path, pans: Pans, monkeypatch: pytest.MonkeyPatch
) -> None:
    for hidden in (lab, Path(sys.executable).parent):
        monkeypatch.setattr("pans.app.commands.service.PRIVATE", (Path("/no"), hidden))
        error = service(pans, "install", "--config", "lab.toml", code=2)["error"]
        assert error["message"].startswith(str(hidden))
        assert "PrivateTmp" in error["message"]
    shown = service(pans, "install", "--config", "lab.toml", "--user")["unit"]
    assert service(pans, "show", "--name", "lab")["text"] == Path(shown).read_text()
    assert "PrivateTmp" not in Path(shown).read_text()


def test_a_trial_start_with_a_verdict_of_fail_is_no_wrong_installation() -> None:
    lines = [(1.0, "READY=1"), *((at_s, "WATCHDOG=1") for at_s in (1.5, 2.0, 2.5)), (3.0, "STOPPING=1")]
    end = {}
    for code in (0, 1, 2, 3, 4, None):
        run = ServiceRun(lines, asked_s=3.0, ended_s=3.1, exit_code=code, errors="26 decisions, late 0\nlast line\n")
        *before, end[code] = _start_findings(run, 20.0)
        assert all(one["ok"] for one in before)
    assert [code for code, found in end.items() if found["ok"]] == [0, 1, 4]
    assert end[4]["found"] == "exit code 4: the service starts, runs and stops; the verdict of this run is FAIL"
    assert end[0]["found"] == "exit code 0"
    assert end[3]["found"] == "exit code 3: last line"


def test_foreign_units_stay(lab: Path, pans: Pans) -> None:
    unit = Path("units/pans-lab.service")
    unit.parent.mkdir()
    unit.write_text("[Service]\nExecStart=/bin/true\n")
    for words in ("install --config lab.toml", "verify --name lab", "remove --name lab"):
        service(pans, *words.split(), code=2)
    assert unit.read_text() == "[Service]\nExecStart=/bin/true\n"


@pytest.mark.skipif(not hasattr(socket, "AF_UNIX") or sys.platform == "win32", reason="needs AF_UNIX")
def test_a_run_tells_systemd_that_it_is_ready_that_it_lives_and_that_it_stops(
    lab: Path, pans: Pans, capsys: pytest.CaptureFixture[str]
) -> None:
    service(pans, "install", "--config", "lab.toml")
    found = service(pans, "verify", "--name", "lab", "--start", "4", code=None)
    said = {one["check"]: one for one in found["findings"]}
    assert all(said[name]["ok"] for name in ("READY", "WATCHDOG", "STOPPING")), said
    assert said["end"]["ok"], said  # late or not
    state = json.loads(Path("state.json").read_text())
    assert state["ended"] == "stopped by SIGTERM"
    assert main([*fixed_run(4)]) in (0, 1)  # another one in the folder of the service's runs
    last = service(pans, "verify", "--name", "lab", code=None)["last_run"]
    assert state["last_folder"] == Path(last["folder"]).name
    assert (last["verdict"], last["faults"]) == (state["verdict"], state["faults"])
    assert last["decisions"] == state["decisions"] == found["last_run"]["decisions"]
    capsys.readouterr()
    main(["service", "verify", "--name", "lab", "--unit-dir", "units"])
    out = capsys.readouterr().out
    assert f"{last['verdict']} ({last['folder']})" in out
    assert all(f"fault: {fault}" in out for fault in last["faults"])


@pytest.mark.skipif(not hasattr(socket, "AF_UNIX") or sys.platform == "win32", reason="needs AF_UNIX")
def test_a_service_that_says_nothing_or_hangs_is_found(tmp_path: Path) -> None:
    silent = [sys.executable, "-c", "import sys; sys.exit('no device')"]
    run = run_as_systemd(silent, tmp_path, watchdog_s=1, seconds=1, start_s=30, stop_s=1)
    assert (run.lines, run.exit_code, run.errors) == ([], 1, "no device\n")
    speak = "import os, signal, socket, time; s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM); s.connect(os.environ['NOTIFY_SOCKET'])"
    hangs = f"{speak}; signal.signal(signal.SIGTERM, signal.SIG_IGN); s.send(b'READY=1'); s.send(b'WATCHDOG=1'); time.sleep(60)"
    run = run_as_systemd([sys.executable, "-c", hangs], tmp_path, watchdog_s=1, seconds=1, start_s=30, stop_s=0.3)
    assert [line for _, line in run.lines] == ["READY=1", "WATCHDOG=1"]
    assert run.exit_code is None
    assert run.longest_silence_s() > 0.9


def test_silence_is_counted_from_ready_to_the_end() -> None:
    lines = [(2.0, "READY=1"), *((at_s, "WATCHDOG=1") for at_s in (1.0, 3.0, 4.5, 9.0))]
    assert ServiceRun(lines, asked_s=5.0, ended_s=9.5).longest_silence_s() == 1.5
    assert ServiceRun(lines, ended_s=9.5).longest_silence_s() == 4.5


def test_monitoring_files_are_written_once(tmp_path: Path, pans: Pans) -> None:
    out = tmp_path / "m"
    found = pans("service monitoring", "--out", out)
    names = ["prometheus.yml", "prometheus-alerts.yml", "grafana-dashboard.json"]
    assert [Path(path).name for path in found["files"]] == names
    assert all(Path(path).read_bytes() == (SHIPPED / Path(path).name).read_bytes() for path in found["files"])
    assert main(["service", "monitoring", "--out", str(out)]) == 2


@pytest.mark.parametrize(
    "user", ["lab\nExecStartPre=/bin/sh", "lab\n", "a b", "%u", "lab\\", "-x", "\x1b[2J", "a:b", "../x"]
)
def test_a_user_s_name_adds_nothing_to_the_unit(user, tmp_path):
    with pytest.raises(UsageError, match=r"--run-as .* is no name of a user: allowed"):
        unit_text("lab", ["/bin/pans"], tmp_path, [], 20.0, user)


@pytest.mark.parametrize("name", ["it's", 'say "hi"', "50%", "a\\b", "Größe", "a b", "$HOME", "#x", ";"])
def test_folders_stand_in_the_unit_as_systemd_reads_them(name):
    """WorkingDirectory is neither unquoted nor unescaped, ReadWritePaths is unquoted alone; specifiers are expanded in both."""
    folder = Path("/srv") / name
    text = unit_text("lab", ["/bin/pans"], folder, [], 20.0, "lab")
    lines = dict(
        line.split("=", 1) for line in text.splitlines() if line.startswith(("WorkingDirectory", "ReadWritePaths"))
    )
    assert lines["WorkingDirectory"].replace("%%", "%") == str(folder)
    quoted = lines["ReadWritePaths"]
    assert quoted[0] == quoted[-1]
    assert quoted[0] not in quoted[1:-1]
    assert quoted[1:-1].replace("%%", "%") == str(folder)
    assert command_of(text)[1] == folder


@pytest.mark.parametrize("name", ["a\nUser=root", "bell\x07", "end\\", "end ", "\x85", "\udce4", "both '\""])
def test_a_folder_that_a_unit_cannot_name_is_refused(name):
    with pytest.raises(UsageError, match="a unit cannot name it"):
        unit_text("lab", ["/bin/pans"], Path("/srv") / name, [], 20.0, "lab")


def test_control_bytes_are_never_raw_in_the_unit():
    words = ["/bin/pans", "".join(map(chr, range(1, 128)))]
    line = command_line(words)
    assert line.isprintable()
    assert command_of(f"ExecStart={line}\nWorkingDirectory=/srv")[0] == words
    with pytest.raises(UsageError, match="no UTF-8"):
        command_line(["/bin/pans", "\udce4.toml"])
