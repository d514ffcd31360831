// What each view shows. A view asks the server, and gives its elements; those with `data-part` are exchanged one by one.

import * as act from "./actions.js";
import { boundChart, courseChart, isForce, judgedChart, mapChart, traceCharts, traceLegend } from "./charts.js";
import {
  ACTIONS, LABEL_NAMES, REASON_NAMES, capital, chip, clock, duration, el, icon, label, labelOf, labelWord, moment, nameOf, number,
  partAddress, percent, reasonOf, sourceOf, table,
} from "./dom.js";

const RECENT = 14; // parts in the strip of the newest
const PACE = 30; // newest parts, by which parts an hour are counted
const DOES = {
  accept: "The part goes on without the check.", reject: "The part goes back to the bin.", verify: "The part goes to the check.",
};
const CAME = { good: "It was good.", bad: "It was bad.", none: "No result reported yet." };
const VERDICT = { kept: "Tolerance kept", open: "Not decided yet", broken: "Tolerance broken" };
const MODES = { decides: "Decides", learns: "Learning", shadow: "Verifying all", safe: "Safe mode" };
const BY = {
  "every outcome": (bad) => `Every outcome is known: ${number(bad.n_wrong)} of ${number(bad.n_known)} were bad.`,
  audits: (bad) => `By audits, ${number(bad.n_wrong)} of ${number(bad.n_known)} bad, and by the known system stops.`,
  "": (bad, stops) => bad.n === 0 ? "No part was accepted without a check." : `${stops ? "Only the system stops are known" : "Nothing is known"} so far; audits would bound it.`,
};

export function modeOf(doing) {
  if (doing.safe_mode) return "safe";
  return doing.shadow ? "shadow" : doing.version === 0 ? "learns" : "decides";
}

export const modeWord = (mode) => [icon(mode === "safe" || mode === "shadow" ? "shield" : mode === "decides" ? "accept" : "open"), MODES[mode]];

export function warnings(doing) {
  // What stands above every view, the worst first.
  const said = [];
  if (doing.store_fault) said.push(`The store cannot be written: ${doing.store_fault}`);
  if (doing.safe_mode) said.push(`Safe mode: every part is verified until fresh evidence keeps the tolerance (${doing.safe_mode})`);
  if (doing.shadow) said.push("Verify everything: every part is verified, the model only says what it would have done");
  if (doing.alarm && !doing.store_fault && !doing.safe_mode) said.unshift(doing.alarm); // else it says the same
  return said.map((text) => el("p", { class: "banner" }, icon("shield"), el("span", {}, text)));
}

function card(id, title, ...children) {
  return el("section", { class: "card", id, "data-part": true, "aria-labelledby": `${id}-title` }, el("h2", { id: `${id}-title` }, title), ...children);
}

const big = (...text) => el("p", { class: "big" }, ...text);
const small = (...text) => el("p", { class: "muted" }, ...text);
const figure = (id, title, ...children) => el("section", { class: "card tile", id, "data-part": true }, el("h2", {}, title), ...children);

// Figures

const saved = (doing) => figure("saved", "Check time saved",
  big(duration((doing.ever.accepted + doing.ever.rejected) * doing.check_seconds)),
  small(`${number(doing.ever.accepted + doing.ever.rejected)} checks left out, ${number(doing.check_seconds)} s each`,
    doing.ever.false_accepts > 0 && `; system stops, not taken off: ${number(doing.ever.false_accepts)}`));

const verified = (doing) => figure("verified", "Verified", big(percent(doing.newest.verified_share)),
  small(`Newest ${number(doing.newest.decisions)} parts`), el("p", {}, `Since the beginning: ${percent(doing.ever.verified_share)}`));

const accepted = (doing) => figure("accepted", "Accepted without check", big(number(doing.ever.accepted)),
  small("Since the beginning"), el("p", {}, `Rejected without check: ${number(doing.ever.rejected)}`));

function pace(recent) {
  const newest = recent.slice(0, PACE);
  const seconds = newest.length > 1 ? newest[0].time - newest.at(-1).time : 0;
  return figure("pace", "Parts an hour", big(seconds > 0 ? number((3600 * (newest.length - 1)) / seconds) : "–"), small(`over the newest ${number(newest.length)}`));
}

