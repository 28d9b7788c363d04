"""A receding horizon with `V*` at its end is optimal however short it is; its factors are those of the problem."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ocp_torch import Circle, InputError, Manufactured
from ocp_torch.export import lowered
from ocp_torch.export.casadi_function import casadi_function
from ocp_torch.studies.horizons import Played, horizons, play
from support.controllers import controllers
from support.systems import Swing

pytest.importorskip("casadi")
from ocp_torch.control.receding_horizon import QUIET, RecedingHorizon, model  # noqa: E402

STARTS = np.random.default_rng(0).random((2, 2))


def terminal(problem):
    """`V*`, with the optimal control to start from."""
    exact = lambda x: {"value": problem.exact_value(x)}
    return casadi_function(lowered(exact, torch.rand(4, problem.dim, dtype=torch.float64)), "exact")


def test_the_model_is_the_problem():
    problem = Swing(control_limit=2.0)
    f, a, B = model(problem)(np.array([0.2, 0.7]))
    x = torch.tensor([[0.2, 0.7]], dtype=torch.float64)
    np.testing.assert_allclose(f.full().ravel(), problem.state_cost(x), rtol=1e-12)
    np.testing.assert_allclose(a.full().ravel(), problem.drift(x)[0], rtol=1e-12)
    np.testing.assert_allclose(B.full().ravel(), problem.control_matrix(x)[0].T.ravel(), rtol=1e-12, atol=1e-15)


@pytest.mark.nightly
@pytest.mark.parametrize("exponent", [2.0, 1.5])
def test_with_the_exact_value_two_steps_are_enough(exponent):
    problem = Manufactured(dim=2, exponent=exponent)
    step, steps = 0.05, 60
    V = terminal(problem)
    short = play(problem, RecedingHorizon(problem, 2, step, V), STARTS, step, steps)
    best = problem.exact_value(torch.as_tensor(STARTS)).numpy()
    np.testing.assert_allclose(short.costs, best, rtol=5e-3)  # what is left after three discount times, and steps
    alone = play(problem, RecedingHorizon(problem, 2, step), STARTS, step, steps)
    assert (alone.costs > short.costs + 0.01).all()


@pytest.mark.parametrize("limit", [0.05, [0.05, 0.02]])
def test_it_keeps_to_the_limits(limit):
    problem = Manufactured(dim=2, control_limit=limit)
    horizon = RecedingHorizon(problem, 5, 0.1)
    u = np.array([horizon(x) for x in STARTS])
    size = np.abs(u) if isinstance(limit, list) else np.linalg.norm(u, axis=1)
    assert (size <= np.array(limit) * (1.0 + 1e-6)).all()
    assert (size.max(axis=0) > 0.9 * np.array(limit)).any()


def test_states_at_which_no_plan_was_found_are_counted(monkeypatch):
    problem = Manufactured(dim=2)
    assert [RecedingHorizon(problem, 5, 0.1)(x).shape for x in STARTS] == [(2,), (2,)]
    monkeypatch.setattr("ocp_torch.control.receding_horizon.QUIET", QUIET | {"ipopt.max_iter": 0})
    hasty = RecedingHorizon(problem, 5, 0.1)
    for x in STARTS:
        hasty(x)
    assert hasty.failed == len(STARTS)


def test_whole_turns_change_nothing():
    problem = Circle()
    controls = []
    for turns in (0.0, 3.0, -2.0):
        horizon = RecedingHorizon(problem, 4, 0.1)
        controls.append([horizon(np.array([x + turns * k])) for k, x in enumerate((0.1, 0.12))])
    np.testing.assert_allclose(controls[1], controls[0], atol=1e-5)
    np.testing.assert_allclose(controls[2], controls[0], atol=1e-5)


def asked(path, **changes):
    return {
        "run": str(path),
        "problem": {},
        "steps": 2,
        "step": None,
        "longer": 2,
        "starts": 2,
        "time": 0.2,
        "seed": 0,
    } | changes


def test_starts_are_drawn_from_the_start_density(tmp_path, monkeypatch):
    """Of a double integrator, which starts at the middle of its box: nothing is played from where `mu0` is 0."""
    (controller,) = controllers("dual", "problem=double_integrator")
    controller.save(tmp_path / "controller.safetensors")
    met = []
    monkeypatch.setattr("ocp_torch.studies.horizons.play", lambda p, u, x0, *_: met.append(x0) or Played(x0[:, 0], 1.0))
    horizons(asked(tmp_path / "controller.safetensors", starts=64))()
    density = controller.problem.initial_density(torch.as_tensor(met[0]))
    assert len(met) == 3
    assert bool((density > 0.0).all())


class Calm(Swing):
    """Its gusts are of size 0, but there."""

    def disturbance(self, s):
        return 0.0 * self.dynamics(s)[1]


@pytest.mark.parametrize("problem", [Calm(), Swing(torque_noise=0.1)])
def test_noise_is_refused_and_what_is_0_is_told_to_be_left_out(problem, monkeypatch):
    held = SimpleNamespace(problem=problem, fields=SimpleNamespace(value=True))
    monkeypatch.setattr("ocp_torch.studies.horizons.load_run", lambda config: held)
    with pytest.raises(InputError, match="without noise") as refused:
        horizons(asked("anything"))
    hint = "disturbance is 0 at all of 4,096 states that were tried; where there is no noise it must give None"
    assert (hint in str(refused.value)) == isinstance(problem, Calm)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (dict(step=0.6), "step is 0.6, but must be above 0 and at most 0.5"),
        (dict(time=300.0), "time is 300, but must be above 0 and at most 250"),
        (dict(step=1e-5, time=None), "time is 3, but must be above 0 and at most 0.1"),
    ],
)
def test_a_step_too_long_to_be_followed_and_a_time_without_end_are_refused(wrong, sentence, tmp_path):
    """The discount time is a half, a step a twentieth of it."""
    file = tmp_path / "controller.safetensors"
    controllers("dual")[0].save(file)
    with pytest.raises(InputError, match=sentence):
        horizons(asked(file, **wrong))


@pytest.mark.nightly
def test_the_comparison_of_a_run(tmp_path, caplog):
    file = tmp_path / "controller.safetensors"
    controllers("dual")[0].save(file)
    with caplog.at_level("INFO"):
        found = horizons(asked(file))()
    assert [len(played.costs) for played in found.values()] == [2, 2, 2]
    assert all(np.isfinite(played.costs).all() and (played.costs > 0.0).all() for played in found.values())
    assert all(name in caplog.text for name in found)
    for changes, reason in [
        ({"steps": 0}, "steps is 0, but must be at least 1"),
        ({"time": -1.0}, "time is -1, but must be above 0"),
    ]:
        with pytest.raises(InputError, match=reason):
            horizons(asked(file, **changes))
    controllers("primal network")[0].save(file)
    with pytest.raises(InputError, match="holds no V: take one of method=dual or pd"):
        horizons(asked(file))
