"""Steppers against updates written out by hand in NumPy, on matrix games small enough to differentiate on paper."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from ocp_torch.errors import InputError
from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective, Phase
from ocp_torch.problems import Circle
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers import (
    Extragradient,
    NonFiniteError,
    Simultaneous,
    advance,
    averaged,
    optimizer_maker,
    schedule_maker,
    short_fit,
)
from ocp_torch.steppers.stepper import project_on_ball

A0, B0 = np.array([1.0, -0.5]), np.array([0.3, 2.0, -1.0])
PHASE = Phase(resolve_constants(Circle()))
both_steppers = pytest.mark.parametrize("stepper", [Simultaneous, Extragradient])


class Vector(nn.Module):
    """A field that is just its parameter, whatever the state."""

    def __init__(self, start) -> None:
        super().__init__()
        self.entries = nn.Parameter(torch.as_tensor(start, dtype=torch.float64).clone())

    def forward(self, x):
        return self.entries


class MatrixGame(Objective):
    """`a` maximises and `b` minimises `a . X b`, with `X` the sampled states as a matrix."""

    players = {"value": ("value",), "density": ("control_density",)}

    def __init__(self) -> None:
        """No problem, no bounds."""

    def losses(self, fields, samples, phase):
        a, b = fields.value(samples.x), fields.control_density(samples.x)
        payoff = a @ samples.x.reshape(len(a), len(b)) @ b
        return {"value": -payoff, "density": payoff}


class Game:
    """A stepper on `MatrixGame`, the average of its iterates, and all points that counted for it."""

    def __init__(self, stepper, matrices, a=A0, b=B0, rates=(0.1, 0.1), optimizer="sgd", average="none", **options):
        self.fields = Fields({"value": Vector(a), "control_density": Vector(b)})
        self.average, self.counted = averaged(self.fields, average, decay=0.8), []
        makers = {p: optimizer_maker(optimizer, r) for p, r in zip(MatrixGame.players, rates, strict=True)}
        objective, schedule = options.pop("objective", MatrixGame()), schedule_maker("constant", steps=1)
        self.stepper = stepper(self.fields, objective, makers, options.pop("schedule", schedule), **options)
        self.queue = iter(matrices)

    def draw(self, phase) -> Samples:
        return Samples.of(Circle(), torch.as_tensor(next(self.queue)).reshape(-1, 1))

    def step(self):
        report = advance(self.stepper, self.average, self.draw, PHASE)
        self.counted.append(tuple(p.numpy() for p in report.counted))
        return report

    @property
    def point(self):
        return entries(self.fields)


def entries(fields) -> tuple[np.ndarray, np.ndarray]:
    """Copies of both players' parameters."""
    return tuple(f.entries.detach().numpy().copy() for f in (fields.value, fields.control_density))


def batches(count: int) -> list[np.ndarray]:
    """``count`` independent batches of six states on the circle, each as the game's 2 x 3 matrix."""
    return list(np.random.default_rng(0).random((count, 2, 3)))


def gradient(z, X):
    """Of the two losses of `MatrixGame`."""
    return -(X @ z[1]), X.T @ z[0]


def move(z, g, rates, radius):
    """Against the gradients, then onto the ball."""
    moved = [p - rate * slope for p, slope, rate in zip(z, g, rates, strict=True)]
    return tuple(p * min(1.0, radius / np.linalg.norm(p)) for p in moved)


def by_hand(stepper, matrices, rates=(0.1, 0.1), radius=math.inf) -> tuple[list, list]:
    """All iterates, and the points that count for the average: for extragradient, equations (18) and (19)."""
    queue, iterates, counted, z = iter(matrices), [], [], (A0, B0)
    for X in queue:
        if stepper is Simultaneous:
            counted.append(z)
            z = move(z, gradient(z, X), rates, radius)
        else:
            counted.append(move(z, gradient(z, X), rates, radius))
            z = move(z, gradient(counted[-1], next(queue)), rates, radius)
        iterates.append(z)
    return iterates, counted


def assert_close(got, wanted, rtol: float = 1e-11):
    for g, w in zip(got, wanted, strict=True):
        np.testing.assert_allclose(g, w, rtol=rtol, atol=1e-14)


def test_extragradient_converges_on_the_bilinear_game_where_simultaneous_steps_circle_outward():
    lr, steps, sizes = 0.3, 200, {}
    for stepper in (Extragradient, Simultaneous):
        game = Game(stepper, [np.ones((1, 1))] * (2 * steps), [1.0], [1.0], rates=(lr, lr))
        for _ in range(steps):
            game.step()
        sizes[stepper] = np.linalg.norm(np.concatenate(game.point))
    # One step multiplies the plane by a matrix whose eigenvalues have these moduli.
    assert sizes[Extragradient] == pytest.approx(math.sqrt(2) * math.hypot(1 - lr**2, lr) ** steps)
    assert sizes[Simultaneous] == pytest.approx(math.sqrt(2) * math.hypot(1, lr) ** steps)
    assert sizes[Extragradient] < 1e-3 < 1e3 < sizes[Simultaneous]


