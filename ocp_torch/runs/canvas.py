"""An empty Matplotlib figure, and figures as files. Matplotlib takes half a second of CPU to import: only to draw."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ocp_torch.files.storage import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:
    Figure = Any


def blank_figure(width: float, height: float, **options) -> Figure:
    """A figure of so many inches that needs no screen; ``options`` are those of `matplotlib.figure.Figure`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", **options})
    FigureCanvasAgg(figure)
    return figure


def save(figures: dict[str, Figure], folder: Path) -> None:
    """Write `<name>.png` of each in ``folder``."""
    for name, figure in figures.items():
        write_atomically(folder / f"{name}.png", partial(figure.savefig, dpi=120, format="png"))
