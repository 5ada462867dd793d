"""Claims: one of several gets a clip, and who shows no life is taken over."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path
from typing import Any

import pytest

from torchcss.app.claims import Claims
from torchcss.errors import OutputError


class Clock:
    """Seconds that pass when a test says so."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_one_of_several_gets_it(tmp_path: Path) -> None:
    first, second = Claims(tmp_path), Claims(tmp_path)
    claim = first.take("clip.a")
    assert claim is not None
    assert claim.holds
    assert second.take("clip.a") is None
    assert second.take("clip") is not None, "another name"
    seen = second.sight("clip.a")
    assert seen is not None
    assert (seen.generation, seen.progress) == (1, "")
    claim.beat("40 %")
    seen = second.sight("clip.a")
    assert seen is not None
    assert (seen.counter, seen.progress) == (2, "40 %")


def test_a_file_system_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of sticks, of some network shares."""

    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refuse)
    assert Claims(tmp_path).take("a") is not None
    assert Claims(tmp_path).take("a") is None


def test_a_disk_that_has_no_room_for_a_name_leaves_no_claim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would count as that of an owner who died."""

    def refuse(_: int) -> str:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as context:
        context.setattr("torchcss.app.claims.process_name", refuse)
        with pytest.raises(OutputError, match="disk is full"):
            Claims(tmp_path).take("a")
    claim = Claims(tmp_path).take("a")
    assert claim is not None
    assert claim.generation == 1


def test_names_may_hold_any_sign(tmp_path: Path) -> None:
    for name in ("clip [1]", "a*", "a?", "!"):
        claim = Claims(tmp_path).take(name)
        assert claim is not None
        assert claim.holds
        assert Claims(tmp_path).take(name) is None


def test_a_claim_that_lost_its_content_can_be_taken_over(tmp_path: Path) -> None:
    assert Claims(tmp_path).take("a") is not None
    (tmp_path / "a" / "1").write_bytes(b"")
    other = Claims(tmp_path, patience_s=1e-9)
    assert other.take("a") is None
    assert other.take("a") is not None


def test_who_lives_keeps_it_and_who_stands_still_is_taken_over(tmp_path: Path) -> None:
    clock = Clock()
    claim, other = Claims(tmp_path).take("a"), Claims(tmp_path, patience_s=10, clock=clock)
    assert claim is not None
    for _ in range(5):
        assert other.take("a") is None
        clock.now += 9
        claim.beat("")
    assert other.take("a") is None
    clock.now += 9.9
    assert other.take("a") is None
    assert claim.holds
    clock.now += 0.2
    taken = other.take("a")
    assert taken is not None
    assert taken.generation == 2
    assert not claim.holds
    before = (tmp_path / "a" / "1").read_text()
    claim.beat("50 %")
    claim.release()
    assert (tmp_path / "a" / "1").read_text() == before, "it has nothing to say any more"


def test_a_clock_that_jumps_back_takes_nothing_over(tmp_path: Path) -> None:
    clock = Clock()
    assert Claims(tmp_path).take("a") is not None
    other = Claims(tmp_path, patience_s=10, clock=clock)
    for now in (1000.0, 0.0, -1000.0, 9.0):
        clock.now = now
        assert other.take("a") is None


def test_what_is_released_can_be_claimed_at_once(tmp_path: Path) -> None:
    claim = Claims(tmp_path).take("a")
    assert claim is not None
    claim.release()
    again = Claims(tmp_path).take("a")
    assert again is not None
    assert again.generation == 2


def test_who_is_known_to_be_dead_is_not_waited_for(tmp_path: Path) -> None:
    claims = Claims(tmp_path, clock=Clock())
    first = claims.take("a")
    assert first is not None
    first.beat("5 %")
    seen = claims.sight("a")
    assert seen is not None
    assert not seen.free
    claims.tell_dead("a", seen)
    seen = claims.sight("a")
    assert seen is not None
    assert seen.free
    assert not seen.released  # deaths are counted
    second = Claims(tmp_path, clock=Clock()).take("a")
    assert second is not None
    assert second.generation == 2
    assert not first.holds
    assert claims.take("a") is None


def test_it_beats_by_itself(tmp_path: Path) -> None:
    claims = Claims(tmp_path, patience_s=0.1)
    claim = claims.take("a")
    assert claim is not None
    with claim.alive(lambda: "half"):
        time.sleep(0.3)
    seen = claims.sight("a")
    assert seen is not None
    assert seen.progress == "half"


def test_a_folder_that_is_gone(tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        Claims(tmp_path / "nowhere").take("a")
