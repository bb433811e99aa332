"""One file over HTTP: resumed by Range where the server vouches for it, tried again where it breaks."""

from __future__ import annotations

import hashlib
import http.client
import os
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terranav.core.errors import DataError

CHUNK = 2**16
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
_BUSY = frozenset({408, 425, 429})  # besides 5xx: the same request may work later
_NO_SUCH_FILE = frozenset({404, 410})


class GoneError(Exception):
    """The server has no such file."""


class _BrokenError(Exception):
    """It did not work, and may work later; after `wait_s` where the server says when."""

    def __init__(self, reason: str, wait_s: float = 0.0) -> None:
        super().__init__(reason)
        self.wait_s = wait_s


@dataclass(frozen=True)
class Trouble:
    """How to bear it: attempts >= 1, silence that counts as broken [s], and what waits between attempts."""

    attempts: int
    timeout_s: float
    pause: Callable[[float], None]


@dataclass(frozen=True)
class Source:
    """An address."""

    url: str

    @property
    def remark(self) -> str:
        """One line that tells this address from others and holds no key that its query may carry."""
        return f"# {hashlib.sha256(self.url.encode()).hexdigest()[:16]} {shown(self.url)}"


def shown(url: str) -> str:
    """An address without its query, user and password, for messages."""
    parts = urllib.parse.urlsplit(url)
    return urllib.parse.urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))


def digest(file: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def download(source: Source, part: Path, trouble: Trouble) -> bool:
    """Bring a whole file to `part`; whether it began with what an earlier attempt left there.

    Beside it PART.from holds the address and the server's ETag while the file is not whole.

    Raises
    ------
    GoneError
        404 or 410.
    DataError
        Any other refusal, or still broken after the last attempt.
    OSError
        What the disk says.
    """
    resumed, reason = False, ""
    for attempt in range(trouble.attempts):
        try:
            resumed = _attempt(source, part, trouble.timeout_s) or resumed
        except _BrokenError as problem:
            reason = str(problem)
            if attempt + 1 < trouble.attempts:
                trouble.pause(min(max(FIRST_PAUSE_S * 2.0**attempt, problem.wait_s), LONGEST_PAUSE_S))
        else:
            _beside(part).unlink(missing_ok=True)
            return resumed
    times = "1 attempt" if trouble.attempts == 1 else f"{trouble.attempts} attempts"
    raise DataError(
        f"{shown(source.url)}: {reason}, given up after {times}; expected a server that answers, try again later"
    )


def _attempt(source: Source, part: Path, timeout_s: float) -> bool:
    """One request; whether it went on from what was there."""
    have, tag = _left(source, part)
    headers = {"User-Agent": "terranav", "Accept-Encoding": "identity"}
    if have:
        headers |= {"Range": f"bytes={have}-", "If-Range": tag}
    with _answer(source, headers, part, timeout_s) as answer:
        return _keep(source, answer, part, have)


def _answer(source: Source, headers: dict[str, str], part: Path, timeout_s: float) -> Any:
    """What the server answers, for a `with` block."""
    try:
        return urllib.request.urlopen(urllib.request.Request(source.url, headers=headers), timeout=timeout_s)
    except urllib.error.HTTPError as problem:
        with problem:
            _refused(source, problem, part)
            raise _BrokenError(f"the server says {problem.code} {problem.reason}", _retry_after(problem)) from None
    except urllib.error.URLError as problem:
        raise _BrokenError(f"no connection ({problem.reason})") from None
    except (http.client.InvalidURL, ValueError) as problem:
        raise DataError(f"{shown(source.url)}: is no address ({problem})") from None
    except (http.client.HTTPException, OSError) as problem:
        raise _BrokenError(f"the connection broke ({str(problem) or type(problem).__name__})") from None


def _chunks(answer: Any) -> Iterator[bytes]:
    """The body, piece by piece; only what the network does is broken, not what the disk does."""
    while True:
        try:
            chunk = answer.read(CHUNK)
        except (http.client.HTTPException, OSError) as problem:
            raise _BrokenError(f"the connection broke ({str(problem) or type(problem).__name__})") from None
        if not chunk:
            return
        yield chunk


def _refused(source: Source, problem: urllib.error.HTTPError, part: Path) -> None:
    """Raise what no further attempt changes."""
    if problem.code in _NO_SUCH_FILE:
        raise GoneError(source.url) from None
    if problem.code == 416:  # what is there is no beginning of the file
        part.unlink(missing_ok=True)
    elif problem.code < 500 and problem.code not in _BUSY:
        raise DataError(f"{shown(source.url)}: the server refuses ({problem.code} {problem.reason})") from None


def _keep(source: Source, answer: Any, part: Path, have: int) -> bool:
    """Write what the server sends behind what is there, or from the start; check that it is all."""
    if answer.headers.get_content_type() == "text/html":
        raise DataError(f"{shown(source.url)}: the server sends a web page, expected a map tile")
    length = answer.headers.get("Content-Length")
    goes_on = bool(answer.status == 206)
    if goes_on and not answer.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
        part.unlink(missing_ok=True)
        raise _BrokenError("the server sends another part than asked for")
    if not goes_on:
        have = 0
    whole = None if length is None else have + int(length)
    tag = answer.headers.get("ETag", "")
    _beside(part).write_text(f"{source.remark}\n{'' if tag.startswith('W/') else tag}\n", encoding="utf-8")
    with part.open("ab" if goes_on else "wb") as stream:
        for chunk in _chunks(answer):
            stream.write(chunk)
            have += len(chunk)
        stream.flush()
        with suppress(OSError):  # some file systems cannot
            os.fsync(stream.fileno())
    if whole is not None and have != whole:
        raise _BrokenError(f"the connection broke after {have} of {whole} bytes")
    if have == 0:
        raise _BrokenError("the server sends an empty file")
    return goes_on


def _left(source: Source, part: Path) -> tuple[int, str]:
    """Bytes that an earlier attempt left of the same file, and the ETag that proves it; (0, '') for none."""
    try:
        remark, tag = _beside(part).read_text(encoding="utf-8").splitlines()[:2]
        have = part.stat().st_size
    except (OSError, ValueError):
        return 0, ""
    return (have, tag) if remark == source.remark and tag and have else (0, "")


def _beside(part: Path) -> Path:
    """Where the address and ETag of a part stand."""
    return part.with_name(f"{part.name}.from")


def _retry_after(problem: urllib.error.HTTPError) -> float:
    """Seconds that the server asks to wait, 0 where it does not say so in seconds."""
    text = problem.headers.get("Retry-After", "") if problem.headers else ""
    return float(text) if text.strip().isdecimal() else 0.0
