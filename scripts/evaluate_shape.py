"""How well the first pose fills the true silhouette: by joints, by edges, by edges and colours.

    python scripts/evaluate_shape.py --sequences DIR ... --out shape.json

Each DIR is a sequence folder with masks (`torchcss.studies.sequences`). In some of its frames
`torchcss.initialise` fits pose, lengths and shape to the marked joints; then to edges too; then to
the colours on either side of the outline as well; then with parts that bend. "overlap" is the share
of the union of fitted and true silhouette that both have, "area" the fitted one's over the true
one's, "root mm" the error of the best fit's joints with the mid-hips on each other (an arm's: the
first joint), "of all" that of the nearest fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Table, finish, start

from torchcss.errors import ConfigurationError
from torchcss.initialise.fit import initialise
from torchcss.initialise.multi_start import StartSearch
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.result import Initialisation
from torchcss.io.video import read_frame
from torchcss.studies.evaluation import silhouette
from torchcss.studies.metrics import mask_overlap, root_aligned_mpjpe_mm
from torchcss.studies.sequences import RecordedSequence, read_sequence
from torchcss.types import frozen

COMPARED = {
    "joints": {"contours": False, "colours": False},
    "edges": {"colours": False},
    "edges, colours": {},
    "and bends": {"bends": True},
}
"""What is fitted, as options."""

FEW = StartSearch(num_starts=8, num_trunks=2, num_flips=8, num_samples=2)


@frozen
class Config:
    """What is fitted."""

    sequences: tuple[Path, ...]
    """Sequence folders with masks."""
    body: str = "body34"
    """Body to fit."""
    frames: int = 2
    """Frames of each, evenly spread."""
    seed: int = 0
    """Seed of the starting poses."""
    small: bool = False
    """One frame and few starts, to see that it runs."""
    out: Path | None = None
    """JSON file to write."""


def main(config: Config) -> dict[str, Any]:
    """Fit, print and write the table; return what is written."""
    report: dict[str, Any] = {"setting": config, "rows": []}
    for folder in config.sequences:
        sequence = read_sequence(folder)
        if sequence.mask is None:
            raise ConfigurationError(f"{folder}: no masks; give a sequence with a mask.npz")
        count = 1 if config.small else min(config.frames, sequence.num_frames)
        for index in np.linspace(0, sequence.num_frames, count, endpoint=False).astype(int):
            for name, fitted in COMPARED.items():
                row = fit(sequence, int(index), config, fitted)
                report["rows"].append(
                    {"sequence": sequence.name, "frame": int(index), "by": name, **row}
                )
    columns = ("sequence", "frame", "by", "overlap", "area", "root mm", "of all mm")
    table = Table("Outline of the first pose", columns, [[*r.values()] for r in report["rows"]])
    return finish(config.out, report, table)


def fit(
    sequence: RecordedSequence, index: int, config: Config, fitted: Mapping[str, Any]
) -> dict[str, float]:
    """Fit one frame and measure."""
    found = initialise(
        read_frame(sequence.video, index),
        sequence.keypoints.at(index),
        sequence.camera,
        config.body,
        generator=torch.Generator().manual_seed(config.seed),
        options=InitialiseOptions(search=FEW if config.small else StartSearch(), **fitted),
    )
    assert sequence.mask is not None
    true = sequence.mask[index]
    drawn = silhouette(found.body, found.mixture.mean[0], sequence.camera)
    errors = joint_errors(found, sequence, index)
    return {
        "overlap": float(mask_overlap(drawn, true)),
        "area": float(drawn.sum() / true.sum()),
        "root_mm": float(errors[0]),
        "of_all_mm": float(errors.min()),
    }


def joint_errors(found: Initialisation, sequence: RecordedSequence, index: int) -> np.ndarray:
    """Root-aligned errors of the fits, over the joints whose truth is known."""
    true = dict(zip(sequence.joint_names, sequence.joints_world[index], strict=True))
    names = [n for n in found.body.joint_names if n in true and np.isfinite(true[n]).all()]
    columns = found.body.joint_columns(names)
    joints = found.body.pose(found.mixture.mean).joints[:, columns].numpy()
    root = None if "l_hip" in names else names[0]
    reference = np.stack([true[name] for name in names])
    return root_aligned_mpjpe_mm(joints, reference, names, root=root)


if __name__ == "__main__":
    start(main, Config, __doc__)
