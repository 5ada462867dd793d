"""Small robots written out as URDF: planar arms, arms of six and seven joints, a quadruped."""

from __future__ import annotations

from pathlib import Path

SEVEN = (
    # origin, roll-pitch-yaw, axis, limit: shoulder, elbow and wrist as the KUKA iiwa has them
    ((0, 0, 0.34), (0, 0, 0), (0, 0, 1), 2.9),
    ((0, 0, 0), (0, 0, 0), (0, 1, 0), 2.0),
    ((0, 0, 0.4), (0, 0, 0), (0, 0, 1), 2.9),
    ((0, 0, 0), (0, 0, 0), (0, -1, 0), 2.0),
    ((0, 0, 0.4), (0, 0, 0), (0, 0, 1), 2.9),
    ((0, 0, 0), (0, 0, 0), (0, 1, 0), 2.0),
    ((0, 0, 0.12), (0, 0, 0), (0, 0, 1), 2.9),
)
SIX = (
    # offsets as Universal Robots have them, two turns of freedom at no joint
    ((0, 0, 0.09), (0, 0, 0), (0, 0, 1), 3.1),
    ((0, 0.13, 0), (0, 1.5, 0), (0, 1, 0), 3.1),
    ((0, -0.12, 0.42), (0, 0, 0), (0, 1, 0), 3.1),
    ((0, 0, 0.39), (0, 1.5, 0), (0, 1, 0), 3.1),
    ((0, 0.1, 0), (0, 0, 0), (0, 0, 1), 3.1),
    ((0, 0, 0.09), (0, 0, 0), (0, 1, 0), 3.1),
)


def write_arm(path: Path, rows=SEVEN, tip: tuple[float, float, float] = (0, 0, 0.1)) -> Path:
    """Write an arm; its links are link0, link1, ... and tip, its joints joint1, joint2, ..."""
    lines = ['<robot name="arm"><link name="link0"/>']
    for number, (origin, turn, axis, limit) in enumerate(rows, 1):
        lines.append(
            f'<link name="link{number}"/>'
            f'<joint name="joint{number}" type="{"continuous" if limit is None else "revolute"}">'
            f'<parent link="link{number - 1}"/><child link="link{number}"/>'
            f"<origin xyz={_text(origin)} rpy={_text(turn)}/><axis xyz={_text(axis)}/>"
            + (
                ""
                if limit is None
                else f'<limit lower="-{limit}" upper="{limit}" effort="1" velocity="1"/>'
            )
            + "</joint>"
        )
    lines.append(
        f'<link name="tip"/><joint name="tool" type="fixed"><parent link="link{len(rows)}"/>'
        f'<child link="tip"/><origin xyz={_text(tip)}/></joint></robot>'
    )
    path.write_text("\n".join(lines))
    return path


def planar_arm(path: Path, *lengths: float, limit: float | None = None) -> Path:
    """Write an arm in the x-y plane."""
    origins = [(0.0, 0.0, 0.0), *((length, 0.0, 0.0) for length in lengths[:-1])]
    rows = tuple((origin, (0, 0, 0), (0, 0, 1), limit) for origin in origins)
    return write_arm(path, rows, (lengths[-1], 0.0, 0.0))


def write_quadruped(path: Path) -> Path:
    """Write a quadruped of ANYmal's names and about its size, Z up and facing +X."""
    lines = ['<robot name="quadruped"><link name="base"/>']

    def joint(name: str, parent: str, child: str, origin, axis=None) -> None:
        kind = "fixed" if axis is None else "revolute"
        lines.append(
            f'<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz={_text(origin)}/>'
            + ("" if axis is None else f'<axis xyz={_text(axis)}/><limit lower="-9" upper="9"'
               ' effort="1" velocity="1"/>')
            + "</joint>"
        )  # fmt: skip

    for leg in ("LF", "RF", "LH", "RH"):
        left, fore = 1 if leg[0] == "L" else -1, 1 if leg[1] == "F" else -1
        joint(f"{leg}_HAA", "base", f"{leg}_HIP", (0.28 * fore, 0.12 * left, 0), (1, 0, 0))
        joint(f"{leg}_HFE", f"{leg}_HIP", f"{leg}_THIGH", (0, 0.05 * left, 0), (0, 1, 0))
        joint(f"{leg}_KFE", f"{leg}_THIGH", f"{leg}_SHANK", (0, 0.05 * left, -0.25), (0, 1, 0))
        joint(f"{leg}_END", f"{leg}_SHANK", f"{leg}_FOOT", (0.05 * fore, 0, -0.32))
    path.write_text("\n".join([*lines, "</robot>"]))
    return path


def _text(numbers) -> str:
    return '"' + " ".join(str(number) for number in numbers) + '"'
