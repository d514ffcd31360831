// The views. Each gets its data and returns its elements; those with `data-part` are replaced one by one when they change.

import * as act from "./actions.js";
import { boundChart, courseChart, isForce, judgedChart, mapChart, traceCharts, traceLegend } from "./charts.js";
import {
  ACTIONS, LABEL_NAMES, REASON_NAMES, capital, chip, clock, duration, el, icon, interval, label, labelOf, labelWord, moment, nameOf, number,
  partAddress, percent, reasonOf, sourceOf, table,
} from "./dom.js";

const RECENT = 14; // parts in the strip of newest parts
const PACE = 30; // newest parts, of which the parts per hour are computed
const CONSEQUENCES = {
  accept: "The part goes on without the check.", reject: "The part goes back to the bin.", verify: "The part goes to the check.",
};
const OUTCOMES = { good: "It was good.", bad: "It was bad.", none: "No result reported yet." };
const VERDICT = { kept: "Tolerance kept", open: "Not decided yet", broken: "Tolerance broken" };
const MODES = { decides: "Decides", learns: "Learning", shadow: "Verifying all", safe: "Safe mode" };
const BASIS = {
  "every outcome": (bad) => `Every outcome is known: ${number(bad.n_wrong)} of ${number(bad.n_known)} were bad.`,
  audits: (bad) => `By audits, ${number(bad.n_wrong)} of ${number(bad.n_known)} bad, and by the known line stops.`,
  "": (bad, stops) => bad.n === 0 ? "No part was accepted without a check." : `${stops ? "Only the line stops are known" : "Nothing is known"} so far; audits would bound it.`,
};

export function modeOf(status) {
  if (status.safe_mode) return "safe";
  return status.shadow ? "shadow" : status.version === 0 ? "learns" : "decides";
}

export const modeWord = (mode) => [icon(mode === "safe" || mode === "shadow" ? "shield" : mode === "decides" ? "accept" : "open"), MODES[mode]];

export function warnings(status) {
  // Return the banners above every view, the worst first.
  const texts = [];
  if (status.store_fault) texts.push(`The store cannot be written: ${status.store_fault}`);
  if (status.safe_mode) texts.push(`Safe mode: parts are verified until new outcomes allow decisions (${status.safe_mode})`);
  if (status.shadow) texts.push("Shadow mode: every part is verified, and the model only predicts");
  if (status.pinned) texts.push(`Version ${status.pinned} was rolled back to, and no automatic retrain replaces it until it is released`);
  if (status.alarm && (status.loss || !status.safe_mode) && !status.store_fault) texts.unshift(status.alarm); // else the alarm has the same text
  return texts.map((text) => el("p", { class: "banner" }, icon("shield"), el("span", {}, text)));
}

function card(id, title, ...children) {
  return el("section", { class: "card", id, "data-part": true, "aria-labelledby": `${id}-title` }, el("h2", { id: `${id}-title` }, title), ...children);
}

const big = (...text) => el("p", { class: "big" }, ...text);
const small = (...text) => el("p", { class: "muted" }, ...text);
const figure = (id, title, ...children) => el("section", { class: "card tile", id, "data-part": true }, el("h2", {}, title), ...children);

// Figures

const saved = (status) => figure("saved", "Check time saved",
  big(duration((status.ever.accepted + status.ever.rejected) * status.check_seconds)),
  small(`${number(status.ever.accepted + status.ever.rejected)} checks saved, ${number(status.check_seconds)} s each`,
    status.ever.false_accepts > 0 && `; line stops, not subtracted: ${number(status.ever.false_accepts)}`));

const verified = (status) => figure("verified", "Verified", big(percent(status.newest.verified_share)),
  small(`Newest ${number(status.newest.decisions)} parts`), el("p", {}, `Since the beginning: ${percent(status.ever.verified_share)}`));

const accepted = (status) => figure("accepted", "Accepted without check", big(number(status.ever.accepted)),
  small("Since the beginning"), el("p", {}, `Rejected without check: ${number(status.ever.rejected)}`));

function pace(recent) {
  const newest = recent.slice(0, PACE);
  const seconds = newest.length > 1 ? newest[0].time - newest.at(-1).time : 0;
  return figure("pace", "Parts per hour", big(seconds > 0 ? number((3600 * (newest.length - 1)) / seconds) : "–"), small(`over the newest ${number(newest.length)}`));
}

