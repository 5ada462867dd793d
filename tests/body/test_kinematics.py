"""The tree: poses and twists against hand-written kinematics, URDF files, and their errors."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import pytest
import pytorch_kinematics as pk
import torch
from reference import kinematics as reference
from torch import Tensor
from torch.autograd import forward_ad

from torchcss.body.catalog import BODY_NAMES
from torchcss.body.chain import JointSpecification
from torchcss.body.kinematics import KinematicTree
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.errors import BodyError, ShapeError
from torchcss.kernels import compiler

ROBOTS = {"panda": 9, "iiwa7": 7, "ur5": 6, "anymal_b": 12, "poppy_torso": 13}
"""Moving joints of the robots in the shared data."""


def by_hand(tree: KinematicTree, q: Tensor) -> tuple[Tensor, Tensor]:
    values = dict(zip(tree.joint_names, q.unbind(-1), strict=True))
    poses = reference.forward_kinematics(tree.specifications, values)
    batch = q.shape[:-1]
    turns = [poses[name][0].expand(*batch, 3, 3) for name in tree.link_names]
    origins = [poses[name][1].expand(*batch, 3) for name in tree.link_names]
    return torch.stack(turns, dim=-3), torch.stack(origins, dim=-2)


def awkward_tree() -> KinematicTree:
    """Branches, oblique axes that are not unit, turned offsets, fixed joints in between."""
    turn = reference.rotation(0.3, 1.0, -2.0)
    rotation = tuple(tuple(row) for row in turn.tolist())
    return KinematicTree(
        [
            JointSpecification(name="root", link="base", parent=None),
            JointSpecification(
                name="a", link="A", parent="base", kind="revolute", axis=(1.0, 2.0, -3.0),
                translation=(0.1, 0.2, 0.3), rotation=rotation,
            ),
            JointSpecification(
                name="slide", link="B", parent="A", kind="prismatic", axis=(0.0, 5.0, 1.0),
                rotation=rotation, translation=(0.0, 0.0, 1.0),
            ),
            JointSpecification(name="weld", link="W", parent="B", translation=(0.5, 0.0, 0.0)),
            JointSpecification(
                name="c", link="C", parent="W", kind="revolute", axis=(0.0, 0.0, 1e-3)
            ),
            JointSpecification(
                name="d", link="D", parent="base", kind="revolute", axis=(0.0, -1.0, 0.0)
            ),
            JointSpecification(
                name="e", link="E", parent="A", kind="prismatic", translation=(1.0, 0.0, 0.0)
            ),
        ]
    )  # fmt: skip


def trees() -> list:
    bodies = [load_body(name, free_proportions=True).tree for name in BODY_NAMES]
    names = [*BODY_NAMES, "awkward"]
    return [
        pytest.param(tree, id=n) for tree, n in zip([*bodies, awkward_tree()], names, strict=True)
    ]


@pytest.mark.parametrize("tree", trees())
def test_poses_are_those_of_rodrigues(tree: KinematicTree, generator: torch.Generator) -> None:
    q = 3 * torch.randn(4, tree.num_joints, generator=generator, dtype=torch.float64)
    rotation, translation, *_ = tree(q)
    expected_rotation, expected_translation = by_hand(tree, q)
    torch.testing.assert_close(rotation, expected_rotation, rtol=0, atol=1e-13)
    torch.testing.assert_close(translation, expected_translation, rtol=0, atol=1e-12)


BODIES = [*BODY_NAMES, *(f"robot_models/{name}.urdf" for name in ROBOTS)]
BODIES += ["mocap_cmu/01_01.bvh", "mocap_cmu/scaled_131_01.bvh"]
BODIES += [f"robot_models/{name}.xml" for name in ("humanoid_gym", "humanoid_CMU")]


@pytest.mark.parametrize("name", BODIES)
def test_the_evaluation_has_the_poses_of_the_chain(
    name: str, shared_data: Path, generator: torch.Generator
) -> None:
    """`BodyModel.pose` is the twin of pytorch-kinematics' forward kinematics, on every body."""
    if name.endswith(".xml"):
        pytest.importorskip("mujoco", reason="comes with the extra [mjcf]")
    body = load_body(name if name in BODY_NAMES else shared_data / name)
    turn = reference.rotation(1.0, -0.2, 0.7)
    body = body.with_base(turn, torch.tensor([0.3, -2.0, 1.0]))
    x = torch.randn(2, 3, body.num_parameters, generator=generator, dtype=torch.float64)
    tree, chain = body.tree, body.tree.chain
    assert list(tree.joint_names) == chain.get_joint_parameter_names()
    assert list(tree.link_names) == sorted(chain.frame_to_idx, key=chain.frame_to_idx.__getitem__)
    theirs, ours = body.forward_kinematics(x), body.pose(x).tree
    torch.testing.assert_close(ours.rotation, theirs[..., :3, :3], rtol=0, atol=1e-12)
    torch.testing.assert_close(ours.translation, theirs[..., :3, 3], rtol=0, atol=1e-12)
    single = body.to(torch.float32).forward_kinematics(x[0, 0].float())
    torch.testing.assert_close(single, theirs[0, 0].float(), rtol=0, atol=1e-4)
    with pytest.raises(ShapeError):
        body.forward_kinematics(x[..., 1:])


