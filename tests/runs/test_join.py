"""Several runs as one (`runs.store.join`)."""

from types import SimpleNamespace

import numpy as np
import pytest
from made_runs import write_run

from r2h_batch.runs.files import RunError
from r2h_batch.runs.store import join, load_run, robot_words


@pytest.fixture
def runs(tmp_path):
    """Three folders; method `two` is in the second and in the third."""
    found = {}
    for folder, names in (("first", ["one"]), ("second", ["two"]), ("third", ["two", "three"])):
        found[folder] = write_run(tmp_path / folder, {name: np.zeros(8, int) for name in names}, 4, 4)
    return [*found.values()]


def test_a_run_that_was_joined_before_counts_as_the_folders_that_it_is_of(runs):
    first, second, third = runs
    whole, nested = join(runs), join([first, join([second, third])])
    assert [run.folder for run in nested.runs] == [run.folder for run in whole.runs] == [run.folder for run in runs]
    assert all(run.runs == (run,) for run in nested.runs)
    assert nested.categories == whole.categories and first.categories.items() <= whole.categories.items()
    assert set(nested.methods) == set(whole.methods) == {"one", "second/two", "third/two", "three"}
    assert join([first]) is first


def test_two_folders_of_one_name_with_a_method_of_one_name_are_refused(runs, tmp_path):
    other = write_run(tmp_path / "there" / "second", {"two": np.zeros(8, int)}, 4, 4)
    with pytest.raises(RunError, match="two run folders of one name hold 'second/two'; rename one of them"):
        join([runs[1], load_run(other.folder)])


def test_methods_of_several_robots_have_the_robots_short_name_in_front_or_the_whole_one_where_two_are_alike():
    def words(*robots):
        return robot_words([SimpleNamespace(robot=name) for name in robots])

    assert words("ur5e_2f85", "ur5e_2f85") == {"ur5e_2f85": ""}
    assert words("ur5e_2f85", "panda_hand", "ur5e_2f85") == {"ur5e_2f85": "ur5e/", "panda_hand": "panda/"}
    assert words("ur5e_2f85", "ur5e_jaws") == {"ur5e_2f85": "ur5e_2f85/", "ur5e_jaws": "ur5e_jaws/"}
