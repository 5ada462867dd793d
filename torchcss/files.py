"""Read and write whole files, one typed error."""

from __future__ import annotations

import errno
import json
import math
import os
import reprlib
import tempfile
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from torchcss.errors import OutputError, TorchcssError

StrPath = str | os.PathLike[str]
"""A path in any form."""

_PICKLED = "it holds pickled objects, which could run a programme; save plain arrays"

_ROWS = 64
"""Rows of an array that are copied at a time."""

_ADVICE = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder with --out",
    errno.EDQUOT: "your disk quota is used up; free some space or choose another folder with --out",
    errno.EFBIG: "the file is larger than this system allows; choose another folder with --out",
    errno.EACCES: "you may not write here; choose another folder with --out",
    errno.EPERM: "you may not write here; choose another folder with --out",
    errno.EROFS: "the file system is read-only; choose another folder with --out",
    errno.ENOTDIR: "part of the path is a file, not a folder; choose another folder with --out",
    errno.EEXIST: "a file is in the way; move it or choose another folder with --out",
    errno.EISDIR: "a folder is in the way; move it or choose another folder with --out",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
}


def output_error(path: Path, error: Exception) -> OutputError:
    """Return the `OutputError` that tells a user why `path` could not be written.

    Args:
        path: The file or folder that was wanted.
        error: What the operating system, or FFmpeg on its behalf, reported.
    """
    other = f"{one_line(error)}; choose another folder with --out"
    advice = _ADVICE.get(getattr(error, "errno", None) or 0, other)
    return OutputError(f"{path}: cannot be written: {advice}")


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Give a temporary name in the folder of `path`; move it to `path` if the body succeeds.

    The temporary name has the same suffix, so that a writer that chooses its format by the suffix
    is not misled. If the body fails, the temporary file goes and `path` stays as it was.

    Args:
        path: The final name.

    Yields:
        The name to write to; the body must close the file.

    Raises:
        OutputError: If the operating system refuses.
    """
    partial = temporary_name(path)
    try:
        yield partial
        with partial.open("rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(partial, path)
    except OutputError:
        raise
    except OSError as error:
        raise output_error(path, error) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def save_arrays(path: Path, arrays: Mapping[str, Any], *, compressed: bool = False) -> None:
    """Write an NPZ file whole or not at all.

    Args:
        path: The file.
        arrays: Arrays by name, or what NumPy makes arrays of.
        compressed: For large arrays of few values, such as masks; it takes time.

    Raises:
        OutputError: If it cannot be written.
    """
    plain: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    # Of a path NumPy would change the name, where that does not end in .npz.
    with replace_file(path) as partial, partial.open("wb") as stream:
        (np.savez_compressed if compressed else np.savez)(stream, **plain)


def extend_arrays(path: Path, arrays: Mapping[str, Any], fill: Mapping[str, float]) -> None:
    """Write an NPZ file whole or not at all, in which some arrays go on from where they were.

    The file is copied piece by piece, so that its size takes no memory.

    Args:
        path: The file, as `save_arrays` or this wrote it.
        arrays: Arrays by name, or what NumPy makes arrays of.
        fill: Those of them that are added to the file's own along the first axis, and what stands
            where the one has a shorter second axis than the other. The rest is replaced.

    Raises:
        OutputError: If it cannot be written, or the file is no longer what it was.
    """
    with replace_file(path) as partial:
        try:
            with zipfile.ZipFile(path) as old, zipfile.ZipFile(partial, "w") as new:
                for name, value in arrays.items():
                    member = f"{name}.npy"
                    with new.open(member, "w", force_zip64=True) as target:
                        if name not in fill:
                            np.lib.format.write_array(target, np.asarray(value), allow_pickle=False)
                            continue
                        with old.open(member) as source:
                            _extend(source, np.asarray(value), fill[name], target)
        except (zipfile.BadZipFile, KeyError, ValueError) as error:
            raise OutputError(f"{path}: changed by somebody else: {one_line(error)}") from error


def _extend(source: IO[bytes], rows: np.ndarray, fill: float, target: IO[bytes]) -> None:
    """Copy the array of an NPY file and add rows to it."""
    header = array_header(source)
    if header is None or header[1] != rows.dtype or header[0][2:] != rows.shape[2:]:
        raise ValueError(f"expected an array to which {rows.dtype} {list(rows.shape)} can be added")
    num, *rest = header[0]
    width = max([*rest[:1], *rows.shape[1:2]], default=0)
    shape = (num + len(rows), *([width] if rest else []), *rest[1:])
    plain = {"descr": np.lib.format.dtype_to_descr(rows.dtype), "fortran_order": False}
    np.lib.format.write_array_header_1_0(target, {**plain, "shape": shape})
    size = math.prod(rest) * rows.dtype.itemsize
    for begin in range(0, num, _ROWS):
        count = min(_ROWS, num - begin)
        block = np.frombuffer(source.read(count * size), rows.dtype).reshape(count, *rest)
        target.write(_widened(block, width, fill).tobytes())
    target.write(_widened(rows, width, fill).tobytes())


def _widened(rows: np.ndarray, width: int, fill: float) -> np.ndarray:
    """Rows with a second axis of this length."""
    if rows.ndim == 1 or rows.shape[1] == width:
        return rows
    wide = np.full((len(rows), width, *rows.shape[2:]), fill, dtype=rows.dtype)
    wide[:, : rows.shape[1]] = rows
    return wide


def write_text(path: Path, text: str) -> None:
    r"""Write a text file in UTF-8 whole or not at all, its lines ended by `\n` everywhere.

    Signs of a file's name that are none of UTF-8, as Linux has them, are written as `\udcff`.

    Raises:
        OutputError: If it cannot be written.
    """
    with replace_file(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


def temporary_name(path: Path) -> Path:
    """A new name beside `path` to write under; two machines may have processes of one number."""
    return path.with_name(f".{path.stem}.{uuid.uuid4().hex}.partial{path.suffix}")


def make_paths(record: Any) -> None:
    """Make paths of the strings that a frozen record of choices was given for its files."""
    for each in fields(record):
        value = getattr(record, each.name)
        if isinstance(value, str) and str(each.type).startswith("Path"):
            object.__setattr__(record, each.name, Path(value))


def prepare_output_folder(path: StrPath) -> Path:
    """Create an output folder and make sure that it can be written, before any work is done.

    Args:
        path: The folder; missing parents are created.

    Returns:
        The folder as a `Path`.

    Raises:
        OutputError: If it cannot be created, is a file, or does not let a file be written.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Permissions alone do not tell: read-only mounts and quotas show when a file is written.
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".torchcss-") as probe:
            probe.write(b"\0" * 4096)
            probe.flush()
    except OSError as error:
        raise output_error(folder, error) from error
    except ValueError as error:  # a null character in the name
        raise OutputError(f"{str(path)!r}: not a folder name: {error}") from error
    return folder


