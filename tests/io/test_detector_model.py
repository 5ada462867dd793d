"""The model's file: found, asked for, fetched from a server of this test's own, and checked."""

from __future__ import annotations

import base64
import hashlib
import io
import sys
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from torchcss.cli import main as cli
from torchcss.errors import DetectorError
from torchcss.io.detector_model import NETWORKS, Source, check_model, download_model, find_model


def bundle(*names: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names or NETWORKS:
            archive.writestr(name, b"network " * 100)
    return buffer.getvalue()


class Server(HTTPServer):
    """Serves one file, with the hash that it states, and counts."""

    data = bundle()
    stated: str | None = None
    asked = 0


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self.server.asked += 1
        self.send_response(200)
        if self.server.stated:
            self.send_header("x-goog-hash", "crc32c=abcd==")
            self.send_header("x-goog-hash", self.server.stated)
        self.end_headers()
        self.wfile.write(self.server.data)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    with Server(("127.0.0.1", 0), Handler) as made:
        thread = threading.Thread(target=made.serve_forever)
        thread.start()
        yield made
        made.shutdown()
        thread.join()


@pytest.fixture
def source(server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Source:
    monkeypatch.setenv("TORCHCSS_CACHE", str(tmp_path / "cache"))
    url = f"http://127.0.0.1:{server.server_port}/pose.task"
    return Source(url, len(server.data), "Apache-2.0")


def terminal(monkeypatch: pytest.MonkeyPatch, answer: str) -> None:
    class Typed(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdin", Typed(answer))
    monkeypatch.setattr(sys, "stderr", Typed())


def test_a_fetched_model_is_kept_with_its_hash(
    server: Server, source: Source, capsys: pytest.CaptureFixture[str]
) -> None:
    md5 = base64.b64encode(hashlib.md5(server.data).digest()).decode()
    server.stated = f"md5={md5}"
    path = download_model(source)
    digest = hashlib.sha256(server.data).hexdigest()
    assert path.read_bytes() == server.data
    assert digest in capsys.readouterr().err
    assert find_model(None, source) == path
    assert server.asked == 1
    path.write_bytes(bundle(*NETWORKS, "more"))  # changed since
    with pytest.raises(DetectorError, match="SHA-256"):
        find_model(None, source)


def test_what_is_not_as_announced_is_refused(server: Server, source: Source) -> None:
    server.stated = "md5=AAAA"
    with pytest.raises(DetectorError, match="MD5"):
        download_model(source)
    server.stated = None
    with pytest.raises(DetectorError, match=f"expected {source.size + 9} bytes, got {source.size}"):
        download_model(source._replace(size=source.size + 9))
    with pytest.raises(DetectorError, match="got more"):
        download_model(source._replace(size=100))
    server.data = bundle("pose_detector.tflite")
    with pytest.raises(DetectorError, match="lacks pose_landmarks_detector"):
        download_model(source._replace(size=len(server.data)))
    with pytest.raises(DetectorError, match="no model"):
        find_model(None, source)  # nothing was kept


def test_no_network_is_one_line(server: Server, source: Source) -> None:
    with pytest.raises(DetectorError, match=r"cannot be fetched.*--detector-model"):
        download_model(source._replace(url="http://127.0.0.1:9/pose.task"))


def test_without_a_terminal_nothing_is_fetched(server: Server, source: Source) -> None:
    with pytest.raises(DetectorError, match="torchcss detect --download-model"):
        find_model(None, source)
    assert server.asked == 0


@pytest.mark.parametrize(("answer", "fetched"), [("y\n", 1), ("\n", 0), ("no\n", 0), ("", 0)])
def test_on_a_terminal_it_asks(
    server: Server, source: Source, monkeypatch: pytest.MonkeyPatch, answer: str, fetched: int
) -> None:
    terminal(monkeypatch, answer)
    if fetched:
        assert find_model(None, source).is_file()
    else:
        with pytest.raises(DetectorError):
            find_model(None, source)
    assert server.asked == fetched
    said = sys.stderr.getvalue()  # type: ignore[attr-defined]
    assert source.url in said
    assert "Apache-2.0" in said
    assert "MB" in said


def test_a_file_that_is_no_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.task"
    for data in (b"", b"PK\3\4 cut", bundle()[:-30], bundle("other.tflite")):
        path.write_bytes(data)
        with pytest.raises(DetectorError, match=r"pose_landmarker"):
            check_model(path)
    with pytest.raises(DetectorError):
        check_model(tmp_path / "missing.task")


def test_the_verb_fetches(server: Server, source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchcss.cli.detect.download_model", lambda: download_model(source))
    assert cli.main(["detect", "--download-model"]) == 0
    assert server.asked == 1
    assert cli.main(["detect"]) == 2
