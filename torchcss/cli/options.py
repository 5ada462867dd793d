"""All of `Settings` as options, for every verb and script that tracks.

    @dataclass(frozen=True, kw_only=True)
    class Config:
        settings: SettingsOptions = Settings(body="arm8")

gives the script `--body`, `--preset`, `--terms` and all others, with the defaults of that record.
"""

from __future__ import annotations

from typing import Annotated

import tyro

from torchcss.tracking.settings import Settings

SettingsOptions = Annotated[Settings, tyro.conf.arg(name="")]
"""How to track; each field is an option of its own name."""
