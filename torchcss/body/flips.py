"""Forward-backward flips: the other poses whose joints project to the same places.

One camera sees the direction of a joint, not its depth. If the parent joint of a limb's segment is
known and the segment's length L, the line of sight of its far end meets the sphere of radius L
about the parent twice (Lee and Chen 1985): with the camera's centre as origin, P the parent and d
the unit vector along the line of sight, the far end is at `t d` with

    t = d . P +- sqrt(L^2 - |P|^2 + (d . P)^2)

that is, nearer or farther than the foot of the perpendicular from P. A body of m segments has 2^m
interpretations in the image of its joints (the kinematic tree of Lee and Chen; [IJRR] speaks of
thousands). Here the trunk, the line of the hips, the line of the shoulders and the head are
segments too. Whether joint limits allow a pose of this set, and which angles give it, is for an
optimiser to say (`torchcss.initialise`).

`Segments(body)` knows the segments of a body; `Segments.flip` moves the joints.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.joint_names import JOINT_NAMES

_TRUNK: dict[str, tuple[str, str]] = {
    "vt1": ("HumanoidRoot", "trunk"),
    "l_hip": ("HumanoidRoot", "hips"),
    "r_hip": ("HumanoidRoot", "hips"),
    "l_shoulder": ("vt1", "shoulders"),
    "r_shoulder": ("vt1", "shoulders"),
    "skull_tip": ("vt1", "head"),
    "nose": ("skull_tip", "head"),
}
_LIMBS = {
    "arm": ("shoulder", "elbow", "wrist", "hand_tip"),
    "leg": ("hip", "knee", "ankle", "toe"),
}


class Limb(NamedTuple):
    """One arm or leg.

    Attributes:
        name: "l_arm", "r_arm", "l_leg" or "r_leg".
        groups: Its segments' groups, from the trunk outwards.
        joint: The joint by which it hangs on the trunk.
        columns: Parameters of the state that move this limb and nothing else.
    """

    name: str
    groups: tuple[str, ...]
    joint: str
    columns: Int[Tensor, " c"]


class Segments:
    """The segments of a body that can flip.

    Args:
        body: A body with H-Anim names.

    Attributes:
        joint: The body's joint centres that take part, parents before children.
        groups: Names of the groups that flip as one, as both halves of hips and of shoulders do.
        trunk: Those of the trunk without the head.
        limbs: Arms and legs.
        depth: How many segments of a limb flip, from the trunk outwards. The hand of a body moves
            with its forearm; that of an arm has joints of its own.
    """

    def __init__(self, body: BodyModel) -> None:
        rows = {
            name: row for name, row in _TRUNK.items() if {name, row[0]} <= set(body.joint_names)
        }
        limbs: list[tuple[str, tuple[str, ...], str]] = []
        for side in ("l", "r"):
            for limb, chain in _LIMBS.items():
                names = [f"{side}_{place}" for place in chain]
                names = [name for name in names if name in body.joint_names]
                if len(names) < 2:
                    continue
                rows |= {child: (parent, child) for parent, child in pairwise(names)}
                limbs.append((f"{side}_{limb}", tuple(names[1:]), names[0]))
        children = list(rows)
        names = [n for n in dict.fromkeys(p for p, _ in rows.values()) if n not in rows] + children
        self.joint: Int[Tensor, " m"] = torch.tensor(
            body.joint_columns(names), dtype=torch.long, device=body.tie.device
        )
        self.groups = tuple(dict.fromkeys(group for _, group in rows.values()))
        self.trunk = [name for name in ("trunk", "hips", "shoulders") if name in self.groups]
        # Parent and group of every joint; roots have none.
        self._rows = [
            (names.index(name), names.index(parent), self.groups.index(group))
            for name, (parent, group) in rows.items()
        ]
        moves = (body.tie.T != 0).to(body.tie) @ body.tree.ancestors[:, body.marker_link].to(
            body.tie
        )
        found = (
            Limb(name, groups, joint, _own_columns(body, moves > 0, groups))
            for name, groups, joint in limbs
        )
        # The limb of a body from a file may have no joint that turns.
        self.limbs = tuple(limb for limb in found if limb.columns.numel())
        self.depth = 2 if len(self.limbs) > 1 else 3

    def flip(
        self,
        joints_world: Float[Tensor, "*batch j 3"],
        flipped: Bool[Tensor, "*batch g"],
        centre_world: Float[Tensor, "3"],
        sight_world: Float[Tensor, "*batch j 3"] | None = None,
    ) -> Float[Tensor, "*batch m 3"]:
        """Move joints along their lines of sight so that some segments lean the other way.

        Segments that do not flip keep leaning as they do (towards the camera or away from it), so
        that everything beyond a flipped segment moves along with it. Every joint stays on its line
        of sight and every segment keeps its length, unless the line does not reach the sphere: then
        the joint goes to the point of the line that is nearest to its parent.

        Args:
            joints_world: Joint centres of a posed body, metres.
            flipped: Which groups flip, in the order of `groups`.
            centre_world: The camera's centre.
            sight_world: Unit vectors along the lines of sight on which the joints shall be; None:
                those on which they are.

        Returns:
            Positions of the joints `joint`, metres.
        """
        before = joints_world[..., self.joint, :] - centre_world.to(joints_world)
        after = list(before.unbind(-2))
        old = before.unbind(-2)
        for child, parent, group in self._rows:
            depth = old[child].norm(dim=-1, keepdim=True)
            along = old[child] / depth
            squared = (old[child] - old[parent]).square().sum(-1, keepdim=True)
            lean = torch.sign(depth - (along * old[parent]).sum(-1, keepdim=True))
            lean = torch.where(flipped[..., group, None], -lean, lean)
            if sight_world is not None:
                along = sight_world[..., self.joint[child], :]
            foot = (along * after[parent]).sum(-1, keepdim=True)
            reach = squared - after[parent].square().sum(-1, keepdim=True) + foot.square()
            after[child] = (foot + lean * reach.clamp(min=0).sqrt()) * along
        return torch.stack(after, dim=-2) + centre_world.to(joints_world)


def _own_columns(
    body: BodyModel, moves: Bool[Tensor, "n j"], joints: tuple[str, ...]
) -> Int[Tensor, " c"]:
    """Parameters that move some of these joints and no joint elsewhere.

    A body from a file has joints that have no name of ours, the fingers say: they do not count.
    """
    side, place = joints[0].split("_", 1)
    limb = next(chain for chain in _LIMBS.values() if place in chain)
    own = [f"{side}_{name}" for name in (*limb, "heel", "midtarsal")]
    inside = torch.tensor([name in own for name in body.joint_names], device=moves.device)
    others = [name in JOINT_NAMES and name not in own for name in body.joint_names]
    outside = torch.tensor(others, device=moves.device)
    return torch.nonzero(moves[:, inside].any(-1) & ~moves[:, outside].any(-1))[:, 0]
