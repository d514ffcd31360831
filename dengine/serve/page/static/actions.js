// What people may do: each action is asked for once more, carries a name, and is told when it is done.

import { el } from "./dom.js";
import { post } from "./server.js";

const at = (id) => document.getElementById(id);
let asked = null;
let from = null;
let after = () => {};
let owner = { name: "", operates: true };

export const ownedBy = (me) => { owner = me; };
export const looksOnly = () => !owner.operates;

export function button(id, title, action, off = false, ...marks) {
  // action : title, what; path and body of the request; fields that are asked for; done, what is said of an answer.
  return el("button", { type: "button", id, class: action.quiet ? null : "main", disabled: off || looksOnly(), "data-asks": JSON.stringify(action.body ?? {}), onclick: () => open(id, action) }, ...marks, title);
}

function field({ name, label, options, ...given }) {
  const id = `confirm-${name}`;
  const input = options
    ? el("select", { id, name }, options.map(([value, text]) => el("option", { value }, text)))
    : el("input", { id, name, ...given });
  return el("p", { class: "field" }, el("label", { for: id }, label), input);
}

function open(id, action) {
  [asked, from] = [action, id];
  at("confirm-title").textContent = action.title;
  at("confirm-what").textContent = action.what;
  at("confirm-failed").textContent = "";
  at("confirm-fields").replaceChildren(...(action.fields ?? []).map(field));
  at("confirm-author").value = owner.name || (localStorage.getItem("dengine_author") ?? "");
  at("confirm-author").closest(".field").hidden = owner.name !== ""; // the token has a name
  at("confirm").showModal();
  (at("confirm-fields").querySelector("input, select") ?? at(owner.name ? "confirm-do" : "confirm-author")).focus();
}

function body() {
  const said = { ...asked.body, author: at("confirm-author").value.trim() };
  for (const { name, type } of asked.fields ?? []) {
    const value = at(`confirm-${name}`).value.trim();
    if (name === "windows") said[name] = value.split(/\s+/).filter(Boolean);
    else if (value !== "") said[name] = type === "number" || name === "version" ? Number(value) : value;
  }
  return said;
}

async function submit(event) {
  event.preventDefault();
  at("confirm-do").disabled = true;
  try {
    const said = body();
    const answer = await post(asked.path, said);
    const file = answer.headers.get("content-disposition");
    const text = file ? await save(answer, file.match(/filename="([\w.]+)"/)[1]) : asked.done?.(await answer.clone().json()) ?? (await answer.json()).text;
    if (!owner.name) localStorage.setItem("dengine_author", said.author);
    at("confirm").close();
    say(text);
    after();
  } catch (error) {
    at("confirm-failed").textContent = error.status ? `It was not done: ${error.message}` : "It was not done, or it is not known whether: the server cannot be reached.";
  } finally {
    at("confirm-do").disabled = false;
  }
}

async function save(answer, name) {
  download(await answer.blob(), name);
  return "The file was downloaded.";
}

export function download(blob, name) {
  const address = URL.createObjectURL(blob);
  el("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}

function say(text) {
  at("said").textContent = text;
  setTimeout(() => { if (at("said").textContent === text) at("said").textContent = ""; }, 8000);
}

export function begin(refresh) {
  after = refresh;
  at("confirm-cancel").addEventListener("click", () => at("confirm").close());
  at("confirm").addEventListener("close", () => at(from)?.focus()); // its part of the page may be a new one by now
  at("confirm").querySelector("form").addEventListener("submit", submit);
}

// The actions

export const shadow = (on) => (on
  ? { title: "Verify everything", what: "From the next part on every part is verified. The model goes on learning.", path: "policy", body: { shadow: true } }
  : { title: "Let the model decide again", what: "From the next part on the model decides again which parts need no check.", path: "policy", body: { shadow: false } });

function windowText({ start, end, low, high, channel, along, reject }) {
  const more = [channel !== 0 && `channel=${channel}`, along !== null && `along=${along}`, reject && "reject"];
  return [start, end, low ?? "", high ?? "", ...more.filter(Boolean)].join(":");
}

export const policy = (now) => ({
  title: "Change the policy", path: "policy",
  what: "How certain the model must be, from the next part on. What was decided keeps its bounds; the guarantee counts anew.",
  fields: [
    { name: "alpha", label: "alpha, the error of the interval", type: "number", min: 0.0001, max: 0.9999, step: "any", value: now.alpha, required: true },
    { name: "lower_bound", label: "Lower bound that a success rate must reach", type: "number", min: 0.5001, max: 0.9999, step: "any", value: now.lower_bound, required: true },
    { name: "audit_rate", label: "Share of certain parts that are verified all the same", type: "number", min: 0, max: 1, step: "any", value: now.audit_rate, required: true },
    { name: "windows", label: "Windows, START:END:LOW:HIGH, with a blank between; :reject rejects", value: now.windows.map(windowText).join(" ") },
  ],
});

export const rollback = (versions) => ({
  title: "Roll back", path: "rollback",
  what: "An earlier model answers again, as a new version. Labels and corrections since then are kept.",
  fields: [{ name: "version", label: "Version", options: versions }],
});

export const retrain = { title: "Retrain now", what: "The model is trained on all labels known by now.", path: "retrain" };
export const exported = { title: "Export", what: "The model that answers now, as a TorchScript file for a controller, with its checksum.", path: "export" };

export const correct = (id, success) => ({
  title: "Correct the label", path: "correct", body: { id, success }, quiet: true,
  what: `The part then counts as ${success ? "good" : "bad"}, in all that is learned and counted. The old label is kept on record.`,
});

export const forget = (id) => ({
  title: "Forget the label", path: "forget", body: { ids: [id] }, quiet: true,
  what: "The label takes no part in anything that is learned or counted. It stays on record, and a correction brings it back.",
  fields: [{ name: "reason", label: "Why" }],
});

const reported = (answer) => `It is recorded: ${answer.success ? "good" : "bad"}${answer.repeated ? ", as it was before" : ""}.`;

export const report = (id, success, stop) => ({
  title: success ? "Report it as good" : "Report it as bad", path: "report", body: { id, success }, quiet: true, done: reported,
  what: stop ? "The part was accepted, and came back: it counts as a system stop." : `The part was ${success ? "good" : "bad"}, as a check has found.`,
});

export const reportPart = {
  title: "This accepted part was bad", path: "report", done: reported,
  what: "A part that went on without a check, and came back: it counts as a system stop.",
  fields: [{ name: "part", label: "Its number, or the id of its decision", required: true }],
  body: { success: false },
};
