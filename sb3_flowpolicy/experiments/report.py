"""One self-contained page from all results."""

from __future__ import annotations

import base64
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.experiments.experiment import NOT_MEASURED
from sb3_flowpolicy.experiments.section import METHOD, Section, png, read_results

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_report(results: Path, page: Path) -> Path:
    """Write one HTML page that needs nothing else, neither files nor network.

    Args:
        results: Folder that ``run`` wrote.
        page: File to write.

    Returns:
        The page.

    Raises:
        ValueError: If there are no results, or a file is corrupt.
        ModuleNotFoundError: If plotly is missing.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'the report needs plotly: pip install "sb3_flowpolicy[experiments]"'
        ) from error
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("sb3_flowpolicy.experiments", package_path="")
    templates = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    sections = [Section(evidence) for evidence in read_results(results)]
    text = templates.get_template("report.html").render(
        sections=sections,
        method=METHOD,
        not_measured=NOT_MEASURED,
        pictures={s.experiment.name: _inline(s.pictures()) for s in sections},
        date=datetime.now(timezone.utc).date().isoformat(),
        # It closes no script element of its own, but other people's data might.
        plotly=get_plotlyjs(),
    )
    page.parent.mkdir(parents=True, exist_ok=True)
    write_text(page, text)
    return page


def _inline(figures: dict[str, Figure]) -> dict[str, str]:
    """Return pictures as addresses that hold them; curves are there interactively."""
    return {
        name: "data:image/png;base64," + base64.b64encode(png(figure, dpi=90)).decode()
        for name, figure in figures.items()
        if name in ("outcomes", "policies")
    }
