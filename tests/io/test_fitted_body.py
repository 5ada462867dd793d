"""A fitted body on disk and back, before the same camera or another one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchcss.body.load import load_body
from torchcss.body.shape import with_shape
from torchcss.errors import BodyError
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.io.fitted_body import read_fitted_body, write_fitted_body
from torchcss.vision.camera import Camera


def rotation(generator: torch.Generator) -> torch.Tensor:
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    return turn * turn.det()


@pytest.fixture
def found(generator: torch.Generator) -> Initialisation:
    lengths = {"thigh": 0.40, "forearm": 0.28}
    body = load_body("body34", lengths=lengths, scale=1.05)
    body = with_shape(body, 1.1 * body.part_shape)
    body = body.with_base(rotation(generator), torch.tensor([0.1, 0.2, 3.0]).double())
    x = body.bounds.project(0.2 * torch.randn(2, 34, generator=generator, dtype=torch.float64))
    spread = torch.diag(torch.linspace(0.01, 0.1, 34, dtype=torch.float64)).expand(2, 34, 34)
    weights = torch.tensor([0.7, 0.3], dtype=torch.float64).log()
    mixture = GaussianMixture(x, spread, weights)
    return Initialisation(
        body, mixture, torch.tensor([1.0, 2.0]).double(), (), dict(body.lengths), 1.05
    )


def camera(generator: torch.Generator) -> Camera:
    return Camera(
        [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480),
        R_camera_world=rotation(generator), t_camera_world=[0.1, 0.2, 0.3],
    )  # fmt: skip


def test_what_is_known_of_the_size_stays_known(
    found: Initialisation, generator: torch.Generator, tmp_path: Path
) -> None:
    for doubt in (0.0, 0.02):
        some = found._replace(size_deviation=doubt)
        write_fitted_body(tmp_path / "body.npz", some, camera(generator))
        assert read_fitted_body(tmp_path).size_deviation == doubt
    arrays = dict(np.load(tmp_path / "body.npz"))
    del arrays["size_deviation"]
    np.savez(tmp_path / "earlier.npz", **arrays)
    assert read_fitted_body(tmp_path / "earlier.npz").size_deviation > 0.03


def test_round_trip(found: Initialisation, generator: torch.Generator, tmp_path: Path):
    write_fitted_body(tmp_path / "body.npz", found, camera(generator))
    for path in (tmp_path, tmp_path / "body.npz"):
        back = read_fitted_body(path)
        assert back.body.lengths == pytest.approx(found.body.lengths)
        for got, written in zip(back.mixture, found.mixture, strict=True):
            assert torch.equal(got, written)
        x = found.mixture.mean
        ours, theirs = found.body.pose(x), back.body.pose(x)
        torch.testing.assert_close(ours.joints, theirs.joints)
        torch.testing.assert_close(
            found.body.surface(ours).points, back.body.surface(theirs).points
        )
        assert back.uncapped is None
        assert not back.uncapped_floored
    assert read_fitted_body(tmp_path, dtype=torch.float32).mixture.mean.dtype == torch.float32
    uncapped = 3 * found.mixture.covariance[0]
    some = found._replace(uncapped=uncapped, uncapped_floored=True)
    write_fitted_body(tmp_path / "body.npz", some, camera(generator))
    back = read_fitted_body(tmp_path)
    assert back.uncapped is not None
    assert torch.equal(back.uncapped, uncapped)
    assert back.uncapped_floored


def test_keeps_its_place_before_another_camera(
    found: Initialisation, generator: torch.Generator, tmp_path: Path
):
    first, second = camera(generator), camera(generator)
    write_fitted_body(tmp_path / "body.npz", found, first)
    back = read_fitted_body(tmp_path, camera=second)
    x = found.mixture.mean
    torch.testing.assert_close(
        first.to_camera_frame(found.body.pose(x).joints),
        second.to_camera_frame(back.body.pose(x).joints),
    )


@pytest.mark.parametrize("what", ["missing", "garbage", "version", "array", "shape", "nan", "body"])
def test_damaged_files(
    found: Initialisation, generator: torch.Generator, tmp_path: Path, what: str
):
    path = tmp_path / "body.npz"
    write_fitted_body(path, found, camera(generator))
    arrays = dict(np.load(path))
    changed = {
        "version": {"schema_version": np.array(9)},
        "shape": {"covariance": arrays["covariance"][:1]},
        "nan": {"state": np.full_like(arrays["state"], np.nan)},
        "body": {"body": np.array("body30")},
    }.get(what, {})
    if what == "missing":
        path.unlink()
    elif what == "garbage":
        path.write_bytes(b"hello")
    else:
        arrays.update(changed)
        if what == "array":
            del arrays["lengths"]
        np.savez(path, **arrays)
    with pytest.raises(BodyError, match=r"body\.npz"):
        read_fitted_body(path)


def test_a_track_is_no_fitted_body(tmp_path: Path) -> None:
    np.savez(tmp_path / "track.npz", schema_version=2, state=np.zeros((3, 1, 34)))
    with pytest.raises(BodyError, match=r"track\.npz: not a fitted body.*expected a body\.npz"):
        read_fitted_body(tmp_path / "track.npz")


ROBOT = (
    "<robot name='r'><link name='a'/><link name='b'/><link name='c'/>"
    "<joint name='j' type='continuous'><parent link='a'/><child link='b'/></joint>"
    "<joint name='k' type='fixed'><parent link='b'/><child link='c'/><origin xyz='0 0 1'/>"
    "</joint></robot>"
)


def fitted_robot(path: Path) -> Initialisation:
    """A robot that was given a root for the fit; the file is its body's name."""
    path.write_text(ROBOT)
    body = load_body(path, free_root=True)
    spread = torch.eye(7, dtype=torch.float64)[None]
    mixture = GaussianMixture(body.rest[None], spread, torch.zeros(1).double())
    return Initialisation(body, mixture, torch.zeros(1).double(), ())


