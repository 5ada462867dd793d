"""The file of a detector's networks: where it lies, whether it is whole, and how it is fetched.

MediaPipe's package brings no model. `find_model` takes the file that was given, else that of the
cache folder, else asks on a terminal whether to fetch it. Nothing is fetched without being asked.
`download_model` checks the size, and the hash that the server states; it keeps the SHA-256 beside
the file, which is compared whenever the file is used.
"""

from __future__ import annotations

import base64
import hashlib
import os
import sys
import urllib.request
import zipfile
from pathlib import Path
from typing import NamedTuple

from torchcss.errors import DetectorError
from torchcss.files import prepare_output_folder, replace_file, write_text

NETWORKS = ("pose_detector.tflite", "pose_landmarks_detector.tflite")
"""What a bundle of MediaPipe's holds."""

_TIMEOUT_S = 60.0


class Source(NamedTuple):
    """Where a model is published.

    Attributes:
        url: Its address.
        size: Bytes.
        licence: What it may be used under.
    """

    url: str
    size: int
    licence: str


OFFICIAL = Source(
    "https://storage.googleapis.com/mediapipe-models/pose_landmarker/pose_landmarker_full/float16/"
    "1/pose_landmarker_full.task",
    9_398_198,
    "Apache-2.0, Google",
)


def model_folder() -> Path:
    """Where fetched models lie: `TORCHCSS_CACHE`, else the user's cache folder."""
    given = os.environ.get("TORCHCSS_CACHE")
    if given:
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchcss"


def find_model(given: Path | None, source: Source = OFFICIAL) -> Path:
    """The model to use.

    Args:
        given: The file, if the user says it.
        source: Where it can be had.

    Raises:
        DetectorError: If there is none, or the file is not a model.
    """
    if given is not None:
        return check_model(given)
    kept = model_folder() / Path(source.url).name
    if kept.is_file():
        return check_model(kept)
    if sys.stdin.isatty() and sys.stderr.isatty():
        print(
            f"The detector of keypoints needs a model that is not on this computer:\n"
            f"  what     MediaPipe pose landmarker, {source.size / 1e6:.1f} MB, {source.licence}\n"
            f"  from     {source.url}\n"
            f"  to       {kept}\n"
            "Fetch it now? [y/N] ",
            end="",
            file=sys.stderr,
            flush=True,
        )
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return download_model(source)
    raise DetectorError(
        f"no model of the detector in {kept.parent}; `torchcss detect --download-model` fetches it "
        f"({source.size / 1e6:.1f} MB, {source.licence}), or give a file with --detector-model"
    )


def download_model(source: Source = OFFICIAL) -> Path:
    """Fetch a model into the cache folder, and say what was kept.

    Raises:
        DetectorError: If it cannot be fetched, or is not what was announced.
        OutputError: If it cannot be written.
    """
    path = prepare_output_folder(model_folder()) / Path(source.url).name
    try:
        with urllib.request.urlopen(source.url, timeout=_TIMEOUT_S) as answer:
            # A byte more than it should be tells that it is longer.
            data, stated = answer.read(source.size + 1), answer.headers.get_all("x-goog-hash") or []
    except (OSError, ValueError) as error:
        raise DetectorError(
            f"{source.url}: cannot be fetched ({error}); fetch it by other means and give it with "
            "--detector-model"
        ) from error
    if len(data) != source.size:
        more = "more" if len(data) > source.size else str(len(data))
        raise DetectorError(f"{source.url}: expected {source.size} bytes, got {more}")
    sums = [part.strip() for line in stated for part in line.split(",")]
    md5 = base64.b64encode(hashlib.md5(data, usedforsecurity=False).digest()).decode()
    if any(each.startswith("md5=") and each != f"md5={md5}" for each in sums):
        raise DetectorError(f"{source.url}: damaged on the way: its MD5 is not the server's")
    digest = hashlib.sha256(data).hexdigest()
    with replace_file(path) as partial:
        partial.write_bytes(data)
        check_model(partial)
    write_text(_sum_of(path), f"{digest}  {path.name}\n")
    print(f"{path}: {len(data)} bytes, SHA-256 {digest}", file=sys.stderr)
    return path


def check_model(path: Path) -> Path:
    """Refuse a file that does not hold the two networks, or is not the one that was fetched.

    Raises:
        DetectorError: With what was expected and found.
    """
    try:
        kept, digest = _sum_of(path), hashlib.sha256(path.read_bytes()).hexdigest()
        if kept.is_file() and kept.read_text().split()[0] != digest:
            raise DetectorError(f"{path}: its SHA-256 is not that of {kept}; fetch it again")
        with zipfile.ZipFile(path) as bundle:
            lacking = sorted({*NETWORKS} - {*bundle.namelist()})
            damaged = None if lacking else bundle.testzip()
    except (OSError, zipfile.BadZipFile, IndexError, UnicodeDecodeError) as error:
        raise DetectorError(
            f"{path}: not a model that can be read ({error}); expected MediaPipe's pose_landmarker "
            "bundle (.task)"
        ) from error
    if lacking or damaged:
        what = f"it lacks {', '.join(lacking)}" if lacking else f"{damaged} is damaged"
        raise DetectorError(f"{path}: expected MediaPipe's pose_landmarker bundle (.task): {what}")
    return path


def _sum_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")
