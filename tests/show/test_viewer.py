"""The viewer: that a recording holds what the track says. Read back with rerun's own reader."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_clip import grey_film
from made_tracks import make_track
from PIL import Image

from torchcss.body.bases import pose_track
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.uncertainty import joint_covariance
from torchcss.cli import main as cli
from torchcss.errors import ConfigurationError, MissingExtraError, OutputError
from torchcss.io.run import Run
from torchcss.io.tracks import TRACK_NAME, Track, save_track, write_summary
from torchcss.io.view_files import RecordedCamera
from torchcss.show import viewer
from torchcss.show.overlay import PALETTE
from torchcss.show.style import DEVIATIONS
from torchcss.show.track_plots import bones_of, count_apart, effective_number
from torchcss.show.viewer import shown_frames, view_track
from torchcss.show.viewer_layout import layout, viewpoint, world_axes
from torchcss.studies.render.scene import look_at
from torchcss.vision.camera import Camera

EVENTS = [{"event": "lost", "frame": 11}, {"event": "found", "frame": 12}]


def run_of(track: Track, camera: Camera | None, folder: Path = Path("run")) -> Run:
    cameras = () if camera is None else (RecordedCamera(camera),)
    track = track._replace(cameras=cameras)
    return Run(path=folder / TRACK_NAME, track=track, summary={"events": EVENTS})


@pytest.fixture(scope="module")
def camera() -> Camera:
    return look_at((0.3, -1.0, 5.0), (0.3, -1.0, 0.0), focal_px=60, image_size_wh=(64, 48))


@pytest.fixture(scope="module")
def run(track: Track, camera: Camera, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("run")
    grey_film(folder / "overlay.mp4", (40, 120, 200))
    return run_of(track, camera, folder)


Rows = dict[str, dict[int | None, dict[str, Any]]]
"""What was logged, by entity, frame (None: static) and component."""


def read(path: Path) -> Rows:
    chunk = pytest.importorskip("rerun.chunk")
    found: Rows = {}
    for piece in chunk.RrdReader(path).stream():
        batch = piece.to_record_batch()
        names = [name for name in batch.schema.names if name != "rerun.controls.RowId"]
        columns = [batch.column(name) for name in names]
        # Nanoseconds, for which Python has no type.
        columns = [c.cast("int64") if str(c.type) == "duration[ns]" else c for c in columns]
        for values in zip(*(column.to_pylist() for column in columns), strict=True):
            row = {k: v for k, v in zip(names, values, strict=True) if v is not None}
            frame = None if piece.is_static else row["frame"]
            found.setdefault(piece.entity_path, {}).setdefault(frame, {}).update(row)
    return found


@pytest.fixture(scope="module")
def rows(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    pytest.importorskip("rerun")
    path = tmp_path_factory.mktemp("saved") / "deep" / "track.rrd"
    view_track(run, save=path)
    return read(path)


def test_skeletons_are_the_tracks_joints(rows: Rows, track: Track, body: BodyModel) -> None:
    bones = np.array(bones_of(body))
    for row, frame in enumerate(track.frames):
        for mode in range(track.num_modes[row]):
            logged = rows[f"/world/modes/{mode}/skeleton"][int(frame)]
            strips = np.array(logged["LineStrips3D:strips"])
            np.testing.assert_allclose(strips, track.joints_world[row, mode][bones], atol=1e-6)
            assert 1e-9 * logged["time"] == pytest.approx(track.times[row], abs=1e-6)


def test_ellipsoids_are_the_covariances(rows: Rows, track: Track, body: BodyModel) -> None:
    for row, frame in enumerate(track.frames):
        for mode in range(track.num_modes[row]):
            pose = pose_track(
                body,
                torch.from_numpy(track.state[row, mode]),
                torch.from_numpy(track.base_transform[row]),
            )
            truth = joint_covariance(body, pose, torch.from_numpy(track.covariance[row, mode]))
            logged = rows[f"/world/modes/{mode}/uncertainty"][int(frame)]
            half = np.array(logged["Ellipsoids3D:half_sizes"]) / DEVIATIONS
            turn = rotation(np.array(logged["Ellipsoids3D:quaternions"]))
            centres = np.array(logged["Ellipsoids3D:centers"])
            np.testing.assert_allclose(centres, track.joints_world[row, mode], atol=1e-6)
            spread = turn @ (half[:, :, None] ** 2 * turn.swapaxes(-1, -2))
            np.testing.assert_allclose(spread, truth.numpy(), atol=1e-9)


def rotation(xyzw: np.ndarray) -> np.ndarray:
    x, y, z, w = (xyzw / np.linalg.norm(xyzw, axis=-1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def test_flesh_is_where_the_body_has_it(rows: Rows, track: Track, body: BodyModel) -> None:
    base = torch.from_numpy(track.base_transform[1])
    placed = body.with_base(base[:3, :3], base[:3, 3])
    turn, centre = placed.part_poses(placed.pose(torch.from_numpy(track.state[1, 2])))
    vertices = body.mesh(9, 14).points.flatten(1, 2)
    expected = (vertices @ turn.mT + centre[:, None]).numpy()
    for part, name in enumerate(body.part_names):
        logged = rows[f"/world/modes/2/body/{name}"]
        local = np.array(logged[None]["Mesh3D:vertex_positions"])
        # The viewer's matrices are stored by columns.
        columns = np.array(logged[11]["Transform3D:mat3x3"]).reshape(3, 3)
        shift = np.array(logged[11]["Transform3D:translation"])
        np.testing.assert_allclose(local @ columns + shift, expected[part], atol=1e-5)


def test_opacity_tells_the_weight_and_colour_the_rank(rows: Rows, track: Track) -> None:
    for row, frame in enumerate(track.frames):
        alphas = []
        for mode in range(track.num_modes[row]):
            (colour,) = rows[f"/world/modes/{mode}/skeleton"][int(frame)]["LineStrips3D:colors"]
            assert tuple(colour.to_bytes(4, "big"))[:3] == PALETTE[mode]
            alphas.append(colour & 255)
        assert alphas[0] == 255
        assert alphas == sorted(alphas, reverse=True)


def test_a_mode_that_goes_is_hidden(rows: Rows, body: BodyModel) -> None:
    for name in ("skeleton", "uncertainty"):
        assert rows[f"/world/modes/2/{name}"][12]["Clear:is_recursive"] == [False]
    for part in body.part_names:
        flesh = rows[f"/world/modes/2/body/{part}"]
        assert flesh[12]["Mesh3D:albedo_factor"] == [0]
        assert flesh[11]["Mesh3D:albedo_factor"][0] & 255 > 0
        assert 10 not in flesh
    assert np.isnan(rows["/cost/2"][12]["Scalars:scalars"]).all()


def test_curves_are_the_tracks_numbers(rows: Rows, track: Track) -> None:
    def value(name: str, frame: np.int64) -> float:
        return rows[f"/{name}"][int(frame)]["Scalars:scalars"][0]

    effective = effective_number(track)
    for row, frame in enumerate(track.frames):
        count = track.num_modes[row]
        for mode in range(count):
            assert value(f"cost/{mode}", frame) == pytest.approx(track.cost[row, mode])
            weight = np.exp(track.log_weight[row, mode])
            assert value(f"weight/{mode}", frame) == pytest.approx(weight)
        assert value("modes/number", frame) == count
        apart = count_apart(track.joints_world[row, :count])
        assert value("modes/apart", frame) == apart
        assert value("modes/effective", frame) == pytest.approx(effective[row])


def test_losses_are_told(rows: Rows) -> None:
    told = {frame: row["TextLog:text"] for frame, row in rows["/events"].items()}
    assert told == {11: ["frame 11: told lost"], 12: ["frame 12: told found"]}


def test_the_pictures_are_inside(rows: Rows, camera: Camera, track: Track) -> None:
    pictures = rows["/world/camera/picture"]
    for frame, level in ((10, 40), (11, 120), (12, 200)):
        (blob,) = pictures[frame]["EncodedImage:blob"]
        image = Image.open(io.BytesIO(bytes(blob)))
        assert image.format == "JPEG"
        assert image.size == camera.image_size_wh
        assert np.asarray(image).mean() == pytest.approx(level, abs=4)


def test_the_frustum_projects_as_the_camera_does(rows: Rows, camera: Camera, track: Track) -> None:
    logged = rows["/world/camera"][None]
    # Columns of world from camera; the viewer counts pixels from the picture's corner.
    turn = np.array(logged["Transform3D:mat3x3"]).reshape(3, 3)
    centre = np.array(logged["Transform3D:translation"])
    K = np.array(logged["Pinhole:image_from_camera"]).reshape(3, 3).T
    points = track.joints_world[0, 0]
    seen = (points - centre) @ turn.T @ K.T
    uv = camera.project(torch.from_numpy(points)).uv.numpy()
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:] - 0.5, uv, atol=1e-3)
    assert np.array(logged["Pinhole:resolution"]).ravel().tolist() == list(camera.image_size_wh)


def test_large_pictures_are_reduced_with_their_camera(
    track: Track, body: BodyModel, tmp_path: Path
) -> None:
    package = pytest.importorskip("rerun")
    large = look_at((0.3, -1.0, 5.0), (0.3, -1.0, 0.0), focal_px=3000, image_size_wh=(2560, 1440))
    frame = next(shown_frames(run_of(track, large)))
    frame = frame._replace(picture=np.zeros((1440, 2560, 3), np.uint8))
    recording = viewer.open_recording("large", save=tmp_path / "large.rrd")
    viewer.Viewer(recording, body, camera=large).add(frame)
    viewer.close_recording(recording)
    viewer.close_recording(recording)  # twice is once
    rows = read(tmp_path / "large.rrd")
    (blob,) = rows["/world/camera/picture"][10]["EncodedImage:blob"]
    assert Image.open(io.BytesIO(bytes(blob))).size == (1280, 720)
    K = np.array(rows["/world/camera"][None]["Pinhole:image_from_camera"]).reshape(3, 3).T
    assert K[0, 0] == pytest.approx(1500)
    # What opens well arranged is the blueprint, which is inside too.
    assert len(package.chunk.RrdReader(tmp_path / "large.rrd").blueprints()) == 1


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_what_is_up_stays_up(up: str, track: Track, body: BodyModel, camera: Camera) -> None:
    package = pytest.importorskip("rerun")

    for seen_by in (camera, None):
        position, target, vertical = viewpoint(track.joints_world[0, 0], seen_by, up)
        assert (position - target) @ vertical > 0  # looked at from above
        assert np.isfinite(position).all()
        layout(track.joints_world[0, 0], seen_by, up, events=seen_by is None)
    name = f"RIGHT_HAND_{up[-1].upper()}_{'DOWN' if up[0] == '-' else 'UP'}"
    assert world_axes(up) is getattr(package.ViewCoordinates, name)


def test_ellipsoids_of_mirrored_and_flat_covariances() -> None:
    source = np.random.default_rng(0)
    factor = source.normal(size=(20, 3, 3))
    covariance = factor @ factor.swapaxes(-1, -2)
    covariance[0] = 0.0
    covariance[1] = np.diag([4.0, 0.0, 1.0])
    half, quaternions = viewer.ellipsoids(covariance)
    turn = rotation(quaternions)
    spread = turn @ ((half[:, :, None] / DEVIATIONS) ** 2 * turn.swapaxes(-1, -2))
    np.testing.assert_allclose(spread, covariance, atol=1e-9)
    assert (half >= 0).all()


def test_without_rerun_the_error_says_what_to_install(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r'pip install "torchcss\[viewer\]"'):
        view_track(run, save=tmp_path / "track.rrd")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.usefixtures("no_display")
def test_without_a_display_only_recordings(run: Run, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"no display.*rerun FILE\.rrd"):
        view_track(run)
    with pytest.raises(ConfigurationError, match="not the address of a viewer"):
        view_track(run, connect="here")


def test_a_recording_that_cannot_be_written(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with pytest.raises(OutputError, match="cannot be written"):
        viewer.open_recording("none", save=tmp_path)


def test_the_verb_saves_a_body_without_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    body = load_body("body34")
    track = make_track(body, (2, 1))
    save_track(tmp_path / TRACK_NAME, track)
    write_summary(tmp_path, {"events": []})
    out = tmp_path / "view.rrd"
    assert cli.main(["view", str(tmp_path), "--save", str(out)]) == 0
    said = capsys.readouterr().out
    assert "without pictures" in said
    assert f"rerun {out}" in said
    rows = read(out)
    assert "/world/camera/picture" not in rows
    strips = np.array(rows["/world/modes/1/skeleton"][0]["LineStrips3D:strips"])
    np.testing.assert_allclose(
        strips, track.joints_world[0, 1][np.array(bones_of(body))], atol=1e-6
    )
