"""A tracker watched while it runs: the sink that shows its frames in the rerun viewer.

`LiveViewer` is a `torchcss.app.recorder.Sink`; `torchcss track --live` makes it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcss.app.recorder import Picture, modes_of
from torchcss.io.export.selection import camera_up, up_axis
from torchcss.show.viewer import ShownFrame, Viewer, close_recording, open_recording
from torchcss.tracking.session import Posterior
from torchcss.types import as_array


class LiveViewer:
    """Shows every frame as soon as it is tracked.

    It is made before the run, so that what is missing is told before anything is computed.

    Args:
        name: What the viewer calls the run.
        save: A recording to write while tracking.
        connect: Address of a viewer that runs, see `torchcss.show.viewer.open_recording`.
        spawn: Whether to open a viewer; by default if neither of the others is given.

    Raises:
        MissingExtraError: If rerun is not installed.
        ConfigurationError: If a viewer would have to be opened where there is no display.
        OutputError: If the recording cannot be written.
    """

    def __init__(
        self,
        name: str,
        *,
        save: Path | None = None,
        connect: str | None = None,
        spawn: bool | None = None,
    ) -> None:
        self._recording = open_recording(name, save=save, connect=connect, spawn=spawn)
        self._viewer: Viewer | None = None

    def add(self, frame: Posterior, picture: Picture) -> None:
        """Show a frame.

        Args:
            frame: What the tracker found.
            picture: How it looks.
        """
        if self._viewer is None:
            joints = as_array(frame.joints_world[:1])
            upward = camera_up(picture.camera)
            up, _ = up_axis(frame.body.joint_names, joints, np.eye(4)[None], upward)
            self._viewer = Viewer(self._recording, frame.body, camera=picture.camera, up=up)
        self._viewer.add(ShownFrame(modes_of(frame), picture.image, frame.lost))

    def close(self) -> None:
        """End the recording; a viewer stays open."""
        close_recording(self._recording)
