"""How much a sweep says: --quiet, --verbose, and the log in its folder."""

from r2h_batch.sweep import command as sweep

SHORT = ["--method", "random", "--splits", "S0", "--trials", "2", "--sim", "none"]


def test_a_quiet_sweep_says_nothing_and_its_log_says_all(tmp_path, capsys):
    assert sweep.main([*SHORT, "--quiet", "--out", str(tmp_path / "a")]) == 0
    said = capsys.readouterr()
    assert said.err == "" and "random" in said.out
    log = (tmp_path / "a" / "log.txt").read_text()
    lines = log.splitlines()
    assert "ready in" in log and "shard 0 stored" in log and "random: 2 trials in" in log and "run folder" in lines[-1]
    assert all(line[4] == line[7] == "-" and line[19] == "Z" for line in lines)
    assert sweep.main([*SHORT, "--verbose", "--out", str(tmp_path / "a")]) == 0
    assert "ready in" in capsys.readouterr().err and len((tmp_path / "a" / "log.txt").read_text().splitlines()) > len(
        lines
    )
    assert sweep.main([*SHORT, "--quiet", "--device", "cuda:77", "--out", str(tmp_path / "b")]) == 2
    assert capsys.readouterr().err.count("\n") == 1, "what went wrong is said"
