"""A broken sensor shows: an exported controller answers NaN where its state is NaN or an angle infinite, as in Python."""

import shutil
import subprocess

import numpy as np
import pytest
import torch

from ocp_torch.control.exported import PHYSICAL, TORUS
from support.controllers import METHODS, SMALL, controller_of
from support.exports import states_of, through_c, truth
from support.small import configured

pytestmark = pytest.mark.usefixtures("quick_composition")

COMPILED = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler here")
# An interval, an angle and a limit; branches that lose a NaN, and no units; constants beside states; tables in ONNX.
VARIANTS = {
    "pendulum": ("dual", "problem=pendulum", "problem.control_limit=1.0"),
    "density": ("pd", "problem.exponent=1.5", "problem.control_limit=0.05"),
    "walls": ("dual", "problem=dubins", "problem.walls=true"),
    "gelu": ("dual", "model.activation=gelu"),
}
EACH = pytest.mark.parametrize(
    "variant", [v if v == "density" else pytest.param(v, marks=pytest.mark.nightly) for v in VARIANTS]
)
# Computed in double; and states or more in single precision.
DOUBLE, SINGLE = 1e-12, 1e-4


def broken_of(variant):
    """The last controller, states with a NaN, then an infinity of each sign, in each coordinate, and what must be given."""
    method, *rest = VARIANTS[variant]
    controller = controller_of(configured(*SMALL, *METHODS[method], *rest))[-1]
    place = PHYSICAL if controller.problem.measures else TORUS
    rows = []
    for number in (torch.nan, torch.inf, -torch.inf):
        for i in range(controller.problem.dim):
            rows.append(states_of(controller, place)[0].clone())
            rows[-1][i] = number
    states = torch.stack(rows)
    wanted = truth(controller, place)(states)
    boxed = controller.problem.chart.boxed if place == PHYSICAL else []
    lost = [i not in boxed for i in range(controller.problem.dim)]
    expected = torch.tensor([True] * len(lost) + 2 * lost)
    for value in wanted.values():
        assert torch.equal(value.isnan().reshape(len(states), -1).all(dim=1), expected)
        assert value[~expected].isfinite().all()
    return controller, states, wanted


def same(got, wanted, tolerance):
    for name, value in wanted.items():
        found = torch.as_tensor(np.asarray(got[name], dtype=np.float64)).reshape(value.shape)
        torch.testing.assert_close(found, value, rtol=tolerance, atol=tolerance, equal_nan=True, msg=name)


@COMPILED
@EACH
def test_c(variant, tmp_path):
    controller, states, wanted = broken_of(variant)
    header, _ = controller.export(tmp_path / "u.c")
    fastest = header.read_text().split("gcc ")[1].split(".")[0]
    same(through_c(tmp_path, "u", wanted, states)[0], wanted, DOUBLE)
    same(through_c(tmp_path, "u", wanted, states, speed=fastest)[0], wanted, DOUBLE)
    for precision in ("FLOAT", "SINGLE"):
        same(through_c(tmp_path, "u", wanted, states, precision)[0], wanted, SINGLE)


@COMPILED
def test_c_is_not_compiled_where_nan_would_be_lost(tmp_path):
    broken_of("density")[0].export(tmp_path / "u.c")
    flags = ["-std=c99", "-O1", "-ffast-math", "-c", str(tmp_path / "u.c"), "-o", str(tmp_path / "u.o")]
    told = subprocess.run(["gcc", *flags], capture_output=True, text=True, check=False)
    assert told.returncode != 0
    assert "add -fno-finite-math-only after -ffast-math" in told.stderr


@EACH
def test_casadi(variant, tmp_path):
    casadi = pytest.importorskip("casadi")
    controller, states, wanted = broken_of(variant)
    (file,) = controller.export(tmp_path / "u.casadi")
    u = casadi.Function.load(str(file))
    results = u.map(len(states))(states.numpy().T)
    same({u.name_out(i): r.full().T for i, r in enumerate(results)}, wanted, DOUBLE)


@EACH
def test_onnx(variant, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    controller, states, wanted = broken_of(variant)
    (file,) = controller.export(tmp_path / "u.onnx")
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    same(dict(zip(names, session.run(None, {"state": states.float().numpy()}), strict=True)), wanted, SINGLE)


@COMPILED
@pytest.mark.nightly
def test_single_precision_loses_what_its_header_says_for_angles_of_many_turns(tmp_path):
    """Some 1e-5 of the most within a turn, and as much again for each turn: twice that at most."""
    controller = controller_of(configured(*SMALL, *METHODS["dual"], *VARIANTS["pendulum"][1:]))[0]
    controller.export(tmp_path / "u.c")
    near = states_of(controller, PHYSICAL)
    for turns in (1, 100, 1000):
        states = near.clone()
        states[:, 0] += turns * controller.problem.chart.length[0]
        states = states.float()
        wanted = truth(controller, PHYSICAL)(states.double())
        got = through_c(tmp_path, "u", wanted, states, "SINGLE")[0]
        off = np.abs(got["control"] - wanted["control"].numpy()).max() / float(wanted["control"].abs().max())
        assert off <= 2e-5 * (1 + turns)
