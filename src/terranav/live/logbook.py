"""What a run writes down, and how it goes on from there after it was stopped or killed."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from terranav.core.errors import ConfigError, DataError, TerranavError
from terranav.io.files import replacing
from terranav.live import checkpoints
from terranav.live.recorder import RECEIVED, Recorder, as_line
from terranav.live.records import Fix, Packet, Remark
from terranav.live.session import Session

SUMMARY = "summary.json"


class Logbook:
    """The recorder and the checkpoints of a run; without a folder nothing is written.

    Parameters
    ----------
    folder : Path, optional
    links : tuple of str
        The input links by number.
    fresh : bool
        Remove the run that the folder holds, instead of going on with it.

    Attributes
    ----------
    checkpoints : int
        Written so far.
    """

    def __init__(self, folder: Path | None, links: tuple[str, ...], *, fresh: bool) -> None:
        self._folder, self._links, self._fresh = folder, links, fresh
        self._recorder: Recorder | None = None
        self.checkpoints = 0

    @property
    def failed(self) -> str:
        """Why nothing is written any more, empty while all is well."""
        return self._recorder.failed if self._recorder is not None else ""

    def begin(self, session: Session) -> list[tuple[str, str, str]]:
        """Open the files: anew, or where the run in the folder stopped, with the session brought to there.

        Returns
        -------
        list of (level, key, text)
            What there is to say of it.

        Raises
        ------
        ConfigError, DataError
            The folder cannot be written, or holds a run on other links, settings or maps.
        """
        folder = self._folder
        if folder is None:
            return []
        if self._fresh or not (folder / RECEIVED).exists():
            checkpoints.remove_all(folder)
            self._recorder = Recorder(folder, self._links)
            return []
        return self._go_on(session, folder)

    def _go_on(self, session: Session, folder: Path) -> list[tuple[str, str, str]]:
        """Bring the session to the end of the recording, and write on behind it."""
        began, wrong = time.perf_counter(), list[str]()
        resumed = session.resume(folder, wrong)
        if resumed.links != self._links:
            raise ConfigError(
                f"--record {folder}: holds a run on {', '.join(resumed.links)}, expected the same links; "
                "or --fresh to remove that run"
            )
        fixes: list[tuple[int, Fix]] = []
        for _, said in resumed.catch_up(wrong):
            fixes += [(session.packets, one) for one in said if isinstance(one, Fix)]
        self._recorder = Recorder(folder, self._links, resume_bytes=resumed.end_bytes)
        for number, fix in fixes:
            self._recorder.fix(number, fix)
        took = time.perf_counter() - began
        text = f"goes on after {session.packets} packets, {resumed.checkpoint} by a checkpoint, in {took:.1f} s"
        return [*(("warning", "resume", one) for one in wrong), ("info", "resumed", text)]

    def packet(self, packet: Packet) -> None:
        """One packet, before it is worked on."""
        if self._recorder is not None:
            self._recorder.packet(packet)

    def fix(self, number: int, fix: Fix) -> None:
        """One fix, and the number of the packet that it came of."""
        if self._recorder is not None:
            self._recorder.fix(number, fix)

    def remark(self, remark: Remark) -> None:
        """One remark."""
        if self._recorder is not None:
            self._recorder.remark(remark)

    def sent(self, output: str, stamp_us: int, data: bytes) -> None:
        """One message that went out."""
        if self._recorder is not None:
            self._recorder.sent(output, stamp_us, data)

    def flush(self) -> None:
        """Hand what was written to the system."""
        if self._recorder is not None:
            self._recorder.flush()

    async def checkpoint(self, session: Session, on_trouble: Callable[[str], None]) -> None:
        """Write a checkpoint of what has been worked on."""
        recorder, folder = self._recorder, self._folder
        if recorder is None or folder is None or recorder.failed or not session.packets:
            return
        facts, engine = session.saved(recorder.received_bytes)
        try:
            await asyncio.to_thread(checkpoints.write, folder, facts, engine)
            self.checkpoints += 1
        except DataError as problem:
            on_trouble(str(problem))

    def close(self, facts: Mapping[str, Any]) -> None:
        """Write the summary and close the files."""
        if self._recorder is None:
            return
        self._recorder.close()
        with contextlib.suppress(TerranavError), replacing(self._recorder.folder / SUMMARY) as path:
            path.write_bytes(as_line(facts))
