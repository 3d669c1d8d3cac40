"""Fixtures that several test files share; what needs data or torch says so when it is skipped."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest


def pytest_configure(config: pytest.Config) -> None:
    # A shell that starts the tests in the background lets them ignore Ctrl-C, and so every process that they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if os.environ.get("PANS_DATA"):
        return
    skip = pytest.mark.skip(
        reason="needs the IDX data sets: set PANS_DATA to the folder that holds mnist/ and fashion-mnist/"
    )
    for item in items:
        if "data" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    return Path(os.environ["PANS_DATA"])


@pytest.fixture(scope="module")
def flow_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with cells.toml, flow.toml and thirds.pans (see thirds.py)."""
    from thirds import write_thirds

    return write_thirds(tmp_path_factory.mktemp("flow"))
