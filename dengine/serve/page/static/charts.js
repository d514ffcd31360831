// Charts: traces and the course of decisions with uPlot, bounds and the map as SVG. Each has a caption that says the same in words.

import { capital, el, interval, labelOf, labelWord, nameOf, number, partAddress, percent, svg } from "./dom.js";

const CHANNELS = 3; // channels drawn: those farthest outside the band
const HEIGHTS = [151, 80, 64]; // of each chart inside its axes, by the number of charts: the figures below stay above the fold
const drawn = new Map(); // by a chart's element: its uPlot, and the observer of its width
const probe = document.createElement("span");

function colour(name) {
  if (!probe.isConnected) document.body.append(probe);
  probe.hidden = true;
  probe.style.color = `var(--${name})`;
  return getComputedStyle(probe).color; // the current one of light-dark()
}

function chart(key, alt, height, makePlot) {
  // makePlot returns uPlot's options and data. It is called when the chart is in the page, and again for another appearance.
  const node = el("div", { class: "chart", role: "img", "aria-label": alt, "data-chart": key });
  node.make = () => {
    const { options, data } = makePlot();
    const size = () => ({ width: Math.max(200, node.clientWidth), height });
    const plot = new uPlot({ ...size(), legend: { show: false }, cursor: { y: false, drag: { setScale: false } }, ...options }, data, node);
    const watch = new ResizeObserver(() => plot.setSize(size()));
    watch.observe(node);
    drawn.set(node, { plot, watch });
  };
  return node;
}

export function drawAll(anew = false) {
  // Draw new charts, and destroy those that are not in the page any more.
  for (const [node, { plot, watch }] of drawn) {
    if (node.isConnected && !anew) continue;
    watch.disconnect();
    plot.destroy();
    drawn.delete(node);
  }
  for (const node of document.querySelectorAll("[data-chart]")) if (!drawn.has(node)) node.make();
}

function axis(side, given = {}) {
  const ink = colour("muted");
  const grid = { stroke: colour("edge"), width: 1 };
  return { side, stroke: ink, font: "14px system-ui, sans-serif", labelFont: "14px system-ui, sans-serif", grid, ticks: grid, ...given };
}

// Traces, and over them the operator's force limits, in the stretches of time where they hold. Times are in samples if the rate is unknown.

const timeOf = ({ rate_hz }, sample) => sample / (rate_hz ?? 1);

const timeText = ({ rate_hz }, time, digits) => (rate_hz === null ? `${number(time)} samples` : `${number(time, digits)} s`);

// Return the force limits of a channel, with the times between which they hold.
function limitsOf(explanation, channel) {
  const { spec, spec: { columns } } = explanation;
  const at = (named) => (typeof named === "string" ? columns.indexOf(named) : named);
  return explanation.limits.filter((each) => at(each.channel) === channel).map((each) => {
    if (each.along === null) return { ...each, from: each.start, to: each.end };
    const there = explanation.trace[at(each.along)].flatMap((at, i) => (at !== null && at >= each.start && at <= each.end ? [timeOf(spec, i)] : []));
    return { ...each, from: there[0], to: there.at(-1) };
  }).filter((each) => each.from !== undefined);
}

// Draw force limits as brackets; the bent ends point to the side that is not allowed.
function drawLimits({ ctx, bbox, valToPos }, limits) {
  ctx.save();
  ctx.strokeStyle = colour("link");
  ctx.lineWidth = 2 * devicePixelRatio;
  ctx.beginPath();
  for (const { from, to, low, high } of limits) {
    const [left, right] = [from, to].map((time) => Math.min(Math.max(valToPos(time, "x", true), bbox.left), bbox.left + bbox.width));
    for (const [limit, outwards] of [[high, -1], [low, 1]]) {
      if (limit === null) continue;
      const y = valToPos(limit, "y", true);
      const tip = y + 8 * outwards * devicePixelRatio;
      ctx.moveTo(left, tip);
      ctx.lineTo(left, y);
      ctx.lineTo(right, y);
      ctx.lineTo(right, tip);
    }
  }
  ctx.stroke();
  ctx.restore();
}

