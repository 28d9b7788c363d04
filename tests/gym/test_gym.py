"""Problems as Gymnasium environments, and controllers as agents in ours and in others. Skipped where Gymnasium is not."""

import math
import sys
import warnings
from contextlib import closing

import numpy as np
import pytest
import torch
from PIL import Image

from ocp_torch.errors import InputError
from ocp_torch.gym.environment import ControlEnvironment, clocks, observe, require_gymnasium, state_of
from ocp_torch.gym.rollout import Agent, RolloutJob, made, play, save_gif
from ocp_torch.problems import PROBLEMS, Dataset, Manufactured
from ocp_torch.runs.record import record
from support import zoo
from support.small import session, small
from support.systems import Cart

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")


@pytest.fixture(scope="module")
def gymnasium():
    found = pytest.importorskip("gymnasium")
    import ocp_torch.gym  # noqa: F401

    return found


def test_without_gymnasium_one_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(InputError, match=r"\[gym\]"):
        require_gymnasium()


def test_states_come_back_from_their_observations():
    x = torch.rand(50, 3, dtype=torch.float64)
    back = torch.from_numpy(state_of(observe(x)))
    assert float(((back - x + 0.5).remainder(1.0) - 0.5).abs().max()) < 1e-6


def test_a_state_is_drawn_as_clocks():
    one, other = clocks(torch.tensor([0.0, 0.25])), clocks(torch.tensor([0.0, 0.75]))
    assert one.dtype == np.uint8
    assert one.shape == other.shape
    assert (one != other).any()


