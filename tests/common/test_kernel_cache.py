"""Compiled kernels are kept by kind of processor, in a place that can be written to."""

from __future__ import annotations

from pathlib import Path

import pytest

from common.config import ConfigError
from common.kernel_cache import kernel_cache


def test_the_folder_is_made_where_asked_and_is_the_same_again(tmp_path: Path) -> None:
    env = {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    folder = kernel_cache(env)
    assert folder.is_dir() and folder.parent == tmp_path / "cache"
    assert kernel_cache(env) == folder
    assert list(folder.iterdir()) == []


def test_another_processor_gets_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = {"XDG_CACHE_HOME": str(tmp_path)}
    here = kernel_cache(env)
    monkeypatch.setattr(Path, "read_text", lambda *_: "flags : none\n")
    assert kernel_cache(env) != here


def test_a_place_that_cannot_be_written_to_is_an_error_that_says_what_to_set(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="set WARP_CACHE_PATH"):
        kernel_cache({"WARP_CACHE_PATH": str(tmp_path / "file")})
