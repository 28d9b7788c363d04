"""The package as it is installed: a wheel holds all of it, its configurations too, and its commands work where there is no
checkout."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

import ocp_torch
from ocp_torch import load_controller
from ocp_torch.cli.explain import CHECKOUT
from support.forked import TINY, certificate_in

PROJECT = (CHECKOUT / "pyproject.toml").read_text()
GITHUB = CHECKOUT / ".github"
PYTHON_FILES = sorted(path.relative_to(CHECKOUT).as_posix() for path in CHECKOUT.glob("ocp_torch/**/*.py"))
CONFIGURATIONS = sorted(path.relative_to(CHECKOUT).as_posix() for path in CHECKOUT.glob("configs/**/*.yaml"))


def test_every_folder_of_the_package_is_named_in_the_project_file():
    named = re.search(r"^packages = \[(.*?)\]", PROJECT, re.MULTILINE | re.DOTALL)
    folders = {str(Path(file).parent).replace("/", ".") for file in PYTHON_FILES}
    assert set(re.findall(r'"([\w.]+)"', named.group(1))) == folders | {"ocp_torch.configs"}


def test_every_command_is_a_script_of_the_same_name():
    entries = re.findall(r'^ocp-([\w-]+) = "ocp_torch\.cli\.commands\.(\w+):main"$', PROJECT, re.MULTILINE)
    assert len(entries) >= 7
    for command, module in entries:
        assert command.replace("-", "_") == module
        assert (
            f"from ocp_torch.cli.commands.{module} import main" in (CHECKOUT / "scripts" / f"{module}.py").read_text()
        )


def test_the_changelog_and_the_citation_are_of_this_version():
    first = re.search(r"^## (\S+)", (GITHUB / "CHANGELOG.md").read_text(), re.MULTILINE)
    citation = yaml.safe_load((GITHUB / "CITATION.cff").read_text())
    assert first.group(1) == citation["version"] == ocp_torch.__version__


def run(*words: str | Path, cwd: Path) -> str:
    """What a command prints that must end well, as a shell starts it where the checkout is not on Python's path."""
    own = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        list(map(str, words)), cwd=cwd, env=own | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from what is checked out, without what earlier builds left, and without a network."""
    pytest.importorskip("setuptools", minversion="77", reason="the wheel is built by setuptools, which is not here")
    pytest.importorskip("pip", reason="pip builds the wheel")
    folder = tmp_path_factory.mktemp("wheel")
    left_out = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for part in ("ocp_torch", "configs"):
        shutil.copytree(CHECKOUT / part, folder / "source" / part, ignore=left_out)
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / file, folder / "source")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--no-deps", "--no-build-isolation")
    run(*pip, "--wheel-dir", folder, folder / "source", cwd=folder)
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The commands of an environment that has the wheel, and what it needs from the one of the tests."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    # Paths that a .pth file adds come last, and bring no editable installs of their own.
    paths = sysconfig.get_paths(vars={"base": str(folder), "platbase": str(folder)})
    outer = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (Path(paths["purelib"]) / "outer.pth").write_text("\n".join(outer) + "\n")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", folder / "bin" / "python")
    run(*pip, "install", "--no-deps", "--no-index", "--ignore-installed", wheel, cwd=folder)
    return folder / "bin"


FROM_PYTHON = """
import sys, importlib.metadata, yaml, ocp_torch
print(ocp_torch.__file__)
commands = [entry for entry in importlib.metadata.distribution("ocp_torch").entry_points if callable(entry.load())]
print(sorted(entry.name.removeprefix("ocp-") for entry in commands))
settings = {name: yaml.safe_load(value) for name, value in (o.split("=") for o in sys.argv[1:])}
print(ocp_torch.train("circle", settings=settings).certificate["lower"])
"""


@pytest.mark.nightly
def test_the_wheel_holds_what_the_checkout_does(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    held = sorted(name for name in names if ".dist-info/" not in name)
    assert held == sorted([*PYTHON_FILES, *(f"ocp_torch/{name}" for name in CONFIGURATIONS), "ocp_torch/py.typed"])
    assert wheel.name.split("-")[1] == ocp_torch.__version__


@pytest.mark.nightly
def test_its_commands_and_functions_work_where_there_is_no_checkout(installed, tmp_path):
    printed = run(installed / "ocp-train", *TINY, cwd=tmp_path)
    (folder,) = (tmp_path / "outputs" / "circle_dual").iterdir()
    assert str(folder) in printed
    assert load_controller(folder / "controller.safetensors").problem.dim == 1
    assert certificate_in(folder)["step"] == 60
    assert folder.name in run(installed / "ocp-compare", "outputs", cwd=tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"outputs"}
    printed = run(installed / "python", "-c", FROM_PYTHON, *TINY[1:], cwd=tmp_path).splitlines()
    assert printed[0].startswith(str(installed.parent))
    assert printed[1] == str(sorted(re.findall(r"^ocp-([\w-]+) = ", PROJECT, re.MULTILINE)))
    assert printed[2] == str(certificate_in(folder)["lower"])
