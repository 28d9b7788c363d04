"""Steps that are replayed do what steps that are called do, and nothing in them waits for the device."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from ocp_torch.compute.cuda_graphs import CudaGraphs, CudaRecorder
from ocp_torch.problems import PROBLEMS
from ocp_torch.steppers import advance, optimizer_maker
from ocp_torch.steppers.soap import ReplayedSOAP
from support.rerun import Rerun
from support.small import METHODS, small
from support.waiting import Waits

pytestmark = pytest.mark.usefixtures("quick_composition")


def replays(trainer):
    recorder = CudaRecorder() if trainer.settings.torch_device.type == "cuda" else Rerun()
    trainer.stepper.replay, trainer.batches.replay = CudaGraphs(recorder), CudaGraphs(recorder)
    return trainer


def steps(trainer, count):
    for _ in range(count):
        advance(trainer.stepper, trainer.state.average, trainer.batches.draw, trainer.phase)
        trainer.state.step += 1
    return trainer


def weights(trainer):
    return torch.cat([p.detach().flatten().cpu() for p in trainer.state.average.parameters()])


VARIANTS = {
    **METHODS,
    "extragradient": ("method=pd", "stepper=extragradient"),
    "no M is known": ("problem=unicycle", "problem.heading_noise=0.3", "problem.position_noise=0.05", "method=pd"),
    "noise in one coordinate": ("problem=pendulum", "problem.torque_noise=0.1", "method=dual"),
    "importance": ("method=dual", "sampler=importance", "sampler.every=4", "sampler.pool=64"),
    "clipped": ("method=pd", "stepper.clip=0.5"),
}


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_replayed_steps_are_steps(variant, device):
    """With Adam: eigenbases of the first few gradients, which SOAP takes, are decided by rounding."""
    options = (*variant, "optimizer=adam", "trainer.dtype=float64", "trainer.steps=24", f"trainer.device={device.type}")
    plain, replayed = small(*options, "trainer.graphs=false"), replays(small(*options))
    for count in (3, 9):
        found, wanted = weights(steps(replayed, count)), weights(steps(plain, count))
        torch.testing.assert_close(found, wanted, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("variant", ["pd", "no M is known"])
def test_a_run_of_replays_resumes_to_the_same_bits(variant, device):
    options = (*VARIANTS[variant], "trainer.steps=24", f"trainer.device={device.type}")
    whole, first, second = (replays(small(*options)) for _ in range(3))
    steps(whole, 24)
    second.state.load_state_dict(steps(first, 13).state.state_dict(), second.settings)
    assert torch.equal(weights(steps(second, 11)), weights(whole))


def test_a_state_is_loaded_over_what_was_captured(device):
    options = ("method=dual", "trainer.steps=24", f"trainer.device={device.type}")
    trainer = steps(replays(small(*options)), 9)
    state = copy.deepcopy(trainer.state.state_dict())
    once = weights(steps(trainer, 8))
    trainer.state.load_state_dict(state, trainer.settings)
    assert torch.equal(weights(steps(trainer, 8)), once)


def test_replayed_soap_is_soap(device):
    """In steps of any rate, over several changes of the eigenbases."""
    start = [torch.randn(6, 4, generator=torch.Generator().manual_seed(1)).double(), torch.ones(5).double()]
    goals = [torch.randn(p.shape, generator=torch.Generator().manual_seed(2)).double().to(device) for p in start]
    ways = []
    for replay in (None, CudaGraphs(CudaRecorder() if device.type == "cuda" else Rerun())):
        own = [nn.Parameter(p.clone().to(device)) for p in start]
        optimizer = optimizer_maker("soap", 0.1, precondition_frequency=3)(own)
        assert isinstance(optimizer, ReplayedSOAP)
        if replay is not None:
            optimizer.replay = replay
        way = []
        for k in range(20):
            optimizer.param_groups[0]["lr"] = 0.1 * math.cos(0.1 * k)
            for p, goal in zip(own, goals, strict=True):
                p.grad = (p - goal).detach() + 0.1 * torch.sin(7.0 * k + p.detach())
            optimizer.step()
            way.append(torch.cat([p.detach().flatten() for p in own]).clone())
        ways.append(torch.stack(way))
    exact = 1e-9 if device.type == "cpu" else 1e-5  # eigenbases are found in float32: as good, and on a GPU others
    torch.testing.assert_close(ways[1], ways[0], rtol=exact, atol=exact)


QUICK = ("circle", "pendulum", "unicycle", "manufactured")
SLOWER = [
    pytest.param(name, marks=pytest.mark.nightly) for name in PROBLEMS if name not in (*QUICK, "dataset", "robot")
]


@pytest.mark.parametrize("name", [*QUICK, *SLOWER])
def test_nothing_in_a_step_waits_for_the_device(name, monkeypatch):
    """Whoever asks a number does so by `decided`, whose answers are checked after the fact."""
    monkeypatch.setattr("ocp_torch.fields.waves.MOST_SUMS", 10_000)  # which waves a network is given is no part of this
    trainer = small(f"problem={name}", "method=pd", "sampler.visited=0.25")
    replays(trainer)
    for progress in (0.0, 1.0):
        phase = replace(trainer.phase, progress=progress)
        for _ in range(3):
            samples = trainer.batches.draw(phase)
            trainer.stepper._differentiate(samples, phase)
        with Waits() as waits:
            for graph in [*trainer.batches.replay._functions.values(), *trainer.stepper.replay._functions.values()]:
                graph.replay()
        assert waits.seen == set()