const verdict = (judged, text) => el("p", { class: `big verdict ${judged.verdict}` }, icon(judged.verdict), text);

const knownBad = ({ false_accepts: wrong }) => wrong > 0 && el("p", { class: "verdict broken" }, icon("bad"), el("b", {}, `${number(wrong)} known bad`));

function badAccepts(doing) {
  const bad = doing.ever.bad_accepts;
  return el("section", { class: "card tile wide", id: "bad", "data-part": true }, el("h2", {}, "Bad accepted parts"),
    knownBad(doing.ever), verdict(bad, VERDICT[bad.verdict]), judgedChart(bad),
    el("p", {}, `${percent(bad.lower, 1)} to ${percent(bad.upper, 1)}, tolerance ${percent(bad.tolerance, 1)}`),
    small(BY[bad.basis](bad, doing.ever.false_accepts)));
}

function wouldHave(doing) {
  const { would_accept: accepts, would_reject: rejects, verified: checked } = doing.ever;
  const certain = accepts.n + rejects.n;
  return el("section", { class: "card tile wide", id: "would", "data-part": true }, el("h2", {}, "It would have decided"),
    big(`${number(certain)} of ${number(checked)} verified parts`),
    el("p", {}, `${number(accepts.n)} accepted, ${number(accepts.n_wrong)} of them bad; ${number(rejects.n)} rejected, ${number(rejects.n_wrong)} of them good; ${duration(certain * doing.check_seconds)} saved.`),
    judgedChart(accepts), small(`Bad among those it would have accepted: ${percent(accepts.lower, 1)} to ${percent(accepts.upper, 1)}; ${VERDICT[accepts.verdict].toLowerCase()} (${percent(accepts.tolerance, 1)}).`));
}

// One part

const bound = (found) => found.bound
  ? [big(`${percent(found.bound.lower, 1)} – ${percent(found.bound.upper, 1)}`), boundChart(found.bound)]
  : big("–");

const counts = (decision) => el("p", { class: "counts" },
  el("span", { class: "good" }, icon("good"), el("b", {}, number(decision.n_success)), " good"),
  el("span", { class: "bad" }, icon("bad"), el("b", {}, number(decision.n_failure)), " bad"));

function neighbours(found) {
  if (!found.neighbours.length) return null;
  const rows = found.neighbours.map((each) => [
    each.decision_id ? el("a", { href: partAddress(each.decision_id) }, nameOf(each.part, each.decision_id)) : "–",
    label(each.success), number(each.distance, 3), each.inside ? "yes" : "no",
  ]);
  return el("details", { id: "near-list" }, el("summary", {}, "The nearest known parts"),
    table([["Part"], ["Label"], ["Distance", "num"], ["In the ball"]], rows));
}

const why = (found) => [
  el("ul", { class: "why" }, found.sentences.map((sentence) => el("li", {}, sentence))),
  found.notes.length > 0 && el("details", { id: "notes" }, el("summary", {}, "More that the engine says of it"), found.notes.map((each) => el("p", {}, each))),
];

function story(found) {
  const { decision, corrections } = found;
  const by = decision.model_version ? ` by model ${decision.model_version}` : ", before the first model";
  const told = [[decision.time, `${capital(decision.action)} (${reasonOf(decision.reason)})${by}`]];
  const first = corrections.length ? corrections[0].was : decision.success;
  const called = (success) => (success === null ? "forgotten" : labelOf(success));
  if (decision.label_time !== null) told.push([decision.label_time, `known to be ${called(first)}, by ${sourceOf(decision.source)}`]);
  for (const each of corrections) told.push([each.time, `corrected from ${called(each.was)} to ${called(each.success)} by ${each.author || "somebody"}`]);
  return el("ol", { class: "story" }, told.map(([time, text]) => el("li", {}, el("time", {}, moment(time)), ` ${text}`)));
}

function labelActions(decision) {
  const { id, action, source, success } = decision;
  const two = (asks) => [true, false].map((good) =>
    act.button(good ? "label-good" : "label-bad", good ? "It was good" : "It was bad", asks(good), source !== null && success === good, icon(labelOf(good))));
  if (source !== null) return [two((good) => act.correct(id, good)), act.button("forget", "Forget the label", act.forget(id), success === null)];
  return two((good) => act.report(id, good, action === "accept" && !good));
}

