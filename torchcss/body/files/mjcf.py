"""A body from an MJCF file, the robot and body descriptions of MuJoCo: tree, limits and solids.

MuJoCo's own compiler reads the file (the extra `[mjcf]`), so that whatever it expands is read:
frames, default classes, replicated and attached bodies. Before that the file is screened and
stripped to what a body is: its bodies, joints and geoms. What it is made of, driven by or looks
like otherwise does not matter here, so no mesh or texture is opened.

A hinge or slide is one joint, a ball three hinges with their middle one within a right angle, and a
free joint the six root parameters. A joint stands at its anchor: joints of one body that have
different anchors are links of their own. An equality of two joints lets one follow the other. Zero
is the pose that the file draws; `ref` shifts limits. Links whose geoms are meshes get a shape along
their bones.

Call `read_mjcf`; `torchcss.load_body("x.xml")` does.
"""

from __future__ import annotations

import math
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.body.catalog import PartSpecification
from torchcss.body.chain import JointSpecification
from torchcss.body.files.bvh import BASE, HungTree
from torchcss.body.files.default_shape import solid_shape, unopened_meshes, unused
from torchcss.body.files.xml import parse_xml
from torchcss.body.rotations import as_rows, as_vector, frame_at, from_quaternion
from torchcss.errors import BodyError, optional_package
from torchcss.files import one_line, shortened

_SOLIDS = {2: ("sphere", 1), 3: ("capsule", 2), 4: ("ellipsoid", 3), 5: ("cylinder", 2),
           6: ("box", 3)}  # fmt: skip
"""Geoms that become parts, by MuJoCo's numbers: their names, and how many sizes they have."""

_KEPT = (
    *("compiler", "default", "asset", "model", "worldbody", "body", "frame", "joint", "freejoint"),
    *("geom", "replicate", "attach", "equality"),
)
"""Elements that say what a body is; others go, with what they hold."""

_SOFT = ("composite", "flexcomp")
"""Elements that make cloth, ropes and the like of bodies of their own."""

_NAMES = ("name", "class", "childclass", "prefix", "mesh", "hfield", "model", "body", "file",
          "joint1", "joint2")  # fmt: skip
_JOINT_EQUALITY = 2
"""MuJoCo's number of an equality between two joints, which makes one follow the other."""

_MOST_FILES, _MOST_BODIES, _FAR = 50, 10_000, 1e6
_LIGHT = 1e-6
"""Mass and inertia that every body has at least: the compiler refuses moving ones without."""


def read_mjcf(path: Path) -> HungTree:
    """Read tree and solids of an MJCF file.

    Args:
        path: The file; what it includes or attaches is looked for beside it.

    Raises:
        BodyError: If the file, or one that it names, is missing, no MJCF, in another folder, or
            expands to very many bodies.
        MissingExtraError: If MuJoCo is not installed.
    """
    model, meshed, screen = _compiled(path)
    if not model.njnt and model.nbody < 2:
        raise BodyError(f"{path}: no <body> in the <worldbody>; expected an MJCF of a body")
    tops = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    joints = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
    chosen = max(tops, key=lambda body: joints[body])
    notes = ["limits, axes and solids: as the MJCF says"]
    if left_out := ", ".join(screen.left_out):
        notes.append(f"equalities of other things than joints are left out: {left_out}")
    if screen.soft:
        notes.append(f"soft bodies are left out: {', '.join(screen.soft)}")
    if len(tops) > 1:
        others = [model.body(body).name or "without name" for body in tops if body != chosen]
        notes.append(f"of several bodies the one with most joints; not {', '.join(others)}")
    skeleton = _Reader(model).read(chosen, tuple(notes))
    bare = {*skeleton.places} - {part.link for part in skeleton.solids}
    if meshes := [link for link in meshed if link in bare]:
        note = unopened_meshes(meshes, "<geom>")
        skeleton = skeleton._replace(notes=(*skeleton.notes, note))
    return skeleton


