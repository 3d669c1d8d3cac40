"""The CUSUM tests of dark_watch.py in plain loops over exposures: the meaning of its kernels."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class NaiveTest:
    """One sum, followed trial by trial."""

    threshold: int
    click_step: int
    silent_step: int
    total: int = 0
    trial: int = 0
    alarms: list[int] = field(default_factory=list)  # trials taken when the threshold was passed

    def take(self, click: int) -> None:
        self.trial += 1
        self.total = max(0, self.total + (self.click_step if click else self.silent_step))
        if self.total >= self.threshold:
            self.alarms.append(self.trial)
            self.total = 0
