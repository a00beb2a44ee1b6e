"""Programs of users that are refused before Python reads them."""

import pytest

from r2h_batch.base.user_code import MOST_BYTES, load_function


def test_a_program_larger_than_any_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    path = tmp_path / "huge_method.py"
    with path.open("wb") as file:
        file.truncate(MOST_BYTES + 1)
    with pytest.raises(ImportError, match=f"huge_method.py: {MOST_BYTES + 1} bytes; at most {MOST_BYTES} are allowed"):
        load_function(f"{path}:predict")
    path.write_bytes(b"predict = 1\n" + b"\n" * (MOST_BYTES - 12))
    assert load_function(f"{path}:predict").function == 1


def test_a_link_to_itself_is_said_in_a_line(tmp_path):
    (tmp_path / "loop_method.py").symlink_to("loop_method.py")
    with pytest.raises(ImportError, match=r"loop_method.py: (a link that leads to itself|no such file)") as said:
        load_function(f"{tmp_path / 'loop_method.py'}:predict")
    assert str(said.value).count("\n") == 0
