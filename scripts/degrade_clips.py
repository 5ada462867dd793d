"""Copies of clips that are worse than those were, in ways that users' clips are.

    python scripts/degrade_clips.py CLIP [CLIP ...] --out worse
    python scripts/evaluate_posterior.py --data worse --out worse.json

A clip is a folder with `video.mp4`, `cameras.json`, `keypoints2d.npz` and `reference3d.npz`, as
`scripts/make_clips.py` writes it. Of each there are as many copies as kinds:

| kind | what is worse |
|---|---|
| crop | the picture ends a little below the hips |
| gap | the second third of the frames has no keypoints |
| swap | left and right are exchanged in twice five frames |
| outliers | 15 % of the keypoints lie somewhere else |
| small | 160 pixels on the shorter side |
| third | every third frame |
| grey | no colours |
| noise | darker, with noise of 8 grey values, and compressed hard |
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from common import start
from PIL import Image

from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder, save_arrays
from torchcss.io.cameras import read_camera
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.joint_names import canonical_joint_name
from torchcss.studies.sequence_writer import write_camera
from torchcss.types import frozen
from torchcss.vision.camera import Camera

SHORT_SIDE, OUTLIERS, SWAPPED = 160, 0.15, 5
NOISE, BRIGHTNESS, COMPRESSED = 8.0, 0.4, 35


@frozen
class Config:
    """What to copy."""

    clips: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of clips."""
    out: Path
    """Folder for the copies, each in one of its own."""
    kinds: tuple[str, ...] = ()
    """Kinds of copies; all by default."""
    seed: int = 0
    """Seed of what is random."""


@dataclass(frozen=True)
class Clip:
    """What a folder holds."""

    images: np.ndarray
    frame_rate: float
    camera: Camera
    keypoints: np.ndarray
    confidence: np.ndarray
    joints: tuple[str, ...]
    reference: dict[str, Any]
    crf: int = 18

    @classmethod
    def read(cls, folder: Path) -> Clip:
        """Read a folder."""
        video = VideoReader(folder / "video.mp4")
        with np.load(folder / "keypoints2d.npz") as file:
            points, confidence = file["keypoints"], file["confidence"]
            joints = tuple(map(str, file["joint_names"]))
        with np.load(folder / "reference3d.npz") as file:
            reference = dict(file)
        return cls(
            np.stack([frame.image for frame in video]),
            float(video.info.frame_rate),
            read_camera(folder / "cameras.json", video=folder / "video.mp4"),
            *(points, confidence, joints, reference),
        )

    def write(self, folder: Path) -> None:
        """Write it as a folder."""
        folder = prepare_output_folder(folder)
        with VideoWriter(folder / "video.mp4", self.frame_rate, crf=self.crf) as video:
            for image in self.images:
                video.write(image)
        write_camera(folder / "cameras.json", self.camera)
        known = {"keypoints": self.keypoints, "confidence": self.confidence}
        named = {"joint_names": self.joints, "frame_rate": self.frame_rate}
        save_arrays(folder / "keypoints2d.npz", known | named)
        save_arrays(folder / "reference3d.npz", self.reference)

    def without(self, gone: np.ndarray) -> Clip:
        """The same without some of the keypoints."""
        points = np.where(gone[..., None], np.nan, self.keypoints)
        return replace(self, keypoints=points, confidence=np.where(gone, 0.0, self.confidence))


def crop(clip: Clip, _: np.random.Generator) -> Clip:
    """The picture ends below the hips."""
    hips = [k for k, name in enumerate(clip.joints) if canonical_joint_name(name) in HIPS]
    if not hips:
        raise ConfigurationError("crop: the keypoints have no hips")
    height = clip.images.shape[1]
    end = int(np.nanmedian(clip.keypoints[:, hips, 1]) + 0.05 * height) // 2 * 2
    end = min(max(end, 2), height)
    camera = clip.camera.cropped(0, 0, clip.camera.image_size_wh[0], end)
    below = clip.keypoints[..., 1] > end
    return replace(clip.without(below), images=clip.images[:, :end], camera=camera)


def gap(clip: Clip, _: np.random.Generator) -> Clip:
    """A third of the frames has no keypoints."""
    third, gone = len(clip.images) // 3, np.zeros(clip.confidence.shape, bool)
    gone[third : 2 * third] = True
    return clip.without(gone)


