"""A tracker watched while it runs: the sink that shows its frames in the rerun viewer.

`LiveViewer` is one of the `sinks` of a `torchcss.recorder.Recorder`; `torchcss track --live` makes
it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcss.io.export.selection import up_axis
from torchcss.io.viewer import Viewer, open_recording, posed_frame
from torchcss.pipeline import TrackedFrame
from torchcss.recorder import Draw
from torchcss.vision.camera import Camera


class LiveViewer:
    """Shows every frame as soon as it is tracked.

    Args:
        name: What the viewer calls the run.
        camera: Camera of the full-size images.
        num_modes: Modes that the tracker keeps at most.
        save: A recording to write while tracking.
        connect: Address of a viewer that runs. With neither, a viewer is opened.

    Raises:
        MissingExtraError: If rerun is not installed.
        ConfigurationError: If a viewer would have to be opened where there is no display.
        OutputError: If the recording cannot be written.
    """

    def __init__(
        self,
        name: str,
        camera: Camera,
        num_modes: int,
        *,
        save: Path | None = None,
        connect: str | None = None,
    ) -> None:
        self._recording = open_recording(name, save=save, connect=connect)
        self._camera, self._num_modes = camera, num_modes
        self._viewer: Viewer | None = None

    def add(self, frame: TrackedFrame, draw: Draw) -> None:
        """Show a frame.

        Args:
            frame: What the tracker found.
            draw: Its picture.
        """
        body, mixture = frame.body, frame.state.mixture
        if self._viewer is None:
            self._viewer = Viewer(
                self._recording,
                body,
                num_modes=self._num_modes,
                camera=self._camera,
                up=_up(frame),
            )
        shown = posed_frame(
            frame.frame.index,
            frame.frame.time_s,
            body,
            body.pose(mixture.mean),
            covariance=mixture.covariance,
            weight=mixture.weight,
            cost=frame.info.cost,
            picture=draw(),
            lost=frame.lost,
        )
        self._viewer.add(shown)

    def close(self) -> None:
        """End the recording; the viewer stays open."""
        if self._viewer is not None:
            self._viewer.close()


def _up(frame: TrackedFrame) -> str:
    """Which axis of the world is up, as the first frame has it."""
    base = np.eye(4)
    base[:3, :3] = frame.body.base_rotation.cpu().numpy()
    joints = frame.joints_world[:1].double().cpu().numpy()
    return up_axis(frame.body.joint_names, joints, base[None])[0]
