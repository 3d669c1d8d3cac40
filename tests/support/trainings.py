"""Small trainings that several test files share."""

from __future__ import annotations

from functools import partial

import pytest


@pytest.fixture
def short_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last stage of a training takes 1500 steps however small the task is; tests that ask for no good head take 30."""
    from pans.trainer.train import head_fit

    monkeypatch.setattr(head_fit, "fit_head_exactly", partial(head_fit.fit_head_exactly, steps=30))
