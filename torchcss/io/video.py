"""Frames in and frames out: any video that FFmpeg (PyAV) opens, a folder of images, H.264 output.

A video is a sequence of `Frame(index, time_s, image)`; `index` counts from the first frame of the
file, whatever `start`, `stop` and `stride` select: keypoints and references keep their place.
Frames are found by decoding from the beginning, never by seeking: seeking is exact in few
containers only. Pictures are turned and mirrored as a telephone writes into the file, as players
do, and high dynamic range is brought to 8 bit (`torchcss.io.high_dynamic_range`).

A damaged video is read up to the damage. The frames before it are yielded, then a `VideoError` says
how many there were; whoever consumed them keeps what was computed. How damage is found is in
`torchcss.io.containers`; single pictures are read in `torchcss.io.pictures`.

By default: `for frame in VideoReader(path)` and `with VideoWriter(path, frame_rate) as writer`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Generator, Iterator
from contextlib import suppress
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float
from PIL import ExifTags, Image

from torchcss.errors import ConfigurationError, ShapeError, VideoError
from torchcss.files import StrPath, naming, one_line, output_error, refusing, temporary_name
from torchcss.io.containers import (
    Damage,
    av_errors,
    not_a_video,
    open_container,
    times_shown,
    upright,
    whole_pictures,
)
from torchcss.io.pictures import (
    natural_order,
    num_pictures,
    read_image,
    size_at_beginning,
)
from torchcss.joint_names import names_in
from torchcss.types import TIME_ROUNDING, ColourImage, Frame

if TYPE_CHECKING:  # PyAV takes long to import: only where a video is read or written
    from av import VideoFrame

IMAGE_SUFFIXES = names_in(".jpg .jpeg .png .bmp .tif .tiff .webp .pgm .ppm")
"""What counts as a frame in a folder of images."""

_UNREAD = names_in(".heic .heif .avif .jxl .jp2 .gif .exr .tga .dng .cr2 .cr3 .nef .arw")
"""Pictures of other kinds."""

VIDEO_SUFFIXES = names_in(".mp4 .mov .avi .mkv .webm .m4v .mpg .mpeg .wmv .mts .m2ts .3gp")
"""What counts as a video in a folder of clips; others are read too."""

_SECONDS_BETWEEN_KEY_FRAMES = 1

_TICKS = 90_000
"""In a second, of films whose frames have times of their own, as in most containers."""

_FOCAL_35MM = ("focal_length.35mm_equivalent", "focallengthin35mmfilm", "focallength35efl")
"""How the keys end under which cameras write the focal length as of 35 mm film."""

_SHORTEST_MM, _LONGEST_MM = 8.0, 1000.0


class VideoInfo(NamedTuple):
    """What is known of a video before it is read.

    Attributes:
        frame_rate: Mean frames per second.
        width: Image columns, after rotation.
        height: Image rows, after rotation.
        num_frames: What the container says, or None where it does not say;
            `VideoReader.count_frames` then counts.
    """

    frame_rate: Fraction
    width: int
    height: int
    num_frames: int | None


class VideoReader:
    """A video file or a folder of images, as a sequence of frames that can be read again and again.

    Args:
        path: A video in any container that FFmpeg reads, one image, or a folder of images that are
            taken in the natural order of their names (`2.png` before `10.png`).
        start: First frame.
        stop: The frame before which reading ends; None or beyond the end: to the last.
        stride: Every how many frames one is taken.
        image_frame_rate: Frames per second of images, which do not say it themselves; None: 30.
            A video says its own.

    Attributes:
        info: Frame rate and size, as the file states them.
        pixel_aspect: Width of a pixel against its height.
        left_out: A line about what is not read, if there is such: pictures of other kinds in a
            folder, further films in a file.
        is_untimed: Whether the file is a bare stream without times, as cameras of single-board
            computers write it, so that its frame rate is a guess.

    Raises:
        VideoError: If nothing can be read, no frame is selected, or the stride is not positive.
    """

    info: VideoInfo
    pixel_aspect = Fraction(1)
    left_out: str | None = None
    is_untimed = False

    def __init__(
        self,
        path: StrPath,
        *,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        image_frame_rate: float | Fraction | None = None,
    ) -> None:
        self.path = Path(path)
        self._start, self._stop, self._stride = start, stop, stride
        rate = 30 if image_frame_rate is None else image_frame_rate
        with naming(self.path, VideoError):
            if stride < 1:
                raise VideoError(f"stride must be at least 1, got {stride}")
            if start < 0:
                raise VideoError(f"start must be at least 0, got {start}")
            if stop is not None and stop <= start:
                raise VideoError(f"stop must be greater than start, got start {start}, stop {stop}")
            if not 0 < rate < math.inf:
                raise VideoError(f"frames per second must be positive, got {rate}")
            # Pictures taken hours apart have too small a rate for such denominators.
            self._image_frame_rate = Fraction(rate).limit_denominator(1001) or Fraction(rate)
            self._images = self._find_images()
        if self._images is None:
            self.info = self._probe_container()
        else:
            first = self._images[min(start, len(self._images) - 1)]
            height, width = read_image(first).shape[:2]
            self.info = VideoInfo(self._image_frame_rate, width, height, len(self._images))
        if self.info.num_frames is not None and start >= self.info.num_frames:
            raise self._beyond_the_end(self.info.num_frames)

    @property
    def num_selected(self) -> int | None:
        """How many frames an iteration yields, or None where the container does not tell."""
        count = self.info.num_frames
        return None if count is None else len(range(count)[self._start : self._stop : self._stride])

    @property
    def image_names(self) -> list[str] | None:
        """Names of the pictures of a folder in order, or None where it is a video."""
        return None if self._images is None else [image.name for image in self._images]

    @property
    def first_image(self) -> Path | None:
        """The first picture of a folder, or None where it is a video."""
        return None if self._images is None else self._images[0]

    def count_frames(self) -> int:
        """Count the frames without decoding them; those before the damage, if there is any.

        Where an MPEG-TS ends in the middle of a picture, that one and its neighbours count as well.
        """
        return len(self._images or times_shown(self.path))

    def frame_times(self) -> list[float] | None:
        """Seconds from the first frame to each, without decoding; None: a file does not say it."""
        if self._images is not None:
            return [float(index / self.info.frame_rate) for index in range(len(self._images))]
        shown = times_shown(self.path)
        times = [time for time in shown if time is not None]
        begin = min(times, default=0.0)
        return sorted(time - begin for time in times) if len(times) == len(shown) else None

    @property
    def selected_rate(self) -> float:
        """Mean frames per second of those that an iteration yields."""
        return float(self.info.frame_rate) / self._stride

    @cached_property
    def _steps(self) -> np.ndarray:
        """Seconds from each frame of a file to the next; what its header says need not be so."""
        return np.diff([] if self._images else self.frame_times() or [])

    @property
    def varies(self) -> bool:
        """Whether some frames are shown for longer than others, by more than rounding."""
        off = np.abs(self._steps - 1 / float(self.info.frame_rate))
        return float(off.max(initial=0.0)) > TIME_ROUNDING

    @property
    def usual_interval(self) -> float:
        """Seconds from one selected frame to the next in the mean, or, where it varies, as a rule.

        See `usual_step`.
        """
        if not self.varies:
            return self._stride / float(self.info.frame_rate)
        return self._stride * usual_step(self._steps)

    def varying_rate(self) -> str | None:
        """A line about frames that are not shown for equally long; None: they are."""
        steps, mean = self._steps, 1 / float(self.info.frame_rate)
        if not len(steps) or np.ptp(steps) < 0.5 * mean:
            return None
        shortest, longest = (f"{1000 * t:.0f}" for t in (steps.min(), steps.max()))
        return (
            f"frames are shown for {shortest} to {longest} ms (variable frame rate): each is taken "
            "at its own time"
        )

    def __iter__(self) -> Iterator[Frame]:
        return self._read_container() if self._images is None else self._read_images()

    def _beyond_the_end(self, num_frames: int) -> VideoError:
        return VideoError(
            f"{self.path}: start {self._start} is beyond the end: "
            f"the video has {num_frames} frames, the last is {num_frames - 1}"
        )

    # Containers.

    def _probe_container(self) -> VideoInfo:
        from av.format import Flags

        try:
            with open_container(self.path) as container:
                if not container.streams.video:
                    raise not_a_video(self.path, "it holds no pictures")
                stream = container.streams.video[0]
                rate = stream.average_rate or stream.guessed_rate or stream.base_rate
                self.is_untimed = bool(container.format.flags & Flags.no_timestamps.value)
                if self.is_untimed:  # its mean is FFmpeg's default, whatever the stream says
                    rate = stream.guessed_rate or rate
                num_frames = stream.frames or None
                duration = (stream.duration or 0) * (stream.time_base or 0) * (rate or 0)
                if num_frames and duration and "mp4" in container.format.name:
                    # An edit list may show a part of the frames that are stored.
                    is_whole = abs(round(duration) - num_frames) <= 1
                    num_frames = num_frames if is_whole else self.count_frames()
                if num_frames and container.format.name == "avi":
                    # Frames that a camera dropped are empty, and nobody returns them.
                    shown = [entry.timestamp for entry in stream.index_entries]
                    has_gaps = len(shown) < num_frames and shown[-1:] == [num_frames - 1]
                    num_frames = self.count_frames() if has_gaps else num_frames
                first = next(iter(whole_pictures(container)), None)
                if first is None:
                    raise not_a_video(self.path, "its first frame cannot be decoded")
                height, width = upright(first, stream).shape[:2]
                aspect = stream.sample_aspect_ratio or Fraction(1)
                if (count := len(container.streams.video)) > 1:
                    self.left_out = (
                        f"{count} films or covers in one file: the first, of {width} x {height} "
                        "pixels, is read"
                    )
                is_turned = (width, height) != (first.width, first.height)
                self.pixel_aspect = 1 / aspect if is_turned else aspect
        except VideoError:
            raise
        except (*av_errors(), ValueError, Damage) as error:
            raise not_a_video(self.path, one_line(error)) from error
        return VideoInfo(rate or Fraction(25), width, height, num_frames)

    def _read_container(self) -> Generator[Frame]:
        num_read, promised = 0, self.info.num_frames
        origin: float | None = None
        time: float | None = None
        damage = ""
        try:
            with open_container(self.path) as container:
                for picture in whole_pictures(container):
                    index, num_read = num_read, num_read + 1
                    if origin is None and picture.time is not None:
                        origin = picture.time
                    time = self._time(picture, index, origin, time)
                    if self._stop is not None and index >= self._stop:
                        return
                    if index < self._start or (index - self._start) % self._stride:
                        continue
                    image = upright(picture, container.streams.video[0])
                    if image.shape[:2] != (self.info.height, self.info.width):
                        raise VideoError(
                            f"{self.path}: frame {index} has {image.shape[1]} x {image.shape[0]} "
                            f"pixels, the first has {self.info.width} x {self.info.height}; "
                            "all frames must have one size"
                        )
                    yield Frame(index, time, image)
                # An MP4 may hide frames by its edit list: there a smaller count is no damage.
                if num_read < (promised or 0) and "mp4" not in container.format.name:
                    damage = "the file ends early"
        except VideoError:
            raise
        except (*av_errors(), ValueError, Damage) as error:
            damage = one_line(error)
        if self._stop is not None and num_read >= self._stop:
            return
        if damage:
            of = "" if promised is None else f" of {promised}"
            raise VideoError(
                f"{self.path}: {num_read}{of} frames could be read ({damage}); "
                f"get a complete copy, or use these with stop {num_read}"
            )
        if num_read <= self._start:
            raise self._beyond_the_end(num_read)

    def _time(
        self, picture: VideoFrame, index: int, origin: float | None, last: float | None
    ) -> float:
        if picture.time is None or origin is None:
            time = float(index / self.info.frame_rate)
        else:
            time = float(picture.time - origin)
        # Some writers give every frame the same time; velocities and smoothing need one that rises.
        return time if last is None or time > last else last + float(1 / self.info.frame_rate)

    # Images.

    def _find_images(self) -> list[Path] | None:
        with refusing(VideoError, f"{str(self.path)!r}: cannot be read"):
            if self.path.is_dir():
                entries = [each for each in self.path.iterdir() if not each.name.startswith(".")]
                # A folder or a broken link of such a name is an image missing: reading it says so,
                # where leaving it out would shift all frames after it.
                images, films, unread = (
                    [each for each in entries if each.suffix.lower() in suffixes]
                    for suffixes in (IMAGE_SUFFIXES, VIDEO_SUFFIXES, _UNREAD)
                )
                if unread:
                    self.left_out = (
                        f"pictures of kinds that are not read are left out, {len(unread)}, such as "
                        f"{min(unread).name}: save them as PNG or JPEG"
                    )
                if not images:
                    expected = f"expected files that end in {', '.join(IMAGE_SUFFIXES)}"
                    if unread:
                        expected = self.left_out
                    elif films:
                        expected = f"give a video in it, such as {min(films)}"
                    raise VideoError(f"no images in this folder; {expected}")
                return sorted(images, key=lambda entry: natural_order(entry.name))
            if not self.path.exists():
                raise VideoError("there is no such file or folder; check the path of the video")
            if not self.path.is_file():
                raise VideoError("expected a file or a folder, found a device")
            if self.path.stat().st_size == 0:
                raise VideoError("the file is empty; get a complete copy")
        if self.path.suffix.lower() not in IMAGE_SUFFIXES:
            return None
        if (count := num_pictures(self.path)) > 1:
            raise VideoError(
                f"{count} pictures in one file; save them as a folder of pictures, or as a video"
            )
        return [self.path]

    @property
    def _chosen(self) -> range:
        return range(len(self._images or ()))[self._start : self._stop : self._stride]

    def check_sizes(self) -> None:
        """See that the pictures of a folder have one size, by what stands at their beginnings.

        Raises:
            VideoError: If one of the selected ones has another. One that cannot be read is left to
                whoever reads it.
        """
        for index in self._chosen:
            assert self._images is not None
            if size_at_beginning(self._images[index]) not in (None, self.info[1:3]):
                self._image(index)

    def _image(self, index: int) -> ColourImage:
        assert self._images is not None
        image = read_image(self._images[index])
        if image.shape[:2] != (self.info.height, self.info.width):
            raise VideoError(
                f"{self._images[index]}: has {image.shape[1]} x {image.shape[0]} pixels, the first "
                f"one has {self.info.width} x {self.info.height}; all must have one size: make it "
                "so, or select those that have with start and stop"
            )
        return image

    def _read_images(self) -> Generator[Frame]:
        for index in self._chosen:
            yield Frame(index, float(index / self.info.frame_rate), self._image(index))


class VideoWriter:
    """An H.264 video (yuv420p, so that every player shows it), written frame by frame.

    The file has a temporary name until `close`, which an exception inside the `with` block calls
    too: an interrupted run leaves a shorter film, never a broken one in place of a good one. The
    size is that of the first frame; where that is odd, which H.264 cannot do, the last row or
    column is repeated.

    Args:
        path: The file, whose suffix says the container: `.mp4`, `.mov` or `.mkv`.
        frame_rate: Frames per second.
        crf: Constant rate factor of x264: 0 without loss, 51 worst; 18 to 24 are usual.

    Raises:
        ConfigurationError: If the suffix, the rate or the factor makes no sense.
        OutputError: If the file cannot be written, from any method.
    """

    def __init__(self, path: StrPath, frame_rate: Fraction | float, *, crf: int = 20) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() not in (".mp4", ".mov", ".mkv"):
            raise ConfigurationError(
                f"{self.path}: expected a name that ends in .mp4, .mov or .mkv"
            )
        if not 0 <= crf <= 51:
            raise ConfigurationError(f"crf must lie between 0 and 51, got {crf}")
        if not 0 < frame_rate < 1e6:
            raise ConfigurationError(f"frames per second must be positive, got {frame_rate}")
        self.num_frames = self._next = 0
        self._rate = self._ticks = Fraction(frame_rate).limit_denominator(65535)
        self._crf = crf
        self._partial = temporary_name(self.path)
        self._size_hw: tuple[int, int] | None = None
        self._container: Any = None
        self._stream: Any = None

    def write(self, image: ColourImage, time_s: float | None = None) -> None:
        """Append one frame, red, green, blue.

        Args:
            image: The frame.
            time_s: When it is shown, seconds, a tick after the one before at the earliest; of all
                frames or of none. None: as many frames come a second as the film says.

        Raises:
            ShapeError: If it is not an 8-bit colour image of the first frame's size.
            OutputError: If the disk does not take it.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise ShapeError(
                f"image: expected uint8 [height, width, 3], got {image.dtype} {list(image.shape)}"
            )
        height, width = image.shape[:2]
        size = self._size_hw or (height, width)
        if size != (height, width):
            raise ShapeError(
                f"image: expected the first frame's size {list(size)}, got {[height, width]}"
            )
        image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        from av import VideoFrame

        try:
            if self._size_hw is None:
                self._size_hw = (height, width)
                if time_s is not None:
                    self._ticks = Fraction(_TICKS)
                self._open(image.shape[1], image.shape[0])
            picture = VideoFrame.from_ndarray(image, format="rgb24")
            shown = 0 if time_s is None else round(time_s * self._ticks)
            picture.pts = max(shown, self._next)
            self._next = picture.pts + 1
            self._container.mux(self._stream.encode(picture))
        except av_errors() as error:
            raise output_error(self.path, error) from error
        self.num_frames += 1

    def _open(self, width: int, height: int) -> None:
        # Written in fragments, so that even a killed process leaves a playable partial file, and
        # turned into an ordinary MP4 when it is closed.
        import av

        options = {"flush_packets": "1"}
        if self.path.suffix.lower() != ".mkv":
            options["movflags"] = "hybrid_fragmented"
        self._container = av.open(f"file:{self._partial}", "w", options=options)
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = 1 / self._ticks
        stream.gop_size = max(1, round(_SECONDS_BETWEEN_KEY_FRAMES * self._rate))
        stream.options = {"crf": str(self._crf), "preset": "veryfast"}
        self._stream = stream

    def close(self) -> None:
        """Finish the film and give it its name; without any frame nothing is left behind.

        Raises:
            OutputError: If the disk is full. What was written is then kept under the final name
                if no older file has it.
        """
        container, self._container = self._container, None
        if container is None:
            return
        try:
            try:
                if self.num_frames:
                    container.mux(self._stream.encode(None))
            finally:
                container.close()
            if self.num_frames:
                os.replace(self._partial, self.path)
        except av_errors() as error:
            if self.num_frames and not self.path.exists():
                with suppress(OSError):
                    os.replace(self._partial, self.path)
            raise output_error(self.path, error) from error
        finally:
            with suppress(OSError):
                self._partial.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
            return
        # The first error is the one to report; a full disk will refuse the closing too.
        with suppress(OSError):
            self.close()


