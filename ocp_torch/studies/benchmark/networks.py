"""The package's trained fields as contenders: any method with any model, as `scripts/train.py` would train it."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass

from ocp_torch.certificate import CertificateSettings
from ocp_torch.fields import Fields
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.studies.benchmark.curve import Curve, Point, due
from ocp_torch.studies.benchmark.measure import Judge
from ocp_torch.training.monitor import Silent


class Recorder(Silent):
    """Keeps the averaged fields at growing sample counts; `seconds` is CPU time without what keeping them took."""

    def __init__(self) -> None:
        self.due = due(10_000)
        self.next = next(self.due)
        self.kept: list[tuple[int, float, Fields]] = []
        self.started = time.process_time()

    @property
    def seconds(self) -> float:
        return time.process_time() - self.started

    def stepped(self, trainer, report, log: bool) -> None:
        last = trainer.step == trainer.end
        if trainer.samples < self.next and not last:
            return
        before = time.process_time()
        self.kept.append((trainer.samples, self.seconds, copy.deepcopy(trainer.averaged_fields)))
        while self.next <= trainer.samples:
            self.next = next(self.due)
        self.started += time.process_time() - before


@dataclass(frozen=True)
class NetworkContender:
    """``config`` is a resolved training configuration; the method and the model are read from it."""

    config: dict

    @property
    def name(self) -> str:
        return f"{self.config['model']['name']} {self.config['method']['name']}"

    def run(self, seed: int, judge: Judge, certificate: CertificateSettings | None) -> Curve:
        """Train with the default budget; the certificate at the end, if there is one, is the configuration's."""
        trainer = build_trainer({**self.config, "seed": seed})
        recorder = Recorder()
        trainer.fit(recorder)
        judge = Judge(trainer.problem, trainer.constants, judge.seed, judge.effort)
        occupation = trainer.objective.occupation
        points = [Point(samples, seconds, judge(fields, occupation)) for samples, seconds, fields in recorder.kept]
        if certificate is None:
            return Curve(self.name, seed, points)
        started = time.process_time()
        certified = trainer.certify(build_certificate_settings(trainer.config))
        return Curve(self.name, seed, points, certified.gap["certified"], time.process_time() - started)
