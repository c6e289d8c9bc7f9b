"""Figures of results by matplotlib, and what a notebook shows of them."""

from __future__ import annotations

import base64
import html as escaping
import io
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .records import Change, Finding, Var

COLOURS = ("#9aa5b1", "#1f5fa8")
VARS = 3.2  # inches, height of a figure of vars
MOST = 8  # causes that are shown


class Drawn(Figure):
    """A figure that a notebook shows, apart from pyplot, which would show it twice."""

    def _repr_png_(self) -> bytes:
        drawn = io.BytesIO()
        self.savefig(drawn, format="png", dpi=90)
        return drawn.getvalue()


def html(result: Any) -> str:
    """The text that the program prints, and the main figure."""
    data = base64.b64encode(result.figure()._repr_png_()).decode()
    text = escaping.escape(str(result))
    return f'<pre style="line-height: 1.2">{text}</pre><img alt="" src="data:image/png;base64,{data}"/>'


def of_vars(fits: dict[str, list[Var]], title: str) -> Drawn:
    """Vars with their 68 % (thick) and 95 % intervals, one colour a fit."""
    figure, (axes,) = _axes([VARS], len(next(iter(fits.values()))))
    _vars(axes, fits)
    axes.set_title(title)
    return figure


def of_findings(findings: list[Finding], fits: dict[str, list[Var]], title: str) -> Drawn:
    """Probabilities of the causes above, vars below, one colour a fit."""
    causes = [(one, other) for one in findings for other in (one, *one.alternatives)]
    has_causes = any(cause.probability is not None for _, cause in causes)
    count = max((len(vars) for vars in fits.values()), default=12)
    heights = [0.7 + 0.3 * min(MOST, len(causes))] if has_causes else []
    figure, axes = _axes([*heights, VARS], count)
    if has_causes:
        _causes(axes[0], causes)
    _vars(axes[-1], fits)
    axes[0].set_title(title)
    return figure


def of_changes(changes: list[Change]) -> Drawn:
    """Changes of the vars with their 68 % error bars; those too large for chance in colour."""
    figure, (axes,) = _axes([VARS], len(changes))
    for is_changed, colour, word in [(False, COLOURS[0], "within chance"), (True, COLOURS[1], "changed")]:
        own = [(i, one) for i, one in enumerate(changes) if one.changed == is_changed]
        if own:
            _bars(axes, own, colour, word)
    axes.axhline(0, color="black", linewidth=0.6)
    _names(axes, [one.name for one in changes])
    axes.set_ylabel("change / %")
    axes.legend(frameon=False)
    return figure


def _bars(axes: Axes, own: list[tuple[int, Change]], colour: str, word: str) -> None:
    at, changes = zip(*own)
    values = [100 * one.relative for one in changes]
    sigmas = [100 * one.sigma for one in changes]
    axes.errorbar(at, values, sigmas, fmt="o", markersize=3, color=colour, label=word)


def _vars(axes: Axes, fits: dict[str, list[Var]]) -> None:
    for place, (name, vars) in enumerate(fits.items()):
        offset = 0.25 * (place - (len(fits) - 1) / 2)
        at = np.arange(len(vars)) + offset
        colour = COLOURS[-len(fits) :][place]
        of = lambda word: np.array([getattr(one, word) for one in vars])
        axes.vlines(at, of("q025"), of("q975"), color=colour, linewidth=0.8)
        axes.vlines(at, of("q16"), of("q84"), color=colour, linewidth=2.4)
        axes.plot(at, of("mean"), "o", markersize=3, color=colour, label=name)
    axes.axhline(1, color="black", linewidth=0.6)
    _names(axes, [one.name for one in next(iter(fits.values()), [])])
    axes.set_ylabel("strength factor")
    if len(fits) > 1:
        axes.legend(frameon=False)


def _causes(axes: Axes, causes: list[Any]) -> None:
    shown = [(one, cause) for one, cause in causes if (cause.probability or 0) > 1e-3][:MOST]
    words = [f"{cause.kind} {cause.at or ''}" for _, cause in shown]
    values = [cause.probability for _, cause in shown]
    colours = [COLOURS[1] if one is cause else COLOURS[0] for one, cause in shown]
    axes.barh(np.arange(len(shown)), values, color=colours)
    axes.set_yticks(np.arange(len(shown)), words)
    axes.invert_yaxis()
    axes.set_xlim(0, 1)
    axes.set_xlabel("probability")


def _axes(heights: list[float], names: int) -> tuple[Drawn, list[Axes]]:
    figure = Drawn(figsize=(min(14, max(6, 0.2 * names)), sum(heights)), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(len(heights), 1, height_ratios=heights)))


def _names(axes: Axes, names: list[str]) -> None:
    axes.set_xticks(np.arange(len(names)), names, rotation=90, fontsize=7)
    axes.set_xlim(-0.7, len(names) - 0.3)
