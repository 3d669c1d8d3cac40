"""Which matrix products and convolutions torch really computes on this processor, found by trying them in child processes.

A processor's flags are no proof: a virtual machine may announce AMX and refuse it, and then every bfloat16 product and every convolution
of oneDNN fails, or ends the process by SIGILL. So each candidate is tried once, checked and timed; the answer is kept in the user's cache
folder, by machine, processor and torch version. A virtual machine may move to another processor, so a kept answer is tried before each
use. Start with `settle`. Nothing here loads torch into this process.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from pans.base.console import note, say
from pans.base.errors import UsageError
from pans.base.files import make_folder, replace_file, user_cache

if TYPE_CHECKING:
    import numpy as np
    import torch

    from pans.app.doctor import Finding

# Environments that torch is tried with, until one computes everything. oneDNN and ATen read them at their first operation.
LIMITS: tuple[dict[str, str], ...] = (
    {},
    {"ONEDNN_MAX_CPU_ISA": "AVX512_CORE_BF16"},  # AMX announced, not granted
    {"ONEDNN_MAX_CPU_ISA": "AVX512_CORE"},
    {"ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2"},
    {"ONEDNN_MAX_CPU_ISA": "SSE41", "ATEN_CPU_CAPABILITY": "default"},
)
TYPES = ("float32", "bfloat16")
FASTER = 1.2  # bfloat16 is coarser, so it must bring something
PATIENCE_S = 300.0  # loading torch on a busy machine takes tens of seconds
SHAPE = (512, 784, 256)  # images by states: the products of an automaton
REPEATS = 5
# lines of /proc/cpuinfo that tell processors apart; a model may come with other microcode, and so grant less
CPU_FACTS = ("vendor_id", "cpu family", "model", "stepping", "microcode", "CPU ", "flags", "Features")
TOLERANCE = {"float32": 1e-4, "bfloat16": 2e-2}  # of the largest value; bfloat16 keeps 8 bits


@dataclass(frozen=True, slots=True)
class Trial:
    """What a child process computed correctly in one environment: GFLOP/s of one core by type, and why the others failed."""

    limits: dict[str, str]
    gflops: dict[str, float]
    failed: dict[str, str]


@dataclass(frozen=True, slots=True)
class Choice:
    """The type of training's products, and the environment in which torch computes them and convolutions."""

    products: str
    limits: dict[str, str]
    trials: list[Trial]

    @property
    def works(self) -> dict[str, float]:
        """GFLOP/s of the types that work in that environment."""
        return next(trial.gflops for trial in self.trials if trial.limits == self.limits)

    def words(self) -> str:
        """Return the choice in a few words, as a bundle's provenance has it."""
        limits = "".join(f", {name}={value}" for name, value in self.limits.items())
        return f"products {self.products}{limits}"


@cache
def settle() -> Choice | None:
    """Set the environment that torch needs here and return what was chosen; None where torch is not installed.

    It must come before torch's first operation. The first call on a machine tries the candidates, which takes a few seconds; later ones
    try the answer alone, and all candidates again where it fails.
    """
    try:
        choice = _kept()
        if choice is None or not holds(choice):
            what = "trying which products this processor computes: once per machine and torch version"
            say(f"pans: {what if choice is None else 'the products found here before fail now; trying which work'}")
            trials = [attempt(LIMITS[0])]
            while trials[-1].failed and len(trials) < len(LIMITS):
                trials.append(attempt(LIMITS[len(trials)]))
            choice = choose(trials)
            _keep(choice)
            os.environ.update(choice.limits)
            _keep(choice)  # once more, by the environment that child processes inherit
    except PackageNotFoundError:
        return None
    os.environ.update(choice.limits)
    note(f"pans: torch computes with {choice.words()} ({_rates(choice.works)})")
    return choice


def choose(trials: list[Trial]) -> Choice:
    """Return the fastest type and environment among `trials`; float32 unless bfloat16 is 1.2 times as fast."""
    best, fastest = Choice("float32", trials[0].limits, trials), 0.0
    for trial in trials:
        for products in TYPES:
            rate = trial.gflops.get(products, 0.0) if "float32" in trial.gflops else 0.0
            if rate > FASTER * fastest:
                best, fastest = Choice(products, trial.limits, trials), rate
    return best


