"""The summary of a seeded run in virtual time, compared key by key with a stored one: scripts read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from commands import fixed_run, json_of

MEASURED = ("armed_after_s", "realtime", "page_faults", "recording", "report")  # of this machine and this run


def of_a_flow(folder: Path) -> tuple[str, ...]:
    bundle, scene, settings = (str(folder / name) for name in ("thirds.pans", "cells.toml", "flow.toml"))
    device = f"sim:flow-snspd?scene={scene}&seed=4&pace=fast"
    return ("run", bundle, "--device", device, "--flow", settings, "--seconds", "0.1", "--gate-class", "b,c")


@pytest.mark.parametrize("kind", ["still", "walks", "flow"])
def test_the_summary_has_the_contracts_keys_order_and_values(
    kind: str, flow_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walks = ("demo", "--pace", "fast", "--trials", "1")
    words = {"still": fixed_run(200, 2), "walks": walks, "flow": of_a_flow(flow_folder)}[kind]
    found = json_of(capsys, "", *words, "--out", tmp_path)
    wanted: dict[str, Any] = json.loads((Path(__file__).parent / f"summary_{kind}.json").read_text())
    assert list(found) == list(wanted)
    for key in wanted:
        if key == "device":
            assert list(found[key]) == list(wanted[key])
        elif key == "clock":  # sums whose last digits depend on the processor
            assert found[key] == pytest.approx(wanted[key], rel=1e-9)
        elif key not in MEASURED:
            assert found[key] == wanted[key], key
            if isinstance(wanted[key], dict):
                assert list(found[key]) == list(wanted[key]), key
