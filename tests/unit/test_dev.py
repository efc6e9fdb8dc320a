"""``./dev``: an environment in a folder with blanks, one that was moved with its tree."""

import importlib.machinery
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parents[2]


@pytest.fixture
def dev(tmp_path, monkeypatch):
    """Return the module ``dev`` with an environment of its own in a folder with blanks."""
    loader = importlib.machinery.SourceFileLoader("dev_under_test", str(TREE / "dev"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    monkeypatch.setattr(module, "VENV", tmp_path / "my lab's tree" / ".venv")
    module.VENV.mkdir(parents=True)
    return module


def installed(dev):
    """Write what an installer and ``./dev`` write: a script with a plain interpreter line, and a launcher."""
    dev.make_environment()
    dev.mend_moved()
    dev.write_if_new(dev.VENV / "bin" / "ours", dev.launcher("platform:python_version"))
    script = dev.VENV / "bin" / "theirs"
    script.write_text(f"{dev.shebang()}import sys\nprint(sys.prefix)\n")
    script.chmod(0o755)


def said(dev, name):
    return subprocess.run([dev.VENV / "bin" / name], capture_output=True, text=True, check=True).stdout.strip()


def test_launchers_run_in_a_folder_with_blanks(dev):
    installed(dev)
    assert said(dev, "theirs") == str(dev.VENV)
    done = subprocess.run([dev.VENV / "bin" / "ours"], capture_output=True, text=True)
    assert sys.version.split()[0] in done.stderr  # sys.exit of a text


@pytest.mark.parametrize("places", [("my lab's tree", "plain"), ("plain", "my lab's tree")])
def test_a_moved_environment_is_mended(dev, tmp_path, monkeypatch, places):
    first, second = (tmp_path / place / ".venv" for place in places)
    first.mkdir(parents=True, exist_ok=True)
    monkeypatch.setattr(dev, "VENV", first)
    installed(dev)
    assert said(dev, "theirs") == str(first)
    second.parent.mkdir(exist_ok=True)
    if second.exists():
        second.rmdir()
    first.rename(second)
    monkeypatch.setattr(dev, "VENV", second)
    dev.make_environment()
    dev.mend_moved()
    assert said(dev, "theirs") == str(second)
    activated = subprocess.run(
        ["sh", "-c", '. "$0" && printf %s "$VIRTUAL_ENV"', str(second / "bin" / "activate")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert activated.stdout == str(second)
    before = (second / "bin" / "theirs").read_bytes()
    dev.mend_moved()
    assert (second / "bin" / "theirs").read_bytes() == before


def test_bytecode_is_kept(dev, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    (tmp_path / "once.py").write_text("")
    subprocess.run([sys.executable, "-c", "import once"], cwd=tmp_path, env=dev.environment(), check=True)
    assert [path.name.partition(".")[0] for path in (tmp_path / "__pycache__").iterdir()] == ["once"]


def test_steps_are_compiled_again_after_a_change_of_any_of_them(dev):
    """Those of the drivers were not: after a change they ran as Python, at a multiple of the cost."""
    steps = {path for folder in ("sioms", "drivers", "daemon", "tools") for path in (TREE / folder).rglob("*_step.py")}
    assert steps and steps <= set(dev.compiled_sources())


@pytest.mark.parametrize("there", ["test", "run", "service"])
@pytest.mark.parametrize("wanted", ["test", "run", "service"])
def test_a_larger_list_holds_the_smaller_ones(dev, tmp_path, there, wanted):
    """Who has run the tests runs the demonstration without a network."""

    def table(profile):
        return {"python": "python", "extras": dev.EXTRAS[profile], "packages": dev.pins(profile)}

    stamp = tmp_path / "stamp"
    stamp.write_text(dev.json.dumps(table(there)))
    larger = ["test", "run", "service"]
    assert dev.stamped(stamp, table(wanted)) is (larger.index(there) <= larger.index(wanted))
    changed = table(wanted) | {"packages": [*dev.pins(wanted), "another==1.0"]}
    assert not dev.stamped(stamp, changed) and not dev.stamped(stamp, table(wanted) | {"python": "other"})
