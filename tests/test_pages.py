"""Every block and command of the pages runs as printed, in the environment of `make demo` and the extras that the page names."""

import re
import subprocess
import sys
import textwrap

import pytest
from pages import PAGES, ROOT, OnlyInstalled, pieces


def follow(folder, pages, *more):
    """The last words of each page's process; "" if it ended well."""
    line = [sys.executable, str(ROOT / "tests" / "support" / "pages.py"), str(folder), *pages, *more]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=2400)
    logs = {page: folder / f"{page.replace('/', '_')}.log" for page in pages}
    said = {page: log.read_text() if log.exists() else done.stderr for page, log in logs.items()}
    return {page: "" if re.search(r"^\d+ ran$", text, re.MULTILINE) else text[-3000:] for page, text in said.items()}


EVERY_DAY = ("README.md", "docs/tutorial.md")
"""Pages that `make test` follows; `make test-all` follows all."""
MARKED = [page if page in EVERY_DAY else pytest.param(page, marks=pytest.mark.whole(part="pages")) for page in PAGES]


@pytest.fixture(scope="module")
def followed(request, tmp_path_factory):
    """The last words of the pages that are asked of in this run: one process has the imports of all."""
    params = [getattr(item, "callspec", None) for item in request.session.items if item.path == request.path]
    asked = {p.params.get("page") for p in params if p}
    return follow(tmp_path_factory.mktemp("pages"), [page for page in PAGES if page in asked])


@pytest.mark.parametrize("page", MARKED)
def test_a_page_runs(followed, page):
    assert followed[page] == ""


def has_slow_parts(page):
    return any(p.kept_from.startswith("slow") for p in pieces((ROOT / page).read_text()))


@pytest.mark.slow
@pytest.mark.parametrize("slow_page", [*filter(has_slow_parts, PAGES)])
def test_a_page_runs_with_its_slow_parts(slow_page, tmp_path):
    assert follow(tmp_path, [slow_page], "--slow") == {slow_page: ""}


@pytest.mark.check
def test_blocks_and_commands_are_found_with_the_reasons_that_leave_them_out():
    text = textwrap.dedent(
        """\
        # Page

        Text with `r2h-batch ls robots` and `a word`.

        <!-- not run: no network -->
        ```
        git clone here  # why
        ```

        <!-- slow `r2h-batch view`: it draws -->

            r2h-batch sweep --trials 60 \\
                --out runs/x
            r2h-batch view runs/x

        ```python
        x = 1
        ```
        """
    )
    found = [(p.text, p.language, p.kept_from) for p in pieces(text)]
    assert found == [
        ("r2h-batch ls robots", "shell", ""),
        ("git clone here", "shell", "not run: no network"),
        ("r2h-batch sweep --trials 60 --out runs/x", "shell", ""),
        ("r2h-batch view runs/x", "shell", "slow: it draws"),
        ("x = 1\n", "python", ""),
    ]
    with pytest.raises(ValueError, match="no command begins with r2h-batch view"):
        list(pieces(text.replace("r2h-batch view runs/x", "r2h-batch ls runs")))


@pytest.mark.check
def test_packages_of_an_extra_are_hidden_until_it_is_installed():
    packages = OnlyInstalled()
    found = {name: packages.find_spec(name) for name in ("viser", "gymnasium", "torch", "json", "pages")}
    assert [name for name, spec in found.items() if spec is None] == ["viser", "gymnasium"]
    packages.install("env")
    assert packages.find_spec("gymnasium") and packages.find_spec("viser") is None
    with pytest.raises(KeyError, match="no extra 'envs'"):
        packages.install("envs")
