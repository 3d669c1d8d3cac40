"""The process that draws: it reads pictures from its input, one JSON object per line, and shows them until the input ends.

`python -m pans.runtime.monitor.child [--panel] [--serve HOST:PORT]`; its first line of output says which port it serves, or why it cannot.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

from pans.runtime.watch.metrics import parse_address

from .history import History

if TYPE_CHECKING:
    from .server import LivePage
    from .terminal import TerminalView

LAST_LOOK_S = 0.6  # how long the page's last figures are offered after the run: a browser's round is 0.25 s


def main(words: Sequence[str]) -> int:
    """Draw until standard input ends; 1 where the address cannot be listened at."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    history, live_page = History(), None
    if "--serve" in words:
        from .server import LivePage

        host, port = parse_address(words[words.index("--serve") + 1], "--serve")
        try:
            live_page = LivePage(host, port, history)
        except OSError as error:
            print(json.dumps({"error": error.strerror or str(error)}), flush=True)
            return 1
    print(json.dumps({"port": 0 if live_page is None else live_page.port}), flush=True)
    with ExitStack() as open_views:
        view = None
        if "--panel" in words:
            from .terminal import TerminalView

            view = TerminalView()
            open_views.callback(view.close)
        _follow(history, view, live_page)
    if live_page is not None:
        time.sleep(LAST_LOOK_S)
        live_page.close()
    return 0


def _follow(history: History, view: TerminalView | None, live_page: LivePage | None) -> None:
    for line in sys.stdin:
        history.take(json.loads(line))
        if view is not None:
            view.draw(history)
        if live_page is not None:
            live_page.draw()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
