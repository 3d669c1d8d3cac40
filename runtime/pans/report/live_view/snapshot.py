"""Pictures of a run in progress, taken alongside the loop: plain numbers, JSON-able, units in the keys.

Only what is there already is read, by short calls with pauses between, so that the loop never waits long for the interpreter. A figure
that changes while it is read is that of one moment or the next.
"""

from __future__ import annotations

import base64
import time
import zlib
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from pans.bundle.automaton import walk_nodes
from pans.bundle.backends import log_evidence
from pans.decide import DecisionFlag
from pans.decide.dark import LEVELS
from pans.decide.still import Core
from pans.live.loop import words_of
from pans.live.timing import upper_edge

from .alarms import INSTANT

if TYPE_CHECKING:
    from pans.bundle.sensor import Bundle
    from pans.decide import Decision
    from pans.live.loop import Account, Status

LATEST = 12  # decisions
LOOKS, LOOK_EVERY_S = 8, 0.003  # for a word that is whole
SAME = 1e-3  # of two probabilities
EVENTS_MAX = 50  # of one picture; what is left comes with the next
PIXELS_MAX = 64  # of a side, as it is shown
PATTERNS_MAX = 2048  # whose pixels are told in one run
BREATH_S = 0.0002  # between two readings, for the loop


class Snapshots:
    """Takes pictures of one run: what `look` returns (watch.state_file) and more; `latest` are the decisions made last.

    With `words` click words are told, too; make it before arming, since what they need may have to be compiled.
    """

    def __init__(
        self, run: Status, bundle: Bundle, latest: deque[Decision], look: Callable[[], dict[str, Any]], *, words: bool
    ) -> None:
        self._run, self._bundle, self._latest, self._look = run, bundle, latest, look
        self._began_s = time.monotonic()
        self._counts = np.zeros_like(run.accounts.timing.total.counts)
        self._told: set[int] = set()
        self._told_events = 0
        automaton = run.job.plan.automaton
        self._light = None if automaton is None else bundle.light_of(automaton)  # of each state
        self._breathe: Callable[[float], None] = time.sleep
        self._core = run.core if words and isinstance(run.core, Core) else None  # whose click words are told
        if self._core is not None:
            self._posterior(self._core, self._core.windows.seen_now()[0] * 0)

    def take(self, breathe: Callable[[float], None] = time.sleep) -> dict[str, Any]:
        """Return the run's figures as they are now; `breathe` is called between the parts."""
        self._breathe = breathe
        session, account = self._run.session, self._run.accounts.account()
        picture = self._look() | {"kind": "picture", "elapsed_s": round(time.monotonic() - self._began_s, 3)}
        picture["simulated"] = bool(session.link.simulated or session.facts.get("simulated"))
        picture["virtual_time"] = session.link.virtual
        for part in (self._results, self._latency, self._decisions, self._dark, self._clock):
            breathe(BREATH_S)
            picture |= part(account)
        return picture

    def _results(self, account: Account) -> dict[str, Any]:
        core = cast(Any, self._run.core)  # of any kind
        wrong = sum(account.contradictions.values()) + account.stream["repeats_differing"]
        light = None if self._light is None else float(core.windows.walks.shown @ self._light)
        figures: dict[str, Any] = account.decided | {"objects": account.objects}
        return figures | {"walk_light": light, "contradictions": wrong}

    def _latency(self, account: Account) -> dict[str, Any]:
        """The histogram of latencies as it has grown since the last picture: [duration in ns, how many more]."""
        before, self._counts = self._counts, account.latency_counts
        grown = self._counts - before
        some = [[upper_edge(bucket), int(grown[bucket])] for bucket in np.flatnonzero(grown).tolist()]
        return {"latency": some}

    def _decisions(self, account: Account) -> dict[str, Any]:
        """The latest decisions, the click word of one of them, and the pixels of patterns that are new.

        The loop may be ahead of the decisions that it has handed over. A word belongs to the decision whose checksum it has.
        """
        core, words = self._core, dict[int, NDArray[np.int64]]()
        if core is None:
            return {"latest": [_facts_of(row) for row in tuple(self._latest)[-LATEST:]]}
        for _ in range(LOOKS):
            words |= {zlib.crc32(counts.tobytes()): counts for counts in core.windows.seen_now()}
            self._breathe(LOOK_EVERY_S)
        latest = tuple(self._latest)
        facts: dict[str, Any] = {"latest": [_facts_of(row) for row in latest[-LATEST:]]}
        for row in reversed(latest):
            if row.counts_crc in words and not row.flags & DecisionFlag.GAP:
                return facts | self._word(core, row, words[row.counts_crc])
        return facts

    def _word(self, core: Core, row: Decision, counts: NDArray[np.int64]) -> dict[str, Any]:
        """A decision with its patterns, the clicks on each, and each class's probability where it is that of the decision."""
        automaton, clicks = self._run.job.plan.automaton, counts.tolist()
        if automaton is None:
            shown = list(range(min(len(clicks), PIXELS_MAX)))
        else:
            nodes = walk_nodes(automaton, counts[None])[0]
            shown = automaton.rows[nodes[nodes < automaton.n_states]].reshape(-1).tolist()
        new = [number for number in dict.fromkeys(shown) if number not in self._told]
        new = new[: max(0, PATTERNS_MAX - len(self._told))]
        self._told.update(new)
        posterior = self._posterior(core, counts)
        sure = len(posterior) and abs(float(posterior.max()) - row.probability) < SAME
        word = {"decision": _facts_of(row), "patterns": shown, "clicks": clicks[: len(shown)]}
        word |= {"posterior": [round(float(one), 4) for one in posterior] if sure else []}
        return {"word": word, "pixels": {str(n): self._pixels(n) for n in new}}

    def _posterior(self, core: Core, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Each class's probability by a word, float64 (classes,); (0,) where there are no classes."""
        if not core.decider.n_classes:
            return np.zeros(0)
        decider = core.decider if core.guard is None else core.guard.decider(core.decider)
        return np.exp(log_evidence(decider.scores_batch(counts[None], core.shots), 1e-30)[0])

    def _pixels(self, number: int) -> dict[str, Any]:
        """Pattern `number`, or row `number` of passive optics (its modulus), white where it is brightest."""
        bundle = self._bundle
        values = bundle.pattern_levels[number] if bundle.analyser is None else np.abs(bundle.analyser.matrix[number])
        picture = values.reshape(bundle.image_shape)
        step = -(-max(picture.shape) // PIXELS_MAX)
        grey = np.round(picture[::step, ::step] * (255 / (float(values.max()) or 1.0))).astype(np.uint8)
        return {"shape": list(grey.shape), "grey": base64.b64encode(grey.tobytes()).decode()}

    def _dark(self, account: Account) -> dict[str, Any]:
        guard = self._run.core.guard
        if guard is None:
            return {}
        watch, facts = guard.watch, dict[str, Any]()
        if watch.exposures:  # one detector in one exposure, as what is expected; a flow tells by its empty frames
            facts = {"dark_exposures": watch.exposures * watch.n_channels, "dark_clicks": int(watch.clicks.sum())}
        return facts | {
            "dark_expected": float(watch.expected.mean()),
            "dark_low": float(watch.low.mean()),
            "dark_high": float(watch.high.mean()),
            "dark_alarm_after": watch.alarm_after(),
            "dark_changed": bool(guard.findings),
            "dark_states": [
                [one.level, guard.present_rate(one) / one.expected, one.words, one.since * watch.n_channels]
                for one in sorted(guard.present, key=lambda one: -LEVELS.index(one.level))
            ],
        }

    def _clock(self, account: Account) -> dict[str, Any]:
        clock = self._run.session.clock
        fit = None if clock is None else clock.fit
        news = self._run.accounts.journal.events[self._told_events : self._told_events + EVENTS_MAX]
        self._told_events += len(news)
        return {
            "clock_drift_ppm": None if fit is None else round(fit.drift_ppm, 4),
            "clock_uncertainty_us": account.clock_uncertainty_us,
            "events": [[e["kind"], words_of(e), e.get("since")] for e in news if e["kind"] in INSTANT],
        }


def _facts_of(row: Decision) -> list[Any]:
    return [row.number, row.object, row.label, round(row.probability, 4), row.clicks, row.truth, row.flags]