function limitsText(spec, { from, to, low, high, reject }) {
  const limits = [low !== null && `at least ${number(low, 1)}`, high !== null && `at most ${number(high, 1)}`].filter(Boolean).join(" and ");
  return `From ${timeText(spec, from, 2)} to ${timeText(spec, to, 2)} the operator's limits are ${limits}, else ${reject ? "reject" : "verify"}. `;
}

const unitOf = ({ unit }, channel) => (Array.isArray(unit) ? unit[channel] : unit ?? "");

export const isForce = ({ channels, unit }) => channels === 1 && /^[µmckM]?N$/.test(unit);

export function traceCharts(explanation) {
  const { low, high } = explanation;
  const isOutside = (value, channel, i) => low && value !== null && (value < low[channel][i] || value > high[channel][i]);
  const outside = explanation.trace.map((values, channel) => values.filter((value, i) => isOutside(value, channel, i)).length);
  const order = outside.map((_, channel) => channel).sort((a, b) => outside[b] - outside[a] || a - b);
  const shown = order.slice(0, CHANNELS).sort((a, b) => a - b);
  const isLast = (i) => i === shown.length - 1;
  return shown.map((channel, i) => traceChart(explanation, channel, HEIGHTS[shown.length - 1] + (isLast(i) ? 69 : 25), isLast(i)));
}

// Only the lowest chart has the numbers of the time axis, for they are one below the other.
function traceChart(explanation, channel, height, isLast) {
  const trace = explanation.trace[channel];
  const band = explanation.low && [explanation.high[channel], explanation.low[channel], explanation.median[channel]];
  const bads = explanation.bads.map((bad) => bad[channel]);
  const limits = limitsOf(explanation, channel);
  const levels = limits.flatMap(({ low, high }) => [low, high]).filter((limit) => limit !== null);
  const key = [explanation.decision.id, channel, explanation.envelope?.n, bads.length, JSON.stringify(limits)].join(" ");
  const caption = traceCaption(explanation, channel);
  const line = (name, width, dash) => ({ stroke: colour(name), width, dash, points: { show: false } });
  const makePlot = () => ({
    data: [trace.map((_, i) => timeOf(explanation.spec, i)), ...(band ?? []), ...bads, trace],
    options: {
      scales: { x: { time: false }, y: { range: (_, low, high) => uPlot.rangeNum(Math.min(low, ...levels), Math.max(high, ...levels), 0.1, true) } },
      hooks: { draw: [(plot) => drawLimits(plot, limits)] },
      axes: [
        axis(2, isLast ? { label: explanation.spec.rate_hz === null ? "samples" : "time in s", size: 32, labelSize: 20, labelGap: -4 } : { size: 8, values: (_, splits) => splits.map(() => "") }),
        axis(3, { label: unitOf(explanation.spec, channel), labelSize: 22, size: 56, space: 20 }),
      ],
      bands: band ? [{ series: [1, 2], fill: colour("good-soft") }] : [],
      series: [
        {},
        ...(band ? [line("good-soft", 0), line("good-soft", 0), line("good", 1.6)] : []),
        ...bads.map(() => line("bad", 1, [7, 4])),
        line("trace", 2.4),
      ],
    },
  });
  return el("figure", {}, chart(key, caption, height, makePlot), el("figcaption", {}, caption));
}

function traceCaption(explanation, channel) {
  const { envelope, spec } = explanation;
  const values = explanation.trace[channel].filter((value) => value !== null);
  const [low, high] = values.length ? [Math.min(...values), Math.max(...values)] : [0, 0];
  const several = explanation.trace.length > 1;
  const what = isForce(spec) ? "Force" : spec.columns[channel] ?? (several ? `Channel ${channel}` : "Trace");
  const duration = timeText(spec, timeOf(spec, explanation.trace[channel].length), 1);
  const range = `${number(low, 1)} to ${number(high, 1)} ${unitOf(spec, channel)}`.trim();
  const limits = limitsOf(explanation, channel).map((each) => limitsText(spec, each)).join("");
  const caption = `${what} over ${duration}, from ${range}. ${limits}`;
  if (!envelope) return `${caption}The band of good parts is drawn from 20 good parts on.`;
  return `${caption}${percent(envelope.outside, 1)} of ${several ? "all channels" : "it"} lies outside the band of good parts.`;
}