def attempt(limits: dict[str, str]) -> Trial:
    """Compute products and convolutions in a child process under `limits`: it may die, as of an illegal instruction."""
    command = [sys.executable, "-c", "from pans_trainer.processor import compute_all; compute_all()"]
    environment = {**os.environ, **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"), **limits}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
        ended, printed = f"the process ended with {done.returncode}", done.stdout
        if done.returncode < 0:
            ended = signal.Signals(-done.returncode).name
    except subprocess.TimeoutExpired as error:
        ended, printed = f"no answer within {PATIENCE_S:.0f} s", (error.stdout or b"").decode()
    answers = dict(line.split("=", 1) for line in printed.splitlines() if line.startswith(TYPES))
    gflops, failed = {}, {}
    for products in TYPES:
        answer = answers.get(products, ended)
        try:
            gflops[products] = float(answer)
        except ValueError:
            failed[products] = answer
    return Trial(limits, gflops, failed)


def holds(choice: Choice) -> bool:
    """Return whether the products of `choice` still work, by computing them in a forked child: it may die. True where there is no fork."""
    if sys.platform != "linux":
        return True
    sys.stdout.flush()  # what is buffered would be written twice
    sys.stderr.flush()
    with warnings.catch_warnings():  # Python 3.12 warns of threads: the child takes none of their locks
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        _compute_and_exit(choice)
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status == 0
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def _compute_and_exit(choice: Choice) -> NoReturn:
    """End this process with 0 if what `choice` takes is computed correctly in its environment; nothing of the parent is cleaned up."""
    code = 1
    try:
        os.environ.update(choice.limits)
        import torch

        torch.set_num_threads(1)
        for products in {"float32", choice.products}:  # convolutions are of float32 in any case
            _rate(products)
        code = 0
    finally:
        os._exit(code)


def compute_all() -> None:
    """Print a line `TYPE=GFLOP/s` or `TYPE=REASON` for each type: the child process of `attempt`."""
    import torch

    torch.set_num_threads(1)
    for products in TYPES:
        try:
            answer = f"{_rate(products):.1f}"
        except Exception as error:
            answer = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        print(f"{products}={answer}", flush=True)


def _rate(products: str) -> float:
    """Return GFLOP/s of the product of SHAPE; ValueError where a product or a convolution is wrong."""
    import numpy as np
    import torch

    dtype, tolerance = getattr(torch, products), TOLERANCE[products]

    def compare(what: str, found: torch.Tensor, exact: np.ndarray) -> None:
        values = found.detach().float().numpy()
        if not np.abs(values - exact).max() <= tolerance * np.abs(exact).max():
            raise ValueError(f"{what} is wrong")

    rows, inner, columns = SHAPE
    drawn = np.random.default_rng(0)
    left, right = (drawn.random(shape, np.float32) for shape in ((rows, inner), (inner, columns)))
    a, b = (torch.from_numpy(values).to(dtype).requires_grad_() for values in (left, right))
    product = a @ b
    product.sum().backward()
    compare("a product", product, left.astype(np.float64) @ right)
    assert a.grad is not None
    compare("a product's gradient", a.grad, np.broadcast_to(right.sum(axis=1, dtype=np.float64), left.shape))

    images, kernels = drawn.random((8, 1, 28, 28), np.float32), drawn.random((16, 1, 3, 3), np.float32)
    layer = torch.nn.Conv2d(1, 16, 3, bias=False)
    layer.weight.data = torch.from_numpy(kernels)
    with torch.autocast("cpu", dtype, enabled=products != "float32"):
        shown = layer(torch.from_numpy(images).contiguous(memory_format=torch.channels_last))
    shown.float().sum().backward()
    windows = np.lib.stride_tricks.sliding_window_view(images[:, 0].astype(np.float64), (3, 3), axis=(1, 2))
    compare("a convolution", shown, np.einsum("nhwij,kij->nkhw", windows, kernels[:, 0]))
    assert layer.weight.grad is not None
    compare("a convolution's gradient", layer.weight.grad[:, 0], np.tile(windows.sum(axis=(0, 1, 2)), (16, 1, 1)))

    times = []
    with torch.no_grad():
        for _ in range(REPEATS):
            before = time.process_time()
            a @ b
            times.append(time.process_time() - before)
    return 2e-9 * rows * inner * columns / max(min(times), 1e-9)


def check_torch() -> Iterator[Finding]:
    """What torch announces, computes and takes here: a check of `pans doctor`."""
    from pans.app.doctor import Finding

    choice = settle()
    if choice is None:
        yield Finding("torch's products", True, "torch is not installed; only training needs it")
        return
    works = "; ".join(
        f"{' '.join(f'{name}={value}' for name, value in trial.limits.items()) or 'as it comes'}: "
        + ", ".join([_rates(trial.gflops), *(f"{name} failed ({why})" for name, why in trial.failed.items())])
        for trial in choice.trials
    )
    wide = ("amx", "avx512_bf16", "avx512f", "avx2")
    announced = ", ".join(sorted(flag for flag in _cpu().split() if flag.startswith(wide))) or "nothing special"
    found = f"announced {announced}; works {works}; taken {choice.words()}"
    remedy = "nothing: training uses what works. A host that grants all that its processor announces may be faster"
    refused = bool(choice.trials[0].failed)
    yield Finding("torch's products", not refused, found, remedy if refused else "")


def _rates(gflops: dict[str, float]) -> str:
    return ", ".join(f"{name} {rate:.0f} GFLOP/s" for name, rate in gflops.items()) or "nothing"


def _cpu() -> str:
    with suppress(OSError):
        block = Path("/proc/cpuinfo").read_text().split("\n\n")[0]
        return "\n".join(line for line in block.splitlines() if line.startswith(CPU_FACTS))
    return platform.processor()


def _file() -> Path:
    """Where the answer for this machine, processor, torch and environment is kept."""
    limits = [f"{name}={os.environ.get(name, '')}" for name in LIMITS[-1]]
    facts = "\n".join([version("torch"), platform.node(), platform.release(), _cpu(), *limits])
    return user_cache() / f"products-{hashlib.sha256(facts.encode()).hexdigest()[:16]}.json"


def _kept() -> Choice | None:
    """Return the answer that was kept; None where there is none, or none that can be read."""
    with suppress(OSError, ValueError, TypeError, KeyError):
        kept = json.loads(_file().read_text(encoding="utf-8"))
        choice = Choice(kept["products"], kept["limits"], [Trial(**trial) for trial in kept["trials"]])
        if choice.products in TYPES and choice.limits in LIMITS and choice.trials:
            return choice
    return None


def _keep(choice: Choice) -> None:
    """Write the answer whole or not at all; a folder that cannot be written costs each process the trial.

    Where nothing worked, as without memory, the next process tries again.
    """
    if not choice.works:
        return
    path = _file()
    with suppress(UsageError):
        make_folder(path.parent)
        replace_file(path, json.dumps(asdict(choice)).encode())
