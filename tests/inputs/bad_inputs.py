"""Bad inputs of every command, made from the parsers: numbers, paths and kinds of files that cannot be right.

Start at GOOD, the command lines that would work. A case is made once per option and kind of
fault; which value it takes goes round, so that all values meet some option.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from pans.runtime.cli.command import parser_of
from pans.runtime.cli.finding import find_commands, load_command
from pans.runtime.errors import UsageError

FAST = "sim:oled-qcmos?pace=fast"
# a command line of each command that would work, with its required arguments; {} stands for nothing
GOOD = {
    "demo": "--pace fast --seconds 0.01 --out new",
    "run": f"b.pans --device {FAST} --decisions 1 --out new",
    "replay": "r.pansrec",
    "verify": "b.pans",
    "info": "b.pans",
    "profile": "check oled-qcmos",
    "report": "b.pans -o new.html",
    "export": "r.pansrec --format csv -o new",
    "bundle": "--patterns p.npy --table t.npy --classes a,b -o new.pans",
    "simulate": "--profile oled-qcmos --scene uniform --listen tcp:127.0.0.1:0",
    "bench": "decide --quick",
    "devices": "--no-usb",
    "doctor": "--udev",
    "calibrate": f"--device {FAST}&scene=uniform --seconds 0.5 -o new.json",
    "train": "s.npz --features 2 --epochs 1 -o new.pans",
    "evaluate": "b.pans --task s.npz --objects 2",
    "data": "scene cells -o new.npz --objects 2",
    "baseline": "direct --task s.npz --photons 5",
    "reproduce": "alpha --collect --cache cache -o new",
    "sweep": "s.npz --features 2 --storage new.log --trials 1",
    "completion": "bash",
    "runs": ".",
    "service": "monitoring -o new",
    "batch": "info b.pans -o new.jsonl",
}
NUMBERS = ("nan", "inf", "-inf", "1e999", "9" * 40, "", "three", "0x10", "1,5")
TOO_LOW = "-1"
MAY_BE_NEGATIVE = {"--offset", "--drift-ppm", "--seed", "--rows", "--seeds"}  # some of them: not judged here
MISSING, EMPTY, NOISE, LATIN, FOLDER, FIFO, BROKEN, LOOP, LONG, NUL, NOWHERE, BELOW, ENDLESS = (
    *("missing.{}", "empty.{}", "noise.{}", "latin.{}", "folder.{}", "fifo.{}", "broken.{}", "loop.{}"),
    *("x" * 300, "nul\0.{}", "", "b.pans/x.{}", "/dev/zero"),
)
INPUTS = (MISSING, EMPTY, NOISE, LATIN, FOLDER, FIFO, BROKEN, LOOP, LONG, NUL, NOWHERE, BELOW, ENDLESS)
OUTPUTS = (
    "there.{}",
    "no/such/new.{}",
    "/proc/new.{}",
    FOLDER,
    FIFO,
    BROKEN,
    LOOP,
    LONG,
    NUL,
    NOWHERE,
    BELOW,
    "b.pans",
)
KINDS = {"pans": "b.pans", "pansrec": "r.pansrec", "npz": "s.npz", "toml": "f.toml", "json": "c.json", "npy": "p.npy"}
# what an option that names a file wants, by command and option ("" for all commands); the rest is found by its type
READS = {
    "bundle": "pans", "--bundle": "pans", "recording": "pansrec", "path": "pans", "paths": "pans", "--profile": "toml",
    "--act-profile": "toml", "--flow": "toml", "--calibration": "json", "--truth": "npz", "--inputs": "npz", "--task": "npz",
    "task": "npz", "--scene": "npz", "--optics": "pans", "--patterns": "npy", "--table": "npy", "--head": "onnx", "--faults": "toml",
}  # fmt: skip
WRITES = {
    "--out": "", "--record": "pansrec", "--trace": "txt", "--state": "json", "--pictures": "npz", "--storage": "log",
}  # fmt: skip
FOLDERS = {
    *(("demo", "--out"), ("run", "--out"), ("export", "--out"), ("reproduce", "--out"), ("evaluate", "--pictures")),
    ("service", "--out"),
}
SUFFIXES = {"report": "html", "bundle": "pans", "calibrate": "json", "train": "pans", "data": "npz"}


@dataclass(frozen=True, slots=True)
class Case:
    """One command line that must be refused: its words, and the exit codes that are right."""

    words: tuple[str, ...]
    codes: frozenset[int] = frozenset({2})
    needs: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        return ascii(" ".join(self.words))[1:-1].replace("x" * 300, "xxx...")[:120]


def write_inputs(folder: Path, recording: Path, bundle: Path) -> None:
    """Write the good files and the bad ones of every kind into `folder`."""
    (folder / "b.pans").write_bytes(bundle.read_bytes())
    (folder / "r.pansrec").write_bytes(recording.read_bytes())
    np.save(folder / "p.npy", np.ones((2, 784)))
    np.save(folder / "t.npy", np.zeros((4, 2)))
    images = np.random.default_rng(0).integers(0, 255, (200, 28, 28)).astype(np.uint8)
    classes = ["T-shirt/top", "Trouser", "Pullover", "Dress", "Coat", "Sandal", "Shirt", "Sneaker", "Bag", "Ankle boot"]
    np.savez(folder / "s.npz", images=images, labels=np.arange(200) % 10, classes=np.array(classes))
    np.savez(folder / "small.npz", images=images[:, :14, :14], labels=np.arange(200) % 10, classes=np.array(classes))
    np.savez(folder / "letters.npz", images=images, labels=np.arange(200) % 10, classes=np.array([*"abcdefghij"]))
    (folder / "f.toml").write_text("kind = 1\n")
    (folder / "c.json").write_text("{}\n")
    (folder / "nothing.html").write_text("<html></html>\n")
    for suffix in (*KINDS, "onnx", "txt", "png", "html", "log", "csv"):
        (folder / f"empty.{suffix}").touch()
        (folder / f"noise.{suffix}").write_bytes(np.random.default_rng(1).bytes(3000))
        (folder / f"latin.{suffix}").write_bytes("name = 'Käse'\n".encode("latin-1"))
        (folder / f"there.{suffix}").write_bytes(b"precious")
        (folder / f"folder.{suffix}").mkdir()
        os.mkfifo(folder / f"fifo.{suffix}")
        (folder / f"broken.{suffix}").symlink_to("nowhere")
        (folder / f"loop.{suffix}").symlink_to(f"loop.{suffix}")
        if suffix in KINDS:
            whole = (folder / KINDS[suffix]).read_bytes()
            (folder / f"half.{suffix}").write_bytes(whole[: len(whole) // 2])


RUN = f"run b.pans --decisions 1 --out new --device {FAST}"
# what no parser knows of: ports, addresses, options without effect, files that do not belong together
BY_HAND = {
    "run b.pans --out new --profile oled-qcmos --decisions 1 --device": {
        **{f"serial:{port}": 3 for port in ("/dev/nope", "folder.pans", "b.pans", "/dev/null", "socket://127.0.0.1:1")},
        **{url: 3 for url in ("usb:ffff:ffff", "serial:ffff:ffff", "serial:socket://nowhere.invalid:1", "serial:socket://127.0.0.1:99999")},
        **{url: 2 for url in ("nonsense", "nonsense:x", "sim:", "sim:nonsense", "usb:")},
        **{f"{FAST}&{more}": 2 for more in ("seed=x", "seed=-1", "pace=slow", "colour=red", "scene=none", "scene=folder.npz")},
        **{f"{FAST}&{more}": 2 for more in ("scene=noise.npz", "scene=fifo.npz", "faults=nonsense", "faults=loss:2", "offset=-1")},
        **{f"{FAST}&{more}": 2 for more in ("changes=x", "optics=b.pans", "drift_ppm=1e9", "buffer=0", "scene=small.npz")},
        **{f"{FAST}&{more}": 2 for more in ("scene=letters.npz", "scene=fashion200&scene")},
    },
    RUN: {
        **{more: 2 for more in ("--gate-class Bag", "--gate-delay-us 5", "--act tcp:127.0.0.1:1", "--act-profile ideal", "--pool 2")},
        **{more: 2 for more in ("--metrics-public", "--calibration-max-age-h 3", "--rotate-mb 0", "--keep-mb 1", "--drive host")},
        **{more: 2 for more in ("--confidence 0.9", "--flow nonsense", "--profile dmd-spad", "--state no/such/x.json")},
        **{more: 2 for more in ("--metrics nowhere", "--metrics 127.0.0.1:99999", "--metrics 0.0.0.0:9464", "--metrics BUSY")},
        **{more: 2 for more in ("--serve 0.0.0.0:8000", "--serve example.org:80", "--serve BUSY")},
        **{more: 2 for more in ("--record new.pansrec --trace new.pansrec", "--record b.pans --force", "--trace b.pans --force")},
        **{more: 2 for more in ("--flow cells --decisions 3", "--rotate-mb 1 --on-dark mask", "--backend automaton", "--core 9999")},
    },
    "simulate --profile oled-qcmos --scene uniform --listen": {
        **{port: 2 for port in ("nonsense", "tcp:", "tcp:127.0.0.1", "tcp:127.0.0.1:99999", "tcp:127.0.0.1:x")},
        **{port: 3 for port in ("BUSY", "tcp:nowhere.invalid:0")},
    },
    "bundle --patterns p.npy --table t.npy -o new.pans": {
        **{more: 2 for more in ("--classes a", "--classes a,a", "--classes a,b,c", "--classes a,b --image-shape 3x3")},
        **{more: 2 for more in ("--classes a,b --levels 1", "--classes a,b --levels 70000", "--classes a,b --image-shape x")},
    },
    "evaluate b.pans": {"--task small.npz": 2, "--task letters.npz": 2, "--task nonsense": 2, "--exact --trials 3": 2},
    "profile": {
        **{more: 2 for more in ("new", "new a.txt", "new b.toml --from nonsense", "new oled-qcmos.toml", "new there.toml")},
        **{more: 2 for more in ("new no/such/x.toml", "new ..toml", "list x", "show", "check", "check f.toml", "check latin.toml")},
        "check --from x": 2,
    },
    "data": {"scene": 2, "fetch nonsense": 2, "scene cells -o new.txt": 2, "scene nonsense -o new.npz": 2, "scene a b -o new.npz": 2},
    "verify": {"": 2, "no-such-name": 2, "b.pans missing.pans": 2},
    "run --decisions 1 --out new --config": {
        **{f"{name}.toml": 2 for name in ("missing", "empty", "noise", "latin", "folder", "fifo", "loop", "f", "nul\0")},
    },
    f"run b.pans --device {FAST} --write-config": {
        **{name: 2 for name in ("there.toml", "no/such/new.toml", "folder.toml", "fifo.toml", "b.pans", "nul\0", "b.pans --force")},
        **{more: 2 for more in ("new.toml --keep-mb 3", "new.toml --unset shots")},
    },
    "info b.pans --log-file": {
        **{name: 2 for name in ("there.txt", "no/such/new.log", "folder.txt", "fifo.txt", "broken.txt", "b.pans", "nul\0", "x" * 300)},
        **{more: 2 for more in ("new.log --log-format xml", "new.log --log-rotate-mb 0")},
    },
    "info b.pans": {"--log-format json": 2, "--log-rotate-mb 3": 2},
    "runs": {
        **{more: 2 for more in ("missing", "b.pans", "fifo.txt", "nul\0", "a b", "prune .", ". --yes", ". --keep 3", "prune . --keep x")},
        **{more: 2 for more in ("prune . --older-than 30", "prune . --older-than -3d", "prune . --larger-than 5gb")},
    },
    "service": {
        **{more: 2 for more in ("show", "verify", "remove", "monitoring", "nonsense", "install --config latin.toml")},
        **{more: 2 for more in ("show --config f.toml", "verify --name no-such-service", "remove --name ../x", "monitoring -o b.pans")},
        **{more: 2 for more in ("show --config missing.toml", "monitoring -o new --start 3", "show --config f.toml --watchdog-s 3")},
    },
    "batch": {
        **{f"{more} -o new.jsonl": 2 for more in ("info none*", "fuzz b.pans", "info missing.pans", "info b.pans --vary x")},
        **{f"info b.pans -o new.jsonl {more}": 2 for more in ("--vary =3", "--workers 0", "--with '", "--with=--colour")},
        **{f"info b.pans -o {name}": 2 for name in ("new.csv", "no/such/new.jsonl", "b.pans", "fifo.txt")},
        "info b.pans": 2,
    },
    "help": {"nonsense": 2},
    "": {"nonsense": 2, "--nonsense": 2, "rnu": 2},
}  # fmt: skip
TRAINS = {"evaluate", "data"}


def cases() -> list[Case]:
    """All of them, in the order of the commands."""
    others = [Case((name, "--nonsense=1")) for name in sorted({*find_commands()} - {*GOOD})]
    return [*(case for name in GOOD for case in _cases_of(name)), *_by_hand(), *others]


def _by_hand() -> Iterator[Case]:
    for words, ways in BY_HAND.items():
        name = words.split(" ")[0]
        if name in TRAINS and not find_spec("torch"):
            continue
        for more, code in ways.items():
            yield Case((*words.split(), *more.split()), frozenset({code}))


def _cases_of(name: str) -> Iterator[Case]:
    try:
        parser = parser_of(name, load_command(find_commands()[name]))
    except UsageError:
        return  # its extra is not installed
    good = GOOD[name].split()
    numbers, inputs, outputs = (itertools.cycle(values) for values in (NUMBERS, INPUTS, OUTPUTS))
    turn = sum(map(ord, name))  # each command begins at another value
    for values, many in ((numbers, NUMBERS), (inputs, INPUTS), (outputs, OUTPUTS)):
        for _ in range(turn % len(many)):
            next(values)
    for action in parser._actions:
        flag = max(action.option_strings, key=len, default="")
        if action.nargs == 0:
            continue
        key = flag or action.dest
        if action.choices:
            yield Case(_with(name, good, parser, action, "nonsense"))
        elif action.type in (int, float) or getattr(action.type, "__name__", "") == "option":
            for value in (next(numbers), next(numbers), *(() if flag in MAY_BE_NEGATIVE else (TOO_LOW,))):
                yield Case(_with(name, good, parser, action, value))
        elif key in READS and not (name == "bundle" and flag == "--task"):
            suffix = READS[key]
            wrong = next(iter({"pans": "s.npz", "npz": "b.pans"}.get(kind, "b.pans") for kind in [suffix]))
            for value in (next(inputs), next(inputs), next(inputs), "half.{}", wrong):
                if value != "half.{}" or suffix in KINDS:
                    yield Case(_with(name, good, parser, action, value.format(suffix)))
        elif key in WRITES:
            suffix = SUFFIXES.get(name) or WRITES[key] or "txt"
            for value in (next(outputs), next(outputs), next(outputs), next(outputs)):
                if key in ("--trace", "--record") and value == "no/such/new.{}":
                    continue  # their folders are made
                if (name, key) in FOLDERS and value in (FOLDER, NOWHERE, "no/such/new.{}"):
                    continue  # a folder, or one that is made
                yield Case(_with(name, good, parser, action, value.format(suffix)))


def _with(
    name: str, good: list[str], parser: argparse.ArgumentParser, action: argparse.Action, value: str
) -> tuple[str, ...]:
    """The good command line with `value` for one argument."""
    words = list(good)
    if action.option_strings:
        for flag in action.option_strings:
            if flag in words:
                at = words.index(flag)
                del words[at : at + 2]
        flag = max(action.option_strings, key=len)
        return (name, *words, f"{flag}={value}")
    places = [one for one in parser._actions if not one.option_strings]
    words[places.index(action)] = value
    return (name, *words)
