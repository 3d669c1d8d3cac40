"""The reference instrument's sources -> a program, compiled with the system's compiler when it is first asked for.

Owns the choice of the compiler, the flags and the place where a built program is kept: under a name made from the sources, the flags and
the compiler's version, so that a change of any makes another one. Never runs what it built.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from pans.runtime.errors import ConfigError

FOLDER = Path(__file__).parents[1] / "reference"
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra")
COMPILERS = ("cc", "gcc", "clang")
BUILD_S = 120.0


def core_sources(folder: Path = FOLDER) -> list[Path]:
    """Return the C files of the core, which need nothing of a system."""
    return sorted(folder.glob("*.c"))


def program_sources(folder: Path = FOLDER) -> list[Path]:
    """Return those of the program: the core behind a pseudo-terminal or TCP."""
    return core_sources(folder) + sorted((folder / "posix").glob("*.c"))


def library_sources(folder: Path = FOLDER) -> list[Path]:
    """Return those of the library: the core with the program's light, without port and clock."""
    shared = [folder / "posix" / name for name in ("bench.c", "light.c")]
    return core_sources(folder) + shared + sorted((folder / "library").glob("*.c"))


def compiler() -> str:
    """Return the compiler's path: the variable CC, or the first of cc, gcc and clang that is there; ConfigError without one."""
    named = os.environ.get("CC", "")
    for name in (named,) if named else COMPILERS:
        if found := shutil.which(name):
            return found
    raise ConfigError(
        f"--engine c: no C compiler: {named or ', '.join(COMPILERS)} not found",
        remedy="install one (apt install gcc, or the Xcode command line tools), or leave --engine out",
    )


def engine_program(folder: Path = FOLDER) -> Path:
    """Return the program, built now if no earlier build of the same sources is in the cache; ConfigError where that is not possible."""
    return _built("reference", folder, [*map(str, program_sources(folder)), "-lm", "-pthread"])


def engine_library(folder: Path = FOLDER) -> Path:
    """Return the shared library, built as the program is."""
    return _built("reference-library", folder, ["-shared", "-fPIC", *map(str, library_sources(folder)), "-lm"])


def _built(name: str, folder: Path, words: list[str]) -> Path:
    if os.name != "posix":
        raise ConfigError(
            "--engine c: the reference instrument's shell is for POSIX systems", remedy="leave --engine out"
        )
    command = compiler()
    target = _cache() / f"{name}-{_fingerprint(command, folder)}"
    if not target.is_file():
        _build([command, *FLAGS, *words], target)
    return target


def _fingerprint(command: str, folder: Path) -> str:
    version = subprocess.run([command, "--version"], capture_output=True, timeout=BUILD_S).stdout
    digest = hashlib.sha256(version + " ".join(FLAGS).encode())
    for path in sorted(folder.rglob("*.[ch]")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:20]


def _cache() -> Path:
    """The folder for built programs: the user's cache, or a temporary one where that cannot be written."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "pans"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="pans-engine-"))


def _build(words: list[str], target: Path) -> None:
    """Compile to a file beside `target`, which takes its name when it is whole: two first starts at once do no harm."""
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=target.name)
    os.close(handle)
    try:
        done = subprocess.run([*words, "-o", name], capture_output=True, text=True, timeout=BUILD_S)
        if done.returncode:
            raise ConfigError(
                f"{words[0]} could not build the reference instrument: {done.stderr.strip()[-500:]}",
                remedy="name another compiler in the variable CC, or leave --engine out",
            )
        os.chmod(name, 0o755)
        os.replace(name, target)
    finally:
        Path(name).unlink(missing_ok=True)
