"""The process that draws: it reads pictures from its input, one JSON object per line, and shows them until the input ends.

`python -m pans.report.live_view.child [--panel] [--serve FD [--local] [--control]]`: FD is a socket that listens, --local lets only this
machine in. With --control, what is asked for on the page is its output, one JSON object per line.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress

from .history import History

NICE = 5  # the page may wait, the run may not


def main(words: Sequence[str]) -> int:
    """Draw until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    history, draws = History(), list[Callable[[History], None]]()
    with ExitStack() as open_views:
        if "--panel" in words:
            from .terminal import TerminalView

            view = TerminalView()
            open_views.callback(view.close)
            draws.append(view.draw)
        if "--serve" in words:  # whoever has connected waits while Bokeh is loaded
            with suppress(OSError, AttributeError):
                os.nice(NICE)
            import asyncio
            import socket

            from .web_page import serve

            listening = socket.socket(fileno=int(words[words.index("--serve") + 1]))
            asyncio.run(serve(listening, history, draws, local="--local" in words, control="--control" in words))
        for line in sys.stdin:
            history.take(json.loads(line))
            for draw in draws:
                draw(history)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
