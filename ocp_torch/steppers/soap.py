"""SOAP of `pytorch_optimizer`, with steps that can be replayed (see `ocp_torch.compute.cuda_graphs`)."""

import math
from collections.abc import Callable
from typing import Any

import torch
from pytorch_optimizer import SOAP
from torch import Tensor

from ocp_torch.compute.cuda_graphs import Eager
from ocp_torch.compute.threads import side_by_side


class ReplayedSOAP(SOAP):
    """`SOAP`, whose moves may go through ``replay``: the learning rate, with its correction for a short memory, is then an
    input of a move, and new eigenbases are found after moves, every so many steps. The arithmetic is that of `SOAP`."""

    replay = Eager()
    _keeps_bases = False  # during a move

    @torch.no_grad()
    def step(self, closure: Callable | None = None) -> Any:
        if not self.replay.captures:
            return super().step(closure)
        (group,) = self.param_groups
        self.init_group(group)
        group["step"] += 1
        steps = group["step"] - 1
        if not steps:
            return None
        first, second = group["betas"]
        rate = group["lr"] * math.sqrt(self.debias(second, steps)) / self.debias(first, steps)
        moved = [p for p in group["params"] if p.grad is not None]
        inputs = [self.replay.number(rate, moved[0]), *(p.grad for p in moved)]
        self.replay("optimizer", self._move, inputs, pure=False)
        if steps % group["precondition_frequency"] == 0:
            refresh = torch.no_grad()(lambda p: self._refresh(self.state[p], group))  # each thread decides for itself
            side_by_side(refresh, moved)
        return None

    def _move(self, rate: Tensor, *gradients: Tensor) -> list[Tensor | None]:
        """Make the library's step at the learning rate 1, and multiply it by ``rate``."""
        (group,) = self.param_groups
        moved = [p for p in group["params"] if p.grad is not None]
        own = [p.grad for p in moved]
        kept = {name: group[name] for name in ("lr", "correct_bias", "step")}
        before = [p.clone() for p in moved]
        group.update(lr=1.0, correct_bias=False, step=1)
        self._keeps_bases = True
        try:
            for p, gradient in zip(moved, gradients, strict=True):
                p.grad = gradient
            SOAP.step(self)
        finally:
            self._keeps_bases = False
            group.update(kept)
            for p, gradient in zip(moved, own, strict=True):
                p.grad = gradient
        torch._foreach_sub_(moved, before)
        torch._foreach_mul_(moved, rate)
        torch._foreach_add_(moved, before)
        return []

    def project(self, grad: Tensor, state: Any, *options: Any, **named: Any) -> Tensor:
        """The projection of `SOAP`; of matrices by products that copy nothing, in two thirds of the time."""
        if grad.dim() != 2 or not all(map(len, state["Q"])):
            return super().project(grad, state, *options, **named)
        left, right = state["Q"]
        back = named.get("project_type") == "backward"
        return left @ grad @ right.T if back else left.T @ grad @ right

    def update_pre_conditioner(self, grad: Tensor, state: Any, step: int, *sizes: Any, **named: Any) -> None:
        """The update of `SOAP`; of matrices by one product for each side, in half the time."""
        if grad.dim() != 2 or not all(map(len, state["GG"])) or named.get("merge_dims"):
            return super().update_pre_conditioner(grad, state, step, *sizes, **named)
        kept = state["shampoo_beta"]
        for gram, one in zip(state["GG"], (grad, grad.T), strict=True):
            gram.addmm_(one, one.T, beta=kept, alpha=1.0 - kept)
        if state["Q"] is None:
            state["Q"] = self.get_orthogonal_matrix(state["GG"])
        elif step % state["precondition_frequency"] == 0:
            state["Q"] = self.get_orthogonal_matrix_qr(state)

    def get_orthogonal_matrix_qr(self, state: dict, *options: Any) -> list:
        """The eigenbases of `SOAP`; during a move, the present ones."""
        return state["Q"] if self._keeps_bases else super().get_orthogonal_matrix_qr(state, *options)

    def _refresh(self, state: dict, group: dict) -> None:
        """Write new eigenbases over the old ones. They are found on the CPU: a matrix of 128 rows takes .45 ms there, copies
        included, and .80 on an H200."""
        host = {name: _on_cpu(state[name]) for name in ("GG", "Q", "exp_avg_sq")}
        bases = self.get_orthogonal_matrix_qr(host, group["max_precondition_dim"], group["merge_dims"])
        state["exp_avg_sq"].copy_(host["exp_avg_sq"])
        for old, new in zip(state["Q"], bases, strict=True):
            if len(old):
                old.copy_(new)

    def load_state_dict(self, state_dict: dict) -> None:
        super().load_state_dict(state_dict)
        self.replay.forget()  # what was captured reads the tensors of before


def _on_cpu(value: Any) -> Any:
    """The tensors in ``value``, of lists too, on the CPU."""
    return value.cpu() if isinstance(value, Tensor) else [_on_cpu(v) for v in value]
