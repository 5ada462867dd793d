"""Containers of films, by PyAV: how one is opened, and its whole pictures up to the damage.

A file that a full disk or an empty battery cut off holds whole pictures before that. Those are
found, and that more was to follow is told, by what the container says. An MPEG-TS does not say how
long it is: where it ends behind a whole picture, and none is missing before that one, nothing tells
that more was to follow.

Call `open_container` and `whole_pictures`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcss.errors import VideoError
from torchcss.io.high_dynamic_range import table
from torchcss.joint_names import names_in
from torchcss.types import ColourImage

if TYPE_CHECKING:  # PyAV takes long to import: only where a video is read or written
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream

# Demuxers that make pictures out of text or of anything at all: no video comes in them. Below,
# those of playlists, which name other files.
_NOT_VIDEOS = {
    *names_in("tty ansi bin xbin adf idf rawvideo subviewer"),
    *names_in("hls applehttp concat dash imf vobsub"),
}

_MOST_PIXELS = 2**27
"""Of a video's picture, which a small file may make large; Pillow refuses large images itself."""

_SEGMENT = b"\x18\x53\x80\x67"
"""What stands before the size of a Matroska file's only large part."""

_PACKETS = (188, 192, 204)
"""Bytes of the packets of which an MPEG transport stream is made."""


def open_container(path: Path) -> InputContainer:
    """A video's container, to be closed by the caller.

    Raises:
        VideoError: If it is of a kind that is not read. Of damaged ones PyAV raises its own
            (`av_errors`).
    """
    import av
    from av.error import ArgumentError

    # Only this file: playlists that name other files or addresses are refused before those are
    # opened.
    kinds = ",".join(sorted(av.formats_available - _NOT_VIDEOS))
    options = {"protocol_whitelist": "file", "format_whitelist": kinds}
    try:
        return av.open(f"file:{path}", container_options=options)
    except ArgumentError as error:  # as PyAV calls what is not among these kinds
        raise not_a_video(path, "it holds text, raw bytes or a playlist") from error


def not_a_video(path: Path, reason: str) -> VideoError:
    """The error for a file in which no film can be read."""
    return VideoError(
        f"{path}: not a video that can be read ({reason}); expected a complete "
        "video file or a folder of images"
    )


def av_errors() -> tuple[type[Exception], ...]:
    """What PyAV raises where a file is at fault."""
    from av.error import FFmpegError

    return FFmpegError, OSError


class Damage(Exception):
    """The container goes on, but not with whole frames."""


def whole_pictures(container: InputContainer) -> Iterator[VideoFrame]:
    """Yield the pictures of the first film in the order in which they are shown, up to the damage.

    Raises:
        Damage: After the pictures before it, as are PyAV's errors (`av_errors`).
    """
    stream = container.streams.video[0]
    decoder = stream.codec_context
    if decoder is None:
        raise Damage("its codec is unknown")
    # Decoding is a hundredth of a frame's work; threads of its own would each hold memory.
    decoder.thread_count = 1
    decoder.options = {"max_pixels": str(_MOST_PIXELS)}  # also for what grows on the way
    if decoder.width * decoder.height > _MOST_PIXELS:
        raise Damage(f"{decoder.width} x {decoder.height} pixels, more than {_MOST_PIXELS:,}")
    held: list[VideoFrame] = []
    whole, sent = None, None  # when the last packets but one and but none were to be decoded
    longest = 0.0
    packets = container.demux(stream)
    try:
        while (packet := next(packets, None)) is not None:
            if packet.is_corrupt:
                raise Damage("the file is cut off or damaged")
            if not packet.size and _is_cut_off(container):
                sent = whole  # half of the last one may be missing
                raise Damage("the file is cut off")
            pictures = packet.decode()
            if not packet.size and container.format.name == "mpegts":
                held, pictures = held + pictures, []
                is_half = any(picture.is_corrupt for picture in held)
                if is_half or _lacks_some(container, [p.pts for p in held], sent, longest):
                    sent = whole if is_half else sent
                    raise Damage("the file is cut off")
            yield from held
            longest = max(longest, _step(sent, packet.dts))
            held, whole, sent = pictures, sent, packet.dts
        yield from held
    except (*av_errors(), Damage):
        # What the decoder holds back is whole, but pictures shown before it may be lost: those that
        # were to be decoded later, so that they are shown later than that.
        with suppress(*av_errors()):
            held += decoder.decode(None)
        yield from takewhile(lambda picture: _is_shown_by(picture.pts, sent), held)
        raise


