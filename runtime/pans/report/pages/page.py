"""Facts in, a page out: Jinja2's environment with the project's escapes, and the forms of facts that several pages share."""

from __future__ import annotations

import base64
import re
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import needed
from pans.base.console import text as safe_text
from pans.base.files import grey_png
from pans.base.numbers import number, wilson_interval
from pans.report.summary.summary import singular

from .charts import Axis, Bars, Curve, Mark, chart, percent, seconds, span, whole

SIDE_MAX = 96  # pixels of a small picture


def render(template: str, **facts: Any) -> bytes:
    """Return the page of a template and its facts; every text is made visible and escaped. UsageError without Jinja2."""
    return str(_environment().get_template(template).render(**facts)).encode()


@cache
def _environment() -> Any:
    jinja2, markup = needed("jinja2"), needed("markupsafe").Markup

    def escaped(value: Any) -> Any:
        return value if isinstance(value, markup) else markup("" if value is None else safe_text.html(value))

    found = jinja2.Environment(
        loader=jinja2.PackageLoader("pans.report.pages"),
        autoescape=True,
        finalize=escaped,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {one.__name__: one for one in (number, percent, seconds, flat)}
    drawing = (chart, Axis, Bars, Curve, Mark, number, percent, seconds, span, whole, wilson_interval)
    found.globals |= {one.__name__: one for one in drawing}
    # our own text, with what stands between backticks as code
    found.filters["coded"] = lambda text: markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", safe_text.html(text)))
    return found


def flat(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield (dotted name, text) of nested facts; empty ones are left out."""
    for name, value in facts.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        elif isinstance(value, list | tuple):
            if value:
                yield f"{prefix}{name}", ", ".join(str(item) for item in value)
        elif value is not None and value != "":
            yield f"{prefix}{name}", f"{value:.6g}" if isinstance(value, float) else str(value)


def picture(values: NDArray[np.float64], low: float = 0.0, high: float | None = None) -> str:
    """Return numbers (height, width) as the address of a grey picture, `low` black, `high` (the largest) white; large ones are thinned."""
    step, top = -(-max(values.shape) // SIDE_MAX), float(values.max()) if high is None else high
    share = np.clip((values[::step, ::step] - low) / ((top - low) or 1.0), 0.0, 1.0)
    return f"data:image/png;base64,{base64.b64encode(grey_png(np.rint(255 * share).astype(np.uint8))).decode()}"


# ---- words of events and faults ----


@cache
def words() -> dict[str, Any]:
    """Return templates/words.toml; the kinds of events stand in docs/reference/formats.md."""
    return tomllib.loads(files(__package__).joinpath("templates/words.toml").read_text(encoding="utf-8"))


def sentence_of(event: Mapping[str, Any]) -> str:
    """Return an event as one sentence; of an unknown kind, or with facts missing, its facts in a row.

    >>> sentence_of({"kind": "reconnected", "attempts": 2, "outage_ms": 812.345})
    'The device was found again after 812 ms (2 attempts).'
    """
    kind = str(event.get("kind", "?"))
    facts = {key: value if isinstance(value, Mapping) else _plain(value) for key, value in event.items()}
    facts["doubt"] = "" if event.get("sure", True) else ", not certain"
    try:
        said = words()["sentences"][f"{kind} {event['what']}" if kind == "blame" else kind].format_map(facts)
        return singular(str(said).replace("..", ".").strip())
    except (KeyError, IndexError, ValueError):
        rest = ", ".join(f"{key} {_plain(value)}" for key, value in event.items() if key != "kind")
        return f"{kind.replace('_', ' ')}{': ' if rest else ''}{rest}"


def _plain(value: Any) -> str:
    return number(value) if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
