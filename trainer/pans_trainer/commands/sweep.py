"""`pans sweep`: a search over training options with optuna, shared by several processes or machines.

A trial is an ordinary training, judged by the loss on the validation part of the training objects: the held-out objects stay unseen. A
killed process costs the work of its trial; the same command continues, and several may run at once on one storage.
"""

from __future__ import annotations

import argparse
import json
import re
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from pans.app.command import Command
from pans.base.console import add_options, emit, install, say
from pans.base.errors import EXIT_FINE, EXIT_INTERRUPTED, UsageError
from pans.base.files import check_outputs, file_identity
from pans.base.numbers import Range
from pans_trainer.options import DEFAULT_ALPHA, EPOCHS, EXACT_FEATURES_MAX, Options, check_options, option_names

from .arguments import add_data_dir, add_threads, interruptible, needing, torch_with

TRIALS = Range(1, 1_000_000, whole=True)
JOURNAL_LINE_MAX_BYTES = 1 << 20
HEARTBEAT_S = 60  # a trial without a sign of life for twice that time is closed as failed


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="TASK", help="as of `pans train`")
    words = "a journal file, or a database URL that machines share"
    parser.add_argument("--storage", required=True, metavar="FILE or URL", help=words)
    parser.add_argument("--study", metavar="NAME", help="default: from task, profile and patterns")
    words = "finished trials of the whole study (default 20)"
    parser.add_argument("--trials", type=TRIALS.option, default=20, metavar="N", help=words)
    parser.add_argument("--profile", default="oled-qcmos", metavar="P", help="default: oled-qcmos")
    parser.add_argument("--epochs", type=EPOCHS.option, default=30, metavar="E", help="of a trial (default 30)")
    parser.add_argument("--hidden", type=int, default=128, metavar="H", help="hidden units of the head (default 128)")
    others = set(option_names(Options)) - {"features", "clicks", "photons", "estimator", "seed"}
    add_options(parser, Options, defaults={"estimator": None}, omit=others)
    add_threads(parser, "")
    add_data_dir(parser)


def _run(args: argparse.Namespace) -> int:
    with needing("a sweep", "train,sweep"):
        import optuna
    torch_with(args.threads, "a sweep")
    from pans.instrument.profile import load_profile
    from pans_trainer.tasks.registry import load_task
    from pans_trainer.train.gradient.loop import train

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    profile = load_profile(args.profile)
    base = _base(args)
    check_options(base, profile)
    task = load_task(args.task, args.data_dir)
    name = args.study or f"{task.name}-{profile.name}-{args.features}"
    started = time.perf_counter()
    storage = open_storage(args.storage)
    sampler = optuna.samplers.TPESampler(multivariate=True)  # unseeded: workers on one study must not repeat each other
    study = optuna.create_study(
        storage=storage, study_name=name, direction="minimize", sampler=sampler, load_if_exists=True
    )
    _check_same(study, base, task.sha256)

    def objective(trial: Any) -> float:
        trained = train(task, profile, suggest(trial, base))
        say(f"trial {trial.number}: validation loss {min(trained.validation_losses):.4f}  {trial.params}")
        return min(trained.validation_losses)

    finished = optuna.trial.TrialState.COMPLETE
    try:
        if sum(trial.state == finished for trial in study.trials) < args.trials:
            study.optimize(objective, callbacks=[optuna.study.MaxTrialsCallback(args.trials, states=(finished,))])
    except KeyboardInterrupt:
        say(f"interrupted; finished trials are in {shown_storage(args.storage)}\n  continue with the same command")
        return EXIT_INTERRUPTED
    done = [trial for trial in study.trials if trial.state == finished]
    payload = {"study": name, "trials": len(done), "best_loss": study.best_value, "best": study.best_params}
    payload |= {"seconds": time.perf_counter() - started, "simulated": True}
    words = f"{name}: {len(done)} trials, best validation loss {study.best_value:.4f}\n  {study.best_params}"
    emit(args, payload, words)
    return EXIT_FINE


