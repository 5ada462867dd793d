"""Typed errors for bad input, and the shape check that raises them.

Every error of this package that a user can cause derives from `TorchcssError`; its message is one
line that says what was expected, what was found, and what to do. The command line prints that line
and exits with status 2; a library user catches the class.

Numerical trouble is not an error: it is data (see `torchcss.types.Status`).
"""

from __future__ import annotations

import importlib
import math
import operator
from typing import Any

import torch
from torch import Tensor


class TorchcssError(Exception):
    """Base of all errors that bad input causes."""


class ShapeError(TorchcssError, ValueError):
    """A tensor has the wrong shape, dtype or device."""


class BodyError(TorchcssError, ValueError):
    """A body or robot description cannot be used: unknown name, bad URDF, duplicate joint."""


class CameraError(TorchcssError, ValueError):
    """A camera file or camera value is missing, malformed or belongs to another image size."""


class VideoError(TorchcssError, ValueError):
    """A video or image folder is missing, empty, truncated or not a video."""


class FrameError(TorchcssError, ValueError):
    """The pixels of a frame cannot be used: not finite, or not grey levels in 0..1."""


class FlowFileError(TorchcssError, ValueError):
    """A `.flo` file is missing, truncated or not a flow file."""


class KeypointError(TorchcssError, ValueError):
    """A keypoint file is missing, malformed, of unknown layout or has nobody in it."""


class MotionCaptureError(TorchcssError, ValueError):
    """A motion capture file is missing, malformed, or not of the format that its name says."""


class TrackFileError(TorchcssError, ValueError):
    """A track file is missing, malformed or of another schema version."""


class OutputError(TorchcssError, OSError):
    """The output folder cannot be written, or the disk is full."""


class ConfigurationError(TorchcssError, ValueError):
    """An option has a value that makes no sense, alone or together with another."""


class DetectorError(TorchcssError, ValueError):
    """A detector of keypoints has no model, or one that cannot be used."""


class MissingExtraError(TorchcssError, ImportError):
    """An optional package is needed; the message says which extra installs it."""


def optional_package(name: str, message: str) -> Any:
    """A package that not every installation has.

    Args:
        name: The module to import.
        message: Who needs it, and how it is installed.

    Raises:
        MissingExtraError: With that message, if it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtraError(message) from error


def check_positive(choice: object, *names: str, hint: str = "", finite: bool = False) -> None:
    """Check that attributes of a choice are positive numbers, or None.

    Args:
        choice: A record of choices.
        names: Its attributes: a number each, or a tuple of them.
        hint: What to do, for the message.
        finite: Infinity is no number either.

    Raises:
        ConfigurationError: If one is not.
    """
    for name in names:
        value = getattr(choice, name)
        if not all(each > 0 and (each < math.inf or not finite) for each in _numbers(value)):
            where = f"{type(choice).__name__}.{name}"
            raise ConfigurationError(f"{where}: expected a positive number, got {value}{hint}")


def _numbers(value: Any) -> tuple[Any, ...]:
    """What there is of an attribute."""
    # Trackers are made anew for each frame: tensors would take far longer.
    return value if isinstance(value, tuple) else () if value is None else (value,)


def make_whole(choice: object, *names: str) -> None:
    """Make Python's of the whole numbers of a frozen record of choices: NumPy's are no JSON.

    Args:
        choice: A record of choices.
        names: Its attributes; None stays.

    Raises:
        ConfigurationError: If one is no whole number.
    """
    for name in names:
        value = getattr(choice, name)
        try:
            object.__setattr__(choice, name, None if value is None else operator.index(value))
        except TypeError as error:
            where = f"{type(choice).__name__}.{name}"
            raise ConfigurationError(f"{where}: expected a whole number, got {value!r}") from error


def check_range(
    choice: object,
    *names: str,
    least: float = 0.0,
    most: float = math.inf,
    hint: str = "",
    finite: bool = True,
) -> None:
    """Check that attributes of a choice lie in a range, both ends included, or are None.

    Args:
        choice: A record of choices.
        names: Its attributes: a number each, or a tuple of which each is to lie there.
        least: The lower end.
        most: The upper end.
        hint: What to do, for the message.
        finite: Infinity is no number.

    Raises:
        ConfigurationError: If one does not.
    """
    span = f"at least {least:g}" if most == math.inf else f"{least:g} to {most:g}"
    for name in names:
        value = getattr(choice, name)
        if not all(
            least <= each <= most and (each < math.inf or not finite) for each in _numbers(value)
        ):
            where = f"{type(choice).__name__}.{name}"
            raise ConfigurationError(f"{where}: expected {span}, got {value}{hint}")


def check_device(device: torch.device | str) -> None:
    """Check that there is a device.

    Args:
        device: Its name.

    Raises:
        ConfigurationError: If there is none.
    """
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # the latter without CUDA
        name = str(device)
        raise ConfigurationError(f"device {name!r} is not available here; use cpu") from error


def check_shape(name: str, tensor: Tensor, *trailing: int | None) -> None:
    """Check that `tensor` ends in the dimensions `trailing`; `None` stands for any size.

    Args:
        name: How the caller calls the tensor, for the message.
        tensor: The tensor to check; any number of leading dimensions is accepted.
        trailing: The sizes of the last dimensions.

    Raises:
        ShapeError: If the number or the size of the trailing dimensions differs, or it is no
            tensor.
    """
    if not isinstance(tensor, Tensor):
        raise ShapeError(
            f"{name}: expected a tensor, got {type(tensor).__name__}; use torch.as_tensor"
        )
    got = tuple(tensor.shape)
    tail = got[len(got) - len(trailing) :] if len(got) >= len(trailing) else None
    if tail is None or any(
        want is not None and have != want for have, want in zip(tail, trailing, strict=True)
    ):
        wanted = ", ".join("any" if want is None else str(want) for want in trailing)
        raise ShapeError(f"{name}: expected a shape [..., {wanted}], got {list(got)}")


def check_floating(name: str, tensor: Tensor) -> None:
    """Check that a tensor holds numbers of single or double precision.

    Args:
        name: How the caller calls the tensor, for the message.
        tensor: The tensor to check.

    Raises:
        ShapeError: If it is of another type.
    """
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ShapeError(f"{name}: expected float32 or float64, got {tensor.dtype}")
