"""Single pictures, and folders of them: reading one, its size, and the order of their names.

Call `read_image`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from torchcss.errors import VideoError
from torchcss.files import StrPath, refusing
from torchcss.types import ColourImage


def read_image(path: StrPath) -> ColourImage:
    """Read one image as 8-bit red, green, blue, turned upright.

    16-bit grey is scaled to 8 bit; transparent images are laid over black.

    Args:
        path: An image that Pillow reads.

    Returns:
        The image `[height, width, 3]`.

    Raises:
        VideoError: If the file is missing, damaged or no image.
    """
    what, advice = f"{path}: not an image that can be read", "get a complete copy"
    # Pillow's decoders raise whatever their format's damage leads to.
    with refusing(VideoError, what, advice=advice), Image.open(path) as opened:
        picture = ImageOps.exif_transpose(opened)
        if picture.mode == "F":
            raise VideoError(
                f"{path}: floating-point images have no fixed range; expected 8 or 16 bit"
            )
        if picture.mode.startswith("I"):
            values = np.asarray(picture)
            grey = (values.astype(np.int64).clip(0, 65535) >> 8).astype(np.uint8)
            return np.repeat(grey[:, :, None], 3, axis=2)
        if "A" in picture.getbands() or "transparency" in picture.info:
            picture = picture.convert("RGBA")
            black = Image.new("RGBA", picture.size, (0, 0, 0, 255))
            picture = Image.alpha_composite(black, picture)
        return np.array(picture.convert("RGB"))


def size_at_beginning(path: Path) -> tuple[int, int] | None:
    """Columns and rows of an image, turned upright; None: nothing that can be read says it.

    The pixels are not read.
    """
    try:
        status = path.stat()
    except OSError:
        return None
    return _size_of_file(path, status.st_mtime_ns, status.st_size)


@lru_cache(2**16)
def _size_of_file(path: Path, _changed: int, _length: int) -> tuple[int, int] | None:
    """The same; a file that is as it was is not opened again, as by who detects and then tracks.

    What a PNG says of its turn behind the pixels is not looked for.
    """
    with suppress(Exception), Image.open(path) as opened:  # see `read_image`
        width, height = opened.size
        turn = opened.getexif().get(ExifTags.Base.Orientation, 1) if "exif" in opened.info else 1
        return (height, width) if turn > 4 else (width, height)
    return None


def num_pictures(path: Path) -> int:
    """How many pictures of one size a file holds, as TIFF and WebP may; a small copy is none."""
    with suppress(Exception), Image.open(path) as opened:  # see `read_image`
        size = opened.size
        opened.seek(1)
        if opened.format != "MPO" and opened.size == size:  # of a telephone, for two eyes
            return opened.n_frames  # type: ignore[attr-defined]
    return 1


def natural_order(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sorting key in which numbers inside names count as numbers: 2 before 10."""
    # `[0-9]` and not `\d`: the latter takes signs such as superscripts that `int` refuses.
    parts = re.split(r"([0-9]+)", name)
    return tuple(
        (0, int(part)) if number else (1, part.lower())
        for number, part in ((index % 2, part) for index, part in enumerate(parts))
        if part
    )


def missing_numbers(names: Sequence[str]) -> str | None:
    """A line about numbers that are missing between those of a folder's pictures, if there are any.

    Args:
        names: The pictures in order, most of them numbered one after another.
    """
    found = [re.findall(r"[0-9]+", Path(name).stem)[-1:] for name in names]
    numbers = [int(number) for of in found for number in of]
    steps = [after - before for before, after in pairwise(numbers)]
    gaps = [place for place, step in enumerate(steps) if step != 1]
    # Pictures numbered in another way, such as by time, have no gaps to tell.
    if len(numbers) < len(names) or not gaps or len(gaps) > 0.5 * len(steps) or min(steps) < 1:
        return None
    return (
        f"{sum(steps) - len(steps)} pictures are missing by their numbers, the first behind "
        f"{names[gaps[0]]}: those beside a gap are taken to follow one another"
    )


def several_kinds(names: Sequence[str]) -> str | None:
    """A line about a folder that holds pictures of several kinds; they may be the same twice."""
    kinds = Counter(Path(name).suffix.lower() for name in names)
    if len(kinds) < 2:
        return None
    told = " and ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    return f"pictures of several kinds, {told}: all are taken, in the order of their names"
