"""The picture of a cost curve: what a part costs under each LB, a line an alpha, beside verifying everything.

save(cost_picture(curve), "out/costs.png")
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .cost_curve import CostCurve, PolicyCost
from .look import BLACK, LIMIT, RECIPES, legend_above, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = "osD^vP"
APART = 0.08  # of the distance between two LBs: the alphas' whiskers side by side
ROOM = 1.25  # above the highest mean


def cost_picture(curve: CostCurve, title: str = "", unit: str = "s") -> Figure:
    """Above: cost a part with its interval, and what verifying everything costs; the choice has a ring. Below: shares of
    parts that were decided without a check. unit : of the costs.
    """
    figure, (top, bottom) = panels(2, (9.0, 7.2), heights=(3, 2))
    bounds = sorted({row.policy.lower_bound for row in curve.rows})
    alphas = sorted({row.policy.alpha for row in curve.rows}, reverse=True)
    top.axhline(curve.baseline, label="verify everything", **LIMIT)
    for i, alpha in enumerate(alphas):
        rows = [row for row in curve.rows if row.policy.alpha == alpha]
        x = np.array([bounds.index(row.policy.lower_bound) for row in rows]) + APART * (i - (len(alphas) - 1) / 2)
        _draw(top, bottom, x, rows, RECIPES[i % len(RECIPES)], MARKERS[i % len(MARKERS)])
        if curve.policy is not None and curve.policy.alpha == alpha:
            at = next(j for j, row in enumerate(rows) if row.policy == curve.policy)
            ring: dict[str, Any] = {"s": 260, "facecolors": "none", "edgecolors": BLACK, "linewidths": 1.6, "zorder": 5}
            top.scatter(x[at], rows[at].cost, label=f"the choice: {curve.verdict}", **ring)
    means = [row.cost for row in curve.rows]
    top.set(ylim=(min(0.0, *means), ROOM * max(curve.baseline, *means)), ylabel=f"cost a part [{unit}]")
    bottom.set(
        ylim=(0, max(10.0, 110 * max(row.certain for row in curve.rows))), ylabel="decided without a check\n[% of parts]"
    )
    bottom.set_xticks(range(len(bounds)), [f"{100 * bound:g}" for bound in bounds])
    bottom.set_xlabel("LB [% of accepted parts that are to be good]")
    for axes in (top, bottom):
        legend_above(axes, columns=len(alphas) + 2)
    figure.suptitle(title or _title(curve, unit))
    return figure


def _title(curve: CostCurve, unit: str) -> str:
    costs = curve.costs
    what = f"check {costs.check:g} {unit}, escape {costs.escape:g} {unit}, false reject {costs.false_reject:g} {unit}"
    how = "bars: errors at the ends of their 95 % intervals"
    return f"{curve.dataset}, {curve.recipe}: {what}\n{curve.reporting} shuffles of {curve.cycles} parts; {how}"


def _draw(top: Axes, bottom: Axes, x: np.ndarray, rows: Sequence[PolicyCost], colour: str, marker: str) -> None:
    cost = np.array([row.cost for row in rows])
    ends = np.array([[row.cost - row.lower for row in rows], [row.upper - row.cost for row in rows]])
    label = f"alpha {rows[0].policy.alpha:g}"
    look: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 6}
    # A replay's mean lies within what its errors' intervals allow, but for rounding.
    top.errorbar(x, cost, yerr=np.maximum(ends, 0.0), capsize=3, elinewidth=1.0, label=label, **look)
    bottom.plot(x, [100 * row.certain for row in rows], label=label, **look)
