"""Reading and writing of frames: whole videos, damaged ones, folders."""

from __future__ import annotations

import errno
import math
import os
import signal
import struct
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.container import InputContainer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_processes import begin
from PIL import ExifTags, Image

from torchcss.app.detect import detect_video
from torchcss.app.lens import KnownLens
from torchcss.app.view_files import OpenView, open_view
from torchcss.errors import ConfigurationError, OutputError, ShapeError, VideoError
from torchcss.io import pictures, video
from torchcss.io.pictures import missing_numbers, natural_order, read_image, several_kinds
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.io.view_files import ViewFiles
from torchcss.studies.demo import CLIP
from torchcss.types import Frame
from torchcss.vision.camera import Camera


def grey_level(index: int) -> int:
    """The brightness that marks frame `index`."""
    return 20 + 6 * index


def film(
    path: Path,
    num_frames: int = 12,
    size_wh: tuple[int, int] = (64, 48),
    rate: Fraction | float = Fraction(30),
) -> Path:
    """Write a film whose frames are uniform grey, brighter from frame to frame."""
    with VideoWriter(path, rate) as writer:
        for index in range(num_frames):
            image = np.full((size_wh[1], size_wh[0], 3), grey_level(index), np.uint8)
            writer.write(image)
    return path


def noisy_film(path: Path, num_frames: int = 60, **options: str) -> Path:
    """Write a film that cannot be compressed, so that it can be cut anywhere."""
    source = np.random.default_rng(0)
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        for _ in range(num_frames):
            image = source.integers(0, 256, (64, 64, 3), dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def demo_film(path: Path) -> Path:
    """The demo's film, whose frames are stored in another order than shown, in any container."""
    options = {"movflags": "faststart"} if path.suffix == ".mp4" else {}
    with av.open(str(CLIP / "video.mp4")) as source, av.open(str(path), "w", options=options) as to:
        stream = to.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            packet.stream = stream
            to.mux([packet] if packet.dts is not None else [])
    return path


def cut(path: Path, fraction: float) -> Path:
    """Write the beginning of a file under another name."""
    data = path.read_bytes()
    shorter = path.with_stem(f"{path.stem}_cut")
    shorter.write_bytes(data[: int(fraction * len(data))])
    return shorter


def read_until_error(reader: VideoReader) -> tuple[list[Frame], VideoError | None]:
    frames = []
    try:
        for frame in reader:
            frames.append(frame)
    except VideoError as error:
        return frames, error
    return frames, None


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv"])
def test_round_trip(tmp_path: Path, suffix: str) -> None:
    path = film(tmp_path / f"a{suffix}")
    reader = VideoReader(path)
    assert (reader.info.width, reader.info.height) == (64, 48)
    assert reader.info.frame_rate == 30
    assert reader.info.num_frames == (None if suffix == ".mkv" else 12)
    assert reader.count_frames() == 12
    for _ in range(2):  # it can be read again
        frames = list(reader)
        assert [frame.index for frame in frames] == list(range(12))
        np.testing.assert_allclose(
            [frame.time_s for frame in frames], np.arange(12) / 30, atol=2e-3
        )
        for frame in frames:
            assert frame.image.dtype == np.uint8
            assert frame.image.shape == (48, 64, 3)
            assert abs(frame.image.astype(float).mean() - grey_level(frame.index)) < 3
    assert list(tmp_path.iterdir()) == [path]  # no temporary file is left


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ([0, 0, 0, 0, 0], [0, 1, 2, 3, 4]),
        ([0, 1, 1, 4, 5], [0, 1, 2, 4, 5]),
        ([3, 2, 4, 4, 7], [0, 1, 2, 3, 4]),
    ],
)
def test_times_rise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: list[int], read: list[int]
) -> None:
    """Where the file's times do not, a frame is one interval after the last, from any start."""
    path = film(tmp_path / "a.mp4", len(written))
    decode = video.whole_pictures

    def with_times(container: InputContainer) -> Iterator[av.VideoFrame]:
        for picture, time in zip(decode(container), written, strict=False):
            picture.time_base, picture.pts = Fraction(1, 30), time
            yield picture

    monkeypatch.setattr(video, "whole_pictures", with_times)
    times = [frame.time_s * 30 for frame in VideoReader(path)]
    assert times == pytest.approx(read)
    assert [frame.time_s * 30 for frame in VideoReader(path, start=2)] == pytest.approx(read[2:])


@pytest.mark.parametrize("size_wh", [(63, 47), (64, 47), (63, 48), (1, 1), (2, 2)])
def test_odd_sizes_are_padded_to_even_ones(tmp_path: Path, size_wh: tuple[int, int]) -> None:
    path = film(tmp_path / "a.mp4", 3, size_wh)
    info = VideoReader(path).info
    assert (info.width, info.height) == tuple(side + side % 2 for side in size_wh)
    assert len(list(VideoReader(path))) == 3