class _Screen:
    """The files that make up one MJCF: screened, stripped, and with their includes put in."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.num_files = 0
        self.left_out: list[str] = []
        self.soft: list[str] = []
        self.attached: dict[str, ElementTree.Element] = {}
        self.sizes: dict[ElementTree.Element, float] = {}

    def read(self, name: str) -> ElementTree.Element:
        """A file of the folder without what is not a body's."""
        path = self.path.parent / name
        self.num_files += 1
        if self.num_files > _MOST_FILES:
            raise BodyError(f"{self.path}: more than {_MOST_FILES} includes: do they loop?")
        if not path.resolve().is_relative_to(self.path.parent.resolve()):
            raise BodyError(f"{self.path}: names {name!r}, which is not in its folder; move it")
        root = parse_xml(path, "an MJCF")
        if root.tag not in ("mujoco", "mujocoinclude"):
            raise BodyError(f"{path}: not an MJCF, expected <mujoco>, found <{root.tag}>")
        root.tag, root.attrib = "mujoco", {}
        self._strip(root)
        return root

    def _strip(self, element: ElementTree.Element) -> None:
        children: list[ElementTree.Element] = []
        for child in element:
            if child.tag == "include":
                children += self.read(child.get("file", ""))
            elif element.tag == "equality" and child.tag != "joint":
                self.left_out.append(child.tag)
            elif child.tag in _SOFT:
                self.soft.append(f"{child.get('name', child.get('prefix'))} ({child.tag})")
            elif child.tag in _KEPT:
                child.attrib.pop("material", None)
                self._check_numbers(child)
                self._strip(child)
                children.append(child)
        element[:] = children
        for child in children:
            name = child.get("file", "")
            if child.tag == "model" and name not in self.attached:
                self.attached[name] = child  # in case that the file attaches itself
                self.attached[name] = self.read(name)

    def _check_numbers(self, element: ElementTree.Element) -> None:
        """Refuse what is not a number: the compiler warns of it in a log file of its own."""
        for key, value in element.items():
            words = value.lower().split()
            if key not in _NAMES and any(word.lstrip("+-").startswith("nan") for word in words):
                raise BodyError(
                    f"{self.path}: <{element.tag} name={element.get('name', '')!r}>: {key}: "
                    f"expected numbers, found {shortened(value)}"
                )

    def num_bodies(self, root: ElementTree.Element) -> float:
        """How many bodies a file expands to."""
        files = {model.get("name"): model.get("file", "") for model in root.iter("model")}

        def count(element: ElementTree.Element) -> float:
            total = sum(map(count, element))
            if element.tag == "body":
                return total + 1
            if element.tag == "attach" and (name := files.get(element.get("model"))) is not None:
                return self.num_bodies(self.attached[name])
            return total * (_count(element) if element.tag == "replicate" else 1)

        if root not in self.sizes:
            self.sizes[root] = math.inf  # of a file that attaches itself
            self.sizes[root] = count(root)
        return self.sizes[root]


def _count(replicate: ElementTree.Element) -> float:
    try:
        return float(replicate.get("count", ""))
    except ValueError:
        return 1  # the compiler says what is wrong


def _compiled(path: Path) -> tuple[Any, list[str], _Screen]:
    """The file as MuJoCo compiles it, the bodies whose meshes are left out, and its screen."""
    mujoco = optional_package(
        "mujoco",
        f"{path}: an MJCF file is read by MuJoCo; install it: pip install 'torchcss[mjcf]'",
    )
    screen = _Screen(path)
    root = screen.read(path.name)
    if not screen.num_bodies(root) <= _MOST_BODIES:
        raise BodyError(f"{path}: expands to more than {_MOST_BODIES:,} bodies; not a body's MJCF")
    others = {name: ElementTree.tostring(model) for name, model in screen.attached.items()}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about dynamics
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, "unicode"), include=others)
            meshed: dict[str, None] = {}
            for geom in list(spec.geoms):
                if geom.meshname:
                    meshed[geom.parent.name] = None
                if geom.meshname or geom.hfieldname or int(geom.type) not in (0, *_SOLIDS):
                    spec.delete(geom)
            for joint in spec.joints:
                if joint.range[0] > joint.range[1]:
                    raise ValueError(
                        f"joint {joint.name!r}: expected a range from the least to the greatest"
                    )
            spec.compiler.fusestatic = spec.compiler.discardvisual = False
            spec.compiler.boundmass = spec.compiler.boundinertia = _LIGHT
            return spec.compile(), list(meshed), screen
    except (ValueError, mujoco.FatalError) as error:
        reason = re.sub(r",? line \d+", "", one_line(error))  # of what was handed over
        raise BodyError(f"{path}: MuJoCo cannot read this MJCF: {reason}") from error


