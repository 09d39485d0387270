from pathlib import Path

import pytest

from beambox.cli.main import main


def test_a_folder_that_lacks_frames_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "000000.txt").write_text("")
    with pytest.raises(SystemExit) as left:
        main(["submit", str(tmp_path / "results"), "--out", str(tmp_path / "s.zip")])
    assert left.value.code == 2
    output = capsys.readouterr().err
    assert output.count("\n") == 1 and "cannot be submitted" in output and "000001" in output
    assert not (tmp_path / "s.zip").exists()


def test_whole_results_are_packed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = tmp_path / "results"
    results.mkdir()
    for number in range(7518):
        (results / f"{number:06d}.txt").touch()
    line = "Car -1 -1 0.1000 10.0 10.0 50.0 50.0 1.5 1.6 3.9 1.0 1.6 20.0 0.1000 0.9000\n"
    (results / "000000.txt").write_text(line)
    with pytest.raises(SystemExit) as main_exit:
        main(["submit", str(results), "--out", str(tmp_path / "s.zip")])
    assert main_exit.value.code == 0
    assert (tmp_path / "s.zip").is_file()
    assert "checked and packed" in capsys.readouterr().out
