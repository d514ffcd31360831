// Creates elements, and formats numbers, times and the engine's words. Text is never parsed as HTML.

const SVG = "http://www.w3.org/2000/svg";
const SHAPES = {
  accept: "M4 13l5 5L20 6",
  reject: "M5 5l14 14M19 5L5 19",
  verify: "M17 10.5a6.5 6.5 0 1 1-13 0a6.500 6.500 0 1 1 13 0M15.500 15.500L21 21",
  shield: "M12 3l8 3v6c0 5-3.500 8-8 9-4.500-1-8-4-8-9V6Z",
  open: "M12 3a9 9 0 1 0 .01 0M12 7v5.500l4 2", // a clock
  none: "M12 10a2 2 0 1 0 .01 0",
};
SHAPES.good = SHAPES.kept = SHAPES.accept;
SHAPES.bad = SHAPES.broken = SHAPES.reject;

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat(9).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

export const el = (name, given = {}, ...children) => fill(document.createElement(name), given, children);
export const svg = (name, given = {}, ...children) => fill(document.createElementNS(SVG, name), given, children);
export const icon = (name) => svg("svg", { class: "icon", viewBox: "0 0 24 24", "aria-hidden": "true" }, svg("path", { d: SHAPES[name] }));

export function number(value, digits = 0) {
  if (value === null || value === undefined) return "–";
  const text = Math.abs(value).toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return value < 0 && /[1-9]/.test(text) ? `−${text}` : text;
}

export const percent = (share, digits = 0) => (share === null || share === undefined ? "–" : `${number(100 * share, digits)}\u202f%`);

// The ends of an interval as texts, rounded outward: a bound that misses a threshold is never shown as the threshold.
export function interval(lower, upper, digits = 0) {
  if (lower === null || lower === undefined) return ["–", "–"];
  const scale = 100 * 10 ** digits;
  const rounded = (end, round) => percent(round(Number((end * scale).toFixed(9))) / scale, digits);
  return [rounded(lower, Math.floor), rounded(upper, Math.ceil)];
}

export function duration(seconds) {
  if (Math.abs(seconds) < 120) return `${number(seconds)} s`;
  return Math.abs(seconds) < 7200 ? `${number(seconds / 60)} min` : `${number(seconds / 3600, 1)} h`;
}

const twoDigits = (n) => String(n).padStart(2, "0");

export function clock(seconds) {
  const at = new Date(seconds * 1000);
  return `${twoDigits(at.getHours())}:${twoDigits(at.getMinutes())}:${twoDigits(at.getSeconds())}`;
}

export function moment(seconds) {
  const at = new Date(seconds * 1000);
  return `${at.getFullYear()}-${twoDigits(at.getMonth() + 1)}-${twoDigits(at.getDate())} ${clock(seconds)}`;
}

export const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

const REASONS = {
  not_finite: "samples missing", constant: "dead sensor", saturated: "sensor at its limit",
  too_large: "impossible values", no_model: "no model yet", no_store: "store unavailable", late: "timeout", outside: "outside the operator's limits",
};
const LABELS = { good: "good", bad: "bad", none: "not known" };
const SOURCES = { verification: "check", audit: "audit", stop: "line stop", confirmed: "confirmation", inspection: "inspection of a reject" };

export const ACTIONS = ["verify", "accept", "reject"];
export const REASON_NAMES = [
  "certain", "uncertain", "no_model", "audit", "not_finite", "constant", "saturated", "model_error", "novel", "safe_mode", "no_store", "late", "outside", "too_large",
];
export const LABEL_NAMES = Object.keys(LABELS);
export const reasonOf = (name) => REASONS[name] ?? name.replace("_", " ");
export const labelWord = (name) => LABELS[name];
export const labelOf = (success) => (success === null ? "none" : success ? "good" : "bad");
export const sourceOf = (name) => SOURCES[name] ?? name;
export const nameOf = (part, id) => part ?? id.slice(-12);
export const partAddress = (id, view = "part") => `${view}?id=${encodeURIComponent(id)}`;

export const chip = (action) => el("span", { class: `chip ${action}` }, icon(action), capital(action));
export const label = (success) => el("span", { class: `label ${labelOf(success)}` }, icon(labelOf(success)), labelWord(labelOf(success)));

export function table(titles, rows, given = {}) {
  // titles: [text, class] of each column; rows: arrays of cells in the same order.
  const head = titles.map(([title, kind]) => el("th", { scope: "col", class: kind }, title));
  const body = rows.map((row) => el("tr", {}, row.map((cell, i) => el("td", { class: titles[i][1] }, cell))));
  return el("table", given, el("thead", {}, el("tr", {}, head)), el("tbody", {}, body));
}