@pytest.mark.parametrize("tree", trees())
def test_twists_move_points_as_autograd_says(
    tree: KinematicTree, generator: torch.Generator
) -> None:
    q = torch.randn(tree.num_joints, generator=generator, dtype=torch.float64)
    offset = torch.randn(len(tree.link_names), 3, generator=generator, dtype=torch.float64)
    base = reference.rotation(1.0, -0.2, 0.7)
    shift = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64)

    def points(q: Tensor) -> Tensor:
        turn, origin = by_hand(tree, q)
        return ((turn @ offset[..., None])[..., 0] + origin) @ base.T + shift

    jacobian = torch.autograd.functional.jacobian(points, q)
    pose = tree(q, torch.cat([base, shift[:, None]], dim=1))
    p = points(q)
    arm = torch.linalg.cross(pose.omega[:, None, :].expand(-1, len(p), -1), p.expand(len(q), -1, 3))
    velocity = (arm + pose.velocity[:, None, :]) * tree.ancestors[..., None]
    torch.testing.assert_close(velocity.permute(1, 2, 0), jacobian, rtol=0, atol=1e-12)
    moved = jacobian.abs().amax(dim=1).T > 1e-12
    assert (moved <= tree.ancestors).all()
    links = {joint.name: tree.link_index(joint.link) for joint in tree.specifications}
    below = tree.ancestors[:, [links[name] for name in tree.joint_names]]
    assert torch.equal(tree.joint_ancestors, below)
    assert tree.joint_ancestors.diagonal().all()


@pytest.mark.parametrize("poses", [lambda tree, q: tree(q).translation,
                                   lambda tree, q: tree.link_poses(q)[..., :3, 3]])  # fmt: skip
