"""The verb `torchcss detect`: a video to its keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from torchcss.app.detect import DetectOptions, detect_video
from torchcss.errors import VideoError
from torchcss.io.detector_model import download_model
from torchcss.types import frozen


@frozen
class Detect:
    """Find the keypoints of everybody in a video; --download-model fetches the detector's model."""

    video: Annotated[Path | None, tyro.conf.Positional] = None
    """A video in any container, or a folder of images."""
    out: Path = Path("keypoints.npz")
    """The file to write, NAME.npz, which `torchcss track --keypoints` takes."""
    download_model: bool = False
    """Fetch MediaPipe's model into the cache folder, and nothing else where no video is given."""
    start: int = 0
    """First frame to look at."""
    stop: int | None = None
    """Frame before which to end."""
    frame_rate: float | None = None
    """Frames per second of a folder of images; by default 30."""
    options: Annotated[DetectOptions, tyro.conf.OmitArgPrefixes] = DetectOptions()

    def run(self) -> None:
        """Run the verb."""
        if self.download_model:
            download_model()
        if self.video is not None:
            detect_video(
                self.video, self.out, self.options, frame_rate=self.frame_rate,
                start=self.start, stop=self.stop,
            )  # fmt: skip
            print(f"keypoints are in {self.out}")
        elif not self.download_model:
            raise VideoError("give a video, or --download-model")
