"""A good run's folder, and the ways to make its files bad with everything else about them right."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import torch
import yaml

from ocp_torch.runs.finish import controller_of
from ocp_torch.training.checkpoint import MAGIC, SCHEMA, load_checkpoint
from ocp_torch.training.monitor import Observer
from support.looks import certificate
from support.small import small


def make_run(folder: Path, *way: str) -> Path:
    """A finished run: checkpoint, configuration, certificate, controller."""
    trainer = small(*way)
    trainer.fit(Observer(), folder / "checkpoints" / "last.pt")
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump({**trainer.config, "resume": None}))
    (folder / "train.log").write_text("a line\n")
    shown = certificate(trainer.run, 0.1, 0.2)
    shown.save(folder / "certificate.json")
    controller_of(trainer, shown, "value", trainer.averaged_fields).save(folder / "controller.safetensors")
    return folder


def signed(path: Path, state: object) -> None:
    """A checkpoint of ``state`` whose digest is right."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    seal(path, buffer.getvalue())


def seal(path: Path, content: bytes) -> None:
    digest = hashlib.sha256(content).hexdigest()
    path.write_bytes(f"{MAGIC} {SCHEMA} {digest}\n".encode() + content)


def changed(path: Path, where: str, value: object) -> None:
    """The checkpoint ``path`` with ``value`` put at a/b/c."""
    state = load_checkpoint(path)
    target, (*groups, last) = state, where.split("/")
    for group in groups:
        target = target[int(group) if isinstance(target, list) or group.isdigit() else group]
    target[last] = value(target[last]) if callable(value) else value
    signed(path, state)