const verdict = (judged, text) => el("p", { class: `big verdict ${judged.verdict}` }, icon(judged.verdict), text);

const knownBad = ({ false_accepts: wrong }) => wrong > 0 && el("p", { class: "verdict broken" }, icon("bad"), el("b", {}, `${number(wrong)} known bad`));

function badAccepts(status) {
  const bad = status.ever.bad_accepts;
  return el("section", { class: "card tile wide", id: "bad", "data-part": true }, el("h2", {}, "Bad accepted parts"),
    knownBad(status.ever), verdict(bad, VERDICT[bad.verdict]), judgedChart(bad),
    el("p", {}, `${interval(bad.lower, bad.upper, 1).join(" to ")}, tolerance ${percent(bad.tolerance, 1)}`),
    small(BASIS[bad.basis](bad, status.ever.false_accepts)), el("p", { id: "claim" }, status.claim));
}

function wouldHave(status) {
  const { would_accept: accepts, would_reject: rejects, verified: checked } = status.ever;
  const certain = accepts.n + rejects.n;
  return el("section", { class: "card tile wide", id: "would", "data-part": true }, el("h2", {}, "Predicted in shadow mode"),
    big(`${number(certain)} of ${number(checked)} verified parts`),
    el("p", {}, `${number(accepts.n)} accepted, ${number(accepts.n_wrong)} of them bad; ${number(rejects.n)} rejected, ${number(rejects.n_wrong)} of them good; ${duration(certain * status.check_seconds)} saved.`),
    judgedChart(accepts), small(`Bad among those it would have accepted: ${interval(accepts.lower, accepts.upper, 1).join(" to ")}; ${VERDICT[accepts.verdict].toLowerCase()} (${percent(accepts.tolerance, 1)}).`));
}

// One part

const bound = (explanation) => explanation.bound
  ? [big(interval(explanation.bound.lower, explanation.bound.upper, 1).join(" – ")), boundChart(explanation.bound)]
  : big("–");

const counts = (decision) => el("p", { class: "counts" },
  el("span", { class: "good" }, icon("good"), el("b", {}, number(decision.n_success)), " good"),
  el("span", { class: "bad" }, icon("bad"), el("b", {}, number(decision.n_failure)), " bad"));

function neighbours(explanation) {
  if (!explanation.neighbours.length) return null;
  const rows = explanation.neighbours.map((neighbour) => [
    neighbour.decision_id ? el("a", { href: partAddress(neighbour.decision_id) }, nameOf(neighbour.part, neighbour.decision_id)) : "–",
    label(neighbour.success), number(neighbour.distance, 3), neighbour.inside ? "yes" : "no",
  ]);
  return el("details", { id: "near-list" }, el("summary", {}, "The nearest labelled parts"),
    table([["Part"], ["Label"], ["Distance", "num"], ["In the neighbourhood"]], rows));
}

const why = (explanation) => [
  el("ul", { class: "why" }, explanation.sentences.map((sentence) => el("li", {}, sentence))),
  explanation.notes.length > 0 && el("details", { id: "notes" }, el("summary", {}, "Notes"), explanation.notes.map((note) => el("p", {}, note))),
];

function story(explanation) {
  const { decision, corrections } = explanation;
  const by = decision.model_version ? ` by model ${decision.model_version}` : ", before the first model";
  const entries = [[decision.time, `${capital(decision.action)} (${reasonOf(decision.reason)})${by}`]];
  const first = corrections.length ? corrections[0].was : decision.success;
  const nameLabel = (success) => (success === null ? "forgotten" : labelOf(success));
  if (decision.label_time !== null) entries.push([decision.label_time, `reported ${nameLabel(first)}, by ${sourceOf(decision.source)}`]);
  for (const correction of corrections) entries.push([correction.time, `corrected from ${nameLabel(correction.was)} to ${nameLabel(correction.success)} by ${correction.author || "somebody"}`]);
  return el("ol", { class: "story" }, entries.map(([time, text]) => el("li", {}, el("time", {}, moment(time)), ` ${text}`)));
}

