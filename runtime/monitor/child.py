"""The process that draws: it reads pictures from its input, one JSON object per line, and shows them until the input ends.

`python -m pans.runtime.monitor.child [--panel] [--serve HOST:PORT [--control]]`; its first line of output says which port it serves, or why
it cannot. With --control, what is asked for on the page follows, one JSON object per line.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress

from pans.runtime.watch.metrics import parse_address

from .history import History

NICE = 5  # the page may wait, the run may not
BACKLOG = 64


def main(words: Sequence[str]) -> int:
    """Draw until standard input ends; 1 where the address cannot be listened at."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    history, listening = History(), None
    if "--serve" in words:
        address = words[words.index("--serve") + 1]
        try:
            listening = _listen(*parse_address(address, "--serve"))
        except OSError as error:
            print(json.dumps({"error": error.strerror or str(error)}), flush=True)
            return 1
    print(json.dumps({"port": 0 if listening is None else listening.getsockname()[1]}), flush=True)
    with ExitStack() as open_views:
        draws: list[Callable[[History], None]] = []
        if "--panel" in words:
            from .terminal import TerminalView

            view = TerminalView()
            open_views.callback(view.close)
            draws.append(view.draw)
        if listening is None:
            for line in sys.stdin:
                history.take(json.loads(line))
                for draw in draws:
                    draw(history)
        else:  # whoever has connected waits while Bokeh is loaded
            with suppress(OSError, AttributeError):
                os.nice(NICE)
            import asyncio

            from .live_page import serve

            asyncio.run(serve(listening, history, draws, address=address, control="--control" in words))
    return 0


def _listen(host: str, port: int) -> socket.socket:
    family, *_, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    with ExitStack() as failed:
        listening = failed.enter_context(socket.socket(family))
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(place)
        listening.listen(BACKLOG)
        listening.setblocking(False)
        failed.pop_all()
    return listening


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
