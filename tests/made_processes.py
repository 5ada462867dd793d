"""Processes of their own that begin at once: forked from one that has the package already.

Importing it takes a process seconds. What depends on how a process starts (a variable that is read
at the import, say) needs `subprocess` all the same.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import traceback
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import NamedTuple

import torch

import torchcss.app.batch
import torchcss.cli.main  # noqa: F401

SERVED = multiprocessing.get_context("spawn" if sys.platform == "win32" else "forkserver")
SERVED.set_forkserver_preload(["made_processes"])


class Begun(NamedTuple):
    """A process that runs a program, and what it tells."""

    process: BaseProcess
    told: Connection

    def end(self) -> int:
        """Wait for the end; how it ended, as `subprocess` says it."""
        self.process.join()
        assert self.process.exitcode is not None
        return self.process.exitcode


def begin(program: str, *arguments: str, **variables: str) -> Begun:
    """Run a program in a process with as many threads as this one.

    Args:
        program: Python's, with the functions `tell` and `hear`: what they send and receive is at
            the other end of `Begun.told`, and so is the traceback of a program that fails.
        arguments: The program's `sys.argv[1:]`.
        variables: More variables of its environment.
    """
    here, there = multiprocessing.Pipe()
    given = program, arguments, {**os.environ, **variables}, torch.get_num_threads(), there
    process = SERVED.Process(target=_run, args=given, daemon=True)
    process.start()
    there.close()
    return Begun(process, here)


def _run(
    program: str, arguments: tuple[str, ...], variables: dict[str, str], threads: int,
    there: Connection,
) -> None:  # fmt: skip
    os.environ.clear()
    os.environ.update(variables)
    torch.set_num_threads(threads)
    sys.argv[1:] = arguments
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    try:
        exec(program, {"__name__": "__main__", "tell": there.send, "hear": there.recv})
    except Exception:
        there.send(traceback.format_exc())
        raise