@pytest.mark.parametrize("rate", [Fraction(30000, 1001), 25, 6, Fraction(1, 2), 29.97])
def test_frame_rates(tmp_path: Path, rate: Fraction | float) -> None:
    reader = VideoReader(film(tmp_path / "a.mp4", 4, rate=rate))
    assert abs(reader.info.frame_rate - rate) < 1e-3
    np.testing.assert_allclose(
        [frame.time_s for frame in reader], np.arange(4) / float(rate), atol=1e-3
    )


def test_crf_trades_size_for_quality(tmp_path: Path) -> None:
    source = np.random.default_rng(1)
    image = source.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    sizes = []
    for crf in (10, 40):
        with VideoWriter(tmp_path / f"{crf}.mp4", 30, crf=crf) as writer:
            writer.write(image)
        sizes.append((tmp_path / f"{crf}.mp4").stat().st_size)
    assert sizes[0] > 1.5 * sizes[1]


@pytest.mark.parametrize(
    ("start", "stop", "stride"),
    [(0, None, 1), (3, None, 1), (0, 5, 1), (2, 9, 3), (0, 100, 4), (11, None, 2), (4, 5, 1)],
)
def test_selection_keeps_the_index_in_the_file(
    tmp_path: Path, start: int, stop: int | None, stride: int
) -> None:
    path = film(tmp_path / "a.mp4")
    folder = tmp_path / "images"
    folder.mkdir()
    for index in range(12):
        level = np.full((8, 10, 3), grey_level(index), np.uint8)
        Image.fromarray(level).save(folder / f"{index}.png")
    expected = list(range(12))[start:stop:stride]
    for source in (path, folder):
        reader = VideoReader(source, start=start, stop=stop, stride=stride)
        assert reader.num_selected == len(expected)
        frames = list(reader)
        assert [frame.index for frame in frames] == expected
        for frame in frames:
            assert abs(frame.image.astype(float).mean() - grey_level(frame.index)) < 3
            assert frame.time_s == pytest.approx(frame.index / 30, abs=2e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stride": 0}, "stride"),
        ({"stride": -1}, "stride"),
        ({"start": -1}, "start"),
        ({"start": 12}, "beyond the end"),
        ({"start": 500}, "12 frames"),
        ({"start": 4, "stop": 4}, "stop"),
    ],
)
def test_bad_selections(tmp_path: Path, options: dict[str, int], words: str) -> None:
    path = film(tmp_path / "a.mp4")
    with pytest.raises(VideoError, match=words):
        VideoReader(path, **options)


def test_start_beyond_the_end_of_a_container_that_does_not_count(tmp_path: Path) -> None:
    reader = VideoReader(film(tmp_path / "a.mkv"), start=50)
    assert reader.num_selected is None
    with pytest.raises(VideoError, match="start 50 is beyond the end: the video has 12 frames"):
        list(reader)


# Rotation.


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_rotation_metadata_is_applied(tmp_path: Path, quarter_turns: int, mirrored: bool) -> None:
    # A bright corner, top left as coded; the display matrix of the track header turns it, after it
    # has exchanged left and right, as some programs do with the front camera.
    path = tmp_path / "a.mp4"
    image = np.zeros((32, 64, 3), np.uint8)
    image[:16, :16] = 255
    with VideoWriter(path, 30) as writer:
        for _ in range(3):
            writer.write(image)
    data = bytearray(path.read_bytes())
    header = data.rindex(b"tkhd") + 4
    matrix = header + 40  # version 0: after the times, identity, layer, group and volume
    cosine, sine = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter_turns]  # clockwise
    one = 1 << 16
    side = -one if mirrored else one
    data[matrix : matrix + 36] = struct.pack(
        ">9i", cosine * side, sine * side, 0, -sine * one, cosine * one, 0, 0, 0, 1 << 30
    )
    path.write_bytes(bytes(data))
    reader = VideoReader(path)
    expected = np.rot90(image[:, ::-1] if mirrored else image, -quarter_turns)
    assert (reader.info.height, reader.info.width) == expected.shape[:2]
    for frame in reader:
        assert frame.image.flags["C_CONTIGUOUS"]
        assert np.abs(frame.image.astype(int) - expected).mean() < 4


# What telephones write.


