"""What a tracker does when it has lost its target: search more widely, and jump.

`torchcss.inference.loss_monitor` tells from the costs that the track is lost. Until it is found
again, each frame is searched with more samples, at a larger scale, for more modes ("when tracking
fails, the number of modes and of samples can be increased", section 8 [IJRR]), and most samples
are of the poses that project to the same places as the best mode: the forward-backward flips of
initialisation (`torchcss.body.flips`), which lie far apart in space and next to each other in the
image. A track that was lost for that reason is found in one frame.
"""

from __future__ import annotations

from dataclasses import replace

from torchcss.inference.loss_monitor import LossMonitor
from torchcss.inference.particle import AnnealedParticleFilter, ParticleFilter
from torchcss.inference.proposals import ScaledProposal
from torchcss.inference.tracker import SequenceTracker, Tracker
from torchcss.types import frozen


@frozen
class Recovery:
    """How losses are told, and how the search widens then.

    Attributes:
        monitor: Tells a loss from the costs.
        samples: How many times as many samples.
        modes: How many times as many modes.
        scale: Factor on the covariance scale, for proposals that have one.
        num_flips: Most flips of the best mode that are searched, see
            `torchcss.tracking.flip_moves`.
        patience: Frames in a row that are searched widely. What is not found by then has left, or
            the picture has changed for good; the track stays marked as lost.
    """

    monitor: LossMonitor = LossMonitor()
    samples: int = 3
    modes: int = 2
    scale: float = 2.0
    num_flips: int = 12
    patience: int = 25

    def widened(self, tracker: SequenceTracker) -> SequenceTracker:
        """The same tracker with a wider search, which forgets: no pose is too far from those lost.

        The flips are for whoever knows the body.
        """
        tracker = replace(tracker, num_samples=self.samples * tracker.num_samples)
        if isinstance(tracker, (ParticleFilter, AnnealedParticleFilter)):
            return tracker
        tracker = replace(tracker, num_modes=self.modes * tracker.num_modes)
        if not isinstance(tracker, Tracker):
            return tracker
        proposal = tracker.proposal
        if isinstance(proposal, ScaledProposal):
            proposal = proposal.widened(self.scale)
        return replace(tracker, proposal=proposal, forgetting=0.0, soft_matching=False)
