"""Our SOAP does what its library's does, in other operations."""

import copy

import pytest
import torch
from pytorch_optimizer import SOAP

from ocp_torch.steppers.soap import ReplayedSOAP


@pytest.mark.parametrize("largest", [10000, 4])
@pytest.mark.parametrize("shape", [(6, 3), (3, 6), (1, 5), (4, 4), (5,)], ids=str)
def test_preconditioners_are_the_librarys(shape, largest):
    generator = torch.Generator().manual_seed(0)
    draw = lambda: torch.randn(shape, generator=generator, dtype=torch.float64)
    weight, options = draw().requires_grad_(True), dict(precondition_frequency=3, max_precondition_dim=largest)
    own, librarys = ReplayedSOAP([weight], **options), SOAP([weight], **options)
    weight.grad = draw()
    own.init_group(own.param_groups[0])
    mine = own.state[weight]
    theirs = copy.deepcopy(mine)  # eigenvectors of the first gradients, many of whose eigenvalues are 0, are arbitrary
    for step in range(1, 8):
        gradient, before = draw(), mine["Q"]
        for optimizer, state in ((own, mine), (librarys, theirs)):
            optimizer.update_pre_conditioner(gradient, state, step=step, max_precondition_dim=largest)
        assert [len(gram) for gram in mine["GG"]] == [len(gram) for gram in theirs["GG"]]
        for name in ("GG", "Q"):
            for one, other in zip(mine[name], theirs[name], strict=True):
                if len(other):
                    torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)
        assert (mine["Q"] is before) == bool(step % 3)
    forth = own.project(gradient, mine, max_precondition_dim=largest)
    torch.testing.assert_close(forth, librarys.project(gradient, mine, max_precondition_dim=largest))
    back = own.project(forth, mine, max_precondition_dim=largest, project_type="backward")
    torch.testing.assert_close(back, gradient, rtol=1e-5, atol=1e-5)