function labelActions(decision) {
  const { id, action, source, success } = decision;
  const two = (makeAction) => [true, false].map((good) =>
    act.button(good ? "label-good" : "label-bad", good ? "It was good" : "It was bad", makeAction(good), source !== null && success === good, icon(labelOf(good))));
  if (source !== null) return [two((good) => act.correct(id, good)), act.button("forget", "Forget the label", act.forget(id), success === null)];
  return two((good) => act.report(id, good, action === "accept" && !good));
}

function detail(explanation, level) {
  const head = (text) => el(`h${level}`, {}, text);
  const { decision } = explanation;
  return [
    el("p", { class: "headline" }, chip(decision.action), " ", el("span", { class: "muted" }, reasonOf(decision.reason)), " ", label(decision.success)),
    traceCharts(explanation), traceLegend(explanation),
    head("Why"), why(explanation),
    explanation.bound && [head("Bound"), bound(explanation)],
    head("Neighbours"), counts(decision), neighbours(explanation),
    head("History"), story(explanation), el("p", { class: "muted" }, "Decision ", el("code", {}, decision.id)),
    head("Label"), el("p", { class: "buttons" }, labelActions(decision)),
  ];
}

// The chart of a trace shows the force limits that are set now, for earlier parts too.
async function getExplanation(get, id, status) {
  return { ...await get(`explanations/${encodeURIComponent(id)}`), limits: status.recipe.policy.force_limits };
}

// The views: called with `get`, the URL's query and the status; each returns its title and its elements

async function now(get, _, status) {
  const { decisions } = await get(`decisions?limit=${PACE}`);
  if (!decisions.length) {
    const waiting = el("section", { id: "waiting", class: "waiting", "data-part": true }, el("h1", {}, "Waiting for the first part"),
      el("p", {}, "As soon as the robot sends a trace, the decision is shown here."));
    return { title: "Now", elements: [waiting] };
  }
  const explanation = await getExplanation(get, decisions[0].id, status);
  const { decision } = explanation;
  const name = decision.part === null ? "Part without a number" : `Part ${decision.part}`;
  const card_ = el("section", { class: `decision ${decision.action}`, id: "now-decision", "data-part": true, "aria-labelledby": "decision",
    "data-spoken": `${name}: ${capital(decision.action)}, ${reasonOf(decision.reason)}.` },
  el("h2", { id: "decision" }, icon(decision.action), el("span", {}, capital(decision.action))),
  el("p", { class: "because" }, reasonOf(decision.reason), decision.audit && ` · ${capital(decision.predicted)}?`),
  el("p", {}, CONSEQUENCES[decision.action]),
  el("p", { class: "about" }, el("a", { href: partAddress(decision.id) }, name), ` at ${clock(decision.time)}`, decision.model_version > 0 && ` · model ${decision.model_version}`),
  el("p", { class: "came" }, icon(labelOf(decision.success)), OUTCOMES[labelOf(decision.success)]));
  const strip = el("section", { class: "recent", id: "recent", "data-part": true, "aria-label": "The newest parts, newest first" },
    el("ol", {}, decisions.slice(0, RECENT).map((each) => {
      const escaped = each.action === "accept" && each.success === false;
      return el("li", {}, el("a", { class: escaped ? "escaped" : each.action, href: partAddress(each.id) }, icon(escaped ? labelOf(false) : each.action),
        el("span", {}, nameOf(each.part, each.id)), el("span", { class: "visually-hidden" }, `: ${capital(each.action)}${escaped ? ", and bad" : ""}`)));
    })));
  const bad = status.ever.bad_accepts;
  const figures = [
    verified(status), accepted(status),
    figure("bad", "Bad accepted parts", knownBad(status.ever), verdict(bad, interval(bad.lower, bad.upper, 1).join(" – ")), small(`${VERDICT[bad.verdict]} (${percent(bad.tolerance)})`)),
    pace(decisions), saved(status),
  ];
  const layout = el("div", { class: "now" }, card_,
    card("trace", `The ${isForce(explanation.spec) ? "force" : "trace"}, and good and bad parts`, traceCharts(explanation), traceLegend(explanation)),
    card("bound", "Bound", bound(explanation)), card("near", "Neighbours", counts(decision), neighbours(explanation)),
    el("div", { class: "figures" }, figures), strip, card("why", "Why", why(explanation)));
  return { title: "Now", elements: [el("h1", { class: "visually-hidden" }, "Now"), layout] };
}

