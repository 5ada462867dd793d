"""The files of one camera: its video, its calibration, its keypoints, checked against each other.

`open_view` reads and checks them; `moments` are the images of several, moment by moment.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import astuple, replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from torch import Tensor

from torchcss.errors import CameraError, VideoError, make_whole
from torchcss.files import naming
from torchcss.initialise.keypoint_checks import typical_sigma
from torchcss.initialise.view import CameraView
from torchcss.io.cameras import LoadedCamera, camera_findings, check_image_size, load_camera
from torchcss.io.keypoints.arrays import read_points
from torchcss.io.keypoints.frames import Film
from torchcss.io.keypoints.links import Links
from torchcss.io.keypoints.masks import OwnMasks, masks_of, read_own_masks
from torchcss.io.keypoints.one_person import Whom
from torchcss.io.keypoints.read import read_person
from torchcss.io.pictures import missing_numbers, several_kinds
from torchcss.io.run import Run
from torchcss.io.video import VideoReader
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.types import Frame, Keypoints, frozen
from torchcss.vision.camera import Camera


class OpenView(NamedTuple):
    """The files of a camera, opened.

    Attributes:
        files: Where they are.
        reader: The frames to be tracked.
        masks: Their foreground.
        camera: The camera, and what its file said about it.
        keypoints: Of the whole video.
        sigma: Noise of a keypoint, pixels of the full image.
        own_masks: What of the masks is the person's, where several people were detected.
    """

    files: ViewFiles
    reader: VideoReader
    masks: VideoReader | None
    camera: LoadedCamera
    keypoints: Keypoints | None
    sigma: float
    own_masks: OwnMasks | None = None

    def with_noise(self, factor: float) -> OpenView:
        """The same with so many times the noise, which is known from now on."""
        if self.keypoints is None or self.files.sigma is not None:
            return self
        sigma = factor * self.sigma
        return self._replace(files=replace(self.files, sigma=sigma), sigma=sigma)

    def noted(self, line: str) -> OpenView:
        """The same with a line more to say of its keypoints."""
        assert self.keypoints is not None
        report = (line, *self.keypoints.report)
        return self._replace(keypoints=self.keypoints._replace(report=report))

    @property
    def recorded(self) -> RecordedCamera:
        """The camera with its files, as a run holds it."""
        return RecordedCamera(self.camera.camera, self.files, self.camera.focal_deviation)

    @property
    def notes(self) -> list[str]:
        """What the files' readers have to say, for the user."""
        notes = [self.camera.units_note, *camera_findings(self.camera.camera)]
        notes += [self.reader.varying_rate(), self.reader.left_out]
        rate = float(self.reader.info.frame_rate)
        if self.reader.image_names is not None:
            given = "as given" if self.files.frame_rate else "assumed: say it with --frame-rate"
            notes.insert(0, f"{rate:g} images a second, {given}")
            notes += [several_kinds(self.reader.image_names)]
            notes += [missing_numbers(self.reader.image_names)]
        elif self.reader.is_untimed:
            notes.append(
                f"{rate:g} images a second, assumed, for the file holds no times: ffmpeg "
                f"-framerate RATE -i {self.files.video.name} -c copy NEW.mp4 makes one that does"
            )
        elif self.files.frame_rate is not None:
            notes.append(
                f"{rate:g} images a second, as the video says: --frame-rate is of pictures"
            )
        if (aspect := float(self.reader.pixel_aspect)) != 1:
            notes.append(
                f"pixels are {aspect:.3g} times as wide as high: in a camera file fy is so many "
                "times fx; an assumed camera takes them as square"
            )
        if self.keypoints is not None:
            notes += self.keypoints.report
        return [note for note in notes if note]

    def view(self, like: Tensor) -> CameraView:
        """The camera that looks on, for a session.

        Args:
            like: A tensor of the body's type and device.
        """
        camera = self.camera.camera.to(dtype=like.dtype, device=like.device)
        return CameraView(camera, self.keypoints, self.sigma, self.files.offset)

    def images(self) -> Iterator[Frame]:
        """The frames to be tracked, each with its mask where there are masks.

        Raises:
            VideoError: If they cannot be read, or the masks end before the video.
        """
        masks = None if self.masks is None else iter(self.masks)
        for frame in self.reader:
            if masks is None:
                yield frame
            elif (mask := next(masks, None)) is None:
                raise VideoError(
                    f"{self.files.masks}: the masks end before frame {frame.index}; give one for "
                    "every frame"
                )
            else:
                height, width = frame.image.shape[:2]
                image = mask.image[:height, :width]
                own = image if self.own_masks is None else self.own_masks.alone(frame.index, image)
                yield replace(frame, mask=own)


