// The page keeps itself new: told of a change it asks the server again, and puts in the parts of the view that differ.

import { begin, ownedBy } from "./actions.js";
import { drawAll, goOverMap } from "./charts.js";
import { clock, el } from "./dom.js";
import { Problem, get, listen } from "./server.js";
import { VIEWS, modeOf, modeWord, warnings } from "./views.js";

const PACE = 400; // ms between two looks, and as many times as long as a look took
const BUSY = 3;
const SPEAK = 8000; // ms between two announcements
const LINE = { live: "Live", cut: "Cut off", connecting: "Connecting …" };

const at = (id) => document.getElementById(id);
const main = at("main");
const view = location.pathname.split("/").pop();
const written = new Map(); // each part of the view as it was put in: one that is still the same stays, and so does the focus in it
let timer = null;
let due = Infinity; // when the next look is
let looking = null;
let notBefore = 0;
let spoke = 0;

function lineIs(state, heard) {
  if (at("link").dataset.state === state) return;
  at("link").dataset.state = state;
  at("link").querySelector(".text").textContent = LINE[state];
  const old = state === "cut";
  document.body.classList.toggle("old", old);
  at("cut").hidden = !old;
  at("cut").textContent = old ? `Cut off since ${clock(heard / 1000)}. What you see is old. The page keeps trying.` : "";
}

function look(wait = 0) {
  const wanted = Math.max(Date.now() + wait, notBefore);
  if (document.hidden || wanted >= due) return;
  clearTimeout(timer);
  due = wanted;
  timer = setTimeout(() => { due = Infinity; refresh(); }, wanted - Date.now());
}

async function refresh() {
  // One look at a time; who asks meanwhile has the next one.
  if (looking) {
    await looking;
    return refresh();
  }
  looking = exchangeAll();
  try {
    await looking;
  } finally {
    looking = null;
  }
}

async function exchangeAll() {
  const begun = Date.now();
  const rests = [];
  const ask = (path) => get(path, rests);
  try {
    const [doing, me] = await Promise.all([ask(view === "overview" ? "status?watch=true" : "status"), ask("me")]);
    ownedBy(me);
    header(doing, me);
    const { title, shown } = await VIEWS[view](ask, new URLSearchParams(location.search), doing);
    exchange(shown);
    document.title = `${title} · ${doing.cell === "cell" ? "" : `Cell ${doing.cell} · `}dengine`;
  } catch (error) {
    if (error instanceof Problem) failed(error);
    else if (error instanceof TypeError && error.message.includes("etch")) lineIs("cut", begun); // the server is away
    else throw error;
  }
  notBefore = Date.now() + Math.max(PACE, BUSY * (Date.now() - begun));
  if (rests.length) look(Math.min(...rests) - Date.now()); // what rests is old by now
}

function failed(problem) {
  if (problem.status === 404 || problem.status === 422) { // there is no such thing, and asking again changes nothing
    exchange([el("section", { class: "card", id: "failed", "data-part": true }, el("h1", {}, "That cannot be shown"), el("p", {}, problem.message), el("p", {}, el("a", { href: "./" }, "Back to what happens now")))]);
    return;
  }
  at("banner").replaceChildren(el("p", { class: "banner" }, problem.message));
  look(2000);
}

function put(id, children, kind) {
  const fresh = el("div", {}, children).innerHTML;
  if (written.get(id) === fresh) return;
  written.set(id, fresh);
  at(id).replaceChildren(...children);
  if (kind) at(id).className = kind;
}

function header(doing, me) {
  const mode = modeOf(doing);
  put("cell", [doing.cell === "cell" ? "" : `Cell ${doing.cell}`]);
  put("mode", [el("span", { class: "visually-hidden" }, "Mode: "), ...modeWord(mode)], `mode ${mode}`);
  put("banner", warnings(doing));
  put("me", [me.name && `Logged in: ${me.name}. `, me.operates ? "" : "A viewer's token: it looks, and changes nothing."]);
}

function exchange(shown) {
  const fresh = el("div", {}, shown);
  const parts = [...fresh.querySelectorAll("[data-part]")];
  const focused = document.activeElement?.id;
  const same = parts.length > 0 && parts.length === main.querySelectorAll("[data-part]").length && parts.every((part) => at(part.id)?.hasAttribute("data-part"));
  if (!same) main.replaceChildren(...fresh.children);
  for (const part of parts) {
    const text = part.outerHTML;
    if (same && written.get(part.id) === text) continue;
    written.set(part.id, text);
    if (same) replace(at(part.id), part);
    if (part.dataset.spoken) speak(part.dataset.spoken);
  }
  drawAll();
  if (focused && document.activeElement?.id !== focused) at(focused)?.focus({ preventScroll: true });
}

function replace(was, part) {
  const open = [...was.querySelectorAll("details[open]")].map((each) => each.id);
  was.replaceWith(part);
  for (const id of open) if (at(id)) at(id).open = true;
}

function speak(text) {
  if (Date.now() - spoke < SPEAK) return;
  spoke = Date.now();
  at("spoken").textContent = text;
}

// The map: a part is chosen without leaving the page

document.addEventListener("keydown", goOverMap);
document.addEventListener("click", async (event) => {
  const link = event.target.closest?.("#map a[href]");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  history.replaceState(null, "", link.getAttribute("href"));
  await refresh();
  at("part-title")?.focus();
});

// Appearance: as the device has it, or as it was chosen here

function appear(theme) {
  document.documentElement.dataset.theme = theme;
  for (const each of document.querySelectorAll(".appearance button")) each.setAttribute("aria-pressed", String(each.dataset.theme === theme));
  drawAll(true);
}

for (const each of document.querySelectorAll(".appearance button")) {
  each.addEventListener("click", () => {
    localStorage.setItem("dengine_theme", each.dataset.theme);
    appear(each.dataset.theme);
  });
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drawAll(true));
appear(localStorage.getItem("dengine_theme") ?? "auto");

for (const link of document.querySelectorAll("header nav a")) {
  if (link.pathname === location.pathname) link.setAttribute("aria-current", "page");
}
document.addEventListener("visibilitychange", () => look());
begin(refresh);
listen(look, lineIs);
