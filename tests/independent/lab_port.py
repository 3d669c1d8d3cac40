"""The independent firmware behind a TCP port or a pseudo-terminal, in real time.

    python lab_port.py --listen tcp --scene scene.npz --levels 124 --peak-hz 60000 [--mode parallel --channels 10]

The first line on stdout is the device URL for `pans run`; on SIGTERM the last one is the device's books as JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import socket
import time
import tty
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from lab_firmware import Firmware
from lab_light import Light

LINE_BYTES = 1 << 16  # that may wait for the line before stream messages are held back
NS_PER_S = 1_000_000_000


def listen(where: str) -> tuple[str, socket.socket | None, int]:
    """Return the device URL, the listening socket (None for a terminal) and the terminal's descriptor."""
    if where == "pty":
        mine, theirs = os.openpty()
        tty.setraw(theirs)
        os.set_blocking(mine, False)
        return f"serial:{os.ttyname(theirs)}", None, mine
    server = socket.create_server(("127.0.0.1", 0))
    return f"serial:socket://127.0.0.1:{server.getsockname()[1]}", server, -1


def serve(firmware: Firmware, port: int, clock: Callable[[], int], told: list[int]) -> None:
    """Move bytes until the client has gone or the process is told to stop."""
    pending = bytearray()
    while not told:
        tick = clock()
        due = firmware.next_due()
        pause_s = 0.05 if due is None else min(0.05, max(0.0, (due - tick) / firmware.tick_hz))
        readable, writable, _ = select.select([port], [port] if pending else [], [], pause_s)
        try:
            data = os.read(port, 1 << 16) if readable else b""
            if readable and not data:
                return
            firmware.receive(data, clock())
            pending += firmware.take()
            if pending and (writable or not data):
                del pending[: os.write(port, pending)]
        except BlockingIOError:
            pass
        except OSError:  # the client has hung up
            return
        firmware.line(full=len(pending) > LINE_BYTES)


def main() -> None:
    """Serve until SIGTERM."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--listen", choices=("tcp", "pty"), default="tcp")
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--levels", type=int, required=True)
    parser.add_argument("--peak-hz", type=float, required=True)
    parser.add_argument("--mode", choices=("sequential", "parallel"), default="sequential")
    parser.add_argument("--channels", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    light = Light.of_scene(args.scene, args.peak_hz, args.levels, args.seed)
    firmware = Firmware(light, parallel=args.mode == "parallel", channels=args.channels)
    started_ns = time.perf_counter_ns()

    def clock() -> int:
        return 123_456 + (time.perf_counter_ns() - started_ns) * firmware.tick_hz // NS_PER_S

    told: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: told.append(number))
    url, server, terminal = listen(args.listen)
    print(url, flush=True)
    while not told:
        if server is None:
            serve(firmware, terminal, clock, told)
            continue
        if not select.select([server], [], [], 0.05)[0]:
            firmware.advance(clock())  # the lease runs on when nobody listens
            firmware.take()
            continue
        client, _ = server.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setblocking(False)
        serve(firmware, client.fileno(), clock, told)
        client.close()
    print(json.dumps(asdict(firmware.books)), flush=True)


if __name__ == "__main__":
    main()