const HOURS = { shift: 8, day: 24, hour: 1 };
const SHIFT_BEGINS = 6; // o'clock
const ROWS = 20; // of the trend

async function trend(get, wished) {
  const by = wished in HOURS ? wished : "shift";
  const start = new Date().setHours(by === "shift" ? SHIFT_BEGINS : 0, 0, 0, 0) / 1000;
  const { stretches } = await get(`course?hours=${HOURS[by]}&start=${start / 3600}`);
  const begun = (last) => start + Math.floor((last - start) / (3600 * HOURS[by])) * 3600 * HOURS[by];
  const rows = stretches.slice(-ROWS).reverse().map((each) => [el("time", {}, moment(begun(each.last)).slice(0, 16)), number(each.n),
    percent((each.accepted + each.rejected) / each.n), percent(each.verified / each.n), number(each.accepted), number(each.false_accepts), number(each.outside)]);
  const ways = Object.keys(HOURS).map((way) => el("li", {}, el("a", { href: `overview?by=${way}`, "aria-current": way === by ? "true" : null }, `by ${way}`)));
  return card("trend", "Trend", el("ul", { class: "chips" }, ways), rows.length === 0 ? small("No parts yet.")
    : table([["From"], ["Parts", "num"], ["Certain", "num more"], ["Verified", "num"], ["Accepted", "num more"], ["Bad accepted", "num"], ["Outside the limits", "num more"]], rows));
}

async function overview(get, query, status) {
  const [course, { events }, { decisions }, { decisions: escaped }] = await Promise.all([
    get("course"), get("events?limit=12"), get(`decisions?limit=${PACE}`), get("decisions?action=accept&label=bad&limit=10"),
  ]);
  const { newest, ever } = status;
  const report = ever.retrains > 0 && course.retrains.filter((each) => each.report.accepted).at(-1);
  const escapes = escaped.length > 0 && card("escapes", `Accepted but bad: ${number(ever.false_accepts)}`,
    el("ul", { class: "chips" }, escaped.map((each) => el("li", {}, el("a", { href: partAddress(each.id) }, nameOf(each.part, each.id)), ` ${moment(each.time)}`)),
      ever.false_accepts > escaped.length && el("li", {}, el("a", { href: "history?action=accept&label=bad" }, "All of them"))));
  const drift = status.watch
    ? [["accepts", "bad among the accepted"], ["rejects", "good among the rejected"], ["novelty", "novel parts"]].map(([name, title]) => el("p", { class: "watched" },
      el("label", { for: `watch-${name}` }, title), el("meter", { id: `watch-${name}`, min: 0, max: 1, high: 0.5, value: Math.min(1, status.watch[name]) }), percent(status.watch[name])))
      .concat(status.watch.recovery ? [small(`Safe mode: ${status.watch.recovery}.`)] : [])
    : [big("–"), small("Not watched under this policy.")];
  const tiles = [
    status.shadow && wouldHave(status), badAccepts(status), verified(status), accepted(status), pace(decisions), saved(status),
    figure("novel", "Novel", big(percent(newest.novel_share, 1)), small(`Newest ${number(newest.decisions)} parts`), el("p", {}, `${status.recipe.policy.audit_rate > 0 ? "Audits" : "Certain but checked"}: ${number(newest.audits)} · Outside the limits: ${number(newest.outside)}`)),
    figure("drift", "Drift, as a share of the alarm's limit", drift),
    figure("model", "Model", big(`version ${status.version}`), small(`Retrains: ${number(ever.retrains)}, ${number(Object.values(ever.dropped).reduce((a, b) => a + b, 0))} dropped`),
      report && el("p", {}, `newest at ${clock(report.time)}, ${number(report.report.seconds, 2)} s`),
      el("p", {}, `Labels until the next retrain: ${number(status.new_labels)} of ${number(status.recipe.retrain_every)}`),
      Object.entries(ever.dropped).map(([reason, n]) => small(`Dropped ${number(n)}: ${reason}`))),
    figure("doing", "Mode", big(MODES[modeOf(status)]), small(`Tolerance ${percent(ever.bad_accepts.tolerance)}, alpha ${number(status.recipe.policy.alpha, 2)}`),
      el("p", {}, `Waiting for a result: ${number(ever.unlabelled)}`),
      el("p", {}, `Model errors: ${number(newest.errors)} · Unusable traces, not trained on: ${number(newest.quarantined)}`)),
  ];
  const rows = course.stretches.map((each) => [moment(each.last), number(each.n), percent(each.verified / each.n), number(each.accepted), number(each.false_accepts)]).reverse();
  const lines = card("course", "From the first part to the newest", course.stretches.length === 0
    ? small("Shown after the first decision.")
    : [courseChart(course), el("details", { id: "course-table" }, el("summary", {}, "The same as a table"),
      table([["Until"], ["Parts", "num"], ["Verified", "num"], ["Accepted", "num"], ["Bad accepted", "num"]], rows))]);
  const happened = card("events", "Events", events.length
    ? el("ol", { class: "story" }, events.map((each) => el("li", {}, el("time", {}, moment(each.time)), " ", el("b", {}, each.kind), each.author && ` · ${each.author}`,
      el("br"), each.text.replace(/\b([0-9a-f]{12})[0-9a-f]{28,}\b/g, "$1…"))))
    : small("No events yet."));
  return { title: "Overview", elements: [el("h1", {}, "Overview"), escapes, el("div", { class: "tiles" }, tiles), el("div", { class: "split" }, el("div", { class: "stack" }, lines, await trend(get, query.get("by"))), happened)] };
}

