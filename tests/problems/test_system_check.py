"""Mistakes in a system are told in one sentence, with the method's name and the state in the user's own units."""

import numpy as np
import pytest
import torch

from ocp_torch import Angle, Interval, System
from ocp_torch.errors import InputError, ProblemError
from ocp_torch.problems.blame import blamed
from ocp_torch.problems.checks.check import check_once
from ocp_torch.problems.samples import Samples


class Sound(System):
    def __init__(self):
        super().__init__([Angle("pole"), Interval("place", -1, 1, "m")], ["push [N]"])

    def cost(self, s):
        return 1.0 - s[:, 0].cos() + s[:, 1] ** 2

    def dynamics(self, s):
        pole, place = s.unbind(-1)
        a = torch.stack([place, pole.sin()], dim=-1)
        return a, torch.stack([torch.zeros_like(pole), torch.ones_like(pole)], dim=-1).unsqueeze(-1)


def mistaken(**methods):
    return type("Mistaken", (Sound,), {"__module__": "my_module", **methods})


def pushed(a=lambda s: s, B=lambda s: torch.ones_like(s).unsqueeze(-1)):
    return lambda self, s: (a(s), B(s))


MISTAKES = {
    "negative": (
        dict(cost=lambda self, s: s[:, 1] ** 2 - 0.5),
        r"^cost of my_module.Mistaken is -0.5 at pole = \S+ rad, place = -?\d\S* m, but must be at least 0; a constant",
    ),
    "column": (
        dict(cost=lambda self, s: s[:, 1:] ** 2),
        r"cost of my_module.Mistaken gave shape \(7, 1\) for states of shape \(7, 2\), but must give \(N,\) = \(7,\)",
    ),
    "no cost": (dict(cost=lambda self, s: None), "cost of my_module.Mistaken gave a NoneType"),
    "one of two": (
        dict(dynamics=lambda self, s: s),
        "dynamics of my_module.Mistaken gave a Tensor, but must give two tensors",
    ),
    "a": (
        dict(dynamics=pushed(a=lambda s: s[:, :1])),
        r"a of dynamics of my_module.Mistaken gave shape \(7, 1\) .* but must give \(N, d\) = \(7, 2\)",
    ),
    "B": (
        dict(dynamics=pushed(B=lambda s: torch.ones_like(s))),
        r"B of dynamics of my_module.Mistaken gave shape \(7, 2\) .* but must give \(N, d, m\) = \(7, 2, 1\)",
    ),
    "sigma": (
        dict(disturbance=lambda self, s: torch.ones_like(s)),
        r"disturbance of my_module.Mistaken gave shape \(7, 2\) .* but must give \(N, d, k\)",
    ),
    "precision": (
        dict(dynamics=pushed(B=lambda s: torch.ones(len(s), 2, 1))),
        "B of dynamics of my_module.Mistaken gave torch.float32 on cpu for states in torch.float64",
    ),
    "margin": (
        dict(cost=lambda self, s: 2.0 - (1.1 - s[:, 1]).sqrt()),
        r"cost of my_module.Mistaken gives nan at pole = \S+ rad, place = 1\.[12]\d* m, but must be finite in the box",
    ),
    "angle": (
        dict(dynamics=pushed(a=lambda s: s)),
        r"a of dynamics of my_module.Mistaken changes by 6.28 when pole goes on by a turn of 6.28319 rad, at pole = .*, but "
        "an angle has no preferred turn: use its sine and cosine",
    ),
    "angle in the cost": (dict(cost=lambda self, s: s[:, 0] ** 2), "cost of my_module.Mistaken changes by"),
    "raises": (
        dict(cost=lambda self, s: s[:, 0] + torch.ones(3, 4)),
        r"cost of my_module.Mistaken raised RuntimeError: .* at states of shape \(7, 2\)",
    ),
    "divergences": (
        dict(divergences=lambda self, s: (s[:, 0], torch.zeros_like(s[:, :1]))),
        r"drift_divergence of my_module.Mistaken is \S+ at pole = .*, but by differences of drift it is 0",
    ),
    "lost derivative": (
        dict(dynamics=pushed(a=lambda s: torch.stack([s[:, 1], -0.05 * s[:, 1].detach()], dim=-1))),
        r"drift_divergence of my_module.Mistaken is 0 at pole = .*, but by differences of drift it is -0.05",
    ),
    "in place": (
        dict(cost=lambda self, s: s[:, 1].mul_(2.0).square()),
        r"cost of my_module.Mistaken changes its argument s in place; .* \(s = s.clone\(\) first\)",
    ),
    "dynamics in place": (
        dict(dynamics=pushed(a=lambda s: s[:, 1:].mul_(2.0).sin().expand(-1, 2))),
        "dynamics of my_module.Mistaken changes its argument s in place",
    ),
    "NumPy": (
        dict(cost=lambda self, s: np.square(s[:, 1])),
        "cost of my_module.Mistaken raised RuntimeError: NumPy was given a tensor; use the functions of torch",
    ),
    "no derivative": (
        dict(cost=lambda self, s: 1.0 + s[:, 1] ** 2 + torch.floor_divide(s[:, 1], 0.3).cos()),
        r"cost of my_module.Mistaken cannot be differentiated by the state, .* \(RuntimeError: derivative for "
        r"aten::floor_divide is not implemented\): use functions that have a derivative in torch",
    ),
    "noise by another name": (
        dict(distrubance=lambda self, s: torch.ones_like(s).unsqueeze(-1)),
        "^my_module.Mistaken defines distrubance, which nothing asks for; did you mean disturbance?",
    ),
    "nothing made": (
        dict(__init__=lambda self: None),
        r"its __init__ must call super\(\).__init__\(coordinates, controls, ..\)",
    ),
    "random": (
        dict(cost=lambda self, s: torch.rand(len(s), dtype=s.dtype)),
        "cost of my_module.Mistaken is no function of the state alone",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_in_the_words_of_the_user(name):
    methods, says = MISTAKES[name]
    with pytest.raises(ProblemError, match=says) as told:
        check_once(mistaken(**methods)())
    assert str(told.value).count(". ") == 0  # one sentence


def test_a_sound_one_passes():
    check_once(Sound())


def test_helpers_may_be_called_almost_as_what_is_there_and_anything_with_an_underscore():
    helper = lambda self, s: s
    check_once(mistaken(costs=helper, _disturbances=helper, gust=helper)())


@pytest.mark.parametrize("wrapped", [lambda f: f, property, torch.no_grad()])
def test_helpers_that_the_class_itself_asks_for_may_be_called_anything(wrapped):
    called = wrapped(lambda self: [self.disturbances(s) for s in ()])
    check_once(mistaken(disturbances=lambda self, s: s, gusts=called)())


@pytest.mark.parametrize(("method", "says"), [("cost", "define cost"), ("dynamics", "define dynamics")])
def test_what_is_left_out_is_asked_for(method, says):
    with pytest.raises(InputError, match=f"must {says}"):
        check_once(mistaken(**{method: getattr(System, method)})())


def test_what_fails_late_is_told_with_the_state_in_its_units():
    """Where a function raises at a few states only, which no check met."""

    def cost(self, s):
        if bool((s[:, 1] > 0.999).any()):
            raise ValueError("too far")
        return s[:, 1] ** 2

    system = mistaken(cost=cost)()
    x = system.to_torus(torch.tensor([[0.0, 0.0], [1.0, 0.9995]], dtype=torch.float64))
    with pytest.raises(ValueError, match="too far") as raised:
        Samples.of(system, x)
    told = str(blamed(raised.value.with_traceback(raised.tb.tb_next), type(system)))
    assert "cost of" in told
    assert "raised ValueError: too far at pole = 1 rad, place = 0.9995 m" in told