function detail(found, level) {
  const head = (text) => el(`h${level}`, {}, text);
  const { decision } = found;
  return [
    el("p", { class: "headline" }, chip(decision.action), " ", el("span", { class: "muted" }, reasonOf(decision.reason)), " ", label(decision.success)),
    traceCharts(found), traceLegend(found),
    head("Why"), why(found),
    found.bound && [head("Bound"), bound(found)],
    head("Neighbours"), counts(decision), neighbours(found),
    head("Its history"), story(found), el("p", { class: "muted" }, "Decision ", el("code", {}, decision.id)),
    head("Its label"), el("p", { class: "buttons" }, labelActions(decision)),
  ];
}

// The picture shows the windows that are set now, over parts of before too.
async function explanation(get, id, doing) {
  return { ...await get(`explanations/${encodeURIComponent(id)}`), windows: doing.recipe.policy.windows };
}

// The views: each is asked with `get`, the query of the address, and the status, and gives its title and its elements

async function now(get, _, doing) {
  const { decisions } = await get(`decisions?limit=${PACE}`);
  if (!decisions.length) {
    const waiting = el("section", { id: "waiting", class: "waiting", "data-part": true }, el("h1", {}, "Waiting for the first part"),
      el("p", {}, "As soon as the robot sends a trace, the decision on it stands here."));
    return { title: "Now", shown: [waiting] };
  }
  const found = await explanation(get, decisions[0].id, doing);
  const { decision } = found;
  const name = decision.part === null ? "Part without a number" : `Part ${decision.part}`;
  const card_ = el("section", { class: `decision ${decision.action}`, id: "now-decision", "data-part": true, "aria-labelledby": "decision",
    "data-spoken": `${name}: ${capital(decision.action)}, ${reasonOf(decision.reason)}.` },
  el("h2", { id: "decision" }, icon(decision.action), el("span", {}, capital(decision.action))),
  el("p", { class: "because" }, reasonOf(decision.reason), decision.audit && ` · ${capital(decision.predicted)}?`),
  el("p", {}, DOES[decision.action]),
  el("p", { class: "about" }, el("a", { href: partAddress(decision.id) }, name), ` at ${clock(decision.time)}`, decision.model_version > 0 && ` · model ${decision.model_version}`),
  el("p", { class: "came" }, icon(labelOf(decision.success)), CAME[labelOf(decision.success)]));
  const strip = el("section", { class: "recent", id: "recent", "data-part": true, "aria-label": "The newest parts, newest first" },
    el("ol", {}, decisions.slice(0, RECENT).map((each) => {
      const escaped = each.action === "accept" && each.success === false;
      return el("li", {}, el("a", { class: escaped ? "escaped" : each.action, href: partAddress(each.id) }, icon(escaped ? labelOf(false) : each.action),
        el("span", {}, nameOf(each.part, each.id)), el("span", { class: "visually-hidden" }, `: ${capital(each.action)}${escaped ? ", and bad" : ""}`)));
    })));
  const bad = doing.ever.bad_accepts;
  const figures = [
    verified(doing), accepted(doing),
    figure("bad", "Bad accepted parts", knownBad(doing.ever), verdict(bad, `${percent(bad.lower, 1)} – ${percent(bad.upper, 1)}`), small(`${VERDICT[bad.verdict]} (${percent(bad.tolerance)})`)),
    pace(decisions), saved(doing),
  ];
  const shown = el("div", { class: "now" }, card_,
    card("trace", `The ${isForce(found.spec) ? "force" : "trace"}, and what good and bad parts look like`, traceCharts(found), traceLegend(found)),
    card("bound", "Bound", bound(found)), card("near", "Neighbours", counts(decision), neighbours(found)),
    el("div", { class: "figures" }, figures), strip, card("why", "Why", why(found)));
  return { title: "Now", shown: [el("h1", { class: "visually-hidden" }, "Now"), shown] };
}

const HOURS = { shift: 8, day: 24, hour: 1 };
const SHIFT_BEGINS = 6; // o'clock
const ROWS = 20; // of the trend

