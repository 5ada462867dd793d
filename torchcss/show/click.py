"""Mark joints by clicking: a window, or a widget in a notebook.

Beside the picture stands a figure of the body with the joint that is next. Left click marks it,
right click or `s` skips it, `u` takes the last one back, Enter ends. Buttons do the same. Left and
right are the person's own.

`click_joints(image)` opens a window and waits. In a notebook with `%matplotlib widget` (package
ipympl, the extra `notebook`), make a `JointClicker(image)`, click, and take `clicker.joints` in a
later cell.
`write_clicked` saves them in the format that `torchcss.io.keypoints.read` calls clicked.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backend_bases import KeyEvent, MouseEvent
from matplotlib.figure import Figure
from matplotlib.widgets import Button

from torchcss.body.load import load_body
from torchcss.errors import ConfigurationError, KeypointError
from torchcss.files import StrPath, write_text
from torchcss.show.track_plots import bones_of, draw_bones
from torchcss.tracking.settings import Settings
from torchcss.types import ColourImage, Keypoints

CLICKED = (
    "skull_tip", "vc7",
    *(f"{side}_{place}" for side in "rl" for place in ("shoulder", "elbow", "wrist", "hand_tip")),
    *(f"{side}_{place}" for side in "rl" for place in ("hip", "knee", "ankle", "toe")),
)  # fmt: skip
"""The joints that are asked for, in this order."""


class JointClicker:
    """The picture with the joints marked so far, and the figure with the joint that is next.

    Args:
        image: The picture.
        names: Joints to ask for, in order; by default `CLICKED`, or all of another body.
        figure: Where to draw; by default a new window of pyplot, or a widget in a notebook.
        body: The body that has these joints, or its file.

    Attributes:
        figure: The figure.
        places: What was answered so far, in order: a place in pixels, or None where skipped.
        finished: Whether the user has ended.

    Raises:
        ConfigurationError: If there is no joint to ask for, or one that the figure lacks.
    """

    def __init__(
        self,
        image: ColourImage,
        names: tuple[str, ...] | None = None,
        *,
        figure: Figure | None = None,
        body: str = Settings.body,
    ) -> None:
        shown = load_body(body, free_root=True)
        there = shown.joint_names
        if names is None:
            names = CLICKED if set(CLICKED) <= set(there) else there
        unknown = [name for name in names if name not in there]
        if not names or unknown or len(set(names)) < len(names):
            raise ConfigurationError(
                f"joints to click: expected different ones of {', '.join(there)}, "
                f"got {', '.join(unknown or names) or 'none'}"
            )
        if figure is None:
            from matplotlib import pyplot

            figure = pyplot.figure(figsize=(11, 7))
        self.names, self.figure = names, figure
        self.places: list[tuple[float, float] | None] = []
        self.finished = False
        joints = shown.pose(shown.rest).joints.numpy()
        # Facing the viewer: the person's left is on the right. What is longer than wide: its side.
        joints = joints[:, [0 if np.ptp(joints[:, 0]) >= np.ptp(joints[:, 2]) else 2, 1]]
        self._map = dict(zip(there, joints.tolist(), strict=True))
        left, right = figure.subplots(1, 2, width_ratios=(3, 1))
        figure.subplots_adjust(left=0.02, right=0.98, bottom=0.1, top=0.92, wspace=0.03)
        left.imshow(image)
        for axes in (left, right):
            axes.set_axis_off()
        right.set_aspect("equal")
        right.margins(0.2)
        look = {"color": "0.6", "lw": 3, "zorder": 1}
        draw_bones(right, joints * [1, -1], bones_of(shown), look)
        self._image_axes, self._map_axes = left, right
        self._marks: list[Any] = []
        self._buttons = []
        for number, (label, action) in enumerate(
            (("Undo (u)", self.undo), ("Skip (s)", self.skip), ("Done (Enter)", self.finish))
        ):
            button = Button(figure.add_axes((0.3 + 0.15 * number, 0.02, 0.13, 0.05)), label)
            button.on_clicked(lambda _, action=action: action())
            self._buttons.append(button)
        _take_keys_off(figure)
        figure.canvas.mpl_connect("button_press_event", self._pressed)  # type: ignore[arg-type]
        figure.canvas.mpl_connect("key_press_event", self._typed)  # type: ignore[arg-type]
        self._draw()

    @property
    def next_joint(self) -> str | None:
        """The joint to be clicked next; None after the last or at the end."""
        if self.finished or len(self.places) == len(self.names):
            return None
        return self.names[len(self.places)]

    @property
    def joints(self) -> Keypoints:
        """The joints marked so far.

        Raises:
            KeypointError: If none is.
        """
        marked = {n: p for n, p in zip(self.names, self.places, strict=False) if p is not None}
        if not marked:
            raise KeypointError("no joint was clicked: click at least three of them")
        places = torch.tensor(list(marked.values()), dtype=torch.float64)
        report = (f"clicked: {len(marked)} joints",)
        return Keypoints(places, torch.ones_like(places[:, 0]), tuple(marked), report=report)

    def mark(self, u: float, v: float) -> None:
        """Answer where the next joint is, pixels."""
        if self.next_joint is not None:
            self.places.append((float(u), float(v)))
            self._draw()

    def skip(self) -> None:
        """Answer that the next joint cannot be seen."""
        if self.next_joint is not None:
            self.places.append(None)
            self._draw()

    def undo(self) -> None:
        """Take the last answer back."""
        if self.places:
            self.places.pop()
            self.finished = False
            self._draw()

    def finish(self) -> None:
        """End; the joints not asked for are missing."""
        self.finished = True
        self._draw()
        manager = self.figure.canvas.manager
        if manager is not None:
            from matplotlib import pyplot

            pyplot.close(self.figure)

    def _pressed(self, event: MouseEvent) -> None:
        if event.inaxes is not self._image_axes or _is_zooming(self.figure):
            return
        if event.button == 1 and event.xdata is not None and event.ydata is not None:
            self.mark(event.xdata, event.ydata)
        elif event.button == 3:
            self.skip()

    def _typed(self, event: KeyEvent) -> None:
        actions = {"u": self.undo, "backspace": self.undo, "s": self.skip, "enter": self.finish}
        if event.key in actions:
            actions[event.key]()

    def _draw(self) -> None:
        for mark in self._marks:
            mark.remove()
        self._marks.clear()
        answered = zip(self.names, self.places, strict=False)
        for name, place in answered:
            colour = "tab:green" if place else "0.8"
            self._marks += self._map_axes.plot(*self._map[name], "o", color=colour, zorder=2)
            if place:
                self._marks += self._image_axes.plot(*place, "o", mfc="none", mec="yellow", mew=2)
        joint = self.next_joint
        if joint is None:
            title = "done: press Enter, or u to take the last one back"
        else:
            self._marks += self._map_axes.plot(*self._map[joint], "o", color="red", ms=12, zorder=3)
            title = f"click: {spoken(joint)}   ({len(self.places) + 1} of {len(self.names)})"
        self._image_axes.set_title(title)
        self.figure.canvas.draw_idle()


def spoken(joint: str) -> str:
    """A joint's name in words: `l_elbow` is "left elbow (the person's own left)"."""
    words = {"skull_tip": "top of the head", "vc7": "base of the neck", "hand_tip": "fingertips"}
    side, _, place = joint.partition("_")
    if side not in ("l", "r"):
        return words.get(joint, joint)
    return f"{'left' if side == 'l' else 'right'} {words.get(place, place)} (the person's own)"


