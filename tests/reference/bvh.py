"""A reader of BVH files from their text alone: the reference for what we write.

It knows the format and nothing of the package. The rotations of a joint apply in the order of its
channels, each about the axes turned by those before: R = R_1 R_2 R_3; a point of the joint's frame
goes to its parent's by `OFFSET + position + R p`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


class BvhJoint(NamedTuple):
    name: str
    parent: int
    offset: tuple[float, float, float]
    channels: tuple[str, ...]
    ends: tuple[tuple[float, float, float], ...]


class BvhFile(NamedTuple):
    joints: tuple[BvhJoint, ...]
    frame_time: float
    motion: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    def positions(self) -> np.ndarray:
        """Joint centres `[frames joints 3]` in the file's unit."""
        out = np.zeros((len(self.motion), len(self.joints), 3))
        for t, row in enumerate(self.motion):
            values = iter(row)
            world: list[np.ndarray] = []
            for j, joint in enumerate(self.joints):
                local = np.eye(4)
                local[:3, 3] = joint.offset
                for channel in joint.channels:
                    value, axis = next(values), "XYZ".index(channel[0])
                    step = np.eye(4)
                    if channel.endswith("position"):
                        step[axis, 3] = value
                    else:
                        step[:3, :3] = rotation(axis, math.radians(value))
                    local = local @ step
                world.append(local if joint.parent < 0 else world[joint.parent] @ local)
                out[t, j] = world[-1][:3, 3]
        return out


def rotation(axis: int, angle: float) -> np.ndarray:
    """Rodrigues' formula about a coordinate axis."""
    k = np.zeros((3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    k[j, i], k[i, j] = 1.0, -1.0
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k)


def read_bvh(text: str) -> BvhFile:
    """Parse a file, strictly."""
    head, _, tail = text.partition("MOTION")
    tokens = iter(head.split())
    assert next(tokens) == "HIERARCHY"
    joints: list[BvhJoint] = []
    stack: list[int] = []

    def numbers() -> tuple[float, float, float]:
        assert next(tokens) == "OFFSET"
        return float(next(tokens)), float(next(tokens)), float(next(tokens))

    for token in tokens:
        if token in ("ROOT", "JOINT"):
            assert (token == "ROOT") == (not joints)
            name = next(tokens)
            assert next(tokens) == "{"
            offset = numbers()
            assert next(tokens) == "CHANNELS"
            channels = tuple(next(tokens) for _ in range(int(next(tokens))))
            joints.append(BvhJoint(name, stack[-1] if stack else -1, offset, channels, ()))
            stack.append(len(joints) - 1)
        elif token == "End":
            assert [next(tokens), next(tokens)] == ["Site", "{"]
            last = joints[stack[-1]]
            joints[stack[-1]] = last._replace(ends=(*last.ends, numbers()))
            assert next(tokens) == "}"
        else:
            assert token == "}", token
            stack.pop()
    assert not stack
    lines = [line for line in tail.splitlines() if line.strip()]
    count, time = lines[0].split(":"), lines[1].split(":")
    assert (count[0].strip(), time[0].strip()) == ("Frames", "Frame Time")
    motion = np.array([[float(value) for value in line.split()] for line in lines[2:]])
    assert motion.shape == (int(count[1]), sum(len(joint.channels) for joint in joints))
    return BvhFile(tuple(joints), float(time[1]), motion)
