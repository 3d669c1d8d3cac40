"""A run that has been prepared and not been armed: all of its objects are real, the instrument is simulated in virtual time."""

from pans.bundle.backends import make_decider
from pans.decide.still import Core
from pans.live.accounts import Accounts
from pans.live.job import Job
from pans.live.options import RunOptions
from pans.live.receiver import Receiver
from pans.live.session import open_session
from pans.live.status import Status
from pans.protocol.wire import Gate, Opcode, pack_command
from pans.record.recorder import Recorder
from pans_sim.ports.serve import open_sim
from pans_sim.testing import small_setup


def small_status(recorder: Recorder | None = None) -> Status:
    """Return one; its session is to be closed."""
    profile, bundle, plan = small_setup("sequential")
    job = Job(profile, bundle, plan, RunOptions(deadline_us=1e9, lease_ms=1000, realtime=False))
    core, link = Core(plan, make_decider(bundle), 1, 0), open_sim("sim:ideal?scene=uniform&pace=fast&seed=1")
    accounts = Accounts(job, core, link, recorder)
    session = open_session(link, job, recorder, accounts.close_books)
    receiver = Receiver(core, accounts.lateness, None, prompt=False)
    return Status(job, core, session, accounts, receiver, began_ns=0)


def ask_for_gate(run: Status, tick: int, duration_ticks: int, channel: int) -> None:
    """As a program of a laboratory asks for a pulse: what it acts upon is on record first."""
    if run.accounts.recorder is not None:
        run.accounts.recorder.flush_decisions()
    run.session.host.submit(Opcode.GATE, pack_command(Gate(tick, duration_ticks, channel)), may_be_refused=True)
