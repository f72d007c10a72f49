"""Notes of running collectors, which `busway status` reads to find them."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from busway.apps.collector.running_notes import RunningCollector, find_collectors


@pytest.mark.parametrize("store", [None, 5, ["s"], {"s": 1}, "a\0b"])
def test_a_note_whose_store_is_no_path_is_left_out_and_others_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: Any
) -> None:
    monkeypatch.setattr("busway.apps.collector.running_notes.holder_of", lambda folder: folder.stat() and os.getpid())
    note = {"pid": os.getpid(), "file": "f", "store": str(tmp_path), "page": "", "is_in_fleet": False}
    (tmp_path / "1.collector").write_text(json.dumps(note | {"store": store}))
    (tmp_path / "2.collector").write_text(json.dumps(note))
    assert find_collectors(tmp_path) == [RunningCollector(**note)]
