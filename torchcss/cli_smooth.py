"""The verb `torchcss smooth`: one trajectory through the modes of a whole track."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchcss.smooth import Smoothing, smooth_file


@dataclass(frozen=True, kw_only=True)
class Smooth:
    """Choose among the modes of a track with all frames in view, and smooth what was chosen."""

    track: Annotated[Path, tyro.conf.Positional]
    """track.npz, or the folder that it is in. It stays as it is."""
    out: Path | None = None
    """Folder for smooth.npz and summary.json; by default the track's folder."""
    evidence: float = Smoothing.evidence
    """Power of each frame's evidence; below 1 because errors of images persist over frames."""
    agility: float = Smoothing.agility
    """Expected accelerations over expected velocities, 1/s; lower is smoother."""

    def run(self) -> None:
        """Run the verb."""
        choice = Smoothing(evidence=self.evidence, agility=self.agility)
        print(report(smooth_file(self.track, out=self.out, choice=choice)))


def report(effect: dict[str, Any]) -> str:
    """What smoothing did, in a few lines.

    Args:
        effect: What `smooth_file` returned.
    """
    lines = [
        f"jitter {effect['jitter_before_m_per_s2']:.1f} to {effect['jitter_after_m_per_s2']:.1f} "
        f"m/s^2, joints moved by {effect['mean_change_mm']:.0f} mm in the mean",
        f"{effect['frames_not_the_trackers_best']} frames take another mode than the tracker's "
        f"best, {effect['path_switches']} switches between modes are left",
    ]
    blind = len(effect["frames_without_evidence"])
    if blind:
        lines.append(f"{blind} frames had no evidence and follow from their neighbours")
    return "\n".join([*lines, f"wrote {effect['file']}"])
