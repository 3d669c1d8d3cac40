"""A PostgreSQL server for one test: in a folder of its own, on a Unix socket alone, run by a user who is not root."""

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

USERS = ("postgres", "nobody")


@contextmanager
def postgres_server() -> Iterator[str]:
    """Yield the URL of an empty database; the test is skipped where there is no server to start."""
    for program in ("initdb", "pg_ctl"):
        if shutil.which(program) is None:
            pytest.skip(f"needs {program} of PostgreSQL")
    known = {entry.pw_name for entry in pwd.getpwall()}
    user = next((name for name in USERS if name in known), None) if os.getuid() == 0 else None
    if os.getuid() == 0 and (user is None or shutil.which("runuser") is None):
        pytest.skip("needs a user who is not root")
    as_user = [] if user is None else ["runuser", "-u", user, "--"]
    folder = tempfile.mkdtemp(prefix="pans-pg-")
    try:
        if user is not None:
            shutil.chown(folder, user)
        data = f"{folder}/data"
        _run([*as_user, "initdb", "-D", data, "-U", "lab", "-A", "trust", "--no-sync"], folder)
        served = f"-c listen_addresses= -k {folder} -F"
        _run([*as_user, "pg_ctl", "-D", data, "-l", f"{folder}/log", "-w", "-t", "120", "-o", served, "start"], folder)
        try:
            yield f"postgresql+psycopg://lab@/postgres?host={folder}"
        finally:
            _run([*as_user, "pg_ctl", "-D", data, "-m", "immediate", "stop"], folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run(words: list[str], folder: str) -> None:
    done = subprocess.run(
        words, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    assert done.returncode == 0, done.stderr.decode("utf-8", "replace")