SIMULABLE = sorted(name for name, c in PROBLEMS.items() if c.has_simulator)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name", [n if k % 4 == 0 else pytest.param(n, marks=pytest.mark.nightly) for k, n in enumerate(SIMULABLE)]
)
def test_every_problem_is_an_environment_that_passes_the_checker(gymnasium, name):
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make(f"ocp_torch/{PROBLEMS[name].__name__}-v0", render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*not within.*|.*[Rr]ender mode.*|.*symmetric.*")
        check_env(env.unwrapped)
    assert env.reset(seed=1)[0].shape == (2 * env.unwrapped.problem.dim,)
    assert env.render().ndim == 3
    env.close()


def test_arguments_reach_the_problem_and_the_environment(gymnasium):
    env = gymnasium.make("ocp_torch/Manufactured-v0", dim=3, seed=4, control_limit=0.3, time_step=0.01, horizon=0.05)
    own = env.unwrapped
    assert (own.problem.dim, own.problem.seed, own.control_bound, own.time_step) == (3, 4, 0.3, 0.01)
    env.reset(seed=0)
    cuts = [env.step(np.ones(3, dtype=np.float32))[3] for _ in range(5)]
    assert cuts == [False] * 4 + [True]
    mine = gymnasium.make("ocp_torch/Problem-v0", problem=zoo.Swing(), control_bound=2.0)
    assert mine.unwrapped.control_bound == 2.0
    for wrong in (dict(dims=3), dict(control_bound=-1.0), dict(time_step=0.0), dict(horizon=-1.0)):
        with pytest.raises(InputError, match=rf"^(problem\.)?{next(iter(wrong))} is"):
            gymnasium.make("ocp_torch/Manufactured-v0", **wrong)
    with pytest.raises(InputError, match="problem is missing"):
        gymnasium.make("ocp_torch/Problem-v0")


@pytest.mark.parametrize("name", ["ocp_torch/Torus-v0", "ocp_torch/DoubleIntegrator-v0"])
def test_episodes_repeat_by_seed_and_differ_without(gymnasium, name):
    """The second starts in a narrow place."""
    first, second = (gymnasium.make(name) for _ in range(2))
    assert np.array_equal(first.reset(seed=3)[0], second.reset(seed=3)[0])
    assert not np.array_equal(first.reset(seed=3)[0], first.reset(seed=4)[0])
    third, fourth = (gymnasium.make(name).reset()[0] for _ in range(2))
    assert not np.array_equal(third, fourth)


def test_who_writes_into_a_state_that_was_told_does_not_move_the_environment(gymnasium):
    env = ControlEnvironment(zoo.Swing())
    told, before = env.reset(seed=0)[1], env.x.clone()
    told["state"] += 0.25
    assert torch.equal(env.x, before)


def test_actions_beyond_the_limit_are_cut_to_the_ball(gymnasium):
    problem = Manufactured(control_limit=0.3)
    env = ControlEnvironment(problem)
    env.reset(seed=0)
    paid = env.step(np.ones(2, dtype=np.float32))[4]["cost"]
    x = env.x.clone()
    env.reset(seed=0)
    again = env.step(np.full(2, math.sqrt(0.5), dtype=np.float32))[4]["cost"]
    assert paid == pytest.approx(again, rel=1e-6)
    torch.testing.assert_close(env.x, x)


def test_each_action_is_in_units_of_its_actuators_limit(gymnasium):
    env = ControlEnvironment(Manufactured(control_limit=[0.3, 0.02]), control_bound=0.2)
    assert env.control_bound.tolist() == [0.2, 0.02]
    assert env.to_action(np.array([0.1, -0.02])).tolist() == [0.5, -1.0]
    env.reset(seed=0)
    x, action = env.x.clone(), np.array([0.5, -5.0], dtype=np.float32)
    paid = env.step(action)[4]["cost"]
    u = torch.tensor([[0.1, -0.02]], dtype=torch.float64)
    middle = x + 0.5 * env.time_step * env.problem.velocity(x, u)
    assert paid == pytest.approx(float(env.problem.state_cost(middle)) + 0.5 * (0.1**2 + 0.02**2))
    torch.testing.assert_close(env.x, (x + env.time_step * env.problem.velocity(middle, u)).remainder(1.0))


@pytest.mark.parametrize("name", ["pendulum", "acrobot", "mountain_car"])
def test_a_step_ends_where_the_system_does_under_a_held_control(gymnasium, name):
    """Whatever the default time step: that of the mountain car is 20 steps of Gymnasium's. And with the same cost."""
    env, off, costs = gymnasium.make(f"ocp_torch/{PROBLEMS[name].__name__}-v0").unwrapped, [], []
    env.action_space.seed(0)
    parts = 300
    for k in range(10):
        x = torch.as_tensor(env.reset(seed=k)[1]["state"])[None]
        action = env.action_space.sample()
        *_, info = env.step(action)
        u = torch.as_tensor(env.control_bound * action.astype(np.float64))[None]
        cost, h = 0.0, env.time_step / parts
        for _ in range(parts):
            velocity, now = env.problem.motion(x + 0.5 * h * env.problem.velocity(x, u), u)
            x, cost = x + h * velocity, cost + float(now) / parts
        off.append(float(((torch.as_tensor(info["state"]) - x + 0.5).remainder(1.0) - 0.5).norm()))
        costs.append((info["cost"], cost))
    assert np.mean(off) < 5e-3
    assert np.allclose(*np.mean(costs, axis=0), rtol=0.02)


@pytest.mark.parametrize("action", [[0.5], [0.5, 0.5, 0.5], [0.5, np.nan], 0.5, ["a", "b"], None])
def test_an_action_that_is_not_a_finite_number_for_each_control_is_refused(gymnasium, action):
    env = gymnasium.make("ocp_torch/Torus-v0").unwrapped
    before = env.reset(seed=0)[1]["state"].copy()
    with pytest.raises(InputError, match=r"action is .*, but must be 2 finite numbers\."):
        env.step(action)
    assert np.array_equal(before, env.x[0].numpy())


def test_a_data_set_is_no_environment(tmp_path):
    path = tmp_path / "a.npz"
    record(zoo.build("circle rho=2"), 300, path, 0, True, 0.0)
    with pytest.raises(InputError, match="cannot be simulated"):
        ControlEnvironment(Dataset(str(path)))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gym") / "run"
    quick = ("certificate.points=64", "certificate.trajectories=4", "certificate.ascents=2", "trainer.figures=false")
    enough = ("trainer.steps=300", "trainer.batch=64", "model.width=24", "optimizer.lr=0.01")
    session(small("problem=circle", "method=dual", *enough, *quick), folder)
    return folder


def asked(run, **changes):
    return RolloutJob({"run": str(run), "problem": {}, "episodes": 8, "seed": 0, "video": None, **changes})


@pytest.mark.nightly
def test_a_controller_acts_in_an_environment_of_ours(gymnasium, run, tmp_path):
    video = tmp_path / "out.gif"
    found = asked(run, env="ocp_torch/Circle-v0", video=str(video)).run()
    with Image.open(video) as film:
        assert film.n_frames > 10
    assert len(found.returns) == 8
    assert (found.lengths == 50).all()
    # Better than doing nothing from the same starts.
    env = made("ocp_torch/Circle-v0")
    idle = []
    for k in range(8):
        env.reset(seed=k)
        total, over = 0.0, False
        while not over:
            _, reward, _, over, _ = env.step(np.zeros(1, dtype=np.float32))
            total += reward
        idle.append(total)
    assert found.returns.mean() > np.mean(idle)
    assert "standard error of 8 episodes" in str(found)


def test_the_environment_is_of_the_controllers_own_problem(gymnasium, run, tmp_path):
    """An episode takes five discount times, of 50 steps: with a discount of 8 each is a quarter as long as by default."""
    quick = ("certificate.points=64", "certificate.trajectories=4", "certificate.ascents=2", "trainer.figures=false")
    other = tmp_path / "other"
    session(small("problem=circle", "problem.discount=8", "problem.control_limit=0.02", "method=dual", *quick), other)
    for name in ("Circle", "Problem"):
        for folder, discount in ((run, 2.0), (other, 8.0)):
            job = asked(folder, env=f"ocp_torch/{name}-v0", episodes=1)
            with closing(job.environment()) as env:
                assert env.unwrapped.problem.discount == discount
            assert job.run().lengths.tolist() == [50]


def test_an_environment_of_another_problem_is_told(gymnasium, run, caplog):
    gymnasium.register("Other-v0", entry_point=lambda **options: ControlEnvironment(Manufactured(dim=1), **options))
    try:
        asked(run, env="Other-v0", episodes=1).run()
        assert "Other-v0 is of the problem Manufactured, but the controller is for Circle" in caplog.text
        caplog.clear()
        asked(run, env="ocp_torch/Circle-v0", episodes=1).run()
        assert "but the controller" not in caplog.text
    finally:
        gymnasium.registry.pop("Other-v0")


def test_wrong_requests_are_one_sentence(gymnasium, run):
    wrong = (
        (dict(env="Nowhere-v0"), "env is 'Nowhere-v0', which cannot be made.*; one of your own is named module:Id-v0"),
        (dict(env="my_envs/Mine-v0"), "; one of your own is named module:Id-v0, after the module that registers it"),
        (dict(env="ocp_torch/Torus-v0"), "has d = 2, m = 2, but the controller is for d = 1"),
        (dict(env="ocp_torch/Circle-v0", video="a.mp4"), "video"),
        (dict(env="ocp_torch/Circle-v0", episodes=0), "episodes"),
    )
    for changes, sentence in wrong:
        with pytest.raises(InputError, match=sentence):
            asked(run, **changes)


@pytest.fixture
def foreign(gymnasium):
    """A tiny environment that is not ours: a phase in degrees, pushed by an action in [-2, 2]."""

    class Dial(gymnasium.Env):
        metadata: dict = {"render_modes": [], "render_fps": 5}

        def __init__(self, render_mode=None):
            self.render_mode = render_mode
            self.observation_space = gymnasium.spaces.Box(0.0, 360.0, (1,), np.float64)
            self.action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float64)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.angle, self.count = self.np_random.uniform(0.0, 360.0), 0
            return np.array([self.angle]), {}

        def step(self, action):
            self.angle, self.count = (self.angle + 36.0 * float(action[0])) % 360.0, self.count + 1
            return np.array([self.angle]), -abs(self.angle - 180.0), False, self.count >= 30, {}

    gymnasium.register("Dial-v0", entry_point=lambda **options: Dial(**options))
    yield "Dial-v0"
    gymnasium.registry.pop("Dial-v0")


