"""A command composes and builds once, a resume reads its checkpoint once, and a start imports nothing it does not use."""

import json
import os
import shutil
import subprocess
import sys

import pytest

from ocp_torch.cli.explain import CHECKOUT
from support.forked import TINY, train

# What a short run has no use for, each with a tenth of a second of CPU or more to import.
UNUSED = (
    "scipy.linalg",
    "matplotlib",
    "sympy",
    "torch._dynamo",
    "torch.distributed.tensor",
    "gymnasium",
    "onnxruntime",
)


def telling():
    """In the child: says when it composes, builds a trainer, and unpacks a checkpoint."""
    from ocp_torch.cli import compose
    from ocp_torch.runs import run
    from ocp_torch.training import checkpoint

    def told(module, name: str, word: str) -> None:
        real = getattr(module, name)

        def tell(*arguments, **options):
            print(f"<{word}>", flush=True)
            return real(*arguments, **options)

        setattr(module, name, tell)

    told(compose, "compose", "composed")
    told(run, "build_trainer", "built")
    told(checkpoint, "unpacked", "read")


def counted(*arguments: str, cwd) -> dict[str, int]:
    ended = train(*arguments, cwd=cwd, before=telling)
    assert ended.status == 0, ended
    return {word: ended.stdout.count(f"<{word}>") for word in ("composed", "built", "read")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("once") / "run"
    assert counted(*TINY, f"hydra.run.dir={folder}", cwd=folder.parent) == {"composed": 1, "built": 1, "read": 0}
    return folder


@pytest.mark.nightly
def test_a_resume_reads_its_checkpoint_once(finished, tmp_path):
    assert counted(f"resume={finished}", cwd=tmp_path) == {"composed": 1, "built": 1, "read": 1}
    run = shutil.copytree(finished, tmp_path / "run")
    assert counted(f"resume={run}", "trainer.steps=62", cwd=tmp_path) == {"composed": 1, "built": 1, "read": 1}
    assert json.loads((run / "certificate.json").read_text())["step"] == 62


def test_without_a_configuration_beside_it_the_checkpoint_is_read_once_more_for_its_own(finished, tmp_path):
    run = shutil.copytree(finished, tmp_path / "run")
    shutil.rmtree(run / ".hydra")
    assert counted(f"resume={run}", "trainer.steps=62", cwd=tmp_path) == {"composed": 1, "built": 1, "read": 2}


@pytest.mark.nightly
def test_a_start_imports_nothing_that_it_does_not_use(tmp_path):
    program = (
        "import runpy, sys\n"
        f"sys.argv = ['train.py', *{[*TINY, 'trainer.steps=1', 'optimizer=soap', f'hydra.run.dir={tmp_path}/run']!r}]\n"
        f"runpy.run_path({str(CHECKOUT / 'scripts' / 'train.py')!r}, run_name='__main__')\n"
        f"print('imported', [name for name in {UNUSED!r} if name in sys.modules])\n"
    )
    words = [sys.executable, "-c", program]
    done = subprocess.run(
        words, cwd=tmp_path, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "imported []"