def suggest(trial: Any, base: Options) -> Options:
    """Return the options of one trial: rates, length of the first stage, batch, initial light, weight of the illumination."""
    return replace(
        base,
        front_rate=trial.suggest_float("front_rate", 2e-3, 5e-2, log=True),
        head_rate=trial.suggest_float("head_rate", 5e-4, 1e-2, log=True),
        warm=trial.suggest_float("warm", 0.1, 0.6),
        batch=trial.suggest_categorical("batch", [256, 512, 1024]),
        light=trial.suggest_float("light", 0.1, 10.0, log=True),
        alpha=trial.suggest_float("alpha", 1e-5, 1e-3, log=True),
    )


def open_storage(where: str) -> Any:
    """Return the storage: a database for a URL (`sqlite:///...`, `postgresql://...`), for any other text a journal file."""
    if "://" in where:
        return _database(where)
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

    path = Path(where)
    file_identity(path)  # UsageError for what is no path
    if not path.resolve().parent.is_dir():
        raise UsageError(f"{path.parent} is not a folder", remedy="make it first")
    _check_journal(path)
    return JournalStorage(JournalFileBackend(str(path), lock_obj=JournalFileOpenLock(str(path))))


def _database(url: str) -> Any:
    """Return the database; its workers send signs of life, so that the trial of one that was killed is closed by the others."""
    from optuna.exceptions import ExperimentalWarning
    from optuna.storages import RDBStorage
    from sqlalchemy.exc import SQLAlchemyError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)  # of heartbeat_interval
            return RDBStorage(url, engine_kwargs={"pool_pre_ping": True}, heartbeat_interval=HEARTBEAT_S)
    except ImportError as error:
        remedy = f"{install('postgres')}, or the driver of your database"
        raise UsageError(f"--storage {shown_storage(url)}: its driver is not installed", remedy=remedy) from error
    except (SQLAlchemyError, ValueError) as error:
        reason = str(getattr(error, "orig", None) or error).strip().split("\n", 1)[0]
        raise UsageError(
            f"--storage {shown_storage(url)}: cannot be opened: {reason}",
            remedy="write sqlite:///FILE or postgresql://USER:PASSWORD@HOST/DATABASE, and check that the server runs",
        ) from error


def shown_storage(where: str) -> str:
    """Return a storage's name without its password.

    >>> shown_storage("postgresql://lab:secret@db.example/pans")
    'postgresql://lab:***@db.example/pans'
    """
    return re.sub(r"(?<=://)([^:/@]*):[^/]*@", r"\1:***@", where)


def _check_journal(path: Path) -> None:
    """Refuse to append to what is no journal of optuna's: a line of JSON with an operation's code each."""
    if not path.exists():
        check_outputs([path])
        return
    check_outputs([path], force=True)
    try:
        with open(path, "rb") as file:
            line = file.readline(JOURNAL_LINE_MAX_BYTES)
        is_journal = not line or "op_code" in json.loads(line)
    except (OSError, ValueError, TypeError, RecursionError):
        is_journal = False
    if not is_journal:
        raise UsageError(f"{path}: is not a journal of a sweep", remedy="name a new file")


def _base(args: argparse.Namespace) -> Options:
    estimator = args.estimator or ("exact" if args.features <= EXACT_FEATURES_MAX else "local")
    same = {name: getattr(args, name) for name in ("features", "clicks", "photons", "epochs", "hidden", "seed")}
    return Options(estimator=estimator, alpha=DEFAULT_ALPHA, **same)


def _check_same(study: Any, base: Options, data_sha256: str) -> None:
    """A study holds trials of one question; UsageError when this one is another."""
    wanted = {key: str(getattr(base, key)) for key in ("clicks", "photons", "estimator", "epochs", "hidden")}
    wanted = {"data": data_sha256} | wanted
    found = study.user_attrs
    differing = [f"{key} {found[key]} (now {value})" for key, value in wanted.items() if found.get(key, value) != value]
    if differing:
        what = f"the study {study.study_name} is another: {', '.join(differing)}"
        raise UsageError(what, remedy="give it a name by --study")
    for key, value in wanted.items():
        if key not in found:
            study.set_user_attr(key, value)


SWEEP = Command(
    "search training options with optuna, in several processes or machines",
    _configure,
    interruptible(_run),
    examples=("pans sweep parts --features 6 --storage study.log --trials 50",),
)