@both_steppers
def test_a_step_is_the_papers_update_with_projection_fresh_samples_and_each_players_own_rate(stepper):
    matrices, rates, radius = batches(24), (0.4, 0.25), 2.3
    iterates, counted = by_hand(stepper, matrices, rates, radius)
    on_sphere = [math.isclose(np.linalg.norm(p), radius) for z in iterates for p in z]
    assert any(on_sphere)
    assert not all(on_sphere)
    game = Game(stepper, matrices, rates=rates, radius=radius)
    for k, z in enumerate(iterates):
        report = game.step()
        assert_close(game.point, z)
        assert_close(game.counted[k], counted[k])
        assert report.samples == 6 * len(matrices) // len(iterates)


def test_simultaneous_adam_is_adam_for_each_player():
    matrices, z = batches(8), [A0, B0]
    game = Game(Simultaneous, matrices, rates=(0.05, 0.02), optimizer="adam")
    first, second = [np.zeros(2), np.zeros(3)], [np.zeros(2), np.zeros(3)]
    for k, X in enumerate(matrices, start=1):
        for i, g in enumerate(gradient(z, X)):
            first[i], second[i] = 0.9 * first[i] + 0.1 * g, 0.99 * second[i] + 0.01 * g**2
        for i, rate in enumerate((0.05, 0.02)):
            z[i] = z[i] - rate * first[i] / (1 - 0.9**k) / (np.sqrt(second[i] / (1 - 0.99**k)) + 1e-8)
        game.step()
        assert_close(game.point, z)


def test_a_step_reports_the_losses_and_gradient_norms_where_it_began_and_clips_long_gradients_only():
    (X,) = batches(1)
    g = gradient((A0, B0), X)
    norms = [np.linalg.norm(p) for p in g]
    clip = sum(norms) / 2
    game = Game(Simultaneous, [X], clip=clip)
    report = game.step()
    assert_close([float(report.losses[p]) for p in ("value", "density")], [-A0 @ X @ B0, A0 @ X @ B0])
    assert_close([float(report.gradient_norms[p]) for p in ("value", "density")], norms)
    clipped = [p * min(1.0, clip / norm) for p, norm in zip(g, norms, strict=True)]
    # torch divides by the norm plus 1e-6.
    assert_close(game.point, move((A0, B0), clipped, (0.1, 0.1), math.inf), rtol=1e-5)


def test_a_parameter_that_no_loss_depends_on_stays_where_it_is():
    game = Game(Simultaneous, batches(1))
    idle = nn.Parameter(torch.ones(2, dtype=torch.float64))
    game.stepper.parameters["value"].append(idle)
    game.step()
    assert idle.tolist() == [1.0, 1.0]
    assert not np.array_equal(game.point[0], A0)


def test_project_on_ball_scales_all_parameters_as_one_vector():
    pieces = [nn.Parameter(torch.tensor([3.0, 0.0])), nn.Parameter(torch.tensor([[4.0]]))]
    for radius, wanted in ((10.0, [[3.0, 0.0], [[4.0]]]), (2.5, [[1.5, 0.0], [[2.0]]])):
        project_on_ball(pieces, radius)
        assert [p.tolist() for p in pieces] == wanted
    origin = [nn.Parameter(torch.zeros(3))]
    project_on_ball(origin, 1.0)
    assert origin[0].tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(InputError, match="stepper.radius"):
        project_on_ball(pieces, 0.0)


def rates_over(name: str, horizon: int, **options) -> list[float]:
    """The learning rate before each of ``horizon`` + 1 steps, as a factor on the first."""
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule, rates = schedule_maker(name, steps=horizon, **options)(optimizer), []
    for _ in range(horizon + 1):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return rates


def test_the_decay_schedule_takes_a_quarter_off_every_20000_steps():
    rates = rates_over("decay", 40000)
    assert rates[0] == rates[19999] == 1.0
    assert rates[20000] == rates[39999] == 0.75
    assert rates[40000] == 0.75**2


def test_the_cosine_schedule_falls_from_one_towards_zero_and_starts_again_after_its_last_step():
    wanted = [0.5 + 0.5 * math.cos(math.pi * k / 100) for k in range(100)] + [1.0]
    np.testing.assert_allclose(rates_over("cosine", 100), wanted, atol=1e-12)
    assert set(rates_over("constant", 5)) == {1.0}


