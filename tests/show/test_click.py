"""Clicking joints, with events sent to a figure that has no window."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_robots import planar_arm
from matplotlib import pyplot
from matplotlib.backend_bases import KeyEvent, MouseButton, MouseEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_webagg_core import FigureCanvasWebAggCore, FigureManagerWebAgg
from matplotlib.figure import Figure

from torchcss.body.load import load_body
from torchcss.errors import ConfigurationError, KeypointError
from torchcss.io.keypoints.one_image import read_joints
from torchcss.show.click import CLICKED, JointClicker, click_joints, spoken, write_clicked

PICTURE = np.full((120, 200, 3), 128, dtype=np.uint8)


@pytest.fixture
def clicker() -> JointClicker:
    figure = Figure(figsize=(11, 7))
    FigureCanvasAgg(figure)
    made = JointClicker(PICTURE, figure=figure)
    figure.canvas.draw()
    return made


def press(clicker: JointClicker, u: float, v: float, button=MouseButton.LEFT) -> None:
    canvas = clicker.figure.canvas
    x, y = clicker.figure.axes[0].transData.transform((u, v))
    canvas.callbacks.process(
        "button_press_event", MouseEvent("button_press_event", canvas, x, y, button)
    )


def push(clicker: JointClicker, number: int) -> None:
    """Press and release one of the buttons below the picture."""
    canvas, axes = clicker.figure.canvas, clicker.figure.axes[2 + number]
    x, y = axes.transAxes.transform((0.5, 0.5))
    for what in ("button_press_event", "button_release_event"):
        canvas.callbacks.process(what, MouseEvent(what, canvas, x, y, MouseButton.LEFT))


def type_key(clicker: JointClicker, key: str) -> None:
    canvas = clicker.figure.canvas
    canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, key))


def test_marks_skips_and_takes_back(clicker: JointClicker):
    assert clicker.next_joint == CLICKED[0]
    press(clicker, 50, 20)
    assert clicker.next_joint == CLICKED[1]
    assert "base of the neck" in clicker.figure.axes[0].get_title()
    press(clicker, 0, 0, MouseButton.RIGHT)
    press(clicker, 60.5, 30)
    type_key(clicker, "u")
    press(clicker, 61, 31)
    type_key(clicker, "s")
    push(clicker, 0)
    push(clicker, 1)
    joints = clicker.joints
    assert joints.names == (CLICKED[0], CLICKED[2])
    np.testing.assert_allclose(joints.positions.numpy(), [[50, 20], [61, 31]], atol=1e-6)
    assert clicker.next_joint == CLICKED[4]
    push(clicker, 2)
    assert clicker.finished
    assert clicker.next_joint is None


def test_a_notebooks_widget_answers_to_what_the_browser_sends():
    figure = Figure(figsize=(11, 7))
    canvas = FigureCanvasWebAggCore(figure)
    clicker = JointClicker(PICTURE, figure=figure)
    FigureManagerWebAgg(canvas, 1)
    canvas.draw()

    def send(kind: str, **what) -> None:
        canvas.handle_event({"type": kind, "modifiers": [], "guiEvent": {}, "buttons": 1, **what})

    def click(axes: int, place: tuple[float, float], button: int = 0) -> None:
        transform = figure.axes[axes].transAxes if axes else figure.axes[0].transData
        x, y = transform.transform(place)
        for kind in ("button_press", "button_release"):
            send(kind, x=x, y=figure.bbox.height - y, button=button)

    click(0, (50, 20))
    click(0, (70, 30))
    click(0, (0, 0), button=2)
    send("key_press", key="ks")
    assert clicker.places[2:] == [None, None]
    send("key_press", key="ku")
    click(2, (0.5, 0.5))
    click(2, (0.5, 0.5))
    click(3, (0.5, 0.5))
    np.testing.assert_allclose(clicker.joints.positions.numpy(), [[50, 20]], atol=1e-6)
    assert clicker.next_joint == CLICKED[2]
    send("key_press", key="kEnter")
    assert clicker.finished


def test_keys_do_nothing_else_in_a_window():
    figure, others = pyplot.figure(), []
    canvas = figure.canvas
    canvas.toolbar = SimpleNamespace(
        save_figure=lambda: others.append("s"),
        back=lambda: others.append("backspace"),
        _wait_cursor_for_draw_cm=nullcontext,
    )
    clicker = JointClicker(PICTURE, figure=figure)
    for key in ("s", "s", "backspace"):
        type_key(clicker, key)
    pyplot.close(figure)
    assert clicker.places == [None]
    assert others == []


def test_clicks_beside_the_picture_count_for_nothing(clicker: JointClicker):
    canvas = clicker.figure.canvas
    x, y = clicker.figure.axes[1].transAxes.transform((0.5, 0.5))
    canvas.callbacks.process(
        "button_press_event", MouseEvent("button_press_event", canvas, x, y, MouseButton.LEFT)
    )
    type_key(clicker, "q")
    assert clicker.places == []
    type_key(clicker, "u")
    assert clicker.next_joint == CLICKED[0]


def test_after_the_last_joint_nothing_is_asked(clicker: JointClicker):
    for number in range(len(CLICKED) + 3):
        press(clicker, 10 + number, 20)
    assert len(clicker.joints.names) == len(CLICKED)
    type_key(clicker, "u")
    assert clicker.next_joint == CLICKED[-1]
    type_key(clicker, "enter")
    assert clicker.finished


def test_the_next_joint_is_shown(clicker: JointClicker):
    def red() -> list:
        lines = clicker.figure.axes[1].lines
        return [np.asarray(line.get_data()).tolist() for line in lines if line.get_color() == "red"]

    before = red()
    clicker.skip()
    after = red()
    assert len(before) == len(after) == 1
    assert before != after


def test_written_joints_read_back(clicker: JointClicker, tmp_path: Path):
    for number, name in enumerate(CLICKED):
        if name.startswith("l_"):
            clicker.skip()
        else:
            clicker.mark(10 + number, 90 - number)
    path = tmp_path / "joints.json"
    write_clicked(path, clicker.joints, (200, 120))
    assert json.loads(path.read_text())["image_size_wh"] == [200, 120]
    found = read_joints(path, image_size_wh=(200, 120))
    assert found.names == clicker.joints.names
    np.testing.assert_allclose(found.positions.numpy(), clicker.joints.positions.numpy())


def test_a_robot_is_asked_for_its_own_joints(tmp_path: Path):
    path = planar_arm(tmp_path / "arm.urdf", 0.5, 0.4)
    clicker = JointClicker(PICTURE, figure=Figure(), body=str(path))
    assert clicker.names == ("link0", "link1", "link2", "tip")
    clicker.mark(10, 20)
    write_clicked(tmp_path / "joints.json", clicker.joints, (200, 120))
    links = load_body(path).joint_of_name
    found = read_joints(tmp_path / "joints.json", image_size_wh=(200, 120), links=links)
    assert found.names == ("link0",)


def test_bad_requests(clicker: JointClicker):
    with pytest.raises(KeypointError, match="no joint was clicked"):
        _ = clicker.joints
    with pytest.raises(ConfigurationError, match="octopus"):
        JointClicker(PICTURE, ("l_wrist", "octopus"), figure=Figure())
    with pytest.raises(ConfigurationError, match="no window can be opened"):
        click_joints(PICTURE)


def test_sides_are_the_persons_own():
    assert spoken("l_hand_tip") == "left fingertips (the person's own)"
    assert spoken("skull_tip") == "top of the head"
