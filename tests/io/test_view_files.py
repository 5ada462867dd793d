"""What tells the files of a camera from others."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchcss.io.view_files import fingerprint


def test_prints_tell_files_folders_and_selections_apart(tmp_path: Path) -> None:
    file, folder = tmp_path / "a.npz", tmp_path / "film"
    folder.mkdir()
    for place in (file, folder / "0.png"):
        place.write_bytes(b"content")
    selected = [Path(f"{file}#{name}") for name in ("one", "two")]
    assert len({fingerprint(path) for path in (file, folder, *selected)}) == 4
    before = fingerprint(file)
    assert fingerprint(file.rename(tmp_path / "b.npz")) == before


def test_what_is_not_there_is_not_told_by_the_folder_where_one_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    gone = fingerprint(Path("gone.npz"))
    (tmp_path / "other").write_bytes(b"content")
    assert fingerprint(Path("gone.npz")) == gone