class Line(NamedTuple):
    """A line that is not empty, and where it stands.

    Attributes:
        number: From 1.
        words: What spaces separate.
    """

    number: int
    words: list[str]


MOST_TEXT, MOST_ARRAYS = 2**30, 2**32
"""Bytes of the largest file that is read whole, and of the largest set of arrays."""


def read_bytes(path: Path, error_class: type[TorchcssError], size: int = -1) -> bytes:
    """The content of a file, or its first `size` bytes.

    Raises:
        error_class: If the file is missing, empty, huge, a folder or cannot be read.
    """
    try:
        if path.is_dir():
            raise error_class(f"{path}: expected a file, found a folder")
        if size < 0 and (length := path.stat().st_size) > MOST_TEXT:
            raise error_class(f"{path}: {length:,} bytes; expected {MOST_TEXT:,} at most")
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
    """The content of a text file in UTF-8, or in what the mark says that Windows puts first.

    Raises:
        error_class: As `read_bytes`, or if it is no such text; the message names the line.
    """
    data = read_bytes(path, error_class)
    is_wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    bad = -1 if is_wide else data.find(b"\0")
    try:
        text = data.decode("utf-16" if is_wide else "utf-8-sig")
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


@contextmanager
def naming(path: object, error_class: type[TorchcssError]) -> Iterator[None]:
    """Put the path before the message of an error that does not begin with it."""
    try:
        yield
    except error_class as error:
        begins = (f"{path}{sign}" for sign in (":", "#", "[", os.sep))
        if str(error).startswith((*begins, repr(str(path)))):
            raise
        raise error_class(f"{path}: {error}") from error


@contextmanager
def refusing(error_class: type[TorchcssError], what: str, *, advice: str = "") -> Iterator[None]:
    """Say in one typed error of one line whatever a library raises for a damaged file.

    Args:
        error_class: The error; those of this class pass as they are.
        what: The file, and what it is not, before the library's reason.
        advice: What to do, after it.

    Raises:
        error_class: If the body raises anything.
    """
    try:
        yield
    except error_class:
        raise
    except Exception as error:
        advised = f"; {advice}" if advice else ""
        raise error_class(f"{what}: {one_line(error)}{advised}") from error


def unexpected(
    error_class: type[TorchcssError], where: object, expected: str, found: object
) -> TorchcssError:
    """The error for a place in a file that holds something else than it should.

    Args:
        error_class: The error.
        where: The place; empty: the whole file, whose name is put before the message elsewhere.
        expected: What should be there.
        found: What is there.
    """
    place = f"{where}: " if where else ""
    return error_class(f"{place}expected {expected}, found {shortened(found)}")


def one_line(error: BaseException | str) -> str:
    """What an exception says, in one short line; of the system's without number and path."""
    said = getattr(error, "strerror", None) or error
    return " ".join(str(said).split())[:120] or type(error).__name__


