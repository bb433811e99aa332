"""Fetching tiles from a server that breaks, lies, is busy, or has no such tile."""

from __future__ import annotations

import errno
import hashlib
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import terranav as tn
from terranav.core.errors import ConfigError, DataError
from terranav.io.fetching import Fetched, fetch_tiles, tiles
from terranav.maps.map import Map

BODY = bytes(np.random.default_rng(2).integers(0, 256, 300_000, dtype=np.uint8))
BOX = (47.2, 9.1, 47.9, 9.8)


@dataclass
class Server:
    """A server on any free port, and how it misbehaves: a list of deeds per path, one for each request, then well."""

    url: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    deeds: dict[str, list[str]] = field(default_factory=dict)
    asked: list[tuple[str, str]] = field(default_factory=list)  # path and Range
    etag: str = '"v1"'


@pytest.fixture
def server() -> Iterator[Server]:
    state = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            answer(state, self)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        state.url = f"http://127.0.0.1:{http.server_address[1]}"
        yield state
        http.shutdown()
        thread.join()


def answer(state: Server, request: BaseHTTPRequestHandler) -> None:
    path = request.path.partition("?")[0]
    wanted = request.headers.get("Range", "")
    state.asked.append((path, wanted))
    deed = state.deeds[path].pop(0) if state.deeds.get(path) else "well"
    body = state.files.get(path)
    if deed.isdecimal() or body is None:
        request.send_error(int(deed) if deed.isdecimal() else 404)
        return
    start = 0
    if wanted and request.headers.get("If-Range") == state.etag and deed != "whole":
        start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        request.send_response(206)
        request.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
    else:
        request.send_response(200)
    request.send_header("Content-Type", "text/html" if deed == "page" else "application/octet-stream")
    request.send_header("Content-Length", str(len(body) - start + (7 if deed == "long" else 0)))
    request.send_header("ETag", state.etag)
    request.end_headers()
    request.wfile.write(body[start : len(body) // 2] if deed == "cut" else body[start:])


def fetched(server: Server, cache: Path, box: tuple[float, float, float, float] = BOX, **more: object) -> list[Fetched]:
    waits: list[float] = []
    return fetch_tiles(f"{server.url}/{{NS}}{{lat02}}{{EW}}{{lon03}}.hgt", box, cache, pause=waits.append, **more)  # type: ignore[arg-type]


def test_a_tile_is_fetched_once_and_checked(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    cache = tmp_path / "new" / "cache"
    (one,) = fetched(server, cache)
    assert (one.state, one.size, one.sha256) == ("fetched", len(BODY), hashlib.sha256(BODY).hexdigest())
    assert one.file == cache / "N47E009.hgt"
    assert one.file.read_bytes() == BODY
    assert f"{one.sha256}  N47E009.hgt" in (cache / "N47E009.hgt.sha256").read_text().splitlines()
    assert sorted(file.name for file in cache.iterdir()) == [".lock", "N47E009.hgt", "N47E009.hgt.sha256"]
    (again,) = fetched(server, cache)
    assert again.state == "cached"
    assert len(server.asked) == 1


def test_a_connection_cut_in_the_middle_is_resumed(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    server.deeds["/N47E009.hgt"] = ["cut", "503", "well"]
    (one,) = fetched(server, tmp_path)
    assert one.state == "resumed"
    assert (tmp_path / "N47E009.hgt").read_bytes() == BODY
    half = f"bytes={len(BODY) // 2}-"
    assert [wanted for _, wanted in server.asked] == ["", half, half]


@pytest.mark.parametrize("changed", [False, True])
def test_a_later_call_resumes_unless_the_file_changed(server: Server, tmp_path: Path, changed: bool) -> None:
    server.files["/N47E009.hgt"] = BODY
    server.deeds["/N47E009.hgt"] = ["cut", "503", "cut"]
    with pytest.raises(DataError, match=r"N47E009.hgt: the server says 503 .* after 2 attempts"):
        fetched(server, tmp_path, attempts=2)
    assert not (tmp_path / "N47E009.hgt").exists()
    server.deeds["/N47E009.hgt"] = []
    if changed:
        server.files["/N47E009.hgt"], server.etag = BODY[::-1], '"v2"'
    (one,) = fetched(server, tmp_path)
    assert one.state == ("fetched" if changed else "resumed")
    assert server.asked[-1][1] == f"bytes={len(BODY) // 2}-"
    assert (tmp_path / "N47E009.hgt").read_bytes() == server.files["/N47E009.hgt"]
    assert not list(tmp_path.glob("*.part*"))


def test_one_at_a_time_in_a_cache(server: Server, tmp_path: Path) -> None:
    fcntl = pytest.importorskip("fcntl")
    with (tmp_path / ".lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(DataError, match="another fetch is at work"):
            fetched(server, tmp_path)
    assert server.asked == []


def test_a_server_that_ignores_ranges_is_read_from_the_start(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    server.deeds["/N47E009.hgt"] = ["cut", "whole"]
    assert [one.state for one in fetched(server, tmp_path)] == ["fetched"]
    assert (tmp_path / "N47E009.hgt").read_bytes() == BODY


def test_a_file_shorter_than_announced_is_never_taken(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    server.etag = 'W/"weak"'  # proves nothing, so that each attempt starts again
    server.deeds["/N47E009.hgt"] = ["long"] * 3
    with pytest.raises(DataError, match=rf"broke after {len(BODY)} of {len(BODY) + 7} bytes.*3 attempts"):
        fetched(server, tmp_path, attempts=3)
    assert not (tmp_path / "N47E009.hgt").exists()


def test_busy_then_well_waits_longer_each_time(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    server.deeds["/N47E009.hgt"] = ["503", "429", "500"]
    waits: list[float] = []
    fetch_tiles(f"{server.url}/{{NS}}{{lat02}}{{EW}}{{lon03}}.hgt", BOX, tmp_path, pause=waits.append)
    assert waits == [1.0, 2.0, 4.0]


def test_tiles_that_do_not_exist_are_remembered(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    wide = (47.2, 9.1, 47.9, 10.5)
    assert [one.state for one in fetched(server, tmp_path, wide)] == ["fetched", "missing"]
    assert (tmp_path / "N47E010.hgt.missing").exists()
    assert [one.state for one in fetched(server, tmp_path, wide)] == ["cached", "missing"]
    assert len(server.asked) == 2
    server.files["/N47E010.hgt"] = BODY[:1000]
    assert [one.state for one in fetched(server, tmp_path, wide, refresh=True)] == ["cached", "fetched"]
    assert not (tmp_path / "N47E010.hgt.missing").exists()


def test_no_tile_at_all_is_an_error(server: Server, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none of the 1 tiles exists"):
        fetched(server, tmp_path)


def test_a_damaged_file_is_fetched_again(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    (one,) = fetched(server, tmp_path)
    assert one.file is not None
    one.file.write_bytes(BODY[:-1] + b"x")
    assert [again.state for again in fetched(server, tmp_path)] == ["replaced"]
    assert one.file.read_bytes() == BODY


def test_a_file_from_elsewhere_is_left_alone(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    (tmp_path / "N47E009.hgt").write_bytes(b"mine")
    with pytest.raises(DataError, match=r"was not fetched from http"):
        fetched(server, tmp_path)
    assert (tmp_path / "N47E009.hgt").read_bytes() == b"mine"


@pytest.mark.parametrize(("deed", "message"), [("403", "refuses (403"), ("page", "sends a web page")])
def test_refusals_are_not_tried_again(server: Server, tmp_path: Path, deed: str, message: str) -> None:
    server.files["/N47E009.hgt"] = BODY
    server.deeds["/N47E009.hgt"] = [deed]
    with pytest.raises(DataError) as caught:
        fetched(server, tmp_path)
    assert message in str(caught.value)
    assert len(server.asked) == 1


def test_a_key_in_the_address_is_written_nowhere(server: Server, tmp_path: Path) -> None:
    server.files["/get"] = BODY
    template = f"{server.url}/get?at={{lat}},{{lon}}&key=secret"
    (one,) = fetch_tiles(template, BOX, tmp_path)
    assert one.file == tmp_path / "N47E9-get"
    assert b"secret" not in b"".join(file.read_bytes() for file in tmp_path.iterdir())
    server.deeds["/get"] = ["403"]
    with pytest.raises(DataError) as caught:
        fetch_tiles(template, (48.1, 9.1, 48.2, 9.2), tmp_path)
    assert "secret" not in str(caught.value)


def test_no_server(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no connection .* given up after 1 attempt"):
        fetch_tiles("http://127.0.0.1:1/{lat}{lon}", BOX, tmp_path, attempts=1)


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"cache cannot be written \(Not a directory\)"):
        fetch_tiles("http://127.0.0.1:1/{lat}{lon}", BOX, tmp_path / "file" / "cache")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here, the disk that is always full")
def test_a_full_disk(server: Server, tmp_path: Path) -> None:
    server.files["/N47E009.hgt"] = BODY
    (tmp_path / "N47E009.hgt.part").symlink_to("/dev/full")
    with pytest.raises(DataError, match=r"cache cannot be written \(No space left on device\)"):
        fetched(server, tmp_path)


@pytest.mark.parametrize(
    "where",
    [
        ("mkdir", "cache"),
        ("open", ".lock"),
        ("write_text", ".part.from"),
        ("open", ".hgt.part"),
        ("write_text", ".sha256.part"),
        ("replace", ".sha256.part"),
        ("replace", ".hgt.part"),
    ],
)
def test_a_disk_that_fills_up_anywhere_leaves_a_cache_that_works(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: tuple[str, str]
) -> None:
    server.files["/N47E009.hgt"] = BODY
    method, suffix = where
    works = getattr(Path, method)

    def full(self: Path, *rest: Any, **more: Any) -> Any:
        if self.name.endswith(suffix):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))
        return works(self, *rest, **more)

    cache = tmp_path / "cache"
    with monkeypatch.context() as patch:
        patch.setattr(Path, method, full)
        with pytest.raises(DataError) as caught:
            fetched(server, cache)
    said = f"{cache}: the cache cannot be written (No space left on device), expected a folder with space"
    assert str(caught.value) == said
    assert not (cache / "N47E009.hgt").exists()
    (one,) = fetched(server, cache)
    assert one.state == "fetched"
    assert (cache / "N47E009.hgt").read_bytes() == BODY
    assert [again.state for again in fetched(server, cache)] == ["cached"]
    assert not list(cache.glob("*.part*"))


def test_what_was_fetched_before_a_refusal_is_kept(server: Server, tmp_path: Path) -> None:
    names = ["N47E009.hgt", "N47E010.hgt", "N47E011.hgt"]
    server.files |= {f"/{name}": BODY[: 1000 * (k + 1)] for k, name in enumerate(names)}
    server.deeds["/N47E010.hgt"] = ["401"]
    wide = (47.2, 9.1, 47.9, 11.5)
    with pytest.raises(DataError, match=r"N47E010.hgt: the server refuses \(401"):
        fetched(server, tmp_path, wide)
    assert [one.state for one in fetched(server, tmp_path, wide)] == ["cached", "fetched", "fetched"]
    assert [(tmp_path / name).stat().st_size for name in names] == [1000, 2000, 3000]


def test_names_of_tiles() -> None:
    found = tiles("https://x.y/{NS}{lat02}/{ew}{lon03}/{lat}_{lon}.tif", (-0.5, -180.0, 1.0, -179.5))
    assert [tile.url for tile in found] == [
        "https://x.y/S01/w180/-1_-180.tif",
        "https://x.y/N00/w180/0_-180.tif",
    ]
    assert [tile.name for tile in found] == ["-1_-180.tif", "0_-180.tif"]
    assert [tile.name for tile in tiles("https://x.y/{lat}/{lon}/dem.tif", BOX)] == ["N47E9-dem.tif"]
    across = tiles("https://x.y/{lat}_{lon}", (10.0, 179.5, 11.0, -179.5))  # the antimeridian
    assert [tile.lon_deg for tile in across] == [179.0, -180.0]
    fine = tiles("https://x.y/{lat}_{lon}", (47.0, 9.0, 47.5, 9.25), 0.25)
    assert [tile.name for tile in fine] == ["47_9", "47.25_9"]
    assert len(tiles("https://x.y/{lat}_{lon}", (-90.0, -180.0, 90.0, 180.0), 5.0)) == 36 * 72


@pytest.mark.parametrize(
    ("template", "box", "side", "message"),
    [
        ("https://x.y/{lat2}{lon}", BOX, 1.0, "unknown field in --template 'lat2'"),
        ("https://x.y/{lat", BOX, 1.0, "expected '}'"),
        ("https://x.y/{lat:02d}{lon}", BOX, 1.0, "carries a format"),
        ("https://x.y/{lat}%00{lon}", BOX, 1.0, "printable"),
        ("https://x.y/{lat}", BOX, 1.0, "no field for the latitude or the longitude"),
        ("ftp://x.y/{lat}{lon}", BOX, 1.0, "begins with http"),
        ("https://x.y/{lat02}{lon}", BOX, 0.5, "needs whole degrees"),
        ("https://x.y/{lat}{lon}", (47.0, 9.0, 47.0, 10.0), 1.0, "has no area"),
        ("https://x.y/{lat}{lon}", (47.0, 9.0, 48.0, 9.0), 1.0, "has no area"),
        ("https://x.y/{lat}{lon}", (47.0, 9.0, 98.0, 10.0), 1.0, "within 90"),
        ("https://x.y/{lat}{lon}", (-90.0, -180.0, 90.0, 180.0), 1.0, "64800 tiles"),
        ("https://x.y/{lat}{lon}", BOX, 0.7, "into 180"),
        ("https://x.y/{lat}{lon}", BOX, 0.0, "> 0"),
    ],
)
def test_bad_questions(template: str, box: tuple[float, float, float, float], side: float, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        tiles(template, box, side)
    assert message in str(caught.value)


@pytest.mark.parametrize("more", [{"attempts": 0}, {"timeout_s": float("nan")}, {"timeout_s": 0.0}])
def test_bad_patience(server: Server, tmp_path: Path, more: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="expected a finite number"):
        fetched(server, tmp_path, **more)
    assert server.asked == []


def test_a_fetched_tile_opens(server: Server, tmp_path: Path) -> None:
    values = np.arange(12.0).reshape(3, 4) * 10.0 + 200.0
    source = tmp_path / "source.tif"
    from terranav.io.raster_out import write_map

    write_map(Map(values, (0.25, 0.0, 9.0, 0.0, -0.25, 48.0)), source)
    server.files["/47/9.tif"] = source.read_bytes()
    (one,) = fetch_tiles(f"{server.url}/{{lat}}/{{lon}}.tif", BOX, tmp_path / "cache")
    assert one.file is not None
    np.testing.assert_array_equal(tn.open_map(one.file).values, values)
