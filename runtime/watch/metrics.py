"""The run's figures for Prometheus: a small HTTP server that answers with the same picture as the state file.

On this machine only, unless it is said twice that others may read: there is no password. Needs the extra `metrics`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from pans.runtime.errors import UsageError

from .http import PageServer, is_loopback

LOOPBACK = "127.0.0.1"
# picture key -> (metric, counts up, help)
FIGURES = {
    "decisions": ("pans_decisions", True, "Decisions made"),
    "late": ("pans_late_decisions", True, "Decisions later than the deadline"),
    "lost_exposures": ("pans_lost_exposures", True, "Exposures that never came"),
    "gaps": ("pans_gaps", True, "Gaps in the stream"),
    "exposures": ("pans_exposures", True, "Exposures received"),
    "reconnects": ("pans_reconnects", True, "Times the device was lost and found again"),
    "dark_exposures": ("pans_dark_exposures", True, "Exposures without light"),
    "dark_clicks": ("pans_dark_clicks", True, "Clicks in exposures without light"),
    "latency_p99_us": ("pans_latency_p99_microseconds", False, "Exposure end to decision, 99 % quantile of the run"),
    "latency_max_us": ("pans_latency_max_microseconds", False, "Exposure end to decision, longest of the run"),
    "exposure_start_us": (
        "pans_exposure_start_error_microseconds",
        False,
        "Farthest start of an exposure off its tick",
    ),
    "exposure_length_us": (
        "pans_exposure_length_error_microseconds",
        False,
        "Farthest length of an exposure off the plan",
    ),
    "rss_bytes": ("pans_resident_memory_bytes", False, "Resident memory"),
    "handles": ("pans_open_handles", False, "Open file handles"),
    "threads": ("pans_threads", False, "Threads"),
    "loop_age_s": ("pans_loop_age_seconds", False, "Since the loop turned last"),
    "uptime_s": ("pans_uptime_seconds", False, "Since the start of the command"),
    "disk_free_bytes": ("pans_disk_free_bytes", False, "Free bytes on the disk of the recording"),
    "disk_left_s": ("pans_disk_seconds_left", False, "Until that disk is full at the rate of the last ten minutes"),
    "recording_bytes": ("pans_recording_bytes", False, "Size of the recording, or of its open part"),
    "host_clock_steps": ("pans_host_clock_steps", True, "Times the computer's clock was set during the run"),
    "host_clock_synchronised": ("pans_host_clock_synchronised", False, "Whether the computer's clock is synchronised"),
    "parts": ("pans_recording_parts", True, "Parts of the recording that were begun"),
}
CAUSES = {
    "late_cause": ("pans_late_decisions_by_cause", "Late decisions by who is to blame"),
    "lost_cause": ("pans_lost_exposures_by_cause", "Lost exposures by who is to blame"),
}


def parse_address(text: str, option: str = "--metrics") -> tuple[str, int]:
    """Read `PORT`, `HOST:PORT` or `[HOST]:PORT`; a port alone means this machine only. `option` is named in errors."""
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") if colon else ""
    if not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise UsageError(f"{option} {text!r}: no address", remedy="write 127.0.0.1:PORT, for example 127.0.0.1:9464")
    return host or LOOPBACK, int(port)


def check_address(text: str, *, public: bool, option: str = "--metrics") -> str:
    """Return `text`; UsageError if it is no address, or one that other machines can reach without `public`."""
    host, _ = parse_address(text, option)
    if not (public or is_loopback(host)):
        raise UsageError(
            f"{option} {text}: other machines could read the figures there, and there is no password",
            remedy=f"use 127.0.0.1, or say {option}-public if that is meant",
        )
    return text


def is_public(text: str) -> bool:
    """Whether other machines can reach this address."""
    return not is_loopback(parse_address(text)[0])


class Collector:
    """What prometheus_client asks for figures, at each scrape."""

    def __init__(self, look: Callable[[], dict[str, Any]]) -> None:
        self._look = look

    def collect(self) -> Iterator[Any]:
        """Yield one family for each figure that the picture holds."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        picture = self._look()
        for key, (name, counts, words) in FIGURES.items():
            if key in picture:
                yield (CounterMetricFamily if counts else GaugeMetricFamily)(name, words, value=picture[key])
        for key, (name, words) in CAUSES.items():
            family = CounterMetricFamily(name, words, labels=["cause"])
            for cause, count in picture.get(key, {}).items():
                family.add_metric([cause], count)
            yield family
        running = GaugeMetricFamily("pans_running", "1 while the device measures and the loop turns")
        running.add_metric([], float(picture.get("state") == "running"))
        yield running


class MetricsServer:
    """Serves the figures until `close`; `port` is the one that was given, or found for port 0."""

    def __init__(self, address: str, look: Callable[[], dict[str, Any]] = dict) -> None:
        self.look = look  # a run that is there later than its server gives its own
        host, port = parse_address(address)
        try:
            from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
        except ImportError as error:
            raise UsageError(
                "--metrics needs prometheus-client, which is not installed",
                remedy="pip install 'pans-runtime[metrics]'",
            ) from error
        registry = CollectorRegistry(auto_describe=False)
        registry.register(Collector(lambda: self.look()))
        try:
            self._server = PageServer(
                host, port, lambda: generate_latest(registry), {"Content-Type": CONTENT_TYPE_LATEST}
            )
        except OSError as error:
            raise UsageError(
                f"--metrics {address}: cannot listen there: {error.strerror or error}", remedy="choose another port"
            ) from error
        self.host, self.port = host, self._server.port

    def close(self) -> None:
        """Stop serving."""
        self._server.close()