async function map(get, query, status) {
  const chosen = query.get("id") ?? "";
  const [partMap, part] = await Promise.all([get("embedding"), chosen ? getExplanation(get, chosen, status).catch(() => null) : null]);
  const legend = [["good", "●", "good"], ["bad", "✕", "bad"], ["none", "■", "not known"], ["", "○", "newest parts"]].map(([kind, sign, text]) =>
    el("li", { class: kind && `label ${kind}` }, el("span", { "aria-hidden": "true" }, sign), text));
  if (partMap.radius !== null) legend.push(el("li", {}, el("span", { class: "swatch ring", "aria-hidden": "true" }), "neighbourhood in which labels are counted"));
  const rows = partMap.marks.slice(-40).reverse().map((mark) => [el("a", { href: partAddress(mark.id, "map") }, nameOf(mark.part, mark.id)), label(mark.success)]);
  const picture = el("section", { class: "card", id: "map", "data-part": true, "aria-label": "Map of the parts" }, partMap.marks.length === 0
    ? el("p", { class: "waiting" }, "The map is shown after the first retrain.")
    : [small("Parts with similar traces lie close together. Choose a part to see its trace and history."),
      mapChart(partMap, chosen), el("ul", { class: "legend" }, legend),
      el("details", { id: "map-list" }, el("summary", {}, "The newest parts on the map as a list"), table([["Part"], ["Label"]], rows))]);
  const beside = el("section", { class: "card part", id: "part", "data-part": true, "aria-labelledby": "part-title" }, part
    ? [el("h2", { id: "part-title", tabindex: -1 }, `Part ${nameOf(part.decision.part, part.decision.id)}`), detail(part, 3)]
    : el("h2", { id: "part-title", tabindex: -1, class: "muted" }, "No part is chosen."));
  return { title: "Map", elements: [el("h1", {}, "Map of the parts"), el("div", { class: "split" }, picture, beside)] };
}

async function part(get, query, status) {
  const explanation = await getExplanation(get, query.get("id") ?? "", status);
  const name = nameOf(explanation.decision.part, explanation.decision.id);
  return { title: `Part ${name}`, elements: [el("article", { class: "card part", id: "part", "data-part": true }, el("h1", {}, `Part ${name}`), detail(explanation, 2))] };
}

const FILTERS = [["action", "Decision", ACTIONS, capital], ["reason", "Reason", REASON_NAMES, reasonOf], ["label", "Label", LABEL_NAMES, labelWord]];
const TIMES = [["since", "From"], ["until", "Until"]];

