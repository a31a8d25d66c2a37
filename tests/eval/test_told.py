"""What several runs tell together."""

import json

import pytest
from rich.console import Console

from eval.scores.figures import rows_of
from eval.scores.told_chances import FIGURES, MATCHES
from eval.told import main, records_of_ours, table_of


def folder(path, name, records):
    (path / name / "scenes").mkdir(parents=True)
    for n, rows in enumerate(records):
        (path / name / "scenes" / f"scene_{n:04d}.json").write_text(json.dumps(rows))
    return path / name


def match(said, so, method="ours, robust"):
    return {"method": method, MATCHES.key: said, MATCHES.over: so}


def test_rooms_of_all_runs_count_together_and_peers_do_not(tmp_path, capsys):
    runs = (
        folder(tmp_path, "a", [[match(0.95, 1.0), match(0.95, 1.0)], [match(0.45, 0.0, "a peer")]]),
        folder(tmp_path, "b", [[match(0.95, 0.0), {"method": "ours, robust", "m.strict": 1.0}]]),
    )
    records = records_of_ours(runs)
    assert [len(r) for r in records.values()] == [2, 0, 2]
    shown = {r.name: r for r in rows_of(FIGURES, records)}
    assert shown[MATCHES.name].count == 3
    assert shown[MATCHES.name].value == pytest.approx(100 * abs(0.95 - 2 / 3))
    table = table_of(list(shown.values()))
    assert table.row_count == len(shown) == 4
    console = Console(width=200, record=True)
    console.print(table)
    assert "28.3 %" in console.export_text()
    main(runs)
    assert "calibration error of matches" in capsys.readouterr().out.replace("\n", " ")


def test_a_folder_without_rooms_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no records of rooms"):
        records_of_ours((tmp_path,))
