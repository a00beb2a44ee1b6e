"""`--from PACKAGE:NAME`: files of installed packages, modules that tell them, and no download."""

import sys

import pytest
from refusals import one_line
from robot_files import write_urdf
from rounds import each

from r2h_batch.base.errors import UsageError
from r2h_batch.data.robot_chain import read_chain
from r2h_batch.data.robot_links import Meshes
from r2h_batch.data.robot_model import read_model
from r2h_batch.data.robot_packages import file_from


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package of arms and a package of modules, as pip writes them."""
    info = tmp_path / "some_arms-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: some-arms\nVersion: 2.0\n")
    names = ("arms/a/arm.urdf", "arms/b/arm.urdf", "arms/b/hand.xml", "arms/readme.md")
    (info / "RECORD").write_text("".join(f"{name},,\n" for name in names))
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("<robot/>")
    told = tmp_path / "told_arms"
    told.mkdir()
    (told / "__init__.py").write_text("")
    (told / "elbow_description.py").write_text(f"print('hello')\nURDF_PATH = {str(tmp_path / 'arms/a/arm.urdf')!r}\n")
    (told / "plain.py").write_text("X = 1\n")
    clone = "import os\nassert os.environ['GIT_ALLOW_PROTOCOL'] != 'none', 'it would download'\n"
    (told / "far_description.py").write_text(clone)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_a_file_is_found_by_how_its_path_ends_and_its_package_is_the_folder_of_what_it_names(installed):
    hand, arm = installed / "arms/b/hand.xml", installed / "arms/b/arm.urdf"
    assert file_from("some-arms:hand.xml") == (hand, installed / "arms") == file_from("some_arms:hand")
    assert file_from("some-arms:b/arm.urdf") == file_from("some-arms:b/arm") == (arm, installed / "arms")


def test_data_of_a_wheel_lie_beside_its_packages_or_where_target_puts_them(tmp_path, monkeypatch):
    """`pip install --target` lists ../../share/... and writes share/... into the folder."""
    for place, up, share in each(
        [
            (tmp_path / "env/lib/site-packages", "../../", tmp_path / "env/share"),
            (tmp_path / "flat", "../../", tmp_path / "flat/share"),
        ]
    ):
        info, file = place / "open_arms-1.0.dist-info", share / "open_arms/v2/arm.xml"
        info.mkdir(parents=True)
        file.parent.mkdir(parents=True)
        file.write_text("<mujoco/>")
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: open-arms\nVersion: 1.0\n")
        (info / "RECORD").write_text(f"{up}share/open_arms/v2/arm.xml,,\n")
        with monkeypatch.context() as only:
            only.syspath_prepend(str(place))
            found = file_from("open-arms:arm.xml")
            assert (found.file.resolve(), found.folder.resolve()) == (file, share / "open_arms")


def test_a_module_tells_its_file_and_folder_in_a_process_of_its_own(installed):
    arm = installed / "arms/a/arm.urdf"
    assert file_from("told_arms:elbow") == file_from("told_arms:elbow_description") == (arm, arm.parent)
    module = installed / "told_arms" / "elbow_description.py"
    module.write_text(f"{module.read_text()}PACKAGE_PATH = {str(installed / 'arms')!r}\n")
    assert file_from("told_arms:elbow").folder == installed / "arms"
    assert "told_arms.elbow_description" not in sys.modules


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("some-arms:arm.urdf", "2 files end so; give more of the path: arms/a/arm.urdf, arms/b/arm.urdf"),
        ("some-arms:rm.urdf", "no file that ends so; of its 3 .urdf and .xml: arm"),
        ("no-such-arms:x", "no such package here; install it in this environment: pip install --no-deps no-such-arms"),
        (
            "told_arms:far",
            "its files are not here, and nothing is downloaded; fetch them first: python -c 'import told_arms.far",
        ),
        ("told_arms:plain", "has neither URDF_PATH nor MJCF_PATH"),
        ("../x:y", "no such package"),
    ],
)
def test_what_is_not_there_is_said_in_one_line(installed, source, words):
    with one_line(words):
        file_from(source)


@pytest.mark.parametrize("source", ["arm.urdf", ":x", "x:"])
def test_a_source_without_both_names_is_refused(source):
    with pytest.raises(UsageError, match="write PACKAGE:NAME"):
        file_from(source)


def test_a_package_whose_folder_has_another_name_is_found_within_what_was_given(tmp_path):
    where = tmp_path / "whole" / "arm_files" / "urdf"
    where.mkdir(parents=True)
    path = write_urdf(where, **{'"parts/block.stl"': '"package://arm_support/parts/block.stl"'})
    (where / "parts").rename(where.parent / "parts")
    block = next(g for part in read_chain(read_model(path), "base", "flange").links for g in part.geoms if g.file)
    with pytest.warns(UserWarning, match="package://arm_support is the folder arm_files, which holds what it names"):
        found = Meshes(read_model(path, [tmp_path / "whole"]), [block], {}).triangles(block)
    assert found.shape == (12, 3, 3)
    for folders in ([], [tmp_path / "whole" / "arm_files" / "urdf"]):  # what the user did not give is not looked into
        with one_line("give --package arm_support=FOLDER"):
            Meshes(read_model(path, folders), [block], {})
    for inside in ("parts/../parts/block.stl", "parts", "parts/none.stl"):
        with one_line("give --package arm_support=FOLDER"):
            Meshes(read_model(path, [tmp_path]), [block._replace(file=f"package://arm_support/{inside}")], {})
