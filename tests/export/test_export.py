"""A controller is the same function in ONNX, in C and in CasADi: random networks, every limit and price, wraps included."""

import json
import shutil
from functools import cache

import numpy as np
import pytest
import torch

from ocp_torch import InputError
from ocp_torch.control.described import described
from ocp_torch.control.exported import PHYSICAL, TORUS
from ocp_torch.control.policies import trained_policies
from support.controllers import METHODS, SMALL, controller_of, controllers
from support.exports import STATES, states_of, through_c, truth
from support.small import configured
from support.systems import Cart

pytestmark = pytest.mark.usefixtures("quick_composition")

# Of the largest number of an output: in double; computed in double for states and results in single precision; and all in
# single precision, where what PyTorch itself is off by is allowed four times.
DOUBLE, ROUNDED, SINGLE, AS_PYTORCH = 1e-12, 1e-7, 1e-5, 4.0
VARIANTS = {
    **{name: (name,) for name in METHODS},
    "gated": ("dual", "problem=manufactured", "problem.dim=5", "model.gated=true", "model.activation=silu"),
    "gelu": ("dual", "model.activation=gelu"),
    "softplus": ("dual", "model.activation=softplus"),
    "sobolev": ("dual", "model=sobolev", "model.modes=3"),
    "limit": ("dual", "problem.control_limit=0.05"),
    "limit, q < 2": ("pd", "problem.exponent=1.5", "problem.control_limit=0.05"),
    "limits": ("dual", "problem=manufactured", "problem.control_limit=[0.05,0.02]"),
    "varying B": ("pd", "problem.exponent=2", "problem.state_dependent_control=true"),
    "noise": ("pd", "problem.noise=0.02", "problem.state_dependent_noise=true"),
    "pendulum": ("dual", "problem=pendulum", "problem.control_limit=1.0"),
    "system": ("dual", "problem=cart_pole"),
    "walls": ("pd", "problem=dubins", "problem.walls=true"),
    "three joints": ("pd", "problem=arm", "problem.dim=3"),
    "held": ("dual", "problem=cart_pole", "warm_start.mode=on"),
}
# Quick is one that has most in it, units and a limit, and is small.
QUICK = ("pendulum",)
EACH = pytest.mark.parametrize(
    "variant", [v if v in QUICK else pytest.param(v, marks=pytest.mark.nightly) for v in VARIANTS]
)


@cache
def controllers_of(variant):
    """Made once for all formats: none changes them."""
    method, *rest = VARIANTS[variant]
    small = () if variant == "sobolev" else SMALL  # which name fields of a perceptron
    return controller_of(configured(*small, *METHODS[method], *rest))


def agree(got, wanted, tolerance, rounded=None):
    """``got`` is ``wanted``; what is ``rounded``, the control in single precision by PyTorch, may be off as that is."""
    assert list(got) == list(wanted)
    for name, value in wanted.items():
        found = torch.as_tensor(np.asarray(got[name], dtype=np.float64)).reshape(value.shape)
        assert torch.isfinite(value).all()
        own = 0.0 if rounded is None or name != "control" else AS_PYTORCH * float((rounded - value).abs().max())
        assert float((found - value).abs().max()) <= tolerance * max(1.0, float(value.abs().max())) + own, name


@torch.no_grad()
def rounded_by_pytorch(controller, states):
    """What its networks give in the single precision they are trained in; a controller itself computes in double."""
    problem = controller.problem
    known = trained_policies(controller.occupation, problem, controller.fields, controller.constants)
    policy = known[controller.kind]
    if not problem.measures:
        return policy(states.remainder(1.0)).double()
    return problem.from_controls(policy(problem.to_torus(problem.chart.nearest(states)))).double()


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler here")
@EACH
def test_c(variant, tmp_path):
    for number, controller in enumerate(controllers_of(variant)):
        name = f"exported_{number}"
        files = controller.export(tmp_path / f"{name}.c")
        assert [file.name for file in files] == [f"{name}.h", f"{name}.c"]
        place = PHYSICAL if controller.problem.measures else TORUS
        states = states_of(controller, place)
        function = truth(controller, place)
        double, metadata = through_c(tmp_path, name, function(states), states)
        agree(double, function(states), DOUBLE)
        if variant not in QUICK:
            fastest = (tmp_path / f"{name}.h").read_text().split("gcc ")[1].split(".")[0]
            agree(through_c(tmp_path, name, function(states), states, speed=fastest)[0], function(states), DOUBLE)
        assert metadata["certificate"] == controller.certificate
        assert metadata["coordinates"] == place
        single = states.float()
        exact = function(single.double())
        agree(through_c(tmp_path, name, exact, single, "FLOAT")[0], exact, ROUNDED)
        agree(
            through_c(tmp_path, name, exact, single, "SINGLE")[0], exact, SINGLE, rounded_by_pytorch(controller, single)
        )


