"""The files of one camera: its video, its calibration, its keypoints, checked against each other.

`open_view` reads and checks them; `track_files` follows one view or several.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from torchcss.cost.joints import JointObservation
from torchcss.errors import VideoError
from torchcss.initialise.keypoint_checks import typical_sigma
from torchcss.io.cameras import LoadedCamera, check_image_size, read_camera
from torchcss.io.keypoints.read import Keypoints, read_keypoints
from torchcss.io.video import VideoReader
from torchcss.io.view_files import ViewFiles
from torchcss.tracking.session import scale_keypoints
from torchcss.tracking.view import ViewStream
from torchcss.types import Frame
from torchcss.vision.features import FeatureExtractor


class OpenView(NamedTuple):
    """The same, opened.

    Attributes:
        reader: The frames to be tracked.
        masks: Their foreground.
        camera: The camera, and what its file said about it.
        keypoints: Of the whole video.
        sigma: Noise of a keypoint, pixels of the full image.
        offset: See `ViewFiles`.
    """

    reader: VideoReader
    masks: VideoReader | None
    camera: LoadedCamera
    keypoints: Keypoints | None
    sigma: float
    offset: int

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height of the video, pixels."""
        return self.reader.info.width, self.reader.info.height

    @property
    def notes(self) -> list[str]:
        """What the files' readers have to say, for the user."""
        said = () if self.keypoints is None else self.keypoints.report
        return [note for note in (self.camera.units_note, *said) if note]

    def noise(self, extractor: FeatureExtractor) -> float:
        """Noise of a keypoint in pixels of the features."""
        return self.sigma * extractor.working_shape(*self.size_wh)[0] / self.size_wh[0]

    def marks(
        self,
        index: int,
        size_wh: tuple[int, int],
        joint_names: tuple[str, ...],
        like: Tensor,
        *,
        relative_noise: float = 1.0,
    ) -> JointObservation | None:
        """The keypoints of a frame of this video; None where there are none.

        Args:
            index: The frame.
            size_wh: Size of the picture in whose pixels they are wanted.
            joint_names: The body's joint centres.
            like: A tensor of the body's type and device.
            relative_noise: See `JointObservation`.
        """
        keypoints = self.keypoints
        if keypoints is None or not 0 <= index < len(keypoints.keypoints):
            return None
        return JointObservation(
            joint_names,
            scale_keypoints(keypoints.keypoints[index], self.size_wh, size_wh).to(like),
            keypoints.confidence[index].to(like),
            keypoints.joint_names,
            relative_noise=relative_noise,
        )

    def stream(
        self,
        extractor: FeatureExtractor,
        joint_names: tuple[str, ...],
        like: Tensor,
        *,
        sigma: float,
        only_first: int | None = None,
        frames: Container[int] | None = None,
    ) -> ViewStream:
        """What the camera sends, for `torchcss.tracking.session.track_frames`.

        Args:
            extractor: Makes the features.
            joint_names: The body's joint centres.
            like: A tensor of the body's type and device.
            sigma: Noise that the joint term is told, pixels of the first camera's features.
            only_first: The one frame whose keypoints are used; None: those of all.
            frames: The frames to send; None: all. These are the first camera's numbers.
        """
        size, noise = extractor.working_shape(*self.size_wh), self.noise(extractor) / sigma

        def sent(reader: VideoReader) -> Iterator[Frame]:
            return (f for f in reader if frames is None or f.index - self.offset in frames)

        def observe(index: int) -> JointObservation | None:
            if only_first is not None and index != only_first + self.offset:
                return None
            return self.marks(index, size, joint_names, like, relative_noise=noise)

        masks = None if self.masks is None else (mask.image for mask in sent(self.masks))
        return ViewStream(sent(self.reader), self.camera.camera, observe, masks)


def open_view(
    files: ViewFiles, camera: Path, *, start: int = 0, stop: int | None = None, stride: int = 1
) -> OpenView:
    """Open the files of a view.

    Args:
        files: The files.
        camera: The calibration.
        start: First frame, of the first camera's video.
        stop: Frame before which to end, of the same.
        stride: Every how many frames to read.

    Raises:
        TorchcssError: If a file cannot be read, or two of them do not belong together.
    """
    if start < 0:
        raise VideoError(f"{files.video}: start must be at least 0, got {start}")
    start, stop = start + files.offset, None if stop is None else stop + files.offset
    if start < 0:
        raise VideoError(
            f"{files.video}: offset {files.offset}: the camera starts {-start} frames after the "
            "first one to be tracked; begin later, or make it the first camera"
        )
    reader = VideoReader(files.video, start=start, stop=stop, stride=stride)
    width, height = reader.info.width, reader.info.height
    masks = None
    if files.masks is not None:
        masks = VideoReader(files.masks, start=start, stop=stop, stride=stride)
        if (masks.info.width, masks.info.height) != (width, height):
            raise VideoError(
                f"{files.masks}: masks must have the video's size {width} x {height}, these have "
                f"{masks.info.width} x {masks.info.height}"
            )
    loaded = read_camera(camera, camera_name=files.camera_name, video=files.video)
    check_image_size(loaded.camera, width, height)
    if files.keypoints is None:
        return OpenView(reader, masks, loaded, None, 1.0, files.offset)
    keypoints = read_keypoints(
        files.keypoints,
        image_size_wh=(width, height),
        num_frames=reader.info.num_frames or reader.count_frames(),
        layout=files.layout,
        normalised=files.normalised,
        first_frame=start,
    )
    sigma = typical_sigma(keypoints.keypoints, keypoints.confidence)
    return OpenView(reader, masks, loaded, keypoints, sigma, files.offset)