async function trend(get, asked, parts) {
  // Shift by shift, by day, by hour, or by batch: what a part's number begins with, up to its last dash, slash, dot or blank.
  const batch = parts.some((each) => /[-_/. ]/.test(each.part ?? ""));
  const by = asked in HOURS || (asked === "batch" && batch) ? asked : "shift";
  const start = new Date().setHours(by === "shift" ? SHIFT_BEGINS : 0, 0, 0, 0) / 1000;
  const { stretches } = await get(`course?${by === "batch" ? `batch=${encodeURIComponent("-_/. ")}` : `hours=${HOURS[by]}&start=${start / 3600}`}`);
  const begun = (last) => start + Math.floor((last - start) / (3600 * HOURS[by])) * 3600 * HOURS[by];
  const rows = stretches.slice(-ROWS).reverse().map((each) => [by === "batch" ? each.batch || "no batch" : el("time", {}, moment(begun(each.last)).slice(0, 16)), number(each.n),
    percent((each.accepted + each.rejected) / each.n), percent(each.verified / each.n), number(each.accepted), number(each.false_accepts), number(each.outside)]);
  const ways = [...Object.keys(HOURS), ...(batch ? ["batch"] : [])].map((way) => el("li", {}, el("a", { href: `overview?by=${way}`, "aria-current": way === by ? "true" : null }, `by ${way}`)));
  return card("trend", "The trend", el("ul", { class: "chips" }, ways), rows.length === 0 ? small("It begins with the first part.")
    : table([[by === "batch" ? "Batch" : "From"], ["Parts", "num"], ["Certain", "num more"], ["Verified", "num"], ["Accepted", "num more"], ["Bad accepted", "num"], ["Outside a window", "num more"]], rows));
}

async function overview(get, query, doing) {
  const [course, { events }, { decisions }, { decisions: escaped }] = await Promise.all([
    get("course"), get("events?limit=12"), get(`decisions?limit=${PACE}`), get("decisions?action=accept&label=bad&limit=10"),
  ]);
  const { newest, ever } = doing;
  const report = ever.retrains > 0 && course.retrains.filter((each) => each.report.accepted).at(-1);
  const escapes = escaped.length > 0 && card("escapes", `Accepted, and bad: ${number(ever.false_accepts)}`,
    el("ul", { class: "chips" }, escaped.map((each) => el("li", {}, el("a", { href: partAddress(each.id) }, nameOf(each.part, each.id)), ` ${moment(each.time)}`)),
      ever.false_accepts > escaped.length && el("li", {}, el("a", { href: "history?action=accept&label=bad" }, "All of them"))));
  const drift = doing.watch
    ? [["accepts", "bad among the accepted"], ["rejects", "good among the rejected"], ["novelty", "novel parts"]].map(([name, title]) => el("p", { class: "watched" },
      el("label", { for: `watch-${name}` }, title), el("meter", { id: `watch-${name}`, min: 0, max: 1, high: 0.5, value: Math.min(1, doing.watch[name]) }), percent(doing.watch[name])))
    : [big("–"), small("Not watched under this policy.")];
  const tiles = [
    doing.shadow && wouldHave(doing), badAccepts(doing), verified(doing), accepted(doing), pace(decisions), saved(doing),
    figure("novel", "Novel", big(percent(newest.novel_share, 1)), small(`Newest ${number(newest.decisions)} parts`), el("p", {}, `${doing.recipe.policy.audit_rate > 0 ? "Audits" : "Certain but checked"}: ${number(newest.audits)} · Outside a window: ${number(newest.outside)}`)),
    figure("drift", "Drift, on its way to an alarm", drift),
    figure("model", "Model", big(`version ${doing.version}`), small(`Retrains: ${number(ever.retrains)}, ${number(Object.values(ever.dropped).reduce((a, b) => a + b, 0))} dropped`),
      report && el("p", {}, `newest at ${clock(report.time)}, ${number(report.report.seconds, 2)} s`),
      el("p", {}, `Labels until the next retrain: ${number(doing.new_labels)} of ${number(doing.recipe.retrain_every)}`),
      Object.entries(ever.dropped).map(([reason, n]) => small(`Dropped ${number(n)}: ${reason}`))),
    figure("doing", "Mode", big(MODES[modeOf(doing)]), small(`Tolerance ${percent(ever.bad_accepts.tolerance)}, alpha ${number(doing.recipe.policy.alpha, 2)}`),
      el("p", {}, `Waiting for a result: ${number(ever.unlabelled)}`),
      el("p", {}, `Model errors: ${number(newest.errors)} · Bad traces, kept out of training: ${number(newest.quarantined)}`)),
  ];
  const rows = course.stretches.map((each) => [moment(each.last), number(each.n), percent(each.verified / each.n), number(each.accepted), number(each.false_accepts)]).reverse();
  const lines = card("course", "From the first part to the newest", course.stretches.length === 0
    ? small("Drawn once a part was decided on.")
    : [courseChart(course), el("details", { id: "course-table" }, el("summary", {}, "The same as a table"),
      table([["Until"], ["Parts", "num"], ["Verified", "num"], ["Accepted", "num"], ["Bad accepted", "num"]], rows))]);
  const happened = card("events", "What happened", events.length
    ? el("ol", { class: "story" }, events.map((each) => el("li", {}, el("time", {}, moment(each.time)), " ", el("b", {}, each.kind), each.author && ` · ${each.author}`,
      el("br"), each.text.replace(/\b([0-9a-f]{12})[0-9a-f]{28,}\b/g, "$1…"))))
    : small("Nothing beside decisions, labels and retrains."));
  return { title: "Overview", shown: [el("h1", {}, "Overview"), escapes, el("div", { class: "tiles" }, tiles), el("div", { class: "split" }, el("div", { class: "stack" }, lines, await trend(get, query.get("by"), decisions)), happened)] };
}