def click_joints(
    image: ColourImage,
    names: tuple[str, ...] | None = None,
    *,
    body: str = Settings.body,
) -> Keypoints:
    """Open a window, let the user click, and wait until it is closed.

    Args:
        image: The picture.
        names: Joints to ask for, in order; by default those of `JointClicker`.
        body: The body that has these joints, or its file.

    Raises:
        ConfigurationError: If no window can be opened here.
        KeypointError: If no joint was clicked.
    """
    import matplotlib
    from matplotlib import pyplot

    if matplotlib.get_backend().lower() in ("agg", "pdf", "svg", "ps", "template", "cairo"):
        raise ConfigurationError(
            f"no window can be opened here (matplotlib's backend is {matplotlib.get_backend()}): "
            "run where there is a display, or give the joints as a file"
        )
    clicker = JointClicker(image, names, body=body)
    pyplot.show(block=True)
    return clicker.joints


def write_clicked(
    path: StrPath,
    joints: Keypoints,
    image_size_wh: tuple[int, int],
    *,
    frame: int = 0,
) -> None:
    """Write joints as a clicked file.

    Args:
        path: JSON file.
        joints: The joints.
        image_size_wh: Size of the picture.
        frame: Which frame of a video it is.

    Raises:
        OutputError: If it cannot be written.
    """
    places = {
        name: [round(number, 2) for number in place]
        for name, place in zip(joints.names, joints.positions.tolist(), strict=True)
    }
    marked = {"joints": places} if frame == 0 else {"frames": {str(frame): places}}
    content = {"image_size_wh": list(image_size_wh), **marked}
    write_text(Path(path), json.dumps(content, indent=2) + "\n")


def _take_keys_off(figure: Figure) -> None:
    """Take matplotlib's own keys off a window: `s` would save the figure, too."""
    manager = figure.canvas.manager
    if manager is not None and manager.key_press_handler_id is not None:
        figure.canvas.mpl_disconnect(manager.key_press_handler_id)


def _is_zooming(figure: Figure) -> bool:
    toolbar = getattr(figure.canvas, "toolbar", None)
    return bool(getattr(toolbar, "mode", ""))
