"""What a host loads before its loop turns, loaded once in the server from which the process simulator starts its hosts."""

import tempfile
from pathlib import Path

from pans.app.run import one_run as one_run
from pans.bundle.backends.choose import make_decider
from pans.decide.still.core import Core
from pans.live.timing import ledger as ledger
from pans.live.watch import watchers as watchers
from pans.protocol.links import serial as serial
from pans.protocol.wire import FrameDecoder
from pans.record.recorder import Recorder
from pans.report.summary import summary as summary
from pans.report.summary import words as words
from pans_sim.testing import small_setup

_, _bundle, _plan = small_setup("sequential")
Core(_plan, make_decider(_bundle), 1, 1).warm_up()
FrameDecoder().feed(b"")
with tempfile.TemporaryDirectory() as _folder, Recorder(Path(_folder) / "warm.pansrec", {}) as _recorder:
    _recorder.close({})
