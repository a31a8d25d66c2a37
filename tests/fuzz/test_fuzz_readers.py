"""Every reader gives a scan or one clear line for damaged files; the program that says so finds what does not."""

import json

import numpy as np
import pytest

pytest.importorskip("laspy")
pytest.importorskip("pye57")
from dataset_writers.__main__ import write_fixtures

import tests.fuzz.fuzz_readers as fuzz
from more2_jax.scans.read_scan import read_scan
from tests.fuzz.mutations import PAGE, _crc32c

MUTATIONS = 60
FORMATS = sorted(
    ["arkitscenes", "e57", "glb", "las", "laz", "masks", "npz", "obj", "pcd", "ply", "ply_folder"]
    + ["replica", "s3dis", "scannet", "scannetpp", "threerscan"]
)


@pytest.fixture(scope="module")
def fixtures(tmp_path_factory):
    return write_fixtures(tmp_path_factory.mktemp("fixtures"))


def test_every_format_has_fixtures_and_each_reads(fixtures):
    assert sorted(p.name for p in fixtures.iterdir()) == FORMATS
    for file in fixtures.glob("*/*/fixture.json"):
        options = json.loads(file.read_text())
        masks = {"masks": file.parent / options.pop("masks")} if "masks" in options else {}
        assert len(read_scan(file.parent / options.pop("scan"), **options, **masks).instances) == 2


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_give_a_scan_or_one_clear_line(fixtures, tmp_path, name):
    tally = fuzz.fuzz(fixtures / name, MUTATIONS, 0, 20.0, 1024.0, tmp_path)
    assert tally.findings == []
    assert tally.outcomes[fuzz.REFUSED] > 0 and sum(tally.outcomes.values()) == MUTATIONS


def test_mutations_repeat_by_their_number(fixtures, tmp_path):
    for folder in ("a", "b"):
        scan, _, what = fuzz.prepare(fixtures / "ply", 3, 17, tmp_path / folder)
    assert what == fuzz.prepare(fixtures / "ply", 3, 17, tmp_path / "c")[2]
    assert scan.read_bytes() == (tmp_path / "a" / scan.name).read_bytes()


def raises(error):
    def read(*_, **__):
        raise error

    return read


@pytest.mark.parametrize(
    ("read", "outcome"),
    [
        (lambda *_, **__: np.zeros(1), fuzz.FINE),
        (raises(ValueError("a.ply: cut short")), fuzz.REFUSED),
        (raises(ValueError("two\nlines")), "unclear line"),
        (raises(ValueError("")), "unclear line"),
        (raises(KeyError("x")), "KeyError"),
        (raises(MemoryError()), "MemoryError"),
    ],
)
def test_what_counts_as_a_finding(monkeypatch, tmp_path, read, outcome):
    monkeypatch.setattr(fuzz, "read_scan", read)
    assert fuzz.outcome_of(tmp_path, {}).startswith(outcome)


@pytest.mark.parametrize(
    ("read", "limit_s", "outcome"),
    [
        ("while True: pass", 1.0, "no answer in 1 s"),
        # Long, as a busy machine may stand still for a second.
        ("import os; os.abort()", 60.0, "the process died"),
        ("b = bytearray(200 << 20)", 60.0, "took"),
    ],
)
def test_hangs_crashes_and_memory_are_findings(monkeypatch, fixtures, tmp_path, read, limit_s, outcome):
    monkeypatch.setattr(fuzz, "read_scan", lambda *_, **__: exec(read))
    tally = fuzz.fuzz(fixtures / "ply", 1, 0, limit_s, 100.0, tmp_path)
    assert [f["outcome"].startswith(outcome) for f in tally.findings] == [True]
    assert list((tmp_path / "ply_0").iterdir()) != []


def test_page_checksums_are_those_of_e57(fixtures):
    data = (fixtures / "e57" / "two_scans" / "room.e57").read_bytes()
    for at in range(0, len(data), PAGE):
        page = data[at : at + PAGE]
        assert _crc32c(page[:-4]) == int.from_bytes(page[-4:], "big")
