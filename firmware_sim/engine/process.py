"""The reference instrument as a process: its URL, and the thread that answers its requests for light.

Owns the child and its pipes; never sees a byte of the protocol.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
from contextlib import suppress
from pathlib import Path

from pans.firmware_sim.device.view import View
from pans.firmware_sim.ports.on_table import scene_on_table
from pans.firmware_sim.ports.serve import SimOptions
from pans.firmware_sim.scene.moving import SceneFile
from pans.runtime.errors import LinkError
from pans.runtime.instrument.profile import Profile, load_profile

from .build import engine_program
from .requests import light_desk
from .settings import settings_text

GOODBYE_S = 2.0


class CEngine:
    """A running reference instrument; `url` is its port. `close` ends it, and so does the end of this process.

    `profile` and `scene` take the place of those that `options` name; `program` is another build of the same shell.
    """

    def __init__(
        self,
        options: SimOptions,
        listen: str,
        *,
        core: int | None = None,
        profile: Profile | None = None,
        scene: SceneFile | None = None,
        program: Path | None = None,
    ) -> None:
        profile = profile or load_profile(options.profile)
        scene = scene or scene_on_table(options.scene, options.changes, options.optics, profile)
        text = settings_text(options, profile, scene, listen, awake=core is not None)
        view = View(profile, scene, None, options.seed)
        view.check_and_warm_up()
        self._folder = tempfile.TemporaryDirectory(prefix="pans-engine-")
        self._desk = light_desk(view, Path(self._folder.name))
        self._failed = ""
        words = [str(program or engine_program())]
        self._child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        try:
            self.url = self._start(text, core)
        except BaseException:
            self.close()
            raise
        threading.Thread(target=self._answer, name="pans-engine-light", daemon=True).start()

    @property
    def failed(self) -> str:
        """Why no light can be computed any more; "" while all is well."""
        return self._failed

    @property
    def running(self) -> bool:
        """Whether the program still runs."""
        return self._child.poll() is None

    def close(self) -> None:
        """End the program; idempotent."""
        assert self._child.stdin is not None
        with suppress(OSError):  # it has gone before
            self._child.stdin.close()
        try:
            self._child.wait(GOODBYE_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._folder.cleanup()

    def _start(self, text: str, core: int | None) -> str:
        assert self._child.stdout is not None
        if core is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(self._child.pid, {core})
        self._say(text)
        url = self._child.stdout.readline().decode("utf-8", "replace").strip()
        if not url:
            raise LinkError(
                f"the reference instrument did not start (exit code {self._child.wait(GOODBYE_S)}): its words are above"
            )
        return url

    def _say(self, text: str) -> None:
        assert self._child.stdin is not None
        self._child.stdin.write(text.encode())
        self._child.stdin.flush()

    def _answer(self) -> None:
        requests = self._child.stdout
        assert requests is not None
        try:
            while line := requests.readline():
                answer = self._desk.take(line, requests)
                if answer is not None:
                    self._say(answer + "\n")
        except Exception as error:  # whatever it is, the instrument waits for an answer that will not come
            self._failed = f"{type(error).__name__}: {error}"
            self._child.kill()