class _Reader:
    """Makes links and parts of one body of a compiled model."""

    def __init__(self, model: Any) -> None:
        self.model = model
        self.joints = [JointSpecification(name=BASE, link=BASE, parent=None)]
        self.parts: list[PartSpecification] = []
        self.links: dict[int, str] = {0: BASE}
        self.has_root = False
        self.names: dict[int, str] = {}

    def read(self, chosen: int, notes: tuple[str, ...]) -> HungTree:
        """The tree that hangs on a body of the world, and its parts."""
        for body in np.flatnonzero(self.model.body_rootid == chosen).tolist():
            self._body(body)
            for geom in np.flatnonzero(self.model.geom_bodyid == body).tolist():
                self._part(geom, self.links[body])
        del self.links[0]
        places = tuple(self.links.values())
        notes += tuple(self._couple())
        solids = tuple(self.parts)
        return HungTree(tuple(self.joints), {}, notes, places, self.has_root, solids=solids)

    def _couple(self) -> Iterator[str]:
        """Let joints follow others by the file's equalities; yield what was left out."""
        model, mimics = self.model, {}
        for index in np.flatnonzero(model.eq_type == _JOINT_EQUALITY).tolist():
            first, second = (int(ids[index]) for ids in (model.eq_obj1id, model.eq_obj2id))
            if first not in self.names:
                continue
            offset, factor, *higher = model.eq_data[index][:5].tolist()
            if second not in self.names or not factor or any(higher) or not model.eq_active0[index]:
                yield f"joint {self.names[first]!r}: its equality is left out, off or not linear"
            else:
                mimics[self.names[first]] = (self.names[second], factor, offset)
        self.joints = [replace(each, mimic=mimics.get(each.name)) for each in self.joints]

    def _body(self, body: int) -> None:
        model = self.model
        name = model.body(body).name or f"body{len(self.joints)}"
        parent = self.links[int(model.body_parentid[body])]
        place = frame_at(from_quaternion(model.body_quat[body]), model.body_pos[body])
        anchor = np.zeros(3)
        for joint in np.flatnonzero(model.jnt_bodyid == body).tolist():
            if model.jnt_type[joint] == 0:
                self.has_root = True
                # A free body is where it is put; its drawn place only says which way is up.
                place[:3, 3] = 0.0
                continue
            at = model.jnt_pos[joint]
            for turn in self._turns(joint, name):
                parent = self._hang(turn, f"{turn.name}_link", parent, place, at - anchor)
                anchor, place = at, np.eye(4)
        fixed = JointSpecification(name=f"{name}_fixed", link=name, parent=parent)
        self.links[body] = self._hang(fixed, name, parent, place, -anchor)

    def _hang(
        self,
        joint: JointSpecification,
        link: str,
        parent: str,
        place: np.ndarray,
        shift: np.ndarray,
    ) -> str:
        """Add a joint and the link below it, shifted from a place in the frame of that above."""
        rotation, where = place[:3, :3], place[:3, 3] + place[:3, :3] @ shift
        if not (np.abs(where) < _FAR).all():
            raise BodyError(
                f"body {link!r}: expected places below {_FAR:g} metres, found {where.tolist()}"
            )
        at, turn = as_vector(where), as_rows(rotation)
        self.joints.append(replace(joint, link=link, parent=parent, translation=at, rotation=turn))
        return link

    def _turns(self, joint: int, body: str) -> list[JointSpecification]:
        """One degree of freedom each; names, kinds, axes and limits only."""
        model, kind = self.model, int(self.model.jnt_type[joint])
        name = model.joint(joint).name or f"{body}_joint{len(self.joints)}"
        if kind != 1:
            self.names[joint] = name
        limits, is_limited = model.jnt_range[joint], bool(model.jnt_limited[joint])
        turn = JointSpecification(name=name, link="", parent="", kind="revolute")
        if kind == 1:  # a ball
            most = float(limits[1]) if is_limited else math.pi
            ends = zip("xyz", np.eye(3), (most, min(most, 0.5 * math.pi), most), strict=True)
            return [
                replace(turn, name=f"{name}_{letter}", axis=as_vector(axis), lower=-end, upper=end)
                for letter, axis, end in ends
            ]
        if is_limited:
            lower, upper = (limits - model.qpos0[model.jnt_qposadr[joint]]).tolist()
            turn = replace(turn, lower=lower, upper=upper)
        kind = "revolute" if kind == 3 else "prismatic"
        return [replace(turn, kind=kind, axis=as_vector(model.jnt_axis[joint]))]

    def _part(self, geom: int, link: str) -> None:
        model = self.model
        if int(model.geom_type[geom]) not in _SOLIDS:
            return
        kind, num_sizes = _SOLIDS[int(model.geom_type[geom])]
        own = model.geom(geom).name or link
        size, place = model.geom_size[geom][:num_sizes], model.geom_pos[geom]
        if not ((size > 1e-6).all() and (np.abs([*size, *place]) < _FAR).all()):
            raise BodyError(
                f"geom {own!r}: expected sizes above 1e-6 and below {_FAR:g} metres, "
                f"found {size.tolist()}"
            )
        self.parts.append(
            PartSpecification(
                name=unused(own, [part.name for part in self.parts]),
                link=link,
                translation=as_vector(place),
                rotation=as_rows(from_quaternion(model.geom_quat[geom])),
                shape=solid_shape(kind, size.tolist()),
            )
        )