def test_a_body_from_a_file_is_found_again(tmp_path: Path, generator: torch.Generator):
    path = tmp_path / "robot.urdf"
    found = fitted_robot(path)
    body = found.body
    write_fitted_body(tmp_path / "body.npz", found, camera(generator))
    back = read_fitted_body(tmp_path / "body.npz")
    assert back.body.name == str(path)
    assert back.body.state_names == body.state_names
    assert back.body.part_names == ("b",)


def test_the_file_of_a_body_is_found_from_anywhere(
    tmp_path: Path, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
):
    made, elsewhere, moved = (tmp_path / name for name in ("made", "elsewhere", "moved"))
    for folder in (made / "robots", elsewhere, moved / "robots"):
        folder.mkdir(parents=True)
    monkeypatch.chdir(made)
    given = Path("robots/robot.urdf")
    write_fitted_body("body.npz", fitted_robot(given), camera(generator))
    (moved / "body.npz").write_bytes((made / "body.npz").read_bytes())
    monkeypatch.chdir(elsewhere)
    assert read_fitted_body(made).body.name == str(made / given)
    assert read_fitted_body(moved).body.name == str(made / given)
    # Gone from where it was: it lies as before relative to the fitted body, or just beside it.
    (made / given).rename(moved / given)
    assert read_fitted_body(moved).body.name == str(moved / given)
    (moved / given).rename(moved / "robot.urdf")
    assert read_fitted_body(moved).body.name == str(moved / "robot.urdf")
    (moved / "robot.urdf").unlink()
    with pytest.raises(BodyError, match=r"tried .*made/robots.*, .*moved/robots.*, .*moved/robot"):
        read_fitted_body(moved)


def robot_with_changed_parameters(path: Path) -> Initialisation:
    """A robot whose limits, prior and neighbours are not those of its file."""
    found = fitted_robot(path)
    body = found.body
    body.lower[-1], body.upper[-1] = -0.5, 0.75
    body.sticky_mean[-1], body.sticky_deviation[-1] = 0.1, 0.3
    body.motion_rate[-1] = 1.25
    body.neighbours = (("b", "b"),)
    return found


def test_changed_limits_prior_and_neighbours_survive(tmp_path: Path, generator: torch.Generator):
    found = robot_with_changed_parameters(tmp_path / "robot.urdf")
    body = found.body
    write_fitted_body(tmp_path / "body.npz", found, camera(generator))
    back = read_fitted_body(tmp_path).body
    assert back.neighbours == (("b", "b"),)
    for name in ("lower", "upper", "sticky_mean", "sticky_deviation", "motion_rate"):
        assert torch.equal(back.get_buffer(name), body.get_buffer(name))


def test_a_file_without_limits_has_those_of_its_body(tmp_path: Path, generator: torch.Generator):
    path = tmp_path / "body.npz"
    write_fitted_body(path, robot_with_changed_parameters(tmp_path / "r.urdf"), camera(generator))
    older = dict(np.load(path))
    for name in ("lower", "upper", "sticky_mean", "sticky_deviation", "motion_rate", "neighbours"):
        del older[name]
    np.savez(path, **older)
    body, plain = read_fitted_body(path).body, load_body(tmp_path / "r.urdf", free_root=True)
    assert body.neighbours == plain.neighbours
    assert torch.equal(body.lower, plain.lower)
    assert torch.equal(body.sticky_deviation, plain.sticky_deviation)


@pytest.mark.parametrize(
    "changed",
    [
        {"lower": np.zeros(3)},
        {"upper": np.full(7, np.nan)},
        {"lower": np.full(7, 9.0)},
        {"sticky_deviation": np.zeros(7)},
        {"neighbours": np.array([["b", "nobody"]])},
    ],
)
def test_damaged_limits_prior_and_neighbours(
    tmp_path: Path, generator: torch.Generator, changed: dict[str, np.ndarray]
):
    path = tmp_path / "body.npz"
    write_fitted_body(path, robot_with_changed_parameters(tmp_path / "r.urdf"), camera(generator))
    np.savez(path, **{**dict(np.load(path)), **changed})
    with pytest.raises(BodyError, match=rf"body\.npz: .*{next(iter(changed))}"):
        read_fitted_body(path)