async function map(get, query, doing) {
  const chosen = query.get("id") ?? "";
  const [found, part] = await Promise.all([get("embedding"), chosen ? explanation(get, chosen, doing).catch(() => null) : null]);
  const legend = [["good", "●", "good"], ["bad", "✕", "bad"], ["none", "■", "not known"], ["", "○", "newest parts"]].map(([kind, sign, text]) =>
    el("li", { class: kind && `label ${kind}` }, el("span", { "aria-hidden": "true" }, sign), text));
  if (found.radius !== null) legend.push(el("li", {}, el("span", { class: "swatch ring", "aria-hidden": "true" }), "ball in which labels are counted"));
  const rows = found.marks.slice(-40).reverse().map((mark) => [el("a", { href: partAddress(mark.id, "map") }, nameOf(mark.part, mark.id)), label(mark.success)]);
  const picture = el("section", { class: "card", id: "map", "data-part": true, "aria-label": "Map of the parts" }, found.marks.length === 0
    ? el("p", { class: "waiting" }, "The map is drawn once the first model is trained.")
    : [small("Parts whose traces look alike to the model lie together. Choose one to see its trace and its history."),
      mapChart(found, chosen), el("ul", { class: "legend" }, legend),
      el("details", { id: "map-list" }, el("summary", {}, "The newest parts of the map as a list"), table([["Part"], ["Label"]], rows))]);
  const beside = el("section", { class: "card part", id: "part", "data-part": true, "aria-labelledby": "part-title" }, part
    ? [el("h2", { id: "part-title", tabindex: -1 }, `Part ${nameOf(part.decision.part, part.decision.id)}`), detail(part, 3)]
    : el("h2", { id: "part-title", tabindex: -1, class: "muted" }, "No part is chosen."));
  return { title: "Map", shown: [el("h1", {}, "Map of the parts"), el("div", { class: "split" }, picture, beside)] };
}

async function part(get, query, doing) {
  const found = await explanation(get, query.get("id") ?? "", doing);
  const name = nameOf(found.decision.part, found.decision.id);
  return { title: `Part ${name}`, shown: [el("article", { class: "card part", id: "part", "data-part": true }, el("h1", {}, `Part ${name}`), detail(found, 2))] };
}

const FILTERS = [["action", "Decision", ACTIONS, capital], ["reason", "Reason", REASON_NAMES, reasonOf], ["label", "Label", LABEL_NAMES, labelWord]];
const TIMES = [["since", "From"], ["until", "Until"]];