@pytest.mark.parametrize(
    ("transfer", "signal", "level"),
    [
        # BT.2408, table 1: white paper, grey card, and black, in parts of the signal; what an
        # ordinary screen of gamma 2.2 makes of their light, relative to that of white paper.
        ("arib-std-b67", 0.75, 255 * (1 - 0.25 * np.exp(-1)) ** (1 / 2.2)),
        ("arib-std-b67", 0.38, 255 * (26 / 203) ** (1 / 2.2)),
        ("smpte2084", 0.58, 255 * (1 - 0.25 * np.exp(-1)) ** (1 / 2.2)),
        ("smpte2084", 0.38, 255 * (26 / 203) ** (1 / 2.2)),
        ("smpte2084", 0.0, 0.0),
        ("bt709", 0.58, 255 * 0.58),
    ],
)
def test_ten_bits_of_high_dynamic_range(
    tmp_path: Path, transfer: str, signal: float, level: float
) -> None:
    path = tmp_path / "a.mp4"
    tags = f"colorprim=bt2020:transfer={transfer}:colormatrix=bt2020nc:fullrange=off"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p10le"
        stream.options = {"x264-params": tags, "crf": "4"}
        for index in range(2):
            picture = av.VideoFrame(64, 48, "yuv420p10le")
            picture.pts, picture.time_base = index, Fraction(1, 30)
            for plane, value in zip(picture.planes, (64 + 876 * signal, 512, 512), strict=True):
                plane.update(np.full(plane.buffer_size // 2, value, "<u2").tobytes())
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    for frame in VideoReader(path):
        assert frame.image.dtype == np.uint8
        np.testing.assert_allclose(frame.image, level, atol=3)


def film_with_times(path: Path, ticks: Iterable[int], rate: int) -> VideoReader:
    """A film whose frames are shown at these ticks, so many a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, rate)
        for index, tick in enumerate(ticks):
            image = np.full((48, 64, 3), grey_level(index), np.uint8)
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = int(tick), Fraction(1, rate)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return VideoReader(path)


def test_variable_frame_rates(tmp_path: Path) -> None:
    """Every frame has the time at which it was filmed; the rate is the mean one."""
    path = tmp_path / "a.mp4"
    ticks = np.cumsum(np.random.default_rng(0).integers(1, 4, 30)) - 1
    ticks -= ticks[0]
    film_with_times(path, ticks, 30)
    reader = VideoReader(path)
    assert reader.num_selected == len(ticks)
    assert [frame.time_s * 30 for frame in reader] == pytest.approx(ticks)
    assert reader.frame_times() == pytest.approx(ticks / 30)
    means = [round(frame.image.mean()) for frame in reader]
    assert means == pytest.approx([grey_level(index) for index in range(30)], abs=3)
    assert float(reader.info.frame_rate) == pytest.approx(30 * 30 / ticks[-1], rel=0.1)
    assert "are shown for 33 to 100 ms (variable frame rate)" in str(reader.varying_rate())


def test_the_usual_interval_is_that_of_most_frames(tmp_path: Path) -> None:
    """Where every second frame of a part is missing, the others are as far apart as ever."""
    ticks = [*range(12), *range(12, 24, 2), *range(24, 30)]
    reader = film_with_times(tmp_path / "a.mp4", ticks, 30)
    assert reader.varies
    assert reader.usual_interval == pytest.approx(1 / 30)
    assert reader.info.frame_rate < 27
    assert VideoReader(tmp_path / "a.mp4", stride=3).usual_interval == pytest.approx(3 / 30)


@pytest.mark.parametrize(("name", "rate"), [("a.mkv", 1000), ("a.mov", 600)])
def test_rounded_times_are_even(tmp_path: Path, name: str, rate: int) -> None:
    """Times in milliseconds, and in QuickTime's 600ths of 29.97 frames a second."""
    ticks = [round(index * rate * 1001 / 30000) for index in range(35)]
    assert len(set(np.diff(ticks))) == 2
    reader = film_with_times(tmp_path / name, ticks, rate)
    assert not reader.varies
    assert reader.varying_rate() is None
    assert reader.usual_interval == 1 / float(reader.info.frame_rate)


def test_a_film_with_times_of_its_frames(tmp_path: Path) -> None:
    """Told by the frames: Matroska's header goes on saying 25 a second."""
    times = [0.0, 0.04, 0.08, 0.2, 0.213]
    for name, accuracy in (("a.mp4", 1e-4), ("a.mkv", 1e-3)):
        with VideoWriter(tmp_path / name, 25) as film:
            for time in times:
                film.write(np.zeros((48, 64, 3), np.uint8), time)
        reader = VideoReader(tmp_path / name)
        assert reader.frame_times() == pytest.approx(times, abs=accuracy)
        assert reader.varies


def test_times_that_do_not_rise_are_a_tick_apart(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", 25) as film:
        for time in (0.0, 0.04, 0.04, 0.03):
            film.write(np.zeros((48, 64, 3), np.uint8), time)
    times = VideoReader(tmp_path / "a.mp4").frame_times()
    assert times == pytest.approx([0.0, 0.04, 0.04 + 1 / 90_000, 0.04 + 2 / 90_000], abs=1e-6)


# Damage.


def test_missing_empty_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="no such file"):
        VideoReader(tmp_path / "none.mp4")
    empty = tmp_path / "empty.mp4"
    empty.touch()
    with pytest.raises(VideoError, match="empty"):
        VideoReader(empty)
    for name, content in {
        "text.mp4": b"hello world\n" * 100,
        "text.txt": b"hello world\n" * 100,
        "noise.mp4": np.random.default_rng(0).bytes(10000),
        "noise.yuv": np.random.default_rng(0).bytes(100000),
        "playlist.m3u8": b"#EXTM3U\n#EXTINF:1,\nhttp://localhost/a.ts\n",
        "list.ffconcat": b"ffconcat version 1.0\nfile a.mp4\n",
        "image.png": b"not an image",
    }.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(VideoError, match="not a") as caught:
            VideoReader(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(VideoError):
        VideoReader("a\0b")
    with pytest.raises(VideoError, match="device"):
        VideoReader("/dev/null")


def test_sound_without_pictures(tmp_path: Path) -> None:
    path = tmp_path / "sound.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(VideoError, match="no pictures"):
        VideoReader(path)


def test_truncated_with_index_at_the_front_yields_what_is_whole(tmp_path: Path) -> None:
    path = cut(noisy_film(tmp_path / "a.mp4", movflags="faststart"), 0.6)
    frames, error = read_until_error(VideoReader(path))
    count = len(frames)
    assert 25 < count < 45
    assert [frame.index for frame in frames] == list(range(count))
    assert error is not None
    assert f"{count} of 60 frames could be read" in str(error)
    assert f"stop {count}" in str(error)
    assert VideoReader(path).count_frames() == count
    # What the message proposes works, also with a start behind.
    frames, error = read_until_error(VideoReader(path, stop=count))
    assert (len(frames), error) == (count, None)
    whole = [frame.image for frame in VideoReader(tmp_path / "a.mp4", stop=count)]
    assert all(
        np.array_equal(frame.image, image) for frame, image in zip(frames, whole, strict=True)
    )


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts"])
@pytest.mark.parametrize("at_once", [True, False])
def test_what_is_read_before_the_damage_are_the_right_frames(
    tmp_path: Path, suffix: str, at_once: bool
) -> None:
    """Frames are decoded in another order than they are shown in, and some were lost between."""
    path = demo_film(tmp_path / f"a{suffix}")
    whole, expected = path.read_bytes(), [frame.image for frame in VideoReader(path)]
    # Odd: whole packets of MPEG-TS, of 188 bytes, are a case of their own.
    for size in (int(share * len(whole)) | 1 for share in (0.2, 0.48, 0.5)):
        path.write_bytes(whole[:size] if at_once else whole)
        reader = VideoReader(path)
        read = iter(reader)
        frames = [next(read)]
        path.write_bytes(whole[:size])
        with pytest.raises(VideoError, match="cut off"):
            frames.extend(read)
        for frame in frames:
            np.testing.assert_array_equal(frame.image, expected[frame.index])
        if at_once:  # else the beginning was read ahead
            assert reader.count_frames() == len(frames) >= 50 * size / len(whole) - 8


def test_frames_that_a_camera_dropped_are_no_damage(tmp_path: Path) -> None:
    """Empty chunks of an AVI: the frames around them have their own times."""
    path = tmp_path / "a.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for level in range(0, 240, 30):
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), "rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    data, marks = path.read_bytes(), (2, 3, 6)
    head, _, rest = data.partition(b"movi")
    chunks = rest[: rest.index(b"idx1")].split(b"00dc")[1:]
    chunks = [bytes(4) if place in marks else chunk for place, chunk in enumerate(chunks)]
    movi = b"".join(b"00dc" + chunk for chunk in chunks)
    sizes = [int.from_bytes(chunk[:4], "little") for chunk in chunks]
    places = np.cumsum([4, *(len(chunk) + 4 for chunk in chunks)])
    index = b"".join(
        b"00dc" + struct.pack("<III", 16, place, size)
        for place, size in zip(places, sizes, strict=False)
    )
    movi = struct.pack("<I", 4 + len(movi)) + b"movi" + movi
    path.write_bytes(head[:-4] + movi + b"idx1" + struct.pack("<I", len(index)) + index)
    reader = VideoReader(path)
    assert reader.info.num_frames == reader.count_frames() == 5
    frames = list(reader)
    assert [frame.time_s * 25 for frame in frames] == pytest.approx([0, 1, 4, 5, 7])
    levels = [frame.image.mean() for frame in frames]
    assert levels == pytest.approx([0, 30, 120, 150, 210], abs=3)
    assert "40 to 120 ms" in (reader.varying_rate() or "")


def test_truncated_avi(tmp_path: Path) -> None:
    path = cut(noisy_film(tmp_path / "a.avi"), 0.5)
    frames, error = read_until_error(VideoReader(path))
    assert 20 < len(frames) < 40
    assert f"{len(frames)} of 60 frames" in str(error)


@pytest.mark.parametrize("suffix", [".mkv", ".ts", ".m2ts"])
@pytest.mark.parametrize("share", [0.51, 0.987])
def test_truncated_where_no_number_of_frames_is_stated(
    tmp_path: Path, suffix: str, share: float
) -> None:
    whole = noisy_film(tmp_path / f"a{suffix}")
    frames, error = read_until_error(VideoReader(whole))
    assert (len(frames), error) == (60, None)
    frames, error = read_until_error(VideoReader(cut(whole, share)))
    assert share - 0.2 < len(frames) / 60 <= 1
    assert f"{len(frames)} frames could be read (the file is cut off)" in str(error)


def test_a_transport_stream_that_ends_between_two_of_its_packets(tmp_path: Path) -> None:
    """It tells where half a picture is there, or one is missing before the last."""
    path = demo_film(tmp_path / "a.ts")
    whole, expected = path.read_bytes(), [frame.image for frame in VideoReader(path)]
    packets = [whole[start : start + 188] for start in range(0, len(whole), 188)]
    # Where pictures begin: packets of the film (number 256) that are marked so.
    begins = [n for n, p in enumerate(packets) if p[1] & 0x40 and (p[1] & 0x1F, p[2]) == (1, 0)]
    assert len(begins) == len(expected)
    silent = 0
    for number, first in enumerate(begins[5:25], 5):
        for end in {first, (first + begins[number + 1]) // 2}:
            path.write_bytes(whole[: 188 * end])
            reader = VideoReader(path)
            frames, error = read_until_error(reader)
            assert number - 4 <= len(frames) <= number
            for frame in frames:
                np.testing.assert_array_equal(frame.image, expected[frame.index])
            if error is None:
                silent += 1
                assert len(frames) == number == reader.count_frames()
                assert end == first
            else:
                assert "frames could be read (the file is cut off)" in str(error)
    assert 0 < silent < 20


def test_a_last_picture_that_is_held_is_no_damage(tmp_path: Path) -> None:
    """A screen's film shows its last picture until something moves."""
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for index in range(4):
            picture = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
            picture.pts, picture.time_base = index, Fraction(1, 30)
            for packet in stream.encode(picture):
                packet.duration = 300 if index == 3 else 1
                container.mux(packet)
        for packet in stream.encode(None):
            packet.duration = 300
            container.mux(packet)
    frames, error = read_until_error(VideoReader(path))
    assert (len(frames), error) == (4, None)


def test_truncated_before_the_index_is_refused(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="not a video"):
        VideoReader(cut(noisy_film(tmp_path / "a.mp4"), 0.6))


def test_first_frame_undecodable(tmp_path: Path) -> None:
    path = noisy_film(tmp_path / "a.mp4", movflags="faststart")
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"mdat") + 8])
    with pytest.raises(VideoError):
        VideoReader(path)


