"""Bad inputs of every command, drawn from its parser or named here: no traceback, no file lost or new, the right exit code, a remedy."""

import contextlib
import io
import itertools
import os
import signal
import socket
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pans.app.command import parser_of
from pans.app.find_commands import find_commands, load_command
from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import UsageError
from pans.instrument.calibration_file import sealed
from pans.instrument.profile import profile_text

LIMIT_S = 60  # only against waiting for ever: a busy machine may take its time
SLOW = (
    "torch",
    "optuna",
    "pans_trainer.train.gradient.loop",
)  # loaded before the limit counts, where they are installed
FAST = "sim:oled-qcmos?pace=fast"
GOOD = {  # a command line of each command that would work, with its required arguments
    "demo": "--pace fast --seconds 0.01 --out new", "run": f"b.pans --device {FAST} --decisions 1 --out new",
    "replay": "r.pansrec", "verify": "b.pans", "info": "b.pans", "profile": "check oled-qcmos", "report": "b.pans -o new.html",
    "export": "r.pansrec --format csv -o new", "bundle": "--patterns p.npy --table t.npy --classes a,b -o new.pans",
    "simulate": "--profile oled-qcmos --scene uniform --listen tcp:127.0.0.1:0", "bench": "decide --quick",
    "devices": "--no-usb", "doctor": "--udev", "calibrate": f"--device {FAST}&scene=uniform --seconds 0.5 -o new.json",
    "train": "s.npz --features 2 --epochs 1 -o new.pans", "evaluate": "b.pans --task s.npz --objects 2",
    "data": "scene cells -o new.npz --objects 2", "baseline": "direct --task s.npz --photons 5",
    "reproduce": "alpha --collect --cache cache -o new", "sweep": "s.npz --features 2 --storage new.log --trials 1",
    "completion": "bash", "runs": ".", "service": "monitoring -o new", "batch": "info b.pans -o new.jsonl",
}  # fmt: skip
NUMBERS = ("nan", "inf", "-inf", "1e999", "9" * 40, "", "three", "0x10", "1,5", "-1")
MAY_BE_NEGATIVE = {"--offset", "--drift-ppm", "--seed", "--rows", "--seeds"}
NO_FILES = ("folder.{}", "fifo.{}", "broken.{}", "loop.{}", "x" * 300, "nul\0.{}", "", "b.pans/x.{}")
INPUTS = ("missing.{}", "empty.{}", "noise.{}", "latin.{}", "/dev/zero", *NO_FILES)
OUTPUTS = ("there.{}", "no/such/new.{}", "/proc/new.{}", "b.pans", *NO_FILES)
KINDS = {"pans": "b.pans", "pansrec": "r.pansrec", "npz": "s.npz", "toml": "f.toml", "json": "c.json", "npy": "p.npy"}
READS = {  # the kind of file that an argument names; numbers and choices are known by their type
    "bundle": "pans", "--bundle": "pans", "recording": "pansrec", "path": "pans", "paths": "pans", "--profile": "toml",
    "--act-profile": "toml", "--flow": "toml", "--calibration": "json", "--truth": "npz", "--inputs": "npz", "--task": "npz",
    "task": "npz", "--scene": "npz", "--optics": "pans", "--patterns": "npy", "--table": "npy", "--head": "onnx", "--faults": "toml",
}  # fmt: skip
WRITES = {"--out": "txt", "--record": "pansrec", "--trace": "txt", "--state": "json", "--pictures": "npz"}
WRITES |= {"--storage": "log"}
SUFFIXES = {"report": "html", "bundle": "pans", "calibrate": "json", "train": "pans", "data": "npz"}
FOLDERS = {("demo", "--out"), ("run", "--out"), ("export", "--out"), ("reproduce", "--out"), ("service", "--out")}
FOLDERS |= {("evaluate", "--pictures")}
Refused = Callable[..., None]
RUN = f"run b.pans --decisions 1 --out new --device {FAST}"
DEVICE = "run b.pans --out new --profile oled-qcmos --decisions 1 --device"
UNREACHABLE = {  # exit code 3: what no parser knows of
    f"{DEVICE} serial:": "/dev/nope|folder.pans|b.pans|/dev/null|socket://127.0.0.1:1|ffff:ffff|socket://nowhere.invalid:1|"
    "socket://127.0.0.1:99999",
    f"{DEVICE} usb:": "ffff:ffff",
    "simulate --profile oled-qcmos --scene uniform --listen ": "tcp:BUSY|tcp:nowhere.invalid:0",
}
REFUSED = {  # exit code 2: addresses, options without effect, files that do not belong together
    f"{DEVICE} ": "nonsense|nonsense:x|sim:|sim:nonsense|usb:",
    f"{DEVICE} {FAST}&": "seed=x|seed=-1|pace=slow|colour=red|scene=none|scene=folder.npz|scene=noise.npz|scene=fifo.npz|"
    "faults=nonsense|faults=loss:2|offset=-1|changes=x|optics=b.pans|drift_ppm=1e9|buffer=0|scene=small.npz|scene=letters.npz|"
    "scene=fashion200&scene",
    f"{RUN} --": "gate-class Bag|gate-delay-us 5|act tcp:127.0.0.1:1|act-profile ideal|pool 2|metrics-public|"
    "calibration-max-age-h 3|rotate-mb 0|keep-mb 1|drive host|confidence 0.9|flow nonsense|profile dmd-spad|"
    "state no/such/x.json|metrics nowhere|metrics 127.0.0.1:99999|metrics 0.0.0.0:9464|metrics BUSY|serve 0.0.0.0:8000|"
    "serve example.org:80|serve BUSY|record new.pansrec --trace new.pansrec|record b.pans --force|trace b.pans --force|"
    "flow cells --decisions 3|rotate-mb 1 --on-dark mask|backend automaton|core 9999",
    "simulate --profile oled-qcmos --scene uniform --listen ": "nonsense|tcp:|tcp:127.0.0.1|tcp:127.0.0.1:99999|tcp:127.0.0.1:x",
    "bundle --patterns p.npy --table t.npy -o new.pans --classes ": "a|a,a|a,b,c|a,b --image-shape 3x3|a,b --levels 1|"
    "a,b --levels 70000|a,b --image-shape x",
    "evaluate b.pans ": "--task small.npz|--task letters.npz|--task nonsense|--exact --trials 3",
    "profile ": "new|new a.txt|new b.toml --from nonsense|new oled-qcmos.toml|new there.toml|new no/such/x.toml|new ..toml|list x|"
    "show|check|check f.toml|check latin.toml|check --from x",
    "data ": "scene|fetch nonsense|scene cells -o new.txt|scene nonsense -o new.npz|scene a b -o new.npz",
    "verify ": "|no-such-name|b.pans missing.pans",
    "run --decisions 1 --out new --config ": "missing.toml|empty.toml|noise.toml|latin.toml|folder.toml|fifo.toml|loop.toml|f.toml|nul\0",
    f"run b.pans --device {FAST} --write-config ": "there.toml|no/such/new.toml|folder.toml|fifo.toml|b.pans|nul\0|b.pans --force|"
    "new.toml --keep-mb 3|new.toml --unset shots",
    "info b.pans --log-": f"file there.txt|file no/such/new.log|file folder.txt|file fifo.txt|file broken.txt|file b.pans|file nul\0|"
    f"file {'x' * 300}|file new.log --log-format xml|file new.log --log-rotate-mb 0|format json|rotate-mb 3",
    "runs ": "missing|b.pans|fifo.txt|nul\0|a b|prune .|. --yes|. --keep 3|prune . --keep x|prune . --older-than 30|"
    "prune . --older-than -3d|prune . --larger-than 5gb",
    "service ": "show|verify|remove|monitoring|nonsense|install --config latin.toml|show --config f.toml|"
    "verify --name no-such-service|remove --name ../x|monitoring -o b.pans|show --config missing.toml|monitoring -o new --start 3|"
    "show --config f.toml --watchdog-s 3",
    "batch info ": "none* -o new.jsonl|missing.pans -o new.jsonl|b.pans|b.pans -o new.csv|b.pans -o no/such/new.jsonl|b.pans -o b.pans|"
    "b.pans -o fifo.txt",
    "batch info b.pans -o new.jsonl --": "vary x|vary =3|workers 0|with '|with=--colour",
    "": "nonsense|--nonsense|rnu|help nonsense|batch fuzz b.pans -o new.jsonl",
    **{f"{name} ": "--nonsense=1" for name in find_commands()},
}
MISTAKES = {  # files of another kind, and devices without a scheme: what is said, and the remedy
    "run r.pansrec --device sim:oled-qcmos": "not a PANS bundle: it is a recording|`pans replay`",
    "run lab.toml --device sim:oled-qcmos": "not a PANS bundle: it is a hardware profile|--profile",
    "run s.npz --device sim:oled-qcmos": "not a PANS bundle: it is a .npz archive|?scene=FILE",
    "run sealed.json --device sim:oled-qcmos": "not a PANS bundle: it is a calibration|--calibration",
    "run folder.txt --device sim:oled-qcmos": "it is a folder|name a file",
    "replay b.pans": "not a recording: it is a bundle|`pans run",
    "replay lab.toml": "not a recording: it is a hardware profile|--profile",
    "info there.txt": "is no file of this project|bundles (.pans)",
    f"{RUN} --calibration lab.toml": "lab.toml: not a calibration: it is a hardware profile|--profile",
    f"{RUN} --calibration options.toml": "options.toml: not a calibration: it is TOML text|--config",
    f"{RUN} --registration sealed.json": "not a registration: it is a calibration|--calibration",
    f"{RUN} --profile sealed.json": "not a hardware profile: it is a calibration|--calibration",
    f"{RUN} --flow lab.toml": "not the settings of a flow: it is a hardware profile|--profile",
    f"{RUN} --config lab.toml": "not a file of options: it is a hardware profile|--write-config",
    "service show --config b.pans": "not a file of options: it is a bundle|--write-config",
    "demo --profile b.pans": "not a hardware profile: it is a bundle|`pans run",
    "bundle --patterns there.txt --head there.txt --classes a,b -o new.pans": "not a readable .npy array|numpy.save",
    "verify folder.txt": "no parts of a recording are here|run-0001",
    "run b.pans --out new --decisions 1 --device COM3": "'COM3' is no device URL|did you mean serial:COM3?",
    "run b.pans --out new --decisions 1 --device /dev/ttyUSB0": "is no device URL|did you mean serial:/dev/ttyUSB0?",
    "run b.pans --out new --decisions 1 --device 192.168.1.3:4000": "is no device URL|did you mean serial:socket://192.168.1.3:4000?",
    "run b.pans --out new --decisions 1 --device tcp:localhost:4000 --profile oled-qcmos": "is no device URL|serial:socket://localhost:4000?",
    "run b.pans --out new --decisions 1 --device r.pansrec": "is no device URL|`pans replay r.pansrec`",
    "run b.pans --out new --decisions 1 --device lab.toml": "is no device URL|did you mean sim:lab.toml?",
    "run b.pans --out new --decisions 1 --device some:thing": "unknown device scheme 'some'|known: |serial, sim",
    "demo --seconds 5ms": "'5ms' is not a number|pans help demo",
}
LINES = [
    (f"{words}{more}".split(" ") if words or more else [], code)
    for table, code in ((UNREACHABLE, 3), (REFUSED, 2))
    for words, ways in table.items()
    for more in ways.split("|")
    if find_spec("torch") or not words.startswith(("evaluate", "data"))
]