class Maps:
    """Hooks a problem may have, to be put into one that has none."""

    def from_observation(self, env, observation):
        assert env == "Dial-v0"
        return observation / 360.0

    def to_action(self, env, control):
        return 10.0 * control


def test_a_problem_maps_a_foreign_environment(gymnasium, foreign, run, monkeypatch, tmp_path):
    with pytest.raises(InputError, match="Circle does not know the environment Dial-v0"):
        asked(run, env=foreign)
    circle = PROBLEMS["circle"]
    monkeypatch.setattr(circle, "from_observation", Maps.from_observation)
    monkeypatch.setattr(circle, "to_action", Maps.to_action)
    # The cost is least at x = 1/2, half a turn: the dial is turned there.
    job = asked(run, env=foreign)
    acted = job.run()
    env = made(foreign)
    last = []
    for k in range(8):
        agent = Agent(job.controller, env, foreign)
        observation, over = env.reset(seed=k)[0], False
        while not over:
            observation, _, _, over, _ = env.step(agent.act(observation))
        last.append(abs(observation[0] - 180.0))
    assert np.median(last) < 40.0
    again = play(job.controller, env, foreign, 8, 0)
    assert np.array_equal(again.returns, acted.returns)
    with pytest.raises(InputError, match="cannot be drawn here|no pictures"):
        asked(run, env=foreign, video=str(tmp_path / "a.gif")).run()
    monkeypatch.setattr(circle, "from_observation", lambda self, env, observation: np.array([np.nan]))
    with pytest.raises(InputError, match="from_observation gave"):
        asked(run, env=foreign)
    monkeypatch.setattr(circle, "from_observation", Maps.from_observation)
    monkeypatch.setattr(circle, "to_action", lambda self, env, control: np.zeros(3))
    with pytest.raises(InputError, match="to_action gave shape"):
        asked(run, env=foreign)


def test_gifs_hold_their_frames(tmp_path):
    frames = [np.full((20, 30, 3), 40 * k, dtype=np.uint8) for k in range(5)]
    save_gif(tmp_path / "a.gif", frames, 10)
    with Image.open(tmp_path / "a.gif") as film:
        assert (film.n_frames, film.size) == (5, (30, 20))