def swap(clip: Clip, _: np.random.Generator) -> Clip:
    """Left and right are exchanged now and then."""
    names = [canonical_joint_name(name) or name for name in clip.joints]
    other = [names.index(name) if name in names else k for k, name in enumerate(map(twin, names))]
    points, confidence = clip.keypoints.copy(), clip.confidence.copy()
    for first in (len(points) // 4, len(points) // 2):
        frames = slice(first, first + SWAPPED)
        points[frames], confidence[frames] = points[frames][:, other], confidence[frames][:, other]
    return replace(clip, keypoints=points, confidence=confidence)


def outliers(clip: Clip, generator: np.random.Generator) -> Clip:
    """Some of the keypoints lie somewhere else about the person."""
    known = np.where(clip.confidence[..., None] > 0, clip.keypoints, np.nan)
    box = np.nanmin(known, (0, 1)), np.nanmax(known, (0, 1))
    wrong = generator.random(clip.confidence.shape) < OUTLIERS
    elsewhere = generator.uniform(*box, clip.keypoints.shape)
    return replace(clip, keypoints=np.where(wrong[..., None], elsewhere, clip.keypoints))


def small(clip: Clip, _: np.random.Generator) -> Clip:
    """A small picture."""
    height, width = clip.images.shape[1:3]
    factor = SHORT_SIDE / min(width, height)
    size = round(width * factor / 2) * 2, round(height * factor / 2) * 2
    images = [Image.fromarray(image).resize(size, Image.Resampling.BOX) for image in clip.images]
    ratio = np.array(size) / (width, height)
    return replace(
        clip,
        images=np.stack(list(map(np.asarray, images))),
        camera=clip.camera.resized(*size),
        keypoints=(clip.keypoints + 0.5) * ratio - 0.5,
    )


def third(clip: Clip, _: np.random.Generator) -> Clip:
    """Every third frame."""
    whole = len(clip.images)
    reference = {
        name: value[::3] if value.ndim and len(value) == whole else value
        for name, value in clip.reference.items()
    }
    reference["frame_rate"] = np.array(clip.frame_rate / 3)
    return replace(
        clip,
        images=clip.images[::3],
        frame_rate=clip.frame_rate / 3,
        keypoints=clip.keypoints[::3],
        confidence=clip.confidence[::3],
        reference=reference,
    )


def grey(clip: Clip, _: np.random.Generator) -> Clip:
    """No colours."""
    mean = clip.images.mean(-1, keepdims=True).astype(np.uint8)
    return replace(clip, images=np.repeat(mean, 3, -1))


def noise(clip: Clip, generator: np.random.Generator) -> Clip:
    """Dark, noisy and compressed."""
    images = np.empty_like(clip.images)
    for own, image in zip(images, clip.images, strict=True):
        worse = BRIGHTNESS * image + generator.normal(0, NOISE, image.shape)
        own[...] = worse.clip(0, 255)
    return replace(clip, images=images, crf=COMPRESSED)


HIPS = ("l_hip", "r_hip")
KINDS: dict[str, Callable[[Clip, np.random.Generator], Clip]] = {
    kind.__name__: kind for kind in (crop, gap, swap, outliers, small, third, grey, noise)
}


def twin(name: str) -> str:
    """The same joint of the other side."""
    return {"l_": "r_", "r_": "l_"}.get(name[:2], name[:2]) + name[2:]


def chosen(names: Iterable[str]) -> list[str]:
    """The kinds that are asked for."""
    kinds = list(names) or list(KINDS)
    unknown = [name for name in kinds if name not in KINDS]
    if unknown:
        raise ConfigurationError(f"--kinds {unknown[0]}: expected some of {', '.join(KINDS)}")
    return kinds


def main(config: Config) -> list[Path]:
    """Write the copies, and say where they are."""
    made = []
    for folder in config.clips:
        clip = Clip.read(folder)
        for kind in chosen(config.kinds):
            made.append(config.out / f"{folder.name}-{kind}")
            generator = np.random.default_rng(config.seed)
            KINDS[kind](clip, generator).write(made[-1])
    print(json.dumps({"clips": [str(path) for path in made]}))
    return made


if __name__ == "__main__":
    start(main, Config, __doc__)