@cache
def faults_of(name: str) -> list[list[list[str]]]:
    """The command lines of `name` in which one argument is wrong, a list for each argument; none where an extra is missing."""
    try:
        parser = parser_of(name, load_command(find_commands()[name]))
    except UsageError:
        return []
    found, places = [], [one for one in parser._actions if not one.option_strings]
    for action in (one for one in parser._actions if one.nargs != 0):
        flag, words = max(action.option_strings, key=len, default=""), GOOD[name].split()
        key, values = flag or action.dest, list[str]()
        if action.choices:
            values = ["nonsense"]
        elif action.type in (int, float) or getattr(action.type, "__name__", "") == "option":
            right = {"9" * 40} if action.type is float else set()
            values = [value for value in NUMBERS[: -1 if flag in MAY_BE_NEGATIVE else None] if value not in right]
        elif key in READS and (name, flag) != ("bundle", "--task"):
            kind, other = READS[key], "s.npz" if READS[key] == "pans" else "b.pans"
            values = [value.format(kind) for value in INPUTS if value or flag not in ("--task", "--profile")]
            values += [other, f"half.{kind}"] if kind in KINDS else [other]
        elif key in WRITES:
            made = {"folder.{}", "", "no/such/new.{}"} if (name, key) in FOLDERS else set[str]()
            made |= {"no/such/new.{}"} if key in ("--trace", "--record") else set()
            values = [value.format(SUFFIXES.get(name, WRITES[key])) for value in OUTPUTS if value not in made]
        if flag:
            at = next((words.index(one) for one in action.option_strings if one in words), len(words))
            lines = [[*words[:at], *words[at + 2 :], f"{flag}={value}"] for value in values]
        else:
            at = places.index(action)
            lines = [[*words[:at], value, *words[at + 1 :]] for value in values]
        found += [[[name, *line] for line in lines]] if lines else []
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The good files and the bad ones of every kind."""
    for slow in SLOW:
        with contextlib.suppress(ModuleNotFoundError):
            import_module(slow)
    folder, bundle = tmp_path_factory.mktemp("bad"), SHIPPED / "fashion10.pans"
    assert main(["run", str(bundle), "--device", FAST, "--decisions", "3", "--record", str(folder / "r.pansrec")]) == 0
    (folder / "b.pans").write_bytes(bundle.read_bytes())
    np.save(folder / "p.npy", np.ones((2, 784)))
    np.save(folder / "t.npy", np.zeros((4, 2)))
    images, labels = np.random.default_rng(0).integers(0, 255, (200, 28, 28)).astype(np.uint8), np.arange(200) % 10
    named = ["T-shirt/top", "Trouser", "Pullover", "Dress", "Coat", "Sandal", "Shirt", "Sneaker", "Bag", "Ankle boot"]
    np.savez(folder / "s.npz", images=images, labels=labels, classes=np.array(named))
    np.savez(folder / "small.npz", images=images[:, :14, :14], labels=labels, classes=np.array(named))
    np.savez(folder / "letters.npz", images=images, labels=labels, classes=np.array([*"abcdefghij"]))
    (folder / "f.toml").write_text("kind = 1\n")
    (folder / "c.json").write_text("{}\n")
    (folder / "lab.toml").write_text(profile_text("oled-qcmos"))
    (folder / "options.toml").write_text("decisions = 3\n")
    (folder / "sealed.json").write_bytes(sealed({"what": 1}, "calibration"))
    for suffix in (*KINDS, "onnx", "txt", "html", "log"):
        (folder / f"empty.{suffix}").touch()
        (folder / f"noise.{suffix}").write_bytes(np.random.default_rng(1).bytes(3000))
        (folder / f"latin.{suffix}").write_bytes("name = 'Käse'\n".encode("latin-1"))
        (folder / f"there.{suffix}").write_bytes(b"precious")
        (folder / f"folder.{suffix}").mkdir()
        os.mkfifo(folder / f"fifo.{suffix}")
        (folder / f"broken.{suffix}").symlink_to("nowhere")
        (folder / f"loop.{suffix}").symlink_to(f"loop.{suffix}")
    for suffix, name in KINDS.items():
        whole = (folder / name).read_bytes()
        (folder / f"half.{suffix}").write_bytes(whole[: len(whole) // 2])
    return folder


def contents(folder: Path) -> dict[str, tuple[int, ...]]:
    """What tells whether anything has changed."""
    facts = [(path, path.lstat()) for path in folder.rglob("*")]
    return {str(path): (one.st_ino, one.st_size, one.st_mtime_ns * path.is_file()) for path, one in facts}


@pytest.fixture(scope="module")
def refused(folder: Path) -> Iterator[Refused]:
    """A call that runs a command line in `folder` and checks its refusal; what waits for ever, as on a FIFO, is ended."""

    def late(*signal: object) -> None:
        raise AssertionError(f"no answer within {LIMIT_S} s")

    def check(words: list[str], wanted: int, *parts: str) -> None:
        kept, out, err = contents(folder), io.StringIO(), io.StringIO()
        signal.alarm(LIMIT_S)
        with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                code = main([word.replace("BUSY", f"127.0.0.1:{taken.getsockname()[1]}") for word in words])
            except SystemExit as end:
                code = int(end.code or 0)
        signal.alarm(0)
        said = out.getvalue() + err.getvalue()
        assert contents(folder) == kept
        assert all(part in said for part in parts), said
        assert (code, said.count("remedy: "), "Traceback" in said) == (wanted, 1, False), said
        assert "explains the options" not in said or "allowed" in said or "must be" in said, said

    before = signal.signal(signal.SIGALRM, late)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        yield check
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", GOOD)
@settings(max_examples=2, deadline=None, derandomize=True, suppress_health_check=[*HealthCheck])
@given(data=st.data())
def test_a_bad_argument_is_refused(name: str, refused: Refused, data: st.DataObject) -> None:
    for lines in faults_of(name):
        refused(data.draw(st.sampled_from(lines)), 2)


@pytest.mark.parametrize(("words", "code"), LINES, ids=[ascii(" ".join(words))[1:120] for words, _ in LINES])
def test_a_line_that_makes_no_sense_is_refused(words: list[str], code: int, refused: Refused) -> None:
    refused(words, code)


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_named_with_its_remedy(line: str, refused: Refused) -> None:
    refused(line.split(), 2, *MISTAKES[line].split("|"))


def test_the_main_error_comes_before_that_of_the_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "fashion10", "--device", "COM3", "--profile", "ideal", "--decisions", "1"]) == 2
    said = capsys.readouterr().err
    assert 0 <= said.index("124 levels") < said.index("besides, the device could not be opened: 'COM3' is no")


def test_every_command_is_tried_with_at_least_200_lines() -> None:
    pytest.importorskip("torch", reason="needs the train extra")
    assert {*GOOD} <= {*find_commands()} == {words[0] for words, _ in LINES if words[-1] == "--nonsense=1"}
    assert len({*map(str, itertools.chain(*itertools.chain(*map(faults_of, GOOD))))}) >= 200
