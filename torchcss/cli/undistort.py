"""The verb `torchcss undistort`: a video of any lens to straight pictures that can be tracked."""

from __future__ import annotations

import shlex
from pathlib import Path

from torchcss.app.undistort import undistort_video
from torchcss.cli.options import PathArgument
from torchcss.io.keypoints.read import Scale
from torchcss.io.view_files import ViewFiles
from torchcss.types import frozen


@frozen
class Undistort:
    """Make straight pictures of a fisheye lens's, or of OpenCV's lens of 8 coefficients or more.

    What torchcss track takes comes out: the video, its camera, its keypoints and its masks. Of
    several cameras make each one's video straight, all into one folder.
    """

    video: PathArgument
    """A video in any container, or a folder of images."""
    camera: Path
    """Calibration of its lens."""
    out: Path = Path("out/straight")
    """Output folder."""
    keypoints: Path | None = None
    """2D joints of the video as recorded."""
    masks: Path | None = None
    """Masks of the video as recorded."""
    start: int = 0
    """The first frame that will be tracked, in which the person is chosen."""
    camera_name: str | None = None
    """Which camera of the calibration file; by default the one of this video."""
    fov: float | None = None
    """Degrees that the straight pictures show from left to right; by default what the middles of
    the borders show, at most 110."""
    layout: str | None = None
    """Layout of a keypoint file that does not name its joints, e.g. BODY_25."""
    normalised: Scale = "pixels"
    """Whether keypoints are pixels, or fractions of the picture."""
    person: str = "prominent"
    """Who of several people: prominent, largest, leftmost or centre, or the file's number."""
    frame_rate: float | None = None
    """Frames per second of a folder of images; by default 30."""

    def run(self) -> None:
        """Run the verb."""
        files = ViewFiles(
            video=self.video,
            keypoints=self.keypoints,
            masks=self.masks,
            camera_name=self.camera_name,
            layout=self.layout,
            normalised=self.normalised,
            frame_rate=self.frame_rate,
            person=self.person,
        )
        paths, notes = undistort_video(files, self.camera, self.out, fov=self.fov, start=self.start)
        for note in notes:
            print(note)
        said = {".json": "--camera ", ".npz": "--keypoints "}
        video, *others = paths
        options = (
            f"{said.get(path.suffix, '--masks ')}{shlex.quote(str(path))}" for path in others
        )
        print(" ".join(["torchcss track", shlex.quote(str(video)), *options]))
