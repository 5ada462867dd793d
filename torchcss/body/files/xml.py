"""XML files of strangers, screened before a parser of robots sees them.

Call `parse_xml`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.parsers import expat

from torchcss.errors import BodyError, TorchcssError
from torchcss.files import one_line, read_bytes

_MOST_BYTES = 50_000_000


def parse_xml(
    path: Path, what: str, error_class: type[TorchcssError] = BodyError
) -> ElementTree.Element:
    """The root element of an XML file.

    Args:
        path: The file.
        what: What the file should be, for messages.
        error_class: What to raise.

    Raises:
        error_class: If it cannot be read, is very large, declares entities, or does not parse.
    """
    data = read_bytes(path, error_class)
    if len(data) > _MOST_BYTES:
        raise error_class(
            f"{path}: {len(data):,} bytes; expected {what} of {_MOST_BYTES:,} at most"
        )

    def refuse(*_: object) -> None:
        raise error_class(f"{path}: declares XML entities, which {what} does not need; remove them")

    # Without name spaces, so that prefixes which nobody declares are part of the name.
    parser, tree = expat.ParserCreate(), ElementTree.TreeBuilder()
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = tree.start
    parser.EndElementHandler = tree.end
    parser.CharacterDataHandler = tree.data
    try:
        parser.Parse(data, True)
        return tree.close()
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, error_class):
            raise
        raise error_class(
            f"{path}: not {what}, the XML does not parse ({one_line(error)})"
        ) from error
