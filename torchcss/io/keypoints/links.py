"""Keypoints named as a body's file names its links: those of a robot, or of an animal.

`torchcss.body.model.BodyModel.joint_of_name` says what the file of a body calls its joints. Case,
spaces, dots and dashes do not matter. A file that names joints as a detector of people does is not
taken for one that names links, though a skeleton may have links of such names that are elsewhere:
`LeftShoulder` is often the collar bone's.

Call `names_links`, then `joints_named`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from torchcss.joint_names import layout_of_names

Links = Mapping[str, str]
"""Joint of a body by what the body's file calls it; none for a body that ships."""


def names_links(names: tuple[str, ...], links: Links) -> bool:
    """Whether a file's names are rather those of a body's links than a detector's of people.

    Args:
        names: What the file calls its joints.
        links: What the body's file calls its joints.
    """
    found = sum(joint is not None for joint in joints_named(names, links))
    people = sum(joint is not None for joint in layout_of_names(names))
    return found > people or (found > 0 and set(names) <= set(links))


def joints_named(names: tuple[str, ...], links: Links) -> tuple[str | None, ...]:
    """The body's joint of every name, each once; None: it has none of that name.

    Args:
        names: What the file calls its joints.
        links: What the body's file calls its joints.
    """
    by_word: dict[str, str | None] = {}
    for name, joint in links.items():
        # Two links that differ in case or separators alone are told apart by exact names only.
        by_word[_word(name)] = joint if by_word.get(_word(name), joint) == joint else None
    found: list[str | None] = []
    for name in names:
        joint = links.get(name, by_word.get(_word(name)))
        found.append(None if joint in found else joint)
    return tuple(found)


def _word(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())
