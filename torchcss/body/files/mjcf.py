"""A body from an MJCF file, the robot and body descriptions of MuJoCo: tree, limits and solids.

Read are bodies, frames, joints and simple geoms, with includes, default classes, and the compiler's
choice of angles; what a body is made of, driven by or looks like otherwise does not matter here.
A hinge or slide is one joint, a ball three hinges with their middle one within a right angle, and a
free joint the six root parameters. A joint stands at its anchor: joints of one body that have
different anchors are links of their own. Zero is the pose that the file draws; `ref` shifts limits.
Meshes are left out: their links get flesh along the bones.

Call `read_mjcf`; `torchcss.load_body("x.xml")` does. The format is MuJoCo's XML reference.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.body.catalog import PartSpecification
from torchcss.body.chain import JointSpecification
from torchcss.body.files.bvh import BASE, Skeleton
from torchcss.body.files.default_shape import as_rows, as_vector, solid_shape
from torchcss.errors import BodyError
from torchcss.files import one_line, read_bytes, shortened

_SOLIDS = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
"""Geoms that become flesh, and how many numbers say their size (without `fromto`)."""

_NO_FLESH = ("plane", "hfield", "mesh", "sdf")
_EXPANDED = ("replicate", "attach", "composite", "flexcomp")
"""Elements that stand for bodies which only MuJoCo's compiler can make."""

_MOST_INCLUDES, _DEEPEST = 50, 200