export function traceLegend(explanation) {
  const { envelope } = explanation;
  const swatch = (kind, text) => el("li", {}, el("span", { class: `swatch ${kind}`, "aria-hidden": "true" }), text);
  return el("ul", { class: "legend" },
    swatch("line-trace", "this part"),
    envelope && [swatch("area-band", `95 % of ${number(envelope.n)} good parts`), swatch("line-median", "their median")],
    explanation.bads.length > 0 && swatch("line-bad", `bad parts (${number(explanation.bads.length)})`),
    explanation.limits.length > 0 && swatch("line-window", `operator's limits (${number(explanation.limits.length)})`));
}

// The course of decisions

export function courseChart(course) {
  const ends = [0];
  for (const each of course.stretches) ends.push(ends.at(-1) + each.n);
  const share = (name) => [...course.stretches, course.stretches.at(-1)].map((each) => each[name] / each.n);
  const [verified, accepted, novel] = ["verified", "accepted", "novel"].map(share);
  const after = (time) => ends[course.stretches.filter((each) => each.last <= time).length];
  const caption = `Share of verified parts over time: it was ${percent(verified[0])} at first and is ${percent(verified.at(-1))} now; accepted without a check now: ${percent(accepted.at(-1))}.`;

  function marks(plot) {
    const { ctx, bbox } = plot;
    const at = (x) => plot.valToPos(x, "x", true);
    const size = 5 * devicePixelRatio;
    ctx.save();
    ctx.setLineDash([]);
    ctx.fillStyle = colour("muted");
    for (const x of new Set(course.retrains.map((each) => at(after(each.time))))) {
      ctx.beginPath();
      ctx.moveTo(x - size, bbox.top + bbox.height);
      ctx.lineTo(x, bbox.top + bbox.height - 2 * size);
      ctx.lineTo(x + size, bbox.top + bbox.height);
      ctx.fill();
    }
    ctx.strokeStyle = colour("bad");
    ctx.lineWidth = 3 * devicePixelRatio;
    course.stretches.forEach((each, i) => {
      if (!each.false_accepts) return;
      const [x, y] = [at((ends[i] + ends[i + 1]) / 2), bbox.top + 2 * size];
      ctx.beginPath();
      ctx.moveTo(x - size, y - size);
      ctx.lineTo(x + size, y + size);
      ctx.moveTo(x + size, y - size);
      ctx.lineTo(x - size, y + size);
      ctx.stroke();
    });
    ctx.restore();
  }

  const paths = (...given) => uPlot.paths.stepped({ align: 1 })(...given);
  const line = (name, width, dash) => ({ stroke: colour(name), width, dash, paths, points: { show: false } });
  const makePlot = () => ({
    data: [ends, verified, accepted, novel],
    options: {
      scales: { x: { time: false }, y: { range: [0, 1] } },
      axes: [axis(2, { label: "parts", size: 32, labelSize: 20, labelGap: -4 }), axis(3, { size: 62, values: (_, ticks) => ticks.map((tick) => percent(tick)) })],
      series: [{}, line("open", 3), line("good", 2, [8, 3]), line("muted", 1.5, [2, 3])],
      hooks: { draw: [marks] },
    },
  });
  const legend = [["line-verified", "verified"], ["line-accepted", "accepted"], ["line-novel", "novel"]].map(([kind, text]) =>
    el("li", {}, el("span", { class: `swatch ${kind}`, "aria-hidden": "true" }), text));
  legend.push(el("li", {}, el("span", { "aria-hidden": "true" }, "▲"), "retrain"));
  legend.push(el("li", { class: "label bad" }, el("span", { "aria-hidden": "true" }, "✕"), "bad accepted"));
  return [el("figure", {}, chart(JSON.stringify(course.stretches.map((each) => each.n)) + ends.at(-1) + course.retrains.length, caption, 260, makePlot), el("figcaption", {}, caption)),
    el("ul", { class: "legend" }, legend)];
}

