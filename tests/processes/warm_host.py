"""What a host loads before its loop turns, loaded once in the server from which the process simulator starts its hosts."""

import tempfile
from pathlib import Path

from pans.firmware_sim.testing import small_setup
from pans.runtime.commands import one_run as one_run
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.link import serial as serial
from pans.runtime.record import Recorder
from pans.runtime.report import summary as summary
from pans.runtime.report import words as words
from pans.runtime.timing import ledger as ledger
from pans.runtime.watch import watchers as watchers
from pans.runtime.wire import FrameDecoder

_, _bundle, _plan = small_setup("sequential")
Core(_plan, make_decider(_bundle), 1, 1).warm_up()
FrameDecoder().feed(b"")
with tempfile.TemporaryDirectory() as _folder, Recorder(Path(_folder) / "warm.pansrec", {}) as _recorder:
    _recorder.close({})
