// The page's main module: after each change it gets the view's data again, and replaces the parts of the view that differ.

import { initActions, setOwner } from "./actions.js";
import { drawAll, moveOnMap } from "./charts.js";
import { clock, el } from "./dom.js";
import { Problem, get, listen } from "./server.js";
import { VIEWS, modeOf, modeWord, warnings } from "./views.js";

const MIN_PAUSE = 400; // ms between two refreshes
const PAUSE_FACTOR = 3; // the pause is at least this many times the duration of a refresh
const ANNOUNCE_PAUSE = 8000; // ms between two announcements to a screen reader
const CONNECTION = { live: "Live", cut: "Cut off", connecting: "Connecting …" };

const at = (id) => document.getElementById(id);
const main = at("main");
const view = location.pathname.split("/").pop();
const written = new Map(); // HTML of each part of the view; an unchanged part is kept, and so is the focus in it
let timer = null;
let due = Infinity; // time of the next refresh
let refreshing = null; // promise of the refresh that is under way
let notBefore = 0;
let lastAnnouncement = 0;

// Show whether the page is connected, with the time of the last event.
function showConnection(state, lastEvent) {
  if (at("link").dataset.state === state) return;
  at("link").dataset.state = state;
  at("link").querySelector(".text").textContent = CONNECTION[state];
  const old = state === "cut";
  document.body.classList.toggle("old", old);
  at("cut").hidden = !old;
  at("cut").textContent = old ? `Cut off since ${clock(lastEvent / 1000)}. What you see is old. The page tries to connect again.` : "";
}

// Refresh after `wait` ms, or as soon as the pause allows.
function scheduleRefresh(wait = 0) {
  const wanted = Math.max(Date.now() + wait, notBefore);
  if (document.hidden || wanted >= due) return;
  clearTimeout(timer);
  due = wanted;
  timer = setTimeout(() => { due = Infinity; refresh(); }, wanted - Date.now());
}

async function refresh() {
  // One refresh at a time; a call during one waits and refreshes again.
  if (refreshing) {
    await refreshing;
    return refresh();
  }
  refreshing = refreshView();
  try {
    await refreshing;
  } finally {
    refreshing = null;
  }
}

// Get the data of the view, and show them.
async function refreshView() {
  const begin = Date.now();
  const reusedUntil = [];
  const getData = (path) => get(path, reusedUntil);
  try {
    const [status, me] = await Promise.all([getData(view === "overview" ? "status?watch=true" : "status"), getData("me")]);
    setOwner(me);
    showHeader(status, me);
    const { title, elements } = await VIEWS[view](getData, new URLSearchParams(location.search), status);
    replaceView(elements);
    document.title = `${title} · ${status.cell === "cell" ? "" : `Cell ${status.cell} · `}dengine`;
  } catch (error) {
    if (error instanceof Problem) showProblem(error);
    else if (error instanceof TypeError && error.message.includes("etch")) showConnection("cut", begin); // the server is unreachable
    else throw error;
  }
  notBefore = Date.now() + Math.max(MIN_PAUSE, PAUSE_FACTOR * (Date.now() - begin));
  if (reusedUntil.length) scheduleRefresh(Math.min(...reusedUntil) - Date.now()); // reused data may be old
}

function showProblem(problem) {
  if (problem.status === 404 || problem.status === 422) { // another request would not help
    replaceView([el("section", { class: "card", id: "failed", "data-part": true }, el("h1", {}, "That cannot be shown"), el("p", {}, problem.message), el("p", {}, el("a", { href: "./" }, "Back to the newest part")))]);
    return;
  }
  at("banner").replaceChildren(el("p", { class: "banner" }, problem.message));
  scheduleRefresh(2000);
}

// Replace the children of an element, unless they are unchanged.
function put(id, children, kind) {
  const html = el("div", {}, children).innerHTML;
  if (written.get(id) === html) return;
  written.set(id, html);
  at(id).replaceChildren(...children);
  if (kind) at(id).className = kind;
}

function showHeader(status, me) {
  const mode = modeOf(status);
  put("cell", [status.cell === "cell" ? "" : `Cell ${status.cell}`]);
  put("mode", [el("span", { class: "visually-hidden" }, "Mode: "), ...modeWord(mode)], `mode ${mode}`);
  put("banner", warnings(status));
  put("me", [me.name && `Logged in: ${me.name}. `, me.operates ? "" : "A viewer's token: it can read, and change nothing."]);
}

// Show the elements of a view: replace the parts that differ, or all if it has other parts. The focus stays.
function replaceView(elements) {
  const fresh = el("div", {}, elements);
  const parts = [...fresh.querySelectorAll("[data-part]")];
  const focused = document.activeElement?.id;
  const same = parts.length > 0 && parts.length === main.querySelectorAll("[data-part]").length && parts.every((part) => at(part.id)?.hasAttribute("data-part"));
  if (!same) main.replaceChildren(...fresh.children);
  for (const part of parts) {
    const html = part.outerHTML;
    if (same && written.get(part.id) === html) continue;
    written.set(part.id, html);
    if (same) replacePart(at(part.id), part);
    if (part.dataset.spoken) announce(part.dataset.spoken);
  }
  drawAll();
  if (focused && document.activeElement?.id !== focused) at(focused)?.focus({ preventScroll: true });
}

// Replace a part of the view; details that are open stay open.
function replacePart(old, part) {
  const open = [...old.querySelectorAll("details[open]")].map((details) => details.id);
  old.replaceWith(part);
  for (const id of open) if (at(id)) at(id).open = true;
}

// Let a screen reader say a text, not too often.
function announce(text) {
  if (Date.now() - lastAnnouncement < ANNOUNCE_PAUSE) return;
  lastAnnouncement = Date.now();
  at("spoken").textContent = text;
}

// The map: a part is chosen without leaving the page

document.addEventListener("keydown", moveOnMap);
document.addEventListener("click", async (event) => {
  const link = event.target.closest?.("#map a[href]");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  history.replaceState(null, "", link.getAttribute("href"));
  await refresh();
  at("part-title")?.focus();
});

// Appearance: as the device's setting, or as chosen here

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  for (const button of document.querySelectorAll(".appearance button")) button.setAttribute("aria-pressed", String(button.dataset.theme === theme));
  drawAll(true);
}

for (const button of document.querySelectorAll(".appearance button")) {
  button.addEventListener("click", () => {
    localStorage.setItem("dengine_theme", button.dataset.theme);
    setTheme(button.dataset.theme);
  });
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drawAll(true));
setTheme(localStorage.getItem("dengine_theme") ?? "auto");

for (const link of document.querySelectorAll("header nav a")) {
  if (link.pathname === location.pathname) link.setAttribute("aria-current", "page");
}
document.addEventListener("visibilitychange", () => scheduleRefresh());
initActions(refresh);
listen(scheduleRefresh, showConnection);