// Bounds: a bar over the zones in which a part is accepted or rejected

export function boundChart(bound) {
  const zones = [];
  const marks = [];
  if (bound.reject_threshold !== null) {
    zones.push([0, bound.reject_threshold, "reject"]);
    marks.push(["✕ ≤", bound.reject_threshold]);
  }
  if (bound.accept_threshold !== null) {
    zones.push([bound.accept_threshold, 1, "accept"]);
    marks.push(["✓ ≥", bound.accept_threshold]);
  }
  const caption = `The success rate lies between ${interval(bound.lower, bound.upper, 1).join(" and ")}. Accepted from ${percent(bound.accept_threshold, 1)} on, rejected up to ${percent(bound.reject_threshold, 1)}.`;
  return intervalBar(1, bound.lower, bound.upper, zones, marks, caption);
}

export function judgedChart(judged) {
  const most = Math.min(1, Math.max(0.02, 2 * judged.tolerance, 1.1 * judged.upper));
  const caption = `The share of wrong ones lies between ${interval(judged.lower, judged.upper, 1).join(" and ")}; the tolerance is ${percent(judged.tolerance, 1)}.`;
  return intervalBar(most, judged.lower, judged.upper, [[0, judged.tolerance, "accept"]], [["≤", judged.tolerance]], caption);
}

function intervalBar(most, lower, upper, zones, marks, caption) {
  const [begin, end, middle] = [16, 464, 42];
  const x = (value) => begin + (Math.min(value, most) / most) * (end - begin);
  const bar = (low, high, half, least, kind) =>
    svg("rect", { x: x(low), y: middle - half, width: Math.max(least, x(high) - x(low)), height: 2 * half, class: kind });
  const places = marks.map(([, value]) => Math.min(Math.max(x(value), begin + 44), end - 44));
  const text = (words, at, kind) => svg("text", { x: at, y: 88, class: kind, "aria-hidden": "true" }, words);
  const ends = [[0, begin, "start"], [most, end, "end"]].filter(([, at]) => places.every((place) => Math.abs(at - place) > 110));
  return svg("svg", { viewBox: "0 0 480 96", role: "img", "aria-label": caption, class: "bound" },
    bar(0, most, 20, 0, "axis"),
    zones.map(([low, high, kind]) => bar(low, high, 20, 1, `zone ${kind}`)),
    bar(lower, upper, 7, 3, "interval"),
    [lower, upper].map((value) => svg("line", { x1: x(value), x2: x(value), y1: middle - 15, y2: middle + 15, class: "interval-end" })),
    marks.map(([sign, value], i) => text(`${sign} ${percent(value)}`, places[i], "middle strong")),
    ends.map(([value, at, kind]) => text(percent(value), at, kind)));
}

// The map: every mark is a link to its part; the tab key reaches one of them, and arrow keys the others

const WIDE = 720;
const HIGH = 500;
const ROOM = 24;

