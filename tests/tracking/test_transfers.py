"""How often a frame would stop an accelerator, counted on a CPU; and that all tensors say where."""

from __future__ import annotations

import pytest
from made_sessions import moving_arm, session_on, standing_person
from made_transfers import Transfers, as_on_an_accelerator

OBSERVED = 12
"""Waits of the host while the features of a frame are made."""

STEPPED = {"arm": 620, "person": 900}
"""Waits of the host in the step of a frame: 20 to 28 evaluations of 6 samples, with ten each."""


@pytest.mark.parametrize("name", STEPPED)
def test_a_frame(name: str) -> None:
    sequence = moving_arm(3)
    if name == "person":
        sequence = standing_person(sequence)
    session = session_on(sequence, "cpu")
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
    assert stepping.waits.total() <= STEPPED[name], _worst(stepping)


def _worst(transfers: Transfers) -> str:
    return "\n".join(f"{number} {site}" for site, number in transfers.waits.most_common(20))
