"""An arm and a track of it, for what is drawn."""

from __future__ import annotations

import pytest
from made_tracks import make_track

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.io.tracks import Track


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body("arm8")


@pytest.fixture(scope="module")
def track(body: BodyModel) -> Track:
    return make_track(body, (2, 3, 2), first_frame=10)