export function mapChart(partMap, chosen) {
  const xs = partMap.marks.map((mark) => mark.x);
  const ys = partMap.marks.map((mark) => mark.y).sort((a, b) => a - b);
  const cut = Math.floor(ys.length * 0.005); // the outermost parts are drawn on the edge
  const across = scale(partMap.probability ? [0, 1] : [Math.min(...xs), Math.max(...xs)], [ROOM, WIDE - ROOM]);
  const up = scale([ys[cut], ys.at(-1 - cut)], [HIGH - ROOM, ROOM]);
  const newest = partMap.marks.at(-1);
  const reached = partMap.marks.find((mark) => mark.id === chosen) ?? newest;
  const labelled = partMap.marks.filter((mark) => mark.action === null);
  const good = labelled.filter((mark) => mark.success).length;
  const caption = `Map of ${labelled.length} labelled parts, ${good} good and ${labelled.length - good} bad, and the newest ${partMap.marks.length - labelled.length}. Arrow keys move from part to part.`;
  const neighbourhood = partMap.radius !== null && svg("svg", { x: 0, y: 0, width: WIDE, height: HIGH, "aria-hidden": "true" },
    svg("ellipse", { cx: across(newest.x), cy: up(newest.y), rx: partMap.radius * across.per, ry: partMap.radius * up.per, class: "neighbourhood" }));
  const name = partMap.probability ? "model's probability of a good part" : "first axis";
  return svg("svg", { viewBox: `0 0 ${WIDE} ${HIGH + 26}`, role: "group", "aria-label": caption, class: "map" },
    svg("rect", { x: 1, y: 1, width: WIDE - 2, height: HIGH - 2, class: "axis" }),
    svg("text", { x: WIDE - 4, y: HIGH + 20, class: "end", "aria-hidden": "true" }, `${name} →`),
    neighbourhood,
    partMap.marks.map((mark) => mapMark(mark, across(mark.x), up(mark.y), mark === reached, mark.id === chosen, mark === newest)));
}

function scale([low, high], [begin, end]) {
  const per = (end - begin) / (high - low || 1);
  const place = (value) => Number((begin + (Math.min(Math.max(value, low), high) - low) * per).toFixed(1));
  place.per = Math.abs(per);
  return place;
}

function mapMark(mark, x, y, reached, chosen, newest) {
  const kind = labelOf(mark.success);
  const name = [nameOf(mark.part, mark.id), mark.action && capital(mark.action), labelWord(kind)].filter(Boolean).join(", ");
  const shapes = {
    good: () => svg("circle", { cx: x, cy: y, r: 5.6, class: "shape" }),
    bad: () => svg("path", { d: `M${x - 7} ${y - 7}l14 14m-14 0l14 -14`, class: "shape cross" }),
    none: () => svg("rect", { x: x - 5, y: y - 5, width: 10, height: 10, class: "shape" }),
  };
  return svg("a", {
    href: partAddress(mark.id, "map"), id: `mark-${mark.id}`, "data-id": mark.id, "data-x": x, "data-y": y,
    class: ["mark", kind, mark.action && "recent", newest && mark.action && "newest", chosen && "chosen"].filter(Boolean).join(" "),
    tabindex: reached ? 0 : -1, "aria-label": name, "aria-current": chosen ? "true" : null,
  },
  svg("title", {}, name),
  svg("circle", { cx: x, cy: y, r: 10.5, class: "hit" }),
  mark.action && svg("circle", { cx: x, cy: y, r: newest ? 15 : 11, class: "ring" }),
  shapes[kind]());
}

const DIRECTIONS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export function moveOnMap(event) {
  // Move the focus with the arrow keys to the nearest mark in their direction.
  const mark = event.target.closest?.("a.mark");
  const direction = DIRECTIONS[event.key];
  if (!mark || !direction) return;
  event.preventDefault();
  const next = nearest(mark, direction);
  if (!next) return;
  mark.setAttribute("tabindex", "-1");
  next.setAttribute("tabindex", "0");
  next.focus();
}

function nearest(mark, [dx, dy]) {
  const place = (each) => [Number(each.dataset.x), Number(each.dataset.y)];
  const [x, y] = place(mark);
  let best = null;
  let least = Infinity;
  for (const each of mark.parentNode.querySelectorAll("a.mark")) {
    const [ax, ay] = [place(each)[0] - x, place(each)[1] - y];
    const along = ax * dx + ay * dy;
    const beside = Math.abs(ax * dy) + Math.abs(ay * dx);
    if (each === mark || along <= 0 || beside > 2 * along + 1) continue;
    if (along + 2 * beside < least) [best, least] = [each, along + 2 * beside];
  }
  return best;
}