def test_second_derivatives_are_those_of_finite_differences(
    poses: Callable[[KinematicTree, Tensor], Tensor], generator: torch.Generator
) -> None:
    """The trap of pytorch-kinematics' default backward: see section 0 of the field notes."""
    tree = load_body("arm8").tree
    q = torch.randn(tree.num_joints, generator=generator, dtype=torch.float64)
    weight = torch.randn(len(tree.link_names), 3, generator=generator, dtype=torch.float64)

    def gradient(q: Tensor, create_graph: bool = False) -> Tensor:
        q = q if q.requires_grad else q.detach().requires_grad_()
        value = (weight * poses(tree, q)).sum().square()
        return torch.autograd.grad(value, q, create_graph=create_graph)[0]

    leaf = q.clone().requires_grad_()
    rows = gradient(leaf, create_graph=True)
    hessian = torch.stack([torch.autograd.grad(row, leaf, retain_graph=True)[0] for row in rows])
    step = 1e-6
    shifts = step * torch.eye(len(q), dtype=torch.float64)
    differences = torch.stack([(gradient(q + s) - gradient(q - s)) / (2 * step) for s in shifts])
    torch.testing.assert_close(hessian, differences, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", [*BODY_NAMES, "awkward"])
def test_one_compiled_call_is_the_same(
    name: str, dtype: torch.dtype, generator: torch.Generator
) -> None:
    """Tensors that want a derivative take the other way, and so do those of `torch.func`."""
    tree = (awkward_tree() if name == "awkward" else load_body(name).tree).to(dtype)
    turn = reference.rotation(0.3, 1.0, -2.0)
    base = torch.cat([turn, torch.tensor([[1.0], [2.0], [3.0]])], dim=1).to(dtype)
    for batch in ((), (0,), (1,), (3, 2)):
        q = torch.randn(*batch, tree.num_joints, generator=generator, dtype=torch.float64)
        q = q.to(dtype)
        compiled, plain = tree(q, base), tree(q.clone().requires_grad_(), base)
        assert plain.rotation.requires_grad
        for one, other in zip(compiled, plain, strict=True):
            torch.testing.assert_close(
                one, other.detach(), rtol=0, atol=2e-5 if dtype == torch.float32 else 1e-12
            )


@pytest.mark.skipif(not compiler.AVAILABLE, reason="numba is not installed")
def test_no_index_of_the_compiled_call_is_out_of_range() -> None:
    program = (
        "import torch; from torchcss.body.load import load_body\n"
        "body = load_body('body34'); body.pose(torch.zeros(2, 34).double()); print('checked')"
    )
    environment = {**os.environ, "TORCHCSS_CHECK_KERNELS": "1"}
    run = [sys.executable, "-c", program]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "checked\n", done.stderr


def test_poses_inside_transforms(generator: torch.Generator) -> None:
    tree = awkward_tree()
    q = torch.randn(4, tree.num_joints, generator=generator, dtype=torch.float64)

    def places(q: Tensor) -> Tensor:
        return tree(q).translation

    torch.testing.assert_close(torch.func.vmap(places)(q), places(q))
    backward = torch.func.jacrev(places)(q[0])
    torch.testing.assert_close(torch.func.jacfwd(places)(q[0]), backward)
    with forward_ad.dual_level():
        dual = places(forward_ad.make_dual(q[0], torch.ones_like(q[0])))
        torch.testing.assert_close(forward_ad.unpack_dual(dual).tangent, backward.sum(-1))


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    tree = awkward_tree().to(dtype)
    pose = tree(torch.zeros(*batch, tree.num_joints, dtype=dtype))
    links, joints = len(tree.link_names), tree.num_joints
    assert pose.rotation.shape == (*batch, links, 3, 3)
    assert pose.translation.shape == (*batch, links, 3)
    assert pose.omega.shape == pose.velocity.shape == (*batch, joints, 3)
    assert all(part.dtype == dtype for part in pose)


def test_wrong_states_are_refused() -> None:
    tree = awkward_tree()
    with pytest.raises(ShapeError, match="expected a shape"):
        tree(torch.zeros(3, dtype=torch.float64))
    with pytest.raises(BodyError, match="no link 'nose'"):
        tree.link_index("nose")


# URDF files.


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_load_and_agree_with_pytorch_kinematics(
    name: str, shared_data: Path, generator: torch.Generator
) -> None:
    path = shared_data / "robot_models" / f"{name}.urdf"
    body = load_body(path)
    tree = body.tree
    assert tree.num_joints == ROBOTS[name]
    theirs = pk.build_chain_from_urdf(path.read_bytes()).to(dtype=torch.float64)
    assert list(tree.joint_names) == theirs.get_joint_parameter_names()
    q = torch.randn(6, tree.num_joints, generator=generator, dtype=torch.float64)
    expected = theirs.forward_kinematics(q)
    rotation, translation, *_ = tree(q)
    assert set(tree.link_names) == set(expected)
    for link, pose in expected.items():
        matrix = pose.get_matrix()
        index = tree.link_index(link)
        # Their numbers have passed through float32 and are not orthonormal; ours are.
        torch.testing.assert_close(rotation[:, index], matrix[:, :3, :3], rtol=0, atol=3e-7)
        torch.testing.assert_close(translation[:, index], matrix[:, :3, 3], rtol=0, atol=3e-7)
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, rtol=0, atol=1e-13)
    torch.testing.assert_close(translation, by_hand(tree, q)[1], rtol=0, atol=3e-7)
    joints = {
        joint.get("name"): joint for joint in ElementTree.parse(path).getroot().findall("joint")
    }
    for row, joint in enumerate(tree.joint_names):
        limit = joints[joint].find("limit")
        if limit is None or joints[joint].get("type") == "continuous":
            expected_limits = (-math.inf, math.inf)
        else:
            expected_limits = (float(limit.get("lower", 0)), float(limit.get("upper", 0)))
        assert (float(tree.lower[row]), float(tree.upper[row])) == expected_limits
    assert torch.isfinite(body.rest).all()
    assert body.pose(body.rest).joints.shape == (len(tree.link_names), 3)