@pytest.fixture(scope="module")
def good_files(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("good")
    return [
        noisy_film(folder / "a.mp4", 8, movflags="faststart").read_bytes(),
        noisy_film(folder / "a.mkv", 8).read_bytes(),
        film(folder / "b.mp4", 4).read_bytes(),
    ]


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    which=st.integers(0, 3),
    noise=st.binary(min_size=1, max_size=400),
    kept=st.floats(0.0, 1.0) | st.just(1.0),
    changes=st.lists(
        st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), max_size=20
    ),
    name=st.sampled_from(["a.mp4", "a.mkv", "a.png", "a.txt"]),
)
def test_only_video_errors_come_from_bad_bytes(
    good_files: list[bytes],
    tmp_path: Path,
    which: int,
    noise: bytes,
    kept: float,
    changes: list[tuple[float, int]],
    name: str,
) -> None:
    content = bytearray([*good_files, noise][which])
    for place, value in changes:
        content[int(place * len(content))] = value
    path = tmp_path / name
    path.write_bytes(content[: max(1, int(kept * len(content)))])
    try:
        reader = VideoReader(path)
    except VideoError as raised:
        error: VideoError | None = raised
    else:
        _, error = read_until_error(reader)
    if error is not None:
        assert "\n" not in str(error)
        assert str(path) in str(error)


