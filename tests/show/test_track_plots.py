"""Figures of a track: that they show what the track says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from made_clip import grey_film
from made_tracks import make_track
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError, ShapeError, TrackFileError
from torchcss.io.tracks import Track
from torchcss.show import track_plots
from torchcss.show.overlay import PALETTE, ProjectedBody, draw_overlay
from torchcss.show.style import save_figure
from torchcss.studies.render.scene import look_at
from torchcss.vision.camera import Camera


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def places(line: object) -> np.ndarray:
    """The corners of a stick figure, gaps left out."""
    points = np.column_stack(line.get_data())  # pyright: ignore[reportAttributeAccessIssue]
    return points[np.isfinite(points).all(-1)]


def test_bones_join_a_body_in_one_piece() -> None:
    for name in ("arm8", "body34"):
        body = load_body(name)
        bones = track_plots.bones_of(body)
        # A tree over all joint centres: every one but the first hangs on one before it.
        assert [b for _, b in bones] == list(range(1, len(body.joint_names)))
        assert all(a < b for a, b in bones)
    named = {tuple(body.joint_names[i] for i in bone) for bone in bones}
    assert {("l_elbow", "l_wrist"), ("vt1", "r_shoulder"), ("HumanoidRoot", "l_hip")} <= named


def test_the_side_view_shows_depth_and_spread(track: Track, body: BodyModel) -> None:
    camera = look_at((0.3, -1.0, 5.0), (0.3, -1.0, 0.0), focal_px=600)  # looks along -Z, level
    truth = {"r_elbow": track.joints_world[1, 0, 1], "RWrist": track.joints_world[1, 0, 2]}
    figure = track_plots.side_view_figure(track, 11, camera=camera, reference=truth)
    front, side = figure.axes
    assert len(legend(figure)) == 4  # the reference and three modes, the best first
    assert legend(figure)[1].startswith(f"{100 * np.exp(track.log_weight[1, 0]):.0f} %")
    lines = side.get_lines()  # the best mode is drawn after the others, the reference last
    best = places(lines[2])
    joints = track.joints_world[1, 0]
    expected = np.stack([5.0 - joints[:, 2], joints[:, 1] + 1.0], -1)
    np.testing.assert_allclose(best[[0, 1, 3, 5]], expected, atol=1e-5)
    np.testing.assert_allclose(places(lines[3]), expected[[1, 2]], atol=1e-5)
    # As the camera sees it: all points are at the best mode's mean depth.
    distance = expected[:, 0].mean()
    seen = (joints[:, 0] - 0.3) * distance / expected[:, 0]
    np.testing.assert_allclose(places(front.get_lines()[2])[[0, 1, 3, 5], 0], seen, atol=1e-5)
    weights = [line.get_alpha() for line in lines[:3]]
    assert weights == sorted(weights)
    assert weights[2] == 1.0
    ellipses = [patch for patch in side.patches if isinstance(patch, Ellipse)]
    assert len(ellipses) == 3 * 3  # shoulder, elbow, wrist; the tip is rigid with the wrist


def test_ellipses_have_one_standard_deviation() -> None:
    covariance = np.diag([9.0, 0.01, 0.04])  # camera's x, y, z
    ellipse = track_plots._one_deviation(np.array([3.0, 1.0]), covariance)
    assert ellipse.get_center() == (3.0, -1.0)
    assert (ellipse.width, ellipse.height) == pytest.approx((0.4, 0.2))
    assert ellipse.angle % 180 == pytest.approx(0)
    covariance[1, 2] = covariance[2, 1] = -0.015  # farther is less y, which is higher
    turned = track_plots._one_deviation(np.array([3.0, 1.0]), covariance)
    assert 0 < turned.angle % 180 < 90


def test_a_reference_that_is_not_known_is_left_out(track: Track) -> None:
    unknown = {"r_elbow": np.full(3, np.nan), "r_wrist": np.zeros(3)}
    figure = track_plots.side_view_figure(track, 12, reference=unknown)
    assert "reference" not in legend(figure)
    with pytest.raises(ShapeError, match="three numbers"):
        track_plots.side_view_figure(track, 12, reference={"r_wrist": np.zeros(2)})
    with pytest.raises(ConfigurationError, match="frames 10 to 12"):
        track_plots.side_view_figure(track, 2)


def test_what_is_behind_the_camera_is_not_seen_and_spoils_no_scale(track: Track) -> None:
    points = np.array([[0.1, 0.2, 0.5], [0.1, 0.2, -0.5], [0.1, 0.2, 1e-9]])
    np.testing.assert_allclose(
        track_plots.in_perspective(points, 1.0), [[0.2, 0.4], [np.nan] * 2, [np.nan] * 2]
    )
    nearest = track.joints_world[0, 0, :, 2].min()
    place = torch.tensor([0.0, 0.0, -float(nearest) - 1e-6], dtype=torch.float64)
    camera = Camera(torch.eye(3), (1, 1), t_camera_world=place)
    front = track_plots.side_view_figure(track, int(track.frames[0]), camera=camera).axes[0]
    assert np.ptp(front.get_xlim()) < 20


def test_other_modes_have_the_colours_of_the_overlay_however_many() -> None:
    seven = len(PALETTE)
    assert [track_plots.mode_colour(mode) for mode in (0, 1)] == [
        tuple(part / 255 for part in PALETTE[mode]) for mode in (0, 1)
    ]
    assert (
        track_plots.mode_colour(seven) == track_plots.mode_colour(1) != track_plots.mode_colour(0)
    )
    body = ProjectedBody(
        torch.tensor([[4.0, 4.0], [28.0, 4.0], [4.0, 28.0]]), torch.ones(3),
        torch.ones(3, dtype=torch.bool), torch.tensor([[0, 1, 2]]), torch.zeros(1).long(),
    )  # fmt: skip
    nobody = body._replace(valid=torch.zeros(3, dtype=torch.bool))
    image = torch.zeros(32, 32, 3, dtype=torch.uint8)
    drawn = [draw_overlay(image, [nobody] * number + [body]) for number in (1, seven)]
    assert torch.equal(*drawn)


def test_explanations_are_counted_by_distance(track: Track) -> None:
    joints = track.joints_world.copy()
    joints[1, 1] = joints[1, 0] + 0.01
    near = track._replace(joints_world=joints)
    counts = track_plots.num_explanations(near).tolist()
    assert counts[1] == track_plots.num_explanations(track).tolist()[1] - 1


def test_modes_over_time(track: Track, tmp_path: Path) -> None:
    cost = track.cost.copy()
    cost[1] = np.inf  # a frame in which nothing was seen
    events = [{"event": "lost", "time_s": 11 / 60}, {"event": "found", "time_s": 12 / 60}]
    figure = track_plots.modes_figure(track._replace(cost=cost), {"events": events})
    weights, number, costs = figure.axes
    assert len(weights.collections) == 3
    marks = {line.get_label(): line.get_xdata() for line in costs.get_lines()}
    assert marks["told lost"] == pytest.approx([11 / 60])
    assert marks["told found"] == pytest.approx([12 / 60])
    shown = costs.get_lines()[0].get_ydata()
    assert np.isnan(shown).tolist() == [True, True, False]
    counts = {line.get_label(): line.get_ydata() for line in number.get_lines()}
    assert counts["modes"].tolist() == [2, 3, 2]
    assert save_figure(figure, tmp_path / "modes.png").stat().st_size > 5000
    none = track.first(0)
    with pytest.raises(TrackFileError, match="no frames"):
        track_plots.modes_figure(none)


@pytest.mark.parametrize("count", [1, 2])
def test_short_tracks_can_be_drawn(body: BodyModel, tmp_path: Path, count: int) -> None:
    track = make_track(body, (2,) * count)
    save_figure(track_plots.modes_figure(track), tmp_path / "modes.png", dpi=40)
    save_figure(track_plots.side_view_figure(track, 0), tmp_path / "side.png", dpi=40)


def test_a_contact_sheet_shows_the_frames_asked_for(tmp_path: Path) -> None:
    video = grey_film(tmp_path / "made.mp4", (0, 60, 120, 180, 240), (720, 48))
    figure = track_plots.contact_sheet(video, (4, 0, 2), columns=2)
    shown = [axes for axes in figure.axes if axes.get_images()]
    titles = [axes.get_title() for axes in shown]
    assert titles == ["frame 4, 0.16 s", "frame 0, 0.00 s", "frame 2, 0.08 s"]
    images = [np.asarray(axes.get_images()[0].get_array()) for axes in shown]
    assert [image.shape for image in images] == [(24, 360, 3)] * 3
    np.testing.assert_allclose([image.mean() for image in images], [240, 0, 120], atol=4)
    with pytest.raises(ConfigurationError, match="no frames \\[9\\]"):
        track_plots.contact_sheet(video, (1, 9))
    with pytest.raises(ConfigurationError, match="at least one"):
        track_plots.contact_sheet(video, ())


def test_a_contact_sheet_of_an_overlay_counts_as_the_track_does(
    track: Track, tmp_path: Path
) -> None:
    overlay = grey_film(tmp_path / "overlay.mp4", (0, 120, 240))
    figure = track_plots.contact_sheet(overlay, track.frames[1:], track=track)
    assert [axes.get_title() for axes in figure.axes] == ["frame 11, 0.18 s", "frame 12, 0.20 s"]
    means = [np.asarray(axes.get_images()[0].get_array()).mean() for axes in figure.axes]
    np.testing.assert_allclose(means, [120, 240], atol=4)
    with pytest.raises(ConfigurationError, match="no frames \\[0\\]"):
        track_plots.contact_sheet(overlay, (0, 11), track=track)


def test_a_body_of_ones_own(body: BodyModel) -> None:
    track = make_track(body)
    figure = track_plots.side_view_figure(track, 0)
    assert len(legend(figure)) == 2