async function history(get, query) {
  const given = new URLSearchParams([...query].map(([name, value]) => [name, value.trim()]).filter(([, value]) => value !== ""));
  const wanted = new URLSearchParams(given);
  for (const [name] of TIMES) if (given.has(name)) wanted.set(name, new Date(given.get(name)).getTime() / 1000);
  wanted.set("limit", 50);
  const { decisions, older } = await get(`decisions?${wanted}`);
  const choices = FILTERS.map(([name, title, values, word]) => el("p", { class: "field" }, el("label", { for: `filter-${name}` }, title),
    el("select", { id: `filter-${name}`, name }, el("option", { value: "" }, "all"), values.map((value) => el("option", { value, selected: given.get(name) === value }, word(value))))));
  const typed = [["part", "Part's number", "text"], ...TIMES.map((each) => [...each, "datetime-local"])].map(([name, title, type]) =>
    el("p", { class: "field" }, el("label", { for: `filter-${name}` }, title), el("input", { id: `filter-${name}`, type, name, value: given.get(name) ?? "" })));
  const form = el("form", { class: "card filters", method: "get", action: "history", "aria-label": "Filters", id: "filters" }, choices, typed,
    el("p", { class: "buttons" }, el("button", { class: "main" }, "Show"), el("a", { href: "history" }, "Show all")));
  const titles = [["Time"], ["Part"], ["Decision"], ["Reason", "more"], ["Label"], ["Bound", "num more"], ["Good / bad neighbours", "num more"], ["Model", "num more"]];
  const rows = decisions.map((each) => [
    el("time", {}, el("span", { class: "more" }, moment(each.time)), el("span", { class: "less" }, clock(each.time))),
    el("a", { href: partAddress(each.id) }, nameOf(each.part, each.id)), chip(each.action), reasonOf(each.reason), label(each.success),
    interval(each.lower, each.upper).join(" – "), `${number(each.n_success)} / ${number(each.n_failure)}`, number(each.model_version),
  ]);
  const next = new URLSearchParams(given);
  if (older) next.set("before", older);
  const list = el("section", { class: "card", id: "history", "data-part": true, "aria-label": "History" }, decisions.length === 0
    ? small("No decision matches.")
    : [table(titles, rows, { class: "decisions" }), el("p", { class: "buttons" }, `${number(decisions.length)} decision${decisions.length === 1 ? "" : "s"} shown.`,
      given.has("before") && el("a", { href: "history" }, "Newest"), older && el("a", { rel: "next", href: `history?${next}` }, "Older"),
      el("button", { type: "button", id: "as-csv", onclick: () => act.download(asCsv(decisions), "decisions.csv") }, "Download these as CSV"))]);
  return { title: "History", elements: [el("h1", {}, "History"), form, list] };
}

function asCsv(decisions) {
  const names = Object.keys(decisions[0]).filter((name) => name !== "embedding" && name !== "trace");
  const shown = (name, value) => (/time$/.test(name) && value !== null ? new Date(1000 * value).toISOString() : value);
  const text = (value) => {
    const plain = value === null || value === undefined ? "" : String(value);
    const safe = typeof value === "string" && /^[=+\-@\t\r]/.test(plain) ? `'${plain}` : plain; // a spreadsheet would take these for formulas
    return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };
  const lines = decisions.map((each) => names.map((name) => text(shown(name, each[name]))).join(","));
  return new Blob([[names.join(","), ...lines, ""].join("\n")], { type: "text/csv" });
}

async function actions(get, _, status) {
  const { versions } = await get("versions");
  const back = versions.filter(({ report, kept }) => report.accepted && kept && report.version !== status.version).reverse();
  const choices = back.map(({ report, time }) => [report.version, `${report.version}: ${moment(time)}`]);
  const block = (name, action, off = false, reason = "") => el("section", { class: "card act", "aria-labelledby": `act-${name}` }, el("h2", { id: `act-${name}` }, action.title),
    el("p", {}, action.explanation), off && small(reason), el("p", { class: "buttons" }, act.button(`do-${name}`, action.title, action, off)));
  const blocks = el("div", { class: "acts", id: "actions", "data-part": true },
    block("shadow", act.shadow(!status.shadow)), block("report", act.reportPart),
    block("rollback", act.rollback(choices), !back.length, "There is no earlier version."),
    status.pinned > 0 && block("release", act.release),
    block("policy", act.policy(status.recipe.policy)), block("retrain", act.retrain));
  return { title: "Actions", elements: [el("h1", {}, "Actions"), small("Each asks for confirmation and your name, which goes into the event log. Labels are corrected on the page of the part."), blocks] };
}

export const VIEWS = { "": now, overview, map, part, history, actions };