# Folders of images.


def test_folder_is_sorted_naturally(tmp_path: Path) -> None:
    for index in range(12):
        level = np.full((6, 8, 3), grey_level(index), np.uint8)
        Image.fromarray(level).save(tmp_path / f"frame{index}.png")
    (tmp_path / "notes.txt").write_text("not an image")
    (tmp_path / ".hidden.png").write_text("not an image")
    reader = VideoReader(tmp_path, image_frame_rate=10)
    assert reader.info == (10, 8, 6, 12)
    assert [int(frame.image[0, 0, 0]) for frame in reader] == [grey_level(i) for i in range(12)]
    assert [frame.time_s for frame in reader] == pytest.approx(np.arange(12) / 10)


def test_numbers_that_are_missing() -> None:
    names = [f"clip2_{number:03d}.png" for number in (7, 8, 9, 12, 13, 15)]
    assert "3 pictures are missing" in (missing_numbers(names) or "")
    assert "behind clip2_009.png" in (missing_numbers(names) or "")
    assert missing_numbers(names[:3]) is None
    assert missing_numbers(["a.png", "b.png", *names]) is None
    assert missing_numbers([f"{number}.png" for number in (0, 40, 83, 121, 160)]) is None


def test_pictures_of_several_kinds_are_told() -> None:
    assert several_kinds(["a.jpg", "b.JPG"]) is None
    told = several_kinds(["a.png", "a.jpg", "b.png"])
    assert told is not None
    assert "1 .jpg and 2 .png" in told