def moments(
    views: Sequence[OpenView], frames: Container[int] | None = None
) -> Iterator[tuple[Frame | None, ...]]:
    """The images of one moment after another, for `TrackingSession.track`.

    Args:
        views: The cameras; the first one's video tells how long.
        frames: The frames of the first one's video that are wanted; None: all.
    """

    def wanted(view: OpenView) -> Iterator[Frame]:
        return (f for f in view.images() if frames is None or f.index - view.files.offset in frames)

    first, *others = (wanted(view) for view in views)
    for frame in first:
        yield (frame, *(next(other, None) for other in others))


@frozen
class FrameSelection:
    """Which frames of the first camera's video.

    Attributes:
        start: First frame.
        stop: Frame before which to end; None: to the last.
        stride: Every how many frames to read.
    """

    start: int = 0
    stop: int | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        make_whole(self, "start", "stop", "stride")


def open_view(
    files: ViewFiles,
    camera: Path | Camera | LoadedCamera,
    selection: FrameSelection | None = None,
    links: Links = MappingProxyType({}),
) -> OpenView:
    """Open the files of a view.

    Args:
        files: The files.
        camera: The calibration file, or the camera, or one with what is said about it.
        selection: Which frames; None: all.
        links: What the body's file calls its joints (`BodyModel.joint_of_name`).

    Raises:
        TorchcssError: If a file cannot be read, or two of them do not belong together.
    """
    start, stop, stride = astuple(selection or FrameSelection())
    if start < 0:
        raise VideoError(f"{files.video}: start must be at least 0, got {start}")
    start, stop = start + files.offset, None if stop is None else stop + files.offset
    if start < 0:
        raise VideoError(
            f"{files.video}: offset {files.offset}: the camera starts {-start} frames after the "
            "first one to be tracked; begin later, or make it the first camera"
        )
    reader = VideoReader(
        files.video, start=start, stop=stop, stride=stride, image_frame_rate=files.frame_rate
    )
    reader.check_sizes()
    width, height = reader.info.width, reader.info.height
    masks = None
    if files.masks is not None:
        masks = VideoReader(files.masks, start=start, stop=stop, stride=stride)
        masks.check_sizes()
        _, *theirs, _ = masks.info
        # Films of odd sizes are a row or column larger.
        if theirs not in ([width, height], [width + width % 2, height + height % 2]):
            raise VideoError(
                f"{files.masks}: masks must have the video's size {width} x {height}, these have "
                f"{theirs[0]} x {theirs[1]}"
            )
    if isinstance(camera, Camera):
        loaded = LoadedCamera(camera, metric=True, units_note=None)
    elif isinstance(camera, LoadedCamera):
        loaded = camera
    else:
        loaded = load_camera(camera, files.camera_name, video=files.video)
    with naming(camera, CameraError) if isinstance(camera, Path) else nullcontext():
        check_image_size(loaded.camera, width, height)
    if files.keypoints is None:
        return OpenView(files, reader, masks, loaded, None, 1.0)
    keypoints = _keypoints(files, reader, start, links)
    sigma = files.sigma or keypoints.relative_noise * typical_sigma(keypoints)
    keypoints = read_points(files.keypoints, keypoints._replace(relative_noise=1.0))
    own = None
    if files.masks is not None and files.masks.resolve() == masks_of(files.keypoints).resolve():
        own = read_own_masks(files.keypoints, keypoints)
    return OpenView(files, reader, masks, loaded, keypoints, sigma, own)


def open_run(run: Run, selection: FrameSelection) -> list[OpenView]:
    """Open the files of a run's cameras, see `open_view`."""
    links = run.body.joint_of_name
    return [
        open_view(each.files, each.camera, selection, links) for each in run.cameras if each.files
    ]


def _keypoints(files: ViewFiles, reader: VideoReader, start: int, links: Links) -> Keypoints:
    """The keypoints of a view that has some."""
    assert files.keypoints is not None
    rate = None if reader.image_names else float(reader.info.frame_rate)
    count = reader.info.num_frames or reader.count_frames()
    film = Film(count, reader.image_names, rate, reader.frame_times)
    return read_person(
        files.keypoints,
        film=film,
        whom=Whom(start, files.person, (reader.info.width, reader.info.height)),
        layout=files.layout,
        normalised=files.normalised,
        links=links,
    )
