"""Figures of states and covariances over time: that they show what the track says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from made_clip import grey_film
from made_robots import write_arm
from made_tracks import make_track
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection, PathCollection
from matplotlib.figure import Figure

from torchcss.body.bases import pose_track
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.uncertainty import joint_covariance
from torchcss.cli import main as cli
from torchcss.errors import TrackFileError
from torchcss.io.tracks import TRACK_NAME, Track, save_track
from torchcss.show.posterior_plots import angles_figure, joints_figure, spectra_figure
from torchcss.show.style import DEVIATIONS, save_figure
from torchcss.show.track_plots import effective_number
from torchcss.studies.render.scene import look_at


@pytest.fixture(scope="module")
def track(body: BodyModel) -> Track:
    return make_track(body, (2, 3, 2, 1))


def panel(figure: Figure, title: str) -> Axes:
    (axes,) = (axes for axes in figure.axes if axes.get_title().startswith(title))
    return axes


def lines(axes: Axes) -> list[np.ndarray]:
    return [
        np.asarray(line.get_ydata()) for line in axes.get_lines() if line.get_linestyle() == "-"
    ]


def band(axes: Axes) -> tuple[float, float]:
    """Lowest and highest place of the band."""
    bands = [c for c in axes.collections if isinstance(c, FillBetweenPolyCollection)]
    heights = np.concatenate(
        [np.asarray(path.vertices)[:, 1] for c in bands for path in c.get_paths()]
    )
    return heights.min(), heights.max()


def test_joints_in_the_world_and_as_the_camera_sees_them(track: Track, body: BodyModel) -> None:
    camera = look_at((0.3, -1.0, 5.0), (0.3, -1.0, 0.0), focal_px=600)  # looks along -Z, level
    elbow, wrist = (track.joint_names.index(f"r_{name}") for name in ("elbow", "wrist"))
    best = track.joints_world[:, 0]
    pose = pose_track(
        body, torch.from_numpy(track.state[:, 0]), torch.from_numpy(track.base_transform)
    )
    spread = joint_covariance(body, pose, torch.from_numpy(track.covariance[:, 0])).numpy()
    deviation = np.sqrt(spread[:, wrist, 2, 2])

    world, seen = joints_figure(track).axes[3:], joints_figure(track, camera=camera).axes
    assert [axes.get_title() for axes in seen[:3]] == [
        "right in the picture (metres)", "up in the picture (metres)",
        "away from the camera (metres)",
    ]  # fmt: skip
    seen = seen[3:]
    np.testing.assert_allclose(lines(world[0])[0], best[:, elbow, 0])
    np.testing.assert_allclose(lines(world[5])[0], best[:, wrist, 2])
    np.testing.assert_allclose(lines(seen[3])[0], best[:, wrist, 0] - 0.3, atol=1e-6)
    np.testing.assert_allclose(lines(seen[4])[0], best[:, wrist, 1] + 1.0, atol=1e-6)
    np.testing.assert_allclose(lines(seen[5])[0], 5.0 - best[:, wrist, 2], atol=1e-6)
    low, high = band(seen[5])
    assert low == pytest.approx((5.0 - best[:, wrist, 2] - DEVIATIONS * deviation).min())
    assert high == pytest.approx((5.0 - best[:, wrist, 2] + DEVIATIONS * deviation).max())
    # The other modes are dots, fainter the less they weigh.
    second = next(c for c in world[0].collections if isinstance(c, PathCollection))
    dots = np.asarray(second.get_offsets())
    np.testing.assert_allclose(dots[:, 1], track.joints_world[:3, 1, elbow, 0])
    share = np.exp(track.log_weight[:3, 1] - track.log_weight[:3, 0])
    np.testing.assert_allclose(np.asarray(second.get_facecolor())[:, 3], 0.15 + 0.85 * share)


def test_parameters_in_degrees_with_their_limits(track: Track, body: BodyModel) -> None:
    figure = angles_figure(track)
    assert len([axes for axes in figure.axes if axes.get_visible()]) == len(track.state_names)
    index = track.state_names.index("r_elbow_flexion")
    axes = panel(figure, "r elbow flexion (degrees)")
    np.testing.assert_allclose(lines(axes)[0], np.degrees(track.state[:, 0, index]))
    limits = [line.get_ydata() for line in axes.get_lines() if line.get_linestyle() == ":"]
    expected = np.degrees([body.lower[index].item(), body.upper[index].item()])
    assert {round(float(np.ravel(limit)[0])) for limit in limits} <= set(expected.round())


def test_a_sliding_joint_is_in_metres(tmp_path: Path) -> None:
    path = write_arm(tmp_path / "arm.urdf", (((0, 0, 0.3), (0, 0, 0), (0, 0, 1), 0.4),) * 2)
    path.write_text(path.read_text().replace("revolute", "prismatic", 1))
    body = load_body(path)
    assert body.is_angle.tolist() == [False, True]
    track = make_track(body)
    axes = panel(angles_figure(track), "joint1 (m)")
    np.testing.assert_allclose(lines(axes)[0], track.state[:, 0, 0])
    assert panel(angles_figure(track), "joint2 (degrees)")


def test_names_of_strangers_are_no_formulas(tmp_path: Path) -> None:
    path = write_arm(tmp_path / "arm.urdf", (((0, 0, 0.3), (0, 0, 0), (0, 0, 1), 0.4),) * 2)
    path.write_text(path.read_text().replace("joint1", r"$\\frac{$").replace("link1", r"$x^{$"))
    track = make_track(load_body(path))
    for figure in (angles_figure(track), joints_figure(track), spectra_figure(track)):
        save_figure(figure, tmp_path / "a.png")


def test_lines_of_the_root_end_where_the_base_moves() -> None:
    track = make_track(load_body("body34"), (1, 1, 1, 1))  # the base moves in every frame
    figure = angles_figure(track)
    assert [len(line) for line in lines(panel(figure, "root x (m)"))] == [1, 1, 1, 1]
    assert [len(line) for line in lines(panel(figure, "l elbow flexion"))] == [4]
    assert joints_figure(track).axes[0].get_ylabel() == "skull tip"


def test_spectra_and_their_widest_directions(body: BodyModel) -> None:
    track = make_track(body, (1, 1, 1))
    covariance = np.tile(1e-4 * np.eye(8), (3, 1, 1, 1))
    covariance[:, 0, 2, 2] = 0.04
    covariance[:, 0, 5, 5] = 0.01
    figure = spectra_figure(track._replace(covariance=covariance))
    assert "all 8 directions; widest over narrowest: 20 (median)" in figure.axes[0].get_title()
    heights = sorted(line[0] for line in lines(figure.axes[0]))
    np.testing.assert_allclose(heights, [0.01] * 6 + [0.1, 0.2])
    first, second = (panel(figure, f"direction {rank}") for rank in (1, 2))
    names = [name.replace("_", " ") for name in track.state_names]
    assert first.get_title().endswith("deviation 0.2")
    assert first.get_yticklabels()[0].get_text() == names[2]
    assert second.get_yticklabels()[0].get_text() == names[5]
    heat = panel(figure, "which parameters")
    assert heat.get_yticklabels()[0].get_text() == names[2]
    shares = np.asarray(heat.collections[0].get_array())
    np.testing.assert_allclose(shares[0], 1.0)
    np.testing.assert_allclose(shares[1:], 0.0, atol=1e-12)


def test_how_many_modes_count(track: Track) -> None:
    even = np.full_like(track.log_weight, -np.inf)
    even[:, 0] = 0.0
    even[1] = np.log(1 / 3)
    even[2, :2] = np.log([0.75, 0.25])
    numbers = effective_number(track._replace(log_weight=even))
    np.testing.assert_allclose(numbers, [1, 3, 1.6, 1])


def test_nothing_to_draw(track: Track, body: BodyModel) -> None:
    none = make_track(body, ())
    for draw in (joints_figure, angles_figure, spectra_figure):
        with pytest.raises(TrackFileError, match="no frames"):
            draw(none)


def test_one_frame_can_be_drawn(body: BodyModel, tmp_path: Path) -> None:
    track = make_track(body, (2,))
    for draw in (joints_figure, angles_figure, spectra_figure):
        save_figure(draw(track), tmp_path / "one.png", dpi=30)


def test_the_verb_writes_every_figure(
    track: Track, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_track(tmp_path / TRACK_NAME, track)
    grey_film(tmp_path / "overlay.mp4", (40, 90, 150, 200))
    out = tmp_path / "figures"
    assert cli.main(["plot", str(tmp_path), "--out", str(out)]) == 0
    names = {"modes", "joints", "angles", "spectra", "side_view", "frames"}
    assert {path.stem for path in out.iterdir()} == names
    assert capsys.readouterr().out.count("wrote") == 6
    assert cli.main(["plot", str(tmp_path), "--frame", "99"]) == 2
    assert "frames 0 to 3" in capsys.readouterr().err
