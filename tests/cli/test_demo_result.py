"""The README's first command ends as it says: every object that stays is found again and put where it is."""

from more2_jax.cli.main import main


def test_the_demo_finds_and_poses_all_six_objects_that_stay(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 0
    said = capsys.readouterr().out
    assert "6 of 6 persisting objects right" in said
    assert (tmp_path / "demo" / "report.html").is_file()
