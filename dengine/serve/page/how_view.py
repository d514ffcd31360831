"""What is shown of how the engine is doing: counts, bounds, drift, retrains and events."""

from __future__ import annotations

from dataclasses import dataclass

from ...decision.policy import Policy
from ...decision.rule import SAFE_MODE
from ...standing import Course, Standing, Watch, course, standing, watch
from ...store.records import Event
from ...store.views import PastRetrain
from .looking import Looking

NEWEST = 500  # parts that are looked at apart
PACE = 30  # newest parts, by which parts an hour are counted
EVENTS = 12


@dataclass(frozen=True)
class HowView:
    """How it is doing.

    course : None before the first decision.  pace : parts an hour, None before the second.
    retrained : the newest accepted retrain.
    """

    doing: Standing
    policy: Policy
    watch: Watch | None
    course: Course | None
    pace: float | None
    retrained: PastRetrain | None
    events: tuple[Event, ...]

    @property
    def left_out(self) -> int:
        """Checks that were left out."""
        return self.doing.ever.accepted + self.doing.ever.rejected


def how_view(looking: Looking) -> HowView:
    """Read how it is doing."""
    store, recipe, engine = looking.store, looking.recipe, looking.service.engine
    doing = standing(store, recipe, NEWEST)
    went = course(store, recipe, NEWEST) if doing.ever.decisions else None
    accepted = [each for each in (went.retrains if went else ()) if each.report.accepted]
    return HowView(
        doing=doing,
        policy=recipe.policy,
        watch=looking.kept("watch", (engine.version, engine.new_labels, recipe), lambda: watch(store, recipe)),
        course=went,
        pace=_pace(looking),
        retrained=accepted[-1] if accepted else None,
        events=tuple(store.events(EVENTS)[::-1]),
    )


def _pace(looking: Looking) -> float | None:
    tally = looking.store.tally(PACE)
    if tally.first is None or tally.last is None or tally.last <= tally.first:
        return None
    return 3600.0 * (tally.count() - 1) / (tally.last - tally.first)


def mode_of(looking: Looking) -> tuple[str, str]:
    """How decisions are made now, decides, learns, shadow or safe, and the message of why a safe mode began."""
    engine = looking.service.engine
    if why := engine.safe_mode:
        return "safe", f"safe.{SAFE_MODE.index(why)}"
    if engine.shadow:
        return "shadow", ""
    return ("learns" if engine.version == 0 else "decides"), ""
