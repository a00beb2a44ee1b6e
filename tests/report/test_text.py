"""Names as tables shorten them."""

from r2h_batch.report.text import SHORT, SHORT_FOLDER, short_names


def test_a_runs_folder_before_a_name_is_cut_at_its_end_and_the_name_stays_readable():
    long = "r2h-v2-as-planned/Contact-Handover (VoxNet, built-in contacts)"
    names = [
        "baselines/oracle",
        "baselines/Contact-Handover (VoxNet)",
        long,
        "Learned (ranker)",
        "my_method_with_a_long_name",
    ]
    assert list(short_names(names).values()) == [
        "baselines/oracle", "baselines/Contact-Handover", "r2h-v2-../Contact-Handover", "Learned", "my_method.._name",
    ]  # fmt: skip


def test_short_names_differ_and_keep_their_sizes():
    names = [f"{folder}/{'method' * 4}_{k}" for folder in ("runs-of-monday", "runs-of-tuesday") for k in range(12)]
    short = list(short_names(names).values())
    assert len(set(short)) == 24 and all(len(s) <= SHORT + 1 + SHORT_FOLDER for s in short)
    assert short_names(["a/b (x)", "a/b (y)"]) == {"a/b (x)": "a/b", "a/b (y)": "a/b#2"}