def test_pictures_that_are_not_read_are_told(tmp_path: Path) -> None:
    (tmp_path / "2.HEIC").touch()
    with pytest.raises(VideoError, match=r"no images in this folder; .* 1, such as 2\.HEIC: save"):
        VideoReader(tmp_path)
    for name in ("1.jpg", "3.jpg"):
        Image.new("RGB", (8, 6)).save(tmp_path / name)
    view = open_view(ViewFiles(video=tmp_path, keypoints=None), Camera.pinhole(8, 6, focal_px=6.0))
    assert any("not read are left out, 1, such as 2.HEIC" in note for note in view.notes)
    (tmp_path / "2.HEIC").unlink()
    assert VideoReader(tmp_path).left_out is None


def test_several_films_in_one_file_are_told(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        streams = [container.add_stream("libx264", rate=25) for _ in range(2)]
        for stream, width in zip(streams, (32, 64), strict=True):
            stream.width, stream.height, stream.pix_fmt = width, 48, "yuv420p"
        for stream in streams:
            image = np.zeros((48, stream.width, 3), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode(None))
    told = "2 films or covers in one file: the first, of 32 x 48 pixels, is read"
    assert VideoReader(tmp_path / "a.mp4").left_out == told


def test_natural_order() -> None:
    names = ["10.png", "2.PNG", "a10", "a2", "b", "²", "1"]  # a superscript is no digit
    assert sorted(names, key=natural_order) == ["1", "2.PNG", "10.png", "a2", "a10", "b", "²"]


def test_kinds_of_images(tmp_path: Path) -> None:
    ramp = np.arange(256, dtype=np.uint16).reshape(16, 16)
    Image.fromarray((ramp * 257).astype(np.uint16)).save(tmp_path / "grey16.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey16.png")[..., 1], ramp)
    Image.fromarray(ramp.astype(np.uint8)).save(tmp_path / "grey8.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey8.png")[..., 2], ramp)
    colour = np.full((4, 5, 4), 200, np.uint8)
    colour[:, :2, 3] = 0
    colour[:, 2:, 3] = 255
    Image.fromarray(colour).save(tmp_path / "alpha.png")
    image = read_image(tmp_path / "alpha.png")
    assert image[0, 0].tolist() == [0, 0, 0]
    assert image[0, 4].tolist() == [200, 200, 200]
    Image.fromarray(colour[..., :3]).convert("P").save(tmp_path / "palette.png")
    assert read_image(tmp_path / "palette.png").shape == (4, 5, 3)
    Image.fromarray(colour[..., :3]).convert("CMYK").save(tmp_path / "ink.jpg")
    assert read_image(tmp_path / "ink.jpg").shape == (4, 5, 3)
    # A telephone's rotation: orientation 6 is shown turned clockwise.
    tags = Image.Exif()
    tags[0x0112] = 6
    Image.fromarray(colour[..., :3]).save(tmp_path / "turned.jpg", exif=tags)
    assert read_image(tmp_path / "turned.jpg").shape == (5, 4, 3)
    Image.fromarray(ramp.astype(np.float32)).save(tmp_path / "real.tiff")
    with pytest.raises(VideoError, match="floating-point"):
        read_image(tmp_path / "real.tiff")


