"""Causes that are really made, and what the timing verdict calls them: the confusion matrix of `pans.runtime.blame`.

    python -m pans.firmware_sim.trials.causes [--injections 200] [--seed 1] [--listen tcp:127.0.0.1:0] [--json]

Owns the choice of causes, the processes that make them and the comparison; host and instrument are the ordinary ones at real pace, one
core each. Linux, with the right to SCHED_FIFO. Exit code 1 when fewer than 95 % are named rightly. How each cause is made:

    link        the fault `stall`: no byte passes in either direction, then a flood
    device      the fault `late`: the device keeps its stream messages, and answers everything else at once
    host        in turns: a spinning process of higher priority on the host's core; SIGSTOP and SIGCONT to the host
    gc          gc.collect() over a big heap in the loop's thread
    disk        the recording goes through a pipe to a process that writes the file; that process is stopped, so that a write blocks
    inference   in turns: the back end computes (holding the interpreter), or sleeps (as one that waits for other hardware)
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from pans.runtime.record import read_recording

from .scheduling_probe import Canary

KINDS = ("link", "device", "host", "gc", "disk", "inference")
NAMED_IN_TIME = 0.95
SPACING_S = (0.9, 1.2)
LENGTH_MS = (25, 70)
DISK_HOLD_MS = 560  # the loop writes every 500 ms: this one blocks for at least 60 ms
SETTLE_S = 1.5
NEAR_NS = 60_000_000  # an injection and what the machine does so shortly before or after it are one incident
HOST_CORE, INSTRUMENT_CORE = 0, 1
ORCHESTRATOR_PRIORITY, HOG_PRIORITY = 70, 60
CANARY_PRIORITY, CANARY_EVERY_US, CANARY_LATE_US = 12, 4_000, 6_000  # the host's loop has 10
READY_S = 60.0


class Injection(NamedTuple):
    """One cause: begins `at_ns` after the start and lasts `length_ns`; `variant` counts within its kind."""

    kind: str
    at_ns: int
    length_ns: int
    variant: int


def make_script(injections: int, seed: int) -> list[Injection]:
    """Return the causes in a random order, as many of each kind, one about every second."""
    dice = random.Random(seed)
    kinds = [KINDS[number % len(KINDS)] for number in range(injections)]
    dice.shuffle(kinds)
    script, at_s, seen = [], SETTLE_S, Counter[str]()
    for kind in kinds:
        length_ms = DISK_HOLD_MS if kind == "disk" else dice.uniform(*LENGTH_MS)
        script.append(Injection(kind, round(at_s * 1e9), round(length_ms * 1e6), seen[kind]))
        seen[kind] += 1
        at_s += dice.uniform(*SPACING_S) + (DISK_HOLD_MS / 1000 if kind == "disk" else 0.0)
    return script


def compare(
    script: Iterable[Injection], start_ns: int, verdicts: list[dict[str, Any]], canary: list[tuple[int, int]]
) -> list[dict[str, Any]]:
    """Return, for each injection, the verdict whose late work overlaps it most ("nothing" if none does).

    `canary` holds the times in which a process of higher priority than the host's did not get one of the two cores: an injection that
    one of them touches is `disturbed`, since two causes were at work. The hog's own times are no disturbance.
    """
    compared = []
    for injection in script:
        begin = start_ns + injection.at_ns
        end = begin + injection.length_ns

        def overlap(verdict: dict[str, Any], begin: int = begin, end: int = end) -> int:
            return min(end, int(verdict["end_ns"])) - max(begin, int(verdict["begin_ns"]))

        hogged = injection.kind == "host" and injection.variant % 2 == 0
        disturbed = not hogged and any(since < end + NEAR_NS and until > begin - NEAR_NS for since, until in canary)
        best = max(verdicts, key=overlap, default=None)
        found = best if best is not None and overlap(best) > 0 else {"cause": "nothing", "sure": False, "why": ""}
        compared.append(
            {
                "kind": injection.kind,
                "variant": injection.variant % 2,
                "length_ms": injection.length_ns / 1e6,
                "named": found["cause"],
                "disturbed": disturbed,
                "sure": found["sure"],
                "why": found["why"],
            }
        )
    return compared


# ---- the orchestrator: everybody's parent ----


class Role:
    """A child that says one JSON line when it is ready, and waits for the start time on its standard input."""

    def __init__(self, name: str, *words: str) -> None:
        self.name = name
        command = [sys.executable, "-m", "pans.firmware_sim.trials.cause_processes", name, *words]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
        )

    def said(self) -> dict[str, Any]:
        """Return the next line of the child, an object."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the {self.name} ended with {self.process.wait()}")
        return dict(json.loads(line))

    def tell(self, word: object) -> None:
        """Send the child one line."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{word}\n")
        self.process.stdin.flush()

    def end(self) -> None:
        """Close its standard input and wait; it is killed if it does not end."""
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def run_all(script: list[Injection], listen: str, folder: Path, seed: int) -> tuple[int, dict[str, Any], Path]:
    """Make every cause of `script`; return the start time, what the host says of its run, and its recording."""
    plan_file, recording = folder / "script.json", folder / "blame.pansrec"
    plan_file.write_text(json.dumps(script))
    roles, canaries = [Role("instrument", str(plan_file), listen, str(seed))], list[Canary]()
    try:
        url = roles[0].said()["url"]
        roles.append(Role("host", url, str(plan_file), str(recording)))
        roles.append(Role("hog", str(plan_file)))
        for core in (HOST_CORE, INSTRUMENT_CORE):
            canaries.append(Canary(core, CANARY_PRIORITY, CANARY_EVERY_US, CANARY_LATE_US))
        host = roles[1].said()
        roles[2].said()
        start_ns = time.perf_counter_ns() + 500_000_000
        for role in roles:
            role.tell(start_ns)
        _stop_and_go(script, start_ns, {"host": int(host["pid"]), "disk": int(host["disk_pid"])})
        words = roles[1].said()
        away = [(gap.begin_ns, gap.end_ns) for one in canaries for gap in one.end().gaps]
        return start_ns, words | {"canary": away}, recording
    finally:
        for one in canaries:
            one.kill()
        for role in reversed(roles):
            role.end()


def _stop_and_go(script: list[Injection], start_ns: int, pids: dict[str, int]) -> None:
    """Stop what is to be stopped, from outside, and let it go on again."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(ORCHESTRATOR_PRIORITY))
    try:
        for injection in script:
            if injection.kind == "disk" or (injection.kind == "host" and injection.variant % 2):
                _sleep_until(start_ns + injection.at_ns)
                os.kill(pids[injection.kind], signal.SIGSTOP)
                _sleep_until(start_ns + injection.at_ns + injection.length_ns)
                os.kill(pids[injection.kind], signal.SIGCONT)
    finally:
        for pid in pids.values():
            os.kill(pid, signal.SIGCONT)
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _sleep_until(at_ns: int) -> None:
    time.sleep(max(0.0, (at_ns - time.perf_counter_ns()) * 1e-9))


