"""Bytes and lines of files that somebody else wrote, with one error that names file and place.

Whatever is wrong with a file ends in the error class that the caller names, in one line. Formats
above these build on it: `torchcss.io.safe_load` JSON and NPZ, `torchcss.body.bvh_text` and
`torchcss.io.motion_parsers` motion capture, `torchcss.body.skeletons` the bodies of other programs.

Call `read_bytes`, `read_text` or `read_lines`.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from torchcss.errors import TorchcssError


class Line(NamedTuple):
    """A line that is not empty, and where it stands.

    Attributes:
        number: From 1.
        words: What spaces separate.
    """

    number: int
    words: list[str]


def read_bytes(path: Path, error_class: type[TorchcssError], size: int = -1) -> bytes:
    """The content of a file, or its first `size` bytes.

    Raises:
        error_class: If the file is missing, empty, a folder or cannot be read.
    """
    try:
        if path.is_dir():
            raise error_class(f"{path}: expected a file, found a folder")
        with path.open("rb") as stream:
            data = stream.read(size)
    except FileNotFoundError as error:
        raise error_class(f"{path}: there is no such file; check the path") from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        if isinstance(error, error_class):
            raise
        raise error_class(f"{str(path)!r}: cannot be read: {one_line(error)}") from error
    if not data:
        raise error_class(f"{path}: the file is empty")
    return data


def read_text(path: Path, error_class: type[TorchcssError]) -> str:
    """The content of a text file in UTF-8, with or without the mark that Windows puts first.

    Raises:
        error_class: As `read_bytes`, or if it is no such text; the message names the line.
    """
    data = read_bytes(path, error_class)
    bad = data.find(b"\0")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        bad, text = error.start, ""
    if bad >= 0:
        line = data.count(b"\n", 0, bad) + 1
        raise error_class(f"{path}: line {line}: not text in UTF-8; save the file in that encoding")
    return text


def read_lines(path: Path, error_class: type[TorchcssError]) -> list[Line]:
    """The lines of a text file that hold anything, in words.

    Raises:
        error_class: As `read_text`, or if there is no such line.
    """
    text = read_text(path, error_class)
    # Not splitlines: it breaks at signs that editors do not count as lines.
    rows = enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), start=1)
    lines = [Line(number, words) for number, row in rows if (words := row.split())]
    if not lines:
        raise error_class(f"{path}: the file is empty")
    return lines


def one_line(error: BaseException) -> str:
    """What an exception says, in one short line."""
    return " ".join(str(error).split())[:120] or type(error).__name__


def shortened(value: object) -> str:
    """A piece of a file for a message, in one short line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
