"""Storage that fails: runs commands in processes of their own, in which the n-th call on files below a folder fails, is cut or is the last.

The faults are made between the process and the kernel (storage_faults.c, by LD_PRELOAD): nothing of the project is replaced. A process with
everything imported is forked for each command, so that hundreds of them take a minute. As a program it is that process.
"""

import ctypes
import gc
import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
LONGEST_S = 60.0


class Fault(IntEnum):
    """What happens at the n-th call; as in storage_faults.c."""

    NONE = 0  # only count
    FAIL_ONCE = 1
    FAIL_ON = 2  # from there on
    SHORT = 3  # a write writes half and says so
    TORN = 4  # it writes half, and the next one fails
    CRASH = 5  # the process dies before the call
    CRASH_TORN = 6  # it dies with half of it written


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code, number of calls counted (0 after a crash), what it said on stderr."""

    code: int
    calls: int
    said: str


class FaultyStorage:
    """Runs commands on a storage with faults; `warm` are the words of commands that load what is needed, run once in `folder`."""

    def __init__(self, folder: Path, warm: Sequence[Sequence[str]]) -> None:
        shim = folder / "storage_faults.so"
        source = str(HERE / "storage_faults.c")
        subprocess.run([compiler(), "-shared", "-fPIC", "-O1", "-o", str(shim), source, "-ldl"], check=True)
        environment = os.environ | {"LD_PRELOAD": str(shim)}
        words = [sys.executable, __file__, str(shim), str(folder)]
        self._errors = folder / "server.txt"
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, env=environment, text=True
            )
        self._ask({"warm": [list(one) for one in warm]})

    def run(
        self,
        words: Sequence[str],
        folder: Path,
        at: int = 0,
        fault: Fault = Fault.NONE,
        error: int = 0,
        journal: str = "",
    ) -> Ended:
        """Run a command in `folder`, on whose files call number `at` meets `fault`; power_cut.py reads the `journal` of all calls."""
        where = {"words": list(words), "folder": str(folder), "journal": journal}
        return Ended(**self._ask(where | {"at": at, "fault": int(fault), "error": error}))

    def close(self) -> None:
        self._process.communicate()

    def _ask(self, asked: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        assert answer, f"the process of the commands ended: {self._errors.read_text()[-2000:]}"
        found: dict[str, Any] = json.loads(answer)
        return found


def compiler() -> str:
    """Return a C compiler, "" where there is none."""
    return shutil.which("cc") or shutil.which("gcc") or ""


def _serve(shim: str, folder: str) -> None:
    """Answer questions on stdin: one JSON object per line."""
    from pans.app.main import main

    faults = ctypes.CDLL(shim)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    os.chdir(folder)
    for line in sys.stdin:
        asked = json.loads(line)
        if "warm" in asked:
            found: dict[str, Any] = {"codes": [main(words) for words in asked["warm"]]}
            gc.collect()
            gc.freeze()  # or every child, before it arms, looks at all that this process has loaded, and copies it
        else:
            found = _forked(main, faults, asked)
        print(json.dumps(found), file=answers, flush=True)


def _forked(main: Any, faults: Any, asked: dict[str, Any]) -> dict[str, Any]:
    said, told = os.memfd_create("stderr"), os.memfd_create("calls")
    child = os.fork()
    if not child:
        code = 99  # a traceback
        try:
            os.chdir(asked["folder"])
            os.dup2(said, 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            faults.storage_journal(asked["journal"].encode())
            faults.storage_arm(asked["folder"].encode(), asked["at"], asked["fault"], asked["error"])
            code = main(asked["words"])
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:
            traceback.print_exc()
        finally:
            os.write(told, str(faults.storage_calls()).encode())
            os._exit(code)
    until = time.monotonic() + LONGEST_S
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > until:
            os.kill(child, 9)
            ended = os.waitpid(child, 0)
            break
        time.sleep(0.002)
    words = [os.pread(handle, 1 << 16, 0).decode(errors="replace") for handle in (said, told)]
    for handle in (said, told):
        os.close(handle)
    return {"code": os.waitstatus_to_exitcode(ended[1]), "calls": int(words[1] or 0), "said": words[0]}


if __name__ == "__main__":
    _serve(*sys.argv[1:])
