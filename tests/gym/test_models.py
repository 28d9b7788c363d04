"""Systems that are models of Gymnasium's own environments: one of their steps is what the model says, controls act alike."""

import math
from contextlib import closing
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from ocp_torch.control.policies import zero_policy
from ocp_torch.errors import InputError
from ocp_torch.gym.rollout import made, play
from ocp_torch.problems import Acrobot, CartPole, InvertedDoublePendulum, MountainCar, Pendulum
from ocp_torch.problems.physical.system import System
from ocp_torch.runs.metrics.classical import classical_policy

gymnasium = pytest.importorskip("gymnasium")

# Gymnasium's "book" parameters; inertias about the joints. Its action is a torque of 1 N m or none.
ACROBOT = Acrobot(
    masses=(1.0, 1.0),
    lengths=(1.0, 1.0),
    centres=(0.5, 0.5),
    inertias=(1.25, 1.25),
    damping=(0.0, 0.0),
    gravity=9.8,
    max_speeds=(12.5, 28.2),
    control_limit=1.0,
)
CAR, CART = MountainCar(), CartPole()
# Each model, a physical state and control to try, and how the environment writes that state.
CASES = {
    "CartPole-v1": (CART, [0.4, 0.3, -0.6, 1.1], [10.0], lambda s: np.array([s[0], s[2], s[1], s[3]])),
    "Acrobot-v1": (ACROBOT, [2.4, -0.7, 0.8, -1.3], [-1.0], lambda s: np.array([s[0] - math.pi, *s[1:]])),
    "MountainCarContinuous-v0": (CAR, [-0.3, 0.02], [0.6], np.array),
}
POLES, BALANCED = InvertedDoublePendulum(), "InvertedDoublePendulum-v5"
mujoco = pytest.mark.skipif(not (find_spec("mujoco") and find_spec("imageio")), reason="gymnasium[mujoco] is missing")


class Agent:
    """A policy of a problem as a controller that `play` takes."""

    kind = "a test's"

    def __init__(self, problem: System, policy) -> None:
        self.problem, self.policy = problem, policy

    def __call__(self, x):
        return self.policy(torch.from_numpy(x)).numpy()


@pytest.mark.parametrize("name", CASES)
def test_a_step_of_theirs_is_one_of_the_model(name):
    """Theirs are off by `O(dt^2)` in a step: by a hundredth in a tenth of it, where it can be made shorter."""
    system, state, control, written = CASES[name]
    off = []
    for shorter in (1.0, 0.1):
        env = gymnasium.make(name).unwrapped
        env.reset(seed=0)
        env.state = written(state)
        field = next((f for f in ("tau", "dt") if hasattr(env, f)), None)
        dt = 1.0
        if field is not None:
            dt = shorter * getattr(env, field)
            setattr(env, field, dt)
        u = system.to_controls(torch.tensor([control], dtype=torch.float64))
        x = system.to_torus(torch.tensor([state], dtype=torch.float64))
        seen, *_ = env.step(system.to_action(name, u[0].numpy()))
        moved = torch.from_numpy(system.from_observation(name, seen)) - x[0] - dt * system.velocity(x, u)[0]
        off.append(float((moved - moved.round()).abs().max()))
        env.close()
    assert off[0] < 0.02
    if field is not None:
        assert off[1] < 0.02 * off[0] + 1e-6  # observations are in single precision


@pytest.mark.parametrize("seed", range(4))
@mujoco
def test_a_step_of_mujocos_is_one_of_the_model(seed):
    """It accelerates as the model says, but for a gravity of 1e-5 m/s^2 along the rail; and what it shows after a step, of
    several by RK4, is off `ds/dt` times the step by its square."""
    from mujoco import mj_forward

    draws = torch.rand(7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5
    s, force = draws[:6] * torch.tensor([1.0, 1.0, 1.0, 3.0, 6.0, 6.0]), 800.0 * float(draws[6])
    a, B = POLES.dynamics(s[None])
    rate, off = (a + B[..., 0] * force)[0], []
    relative = lambda q: np.array([q[0], q[1], q[2] - q[1]])  # the second joint of theirs
    for shorter in (0.1, 0.01):
        with closing(made(BALANCED)) as env:
            env.reset(seed=0)
            own = env.unwrapped
            own.model.opt.timestep *= shorter
            own.set_state(relative(s[:3]), relative(s[3:]))
            own.data.ctrl[:] = action = POLES.action(np.array([force]))
            mj_forward(own.model, own.data)
            assert own.data.qacc == pytest.approx(relative(rate[3:]), abs=2e-5)
            seen = torch.from_numpy(POLES.observed(env.step(action)[0]))
        off.append(float((seen - s - own.dt * rate).abs().max()))
    assert 1e-4 < off[0] < 0.02
    assert off[1] < 0.02 * off[0]


@pytest.mark.parametrize("name", CASES)
def test_what_they_show_beyond_a_seam_is_taken_at_it(name):
    system, state, *_ = CASES[name]
    s = torch.tensor([state], dtype=torch.float64)
    s[0, -1] = 1e3
    assert float(system.chart.clipped(s)[0, -1]) == 0.5
    with pytest.raises(InputError, match="does not know the environment Pendulum-v1"):
        system.from_observation("Pendulum-v1", np.zeros(3))


def test_a_system_that_names_an_environment_must_say_how_it_is_played():
    class Silent(Pendulum):
        observed, action = System.observed, System.action

    with pytest.raises(InputError, match=r"Silent must define observed\(observation\)"):
        Silent().from_observation("Pendulum-v1", np.zeros(3))
    with pytest.raises(InputError, match=r"Silent must define action\(control\)"):
        Silent().to_action("Pendulum-v1", np.zeros(1))


def test_torques_between_are_rounded_and_pushes_have_a_side():
    assert [int(ACROBOT.action(np.array([u]))) for u in (-9.0, -0.4, 0.3, 0.7)] == [0, 1, 1, 2]
    assert [int(CART.action(np.array([u]))) for u in (-3.0, 0.2)] == [0, 1]


@pytest.mark.parametrize(
    ("name", "least", "most"),
    # Upright for all of an episode, at 1 a step, and at 10 less the square of the 0.8 m that the tip lacks of 2 m; the tip up
    # in 80 to 90 steps of 500; and 100 for the goal less 0.1 a step of full force.
    [
        ("CartPole-v1", 500.0, 60.0),
        pytest.param(BALANCED, 9359.0, 500.0, marks=mujoco),
        ("Acrobot-v1", -150.0, -500.0),
        ("MountainCarContinuous-v0", 80.0, 0.0),
    ],
)
def test_the_models_classical_controllers_solve_theirs_and_no_control_does_not(name, least, most):
    system = POLES if name == BALANCED else CASES[name][0]
    with closing(made(name)) as env:
        assert play(Agent(system, classical_policy(system)), env, name, 2, 0).returns.min() >= least
        assert play(Agent(system, zero_policy(system)), env, name, 1, 0).returns.max() <= most