def test_one_image_is_a_video_of_one_frame(tmp_path: Path) -> None:
    Image.new("RGB", (7, 5)).save(tmp_path / "a.png")
    assert [frame.image.shape for frame in VideoReader(tmp_path / "a.png")] == [(5, 7, 3)]


@pytest.mark.parametrize("name", ["a.tif", "a.webp", "a.png"])
def test_a_file_of_many_pictures_is_no_picture(tmp_path: Path, name: str) -> None:
    first, *more = (Image.new("RGB", (7, 5), (40 * level, 0, 0)) for level in range(4))
    first.save(tmp_path / name, save_all=True, append_images=more)
    with pytest.raises(VideoError, match="4 pictures in one file; save them as a folder"):
        VideoReader(tmp_path / name)
    first.save(tmp_path / "a.tif", save_all=True, append_images=[Image.new("RGB", (3, 2))])
    assert VideoReader(tmp_path / "a.tif").info.num_frames == 1  # beside it is a small copy


def test_bad_folders(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="no images"):
        VideoReader(tmp_path)
    (tmp_path / "b.MOV").touch()
    with pytest.raises(VideoError, match=r"give a video in it, such as .*b\.MOV"):
        VideoReader(tmp_path)
    Image.new("RGB", (8, 6)).save(tmp_path / "0.png")
    Image.new("RGB", (9, 6)).save(tmp_path / "1.png")
    frames, error = read_until_error(VideoReader(tmp_path))
    assert len(frames) == 1
    assert "9 x 6" in str(error)
    assert "8 x 6" in str(error)
    for chosen in ({"start": 1}, {"stop": 1}):
        reader = VideoReader(tmp_path, **chosen)
        reader.check_sizes()
        assert len(list(reader)) == 1
    with pytest.raises(VideoError, match="beyond the end"):
        VideoReader(tmp_path, start=2)
    (tmp_path / "1.png").write_bytes((tmp_path / "0.png").read_bytes()[:40])
    frames, error = read_until_error(VideoReader(tmp_path))
    assert len(frames) == 1
    assert "1.png" in str(error)
    for rate in (0, -1, math.nan, math.inf):
        with pytest.raises(VideoError, match="per second"):
            VideoReader(tmp_path, image_frame_rate=rate)
    assert VideoReader(tmp_path, image_frame_rate=1 / 3600).info.frame_rate > 0


def test_pictures_of_several_sizes_are_told_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upright = Image.new("RGB", (8, 6))
    turned, exif = Image.new("RGB", (6, 8)), Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    for suffix in (".jpg", ".png", ".tif", ".webp"):
        upright.save(tmp_path / f"a{suffix}")
        turned.save(tmp_path / f"b{suffix}", exif=exif)
    (tmp_path / "broken.jpg").write_bytes(b"x")
    VideoReader(tmp_path).check_sizes()
    files = ViewFiles(video=tmp_path, keypoints=None)
    open_view(files, Camera.pinhole(8, 6, focal_px=6.0))
    turned.save(tmp_path / "c.jpg")
    for act in (
        lambda: open_view(files, Camera.pinhole(8, 6, focal_px=6.0)),
        lambda: detect_video(tmp_path, tmp_path / "people.npz"),
    ):
        with pytest.raises(VideoError, match=r"c\.jpg: has 6 x 8 pixels, the first one has 8 x 6"):
            act()
    # Twenty thousand pictures must take seconds: none is decoded that is of the first one's size.
    reader = VideoReader(tmp_path, stop=3)
    monkeypatch.setattr(video, "read_image", None)
    reader.check_sizes()
    # Nor is one opened again that is as it was: films are detected first and tracked then.
    monkeypatch.setattr(pictures, "Image", None)
    reader.check_sizes()


# Writing.


def test_interrupted_writer_keeps_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    image = np.zeros((16, 16, 3), np.uint8)

    def run() -> None:
        with VideoWriter(path, 30) as writer:
            for index in range(100):
                if index == 7:
                    raise KeyboardInterrupt
                writer.write(image)

    with pytest.raises(KeyboardInterrupt):
        run()
    assert len(list(VideoReader(path))) == 7
    assert list(tmp_path.iterdir()) == [path]