_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxdict, _SHORT.maxlist, _SHORT.maxtuple = 4, 6, 12, 12
_SHORT.maxstring = _SHORT.maxother = 70


def shortened(value: object) -> str:
    """A piece of a file for a message, in one short line, however deep it is."""
    text = " ".join(_SHORT.repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


_DEEPEST = 50
"""Levels of a JSON file."""


def load_json(path: Path, error_class: type[TorchcssError]) -> Any:
    """Return the content of a JSON file.

    Raises:
        error_class: If the file is missing, empty, unreadable, not JSON, or nested so deeply that
            readers would fail on it.
    """
    data = read_bytes(path, error_class)
    with refusing(error_class, f"{path}: not a JSON file"):
        try:
            content = json.loads(data)
        except ValueError:
            if path.suffix.lower() == ".json":
                raise
            raise error_class(
                f"{path}: not a JSON file, nor of another format that is read; docs/guide.md lists "
                "them"
            ) from None
    if not _is_shallow(content):
        raise error_class(f"{path}: nested more than {_DEEPEST} levels deep, as no format is")
    return content


def _is_shallow(content: Any) -> bool:
    """Whether nothing is nested more than `_DEEPEST` levels deep."""
    level = [content]
    for _ in range(_DEEPEST):
        level = [
            each
            for within in level
            if isinstance(within, (dict, list))
            for each in (within.values() if isinstance(within, dict) else within)
            if isinstance(each, (dict, list))
        ]
        if not level:
            return True
    return False


def load_arrays(
    path: Path, error_class: type[TorchcssError], most: int | None = None
) -> Mapping[str, np.ndarray]:
    """Return all arrays of an NPZ file, in memory.

    Args:
        path: The file.
        error_class: What to raise.
        most: Bytes that they may have together; None: `MOST_ARRAYS`.

    Raises:
        error_class: If the file is missing, damaged, no NPZ file, or holds pickled objects.
    """
    if not read_bytes(path, error_class, 4).startswith(b"PK"):
        raise error_class(f"{path}: not an NPZ file; expected what numpy.savez writes")
    try:
        # The stream is ours: NumPy does not close its own where the archive turns out damaged.
        _check_sizes(path, MOST_ARRAYS if most is None else most)
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # zipfile, zlib and NumPy raise a dozen kinds for damaged archives
        advice = "" if str(error) == _PICKLED else "; get a complete copy"
        reason = f"{one_line(error)}{advice}"
        raise error_class(f"{path}: cannot be read as an NPZ file: {reason}") from error


def _check_sizes(path: Path, most: int) -> None:
    """Refuse arrays that would take more memory than the file can fill, before any is taken.

    Raises:
        ValueError: If they would.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if (total := sum(member.file_size for member in members)) > most:
            raise ValueError(f"{total:,} bytes of arrays; expected {most:,} at most")
        for member in members:
            with archive.open(member) as stream:
                _check_header(stream, member.file_size)


def array_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype] | None:
    """Shape and type of the NPY file that begins in a stream; None: of a version unknown here."""
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    read = readers.get(np.lib.format.read_magic(stream))
    if read is None:
        return None
    shape, _, dtype = read(stream)
    return shape, dtype


def _check_header(stream: IO[bytes], size: int) -> None:
    """Refuse an array of objects, or whose heading says more numbers than there are bytes."""
    header = array_header(stream)
    if header is None:
        return  # NumPy says what is wrong
    shape, dtype = header
    if dtype.hasobject:
        raise ValueError(_PICKLED)
    if math.prod(shape) * max(dtype.itemsize, 1) > size:
        raise ValueError(f"its heading says {list(shape)} of {dtype}, which is more than it holds")


def load_array(path: Path, error_class: type[TorchcssError]) -> np.ndarray:
    """Return the array of an NPY file.

    Raises:
        error_class: If the file is missing, damaged, no NPY file, or holds pickled objects.
    """
    if not read_bytes(path, error_class, 6).startswith(b"\x93NUMPY"):
        raise error_class(f"{path}: not an NPY file; expected what numpy.save writes")
    damaged = refusing(error_class, f"{path}: cannot be read as an NPY file")
    with damaged, path.open("rb") as stream:
        _check_header(stream, path.stat().st_size)
        stream.seek(0)
        return np.load(stream, allow_pickle=False)


def real_numbers(value: object, where: str, error_class: type[TorchcssError]) -> np.ndarray:
    """Return nested lists of numbers as a float64 array.

    Args:
        value: What JSON or TOML gave.
        where: The place in the file, for the message.
        error_class: What to raise.

    Raises:
        error_class: If it is ragged or holds anything but numbers.
    """
    try:
        if _only_numbers(value):
            return np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError, RecursionError):
        pass  # ragged, beyond the range of float64, or nested without end
    raise unexpected(error_class, where, "numbers", value)


def _only_numbers(value: object) -> bool:
    if isinstance(value, list):
        return all(_only_numbers(entry) for entry in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)