@both_steppers
def test_every_players_schedule_advances_once_a_step(stepper):
    game = Game(stepper, batches(8), rates=(0.4, 0.2), schedule=schedule_maker("decay", 8, decay=0.5, every=2))
    for factor in (1.0, 0.5, 0.5, 0.25):
        game.step()
        assert game.stepper.learning_rates() == pytest.approx({"value": 0.4 * factor, "density": 0.2 * factor})


@both_steppers
@pytest.mark.parametrize("average", ["uniform", "ema", "none"])
def test_the_average_is_over_the_iterates_that_count(stepper, average):
    matrices = batches(18)
    _, counted = by_hand(stepper, matrices)
    game = Game(stepper, matrices, average=average)
    for _ in counted:
        game.step()
    ema = counted[0]
    for n, z in enumerate(counted[1:], 1):
        kept = min(0.8, (1 + n) / (10 + n))
        ema = [kept * old + (1 - kept) * new for old, new in zip(ema, z, strict=True)]
    uniform = [np.mean(p, axis=0) for p in zip(*counted, strict=True)]
    wanted = {"uniform": uniform, "ema": ema, "none": counted[-1]}[average]
    # torch keeps the uniform weight 1 / n in single precision.
    assert_close(entries(game.average.module), wanted, rtol=1e-7 if average == "uniform" else 1e-11)


@pytest.mark.parametrize(
    ("stepper", "draw"),
    [(Simultaneous, 1), (Extragradient, 2), (Extragradient, 3)],
    ids=["simultaneous", "look-ahead", "step after the look-ahead"],
)
def test_a_non_finite_loss_stops_before_any_parameter_changed(stepper, draw):
    matrices = batches(4)
    matrices[draw][0, 0] = np.nan
    game = Game(stepper, matrices)
    game.step()
    before = game.point
    with pytest.raises(NonFiniteError, match="the loss of player 'value'"):
        game.step()
    for now, then in zip(game.point, before, strict=True):
        np.testing.assert_array_equal(now, then)


class LoneGame(MatrixGame):
    """The value player's half of the game: the density player rests."""

    def losses(self, fields, samples, phase):
        return {"value": super().losses(fields, samples, phase)["value"]}


@both_steppers
def test_a_player_without_a_loss_rests_and_so_does_its_schedule(stepper):
    game = Game(stepper, batches(2), objective=LoneGame(), schedule=schedule_maker("decay", 8, decay=0.5, every=1))
    report = game.step()
    assert report.losses.keys() == {"value"}
    assert not np.array_equal(game.point[0], A0)
    np.testing.assert_array_equal(game.point[1], B0)
    assert game.stepper.learning_rates() == pytest.approx({"value": 0.05, "density": 0.1})


class RootGame(MatrixGame):
    """A finite loss whose gradient is infinite where the first entry of `a` is zero."""

    def losses(self, fields, samples, phase):
        a, b = fields.value(samples.x), fields.control_density(samples.x)
        return {"value": a[0].sqrt(), "density": b.square().sum()}


def test_a_non_finite_gradient_of_a_finite_loss_stops_as_well():
    game = Game(Simultaneous, batches(1), a=[0.0, 1.0], objective=RootGame())
    with pytest.raises(NonFiniteError, match="gradient"):
        game.step()
    np.testing.assert_array_equal(game.point[1], B0)


@pytest.mark.parametrize("betas", [(0.9, 0.95), (0.5, 0.8)])
def test_a_short_fit_moves_as_its_optimiser_with_these_options(betas):
    game = lambda: Fields({"value": Vector(A0), "control_density": Vector(B0)})
    one, other, draws = game(), game(), [Samples.of(Circle(), torch.rand(6, 1, dtype=torch.float64)) for _ in range(4)]
    fit, _ = short_fit(one, MatrixGame(), 1e-2, len(draws), betas=betas)
    makers = dict.fromkeys(MatrixGame.players, optimizer_maker("soap", 1e-2, betas=betas))
    by_hand = Simultaneous(other, MatrixGame(), makers, schedule_maker("cosine", len(draws)))
    for samples in draws:
        fit.step([samples], PHASE)
        by_hand.step([samples], PHASE)
    torch.testing.assert_close(list(one.parameters()), list(other.parameters()), rtol=0.0, atol=0.0)
    usual, _ = short_fit(game(), MatrixGame(), 1e-2, 4)
    assert (
        usual.optimizers["value"].param_groups[0]["betas"] != betas == fit.optimizers["value"].param_groups[0]["betas"]
    )