def test_a_killed_process_leaves_the_old_file_and_a_playable_partial_one(tmp_path: Path) -> None:
    path = film(tmp_path / "a.mp4", 5)
    good = path.read_bytes()
    programme = (
        "import sys, os, signal, numpy as np\n"
        "from torchcss.io.video import VideoWriter\n"
        "writer = VideoWriter(sys.argv[1], 10)\n"
        "source = np.random.default_rng(0)\n"
        "for _ in range(100): writer.write(source.integers(0, 256, (64, 64, 3), dtype=np.uint8))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert begin(programme, str(path)).end() == -signal.SIGKILL
    assert path.read_bytes() == good
    (partial,) = (entry for entry in tmp_path.iterdir() if entry != path)
    frames, _ = read_until_error(VideoReader(partial))
    assert len(frames) > 10


@pytest.mark.parametrize("old", [False, True])
def test_full_disk(tmp_path: Path, old: bool) -> None:
    # A limit on the size of files stands in for the full disk: the same path through FFmpeg.
    path = tmp_path / "a.mp4"
    if old:
        film(path, 3)
    programme = (
        "import sys, resource, signal, numpy as np\n"
        "from torchcss.errors import OutputError\n"
        "from torchcss.io.video import VideoWriter\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200000, 200000))\n"
        "source = np.random.default_rng(0)\n"
        "try:\n"
        "    with VideoWriter(sys.argv[1], 10) as writer:\n"
        "        for _ in range(300):\n"
        "            writer.write(source.integers(0, 256, (64, 64, 3), dtype=np.uint8))\n"
        "except OutputError as error:\n"
        "    tell(str(error))\n"
    )
    begun = begin(programme, str(path))
    assert "larger than this system allows" in begun.told.recv()
    assert begun.end() == 0
    assert list(tmp_path.iterdir()) == [path]
    frames, _ = read_until_error(VideoReader(path))
    assert len(frames) == 3 if old else len(frames) > 5


def test_writer_without_frames_leaves_nothing(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", 30):
        pass
    assert list(tmp_path.iterdir()) == []


def test_unwritable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.zeros((16, 16, 3), np.uint8)
    with pytest.raises(OutputError), VideoWriter(tmp_path / "none" / "a.mp4", 30) as writer:
        writer.write(image)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError), VideoWriter(tmp_path / "file" / "a.mp4", 30) as writer:
        writer.write(image)

    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OutputError, match="read-only"), VideoWriter(tmp_path / "a.mp4", 30) as w:
        w.write(image)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file"]


def test_bad_frames_and_options(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", 30) as writer:
        writer.write(np.zeros((16, 16, 3), np.uint8))
        for image in (
            np.zeros((16, 18, 3), np.uint8),
            np.zeros((16, 16), np.uint8),
            np.zeros((16, 16, 3)),
            np.zeros((0, 16, 3), np.uint8),
        ):
            with pytest.raises(ShapeError):
                writer.write(image)
    with pytest.raises(ConfigurationError, match="mp4"):
        VideoWriter(tmp_path / "a.xyz", 30)
    with pytest.raises(ConfigurationError, match="crf"):
        VideoWriter(tmp_path / "a.mp4", 30, crf=52)
    for rate in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ConfigurationError, match="per second"):
            VideoWriter(tmp_path / "a.mp4", rate)


# Files of others.


@pytest.mark.parametrize(
    ("name", "size_wh", "num_frames", "rate"),
    [
        ("balance_beam_4cam/cam01.mp4", (1080, 1920), 100, 60),
        ("handheld_board/cam_0.mp4", (1280, 720), 57, 6),
        ("walk_sit_mono/cam0.mp4", (720, 720), 187, 20),
        ("rendered_turn/video.mp4", (640, 480), 103, 30),
    ],
)
def test_real_videos(
    shared_data: Path, name: str, size_wh: tuple[int, int], num_frames: int, rate: int
) -> None:
    reader = VideoReader(shared_data / name, start=num_frames - 3)
    assert reader.info == (rate, *size_wh, num_frames)
    assert reader.count_frames() == num_frames
    assert [frame.index for frame in reader] == list(range(num_frames - 3, num_frames))


def test_real_folder_shows_what_the_video_shows(shared_data: Path) -> None:
    beam = shared_data / "balance_beam_4cam"
    (whole,) = VideoReader(beam / "cam01.mp4", start=7, stop=8)
    (half,) = VideoReader(beam / "frames_half" / "cam01", start=7, stop=8)
    shrunk = np.asarray(Image.fromarray(whole.image).resize((540, 960), Image.Resampling.BOX))
    assert np.abs(shrunk.astype(float) - half.image).mean() < 4


def test_pixels_that_are_not_square_are_told(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(16, 11)
        for _ in range(3):
            picture = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    reader = VideoReader(path)
    assert reader.pixel_aspect == Fraction(16, 11)
    lens = KnownLens(focal=100.0).camera(64, 48)
    notes = OpenView(ViewFiles(video=path, keypoints=None), reader, None, lens, None, 1.0).notes
    assert any("1.45 times as wide as high" in note for note in notes)