def test_mimic_fingers_of_panda_share_a_parameter(shared_data: Path) -> None:
    body = load_body(shared_data / "robot_models" / "panda.urdf")
    assert body.tree.num_joints == 9
    assert body.num_parameters == 8
    assert "panda_finger_joint2" not in body.state_names
    x = torch.zeros(8, dtype=torch.float64)
    x[body.state_index("panda_finger_joint1")] = 0.03
    joints = body.pose(x).joints
    rest = body.pose(torch.zeros_like(x)).joints
    for finger in ("panda_leftfinger", "panda_rightfinger"):
        moved = joints[body.joint_index(finger)] - rest[body.joint_index(finger)]
        assert float(moved.norm()) == pytest.approx(0.03)


LINKS = "<link name='a'/><link name='b'/>"


def joint(
    inside: str = "",
    *,
    name: str = "j",
    kind: str = "revolute",
    parent: str = "a",
    child: str = "b",
) -> str:
    return (
        f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>"
        f"{inside}</joint>"
    )


def robot(inside: str) -> str:
    return f"<robot name='r'>{inside}</robot>"


def load(folder: Path, text: str) -> BodyModel:
    path = folder / "robot.urdf"
    path.write_text(text)
    return load_body(path)


THREE = LINKS + "<link name='c'/>" + joint("<limit lower='-1' upper='2'/>")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param("", "the file is empty", id="empty file"),
        pytest.param("hello, world", "XML does not parse", id="not XML"),
        pytest.param("\x00\x01\x02", "XML does not parse", id="binary"),
        pytest.param("<?xml version='1.0' encoding='latin-17'?><robot/>", "parse", id="encoding"),
        pytest.param("<mujoco><worldbody/></mujoco>", "found <mujoco>", id="MJCF"),
        pytest.param(robot(""), "expected <robot> with links", id="no links"),
        pytest.param(
            robot(THREE + joint(kind="floating", name="k", parent="b", child="c")),
            "'floating'; supported", id="floating below the root",
        ),
        pytest.param(robot(LINKS + joint(kind="planar")), "'planar'; supported", id="planar"),
        pytest.param(robot(THREE + joint(child="c")), "same name", id="duplicate joint"),
        pytest.param(
            robot(LINKS + joint().replace("name=", "nam=", 1)), "or one has none", id="no name"
        ),
        pytest.param(robot(LINKS + LINKS + joint()), "a link occurs twice", id="duplicate link"),
        pytest.param(robot(LINKS), r"one root link, found \['a', 'b'\]", id="two roots"),
        pytest.param(
            robot(LINKS + joint() + joint(name="k", parent="b", child="a")),
            r"one root link, found \[\]", id="no root",
        ),
        pytest.param(
            robot(
                THREE + "<link name='d'/>" + joint(name="k", parent="c", child="d")
                + joint(name="l", parent="d", child="c")
            ),
            r"\['c', 'd'\] form a loop", id="loop beside a tree",
        ),
        pytest.param(robot(LINKS + joint(child="z")), r"not exist: \['z'\]", id="unknown link"),
        pytest.param(
            robot(LINKS + "<joint name='j' type='fixed'><child link='b'/></joint>"),
            "no <parent", id="no parent",
        ),
        pytest.param(robot(LINKS + joint("<axis xyz='0 0 0'/>")), "axis not zero", id="zero axis"),
        pytest.param(robot(LINKS + joint("<axis xyz='0 1'/>")), "3 numbers", id="short axis"),
        pytest.param(robot(LINKS + joint("<axis xyz='x y z'/>")), "'x y z'", id="no number"),
        pytest.param(robot(LINKS + joint("<axis xyz='inf 0 1'/>")), "'inf 0", id="infinite axis"),
        pytest.param(robot(LINKS + joint("<origin xyz='nan 0 0'/>")), "'nan 0 0'", id="origin NaN"),
        pytest.param(robot(LINKS + joint("<origin rpy='1 2'/>")), "3 numbers", id="origin"),
        pytest.param(robot(LINKS + joint("<limit lower='low'/>")), "'low'", id="limit"),
        pytest.param(robot(LINKS + joint("<limit lower='nan'/>")), "lower limit", id="limit NaN"),
        pytest.param(
            robot(LINKS + joint("<limit lower='1' upper='0'/>")), "lower limit 1", id="no range"
        ),
        pytest.param(
            robot(THREE + joint("<mimic joint='k'/>", name="k", child="c")), "'k'", id="mimics self"
        ),
        pytest.param(
            robot(THREE + joint("<mimic joint='j' multiplier='0'/>", name="k", child="c")),
            "multiplier 0", id="mimics nothing",
        ),
        pytest.param(
            robot(THREE + joint("<mimic joint='j' offset='far'/>", name="k", child="c")),
            "'far'", id="mimic offset",
        ),
        pytest.param(
            robot(
                THREE
                + joint("<mimic joint='j'/><limit lower='5' upper='6'/>", name="k", child="c")
            ),
            "exclude each other", id="limits exclude each other",
        ),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BodyError, match=message) as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_numbers_of_a_urdf_keep_all_their_digits(tmp_path: Path) -> None:
    text = "<origin xyz='0.1 -0.2 0.3' rpy='0.3 0 0'/><axis xyz='0 0.6 0.8'/>"
    (_, turned) = load(tmp_path, robot(LINKS + joint(text))).tree.specifications
    assert turned.translation == (0.1, -0.2, 0.3)
    assert turned.axis == (0.0, 0.6, 0.8)
    assert turned.rotation[1:] == (
        (0.0, math.cos(0.3), -math.sin(0.3)), (0.0, math.sin(0.3), math.cos(0.3))
    )  # fmt: skip


