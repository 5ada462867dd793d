"""Files that are either whole or not there, and one wording for a disk that will not take them.

A track runs for minutes and may be stopped at any moment. Every file is therefore written beside
its final name and moved there in one step, so that a reader never meets half a file and a good file
is never lost to a bad end. What the operating system refuses becomes an `OutputError` that says
what to do.

Call `replace_file` as a context to write one file, `prepare_output_folder` before a long run.
"""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from torchcss.errors import OutputError

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


def output_error(path: Path, error: OSError) -> OutputError:
    """Return the `OutputError` that tells a user why `path` could not be written.

    Args:
        path: The file or folder that was wanted.
        error: What the operating system, or FFmpeg on its behalf, reported.
    """
    advice = _ADVICE.get(
        error.errno or 0, f"{error.strerror or error}; choose another folder with --out"
    )
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


def temporary_name(path: Path) -> Path:
    """Return the name beside `path` under which this process writes before it moves the file."""
    return path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")


def prepare_output_folder(path: str | os.PathLike[str]) -> Path:
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