def times_shown(path: Path) -> list[float | None]:
    """When each picture is shown, seconds, in the order in which they are stored.

    Nothing is decoded. Only those before the damage are there, if there is any.
    """
    times: list[float | None] = []
    whole, sent, longest = None, None, 0.0
    # What cannot be demuxed ends the count, as it ends the reading: see `whole_pictures`.
    with suppress(*av_errors()), open_container(path) as container:
        for packet in container.demux(video=0):
            if not packet.size and not _is_cut_off(container):
                if _lacks_some(container, times, sent, longest):
                    break
                return times
            if packet.is_corrupt or not packet.size:
                sent = sent if packet.size else whole
                break
            shown, decoded = (
                None if at is None else float(at * (packet.time_base or 1))
                for at in (packet.pts, packet.dts)
            )
            times += [] if packet.is_discard else [shown]
            longest = max(longest, _step(sent, decoded))
            whole, sent = sent, decoded
    return [time for time in times if _is_shown_by(time, sent)]


def upright(picture: VideoFrame, stream: VideoStream) -> ColourImage:
    """Return the picture as a player shows it on a screen of standard range."""
    levels = table(int(stream.codec_context.color_trc or 0))
    # One thread, as for decoding: on busy cores a picture waits longer for threads than it takes.
    if levels is None:
        image = picture.to_ndarray(format="rgb24", threads=1)
    else:
        deep = picture.to_ndarray(format="rgb48le", threads=1)
        image = np.take(levels, np.asarray(deep, np.uint16))
    # How a pixel's place (x, y) is shown: x' = a x + c y, y' = b x + d y, maybe mirrored.
    angle = math.radians(picture.rotation)
    a, b, c, d = math.cos(angle), -math.sin(angle), math.sin(angle), math.cos(angle)
    with suppress(KeyError, ValueError):  # there is none, or beside it what PyAV does not know
        data: Any = picture.side_data
        a, b, _, c, d, *_ = np.frombuffer(data["DISPLAYMATRIX"], np.int32).tolist()
    if abs(b) > abs(a):
        image, a, d = image.swapaxes(0, 1), c, b
    return np.ascontiguousarray(image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def _is_shown_by(time: float | None, sent: float | None) -> bool:
    """Whether a picture is shown when a packet was to be decoded, or before, or has no time."""
    return time is None or (sent is not None and time <= sent)


def _step(before: float | None, after: float | None) -> float:
    return 0.0 if before is None or after is None else after - before


def _lacks_some(
    container: InputContainer, shown: Sequence[float | None], sent: float | None, longest: float
) -> bool:
    """Whether an MPEG-TS lacks pictures that were to be shown between its last ones.

    Args:
        container: The container.
        shown: When its last pictures, or all, are shown.
        sent: When the last packet was to be decoded: what is shown until then is there.
        longest: The longest step from one packet to the next.
    """
    if container.format.name != "mpegts" or sent is None:
        return False
    late = sorted(time for time in shown if time is not None and time >= sent)
    return any(after - before > 1.5 * longest for before, after in pairwise(late))


def _is_cut_off(container: InputContainer) -> bool:
    """Whether a file is shorter than it says, or ends within a packet."""
    path = Path(container.name.removeprefix("file:"))
    size = path.stat().st_size
    if container.format.name == "mpegts":
        return all(size % packet for packet in _PACKETS)
    if "matroska" not in container.format.name:
        return False
    with path.open("rb") as file:
        _, found, rest = file.read(4096).partition(_SEGMENT)
        # As many bytes as the first one has leading zeros say the size, and one more.
        count = 9 - rest[0].bit_length() if found and rest else 0
        stated = int.from_bytes(rest[:count]) - (1 << 7 * count)
        is_known = 0 < count < 9 and stated != (1 << 7 * count) - 1
        return is_known and size < file.tell() - len(rest) + count + stated
