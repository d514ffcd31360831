// The actions that people can take: each is confirmed in a dialog, carries the person's name, and shows its result.

import { el } from "./dom.js";
import { post } from "./server.js";

const at = (id) => document.getElementById(id);
const newest = new Map(); // by id of a button: its action as of the last refresh, for an unchanged button stays in the page
let current = null; // the action that the dialog asks about
let openedBy = null; // id of its button
let refresh = () => {};
let owner = { name: "", operates: true };

export const setOwner = (me) => { owner = me; }; // the owner of the page's token

export function button(id, title, action, off = false, ...marks) {
  // action : title and explanation of the dialog; path and body of the request; fields to fill in; resultText(response).
  newest.set(id, action);
  return el("button", { type: "button", id, class: action.quiet ? null : "main", disabled: off || !owner.operates, "data-asks": JSON.stringify(action.body ?? {}), onclick: () => open(id, newest.get(id)) }, ...marks, title);
}

function field({ name, label, options, ...attributes }) {
  const id = `confirm-${name}`;
  const input = options
    ? el("select", { id, name }, options.map(([value, text]) => el("option", { value }, text)))
    : el("input", { id, name, ...attributes });
  return el("p", { class: "field" }, el("label", { for: id }, label), input);
}

function open(id, action) {
  current = action;
  openedBy = id;
  at("confirm-title").textContent = action.title;
  at("confirm-explanation").textContent = action.explanation;
  at("confirm-failed").textContent = "";
  at("confirm-fields").replaceChildren(...(action.fields ?? []).map(field));
  at("confirm-author").value = owner.name || (localStorage.getItem("dengine_author") ?? "");
  at("confirm-author").closest(".field").hidden = owner.name !== ""; // the token has a name
  at("confirm").showModal();
  (at("confirm-fields").querySelector("input, select") ?? at(owner.name ? "confirm-do" : "confirm-author")).focus();
}

// Return the body of the request, from the action and the filled-in fields.
function requestBody() {
  const body = { ...current.body, author: at("confirm-author").value.trim() };
  for (const { name, type } of current.fields ?? []) {
    const value = at(`confirm-${name}`).value.trim();
    if (name === "force_limits") body[name] = value.split(/\s+/).filter(Boolean);
    else if (value !== "") body[name] = type === "number" || name === "version" ? Number(value) : value;
  }
  return body;
}

async function submit(event) {
  event.preventDefault();
  at("confirm-do").disabled = true;
  try {
    const body = requestBody();
    const response = await post(current.path, body);
    showResult(await resultText(response));
    if (!owner.name) localStorage.setItem("dengine_author", body.author);
    at("confirm").close();
    refresh();
  } catch (error) {
    at("confirm-failed").textContent = error.status ? `Not done: ${error.message}` : "The server cannot be reached. It may or may not have been done.";
  } finally {
    at("confirm-do").disabled = false;
  }
}

// Return the text about a response.
async function resultText(response) {
  const data = await response.json();
  return current.resultText ? current.resultText(data) : data.text;
}

export function download(blob, name) {
  const address = URL.createObjectURL(blob);
  el("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}

function showResult(text) {
  at("result").textContent = text;
  setTimeout(() => { if (at("result").textContent === text) at("result").textContent = ""; }, 8000);
}

export function initActions(refreshPage) {
  refresh = refreshPage;
  at("confirm-cancel").addEventListener("click", () => at("confirm").close());
  at("confirm").addEventListener("close", () => at(openedBy)?.focus()); // the button may have been replaced meanwhile
  at("confirm").querySelector("form").addEventListener("submit", submit);
}

// The actions

export const shadow = (on) => (on
  ? { title: "Verify everything", explanation: "From the next part on every part is verified. The model goes on learning.", path: "policy", body: { shadow: true } }
  : { title: "Let the model decide again", explanation: "From the next part on the model decides again which parts need no check.", path: "policy", body: { shadow: false } });

// Return an operator's force limits as they are typed.
function limitsText({ start, end, low, high, channel, along, reject }) {
  const more = [channel !== 0 && `channel=${channel}`, along !== null && `along=${along}`, reject && "reject"];
  return [start, end, low ?? "", high ?? "", ...more.filter(Boolean)].join(":");
}

export const policy = (now) => ({
  title: "Change the policy", path: "policy",
  explanation: "How certain the model must be, from the next part on. Earlier decisions keep their bounds; the guarantee starts to count again.",
  fields: [
    { name: "alpha", label: "alpha, the error level of the interval", type: "number", min: 0.0001, max: 0.9999, step: "any", value: now.alpha, required: true },
    { name: "lower_bound", label: "Lower bound that a success rate must reach", type: "number", min: 0.5001, max: 0.9999, step: "any", value: now.lower_bound, required: true },
    { name: "audit_rate", label: "Share of certain parts that are verified (audits)", type: "number", min: 0, max: 1, step: "any", value: now.audit_rate, required: true },
    { name: "force_limits", label: "Force limits, START:END:LOW:HIGH, separated by blanks; :reject rejects", value: now.force_limits.map(limitsText).join(" ") },
  ],
});

export const rollback = (versions) => ({
  title: "Roll back", path: "rollback",
  explanation: "An earlier model decides again, as a new version, until it is released or somebody retrains. Labels and corrections since then are kept.",
  fields: [{ name: "version", label: "Version", options: versions }],
});

export const release = { title: "Release the version", explanation: "The next retrain may replace the model that was rolled back to.", path: "release" };

export const retrain = { title: "Retrain now", explanation: "The model is trained on all labels so far.", path: "retrain" };

export const correct = (id, success) => ({
  title: "Correct the label", path: "correct", body: { id, success }, quiet: true,
  explanation: `The part then counts as ${success ? "good" : "bad"}, in training and in all counts. The old label stays on record.`,
});

export const forget = (id) => ({
  title: "Forget the label", path: "forget", body: { ids: [id] }, quiet: true,
  explanation: "The label is left out of training and of all counts. It stays on record, and a correction takes it in again.",
  fields: [{ name: "reason", label: "Why" }],
});

const reportText = (response) => `Recorded: ${response.success ? "good" : "bad"}${response.repeated ? ", as before" : ""}.`;

export const report = (id, success, stop) => ({
  title: success ? "Report it as good" : "Report it as bad", path: "report", body: { id, success }, quiet: true, resultText: reportText,
  explanation: stop ? "The part was accepted, and was bad: it counts as a line stop." : `A check found that the part is ${success ? "good" : "bad"}.`,
});

export const reportPart = {
  title: "This accepted part was bad", path: "report", resultText: reportText,
  explanation: "A part that went on without a check turned out bad: it counts as a line stop.",
  fields: [{ name: "part", label: "Its number, or the id of its decision", required: true }],
  body: { success: false },
};