@pytest.mark.nightly
@EACH
def test_casadi(variant, tmp_path):
    casadi = pytest.importorskip("casadi")
    for controller in controllers_of(variant):
        place = PHYSICAL if controller.problem.measures else TORUS
        (file,) = controller.export(tmp_path / "u.casadi")
        u = casadi.Function.load(str(file))
        states = states_of(controller, place)
        wanted = truth(controller, place)(states)
        results = u.map(len(states))(states.numpy().T)
        results = results if len(wanted) > 1 else [results]
        agree({u.name_out(i): r.full().T for i, r in enumerate(results)}, wanted, DOUBLE)
        reader = casadi.FileDeserializer(str(file))
        reader.unpack()
        assert json.loads(reader.unpack())["config"] == controller.config


def test_derivatives_of_casadi_are_exact(tmp_path):
    casadi = pytest.importorskip("casadi")
    controller = controllers("dual")[0]
    (file,) = controller.export(tmp_path / "u.casadi")
    state = casadi.MX.sym("x", 2)
    V = casadi.Function.load(str(file))(state)[1]
    hessian, gradient = casadi.hessian(V, state)
    both = casadi.Function("both", [state], [gradient, hessian])
    function = truth(controller, TORUS)
    x = torch.rand(2, dtype=torch.float64)
    slope, bent = (torch.tensor(r.full()) for r in both(x.numpy()))
    torch.testing.assert_close(slope.squeeze(1), function(x[None])["gradient"][0], rtol=1e-11, atol=1e-11)
    step = 1e-5 * torch.eye(2, dtype=torch.float64)
    differences = (function(x + step)["gradient"] - function(x - step)["gradient"]) / 2e-5
    torch.testing.assert_close(bent, differences, rtol=1e-6, atol=1e-5)


@pytest.mark.nightly
@EACH
def test_onnx(variant, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    for controller in controllers_of(variant):
        place = PHYSICAL if controller.problem.measures else TORUS
        (file,) = controller.export(tmp_path / "u.onnx")
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        metadata = json.loads(session.get_modelmeta().custom_metadata_map["ocp_torch"])
        assert metadata["problem"]["parameters"].keys() == described(controller.problem)["parameters"].keys()
        names = [output.name for output in session.get_outputs()]
        for count in (STATES, 1):
            states = states_of(controller, place)[:count].float()
            got = dict(zip(names, session.run(None, {"state": states.numpy()}), strict=True))
            agree(got, truth(controller, place)(states.double()), ROUNDED)


def test_a_system_can_be_exported_on_the_torus(tmp_path):
    casadi = pytest.importorskip("casadi")
    controller = controllers("dual", "problem=pendulum")[0]
    (file,) = controller.export(tmp_path / "u.casadi", coordinates=TORUS)
    x = states_of(controller, TORUS)
    got = casadi.Function.load(str(file)).map(len(x))(x.numpy().T)[0].full().T
    agree({"control": got}, {"control": truth(controller, TORUS)(x)["control"]}, DOUBLE)
    rounded = controller(x).double()
    torch.testing.assert_close(torch.tensor(got), rounded, rtol=1e-3, atol=1e-4 * float(rounded.abs().max()))


class Branching(Cart):
    """Its dynamics ask for a number."""

    def dynamics(self, s):
        a, B = super().dynamics(s)
        return (a, 2.0 * B) if float(s[0, 0]) > 0.0 else (a, B)


class Numbers(Cart):
    """Its dynamics go through NumPy, where no tracer follows."""

    def dynamics(self, s):
        a, B = super().dynamics(s)
        return a, B * torch.from_numpy(1.5 + np.sin(s.detach().numpy()[:, :1, None]))


@pytest.mark.nightly
def test_what_cannot_be_exported_is_told_in_a_sentence(tmp_path):
    controller = controllers("dual")[0]
    for arguments, reason in [
        (("u.txt",), "out is .*u.txt', but must end in one of .onnx, .c, .casadi, unless format names one"),
        (("u.onnx", "c"), r"out is .*u.onnx', but format=c writes files that end in .c"),
        (("u.c", "fortran"), "format is 'fortran', but must be one of"),
        (("a-b.c",), "its name must be letters, digits and _"),
        (("u.c", None, "physical"), "coordinates is physical, but the problem torus has no units; choose torus"),
    ]:
        with pytest.raises(InputError, match=reason):
            controller.export(tmp_path / arguments[0], *arguments[1:])
    branching = controller_of(configured(*SMALL, "problem._target_=support.systems.Cart", "method=dual"), Branching())[
        0
    ]
    with pytest.raises(InputError, match="this controller cannot be exported, as it cannot be traced"):
        branching.export(tmp_path / "u.c")
    through_numpy = controller_of(
        configured(*SMALL, "problem._target_=support.systems.Cart", "method=dual"), Numbers()
    )[0]
    with pytest.raises(InputError, match="its control is not what was traced at other states"):
        through_numpy.export(tmp_path / "u.c")
    assert list(tmp_path.iterdir()) == []
