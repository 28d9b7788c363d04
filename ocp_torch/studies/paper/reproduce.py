"""Everything in the paper's numerical sections, one after the other, into one folder."""

import json
import logging
import time
from dataclasses import asdict
from pathlib import Path

import torch
from tqdm import tqdm

from ocp_torch.errors import InputError, require_choice, require_integer, require_section
from ocp_torch.files.storage import write_atomically
from ocp_torch.studies.benchmark.measure import median_and_spread
from ocp_torch.studies.paper import figures
from ocp_torch.studies.paper.runs import NOISE, RECIPES, Comparison, History, carry_out, compare_with_exact, truth

log = logging.getLogger(__name__)


def check(config: dict) -> tuple[tuple[int, ...], int, dict[str, int]]:
    """Seeds, modes and the lengths of the comparisons with the exact kernel, from ``config``; `InputError` if wrong."""
    seeds = config["seeds"]
    if not isinstance(seeds, list) or not seeds:
        raise InputError(f"seeds is {seeds!r}, but must be a list of whole numbers, as in [0,1,2].")
    modes = require_integer("modes", config["modes"], 1, maximum=4096)
    exact = require_section("exact_steps", config["exact_steps"])
    for name in exact:
        require_choice("exact_steps", name, RECIPES)
    for name in RECIPES:
        require_integer(f"exact_steps.{name}", exact.get(name), 1, maximum=min(20000, RECIPES[name].steps))
    return tuple(require_integer("seeds", seed, 0) for seed in seeds), modes, exact


def reproduce(checked: tuple[tuple[int, ...], int, dict[str, int]], folder: Path) -> None:
    """Write `figures/*.png`, `numbers.md` and `numbers.json` under ``folder``; ``checked`` is what `check` gave."""
    seeds, modes, exact = checked
    torch.set_num_threads(1)
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    histories: dict[str, History] = {}
    comparisons = []
    total = sum(r.steps for r in RECIPES.values()) + 2 * sum(exact.values())
    with tqdm(total=total, unit="step", dynamic_ncols=True, disable=None) as bar:
        for name, recipe in RECIPES.items():
            bar.set_postfix_str(name)
            histories[name] = carry_out(recipe, seeds, modes, bar.update)
        for name, recipe in RECIPES.items():
            bar.set_postfix_str(f"{name}, exact kernel")
            comparisons.append(compare_with_exact(recipe, exact[name], modes, seeds[0], tick=bar.update))
    text = report(histories, comparisons, seeds, modes) + f"\nIn all {time.perf_counter() - started:.0f} s.\n"
    write_atomically(folder / "numbers.md", lambda path: path.write_text(text))
    numbers = {name: history.numbers for name, history in histories.items()}
    record = {"numbers": numbers, "comparisons": [asdict(c) for c in comparisons]}
    write_atomically(folder / "numbers.json", lambda path: path.write_text(json.dumps(record, indent=1) + "\n"))
    drawn = {"mu_star": figures.optimal_occupation(), "cost_per_step": figures.costs(comparisons)}
    for name, history in histories.items():
        drawn |= {f"{name}_performance": figures.evolution(history), f"{name}_iterates": figures.iterates(history)}
    for name, figure in drawn.items():
        figure.savefig(folder / "figures" / f"{name}.png", dpi=130)
    log.info("\n%s\nwritten to %s", text, folder)


def report(histories: dict[str, History], comparisons: list[Comparison], seeds: tuple[int, ...], modes: int) -> str:
    """The numbers as Markdown, beside those of an independent re-implementation of the paper."""
    lines = [
        f"Circle, rho = 2, M = 2, C_V = 2; regularity 2, {modes} modes; averages; seeds {', '.join(map(str, seeds))}.",
        f"dual_noise: noise {NOISE:g}, regularity 3; OPT = {truth(NOISE).optimum:.9g}, and Perf, from grids.",
        "Per cent above (+) or below (-) OPT: median [smallest, largest] over seeds. The re-implementation's ranges are over "
        "three seeds of its own; a single pass depends on its samples, so that the two need not coincide.",
        "",
        "| method | steps | number | here | re-implementation |",
        "|---|---|---|---|---|",
    ]
    for name, history in histories.items():
        for look, known in history.recipe.known.items():
            for number in history.recipe.numbers:
                middle, low, high = median_and_spread([m[number] for m in history.numbers[look]])
                there = f"{known[number][0]:+g} to {known[number][1]:+g}" if number in known else ""
                label = {"value": "Perf, from V", "density": "Perf, w / mu"}.get(number, number)
                lines.append(f"| {name} | {look:,} | {label} | {middle:+.3f} [{low:+.3f}, {high:+.3f}] | {there} |")
    lines += ["", "Exact kernel and truncation on the same samples, averaged iterates:", ""]
    lines += ["| method | steps | field | largest relative difference |", "|---|---|---|---|"]
    for c in comparisons:
        lines += [f"| {c.method} | {c.steps:,} | {field} | {d:.1e} |" for field, d in c.differences.items()]
    lines += ["", "CPU time per step, in microseconds:", ""]
    lines += ["| method | form | up to n = | | up to n = | |", "|---|---|---|---|---|---|"]
    for c in comparisons:
        for form, points in c.costs.items():
            cells = [f"{n:,} | {1e6 * seconds:.0f}" for n, seconds in (points[0], points[-1])]
            lines.append(f"| {c.method} | {form} | {' | '.join(cells)} |")
    lines += ["", "CPU seconds:", "", "| part | training, all seeds at once | measuring |", "|---|---|---|"]
    for name, h in histories.items():
        lines.append(f"| {name}, {h.recipe.steps:,} steps | {h.train_seconds:.1f} | {h.measure_seconds:.1f} |")
    return "\n".join(lines) + "\n"