async function history(get, query) {
  const asked = new URLSearchParams([...query].map(([name, value]) => [name, value.trim()]).filter(([, value]) => value !== ""));
  const wanted = new URLSearchParams(asked);
  for (const [name] of TIMES) if (asked.has(name)) wanted.set(name, new Date(asked.get(name)).getTime() / 1000);
  wanted.set("limit", 50);
  const { decisions, older } = await get(`decisions?${wanted}`);
  const choices = FILTERS.map(([name, title, values, word]) => el("p", { class: "field" }, el("label", { for: `filter-${name}` }, title),
    el("select", { id: `filter-${name}`, name }, el("option", { value: "" }, "all"), values.map((value) => el("option", { value, selected: asked.get(name) === value }, word(value))))));
  const typed = [["part", "Part's number", "text"], ...TIMES.map((each) => [...each, "datetime-local"])].map(([name, title, type]) =>
    el("p", { class: "field" }, el("label", { for: `filter-${name}` }, title), el("input", { id: `filter-${name}`, type, name, value: asked.get(name) ?? "" })));
  const form = el("form", { class: "card filters", method: "get", action: "history", "aria-label": "Filters", id: "filters" }, choices, typed,
    el("p", { class: "buttons" }, el("button", { class: "main" }, "Show"), el("a", { href: "history" }, "Show all")));
  const titles = [["Time"], ["Part"], ["Decision"], ["Reason", "more"], ["Label"], ["Bound", "num more"], ["Good / bad near it", "num more"], ["Model", "num more"]];
  const rows = decisions.map((each) => [
    el("time", {}, el("span", { class: "more" }, moment(each.time)), el("span", { class: "less" }, clock(each.time))),
    el("a", { href: partAddress(each.id) }, nameOf(each.part, each.id)), chip(each.action), reasonOf(each.reason), label(each.success),
    `${percent(each.lower)} – ${percent(each.upper)}`, `${number(each.n_success)} / ${number(each.n_failure)}`, number(each.model_version),
  ]);
  const next = new URLSearchParams(asked);
  if (older) next.set("before", older);
  const shown = el("section", { class: "card", id: "history", "data-part": true, "aria-label": "History" }, decisions.length === 0
    ? small("No decision fits.")
    : [table(titles, rows, { class: "decisions" }), el("p", { class: "buttons" }, `${number(decisions.length)} decision${decisions.length === 1 ? "" : "s"} shown.`,
      asked.has("before") && el("a", { href: "history" }, "Newest"), older && el("a", { rel: "next", href: `history?${next}` }, "Older"),
      el("button", { type: "button", id: "as-csv", onclick: () => act.download(asCsv(decisions), "decisions.csv") }, "Download these as CSV"))]);
  return { title: "History", shown: [el("h1", {}, "History"), form, shown] };
}

function asCsv(decisions) {
  const names = Object.keys(decisions[0]).filter((name) => name !== "embedding" && name !== "trace");
  const shown = (name, value) => (/time$/.test(name) && value !== null ? new Date(1000 * value).toISOString() : value);
  const text = (value) => {
    const plain = value === null || value === undefined ? "" : String(value);
    const safe = typeof value === "string" && /^[=+\-@\t\r]/.test(plain) ? `'${plain}` : plain; // a spreadsheet takes these for formulas
    return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };
  const lines = decisions.map((each) => names.map((name) => text(shown(name, each[name]))).join(","));
  return new Blob([[names.join(","), ...lines, ""].join("\n")], { type: "text/csv" });
}

async function actions(get, _, doing) {
  const { versions } = await get("versions");
  const back = versions.filter(({ report, kept }) => report.accepted && kept && report.version !== doing.version).reverse();
  const choices = back.map(({ report, time }) => [report.version, `${report.version}: ${moment(time)}`]);
  const block = (name, action, off = false, because = "") => el("section", { class: "card act", "aria-labelledby": `act-${name}` }, el("h2", { id: `act-${name}` }, action.title),
    el("p", {}, action.what), off && small(because), el("p", { class: "buttons" }, act.button(`do-${name}`, action.title, action, off)));
  const shown = el("div", { class: "acts", id: "actions", "data-part": true },
    block("shadow", act.shadow(!doing.shadow)), block("report", act.reportPart),
    block("rollback", act.rollback(choices), !back.length, "There is no earlier version to go back to."),
    block("policy", act.policy(doing.recipe.policy)), block("retrain", act.retrain),
    block("export", act.exported, doing.version === 0, "There is something to export once the first model is trained."));
  return { title: "Actions", shown: [el("h1", {}, "Actions"), small("Each is confirmed, carries your name, and stays in the event log. A label is put right where its part is shown."), shown] };
}

export const VIEWS = { "": now, overview, map, part, history, actions };
