"""The joints that other programs animate: named, of three turns each, in a tree.

A body of ours turns in many joints of one axis. Those that turn in one place are one joint of an
animated skeleton (swing, raising and twist are the shoulder), and the landmarks that are fixed in a
link (nose, toes, the base of the neck) are joints that never turn. Names and parents are H-Anim's.

Orientations are measured from the body's zero pose: standing, arms hanging, Y up, facing +Z.
`t_pose` holds the turns that lift the arms to the sides from there.

Call `make_skeleton`, then `node_poses` for every frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from torchcss.body.bases import pose_track
from torchcss.body.model import BodyModel
from torchcss.body.rotations import about
from torchcss.joint_names import by_word

# Where H-Anim hangs what we fix in the link below. Both ends turn alike, so only the picture of
# the bones differs.
_PARENTS = by_word(
    {
        "vt1": "l_sternoclavicular r_sternoclavicular l_shoulder r_shoulder vc7",
        "skullbase": "skull_tip nose l_eye r_eye l_ear r_ear",
        "l_midtarsal": "l_toe",
        "r_midtarsal": "r_toe",
        "l_wrist": "l_hand_tip",
        "r_wrist": "r_hand_tip",
    }
)

# Joints of the catalogue that carry no landmark at their place.
_NAMES = {
    f"{side}_clavicle_{motion}": f"{side}_sternoclavicular"
    for side in "lr"
    for motion in ("elevation", "protraction")
}


class Node(NamedTuple):
    """A joint of the skeleton.

    Attributes:
        name: Its name.
        parent: Its parent's position in the list, which is before its own; -1 for the root.
        link: The link that turns with it.
        point: Its place in that link's frame, metres.
    """

    name: str
    parent: int
    link: int
    point: tuple[float, float, float]


class Skeleton(NamedTuple):
    """The joints as a tree.

    Attributes:
        nodes: Parents before children, each followed by all that hangs on it.
    """

    nodes: tuple[Node, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes."""
        return tuple(node.name for node in self.nodes)

    @property
    def parents(self) -> tuple[int, ...]:
        """Parent of every node, -1 for the root."""
        return tuple(node.parent for node in self.nodes)


def make_skeleton(body: BodyModel) -> Skeleton:
    """Merge the joints of a body that turn in one place, and name them.

    Args:
        body: Any body; one from a URDF keeps all its joints, named by their links.
    """
    links, landmarks = body.tree.link_names, _landmarks(body)
    specifications = body.tree.specifications
    children = [joint.parent for joint in specifications]
    # The first landmark at a link's origin; and whether more hangs on the link than the next joint
    # at its origin.
    name_at = {link: name for name, link, point in reversed(landmarks) if not any(point)}
    busy = {link: any(any(point) for _, on, point in landmarks if on == link) for link in links}

    nodes: list[Node] = []
    named: list[bool] = []
    owner: dict[str, int] = {}
    coincident: dict[str, bool] = {}  # the link's origin is its node's place
    for joint in specifications:
        link, above = joint.link, joint.parent
        busy[link] |= children.count(link) > 1
        own_name = name_at.get(link)
        node = Node(
            own_name or _NAMES.get(joint.name, joint.name), -1, links.index(link), (0, 0, 0)
        )
        if above is None:
            owner[link], coincident[link] = 0, True
            nodes.append(node)
            named.append(own_name is not None)
            continue
        at = owner[above]
        here = coincident[above] and bool(np.allclose(joint.translation, 0, atol=1e-9))
        turns = joint.kind == "revolute"
        # The root may also travel; a joint below it that does keeps its parent's orientation.
        joins = here and not busy[above] and not (named[at] and own_name)
        if joint.kind == "fixed" or (not turns and not (joins and at == 0)):
            owner[link], coincident[link] = at, here and joint.kind == "fixed"
            busy[link] |= coincident[link] and busy[above]
            if coincident[link] and own_name and not named[at]:
                nodes[at], named[at] = nodes[at]._replace(name=own_name), True
        elif joins:
            name = nodes[at].name if named[at] else node.name
            nodes[at] = node._replace(name=name, parent=nodes[at].parent)
            named[at] = named[at] or own_name is not None
            owner[link], coincident[link] = at, True
        else:
            owner[link], coincident[link] = len(nodes), True
            nodes.append(node._replace(parent=at))
            named.append(own_name is not None)
    used = {node.name for node, has in zip(nodes, named, strict=True) if has}
    for name, link, point in landmarks:
        if name not in used:
            used.add(name)
            nodes.append(Node(name, owner[link], links.index(link), point))
    return _ordered(nodes)


def _landmarks(body: BodyModel) -> list[tuple[str, str, tuple[float, float, float]]]:
    """Name, link and place in its frame of every named joint centre."""
    links = [body.tree.link_names[link] for link in body.marker_link.tolist()]
    points = map(tuple, body.marker_offset.tolist())
    return list(zip(body.joint_names, links, points, strict=True))


def _ordered(nodes: Sequence[Node]) -> Skeleton:
    """Hang the nodes where H-Anim does, and put each before all that hangs on it."""
    place = {node.name: index for index, node in enumerate(nodes)}
    parents = [node.parent for node in nodes]
    for index, node in enumerate(nodes):
        wanted = place.get(_PARENTS.get(node.name, ""))
        # Only if it turns with the parent that the node has: a free clavicle keeps its shoulder.
        if wanted is not None and nodes[wanted].parent == node.parent:
            parents[index] = wanted
    order: list[int] = []

    def visit(index: int) -> None:
        order.append(index)
        for child, parent in enumerate(parents):
            if parent == index:
                visit(child)

    visit(0)
    rank = {old: new for new, old in enumerate(order)} | {-1: -1}
    return Skeleton(tuple(nodes[old]._replace(parent=rank[parents[old]]) for old in order))


def node_poses(
    skeleton: Skeleton,
    body: BodyModel,
    state: Float[np.ndarray, "t n"],
    base: Float[np.ndarray, "t 4 4"],
) -> tuple[Float[np.ndarray, "t nodes 3 3"], Float[np.ndarray, "t nodes 3"]]:
    """Orientations, from the zero pose, and places of the nodes.

    Args:
        skeleton: From `make_skeleton`.
        body: The same body, on the origin.
        state: States.
        base: Base transforms, in the frame that is wanted.

    Returns:
        Orientations and, in metres, places.
    """
    tree = pose_track(body, torch.from_numpy(state), torch.from_numpy(base)).tree
    zero = body.tree.link_poses(body.offset)[:, :3, :3]
    link = [node.link for node in skeleton.nodes]
    point = torch.tensor([node.point for node in skeleton.nodes], dtype=torch.float64)
    rotation = tree.rotation[:, link]
    place = (rotation @ point[:, :, None])[..., 0] + tree.translation[:, link]
    return (rotation @ zero[link].mT).numpy(), place.numpy()


def t_pose(skeleton: Skeleton) -> Float[np.ndarray, "nodes 3 3"]:
    """Orientations of the nodes in the T-pose: arms to the sides, palms down; empty of other turns.

    Args:
        skeleton: A skeleton with a shoulder, else nothing is turned.
    """
    turns = np.tile(np.eye(3), (len(skeleton.nodes), 1, 1))
    angles = {"l_shoulder": np.pi / 2, "r_shoulder": -np.pi / 2}
    for index, node in enumerate(skeleton.nodes):
        if node.name in angles:
            turns[index] = about(2, np.array(angles[node.name]))
        elif node.parent >= 0:
            turns[index] = turns[node.parent]
    return turns