# ---- what came of it ----


def report(compared: list[dict[str, Any]], others: Counter[str], host: dict[str, Any]) -> dict[str, Any]:
    """Return the confusion matrix and its sums."""
    disturbed = [entry for entry in compared if entry["disturbed"]]
    compared = [entry for entry in compared if not entry["disturbed"]]
    named = sorted({entry["named"] for entry in compared} - set(KINDS))
    matrix = {
        kind: {name: sum(1 for entry in compared if (entry["kind"], entry["named"]) == (kind, name)) for name in (*KINDS, *named)}
        for kind in KINDS
    }  # fmt: skip
    right = sum(entry["kind"] == entry["named"] for entry in compared)
    return {
        "simulated": True,
        "injections": len(compared),
        "right": right,
        "share": right / len(compared) if compared else 0.0,
        "sure": sum(entry["sure"] for entry in compared),
        "sure_and_wrong": sum(entry["sure"] and entry["kind"] != entry["named"] for entry in compared),
        "matrix": matrix,
        "disturbed": len(disturbed),
        "disturbed_right": sum(entry["kind"] == entry["named"] for entry in disturbed),
        "disturbed_named": dict(Counter(entry["named"] for entry in disturbed)),
        "not_injected": dict(others),
        "wrong": [entry for entry in compared if entry["kind"] != entry["named"]],
        "host": host,
    }


def show(result: dict[str, Any]) -> str:
    """Return the matrix for people: a row per cause that was made, a column per name that it was given."""
    columns = list(next(iter(result["matrix"].values())))
    lines = ["SIMULATED instrument, real pace; rows: cause that was made, columns: cause that was named", ""]
    lines.append(f"{'':<10}" + "".join(f"{name:>11}" for name in columns))
    for kind, row in result["matrix"].items():
        lines.append(f"{kind:<10}" + "".join(f"{row[name] or '·':>11}" for name in columns))
    lines += [
        "",
        f"{result['right']} of {result['injections']} named rightly ({result['share']:.1%}); "
        f"{result['sure']} verdicts say that they are sure, {result['sure_and_wrong']} of these are wrong",
        f"besides: {result['disturbed']} injections that the machine disturbed at the same time (a canary of higher priority was kept "
        f"from one of the cores); {result['disturbed_right']} of them named rightly, all: {result['disturbed_named']}",
        f"late work that nobody injected (the machine's own): {result['not_injected'] or 'none'}",
        f"host: {result['host']}",
    ]
    lines += [f"  wrong: {entry}" for entry in result["wrong"]]
    return "\n".join(lines)


def main() -> int:
    """Make causes from the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m pans.firmware_sim.trials.causes", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--injections", type=int, default=200, help="how many causes (default 200)")
    parser.add_argument("--seed", type=int, default=1, help="of the order, the moments and the lengths (default 1)")
    parser.add_argument("--listen", default="pty", help="the instrument's port: pty (default) or tcp:127.0.0.1:0")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    args = parser.parse_args()
    if not hasattr(os, "sched_setscheduler") or (os.cpu_count() or 1) <= INSTRUMENT_CORE:
        print("this needs Linux and two cores: a core each for host and instrument", file=sys.stderr)
        return 2
    script = make_script(args.injections, args.seed)
    with tempfile.TemporaryDirectory() as folder:
        start_ns, host, recording = run_all(script, args.listen, Path(folder), args.seed)
        events = [event for event in read_recording(recording).events() if event["kind"] == "blame"]
    verdicts = [event for event in events if event["what"] == "late"]
    compared = compare(script, start_ns, verdicts, host.pop("canary"))
    spans = [(start_ns + one.at_ns, start_ns + one.at_ns + one.length_ns) for one in script]
    others = Counter(
        str(verdict["cause"])
        for verdict in verdicts
        if not any(verdict["begin_ns"] < end and verdict["end_ns"] > begin for begin, end in spans)
    )
    result = report(compared, others, host)
    print(json.dumps(result) if args.json else show(result))
    return 0 if result["share"] >= NAMED_IN_TIME else 1


if __name__ == "__main__":
    sys.exit(main())
