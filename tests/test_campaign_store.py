"""Campaigns whose tests lie behind a URL that fsspec reads: in memory, and local files by ``file://`` for whole campaigns on processes."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path

import pytest

from campaigns import SPEEDS, records_of, write_campaign
from operando.campaign import load_campaign, run_campaign
from operando.campaign.store import copied, in_store, listing, matches
from operando.errors import ConfigError, MissingError

fsspec = pytest.importorskip("fsspec")


@pytest.fixture
def memory():
    files = fsspec.filesystem("memory")
    for name in ("runs/600/test.toml", "runs/600/idle/a.uff", "runs/900/test.toml", "runs/other.txt"):
        files.pipe(f"/bucket/{name}", name.encode())
    yield files
    files.rm("/bucket", recursive=True)


def test_a_glob_of_a_store_names_what_it_matches(memory, tmp_path):
    assert [in_store(p) for p in ("s3://b/a.toml", "C:/b/a.toml", Path("a//b"))] == [True, False, False]
    root, found = matches("memory://bucket/runs/*/test.toml")
    assert root == "/bucket/runs/*/test.toml"
    assert list(found) == ["/bucket/runs/600/test.toml", "/bucket/runs/900/test.toml"]
    for pattern in ("memory://bucket/runs/{speed}/test.toml", "memory://bucket/runs/{speed}"):
        (tmp_path / "campaign.toml").write_text(f'tests = ["{pattern}"]\nbaseline = {{speed = 900}}\n')
        campaign = load_campaign(tmp_path / "campaign.toml")
        assert [m.name for m in campaign.members] == ["speed-600", "speed-900"]
        assert [m.path for m in campaign.members] == list(found.values())
        assert campaign.baseline == "speed-900"


def test_a_copy_holds_the_folder_and_goes_again(memory):
    with copied("memory://bucket/runs/600/test.toml") as here:
        assert (here.name, here.parent.name) == ("test.toml", "600")
        assert (here.parent / "idle/a.uff").read_bytes() == b"runs/600/idle/a.uff"
        assert not (here.parent.parent / "900").exists()
    assert not here.parent.parent.exists()


def test_a_changed_file_is_seen_without_reading_it(memory):
    before = listing("memory://bucket/runs/600/test.toml")
    assert [name for name, *_ in before] == ["/bucket/runs/600/idle/a.uff", "/bucket/runs/600/test.toml"]
    assert listing("memory://bucket/runs/600/test.toml") == before
    memory.pipe("/bucket/runs/600/idle/a.uff", b"other")
    assert listing("memory://bucket/runs/600/test.toml") != before


def test_what_a_store_lacks_is_said(memory, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="no such test file"):
        listing("memory://bucket/runs/1200/test.toml")
    with pytest.raises(ConfigError, match="cannot be read from its store"):
        listing("unheard-of://bucket/test.toml")
    for text, said in (
        ('tests = ["memory://bucket/none/{speed}/test.toml"]', "no test file matches"),
        ('template = "memory://bucket/test.toml"\nrows = [{speed = 1}]', "a template cannot be in an object store"),
    ):
        (tmp_path / "campaign.toml").write_text(text)
        with pytest.raises(ConfigError, match=said):
            load_campaign(tmp_path / "campaign.toml")
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(MissingError, match="need fsspec"):
        listing("memory://bucket/runs/600/test.toml")


def test_a_campaign_from_a_store_gives_the_answers_of_local_files(tmp_path, monkeypatch):
    local = write_campaign(tmp_path)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    monkeypatch.setattr(tempfile, "tempdir", None)
    store = tmp_path / "store.toml"
    store.write_text(local.read_text().replace('"runs/', f'"{tmp_path.as_uri()}/runs/'))
    wanted = run_campaign(local, tmp_path / "wanted", processes=1)
    found = run_campaign(store, tmp_path / "found", processes=2)
    assert found["idle"] == wanted["idle"]
    assert found["counts"]["run"] == len(SPEEDS)
    assert [t["test"] for t in found["tests"]] == [f"{tmp_path.as_uri()}/runs/{speed}/test.toml" for speed in SPEEDS]
    assert not any(scratch.iterdir())
    summaries = [json.loads((tmp_path / name / "tests/speed-900/summary.json").read_text()) for name in ("wanted", "found")]
    assert summaries[0] == summaries[1]

    before = records_of(tmp_path / "found")
    os.utime(tmp_path / "runs/900/idle.uff", ns=(1, 1))
    (tmp_path / "runs/1200/idle.uff").unlink()
    again = run_campaign(store, tmp_path / "found", processes=1)
    assert (again["counts"]["run"], again["counts"]["unchanged"]) == (2, 1)
    assert [t["state"] for t in again["tests"]] == ["done", "done", "failed"]
    after = records_of(tmp_path / "found")
    assert after["speed-600"] == before["speed-600"]
    assert after["speed-900"][0]["seconds"] < before["speed-900"][0]["seconds"]  # its stages stand: the contents are the same