def usual_step(steps: Float[np.ndarray, " t"]) -> float:
    """Mean of the intervals that differ from their median by no more than their rounding.

    Args:
        steps: Seconds from each frame to the next.
    """
    usual = np.quantile(steps, 0.5, method="lower")  # one of them
    return float(steps[np.abs(steps - usual) < 1.5 * TIME_ROUNDING].mean())


def read_frame(path: StrPath, index: int = 0) -> ColourImage:
    """Read one frame of a video, or one image.

    Args:
        path: What `VideoReader` takes.
        index: Place of the frame in the video, from 0.

    Raises:
        VideoError: If it cannot be read, or the video ends before it.
    """
    return next(iter(VideoReader(path, start=index, stop=index + 1))).image


def focal_length_35mm(path: StrPath) -> float | None:
    """What a file says of its lens: the focal length in mm that shows as much on 35 mm film.

    Read are Apple's and Android's keys of a video, and EXIF's of a picture or of the first one of a
    folder. None: nothing, or nothing that can be read.
    """
    reader = VideoReader(path)
    value: Any = None
    with suppress(*av_errors(), ValueError, SyntaxError):
        if reader.first_image is not None:
            with Image.open(reader.first_image) as picture:
                value = (
                    picture.getexif()
                    .get_ifd(ExifTags.IFD.Exif)
                    .get(ExifTags.Base.FocalLengthIn35mmFilm)
                )
        else:
            with open_container(reader.path) as container:
                said = {**container.metadata, **container.streams.video[0].metadata}
            value = next((said[key] for key in said if key.lower().endswith(_FOCAL_35MM)), None)
    try:
        focal = float(value)
    except (TypeError, ValueError):
        return None
    return focal if _SHORTEST_MM <= focal <= _LONGEST_MM else None
