"""The elements of MATLAB's files of version 5, looked through before SciPy reads them.

SciPy ends the process, which no `except` catches, where an element has a type that is none, where
text has no dimensions, and where matrices are nested too deep; it takes memory for as many items
as the dimensions say, and time by the square of the number of a structure's fields.

The format is of MathWorks' "MAT-File Format": https://www.mathworks.com/help/pdf_doc/matlab/.
"""

from __future__ import annotations

import math
import struct
import zlib

MOST_UNPACKED = 2**26
"""Bytes of the largest calibration, unpacked; MATLAB's hold the pictures' corners too."""

_MOST_LEVELS = 32
_MOST_FIELDS = 1000

_PACKED, _MATRIX = 15, 14
_PLAIN = {*range(1, 8), 9, 12, 13, 16, 17, 18}
"""Types of elements that hold numbers or signs."""

_CELLS, _STRUCTURE, _OBJECT, _TEXT, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_NUMBERS = range(6, 16)


def check_mat_elements(data: bytes) -> None:
    """Refuse a file of version 4 or 5 that SciPy cannot read safely.

    Args:
        data: The file. One of version 4 has no elements: only its size is looked at.

    Raises:
        ValueError: If an element is none of the format's, or ends after what holds it; if there is
            more of anything than in a calibration. What is damaged raises others too.
    """
    order = "<" if data[126:128] == b"IM" else ">"  # as SciPy tells it
    at, total = len(data) if 0 in data[:4] else 128, 0
    while at + 8 <= len(data) and total < MOST_UNPACKED:
        kind, size = struct.unpack_from(f"{order}II", data, at)
        variable, at = memoryview(data)[at : at + 8 + size], at + 8 + size
        if kind == _PACKED:
            variable = memoryview(zlib.decompressobj().decompress(variable[8:], MOST_UNPACKED))
        total += len(variable)
        if max(total, len(data)) < MOST_UNPACKED:
            _Variable(variable, order).matrix(_MOST_LEVELS)
    if max(total, len(data)) >= MOST_UNPACKED:
        raise ValueError(f"more than {MOST_UNPACKED:,} bytes; not a calibration")


class _Variable:
    """What holds a variable, gone through in SciPy's order, which heeds no matrix's own size."""

    def __init__(self, data: memoryview, order: str) -> None:
        self._data, self._order, self._at = data, order, 0

    def matrix(self, levels: int) -> None:
        """Go on to the end of a matrix, in which others are nested in fewer than `levels`."""
        kind, size = self._numbers("I", self._take(8))
        if kind != _MATRIX or not levels:
            raise ValueError(f"an element of type {kind}, not a matrix, or nested too deep")
        if not size and levels < _MOST_LEVELS:  # empty; SciPy reads on in the outermost
            return
        flags = self._numbers("I", self._take(16))[2]
        form, num_parts = flags & 0xFF, 1 + (flags >> 11 & 1)  # of complex numbers two
        count = 1 if form == _OPAQUE else self._count(form)
        self._element()  # the name
        num_elements = {_TEXT: 1, _SPARSE: 2 + num_parts, _OPAQUE: 2}.get(form, 0)
        if form in (_STRUCTURE, _OBJECT):
            count *= self._num_fields(form)
        elif form in _NUMBERS:
            num_elements = num_parts
        elif form not in (_CELLS, _TEXT, _SPARSE, _FUNCTION, _OPAQUE):
            raise ValueError(f"a matrix of class {form}")
        for _ in range(num_elements):
            self._element()
        if form in (_CELLS, _STRUCTURE, _OBJECT, _FUNCTION, _OPAQUE):
            for _ in range(1 if form == _FUNCTION else count):
                self.matrix(levels - 1)

    def _count(self, form: int) -> int:
        """The number of items, by the dimensions."""
        shape = self._numbers("i", self._element())
        most = math.inf if form == _SPARSE else len(self._data)
        count = math.prod(shape[:-1] if form == _TEXT else shape)  # of text, that of lines too
        if not shape or min(shape) < 0 or max(count, math.prod(shape)) > most:
            raise ValueError(f"a matrix of shape {list(shape)} in {len(self._data):,} bytes")
        return count

    def _num_fields(self, form: int) -> int:
        """The number of a structure's fields; their names have all the same length."""
        if form == _OBJECT:
            self._element()  # the class
        width, names = self._numbers("i", self._element())[0], self._element()
        if width < 1 or len(names) // width > _MOST_FIELDS:
            raise ValueError(f"{len(names):,} bytes of fields' names, each of {width}")
        return len(names) // width

    def _element(self) -> memoryview:
        """The content of the next element, which holds no others."""
        tag = self._take(8)
        kind, size = self._numbers("I", tag)
        small = kind >> 16  # then it is the size, and the content lies in the tag
        if small:
            kind, content = kind & 0xFFFF, tag[4 : 4 + small]
        else:
            content = self._take(size)
            self._at += -size % 8
        if kind not in _PLAIN or small > 4:
            raise ValueError(f"an element of type {kind}")
        return content

    def _take(self, size: int) -> memoryview:
        """The next bytes."""
        taken, self._at = self._data[self._at : self._at + size], self._at + size
        if len(taken) < size:
            raise ValueError("an element ends after what holds it")
        return taken

    def _numbers(self, kind: str, content: memoryview) -> tuple[int, ...]:
        """The integers of four bytes in this."""
        num = len(content) // 4
        return struct.unpack_from(f"{self._order}{num}{kind}", content)