class _Place(NamedTuple):
    """Orientation and origin in the frame of a body."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def then(self, other: _Place) -> _Place:
        return _Place(
            self.rotation @ other.rotation, self.translation + self.rotation @ other.translation
        )


_HERE = _Place(np.eye(3), np.zeros(3))


def read_mjcf(path: Path) -> tuple[Skeleton, tuple[PartSpecification, ...]]:
    """Read tree and solids of an MJCF file.

    Args:
        path: The file; what it includes is looked for beside it.

    Returns:
        The tree, and the parts of the links that have solids.

    Raises:
        BodyError: If the file, or one that it includes, is missing or no MJCF, or has bodies that
            only MuJoCo's compiler can make.
    """
    return _Reader(path).read()


class _Reader:
    """What is known while one file is read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.num_includes = 0
        self.root = self._parse(path)
        if self.root.tag not in ("mujoco", "mujocoinclude"):
            raise BodyError(f"{path}: not an MJCF, expected <mujoco>, found <{self.root.tag}>")
        self._include(self.root)
        options: dict[str, str] = {}
        for element in self.root.findall("compiler"):
            options |= element.attrib
        self.degrees = options.get("angle", "degree") != "radian"
        self.sequence = options.get("eulerseq", "xyz")
        self.limits_by_range = options.get("autolimits", "true") != "false"
        if len(self.sequence) != 3 or set(self.sequence.lower()) - set("xyz"):
            raise self._bad("compiler", "eulerseq of three of x, y, z", self.sequence)
        if options.get("coordinate", "local") != "local":
            raise self._bad("compiler", "local coordinates", options["coordinate"])
        self.defaults: dict[str, dict[str, dict[str, str]]] = {}
        for element in self.root.findall("default"):
            self._read_defaults(element, {}, "main")
        self.joints = [JointSpecification(name=BASE, link=BASE, parent=None)]
        self.parts: list[PartSpecification] = []
        self.places: list[str] = []
        self.notes: list[str] = []
        self.has_root = False

    # Files and defaults.

    def _parse(self, path: Path) -> ElementTree.Element:
        data = read_bytes(path, BodyError)
        try:
            return ElementTree.fromstring(data)
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            raise BodyError(
                f"{path}: not an MJCF, the XML does not parse ({one_line(error)})"
            ) from error

    def _include(self, parent: ElementTree.Element, depth: int = 0) -> None:
        """Put the content of included files in their place."""
        if depth > _DEEPEST:
            raise BodyError(f"{self.path}: elements more than {_DEEPEST} deep; not an MJCF")
        for index, element in reversed(list(enumerate(parent))):
            if element.tag != "include":
                self._include(element, depth + 1)
                continue
            self.num_includes += 1
            if self.num_includes > _MOST_INCLUDES:
                raise BodyError(f"{self.path}: more than {_MOST_INCLUDES} includes: do they loop?")
            file = self.path.parent / element.get("file", "")
            content = self._parse(file)
            self._include(content, depth + 1)
            parent[index : index + 1] = list(content)

    def _read_defaults(
        self, element: ElementTree.Element, above: Mapping[str, Mapping[str, str]], name: str
    ) -> None:
        own = {kind: dict(values) for kind, values in above.items()}
        for child in element:
            if child.tag != "default":
                own.setdefault(child.tag, {}).update(child.attrib)
        name = element.get("class", name)
        merged = self.defaults.setdefault(name, {})
        for kind, values in own.items():
            merged.setdefault(kind, {}).update(values)
        for child in element.findall("default"):
            self._read_defaults(child, own, child.get("class", name))

    def _with_defaults(self, element: ElementTree.Element, class_name: str) -> dict[str, str]:
        chosen = element.get("class", class_name)
        if chosen not in self.defaults and chosen != "main":
            raise self._bad(self._label(element), "a default class of the file", chosen)
        return {**self.defaults.get(chosen, {}).get(element.tag, {}), **element.attrib}

    # Numbers.

    def _label(self, element: ElementTree.Element) -> str:
        return f"<{element.tag} name={element.get('name', '')!r}>"

    def _bad(self, where: str, expected: str, found: object) -> BodyError:
        return BodyError(f"{self.path}: {where}: expected {expected}, found {shortened(found)}")

    def _numbers(self, where: str, text: str, *sizes: int) -> np.ndarray:
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.array([math.nan])
        # What is beyond this is no body's, and its square would overflow.
        if (sizes and len(values) not in sizes) or not (np.abs(values) < 1e9).all():
            wanted = " or ".join(str(size) for size in sizes) or "some"
            raise self._bad(where, f"{wanted} numbers", text)
        return values

    def _unit(self, where: str, vector: np.ndarray) -> np.ndarray:
        length = float(np.linalg.norm(vector))
        if not length > 1e-12:
            raise self._bad(where, "a direction that is not zero", vector.tolist())
        return vector / length

    def _angle(self, value: float) -> float:
        return math.radians(value) if self.degrees else value

    def _place(self, where: str, values: Mapping[str, str]) -> _Place:
        """Position and orientation, in whichever of five ways the latter is given."""
        translation = self._numbers(where, values.get("pos", "0 0 0"), 3)
        rotation = np.eye(3)
        if "quat" in values:
            w, *xyz = self._unit(where, self._numbers(where, values["quat"], 4)).tolist()
            angle = 2 * math.atan2(math.hypot(*xyz), w)
            axis = np.array(xyz)
            rotation = _rotation(axis, angle) if np.linalg.norm(axis) > 0 else rotation
        elif "axisangle" in values:
            *axis, angle = self._numbers(where, values["axisangle"], 4).tolist()
            rotation = _rotation(self._unit(where, np.array(axis)), self._angle(angle))
        elif "euler" in values:
            angles = self._numbers(where, values["euler"], 3)
            for letter, angle in zip(self.sequence, angles.tolist(), strict=True):
                turn = _rotation(np.eye(3)["xyz".index(letter.lower())], self._angle(angle))
                # Small letters turn with the body, capital ones about fixed axes.
                rotation = rotation @ turn if letter.islower() else turn @ rotation
        elif "xyaxes" in values:
            numbers = self._numbers(where, values["xyaxes"], 6)
            x = self._unit(where, numbers[:3])
            y = self._unit(where, numbers[3:] - x * (x @ numbers[3:]))
            rotation = np.stack([x, y, np.cross(x, y)], axis=1)
        elif "zaxis" in values:
            rotation = _turn_of_z(self._unit(where, self._numbers(where, values["zaxis"], 3)))
        return _Place(rotation, translation)

    # The tree.

    def read(self) -> tuple[Skeleton, tuple[PartSpecification, ...]]:
        bodies = [
            (body, place, class_name)
            for world in self.root.findall("worldbody")
            for body, place, class_name in self._children(world, _HERE, "main")
        ]
        if not bodies:
            raise BodyError(
                f"{self.path}: no <body> in the <worldbody>; expected an MJCF of a body"
            )
        chosen = max(bodies, key=lambda body: _num_joints(body[0]))
        if len(bodies) > 1:
            others = [
                body.get("name", "without name") for body, *_ in bodies if body is not chosen[0]
            ]
            self.notes.append(
                f"of several bodies the one with most joints; not {', '.join(others)}"
            )
        self._body(*chosen, BASE)
        self.notes.insert(0, "limits, axes and solids: as the MJCF says")
        skeleton = Skeleton(
            tuple(self.joints), {}, tuple(self.notes), tuple(self.places), self.has_root
        )
        return skeleton, tuple(self.parts)

    def _children(
        self, element: ElementTree.Element, place: _Place, class_name: str
    ) -> list[tuple[ElementTree.Element, _Place, str]]:
        """Bodies below an element, through frames, with the place and class that frames give."""
        found = []
        for child in element:
            if child.tag in _EXPANDED:
                raise BodyError(
                    f"{self.path}: <{child.tag}> needs MuJoCo's compiler; save the compiled model "
                    "(mj_saveLastXML) and load that"
                )
            inner = child.get("childclass", class_name)
            if child.tag == "frame":
                here = place.then(self._place(self._label(child), child.attrib))
                found += self._children(child, here, inner)
            elif child.tag == "body":
                here = place.then(self._place(self._label(child), child.attrib))
                found.append((child, here, inner))
        return found

    def _content(
        self, element: ElementTree.Element, tags: tuple[str, ...], place: _Place, class_name: str
    ) -> list[tuple[ElementTree.Element, _Place, str]]:
        """Joints or geoms of a body, through frames."""
        found = []
        for child in element:
            if child.tag == "frame":
                here = place.then(self._place(self._label(child), child.attrib))
                found += self._content(child, tags, here, child.get("childclass", class_name))
            elif child.tag in tags:
                found.append((child, place, class_name))
        return found

    def _body(
        self, element: ElementTree.Element, place: _Place, class_name: str, parent: str
    ) -> None:
        name = element.get("name") or f"body{len(self.joints)}"
        is_root = parent == BASE
        anchor = np.zeros(3)
        joints = self._content(element, ("joint", "freejoint"), _HERE, class_name)
        for child, inner, inherited in joints:
            values = self._with_defaults(child, inherited) if child.tag == "joint" else child.attrib
            label = f"joint {child.get('name', name)!r}"
            kind = "free" if child.tag == "freejoint" else values.get("type", "hinge")
            if kind == "free":
                if not is_root or len(joints) > 1:
                    raise self._bad(label, "a free joint alone, on the body in the world", name)
                self.has_root = True
                # A free body is where it is put; its drawn place only says which way is up.
                place = place._replace(translation=np.zeros(3))
                continue
            at = inner.then(_Place(np.eye(3), self._numbers(label, values.get("pos", "0 0 0"), 3)))
            joint_name = child.get("name") or f"{name}_joint{len(self.joints)}"
            for turn in self._turns(label, joint_name, kind, values, inner.rotation):
                link = f"{turn.name}_link"
                shift = place.translation + place.rotation @ (at.translation - anchor)
                self.joints.append(
                    JointSpecification(
                        name=turn.name, link=link, parent=parent, kind=turn.kind, axis=turn.axis,
                        lower=turn.lower, upper=turn.upper, translation=as_vector(shift),
                        rotation=as_rows(place.rotation),
                    )
                )  # fmt: skip
                parent, anchor, place = link, at.translation, _HERE
        shift = place.translation - place.rotation @ anchor
        self.joints.append(
            JointSpecification(
                name=f"{name}_fixed", link=name, parent=parent, translation=as_vector(shift),
                rotation=as_rows(place.rotation),
            )
        )  # fmt: skip
        self.places.append(name)
        self._geoms(element, name, class_name)
        for child, inner, inherited in self._children(element, _HERE, class_name):
            self._body(child, inner, inherited, name)

    def _turns(
        self, label: str, name: str, kind: str, values: Mapping[str, str], turn: np.ndarray
    ) -> list[JointSpecification]:
        """One degree of freedom each; names, kinds, axes and limits only."""
        if kind not in ("hinge", "slide", "ball"):
            raise self._bad(label, "type hinge, slide, ball or free", kind)
        limits = self._numbers(label, values.get("range", "0 0"), 2).tolist()
        limited = values.get("limited", "auto")
        is_limited = limited == "true" or (
            limited == "auto" and self.limits_by_range and "range" in values
        )
        if kind == "ball":
            most = self._angle(limits[1]) if is_limited else math.pi
            ends = {"x": most, "y": min(most, 0.5 * math.pi), "z": most}
            return [
                JointSpecification(
                    name=f"{name}_{letter}", link="", parent="", kind="revolute",
                    axis=as_vector(turn @ np.eye(3)["xyz".index(letter)]), lower=-end, upper=end,
                )
                for letter, end in ends.items()
            ]  # fmt: skip
        axis = self._unit(label, self._numbers(label, values.get("axis", "0 0 1"), 3))
        (reference,) = self._numbers(label, values.get("ref", "0"), 1).tolist()
        lower, upper = -math.inf, math.inf
        if is_limited:
            lower, upper = (limit - reference for limit in limits)
            if kind == "hinge":
                lower, upper = self._angle(lower), self._angle(upper)
            if lower > upper:
                raise self._bad(label, "a range from the least to the greatest", values["range"])
        return [
            JointSpecification(
                name=name, link="", parent="", axis=as_vector(turn @ axis),
                kind="revolute" if kind == "hinge" else "prismatic", lower=lower, upper=upper,
            )
        ]  # fmt: skip

    def _geoms(self, element: ElementTree.Element, link: str, class_name: str) -> None:
        for child, inner, inherited in self._content(element, ("geom",), _HERE, class_name):
            values = self._with_defaults(child, inherited)
            label = f"geom {child.get('name', link)!r}"
            kind = values.get("type", "sphere")
            if kind in _NO_FLESH or ("mesh" in values and kind not in _SOLIDS):
                continue
            if kind not in _SOLIDS:
                raise self._bad(label, f"type {', '.join((*_SOLIDS, *_NO_FLESH))}", kind)
            if "mesh" in values and "size" not in values:
                continue  # a solid that the compiler would fit to the mesh
            size = self._numbers(label, values.get("size", "")).tolist()
            place = self._place(label, values)
            if "fromto" in values:
                ends = self._numbers(label, values["fromto"], 6)
                # MuJoCo has z point to the first end; of a box it tells how it is turned.
                along = ends[:3] - ends[3:]
                half = 0.5 * float(np.linalg.norm(along))
                place = _Place(_turn_of_z(self._unit(label, along)), 0.5 * (ends[:3] + ends[3:]))
                size = [*size[:1], half] if _SOLIDS[kind] == 2 else [*size[:2], half]
            needed = _SOLIDS[kind]
            if len(size) < needed or not all(number > 1e-6 for number in size[:needed]):
                raise self._bad(label, f"{needed} positive numbers as size", size)
            place = inner.then(place)
            name, names = child.get("name") or link, {part.name for part in self.parts}
            if name in names:
                name = next(f"{name}_{n}" for n in range(2, 99_999) if f"{name}_{n}" not in names)
            self.parts.append(
                PartSpecification(
                    name=name,
                    link=link,
                    translation=as_vector(place.translation),
                    rotation=as_rows(place.rotation),
                    shape=solid_shape(kind, size),
                )
            )


def _num_joints(body: ElementTree.Element) -> int:
    return sum(1 for element in body.iter() if element.tag in ("joint", "freejoint"))


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)


def _turn_of_z(direction: np.ndarray) -> np.ndarray:
    """The least rotation that takes the z axis to a unit vector."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, direction)
    if np.linalg.norm(axis) < 1e-12:
        return np.eye(3) if direction[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return _rotation(axis, math.atan2(float(np.linalg.norm(axis)), float(direction[2])))
