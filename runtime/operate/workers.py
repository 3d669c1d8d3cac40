"""Where the items of a batch run: here, in a local cluster, or on the workers of a Dask scheduler (extra `dask`).

Owns the connection to Dask, imported only when it is asked for. An item whose worker dies is done by another one. Dask's own messages
are pickled: connect only to a scheduler that you trust, in a network that you trust.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any

from pans.runtime.errors import LinkError, UsageError

from .batch import Item, run_item

RETRIES = 2
CONNECT_S = 30


def results_here(items: Sequence[Item], folder: str) -> Iterator[tuple[Item, dict[str, Any]]]:
    """Yield each item with its result, one after the other."""
    for item in items:
        yield item, run_item(item.words, folder)


def results_of_dask(
    items: Sequence[Item], folder: str, *, address: str = "", workers: int = 0
) -> Iterator[tuple[Item, dict[str, Any]]]:
    """Yield each item with its result as it comes, from the scheduler at `address` or from a local cluster of `workers` processes.

    An item that fails on several workers, each of which died, has an error and no exit code. LinkError without a scheduler.
    """
    distributed = need_distributed()
    with ExitStack() as opened:
        if not address:
            cluster = distributed.LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
            address = opened.enter_context(cluster)
        try:
            client = opened.enter_context(distributed.Client(address, timeout=CONNECT_S))
        except (OSError, ValueError) as error:
            raise LinkError(
                f"--dask {address}: no scheduler answers: {error}",
                remedy="start one with `dask scheduler`, or use --workers",
            ) from error
        futures = {
            client.submit(run_item, item.words, folder, key=f"pans-{number}", pure=False, retries=RETRIES): item
            for number, item in enumerate(items)
        }
        by_key = {future.key: item for future, item in futures.items()}
        try:
            for future in distributed.as_completed(list(futures)):
                yield by_key[future.key], _result(future)
                future.release()
        except BaseException:
            client.cancel(list(futures), force=True)
            raise


def _result(future: Any) -> dict[str, Any]:
    try:
        found: dict[str, Any] = future.result()
    except Exception as error:  # a worker that died again and again, or that has no pans
        failed = {"exit": None, "seconds": None, "host": "", "answer": None}
        return failed | {"error": f"{type(error).__name__}: {error}"[:2000]}
    return found


def need_distributed() -> Any:
    """Return dask.distributed; UsageError that names the extra."""
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise UsageError(
            "--dask and --workers need the packages dask and distributed, which are not installed",
            remedy="pip install 'pans-runtime[dask]'",
        ) from error
