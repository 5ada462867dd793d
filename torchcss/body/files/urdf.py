"""A body from a URDF file: its tree, limits, simple solids and boxes of meshes.

The parser of pytorch-kinematics leaves limits and mimic joints out, and keeps seven digits of
origins and axes: the file is read here. A floating joint of the root link, or of one that is fixed
to it, is a free root, and what hangs on that link beside it is left out. Solids are boxes,
cylinders, spheres and capsules: the visual ones of a link, or where it has none those for
collisions. A link that has only meshes is as large as the box around them, in its own frame, if
they are STL, OBJ or COLLADA files in the folder of the URDF or below it; others are not opened.

Call `read_urdf`; `torchcss.load_body("x.urdf")` does.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from torchcss.body.catalog import PartSpecification
from torchcss.body.chain import JointSpecification, check_joints, link_order
from torchcss.body.files.bvh import HungTree
from torchcss.body.files.bvh_parser import MOST_LINKS
from torchcss.body.files.default_shape import solid_shape, unopened_meshes, unused
from torchcss.body.files.mesh import MESH_SUFFIXES, mesh_points
from torchcss.body.rotations import Vector3, about_fixed_axes, as_rows, as_vector
from torchcss.errors import BodyError
from torchcss.files import shortened

_SIZES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
}


_DRAWN = ("visual", "collision")
"""Elements of a link that say what it looks like, the better first."""

PointsOf = Callable[[Path], Float[np.ndarray, "8 3"]]
"""Reads a mesh."""

_THINNEST = 0.001
"""Half the thickness of the thinnest part, metres."""

_LARGEST = 10.0
"""A link's half side that is none: such as of a mesh in millimetres, metres."""

_MOST_TURN = 20.0
"""Radians, or metres, between the limits of a joint: more are degrees, or millimetres."""

_ROUNDED = (0.5, 1.0, 0.0, 0.0, 0.0, 0.0)
"""What a part in a box has beside its half sides: a section that is round, ends that are nearly
flat."""


def read_urdf(robot: ElementTree.Element, folder: Path) -> HungTree:
    """Tree and solids of a URDF.

    Args:
        robot: Its root element.
        folder: Where meshes are looked for.

    Raises:
        BodyError: If it is no URDF, has joints of more than one degree of freedom, repeats a name,
            is not one tree, or has a number that is none.
    """
    words = [word for each in robot.iter() for word in (each.tag, *each.attrib.values())]
    if any(word.startswith("xacro:") or "${" in word for word in words):
        raise BodyError("a xacro file, which makes a URDF: expand it, xacro THIS > ROBOT.urdf")
    if robot.tag != "robot" or robot.find("link") is None:
        raise BodyError(f"not a URDF, expected <robot> with links, found <{robot.tag}>")
    notes = ["limits, axes and solids: as the URDF says"]
    floats = _take_off_the_world(robot, notes)
    elements = {element.get("name", ""): element for element in robot.findall("joint")}
    root = _check_links(robot, elements)
    moving = {name for name, element in elements.items() if element.get("type") != "fixed"}
    for name, element in elements.items():
        mimic = element.find("mimic")
        if mimic is not None and not {name, mimic.get("joint")} <= moving:
            element.remove(mimic)
            told = "is taken as free" if name in moving else "stays fixed"
            of = mimic.get("joint")
            notes.append(f"joint {name!r} mimics {of!r}, which is no joint that moves: it {told}")
    joints = _tree(root, elements)
    turned = [name for name, element in elements.items() if _turns_more_than_once(name, element)]
    if turned:
        notes.append(
            f"joints whose rpy turn more than once around, {shortened(turned)}: they are radians"
        )
    if wide := [each.name for each in joints if _MOST_TURN < each.upper - each.lower < math.inf]:
        notes.append(
            f"joints whose limits are far apart, {shortened(wide)}: they are radians and metres"
        )
    links = {link.get("name", "") for link in robot.findall("link")}
    if beside := links - {joint.link for joint in joints}:
        raise BodyError(f"the links {sorted(beside)} form a loop")
    solids = _solids(robot)
    solids += _boxes_of_meshes(robot, folder.resolve(), {part.link for part in solids}, notes)
    check_joints(joints)
    places = tuple(link_order(joints))
    return HungTree(tuple(joints), {}, tuple(notes), places, floats, solids=solids)


def _take_off_the_world(robot: ElementTree.Element, notes: list[str]) -> bool:
    """Keep only what hangs on a floating joint of the root link; whether there is one."""
    joints = robot.findall("joint")
    above = {_link(joint, "child"): joint for joint in joints}
    floating = [joint for joint in joints if joint.get("type") == "floating"]
    if len(floating) != 1:
        return False
    link = _link(floating[0], "parent")
    for _ in joints:  # what it hangs on stands still
        if link in above and above[link].get("type") == "fixed":
            link = _link(above[link], "parent")
    if link in above:
        return False
    kept = [_link(floating[0], "child")]
    for link in kept:  # grows while it is walked
        below = [_link(joint, "child") for joint in joints
                 if _link(joint, "parent") == link]  # fmt: skip
        kept += [child for child in below if child not in kept]
    world = _link(floating[0], "parent")
    others = [link for link in robot.findall("link") if link.get("name") not in (*kept, world)]
    if others:
        names = ", ".join(link.get("name", "") for link in others)
        notes.append(f"left out, as it hangs on {world!r} beside the body: {shortened(names)}")
    for element in [*joints, *robot.findall("link")]:
        name = element.get("name") if element.tag == "link" else _link(element, "parent")
        if name not in kept:
            robot.remove(element)
    return True


