"""The tree as a distribution: every package found, links home, bare names refused, wheel and sdist complete."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from setuptools import find_packages

TREE = Path(__file__).resolve().parents[2]
OUTER = ("daemon", "drivers", "tools")
PIPE_TOOLS = {"devin", "devout", "sdev", "smarkers"}
SETTINGS = tomllib.loads((TREE / "pyproject.toml").read_text())
FOUND = set(find_packages(str(TREE), **SETTINGS["tool"]["setuptools"]["packages"]["find"]))


def packages_in_tree():
    """Return the package names of all folders with an __init__.py, walked without following the links."""
    found = set()
    for top in ("sioms", *OUTER):
        prefix = "" if top == "sioms" else "sioms."
        for folder, _, files in os.walk(TREE / top):
            if "__init__.py" in files:
                found.add(prefix + ".".join(Path(folder).relative_to(TREE).parts))
    return found


def modules_in_tree():
    """Return the paths, as installed, of all modules of the packages."""
    found = set()
    for package in FOUND:
        folder = TREE.joinpath(*package.split("."))
        found |= {"/".join([*package.split("."), path.name]) for path in folder.glob("*.py")}
    return found


def test_every_folder_with_an_init_is_found_through_the_links_and_no_other():
    assert packages_in_tree() == FOUND


@pytest.mark.parametrize("name", OUTER)
def test_links_point_home(name):
    link = TREE / "sioms" / name
    assert link.is_symlink()
    assert os.readlink(link) == f"../{name}"


@pytest.mark.parametrize("name", OUTER)
def test_bare_folder_names_refuse_to_be_imported(name):
    done = subprocess.run([sys.executable, "-c", f"import {name}"], cwd=TREE, capture_output=True, text=True)
    assert done.returncode == 1
    assert f"ImportError: import sioms.{name}, not {name}" in done.stderr


def test_the_environment_has_the_entry_points_of_the_tree():
    found = metadata.distribution("sioms").entry_points
    declared = {(name, "console_scripts", value) for name, value in SETTINGS["project"]["scripts"].items()}
    for group, names in SETTINGS["project"].get("entry-points", {}).items():
        declared |= {(name, group, value) for name, value in names.items()}
    assert {(one.name, one.group, one.value) for one in found} == declared


def test_edits_of_the_tree_hold_at_once():
    code = "import sioms, sioms.daemon, os; print(os.path.realpath(sioms.daemon.__file__))"
    done = subprocess.run([sys.executable, "-c", code], cwd="/", capture_output=True, text=True, check=True)
    assert Path(done.stdout.strip()) == TREE / "daemon" / "__init__.py"


def test_pipe_tools_are_one_text():
    folder = TREE / "tools" / "bin"
    assert {path.name for path in folder.iterdir()} == PIPE_TOOLS
    assert {f"tools/bin/{name}" for name in PIPE_TOOLS} == set(SETTINGS["tool"]["setuptools"]["script-files"])
    assert len({path.read_text() for path in folder.iterdir()}) == 1
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A copy of the tree, its sdist, its wheel, and the wheel of the unpacked sdist."""
    pytest.importorskip("setuptools")
    work = tmp_path_factory.mktemp("build")
    copy = work / "tree"
    copy.mkdir()
    for name in ("sioms", *OUTER):
        shutil.copytree(TREE / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("etc", "examples", "docs/man"):
        shutil.copytree(TREE / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "LICENSE"):
        shutil.copy(TREE / name, copy)
    (copy / "README.md").write_text("# SIOMS\n")
    sdist = build(copy, "build_sdist", work)
    shutil.unpack_archive(sdist, work / "unpacked")
    (unpacked,) = (work / "unpacked").iterdir()
    return build(copy, "build_wheel", work / "direct"), build(unpacked, "build_wheel", work / "again")


def build(tree, hook, out):
    out.mkdir(exist_ok=True)
    code = f"import setuptools.build_meta as b; print('made', b.{hook}({str(out)!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tree, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return out / done.stdout.split()[-1]


def test_wheel_holds_every_module_and_tool(built):
    with zipfile.ZipFile(built[0]) as wheel:
        names = set(wheel.namelist())
        modes = {
            Path(one.filename).name: one.external_attr >> 16 for one in wheel.infolist() if "/scripts/" in one.filename
        }
        programs = [f"sioms/native/_{tool}" for tool in ("devin", "devout")]
        compiled = [one.external_attr >> 16 for one in wheel.infolist() if one.filename in programs]
    assert len(compiled) == sum((TREE / name).exists() for name in programs)
    assert all(mode & 0o111 == 0o111 for mode in compiled)
    assert modules_in_tree() <= names
    assert "sioms/py.typed" in names
    assert set(modes) == PIPE_TOOLS
    assert all(mode & 0o111 == 0o111 for mode in modes.values())
    tops = {name.split("/")[0].partition("-")[0] for name in names}
    assert tops == {"sioms"}  # no global name such as daemon is taken


def files_beside_modules():
    """Return what the wheel must hold besides modules, by its path under the environment's ``share``."""
    found = {f"man/man{page.suffix[1:]}/{page.name}" for page in (TREE / "docs" / "man").iterdir()}
    for top in ("etc", "examples", "docs/man"):
        for path in (TREE / top).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                found.add(f"sioms/{path.relative_to(TREE)}")
    return found


def test_wheel_and_sdist_hold_manual_pages_service_files_and_examples(built):
    for path in built:
        with zipfile.ZipFile(path) as wheel:
            shared = {
                name.partition(".data/data/share/")[2] for name in wheel.namelist() if ".data/data/share/" in name
            }
        assert files_beside_modules() == shared


def test_an_installed_wheel_finds_the_files_of_its_service(built, tmp_path):
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    (libraries,) = (tmp_path / "venv" / "lib").glob("python3.*/site-packages")
    with zipfile.ZipFile(built[0]) as wheel:
        wheel.extractall(libraries)
    shutil.move(libraries / "sioms-0.1.0.data" / "data" / "share", tmp_path / "venv" / "share")
    (libraries / "others.pth").write_text("\n".join(p for p in sys.path if p.endswith("site-packages")))
    root = tmp_path / "root"
    root.mkdir()
    code = (
        f"from sioms.tools.front import main; raise SystemExit(main(['service', 'install', '--root', {str(root)!r}]))"
    )
    done = subprocess.run(
        [tmp_path / "venv" / "bin" / "python3", "-P", "-c", code], cwd="/", capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    unit = (root / "etc/systemd/system/sioms.service").read_text()
    assert f"ExecStart={tmp_path}/venv/bin/siomsd --config /etc/sioms/workcell.toml\n" in unit


def test_sdist_gives_the_same_wheel(built):
    contents = []
    for path in built:
        with zipfile.ZipFile(path) as wheel:
            contents.append({one.filename: one.CRC for one in wheel.infolist() if "dist-info" not in one.filename})
    assert contents[0] == contents[1]


def test_pipe_tool_of_a_wheel_starts_on_a_bare_interpreter(built, tmp_path):
    """The installed layout: the tool finds its libraries beside itself, also through a link, without site."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    (libraries,) = (tmp_path / "venv" / "lib").glob("python3.*/site-packages")
    with zipfile.ZipFile(built[0]) as wheel:
        wheel.extractall(libraries)
    tool = tmp_path / "venv" / "bin" / "devin"
    shutil.move(libraries / "sioms-0.1.0.data" / "scripts" / "devin", tool)
    tool.chmod(0o755)
    (libraries / "sioms" / "tools" / "devin.py").write_text(
        "import sys\n\n\ndef main():\n    print(sys.argv, 'site' in sys.modules, __file__)\n    return 7\n"
    )
    (tmp_path / "linked").symlink_to(tool)
    for name in (tool, tmp_path / "linked"):
        done = subprocess.run([name, "a b", "-t0.1"], capture_output=True, text=True, cwd="/")
        assert done.returncode == 7, done.stderr
        assert done.stdout.split() == f"['devin', 'a b', '-t0.1'] False {libraries}/sioms/tools/devin.py".split()
