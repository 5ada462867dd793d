"""Pictures of high dynamic range, which telephones film, as an ordinary screen shows them.

`table(transfer)` turns the 16-bit signal of a channel into 8 bit: into the light that it means, as
a multiple of the light of white paper; what is brighter than three quarters of that is compressed;
then into the signal of an ordinary screen. Each channel is by itself: colours of the wide gamut
(BT.2020) come out a little paler than they were.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float, UInt8

PQ, HLG = 16, 18
"""Transfer characteristics of ITU-T H.273: SMPTE ST 2084, and ARIB STD-B67."""

PAPER_WHITE = 203.0
"""Light of white paper, candela per square metre (ITU-R BT.2408)."""

_KNEE = 0.75
_GAMMA = 2.2


@cache
def table(transfer: int) -> UInt8[np.ndarray, " levels"] | None:
    """8-bit levels of the 65536 levels of a signal; None: the transfer is an ordinary one.

    Args:
        transfer: Its number, see `PQ` and `HLG`.
    """
    if transfer not in (PQ, HLG):
        return None
    signal = np.linspace(0.0, 1.0, 1 << 16)
    light = (_pq(signal) if transfer == PQ else _hlg(signal)) / PAPER_WHITE
    room = 1.0 - _KNEE
    above = np.maximum(light - _KNEE, 0.0)
    light = np.where(light < _KNEE, light, 1.0 - room * np.exp(-above / room))
    return np.round(255 * light ** (1 / _GAMMA)).astype(np.uint8)


def _pq(signal: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Candela per square metre of a signal (BT.2100, table 4)."""
    root = signal ** (32 / 2523)
    ratio = np.maximum(root - 107 / 128, 0.0) / (2413 / 128 - 2392 / 128 * root)
    return 10000.0 * ratio ** (8192 / 1305)


def _hlg(signal: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The same of a screen of 1000 candela per square metre (BT.2100, table 5)."""
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    return 1000.0 * scene**1.2