def _check_links(robot: ElementTree.Element, joints: Mapping[str, ElementTree.Element]) -> str:
    """Check names, and that every link but one hangs on one joint; returns that one."""
    if len(joints) != len(robot.findall("joint")) or "" in joints:
        raise BodyError("two joints have the same name, or one has none")
    children, parents = (
        [_link(element, tag) for element in joints.values()] for tag in ("child", "parent")
    )
    links = [link.get("name", "") for link in robot.findall("link")]
    if len(links) > MOST_LINKS:
        raise BodyError(f"{len(links):,} links; expected a robot of {MOST_LINKS:,} at most")
    unknown = {*children, *parents} - set(links)
    if unknown:
        raise BodyError(f"joints name links that do not exist: {sorted(unknown)}")
    if len(set(children)) != len(children) or len(set(links)) != len(links):
        raise BodyError("a link occurs twice, or hangs on two joints")
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise BodyError(f"expected exactly one root link, found {sorted(roots)}")
    return roots[0]


def _link(element: ElementTree.Element, tag: str) -> str:
    """The link that a joint names as its child or parent."""
    child = element.find(tag)
    if child is None or not child.get("link"):
        raise BodyError(f"joint {element.get('name')!r} has no <{tag} link=...>")
    return child.get("link", "")


def _tree(root: str, elements: Mapping[str, ElementTree.Element]) -> list[JointSpecification]:
    """What hangs on a link, depth first."""
    joints, ahead = [JointSpecification(name="root", link=root, parent=None)], []
    while True:
        here = joints[-1].link
        ahead = [each for each in elements.values() if _link(each, "parent") == here] + ahead
        if not ahead:
            return joints
        joints.append(_joint(ahead.pop(0)))


def _joint(element: ElementTree.Element) -> JointSpecification:
    """A joint with its numbers and with what it mimics."""
    name, kind = element.get("name", ""), element.get("type", "")
    where, axis = f"joint {name!r}", element.find("axis")
    translation, rotation = _origin(where, element)
    joint = JointSpecification(
        name=name,
        link=_link(element, "child"),
        parent=_link(element, "parent"),
        kind="revolute" if kind == "continuous" else kind,
        translation=translation,
        rotation=rotation,
    )
    if kind != "fixed":  # files often give fixed joints the axis 0 0 0
        text = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
        x, y, z = _numbers(where, "axis", text, 3)
        joint = replace(joint, axis=(x, y, z))
    limit, mimic = element.find("limit"), element.find("mimic")
    try:
        if limit is not None and kind != "continuous" and {"lower", "upper"} & set(limit.keys()):
            lower, upper = (float(limit.get(end, 0.0)) for end in ("lower", "upper"))
            joint = replace(joint, lower=lower, upper=upper)
        if mimic is None:
            return joint
        multiplier, offset = float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))
    except ValueError as error:
        raise BodyError(f"{where}: {error}") from error
    if not (math.isfinite(multiplier) and math.isfinite(offset) and multiplier != 0):
        raise BodyError(
            f"{where} mimics with multiplier {multiplier} and offset {offset}; expected finite "
            "numbers and a multiplier that is not zero"
        )
    return replace(joint, mimic=(mimic.get("joint", ""), multiplier, offset))


def _turns_more_than_once(name: str, element: ElementTree.Element) -> bool:
    """Whether a joint's angles are more than radians are."""
    origin = element.find("origin")
    text = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
    return max(map(abs, _numbers(f"joint {name!r}", "rpy", text, 3))) > 2 * math.pi + 0.01


def _solids(robot: ElementTree.Element) -> tuple[PartSpecification, ...]:
    """The simple solids of all links."""
    parts: list[PartSpecification] = []
    links = robot.findall("link")
    # A link's first solid has its name, also that of a link further on.
    used = {link.get("name", "") for link in links}
    for link in links:
        name = link.get("name", "")
        for further, (element, solid) in enumerate(_simple_solids(link)):
            where = f"link {name!r}: <{solid.tag}>"
            size: list[float] = []
            for key in _SIZES[solid.tag]:
                size += _numbers(where, key, solid.get(key, ""), 3 if key == "size" else 1)
            if not all(number > 1e-6 for number in size):
                raise BodyError(f"{where}: expected positive sizes, found {size}")
            if solid.tag == "box":
                size = [0.5 * side for side in size]
            elif len(size) == 2:
                size[1] *= 0.5
            translation, rotation = _origin(where, element)
            parts.append(
                PartSpecification(
                    name=unused(name, used) if further else name,
                    link=name,
                    translation=translation,
                    rotation=rotation,
                    shape=solid_shape(solid.tag, size),
                )
            )
            used.add(parts[-1].name)
    return tuple(parts)


