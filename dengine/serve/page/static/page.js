// The page keeps itself new: told of a change it asks for the same view again, and puts in the parts that differ.
// Nothing else is needed from here but the dialog of the acts and the arrow keys on the map.

const body = document.body;
const words = body.dataset;
const PACE = { now: 400, how: 2000, map: 1500, history: 1000, acts: 1000, part: 1000 }; // ms between two looks
const SILENCE = 12000; // ms without a word, after which the line counts as cut: the server says something every 5 s
const SPEAK = 8000; // ms between two announcements

const view = body.className.match(/view-(\w+)/)[1];
const pace = PACE[view] ?? 1000;
const link = document.getElementById("link");
const cut = document.getElementById("cut");
const dialog = document.getElementById("confirm");
let heard = Date.now();
let looked = 0;
let waiting = null;
let looking = false;
let again = false;
let spoke = 0;
// What each part was when it was put in: one that is still the same stays, and so does the focus in it.
const written = new Map([...document.querySelectorAll("[data-part]")].map((part) => [part.id, part.outerHTML]));

function lineIs(state) {
  if (link.dataset.state === state) return;
  link.dataset.state = state;
  link.querySelector(".text").textContent = { live: words.live, cut: words.cut, connecting: words.connecting }[state];
  const old = state === "cut";
  body.classList.toggle("old", old);
  cut.hidden = !old;
  cut.textContent = old ? words.old.replace("TIME", new Date(heard).toLocaleTimeString(words.lang)) : "";
}

function heardOf() {
  heard = Date.now();
  lineIs("live");
}

function listen() {
  const source = new EventSource(`${words.root}/events`);
  source.addEventListener("hello", (event) => {
    heardOf();
    if (JSON.parse(event.data).boot !== words.boot) location.reload(); // another process: another token, other words
    else look();
  });
  source.addEventListener("changed", () => { heardOf(); look(); });
  source.addEventListener("tick", heardOf);
  source.addEventListener("error", () => {
    lineIs("cut");
    if (source.readyState === EventSource.CLOSED) setTimeout(listen, 2000); // refused, not only interrupted
  });
}

setInterval(() => { if (Date.now() - heard > SILENCE) lineIs("cut"); }, 1000);

function look() {
  if (waiting !== null || document.hidden) return;
  const wait = Math.max(0, looked + pace - Date.now());
  waiting = setTimeout(() => { waiting = null; refresh(); }, wait);
}

document.addEventListener("visibilitychange", look);

async function refresh(address = location.href) {
  if (looking) { again = true; return; }
  looking = true;
  looked = Date.now();
  try {
    const answer = await fetch(address, { headers: { accept: "text/html" } });
    if (answer.ok) exchange(new DOMParser().parseFromString(await answer.text(), "text/html"));
  } catch {
    lineIs("cut");
  } finally {
    looking = false;
  }
  if (again) { again = false; await refresh(); }
}

function exchange(fresh) {
  const focused = document.activeElement?.id;
  for (const part of document.querySelectorAll("[data-part]")) {
    const other = fresh.getElementById(part.id);
    if (!other) { location.reload(); return; } // the view is another one now
    const was = other.outerHTML;
    if (was === written.get(part.id)) continue;
    written.set(part.id, was);
    const open = [...part.querySelectorAll("details[open]")].map((each) => each.id);
    part.replaceWith(other);
    for (const id of open) {
      const same = document.getElementById(id) ?? other.querySelector(`details[id^="${id.split("-")[0]}-"]`);
      if (same) same.open = true;
    }
    if (other.dataset.spoken) speak(other.dataset.spoken);
  }
  document.title = fresh.title;
  if (focused && document.activeElement?.id !== focused) document.getElementById(focused)?.focus({ preventScroll: true });
}

function speak(text) {
  if (Date.now() - spoke < SPEAK) return;
  spoke = Date.now();
  document.getElementById("spoken").textContent = text;
}

// The map: a part is chosen without leaving the page; arrow keys go to the nearest mark in their direction.

document.addEventListener("click", async (event) => {
  const mark = event.target.closest?.("#map a[href]");
  if (!mark || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  const address = mark.getAttribute("href");
  history.replaceState(null, "", address);
  await refresh(address);
  document.getElementById("part-title")?.focus();
});

const DIRECTIONS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

document.addEventListener("keydown", (event) => {
  const mark = event.target.closest?.("a.mark");
  const direction = DIRECTIONS[event.key];
  if (!mark || !direction) return;
  event.preventDefault();
  const next = nearest(mark, direction);
  if (!next) return;
  mark.setAttribute("tabindex", "-1");
  next.setAttribute("tabindex", "0");
  next.focus();
});

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
    if (along + 2 * beside < least) { least = along + 2 * beside; best = each; }
  }
  return best;
}

// Acts: asked for once more, with a name, and then told.

let asked = null;

document.addEventListener("click", (event) => {
  const button = event.target.closest?.("button[data-act]");
  if (!button) return;
  asked = { ...button.dataset, from: button.id };
  document.getElementById("confirm-title").textContent = asked.title;
  document.getElementById("confirm-what").textContent = asked.what;
  document.getElementById("confirm-failed").textContent = "";
  document.getElementById("confirm-author").value = localStorage.getItem("dengine_author") ?? "";
  const versions = document.getElementById("confirm-version-field");
  versions.hidden = asked.act !== "rollback";
  if (!versions.hidden) {
    document.getElementById("confirm-version").replaceChildren(document.getElementById("versions").content.cloneNode(true));
  }
  dialog.showModal();
  document.getElementById("confirm-author").focus();
});

document.getElementById("confirm-cancel").addEventListener("click", () => dialog.close());
dialog.addEventListener("close", () => document.getElementById(asked.from)?.focus()); // its part may be a new one by now

dialog.querySelector("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const author = document.getElementById("confirm-author").value.trim();
  const form = new URLSearchParams({ token: words.token, author });
  if (asked.id) form.set("id", asked.id);
  if (asked.label) form.set("label", asked.label);
  if (asked.act === "rollback") form.set("version", document.getElementById("confirm-version").value);
  const button = document.getElementById("confirm-do");
  button.disabled = true;
  try {
    const answer = await fetch(`${words.root}/acts/${asked.act}`, { method: "POST", body: form });
    await told(answer, author);
  } catch {
    document.getElementById("confirm-failed").textContent = words.unreachable;
  } finally {
    button.disabled = false;
  }
});

async function told(answer, author) {
  const file = answer.headers.get("content-disposition");
  const { said, detail } = file ? {} : await answer.json();
  if (!answer.ok) {
    document.getElementById("confirm-failed").textContent = said ?? detail; // detail: of the guard before the page
    return;
  }
  localStorage.setItem("dengine_author", author);
  if (file) await save(answer, file.match(/filename="([\w.]+)"/)[1]);
  dialog.close();
  say(said ?? words.exported);
  await refresh();
}

async function save(answer, name) {
  const address = URL.createObjectURL(await answer.blob());
  const anchor = Object.assign(document.createElement("a"), { href: address, download: name });
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}

function say(text) {
  const said = document.getElementById("said");
  said.textContent = text;
  setTimeout(() => { if (said.textContent === text) said.textContent = ""; }, 6000);
}

listen();