def test_actions_apply_the_controls_they_are_made_of(gymnasium):
    env = ControlEnvironment(Manufactured(control_size=0.4))
    u = np.array([0.1, -0.2])
    assert env.to_action(u) * env.control_bound == pytest.approx(u)
    assert env.to_action(9.0 * u).tolist() == [1.0, -1.0]


@pytest.fixture
def theirs(gymnasium):
    """Gymnasium's own pendulum, without the frame that cuts its episodes."""
    env = gymnasium.make("Pendulum-v1").unwrapped
    yield env
    env.close()


def test_the_pendulum_is_gymnasiums_over_a_short_time(theirs):
    """One of their steps against the model's velocity: their Euler step is off by `O(dt^2)`: a tenth of `dt`, a hundredth."""
    pendulum = PROBLEMS["pendulum"](torque_cost=0.001, control_limit=1.0)
    rng = np.random.default_rng(5)
    errors = {0.05: [], 0.005: []}
    for _ in range(40):
        theirs.reset()
        start, u = rng.uniform([-3.0, -7.0], [3.0, 7.0]), rng.uniform(-1.0, 1.0, 1)
        for dt, found in errors.items():
            theirs.state, theirs.dt = start.copy(), dt
            x = pendulum.from_observation("Pendulum-v1", theirs._get_obs().astype(np.float64))
            velocity = pendulum.velocity(torch.from_numpy(x)[None], torch.from_numpy(u)[None])[0].numpy()
            observation, reward, *_ = theirs.step(pendulum.to_action("Pendulum-v1", u))
            off = pendulum.from_observation("Pendulum-v1", observation) - x - dt * velocity
            found.append(float(np.abs(off - off.round()).max()))
            # The cost agrees but for `theta^2`, which the model makes smooth, and single precision of the observation.
            cost = float(
                pendulum.state_cost(torch.from_numpy(x)[None]) + pendulum.control_cost.cost(torch.from_numpy(u))
            )
            smooth = start[0] ** 2 - 2.0 * (1.0 - math.cos(start[0]))
            assert -reward - smooth == pytest.approx(cost / pendulum._scale, rel=1e-4, abs=1e-4)
    assert max(errors[0.05]) < 0.02
    assert max(errors[0.005]) < 0.015 * max(errors[0.05]) + 1e-6


@pytest.mark.nightly
def test_a_saved_pendulum_controller_plays_gymnasiums_untouched(gymnasium, tmp_path):
    """The classical swing-up through the same maps: what does not swing up returns about -1200."""
    from ocp_torch.runs.metrics.classical import classical_policy

    pendulum = PROBLEMS["pendulum"](torque_cost=0.001, control_limit=1.0)
    policy = classical_policy(pendulum)

    class Classical:
        problem, kind = pendulum, "classical"

        def __call__(self, x):
            return policy(torch.from_numpy(x)).numpy()

    env = made("Pendulum-v1")
    found = play(Classical(), env, "Pendulum-v1", 20, 0)
    env.close()
    assert (found.lengths == 200).all()
    assert found.returns.mean() > -500.0
    folder = tmp_path / "run"
    few = ("certificate.points=64", "certificate.trajectories=4", "certificate.ascents=2", "trainer.figures=false")
    small_run = ("trainer.steps=5", "trainer.batch=32", "trainer.rounds=1", "model.width=16", "model.waves=0")
    short = ("warm_start.rounds=2", "problem.discount=8.0")  # controllers that are hardly trained take long to simulate
    session(small("experiment=gymnasium_pendulum", *small_run, *short, *few), folder)
    played = asked(folder, env="Pendulum-v1", episodes=2).run()
    assert (played.lengths == 200).all()
    assert np.isfinite(played.returns).all()


def test_a_system_shows_its_state_and_control_in_physical_units(gymnasium):
    system = Cart(noisy=False)
    env = ControlEnvironment(system, control_bound=1.0, time_step=0.01)
    assert env.metadata["coordinates"] == ["trolley [m]", "pole [rad]", "spin [rad/s]"]
    assert env.metadata["controls"] == ["push [N]", "torque [N m]"]
    _, info = env.reset(seed=3)
    before = info["physical_state"]
    assert np.abs(before[0]) <= 2.0
    *_, info = env.step(np.array([0.5, -0.25], dtype=np.float32))
    assert info["physical_control"] == pytest.approx(np.array([0.5, -0.25]) / np.sqrt([0.5, 2.0]))
    s = torch.from_numpy(before)[None]
    a, B = system.dynamics(s)
    moved = s + 0.01 * (a + torch.einsum("ndm,nm->nd", B, torch.from_numpy(info["physical_control"])[None]))
    assert info["physical_state"] == pytest.approx(moved[0].numpy(), abs=2e-3)
