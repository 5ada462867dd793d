"""How often a frame would stop an accelerator, counted on a CPU; and that all tensors say where."""

from __future__ import annotations

import pytest
from made_sessions import moving_arm, session_on, standing_person
from made_transfers import Transfers, as_on_an_accelerator

from torchcss.studies.render.sequences import SyntheticSequence

OBSERVED = 12
"""Waits of the host while the features of a frame are made."""

STEPPED = {"arm": 620, "person": 980}
"""Waits of the host in the step of a frame, in the mean over seeds, which differ by a third: 20 to
34 evaluations of 6 samples, with ten each."""

_SEEDS = range(4)


@pytest.mark.parametrize("name", STEPPED)
def test_a_frame(name: str) -> None:
    sequence = moving_arm(3)
    if name == "person":
        sequence = standing_person(sequence)
    stepped = [_waits(sequence, seed) for seed in _SEEDS]
    mean = sum(stepping.waits.total() for stepping in stepped) / len(stepped)
    assert mean <= STEPPED[name], _worst(stepped[0])


def _waits(sequence: SyntheticSequence, seed: int) -> Transfers:
    """How often the host waits in the step of the last frame."""
    session = session_on(sequence, "cpu", seed=seed)
    *before, last = sequence.frames
    for frame in before:
        session.step(session.observe(frame))
    with as_on_an_accelerator() as observing:
        observation = session.observe(last)
    with as_on_an_accelerator() as stepping:
        session.step(observation)
    assert not observing.homeless
    assert not stepping.homeless
    assert observing.waits.total() <= OBSERVED, _worst(observing)
    return stepping


def _worst(transfers: Transfers) -> str:
    return "\n".join(f"{number} {site}" for site, number in transfers.waits.most_common(20))