def test_a_joint_that_mimics_none_is_free_and_said(tmp_path: Path) -> None:
    body = load(tmp_path, robot(THREE + joint("<mimic joint='z'/>", name="k", child="c")))
    assert body.num_parameters == 2
    assert any("'k' mimics 'z'" in note for note in body.notes)


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BodyError, match="there is no such file"):
        load_body(tmp_path / "nowhere.urdf")
    with pytest.raises(BodyError, match=r"no body .*arm7"):
        load_body("arm9")
    with pytest.raises(BodyError, match=r"no body .* ends in \.urdf"):
        load_body(tmp_path)
    (tmp_path / "folder.urdf").mkdir()
    with pytest.raises(BodyError, match=r"folder\.urdf: expected a file, found a folder"):
        load_body(tmp_path / "folder.urdf")


def test_what_urdf_leaves_out(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """Axis x, no limits, no inertias; meshes, colours and foreign tags do not matter."""
    odd = "<visual><geometry><mesh/></geometry></visual><inertial/>"
    text = robot(f"<link name='a'>{odd}</link><link name='b'/><gazebo/>" + joint("<weird/>"))
    body = load(tmp_path, "<?xml version='1.0' encoding='utf-8'?>" + text)
    assert [joint.axis for joint in body.tree.specifications if joint.kind != "fixed"] == [
        (1, 0, 0)
    ]
    assert body.bounds.lower.tolist() == [-math.inf]
    assert body.bounds.upper.tolist() == [math.inf]
    assert body.rest.tolist() == [0.0]
    assert capfd.readouterr() == ("", "")


def test_limits_without_effort_and_of_continuous_joints(tmp_path: Path) -> None:
    limit = "<limit lower='-1' upper='0.5'/>"
    body = load(tmp_path, robot(LINKS + joint(limit)))
    assert (float(body.lower), float(body.upper)) == (-1.0, 0.5)
    body = load(tmp_path, robot(LINKS + joint(limit, kind="continuous")))
    assert (float(body.lower), float(body.upper)) == (-math.inf, math.inf)
    body = load(tmp_path, robot(LINKS + joint("<limit lower='0.2' upper='0.5'/>")))
    assert float(body.rest) == 0.2


def test_mimic_joint_narrows_the_limits_and_keeps_its_offset(tmp_path: Path) -> None:
    follower = "<mimic joint='j' multiplier='-2' offset='0.5'/><limit lower='-1' upper='2'/>"
    body = load(tmp_path, robot(THREE + joint(follower, name="k", child="c")))
    assert body.state_names == ("j",)
    assert (float(body.lower), float(body.upper)) == (-0.75, 0.75)
    q = torch.tensor([0.3], dtype=torch.float64) @ body.tie.T + body.offset
    torch.testing.assert_close(q, torch.tensor([0.3, -0.1], dtype=torch.float64))


def test_robots_without_moving_joints_stand_still(tmp_path: Path) -> None:
    for text in (robot("<link name='a'/>"), robot(LINKS + joint(kind="fixed"))):
        body = load(tmp_path, text)
        assert body.num_parameters == 0
        pose = body.pose(torch.zeros(4, 0, dtype=torch.float64))
        assert pose.joints.shape == (4, len(body.joint_names), 3)
        assert not pose.joints.any()


def test_a_joint_may_be_called_root(tmp_path: Path) -> None:
    assert load(tmp_path, robot(LINKS + joint(name="root"))).state_names == ("root",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "a"}, "joint names must be unique; repeated: a"),
        ({"link": "A"}, "link names must be unique; repeated: A"),
        ({"parent": None}, "exactly one root"),
        ({"parent": "Z"}, "must form one tree"),
        ({"kind": "ball"}, "type 'ball'"),
        ({"axis": (0.0, 0.0, 0.0)}, "not zero"),
        ({"lower": 2.0, "upper": 1.0}, "lower limit"),
        ({"translation": (math.inf, 0.0, 0.0)}, "finite"),
    ],
)
def test_bad_specifications_are_refused(change: dict, message: str) -> None:
    root = JointSpecification(name="root", link="base", parent=None)
    first = JointSpecification(name="a", link="A", parent="base", kind="revolute")
    second = {"name": "b", "link": "B", "parent": "A", "kind": "revolute", **change}
    with pytest.raises(BodyError, match=message):
        KinematicTree([root, first, JointSpecification(**second)])
