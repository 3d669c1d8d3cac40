"""Whole runs under every fault, alone and together, in every mode: exposures exactly once, decisions, gates and all books."""

import pytest
from fault_grid import CASES, MODES, OFTEN, run_case

pytestmark = pytest.mark.slow
FRAMES = 20_000  # stream messages of a run
ROUNDS = 2


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("mode", range(len(MODES)), ids=MODES)
def test_every_exposure_counts_once_and_every_decision_is_the_oracle_s(mode: int, case: str) -> None:
    for number in range(ROUNDS):
        result = run_case(case, mode + number * len(MODES), FRAMES, OFTEN.get(case) if number else None)
        assert result.violations == []
        assert result.checked["decisions"] > 100