def _boxes_of_meshes(
    robot: ElementTree.Element, folder: Path, shaped: set[str], notes: list[str]
) -> tuple[PartSpecification, ...]:
    """A part for every link that has no solids but meshes."""
    parts: list[PartSpecification] = []
    unopened: list[str] = []
    points_of = cache(mesh_points)  # legs and fingers often share one
    for link in robot.findall("link"):
        name = link.get("name", "")
        if name in shaped or link.find("*/geometry/mesh") is None:
            continue
        kinds = (_mesh_points(link, tag, folder, notes, points_of) for tag in _DRAWN)
        if (corners := next((each for each in kinds if each is not None), None)) is None:
            mesh = link.find("*/geometry/mesh[@filename]")
            file = "" if mesh is None else re.split(r"[/\\]", mesh.get("filename", ""))[-1]
            unopened.append(f"{name} ({shortened(file)})")
            continue
        low, high = corners.min(0), corners.max(0)
        half = np.maximum(0.5 * (high - low), _THINNEST)
        if (largest := half.max()) > _LARGEST:
            notes.append(
                f"link {name!r} is {2 * largest:.0f} m large by its mesh, more than links are: if "
                'that is in millimetres, say <mesh scale="0.001 0.001 0.001">'
            )
        order = np.argsort(half)  # a superquadric's own axis is its longest
        turn = np.eye(3)[:, order]
        turn[:, 0] *= np.linalg.det(turn)
        parts.append(
            PartSpecification(
                name=name,
                link=name,
                translation=as_vector(0.5 * (low + high)),
                rotation=as_rows(turn),
                shape=(*half[order].tolist(), *_ROUNDED),
            )
        )
    if parts:
        names = shortened(", ".join(part.name for part in parts))
        notes.append(f"as large as the boxes around their meshes: {names}")
    if unopened:
        notes.append(
            unopened_meshes(unopened, "<collision>, or files .stl, .obj or .dae in this folder,")
        )
    return tuple(parts)


def _mesh_points(
    link: ElementTree.Element, tag: str, folder: Path, notes: list[str], points_of: PointsOf
) -> Float[np.ndarray, "p 3"] | None:
    """Corners of all meshes of a link in its frame; None: there are none, or one is not at hand."""
    found: list[np.ndarray] = []
    for element in link.findall(tag):
        for mesh in element.findall("geometry/mesh"):
            path = _inside(folder, mesh.get("filename", ""))
            if path is None:
                return None
            where = f"link {link.get('name', '')!r}: <mesh>"
            scale = _numbers(where, "scale", mesh.get("scale", "1 1 1"), 3)
            place, turn = _origin(where, element)
            try:
                corners = points_of(path)
            except BodyError as error:  # such as a pointer to where the file lies
                notes.append(str(error))
                return None
            found.append(corners * scale @ np.array(turn).T + place)
    return np.concatenate(found) if found else None


def _inside(folder: Path, name: str) -> Path | None:
    """The mesh of that name in a folder or below it; a package is the folder, or is in it."""
    package, _, rest = name.removeprefix("file://").removeprefix("package://").partition("/")
    for each in (f"{package}/{rest}", rest if name.startswith("package://") else ""):
        with suppress(OSError, ValueError):
            path = (folder / each).resolve()
            if (
                path.suffix.lower() in MESH_SUFFIXES
                and path.is_relative_to(folder)
                and path.is_file()
            ):
                return path
    return None


def _simple_solids(
    link: ElementTree.Element,
) -> list[tuple[ElementTree.Element, ElementTree.Element]]:
    """Elements of a link that have a simple solid, with it: visual ones or else for collisions."""
    for tag in _DRAWN:
        found = [
            (element, solid)
            for element in link.findall(tag)
            for geometry in element.findall("geometry")
            for solid in geometry
            if solid.tag in _SIZES
        ]
        if found:
            return found
    return []


def _origin(
    where: str, element: ElementTree.Element
) -> tuple[Vector3, tuple[Vector3, Vector3, Vector3]]:
    """Where a joint or a solid sits, and how it is turned."""
    origin = element.find("origin")
    values = {} if origin is None else origin.attrib
    x, y, z = _numbers(where, "xyz", values.get("xyz", "0 0 0"), 3)
    turn = about_fixed_axes(_numbers(where, "rpy", values.get("rpy", "0 0 0"), 3), "XYZ")
    return (x, y, z), as_rows(turn)


def _numbers(where: str, key: str, text: str, size: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != size or not all(abs(value) < 1e9 for value in values):
        raise BodyError(f"{where}: {key}: expected {size} numbers, found {shortened(text)}")
    return values
