"""What the page says, in the reader's language: messages by key, and numbers and times as that language writes them.

The page's messages in English, by key.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from .german import GERMAN

ENGLISH = {
    "language": "English",
    "skip": "Skip to the content",
    "views": "Views",
    "view.now": "Now",
    "view.how": "How it is doing",
    "view.map": "Map",
    "view.history": "History",
    "view.acts": "Acts",
    "view.part": "Part",
    "cell": "Cell {name}",
    "theme.label": "Appearance",
    "theme.auto": "As the device",
    "theme.light": "Light",
    "theme.dark": "Dark",
    "language.label": "Language",
    "link.live": "Live",
    "link.connecting": "Connecting …",
    "link.cut": "Cut off",
    "link.old": "Cut off since {time}. What you see is old. The page keeps trying.",
    "failed": "That cannot be shown",
    "back": "Back to what happens now",
    # Modes
    "mode.shadow": "Verify everything: every part is verified, the model only says what it would have done",
    "mode.safe": "Safe mode: every part is verified until fresh evidence keeps the tolerance ({reason})",
    "mode.short.decides": "Decides",
    "mode.short.learns": "Learning",
    "mode.short.shadow": "Verifying all",
    "mode.short.safe": "Safe mode",
    # Why a safe mode began, by the place in SAFE_MODE
    "safe.1": "accepted parts failed more often than the tolerance",
    "safe.2": "rejected parts were good more often than the tolerance",
    "safe.3": "too many traces were novel",
    # Decisions
    "action.accept": "Accept",
    "action.reject": "Reject",
    "action.verify": "Verify",
    "does.accept": "The part goes on without the check.",
    "does.reject": "The part goes back to the bin.",
    "does.verify": "The part goes to the check.",
    "reason.certain": "certain",
    "reason.uncertain": "uncertain",
    "reason.no_model": "no model yet",
    "reason.audit": "audit",
    "reason.not_finite": "samples missing",
    "reason.constant": "dead sensor",
    "reason.saturated": "sensor at its limit",
    "reason.model_error": "model error",
    "reason.novel": "novel",
    "reason.safe_mode": "safe mode",
    "reason.no_store": "store away",
    "reason.late": "too late",
    "label.good": "good",
    "label.bad": "bad",
    "label.none": "not known",
    "came.good": "It was good.",
    "came.bad": "It was bad.",
    "came.none": "Nothing is known of it yet.",
    "source.verification": "check",
    "source.audit": "audit",
    "source.stop": "system stop",
    "source.confirmed": "confirmed later",
    # Why
    "why.certain": "The bound meets the tolerance.",
    "why.uncertain": "The bound does not meet the tolerance: too few parts like it are known, or they differ.",
    "why.no_model": "No model has been trained yet, so every part is verified.",
    "why.audit": "The model was certain ({predicted}), and the part is verified all the same, to watch the model.",
    "why.not_finite": "Samples of the trace are missing or infinite.",
    "why.constant": "Every sample of the trace is the same: a dead sensor.",
    "why.saturated": "The trace touches the sensor's range.",
    "why.model_error": "The model raised an error, which the log tells.",
    "why.novel": "The trace is unlike all that was learned from; what its neighbours say does not count then.",
    "why.safe_mode": "Safe mode: every part is verified.",
    "why.no_store": "The store could not be written, so the model was not asked.",
    "why.late": "The answer would have come too late, so whoever asked verifies.",
    "why.counted": "Of {n} known parts near it, {good} were good and {bad} bad.",
    "why.nobody": "No known part is near it.",
    "why.bound": "So the success rate there lies between {lower} and {upper}.",
    "why.accept": "To accept, the lower end must reach {at}; it is {value}.",
    "why.reject": "To reject, the upper end must be {at} or less; it is {value}.",
    "why.needed": "{n} more good parts near it, and no bad one, would be enough.",
    "why.all": "All that the engine says of it",
    # Now
    "now.title": "Now",
    "now.waiting": "Waiting for the first part",
    "now.waiting.hint": "As soon as the robot sends a trace, the decision on it stands here.",
    "now.trace": "The force, and what good and bad parts look like",
    "now.bound": "Bound",
    "now.neighbours": "Neighbours",
    "now.why": "Why",
    "now.figures": "How it is doing",
    "now.recent": "The newest parts, newest first",
    "now.part": "Part {part}",
    "now.nopart": "Part without a number",
    "now.at": "at {time}",
    "now.model": "model {version}",
    "now.announce": "{part}: {action}, {reason}.",
    "near.good": "good",
    "near.bad": "bad",
    "near.nearest": "The nearest known parts",
    "near.distance": "Distance",
    "near.inside": "In the ball",
    "yes": "yes",
    "no": "no",
    # Charts
    "chart.time": "time in s",
    "chart.trace": "this part",
    "chart.band": "95 % of {n} good parts",
    "chart.median": "their median",
    "chart.bad": "bad parts ({n})",
    "chart.noband": "The band of good parts is drawn once 20 of them are known.",
    "alt.trace": "Force over {seconds} s, from {low} to {high} {unit}. {band}",
    "alt.inside": "{share} of it lies outside the band of good parts; for most good parts it is less than {usual}.",
    "alt.leaves": "It leaves the band farthest {side} between {start} s and {end} s.",
    "alt.above": "upwards",
    "alt.below": "downwards",
    "alt.noband": "No band of good parts is drawn yet.",
    "alt.bound": "The success rate lies between {lower} and {upper}. Accepted from {accept} on, rejected up to {reject}.",
    "alt.bad": "The share of bad accepted parts lies between {lower} and {upper}; the tolerance is {tolerance}.",
    "alt.course": "Share of verified parts from the first to the newest: it began at {first} and is now at {last}.",
    "alt.map": "Map of {n} known parts, {good} good and {bad} bad, and the newest {new}. Arrow keys go from part to part.",
    # How it is doing
    "how.title": "How it is doing",
    "how.newest": "Newest {n} parts",
    "how.ever": "Since the beginning",
    "how.parts": "Parts",
    "how.verified": "Verified",
    "how.accepted": "Accepted without check",
    "how.rejected": "Rejected without check",
    "how.bad": "Bad accepted parts",
    "how.bad.of": "{bad} of {known} that are known about",
    "how.bad.stops": "{stops} system stops",
    "how.bad.by.every": "Every outcome is known.",
    "how.bad.by.audits": "Estimated by audits.",
    "how.bad.by.none": "Only stops are known so far; audits would bound it.",
    "how.verdict.kept": "Tolerance kept",
    "how.verdict.open": "Not decided yet",
    "how.verdict.broken": "Tolerance broken",
    "how.interval": "{lower} to {upper}, tolerance {tolerance}",
    "how.rate": "Parts an hour",
    "how.rate.over": "over the newest {n}",
    "how.saved": "Check time saved",
    "how.saved.by": "{n} checks left out, {seconds} s each",
    "how.saved.stops": "system stops, not taken off: {stops}",
    "how.novel": "Novel",
    "how.audits": "Audits",
    "how.quarantined": "Bad traces, kept out of training",
    "how.errors": "Model errors",
    "how.drift": "Drift",
    "how.drift.none": "Not watched under this policy.",
    "how.drift.accepts": "bad among the accepted",
    "how.drift.rejects": "good among the rejected",
    "how.drift.novelty": "novel parts",
    "how.model": "Model",
    "how.version": "version {version}",
    "how.retrains": "{n} retrains, {dropped} dropped",
    "how.retrained": "newest at {time}, {seconds} s",
    "how.labels": "Labels until the next retrain",
    "how.labels.of": "{n} of {every}",
    "how.mode": "Mode",
    "how.policy": "Tolerance {tolerance}, alpha {alpha}",
    "how.course": "Verified share, from the first part to the newest",
    "how.course.retrain": "retrain",
    "how.course.bad": "bad accepted",
    "how.course.parts": "parts",
    "how.course.none": "Drawn once 20 parts were decided on.",
    "how.events": "What happened",
    "how.events.none": "Nothing yet.",
    "how.table": "The same as a table",
    "how.waiting": "Waiting for a result",
    # Map
    "map.title": "Map of the parts",
    "map.hint": "Parts whose force looks alike to the model lie together. Choose one to see its force and its history.",
    "map.none": "The map is drawn once the first model is trained.",
    "map.good": "good",
    "map.bad": "bad",
    "map.recent": "newest parts",
    "map.ball": "ball in which labels are counted",
    "map.probability": "model's probability of a good part",
    "map.first": "first axis",
    "map.mark": "{part}, {label}",
    "map.mark.new": "{part}, {action}, {label}",
    "map.list": "The newest parts of the map as a list",
    "map.choose": "No part is chosen.",
    # A part
    "part.title": "Part {part}",
    "part.id": "Decision",
    "part.history": "Its history",
    "part.decided": "{action} ({reason}) by model {version}",
    "part.decided.none": "{action} ({reason}), before the first model",
    "part.labelled": "known to be {label}, by {source}",
    "part.corrected": "corrected from {was} to {now} by {author}",
    "part.forgotten": "forgotten",
    "part.nobody": "somebody",
    "part.correct": "Correct the label",
    "part.correct.good": "It was good",
    "part.correct.bad": "It was bad",
    "part.correct.none": "Nothing was reported of this part, so there is nothing to correct.",
    # History
    "history.title": "History",
    "history.filters": "Filters",
    "history.action": "Decision",
    "history.reason": "Reason",
    "history.label": "Label",
    "history.since": "From",
    "history.until": "Until",
    "history.any": "all",
    "history.apply": "Show",
    "history.reset": "Show all",
    "history.time": "Time",
    "history.part": "Part",
    "history.bound": "Bound",
    "history.near": "Good / bad near it",
    "history.version": "Model",
    "history.older": "Older",
    "history.newest": "Newest",
    "history.none": "No decision fits.",
    "history.count": "{n} decisions shown.",
    # Acts
    "acts.title": "Acts",
    "acts.hint": "Each is confirmed, carries your name, and stays in the event log.",
    "act.author": "Your name",
    "act.author.hint": "It goes into the event log.",
    "act.confirm": "Do it",
    "act.cancel": "Cancel",
    "act.shadow-on": "Verify everything",
    "act.shadow-on.what": "From the next part on every part is verified. The model goes on learning.",
    "act.shadow-on.done": "Every part is verified from now on.",
    "act.shadow-off": "Let the model decide again",
    "act.shadow-off.what": "From the next part on the model decides again which parts need no check.",
    "act.shadow-off.done": "The model decides again.",
    "act.correct": "Correct the label",
    "act.correct.what": "The part then counts as {label}, in all that is learned and counted. The old label is kept.",
    "act.correct.done": "The label is corrected.",
    "act.rollback": "Roll back",
    "act.rollback.what": "An earlier model answers again, as a new version. Labels and corrections since then are kept.",
    "act.rollback.done": "The earlier model answers again.",
    "act.rollback.version": "Version",
    "act.rollback.none": "There is no earlier version to go back to.",
    "act.rollback.option": "{version}: {time}",
    "act.retrain": "Retrain now",
    "act.retrain.what": "The model is trained on all labels known by now.",
    "act.retrain.done": "The retrain has begun; its model answers as soon as it is ready.",
    "act.export": "Export",
    "act.export.what": "The model that answers now, as a TorchScript file for a controller, with its checksum.",
    "act.export.done": "The file was downloaded.",
    "act.export.none": "There is something to export once the first model is trained.",
    "act.nothing": "Nothing changed: it was so already.",
    "act.no-author": "Expected your name, got none: it goes into the event log.",
    "act.failed": "It was not done: {why}",
    "act.refused": "Expected a request of this page, got another: load the page again.",
    "act.unreachable": "It was not done, or it is not known whether: the server cannot be reached.",
}


CATALOGUES: Mapping[str, Mapping[str, str]] = {"en": ENGLISH, "de": GERMAN}
DEFAULT = "en"
MINUS, THIN = "\u2212", "\u202f"


@dataclass(frozen=True, slots=True)
class Words:
    """One language.  lang : its code, one of `CATALOGUES`."""

    lang: str = DEFAULT

    def __call__(self, key: str, **values: object) -> str:
        """The message of a key with its values filled in; an unknown key is a KeyError."""
        return CATALOGUES[self.lang][key].format(**values)

    def number(self, value: float | None, digits: int = 0) -> str:
        """1,234.5 in English, 1.234,5 in German; a dash where there is none."""
        if value is None or value != value:
            return "–"
        text = f"{abs(value):,.{digits}f}"
        if self.lang == "de":
            text = text.translate({ord(","): ".", ord("."): ","})
        negative = value < 0 and any(digit in text for digit in "123456789")
        return MINUS + text if negative else text

    def percent(self, share: float | None, digits: int = 0) -> str:
        """A share as per cent; a dash where there is none."""
        return "–" if share is None else f"{self.number(100.0 * share, digits)}{THIN}%"

    def moment(self, seconds: float | None) -> str:
        """Day and time of day, by the server's clock; seconds since 1970."""
        if seconds is None:
            return "–"
        form = "%d.%m.%Y, %H:%M:%S" if self.lang == "de" else "%Y-%m-%d %H:%M:%S"
        return f"{datetime.fromtimestamp(seconds):{form}}"

    def clock(self, seconds: float | None) -> str:
        """The time of day."""
        return "–" if seconds is None else f"{datetime.fromtimestamp(seconds):%H:%M:%S}"

    def duration(self, seconds: float) -> str:
        """90 s, 12 min, 3.4 h."""
        if abs(seconds) < 120:
            return f"{self.number(seconds)} s"
        if abs(seconds) < 7200:
            return f"{self.number(seconds / 60)} min"
        return f"{self.number(seconds / 3600, 1)} h"


def language(wanted: str | None, accepted: str = "") -> str:
    """The language to answer in: the one that was chosen, or the first one known of an Accept-Language header."""
    if wanted is not None and wanted in CATALOGUES:
        return wanted
    for _, code in sorted(_ranked(accepted), key=lambda each: -each[0]):
        if code in CATALOGUES:
            return code
    return DEFAULT


def _ranked(accepted: str) -> list[tuple[float, str]]:
    found = []
    for each in accepted.split(",")[:20]:
        name, _, weight = each.partition(";q=")
        try:
            rank = float(weight or 1.0)
        except ValueError:
            continue
        found.append((rank, name.strip().lower()[:2]))
    return found
